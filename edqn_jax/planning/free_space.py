"""Free space: from where in a world there is a way to its goal."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import scipy
from jax import Array

from edqn_jax.planning.kept import kept_of_scene
from edqn_jax.planning.lattice import CELL_M, FINE_M, STEPS, Lattice, NoPathError, is_small
from edqn_jax.planning.path import point_text
from edqn_jax.sim.scene.scene import Scene

NICHES = 1e-3
"""Share of the free space that closed places may have in an open world: under a ball, between blocks that overlap."""

COARSE_M = 1.0
"""Edge of cells that find every closed space that has room for a start."""

_FORWARD = STEPS[13:]  # of each pair of opposite directions one


@dataclasses.dataclass(frozen=True)
class Reachable:
    """The cells of a lattice from which there is a way to a goal."""

    is_way: np.ndarray
    """[X, Y, Z] bool, whether there is a way."""
    corner: np.ndarray
    """[3] metres, middle of the first cell."""
    edge_m: float
    lost: float
    """Share of the free cells that have no way; niches between shapes, as small as `NICHES`, are not counted."""


def find_reachable(scene: Scene, radius: float, cell: float | None = None) -> Reachable:
    """Returns from where in a world a sphere has a way to the goal.

    Args:
        scene: one world.
        radius: of the sphere, metres.
        cell: edge of the lattice's cubes, metres; by default as fine as A* needs them, unless coarse ones show that
            there is a way from everywhere.

    Raises:
        ConfigError: if the volume has too many cells.
        NoPathError: if the sphere does not fit at the goal.
    """
    if cell is None:
        found = find_reachable(scene, radius, COARSE_M)
        if found.lost > 0.0:
            found = find_reachable(scene, radius, CELL_M)
        if not is_reachable(found, scene.start) and is_small(scene, FINE_M):
            found = find_reachable(scene, radius, FINE_M)
        return found
    lattice = Lattice(scene, np.asarray(scene.goal, np.float64), radius, cell)
    lattice.compute_all_distances()
    clearance = lattice.distance.reshape(tuple(lattice.shape))
    free = clearance >= radius
    if not free[tuple(lattice.origin)]:
        raise NoPathError(f"a sphere of {radius:g} m does not fit at the goal {point_text(lattice.start)}")
    parts = _parts(lattice, clearance)
    way = free & (parts == parts[tuple(lattice.origin)])
    lost = 1.0 - np.count_nonzero(way) / np.count_nonzero(free)
    return Reachable(way, lattice.middle(np.array(0)), cell, lost if lost > NICHES else 0.0)


def kept_reachable(scene: Scene, radius: float) -> Reachable:
    """Returns `find_reachable` with its own cells; a command finds what an earlier one has found.

    Raises:
        ConfigError, NoPathError: as `find_reachable`.
    """

    def make() -> np.ndarray:
        found = find_reachable(scene, radius)
        numbers = np.array([*found.corner, found.edge_m, found.lost, *found.is_way.shape], np.float64)
        return np.concatenate([numbers.view(np.uint8), np.packbits(found.is_way)])

    kept = kept_of_scene("reachable", scene, radius, make)
    numbers = kept[: 8 * np.dtype(np.float64).itemsize].copy().view(np.float64)
    shape = tuple(numbers[5:].astype(int))
    is_way = np.unpackbits(kept[numbers.nbytes :], count=math.prod(shape)).astype(bool).reshape(shape)
    return Reachable(is_way, numbers[:3], float(numbers[3]), float(numbers[4]))


def is_reachable(found: Reachable, point: np.ndarray | Array) -> bool:
    """Returns whether there is a way from the cell that a point [3], metres, is in."""
    at = np.round((np.asarray(point) - found.corner) / found.edge_m).astype(int)
    return bool(np.all((at >= 0) & (at < found.is_way.shape))) and bool(found.is_way[tuple(at)])


def _parts(lattice: Lattice, clearance: np.ndarray) -> np.ndarray:
    """Returns a number for each free cell [X, Y, Z]: equal for two if there is a way, by the edges that A* takes.

    Nothing can be between two neighbours that are both further from all surfaces than radius and half a cell. Parts of
    such cells are found first, and are then joined through the cells near surfaces and along diagonals.
    """
    number = np.zeros(clearance.shape, np.int32)
    scipy.ndimage.label(clearance >= lattice.radius + lattice.cell / 2, output=number)
    near = (clearance >= lattice.radius) & (number == 0)
    number[near] = 1 + number.max() + np.arange(np.count_nonzero(near))
    pairs = []
    for step in _FORWARD:
        origins, cells = _neighbours(number, step)
        joined = lattice.passable(origins, cells, np.full(len(cells), lattice.cell * np.linalg.norm(step)))
        pairs.append(np.stack([number.ravel()[origins[joined]], number.ravel()[cells[joined]]]))
    first, second = np.concatenate(pairs, axis=1)
    nodes = int(number.max()) + 1
    graph = scipy.sparse.coo_array((np.ones(len(first)), (first, second)), (nodes, nodes))
    _, parts = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return parts[number]


def _neighbours(number: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns flat cells [E] and their neighbours at `step` [3], where both have a number and not the same."""
    flat = np.arange(number.size).reshape(number.shape)
    here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, number.shape, strict=True))
    there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, number.shape, strict=True))
    wanted = (number[here] > 0) & (number[there] > 0) & (number[here] != number[there])
    return flat[here][wanted], flat[there][wanted]
