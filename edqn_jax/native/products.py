"""Products of matrices in bfloat16 with sums in float32: mixed precision of the updates of training.

Factors are rounded to the nearest bfloat16, ties to even; parameters, sums and optimisers stay in float32
(Micikevicius et al. 2018). CPUs with AMX take them by `products.c`, several times as fast as in float32, and AMD's with
bfloat16 in AVX-512 twice as fast; elsewhere XLA multiplies the rounded factors, which is slower than not to round them.
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import Array, lax

from edqn_jax.native.build import ensure_registered
from edqn_jax.native.shipped import processor_flags

SOURCE = Path(__file__).with_suffix(".c")

TARGETS = ("edqn_product", "edqn_product_nt", "edqn_product_tn")

LEAST_SIDE = 16
"""Rows, columns and depth that a product has at least for it to be taken in bfloat16: narrower ones wait for memory."""

_ROUNDED = contextvars.ContextVar("products are taken in bfloat16", default=False)


def precision_of(name: str) -> str:
    """Returns the type of factors that `train.products` names; `auto` is bfloat16 where that is faster."""
    if name == "auto":
        return "bfloat16" if is_available() else "float32"
    return name


@contextlib.contextmanager
def in_precision(name: str) -> Iterator[None]:
    """Takes products of layers that are traced within as `train.products` says."""
    token = _ROUNDED.set(precision_of(name) == "bfloat16")
    try:
        yield
    finally:
        _ROUNDED.reset(token)


def are_rounded() -> bool:
    """Returns whether layers that are traced now take their products in bfloat16."""
    return _ROUNDED.get()


def is_available() -> bool:
    """Returns whether this process's CPU, its default backend, multiplies by `products.c`."""
    return jax.default_backend() == "cpu" and _is_faster() and ensure_registered(SOURCE, TARGETS)


@functools.cache
def _is_faster() -> bool:
    return is_faster_on(processor_flags())


def is_faster_on(flags: frozenset[str]) -> bool:
    """Returns whether a processor with these flags multiplies faster in bfloat16 than in float32.

    By AMX, or by AVX-512's dot products of pairs on AMD's processors, which alone have SSE4a: on Intel's, a dot product
    takes as long as the two sums of products in float32.
    """
    return "avx512_bf16" in flags and ({"amx_bf16", "amx_tile"} <= flags or "sse4a" in flags)


@jax.custom_vjp
def rounded_matmul(x: Array, kernel: Array) -> Array:
    """Returns `x @ kernel`, `[..., F]`, of rows `[..., K]` and a kernel `[K, F]`, both rounded to bfloat16."""
    return _multiply(x.reshape(-1, x.shape[-1]), kernel).reshape(*x.shape[:-1], kernel.shape[-1])


def _product(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return rounded_matmul(x, kernel), (x, kernel)


def _product_gradient(kept: tuple[Array, Array], change: Array) -> tuple[Array, Array]:
    x, kernel = kept
    rows, changes = x.reshape(-1, x.shape[-1]), change.reshape(-1, change.shape[-1])
    of_rows = _multiply(changes, kernel, transpose_right=True)
    return of_rows.reshape(x.shape), _multiply(rows, changes, transpose_left=True)


rounded_matmul.defvjp(_product, _product_gradient)


def _multiply(left: Array, right: Array, *, transpose_left: bool = False, transpose_right: bool = False) -> Array:
    """Returns the product [M, N] of two matrices, of which one may be transposed."""
    rows, depth = left.shape[::-1] if transpose_left else left.shape
    columns = right.shape[0 if transpose_right else 1]
    if min(rows, depth, columns) < LEAST_SIDE or not left.dtype == right.dtype == jnp.float32:
        return jnp.matmul(left.T if transpose_left else left, right.T if transpose_right else right)
    if not is_available():
        left, right = (lax.reduce_precision(x, exponent_bits=8, mantissa_bits=7) for x in (left, right))
        return jnp.matmul(left.T if transpose_left else left, right.T if transpose_right else right)
    target = TARGETS[2 if transpose_left else 1 if transpose_right else 0]
    shape = jax.ShapeDtypeStruct((rows, columns), jnp.float32)
    return jax.ffi.ffi_call(target, shape, vmap_method="broadcast_all")(left, right)
