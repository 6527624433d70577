"""Drones of Gymnasium with few pixels, and moves for them."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.extras import require_extra
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.sim.actions import move_number

interop = require_extra("edqn_jax.interop.gymnasium")

DOWN = int(move_number("down"))
HOVER = int(move_number("hover"))
MOVES = np.random.default_rng(5).integers(0, 27, size=(12, 3))


@functools.cache
def small(world: str = "medium") -> Config:
    """Few pixels: the camera is not what is tested here."""
    config = make_config(world)
    return dataclasses.replace(config, camera=dataclasses.replace(config.camera, width=16, height=12))


@functools.cache
def policy() -> Policy:
    """One that has learnt nothing."""
    return Policy(small(), fresh_policy(small()))


def many(count: int = 3, **options: Any) -> Any:
    return interop.DroneVectorEnv(count, "medium", small(), worlds=3, **options)
