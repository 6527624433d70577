"""Where moving shapes are, and what they touch, in the plainest way: stepping in time, in double precision."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def bounced(position: float, velocity: float, low: float, high: float, time: float, steps: int = 20_000) -> float:
    """Returns a coordinate after `time` seconds: small steps, each turned back at the walls."""
    for _ in range(steps):
        position += velocity * time / steps
        if position > high:
            position, velocity = 2 * high - position, -velocity
        elif position < low:
            position, velocity = 2 * low - position, -velocity
    return position


def swung(a: NDArray, b: NDArray, rate: float, phase: float, time: float) -> NDArray:
    """Returns the displacement [3] on an ellipse of half axes `a` and `b`, from the phase at time 0."""

    def on_ellipse(angle: float) -> NDArray:
        return math.cos(angle) * np.asarray(a, float) + math.sin(angle) * np.asarray(b, float)

    return on_ellipse(phase + rate * time) - on_ellipse(phase)


def thrown(throw, start: NDArray, goal: NDArray, time: float, steps: int = 4000) -> NDArray | None:
    """Returns where a ball is, by its equation of motion from the launch on; None before that."""
    start, goal = np.asarray(start, float), np.asarray(goal, float)
    way = goal - start
    length = float(np.linalg.norm(way))
    hit = max(float(throw.share) * length / float(throw.pace), float(throw.early))
    launch = hit - float(throw.early)
    if time < launch - 1e-9:
        return None
    aim = start + min(float(throw.pace) * hit, length) * way / length
    heading = math.atan2(way[1], way[0]) + float(throw.bearing)
    e = float(throw.elevation)
    comes_from = np.array([math.cos(e) * math.cos(heading), math.cos(e) * math.sin(heading), math.sin(e)])
    place = aim + float(throw.speed) * float(throw.early) * comes_from
    # Thrown upwards just so much that gravity brings it to the aim.
    velocity = -float(throw.speed) * comes_from + np.array([0, 0, 0.5 * float(throw.gravity) * float(throw.early)])
    dt = (time - launch) / steps
    for _ in range(steps):
        middle = velocity - np.array([0, 0, 0.5 * float(throw.gravity) * dt])
        place, velocity = place + middle * dt, velocity - np.array([0, 0, float(throw.gravity) * dt])
    return place
