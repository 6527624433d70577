"""A camera that takes frames, a number at a time, in NumPy: slow and obvious."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def settings(
    lux: float,
    mean: float,
    target: float,
    shortest: float,
    longest: float,
    most_gain: float,
    sensitivity: float,
    well: float,
) -> tuple[float, float]:
    """Exposure time and gain: the first of 100 000 times, and then gains, with which the mean is at the target."""
    for time in np.geomspace(shortest, longest, 100_000):
        if sensitivity * lux * time * mean >= target * well:
            return float(time), 1.0
    for gain in np.geomspace(1.0, most_gain, 100_000):
        if gain * sensitivity * lux * longest * mean >= target * well:
            return longest, float(gain)
    return longest, most_gain


def pose(position: NDArray, quaternion: NDArray, dt: float, before: float) -> tuple[NDArray, NDArray]:
    """Place and attitude `before` seconds before the last of the poses [K + 1], which are `dt` seconds apart."""
    newer = len(position) - 1
    while before > dt:
        newer, before = newer - 1, before - dt
    share, older = before / dt, newer - 1
    other = quaternion[older] if quaternion[older] @ quaternion[newer] >= 0 else -quaternion[older]
    mixed = (1 - share) * quaternion[newer] + share * other
    return (1 - share) * position[newer] + share * position[older], mixed / np.linalg.norm(mixed)


def level(electrons: float, random: float, gain: float, read_noise: float, well: float, white: int = 255) -> int:
    """The level of a pixel whose standard normal random number is `random`."""
    read = electrons + random * (electrons + read_noise**2) ** 0.5
    return min(max(round(white * gain * read / well), 0), white)
