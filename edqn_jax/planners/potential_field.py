"""APF: the artificial potential field. It knows the map.

Khatib, "Real-Time Obstacle Avoidance for Manipulators and Mobile Robots", Int. J. Robotics Research 5(1), 1986:
the goal attracts with 1/2 k rho_goal^2, every shape within `influence_m` repels with
1/2 eta (1 / rho - 1 / rho_0)^2, rho the distance between its surface and the drone's, and the drone goes where
the sum of the forces pushes it. Beyond `conic_m` from the goal the attraction is constant, as is usual, so that
far goals do not push through walls.

The path is followed in steps of equal length. A field of this kind has local minima: if the drone has come nowhere
in `patience` steps, or a step would hit something, the planner says "no path", though there may well be one.
The budget's step is one step of the path.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time

import numpy as np

from edqn_jax.planners.packages import require
from edqn_jax.planners.planner import MARGIN, Budget, Plan, Task, found, not_found, point_text, refusal
from edqn_jax.planners.solids import leg_free, shape_distance, solid_table

numba = require("numba")

STEPS = 20_000
"""Steps at most, unless the budget says otherwise."""

_ARRIVED, _MINIMUM, _HIT, _SPENT = range(4)
_NUDGE = 1e-5  # metres, of the central differences


@dataclasses.dataclass(frozen=True)
class ApfConfig:
    """The field and how it is followed; all values are ours."""

    attraction: float = 1.0
    """k, force per metre from the goal."""
    repulsion: float = 20.0
    """eta."""
    influence_m: float = 2.0
    """rho_0, the distance from which a shape repels."""
    conic_m: float = 5.0
    """Distance from the goal beyond which the attraction is constant."""
    step_m: float = 0.1
    """Length of a step."""
    patience: int = 100
    """Steps after which the drone must have come somewhere."""
    somewhere_m: float = 0.5
    """How far that is."""


@numba.njit
def force(table, x, y, z, goal, radius, attraction, repulsion, influence, conic):
    """The force (x, y, z) at a point: minus the gradient of both potentials."""
    rx, ry, rz = goal[0] - x, goal[1] - y, goal[2] - z
    apart = math.sqrt(rx * rx + ry * ry + rz * rz)
    pull = attraction * min(1.0, conic / max(apart, 1e-12))
    fx, fy, fz = pull * rx, pull * ry, pull * rz
    for i in range(table.shape[0]):
        row = table[i]
        rho = shape_distance(row, x, y, z) - radius
        if rho >= influence:
            continue
        gx = shape_distance(row, x + _NUDGE, y, z) - shape_distance(row, x - _NUDGE, y, z)
        gy = shape_distance(row, x, y + _NUDGE, z) - shape_distance(row, x, y - _NUDGE, z)
        gz = shape_distance(row, x, y, z + _NUDGE) - shape_distance(row, x, y, z - _NUDGE)
        rho = max(rho, 1e-6)
        push = repulsion * (1.0 / rho - 1.0 / influence) / (rho * rho) / (2.0 * _NUDGE)
        fx, fy, fz = fx + push * gx, fy + push * gy, fz + push * gz
    return fx, fy, fz


@numba.njit
def descend(table, start, goal, volume, radius, goal_radius, gains, step, patience, somewhere, steps):
    """Follow the force from `start` [3]: how it ended, the points [n, 3] and n.

    `gains` are attraction, repulsion, influence and the conic distance; `volume` [2, 3] holds the drone in.
    """
    points = np.empty((steps + 1, 3))
    points[0] = start
    for n in range(steps):
        here = points[n]
        near = math.sqrt((goal[0] - here[0]) ** 2 + (goal[1] - here[1]) ** 2 + (goal[2] - here[2]) ** 2) <= goal_radius
        if near and leg_free(table, here, goal, radius):
            return _ARRIVED, points, n + 1
        if n >= patience:
            past = points[n - patience]
            if (here[0] - past[0]) ** 2 + (here[1] - past[1]) ** 2 + (here[2] - past[2]) ** 2 < somewhere**2:
                return _MINIMUM, points, n + 1
        fx, fy, fz = force(table, here[0], here[1], here[2], goal, radius, gains[0], gains[1], gains[2], gains[3])
        strength = math.sqrt(fx * fx + fy * fy + fz * fz)
        if not strength > 1e-9:
            return _MINIMUM, points, n + 1
        there = points[n + 1]
        there[0], there[1], there[2] = (
            here[0] + step * fx / strength,
            here[1] + step * fy / strength,
            here[2] + step * fz / strength,
        )
        for axis in range(3):
            there[axis] = min(max(there[axis], volume[0, axis]), volume[1, axis])
        if not leg_free(table, here, there, radius):
            return _HIT, points, n + 1
    return _SPENT, points, steps + 1


def plan(
    task: Task,
    budget: Budget = Budget(),  # noqa: B008 (it is frozen)
    seed: int = 0,
    config: ApfConfig = ApfConfig(),  # noqa: B008
) -> Plan:
    """The path downhill, or where it got stuck. `seed` does nothing, descent is deterministic."""
    del seed
    refused = refusal(task)
    if refused:
        return not_found(refused)
    _compile()
    steps = STEPS if budget.steps is None else budget.steps
    began = time.perf_counter()
    gains = np.array([config.attraction, config.repulsion, config.influence_m, config.conic_m])
    how, points, count = descend(
        solid_table(task.scene),
        np.asarray(task.start, np.float64),
        np.asarray(task.goal, np.float64),
        np.asarray(task.scene.volume, np.float64),
        task.body_radius + MARGIN,
        task.goal_radius,
        gains,
        config.step_m,
        config.patience,
        config.somewhere_m,
        steps,
    )
    seconds, taken = time.perf_counter() - began, count - 1
    if how == _ARRIVED:
        return found(np.concatenate([points[:count], task.goal[None]]), seconds, taken)
    last = point_text(np.round(points[count - 1], 1))
    why = {
        _MINIMUM: f"a local minimum of the potential at {last}",
        _HIT: f"the force drives the drone into something at {last}",
        _SPENT: f"the goal was not reached within {steps} steps",
    }
    return not_found(why[how], seconds, taken)


@functools.lru_cache(maxsize=1)
def _compile() -> None:
    """Let numba compile before the clock starts."""
    there = np.ones(3)
    descend(np.zeros((0, 17)), np.zeros(3), there, np.array([there, there]), 0.1, 0.1, np.ones(4), 0.1, 1, 0.1, 1)
