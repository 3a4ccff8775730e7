"""The web viewer: a page on this machine that shows tracking in any browser, through viser.

The loop leaves views in a mailbox with one slot. A thread of the viewer's own fetches the newest,
draws it when somebody looks, and leaves the rest to viser's web server; so neither a slow browser
nor none at all keeps the loop waiting.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from handtrack.errors import HandtrackError, InputError, MissingDependencyError
from handtrack.viewer.controls import Controls
from handtrack.viewer.depth_colours import Image
from handtrack.viewer.mailbox import Mailbox
from handtrack.viewer.pictures import INK, draw_lines
from handtrack.viewer.viewer import View
from handtrack.viewer.web_panel import WebPanel, confidence_text
from handtrack.viewer.web_scene import DIRECTIONS, FIRST_LOOK, WebScene, eye_at

if TYPE_CHECKING:
    import viser

LOCAL = "127.0.0.1"
"""Host that only this machine can reach."""

PORT = 8080
"""Port that is tried first."""

MOST_RATE = 30.0
"""Views drawn per second at most [1/s]."""

SHOT_SIZE = (960, 720)
"""Width and height of the scene in a screenshot [pixels]."""

NICENESS = 10
"""Niceness of the threads that draw and send: tracking comes first."""

_ANSWER_SECONDS = 20.0

_log = logging.getLogger(__name__)


class ViewerError(HandtrackError, RuntimeError):
    """The viewer cannot do what it was asked for."""


class WebViewer:
    """Shows views on a web page, and passes on what the user does there."""

    def __init__(
        self,
        controls: Controls,
        *,
        trackers: Sequence[str],
        length: int | None = None,
        live: bool = False,
        can_record: bool = False,
        draw_unseen: bool = False,
        host: str = LOCAL,
        port: int = PORT,
    ) -> None:
        """Start the web server.

        Args:
            controls: What the user's wishes go to.
            trackers: Names of the trackers to choose from.
            length: Number of frames of a recording, None without an end.
            live: Whether frames come from a device.
            can_record: Whether there is anything to record to.
            draw_unseen: Draw even while no browser looks, to measure what drawing costs.
            host: Address to listen at. Who can reach it can see everything and press everything.
            port: Port that is tried first, then those above it; 0 takes any.

        Raises:
            MissingDependencyError: viser is not installed.
            InputError: The host or the port cannot be listened at.
        """
        # The server's threads inherit the niceness of the one that starts them.
        with ThreadPoolExecutor(1, initializer=_give_way) as pool:
            self._server = pool.submit(_start_server, host, port).result()
        self.url = f"http://{host}:{self._server.get_port()}"
        """Address of the page."""
        self.drawn = 0
        """Views drawn."""
        self._draw_unseen = draw_unseen
        self._mailbox: Mailbox[View] = Mailbox()
        self._last: View | None = None
        self._scene = WebScene(self._server)
        with self._server.atomic():
            self._panel = WebPanel(
                self._server, controls, trackers=trackers, length=length, live=live,
                can_record=can_record,
            )  # fmt: skip
            self._add_looks()
        self._panel.screenshot.on_click(self._send_screenshot)
        self._server.on_client_connect(self._welcome)
        self._thread = threading.Thread(target=self._work, name="handtrack-viewer", daemon=True)
        self._thread.start()

    @property
    def clients(self) -> int:
        """Browsers that look at the page."""
        return len(self._server.get_clients())

    def show(self, view: View) -> None:
        """Leave a view for the viewer's thread; see `Viewer`."""
        self._last = view
        self._mailbox.put(view)

    def close(self) -> None:
        """Stop the web server; browsers say that they lost it."""
        if self._mailbox.closed:
            return
        self._mailbox.close()
        self._thread.join(timeout=_ANSWER_SECONDS)
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def screenshot(self, client: viser.ClientHandle | None = None) -> Image:
        """The scene as a browser shows it, with the state; B G R, of `SHOT_SIZE`.

        Args:
            client: Whose browser draws it; any when None.

        Raises:
            ViewerError: No browser looks at the page, or it does not answer.
        """
        clients = list(self._server.get_clients().values())
        client = client if client is not None else next(iter(clients), None)
        if client is None:
            raise ViewerError("no browser looks at the page: open it first")
        width, height = SHOT_SIZE
        try:
            picture = client.get_render(
                height, width, transport_format="jpeg", timeout=_ANSWER_SECONDS
            )
        except (RuntimeError, TimeoutError) as error:
            raise ViewerError(f"the browser draws no screenshot: {error}") from error
        shot = np.ascontiguousarray(picture[..., 2::-1])
        view = self._last
        if view is not None:
            hand = view.hand
            draw_lines(shot, [
                (f"frame {view.frame.index}: {hand.state.value.replace('_', ' ')}", INK),
                (confidence_text(hand).replace("±", "+/-"), INK),
            ])  # fmt: skip
        return shot

    def _work(self) -> None:
        """Draw the newest view, again and again; the viewer's own thread."""
        _give_way()
        while (view := self._mailbox.take()) is not None:
            begin = time.perf_counter()
            if self._draw_unseen or self.clients:
                try:
                    with self._server.atomic():
                        self._scene.draw(view)
                        self._panel.draw(view)
                    self.drawn += 1
                except Exception:  # a view that cannot be drawn must not end all drawing
                    _log.exception("view of frame %d cannot be drawn", view.frame.index)
            time.sleep(max(0.0, 1.0 / MOST_RATE - (time.perf_counter() - begin)))

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Show a new browser the hand from the camera, and the last view, which may be the last."""
        client.camera.position, client.camera.look_at = eye_at(FIRST_LOOK, self._scene.centre)
        if self._last is not None:
            self._mailbox.put(self._last)

    def _add_looks(self) -> None:
        """Buttons and boxes for what is seen of the scene."""
        gui, scene = self._server.gui, self._scene
        with gui.add_folder("Scene", expand_by_default=False):
            looks = gui.add_button_group("Look from", tuple(DIRECTIONS))
            parts = {
                name: gui.add_checkbox(label, True)
                for name, label in (
                    ("show_points", "Points"), ("show_mesh", "Mesh"), ("show_skeleton", "Skeleton"),
                )
            }  # fmt: skip

        @looks.on_click
        def _(event: Any) -> None:
            if event.client is not None:
                eye, target = eye_at(event.target.value, scene.centre)
                event.client.camera.position, event.client.camera.look_at = eye, target

        def switch(name: str) -> None:
            def changed(event: Any) -> None:
                setattr(scene, name, bool(event.target.value))
                if self._last is not None:
                    self._mailbox.put(self._last)

            parts[name].on_update(changed)

        for name in parts:
            switch(name)

    def _send_screenshot(self, event: Any) -> None:
        """Send a screenshot to the browser whose user wants it."""
        if event.client is None:
            return
        try:
            picture = self.screenshot(event.client)
        except ViewerError as error:
            event.client.add_notification("No screenshot", str(error), color="red")
            return
        index = 0 if self._last is None else self._last.frame.index
        _, content = cv2.imencode(".png", picture)
        event.client.send_file_download(
            f"handtrack-{index:06d}.png", content.tobytes(), save_immediately=True
        )


def _give_way() -> None:
    """Let this thread wait for tracking's, where threads have priorities of their own."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # a sandbox may forbid it; it is only a courtesy
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


def _start_server(host: str, port: int) -> viser.ViserServer:
    """Viser's server, without its chat.

    Raises:
        MissingDependencyError: viser is not installed.
        InputError: The host or the port cannot be listened at.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingDependencyError(
            "the web viewer needs viser: pip install 'handtrack[viewer]', or go on without a "
            f"viewer ({error})"
        ) from error
    if not 0 <= port < 65536:
        raise InputError(f"port is {port}: expected 0 to 65535")
    # viser would try a thousand ports on a host that does not exist, and wait for ever.
    try:
        with socket.create_server((host, 0)):
            pass
    except OSError as error:
        raise InputError(
            f"cannot listen at {host!r}: {error}; expected an address of this machine, such as "
            f"{LOCAL}"
        ) from error
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label="handtrack", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
    server.gui.main_panel.dock_right()
    return server
