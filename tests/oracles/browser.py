"""A headless Chromium for tests of the web page; tests are skipped where there is none."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

VARIABLE = "HANDTRACK_CHROMIUM"
"""Environment variable that names the browser."""

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
"""No window, no graphics card, and no talking to anybody but the page."""


def headless_browser() -> Iterator[Any]:
    """A browser of Playwright's, closed at the end."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = [os.environ[VARIABLE]] if VARIABLE in os.environ else NAMES
    path = next((found for name in names if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(names)} is installed ({VARIABLE} names one)")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, headless=True, args=list(FLAGS))
        yield browser
        browser.close()
