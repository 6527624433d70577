"""Linear layers whose gradients cost what their products do.

XLA turns the gradient of a kernel that many rows share into a product of transposed copies, and that of a bias into a
sum that a CPU takes slowly. Both are written as plain products here: on CPU cores a VAE update takes seven tenths of
the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jax.nn.initializers import lecun_normal, zeros

from edqn_jax.errors import ConfigError
from edqn_jax.native.products import are_rounded, rounded_matmul
from edqn_jax.user_code import check_takes, describe_object

ROWS_OF_A_PART = 16_384
"""Rows that a part of a kernel's gradient sums over: a GPU takes several parts at once. Where the rows do not divide
into as many parts, there are fewer, longer ones."""


class Dense(nn.Module):
    """A linear layer with the parameters of `flax.linen.Dense`."""

    features: int
    use_bias: bool = True
    kernel_init: Callable[..., Any] = lecun_normal()
    bias_init: Callable[..., Any] = zeros
    many_rows: bool = True
    """Whether its gradients are written as products; else they are JAX's own, of any order."""

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Returns `[..., features]` of `[..., K]`."""
        y = matmul(x, self.param("kernel", self.kernel_init, (x.shape[-1], self.features)), many_rows=self.many_rows)
        if not self.use_bias:
            return y
        bias = self.param("bias", self.bias_init, (self.features,))
        return add_shared(y, bias) if self.many_rows else y + bias


class Weights(nn.Module):
    """The parameters of a linear layer `Dense`, for those who multiply by several at once."""

    features: int
    use_bias: bool = True

    @nn.compact
    def __call__(self, inputs: int) -> list[Array]:
        """Returns kernel `[K, F]`, and bias `[F]` if there is one, for K inputs."""
        kernel = self.param("kernel", lecun_normal(), (inputs, self.features))
        return [kernel, self.param("bias", zeros, (self.features,))] if self.use_bias else [kernel]


def init_params(module: Any, name: str, key: Array, **inputs: Any) -> Any:
    """Returns fresh parameters of a module for such inputs, which are given by their place.

    Args:
        name: of the module, for messages.

    Raises:
        ConfigError: if it is no module, takes other inputs, or has variables of other kinds.
    """
    if not isinstance(module, nn.Module):
        raise ConfigError(f"{name} must be a flax module, and what makes it returned {describe_object(module)}")
    check_takes(module, ", ".join(inputs), f"`__call__` of {name}")
    variables = module.init(key, *inputs.values())
    if set(variables) != {"params"}:
        others = ", ".join(sorted(set(variables) - {"params"}))
        raise ConfigError(f"{name} must have parameters{f' alone, not {others}' if others else ''}")
    return variables["params"]


def matmul(x: Array, kernel: Array, *, many_rows: bool = True) -> Array:
    """Returns `x @ kernel`, `[..., F]`, of rows `[..., K]` and a kernel `[K, F]`, as `in_precision` has them."""
    if are_rounded():
        return rounded_matmul(x, kernel)
    return shared_matmul(x, kernel) if many_rows else x @ kernel


@jax.custom_vjp
def shared_matmul(x: Array, kernel: Array) -> Array:
    """Returns `x @ kernel`, `[..., F]`, of rows `[..., K]` and a kernel `[K, F]` that all of them share."""
    return x @ kernel


def _product(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return shared_matmul(x, kernel), (x, kernel)


def _product_gradient(kept: tuple[Array, Array], change: Array) -> tuple[Array, Array]:
    x, kernel = kept
    rows = math.prod(x.shape[:-1])
    groups = math.gcd(rows, max(1, rows // ROWS_OF_A_PART))
    parts = jnp.einsum("gmk,gmf->gkf", x.reshape(groups, -1, x.shape[-1]), change.reshape(groups, -1, change.shape[-1]))
    return change @ kernel.T, jnp.sum(parts, axis=0)


@jax.custom_vjp
def add_shared(x: Array, shared: Array) -> Array:
    """Returns `x + shared`, `[..., *S]`, of rows `[..., *S]` and one array `[*S]` that is added to all of them."""
    return x + shared.reshape((1,) * (x.ndim - shared.ndim) + shared.shape)


def _added(x: Array, shared: Array) -> tuple[Array, Array]:
    return add_shared(x, shared), shared


def _added_gradient(shared: Array, change: Array) -> tuple[Array, Array]:
    rows = change.reshape(-1, math.prod(shared.shape))
    return change, (jnp.ones(rows.shape[0]) @ rows).reshape(shared.shape)


@jax.custom_vjp
def add_to_each(rows: Array, one: Array) -> Array:
    """Returns `rows + one`, `[..., N, F]`, of rows `[..., N, F]` and what is added to each N of them, `[..., F]`."""
    return rows + one[..., None, :]


def _added_to_each(rows: Array, one: Array) -> tuple[Array, None]:
    return add_to_each(rows, one), None


def _added_to_each_gradient(_: None, change: Array) -> tuple[Array, Array]:
    ones = jnp.ones((*change.shape[:-2], 1, change.shape[-2]), change.dtype)
    return change, (ones @ change)[..., 0, :]


shared_matmul.defvjp(_product, _product_gradient)
add_shared.defvjp(_added, _added_gradient)
add_to_each.defvjp(_added_to_each, _added_to_each_gradient)
