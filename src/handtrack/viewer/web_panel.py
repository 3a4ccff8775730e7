"""The control panel of the web viewer: depth image, state, timings, and the user's controls."""

from __future__ import annotations

import base64
import html
import time
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from handtrack.tracking.result import HandResult, TrackState
from handtrack.viewer.controls import SPEEDS, Controls
from handtrack.viewer.depth_colours import Image, colour_depth, depth_range
from handtrack.viewer.pictures import STATE_COLOURS, draw_skeleton
from handtrack.viewer.viewer import View
from handtrack.viewer.web_scene import change

if TYPE_CHECKING:
    import viser

IMAGE_WIDTH = 320
"""Width of the depth image in the panel [pixels]."""

TEXT_PERIOD = 0.1
"""Texts that nobody could read faster change at most once in so long [s]."""

SCRUB_HOLD = 0.6
"""For so long after the user moved the slider it is not moved by the loop [s]."""

LOADING = (
    "Loading the tracker. Its kernels are compiled on the first start, which takes about a minute; "
    "later starts take seconds."
)
"""What stands in the place of the state before the first frame."""

_TIMED = 30
"""Frames whose median time is shown."""


class WebPanel:
    """The panel's elements; each view changes what they show, the user changes `Controls`."""

    def __init__(
        self,
        server: viser.ViserServer,
        controls: Controls,
        *,
        trackers: Sequence[str],
        length: int | None,
        live: bool,
        can_record: bool,
    ) -> None:
        """Add the elements.

        Args:
            server: The web server, whose panel is empty.
            controls: What the user's wishes go to.
            trackers: Names of the trackers to choose from.
            length: Number of frames of a recording, None without an end.
            live: Whether frames come from a device.
            can_record: Whether there is anything to record to.
        """
        self._controls, self._length, self._live = controls, length, live
        self._timings: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=_TIMED))
        self._text_time = self._scrub_time = -np.inf
        self._range: tuple[float, float] | None = None
        gui = server.gui
        self._image = gui.add_html("")
        self._state = gui.add_html(_framed(LOADING))
        wishes = controls.wishes
        with gui.add_folder("Live" if live else "Playback"):
            self._play = gui.add_button("Pause", hint="Pause, or go on")
            self._steps = gui.add_button_group("Step", ("back", "forward"))
            self._slider = gui.add_slider("Frame", 0, max(1, (length or 1) - 1), 1, 0)
            current = next(name for name, speed in SPEEDS.items() if speed == wishes.speed)
            self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value=current)
            self._repeat = gui.add_checkbox("Repeat", wishes.repeat)
        for control in (self._steps, self._slider, self._speed, self._repeat):
            control.visible = not live
        self._slider.visible = bool(length)
        with gui.add_folder("Tracking"):
            self._tracker = gui.add_dropdown(
                "Tracker", tuple(trackers), initial_value=wishes.tracker
            )
            self._hypotheses = gui.add_checkbox(
                "Hypotheses", wishes.hypotheses, hint="Poses that compete, green is best"
            )
            self._record = gui.add_button("Record", visible=can_record)
            self.screenshot = gui.add_button("Screenshot")
        with gui.add_folder("Timings", expand_by_default=False):
            self._table = gui.add_html("")
        self._connect()

    def _connect(self) -> None:
        """Pass the user's actions on; changes that the loop itself makes are no wishes."""
        controls = self._controls

        @self._play.on_click
        def _(_: Any) -> None:
            controls.change(paused=not controls.wishes.paused)

        @self._steps.on_click
        def _(event: Any) -> None:
            controls.step(1 if event.target.value == "forward" else -1)

        @self._record.on_click
        def _(_: Any) -> None:
            controls.change(recording=not controls.wishes.recording)

        @self._slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self._scrub_time = time.monotonic()
                controls.go_to(int(event.target.value))

        @self._speed.on_update
        def _(event: Any) -> None:
            controls.change(speed=SPEEDS[event.target.value])

        @self._repeat.on_update
        def _(event: Any) -> None:
            controls.change(repeat=bool(event.target.value))

        @self._hypotheses.on_update
        def _(event: Any) -> None:
            controls.change(hypotheses=bool(event.target.value))

        @self._tracker.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                controls.change(tracker=str(event.target.value))

    def draw(self, view: View) -> None:
        """Show a view."""
        self._note_timings(view)
        change(self._play, label="Play" if view.paused else "Pause")
        change(
            self._record, label="Stop recording" if view.recording else "Record",
            color="red" if view.recording else None,
        )  # fmt: skip
        change(self._tracker, value=view.tracker)
        now = time.monotonic()
        self._image.content = image_text(panel_picture(view, self._follow(view)))
        if view.paused or now - self._text_time > TEXT_PERIOD:
            self._text_time = now
            change(self._state, content=state_text(view))
            if self._length and now - self._scrub_time > SCRUB_HOLD:
                change(self._slider, value=view.frame.index)
            medians = {name: float(np.median(spent)) for name, spent in self._timings.items()}
            change(self._table, content=timings_text(medians))

    def _follow(self, view: View) -> tuple[float, float]:
        """Near and far end of the image's colours [m], which follow the hand gently."""
        centre = float(view.hand.keypoints[:, 2].mean())
        near, far = depth_range(view.frame.depth, centre)
        if self._range is not None:
            near, far = (
                0.8 * old + 0.2 * new for old, new in zip(self._range, (near, far), strict=True)
            )
        self._range = near, far
        return near, far

    def _note_timings(self, view: View) -> None:
        """Keep the time that each stage took."""
        for name, spent in view.hand.timings.items():
            self._timings[name].append(spent)


