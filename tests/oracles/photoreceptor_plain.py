"""A photoreceptor of first order as a loop over very small steps, in NumPy: slow and obvious."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def follow(cutoff_hz: float, level: NDArray, times: NDArray, luma: NDArray, lag: NDArray, parts: int = 4000) -> NDArray:
    """What the pixels [T, H, W] show at the frames: y' = 2 pi f (x - y), x linear between frames, by Heun's rule.

    f is `cutoff_hz` times v2e's share (8-bit brightness + 20) / 275, the mean of both frames.
    """
    shown = [level[0] + lag]
    y = shown[0].astype(np.float64)
    for k in range(len(times) - 1):
        share = ((255.0 * luma[k] + 20.0) / 275.0 + (255.0 * luma[k + 1] + 20.0) / 275.0) / 2
        rate, dt = 2 * np.pi * cutoff_hz * share, (times[k + 1] - times[k]) / parts
        for part in range(parts):
            here = level[k] + (level[k + 1] - level[k]) * part / parts
            there = level[k] + (level[k + 1] - level[k]) * (part + 1) / parts
            first = rate * (here - y)
            y = y + dt * (first + rate * (there - (y + dt * first))) / 2
        shown.append(y)
    return np.stack(shown)
