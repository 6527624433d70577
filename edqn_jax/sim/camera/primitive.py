"""A JAX primitive that draws pictures in one batch, however often `vmap` maps them.

It is traced once, where a program is lowered; `jax.custom_batching.custom_vmap` traces again at every `vmap`
(docs/decisions/0011). M pictures of H x W pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

Static = tuple[Hashable, ...]


def render_in_one_batch(
    render: Callable[..., Array],
    static: Static,
    arguments: tuple[Any, ...],
    shape: tuple[int, int],
    natively: Callable[..., Array | None],
) -> Array:
    """Returns one picture, [H, W] float32; all pictures that it is mapped to are drawn by one call of `render`.

    Args:
        render: `render(*static, *arguments)` returns pictures [M, H, W] of arguments with a leading [M]. A function of
            a module, not one made for the call: compiled programs are cached by its identity.
        static: arguments that are known when tracing.
        arguments: pytrees of arrays, of one picture.
        shape: H, W.
        natively: `natively(platform, *static, *arguments)` draws where the program is compiled for "cpu" or "cuda", of
            arguments with leading [L] (see `_pictures_p`); or returns None if it cannot, and `render` does.
    """
    leaves, tree = jax.tree.flatten(arguments)
    parameters = {"render": render, "static": static, "tree": tree, "shape": shape, "natively": natively}
    return _pictures_p.bind(*(leaf[None] for leaf in leaves), **parameters)[0]


_pictures_p = Primitive("pictures")
"""Its operands are the leaves of the arguments, each with a leading [L]; its result is [M, H, W].

M is the largest L, and a multiple of every other: where frames share a world, one row of it serves M / L pictures in a
row.
"""


def _render(*leaves: Array, render: Callable[..., Array], static: Static, tree: Any, **_: Any) -> Array:
    count = most_rows(leaves)
    return render(
        *static, *jax.tree.unflatten(tree, [jnp.repeat(leaf, count // leaf.shape[0], axis=0) for leaf in leaves])
    )


def _render_natively(
    platform: str,
    *leaves: Array,
    render: Callable[..., Array],
    natively: Callable[..., Array | None],
    static: Static,
    tree: Any,
    **_: Any,
) -> Array:
    found = natively(platform, *static, *jax.tree.unflatten(tree, leaves))
    return _render(*leaves, render=render, static=static, tree=tree) if found is None else found


def most_rows(leaves: Sequence[Any]) -> int:
    """Returns M of arrays with a leading [L]."""
    return max(leaf.shape[0] for leaf in leaves)


def _abstract(*leaves: Any, shape: tuple[int, int], **_: Any) -> ShapedArray:
    return ShapedArray((most_rows(leaves), *shape), np.dtype(np.float32))


def _batch(leaves: Sequence[Array], axes: Sequence[int | None], **parameters: Any) -> tuple[Array, int]:
    """Merges a mapped axis into the leading [M]: the rule for `vmap`."""
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)

    def merged(leaf: Array, axis: int | None) -> Array:
        if axis is None and leaf.shape[0] == 1:
            return leaf
        mapped = jnp.broadcast_to(leaf, (size, *leaf.shape)) if axis is None else jnp.moveaxis(leaf, axis, 0)
        return mapped.reshape(mapped.shape[0] * mapped.shape[1], *mapped.shape[2:])

    pictures = _pictures_p.bind(*(merged(*each) for each in zip(leaves, axes, strict=True)), **parameters)
    return pictures.reshape(size, -1, *pictures.shape[1:]), 0


_pictures_p.def_abstract_eval(_abstract)
_pictures_p.def_impl(jax.jit(_pictures_p.bind, static_argnames=("render", "static", "tree", "shape", "natively")))
batching.primitive_batchers[_pictures_p] = _batch
mlir.register_lowering(_pictures_p, mlir.lower_fun(_render, multiple_results=False))
for _platform in ("cpu", "cuda"):
    _lowering = mlir.lower_fun(partial(_render_natively, _platform), multiple_results=False)
    mlir.register_lowering(_pictures_p, _lowering, platform=_platform)
