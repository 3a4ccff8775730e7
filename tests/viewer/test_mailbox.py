"""The mailbox with one slot: the newest item is delivered, nobody who sends waits."""

from __future__ import annotations

import threading
import time

from handtrack.viewer.mailbox import Mailbox


def test_only_the_newest_item_is_delivered() -> None:
    mailbox: Mailbox[int] = Mailbox()
    for number in range(5):
        mailbox.put(number)
    assert mailbox.take() == 4
    assert mailbox.take(timeout=0.0) is None
    assert mailbox.replaced == 4


def test_whoever_waits_is_woken_by_an_item_and_by_the_end() -> None:
    mailbox: Mailbox[int] = Mailbox()
    taken: list[int | None] = []
    arrived = threading.Event()

    def receive() -> None:
        taken.append(mailbox.take())
        arrived.set()
        taken.append(mailbox.take())

    thread = threading.Thread(target=receive, daemon=True)
    thread.start()
    mailbox.put(7)
    assert arrived.wait(10.0)
    mailbox.close()
    thread.join(10.0)
    assert taken == [7, None] and mailbox.closed
    mailbox.put(8)
    assert mailbox.take() is None


def test_a_sender_never_waits_for_a_slow_receiver() -> None:
    mailbox: Mailbox[int] = Mailbox()
    begin = time.perf_counter()
    for number in range(10_000):
        mailbox.put(number)
    assert time.perf_counter() - begin < 1.0
