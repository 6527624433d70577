"""A* compiled with numba, on the same lattice and with the same edges as `astar`, which describes them.

It expands one cell at a time instead of many at once. The shortest lattice path has the same length as that of
`astar`, but need not be the same one of several of equal length. It is shortened by the same function. The budget's
step is one expanded cell.
"""

from __future__ import annotations

import functools
import heapq
import math
import time
from typing import NamedTuple

import numpy as np

from edqn_jax.extras import require_extra
from edqn_jax.planning.astar import shorten_path
from edqn_jax.planning.lattice import edge_margin
from edqn_jax.planning.path import PlannedPath, PlanningTask, not_found, path_as_plan
from rivals.planners.planner import Budget, refusal
from rivals.planners.solids import distance, leg_free, solid_table

numba = require_extra("numba")

CELL_M, COARSE_CELL_M = 0.5, 1.0
"""Cell size of the lattice in metres; the coarse one is that of the SNN."""

_FOUND, _BLOCKED, _ENCLOSED, _SPENT = range(4)
_KNOWN, _REACHED = 1, 2
_SAMPLES = 8  # of an edge, as in `sim.distance.segment_contact`
_STEPS = (0.0, 1.0, math.sqrt(2.0), math.sqrt(3.0))  # cells between neighbours, by the number of axes moved along
_TIE = 1e-9  # of entries of equal estimate the one nearest to the goal comes first; costs at most 1e-9 of the length


class _Lattice(NamedTuple):
    """Cells that fill the flight volume; the middle of the cell `origin` is the start.

    Tuples, because numba counts the references to arrays in every call.
    """

    start: tuple[float, float, float]  # metres
    origin: tuple[int, int, int]  # index of the start's cell
    shape: tuple[int, int, int]  # number of cells
    cell: float  # metres


class _Obstacles(NamedTuple):
    """The map, and the sphere that must pass."""

    table: np.ndarray  # [N, 17] from `solid_table`
    radius: float  # metres
    margin: float  # metres that edges need beyond the radius


class _Cells(NamedTuple):
    """State of the search for each cell, by flat index [C]."""

    state: np.ndarray  # uint8: `_KNOWN` if the clearance is computed, `_REACHED` if there is a path
    clearance: np.ndarray  # metres from the middle of the cell to the nearest surface
    length: np.ndarray  # metres of the shortest path so far
    parent: np.ndarray  # int32, the cell before on that path


# ---------------------------------------------------------------------------------------- lattice


@numba.njit
def _lattice(start, lower, upper, cell):
    """Returns the lattice of a volume from `lower` [3] to `upper` [3] with a cell at `start` [3]."""
    # Rounded up a little: float32 may put a point on the boundary just outside the volume.
    i, j, k = [math.floor((start[axis] - lower[axis]) / cell + 1e-5) for axis in range(3)]
    nx, ny, nz = [math.floor((upper[axis] - start[axis]) / cell + 1e-5) + 1 for axis in range(3)]
    return _Lattice((start[0], start[1], start[2]), (i, j, k), (i + nx, j + ny, k + nz), cell)


@numba.njit
def _flat(lattice, i, j, k):
    return (i * lattice.shape[1] + j) * lattice.shape[2] + k


@numba.njit
def _index(lattice, at):
    i, rest = divmod(at, lattice.shape[1] * lattice.shape[2])
    j, k = divmod(rest, lattice.shape[2])
    return i, j, k


@numba.njit
def _inside(lattice, i, j, k):
    return 0 <= i < lattice.shape[0] and 0 <= j < lattice.shape[1] and 0 <= k < lattice.shape[2]


@numba.njit
def _middle(lattice, i, j, k):
    """Returns the middle (x, y, z) of a cell, metres."""
    start, origin, cell = lattice.start, lattice.origin, lattice.cell
    return start[0] + cell * (i - origin[0]), start[1] + cell * (j - origin[1]), start[2] + cell * (k - origin[2])


