"""Meshes of any form, drawn through a depth buffer: triangles of concave solids have no order of painting.

T triangles; a picture has [H, W] pixels, its first row at the bottom.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from edqn_jax.report.worlds.views import View, pale, shaded
from edqn_jax.sim.scene.shapes.kind import THICKNESS, ShapeKind

PIXELS = 1200
"""Along the longer side of a picture."""
SECTION = 0.45
"""Share of its own brightness with which a mesh is drawn where it is cut."""
EDGE = 0.6
"""The same of an edge."""
EDGE_M = 0.15
"""Metres along the view between a pixel and one beside it from which on there is an edge."""

FLOOR_M = 0.3
"""Metres above a mesh's own floor up to which it is part of the floor."""
FLOOR_SHARE = 0.25
"""Share of the ground below a mesh that its floor covers, at least."""

_LEVEL = 0.9  # of a normal's upward part
_RISES_M = 1.0  # by which a mesh is higher than its floor, at least
_EDGE_PIXELS = 6.0  # the same in pixels: a slope is no edge
_AT_ONCE = 2**20  # pixels in the boxes around triangles that are drawn together
_ASIDE = np.array([0.3127, 0.6713])  # pixels: sides along the axes are not to run through middles of pixels

Numbers = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Mesh:
    """Triangles of one colour in the world."""

    corners: Numbers
    """[T, 3, 3] metres, anticlockwise from outside."""
    colour: np.ndarray
    """[3] RGB in [0, 1]."""
    is_closed: bool = True
    """Whether there is an inside, which is seen where it is cut."""
    cuts: tuple[tuple[np.ndarray, float], ...] = ()
    """Planes beyond which it is not drawn: a unit normal [3] towards the eye, and how far along it, metres."""
    open_below: float = -np.inf
    """Height, metres, below which it is drawn pale."""


def mesh_of_shape(kind: ShapeKind, shape: Any) -> Mesh | None:
    """Returns the mesh that a shape is written with; None if it has none, or if its parts are all of the mesh."""
    if kind.asset is None or kind.faces is None:
        return None
    asset = kind.asset(shape)
    faces = np.asarray(asset["face"])
    parts = [kind.faces(shape)] if kind.parts is None else kind.parts(shape)
    if len(parts) == 1 and len(parts[0]) == len(faces):
        return None
    corners = shape.position + np.asarray(asset["vertex"])[faces] @ np.asarray(shape.rotation).T
    return Mesh(corners, np.asarray(shape.albedo), kind.custom is None or THICKNESS not in kind.custom(shape))


def floor_of(mesh: Mesh, lowest: float, highest: float) -> float | None:
    """Returns the height, metres, of the floor that is part of a mesh, as of a scan; None if it has none.

    It is where most of the level area is, if that covers enough and the mesh rises above it.

    Args:
        mesh: in the world.
        lowest: height, metres, above which a floor may be.
        highest: the same below which it may be.
    """
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    normals, heights = np.cross(b - a, c - a) / 2, mesh.corners[..., 2].mean(1)
    area = np.linalg.norm(normals, axis=1)
    upwards = normals[:, 2] if mesh.is_closed else np.abs(normals[:, 2])
    level = (upwards > _LEVEL * area) & (heights >= lowest) & (heights <= highest)
    if not level.any():
        return None
    order = np.argsort(heights[level])
    heights, area = heights[level][order], area[level][order]
    until = np.concatenate([[0.0], np.cumsum(area)])
    covered = until[np.searchsorted(heights, heights + FLOOR_M, side="right")] - until[:-1]
    first = int(np.argmax(covered))
    corners = mesh.corners.reshape(-1, 3)
    floor = float(heights[np.searchsorted(until[1:], until[first] + covered[first] / 2)])
    wide_enough = covered[first] >= FLOOR_SHARE * np.prod(np.ptp(corners[:, :2], axis=0))
    return floor if wide_enough and corners[:, 2].max() >= floor + _RISES_M else None


