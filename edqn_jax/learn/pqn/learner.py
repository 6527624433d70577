"""PQN as a learner: a rollout of all environments, its lambda-returns, some epochs over it, and on to the next.

Parallelised Q-network (Gallici et al. 2024, Algorithm 1). There is no target network, no replay and no double
estimate; layer normalisation (`agent.layer_norm`) is what keeps it stable.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from edqn_jax.config import Config
from edqn_jax.keys import split_each
from edqn_jax.learn import qnetwork
from edqn_jax.learn.actor import observation_size
from edqn_jax.learn.dqn.losses import td_loss, value_of
from edqn_jax.learn.exploration import epsilon_greedy_moves
from edqn_jax.learn.learner import Learner, Rings, UpdateStats
from edqn_jax.learn.pqn.returns import Rollout, lambda_returns, rollout_of
from edqn_jax.learn.qnetwork import Params, make_optimiser, network_values
from edqn_jax.learn.schedule import Schedule
from edqn_jax.native.adam import Adam
from edqn_jax.native.all_sum import all_sum
from edqn_jax.native.products import in_precision
from edqn_jax.sim.actions import ACTIONS

METRICS = ("q_loss", "mean_q")


@struct.dataclass
class PqnState:
    """The Q-network and its optimiser; the same on every device."""

    q: Params
    average: Params  # Polyak average that evaluation flies
    q_optimiser: Any


@struct.dataclass
class Sample:
    """One decision with its return."""

    history: Array  # [..., H, D]
    action: Array  # [...] int32
    target: Array  # [...] return, scaled
    weight: Array  # [...] 1, or 0 for what is no decision


def init_state(config: Config, key: Array) -> PqnState:
    """Returns a network that has learnt nothing; `key` is consumed."""
    q = qnetwork.init_q(config.agent, observation_size(config), len(ACTIONS), key)
    return PqnState(q=q, average=q, q_optimiser=_optimiser(config).init(q))


def begin_from(config: Config, state: PqnState, params: Params) -> PqnState:
    """Returns the state with the Q-network of a policy; its optimiser has seen nothing."""
    return dataclasses.replace(state, q=params, average=params)


def _optimiser(config: Config) -> Adam:
    schedule, pqn = Schedule.from_config(config), config.pqn
    rollouts = (schedule.scheduled - schedule.warmup) // pqn.rollout
    return make_optimiser(config.agent, rollouts * pqn.epochs * pqn.minibatches)


def count_rows_before_updates(config: Config) -> int:
    """Returns the rows before the first update: a rollout, and what the first decision of it remembers."""
    return config.pqn.rollout + config.agent.history - 1


def count_ring_rows(config: Config) -> int:
    """Returns the rows of a ring: a rollout, where it led, and what the first decision of it remembers."""
    return config.pqn.rollout + config.agent.history


def count_updates(config: Config, newest: Array) -> Array:
    """Returns the updates [...] int32 that follow when rows `newest` [...] are the newest."""
    since = newest - count_rows_before_updates(config)
    ends = (since >= 0) & (since % config.pqn.rollout == 0)
    return jnp.where(ends, config.pqn.epochs * config.pqn.minibatches, 0)


def samples_of(config: Config, q: Params, rollout: Rollout) -> Sample:
    """Returns the decisions [T] of one environment's rollout with their returns under the Q-network `q`."""
    best = jnp.max(network_values(config.agent, q, rollout.history[1:]), axis=-1)
    rewards = config.agent.reward_scale * rollout.reward
    target = lambda_returns(rewards, best, rollout.outcome, config.agent.discount, config.pqn.trace)
    return Sample(history=rollout.history[:-1], action=rollout.action, target=target, weight=rollout.weight)


def update_q(
    config: Config, axis: str | None, state: PqnState, rings: Rings, after: Array | float
) -> tuple[UpdateStats, PqnState]:
    """Learns from a rollout where one has just ended; see `Learner.update`."""
    agent, pqn = config.agent, config.pqn

    def loss(q: Params, batch: Sample):
        with in_precision(config.train.products):
            values = network_values(agent, q, batch.history)
        errors = jax.vmap(partial(td_loss, huber_delta=agent.huber_delta))(values, batch.action, batch.target)
        taken = jax.vmap(value_of)(values, batch.action)
        return jnp.sum(batch.weight * errors), (jnp.sum(batch.weight), jnp.sum(batch.weight * taken))

    def update(state: PqnState, batch: Sample):
        (total, (count, sum_q)), gradient = jax.value_and_grad(loss, has_aux=True)(state.q, batch)
        gradient, total, count, sum_q = all_sum((gradient, total, count, sum_q), axis, after)
        count = jnp.maximum(count, 1.0)
        averages = ((state.average, pqn.average_rate),)
        new = _optimiser(config).step(gradient, state.q_optimiser, state.q, averages, scale=1.0 / count)
        state = PqnState(q=new.params, average=new.averages[0], q_optimiser=new.state)
        return state, (total / count, sum_q / count, new.finite)

    def learn(state: PqnState):
        take = partial(rollout_of, time=rings.time, decisions=pqn.rollout, history=agent.history)
        rollouts = jax.vmap(jax.vmap(take, in_axes=1))(rings.rows)  # [S, E, T, ...]
        found = jax.vmap(jax.vmap(partial(samples_of, config, state.q)))(rollouts)
        # Each shard shuffles its own decisions, so that the layout on devices changes nothing but the order of sums.
        found = jax.tree.map(lambda x: x.reshape(x.shape[0], -1, *x.shape[3:]), found)  # [S, E T, ...]
        orders = jax.vmap(jax.vmap(lambda k: jax.random.permutation(k, found.weight.shape[1])))(
            split_each(rings.keys, pqn.epochs)
        )  # [epochs, S, E T]

        def epoch(state: PqnState, order: Array):
            mixed = jax.vmap(lambda s, o: jax.tree.map(lambda x: x[o], s))(found, order)
            return lax.scan(update, state, jax.tree.map(partial(_split_minibatches, pqn.minibatches), mixed))

        state, numbers = lax.scan(epoch, state, orders)
        loss, mean_q, finite = (x.reshape(-1) for x in numbers)
        return UpdateStats.from_updates(loss, dict(zip(METRICS, (loss, mean_q), strict=True)), finite), state

    def rest(state: PqnState):
        return UpdateStats.without_updates(*METRICS), state

    return lax.cond(count_updates(config, rings.time) > 0, learn, rest, state)


def _split_minibatches(count: int, x: Array) -> Array:
    """Returns [M, S * N / M, ...] of [S, N, ...]."""
    cut = x.reshape(x.shape[0], count, -1, *x.shape[2:])
    return jnp.moveaxis(cut, 0, 1).reshape(count, -1, *x.shape[2:])


PQN = Learner(
    init=init_state,
    act=lambda config, state, *rest: epsilon_greedy_moves(config, state.q, *rest),
    decide=lambda config, params, memory: qnetwork.greedy_moves(config.agent, params, memory),
    ring_length=count_ring_rows,
    starts=count_rows_before_updates,
    updates=count_updates,
    update=update_q,
    network=lambda state: state.q,
    policy=lambda state: state.average,
    begin_from=begin_from,
)
