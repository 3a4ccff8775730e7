"""Importing packages of extras: each failure says in one line what is to be done."""

import sys

import pytest

from handtrack.errors import MissingDependencyError
from handtrack.optional import import_extra


def test_a_package_that_is_not_installed_is_told_with_what_to_type():
    with pytest.raises(MissingDependencyError, match=r"pip install 'handtrack\[rosbag\]'"):
        import_extra("a_module_that_is_nowhere", "rosbag", "reading a bag")


def test_a_package_that_cannot_be_loaded_is_not_to_be_installed_again(tmp_path, monkeypatch):
    package = tmp_path / "half_installed"
    package.mkdir()
    (package / "__init__.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "half_installed", raising=False)
    with pytest.raises(MissingDependencyError, match="cannot be loaded: libusb") as caught:
        import_extra("half_installed", "realsense", "a RealSense camera")
    assert "pip install" not in str(caught.value)
