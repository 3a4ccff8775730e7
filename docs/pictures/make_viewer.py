"""Take the screenshots of the web viewer for docs/viewer.md, in a headless Chromium.

Needs `pip install 'handtrack[viewer]' playwright` and a Chromium on the PATH.

Usage: python docs/pictures/make_viewer.py [--out docs/pictures]
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

SIZE = {"width": 1200, "height": 760}
PLACE, FURTHER = 98, 8
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-background-networking",
]  # fmt: skip


def main() -> None:
    """Start `handtrack view`, look at it, end it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    options = parser.parse_args()
    words = [sys.executable, "-m", "handtrack", "view", "--port", "0", "--speed", "1/4"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = re.search(r"http://\S+", process.stdout.readline())
        assert address is not None
        take(address.group(), options.out)
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(20)


def take(url: str, folder: Path) -> None:
    """Take both screenshots."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
        page.goto(url)
        page.wait_for_selector("#handtrack-count", timeout=180_000)
        page.locator(".mantine-Notification-closeButton").first.click()
        go_to(page, PLACE)
        page.screenshot(path=folder / "viewer.png")
        page.get_by_label("Hypotheses").click()
        page.wait_for_selector("#handtrack-hypotheses", timeout=60_000)
        page.wait_for_timeout(2000)
        page.screenshot(path=folder / "viewer_hypotheses.png")
        browser.close()


def go_to(page: Any, place: int) -> None:
    """Pause at a frame, and wait until it is drawn."""
    page.get_by_role("button", name="Pause", exact=True).click()
    number = page.locator("input[inputmode=decimal]").first
    number.fill(str(place))
    number.press("Enter")
    page.wait_for_function(
        "text => document.getElementById('handtrack-frame').innerText.startsWith(text)",
        arg=f"frame {place} ", timeout=60_000,
    )  # fmt: skip
    # Some frames further on, the tracker has settled.
    for _ in range(FURTHER):
        count = page.inner_text("#handtrack-count")
        page.get_by_role("button", name="forward", exact=True).click()
        page.wait_for_function(
            "count => document.getElementById('handtrack-count').innerText != count",
            arg=count, timeout=60_000,
        )  # fmt: skip
    page.wait_for_timeout(2000)


if __name__ == "__main__":
    main()
