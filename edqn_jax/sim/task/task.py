"""The contract of a task: pure functions that learners, rollouts and other libraries' environments call.

    task = task_of(config)
    state, observation = task.reset(world, key)
    state, step = task.step(world, state, action)

All functions are pure and of one drone; `map` maps them over environments. `EnvParams` holds the arrays that they
depend on.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

from jax import Array
from jax.typing import ArrayLike

from edqn_jax.config import Config
from edqn_jax.sim.actions import Box, Discrete
from edqn_jax.sim.task import env, group
from edqn_jax.sim.task.action_sets import action_set
from edqn_jax.sim.task.env import EnvParams, EnvState, Step
from edqn_jax.sim.task.observation import (
    Observation,
    mirrored_motion,
    motion_size,
    own_size,
    rotate_own_state,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """Pure functions of one drone on its missions."""

    actions: Discrete | Box
    """What an action is."""
    still: ArrayLike
    """An action that holds the drone where it is."""
    own_size: int
    """Values of the own state in an observation."""
    motion_size: int
    """Values of the own motion in an observation."""
    reset: Callable[[EnvParams, Array, Array | None], tuple[EnvState, Observation]]
    """(env_params, key, mission [] or None, which samples one) → state, the first observation; the key is consumed."""
    begin: Callable[[EnvParams, Array, Array | None], EnvState]
    """(env_params, key, mission or None) → a state whose next step is a reset; nothing is observed before that."""
    step: Callable[..., tuple[EnvState, Step]]
    """(env_params, state, action, mission=None) → state, result of the decision or of the reset that replaces it."""
    map: Callable[[Callable[..., Any]], Callable[..., Any]]
    """Maps a function of one drone over environments [E, ...], in groups where several drones share a world."""
    label: Callable[[EnvParams, EnvState], Array] | None = None
    """(env_params, state) → how near things are [H, W], for training alone; no observation holds it."""
    mirror: tuple[float, ...] | None = None
    """Factors [motion_size] on the own motion when left and right are exchanged; None where that is no symmetry."""
    turn: Callable[[Array, Array], Array] | None = None
    """(own states [..., own_size], quarter turns [...]) → those of world and drone turned about the vertical."""


def shaped_task(config: Config) -> Task:
    """Returns a task for `jax.eval_shape`: its arrays have the shapes of the configured one's, which is slow to trace.

    No physics changes a shape, and the closed form is traced in a third of MJX's time.
    """
    return task_of(dataclasses.replace(config, drone=dataclasses.replace(config.drone, physics="rigid_body")))


@functools.cache
def task_of(config: Config) -> Task:
    """Returns the task that a configuration describes.

    Raises:
        ConfigError: if there are no such actions.
    """
    actions = action_set(config)
    return Task(
        actions=actions.space,
        still=actions.still,
        own_size=own_size(config),
        motion_size=motion_size(config),
        reset=lambda env_params, key, mission=None: env.reset(config, env_params, key, mission),
        begin=lambda env_params, key, mission=None: env.before_reset(config, env_params, key, mission),
        step=lambda env_params, state, action, mission=None: env.step(config, env_params, state, action, mission),
        map=functools.partial(group.map_drones, config),
        label=lambda env_params, state: env.nearness(config, env_params, state),
        mirror=mirrored_motion(config),
        turn=rotate_own_state,
    )
