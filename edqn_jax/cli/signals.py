"""SIGTERM as a request that the command reads when it can act on it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def listening_for_sigterm() -> Iterator[Callable[[], bool]]:
    """Records SIGTERM within the block; the function that it yields returns whether one arrived."""
    requested = False

    def note(number: int, frame: object) -> None:
        del number, frame
        nonlocal requested
        requested = True

    before = signal.signal(signal.SIGTERM, note)
    try:
        yield lambda: requested
    finally:
        signal.signal(signal.SIGTERM, before)
