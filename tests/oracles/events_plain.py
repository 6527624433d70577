"""The three event laws as loops over pixels, one event at a time, in NumPy: slow and obvious."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Event = tuple[float, int, int, int]
"""Seconds from the window's start, column, row, polarity."""


def paper(level: NDArray, times: NDArray, threshold: float, tolerance: float, refractory_ns: float) -> list[Event]:
    """Eq. 2-5 for log brightness `[T, H, W]` at `times` (seconds)."""
    found: list[Event] = []
    for pair in range(len(times) - 1):
        interval = times[pair + 1] - times[pair]
        limit = int(round(interval * 1e9) * 1e-3 / (refractory_ns * 1e-3)) if refractory_ns else 10**9
        for y in range(level.shape[1]):
            for x in range(level.shape[2]):
                change = float(level[pair + 1, y, x]) - float(level[pair, y, x])
                if abs(change) <= threshold:
                    continue
                count = min(limit, math.floor(abs(change) / tolerance))
                for k in range(count):
                    moment = times[pair] + k * interval / count - times[0]
                    found.append((moment, x, y, 1 if change > 0 else -1))
    return sorted(found)


def airsim_count(before: int, after: int, tolerance: float) -> tuple[int, int]:
    """Events and polarity between two 8-bit grey values, in AirSim's order of operations, uncapped."""
    start = np.log(np.float32(before) + np.float32(0.001))
    end = np.log(np.float32(after) + np.float32(0.001))
    if abs(float(end - start)) < tolerance:
        return 0, 0
    sign = 1.0 if end > start else -1.0
    first_crossing = np.float32(float(start) + sign * tolerance)
    if sign * (float(end) - float(first_crossing)) <= 0.0:
        return 0, 0
    count = abs(int((float(end) - float(first_crossing)) / tolerance))
    return count, int(sign) if count else 0


def esim(
    level: NDArray,
    times: NDArray,
    residual: NDArray,
    contrast_on: float,
    contrast_off: float,
    refractory_ns: float,
) -> list[Event]:
    """A sensor: walk each pixel's brightness along its straight lines, level by level."""
    found: list[Event] = []
    _, height, width = level.shape
    for y in range(height):
        for x in range(width):
            reference = float(level[0, y, x]) - float(residual[y, x])
            last = -math.inf
            for pair in range(len(times) - 1):
                before, after = float(level[pair, y, x]), float(level[pair + 1, y, x])
                while True:
                    if after >= before and after - reference >= contrast_on:
                        reference, sign = reference + contrast_on, 1
                    elif after < before and reference - after >= contrast_off:
                        reference, sign = reference - contrast_off, -1
                    else:
                        break
                    share = (reference - before) / (after - before)
                    moment = times[pair] + share * (times[pair + 1] - times[pair]) - times[0]
                    if moment - last >= refractory_ns * 1e-9:
                        found.append((moment, x, y, sign))
                        last = moment
    return sorted(found)


def merged(one: list[Event], other: list[Event], times: NDArray, refractory_ns: float) -> list[Event]:
    """Two lists of events as one camera's: a pixel's of a polarity between two frames, evenly from first to last.

    Pixels that have events of one list alone keep them as they are.
    """
    groups: dict[tuple[int, int, int, int], tuple[list[float], list[float]]] = {}
    for which, events in enumerate((one, other)):
        for moment, x, y, sign in events:
            pair = int(np.searchsorted(times - times[0], moment, side="right")) - 1
            groups.setdefault((pair, x, y, sign), ([], []))[which].append(moment)
    found: list[Event] = []
    for (pair, x, y, sign), (of_one, of_other) in groups.items():
        moments = sorted(of_one + of_other)
        if of_one and of_other:
            step = max((moments[-1] - moments[0]) / (len(moments) - 1), refractory_ns * 1e-9)
            start, end = times[pair] - times[0], times[pair + 1] - times[0]
            first = max(min(moments[0], end - 1e-6 - (len(moments) - 1) * step), start)
            moments = [first + k * step for k in range(len(moments))]
        found += [(moment, x, y, sign) for moment in moments]
    return sorted(found)
