"""Checks inside compiled programs, which only `--debug` makes; otherwise they leave nothing in the program."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jax.experimental import checkify


def check_finite(number: Array, of: str) -> None:
    """Checks that every number [...] is finite; `of` names what it is for the message."""
    checkify.debug_check(jnp.all(jnp.isfinite(number)), f"{of} is not finite")


def check_index(index: Array, below: int | Array, of: str) -> None:
    """Checks that every index [...] is at least 0 and less than `below`; JAX would take the nearest that is.

    Args:
        index: of any shape, whole numbers.
        below: [] or broadcast against `index`.
        of: what is indexed, for the message.
    """
    wrong = (index < 0) | (index >= below)
    first = jnp.ravel(index)[jnp.argmax(wrong)]
    checkify.debug_check(~jnp.any(wrong), f"index {{index}} of {of} is out of bounds", index=first)


def is_finite(tree: object) -> Array:
    """Returns whether every number of a tree's arrays is finite, [] bool; whole numbers are."""
    sums = [jnp.sum(leaf) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.isfinite(sum(sums, jnp.zeros(())))
