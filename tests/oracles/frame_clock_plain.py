"""A frame camera that exposes by its own clock, frame by frame, in Python: slow and obvious."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def newest_end(now: float, rate: float, phase: float, latency: float) -> float:
    """When the newest exposure ended whose frame is there at time `now`; one ends `phase` after time 0."""
    end = phase - 100.0 / rate
    while end + 1.0 / rate + latency <= now:
        end += 1.0 / rate
    return end


def place_at(time: float, path: NDArray, dt: float) -> NDArray:
    """Place at a time of a flight whose poses are `dt` apart, the first at time 0; before it the drone stood still."""
    times = np.arange(len(path)) * dt
    return np.array([np.interp(time, times, values) for values in path.T])
