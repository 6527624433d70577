"""Rays through fields in C, on GPUs in CUDA, where there is a compiler; elsewhere `field.py` has the same in JAX."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.native import build
from edqn_jax.sim.scene.shapes.kind import Vector

STEPS = 64
"""Most steps of a ray, each as long as the distance where it begins: along a wall they are short."""

STOPS, CONE = 0.03, 0.0005
"""Shares of a cell and of a depth: a ray nearer to a surface has met it. So has one that has used up its steps,
which runs along a surface."""

TOGETHER = 8
"""Neighbouring rays that begin as one."""

BLOCK = 4
"""Cells along each side of the blocks whose least distance is looked at first."""

WORTH = 0.2
"""Share of the width of rays together below which they part."""

FAR_M = 1e30
"""Depth of rays that meet nothing."""

NOWHERE = 1e29

SOURCES = {name: Path(__file__).with_name(f"field_rays.{name}") for name in ("h", "c", "cu")}
TARGET = "edqn_field_rays"


def is_available(platform: str) -> bool:
    """Returns whether the library of "cpu" or "cuda" is loaded and registered, which the first call does."""
    return build.ensure_for(platform, SOURCES, (TARGET,), (SOURCES["h"],))


def meet(table: tuple[np.ndarray, ...], fields: Any, origin: Array, ray: Vector) -> tuple[Array, Array, Array, Array]:
    """Returns depths [N, R, C] and three parts of the normals where rays meet fields.

    Args:
        table: of G grids: all values and [G] where each grid begins, the least of all blocks and [G] where they begin,
            [G, 3] values along each axis, [G] metres of a cell.
        fields: N of them.
        origin: [3] metres.
        ray: direction of the rays, [R, C] each.
    """
    shape, rays = ray[0].shape, jnp.stack([part.ravel() for part in ray], axis=-1)
    number, count = fields.position.shape[0], rays.shape[0]
    results = tuple(jax.ShapeDtypeStruct((number, count, *more), jnp.float32) for more in ((), (3,)))
    call = jax.ffi.ffi_call(TARGET, results, vmap_method="expand_dims")
    place = fields.position, fields.rotation, fields.half, fields.grid
    given = [jnp.asarray(part, jnp.float32) for part in (*place, origin, rays)]
    depth, normal = call(*table, *given)
    depth, normal = depth.reshape(number, *shape), normal.reshape(number, *shape, 3)
    return depth, normal[..., 0], normal[..., 1], normal[..., 2]
