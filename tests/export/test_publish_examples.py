"""The example clients, against a publisher."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from handtrack.export.publisher import Publisher
from handtrack.hand.side import Side
from handtrack.tracking.result import HandResult
from oracles.browser import headless_browser

EXAMPLES = Path(__file__).parents[2] / "examples"

pytest.importorskip("websockets", reason="websockets, which publishing needs, is not installed")


@contextmanager
def publishing(results: list[HandResult], frame_at: Callable[[int], Any]) -> Iterator[Publisher]:
    """Publishes the results over and over, 50 a second."""
    stop = threading.Event()

    def run(publisher: Publisher) -> None:
        place = 0
        while not stop.wait(0.02):
            publisher.frame(frame_at(place), results[place % len(results)])
            place += 1

    with Publisher(port=0) as publisher:
        thread = threading.Thread(target=run, args=(publisher,), daemon=True)
        thread.start()
        try:
            yield publisher
        finally:
            stop.set()
            thread.join()


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location("example", EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_python_client_prints_the_fingertip(
    hand_results: list[HandResult],
    frame_at: Callable[[int], Any],
    capsys: pytest.CaptureFixture[str],
) -> None:
    with publishing(hand_results, frame_at) as publisher:
        load("04_receive_published_frames").main(publisher.url, frames=len(hand_results))
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith(f"{len(hand_results)} frames, ")
    assert sum("index tip" in line for line in lines) >= 8
    assert any("no_hand: nothing there" in line for line in lines)


@pytest.fixture
def browser() -> Iterator[Any]:
    yield from headless_browser()


@pytest.mark.parametrize("side", ["left"], indirect=True, scope="session")
def test_the_page_draws_the_hand(
    hand_results: list[HandResult], frame_at: Callable[[int], Any], side: Side, browser: Any
) -> None:
    with publishing(hand_results[2:8], frame_at) as publisher:
        page = browser.new_page(viewport={"width": 640, "height": 480})
        problems: list[str] = []
        page.on("console", lambda message: problems.append(message.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(f"file://{EXAMPLES / 'published_hand.html'}?{publisher.url}")
        page.wait_for_function("document.getElementById('status').textContent.includes('tracking')")
        assert f"{side} hand" in page.inner_text("#status")
        drawn = page.evaluate(
            "() => { const c = document.getElementById('view');"
            " const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
            " let n = 0; for (let k = 3; k < d.length; k += 4) n += d[k] > 0; return n; }"
        )
        assert 500 < drawn < 100_000 and not problems
