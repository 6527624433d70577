"""What a command is doing, on standard error, from its first moment on: a line that ticks, or one now and then.

A terminal has one line that is drawn anew four times a second and is gone once something else is printed. Elsewhere,
as in a log, a line stands at the beginning, and another after every `SILENT_S` in which nothing was printed: with the
command's name and its clock where a phase is named for the first time, and short where it goes on.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from edqn_jax.cli.process.durations import Durations
from edqn_jax.cli.process.streams import Lasting, lasting_streams
from edqn_jax.watchers import taken

if TYPE_CHECKING:
    from edqn_jax.evaluation.rollouts import ShowPhase

BEGAN = time.monotonic()
"""When this process began, about."""

TICK_S = 0.25
"""Between two drawings of the line on a terminal."""

SILENT_S = 2.0
"""Time without a line elsewhere after which one is printed; with `TICK_S` and a busy machine's delay less than 3 s."""

UNEVEN = ("flying the missions", "validating")
"""Phases whose parts end late and together, as flights do that are flown at once: how many are done says little of
the time that is left, and no such time is shown."""

_CLEARED = b"\r\x1b[K"


class Status:
    """The phase of a command and its clock."""

    def __init__(self, title: str, descriptor: int, *, lives: bool, durations: Durations | None = None) -> None:
        """Shows nothing before `start`.

        Args:
            title: what each line begins with.
            descriptor: to write to.
            lives: whether one line is drawn over and over, as a terminal can.
            durations: of the last time.
        """
        self._durations = durations
        self._title, self._descriptor, self._lives = title, descriptor, lives
        self._lock, self._ended = threading.RLock(), threading.Event()
        self._began = self._phase_began = self._printed = time.monotonic()
        self._name, self._done, self._total = "starting", 0, 0
        self._is_shown, self._is_at_start = False, True  # of a line on the terminal
        self._named = ""  # phase of the last line in a log

    def start(self) -> None:
        """Shows the first line and goes on until `stop`."""
        self._show()
        threading.Thread(target=self._tick, name="status", daemon=True).start()

    def stop(self) -> None:
        """Clears the line; nothing is shown any more."""
        with self._lock:
            self._ended.set()
            self._clear()

    def phase(self, name: str, done: int = 0, total: int = 0) -> None:
        """Begins a phase, or says how much of it is done, of how much."""
        with self._lock:
            if name != self._name:
                self._name, self._phase_began = name, time.monotonic()
            self._done, self._total = done, total

    def make_way(self, data: bytes, *, is_terminal: bool) -> None:
        """Clears the line before something else is printed: `data`, to a terminal or elsewhere."""
        with self._lock:
            self._printed = time.monotonic()
            if is_terminal:
                self._clear()
                self._is_at_start = data.endswith(b"\n")

    def line(self, now: float, *, is_short: bool = False) -> str:
        """Returns the line at a time of `time.monotonic`; a short one names the phase and its clock alone."""
        took = now - self._phase_began
        parts = [f"  {self._name}" if is_short else f"{self._title}: {self._name}"]
        if self._total:
            parts.append(f"{self._done:,} of {self._total:,}")
        parts.append(_clock(took))
        if 0 < self._done < self._total and self._name not in UNEVEN:
            parts.append(f"about {_clock(took / self._done * (self._total - self._done))} left")
        elif not self._total and not is_short and (last := self._last()):
            parts.append(f"last time {_clock(last)}")
        if not is_short and now - self._began > took + 1.0:
            parts.append(f"{_clock(now - self._began)} in all")
        return ", ".join(parts)

    def _last(self) -> float | None:
        return None if self._durations is None else self._durations.last(self._name)

    def _tick(self) -> None:
        while not self._ended.wait(TICK_S):
            with self._lock:
                silent = time.monotonic() - self._printed >= SILENT_S
                if not self._ended.is_set() and (self._is_at_start if self._lives else silent):
                    self._show()

    def _show(self) -> None:
        now = time.monotonic()
        text = self.line(now, is_short=not self._lives and self._name == self._named)
        if self._lives:
            columns = shutil.get_terminal_size().columns
            self._write(_CLEARED + text[: columns - 1].encode("ascii", "replace"))
            self._is_shown = True
        else:
            self._write(f"{text}\n".encode("ascii", "replace"))
            self._printed, self._named = now, self._name

    def _clear(self) -> None:
        if self._is_shown:
            self._write(_CLEARED)
            self._is_shown = False

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            os.write(self._descriptor, data)


