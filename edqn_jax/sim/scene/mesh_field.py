"""Grids of signed distances of closed meshes, made on the host before anything that flies is compiled.

Between the points of a grid a distance is interpolated, which is too large beside edges and corners. So values are
lowered there by as much as the interpolation exceeds the exact distance: of small convex meshes at points half a cell
apart, of others (`solid_distance.py`) in the middle of each cell and at points of the surface, so that what is thinner
than a cell is still there.

V vertices, F triangles; distances in metres, negative inside.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.kept_grids import KEPT_VALUES, kept_values
from edqn_jax.sim.scene.solid_distance import points_on, solid_distances

CELL_M = 0.1
"""Cell of a grid that is neither small nor very large, metres."""

COARSEST_M = 0.4
"""Largest cell, of a mesh whose grid would have more than `MOST_VALUES` with smaller ones, metres."""

MARGIN_M = 0.5
"""Metres around a mesh that its grid reaches, more than a drone's radius."""

MOST_VALUES = 2**22
"""Of a grid, and of all grids of a world, 16 MiB that every program holds."""

MOST_TRIANGLES = 500_000

MOST_THICKNESS_M = 1.0
"""Of a surface, metres."""

_FINEST_M = 0.025
_FINE_VALUES = 2**16  # of a grid that has cells below CELL_M, for thin meshes
_BAND = 3  # cells around the surface in which interpolation is compared with exact distances
_UNSEEN = 1.2  # how much larger the excess of interpolation may be between those points
_DENT = 1e-3  # share of its hull that a convex mesh may leave empty
_MANY = 1000  # triangles, of which distances are taken to planes
_PLANES = 1000  # of such a hull's own, and as many more
_BLOCK = 4  # points along each side of a block that shares candidates
_AT_ONCE = 2**22  # numbers of an intermediate array
_TOGETHER = 2**10  # triangles whose pieces fit a core's cache

Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Grid:
    """A grid of distances about the middle of a mesh's box; grids of equal content are equal."""

    values: NDArray[np.float32]  # [X, Y, Z], its middle in the middle of the box
    cell: float
    half: Numbers  # [3] half extents of the mesh's box
    vertices: Numbers  # [V, 3] about the middle of the box; of a convex mesh those of its hull
    faces: NDArray[np.int64]  # [F, 3] anticlockwise from outside
    is_convex: bool
    thickness: float  # metres of a surface; 0 of a closed mesh
    digest: bytes

    @classmethod
    def of(
        cls,
        values: NDArray[np.floating],
        cell: float,
        half: Numbers,
        vertices: Numbers,
        faces: NDArray[np.integer],
        is_convex: bool = True,
        thickness: float = 0.0,
    ) -> Grid:
        """Returns a grid of such contents."""
        content = (np.asarray(values, np.float32), np.asarray([cell, thickness]), half, vertices, faces)
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in content)).digest()
        return cls(content[0], float(cell), half, vertices, np.asarray(faces, np.int64), is_convex, thickness, digest)

    @functools.cached_property
    def slope(self) -> float:
        """Returns the largest gradient of the interpolated distance, metres a metre: above 1 where values are lowered.

        A step of the whole distance may pass where the interpolated one is 0, but the mesh itself only by as much as
        the distance is larger than that to the mesh.
        """
        squares = np.zeros(self.values.shape)
        for axis in range(3):
            # Within a cell each part of the gradient is linear in x, y and z: the longest is at a corner.
            steps = np.diff(self.values.astype(np.float64), axis=axis) ** 2
            after, before = np.zeros((3, 2), int), np.zeros((3, 2), int)
            after[axis, 1] = before[axis, 0] = 1
            squares += np.maximum(np.pad(steps, after), np.pad(steps, before))
        return float(np.sqrt(squares.max())) / self.cell

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Grid) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def grid_of_mesh(
    vertices: Numbers, faces: NDArray[np.integer], cell: float | None = None, thickness: float = 0.0
) -> tuple[Grid, Numbers]:
    """Returns the grid of a closed mesh, or of a surface with a thickness, and the middle [3] of its box.

    Args:
        vertices: [V, 3] metres.
        faces: [F, 3] vertices of each triangle, anticlockwise from outside; parts may overlap.
        cell: metres; None takes `CELL_M`, less for small meshes as long as the grid is small, and more for large ones.
        thickness: metres, half of them to either side of the triangles, which need not close anything then; 0 is a
            closed mesh.

    Raises:
        ConfigError: if the mesh is not closed, or is too large.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    check_finite(vertices, faces)
    if not thickness:
        check_mesh(vertices, faces)
    elif not 0 < thickness <= MOST_THICKNESS_M:
        raise ConfigError(f"the mesh has a thickness of {thickness:g} m; it must be above 0, to {MOST_THICKNESS_M:g} m")
    return _grid(vertices.tobytes(), faces.tobytes(), cell, float(thickness))


@lru_cache(maxsize=32)
def _grid(vertices: bytes, faces: bytes, cell: float | None, thickness: float) -> tuple[Grid, Numbers]:
    """Returns `grid_of_mesh` of the bytes of a mesh, so that geoms of one mesh share a grid."""
    given, triangles = np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3)
    low, high = given.min(0) - thickness / 2, given.max(0) + thickness / 2
    middle, half = (low + high) / 2, (high - low) / 2
    is_convex = not thickness and is_hull(given, triangles)
    cell = _cell_for(half, is_convex) if cell is None else cell
    if not np.prod(_counts(half, cell)) <= MOST_VALUES:
        raise ConfigError(
            f"the mesh measures {' x '.join(f'{2 * side:.4g}' for side in half)} m, and its distances on a grid of "
            f"{cell:g} m would be {np.prod(_counts(half, cell)):,.0f} values; a mesh may have {MOST_VALUES:,}, so make "
            "it of smaller ones, or of boxes, or, if its file is in millimetres, scale it by 0.001"
        )
    corners, rings = hull_of(given) if is_convex else (given, triangles)
    corners = corners - middle

    def make() -> Numbers:
        # Of large convex meshes, points half a cell apart are too many.
        if is_convex and not is_large:
            return _lowered_values(corners, rings, half, cell)
        return _lowered_values_of_solid(corners[rings], half, cell, thickness)

    is_large = np.prod(_counts(half, cell)) >= KEPT_VALUES
    content = (vertices, faces, np.array([cell, thickness]).tobytes())
    values = kept_values(content, make) if is_large else make()
    return Grid.of(values, cell, half, corners, rings, is_convex, thickness), middle


def is_hull(vertices: Numbers, faces: NDArray[np.integer]) -> bool:
    """Returns whether a closed mesh [V, 3] of triangles [F, 3] fills its convex hull, with which MuJoCo collides.

    Raises:
        ConfigError: if all lie in a plane.
    """
    corners, rings = hull_of(vertices)
    filled = _volume(vertices[faces]) / _volume(corners[rings])
    return bool(abs(filled - 1) <= _DENT)


def check_finite(vertices: Numbers, faces: NDArray[np.integer]) -> None:
    """Raises unless a mesh [V, 3], metres, of triangles [F, 3] is finite and small.

    Raises:
        ConfigError: says what is wrong and what would be right.
    """
    if len(faces) > MOST_TRIANGLES:
        raise ConfigError(f"the mesh has {len(faces):,} triangles; it may have {MOST_TRIANGLES:,}")
    if not np.all(np.isfinite(vertices)):
        raise ConfigError("the mesh has a vertex that is not finite; give it numbers")


def check_mesh(vertices: Numbers, faces: NDArray[np.integer]) -> None:
    """Raises unless a finite mesh [V, 3], metres, of triangles [F, 3] is closed and turned outwards.

    Raises:
        ConfigError: says what is wrong and what would be right.
    """
    _, same = np.unique(vertices, axis=0, return_inverse=True)
    corners = same.reshape(-1)[faces]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(1)]
    there = (corners * len(vertices) + np.roll(corners, -1, axis=1)).ravel()
    back = (np.roll(corners, -1, axis=1) * len(vertices) + corners).ravel()
    edges, number = np.unique(np.concatenate([there, back]), return_inverse=True)
    weights = np.repeat([1, -1], len(there))
    # Parts that share an edge have as many triangles on either side of it.
    lone = int(np.abs(np.bincount(number.reshape(-1), weights, len(edges))).sum()) // 2
    if lone or not len(corners):
        raise ConfigError(
            f"the mesh is not watertight: {lone:,} edges of its {len(faces):,} triangles have none beside them that is "
            "turned as they are; close it, every triangle anticlockwise from outside"
        )
    if _volume(vertices[faces]) < 0:
        raise ConfigError("the mesh is inside out; list the corners of each triangle anticlockwise from outside")


def _volume(triangles: Numbers) -> float:
    """Returns the volume within a closed mesh of triangles [F, 3, 3], negative if it is inside out."""
    a, b, c = np.moveaxis(triangles - triangles.mean((0, 1)), 1, 0)
    return float(np.sum(np.cross(a, b) * c) / 6)


def hull_of(vertices: Numbers) -> tuple[Numbers, NDArray[np.int64]]:
    """Returns vertices [V, 3] and triangles [F, 3], anticlockwise from outside, of the convex hull of points [P, 3].

    Raises:
        ConfigError: if all lie in a plane.
    """
    try:
        hull = scipy.spatial.ConvexHull(vertices)
    except scipy.spatial.QhullError:
        raise ConfigError("the mesh is flat; use a thin box, or a plane") from None
    a, b, c = np.moveaxis(vertices[hull.simplices], 1, 0)
    outwards = np.sum(np.cross(b - a, c - a) * hull.equations[:, :3], axis=1) > 0
    rings = np.where(outwards[:, None], hull.simplices, hull.simplices[:, ::-1])
    used, numbers = np.unique(rings, return_inverse=True)
    return vertices[used], numbers.reshape(-1, 3)


def _counts(half: Numbers, cell: float) -> Numbers:
    """Returns the number of values along each axis, an odd one."""
    return 2 * np.ceil((half + MARGIN_M) / cell) + 1


def _cell_for(half: Numbers, is_convex: bool) -> float:
    cell = float(np.clip(half.min() if is_convex else 0.0, _FINEST_M, CELL_M))
    while cell < CELL_M and np.prod(_counts(half, cell)) > _FINE_VALUES:
        cell = min(2 * cell, CELL_M)
    while cell < COARSEST_M and np.prod(_counts(half, cell)) > MOST_VALUES:
        cell = min(1.25 * cell, COARSEST_M)
    return cell


def _lowered_values_of_solid(triangles: Numbers, half: Numbers, cell: float, thickness: float) -> Numbers:
    """Returns distances [X, Y, Z] as `_lowered_values`, of triangles [F, 3, 3] of any mesh."""
    counts = _counts(half, cell).astype(int)
    found, middles = solid_distances(triangles, counts, cell, is_closed=not thickness)
    exact = found.astype(np.float64)
    between = functools.reduce(_means, range(3), exact)
    near = np.abs(middles) < (_BAND - 1) * cell
    excess = np.zeros(middles.shape)
    excess[near] = np.maximum(_UNSEEN * (between[near] - middles[near]), 0.0)
    # At the surface itself both sides of something thin meet.
    for some in np.array_split(triangles, -(-len(triangles) // _TOGETHER)):
        at = points_on(some, cell) / cell + (counts - 1) / 2
        places = np.minimum(at.astype(np.int64), counts - 2)
        cells = np.ravel_multi_index(tuple(places.T), excess.shape)
        np.maximum.at(excess.reshape(-1), cells, _interpolated(exact, places, at - places))
    lowering = np.pad(excess, 1)
    for axis in range(3):
        moved = np.moveaxis(lowering, axis, 0)
        lowering = np.moveaxis(np.maximum(moved[1:], moved[:-1]), 0, axis)
    far = exact > (_BAND - 1) * cell
    lowering[far] = np.maximum(lowering[far], cell**2 / (4 * exact[far]))
    return exact - lowering - thickness / 2


def _means(values: Numbers, axis: int) -> Numbers:
    """Returns the means of neighbours along an axis."""
    moved = np.moveaxis(values, axis, 0)
    return np.moveaxis((moved[1:] + moved[:-1]) / 2, 0, axis)


def _interpolated(values: NDArray[np.floating], places: NDArray[np.int64], parts: Numbers) -> Numbers:
    """Returns values [P] between those of a lattice, in the cells at `places` [P, 3], `parts` [P, 3] of a cell on."""
    strides = np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
    first, flat = places @ strides, values.ravel()
    shares = [(1 - part, part) for part in parts.T]
    found = np.zeros(len(places))
    for i, j, k in itertools.product((0, 1), repeat=3):
        found += shares[0][i] * shares[1][j] * shares[2][k] * flat[first + np.dot(strides, (i, j, k))]
    return found


def _lowered_values(vertices: Numbers, faces: NDArray[np.integer], half: Numbers, cell: float) -> Numbers:
    """Returns distances [X, Y, Z] between which interpolation is not too large, of a mesh about its box's middle."""
    axes = [cell * (np.arange(n) - (n - 1) / 2) for n in _counts(half, cell)]
    shape = tuple(map(len, axes))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    exact = convex_distances(points.reshape(-1, 3), vertices, faces).reshape(shape)
    fine = exact
    for axis in range(3):
        fine = _with_middles(fine, axis)
    near = np.abs(fine) < _BAND * cell
    at = np.argwhere(near)
    between = cell * (at - (np.array(fine.shape) - 1) / 2) / 2
    excess = np.zeros(fine.shape)
    excess[near] = _UNSEEN * (fine[near] - convex_distances(between, vertices, faces))
    lowering = scipy.ndimage.maximum_filter(excess, size=5)[::2, ::2, ::2]
    # Further away the distance bends by at most 1 / distance in two directions.
    far = exact > (_BAND - 1) * cell
    lowering[far] = np.maximum(lowering[far], cell**2 / (4 * exact[far]))
    return exact - lowering


