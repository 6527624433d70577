"""Cast shadows: what the sun does not reach, because a shape is in the way, has the ambient light alone.

From the point that a layer shows in a pixel's middle one ray goes towards the sun. So edges of shadows are whole
pixels, where silhouettes are shares of a pixel (`coverage.py`).

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
from edqn_jax.sim.scene.shapes.kind import Vector
from edqn_jax.sim.scene.surface import Daylight

CLEAR_M = 0.01
"""Metres from a point within which nothing casts a shadow on it: rounding, and the tolerance with which rays meet
fields, put points of a surface millimetres before or behind it, and a ray must not meet what it begins on."""

CONVEX = ("boxes", "cylinders", "spheres", "tilted_boxes", "capsules", "tilted_cylinders")
"""Kinds whose shapes are not asked about their own points: the sun reaches whatever of them faces it. At silhouettes
the points of pixels that are partly covered lie beside them, where they would be in their own way."""


def ambient_of(light: Daylight, value: Values, shape: Array) -> Array:
    """Returns the brightness without sun of the shapes of these numbers [...], as floats: ambient share x albedo."""
    albedo = jnp.concatenate([value[kind] for kind in first_numbers(value)])
    return light.ambient * albedo.at[shape.astype(jnp.int32)].get(mode="clip")


def in_shadow(
    scene: Scene, light: Daylight, value: Values, origin: Array, rays: Rays, depth: Array, shape: Array
) -> Array:
    """Returns which points the sun does not reach: bool [K, H, W].

    Args:
        scene: one world with all that casts shadows.
        value: albedo of its shapes.
        origin: [3] metres.
        rays: through the middles of pixels.
        depth: [K, H, W] metres along the rays, finite.
        shape: [K, H, W] number of the shape that is there, as floats.
    """
    points = jnp.stack([origin[i] + depth * part for i, part in enumerate((rays.dx, rays.dy, rays.dz))], axis=-1)
    sun: Any = tuple(jnp.reshape(jnp.asarray(light.sun)[i], (1, 1, 1)) for i in range(3))
    first, dark = first_numbers(value), jnp.zeros(shape.size, bool)
    for kind, shapes in scene.shapes().items():
        if shapes.position.shape[0]:
            one_more = partial(_with_one_more, kind, sun, points.reshape(-1, 3), shape.ravel())
            numbers = first[kind] + jnp.arange(shapes.position.shape[0], dtype=jnp.float32)
            # One shape after another: a reduction over shapes takes several times as long on a CPU.
            dark = lax.scan(one_more, dark, (shapes, numbers))[0]
    return dark.reshape(shape.shape)


def _with_one_more(
    kind: str, sun: Vector, points: Array, own: Array, dark: Array, one: tuple[Any, Array]
) -> tuple[Array, None]:
    """Returns which points [P, 3] of shapes `own` [P] are in the dark [P], with one more shape, of that number."""
    shape, number = one
    alone = jax.tree.map(lambda leaf: leaf[None], shape)
    met = jax.vmap(lambda point: SHAPES.get(kind).meet(alone, point, sun))(points)
    stops = (met.hit & (met.depth > CLEAR_M))[:, 0, 0, 0]
    return dark | (stops & (own != number) if kind in CONVEX else stops), None
