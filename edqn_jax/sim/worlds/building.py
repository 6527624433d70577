"""Building blocks of random worlds: shapes that may be absent, their colours, floor and volume."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from edqn_jax.sim.scene.scene import (
    FIELDS,
    PARKED,
    Planes,
    Scene,
    Spheres,
    UprightBoxes,
    UprightCylinders,
    no_shapes,
)
from edqn_jax.sim.worlds.free_points import far_apart

Size = tuple[float, float, ArrayLike]
"""Of a flight volume, metres; the height may be drawn."""

GROUND_RGB = (0.37, 0.43, 0.35)
"""Albedo of the ground."""
COLOUR_DRAWS = 5
"""Random numbers that a colour takes."""


def make_boxes(present: Array, position: Array, half: Array, yaw: Array, albedo: Array) -> UprightBoxes:
    """Returns those of N boxes that are `present` [N] bool; the others are parked."""
    return UprightBoxes(
        position=jnp.where(present[:, None], position, PARKED),
        half=jnp.where(present[:, None], half, 0.0),
        yaw=jnp.where(present, yaw, 0.0),
        albedo=albedo,
    )


def make_cylinders(
    present: Array, position: Array, radius: Array, half_height: ArrayLike, albedo: Array
) -> UprightCylinders:
    """Returns those of N upright cylinders that are `present` [N] bool; the others are parked."""
    return UprightCylinders(
        position=jnp.where(present[:, None], position, PARKED),
        radius=jnp.where(present, radius, 0.0),
        half_height=jnp.where(present, half_height, 0.0),
        albedo=albedo,
    )


def make_spheres(present: Array, position: Array, radius: Array, albedo: Array) -> Spheres:
    """Returns those of N spheres that are `present` [N] bool; the others are parked."""
    return Spheres(
        position=jnp.where(present[:, None], position, PARKED),
        radius=jnp.where(present, radius, 0.0),
        albedo=albedo,
    )


def make_ground() -> Planes:
    """Returns level ground at height 0."""
    return Planes(position=jnp.zeros((1, 3)), normal=jnp.array([[0.0, 0.0, 1.0]]), albedo=jnp.array([GROUND_RGB]))


def floor_and_ceiling(height: ArrayLike, albedo: Array) -> Planes:
    """Returns level ground and a ceiling `height` metres above it, of `albedo` [3]."""
    level = jnp.array([0.0, 0.0, 1.0])
    return Planes(
        position=jnp.stack([jnp.zeros(3), height * level]),
        normal=jnp.stack([level, -level]),
        albedo=jnp.stack([jnp.array(GROUND_RGB), albedo]),
    )


def build_scene(
    size: Size,
    ends: Array,
    planes: Planes,
    boxes: UprightBoxes | None = None,
    cylinders: UprightCylinders | None = None,
    spheres: Spheres | None = None,
) -> Scene:
    """Returns a world with these shapes and a free start and goal far apart, from uniform draws `ends` [2, K, 3]."""
    given = {"boxes": boxes, "cylinders": cylinders, "spheres": spheres, "planes": planes}
    shapes = {kind: no_shapes(kind) if given.get(kind) is None else given[kind] for kind in FIELDS}
    scene = Scene(
        **shapes,
        volume=jnp.stack([jnp.zeros(3), jnp.stack([jnp.asarray(side, jnp.float32) for side in size])]),
        start=jnp.zeros(3),
        goal=jnp.zeros(3),
    )
    start, goal = far_apart(scene, ends)
    return dataclasses.replace(scene, start=start, goal=goal)


def scale_uniforms(span: tuple[float | Array, float | Array], uniforms: Array) -> Array:
    """Returns numbers [...] from the first to the second of `span`, from uniform draws [...]."""
    return span[0] + (span[1] - span[0]) * uniforms


def make_albedos(uniforms: Array) -> Array:
    """Returns albedos [N, 3] from uniform draws [N, 5]: greys of all values, about half of them with a tint."""
    grey = 0.15 + 0.7 * uniforms[:, :1]
    tint = 0.5 * uniforms[:, 1:4] - 0.25
    return jnp.clip(grey + jnp.where(uniforms[:, 4:] < 0.5, tint, 0.0), 0.05, 0.95)
