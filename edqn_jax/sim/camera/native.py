"""Cameras in C and CUDA, level ones and those on the body.

Where there is a C compiler, or on GPUs CUDA's, they are drawn by `pictures.c` and `pictures.cu`; everywhere else by the
same functions in JAX (`columns.py`, `depth.py`). All agree to rounding (`tests/sim/camera/test_native.py`). C knows the
kinds of shape of `OPERANDS` and fields, CUDA the former: scenes with any other, one's own included, are drawn in JAX.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import CameraConfig
from edqn_jax.native import build
from edqn_jax.sim.camera import raycast
from edqn_jax.sim.camera.primitive import most_rows
from edqn_jax.sim.camera.texture import WAVES
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.shapes import field_rays
from edqn_jax.sim.scene.shapes.field import table_for_rays
from edqn_jax.sim.scene.surface import SURFACE_NUMBERS

SOURCES = {name: Path(__file__).with_name(f"pictures.{name}") for name in ("h", "c", "cu")}
HEADERS = (
    SOURCES["h"],
    *(Path(__file__).with_name(f"{name}.h") for name in ("constants", "patterns", "shadows", "tilted", "fields")),
    *field_rays.HEADERS,
)

OPERANDS = {
    "boxes": ("position", "half", "yaw", "albedo"),
    "cylinders": ("position", "radius", "half_height", "albedo"),
    "spheres": ("position", "radius", "albedo"),
    "planes": ("position", "normal", "albedo"),
}
"""Kinds of shape that the library draws, and what it reads of each. A scene with room for any other is drawn by JAX."""

FIELDS = "fields"
"""The kind that C draws as well, after the others (`fields.h`), where no shadows are cast, and CUDA does not."""

FIELD_OPERANDS = ("position", "rotation", "half", "grid", "albedo")
"""What C reads of each field, beside their grids and surfaces."""

MOST_PLANES = 8
"""A scene with more is drawn by JAX."""

TARGETS = ("edqn_pictures", "edqn_depths", "edqn_tilted_pictures", "edqn_tilted_depths")

NOWHERE = 1e29
"""Depths beyond this, in metres, are those of rays that meet nothing."""


def can_render(scene: Scene, platform: str, shadows: bool = False) -> bool:
    """Returns whether the library of "cpu" or "cuda" is at hand and draws such pictures; known when tracing.

    Args:
        scene: with any leading axis.
        platform: the library's.
        shadows: whether shadows are cast.
    """
    leaves = [*_shapes(scene), *_leaves(scene.others.get(FIELDS), FIELD_OPERANDS)]
    known = not kinds_for_jax(scene, platform, shadows) and all(leaf.dtype == jnp.float32 for leaf in leaves)
    return known and is_available(platform)


def kinds_for_jax(scene: Scene, platform: str = "cpu", shadows: bool = False) -> list[str]:
    """Returns the kinds of shape because of which JAX draws a scene, or a pool; none if C, or CUDA, can draw it."""
    counts = {kind: shapes.position.shape[-2] for kind, shapes in scene.shapes().items()}
    drawn = (*OPERANDS, FIELDS) if platform == "cpu" and not shadows else OPERANDS
    most = dict.fromkeys(drawn, math.inf) | {"planes": MOST_PLANES}
    return [kind for kind, count in counts.items() if count > most.get(kind, 0)]


def render_luma(config: CameraConfig, scene: Scene, origin: Array, rotation: Array, weights: Array) -> Array:
    """Returns brightness [M, H, W] as `columns.render_columns` does; leading [L] as in `primitive`.

    Origins are in metres.
    """
    return _call(_target("pictures", config), config, scene, origin, rotation, weights)


def render_depth(config: CameraConfig, scene: Scene, origin: Array, rotation: Array) -> Array:
    """Returns the depth [M, H, W] metres along the middle ray of each pixel, inf where there is nothing.

    As `depth.nearest_depth` does; arrays have a leading [L], see `primitive`.
    """
    found = _call(_target("depths", config), config, scene, origin, rotation)
    return jnp.where(found > NOWHERE, jnp.inf, found)


def _target(drawn: str, config: CameraConfig) -> str:
    return f"edqn_{drawn}" if config.mount == "level" else f"edqn_tilted_{drawn}"


def _call(target: str, config: CameraConfig, scene: Scene, *frames: Array) -> Array:
    u, v = raycast.image_plane(config, 1, 1)
    waves = np.array(
        [[*np.divide(w.direction, config.texture_period_m * w.octave), w.weight] for w in WAVES], np.float32
    )
    drawn = config.mount == "body", config.samples_across, config.samples_down, config.shadows
    constants = np.array([raycast.pitch_of(config), config.texture_contrast, *drawn], np.float32)
    shapes, fields = _shapes(scene), _fields(scene)
    origin, rotation, *weights = frames
    looks = [_daylight(config, scene), *(_surfaces(getattr(scene, kind)) for kind in OPERANDS)] if weights else []
    count = most_rows([*shapes, *_leaves(scene.others.get(FIELDS), FIELD_OPERANDS), *frames])
    shape = jax.ShapeDtypeStruct((count, config.height, config.width), jnp.float32)
    call = jax.ffi.ffi_call(target, shape)
    return call(constants, u, v, waves, origin, rotation, *shapes, *looks, *weights, *fields)


def _leaves(shapes: Any, names: tuple[str, ...]) -> list[Array]:
    return [] if shapes is None else [getattr(shapes, name) for name in names]


def _shapes(scene: Scene) -> list[Array]:
    return [leaf for kind, names in OPERANDS.items() for leaf in _leaves(getattr(scene, kind), names)]


def _fields(scene: Scene) -> list[Array | np.ndarray]:
    """Returns the operands of fields, those of the enum in `fields.h`; none where there are no fields."""
    fields = scene.others.get(FIELDS)
    if fields is None or not fields.position.shape[-2]:
        return []
    surfaces = _surfaces(fields)
    if fields.surface is None:  # blank beside others that have some
        surfaces = np.zeros((1, fields.position.shape[-2], SURFACE_NUMBERS), np.float32)
    return [*table_for_rays(fields), *_leaves(fields, FIELD_OPERANDS), surfaces]


def _daylight(config: CameraConfig, scene: Scene) -> Array | np.ndarray:
    """Returns the light of each world: ambient share, direction of the sun, RGB of the sky: [L, 7]."""
    light = scene.daylight
    if light is None:
        return np.array([[config.ambient, *raycast.sun_direction(config), *config.sky_rgb]], np.float32)
    return jnp.concatenate([light.ambient[:, None], light.sun, light.sky], axis=1)


def _surfaces(shapes: Any) -> Array | np.ndarray:
    """Returns the surfaces of shapes [L, N, SURFACE_NUMBERS]; N is 0 where they carry the plaid."""
    surface = shapes.surface
    return np.zeros((1, 0, SURFACE_NUMBERS), np.float32) if surface is None else surface.numbers


def is_available(platform: str) -> bool:
    """Returns whether the library of "cpu" or "cuda" is loaded and registered, which the first call does."""
    return build.ensure_for(platform, SOURCES, TARGETS, HEADERS)
