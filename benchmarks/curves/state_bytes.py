"""The bytes of the train state, computed from its shapes without allocating it."""

from __future__ import annotations

import dataclasses

import jax

from edqn_jax.config import Config
from edqn_jax.learn.state import init_state
from edqn_jax.sim.task.env import EnvParams
from measurement.timing import size_of


@dataclasses.dataclass(frozen=True)
class StateBytes:
    """The bytes of the train state: environments x `environment` + replay_slots x `replay_slot` + `rest`, exactly."""

    environment: int
    """Of one environment: drone, mission, sensor and the policy's memory."""
    replay_slot: int
    """Of one observation in the replay with action, reward and outcome."""
    rest: int
    """Of parameters, optimisers, what the VAE learns from, keys of the shards and the step."""
    environments: int
    replay_slots: int


def state_bytes(config: Config, world: EnvParams) -> StateBytes:
    """Returns the bytes of the train state for a configuration."""
    state = jax.eval_shape(lambda world, key: init_state(config, world, key), world, jax.random.key(0))
    actors, ring = state.actors, state.actors.replay
    environments = size_of(dataclasses.replace(actors, replay=None, samples=None, key=None))
    return StateBytes(
        environment=environments // config.train.num_envs,
        replay_slot=size_of(ring) // ring.reward.size,
        rest=size_of((state.learner, actors.samples, actors.key, state.step)),
        environments=config.train.num_envs,
        replay_slots=ring.reward.size,
    )
