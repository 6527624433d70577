"""What Gymnasium's environments of one drone and of many share: the task, its options and its spaces. Needs `gym`."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.interop import functional
from edqn_jax.interop.drone_programs import Leaves, Program
from edqn_jax.interop.functional import FunctionalEnv, Kind, Params
from edqn_jax.learn.perception.code import Params as EncoderParams
from edqn_jax.learn.policy import Policy
from edqn_jax.sim.actions import Box, Discrete
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.task.action_sets import are_actions, describe_space
from edqn_jax.sim.task.env import EnvState
from edqn_jax.sim.task.reward import Reward

gymnasium = require_extra("gymnasium", extra="gym")


@dataclasses.dataclass(frozen=True, eq=False)
class GymTask:
    """A task with its worlds, in Gymnasium's spaces and the arguments of the compiled programs."""

    env: FunctionalEnv
    params: Params
    limit: int | None = None

    @property
    def config(self) -> Config:
        return self.env.config

    @property
    def environment(self) -> Environment:
        return Environment(self.config, self.params.world)

    @functools.cached_property
    def program(self) -> tuple[Program, Leaves, EncoderParams]:
        """Returns the first arguments of every compiled function."""
        leaves, structure = jax.tree.flatten(self.params.world)
        return Program(self.env, structure, self.limit), leaves, self.params.encoder

    @property
    def observations(self) -> Any:
        """Returns the space of one drone's observations."""
        space = self.env.observation_space(self.params)
        if isinstance(space, Box):
            return _box(space)
        return gymnasium.spaces.Dict({name: _box(box) for name, box in space.items()})

    @property
    def actions(self) -> Any:
        """Returns the space of one drone's actions."""
        space = self.env.action_space(self.params)
        return gymnasium.spaces.Discrete(space.n) if isinstance(space, Discrete) else _box(space)

    def action(self, given: Any, count: int | None) -> NDArray:
        """Returns actions [count, ...], or one, as the programs take them.

        Raises:
            gymnasium.error.InvalidAction: if they are none.
        """
        space, numbers = self.env.action_space(self.params), np.asarray(given)
        if not are_actions(space, numbers, () if count is None else (count,)):
            wanted = "an action must be" if count is None else f"there must be {count} actions, each"
            raise gymnasium.error.InvalidAction(f"{wanted} {describe_space(space)}")
        return numbers.astype(space.dtype)

    def mission(self, options: dict[str, Any] | None, count: int | None) -> Array | None:
        """Returns which missions [count], or [] of one drone, the options of a reset ask for; None draws them.

        Raises:
            ConfigError: names the options that there are.
        """
        if not options:
            return None
        if set(options) != {"mission"}:
            raise ConfigError(f"options of reset may have 'mission' alone, not {', '.join(map(repr, options))}")
        asked, most = np.asarray(options["mission"]), self.environment.missions
        if not np.issubdtype(asked.dtype, np.integer) or np.any(asked < 0) or np.any(asked >= most):
            raise ConfigError(f"mission must be whole numbers from 0 to {most - 1}, not {options['mission']}")
        if asked.shape not in ((), () if count is None else (count,)):
            raise ConfigError(f"mission must be one number{'' if count is None else f' or {count}'}, not {asked.size}")
        return jnp.asarray(np.broadcast_to(asked, () if count is None else (count,)), jnp.int32)

    def picture(self, state: EnvState) -> NDArray[np.uint8]:
        """Returns what a person would see from a drone's camera, [192, 256, 3] with the default camera."""
        return np.round(np.asarray(self.environment.picture(state)) * 255.0).astype(np.uint8)


def on_host(tree: Any) -> Any:
    """Returns the arrays as NumPy's own, which may be written: JAX's may not."""
    return jax.tree.map(np.array, tree)


def _box(space: Box) -> Any:
    return gymnasium.spaces.Box(space.low, space.high, space.shape, np.float32)


class TaskOptions(TypedDict, total=False):
    """Options of `DroneEnv` and `DroneVectorEnv`, as keywords."""

    observation: Kind
    """`image` (default) is a Dict of `image`, `own` [10] and `motion` [7]: the image holds the signed number of events
    of each pixel as a logarithm, [H, W], or what another sensor of the configuration shows. `code` is one vector of
    code, own state and own motion. `kinematics` is own state and motion, without a sensor."""
    policy: Policy | None
    """Whose encoder makes the codes."""
    worlds: int | None
    """Random worlds, of which each reset draws one; None is `functional.WORLDS`, and 1 for a world from a file."""
    world_seed: int
    """Which random worlds, of those that training draws from."""
    reward: Reward | None
    """Of every decision, in place of the configured one: a function of a `Transition`."""


def make_task(
    world: str | Path | None, config: Config | None, limit: int | None = None, **options: Unpack[TaskOptions]
) -> GymTask:
    """Returns the task of these arguments, which are those of `DroneEnv`.

    Raises:
        ConfigError: if they do not fit each other, or the world cannot be flown.
    """
    return GymTask(*functional.make(world, config, **options), limit)
