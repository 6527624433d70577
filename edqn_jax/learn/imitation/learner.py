"""Imitation as a learner: the student flies, the teacher says at every decision what it would do, and that is learnt.

DAgger (Ross et al. 2011, Algorithm 3.1), of which each iteration is one training step: the data set is the replay. At
first the teacher takes a share beta of the moves, which falls to 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from edqn_jax.config import Config
from edqn_jax.config.learning import ImitationConfig
from edqn_jax.keys import split_each
from edqn_jax.learn import qnetwork, replay
from edqn_jax.learn.actor import observation_size
from edqn_jax.learn.dqn.learner import count_rows_before_updates, count_updates
from edqn_jax.learn.dqn.losses import value_of
from edqn_jax.learn.learner import Exploration, Learner, Metrics, Rings, Teacher, UpdateStats
from edqn_jax.learn.qnetwork import Params, make_optimiser, network_values
from edqn_jax.learn.schedule import Schedule
from edqn_jax.native.adam import Adam
from edqn_jax.native.all_sum import all_sum
from edqn_jax.native.products import in_precision
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.task.task import task_of

METRICS = ("imitation_loss", "agreement")


@struct.dataclass
class StudentState:
    """The student's network, whose outputs are logits of the moves, and its optimiser; the same on every device."""

    q: Params
    average: Params  # Polyak average that evaluation flies
    optimiser: Any


def init_state(config: Config, key: Array) -> StudentState:
    """Returns a student that has learnt nothing; `key` is consumed."""
    q = qnetwork.init_q(config.agent, observation_size(config), len(ACTIONS), key)
    return StudentState(q=q, average=q, optimiser=_optimiser(config).init(q))


def begin_from(config: Config, state: StudentState, params: Params) -> StudentState:
    """Returns the state with the network of a policy; its optimiser has seen nothing."""
    return dataclasses.replace(state, q=params, average=params)


def _optimiser(config: Config) -> Adam:
    schedule = Schedule.from_config(config)
    updates = (schedule.scheduled - schedule.learn_from) * config.agent.updates_per_step
    return make_optimiser(config.agent, updates)


def teacher_share(config: ImitationConfig, decisions: Array, total: int) -> Array:
    """Returns beta [], the share of moves that the teacher takes after so many decisions of `total`.

    >>> config = ImitationConfig(teacher_moves=0.8, teacher_fraction=0.5)
    >>> print([f"{teacher_share(config, jnp.int32(done), 100):.2f}" for done in (0, 25, 50, 100)])
    ['0.80', '0.40', '0.00', '0.00']
    """
    done = jnp.clip(decisions / max(config.teacher_fraction * total, 1.0), 0.0, 1.0)
    return config.teacher_moves * (1.0 - done)


def choose_moves(
    config: Config, state: StudentState, memory: Array, keys: Array, exploration: Exploration
) -> tuple[Array, Metrics]:
    """Returns moves [S, E] int32, each the teacher's with probability beta and else the student's, and beta.

    Args:
        config: of the run.
        state: of the student.
        memory: [S, E, H, D].
        keys: [S] of the shards, consumed.
        exploration: with the teacher's advice.
    """
    assert exploration.advice is not None
    share = teacher_share(config.imitation, exploration.decisions, exploration.total)
    own = qnetwork.greedy_moves(config.agent, state.q, memory)
    coins = jax.vmap(lambda key: jax.random.uniform(key, own.shape[1:]))(keys)
    return jnp.where(coins < share, exploration.advice, own), {"teacher_moves": share}


def imitation_loss(logits: Array, advice: Array) -> Array:
    """Returns the cross-entropy [] of logits [A] of the moves and the move that the teacher advises [].

    >>> print(jnp.round(imitation_loss(jnp.zeros(4), jnp.array(2)) / jnp.log(4.0), 3))
    1.0
    """
    return -value_of(jax.nn.log_softmax(logits), advice)


def update_student(
    config: Config, axis: str | None, state: StudentState, rings: Rings, after: Array | float
) -> tuple[UpdateStats, StudentState]:
    """Updates the student with rows drawn uniformly from the rings; see `Learner.update`."""
    # What a move leads to is not learnt from.
    agent, task = dataclasses.replace(config.agent, n_step=1), task_of(config)
    share = agent.batch_size // config.train.shards

    def loss(q: Params, batch: replay.Batch):
        assert batch.advice is not None
        with in_precision(config.train.products):
            logits = network_values(agent, q, batch.history)
        losses = jax.vmap(imitation_loss)(logits, batch.advice)
        agrees = jnp.argmax(logits, axis=-1) == batch.advice
        return jnp.sum(batch.weight * losses), (jnp.sum(batch.weight), jnp.sum(batch.weight * agrees))

    def update(state: StudentState, keys: Array):
        batch = jax.vmap(lambda r, k: replay.sample_transitions(agent, r, rings.time, share, k, task))(rings.rows, keys)
        batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
        (total, (count, agrees)), gradient = jax.value_and_grad(loss, has_aux=True)(state.q, batch)
        gradient, total, count, agrees = all_sum((gradient, total, count, agrees), axis, after)
        count = jnp.maximum(count, 1.0)
        averages = ((state.average, agent.average_rate),)
        new = _optimiser(config).step(gradient, state.optimiser, state.q, averages, scale=1.0 / count)
        state = StudentState(q=new.params, average=new.averages[0], optimiser=new.state)
        return state, (total / count, agrees / count, new.finite)

    def learn(state: StudentState):
        state, (loss, agreement, finite) = lax.scan(update, state, split_each(rings.keys, agent.updates_per_step))
        return UpdateStats.from_updates(loss, dict(zip(METRICS, (loss, agreement), strict=True)), finite), state

    def rest(state: StudentState):
        return UpdateStats.without_updates(*METRICS), state

    return lax.cond(count_updates(config, rings.time) > 0, learn, rest, state)


def imitation_of(teacher: Callable[[Config], Teacher]) -> Learner:
    """Returns the learner that imitates the policy which `teacher` returns for a configuration."""
    return Learner(
        init=init_state,
        act=choose_moves,
        decide=lambda config, params, memory: qnetwork.greedy_moves(config.agent, params, memory),
        ring_length=lambda config: replay.ring_length(config.agent, config.train.num_envs),
        starts=count_rows_before_updates,
        updates=count_updates,
        update=update_student,
        network=lambda state: state.q,
        policy=lambda state: state.average,
        begin_from=begin_from,
        teacher=teacher,
    )