def plot_meshes(axes: Axes, view: View, meshes: Sequence[Mesh]) -> None:
    """Draws meshes as one picture in which what is nearer to the eye hides what is behind it."""
    flat = view.project(np.concatenate([_corners_before_cuts(mesh) for mesh in meshes]))
    if not len(flat):
        return
    low, high = flat.min(0), flat.max(0)
    pitch = float((high - low).max()) / PIXELS
    if pitch == 0:
        return
    picture = draw_meshes(view, meshes, low, pitch, np.ceil((high - low) / pitch).astype(int) + 1)
    (x0, y0), (x1, y1) = low, low + pitch * np.array(picture.shape[1::-1])
    # `imshow` would set the limits of the axes.
    image = AxesImage(axes, extent=(x0, x1, y0, y1), origin="lower", interpolation="antialiased", zorder=2)
    image.set_data(picture)
    image.sticky_edges.x[:], image.sticky_edges.y[:] = [], []
    axes.add_image(image)
    axes.update_datalim([(x0, y0), (x1, y1)])
    axes.autoscale_view()


def draw_meshes(view: View, meshes: Sequence[Mesh], low: Numbers, pitch: float, size: Integers) -> Numbers:
    """Returns meshes as a picture [H, W, 4], RGBA in [0, 1].

    Where a closed mesh is cut its inside is shown, however its parts overlap.

    Args:
        view: an orthographic one, from above.
        meshes: what is drawn.
        low: [2] the picture's lower left corner, metres as of `View.project`.
        pitch: metres of a pixel.
        size: W and H.
    """
    wide, high = (int(side) for side in size)
    count, towards = wide * high, view.towards
    seen, colour = np.full(count, -np.inf), np.zeros((count, 3))
    # A point of the world is its place in the picture and its depth along the view.
    across = view.project(np.eye(3))
    x, y = low[0] + pitch * (np.arange(wide) + _ASIDE[0]), low[1] + pitch * (np.arange(high) + _ASIDE[1])
    flat_z = np.repeat(y * across[2, 1], wide)
    for mesh in map(_before_cuts, meshes):
        limit = np.full(count, np.inf)
        for normal, along in mesh.cuts:
            to_right, upwards = normal @ across
            limit = np.minimum(limit, (along - np.add.outer(y * upwards, x * to_right).ravel()) / (normal @ towards))
        a, b, c = np.moveaxis(mesh.corners, 1, 0)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        leaves = -np.sign(normals @ towards).astype(int)
        nearest, which, inside = np.full(count, -np.inf), np.zeros(count, int), np.zeros(count, int)
        flat = (view.project(mesh.corners) - low) / pitch - _ASIDE
        for pixel, depth, triangle in _pixels_of(flat, mesh.corners @ towards, wide, high):
            shown = depth <= limit[pixel]
            pixel, depth, triangle = pixel[shown], depth[shown], triangle[shown]
            np.add.at(inside, pixel, leaves[triangle])
            np.maximum.at(nearest, pixel, depth)
            first = nearest[pixel] == depth
            which[pixel[first]] = triangle[first]
        found = np.flatnonzero(nearest > -np.inf)
        nearest, which, inside = nearest[found], which[found], inside[found]
        own = shaded(mesh.colour, normals[which] * -leaves[which][:, None])
        if mesh.is_closed and mesh.cuts:
            # A ray that leaves the mesh more often than it enters begins within.
            nearest = np.where(inside > 0, limit[found], nearest)
            own[inside > 0] = SECTION * shaded(mesh.colour, np.array([0.0, 0.0, 1.0]))
        is_open = flat_z[found] + nearest * towards[2] < mesh.open_below
        own[is_open] = pale(own[is_open])
        nearer = nearest > seen[found]
        seen[found[nearer]], colour[found[nearer]] = nearest[nearer], own[nearer]
    there, depth = np.isfinite(seen).reshape(high, wide), seen.reshape(high, wide)
    picture = np.concatenate([colour.reshape(high, wide, 3), there[..., None]], axis=-1)
    picture[_edges(depth, max(EDGE_M, _EDGE_PIXELS * pitch)), :3] *= EDGE
    return picture


