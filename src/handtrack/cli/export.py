"""`handtrack export`: results of tracking in the formats of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Write tracked hands for spreadsheets, animation, virtual reality and biomechanics.

    RESULTS is the results.npz that `handtrack track` writes, or its folder. docs/exports.md says
    what each format holds, in which axes and units, and how it was checked.

    Examples::

        handtrack export out/demo --to glb --out hand.glb
        handtrack export out/demo/results.npz --to csv --out hand.csv
    """

    results: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")]
    """results.npz, or the folder that holds it."""
    to: Literal["csv", "jsonl", "npz", "bvh", "glb", "openxr", "trc"]
    """Format: csv, jsonl (JSON lines), npz (NumPy), bvh and glb (animation; glTF with skinned
    mesh), openxr (26 joints, JSON lines), trc (markers for OpenSim)."""
    out: Path
    """File to write."""


def run(options: ExportOptions) -> int:
    """Read, write, say what was written.

    Args:
        options: The command's options.

    Returns:
        Exit code 0.

    Raises:
        HandtrackError: The results cannot be read or the file cannot be written.
    """
    # Imported here: `handtrack --help` need not wait for SciPy.
    from handtrack.errors import InputError
    from handtrack.export.formats import FORMATS, write_track
    from handtrack.export.track import read_track

    source = options.results / "results.npz" if options.results.is_dir() else options.results
    if options.out.resolve() == source.resolve():
        raise InputError(f"{options.out} is the file that is read: name another one")
    track = read_track(source)
    write_track(track, options.out, options.to)
    followed = int(track.followed.sum())
    print(f"written to {options.out}: {len(track)} frames of a {track.side} hand")
    if followed < len(track):
        lost = FORMATS[options.to].lost
        print(f"the hand was followed in {followed} of them; the others {lost}")
    return 0
