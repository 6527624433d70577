"""Checks inside compiled programs, which only `--debug` makes, and of trees of arrays while they are traced.

Neither leaves anything in the program otherwise.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax
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
    numbers = [jnp.ravel(leaf) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    if not numbers:
        return jnp.bool_(True)
    # One sum, and not a compiled operation for each array, into which XLA would take this apart.
    return jnp.isfinite(jnp.sum(lax.optimization_barrier(jnp.concatenate(numbers)) if len(numbers) > 1 else numbers[0]))


def tree_form(tree: object) -> str:
    """Returns what a tree is made of, in words: types and shapes of its arrays, and how they are held together."""
    leaves, structure = jax.tree.flatten(tree)
    text = str(structure).removeprefix("PyTreeDef(").removesuffix(")")
    for leaf in leaves:
        array = leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf)
        text = text.replace("*", f"{array.dtype}{list(array.shape)}", 1)
    return text


def first_difference(before: object, after: object) -> str | None:
    """Returns where types, shapes or the structure of two trees first differ, in words; None where they do not."""
    old, new = (
        {jax.tree_util.keystr(path): tree_form(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
        for tree in (before, after)
    )
    for path in old | new:
        if old.get(path) != new.get(path):
            return f"{path or 'it'} is {new.get(path, 'missing')}, not {old.get(path, 'missing')}"
    if jax.tree.structure(before) != jax.tree.structure(after):
        return f"the parts are held in {type(after).__name__}, not {type(before).__name__}"
    return None
