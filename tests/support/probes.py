"""Tasks whose values are known exactly, for the training step that trains everything else.

A probe has two states, shown as one-hot own states, and two ways: the drone's moves with even numbers are the first,
those with odd numbers the second. It keeps the contract of `sim.task.task.Task`: an ended episode spends its next step
on being reset. Several probes stand in one world as its missions, one for each of the agents that train together.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn.actor import observation_size
from edqn_jax.learn.trainer import Trainer, TrainState
from edqn_jax.sim.actions import ACTIONS, Discrete
from edqn_jax.sim.task.env import EnvParams, NonFinite, Step
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE, Observation
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import Task

STATES, WAYS = 2, 2
LIMIT = 5
"""Decisions after which the endless probe is cut off."""
PROBES = ("constant", "two steps", "action", "state", "matching", "endless", "detour")

SECOND = float(np.mean(np.arange(len(ACTIONS)) % WAYS))
"""Share of the moves that are the second way."""


@struct.dataclass
class Life:
    """One environment."""

    state: Array  # [] int32
    decision: Array  # [] int32
    ended: Array  # [] bool
    paid: Array  # [] in this episode
    key: Array


def move(probe: Array, state: Array, way: Array, decision: Array) -> tuple[Array, Array, Array]:
    """State, reward and outcome after one decision of probe number `probe`."""
    paid = jnp.where(way == 1, 1.0, -1.0)
    signed = jnp.where(state == 1, 1.0, -1.0)
    at_end, going = jnp.int32(Outcome.GOAL), jnp.int32(Outcome.RUNNING)
    cut = jnp.where(decision >= LIMIT, Outcome.TIME_OUT, Outcome.RUNNING).astype(jnp.int32)
    last = jnp.where(state == 1, at_end, going)
    stopped = jnp.where((state == 1) | (way == 0), at_end, going)
    cases = {
        # one decision that always pays 1
        "constant": (state, 1.0, at_end),
        # from the first state to the second for nothing, then 1
        "two steps": (1, jnp.where(state == 1, 1.0, 0.0), last),
        # one decision that pays 1 for the second way and -1 for the first
        "action": (state, paid, at_end),
        # one decision that pays 1 in the second state and -1 in the first
        "state": (state, signed, at_end),
        # one decision that pays 1 where way and state agree and -1 where not
        "matching": (state, paid * signed, at_end),
        # 1 for ever, but cut off after LIMIT decisions
        "endless": (state, 1.0, cut),
        # first state: 0.5 and the end, or nothing and on to the second; there 2 for the second way, else 0
        "detour": (1, jnp.where(state == 1, 1.0 + paid, jnp.where(way == 0, 0.5, 0.0)), stopped),
    }
    chosen = [cases[name] for name in PROBES]
    return tuple(jnp.stack([jnp.asarray(case[i]) for case in chosen])[probe] for i in range(3))  # type: ignore


def _first_state(probe: Array, key: Array) -> Array:
    """Always the first, but for probes about states."""
    either = jnp.isin(probe, jnp.array([PROBES.index("state"), PROBES.index("matching")]))
    return jnp.where(either, jax.random.randint(key, (), 0, STATES), 0)


def _observed(life: Life) -> Observation:
    own = jax.nn.one_hot(life.state, OWN_SIZE)
    return Observation(sensed=None, own=own, motion=jnp.zeros(MOTION_SIZE))


def _begin(world: Any, key: Array, mission: Array | None = None) -> Life:
    nothing = jnp.zeros((), jnp.int32)
    return Life(state=nothing, decision=nothing, ended=jnp.ones((), bool), paid=jnp.zeros(()), key=key)


def _reset(world: Any, key: Array, mission: Array | None = None) -> tuple[Life, Observation]:
    life, step = _step(world, _begin(world, key), jnp.int32(0))
    return life, step.observation


def _step(world: Any, life: Life, action: Array, mission: Array | None = None) -> tuple[Life, Step]:
    probe, over = world.missions, life.ended
    key, drawing = jax.random.split(life.key)
    decision = life.decision + 1
    state, reward, outcome = move(probe, life.state, action % WAYS, decision)
    reward = jnp.where(over, 0.0, reward)
    outcome = jnp.where(over, int(Outcome.RUNNING), outcome)
    after = Life(
        state=jnp.where(over, _first_state(probe, drawing), state),
        decision=jnp.where(over, 0, decision),
        ended=outcome != Outcome.RUNNING,
        paid=jnp.where(over, 0.0, life.paid + reward),
        key=key,
    )
    sound: Any = jnp.zeros((), bool)
    step: Any = Step(
        observation=_observed(after),
        reward=reward,
        outcome=outcome,
        is_reset=over,
        episode_return=after.paid,
        episode_length=after.decision,
        flight=None,  # type: ignore[arg-type]
        end_step=jnp.int32(1),
        contact=jnp.ones(()),
        broken=NonFinite(sound, sound, sound),
    )
    return after, step


TASK: Any = Task(
    actions=Discrete(len(ACTIONS)),
    still=np.int32(0),
    own_size=OWN_SIZE,
    motion_size=MOTION_SIZE,
    reset=_reset,  # type: ignore[arg-type]
    begin=_begin,  # type: ignore[arg-type]
    step=_step,  # type: ignore[arg-type]
    map=jax.vmap,
)


def trained(config: Config, probes: Sequence[str] = PROBES) -> TrainState:
    """Returns what one agent for each probe has become in a run of one chunk, by the training step itself.

    No configuration names a task but the drone's, so the modules of `learn` are made to find this one.
    """
    worlds: Any = [EnvParams(airframe=None, pool=None, missions=jnp.int32(PROBES.index(each))) for each in probes]  # type: ignore
    with pytest.MonkeyPatch.context() as patch:
        for name, module in list(sys.modules.items()):
            if name.startswith("edqn_jax.learn") and hasattr(module, "task_of"):
                patch.setattr(module, "task_of", lambda config: TASK)
        trainer = Trainer(config, worlds, jax.devices()[:1])
        state, _ = trainer.chunk(trainer.init(range(len(probes))), 0)
    return state


def first_seen(config: Config, probe: str) -> Array:
    """[states, history, D] what the network sees when an episode first comes to each state."""
    size = observation_size(config)
    seen = jnp.zeros((STATES, config.agent.history + 1, size)).at[:, -1].set(jnp.eye(STATES, size))
    return seen.at[1, -2, 0].set(float(probe in ("two steps", "detour")))[:, 1:]
