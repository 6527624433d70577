"""Fields: solids of any form as grids of signed distances (`sim/scene/mesh_field.py`).

Where a field stands, and how it moves, is in a world's arrays; its grid is static, a constant of a program, since the
camera copies those arrays for each column.
Between its values a distance is interpolated; beyond its grid a field is at least as far away as the box around the
mesh, and as the nearest point of the grid together with the distance there.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.grid_boxes import boxes_of_grid, thinned
from edqn_jax.sim.scene.mesh_field import Grid, grid_of_mesh, hull_of, spread_directions
from edqn_jax.sim.scene.motion import Motion
from edqn_jax.sim.scene.shapes import field_rays, field_walk
from edqn_jax.sim.scene.shapes.faces import faces_of_box
from edqn_jax.sim.scene.shapes.kind import (
    FAR,
    GREY,
    PARKED,
    THICKNESS,
    Geom,
    Hits,
    ShapeKind,
    Vector,
    norm,
    offset,
    quaternion_of,
)
from edqn_jax.sim.scene.surface import Surface

SLACK_M = 0.1
"""Metres that a distance may be too small near a surface, in corners of cells of `CELL_M`."""

TOUCHES = 1e-6
"""Metres that are none."""

_MOST_FACES = 400  # of a solid in pictures
_MOST_TRIANGLES = 50_000  # of a mesh on the page


@struct.dataclass
class Fields:
    """Solids of which distances are known on grids."""

    position: Array  # [N, 3] middle of the box around the solid, metres
    rotation: Array  # [N, 3, 3] body-to-world
    half: Array  # [N, 3] half extents of that box along its own axes, metres
    grid: Array  # [N] number of its grid
    albedo: Array  # [N, 3]
    motion: Motion | None = None
    surface: Surface | None = None
    grids: tuple[Grid, ...] = struct.field(pytree_node=False, default=())


class _Table(NamedTuple):
    """All grids as one array, and a row for each grid."""

    counts: np.ndarray  # [G, 3] values along each axis
    cell: np.ndarray  # [G] metres
    values: np.ndarray  # of all grids, one after the other
    begin: np.ndarray  # [G] number of its first value
    for_rays: np.ndarray  # the same values in 16 bits (`field_rays.quantized`)
    least: np.ndarray  # of all values in each block of cells
    blocks_begin: np.ndarray  # [G] number of its first block


@lru_cache(maxsize=8)
def _table(grids: tuple[Grid, ...]) -> _Table:
    blocks = [_least_of_blocks(grid.values) for grid in grids]
    return _Table(
        np.array([grid.values.shape for grid in grids], np.int32),
        np.array([grid.cell for grid in grids], np.float32),
        np.concatenate([grid.values.ravel() for grid in grids]),
        np.cumsum([0, *(grid.values.size for grid in grids[:-1])]).astype(np.int32),
        np.concatenate([field_rays.quantized(grid.values.ravel(), grid.cell) for grid in grids]),
        np.concatenate([least.ravel() for least in blocks]),
        np.cumsum([0, *(least.size for least in blocks[:-1])]).astype(np.int32),
    )


def table_for_rays(fields: Fields) -> tuple[np.ndarray, ...]:
    """Returns what `field_rays.meet` reads of the G grids of fields: its `table`, of values [...] and rows [G, ...]."""
    table = _table(fields.grids)
    return table.for_rays, table.begin, table.least, table.blocks_begin, table.counts, table.cell


def _least_of_blocks(values: np.ndarray) -> np.ndarray:
    """Returns the least value of each block of `BLOCK` cells along each axis, the values at its ends included."""
    for axis in range(3):
        moved, size = np.moveaxis(values, axis, 0), field_rays.BLOCK
        parts = [moved[begin : begin + size + 1].min(0) for begin in range(0, len(moved) - 1, size)]
        values = np.moveaxis(np.stack(parts), 0, axis)
    return values


def _in_cells(fields: Fields, place: Vector) -> Vector:
    """Returns places in each field's own axes as numbers of values on its grid; those outside as the nearest on it."""
    table, number = _table(fields.grids), _grid_numbers(fields, place[0].ndim)
    counts, cell = jnp.asarray(table.counts)[number], jnp.asarray(table.cell)[number]
    x, y, z = (jnp.clip(place[i] / cell + (counts[..., i] - 1) / 2, 0.0, counts[..., i] - 1.0) for i in range(3))
    return x, y, z


