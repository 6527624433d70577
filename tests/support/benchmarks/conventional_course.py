"""The paper's world for our environment and for the conventional stack."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from conventional_stack import world
from conventional_stack.fleet import Course, Fleet, Record
from edqn_jax.config import Config
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.scene.scene import Scene, stack_scenes
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import Missions


@functools.cache
def paper() -> Scene:
    return mjcf.load_scene(mjcf.resolve_world("paper"))


def course_of(start: NDArray, goal: NDArray) -> Course:
    """Missions [M, 3] in the paper's world."""
    return Course(world.text_of(paper()), np.asarray(start, np.float64), np.asarray(goal, np.float64))


def world_of(config: Config, start: NDArray, goal: NDArray) -> env.EnvParams:
    """Returns the same missions for our environment."""
    missions = Missions(
        scene=jnp.zeros(len(start), jnp.int32),
        start=jnp.asarray(start, jnp.float32),
        goal=jnp.asarray(goal, jnp.float32),
    )
    return env.EnvParams(load_airframe(config.drone), stack_scenes([paper()]), missions)


def fleet_of(config: Config, start: NDArray, goal: NDArray) -> Fleet:
    """Returns a fleet with one drone on each mission."""
    fleet = Fleet(config, course_of(start, goal), Record.empty(config, len(start)), seed=0)
    fleet.reset(range(len(start)))
    return fleet
