"""Pictures of a level camera, image column by image column.

Under a level camera an upright shape fills one interval of rows in each column that it covers, and few shapes
cover any one column: two on average in a world of thirty, seldom more than eight. So the work is laid out by
columns, not by frames: all columns of all frames of a batch are sorted by how many shapes cover them, and
blocks of them are drawn with as many slots as the fullest of the block needs.

M frames, C columns of H pixels in each, Q = M x C; N upright shapes; B columns in a block, K slots.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.flatten_util import ravel_pytree
from jax.interpreters import batching, mlir

from edqn_jax.config import CameraConfig
from edqn_jax.sim import coverage, raycast
from edqn_jax.sim.coverage import Layers
from edqn_jax.sim.raycast import Rays, Values
from edqn_jax.sim.scene import Scene, UprightBoxes, UprightCylinders, no_shapes
from edqn_jax.sim.xla import materialised

SLOTS = (0, 2, 4, 8)
"""Shapes that the kinds of blocks have room for; fuller columns take one shape after another."""

BLOCKS = 32
"""Blocks that a batch is cut into."""

SMALLEST_BLOCK = 256
"""Columns that a block has at least: below, starting its operations costs more than what it saves."""

WORD = 32
"""Shapes whose presence one integer holds, a bit each."""


@struct.dataclass
class Frame:
    """What all columns of a frame share."""

    origin: Array  # [3] metres
    heading: Array  # [2] cosine and sine
    scene: Scene  # without the upright boxes and cylinders
    value: Values
    sky: Array  # []


@dataclasses.dataclass(frozen=True)
class _Rows:
    """Frames as rows of numbers, so that one is read at once."""

    rows: Array  # [M, ...]
    frame: Callable[[Array], Frame]  # of one row

    @classmethod
    def of(cls, frames: Frame) -> _Rows:
        _, frame = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape[1:]), frames))
        return cls(materialised(jax.vmap(lambda one: ravel_pytree(one)[0])(frames)), frame)

    def take(self, numbers: Array) -> Frame:
        """The frames of these numbers, [B, ...]."""
        return jax.vmap(self.frame)(self.rows.at[numbers].get(mode="promise_in_bounds"))


Finish = Callable[[CameraConfig, Frame, Rays, Layers], Array]
"""Blends the layers of [H, 1] pixels over what lies behind them."""


def picture(
    config: CameraConfig, finish: Finish, scene: Scene, origin: Array, rotation: Array, weights: Array
) -> Array:
    """One frame, [H, W], of a scene from origin [3] and rotation [3, 3] under weights [3] of RGB.

    However it is mapped, all frames end up in one batch: only together can columns be sorted.

    Args:
        finish: a function of a module, not one made anew: what is compiled is kept by it.
    """
    leaves, tree = jax.tree.flatten((scene, origin, rotation, weights))
    return _pictures_p.bind(*(leaf[None] for leaf in leaves), config=config, finish=finish, tree=tree)[0]


# A primitive, so that the pictures are traced once, where a program is lowered, and not at every `vmap` on the way
# there (docs/decisions/0011). Its arguments are the leaves of `_pictures`, its rule of mapping a reshape.
_pictures_p = Primitive("pictures")


def _from_leaves(*leaves: Array, config: CameraConfig, finish: Finish, tree: Any) -> Array:
    return _pictures(config, finish, *jax.tree.unflatten(tree, leaves))


def _shape(*leaves: Any, config: CameraConfig, finish: Finish, tree: Any) -> ShapedArray:
    return ShapedArray((leaves[0].shape[0], config.height, config.width), np.dtype(np.float32))


def _map(leaves: Sequence[Array], axes: Sequence[int | None], **how: Any) -> tuple[Array, int]:
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)

    def merged(leaf: Array, axis: int | None) -> Array:
        whole = jnp.broadcast_to(leaf, (size, *leaf.shape)) if axis is None else jnp.moveaxis(leaf, axis, 0)
        return whole.reshape(whole.shape[0] * whole.shape[1], *whole.shape[2:])

    frames = _pictures_p.bind(*(merged(*each) for each in zip(leaves, axes, strict=True)), **how)
    return frames.reshape(size, -1, *frames.shape[1:]), 0


_pictures_p.def_abstract_eval(_shape)
_pictures_p.def_impl(jax.jit(_from_leaves, static_argnames=("config", "finish", "tree")))
batching.primitive_batchers[_pictures_p] = _map
mlir.register_lowering(_pictures_p, mlir.lower_fun(_from_leaves, multiple_results=False))


def _pictures(
    config: CameraConfig, finish: Finish, scene: Scene, origin: Array, rotation: Array, weights: Array
) -> Array:
    """Brightness [M, H, W]; every argument has a leading [M]."""
    ways, way = ways_to_draw(config, scene, origin, rotation, weights)

    # Sorted by the way they need, in blocks of which each takes the way of its last, the fullest.
    count, width = origin.shape[0], config.width
    size = count * width
    block = max(SMALLEST_BLOCK, -(-size // BLOCKS))
    blocks = -(-size // block)
    numbers = jnp.arange(size, dtype=jnp.int32)
    order = jnp.sort(way * size + numbers) % size
    padded = jnp.concatenate([order, jnp.broadcast_to(order[-1], (blocks * block - size,))])
    drawn = lax.map(
        lambda which: lax.switch(way[which[-1]], [partial(draw, config, finish) for draw in ways], which),
        padded.reshape(blocks, block),
    )
    place = jnp.zeros(size, jnp.int32).at[order].set(numbers, unique_indices=True)
    found = drawn.reshape(-1, config.height).at[place].get(mode="promise_in_bounds")
    return materialised(found.reshape(count, width, config.height).swapaxes(1, 2))


def ways_to_draw(
    config: CameraConfig, scene: Scene, origin: Array, rotation: Array, weights: Array
) -> tuple[list[Callable[[CameraConfig, Finish, Array], Array]], Array]:
    """Ways to draw columns numbered [B], brightness [B, H] each, and which of them each column needs: [Q].

    A way can do what those before it can. Every argument has a leading [M].
    """
    frames, tables = materialised(jax.vmap(partial(_frame, config))(scene, origin, rotation, weights))
    words = jax.vmap(partial(_presence, config))(tables)
    return _ways(config, frames, tables, words)


def _frame(config: CameraConfig, scene: Scene, origin: Array, rotation: Array, weights: Array) -> tuple[Frame, Array]:
    """One frame, and the table [N + 1, F] of its upright shapes."""
    value = raycast.albedo_values(scene, weights)
    forward_x, forward_y = rotation[0, 0], rotation[1, 0]
    heading = jnp.stack([forward_x, forward_y]) * lax.rsqrt(jnp.maximum(forward_x**2 + forward_y**2, raycast.TINY))
    rest = dataclasses.replace(scene, boxes=no_shapes(UprightBoxes), cylinders=no_shapes(UprightCylinders))
    frame = Frame(
        origin=origin, heading=heading, scene=rest, value=value, sky=jnp.sum(jnp.asarray(config.sky_rgb) * weights)
    )
    return frame, coverage.upright_table(config, scene, origin, heading, value)


def _presence(config: CameraConfig, table: Array) -> Array:
    """Which shapes of a frame's table cover each column, a bit each: [words, C]."""
    u, pitch = raycast.columns_of(config)[None], raycast.pitch_of(config)
    left, right = table[:-1, 0, None], table[:-1, 1, None]
    covers = (jnp.minimum(u + pitch / 2, right) > jnp.maximum(u - pitch / 2, left)).astype(jnp.uint32)
    shifts = jnp.arange(covers.shape[0], dtype=jnp.uint32) % WORD
    bits = jnp.left_shift(covers, shifts[:, None])
    words = [jnp.sum(bits[first : first + WORD], axis=0, dtype=jnp.uint32) for first in range(0, len(bits), WORD)]
    return jnp.stack(words) if words else jnp.zeros((1, config.width), jnp.uint32)


