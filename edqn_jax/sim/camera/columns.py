"""Pictures of a level camera, drawn image column by image column.

Under a level camera an upright shape fills one interval of rows in each column that it covers, and few shapes
cover any one column: two on average in a world of thirty, seldom more than eight. So columns are the unit of work,
not frames: all columns of all frames of a batch are sorted by the number of shapes that cover them and cut into
blocks. Each block is drawn by one of a few branches, each with slots for a fixed number of shapes: the smallest
branch that is large enough for all columns of the block. Draw branches are ordered by capacity. A batch that is too
small to be cut is drawn by the last branch.

M frames, C columns of H pixels in each, Q = M x C; N upright shapes; B columns in a block.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import coverage, raycast
from edqn_jax.sim.camera.coverage import Layers
from edqn_jax.sim.camera.raycast import Rays, Values
from edqn_jax.sim.camera.surfaces import surfaces_at_eye
from edqn_jax.sim.scene.scene import Scene, no_shapes
from edqn_jax.sim.scene.shapes.kind import TINY
from edqn_jax.sim.scene.surface import Surface
from edqn_jax.xla import materialise_tree

SLOTS = (0, 2, 4, 8)
"""Capacities of the branches, upright shapes per column; columns with more are drawn in a loop over their shapes."""

BLOCKS = 32
"""Number of blocks that a batch is cut into, if they are large enough."""

SMALLEST_BLOCK = 256
"""Least number of columns in a block: below, starting a block's operations costs more than sorting saves."""

EXACT = (*raycast.UPRIGHT, "spheres", "planes")
"""Kinds of shape whose part of a pixel is known; whatever other kinds are registered is counted by rays."""

WORD = 32
"""Shapes whose presence one integer holds, a bit each."""


@struct.dataclass
class Frame:
    """Values that all columns of a frame share."""

    origin: Array  # [3] metres
    heading: Array  # [2] cosine and sine
    scene: Scene  # without the upright boxes and cylinders, unless these cast shadows
    value: Values
    sky: Array  # []
    surfaces: Surface | None  # of all shapes (`surfaces.surfaces_at_eye`)


@dataclasses.dataclass(frozen=True)
class _Rows:
    """Frames as rows of numbers, so that one gather reads all of a frame."""

    rows: Array  # [M, ...]
    frame: Callable[[Array], Frame]  # of one row

    @classmethod
    def of(cls, frames: Frame) -> _Rows:
        _, frame = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape[1:]), frames))
        return cls(materialise_tree(jax.vmap(lambda one: ravel_pytree(one)[0])(frames)), frame)

    def take(self, numbers: Array) -> Frame:
        """Returns the frames of these numbers, [B, ...]."""
        return jax.vmap(self.frame)(self.rows.at[numbers].get(mode="promise_in_bounds"))


def has_numbers(config: CameraConfig, surfaces: Surface | None) -> bool:
    """Returns whether layers say which shape they show: where shapes have surfaces of their own, or cast shadows."""
    return surfaces is not None or config.shadows


Finish = Callable[[CameraConfig, Frame, Rays, Layers], Array]
"""Blends the layers of [H, 1] pixels over what lies behind them."""

Branch = Callable[[CameraConfig, Finish, Array], Array]
"""Draws the columns numbered [B] of a batch: brightness [B, H]."""


