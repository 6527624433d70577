"""A training run of seconds, in place of a trial of a search."""

from __future__ import annotations

import dataclasses

from edqn_jax.config import Config
from tests.support.miniature import WORLD


def tiny_trial(config: Config) -> Config:
    """Returns the configuration of a trial with 2,048 decisions, few environments and no camera."""
    return dataclasses.replace(
        config,
        camera=dataclasses.replace(config.camera, width=8, height=6),
        drone=dataclasses.replace(config.drone, physics="rigid_body"),
        env=dataclasses.replace(config.env, sensor="blind", reward="progress"),
        world=dataclasses.replace(config.world, name=str(WORLD), flown="", missions=16),
        agent=dataclasses.replace(config.agent, batch_size=16, replay_size=512, learning_starts=64, turn=False),
        train=dataclasses.replace(
            config.train, num_envs=16, chunk_steps=16, validation_missions=2, total_steps=2048, validation_every=512
        ),
    )
