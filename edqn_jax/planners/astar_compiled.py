"""A*, compiled with numba: the same lattice and the same rule for edges as `astar`, one entry at a time.

It knows the map. `astar` says what the lattice is and is what this one is held against: the shortest lattice path
has the same length here, though among many of one length it may be another. The path is pulled tight by the
same function. The budget's step is one cell expanded; there are no more than cells, so that the search ends.
"""

from __future__ import annotations

import functools
import heapq
import math
import time

import numpy as np

from edqn_jax.planners.astar import pull_tight, unseen_depth
from edqn_jax.planners.packages import require
from edqn_jax.planners.planner import Budget, Plan, Task, found, not_found, refusal
from edqn_jax.planners.solids import distance, leg_free, solid_table

numba = require("numba")

CELL_M, COARSE_CELL_M = 0.5, 1.0
"""Cell of the lattice, metres; the coarse one is as large as the SNN's."""

_FOUND, _BLOCKED, _SHUT_IN, _SPENT = range(4)
_KNOWN, _OPENED = 1, 2
_SAMPLES = 8  # of an edge, as in `sim.scene.segment_contact`
_TIE = 1e-9  # entries of one length are taken nearest to the goal first, which costs 1e-9 of the length at most


@numba.njit
def _edge_free(table, x, y, z, dx, dy, dz, radius):
    for k in range(_SAMPLES):
        share = k / (_SAMPLES - 1)
        if distance(table, x + share * dx, y + share * dy, z + share * dz) <= radius:
            return False
    return True


@numba.njit
def _free_length(i, j, k, goal, cell):
    """Length of the shortest lattice path to the goal's cell if nothing is in the way."""
    a, b, c = abs(i - goal[0]), abs(j - goal[1]), abs(k - goal[2])
    low, high = min(a, b, c), max(a, b, c)
    middle = a + b + c - low - high
    return cell * (math.sqrt(3.0) * low + math.sqrt(2.0) * (middle - low) + (high - middle))


@numba.njit
def _cell_near(table, point, start, origin, shape, cell, radius):
    """The nearest cell from which the sphere passes straight to a point; -1 in its first place if there is none."""
    best, nearest = np.full(3, -1), math.inf
    middle = np.empty(3)
    corner = np.empty(3, np.int64)
    for number in range(8):
        inside = True
        for axis in range(3):
            base = math.floor((point[axis] - start[axis]) / cell + 1e-5) + origin[axis]
            corner[axis] = base + (number >> (2 - axis) & 1)
            inside = inside and 0 <= corner[axis] < shape[axis]
            middle[axis] = start[axis] + cell * (corner[axis] - origin[axis])
        if not inside:
            continue
        apart = math.sqrt(np.sum((middle - point) ** 2))
        if apart < nearest and leg_free(table, middle, point, radius):
            nearest = apart
            best[:] = corner
    return best


