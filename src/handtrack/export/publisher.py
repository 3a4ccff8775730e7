"""Live frames for other programs: JSON over a WebSocket, and never a wait for the tracking loop.

The server runs on a thread of its own. `Publisher.frame` leaves a frame in a slot and returns; the
thread turns the newest one into JSON, once, and hands it to every client's slot. A client that does
not keep up finds the newest frame in its slot when it is ready for one; what it missed is counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import socket
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING

from handtrack.errors import InputError, MissingDependencyError
from handtrack.export.frame_document import result_document, to_json

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

    from handtrack.camera.frame import DepthFrame
    from handtrack.tracking.result import HandResult

HOST, PORT = "127.0.0.1", 8765
"""Where frames are published unless told otherwise: for programs on this machine only."""

LOCAL_ORIGINS: tuple[str | re.Pattern[str] | None, ...] = (
    None,
    "null",
    re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"),
)
"""Pages that may listen: programs that are no browser, files, and pages from this machine. Without
this, any page that the user has open could watch the hand."""

_SEND_BUFFER = 65536
"""Size asked for a client's socket buffer [bytes]: what lies there grows old."""

_UNSENT = 4096
"""Bytes not yet taken by the socket, above which a client counts as busy."""

_CLOSE_SECONDS = 1.0
"""How long a client may take to say goodbye [s]."""

_PING_SECONDS = 20.0
"""How often an idle client is asked whether it is there, and how long it may take to answer [s]."""

_STALL_SECONDS = 60.0
"""A client whose socket has taken nothing for so long is let go [s]; pings wait behind frames."""

_LOG = logging.getLogger("handtrack.publisher")
_LOG.addHandler(logging.NullHandler())  # what strangers send to the port is not for the terminal


@dataclass(eq=False, slots=True)
class _Client:
    """One client: its connection, and its slot."""

    connection: ServerConnection
    waiting: str | None = None
    ready: asyncio.Event = field(default_factory=asyncio.Event)


class Publisher:
    """Sends every frame's result to whoever listens.

    Examples::

        with Publisher() as publisher:
            for frame in sequence:
                publisher.frame(frame, tracker.track(frame.depth))
    """

    def __init__(
        self,
        host: str = HOST,
        port: int = PORT,
        *,
        origins: Sequence[str | re.Pattern[str] | None] = LOCAL_ORIGINS,
    ) -> None:
        """Listen.

        Args:
            host: Address to listen at; 0.0.0.0 lets other machines in, unauthenticated and in
                clear text.
            port: TCP port; 0 takes a free one, which `port` then tells.
            origins: Values of the Origin header that are let in; None stands for no header.

        Raises:
            InputError: The port is in use, or the address is not one of this machine.
            MissingDependencyError: The package websockets is not installed.
        """
        try:
            import websockets.asyncio.server  # noqa: F401
        except ImportError as error:
            raise MissingDependencyError(
                "publishing needs the package websockets: pip install 'handtrack[publish]'"
            ) from error
        self.host = host
        self.port = port
        self.sent = 0
        """Messages given to clients' sockets."""
        self.dropped = 0
        """Messages that a client did not get because it was busy, over all clients."""
        self._clients: set[_Client] = set()
        self._lock = threading.Lock()
        self._newest: tuple[int, float, HandResult] | None = None
        self._open = False
        self._loop: asyncio.AbstractEventLoop
        self._closing: asyncio.Event
        started: Future[int] = Future()
        self._thread = threading.Thread(
            target=self._run, args=(origins, started), name="handtrack-publisher", daemon=True
        )
        self._thread.start()
        try:
            self.port = started.result()
        except (OSError, OverflowError) as error:
            self._thread.join()
            raise InputError(
                f"cannot publish at {host}:{port}: {error}; name another address, or port 0 for a "
                "free one"
            ) from error

    @property
    def url(self) -> str:
        """Where clients connect."""
        return f"ws://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"

    @property
    def clients(self) -> int:
        """Number of clients that are connected."""
        return len(self._clients)

    def frame(self, frame: DepthFrame, hand: HandResult) -> None:
        """Publish one frame's result; returns at once. After `close` it does nothing.

        Args:
            frame: The frame; its number and time stamp are sent.
            hand: What the tracker said about it.
        """
        with self._lock:
            if not self._open or not self._clients:
                return
            replaced = self._newest is not None
            self._newest = frame.index, frame.time, hand
            if replaced:
                self.dropped += len(self._clients)
            else:
                self._loop.call_soon_threadsafe(self._hand_out)

    def close(self) -> None:
        """Say goodbye to all clients and stop; more calls do nothing."""
        with self._lock:
            if not self._open:
                return
            self._open = False
            self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join()

    def __enter__(self) -> Publisher:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _run(self, origins: Sequence[str | re.Pattern[str] | None], started: Future[int]) -> None:
        """The thread: serve until `close`."""
        try:
            asyncio.run(self._serve(origins, started))
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)
        finally:
            with self._lock:
                self._open = False

    async def _serve(
        self, origins: Sequence[str | re.Pattern[str] | None], started: Future[int]
    ) -> None:
        from websockets.asyncio.server import serve

        self._loop, self._closing = asyncio.get_running_loop(), asyncio.Event()
        server = await serve(
            self._attend, self.host, self.port, origins=list(origins), compression=None,  # type: ignore[arg-type]
            max_size=_UNSENT, write_limit=_UNSENT, close_timeout=_CLOSE_SECONDS,
            ping_interval=_PING_SECONDS, ping_timeout=_PING_SECONDS, logger=_LOG,
        )  # fmt: skip
        self._open = True
        started.set_result(next(iter(server.sockets)).getsockname()[1])
        await self._closing.wait()
        server.close()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(server.wait_closed(), _CLOSE_SECONDS)
        # A client that does not read does not hear the goodbye either.
        for client in self._clients:
            client.connection.transport.abort()
        await server.wait_closed()

    async def _attend(self, connection: ServerConnection) -> None:
        """Serve one client until it goes."""
        from websockets.exceptions import ConnectionClosed

        wire = connection.transport.get_extra_info("socket")
        if wire is not None:
            wire.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        client = _Client(connection)
        self._clients.add(client)
        sender = self._loop.create_task(self._send(client))
        try:
            # What clients say is of no interest, but their goodbyes and pongs come with it.
            async for _ in connection:
                pass
        except ConnectionClosed:
            pass
        finally:
            self._clients.discard(client)
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)

    async def _send(self, client: _Client) -> None:
        """Send what lies in a client's slot, whenever its socket takes more."""
        from websockets.exceptions import ConnectionClosed

        while True:
            await client.ready.wait()
            client.ready.clear()
            text, client.waiting = client.waiting, None
            if text is not None:
                try:
                    await asyncio.wait_for(client.connection.send(text), _STALL_SECONDS)
                except ConnectionClosed:
                    return
                except TimeoutError:
                    client.connection.transport.abort()
                    return
                self.sent += 1

    def _hand_out(self) -> None:
        """Put the newest frame into every client's slot."""
        with self._lock:
            newest, self._newest = self._newest, None
        if newest is None or not self._clients:
            return
        text = to_json(result_document(*newest))
        for client in self._clients:
            if client.waiting is not None:
                with self._lock:
                    self.dropped += 1
            client.waiting = text
            client.ready.set()