def render_columns(
    config: CameraConfig, finish: Finish, scene: Scene, origin: Array, rotation: Array, weights: Array
) -> Array:
    """Returns brightness [M, H, W] of scenes from origin [3], metres, and rotation [3, 3] under weights [3] of RGB.

    Every array has a leading [M]. All frames must come in one batch: only together can their columns be sorted.
    """
    branches, branch = render_branches(config, scene, origin, rotation, weights)

    # Sorted by the branch that they need, in blocks; each block takes the branch of its last column, the fullest.
    count, width = origin.shape[0], config.width
    size = count * width
    block = max(SMALLEST_BLOCK, -(-size // BLOCKS))
    blocks = -(-size // block)
    numbers = jnp.arange(size, dtype=jnp.int32)
    if blocks == 1:
        # There is nothing to sort, and the last branch alone compiles several times faster than all of them.
        drawn = branches[-1](config, finish, numbers)
        return materialise_tree(drawn.reshape(count, width, config.height).swapaxes(1, 2))
    order = jnp.sort(branch * size + numbers) % size
    padded = jnp.concatenate([order, jnp.broadcast_to(order[-1], (blocks * block - size,))])
    drawn = lax.map(
        lambda which: lax.switch(branch[which[-1]], [partial(draw, config, finish) for draw in branches], which),
        padded.reshape(blocks, block),
    )
    place = jnp.zeros(size, jnp.int32).at[order].set(numbers, unique_indices=True)
    unsorted = drawn.reshape(-1, config.height).at[place].get(mode="promise_in_bounds")
    return materialise_tree(unsorted.reshape(count, width, config.height).swapaxes(1, 2))


def render_branches(
    config: CameraConfig, scene: Scene, origin: Array, rotation: Array, weights: Array
) -> tuple[list[Branch], Array]:
    """Returns the branches, ordered by capacity, and [Q] the index of the first that suffices for each column.

    Every array has a leading [M]; origins are in metres.
    """
    frames, tables = materialise_tree(jax.vmap(partial(_frame, config))(scene, origin, rotation, weights))
    words = jax.vmap(partial(_presence, config))(tables)
    return _branches(config, frames, tables, words)


def _frame(config: CameraConfig, scene: Scene, origin: Array, rotation: Array, weights: Array) -> tuple[Frame, Array]:
    """Returns one frame, and the table [N + 1, F] of its upright shapes."""
    value = raycast.albedo_values(scene, weights)
    forward_x, forward_y = rotation[0, 0], rotation[1, 0]
    heading = jnp.stack([forward_x, forward_y]) * lax.rsqrt(jnp.maximum(forward_x**2 + forward_y**2, TINY))
    rest = scene if config.shadows else scene.with_shapes({kind: no_shapes(kind) for kind in raycast.UPRIGHT})
    frame = Frame(
        origin=origin,
        heading=heading,
        scene=rest,
        value=value,
        sky=jnp.sum(jnp.asarray(raycast.daylight_of(config, scene.daylight).sky) * weights),
        surfaces=surfaces_at_eye(scene, raycast.first_numbers(value), origin),
    )
    return frame, coverage.upright_table(config, scene, origin, heading, value)


def _presence(config: CameraConfig, table: Array) -> Array:
    """Returns which shapes of a frame's table cover each column, a bit each: [words, C]."""
    u, pitch = raycast.columns_of(config)[None], raycast.pitch_of(config)
    left, right = table[:-1, 0, None], table[:-1, 1, None]
    covers = (jnp.minimum(u + pitch / 2, right) > jnp.maximum(u - pitch / 2, left)).astype(jnp.uint32)
    shifts = jnp.arange(covers.shape[0], dtype=jnp.uint32) % WORD
    bits = jnp.left_shift(covers, shifts[:, None])
    words = [jnp.sum(bits[first : first + WORD], axis=0, dtype=jnp.uint32) for first in range(0, len(bits), WORD)]
    return jnp.stack(words) if words else jnp.zeros((1, config.width), jnp.uint32)


def _branches(config: CameraConfig, frames: Frame, tables: Array, words: Array) -> tuple[list[Branch], Array]:
    """Returns `render_branches` of frames, their tables [M, N + 1, F] and the presence words [M, words, C]."""
    shapes, spheres = tables.shape[1] - 1, frames.scene.spheres.radius.shape[1]
    capacities = [n for n in SLOTS if n < shapes] + ([shapes] if shapes <= SLOTS[-1] else [])
    present = jnp.sum(lax.population_count(words), axis=1)
    needed = jnp.sum(jnp.stack([present > n for n in capacities]), axis=0, dtype=jnp.int32)
    batch = _Batch(_Rows.of(frames), tables, words)
    branches: list[Branch] = [partial(_render, batch, n, spheres > 0 and n == capacities[-1]) for n in capacities]
    if spheres:
        seen = jax.vmap(partial(coverage.spheres_in_columns, config))(
            frames.scene.spheres, frames.origin, frames.heading
        )
        needed = jnp.where(seen, jnp.maximum(needed, len(capacities) - 1), needed)
    if shapes > capacities[-1]:
        branches.append(partial(_render, batch, None, True))
    return branches, needed.reshape(-1)


@dataclasses.dataclass(frozen=True)
class _Batch:
    """Arrays that every branch reads."""

    frames: _Rows
    tables: Array  # [M, N + 1, F] upright shapes, and last one that covers nothing
    words: Array  # [M, words, C] presence


@dataclasses.dataclass(frozen=True)
class _Columns:
    """The columns of a block. B columns."""

    number: Array  # [B] int32, of the frame
    frame: Frame  # [B, ...]
    u: Array  # [B] position across the image, see `raycast.columns_of`
    words: list[Array]  # each [B], presence


def _render(
    batch: _Batch, slots: int | None, spheres: bool, config: CameraConfig, finish: Finish, which: Array
) -> Array:
    """Returns brightness [B, H] of the columns numbered `which` [B].

    Args:
        slots: capacity: upright shapes of a column that are drawn; None draws any number of them.
        spheres: whether spheres are drawn.
    """
    columns = _take_columns(config, batch, which)
    if slots is None:
        return _render_any_number(config, finish, batch, columns, spheres)
    return _render_in_slots(config, finish, batch, columns, slots, spheres)


def _take_columns(config: CameraConfig, batch: _Batch, which: Array) -> _Columns:
    number, column = which // config.width, which % config.width
    frame = batch.frames.take(number)
    u = raycast.columns_of(config)[column]
    words = [batch.words[:, w].at[number, column].get(mode="promise_in_bounds") for w in range(batch.words.shape[1])]
    return _Columns(number, frame, u, words)


def _render_in_slots(
    config: CameraConfig, finish: Finish, batch: _Batch, columns: _Columns, slots: int, spheres: bool
) -> Array:
    """Returns brightness [B, H] of columns that at most `slots` upright shapes cover."""
    depth = min(slots + _other_shapes(columns.frame, spheres), coverage.DEPTH_OF_LAYERS)

    def one(frame: Frame, u: Array, sides: Array | None) -> Array:
        layers = _layers_of_others(config, frame, u, depth, spheres)
        if sides is not None:
            layers = coverage.insert_sides(config, layers, sides)
        return _blend(config, finish, frame, u, layers)

    sides = _take_sides(config, batch, columns, columns.words, slots)[1] if slots else None
    return jax.vmap(one)(columns.frame, columns.u, sides)


def _render_any_number(config: CameraConfig, finish: Finish, batch: _Batch, columns: _Columns, spheres: bool) -> Array:
    """Returns brightness [B, H] of columns that any number of upright shapes cover, one shape after another."""
    layers = jax.vmap(lambda f, u: _layers_of_others(config, f, u, coverage.DEPTH_OF_LAYERS, spheres))(
        columns.frame, columns.u
    )

    def one_more(carry: tuple[list[Array], Layers]) -> tuple[list[Array], Layers]:
        words, sides = _take_sides(config, batch, columns, carry[0], 1)
        return words, jax.vmap(partial(coverage.insert_sides, config))(carry[1], sides)

    _, layers = lax.while_loop(lambda carry: jnp.any(jnp.stack(carry[0]) != 0), one_more, (columns.words, layers))
    return jax.vmap(partial(_blend, config, finish))(columns.frame, columns.u, layers)


def _other_shapes(frame: Frame, spheres: bool) -> int:
    """Returns the number of shapes that are not upright; spheres count only where they are drawn."""
    without = EXACT if not spheres else tuple(kind for kind in EXACT if kind != "spheres")
    return sum(value.shape[1] for kind, value in frame.value.items() if kind not in without)


def _layers_of_others(config: CameraConfig, frame: Frame, u: Array, depth: int, spheres: bool) -> Layers:
    """Returns the `depth` nearest layers of one column, [H, 1] pixels, of all but the upright shapes."""
    layers = coverage.no_layers((config.height, 1), depth, numbered=has_numbers(config, frame.surfaces))
    light, first = raycast.daylight_of(config, frame.scene.daylight), raycast.first_numbers(frame.value)
    many, rays = _rays(config, frame, u, config.samples_across, config.samples_down), _rays(config, frame, u)
    for kind, met in raycast.hits(frame.scene, frame.origin, many, without=EXACT).items():
        bright = raycast.brightness_of(light, met, frame.value[kind])
        layers = coverage.add_sampled_layers(met, bright, first[kind], many, layers, kind in coverage.SLOPED)
    if spheres:
        layers = coverage.sphere_layers(config, frame.scene, frame.origin, rays, frame.value, layers)
    return layers


def _take_sides(
    config: CameraConfig, batch: _Batch, columns: _Columns, words: list[Array], count: int
) -> tuple[list[Array], Array]:
    """Returns the presence words without the first `count` shapes of each column, and the sides of these shapes."""
    picks = []
    none = batch.tables.shape[1] - 1
    for _ in range(count):
        pick, words = _take_one(words, none)
        picks.append(pick)
    index = jnp.stack(picks)
    rows = batch.tables.reshape(-1, batch.tables.shape[-1])
    picked = rows.at[columns.number[None] * (none + 1) + index].get(mode="promise_in_bounds")
    boxes = columns.frame.value["boxes"].shape[1]
    mixed = index >= boxes if boxes < none else None
    own, numbers = columns.frame.scene.daylight, index if has_numbers(config, columns.frame.surfaces) else None
    light = own if own is None else dataclasses.replace(own, sun=jnp.moveaxis(own.sun, -1, 0))
    light = raycast.daylight_of(config, light)
    return words, coverage.column_sides(config, light, picked, mixed, boxes, columns.frame.heading, columns.u, numbers)


def _take_one(words: list[Array], none: int) -> tuple[Array, list[Array]]:
    """Returns the first shape [B] of each column (`none` where there is none), and the words [B] without it."""
    index, left, searching = jnp.full(words[0].shape, none), [], jnp.ones(words[0].shape, bool)
    for first, word in zip(range(0, WORD * len(words), WORD), words, strict=True):
        here = searching & (word != 0)
        lowest = lax.population_count((word & (~word + 1)) - 1).astype(jnp.int32)
        index = jnp.where(here, first + lowest, index)
        left.append(jnp.where(here, word & (word - 1), word))
        searching = searching & ~here
    return index, left


def _blend(config: CameraConfig, finish: Finish, frame: Frame, u: Array, layers: Layers) -> Array:
    """Returns brightness [H] of one column."""
    return finish(config, frame, _rays(config, frame, u), layers)[:, 0]


def _rays(config: CameraConfig, frame: Frame, u: Array, across: int = 1, down: int = 1) -> Rays:
    """Returns the rays of the column at `u` []."""
    return raycast.column_rays(config, frame.heading, u, across, down)
