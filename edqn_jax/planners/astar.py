"""A*: the shortest path of a drone that knows the map, the reference for the paths of learned flights.

A lattice of 0.5 m cells fills the flight volume, with a cell at the start. A cell is free if a sphere of the body's
radius fits around its middle, and two of the 26 neighbours are joined if the sphere passes straight between them. The
heuristic, the length of the shortest lattice path without obstacles, is consistent, so the path found is the shortest
on the lattice. It is then shortened wherever the straight line is free, checked along its whole length.

The open list is expanded in batches, all entries up to a bound on g + h at once, which NumPy computes quickly. A cell
may then be improved after it was expanded, so the search ends only when no open entry could still improve the goal:
the result is as exact as that of expanding one entry at a time. Distances are computed only for cells that the search
reaches.

    python -m edqn_jax.planners.astar [--world NAME]
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
import math
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import DENSITIES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.planners.planner import path_length, point_text
from edqn_jax.sim.mjcf import check_scene, load_world, resolve_world
from edqn_jax.sim.scene import Scene, segment_contact, signed_distance
from edqn_jax.sim.worlds import random_scene, world_key

_STEPS = np.array([step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)])  # [26, 3]
_SLACK = 1.0  # a batch holds entries up to this many cells above the best: fewer batches, a few cells too many
_STRIDE = 0.02  # metres; undetected penetration of at most 0.01^2 / 2 r = 0.14 mm
_LANES = (64, 512, 4096, 32768)  # batches are padded to one of these, to compile few programs


class NoPathError(ConfigError):
    """There is no path from start to goal; the message says why."""


@dataclasses.dataclass(frozen=True)
class Path:
    """A collision-free path."""

    points: np.ndarray
    """[K, 3] metres, from start to goal; straight between the points."""
    length_m: float
    """Length after shortening."""
    grid_length_m: float
    """Length of the shortest path on the lattice, the last leg from the lattice to the goal included."""


def shortest_path(
    scene: Scene, start: np.ndarray | Array, goal: np.ndarray | Array, radius: float, cell: float = 0.5
) -> Path:
    """Returns the shortest path of a sphere from `start` [3] to `goal` [3]; these, `radius` and `cell` in metres.

    Raises:
        NoPathError: if there is no path, or the sphere does not fit at the start or the goal.
    """
    start, goal = np.asarray(start, np.float64), np.asarray(goal, np.float64)
    lattice = _Lattice(scene, start, radius, cell)
    for role, point in (("start", start), ("goal", goal)):
        if not np.all((point >= lattice.lower) & (point <= lattice.upper)):
            raise NoPathError(f"there is no path: the {role} {point_text(point)} lies outside the flight volume")
        if lattice.distances(point[None])[0] < radius:
            raise NoPathError(
                f"there is no path: a sphere of {radius:g} m does not fit at the {role} {point_text(point)}"
            )
    target = lattice.cell_near(goal)
    cells, length = _search(lattice, int(lattice.flat(lattice.origin)), target)
    points = start + cell * (lattice.index(cells) - lattice.origin)
    last = float(np.linalg.norm(goal - points[-1]))
    if last > 0.0:
        points = np.concatenate([points, goal[None]])
    tight = shorten(points, functools.partial(_leg_touches, scene, radius=radius))
    return Path(tight, path_length(tight), length + last)


class _Lattice:
    """Cells of the volume by flat index, with the distances computed so far."""

    def __init__(self, scene: Scene, start: np.ndarray, radius: float, cell: float):
        self.scene, self.radius, self.cell, self.start = scene, radius, cell, start
        self.lower, self.upper = np.asarray(scene.volume, np.float64)
        # Rounded up a little: float32 may put a point on the boundary just outside the volume.
        self.origin = np.floor((start - self.lower) / cell + 1e-5).astype(np.int64)
        self.shape = self.origin + np.floor((self.upper - start) / cell + 1e-5).astype(np.int64) + 1
        self.distance = np.full(int(np.prod(np.maximum(self.shape, 1))), np.nan, np.float32)

    def flat(self, index: np.ndarray) -> np.ndarray:
        return (index[..., 0] * self.shape[1] + index[..., 1]) * self.shape[2] + index[..., 2]

    def index(self, flat: np.ndarray) -> np.ndarray:
        return np.stack(np.unravel_index(flat, tuple(self.shape)), axis=-1)

    def middle(self, flat: np.ndarray) -> np.ndarray:
        return self.start + self.cell * (self.index(flat) - self.origin)

    def distances(self, points: np.ndarray) -> np.ndarray:
        return _batched(_signed_distances, self.scene, points)

    def compute_distances(self, cells: np.ndarray) -> None:
        """Computes the distances of those cells that are not known yet."""
        unknown = np.unique(cells[np.isnan(self.distance[cells])])
        if unknown.size:
            self.distance[unknown] = self.distances(self.middle(unknown))

    def passable(self, origins: np.ndarray, cells: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Returns whether the sphere fits at `cells` [E] and passes from `origins` [E] to them, [E] bool."""
        self.compute_distances(cells)
        passable = self.distance[cells] >= self.radius
        # The distance changes by at most one metre per metre, which proves most edges free.
        slack = self.distance[origins] + self.distance[cells] - lengths - 2 * self.radius
        narrow = np.flatnonzero(passable & (slack < 0))
        if narrow.size:
            ends = np.concatenate([self.middle(origins[narrow]), self.middle(cells[narrow])], axis=1)
            passable[narrow] = ~_batched(_touches, self.scene, ends, self.radius + edge_margin(self.cell, self.radius))
        return passable

    def cell_near(self, point: np.ndarray) -> int:
        """Returns the nearest cell from which the sphere passes straight to the point.

        Raises:
            NoPathError: if there is none.
        """
        base = np.floor((point - self.start) / self.cell + 1e-5).astype(np.int64) + self.origin
        corners = base + np.array(list(itertools.product((0, 1), repeat=3)))
        corners = corners[np.all((corners >= 0) & (corners < self.shape), axis=1)]
        middles = self.start + self.cell * (corners - self.origin)
        for i in np.argsort(np.linalg.norm(middles - point, axis=1), kind="stable"):
            if not _leg_touches(self.scene, middles[i], point, self.radius):
                return int(self.flat(corners[i]))
        raise NoPathError(f"there is no path: the goal {point_text(point)} is enclosed within {self.cell:g} m")


