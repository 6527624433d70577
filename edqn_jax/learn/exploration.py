"""Exploration: epsilon-greedy moves, and how epsilon falls (Algorithm 1, step 5)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import AgentConfig, Config
from edqn_jax.learn.learner import Exploration, Metrics
from edqn_jax.learn.qnetwork import Params, network_values


def epsilon_greedy_moves(
    config: Config, params: Params, memory: Array, keys: Array, progress: Exploration
) -> tuple[Array, Metrics]:
    """Returns epsilon-greedy moves [S, E] int32 of a Q-network, and epsilon.

    Args:
        params: of the Q-network.
        memory: [S, E, H, D].
        keys: [S] of the shards, consumed.
        progress: where the run stands.
    """
    epsilon = exploration_rate(config.agent, progress.decisions, progress.total, progress.episodes)
    values = partial(network_values, config.agent, params)
    moves = jax.vmap(lambda m, k, e: epsilon_greedy(values(m), e, k))(memory, keys, epsilon)
    return moves, {"epsilon": jnp.mean(epsilon)}


def epsilon_greedy(q: Array, epsilon: Array, key: Array) -> Array:
    """Chooses the best action of `q` [..., A], or with probability `epsilon` [...] a random one: [...] int32."""
    coin, choice = jax.random.uniform(key, (2, *q.shape[:-1]))
    random = jnp.floor(choice * q.shape[-1])
    return jnp.where(coin < epsilon, random, jnp.argmax(q, axis=-1)).astype(jnp.int32)


def exploration_rate(config: AgentConfig, decisions: Array, total: int, episodes: Array) -> Array:
    """Returns epsilon [...]: random at first, then falling linearly.

    Args:
        decisions: [] decisions of the DQN phase so far, in all environments.
        total: decisions that the phase will have.
        episodes: [...] episodes that each environment has finished in the phase.
    """
    if config.exploration_episodes > 0:
        progress = episodes / config.exploration_episodes
    else:
        span = max(config.exploration_fraction * total, 1.0)
        progress = jnp.full(episodes.shape, (decisions - config.random_decisions) / span)
    progress = jnp.clip(progress, 0.0, 1.0)
    epsilon = config.exploration_start + progress * (config.exploration_end - config.exploration_start)
    return jnp.where(decisions < config.random_decisions, 1.0, epsilon)
