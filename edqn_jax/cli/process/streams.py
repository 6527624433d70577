"""Standard output and error of a command: what cannot be written there is replaced or dropped.

A reader may have enough, a terminal may be gone, a character may not exist in its encoding, or a command may be started
without the streams. None of this is a reason to lose a flight or a training.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Protocol

NOBODY_READS = (errno.EPIPE, errno.EIO)
"""Errors of writing to a closed pipe or terminal, which are ignored."""

CANNOT_WRITE = 2
"""Exit code of a command that is done, but whose output could not be written."""

_RETRY_S = 0.01
"""Between attempts to write to a pipe that is full and does not block."""


class Watch(Protocol):
    """What is told before something is written."""

    def __call__(self, data: bytes, *, is_terminal: bool) -> None:
        """Takes what is about to be written, and whether to a terminal."""


class Lasting(io.FileIO):
    """A descriptor to which writing never fails: after the first failure everything is dropped."""

    def __init__(self, descriptor: int) -> None:
        """Writes to the descriptor, which stays open."""
        super().__init__(descriptor, "w", closefd=False)
        self.failure: OSError | None = None
        self._watch: Watch | None = None
        self._is_terminal = self.isatty()

    def watch(self, watch: Watch) -> None:
        """Has `watch` called before each write."""
        self._watch = watch

    def write(self, data) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Writes, or drops, all or a part of `data`; returns how many bytes."""
        size = memoryview(data).nbytes
        if self.failure is not None:
            return size
        if self._watch is not None:
            self._watch(bytes(data), is_terminal=self._is_terminal)
        try:
            while (written := super().write(data)) is None:
                time.sleep(_RETRY_S)
            return written
        except OSError as error:
            self.failure = error
            return size


@contextlib.contextmanager
def lasting_streams() -> Iterator[list[Lasting]]:
    """Makes standard output and error streams that never fail, within the block.

    Characters that their encoding lacks are replaced. Streams that a program has put in place of its own, as notebooks
    do, are left as they are.

    Yields:
        what is written to, whose `failure` says why what was not.
    """
    before = sys.stdout, sys.stderr
    _open_missing()
    outputs = []
    for name, errors in (("stdout", "replace"), ("stderr", "backslashreplace")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif type(stream) is io.TextIOWrapper and _descriptor(stream) in (1, 2):
            stream.flush()
            outputs.append(Lasting(stream.fileno()))
            again = io.TextIOWrapper(
                io.BufferedWriter(outputs[-1]),
                encoding=stream.encoding,
                errors=errors,
                line_buffering=stream.line_buffering or stream.write_through,
            )
            setattr(sys, name, again)
    try:
        yield outputs
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before


def exit_code(outputs: Sequence[Lasting], code: int) -> int:
    """Returns the exit code of a command that ended with `code`, and says so where its output could not be written.

    A reader that has enough, as `head` may, or a terminal that is gone leaves the code as it is.
    """
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    for output in outputs:
        if output.failure is not None and output.failure.errno not in NOBODY_READS:
            name = "standard output" if output.fileno() == 1 else "standard error"
            print(f"edqn: {name} cannot be written: {output.failure.strerror}", file=sys.stderr)
            code = code or CANNOT_WRITE
    return code


def _open_missing() -> None:
    """Opens the descriptors 0 to 2 that are closed: a file that got their number would be written to by libraries."""
    with contextlib.suppress(OSError):
        while (opened := os.open(os.devnull, os.O_RDWR)) <= 2:
            os.set_inheritable(opened, True)
        os.close(opened)


def _descriptor(stream: io.TextIOWrapper) -> int:
    try:
        return stream.fileno()
    except (OSError, ValueError):
        return -1
