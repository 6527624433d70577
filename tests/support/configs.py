"""Configurations that compile and train in seconds."""

from __future__ import annotations

import dataclasses

from edqn_jax.config import (
    AgentConfig,
    CameraConfig,
    Config,
    DroneConfig,
    EncoderConfig,
    TrainConfig,
    WorldConfig,
)
from tests.support.miniature import WORLD as MINIATURE_WORLD

TINY = Config(
    drone=DroneConfig(physics="rigid_body"),  # compiles in less time; the layout's tests fly with MJX
    camera=CameraConfig(width=8, height=6),
    encoder=EncoderConfig(
        code_size=4,
        patch_layers=(8, 4),
        joint_layers=(16,),
        decoder_hidden=(16,),
        warmup_decisions=64,
        warmup_updates_per_step=1,
        batch_size=16,
        replay_size=48,
    ),
    agent=AgentConfig(
        hidden=(16,),
        batch_size=16,
        updates_per_step=2,
        n_step=3,
        history=2,
        learning_starts=64,
        replay_size=512,
    ),
    # The same numbers on every processor.
    train=TrainConfig(num_envs=16, chunk_steps=4, total_steps=256, products="float32"),
)
"""For `miniature_world`."""


def retrained(retrain_at: tuple[float, ...]) -> Config:
    """64 steps, a warm-up of 4, a retraining of 2; the replay holds 5 steps before the DQN learns."""
    encoder = dataclasses.replace(TINY.encoder, retrain_decisions=32, retrain_at=retrain_at)
    return dataclasses.replace(TINY, encoder=encoder, train=dataclasses.replace(TINY.train, total_steps=1024))


TINY_RUN = dataclasses.replace(
    TINY,
    camera=CameraConfig(width=8, height=6),
    env=dataclasses.replace(TINY.env, max_decisions=12),
    world=WorldConfig(name=str(MINIATURE_WORLD), missions=32),
    train=TrainConfig(num_envs=16, chunk_steps=4, total_steps=512, validation_every=128, validation_missions=4),
)
"""A whole run, with validations."""


BLIND_RUN = dataclasses.replace(
    TINY_RUN,
    # This sensor is the quickest to compile.
    env=dataclasses.replace(TINY_RUN.env, sensor="blind"),
    train=dataclasses.replace(TINY_RUN.train, total_steps=256, validation_every=0),
)


FIGURES = {"world", "path", "returns", "learning"}
"""Names of the figures of every run."""
