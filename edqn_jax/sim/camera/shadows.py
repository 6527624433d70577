"""Cast shadows: what the sun does not reach, because a shape is in the way, has the ambient light alone.

From the point that a layer shows in a pixel's middle one ray goes towards the sun. So edges of shadows are whole
pixels, where silhouettes are shares of a pixel (`coverage.py`). Where shapes touch, that point may lie within another
shape than the one that is shown. So another shape keeps the sun off if the ray leaves it, and the shape that is shown
only if the ray enters it: else the sun would shine along the foot of a wall in the dark. The price: beside a lit shape
that another touches, some points are dark that lie within it by the width of a pixel.

K layers of H x W pixels, N shapes of a kind.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from edqn_jax.config import SHAPES
from edqn_jax.sim.camera.raycast import Rays, Values, first_numbers
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.surface import Daylight

CLEAR_M = 0.01
"""Metres from a point within which nothing casts a shadow on it: rounding, and the tolerance with which rays meet
fields, put points of a surface millimetres before or behind it, and a ray must not meet what it begins on."""


def ambient_of(light: Daylight, value: Values, shape: Array) -> Array:
    """Returns the brightness without sun of the shapes of these numbers [...], as floats: ambient share x albedo."""
    albedo = jnp.concatenate([value[kind] for kind in first_numbers(value)])
    return light.ambient * albedo.at[shape.astype(jnp.int32)].get(mode="clip")


def in_shadow(
    scene: Scene, light: Daylight, origin: Array, rays: Rays, depth: Array, shape: Array, first: dict[str, int]
) -> Array:
    """Returns which points the sun does not reach: bool [K, H, W].

    Args:
        scene: one world with all that casts shadows.
        origin: [3] metres.
        rays: through the middles of pixels.
        depth: [K, H, W] metres along the rays, finite.
        shape: [K, H, W] number of the shape that is shown.
        first: number of the first shape of each kind (`raycast.first_numbers`).
    """
    points = jnp.stack([origin[i] + depth * part for i, part in enumerate((rays.dx, rays.dy, rays.dz))], axis=-1)
    sun = jnp.asarray(light.sun)
    points, shown, dark = points.reshape(-1, 3), shape.ravel().astype(jnp.int32), jnp.zeros(depth.size, bool)
    for kind, shapes in scene.shapes().items():
        if count := shapes.position.shape[0]:
            # One shape after another: a reduction over shapes takes several times as long on a CPU.
            numbered = first[kind] + jnp.arange(count), shapes
            dark = lax.scan(partial(_with_one_more, kind, sun, points, shown), dark, numbered)[0]
    return dark.reshape(depth.shape)


def _with_one_more(
    kind: str, sun: Array, points: Array, shown: Array, dark: Array, numbered: tuple[Array, Any]
) -> tuple[Array, None]:
    """Returns which points [P, 3] of shapes `shown` [P] are in the dark [P], with one more shape and its number."""
    number, shape = numbered
    known = SHAPES.get(kind)
    alone = jax.tree.map(lambda leaf: leaf[None], shape)

    def meet(point: Array, way: Array) -> tuple[Array, Array]:
        met = known.meet(alone, point, tuple(part.reshape(1, 1, 1) for part in way))  # type: ignore[arg-type]
        return met.hit.reshape(()), met.depth.reshape(())

    if known.reach is None:
        hit, depth = jax.vmap(meet, (0, None))(points, sun)
        return dark | (hit & (depth > CLEAR_M)), None
    # A ray leaves a shape where one that comes back from beyond it enters.
    beyond = jnp.linalg.norm(points - shape.position, axis=1) + jnp.linalg.norm(known.reach(shape)) + CLEAR_M
    itself = shown == number
    begin = jnp.where(itself, 0.0, beyond)
    hit, depth = jax.vmap(meet)(points + begin[:, None] * sun, jnp.where(itself[:, None], sun, -sun))
    return dark | (hit & jnp.where(itself, depth > CLEAR_M, depth < beyond - CLEAR_M)), None
