"""The publisher with real clients: what they get, and what one that stalls does to the rest."""

from __future__ import annotations

import json
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.errors import InputError, MissingDependencyError
from handtrack.export.publisher import Publisher
from handtrack.tracking.result import HandResult
from oracles.collector import wait_until

CAMERA = Camera(width=8, height=6, fx=6.0, fy=6.0, cx=3.5, cy=2.5)
SCHEMA = Path(__file__).parents[2] / "docs" / "frame.schema.json"

client = pytest.importorskip(
    "websockets.sync.client", reason="websockets, which publishing needs, is not installed"
)
exceptions = pytest.importorskip("websockets.exceptions")

one_hand = pytest.mark.parametrize("side", ["right"], indirect=True, scope="session")
"""For tests that do not look at the hand."""


def frame(index: int) -> DepthFrame:
    return DepthFrame(
        depth=np.zeros((6, 8), np.float32), camera=CAMERA, time=index / 60, index=index
    )


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with Publisher(port=0) as publisher:
        yield publisher


def connect(publisher: Publisher, count: int = 1, **options: Any) -> Any:
    """A client that the publisher knows of, being then its only one or its `count`th."""
    connection = client.connect(publisher.url, compression=None, **options)
    wait_until(lambda: publisher.clients == count, seconds=10.0)
    return connection


def assert_sent(publisher: Publisher, count: int) -> None:
    """What was received is counted: a moment later, since a frame counts once it is under way."""
    wait_until(lambda: publisher.sent >= count, seconds=10.0)
    assert publisher.sent == count


def test_a_client_gets_every_frame_as_documented(
    publisher: Publisher, hand_results: list[HandResult]
) -> None:
    jsonschema = pytest.importorskip(
        "jsonschema", reason="jsonschema, which checks documents, is not installed"
    )
    schema = jsonschema.Draft202012Validator(json.loads(SCHEMA.read_text("utf-8")))
    with connect(publisher) as listener:
        for index, hand in enumerate(hand_results):
            publisher.frame(frame(index), hand)
            document = json.loads(listener.recv(timeout=5))
            schema.validate(document)
            assert document["frame"] == index and document["time"] == index / 60
            assert document["side"] == hand.side and document["state"] == hand.state.value
            if document["keypoints"] is not None:
                np.testing.assert_allclose(document["keypoints"], hand.keypoints, atol=1e-7)
    assert_sent(publisher, len(hand_results))
    assert publisher.dropped == 0


@one_hand
def test_many_clients_get_the_same_frames(
    publisher: Publisher, hand_results: list[HandResult]
) -> None:
    listeners = [connect(publisher, count + 1) for count in range(24)]
    for index in range(5):
        publisher.frame(frame(index), hand_results[5])
        messages = {listener.recv(timeout=5) for listener in listeners}
        assert len(messages) == 1 and json.loads(messages.pop())["frame"] == index
    for listener in listeners:
        listener.close()
    wait_until(lambda: publisher.clients == 0, seconds=10.0)
    publisher.frame(frame(9), hand_results[5])
    assert_sent(publisher, 5 * 24)
    assert publisher.dropped == 0


def stalled_client(publisher: Publisher, count: int) -> Any:
    """A client that reads nothing unless told to, and whose socket holds little."""
    wire = socket.socket()
    wire.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    wire.connect((publisher.host, publisher.port))
    return connect(publisher, count, sock=wire, max_queue=1)


@one_hand
def test_a_stalled_client_holds_up_nobody_and_loses_old_frames(
    publisher: Publisher, hand_results: list[HandResult]
) -> None:
    stalled = stalled_client(publisher, 1)
    quick = connect(publisher, 2)
    waits = []
    total = 300
    for index in range(total):
        start = time.perf_counter()
        publisher.frame(frame(index), hand_results[5])
        waits.append(time.perf_counter() - start)
        assert json.loads(quick.recv(timeout=5))["frame"] == index
    assert np.median(waits) < 1e-3 and max(waits) < 0.25
    assert publisher.dropped > 150
    # Read again: what was under way, then straight to the newest.
    frames = [json.loads(stalled.recv(timeout=5))["frame"]]
    while frames[-1] != total - 1:
        frames.append(json.loads(stalled.recv(timeout=5))["frame"])
    assert frames == sorted(set(frames)), "in order, none twice"
    assert len(frames) + publisher.dropped == total
    publisher.frame(frame(total), hand_results[5])
    assert json.loads(stalled.recv(timeout=5))["frame"] == total
    for connection in (stalled, quick):
        connection.close()


