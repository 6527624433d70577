"""Events counted as they come, so that a decision waits for those of a few packets alone."""

from __future__ import annotations

import collections
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from edqn_jax.interop.deployment.runner import Runner


def at_pace(times: NDArray[np.int64], until_us: int, pace: float) -> NDArray[np.int64]:
    """Returns times [N] before `until_us` as a drone at the policy's own speed would have seen them: nearer to it."""
    return until_us - np.ceil((until_us - times) * pace).astype(np.int64)


def events_at_pace(events: NDArray, until_us: int, pace: float) -> NDArray:
    """Returns events [N] with their times as of `at_pace`."""
    if pace == 1.0:
        return events
    paced = events.copy()
    paced["t"] = at_pace(events["t"], until_us, pace)
    return paced


class Tally:
    """Counts of the newest packets in the policy's pixels."""

    def __init__(self, runner: Runner, pace: float) -> None:
        self._runner, self._pace = runner, pace
        times = np.asarray(runner.about["frame_times_us"], np.int64)
        self._edges = times - times[0]
        self._packets: collections.deque[tuple[int, NDArray, NDArray | None]] = collections.deque()
        self._spans: collections.deque[tuple[int, int]] = collections.deque()

    def take(self, packets: Iterable[tuple[int, NDArray]]) -> None:
        """Counts packets that are new: `until` and events [N] of each."""
        for until, events in packets:
            if self._packets and until < self._packets[-1][0]:  # the camera's clock began anew
                self._packets.clear()
                self._spans.clear()
            if not events.size:
                continue
            self._packets.append((until, events, self._runner.count(events)))
            self._spans.append((int(events["t"].min()), int(events["t"].max())))
            oldest = until - round(self._edges[-1] / self._pace) - 1
            while self._packets[0][0] < oldest:
                self._packets.popleft()
                self._spans.popleft()

    def number(self, until_us: int) -> NDArray[np.int64] | None:
        """Returns how many events there are before `until_us` [F, 2, H, W], as `Runner.decide` takes them.

        None, where a packet could not be counted, or there is none.
        """
        known = [counted for _, _, counted in self._packets if counted is not None]
        if not known or len(known) < len(self._packets):
            return None
        start_us = until_us - int(self._edges[-1])
        since = at_pace(np.array(self._spans, np.int64), until_us, self._pace) - start_us
        pairs = np.searchsorted(self._edges, since, side="right") - 1  # -1 before, len - 1 from the end on
        total = np.zeros((len(self._edges) - 1, *known[0].shape), np.int64)
        for (first, last), (_, events, _), counted in zip(pairs, self._packets, known, strict=True):
            if first != last:
                total += self._apart(events, until_us, start_us)
            elif 0 <= first < len(total):
                total[first] += counted
        return total

    def _apart(self, events: NDArray, until_us: int, start_us: int) -> NDArray[np.int64]:
        """Returns the number of events of a packet that is not within one pair of frames."""
        since = at_pace(events["t"], until_us, self._pace) - start_us
        pairs = np.searchsorted(self._edges, since, side="right") - 1
        parts = [self._runner.count(events[pairs == pair]) for pair in range(len(self._edges) - 1)]
        return np.stack([part for part in parts if part is not None])
