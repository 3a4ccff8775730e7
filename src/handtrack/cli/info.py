"""`handtrack info`: everything that a bug report should say about an installation."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from handtrack.camera.source import FORMATS, LIVE_SOURCES, reader
from handtrack.optional import EXTRAS, installed

PACKAGES = (
    "numpy", "scipy", "warp-lang", "opencv-python-headless", "trimesh", "scikit-learn", "tyro",
    "rich", "joblib", "mujoco", "viser", "pyrealsense2", "rosbags", "dask", "distributed",
)  # fmt: skip
"""Packages whose versions are told, core ones first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InfoOptions:
    """Show versions, devices, artifacts and readers: what to put into a bug report.

    Examples::

        handtrack info
        handtrack info --json
    """

    json: bool = False
    """Print JSON instead of a table."""


def run(options: InfoOptions) -> int:
    """Print what `collect` found.

    Args:
        options: The command's options.

    Returns:
        Exit code 0.
    """
    facts = collect()
    if options.json:
        print(json.dumps(facts, indent=2))
        return 0
    from rich.console import Console
    from rich.text import Text

    # Lines are not broken: there are commands among them, and this goes into bug reports.
    console = Console(soft_wrap=True, highlight=False)
    width = max(len(name) for values in facts.values() for name in values)
    for section, values in facts.items():
        console.print(Text(section, style="bold"))
        for name, value in values.items():
            console.print(Text(f"  {name:<{width}}  {value}"))
    return 0


def collect() -> dict[str, dict[str, Any]]:
    """Facts about the installation: section -> name -> value."""
    return {
        "versions": _versions(),
        "devices": _devices(),
        "artifacts": _artifacts(),
        "sequence formats": _formats(),
        "live sources": dict(LIVE_SOURCES),
        "extras": _extras(),
    }


def _versions() -> dict[str, str]:
    """handtrack, Python and the packages it uses."""
    from importlib.metadata import PackageNotFoundError, version

    from handtrack import __version__

    versions = {
        "handtrack": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def _devices() -> dict[str, str]:
    """Devices that kernels can run on, and where compiled kernels are kept."""
    from handtrack.cli import compute_device

    chosen = compute_device("auto")
    import warp as wp

    devices: dict[str, str] = {}
    for device in wp.get_devices():
        if device.is_cuda:
            memory = device.total_memory / 2**30
            devices[device.alias] = f"{device.name}, {memory:.0f} GiB, sm_{device.arch}"
        else:
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
            devices[device.alias] = f"{platform.machine()}, {cores or os.cpu_count()} cores"
    devices["auto means"] = chosen.alias
    devices["kernel cache"] = str(wp.config.kernel_cache_dir)
    return devices


def _artifacts() -> dict[str, str]:
    """Artifacts and recordings that come with this installation."""
    from handtrack.artifacts import artifact_files, artifact_root

    root = artifact_root()
    facts = {"folder": str(root)}
    for path in artifact_files():
        megabytes = path.stat().st_size / 1e6
        facts[path.relative_to(root).as_posix()] = f"{megabytes:.2f} MB, sha256 {_sha256(path)}"
    return facts


def _formats() -> dict[str, str]:
    """Formats that `open_sequence` reads, with what some of them need."""
    told = {}
    for name in FORMATS:
        extra = reader(name).extra
        missing = extra is not None and not installed(extra)
        told[name] = reader(name).layout + (f" [needs the extra {extra}]" if missing else "")
    return told


def _extras() -> dict[str, str]:
    """Optional parts of this distribution, and how to install those that are missing."""
    return {
        extra: "installed" if installed(extra) else f"missing: pip install 'handtrack[{extra}]'"
        for extra in EXTRAS
    }


def _sha256(path: Path) -> str:
    """First 16 digits of a file's SHA-256."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]
