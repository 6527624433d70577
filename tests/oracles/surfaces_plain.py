"""Patterns of surfaces by brute force: what they are at a point, and the average of many points, in float64 NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edqn_jax.sim.scene.surface import CONTRAST, KIND, PATTERNS, PHASES, SHARES


def wave(phase: NDArray) -> NDArray:
    """Two parabolas: rising from 0 to 1 at a quarter, back at a half."""
    along = phase - np.floor(phase)
    return np.where(along < 0.5, 16 * along * (0.5 - along), -16 * (along - 0.5) * (1.0 - along))


def within(phase: NDArray, width: float) -> NDArray:
    """1 within half a `width` of the whole numbers, else 0."""
    return (np.abs(phase - np.round(phase)) < width / 2).astype(float)


def trapezoid(phase: NDArray, width: float, edge: float) -> NDArray:
    """1 around the whole numbers, 0 far off; slopes of width `edge` between, whose middles are `width` apart."""
    away = np.abs(phase - np.round(phase))
    return np.clip((width / 2 - away) / edge + 0.5, 0.0, 1.0)


def stripes(phase: NDArray, width: float) -> NDArray:
    return (within(phase, width) - width) / max(width, 1 - width)


def pattern(name: str, shares: ArrayLike, q: NDArray) -> NDArray:
    """What a pattern is at phases `q` [4, ...]."""
    a, b, c, d = np.asarray(shares, np.float64)
    match name:
        case "blank":
            return np.zeros(q.shape[1:])
        case "waves":
            return np.sum([share * wave(phase) for share, phase in zip((a, b, c, d), q, strict=True)], axis=0)
        case "noise":
            finer = (q[2] + q[3], 2 * q[2] - q[1], 2 * q[3] + q[0], 3 * q[2] - 2 * q[3])
            parts = zip((a, b, c, d), q, finer, strict=True)
            return np.sum([share * (wave(phase) + 0.5 * wave(fine)) for share, phase, fine in parts], axis=0)
        case "checks":
            first, second = stripes(q[0], d), stripes(q[1], d)
            return a * first + b * first * second + c * second
        case "bricks":
            even = within(q[1], 0.5) > 0
            upright = np.where(even, within(q[0], c), within(q[0] + 0.5, c))
            return a * np.maximum(within(2 * q[1] + 0.5, b), upright)
        case "posters":
            fine = (q[2], q[3], q[2] + q[3], 2 * q[2] - q[3])
            return within(q[0], c) * within(q[1], d) * (a + b * sum(wave(p) for p in fine))
        case "spots":
            fine = (q[2], q[3], 2 * q[3] + q[2])
            return trapezoid(q[0], c, d) * trapezoid(q[1], c, d) * (a + b * sum(wave(p) for p in fine))
        case "wood":
            return a * stripes(q[0] + b * wave(q[1]) + 0.5 * b * wave(q[2]), c) + d * wave(q[3])
    raise ValueError(name)


def pixel(name: str, shares: ArrayLike, at: NDArray, right: NDArray, up: NDArray, samples: int = 32) -> NDArray:
    """The average of a pattern over pixels, whose phases [4, ...] change by `right` and `up` from edge to edge."""
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    total = np.zeros(at.shape[1:])
    for x in steps:
        for y in steps:
            total += pattern(name, shares, at + x * right + y * up)
    return total / samples**2


def factor(numbers: NDArray, position: NDArray, points: NDArray) -> NDArray:
    """The relative albedo of a surface at points [K, 3]."""
    numbers = np.asarray(numbers, np.float64)
    rows = numbers[PHASES:].reshape(4, 4)
    phases = (points - np.asarray(position, np.float64)) @ rows[:, :3].T + rows[:, 3]
    return 1 + numbers[CONTRAST] * pattern(PATTERNS[int(numbers[KIND])], numbers[SHARES:PHASES], phases.T)
