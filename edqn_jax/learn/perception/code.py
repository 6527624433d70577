"""The code of the VAE: its distribution given an encoder's last hidden layer, and the divergence from its prior."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jax.nn.initializers import constant, lecun_normal, zeros

from edqn_jax.learn.perception.layers import Dense

Params = Any
"""Nested dictionaries of arrays."""

EVENT_CHANNELS = 2
"""ON and OFF events."""


class Form(enum.Enum):
    """Form of what the VAE reads."""

    EVENTS = enum.auto()
    """An event field."""
    PICTURE = enum.auto()
    """Pictures, an array [..., C, H, W] of order 1."""


MAX_LOG_VARIANCE = 6.0
"""Bound of the log-variance's magnitude: its exponential cannot overflow."""

MAX_MEAN = 1e3
"""Bound of a code value's magnitude: its square cannot overflow."""


class CodeHead(nn.Module):
    """Mean and log-variance of the code, each a linear layer."""

    size: int
    mean_init: Callable[..., Array] = lecun_normal()

    @nn.compact
    def __call__(self, z: Array) -> tuple[Array, Array]:
        """Returns mean and log-variance, each `[..., size]`, of the last hidden layer `[..., Z]`."""
        mean = Dense(self.size, kernel_init=self.mean_init, name="mean")(z)
        # Nearly noiseless codes at first; the KL term increases the variance.
        log_variance = Dense(self.size, kernel_init=zeros, bias_init=constant(-4.0), name="log_variance")(z)
        return jnp.clip(mean, -MAX_MEAN, MAX_MEAN), jnp.clip(log_variance, -MAX_LOG_VARIANCE, MAX_LOG_VARIANCE)


def kl_divergence(mean: Array, log_variance: Array) -> Array:
    """Returns KL(N(mean, variance) || N(0, 1)), summed over the code: `[..., code_size]` to `[...]`."""
    return 0.5 * jnp.sum(jnp.square(mean) + jnp.exp(log_variance) - 1.0 - log_variance, axis=-1)