def _search(lattice: _Lattice, source: int, target: int) -> tuple[np.ndarray, float]:
    """Returns the flat cells of the shortest path from source to target, and its length in metres.

    Raises:
        NoPathError: if there is no path.
    """
    lengths = lattice.cell * np.linalg.norm(_STEPS, axis=1)
    offsets = (_STEPS[:, 0] * lattice.shape[1] + _STEPS[:, 1]) * lattice.shape[2] + _STEPS[:, 2]
    goal = lattice.index(np.array(target))
    tiny = 1e-9 * lattice.cell
    g = np.full(lattice.distance.size, np.inf)
    parent = np.full(lattice.distance.size, -1, np.int32)
    is_open = np.zeros(lattice.distance.size, bool)
    lattice.compute_distances(np.array([source]))
    g[source], is_open[source] = 0.0, True
    now, later, bound = np.array([source]), [], -np.inf
    while True:
        if now.size == 0:
            waiting = np.unique(np.concatenate(later)) if later else np.zeros(0, np.int64)
            waiting = waiting[is_open[waiting]]
            if waiting.size == 0:
                break
            estimate = g[waiting] + _free_length(lattice.index(waiting), goal, lattice.cell)
            if estimate.min() >= g[target] - tiny:
                break
            bound = estimate.min() + _SLACK * lattice.cell
            now, later = waiting[estimate <= bound], [waiting[estimate > bound]]
        is_open[now] = False
        at = lattice.index(now)[:, None] + _STEPS
        inside = np.all((at >= 0) & (at < lattice.shape), axis=-1)
        row, step = np.nonzero(inside)
        origins, cells = now[row], now[row] + offsets[step]
        reached = g[origins] + lengths[step]
        better = reached < g[cells] - tiny
        origins, cells, step, reached = origins[better], cells[better], step[better], reached[better]
        estimate = reached + _free_length(lattice.index(cells), goal, lattice.cell)
        better = estimate < g[target] - tiny if np.isfinite(g[target]) else np.ones(cells.size, bool)
        better[better] = lattice.passable(origins[better], cells[better], lengths[step[better]])
        origins, cells, reached, estimate = origins[better], cells[better], reached[better], estimate[better]
        # If a cell is reached several times, the shortest path is written last and stays.
        order = np.argsort(-reached, kind="stable")
        g[cells[order]], parent[cells[order]] = reached[order], origins[order]
        is_open[cells] = True
        is_open[target] = False
        soon = estimate <= bound
        now = np.unique(cells[soon])
        now = now[is_open[now]]
        later.append(cells[~soon])
    if not np.isfinite(g[target]):
        ends = point_text(lattice.middle(np.array(source))), point_text(lattice.middle(np.array(target)))
        raise NoPathError(
            f"there is no path from {ends[0]} to {ends[1]} for a sphere of {lattice.radius:g} m: every path is blocked"
        )
    cells = [target]
    while cells[-1] != source:
        cells.append(int(parent[cells[-1]]))
    return np.array(cells[::-1]), float(g[target])


def _free_length(index: np.ndarray, goal: np.ndarray, cell: float) -> np.ndarray:
    """Returns the length of the shortest lattice path without obstacles from cells [..., 3] to the goal [3], metres."""
    apart = np.abs(index - goal)
    low, middle, high = apart.min(axis=-1), np.median(apart, axis=-1), apart.max(axis=-1)
    return cell * (math.sqrt(3) * low + math.sqrt(2) * (middle - low) + (high - middle))


def edge_margin(cell: float, radius: float) -> float:
    """Returns the metres by which a sphere can penetrate between two samples of an edge at most, (h / 2)^2 / 2 r.

    Edges are checked with a radius that is larger by this margin. `segment_contact` takes 8 samples, so h is a seventh
    of the longest edge, sqrt(3) cells.
    """
    return (math.sqrt(3) * cell / 14) ** 2 / (2 * radius)


