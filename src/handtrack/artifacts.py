"""Where artifacts, sample data and benchmark cases lie: in the installed package, or a checkout."""

from __future__ import annotations

from pathlib import Path

from handtrack.errors import MissingFileError

_PACKAGE = Path(__file__).resolve().parent
_FOLDERS = ("models", "data", "benchmarks")


def artifact_root() -> Path:
    """Folder with `models/`, `data/` and `benchmarks/`: in a wheel's package, else the checkout."""
    packed = _PACKAGE / "_artifacts"
    return packed if packed.is_dir() else _PACKAGE.parents[1]


def artifact_path(name: str) -> Path:
    """Path of a trained artifact, sample data or benchmark cases that come with handtrack.

    Args:
        name: Such as "hand.npz" or "models/hand.npz", "demo.npz" or "data/demo.npz",
            "benchmarks/tracking.toml".

    Raises:
        MissingFileError: Nothing of that name comes with this installation.
    """
    root = artifact_root()
    for candidate in (root / folder / name for folder in _FOLDERS):
        if candidate.exists():
            return candidate
    if name.startswith(tuple(f"{folder}/" for folder in _FOLDERS)) and (root / name).exists():
        return root / name
    held = ", ".join(path.relative_to(root).as_posix() for path in artifact_files()) or "nothing"
    raise MissingFileError(
        f"{name!r} does not come with this handtrack: {root} holds {held}; install handtrack "
        "again, or build the artifact as models/README.md says"
    )


def artifact_files() -> list[Path]:
    """All trained artifacts and recordings that come with this installation."""
    root = artifact_root()
    return [path for folder in _FOLDERS for path in sorted((root / folder).glob("**/*.npz"))]
