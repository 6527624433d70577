"""How many bytes training takes, counted from the shapes of its state; nothing is allocated."""

from __future__ import annotations

import dataclasses

import jax

from edqn_jax.config import Config
from edqn_jax.learn import trainer
from edqn_jax.sim.env import World
from measurement.timing import size_of


@dataclasses.dataclass(frozen=True)
class StateBytes:
    """What the train state is made of: environments x each + slots x each + the rest, to the byte."""

    environment: int
    """One environment: body, mission, sensor, what it remembers."""
    replay_slot: int
    """One observation in the replay, with what is stored beside it."""
    rest: int
    """Parameters, optimisers, keys of the shards, the step; whatever the number of environments."""
    environments: int
    replay_slots: int


def state_bytes(config: Config, world: World) -> StateBytes:
    """The bytes of the state that training with this configuration carries from step to step."""
    state = jax.eval_shape(lambda world, key: trainer.init(config, world, key), world, jax.random.key(0))
    actors, ring = state.actors, state.actors.replay
    flown = size_of(dataclasses.replace(actors, replay=None, key=None))
    return StateBytes(
        environment=flown // config.train.num_envs,
        replay_slot=size_of(ring) // ring.reward.size,
        rest=size_of((state.learner, actors.key, state.step)),
        environments=config.train.num_envs,
        replay_slots=ring.reward.size,
    )
