"""APF: a planner that descends an artificial potential field.

Khatib, "Real-Time Obstacle Avoidance for Manipulators and Mobile Robots", Int. J. Robotics Research 5(1), 1986:
the goal attracts with the potential 1/2 k rho_goal^2, and every shape within `influence_m` repels with
1/2 eta (1 / rho - 1 / rho_0)^2, where rho is the distance between its surface and that of the drone. The path follows
the sum of the forces. Beyond `conic_m` from the goal the attraction is constant, as is usual, so that it does not
exceed the repulsion of obstacles when the goal is far away.

The path consists of steps of equal length. Such a field has local minima: if the drone moves less than `progress_m` in
`patience` steps, or a step would touch an obstacle, the planner reports "no path", although there may be one. The
budget's step is one step of the path.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time

import numpy as np

from edqn_jax.extras import require_extra
from edqn_jax.planning.path import MARGIN, PlannedPath, PlanningTask, not_found, path_as_plan, point_text
from rivals.planners.planner import Budget, refusal
from rivals.planners.solids import leg_free, shape_distance, solid_table

numba = require_extra("numba")

STEPS = 20_000
"""Maximum number of steps unless the budget sets another."""

_ARRIVED, _MINIMUM, _HIT, _SPENT = range(4)
_DIFFERENCE = 1e-5  # metres, of the central differences


@dataclasses.dataclass(frozen=True)
class ApfConfig:
    """The field and how it is followed; the values are not from a publication."""

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
    """Steps in which the drone must move by `progress_m`."""
    progress_m: float = 0.5
    """Metres from the point `patience` steps before."""


@numba.njit
def force(table, x, y, z, goal, radius, attraction, repulsion, influence, conic):
    """Returns the force (x, y, z) at a point: the negative gradient of both potentials."""
    rx, ry, rz = goal[0] - x, goal[1] - y, goal[2] - z
    apart = math.sqrt(rx * rx + ry * ry + rz * rz)
    pull = attraction * min(1.0, conic / max(apart, 1e-12))
    fx, fy, fz = pull * rx, pull * ry, pull * rz
    for i in range(table.shape[0]):
        row = table[i]
        rho = shape_distance(row, x, y, z) - radius
        if rho >= influence:
            continue
        gx = shape_distance(row, x + _DIFFERENCE, y, z) - shape_distance(row, x - _DIFFERENCE, y, z)
        gy = shape_distance(row, x, y + _DIFFERENCE, z) - shape_distance(row, x, y - _DIFFERENCE, z)
        gz = shape_distance(row, x, y, z + _DIFFERENCE) - shape_distance(row, x, y, z - _DIFFERENCE)
        rho = max(rho, 1e-6)
        push = repulsion * (1.0 / rho - 1.0 / influence) / (rho * rho) / (2.0 * _DIFFERENCE)
        fx, fy, fz = fx + push * gx, fy + push * gy, fz + push * gz
    return fx, fy, fz


@numba.njit
def descend(table, start, goal, volume, radius, goal_radius, gains, step, patience, progress, steps):
    """Follows the force from `start` [3].

    Args:
        table: [N, 17] from `solid_table`.
        start, goal: [3] metres.
        volume: [2, 3] metres, the path stays within.
        radius, goal_radius: metres.
        gains: [4] attraction, repulsion, influence and conic distance of `ApfConfig`.
        step, patience, progress: as in `ApfConfig`.
        steps: maximum number of steps.

    Returns:
        how it ended; an array [steps + 1, 3] whose first rows are the path's points, metres; the number of these rows.
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
            if (here[0] - past[0]) ** 2 + (here[1] - past[1]) ** 2 + (here[2] - past[2]) ** 2 < progress**2:
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
    task: PlanningTask,
    budget: Budget = Budget(),  # noqa: B008 (it is frozen)
    seed: int = 0,
    config: ApfConfig = ApfConfig(),  # noqa: B008
) -> PlannedPath:
    """Returns the path along the force, or where it got stuck. The descent is deterministic: `seed` is unused."""
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
        config.progress_m,
        steps,
    )
    seconds, taken = time.perf_counter() - began, count - 1
    if how == _ARRIVED:
        return path_as_plan(np.concatenate([points[:count], task.goal[None]]), seconds, taken)
    last = point_text(np.round(points[count - 1], 1))
    why = {
        _MINIMUM: f"a local minimum of the potential at {last}",
        _HIT: f"the force drives the drone into an obstacle at {last}",
        _SPENT: f"the goal was not reached within {steps} steps",
    }
    return not_found(why[how], seconds, taken)


@functools.lru_cache(maxsize=1)
def _compile() -> None:
    """Makes numba compile before time is measured."""
    there = np.ones(3)
    descend(np.zeros((0, 17)), np.zeros(3), there, np.array([there, there]), 0.1, 0.1, np.ones(4), 0.1, 1, 0.1, 1)
