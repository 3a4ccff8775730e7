"""Errors raised by handtrack: each a `HandtrackError` and the built-in error a caller expects."""


class HandtrackError(Exception):
    """Root of all errors that handtrack raises on purpose."""


class InputError(HandtrackError, ValueError):
    """A value given by the caller is unusable: wrong shape, type, range or name."""


class MissingFileError(HandtrackError, FileNotFoundError):
    """A file that is needed is not there."""


class DamagedFileError(HandtrackError, ValueError):
    """A file is there but cannot be read as what it should be."""


class DeviceError(HandtrackError, RuntimeError):
    """The requested compute device does not exist or cannot run the kernels."""


class MissingDependencyError(HandtrackError, ImportError):
    """An optional package is needed for this call and is not installed."""
