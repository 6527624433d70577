"""A*: the shortest path of a drone that knows the map, the reference for the paths of learned flights.

A lattice of 0.5 m cells fills the flight volume, with a cell at the start, or finer ones where these find no path. A
cell is free if a sphere of the body's radius fits around its middle, and two of the 26 neighbours are joined if the
sphere passes straight between them. The heuristic, the length of the shortest lattice path without obstacles, is
consistent, so the path found is the shortest on the lattice. It is then shortened wherever the straight line is free,
checked along its whole length.

The open list is expanded in batches, all entries up to a bound on g + h at once, which NumPy computes quickly. A cell
may then be improved after it was expanded, so the search ends only when no open entry could still improve the goal:
the result is as exact as that of expanding one entry at a time. Distances are computed only for cells that the search
reaches.

    python -m edqn_jax.planning.astar [--world NAME]
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import sys
import time
from collections.abc import Callable

import numpy as np
from jax import Array

from edqn_jax.config import FAMILIES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.planning.kept import kept_of_scene
from edqn_jax.planning.lattice import CELL_M, FINE_M, STEPS, Lattice, NoPathError, is_small, leg_touches
from edqn_jax.planning.path import PlannedPath, not_found, path_as_plan, path_length, point_text
from edqn_jax.sim.scene.mjcf import check_scene, load_world, resolve_world
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.worlds.families import random_scene, world_key

_SLACK = 1.0  # a batch holds entries up to this many cells above the best: fewer batches, a few cells too many


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
    scene: Scene, start: np.ndarray | Array, goal: np.ndarray | Array, radius: float, cell: float | None = None
) -> Path:
    """Returns the shortest path of a sphere from `start` [3] to `goal` [3]; these, `radius` and `cell` in metres.

    Without `cell` the lattice has cells of `CELL_M`; where there is no path on it and the volume is small enough, finer
    ones, which find narrower doors.

    Raises:
        ConfigError: if the volume has too many cells.
        NoPathError: if there is no path, or the sphere does not fit at the start or the goal.
    """
    if cell is None:
        try:
            return shortest_path(scene, start, goal, radius, CELL_M)
        except NoPathError:
            if not is_small(scene, FINE_M):
                raise
            return shortest_path(scene, start, goal, radius, FINE_M)
    start, goal = np.asarray(start, np.float64), np.asarray(goal, np.float64)
    lattice = Lattice(scene, start, radius, cell)
    for role, point in (("start", start), ("goal", goal)):
        if not np.all((point >= lattice.lower) & (point <= lattice.upper)):
            raise NoPathError(f"there is no path: the {role} {point_text(point)} lies outside the flight volume")
        if lattice.distances(point[None])[0] < radius:
            raise NoPathError(
                f"there is no path: a sphere of {radius:g} m does not fit at the {role} {point_text(point)}"
            )
    target = lattice.cell_near(goal)
    cells, length = search_lattice(lattice, int(lattice.flat(lattice.origin)), target)
    points = start + cell * (lattice.index(cells) - lattice.origin)
    last = float(np.linalg.norm(goal - points[-1]))
    if last > 0.0:
        points = np.concatenate([points, goal[None]])
    tight = shorten_path(points, functools.partial(leg_touches, scene, radius=radius))
    return Path(tight, path_length(tight), length + last)


def kept_shortest_path(scene: Scene, radius: float) -> Path:
    """Returns `shortest_path` from a world's start to its goal; a command finds what an earlier one has found.

    Raises:
        ConfigError, NoPathError: as `shortest_path`.
    """

    def make() -> np.ndarray:
        found = shortest_path(scene, scene.start, scene.goal, radius)
        return np.concatenate([[[found.length_m, found.grid_length_m, 0.0]], found.points])

    kept = kept_of_scene("path", scene, radius, make)
    return Path(kept[1:], float(kept[0, 0]), float(kept[0, 1]))


def plan(scene: Scene, *, body_radius: float = 0.36) -> PlannedPath:
    """Plans a path from a world's start to its goal with A*, which is given the whole map.

    Args:
        scene: one world, such as `Environment.scene` returns.
        body_radius: of the sphere that must touch nothing, metres.

    Raises:
        ConfigError: if the volume has too many cells.
    """
    began = time.perf_counter()
    try:
        path = shortest_path(scene, scene.start, scene.goal, body_radius)
    except NoPathError as error:
        reason = str(error).removeprefix("there is no path: ")
        return not_found(reason, time.perf_counter() - began)
    return path_as_plan(path.points, time.perf_counter() - began, steps=0)


def search_lattice(
    lattice: Lattice, source: int, target: int, price: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Returns the flat cells of the shortest path from source to target, and its length in metres.

    Args:
        lattice: says which cells are passable.
        source: flat index of the first cell.
        target: flat index of the last cell.
        price: [cells] factors of at least 1 by which a step into a cell is longer; None: as long as it is.

    Raises:
        NoPathError: if there is no path.
    """
    lengths = lattice.cell * np.linalg.norm(STEPS, axis=1)
    offsets = (STEPS[:, 0] * lattice.shape[1] + STEPS[:, 1]) * lattice.shape[2] + STEPS[:, 2]
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
        at = lattice.index(now)[:, None] + STEPS
        inside = np.all((at >= 0) & (at < lattice.shape), axis=-1)
        row, step = np.nonzero(inside)
        origins, cells = now[row], now[row] + offsets[step]
        reached = g[origins] + (lengths[step] if price is None else lengths[step] * price[cells])
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


Touches = Callable[[np.ndarray, np.ndarray], bool]
"""Returns whether the sphere touches anything on the straight line between two points [3]."""


def shorten_path(points: np.ndarray, touches: Touches) -> np.ndarray:
    """Shortens a path [K, 3], metres, by line of sight and by cutting corners until a round gains less than 1 cm."""
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


def main(arguments: list[str] | None = None) -> int:
    """Print the shortest path of a world."""
    parser = argparse.ArgumentParser(prog="python -m edqn_jax.planning.astar", description=main.__doc__)
    parser.add_argument(
        "--world", default="paper", help="paper, the name of random worlds such as medium or rooms, or an MJCF file"
    )
    parser.add_argument("--index", type=int, default=0, help="which test world, for random worlds")
    options = parser.parse_args(arguments)
    radius = Config().drone.body_radius_m
    try:
        if options.world in FAMILIES:
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
