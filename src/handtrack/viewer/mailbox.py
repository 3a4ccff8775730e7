"""A mailbox with one slot: the sender never waits, the receiver gets the newest."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Mailbox(Generic[Item]):
    """Hands items from one thread to another; an item that was not fetched in time is replaced."""

    def __init__(self) -> None:
        """Start empty."""
        self._changed = threading.Condition()
        self._item: Item | None = None
        self._closed = False
        self.replaced = 0
        """Items that were never fetched, because a newer one took their place."""

    def put(self, item: Item) -> None:
        """Leave an item; the one that lies there, if any, is thrown away."""
        with self._changed:
            self.replaced += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self, timeout: float | None = None) -> Item | None:
        """Wait for an item and fetch it.

        Args:
            timeout: So long at most [s]; None waits until there is one.

        Returns:
            The newest item; None after the timeout, or once the mailbox is closed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._item is not None, timeout)
            if self._closed:
                return None
            item, self._item = self._item, None
            return item

    @property
    def closed(self) -> bool:
        """Whether nothing will be delivered any more."""
        return self._closed

    def close(self) -> None:
        """Wake the receiver; nothing is delivered any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
