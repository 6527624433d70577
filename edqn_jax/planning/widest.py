"""The widest way: of all ways from start to goal the one whose tightest place is the widest.

On a lattice, whose cells know their clearance, two neighbours at a distance L that both have a clearance of L / 2 are
joined by a free line, since the clearance changes by at most a metre a metre. So the widest way is that of the largest
clearance at which the cells above it still join start and goal: labels say it, no line is checked. The way through
these cells keeps away from what is near, and is then moved point by point to where the clearance is larger, so that its
tightest place is in the middle of a door and not where a cell happens to be. What is reported was found along the way
itself: a way as wide as that exists.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math

import numpy as np
import scipy
from jax import Array

from edqn_jax.planning.astar import search_lattice, shortest_path
from edqn_jax.planning.free_space import COARSE_M
from edqn_jax.planning.kept import kept_of_scene
from edqn_jax.planning.lattice import CELL_M, FINE_M, Lattice, NoPathError, is_small
from edqn_jax.planning.path import path_length
from edqn_jax.sim.scene.scene import Scene

ENDS_M = 1.0
"""Metres around start and goal in which a way may be as tight as the body is wide: a start stands on the ground."""

COMFORT_M = 1.5
"""Metres of clearance beyond which a way is not led further away from things."""

_PRICE = 8.0  # of a metre at no clearance, beside that of its length
_RESOLVED_M = 1e-3  # of clearance, by bisection
_SAMPLE_M = 0.02  # between the points of a way where its clearance is taken
_MOVES = 40  # rounds in which points of a way are moved
_SLOPE_M = 0.01  # of finite differences


@dataclasses.dataclass(frozen=True)
class WidestWay:
    """A way from start to goal, and the clearance along it."""

    points: np.ndarray
    """[K, 3] metres, `_SAMPLE_M` apart, from start to goal."""
    clearance: np.ndarray
    """[K] metres from each point to the nearest surface."""
    fits: bool
    """Whether A* finds a way for the body on its lattice, as `edqn evaluate` asks for."""

    @property
    def tightest(self) -> int:
        """Returns the number of the point with the least clearance, `ENDS_M` around start and goal left out.

        Along a wall it is the middle one.
        """
        apart = [np.linalg.norm(self.points - end, axis=1) for end in (self.points[0], self.points[-1])]
        between = np.minimum(*apart) > ENDS_M
        clearance = np.where(between | ~between.any(), self.clearance, np.inf)
        alike, _ = scipy.ndimage.label(clearance <= clearance.min() + _RESOLVED_M)  # pyright: ignore[reportGeneralTypeIssues]
        number = np.flatnonzero(alike == alike[np.argmin(clearance)])
        return int(number[len(number) // 2])

    @property
    def clearance_m(self) -> float:
        """Returns the clearance at the tightest place, metres."""
        return float(self.clearance[self.tightest])

    @property
    def length_m(self) -> float:
        """Returns the length in metres."""
        return path_length(self.points)


def find_widest_way(scene: Scene, radius: float) -> WidestWay | None:
    """Returns the widest way from a world's start to its goal; None if there is none but of less than half a cell.

    Args:
        scene: one world, as it is at time 0; the body fits at its start and goal.
        radius: of the body, metres.

    Raises:
        ConfigError: if the volume has too many cells.
    """
    lattice, target, found = _open_lattice(scene, radius, FINE_M if is_small(scene, FINE_M) else CELL_M)
    ways = [] if found is None else _as_it_is_and_moved(lattice, _way_through(lattice, target), found)
    fits = found is not None and found >= radius
    if not fits or max(way.clearance_m for way in ways) < radius:
        # A* checks lines between cells, and passes where labels do not.
        with contextlib.suppress(NoPathError):
            path = shortest_path(scene, scene.start, scene.goal, radius).points
            ways, fits = [*ways, *_as_it_is_and_moved(lattice, path, radius)], True
    if not ways:
        return None
    return dataclasses.replace(max(ways, key=lambda way: way.clearance_m), fits=fits)


def is_roomy(scene: Scene, radius: float, need: float) -> bool:
    """Returns whether coarse cells show a way with a clearance of `need` metres; quick, and False where it is unknown.

    A command finds what an earlier one has found.

    Args:
        scene: as in `find_widest_way`.
        radius: of the body, metres.
        need: metres.

    Raises:
        ConfigError: if the volume has too many cells.
    """

    def make() -> np.ndarray:
        found = _open_lattice(scene, radius, COARSE_M)[2]
        return np.array([-math.inf if found is None else found])

    return bool(kept_of_scene("widest", scene, radius, make)[0] >= need)


def _open_lattice(scene: Scene, radius: float, cell: float) -> tuple[_Openings, int, float | None]:
    """Returns a lattice, opened for its widest way, the cell of the goal, and what `open_widest` returns."""
    lattice = _Openings(scene, np.asarray(scene.start, np.float64), radius, cell)
    lattice.compute_all_distances()
    try:
        target = lattice.cell_near(np.asarray(scene.goal, np.float64))
    except NoPathError:
        return lattice, -1, None
    return lattice, target, lattice.open_widest(np.unravel_index(target, tuple(lattice.shape)))


class _Openings(Lattice):
    """A lattice of which cells are passable that have the clearance of its widest way."""

    def open_widest(self, target: tuple[np.intp, ...]) -> float | None:
        """Makes the cells of the widest way to the cell `target` passable.

        Returns:
            the clearance of the tightest of these cells, metres; None if there is no such way.
        """
        clearance = self.distance.reshape(tuple(self.shape))
        parts = np.zeros(clearance.shape, np.int32)
        for directions in (3, 2, 1):
            self._longest = math.sqrt(directions) * self.cell
            near = self._near_ends(np.array(target)) & (clearance >= max(self.radius, self._longest / 2))
            room = np.where(near, np.inf, clearance)
            structure = scipy.ndimage.generate_binary_structure(3, directions)

            def joins(need: float, room=room, structure=structure) -> bool:
                scipy.ndimage.label(room >= need, structure, output=parts)
                return bool(parts[tuple(self.origin)] == parts[target] != 0)

            low, high = self._longest / 2, float(clearance.max())
            if not joins(low):
                continue
            while high - low > _RESOLVED_M:
                middle = (low + high) / 2
                low, high = (middle, high) if joins(middle) else (low, middle)
            self._is_open = (room >= low).ravel()
            return low
        return None

    def _near_ends(self, target: np.ndarray) -> np.ndarray:
        """Returns which cells [X, Y, Z] are within `ENDS_M` of the start or of the cell `target` [3]."""
        x, y, z = (np.arange(n) for n in self.shape)
        near = np.zeros(tuple(self.shape), bool)
        for end in (self.origin, target):
            dx, dy, dz = (x - end[0]) ** 2, (y - end[1]) ** 2, (z - end[2]) ** 2
            near |= dx[:, None, None] + dy[:, None] + dz <= (ENDS_M / self.cell) ** 2
        return near

    def passable(self, origins: np.ndarray, cells: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Returns [E] bool: `cells` [E] are open, and so is the line from `origins` [E], `lengths` [E] metres off."""
        return self._is_open[cells] & (lengths <= self._longest * (1 + 1e-6))


