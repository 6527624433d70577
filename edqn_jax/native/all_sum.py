"""Sums over the devices of a mesh axis."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from edqn_jax.native.build import ensure_registered

Tree = TypeVar("Tree")

SOURCE = Path(__file__).with_suffix(".c")


def all_sum(tree: Tree, axis: str | None, after: Any) -> Tree:
    """Returns the sums of arrays over the devices of a mesh axis.

    On CPUs of one process with a C compiler, `all_sum.c` adds arrays of float32 and int32, elsewhere and otherwise XLA.
    All devices must take the sums of a program in the same order. XLA keeps one for its own sums, and for those in C
    because each is given a result of the one before, `after`.

    Args:
        axis: name of the mesh axis, None for one device.
        after: a result of the sum before this one, [] float32 or 0.0; it is not read.
    """
    if axis is None:
        return tree
    leaves, form = jax.tree.flatten(tree)
    count = lax.axis_size(axis)
    plain = all(leaf.dtype in (jnp.float32, jnp.int32) for leaf in leaves)
    if count == 1 or not plain or jax.default_backend() != "cpu" or jax.process_count() > 1 or not is_available():
        return lax.psum(tree, axis)
    shapes = [jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype) for leaf in leaves]
    call = jax.ffi.ffi_call("edqn_all_sum", shapes, vmap_method="broadcast_all")
    first = jnp.asarray(after, jnp.float32)
    return jax.tree.unflatten(form, call(lax.axis_index(axis), jnp.int32(count), first, *leaves))


def is_available() -> bool:
    """Returns whether the library is loaded and registered, which the first call does."""
    return ensure_registered(SOURCE, ("edqn_all_sum",))
