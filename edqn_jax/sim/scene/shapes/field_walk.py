"""Rays through fields in JAX, where `field_rays.py` has no library: what `field_rays.h` does, in its words.

N fields, G groups of K neighbouring rays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from edqn_jax.sim.scene.shapes import field_rays
from edqn_jax.sim.scene.shapes.field_rays import BLOCK, CONE, FAR_M, PER_CELL, STOPS
from edqn_jax.sim.scene.shapes.kind import TINY, Vector, per_shape, safe_inverse

State = TypeVar("State")


class _Lattices(NamedTuple):
    """The grid of each field, and the eye on it: numbers [N, 1, 1]."""

    values: Array  # of all grids
    least: Array
    begin: Array  # number of the first value, and of the first block
    begin_least: Array
    across: Array  # values from one place to the next along x and y
    along: Array
    blocks_across: Array
    blocks_along: Array
    most: Sequence[Array]  # where along each axis a ray is taken to be at most: in the last cell
    eye: Sequence[Array]  # in cells
    cell: Array
    end: Array  # distance at which rays end at depth 0, and what it grows by with depth, thousandths of a cell
    end_per_depth: Array


class _Places(NamedTuple):
    """Depths of rays, and where they are then on their lattices: a little less than the last value at most.

    Carried along: computed twice, a place may be rounded to either side of where cells meet, and the value of one cell
    be read at the share of the other.
    """

    depth: Array
    at: Sequence[Array]


class _Cells(NamedTuple):
    """Cells [N, G, K], and where in them rays are."""

    corner: Sequence[Array]
    part: Sequence[Array]


def meet(table: tuple[np.ndarray, ...], fields: Any, origin: Array, ray: Vector) -> tuple[Array, Array, Array, Array]:
    """Returns depths [N, R, C] and three parts of the normals where rays meet fields, as `field_rays.meet` does.

    Args:
        table: as there.
        fields: N of them.
        origin: [3] metres.
        ray: direction of the rays, [R, C] each.
    """
    shape, number = ray[0].shape, fields.position.shape[0]
    missing = -ray[0].size % field_rays.TOGETHER
    groups = [jnp.pad(part.ravel(), (0, missing), mode="edge").reshape(1, -1, field_rays.TOGETHER) for part in ray]
    turn = [[per_shape(fields.rotation[:, j, i]) for j in range(3)] for i in range(3)]
    away = [per_shape(origin[i] - fields.position[:, i]) for i in range(3)]
    o: Any = [sum(turn[i][j] * away[j] for j in range(3)) for i in range(3)]
    d: Any = [sum(turn[i][j] * groups[j] for j in range(3)) for i in range(3)]
    enter, leave = jnp.zeros(()), jnp.full((), FAR_M)
    for i in range(3):
        per_d = safe_inverse(d[i])
        middle, reach = -o[i] * per_d, per_shape(fields.half[:, i]) * jnp.abs(per_d)
        enter, leave = jnp.maximum(enter, middle - reach), jnp.minimum(leave, middle + reach)
    g = _lattices(table, fields, o)
    depth = jnp.maximum(enter, _march_together(g, d, enter, leave))
    depth, slopes = _walk(g, d, depth, enter, leave)
    hit = (depth > 0) & (depth < leave)
    scale = jnp.where(hit, safe_inverse(_length(slopes)), 0.0)
    normal = [scale * sum(turn[i][j] * slopes[i] for i in range(3)) for j in range(3)]
    found = (jnp.where(hit, depth, FAR_M), *normal)
    x, y, z, w = (part.reshape(number, -1)[:, : ray[0].size].reshape(number, *shape) for part in found)
    return x, y, z, w


def _lattices(table: tuple[np.ndarray, ...], fields: Any, o: Sequence[Array]) -> _Lattices:
    values, begin, least, begin_least, counts, cells = table
    number = per_shape(fields.grid.astype(jnp.int32))
    count = [jnp.asarray(counts)[number, i] for i in range(3)]
    cell, last = jnp.asarray(cells)[number], [each - 1.0 for each in count]
    y, z = ((count[i] + BLOCK - 2) // BLOCK for i in (1, 2))
    return _Lattices(
        values=jnp.asarray(values),
        least=jnp.asarray(least),
        begin=jnp.asarray(begin)[number],
        begin_least=jnp.asarray(begin_least)[number],
        across=count[1] * count[2],
        along=count[2],
        blocks_across=y * z,
        blocks_along=z,
        most=[each * (1 - field_rays.ROUNDED) - 0.001 for each in last],
        eye=[o[i] / cell + last[i] / 2 for i in range(3)],
        cell=cell,
        end=jnp.full((), PER_CELL * STOPS),
        end_per_depth=PER_CELL * CONE / cell,
    )


def _placed(g: _Lattices, d: Sequence[Array], depth: Array) -> _Places:
    """Returns where rays `d`, cells, are at a depth."""
    return _Places(depth, [jnp.clip(g.eye[i] + depth * d[i], 0.0, g.most[i]) for i in range(3)])


def _least_around(g: _Lattices, at: Sequence[Array]) -> Array:
    """Returns the least distances in the blocks where rays are."""
    x, y, z = (each.astype(jnp.int32) // BLOCK for each in at)
    return g.least.at[g.begin_least + x * g.blocks_across + y * g.blocks_along + z].get(mode="promise_in_bounds")


def _cells_around(g: _Lattices, at: Sequence[Array]) -> _Cells:
    lower = [each.astype(jnp.int32) for each in at]
    part = [each - low for each, low in zip(at, lower, strict=True)]
    first = g.begin + lower[0] * g.across + lower[1] * g.along + lower[2]
    places = (first + i * g.across + j * g.along + k for i in range(2) for j in range(2) for k in range(2))
    corner = [g.values.at[place].get(mode="promise_in_bounds").astype(jnp.float32) for place in places]
    return _Cells(corner, part)


def _mixed(low: Array, high: Array, part: Array) -> Array:
    return low + part * (high - low)


def _distance_in(c: _Cells, d: Sequence[Array], further: Array) -> tuple[Array, list[Array]]:
    """Returns distances in cells, `further` than where rays are, thousandths of a cell, and their slopes per cell."""
    x, y, z = (c.part[i] + further * d[i] for i in range(3))
    k = c.corner
    z00, z01, z10, z11 = (_mixed(k[i], k[i + 1], z) for i in (0, 2, 4, 6))
    y0, y1 = _mixed(z00, z01, y), _mixed(z10, z11, y)
    slope_z = _mixed(_mixed(k[1] - k[0], k[3] - k[2], y), _mixed(k[5] - k[4], k[7] - k[6], y), x)
    return _mixed(y0, y1, x), [y1 - y0, _mixed(z01 - z00, z11 - z10, x), slope_z]


def _march_together(g: _Lattices, d: Sequence[Array], enter: Array, leave: Array) -> Array:
    """Returns the depth [N, G, 1] up to which no ray of a group meets anything, of rays `d` [N, G, K], metres."""
    low = [jnp.min(part, axis=-1, keepdims=True) for part in d]
    high = [jnp.max(part, axis=-1, keepdims=True) for part in d]
    middle = [0.5 * (low[i] + high[i]) for i in range(3)]
    spread = _length([0.5 * (high[i] - low[i]) for i in range(3)])
    first, last = jnp.min(enter, axis=-1, keepdims=True), jnp.max(leave, axis=-1, keepdims=True)
    per_metre, in_cells = 1.0 / (_length(middle) + spread), [part / g.cell for part in middle]

    def advance(
        room_at: Callable[[Sequence[Array]], Array], worth: float, least: Array, times: int, depth: Array
    ) -> Array:
        def step(state: _Places, going: Array) -> tuple[_Places, Array]:
            room = room_at(state.at) - spread * state.depth
            going = going & (room >= worth * spread * state.depth + least) & (state.depth < last)
            return _placed(g, in_cells, jnp.where(going, state.depth + room * per_metre, state.depth)), going

        return _repeat(step, _placed(g, in_cells, depth), depth < last, times).depth

    def finely(at: Sequence[Array]) -> Array:
        return _distance_in(_cells_around(g, at), in_cells, jnp.zeros(()))[0] * (g.cell / PER_CELL)

    least = field_rays.FINER_ROOM * g.cell
    depth = advance(partial(_least_around, g), field_rays.WORTH, g.cell, field_rays.STEPS, first)
    return advance(finely, field_rays.FINER_WORTH, least, field_rays.FINER_STEPS, depth)


def _walk(g: _Lattices, metres: Sequence[Array], depth: Array, enter: Array, leave: Array) -> tuple[Array, list[Array]]:
    """Returns where rays `metres` [N, G, K] end, which begin at `depth`, and the slopes there."""
    d = [part / g.cell for part in metres]
    per_value = (g.cell / PER_CELL) / _length(metres)

    ahead = [jnp.where(part > -TINY, 1.0, 0.0) for part in metres]
    per_d = [safe_inverse(part) * g.cell for part in metres]

    def end_at(depth: Array) -> Array:
        return g.end + g.end_per_depth * depth

    def rest_in(c: _Cells) -> Array:
        """Returns the depth from where rays are to where they leave their cells."""
        x, y, z = ((ahead[i] - c.part[i]) * per_d[i] for i in range(3))
        return jnp.maximum(jnp.minimum(jnp.minimum(jnp.minimum(FAR_M, x), y), z), 0.0)

    def step(state: tuple[_Places, Array], going: Array) -> tuple[tuple[_Places, Array], Array]:
        (depth, at), stride = state
        c = _cells_around(g, at)
        rest = rest_in(c)
        here, there = _distance_in(c, d, jnp.zeros(()))[0], _distance_in(c, d, rest)[0]
        going = going & (here > end_at(depth)) & (there > end_at(depth + rest))
        stride = jnp.where(going, there * per_value, stride)
        depth = jnp.where(going, depth + (rest + stride), depth)
        placed = _placed(g, d, depth)
        # Where a ray ended, it is still in the cell in which that was found.
        kept = [jnp.where(going, new, old) for new, old in zip(placed.at, at, strict=True)]
        return (_Places(depth, kept), stride), going & (depth < leave)

    going = (enter < leave) & (depth < leave)
    (depth, at), stride = _repeat(step, (_placed(g, d, depth), jnp.zeros_like(depth)), going, field_rays.STEPS)
    c = _cells_around(g, at)
    rest = rest_in(c)
    here = _distance_in(c, d, jnp.zeros(()))[0] - end_at(depth)
    there = _distance_in(c, d, rest)[0] - end_at(depth + rest)
    within, beyond = (here > 0) & (there <= 0), here <= 0  # beyond: the last step was too long
    further = jnp.where(within, rest * here / jnp.where(within, here - there, 1.0), 0.0)
    for _ in range(field_rays.REFINED - 1):
        left, slopes = _distance_in(c, d, further)
        fall = slopes[0] * d[0] + slopes[1] * d[1] + slopes[2] * d[2] - g.end_per_depth
        closer = further - (left - end_at(depth + further)) / jnp.minimum(fall, -TINY)
        further = jnp.where(within, jnp.clip(closer, 0.0, rest), further)
        further = jnp.where(beyond & (fall < 0), jnp.clip(closer, -stride, 0.0), further)
    return depth + further, _distance_in(c, d, further)[1]


def _length(vector: Any) -> Array:
    return jnp.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


def _repeat(step: Callable[[State, Array], tuple[State, Array]], state: State, going: Array, times: int) -> State:
    """Returns the state of rays after steps, at most `times`, until none goes on; a step returns it, and which do."""

    def more(carry: tuple[Array, State, Array]) -> tuple[Array, State, Array]:
        return carry[0] + 1, *step(*carry[1:])

    begin = (jnp.zeros((), jnp.int32), state, going)
    return lax.while_loop(lambda carry: jnp.any(carry[2]) & (carry[0] < times), more, begin)[1]
