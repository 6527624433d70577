"""A small workload that is trained as any other, and a world that is quicker to compile for."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.learn.state import Health, Losses
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.scene.scene import stack_scenes
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.missions import spread_missions

MINIATURE = (
    *("--world", "paper"),
    *("--num-envs", "16", "--agent.batch-size", "16", "--agent.replay-size", "512", "--agent.learning-starts", "64"),
    *("--camera.width", "8", "--camera.height", "6", "--train.validation-missions", "2", "--world.missions", "16"),
    *("--drone.physics", "rigid_body"),  # compiles in less time
)
"""Flags of train.py."""

WORLD = Path(__file__).with_name("miniature.xml")
"""Ground, blocks and a ball, as in the paper's world, but few: a training step compiles in two thirds of the time."""


def no_losses(steps: int) -> Losses:
    """Stands for what training steps return in which nothing was learnt."""
    zeros: Any = np.zeros(steps)
    health = Health(*[zeros] * len(dataclasses.fields(Health)))
    names = ("q_loss", "mean_q", "reconstruction_loss", "kl", "epsilon")
    return Losses(metrics=dict.fromkeys(names, zeros), health=health)


def miniature_world(config: Config, own_start_fraction: float = 0.25) -> EnvParams:
    """64 missions in that world, so many of them from near its own start."""
    pool = stack_scenes([mjcf.load_scene(WORLD)])
    missions = spread_missions(pool, 64, own_start_fraction, 1.0, jax.random.key(1))
    return EnvParams(airframe=load_airframe(config.drone), pool=pool, missions=missions)
