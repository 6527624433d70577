"""Replay: every observation stored once, in time order, one ring per logical shard.

Our own sixty lines rather than a library's: writes are one contiguous row of all environments, starts that
would cross an episode's end or the ring's seam are masked, and shards sample for themselves, so that the
layout on devices changes nothing but the order of sums.

Row t of an environment holds the observation at decision t, what arriving there brought (reward, outcome,
whether it was a reset) and the action taken next. L is the ring's length in decisions, E the environments
of the shard, D the size of an observation.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.checks import check_index
from edqn_jax.config import AgentConfig
from edqn_jax.keys import uniform_integers
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import Task


@struct.dataclass
class Rows:
    """One decision of E environments, or a whole ring of them with a leading [L]."""

    observation: Array  # [E, D] float32
    reward: Array  # [E] float32, for arriving here
    outcome: Array  # [E] int8, `Outcome` on arriving here
    is_reset: Array  # [E] bool, a new episode begins here
    action: Array  # [E] int8, taken here
    advice: Array | None = None  # [E] int8, move of the learner's teacher here; None without one


@struct.dataclass
class Batch:
    """B sampled n-step transitions. H is the history."""

    history: Array  # [B, H, D] observations up to the start, newest last; zeros before the episode began
    action: Array  # [B] int32
    returns: Array  # [B] discounted rewards until the end or n steps
    discount: Array  # [B] gamma^m for the bootstrap, 0 after a terminal outcome
    next_history: Array  # [B, H, D] observations up to where the bootstrap is taken
    weight: Array  # [B] 1 for a sample, 0 for a row that starts nothing (an episode's last) or led to a divergence
    advice: Array | None = None  # [B] int32, as in `Rows`


def empty_ring(length: int, envs: int, observation_size: int, *, advised: bool = False) -> Rows:
    """Returns a ring of `length` decisions of the `envs` environments of one shard, with advice if `advised`."""
    return Rows(
        observation=jnp.zeros((length, envs, observation_size)),
        reward=jnp.zeros((length, envs)),
        outcome=jnp.zeros((length, envs), jnp.int8),
        is_reset=jnp.zeros((length, envs), bool),
        action=jnp.zeros((length, envs), jnp.int8),
        advice=jnp.zeros((length, envs), jnp.int8) if advised else None,
    )


def ring_length(config: AgentConfig, total_envs: int) -> int:
    """Returns the decisions that the ring holds: at least enough to sample one n-step transition."""
    return max(config.replay_size // total_envs, config.n_step + config.history + 1)


def store_decision(ring: Rows, rows: Rows, time: Array) -> Rows:
    """Stores one decision; `time` [] int32 counts decisions since the replay began, from 0."""
    at = time % ring.reward.shape[0]
    return jax.tree.map(lambda old, new: old.at[at].set(new.astype(old.dtype)), ring, rows)


def stack_observations(rows: Array, is_reset: Array) -> Array:
    """Returns observations [H, D] in time order with those of earlier episodes zeroed; `is_reset` [H]."""
    # An observation belongs to the newest one's episode if no reset comes after it.
    later = jnp.cumsum(is_reset[::-1].astype(jnp.int32))[::-1]
    after = jnp.concatenate([later[1:], jnp.zeros(1, jnp.int32)])
    return jnp.where((after == 0)[:, None], rows, 0.0)


def sample_transitions(
    config: AgentConfig, ring: Rows, time: Array, batch: int, key: Array, task: Task | None = None
) -> Batch:
    """Draws B = `batch` transitions of one shard, uniform over the rows that can start one.

    Args:
        ring: [L, E, ...].
        time: the newest row's, as in `store_decision`.
        key: consumed.
        task: that was flown; None will do where `config.turn` is off.
    """
    length, envs = ring.reward.shape
    n, h = config.n_step, config.history
    age_key, env_key, *more = jax.random.split(key, 3 if config.turn else 2)
    oldest = jnp.minimum(time + 1, length) - h
    age = n + uniform_integers(age_key, (batch,), jnp.maximum(oldest, n) - n + 1)
    env = uniform_integers(env_key, (batch,), envs)
    check_index(env, envs, "the replay's environments")
    check_index(age - n, oldest - n + 1, "the decisions that can start a transition")
    transitions = jax.vmap(lambda a, e: _transition(config, ring, time - a, e))(age, env)
    if not config.turn:
        return transitions
    quarters = jnp.broadcast_to(uniform_integers(more[0], (batch, 1), 4), (batch, h))
    assert task is not None
    history, next_history = (
        _rotate_own_states(task, each, quarters) for each in (transitions.history, transitions.next_history)
    )
    return dataclasses.replace(transitions, history=history, next_history=next_history)


def _rotate_own_states(task: Task, history: Array, quarters: Array) -> Array:
    """Returns observations [B, H, D] with own states turned by quarters [B, H]; those before an episode stay zero."""
    assert task.turn is not None
    seen, own = jnp.split(history, [history.shape[-1] - task.own_size], axis=-1)
    return jnp.concatenate([seen, task.turn(own, quarters)], axis=-1)


def _transition(config: AgentConfig, ring: Rows, start: Array, env: Array) -> Batch:
    """Returns the n-step transition that begins at row `start` of one environment, counted as in `store_decision`."""
    length = ring.reward.shape[0]
    n, h = config.n_step, config.history
    # Rows start-h+1 .. start+n; the last n are what the start's action led to.
    at = (start + jnp.arange(1 - h, n + 1)) % length
    rewards, outcomes, resets = ring.reward[at, env], ring.outcome[at, env], ring.is_reset[at, env]
    ends = outcomes[h:] != Outcome.RUNNING
    running = jnp.cumprod(jnp.concatenate([jnp.ones(1), 1.0 - ends[:-1].astype(jnp.float32)]))
    discounts = config.discount ** jnp.arange(n, dtype=jnp.float32)
    steps = jnp.sum(running).astype(jnp.int32)  # to the end of the episode, or n
    terminal = ends[steps - 1] & (outcomes[h + steps - 1] != Outcome.TIME_OUT)
    observations = ring.observation[at, env]
    newest = jax.lax.dynamic_slice_in_dim
    return Batch(
        history=stack_observations(observations[:h], resets[:h]),
        action=ring.action[at[h - 1], env].astype(jnp.int32),
        returns=jnp.sum(running * discounts * rewards[h:]),
        discount=jnp.where(terminal, 0.0, config.discount**steps),
        next_history=stack_observations(newest(observations, steps, h), newest(resets, steps, h)),
        # Diverged transitions get weight 0.
        weight=((outcomes[h - 1] == Outcome.RUNNING) & (outcomes[h + steps - 1] != Outcome.DIVERGED)).astype(
            jnp.float32
        ),
        advice=None if ring.advice is None else ring.advice[at[h - 1], env].astype(jnp.int32),
    )
