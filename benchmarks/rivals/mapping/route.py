"""A* on an occupancy grid, compiled with numba: a cheap way over what is known, and how far of it has been seen.

The cells are those of the grid and each has a weight, the cost of a metre through it: 1 where it is free, more where it
is unknown or near an occupied one, and very much where the body might touch one. So there is always a way, also for a
drone that a new obstacle has caught beside itself; a way through an obstacle is taken only where nothing else is left.
Weights are computed for cells that the search reaches, and for no others. Search: Hart, Nilsson and Raphael 1968, on
26 neighbours as the lattices of `planners`; the way is then shortened as all paths of A* are.

Far away nearly all is unknown, so the rest of a way is estimated as if all of it were (Pohl's weighted A*, *Artificial
Intelligence* 1, 1970): the way costs at most `unknown_weight`, or `MOST_GREED` if that is less, times what the cheapest
one costs, and is the cheapest if the unknown costs nothing more. Estimated by free cells, a search would expand most of
the volume.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import math
from typing import NamedTuple

import numpy as np

from edqn_jax.extras import require_extra
from edqn_jax.planning.astar import shorten_path

numba = require_extra("numba")

OCCUPIED_WEIGHT = 1000.0
"""Weight of an occupied cell: rather a detour of 1 km than a metre through it."""

TOUCHED_WEIGHT = 30.0
"""Weight of a cell in which the body might touch an occupied one: rather a detour of 30 m than a metre through it."""

MOST_GREED = 1.5
"""How many times what the cheapest way costs a way may cost at most."""

_STEPS = (0.0, 1.0, math.sqrt(2.0), math.sqrt(3.0))  # cells between neighbours, by the number of axes moved along
_TIE = 1e-6  # of entries of equal estimate the one nearest to the goal comes first
_STRIDE = 0.5  # cells between the samples of a straight leg


@dataclasses.dataclass(frozen=True)
class RouteConfig:
    """What a way costs. Distances are between the middles of cells."""

    occupied_above: float = 0.0
    """Log-odds above which a cell is occupied."""
    touch_m: float = 0.8
    """Distance from an occupied cell within which the body might touch it, metres."""
    near_m: float = 1.3
    """Distance from an occupied cell within which a way costs more, metres."""
    near_weight: float = 2.0
    """Cost of a metre there."""
    body_m: float = 0.5
    """Distance from an unknown cell within which the body might touch what is in it, metres."""
    unknown_weight: float = 1.5
    """Cost of a metre there; 1 is as through what is free."""
    fence_m: float = 0.66
    """Distance that a way keeps from the ends of the volume, metres; less at a start or goal that has less."""
    ahead_m: float = 10.0
    """Length of the way that is returned; it is planned anew long before its end."""


class _Map(NamedTuple):
    """The grid as the search reads it."""

    log_odds: np.ndarray  # [X, Y, Z]
    touch: np.ndarray  # [T, 3] int, cells around one in which the body might touch it
    near: np.ndarray  # [N, 3] int, cells around those
    body: np.ndarray  # [B, 3] int, cells that the body might touch
    low: tuple[int, int, int]  # first cell that a way may use
    high: tuple[int, int, int]  # last one
    occupied_above: float
    near_weight: float
    unknown_weight: float


@dataclasses.dataclass(frozen=True)
class Route:
    """The next part of a way."""

    points: np.ndarray
    """[N, 3] metres, straight between them; the first is the drone."""
    expanded: int
    """Cells that the search expanded."""


class Router:
    """Plans ways in one volume."""

    def __init__(self, config: RouteConfig, cell_m: float, volume: np.ndarray):
        """Prepares the search; edge of the cells in metres, `volume` [2, 3] metres, as float64."""
        self.config, self.cell, self.volume = config, cell_m, np.asarray(volume, np.float64)
        self._touch, self._near = _around(cell_m, 0.0, config.touch_m), _around(cell_m, config.touch_m, config.near_m)
        self._body = _around(cell_m, 0.0, config.body_m)

    def cells(self, log_odds: np.ndarray, position: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Returns the cells [n, 3] of the next part of a way, the cost of all of it and cells expanded.

        Args:
            log_odds: [X, Y, Z] of the grid, of which cell (0, 0, 0) is in the volume's lower corner.
            position: [3] of the drone, metres.
            goal: [3] metres.

        Returns:
            cells, the drone's first; cost in cells that weigh 1; number of expanded cells.
        """
        known, lower = self._map(log_odds, goal), self.volume[0]
        source, target = (
            tuple(int(i) for i in np.clip((point - lower) // self.cell, known.low, known.high))
            for point in (position, goal)
        )
        return _search(known, source, target, math.ceil(self.config.ahead_m / self.cell))

    def plan(self, log_odds: np.ndarray, position: np.ndarray, goal: np.ndarray) -> Route:
        """Returns the next part of a way, shortened where the straight line is free; as `cells`.

        Args:
            log_odds: [X, Y, Z] of the grid.
            position: [3] of the drone, metres.
            goal: [3] metres.
        """
        cell, (lower, upper) = self.cell, self.volume
        cells, _, expanded = self.cells(log_odds, position, goal)
        points = np.clip(lower + cell * (cells + 0.5), lower, upper)
        points[0] = position
        if np.all(np.abs(points[-1] - goal) <= cell):  # the last cell is the goal's, or the nearest that a way may use
            points = np.concatenate([points, goal[None]])
        known = self._map(log_odds, goal)
        # Only through cells of weight 1, where the straight line is the cheapest way.
        tight = shorten_path(points, lambda a, b: _heaviest(known, (a - lower) / cell, (b - lower) / cell) > 1.0)
        return Route(tight, expanded)

    def known_length_m(self, log_odds: np.ndarray, points: np.ndarray) -> float:
        """Returns the length, metres, of the part of a way [N, 3], metres, in which the body is known to be free."""
        lower = self.volume[0]
        known = self._map(log_odds, points[-1])
        return self.cell * float(_known_length(known, (points - lower) / self.cell))

    def _map(self, log_odds: np.ndarray, goal: np.ndarray) -> _Map:
        config, (lower, upper) = self.config, self.volume
        inner = np.array([lower + config.fence_m, upper - config.fence_m])
        inner[0] = np.minimum(inner[0], np.minimum(goal, (lower + upper) / 2))
        inner[1] = np.maximum(inner[1], np.maximum(goal, (lower + upper) / 2))
        last = np.array(log_odds.shape) - 1
        low = np.clip(np.ceil((inner[0] - lower) / self.cell - 0.5), 0, last).astype(int)
        high = np.clip(np.floor((inner[1] - lower) / self.cell - 0.5), low, last).astype(int)
        return _Map(
            log_odds,
            self._touch,
            self._near,
            self._body,
            (int(low[0]), int(low[1]), int(low[2])),
            (int(high[0]), int(high[1]), int(high[2])),
            config.occupied_above,
            config.near_weight,
            config.unknown_weight,
        )


def _around(cell: float, beyond: float, within: float) -> np.ndarray:
    """Returns the cells [N, 3] around one whose distance, metres, is more than `beyond` and at most `within`.

    The nearest come first; of `beyond` 0 the cell itself, too.
    """
    reach = range(-math.floor(within / cell), math.floor(within / cell) + 1)
    cells = np.array(list(itertools.product(reach, repeat=3)), np.int64).reshape(-1, 3)
    apart = cell * np.linalg.norm(cells, axis=1)
    chosen = (apart <= within + 1e-9) & ((apart > beyond + 1e-9) | (beyond == 0.0))
    return np.ascontiguousarray(cells[chosen][np.argsort(apart[chosen], kind="stable")])


@numba.njit(nogil=True)
def _is_occupied_around(known, around, i, j, k):
    """Returns whether one of the cells at the offsets `around` [N, 3] from (i, j, k) is occupied."""
    shape = known.log_odds.shape
    for n in range(around.shape[0]):
        a, b, c = i + around[n, 0], j + around[n, 1], k + around[n, 2]
        if 0 <= a < shape[0] and 0 <= b < shape[1] and 0 <= c < shape[2]:
            if known.log_odds[a, b, c] > known.occupied_above:
                return True
    return False


# Two functions rather than one with a flag, for which the innermost loop would have to ask.
@numba.njit(nogil=True)
def _is_unknown_around(known, around, i, j, k):
    """Returns whether one of the cells at the offsets `around` [N, 3] from (i, j, k) is unknown."""
    shape = known.log_odds.shape
    for n in range(around.shape[0]):
        a, b, c = i + around[n, 0], j + around[n, 1], k + around[n, 2]
        if 0 <= a < shape[0] and 0 <= b < shape[1] and 0 <= c < shape[2]:
            if known.log_odds[a, b, c] == 0.0:
                return True
    return False


@numba.njit(nogil=True)
def _weight(known, i, j, k):
    """Returns the cost of a metre through the cell (i, j, k)."""
    if known.log_odds[i, j, k] > known.occupied_above:
        return OCCUPIED_WEIGHT
    if _is_occupied_around(known, known.touch, i, j, k):
        return TOUCHED_WEIGHT
    weight = 1.0
    if known.unknown_weight > 1.0 and _is_unknown_around(known, known.body, i, j, k):
        weight = known.unknown_weight
    if _is_occupied_around(known, known.near, i, j, k):
        return max(weight, known.near_weight)
    return weight


@numba.njit(nogil=True)
def _free_length(a, b, c):
    """Returns the cells of the shortest lattice path over `a`, `b` and `c` cells along the axes."""
    low, high = min(a, b, c), max(a, b, c)
    middle = a + b + c - low - high
    return math.sqrt(3.0) * low + math.sqrt(2.0) * (middle - low) + (high - middle)


@numba.njit(nogil=True)
def _search(known, source, target, most):
    """Returns the first `most` + 1 cells [n, 3] of a way, its cost, and how many cells were expanded."""
    shape, low, high = known.log_odds.shape, known.low, known.high
    greed = min(max(1.0, known.unknown_weight), MOST_GREED)
    count = shape[0] * shape[1] * shape[2]
    weights = np.zeros(count, np.float32)  # 0: not computed yet
    costs = np.empty(count)  # where there is a weight
    parent = np.empty(count, np.int32)
    start = (source[0] * shape[1] + source[1]) * shape[2] + source[2]
    finish = (target[0] * shape[1] + target[1]) * shape[2] + target[2]
    weights[start], costs[start], parent[start] = _weight(known, *source), 0.0, start
    entries: list = [(0.0, 0.0, start)]  # estimate of the whole way, minus the cost so far, cell
    expanded = 0
    while True:
        _, minus, at = heapq.heappop(entries)
        if -minus > costs[at]:
            continue  # a cheaper way to this cell was found after the entry was made
        if at == finish:
            break
        expanded += 1
        i, rest = divmod(at, shape[1] * shape[2])
        j, k = divmod(rest, shape[2])
        for di in range(-1, 2):
            for dj in range(-1, 2):
                for dk in range(-1, 2):
                    a, b, c = i + di, j + dj, k + dk
                    if not (low[0] <= a <= high[0] and low[1] <= b <= high[1] and low[2] <= c <= high[2]):
                        continue
                    to = (a * shape[1] + b) * shape[2] + c
                    if to == at:
                        continue
                    if weights[to] == 0.0:
                        weights[to], costs[to] = _weight(known, a, b, c), math.inf
                    step = _STEPS[di * di + dj * dj + dk * dk]
                    cost = costs[at] + step * 0.5 * (weights[at] + weights[to])
                    if cost >= costs[to] - 1e-9:
                        continue
                    costs[to], parent[to] = cost, at
                    left = greed * _free_length(abs(a - target[0]), abs(b - target[1]), abs(c - target[2]))
                    heapq.heappush(entries, (cost + left - _TIE * cost, -cost, to))
    length, at = 1, finish
    while at != start:
        at = parent[at]
        length += 1
    kept = min(length, most + 1)
    cells = np.empty((kept, 3), np.int64)
    at = finish
    for n in range(length - 1, -1, -1):
        if n < kept:
            i, rest = divmod(at, shape[1] * shape[2])
            j, k = divmod(rest, shape[2])
            cells[n, 0], cells[n, 1], cells[n, 2] = i, j, k
        at = parent[at]
    return cells, costs[finish], expanded


@numba.njit(nogil=True)
def _cell_of(known, x, y, z):
    """Returns the cell (i, j, k) of a point in cells, the nearest one of the grid."""
    shape = known.log_odds.shape
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    return min(max(i, 0), shape[0] - 1), min(max(j, 0), shape[1] - 1), min(max(k, 0), shape[2] - 1)


@numba.njit(nogil=True)
def _heaviest(known, a, b):
    """Returns the largest weight on the straight leg from `a` [3] to `b` [3], in cells."""
    length = math.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
    steps = max(1, math.ceil(length / _STRIDE))
    heaviest = 0.0
    for n in range(steps + 1):
        share = n / steps
        i, j, k = _cell_of(
            known, a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])
        )
        heaviest = max(heaviest, _weight(known, i, j, k))
    return heaviest


@numba.njit(nogil=True)
def _known_length(known, points):
    """Returns the length of the part of a way [N, 3] in which the body is known to be free; both in cells."""
    total = 0.0
    for leg in range(points.shape[0] - 1):
        a, b = points[leg], points[leg + 1]
        length = math.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
        steps = max(1, math.ceil(length / _STRIDE))
        for n in range(steps):
            share = (n + 1) / steps
            i, j, k = _cell_of(
                known, a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])
            )
            unseen = _is_unknown_around(known, known.body, i, j, k)
            if unseen or _is_occupied_around(known, known.touch, i, j, k):
                return total + length * n / steps
        total += length
    return total