def _grid_numbers(fields: Fields, dimensions: int) -> Array:
    """Returns the number of each field's grid: [N], with as many axes of 1 as places of `dimensions` need."""
    number = fields.grid.astype(jnp.int32)
    return number.reshape(number.shape + (1,) * (dimensions - 1))


def _interpolate(fields: Fields, at: Vector) -> tuple[Array, Vector]:
    """Returns distances [N, ...] at places `_in_cells`, and their slopes along each field's own axes."""
    table, number = _table(fields.grids), _grid_numbers(fields, at[0].ndim)
    counts = jnp.asarray(table.counts)[number]
    lower = [jnp.minimum(at[i].astype(jnp.int32), counts[..., i] - 2) for i in range(3)]
    part = [at[i] - lower[i] for i in range(3)]
    across, along, values = counts[..., 1] * counts[..., 2], counts[..., 2], jnp.asarray(table.values)
    first = jnp.asarray(table.begin)[number] + lower[0] * across + lower[1] * along + lower[2]

    def value(i: int, j: int, k: int) -> Array:
        return values.at[first + i * across + j * along + k].get(mode="promise_in_bounds")

    corner = [[[value(i, j, k) for k in range(2)] for j in range(2)] for i in range(2)]

    def between(low: Array, high: Array, axis: int) -> Array:
        return low + part[axis] * (high - low)

    z = [[between(corner[i][j][0], corner[i][j][1], 2) for j in range(2)] for i in range(2)]
    y = [between(z[i][0], z[i][1], 1) for i in range(2)]
    across_z = [[corner[i][j][1] - corner[i][j][0] for j in range(2)] for i in range(2)]
    slope_z = [between(across_z[i][0], across_z[i][1], 1) for i in range(2)]
    slopes = (
        y[1] - y[0],
        between(z[0][1] - z[0][0], z[1][1] - z[1][0], 0),
        between(slope_z[0], slope_z[1], 0),
    )
    return between(y[0], y[1], 0), slopes


def _distance(fields: Fields, x: Array, y: Array, z: Array) -> Array:
    away, r = offset(fields.position, x, y, z), fields.rotation
    place: Any = tuple(sum(r[:, j, i] * away[j] for j in range(3)) for i in range(3))
    table, number = _table(fields.grids), fields.grid.astype(jnp.int32)
    reach = (jnp.asarray(table.counts)[number] - 1) * (jnp.asarray(table.cell)[number] / 2)[:, None]
    beyond = norm(*(jnp.maximum(jnp.abs(place[i]) - reach[:, i], 0.0) for i in range(3)))
    to_box = norm(*(jnp.maximum(jnp.abs(place[i]) - fields.half[:, i], 0.0) for i in range(3)))
    inside, _ = _interpolate(fields, _in_cells(fields, place))
    # The grid's border lies between a point beyond it and the solid, at a right or a blunt angle.
    found = jnp.where(beyond > TOUCHES, norm(beyond, jnp.maximum(inside, 0.0)), inside)
    return jnp.where(to_box > TOUCHES, jnp.maximum(found, to_box), found)


def _meet(fields: Fields, origin: Array, ray: Vector) -> Hits:
    """Returns where rays meet fields: they advance by the distance, within the box around each solid."""
    shape = jnp.broadcast_shapes(*(part.shape for part in ray))
    whole: Any = tuple(jnp.broadcast_to(part, shape)[0] for part in ray)
    table = table_for_rays(fields)
    natively, plainly = partial(field_rays.meet, table), partial(field_walk.meet, table)
    with_library = {platform: natively for platform in ("cpu", "cuda") if field_rays.is_available(platform)}
    depth, *normal = lax.platform_dependent(fields, origin, whole, **with_library, default=plainly)
    return Hits.of(depth, depth < field_rays.NOWHERE, (normal[0], normal[1], normal[2]))