def _ways(
    config: CameraConfig, frames: Frame, tables: Array, words: Array
) -> tuple[list[Callable[[CameraConfig, Finish, Array], Array]], Array]:
    """`ways_to_draw`, of frames that are laid out."""
    shapes, spheres = tables.shape[1] - 1, frames.scene.spheres.radius.shape[1]
    room = [n for n in SLOTS if n < shapes] + ([shapes] if shapes <= SLOTS[-1] else [])
    held = jnp.sum(lax.population_count(words), axis=1)
    needed = jnp.sum(jnp.stack([held > n for n in room]), axis=0, dtype=jnp.int32)
    draw = partial(_draw, _Rows.of(frames), tables, words)
    ways = [partial(draw, n, spheres > 0 and n == room[-1]) for n in room]
    if spheres:
        seen = jax.vmap(partial(coverage.spheres_in_columns, config))(
            frames.scene.spheres, frames.origin, frames.heading
        )
        needed = jnp.where(seen, jnp.maximum(needed, len(room) - 1), needed)
    if shapes > room[-1]:
        ways.append(partial(draw, None, True))
    return ways, needed.reshape(-1)


def _draw(
    frames: _Rows,
    tables: Array,
    words: Array,
    slots: int | None,
    spheres: bool,
    config: CameraConfig,
    finish: Finish,
    which: Array,
) -> Array:
    """Brightness [B, H] of the columns numbered `which` [B].

    Args:
        slots: upright shapes that there is room for in each column; None has room for any number.
        spheres: whether spheres can be seen.
    """
    number, column = which // config.width, which % config.width
    frame = frames.take(number)
    u = raycast.columns_of(config)[column]
    held = [words[:, w].at[number, column].get(mode="promise_in_bounds") for w in range(words.shape[1])]
    none = tables.shape[1] - 1
    rows = tables.reshape(-1, tables.shape[-1])

    def take(held: list[Array], count: int) -> tuple[list[Array], Array]:
        picks = []
        for _ in range(count):
            pick, held = _take_one(held, none)
            picks.append(pick)
        index = jnp.stack(picks)
        picked = rows.at[number[None] * (none + 1) + index].get(mode="promise_in_bounds")
        boxes = frame.value.boxes.shape[1]
        mixed = index >= boxes if boxes < none else None
        return held, coverage.sides(config, picked, mixed, boxes, frame.heading, u)

    def begin(frame: Frame, u: Array, depth: int) -> Layers:
        layers = coverage.no_layers((config.height, 1), depth)
        many, rays = _rays(config, frame, u, config.samples_across, config.samples_down), _rays(config, frame, u)
        for surfaces in raycast.other_surfaces(config, frame.scene, frame.origin, many, frame.value):
            layers = coverage.counted_layers(surfaces, many, layers)
        if spheres:
            layers = coverage.sphere_layers(config, frame.scene, frame.origin, rays, frame.value, layers)
        return layers

    def end(frame: Frame, u: Array, layers: Layers) -> Array:
        return finish(config, frame, _rays(config, frame, u), layers)[:, 0]

    others = sum(getattr(frame.value, kind).shape[1] for kind in ("tilted_boxes", "capsules", "tilted_cylinders"))
    others += frame.value.spheres.shape[1] if spheres else 0
    if slots is None:
        layers = jax.vmap(lambda f, u: begin(f, u, coverage.DEPTH_OF_LAYERS))(frame, u)

        def one_more(carry):
            held, columns = take(carry[0], 1)
            return held, jax.vmap(partial(coverage.insert_sides, config))(carry[1], columns)

        _, layers = lax.while_loop(lambda carry: jnp.any(jnp.stack(carry[0]) != 0), one_more, (held, layers))
        return jax.vmap(end)(frame, u, layers)

    def one(frame: Frame, u: Array, columns: Array | None) -> Array:
        layers = begin(frame, u, min(slots + others, coverage.DEPTH_OF_LAYERS))
        if columns is not None:
            layers = coverage.insert_sides(config, layers, columns)
        return end(frame, u, layers)

    return jax.vmap(one)(frame, u, take(held, slots)[1] if slots else None)


def _rays(config: CameraConfig, frame: Frame, u: Array, across: int = 1, down: int = 1) -> Rays:
    """Rays of the column at `u` []."""
    return raycast.column_rays(config, frame.heading, u, across, down)


def _take_one(words: list[Array], none: int) -> tuple[Array, list[Array]]:
    """The first shape [B] of each column (`none` where there is none), and `words` [B] without it."""
    index, left, searching = jnp.full(words[0].shape, none), [], jnp.ones(words[0].shape, bool)
    for first, word in zip(range(0, WORD * len(words), WORD), words, strict=True):
        here = searching & (word != 0)
        lowest = lax.population_count((word & (~word + 1)) - 1).astype(jnp.int32)
        index = jnp.where(here, first + lowest, index)
        left.append(jnp.where(here, word & (word - 1), word))
        searching = searching & ~here
    return index, left