@numba.njit
def _cell_near(lattice, obstacles, point):
    """Returns the nearest cell (i, j, k) from which the sphere passes straight to `point` [3]; (-1, -1, -1) if none."""
    best, nearest = (-1, -1, -1), math.inf
    start, origin, cell = lattice.start, lattice.origin, lattice.cell
    low = [math.floor((point[axis] - start[axis]) / cell + 1e-5) + origin[axis] for axis in range(3)]
    for i in range(low[0], low[0] + 2):
        for j in range(low[1], low[1] + 2):
            for k in range(low[2], low[2] + 2):
                if not _inside(lattice, i, j, k):
                    continue
                middle = np.array(_middle(lattice, i, j, k))
                apart = math.sqrt(np.sum((middle - point) ** 2))
                if apart < nearest and leg_free(obstacles.table, middle, point, obstacles.radius):
                    best, nearest = (i, j, k), apart
    return best


@numba.njit
def _free_length(lattice, i, j, k, goal):
    """Returns the length of the shortest lattice path to the cell `goal` (i, j, k) if nothing is in the way."""
    a, b, c = abs(i - goal[0]), abs(j - goal[1]), abs(k - goal[2])
    low, high = min(a, b, c), max(a, b, c)
    middle = a + b + c - low - high
    return lattice.cell * (math.sqrt(3.0) * low + math.sqrt(2.0) * (middle - low) + (high - middle))


# ----------------------------------------------------------------------------------------- search


@numba.njit
def _nothing_reached(count):
    """Returns the cells before the search. Pages of memory are used only where a cell is written."""
    return _Cells(np.zeros(count, np.uint8), np.empty(count), np.empty(count), np.empty(count, np.int32))


@numba.njit
def _edge_free(table, x, y, z, dx, dy, dz, radius):
    """Returns whether a sphere passes from (x, y, z) to (x + dx, y + dy, z + dz), checked at `_SAMPLES` points."""
    for sample in range(_SAMPLES):
        share = sample / (_SAMPLES - 1)
        if distance(table, x + share * dx, y + share * dy, z + share * dz) <= radius:
            return False
    return True


@numba.njit
def _expand(lattice, obstacles, cells, entries, at, target):
    """Takes the path through the cell `at` to each of its 26 neighbours to which it is shorter.

    Arrays are used here and not in functions of one neighbour, in which numba's counting of references costs 10 %.
    """
    table, radius, margin = obstacles
    state, clearance, lengths, parent = cells
    cell, here = lattice.cell, lengths[at]
    i, j, k = _index(lattice, at)
    x, y, z = _middle(lattice, i, j, k)
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-1, 2):
                if (di == 0 and dj == 0 and dk == 0) or not _inside(lattice, i + di, j + dj, k + dk):
                    continue
                to = _flat(lattice, i + di, j + dj, k + dk)
                step = cell * _STEPS[di * di + dj * dj + dk * dk]
                length = here + step
                if state[to] & _REACHED and length >= lengths[to] - 1e-9 * cell:
                    continue
                dx, dy, dz = cell * di, cell * dj, cell * dk
                if not state[to] & _KNOWN:
                    clearance[to] = distance(table, x + dx, y + dy, z + dz)
                    state[to] |= _KNOWN
                if clearance[to] < radius:
                    continue
                # The clearance changes by at most one metre per metre, which proves most edges free.
                proved = clearance[at] + clearance[to] - step - 2.0 * radius >= 0.0
                if not proved and not _edge_free(table, x, y, z, dx, dy, dz, radius + margin):
                    continue
                lengths[to], parent[to] = length, at
                state[to] |= _REACHED
                estimate = length + _free_length(lattice, i + di, j + dj, k + dk, target)
                heapq.heappush(entries, (estimate - _TIE * length, -length, to))


@numba.njit
def _search_cells(lattice, obstacles, cells, source, target, limit):
    """Expands cells in the order of their estimates until the cell `target` (i, j, k) comes first.

    Returns:
        `_FOUND`, `_BLOCKED` or `_SPENT`, and the number of expanded cells.
    """
    x, y, z = lattice.start
    cells.length[source], cells.parent[source], cells.state[source] = 0.0, source, _KNOWN | _REACHED
    cells.clearance[source] = distance(obstacles.table, x, y, z)
    finish = _flat(lattice, target[0], target[1], target[2])
    entries = [(0.0, 0.0, source)]  # estimate of the whole path, minus the length so far, cell
    expanded = 0
    while len(entries) > 0:
        _, negative_length, at = heapq.heappop(entries)
        if -negative_length > cells.length[at]:
            continue  # a shorter path to this cell was found after the entry was made
        if at == finish:
            return _FOUND, expanded
        if expanded >= limit:
            return _SPENT, expanded
        expanded += 1
        _expand(lattice, obstacles, cells, entries, at, target)
    return _BLOCKED, expanded


