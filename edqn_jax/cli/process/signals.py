"""SIGINT and SIGTERM: the first ends a command within seconds and a training after its chunk, the second ends at once.

Python runs a signal's handler between two of its own instructions, so not while XLA compiles or a chunk runs. Therefore
a thread listens: the system's own handler writes to a socket, and the thread reads it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import NoReturn

from edqn_jax.files import whole_files

HEARD = (signal.SIGINT, signal.SIGTERM)

_NAMES = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}

ONE_S = 1.0
"""Signals within so short a time are one: `timeout` sends its own to the process and to its group."""

_WAITS_S = 2.0
"""That an end waits for a file that is just being written."""


class Stops:
    """Stop requests by signals."""

    def __init__(self) -> None:
        """Ends the process at the first signal."""
        self.number: int | None = None
        """The signal that a phase of work was asked to stop by."""
        self._heard_at = 0.0
        self._tell: Callable[[str], None] | None = None
        self._lock = threading.Lock()

    def is_requested(self) -> bool:
        """Returns whether work has been asked to stop."""
        return self.number is not None

    @contextlib.contextmanager
    def obey_signals(self, tell: Callable[[str], None]) -> Iterator[None]:
        """Within the block, the first signal is a request that `is_requested` returns; `tell` says so to people."""
        with self._lock:
            self._tell = tell
        try:
            yield
        finally:
            with self._lock:
                self._tell = None

    def on_signal(self, number: int) -> None:
        """Notes a signal, or ends the process."""
        with self._lock:
            tell = self._tell
            if self.number is not None and time.monotonic() < self._heard_at + ONE_S:
                return
            if tell is None or self.number is not None:
                _end(number)
            self.number, self._heard_at = number, time.monotonic()
        text = f"{_NAMES[signal.Signals(number)]}: stopping after this chunk; a second signal ends at once"
        # Whoever reads what is printed may not read: this thread must go on listening.
        threading.Thread(target=_suppressed, args=(tell, text), name="telling", daemon=True).start()


@contextlib.contextmanager
def listen_to_signals() -> Iterator[Stops]:
    """Listens to signals within the block; where Python allows no handlers, only to those that it hears itself."""
    stops = Stops()
    try:
        before = {number: signal.signal(number, lambda *_: None) for number in HEARD}
    except ValueError:  # not in the main thread
        yield stops
        return
    listening, written = socket.socketpair()
    written.setblocking(False)
    woken = signal.set_wakeup_fd(written.fileno(), warn_on_full_buffer=False)

    def listen() -> None:
        with listening:
            while numbers := listening.recv(16):
                for number in numbers:
                    if number in HEARD:
                        stops.on_signal(number)

    threading.Thread(target=listen, name="signals", daemon=True).start()
    try:
        yield stops
    finally:
        signal.set_wakeup_fd(woken)
        for number, handler in before.items():
            signal.signal(number, handler)
        written.close()  # ends the thread


def _suppressed(tell: Callable[[str], None], text: str) -> None:
    with contextlib.suppress(Exception):
        tell(text)


def _end(number: int) -> NoReturn:
    """Ends the process as the signal would, with no file half-written."""
    whole_files.acquire(timeout=_WAITS_S)
    if sys.stdout.isatty():
        os.write(sys.stdout.fileno(), b"\x1b[?25h\n")  # a live display hides the cursor
    elif sys.stderr.isatty():
        os.write(2, b"\n")  # after the line of the status
    with contextlib.suppress(OSError):
        os.write(2, f"edqn: {_NAMES[signal.Signals(number)]}\n".encode())
    os._exit(128 + number)