def _way_through(lattice: _Openings, target: int) -> np.ndarray:
    """Returns a way [K, 3], metres, through the open cells: short, and away from what is near."""
    price = 1.0 + _PRICE * np.clip(1.0 - lattice.distance / COMFORT_M, 0.0, 1.0) ** 2
    cells, _ = search_lattice(lattice, int(lattice.flat(lattice.origin)), target, price)
    return np.concatenate([lattice.middle(cells), np.asarray(lattice.scene.goal, np.float64)[None]])


def _as_it_is_and_moved(lattice: Lattice, points: np.ndarray, clearance: float) -> list[WidestWay]:
    """Returns a way through points [K, 3] of this clearance, metres, and the same moved to where it has more."""
    moved = _moved_away(lattice, _sampled(points, lattice.cell / 2), max(COMFORT_M, clearance))
    sampled = [_sampled(way, _SAMPLE_M) for way in (points, moved)]
    return [WidestWay(way, lattice.distances(way), fits=False) for way in sampled]


def _sampled(points: np.ndarray | Array, step: float) -> np.ndarray:
    """Returns a line through points [K, 3] as points at most `step` metres apart, [N, 3]."""
    points = np.asarray(points, np.float64)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], max(2, math.ceil(along[-1] / step) + 1))
    return np.stack([np.interp(at, along, points[:, axis]) for axis in range(3)], axis=1)


def _moved_away(lattice: Lattice, points: np.ndarray, comfort: float) -> np.ndarray:
    """Returns a way [K, 3] that is straighter where it has `comfort` metres of clearance, and elsewhere has more.

    No point loses clearance below `comfort`; both ends stay.
    """
    shifts = _SLOPE_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    for step in np.geomspace(lattice.cell / 2, 2 * _RESOLVED_M, _MOVES):
        inner = points[1:-1]
        around = lattice.distances((inner + shifts[:, None]).reshape(-1, 3)).reshape(len(shifts), -1)
        slope = (around[1:4] - around[4:]).T / (2 * _SLOPE_M)
        tangent = points[2:] - points[:-2]
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
        across = slope - np.sum(slope * tangent, axis=1, keepdims=True) * tangent
        tight = np.clip(1.0 - around[0] / comfort, 0.0, 1.0)[:, None]
        tried = inner + tight * step * across + (1.0 - tight) * ((points[:-2] + points[2:]) / 2 - inner)
        tried = np.clip(tried, lattice.lower, lattice.upper)
        better = lattice.distances(tried) >= np.minimum(around[0], comfort)
        points = np.concatenate([points[:1], np.where(better[:, None], tried, inner), points[-1:]])
    return points
