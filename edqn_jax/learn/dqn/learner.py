"""DQN as a learner: updates from the replay, a target network that follows, an average that flies."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from edqn_jax.config import Config
from edqn_jax.keys import split_each
from edqn_jax.learn import qnetwork, replay
from edqn_jax.learn.actor import observation_size
from edqn_jax.learn.dqn.losses import batch_loss
from edqn_jax.learn.exploration import epsilon_greedy_moves
from edqn_jax.learn.learner import Learner, Rings, UpdateStats
from edqn_jax.learn.qnetwork import Params, make_optimiser
from edqn_jax.learn.schedule import Schedule
from edqn_jax.native.adam import Adam
from edqn_jax.native.all_sum import all_sum
from edqn_jax.native.products import in_precision
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.task.task import task_of

METRICS = ("q_loss", "mean_q")


@struct.dataclass
class DqnState:
    """Q-networks and their optimiser; the same on every device."""

    q: Params
    target: Params
    average: Params  # Polyak average that evaluation flies
    q_optimiser: Any


def init_state(config: Config, key: Array) -> DqnState:
    """Returns networks that have learnt nothing; `key` is consumed."""
    q = qnetwork.init_q(config.agent, observation_size(config), len(ACTIONS), key)
    return DqnState(q=q, target=q, average=q, q_optimiser=_optimiser(config).init(q))


def begin_from(config: Config, state: DqnState, params: Params) -> DqnState:
    """Returns the state with the Q-network of a policy; its optimiser has seen nothing."""
    return dataclasses.replace(state, q=params, target=params, average=params)


def _optimiser(config: Config) -> Adam:
    schedule = Schedule.from_config(config)
    return make_optimiser(config.agent, (schedule.scheduled - schedule.learn_from) * config.agent.updates_per_step)


def count_rows_before_updates(config: Config) -> int:
    """Returns the rows of a replay before the first update."""
    least = config.agent.n_step + config.agent.history
    return max(math.ceil(config.agent.learning_starts / config.train.num_envs), least)


def count_updates(config: Config, newest: Array) -> Array:
    """Returns the updates [...] int32 that follow when rows `newest` [...] are the newest."""
    return jnp.where(newest >= count_rows_before_updates(config), config.agent.updates_per_step, 0)


def update_q(
    config: Config, axis: str | None, state: DqnState, rings: Rings, after: Array | float
) -> tuple[UpdateStats, DqnState]:
    """Updates the Q-network from the replay (Algorithm 1, steps 7-9); see `Learner.update`."""
    agent, task = config.agent, task_of(config)
    share = agent.batch_size // config.train.shards

    # All of a network as one vector: what is done to each number of it is one operation, and not one for each layer.
    _, tree = ravel_pytree(state.q)

    def vector(params: Params) -> Array:
        return ravel_pytree(params)[0]

    def loss(q: Array, target: Array, batch: replay.Batch):
        with in_precision(config.train.products):
            return batch_loss(agent, tree(q), tree(target), len(ACTIONS), batch)

    def update(state: DqnState, keys: Array):
        batch = jax.vmap(lambda r, k: replay.sample_transitions(agent, r, rings.time, share, k, task))(rings.rows, keys)
        batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
        (total, (count, sum_q)), gradient = jax.value_and_grad(loss, has_aux=True)(state.q, state.target, batch)
        gradient, total, count, sum_q = all_sum((gradient, total, count, sum_q), axis, after)
        count = jnp.maximum(count, 1.0)
        averages = (state.target, agent.target_rate), (state.average, agent.average_rate)
        new = _optimiser(config).step(gradient, state.q_optimiser, state.q, averages, scale=1.0 / count)
        target, average = new.averages
        state = DqnState(q=new.params, target=target, average=average, q_optimiser=new.state)
        return state, (total / count, sum_q / count, new.finite)

    def learn(state: DqnState):
        many = split_each(rings.keys, agent.updates_per_step)
        state, (loss, mean_q, finite) = lax.scan(update, _each_network(vector, state), many)
        stats = UpdateStats.from_updates(loss, dict(zip(METRICS, (loss, mean_q), strict=True)), finite)
        return stats, _each_network(tree, state)

    def rest(state: DqnState):
        return UpdateStats.without_updates(*METRICS), state

    return lax.cond(count_updates(config, rings.time) > 0, learn, rest, state)


def _each_network(change: Callable[[Any], Any], state: DqnState) -> DqnState:
    """Returns `state` with its three Q-networks changed."""
    return dataclasses.replace(state, q=change(state.q), target=change(state.target), average=change(state.average))


DQN = Learner(
    init=init_state,
    act=lambda config, state, *rest: epsilon_greedy_moves(config, state.q, *rest),
    decide=lambda config, params, memory: qnetwork.greedy_moves(config.agent, params, memory),
    ring_length=lambda config: replay.ring_length(config.agent, config.train.num_envs),
    starts=count_rows_before_updates,
    updates=count_updates,
    update=update_q,
    network=lambda state: state.q,
    policy=lambda state: state.average,
    begin_from=begin_from,
)
