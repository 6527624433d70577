"""The pixels of a real sensor under one of ours, one by one, in NumPy: slow and obvious."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def memoryless(change: float, thresholds: NDArray, rng: np.random.Generator) -> int:
    """Returns the events of all pixels [n] for one change of log brightness.

    Each pixel's reference lies anywhere within a threshold of its own before the change.
    """
    return sum(int(rng.random() + abs(change) / threshold) for threshold in thresholds)


def with_memory(levels: NDArray, thresholds: NDArray, rng: np.random.Generator) -> NDArray:
    """Returns ON minus OFF events of all pixels [n] between levels of log brightness [T], [T - 1]; references start
    anywhere within a threshold of the first level."""
    references = levels[0] + rng.uniform(-1.0, 1.0, thresholds.shape) * thresholds
    events = []
    for level in levels[1:]:
        number = 0
        for pixel, threshold in enumerate(thresholds):
            while level >= references[pixel] + threshold:
                references[pixel] += threshold
                number += 1
            while level <= references[pixel] - threshold:
                references[pixel] -= threshold
                number -= 1
        events.append(number)
    return np.array(events)


def thresholds_of(nominal: float, mismatch: float, pixels: int, rng: np.random.Generator) -> NDArray:
    """Returns the thresholds [n] of pixels, normal about the nominal one."""
    return nominal * np.maximum(1.0 + mismatch * rng.normal(size=pixels), 0.1)
