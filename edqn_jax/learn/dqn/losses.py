"""Deep Q-learning: Eq. 7-10 of the paper, and the published refinements that the configuration may switch on.

Functions are for one transition, named as the literature does: `q` values, `a` action, `r` return.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import optax
from jax import Array

from edqn_jax.checks import check_index
from edqn_jax.config import AgentConfig
from edqn_jax.learn.qnetwork import Params, q_values
from edqn_jax.learn.replay import Batch


def value_of(q: Array, a: Array) -> Array:
    """Returns Q(s, a) [] of `q` [A].

    A sum over a mask: on a GPU, picking one number of each row takes longer than all products of the network.
    """
    return jnp.sum(jnp.where(jnp.arange(q.shape[-1]) == a, q, 0.0))


def td_target(returns: Array, discount: Array, q_next: Array, q_select: Array) -> Array:
    """Returns Eq. 7 and 10, y = r + gamma max_a Q(s', a) (1 - done), or its n-step and double forms.

    Args:
        returns: [] r, or the discounted sum of n rewards.
        discount: [] gamma (or gamma^n), 0 when the transition ended the episode: (1 - done) of Eq. 10.
        q_next: [A] target network at s'.
        q_select: [A] values that choose the action: `q_next` itself, or the online network's (double DQN,
            van Hasselt et al. 2016).

    >>> q_next = jnp.array([3.0, 1.0])
    >>> print(td_target(jnp.array(1.0), jnp.array(0.5), q_next, q_next))
    2.5
    >>> print(td_target(jnp.array(1.0), jnp.array(0.5), q_next, jnp.array([0.0, 1.0])))  # double: the other one chooses
    1.5
    """
    chex.assert_rank([returns, discount, q_next, q_select], [0, 0, 1, 1])
    return returns + discount * value_of(q_next, jnp.argmax(q_select))


def td_loss(q: Array, a: Array, y: Array, huber_delta: float) -> Array:
    """Returns Eq. 9, half the squared TD error; beyond `huber_delta` > 0 it grows linearly.

    Args:
        q: [A] online network at s. a: [] action taken. y: [] target, held constant.
    """
    chex.assert_rank([q, a, y], [1, 0, 0])
    error = jax.lax.stop_gradient(y) - value_of(q, a)
    if huber_delta <= 0:
        return 0.5 * error**2
    return optax.losses.huber_loss(error, delta=huber_delta)


def batch_loss(config: AgentConfig, params: Params, target_params: Params, actions: int, batch: Batch):
    """Returns the sum of Eq. 9 over a batch, and what goes with it.

    Returns:
        loss: [] summed over the samples; (count, mean_q): [] samples and sum of Q(s, a).
    """
    check_index(batch.action, actions, "the moves")
    q = q_values(config, params, actions, batch.history)
    q_next = q_values(config, target_params, actions, batch.next_history)
    q_select = q_values(config, params, actions, batch.next_history) if config.double else q_next
    returns = config.reward_scale * batch.returns
    y = jax.vmap(td_target)(returns, batch.discount, q_next, q_select)
    losses = jax.vmap(lambda q, a, y: td_loss(q, a, y, config.huber_delta))(q, batch.action, y)
    taken = jax.vmap(value_of)(q, batch.action)
    return jnp.sum(batch.weight * losses), (jnp.sum(batch.weight), jnp.sum(batch.weight * taken))