Touches = Callable[[np.ndarray, np.ndarray], bool]
"""Returns whether the sphere touches anything on the straight line between two points [3]."""


def shorten(points: np.ndarray, touches: Touches) -> np.ndarray:
    """Shortens a path [K, 3] by line of sight and by cutting corners until a round gains less than 1 cm."""
    points = _skip_ahead(points, touches)
    while True:
        tighter = _skip_ahead(_cut_corners(points, touches), touches)
        if path_length(tighter) > path_length(points) - 0.01:
            return points
        points = tighter


def _cut_corners(points: np.ndarray, touches: Touches) -> np.ndarray:
    """Cuts off each corner as far up its two legs, at most half of each, as the short cut stays free."""
    kept = [points[0]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        free, blocked = 0.0, 1.0
        for _ in range(7):  # to 1 % of the leg
            share = (free + blocked) / 2
            a, b = corner + share / 2 * (before - corner), corner + share / 2 * (after - corner)
            if touches(a, b):
                blocked = share
            else:
                free = share
        if free > 0.0:
            kept += [corner + free / 2 * (before - corner), corner + free / 2 * (after - corner)]
        else:
            kept.append(corner)
    return np.array([*kept, points[-1]])


def _skip_ahead(points: np.ndarray, touches: Touches) -> np.ndarray:
    """Keeps, after each kept point, only the furthest later point to which the straight line is free."""
    kept, here = [0], 0
    while here < len(points) - 1:
        there = len(points) - 1
        while there > here + 1 and touches(points[here], points[there]):
            there -= 1
        kept.append(there)
        here = there
    return points[kept]


def _leg_touches(scene: Scene, start: np.ndarray, end: np.ndarray, radius: float) -> bool:
    return bool(_long_touches(scene, np.float32(start), np.float32(end), np.float32(radius)))


@jax.jit
def _long_touches(scene: Scene, start: Array, end: Array, radius: Array) -> Array:
    """Returns whether the sphere touches anything on a straight leg of any length, in steps of the clearance."""
    length = jnp.sqrt(jnp.sum((end - start) ** 2))
    direction = (end - start) / jnp.maximum(length, 1e-9)

    def gap(along: Array) -> Array:
        return signed_distance(scene, start + along * direction) - radius

    def walk(state: tuple[Array, Array]) -> tuple[Array, Array]:
        along, free = state
        along = jnp.minimum(along + jnp.maximum(free, _STRIDE), length)
        return along, gap(along)

    zero = jnp.zeros(())
    _, free = jax.lax.while_loop(lambda s: (s[0] < length) & (s[1] >= 0), walk, (zero, gap(zero)))
    return free < 0


@jax.jit
def _signed_distances(scene: Scene, points: Array) -> Array:
    return jax.vmap(lambda point: signed_distance(scene, point))(points)


@jax.jit
def _touches(scene: Scene, ends: Array, radius: Array) -> Array:
    return jax.vmap(lambda pair: segment_contact(scene, pair[:3], pair[3:], radius)[0])(ends)


def _batched(function, scene: Scene, rows: np.ndarray, *rest: float) -> np.ndarray:
    """Returns `function(scene, rows, *rest)`, computed in batches of a few fixed sizes."""
    parts, done = [], 0
    while done < len(rows):
        part = rows[done : done + _LANES[-1]]
        lanes = next(lanes for lanes in _LANES if lanes >= len(part))
        padded = np.zeros((lanes, rows.shape[1]), np.float32)
        padded[: len(part)] = part
        parts.append(np.asarray(function(scene, padded, *map(np.float32, rest)))[: len(part)])
        done += len(part)
    return np.concatenate(parts)


def main(arguments: list[str] | None = None) -> int:
    """Print the shortest path of a world."""
    parser = argparse.ArgumentParser(prog="python -m edqn_jax.planners.astar", description=main.__doc__)
    parser.add_argument("--world", default="paper", help="paper, sparse, medium, dense, mixed or an MJCF file")
    parser.add_argument("--index", type=int, default=0, help="which test world, for random worlds")
    options = parser.parse_args(arguments)
    radius = Config().drone.body_radius_m
    try:
        if options.world in DENSITIES:
            scene = random_scene(options.world, world_key("test", options.index))
        else:
            world = load_world(resolve_world(options.world))
            scene = world.scene
            check_scene(scene, radius, names=world.names, title=str(world.path))
        began = time.perf_counter()
        path = shortest_path(scene, scene.start, scene.goal, radius)
        seconds = time.perf_counter() - began
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    straight = float(np.linalg.norm(np.asarray(scene.goal) - np.asarray(scene.start)))
    print(f"straight line      {straight:8.2f} m")
    print(f"lattice path       {path.grid_length_m:8.2f} m")
    print(f"shortened          {path.length_m:8.2f} m, {len(path.points)} points, found in {seconds:.2f} s")
    for point in path.points:
        print("  " + "  ".join(f"{value:7.2f}" for value in point))
    return 0


if __name__ == "__main__":
    sys.exit(main())
