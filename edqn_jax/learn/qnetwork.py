"""The Q-network: stacked observations in, one value per move out; `agent.network` may name one of your own.

Also the optimiser that its learners share.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax import Array

from edqn_jax.config import NETWORKS, AgentConfig
from edqn_jax.errors import ConfigError
from edqn_jax.learn.perception.layers import Dense, init_params
from edqn_jax.native.adam import Adam
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
            x = Dense(width, many_rows=False)(x)
            if self.config.layer_norm:
                x = nn.LayerNorm()(x)
            x = nn.relu(x)
        if not self.config.dueling:
            return Dense(self.actions, many_rows=False)(x)
        # Q = V + A - mean A (Wang et al. 2016, Eq. 9), both heads in one product.
        heads = Dense(self.actions + 1, many_rows=False)(x)
        advantage = heads[..., 1:]
        return heads[..., :1] + advantage - jnp.mean(advantage, axis=-1, keepdims=True)


def network_of(config: AgentConfig, actions: int) -> nn.Module:
    """Returns the network that `agent.network` names.

    Raises:
        ConfigError: if there is none of that name.
    """
    return NETWORKS.get(config.network)(config, actions)


def init_q(config: AgentConfig, observation_size: int, actions: int, key: Array) -> Params:
    """Returns fresh parameters.

    Raises:
        ConfigError: if the network does not map `[history * observation_size]` to `[actions]`, or has other variables.
    """
    inputs, network = jnp.zeros(config.history * observation_size), network_of(config, actions)
    params = init_params(network, f"the network '{config.network}'", key, x=inputs)
    values = jax.eval_shape(network.apply, {"params": params}, inputs)
    if jnp.shape(values) != (actions,):
        raise ConfigError(
            f"the network '{config.network}' must return [{actions}] values for [{inputs.size}] inputs, not "
            f"{list(jnp.shape(values))}"
        )
    return params


def q_values(config: AgentConfig, params: Params, actions: int, history: Array) -> Array:
    """Returns values [..., actions] of observation histories [..., history, observation], newest last."""
    flat = history.reshape(*history.shape[:-2], -1)
    return network_of(config, actions).apply({"params": params}, flat)  # type: ignore[return-value]


def network_values(config: AgentConfig, params: Params, memory: Array) -> Array:
    """Returns the values [..., 27] of the drone's moves for memories [..., H, D]."""
    return q_values(config, params, len(ACTIONS), memory)


def greedy_moves(config: AgentConfig, params: Params, memory: Array) -> Array:
    """Returns the best moves [...] int32 for memories [..., H, D]."""
    return jnp.argmax(network_values(config, params, memory), axis=-1).astype(jnp.int32)


def make_optimiser(config: AgentConfig, updates: int) -> Adam:
    """Returns Adam with a clipped global norm and a step size that falls linearly over `updates`."""
    rate = optax.linear_schedule(config.learning_rate, config.final_learning_rate, max(updates, 1))
    return Adam(rate, config.max_gradient_norm)