_shown: list[Status] = []
"""The status of this process' command, if it shows one."""

_timed: list[Durations] = []
"""How long the phases of this process' command take, also while something else shows them."""


def show_phase(name: str, done: int = 0, total: int = 0) -> None:
    """Shows that a phase begins, or how much of it is done; does nothing outside of a command."""
    for durations in _timed:
        durations.begin(name)
    for status in _shown:
        status.phase(name, done, total)


def say_phase(name: str) -> None:
    """Prints the name of a phase that begins, as a line that stays, and shows its clock."""
    print(name, flush=True)
    show_phase(name)


def last_time(name: str) -> float | None:
    """Returns the seconds that a phase of this process' command took the last time, if that is known."""
    return next((took for each in _timed if (took := each.last(name)) is not None), None)


def end_status() -> None:
    """Shows nothing any more, because something else does."""
    while _shown:
        _shown.pop().stop()


@contextlib.contextmanager
def shown_status(argv: Sequence[str], outputs: Sequence[Lasting]) -> Iterator[None]:
    """Shows within the block what the command of these words does.

    Nothing is shown where standard error is closed or another program's, in a process of a simulated flight, whose
    command shows its own, nor, but on a terminal, before what is there at once: a help, versions or a script.

    Args:
        argv: words of the command.
        outputs: of `lasting_streams`; the line makes way for what is written to them.
    """
    error = _standard_error(outputs)
    if error is None or any(word.partition("=")[0] == "--clock" for word in argv):
        yield
        return
    command = _command_of(argv)
    at_once = command in ("", "completion") or {"-h", "--help", "--help-all", "--version"} & set(argv)
    if at_once and not _is_live(error):
        yield
        return
    with status_of(f"edqn {command}".rstrip(), outputs):
        yield


@contextlib.contextmanager
def status_of(title: str, outputs: Sequence[Lasting]) -> Iterator[None]:
    """Shows within the block what a program of this title does, unless standard error is closed or another's."""
    error = _standard_error(outputs)
    if error is None:
        yield
        return
    sys.stderr.flush()
    durations = Durations(title)
    status = Status(title, error.fileno(), lives=_is_live(error), durations=durations)
    _timed.append(durations)
    for output in outputs:
        output.watch(status.make_way)
    _shown.append(status)
    status.start()
    try:
        with taken(title):
            yield
    finally:
        end_status()
        _timed.remove(durations)
        durations.keep()


def show_phases(title: str) -> ShowPhase:
    """Shows on standard error what a script does, from now until it ends, as the commands of `edqn` do.

    A terminal has one line with the phase and its clock; elsewhere, as in a log, a line is printed after every two
    seconds without output. Nothing is shown where standard error is another program's, as in a notebook. Call it before
    the imports that take seconds.

    Args:
        title: what each line begins with, such as the name of the script.

    Returns:
        what to call as a phase begins: with its name, and where it has parts with how many are done, of how many. It is
        also a `phase` for `evaluate` and `record`.
    """
    atexit.register(open_status(title).close)
    return show_phase


def open_status(title: str) -> contextlib.ExitStack:
    """Shows what this process does, as `status_of`, until what is returned is closed."""
    with contextlib.ExitStack() as shown:
        shown.enter_context(status_of(title, shown.enter_context(lasting_streams())))
        return shown.pop_all()


def _standard_error(outputs: Sequence[Lasting]) -> Lasting | None:
    return next((output for output in outputs if output.fileno() == 2), None)


def _is_live(error: Lasting) -> bool:
    """Returns whether one line can be drawn over and over."""
    return error.isatty() and os.environ.get("TERM") not in (None, "", "dumb")


def _command_of(argv: Sequence[str]) -> str:
    """Returns the command among its words, or nothing; what is imported may stand before it."""
    words = [word for before, word in zip(("", *argv), argv, strict=False) if before != "--import"]
    command = next((word for word in words if not word.startswith("-")), "")
    return command if command.isidentifier() else ""


def _clock(seconds: float) -> str:
    """Returns `m:ss`, without the packages that `evaluation.metrics.format_duration` takes seconds to import."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02}"
