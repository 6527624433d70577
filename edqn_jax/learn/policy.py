"""The policy that flies: an encoder, a Q-network and the memory that stacks observations."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn import embedding
from edqn_jax.learn.dqn import epsilon_greedy
from edqn_jax.learn.qnetwork import Params, q_values
from edqn_jax.sim.env import ACTIONS, OWN_SIZE, Observation

Memory = Array
"""[H, D] the newest observations as the network sees them, newest last; zeros before an episode began."""


@struct.dataclass
class PolicyParams:
    """All that a policy knows."""

    encoder: Params  # {} where nothing is encoded
    q: Params


def observation_size(config: Config) -> int:
    """D: what is seen and the own state."""
    return embedding.size(config) + OWN_SIZE


def empty_memory(config: Config) -> Memory:
    """The memory at the beginning of an episode."""
    return jnp.zeros((config.agent.history, observation_size(config)))


def remember(memory: Memory, flat: Array) -> Memory:
    """The memory [..., H, D] with a new observation [..., D] at its end."""
    return jnp.concatenate([memory[..., 1:, :], flat[..., None, :]], axis=-2)


def flatten(config: Config, params: Params, observation: Observation) -> Array:
    """[..., D] what is seen, by default as a code, and own state of observations [...]."""
    seen = embedding.embed(config, params, observation.sensed)
    return observation.own if seen is None else jnp.concatenate([seen, observation.own], axis=-1)


def act(
    config: Config,
    params: PolicyParams,
    memory: Memory,
    observation: Observation,
    key: Array,
    epsilon: float = 0.0,
) -> tuple[Array, Memory]:
    """The move [] int32 for one observation, and the memory with that observation in it."""
    memory = remember(memory, flatten(config, params.encoder, observation))
    q = q_values(config.agent, params.q, len(ACTIONS), memory)
    action = epsilon_greedy(q, jnp.float32(epsilon), key) if epsilon else jnp.argmax(q).astype(jnp.int32)
    return action, memory
