"""Start and goal of a world that has none: free places far apart with a way between them."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mesh_field import Grid

ROOM_M = 0.5
"""Metres of clearance beyond the body's radius along the way, and at its ends."""

LONGEST_M = 60.0
"""Of the way, metres."""

_CELL_M = 0.5
_HEIGHTS_M = (0.8, 2.5)  # above what is below, where flights begin and end
_SURFACE_M = 0.3  # a point of the lattice this near to a surface is beside it
_ROOFED = 0.01  # share of the free points below a roof from which on flights begin and end there
_MOST = 2_000_000

Point = tuple[float, float, float]


def find_ends(
    grid: Grid,
    middle: NDArray[np.float64],
    volume: tuple[NDArray[np.float64], NDArray[np.float64]],
    radius: float,
    start: Point | None,
    goal: Point | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns start and goal [3], metres: those that are given, and for others free places far away from each other.

    Args:
        grid: of the distances of the only solid beside the ground.
        middle: [3] of the grid's box in the world, metres.
        volume: lower and upper corner [3], metres.
        radius: of the body, metres.
        start: None if it is to be found.
        goal: likewise.

    Raises:
        ConfigError: if there is no room.
    """
    if start is not None and goal is not None:
        return np.asarray(start), np.asarray(goal)
    low, high = volume
    cell = max(_CELL_M, float(np.prod(high - low) / _MOST) ** (1 / 3))
    axes = [np.arange(a + cell, b - cell / 2, cell) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance = _distances(grid, points - middle)
    free = distance >= radius + ROOM_M
    free &= points[..., 2] - low[2] >= radius + ROOM_M
    parts, count = scipy.ndimage.label(free)  # pyright: ignore[reportGeneralTypeIssues]
    if not count:
        raise ConfigError(f"there is no place with {radius + ROOM_M:g} m of room; give --scale, or --start and --goal")
    roofed = _is_roofed(distance)
    is_indoors = (roofed & free).sum() > _ROOFED * free.sum()
    sizes = np.bincount(parts[roofed & free if is_indoors else free], minlength=count + 1)[1:]
    part = parts == 1 + int(np.argmax(sizes))
    given = start if start is not None else goal
    if given is not None:
        nearest = np.linalg.norm(points - given, axis=-1)
        at = np.unravel_index(np.argmin(np.where(free, nearest, np.inf)), free.shape)
        part = parts == parts[at]
    ends = part & _is_end(distance, cell)
    if is_indoors and (ends & roofed).sum() > 1:
        ends &= roofed
    if ends.sum() < 2:
        ends = part
    first = None if given is None else np.argmin(np.where(part, nearest, np.inf))  # pyright: ignore[reportPossiblyUnbound]
    one, other = _far_apart(part, ends, first, cell)
    places = points.reshape(-1, 3)[[one, other]]
    if start is not None:
        return np.asarray(start), places[1]
    return (places[1], np.asarray(goal)) if goal is not None else (places[0], places[1])


def _distances(grid: Grid, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns distances [...] at places [..., 3] about the middle of a grid; beyond it at least those of its border."""
    reach = grid.cell * (np.array(grid.values.shape) - 1) / 2
    at = np.moveaxis((places + reach) / grid.cell, -1, 0)
    beyond = np.linalg.norm(np.maximum(np.abs(places) - reach, 0.0), axis=-1)
    return scipy.ndimage.map_coordinates(grid.values, at, order=1, mode="nearest") + beyond


def _is_roofed(distance: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns which points have something above."""
    return np.flip(np.cumsum(np.flip(distance < _SURFACE_M, 2), axis=2), 2) > 0


def _is_end(distance: NDArray[np.float64], cell: float) -> NDArray[np.bool_]:
    """Returns which points are at a height to begin at."""
    solid = distance < _SURFACE_M
    below = np.zeros(solid.shape)
    height = np.full(solid.shape[:2], cell)
    for level in range(solid.shape[2]):
        height = np.where(solid[:, :, level], 0.0, height + cell)
        below[:, :, level] = height
    return (below >= _HEIGHTS_M[0]) & (below <= _HEIGHTS_M[1])


def _far_apart(part: NDArray[np.bool_], ends: NDArray[np.bool_], first: np.intp | None, cell: float) -> tuple[int, int]:
    """Returns the numbers of two points of `ends` with a long way through `part`, the first one if it is given."""
    flat, allowed = np.flatnonzero(part), ends[part]
    number = np.full(part.shape, -1)
    number[part] = np.arange(len(flat))
    pairs = []
    for axis in range(3):
        moved = np.moveaxis(number, axis, 0)
        a, b = moved[:-1].ravel(), moved[1:].ravel()
        pairs.append(np.stack([a, b], axis=1)[(a >= 0) & (b >= 0)])
    a, b = np.concatenate(pairs).T
    graph = scipy.sparse.coo_matrix((np.full(len(a), cell), (a, b)), shape=(len(flat), len(flat))).tocsr()

    def farthest(of: int) -> int:
        away = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=of)
        return int(np.argmax(np.where(allowed & np.isfinite(away) & (away <= LONGEST_M), away, -1.0)))

    if first is None:
        one = farthest(int(np.flatnonzero(allowed)[0]))
    else:
        one = int(np.searchsorted(flat, first))
    return int(flat[one]), int(flat[farthest(one)])