@numba.njit
def _path_to(lattice, cells, source, finish):
    """Returns the middles [n, 3] of the cells on the path from `source` to `finish`, metres."""
    count, at = 1, finish
    while at != source:
        at = cells.parent[at]
        count += 1
    points = np.empty((count, 3))
    at = finish
    for n in range(count - 1, -1, -1):
        i, j, k = _index(lattice, at)
        points[n, 0], points[n, 1], points[n, 2] = _middle(lattice, i, j, k)
        at = cells.parent[at]
    return points


@numba.njit
def search(table, start, goal, lower, upper, cell, radius, margin, limit):
    """Searches the shortest lattice path of a sphere.

    Args:
        table: [N, 17] from `solid_table`.
        start, goal: [3] metres.
        lower, upper: [3] metres, corners of the flight volume.
        cell: size of a cell, metres.
        radius: of the sphere, metres.
        margin: metres that edges need beyond the radius, see `astar.edge_margin`.
        limit: maximum number of cells to expand.

    Returns:
        how it ended; the middles [n, 3] of the path's cells from the start on; the path's length in metres, inf
        without a path; the number of expanded cells.
    """
    obstacles = _Obstacles(table, radius, margin)
    lattice = _lattice(start, lower, upper, cell)
    target = _cell_near(lattice, obstacles, goal)
    if target[0] < 0:
        return _ENCLOSED, np.empty((0, 3)), math.inf, 0
    cells = _nothing_reached(lattice.shape[0] * lattice.shape[1] * lattice.shape[2])
    source = _flat(lattice, lattice.origin[0], lattice.origin[1], lattice.origin[2])
    how, expanded = _search_cells(lattice, obstacles, cells, source, target, limit)
    if how != _FOUND:
        return how, np.empty((0, 3)), math.inf, expanded
    finish = _flat(lattice, target[0], target[1], target[2])
    return _FOUND, _path_to(lattice, cells, source, finish), cells.length[finish], expanded


def plan(
    task: PlanningTask,
    budget: Budget = Budget(),  # noqa: B008 (it is frozen)
    seed: int = 0,
    cell: float = CELL_M,
) -> PlannedPath:
    """Returns the shortest path on a lattice of `cell` metres, shortened. Deterministic: `seed` is unused."""
    del seed
    refused = refusal(task)
    if refused:
        return not_found(refused)
    _compile()
    limit = np.iinfo(np.int64).max if budget.steps is None else budget.steps
    lower, upper = np.asarray(task.scene.volume, np.float64)
    start, goal = np.asarray(task.start, np.float64), np.asarray(task.goal, np.float64)
    margin = edge_margin(cell, task.body_radius)
    began = time.perf_counter()
    table = solid_table(task.scene)
    how, points, _, expanded = search(table, start, goal, lower, upper, cell, task.body_radius, margin, limit)
    if how == _FOUND:
        if np.any(points[-1] != goal):
            points = np.concatenate([points, goal[None]])
        points = shorten_path(points, lambda a, b: not leg_free(table, a, b, task.body_radius))
    seconds = time.perf_counter() - began
    if how == _FOUND:
        return path_as_plan(points, seconds, expanded)
    why = {
        _BLOCKED: "every path is blocked",
        _ENCLOSED: f"the goal is enclosed within {cell:g} m",
        _SPENT: f"the goal was not reached within {expanded} cells",
    }
    return not_found(why[how], seconds, expanded)


def plan_coarse(task: PlanningTask, budget: Budget = Budget(), seed: int = 0) -> PlannedPath:  # noqa: B008
    """Returns the shortest path on a lattice of `COARSE_CELL_M`, which has an eighth of the cells, shortened."""
    return plan(task, budget, seed, COARSE_CELL_M)


@functools.lru_cache(maxsize=1)
def _compile() -> None:
    """Makes numba compile before time is measured."""
    search(np.zeros((0, 17)), np.zeros(3), np.ones(3), np.zeros(3), np.ones(3), 0.5, 0.1, 0.0, 100)
