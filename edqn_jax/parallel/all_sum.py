"""Sums over the devices of a mesh axis."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from edqn_jax.parallel.c_library import registered

Tree = TypeVar("Tree")

SOURCE = Path(__file__).with_suffix(".c")


def all_sum(tree: Tree, axis: str | None, after: Any) -> Tree:
    """Returns the sum of float32 and int32 arrays over the devices that share the work, if there are any.

    Devices meet in the same order everywhere: that of the sums, if each is given something of the one before. On CPUs
    of one process it is ours (`all_sum.c`), where it is at hand; else XLA's, which keeps to an order by itself. Both
    add in the order of the devices.

    Args:
        axis: name of the mesh axis, None for one device.
        after: a result of the sum before this one, [] float32 or 0.0; it is not read.
    """
    if axis is None:
        return tree
    leaves, form = jax.tree.flatten(tree)
    count = lax.axis_size(axis)
    if count == 1 or jax.default_backend() != "cpu" or jax.process_count() > 1 or not _is_at_hand():
        return lax.psum(tree, axis)
    shapes = [jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype) for leaf in leaves]
    call = jax.ffi.ffi_call("edqn_all_sum", shapes, vmap_method="broadcast_all")
    first = jnp.asarray(after, jnp.float32)
    return jax.tree.unflatten(form, call(lax.axis_index(axis), jnp.int32(count), first, *leaves))


def _is_at_hand() -> bool:
    return registered(SOURCE, ("edqn_all_sum",))