def _read(geom: Geom) -> Fields | None:
    if geom.mesh is None:
        return None
    try:
        grid, middle = grid_of_mesh(*geom.mesh, thickness=geom.thickness)
    except ConfigError as error:
        # Only the file that names it can make it a surface.
        hint = f'; or give it a thickness: <numeric name="{THICKNESS}NAME OF THE GEOM" data="0.1"/> in <custom>'
        raise ConfigError(f"{error}{hint if 'watertight' in str(error) else ''}") from None
    position = geom.position + geom.rotation @ middle
    return Fields(position, geom.rotation, grid.half, np.float32(0), geom.albedo, grids=(grid,))  # type: ignore[arg-type]


def grid_of(one: Fields) -> Grid:
    """Returns the grid of a single field."""
    return one.grids[int(one.grid)]


def _asset(one: Fields) -> dict[str, Any]:
    grid = grid_of(one)
    return {"vertex": grid.vertices, "face": grid.faces}


def _custom(one: Fields) -> dict[str, Any]:
    thickness = grid_of(one).thickness
    return {THICKNESS: [thickness]} if thickness else {}


def _faces(one: Fields) -> list[np.ndarray]:
    vertices, faces = grid_of(one).vertices, grid_of(one).faces
    if len(faces) > _MOST_FACES:
        # The hull of the vertices that reach furthest in directions all around.
        towards = spread_directions(_MOST_FACES // 4)
        vertices, faces = hull_of(vertices[np.unique([np.argmax(vertices @ one) for one in towards])])
    return list((one.position + vertices @ np.asarray(one.rotation).T)[faces])


def _parts(one: Fields) -> list[list[np.ndarray]]:
    grid, turn = grid_of(one), np.asarray(one.rotation)
    if grid.is_convex:
        return [_faces(one)]
    return [
        faces_of_box(one.position + turn @ (low + high) / 2, (high - low) / 2, turn)
        for low, high in boxes_of_grid(grid)
    ]


def _page(one: Fields) -> dict[str, Any]:
    grid = grid_of(one)
    if grid.is_convex and len(grid.faces) <= _MOST_FACES:
        return {"kind": "faces", "faces": [ring - one.position for ring in _faces(one)]}
    vertices, faces = thinned(grid.vertices, grid.faces, _MOST_TRIANGLES)
    return {"kind": "mesh", "turn": np.asarray(one.rotation).ravel(), "vertices": vertices, "triangles": faces}


def _share(several: Sequence[Fields]) -> list[Fields]:
    """Returns fields, single or not, with one tuple of grids, in which each grid stands once."""
    grids = tuple(dict.fromkeys(grid for each in several for grid in each.grids))

    def numbered(each: Fields) -> Fields:
        if each.grids == grids:
            return each
        numbers = np.array([grids.index(grid) for grid in each.grids], np.float32)[np.asarray(each.grid, np.int32)]
        return each.replace(grid=jax.device_put(numbers) if isinstance(each.grid, Array) else numbers, grids=grids)  # type: ignore[attr-defined]

    return [numbered(each) for each in several]


_NOTHING = Grid.of(np.full((2, 2, 2), PARKED), 1.0, np.zeros(3), np.zeros((0, 3)), np.zeros((0, 3), np.int64))

FIELD = ShapeKind(
    parked=Fields(FAR, np.eye(3), np.zeros(3), np.float32(0), GREY, grids=(_NOTHING,)),  # type: ignore[arg-type]
    geom="mesh",
    distance=_distance,
    meet=_meet,
    read=_read,
    write=lambda one: {"quat": quaternion_of(one.rotation)},
    asset=_asset,
    custom=_custom,
    share=_share,
    slack=SLACK_M,
    reach=lambda fields: (abs(fields.rotation) * fields.half[..., None, :]).sum(-1),
    faces=_faces,
    parts=_parts,
    page=_page,
)
