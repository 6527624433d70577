"""How a command ends: exit codes, and the endings that are neither success nor a mistake of the user's."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

DONE = 0
BAD_INPUT = 2
DIVERGED = 3
INTERRUPTED = 130
TERMINATED = 143


class DivergedError(RuntimeError):
    """Training met numbers that are not finite; the message says which and when."""


class StoppedError(RuntimeError):
    """Training was asked to stop and did so after saving; the message says where."""


@contextmanager
def listening_for_sigterm() -> Iterator[Callable[[], bool]]:
    """Within the block SIGTERM only takes note; the function that it yields tells whether one came."""
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