def _with_middles(values: Numbers, axis: int) -> Numbers:
    """Returns values with those halfway between neighbours along an axis, by interpolation."""
    moved = np.moveaxis(values, axis, 0)
    more = np.empty((2 * len(moved) - 1, *moved.shape[1:]))
    more[::2], more[1::2] = moved, (moved[1:] + moved[:-1]) / 2
    return np.moveaxis(more, 0, axis)


def convex_distances(points: Numbers, vertices: Numbers, faces: NDArray[np.integer]) -> Numbers:
    """Returns the signed distances [P] of points [P, 3] to a closed convex mesh, metres.

    Exact; of more than 1,000 triangles at most 1 % too small outside.
    """
    triangles = vertices[faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    triangles, normals = triangles[lengths > 0], (normals[lengths > 0].T / lengths[lengths > 0]).T
    if len(triangles) > _MANY:
        largest = np.argsort(-lengths[lengths > 0])[:_PLANES]
        return _to_planes(points, vertices, np.concatenate([normals[largest], spread_directions(_PLANES)]))
    offsets = np.sum(normals * triangles[:, 0], axis=1)
    step = max(1, _AT_ONCE // len(triangles))
    # Inside, the nearest point lies on the nearest plane.
    parts = (points[i : i + step] for i in range(0, len(points), step))
    found = np.concatenate([np.zeros(0), *(np.max(part @ normals.T - offsets, axis=1) for part in parts)])
    out = np.flatnonzero(found > 0)
    if len(out):
        found[out] = _outer_distances(points[out], triangles, normals)
    return found


def spread_directions(count: int) -> Numbers:
    """Returns unit vectors [count, 3] spread evenly over the sphere."""
    number = np.arange(count) + 0.5
    height, turn = 1 - 2 * number / count, np.pi * (1 + 5**0.5) * number
    around = np.sqrt(1 - height**2)
    return np.stack([around * np.cos(turn), around * np.sin(turn), height], axis=1)


def _to_planes(points: Numbers, vertices: Numbers, normals: Numbers) -> Numbers:
    """Returns the largest distance [P] of points [P, 3] to planes that touch a convex mesh: never more than to it."""
    offsets = np.concatenate([np.max(normals[i : i + 16] @ vertices.T, axis=1) for i in range(0, len(normals), 16)])
    step = max(1, _AT_ONCE // len(normals))
    parts = (points[i : i + step] for i in range(0, len(points), step))
    return np.concatenate([np.max(part @ normals.T - offsets, axis=1) for part in parts])


def _outer_distances(points: Numbers, triangles: Numbers, normals: Numbers) -> Numbers:
    """Returns the distances [P] of points [P, 3] outside of a convex mesh; blocks of points share candidates."""
    middles = triangles.mean(1)
    radii = np.linalg.norm(triangles - middles[:, None], axis=2).max(1)
    low, high = points.min(0), points.max(0)
    side = _BLOCK * max(float(np.prod(high - low) / len(points)) ** (1 / 3), 1e-6)
    _, block = np.unique(np.floor((points - low) / side).astype(np.int64), axis=0, return_inverse=True)
    block = block.reshape(-1)
    order = np.argsort(block, kind="stable")
    found = np.empty(len(points))
    for members in np.split(order, np.flatnonzero(np.diff(block[order])) + 1):
        centre = points[members].mean(0)
        reach = np.linalg.norm(points[members] - centre, axis=1).max()
        away = np.linalg.norm(middles - centre, axis=1)
        near = away - radii <= away.min() + 2 * reach + 1e-9
        # The nearest point lies on a triangle whose plane the point is above of.
        near[near] = np.sum((centre - middles[near]) * normals[near], axis=1) >= -reach - 1e-9
        step = max(1, _AT_ONCE // max(1, int(near.sum())))
        for part in (members[i : i + step] for i in range(0, len(members), step)):
            found[part] = _to_triangles(points[part] - centre, triangles[near] - centre, normals[near])
    return found


def _to_triangles(points: Numbers, triangles: Numbers, normals: Numbers) -> Numbers:
    """Returns the distance [P] of points [P, 3] to the nearest of triangles [K, 3, 3]."""
    edges = np.roll(triangles, -1, axis=1) - triangles
    height = points @ normals.T - np.sum(normals * triangles[:, 0], axis=1)
    above = np.ones(height.shape, bool)
    beside = np.full(height.shape, np.inf)
    squares = np.sum(points**2, axis=1)[:, None]
    for i in range(3):
        start, edge = triangles[:, i], edges[:, i]
        outward = np.cross(edge, normals)
        above &= points @ outward.T <= np.sum(outward * start, axis=1)
        along = points @ edge.T - np.sum(edge * start, axis=1)
        length = np.maximum(np.sum(edge**2, axis=1), 1e-300)
        share = np.clip(along / length, 0.0, 1.0)
        to_start = squares - 2 * points @ start.T + np.sum(start**2, axis=1)
        np.minimum(beside, to_start - share * (2 * along - share * length), out=beside)
    return np.sqrt(np.maximum(np.where(above, height**2, beside), 0.0).min(1))
