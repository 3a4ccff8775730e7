"""Packages that only some parts need: importing them, and saying how to install them."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from handtrack.errors import MissingDependencyError

EXTRAS: dict[str, tuple[str, ...]] = {
    "realsense": ("pyrealsense2",),
    "rosbag": ("rosbags",),
    "cluster": ("dask", "distributed"),
    "viewer": ("viser",),
    "publish": ("websockets",),
    "physics": ("mujoco", "daqp", "coacd"),
}
"""Extra of this distribution -> the modules that it installs."""


def import_extra(module: str, extra: str, purpose: str) -> ModuleType:
    """Import a module of an extra.

    Args:
        module: The module, such as "rosbags.highlevel".
        extra: The extra that installs it, a key of `EXTRAS`.
        purpose: What it is needed for: the start of the message.

    Raises:
        MissingDependencyError: It is not installed; the message is one line with what to type.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        if find_spec(package) is not None:  # there, but a part of the system that it needs is not
            raise MissingDependencyError(
                f"{purpose} needs the package {package}, which is installed but cannot be "
                f"loaded: {error}"
            ) from error
        raise MissingDependencyError(
            f"{purpose} needs the package {package} ({error}): pip install 'handtrack[{extra}]'"
        ) from error


def installed(extra: str) -> bool:
    """Whether all modules of an extra are there; nothing is imported for the answer."""
    return all(find_spec(module) is not None for module in EXTRAS[extra])