def _before_cuts(mesh: Mesh) -> Mesh:
    """Returns a mesh without the triangles that are wholly beyond a plane."""
    kept = np.ones(len(mesh.corners), bool)
    for normal, along in mesh.cuts:
        kept &= (mesh.corners @ normal).min(1) <= along
    return dataclasses.replace(mesh, corners=mesh.corners[kept])


def _corners_before_cuts(mesh: Mesh) -> Numbers:
    """Returns corners [N, 3] around what is drawn of a mesh: those beyond a plane are moved to it."""
    corners = _before_cuts(mesh).corners.reshape(-1, 3)
    for normal, along in mesh.cuts:
        corners = corners - np.maximum(corners @ normal - along, 0.0)[:, None] * normal
    return corners


def _pixels_of(flat: Numbers, depth: Numbers, wide: int, high: int) -> Iterator[tuple[Integers, Numbers, Integers]]:
    """Yields pixels, depths there and triangles, some at a time, of triangles [T, 3, 2] of depths [T, 3] at corners.

    A pixel beside a line belongs to the triangle on one side of it, and never to those on both.
    """
    first = np.clip(np.ceil(flat[..., 1].min(1)), 0, high).astype(int)
    rows = np.clip(np.ceil(flat[..., 1].max(1)), 0, high).astype(int) - first
    boxes = np.cumsum(rows * (np.ptp(flat[..., 0], axis=1) + 2))
    a, b, c = np.moveaxis(flat, 1, 0)
    twice = _cross(b - a, c - a)
    kept = np.flatnonzero((rows > 0) & (np.abs(twice) > 1e-12))
    for some in np.split(kept, np.flatnonzero(np.diff(boxes[kept] // _AT_ONCE)) + 1):
        triangle, along = _repeated(some, rows[some])
        row = first[triangle] + along
        left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
        for one, other in ((0, 1), (1, 2), (2, 0)):
            # From the lower end, whichever triangle it is of: both then find the same crossing.
            ends = flat[triangle][:, [one, other]]
            lower = np.argmin(ends[..., 1], axis=1)
            p, q = ends[np.arange(len(ends)), lower], ends[np.arange(len(ends)), 1 - lower]
            crossed = (p[:, 1] <= row) & (row < q[:, 1])
            x = p[:, 0] + (row - p[:, 1]) * (q[:, 0] - p[:, 0]) / np.where(crossed, q[:, 1] - p[:, 1], 1.0)
            left, right = np.where(crossed, np.minimum(left, x), left), np.where(crossed, np.maximum(right, x), right)
        begin = np.clip(np.ceil(np.where(left <= right, left, 0)), 0, wide).astype(int)
        end = np.clip(np.ceil(np.where(left <= right, right, 0)), 0, wide).astype(int)
        span, along = _repeated(np.arange(len(row)), np.maximum(end - begin, 0))
        triangle, x, y = triangle[span], begin[span] + along, row[span]
        # As much of each corner's depth as the opposite part of the triangle has of its area.
        away = np.stack([x, y], axis=1) - a[triangle]
        share_b = _cross(away, (c - a)[triangle]) / twice[triangle]
        share_c = _cross((b - a)[triangle], away) / twice[triangle]
        at_a, at_b, at_c = depth[triangle].T
        yield y * wide + x, at_a + share_b * (at_b - at_a) + share_c * (at_c - at_a), triangle


def _cross(one: Numbers, other: Numbers) -> Numbers:
    """Returns twice the signed area [K] of the triangle of two vectors [K, 2]."""
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def _repeated(items: Integers, counts: Integers) -> tuple[Integers, Integers]:
    """Returns items [K], each so often, and which repetition of it each is."""
    before = np.cumsum(counts) - counts
    return np.repeat(items, counts), np.arange(int(counts.sum())) - np.repeat(before, counts)


def _edges(depth: Numbers, step: float) -> NDArray[np.bool_]:
    """Returns which pixels [H, W] stand before one beside them by more than a step, metres along the view."""
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        near, edge = np.moveaxis(depth, axis, 0), np.moveaxis(edges, axis, 0)
        edge[1:] |= near[1:] > near[:-1] + step
        edge[:-1] |= near[:-1] > near[1:] + step
    return edges