@numba.njit
def search(table, start, goal, lower, upper, cell, radius, margin, limit):
    """How it ended, the path's cells as points [n, 3] from start on, its length in metres, and cells expanded.

    `start`, `goal`, `lower` and `upper` are [3] metres, `margin` is what edges need beyond the radius, and
    `limit` the most cells to expand.
    """
    origin, shape = np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        # A point on the fence belongs to the volume, whatever the last digit of its float32 says.
        origin[axis] = math.floor((start[axis] - lower[axis]) / cell + 1e-5)
        shape[axis] = origin[axis] + math.floor((upper[axis] - start[axis]) / cell + 1e-5) + 1
    nothing = np.empty((0, 3))
    target = _cell_near(table, goal, start, origin, shape, cell, radius)
    if target[0] < 0:
        return _SHUT_IN, nothing, math.inf, 0
    ny, nz = shape[1], shape[2]
    source = (origin[0] * ny + origin[1]) * nz + origin[2]
    finish = (target[0] * ny + target[1]) * nz + target[2]
    # Only cells that are reached are ever written, so that the system hands out memory for these alone.
    state = np.zeros(shape[0] * ny * nz, np.uint8)
    length, room = np.empty(state.size), np.empty(state.size)
    parent = np.empty(state.size, np.int32)
    tiny = 1e-9 * cell
    length[source], parent[source], state[source] = 0.0, source, _KNOWN | _OPENED
    room[source] = distance(table, start[0], start[1], start[2])
    entries = [(0.0, 0.0, source)]
    expanded = 0
    while len(entries) > 0:
        _, negative, at = heapq.heappop(entries)
        here = -negative
        if here > length[at]:
            continue
        if at == finish:
            break
        if expanded >= limit:
            return _SPENT, nothing, math.inf, expanded
        expanded += 1
        i, rest = divmod(at, ny * nz)
        j, k = divmod(rest, nz)
        x, y, z = (
            start[0] + cell * (i - origin[0]),
            start[1] + cell * (j - origin[1]),
            start[2] + cell * (k - origin[2]),
        )
        for di in range(-1, 2):
            for dj in range(-1, 2):
                for dk in range(-1, 2):
                    if (di == 0 and dj == 0 and dk == 0) or not (
                        0 <= i + di < shape[0] and 0 <= j + dj < ny and 0 <= k + dk < nz
                    ):
                        continue
                    to = ((i + di) * ny + j + dj) * nz + k + dk
                    step = cell * math.sqrt(di * di + dj * dj + dk * dk)
                    reached = here + step
                    if state[to] & _OPENED and reached >= length[to] - tiny:
                        continue
                    dx, dy, dz = cell * di, cell * dj, cell * dk
                    if not state[to] & _KNOWN:
                        room[to] = distance(table, x + dx, y + dy, z + dz)
                        state[to] |= _KNOWN
                    if room[to] < radius:
                        continue
                    # The distance changes by at most a metre a metre, which proves most edges free.
                    if room[at] + room[to] - step - 2.0 * radius < 0.0 and not _edge_free(
                        table, x, y, z, dx, dy, dz, radius + margin
                    ):
                        continue
                    length[to], parent[to] = reached, at
                    state[to] |= _OPENED
                    estimate = reached + _free_length(i + di, j + dj, k + dk, target, cell)
                    heapq.heappush(entries, (estimate - _TIE * reached, -reached, to))
    if not state[finish] & _OPENED:
        return _BLOCKED, nothing, math.inf, expanded
    count, at = 1, finish
    while at != source:
        at = parent[at]
        count += 1
    points = np.empty((count, 3))
    at = finish
    for n in range(count - 1, -1, -1):
        i, rest = divmod(at, ny * nz)
        j, k = divmod(rest, nz)
        points[n, 0] = start[0] + cell * (i - origin[0])
        points[n, 1] = start[1] + cell * (j - origin[1])
        points[n, 2] = start[2] + cell * (k - origin[2])
        at = parent[at]
    return _FOUND, points, length[finish], expanded


def plan(
    task: Task,
    budget: Budget = Budget(),  # noqa: B008 (it is frozen)
    seed: int = 0,
    cell: float = CELL_M,
) -> Plan:
    """The shortest path. `seed` does nothing, the search is deterministic."""
    del seed
    refused = refusal(task)
    if refused:
        return not_found(refused)
    _compile()
    limit = np.iinfo(np.int64).max if budget.steps is None else budget.steps
    lower, upper = np.asarray(task.scene.volume, np.float64)
    start, goal = np.asarray(task.start, np.float64), np.asarray(task.goal, np.float64)
    margin = unseen_depth(cell, task.body_radius)
    began = time.perf_counter()
    table = solid_table(task.scene)
    how, points, _, expanded = search(table, start, goal, lower, upper, cell, task.body_radius, margin, limit)
    if how == _FOUND:
        if np.any(points[-1] != goal):
            points = np.concatenate([points, goal[None]])
        points = pull_tight(points, lambda a, b: not leg_free(table, a, b, task.body_radius))
    seconds = time.perf_counter() - began
    if how == _FOUND:
        return found(points, seconds, expanded)
    why = {
        _BLOCKED: "every way is blocked",
        _SHUT_IN: f"the goal is shut in within {cell:g} m",
        _SPENT: f"the goal was not reached within {expanded} cells",
    }
    return not_found(why[how], seconds, expanded)


def plan_coarse(task: Task, budget: Budget = Budget(), seed: int = 0) -> Plan:  # noqa: B008
    """The shortest path on a lattice of `COARSE_CELL_M`, pulled tight: with an eighth of the cells."""
    return plan(task, budget, seed, COARSE_CELL_M)


@functools.lru_cache(maxsize=1)
def _compile() -> None:
    """Let numba compile before the clock starts."""
    search(np.zeros((0, 17)), np.zeros(3), np.ones(3), np.zeros(3), np.ones(3), 0.5, 0.1, 0.0, 100)
