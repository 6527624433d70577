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

STEPS = 256
"""Most steps of a ray, each out of a cell and on by the distance there: along a wall they are short."""

STOPS, CONE = 0.002, 0.00002
"""Shares of a cell and of a depth: a ray so near to a surface has met it. So has one that has used up its steps, which
runs along a surface."""

REFINED = 3
"""Times that the distance is asked for between both ends of the last step of a ray."""

PER_CELL = 1000.0
"""Units to a cell of the distances that rays meet: they are whole numbers of 16 bits, two of which one read takes."""

TOGETHER = 16
"""Neighbouring rays that begin as one."""

BLOCK = 4
"""Cells along each side of the blocks whose least distance is looked at first."""

WORTH = 0.2
"""Share of the width of rays together below which they leave the distances of blocks for those between values."""

FINER_STEPS, FINER_WORTH, FINER_ROOM = 4, 0.1, 0.2
"""Most steps that they then take; share of their width, and of a cell, below which they part."""

FAR_M = 1e30
"""Depth of rays that meet nothing."""

ROUNDED = 1.2e-7
"""Share of a number by which the next smaller one of 32 bits may be smaller."""

NOWHERE = 1e29

SOURCES = {name: Path(__file__).with_name(f"field_rays.{name}") for name in ("c", "cu")}
HEADERS = tuple(Path(__file__).with_name(f"{name}.h") for name in ("field_rays", "field_batch", "wide"))
TARGET = "edqn_field_rays"


def is_available(platform: str) -> bool:
    """Returns whether the library of "cpu" or "cuda" is loaded and registered, which the first call does."""
    return build.ensure_for(platform, SOURCES, (TARGET,), HEADERS)


def meet(table: tuple[np.ndarray, ...], fields: Any, origin: Array, ray: Vector) -> tuple[Array, Array, Array, Array]:
    """Returns depths [N, R, C] and three parts of the normals where rays meet fields.

    Args:
        table: of G grids: all values (`quantized`) and [G] where each grid begins, the least of all blocks and [G]
            where they begin, [G, 3] values along each axis, [G] metres of a cell.
        fields: N of them.
        origin: [3] metres.
        ray: direction of the rays, [R, C] each.
    """
    shape, rays = ray[0].shape, jnp.stack([part.ravel() for part in ray])
    number, count = fields.position.shape[0], rays.shape[1]
    results = tuple(jax.ShapeDtypeStruct((number, *more, count), jnp.float32) for more in ((), (3,)))
    call = jax.ffi.ffi_call(TARGET, results, vmap_method="expand_dims")
    place = fields.position, fields.rotation, fields.half, fields.grid
    given = [jnp.asarray(part, jnp.float32) for part in (*place, origin, rays)]
    depth, normal = call(*table, *given)
    x, y, z = (normal[:, i].reshape(number, *shape) for i in range(3))
    return depth.reshape(number, *shape), x, y, z


def quantized(values: np.ndarray, cell: float) -> np.ndarray:
    """Returns distances [...], metres, in units of `PER_CELL` to a cell: int16 [...], further ones as the furthest."""
    most = np.iinfo(np.int16).max
    return np.clip(np.rint(values * (PER_CELL / cell)), -most, most).astype(np.int16)
