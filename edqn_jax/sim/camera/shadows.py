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


def ambient_of(light: Daylight, value: Values, shape: Array) -> Array:
    """Returns the brightness without sun of the shapes of these numbers [...], as floats: ambient share x albedo."""
    albedo = jnp.concatenate([value[kind] for kind in first_numbers(value)])
    return light.ambient * albedo.at[shape.astype(jnp.int32)].get(mode="clip")


def in_shadow(scene: Scene, light: Daylight, origin: Array, rays: Rays, depth: Array) -> Array:
    """Returns which points the sun does not reach: bool [K, H, W].

    Args:
        scene: one world with all that casts shadows.
        origin: [3] metres.
        rays: through the middles of pixels.
        depth: [K, H, W] metres along the rays, finite.
    """
    points = jnp.stack([origin[i] + depth * part for i, part in enumerate((rays.dx, rays.dy, rays.dz))], axis=-1)
    sun: Any = tuple(jnp.reshape(jnp.asarray(light.sun)[i], (1, 1, 1)) for i in range(3))
    dark = jnp.zeros(depth.size, bool)
    for kind, shapes in scene.shapes().items():
        if shapes.position.shape[0]:
            # One shape after another: a reduction over shapes takes several times as long on a CPU.
            dark = lax.scan(partial(_with_one_more, kind, sun, points.reshape(-1, 3)), dark, shapes)[0]
    return dark.reshape(depth.shape)


def _with_one_more(kind: str, sun: Vector, points: Array, dark: Array, shape: Any) -> tuple[Array, None]:
    """Returns which points [P, 3] are in the dark [P], with one more shape."""
    alone = jax.tree.map(lambda leaf: leaf[None], shape)
    met = jax.vmap(lambda point: SHAPES.get(kind).meet(alone, point, sun))(points)
    return dark | (met.hit & (met.depth > CLEAR_M))[:, 0, 0, 0], None
