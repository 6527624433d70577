"""Frames for the camera in C, and what calls it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import native
from edqn_jax.sim.scene.scene import Scene, stack_scenes
from tests.support.drawn_scenes import GROUND, ball, box, pillar, rotation_of, scene_of

CONFIG = CameraConfig()
ROUNDING = 1e-4
"""Brightness, three times the most that was seen away from ties: compilers contract and order operations otherwise."""

TIES = 1e-3
"""Share of pixels in which faces of two shapes that coincide, as walls of a canyon do, are told apart by rounding; 3e-4
were seen."""


def frames(scenes: list[Scene], count: int, seed: int) -> tuple[Scene, jax.Array, jax.Array]:
    """Frames anywhere in the worlds' volumes, inside of shapes as well: scenes, origins and rotations [count, ...]."""
    rng = np.random.default_rng(seed)
    pool = stack_scenes(scenes)
    scene = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[rng.integers(0, len(scenes), count)]), pool)
    low, high = np.asarray(scene.volume[:, 0]), np.asarray(scene.volume[:, 1])
    origin = low + (high - low) * rng.random((count, 3))
    rotation = np.stack([rotation_of(0, 0, yaw) for yaw in rng.uniform(-np.pi, np.pi, count)])
    return scene, jnp.asarray(origin, jnp.float32), jnp.asarray(rotation, jnp.float32)


@partial(jax.jit, static_argnums=(0, 1))
def in_c(call: Callable, config: CameraConfig, scene: Scene, origin: jax.Array, rotation: jax.Array, weights):
    """`call` is what calls C, of which a program holds one."""
    pictures = native.render_luma(config, scene, origin, rotation, weights)
    return pictures, native.render_depth(config, scene, origin, rotation)


def crowd(rng: np.random.Generator) -> Scene:
    places = rng.uniform([0, 0, 0], [60, 60, 12], (30, 3))
    sizes = rng.uniform(0.3, 4, (30, 3))
    return scene_of(
        GROUND,
        *(box(x, y, z, a, b, c, x) for (x, y, z), (a, b, c) in zip(places[:14], sizes, strict=False)),
        *(pillar(x, y, z, a, b) for (x, y, z), (a, b, _) in zip(places[14:24], sizes[14:], strict=False)),
        *(ball(x, y, z, a) for (x, y, z), (a, _, _) in zip(places[24:], sizes[24:], strict=True)),
    )