def panel_picture(view: View, ends: tuple[float, float]) -> Image:
    """The depth image with the skeleton, B G R, about `IMAGE_WIDTH` pixels wide.

    Args:
        view: The view.
        ends: Near and far end of the colours [m].
    """
    depth = view.frame.depth
    step = max(1, round(depth.shape[1] / IMAGE_WIDTH))
    camera = view.frame.camera.thin(step)
    picture = colour_depth(depth[::step, ::step], *ends)
    if view.hand.state is not TrackState.NO_HAND:
        lost = view.hand.state is TrackState.LOST
        draw_skeleton(picture, camera.project(view.hand.keypoints), size=0.5, faded=lost)
    return picture


def image_text(picture: Image) -> str:
    """A picture, B G R, as HTML that holds it.

    viser's own images are files of the page that vanish when the next one comes; a browser that is
    too slow to fetch one in time counts that as an error.
    """
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    data = base64.b64encode(encoded.tobytes()).decode("ascii")
    height, width = picture.shape[:2]
    return (
        f'<div style="padding: 0 0.6em"><img id="handtrack-image" alt="depth image"'
        f' decoding="sync" style="width: 100%; aspect-ratio: {width}/{height}"'
        f' src="data:image/jpeg;base64,{data}"></div>'
    )


def state_text(view: View) -> str:
    """State, confidence, place and rate as HTML."""
    hand = view.hand
    blue, green, red = STATE_COLOURS[hand.state]
    place = f"frame {view.frame.index}" + (f" of {view.length}" if view.length else "")
    lines = [
        f'<b style="color: rgb({red}, {green}, {blue}); font-size: 1.35em" id="handtrack-state">'
        f"{html.escape(hand.state.value.replace('_', ' '))}</b>"
        f' <span id="handtrack-tracker">{html.escape(view.tracker)}</span>',
        html.escape(confidence_text(hand)),
        f'<span id="handtrack-frame">{place}</span>, <span id="handtrack-count">{view.count}'
        f"</span> tracked{_rate_text(view)}",
    ]
    if np.isfinite(view.delay):
        lines.append(f"{1e3 * view.delay:.0f} ms old, {view.dropped} frames dropped")
    lines += [
        f'<span style="color: rgb(240, 160, 60)">{html.escape(text)}</span>'
        for text in dict.fromkeys((view.notice, hand.problem or ""))
        if text
    ]
    if view.hypotheses is not None:
        errors = ", ".join(f"{1e3 * error:.1f}" for error in view.hypotheses.errors)
        lines.append(f'<span id="handtrack-hypotheses">hypotheses: {errors} mm</span>')
    return _framed("<br>".join(lines))


def _framed(content: str) -> str:
    """HTML with the margins of the panel's other elements."""
    return f'<div style="padding: 0.2em 1em; line-height: 1.5">{content}</div>'


def confidence_text(hand: HandResult) -> str:
    """How far the result may be off, in words."""
    if not np.isfinite(hand.depth_error):
        return "no pose"
    text = f"depth error {1e3 * hand.depth_error:.1f} mm"
    deviation = float(np.mean(hand.keypoint_std))
    return f"{text}, keypoints ± {1e3 * deviation:.0f} mm" if np.isfinite(deviation) else text


def timings_text(medians: Mapping[str, float]) -> str:
    """Median time per stage as an HTML table."""
    rows = "".join(
        f'<tr><td>{html.escape(name)}</td><td style="text-align: right">{spent:.1f} ms</td></tr>'
        for name, spent in medians.items()
    )
    return f'<table style="width: 100%; padding: 0 1em">{rows}</table>'


def _rate_text(view: View) -> str:
    """Rate of the loop, and of tracking alone where the loop waits for a clock."""
    total = view.hand.timings.get("total", 0.0)
    parts = [f"{view.rate:.0f} frames/s"] if np.isfinite(view.rate) else []
    if total > 0:
        parts.append(f"{total:.0f} ms each")
    return "".join(f", {part}" for part in parts)
