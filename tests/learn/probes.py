"""Small tasks whose values are known exactly, and the project's learner run on them.

A task has two states, shown as one-hot observations, and two actions. They follow the protocol of the drone's
environment: an ended episode spends its next step on being reset.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from edqn_jax.config import AgentConfig
from edqn_jax.learn import qnetwork, replay
from edqn_jax.learn.dqn import losses
from edqn_jax.sim.task.outcomes import Outcome

ACTIONS, ENVS, STATES = 2, 16, 2
LIMIT = 5
"""Decisions after which the endless tasks are cut off."""
TASKS = ("constant", "two steps", "action", "state", "matching", "endless", "detour")


class Life(NamedTuple):
    state: Array  # [] int32
    decision: Array  # [] int32
    ended: Array  # [] bool


def move(task: Array, state: Array, action: Array, decision: Array) -> tuple[Array, Array, Array]:
    """State, reward and outcome after one decision of task number `task`."""
    paid = jnp.where(action == 1, 1.0, -1.0)
    signed = jnp.where(state == 1, 1.0, -1.0)
    at_end, going = jnp.int32(Outcome.GOAL), jnp.int32(Outcome.RUNNING)
    cut = jnp.where(decision >= LIMIT, Outcome.TIME_OUT, Outcome.RUNNING).astype(jnp.int32)
    last = jnp.where(state == 1, at_end, going)
    stopped = jnp.where((state == 1) | (action == 0), at_end, going)
    cases = {
        # one decision that always pays 1
        "constant": (state, 1.0, at_end),
        # from the first state to the second for nothing, then 1
        "two steps": (1, jnp.where(state == 1, 1.0, 0.0), last),
        # one decision that pays 1 for the second action and -1 for the first
        "action": (state, paid, at_end),
        # one decision that pays 1 in the second state and -1 in the first
        "state": (state, signed, at_end),
        # one decision that pays 1 where action and state agree and -1 where not
        "matching": (state, paid * signed, at_end),
        # 1 for ever, but cut off after LIMIT decisions
        "endless": (state, 1.0, cut),
        # first state: 0.5 and the end, or nothing and on to the second; there 2 for the second action, else 0
        "detour": (1, jnp.where(state == 1, 1.0 + paid, jnp.where(action == 0, 0.5, 0.0)), stopped),
    }
    chosen = [cases[name] for name in TASKS]
    return tuple(jnp.stack([jnp.asarray(case[i]) for case in chosen])[task] for i in range(3))  # type: ignore


def first_state(task: Array, key: Array) -> Array:
    """Always the first, but for tasks about states."""
    either = jnp.isin(task, jnp.array([TASKS.index("state"), TASKS.index("matching")]))
    return jnp.where(either, jax.random.randint(key, (), 0, STATES), 0)


def live(task: Array, life: Life, action: Array, key: Array) -> tuple[Life, replay.Rows]:
    """One step of one environment, and its row (the action of the row is filled in later)."""
    decision = life.decision + 1
    state, reward, outcome = move(task, life.state, action, decision)
    state = jnp.where(life.ended, first_state(task, key), state)
    outcome = jnp.where(life.ended, int(Outcome.RUNNING), outcome)
    row = replay.Rows(
        observation=jax.nn.one_hot(state, STATES),
        reward=jnp.where(life.ended, 0.0, reward),
        outcome=outcome.astype(jnp.int8),
        is_reset=life.ended,
        action=action,
    )
    return Life(state, jnp.where(life.ended, 0, decision), outcome != Outcome.RUNNING), row


def first_seen(task: Array, history: int) -> Array:
    """[states, history, STATES] what the network sees when an episode first comes to each state."""
    follows = jnp.isin(task, jnp.array([TASKS.index("two steps"), TASKS.index("detour")]))
    seen = jnp.zeros((STATES, history + 1, STATES)).at[:, -1].set(jnp.eye(STATES))
    return seen.at[1, -2, 0].set(jnp.where(follows, 1.0, 0.0))[:, 1:]


@partial(jax.jit, static_argnums=(0, 1))
def learn(config: AgentConfig, steps: int, task: Array, key: Array) -> Array:
    """Q [states, actions] after `steps` decisions of random exploration, one update each."""
    q_key, first_key, key = jax.random.split(key, 3)
    online = qnetwork.init_q(config, STATES, ACTIONS, q_key)
    adam = qnetwork.optimiser(config, steps)
    draw = partial(jax.random.randint, shape=(ENVS,), minval=0, maxval=ACTIONS)
    lives = Life(
        state=jax.vmap(partial(first_state, task))(jax.random.split(first_key, ENVS)),
        decision=jnp.zeros(ENVS, jnp.int32),
        ended=jnp.ones(ENVS, bool),  # the first step is a reset
    )

    def step(carry, time):
        online, target, state, lives, ring, action, key = carry
        key, act_key, live_key, sample_key = jax.random.split(key, 4)
        lives, rows = jax.vmap(partial(live, task))(lives, action, jax.random.split(live_key, ENVS))
        action = draw(act_key)
        ring = replay.write(ring, dataclasses.replace(rows, action=action), time)
        batch = replay.sample(config, ring, time, config.batch_size, sample_key)

        def loss(params):
            total, (count, _) = losses.batch_loss(config, params, target, ACTIONS, batch)
            return total / jnp.maximum(count, 1.0)

        change, after = adam.update(jax.grad(loss)(online), state, online)
        learned: qnetwork.Params = optax.apply_updates(online, change)
        warm = time > 4 * (config.n_step + config.history)
        learned, after = jax.tree.map(lambda a, b: jnp.where(warm, a, b), (learned, after), (online, state))
        target = qnetwork.polyak(learned, target, config.target_rate)
        return (learned, target, after, lives, ring, action, key), None

    ring = replay.empty(replay.ring_length(config, ENVS), ENVS, STATES)
    carry = (online, online, adam.init(online), lives, ring, jnp.zeros(ENVS, jnp.int32), key)
    online = jax.lax.scan(step, carry, jnp.arange(steps))[0][0]
    return qnetwork.q_values(config, online, ACTIONS, first_seen(task, config.history))