@one_hand
def test_frames_faster_than_json_are_dropped_and_counted(
    publisher: Publisher, hand_results: list[HandResult]
) -> None:
    with connect(publisher) as listener:
        total = 2000
        for index in range(total):
            publisher.frame(frame(index), hand_results[5])
        frames = []
        while not frames or frames[-1] != total - 1:
            frames.append(json.loads(listener.recv(timeout=5))["frame"])
    assert frames == sorted(set(frames)) and len(frames) + publisher.dropped == total
    assert_sent(publisher, len(frames))


@one_hand
def test_nobody_listening_costs_nothing_and_is_not_counted(
    publisher: Publisher, hand_results: list[HandResult]
) -> None:
    for index in range(100):
        publisher.frame(frame(index), hand_results[5])
    assert publisher.sent == publisher.dropped == 0


@one_hand
def test_closing_says_goodbye_even_with_a_stalled_client(hand_results: list[HandResult]) -> None:
    publisher = Publisher(port=0)
    stalled = stalled_client(publisher, 1)
    listener = connect(publisher, 2)
    for index in range(100):
        publisher.frame(frame(index), hand_results[5])
        listener.recv(timeout=5)
    start = time.monotonic()
    publisher.close()
    assert time.monotonic() - start < 4.0
    with pytest.raises(exceptions.ConnectionClosedOK) as closed:
        listener.recv(timeout=5)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1001
    publisher.frame(frame(0), hand_results[5])
    publisher.close()
    with pytest.raises(OSError):
        client.connect(publisher.url)
    # Its port is free again.
    with Publisher(port=publisher.port):
        pass
    stalled.socket.close()


@one_hand
def test_a_client_that_stalls_for_long_is_let_go(
    publisher: Publisher, hand_results: list[HandResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handtrack.export.publisher._STALL_SECONDS", 0.5)
    stalled = stalled_client(publisher, 1)
    quick = connect(publisher, 2)
    for index in range(150):
        publisher.frame(frame(index), hand_results[5])
        quick.recv(timeout=5)
    wait_until(lambda: publisher.clients == 1, seconds=10.0)
    publisher.frame(frame(150), hand_results[5])
    assert json.loads(quick.recv(timeout=5))["frame"] == 150
    quick.close()
    stalled.socket.close()


@one_hand
def test_a_client_that_vanishes_or_talks_is_no_harm(
    publisher: Publisher, hand_results: list[HandResult]
) -> None:
    with connect(publisher) as talker:
        for _ in range(100):
            talker.send("hello")
        vanishing = connect(publisher, 2)
        vanishing.socket.shutdown(socket.SHUT_RDWR)
        wait_until(lambda: publisher.clients == 1, seconds=10.0)
        publisher.frame(frame(3), hand_results[5])
        assert json.loads(talker.recv(timeout=5))["frame"] == 3
    with socket.create_connection((publisher.host, publisher.port)) as stranger:
        stranger.sendall(b"nonsense\r\n\r\n")
        assert b"Switching Protocols" not in stranger.recv(1024)
    with connect(publisher) as listener:
        publisher.frame(frame(4), hand_results[5])
        assert json.loads(listener.recv(timeout=5))["frame"] == 4


def test_a_port_in_use_is_an_error_that_says_so(publisher: Publisher) -> None:
    with pytest.raises(InputError, match=f"cannot publish at 127.0.0.1:{publisher.port}: .*in use"):
        Publisher(port=publisher.port)
    with pytest.raises(InputError, match="cannot publish at 203"):
        Publisher("203.0.113.1", 0)


@pytest.mark.parametrize(
    ("origin", "welcome"),
    [
        (None, True), ("null", True), ("http://localhost:5173", True), ("http://127.0.0.1", True),
        ("https://example.org", False), ("http://localhost.example.org", False),
        ("http://127.0.0.1.example.org", False),
    ],
)  # fmt: skip
def test_pages_from_elsewhere_are_not_let_in(
    publisher: Publisher, origin: str | None, welcome: bool
) -> None:
    if welcome:
        client.connect(publisher.url, origin=origin).close()
        return
    with pytest.raises(exceptions.InvalidStatus) as refused:
        client.connect(publisher.url, origin=origin)
    assert refused.value.response.status_code == 403


def test_without_websockets_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'handtrack\[publish\]'"):
        Publisher(port=0)


def test_an_ipv6_address_is_written_in_brackets() -> None:
    try:
        publisher = Publisher("::1", 0)
    except InputError:
        pytest.skip("this machine has no IPv6 loopback")
    with publisher:
        assert publisher.url == f"ws://[::1]:{publisher.port}"
        client.connect(publisher.url).close()
