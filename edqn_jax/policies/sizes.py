"""Flight volumes beside those that a policy was trained in. Without JAX, as `edqn fly` is."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGER = 1.5
"""A volume is much larger than those of training if a side is so many times as long."""


def describe_larger(sides: ArrayLike, trained_in: Iterable[ArrayLike]) -> list[str]:
    """Returns a warning, in a list, if a flight volume is much larger than those of the training; else an empty one.

    Args:
        sides: [3] metres.
        trained_in: [3] metres each; none where they are not known.
    """
    every = [sorted_sides(known) for known in trained_in]
    if not every:
        return []
    here, there = sorted_sides(sides), np.max(every, axis=0)
    if np.all(here <= LARGER * there):
        return []
    met, known = (" × ".join(f"{side:.4g}" for side in each) for each in (here, there))
    return [
        f"the flight volume of {met} m is much larger than those that the policy was trained in, at most {known} m: "
        "how it flies there has not been measured"
    ]


def sorted_sides(sides: ArrayLike) -> NDArray[np.float64]:
    """Returns sides [3] of a volume, metres: the longer level one, the other one, the height."""
    x, y, z = np.asarray(sides, np.float64)
    return np.array([max(x, y), min(x, y), z])
