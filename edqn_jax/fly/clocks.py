"""Clocks: the host's, and how far those of camera and autopilot are from it."""

from __future__ import annotations

import collections
import time
from typing import Protocol

WINDOW_S = 5.0
"""Samples of so long decide a clock's offset."""

JUMP_S = 0.1
"""An offset that differs by more is that of a clock that has jumped."""


class Clock(Protocol):
    """The host's clock, real or simulated."""

    passes: bool
    """Whether time passes by itself, so that something can be waited for."""

    def now(self) -> float:
        """Returns seconds since some moment; never runs back."""
        ...

    def sleep_until(self, moment: float) -> None:
        """Returns once this moment is there."""
        ...

    def work(self) -> None:
        """Lets the time pass that a decision takes, where it does not pass by itself."""
        ...


class WallClock:
    """The machine's monotonic clock."""

    passes = True

    def now(self) -> float:
        """Returns its seconds."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Sleeps until a moment."""
        left = moment - time.monotonic()
        if left > 0.0:
            time.sleep(left)

    def work(self) -> None:
        """Does nothing: time passes by itself."""


class ClockOffset:
    """Seconds to add to another clock's to have the host's: that of the sample with the least delay in `WINDOW_S`.

    As the window moves on, so does a clock that drifts. One that jumps by more than `JUMP_S` is followed after three
    samples that agree.
    """

    def __init__(self) -> None:
        self._samples: collections.deque[tuple[float, float, float]] = collections.deque()
        self._strange: list[tuple[float, float, float]] = []
        self.value: float | None = None
        """Seconds; None before the first sample."""
        self.jumps = 0

    def add_exchange(self, sent: float, other: float, received: float) -> None:
        """Takes a sample of a question and its answer.

        Args:
            sent: when the question was sent, the host's clock.
            other: what the other clock showed as it answered.
            received: when the answer came, the host's clock.
        """
        self._add((sent + received) / 2 - other, received - sent, received)

    def add_arrival(self, other: float, received: float) -> None:
        """Takes a sample of a message that says when it was made: its delay is part of the offset."""
        self._add(received - other, received - other, received)

    def _add(self, offset: float, delay: float, now: float) -> None:
        sample = (now, delay, offset)
        if self.value is not None and abs(offset - self.value) > JUMP_S:
            self._strange.append(sample)
            if len(self._strange) < 3:
                return
            self._samples.clear()
            self._samples.extend(self._strange)
            self.jumps += 1
        else:
            self._samples.append(sample)
        self._strange.clear()
        while self._samples[0][0] < now - WINDOW_S:
            self._samples.popleft()
        self.value = min(self._samples, key=lambda each: each[1])[2]
