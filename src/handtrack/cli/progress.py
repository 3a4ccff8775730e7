"""Progress bars of long commands: on stderr, and only on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")


def progress(items: Iterable[Item], total: int | None, text: str) -> Iterator[Item]:
    """Yield the items while a bar shows how far they are.

    Args:
        items: What to go through.
        total: How many there are; None, as with a live source, shows a count without an end.
        text: What is being done.
    """
    with counting(total, text) as count:
        for done, item in enumerate(items, start=1):
            yield item
            count(done, text)


@contextmanager
def counting(total: int | None, text: str) -> Iterator[Callable[[int, str], None]]:
    """A bar for work that counts itself.

    Args:
        total: How much there is; None shows a count without an end.
        text: What is being done.

    Yields:
        A function that takes how much is done and what is being done.
    """
    if not sys.stderr.isatty():
        yield lambda done, text: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(text, total=total)
        yield lambda done, text: bar.update(task, completed=done, description=text)
