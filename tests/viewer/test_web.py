"""The web page in a real browser: no errors, the hand where it is, controls that act."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed")

from handtrack.camera.sequence import RecordedSequence
from handtrack.errors import InputError, MissingDependencyError
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.tracking.result import TrackState
from handtrack.tracking.tracker import HandTracker
from handtrack.viewer.controls import Controls, Wishes
from handtrack.viewer.depth_colours import colour_depth
from handtrack.viewer.loop import TrackingLoop
from handtrack.viewer.playback import Playback
from handtrack.viewer.viewer import View
from handtrack.viewer.web import ViewerError, WebViewer
from handtrack.viewer.web_panel import panel_picture, state_text
from handtrack.viewer.web_scene import SKIN
from oracles.browser import headless_browser
from oracles.collector import Collector, wait_until

pytestmark = pytest.mark.slow

TRACKERS = ("hybrid", "pso")


class Page:
    """A page that shows the loop, and what it complained about."""

    def __init__(self, browser: Any, viewer: WebViewer) -> None:
        self.errors: list[str] = []
        self.tab = browser.new_page(viewport={"width": 800, "height": 600})
        self.tab.on("console", self._listen)
        self.tab.on("pageerror", lambda error: self.errors.append(str(error)))
        self.tab.on("requestfailed", lambda request: self.errors.append(request.url[:200]))
        self.tab.goto(viewer.url)
        self.tab.wait_for_selector("#handtrack-count", timeout=60_000)

    def _listen(self, message: Any) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def text(self, name: str) -> str:
        """Text of an element of the panel."""
        return self.tab.inner_text(f"#handtrack-{name}")

    def wait(self, name: str, text: str) -> None:
        """Wait for a text in an element of the panel."""
        self.tab.wait_for_function(
            "([name, text]) => document.getElementById(name)?.innerText == text",
            arg=[f"handtrack-{name}", text], timeout=20_000,
        )  # fmt: skip

    def press(self, label: str) -> None:
        """Press a button."""
        self.tab.get_by_role("button", name=label, exact=True).first.click()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    yield from headless_browser()


class Session:
    """A loop over the sample in a thread of its own, with a web viewer."""

    def __init__(
        self, sample: RecordedSequence, make_tracker: Callable[[str], HandTracker], start: Any
    ) -> None:
        self.controls = Controls(Wishes(tracker="hybrid", speed=0.25))
        self.sink = Collector()
        self.recorders: list[Collector] = []
        self.viewer = WebViewer(
            self.controls, trackers=TRACKERS, length=len(sample), can_record=True, port=0
        )
        self.loop = TrackingLoop(
            Playback(sample), make_tracker, self.controls, viewer=self.viewer, sinks=[self.sink],
            make_recorder=self._make_recorder, linger=True,
        )  # fmt: skip
        start(self.loop.run)

    def _make_recorder(self) -> Collector:
        self.recorders.append(Collector())
        return self.recorders[-1]


@pytest.fixture
def session(
    sample: RecordedSequence, make_tracker: Callable[[str], HandTracker], in_thread: Any
) -> Iterator[Session]:
    session = Session(sample, make_tracker, in_thread)
    yield session
    session.controls.stop()


def test_the_page_works(
    browser: Any, session: Session, sample: RecordedSequence, tmp_path: Path
) -> None:
    # One page for all of it: a browser that draws without a graphics card starts slowly.
    page = Page(browser, session.viewer)
    wait_until(lambda: session.viewer.drawn > 3)
    assert page.text("state") == "tracking" and page.text("tracker") == "hybrid"
    # Pause stops the counter, step advances by one.
    page.press("Pause")
    wait_until(lambda: session.controls.wishes.paused)
    page.tab.get_by_role("button", name="Play", exact=True).wait_for()
    page.wait("count", str(session.loop.count))
    count, place = session.loop.count, session.sink.places[-1]
    page.tab.wait_for_timeout(400)
    assert session.loop.count == count and page.text("count") == str(count)
    page.press("forward")
    page.wait("count", str(count + 1))
    assert session.sink.places[-1] == (place + 1) % len(sample)
    page.press("back")
    page.wait("frame", f"frame {place} of {len(sample)}")

    # Scrubbing: the number beside the slider.
    number = page.tab.locator("input[inputmode=numeric], input[inputmode=decimal]").first
    number.fill("120")
    number.press("Enter")
    page.wait("frame", f"frame 120 of {len(sample)}")

    check_image(page, session)
    check_scene(session, sample)

    # Another tracker, by the list.
    page.tab.locator("input[role=combobox][value=hybrid]").click()
    page.tab.get_by_role("option", name="pso").click()
    page.wait("tracker", "pso")
    assert session.controls.wishes.tracker == "pso"

    # A screenshot is a file with a picture of the scene.
    with page.tab.expect_download(timeout=60_000) as download:
        page.press("Screenshot")
    download.value.save_as(tmp_path / "shot.png")
    picture = cv2.imread(str(tmp_path / "shot.png"))
    assert picture.shape == (720, 960, 3) and len(np.unique(picture.reshape(-1, 3), axis=0)) > 500

    # Recording: what is tracked between two presses.
    page.press("Record")
    wait_until(lambda: bool(session.recorders))
    page.press("forward")
    wait_until(lambda: len(session.recorders[0].frames) == 1)
    page.press("Stop recording")
    wait_until(lambda: session.recorders[0].closed == 1)

    page.press("Play")
    wait_until(lambda: session.loop.count > count + 8)
    assert not page.errors
    page.tab.close()


def check_image(page: Page, session: Session) -> None:
    """The image in the panel is the depth image with the skeleton, and large enough to be seen."""
    element = page.tab.locator("#handtrack-image")
    data = element.get_attribute("src").partition("base64,")[2]
    seen = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    view, ends = session.viewer._last, session.viewer._panel._range
    assert view is not None and ends is not None
    expected = panel_picture(view, ends)
    assert seen.shape == expected.shape
    assert np.abs(seen.astype(int) - expected).mean() < 6
    bare = colour_depth(view.frame.depth, *ends)
    assert np.abs(bare.astype(int) - expected).max(axis=-1).mean() > 1, "skeleton"
    screen = cv2.imdecode(np.frombuffer(element.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert min(screen.shape[:2]) > 150
    assert 0.02 < (screen.max(axis=-1) > 120).mean() < 0.6


def check_scene(session: Session, sample: RecordedSequence) -> None:
    """From where the depth camera is, the mesh covers what our own renderer draws."""
    view = session.viewer._last
    assert view is not None and view.frame.index == 120
    session.viewer._scene.show_points = session.viewer._scene.show_skeleton = False
    session.viewer._scene.draw(view)
    camera = sample.camera
    client = next(iter(session.viewer._server.get_clients().values()))
    expected = DepthRenderer(view.hand.hand, camera, device="cpu").render(view.hand.pose)[0] > 0

    def overlap() -> float:
        picture = client.get_render(
            camera.height, camera.width, wxyz=(1, 0, 0, 0), position=(0, 0, 0),
            fov=2 * math.atan(0.5 * camera.height / camera.fy), transport_format="png", timeout=30,
        )  # fmt: skip
        seen = picture[..., 3] > 60
        skin = picture[expected & seen][:, :3].astype(float)
        if not len(skin):
            return 0.0
        # The colour of skin, in all shades of light.
        hue = skin.mean(axis=0) / skin.mean()
        wanted = np.array(SKIN) / np.mean(SKIN)
        assert np.abs(hue - wanted).max() < 0.25 and skin.mean(axis=1).std() > 5
        return float((expected & seen).sum() / (expected | seen).sum())

    # What was sent is drawn a moment later.
    best = 0.0
    for _ in range(10):
        best = max(best, overlap())
        if best > 0.85:
            break
    assert best > 0.85, f"mesh and reference overlap by {best:.2f}"
    session.viewer._scene.show_points = session.viewer._scene.show_skeleton = True
    session.viewer._scene.draw(view)


def test_nothing_is_drawn_for_nobody_and_a_screenshot_needs_somebody(
    session: Session,
) -> None:
    wait_until(lambda: session.loop.count > 5)
    assert session.viewer.drawn == 0 and session.viewer.clients == 0
    with pytest.raises(ViewerError, match="open it first"):
        session.viewer.screenshot()


def test_only_this_machine_is_listened_to_by_default(session: Session) -> None:
    assert session.viewer.url.startswith("http://127.0.0.1:")
    assert session.viewer._server.get_host() == "127.0.0.1"


@pytest.mark.parametrize(
    ("host", "port", "word"), [("999.1.2.3", 0, "listen"), ("127.0.0.1", 70000, "port")]
)
def test_addresses_that_do_not_exist_are_refused(host: str, port: int, word: str) -> None:
    with pytest.raises(InputError, match=word):
        WebViewer(Controls(Wishes(tracker="hybrid")), trackers=TRACKERS, host=host, port=port)


def test_without_viser_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(MissingDependencyError, match=r"handtrack\[viewer\]"):
        WebViewer(Controls(Wishes(tracker="hybrid")), trackers=TRACKERS)


def test_a_lost_hand_is_told(
    sample: RecordedSequence, make_tracker: Callable[[str], HandTracker]
) -> None:
    tracker = make_tracker("hybrid")
    tracker.track(sample[0].depth)
    hand = tracker.track(np.zeros(sample.camera.shape, np.float32))
    assert hand.state is TrackState.LOST
    text = state_text(View(
        frame=sample[1], hand=hand, tracker="<b>", rate=np.nan, count=2, notice="camera & cable",
    ))  # fmt: skip
    assert "lost" in text and "camera &amp; cable" in text and "&lt;b&gt;" in text
    assert hand.problem is not None and hand.problem in text
