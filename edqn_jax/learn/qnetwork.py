"""The Q-network: stacked observations in, one value per move out."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import AgentConfig
from edqn_jax.sim.actions import ACTIONS

Params = Any
"""A plain pytree of parameters."""


class QNetwork(nn.Module):
    """ReLU layers, optionally normalised, and one value per action, optionally as dueling heads."""

    config: AgentConfig
    actions: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Returns values [..., actions] of stacked observations `x` [..., history * observation]."""
        for width in self.config.hidden:
            x = nn.Dense(width)(x)
            if self.config.layer_norm:
                x = nn.LayerNorm()(x)
            x = nn.relu(x)
        if not self.config.dueling:
            return nn.Dense(self.actions)(x)
        # Q = V + A - mean A (Wang et al. 2016, Eq. 9), both heads in one product.
        heads = nn.Dense(self.actions + 1)(x)
        advantage = heads[..., 1:]
        return heads[..., :1] + advantage - jnp.mean(advantage, axis=-1, keepdims=True)


def init_q(config: AgentConfig, observation_size: int, actions: int, key: Array) -> Params:
    """Returns fresh parameters."""
    inputs = jnp.zeros(config.history * observation_size)
    return QNetwork(config, actions).init(key, inputs)["params"]


def q_values(config: AgentConfig, params: Params, actions: int, history: Array) -> Array:
    """Returns values [..., actions] of observation histories [..., history, observation], newest last."""
    flat = history.reshape(*history.shape[:-2], -1)
    return QNetwork(config, actions).apply({"params": params}, flat)  # type: ignore[return-value]


def network_values(config: AgentConfig, params: Params, memory: Array) -> Array:
    """Returns the values [..., 27] of the drone's moves for memories [..., H, D]."""
    return q_values(config, params, len(ACTIONS), memory)


def greedy_moves(config: AgentConfig, params: Params, memory: Array) -> Array:
    """Returns the best moves [...] int32 for memories [..., H, D]."""
    return jnp.argmax(network_values(config, params, memory), axis=-1).astype(jnp.int32)
