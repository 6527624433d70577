"""The state of training, what a step returns, and the state before the first step.

`TrainState` holds everything that the future depends on. Environments and replay stand in S logical shards,
[S, E, ...], whatever the number of devices.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn import replay, samples
from edqn_jax.learn.actor import AgentActor, observation_size
from edqn_jax.learn.imitation.advice import Advice, no_advice
from edqn_jax.learn.learner import Metrics, learner_of
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.samples import Samples
from edqn_jax.learn.updates import Networks, init_networks
from edqn_jax.sim.task import group
from edqn_jax.sim.task.env import EnvParams, EnvState
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import shaped_task, task_of

NO_START = int(Outcome.TIME_OUT)
"""Outcome in the replay of a row at which no transition starts, as where an episode has ended."""


@struct.dataclass
class Actors:
    """Environments and replay of S shards with E environments each."""

    env: EnvState  # [S, E, ...]
    memory: Array  # [S, E, H, D] stacked observations, the newest included
    reward: Array  # [S, E] for arriving where the environment is
    outcome: Array  # [S, E]
    is_reset: Array  # [S, E]
    manoeuvre: Array  # [S, E] the held move of the warm-up; checkpoints have it under this name
    episodes: Array  # [S, E] episodes finished since the DQN started
    replay: replay.Rows  # [S, L, E, ...]
    samples: Samples | None  # [S, L, E, ...] what the VAE learns from; None where there is none
    key: Array  # [S] typed keys of the shards
    advice: Advice | None = None  # [S, E, ...] of the learner's teacher; None without one


@struct.dataclass
class TrainState:
    """Everything that the future of a run depends on."""

    actors: Actors
    learner: Networks
    step: Array  # [] int32 training steps done


@struct.dataclass
class Episodes:
    """Episodes that ended in each training step: [S, E]; other environments have outcome RUNNING."""

    outcome: Array
    length: Array
    episode_return: Array


@struct.dataclass
class Health:
    """How often a quantity was not finite in one training step, in the order in which one spoils the next; [] int32."""

    physics_state: Array
    """Environments, which were reset."""
    observation: Array
    reward: Array
    parameters: Array
    """1 if a number of the VAE or of the learner's network was not finite before the updates."""
    loss: Array
    """Updates."""
    gradient: Array
    """Updates, which were skipped."""


@struct.dataclass
class Losses:
    """One training step: metrics of perception and learner by name, and health."""

    metrics: Metrics
    """Means over the step's updates that had a finite loss, and what the learner tells of acting; NaN for what did not
    learn in it."""
    health: Health


class InitialKeys(NamedTuple):
    """Keys split from the key of a run's learning."""

    learner: Array
    environments: Array  # [N] by the environment's global number
    shards: Array  # [S] by the shard's global number, never a device's

    @classmethod
    def split(cls, key: Array, envs: int, shards: int) -> InitialKeys:
        """Splits `key`, which is consumed."""
        learner, environments, of_shards = jax.random.split(key, 3)
        return cls(
            learner,
            jax.vmap(partial(jax.random.fold_in, environments))(jnp.arange(envs)),
            jax.vmap(partial(jax.random.fold_in, of_shards))(jnp.arange(shards)),
        )


def init_state(config: Config, env_params: EnvParams, key: Array) -> TrainState:
    """Returns the state before the first step; a pure function of the key, so `vmap` maps it over seeds."""
    shards, envs = config.train.shards, config.train.num_envs
    keys = InitialKeys.split(key, envs, shards)
    # Nothing has been seen yet: the first step is every environment's reset.
    task = task_of(config)
    state = task.map(lambda k: task.begin(env_params, k, None))(keys.environments)
    networks, memory = init_networks(config, keys.learner), AgentActor(config).init()
    learner = learner_of(config)
    ring = replay.empty_ring(
        learner.ring_length(config), envs // shards, observation_size(config), advised=learner.teacher is not None
    )
    whole = Actors(
        env=state,
        memory=jnp.broadcast_to(memory, (envs, *memory.shape)),
        reward=jnp.zeros(envs),
        outcome=jnp.full(envs, NO_START),
        is_reset=jnp.ones(envs, bool),
        manoeuvre=jnp.zeros(envs, jnp.int32),
        episodes=jnp.zeros(envs, jnp.int32),
        replay=jnp.zeros(envs),  # type: ignore[arg-type]
        samples=None,
        key=jnp.zeros(envs),
        advice=None if learner.teacher is None else no_advice(learner.teacher(config).config, envs),
    )
    actors = jax.tree.map(lambda x: x.reshape(shards, envs // shards, *x.shape[1:]), whole).replace(
        replay=jax.tree.map(lambda x: jnp.broadcast_to(x, (shards, *x.shape)), ring),
        samples=_empty_samples(config, env_params, state),
        key=keys.shards,
    )
    return TrainState(actors=actors, learner=networks, step=jnp.zeros((), jnp.int32))


def _empty_samples(config: Config, env_params: EnvParams, state: EnvState) -> Samples | None:
    """Returns the rings [S, L, E, ...] of what the VAE learns from; None where there is no VAE."""
    if not embedding.has_code(config):
        return None
    task, shards, envs = shaped_task(config), config.train.shards, config.train.num_envs

    def one(state: EnvState) -> Samples:
        step = task.step(env_params, state, task.still)[1]
        observation = embedding.as_encoder_input(config, step.observation)
        near = None if task.label is None else task.label(env_params, state)
        wanted = samples.target_of(config.encoder, observation, near)
        return samples.samples_of(config.encoder, observation, wanted)

    if group.is_multi_drone(config):
        whole = jax.eval_shape(task.map(one), state)
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), whole)
    else:
        shapes = jax.eval_shape(one, jax.tree.map(lambda x: x[0], state))
    ring = samples.empty_ring(config.encoder, shapes, envs // shards, envs)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (shards, *x.shape)), ring)
