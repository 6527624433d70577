"""The task as pure functions in the manner of gymnax: every step takes a key, a state, a move and parameters.

    from edqn_jax.interop import functional

    env, params = functional.make("medium", observation="kinematics")
    observation, state = env.reset(key, params)
    observation, state, reward, terminated, truncated, info = env.step(key, state, action, params)

All functions are of one drone; `jax.vmap`, `jax.jit` and `jax.lax.scan` apply. They need no extra.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import FAMILIES, Config
from edqn_jax.config.loading import check_config, make_config
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.errors import ConfigError
from edqn_jax.learn.actor import AgentActor, PolicyParams
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.perception.code import Params as EncoderParams
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import check_has_params
from edqn_jax.sim.actions import Box, Discrete
from edqn_jax.sim.environment import make as make_environment
from edqn_jax.sim.sensors.sensor import sensor_of
from edqn_jax.sim.task.action_sets import checked_action
from edqn_jax.sim.task.env import EnvParams, EnvState
from edqn_jax.sim.task.observation import Observation
from edqn_jax.sim.task.outcomes import Outcome, is_terminal
from edqn_jax.sim.task.reward import Reward
from edqn_jax.sim.task.task import Task, task_of

Kind = Literal["image", "code", "kinematics"]
"""What a drone observes: an image with its own state and motion, one vector with a code, or one without."""

LARGEST = 10.0
"""Bound of each number of an observation; what is flown stays within, and is cut off there."""

WORLDS = 64
"""Random worlds of an environment unless it is told how many, each with a mission of its own."""

Observed = Any
"""An observation: a dict of `image` [H, W, ...], `own` [10] and `motion` [7], or a vector [N]; float32."""


@struct.dataclass
class Params:
    """Arrays that an environment depends on; others of the same shapes need no new compilation."""

    world: EnvParams
    encoder: EncoderParams  # {} unless codes are observed


@struct.dataclass
class State:
    """One drone between two decisions."""

    flight: EnvState


@dataclasses.dataclass(frozen=True)
class FunctionalEnv:
    """The functions of one drone; a static argument of `jax.jit`, or closed over."""

    config: Config
    observation: Kind

    @property
    def task(self) -> Task:
        """Returns the task that is flown, without what is observed of it."""
        return task_of(self.config)

    @property
    def num_actions(self) -> int:
        """Returns the number of moves.

        Raises:
            ConfigError: if actions are not numbered.
        """
        space = self.task.actions
        if not isinstance(space, Discrete):
            raise ConfigError(f"actions of '{self.config.env.actions}' have no numbers; ask `action_space`")
        return space.n

    def action_space(self, params: Params | None = None) -> Discrete | Box:
        """Returns the space of actions: of moves numbers, of other `env.actions` a box."""
        return self.task.actions

    @as_tested
    def observation_space(self, params: Params | None = None) -> Box | dict[str, Box]:
        """Returns the space of observations, of `image` one for each name."""
        own, motion = self.task.own_size, self.task.motion_size
        if self.observation == "kinematics":
            return _box(own + motion)
        if self.observation == "code":
            return _box(embedding.embedding_size(self.config) + own + motion)
        image = jax.eval_shape(lambda: _image_of(self.config)).shape
        return {"image": _box(*image), "own": _box(own), "motion": _box(motion)}

    @as_tested
    def reset(self, key: Array, params: Params, mission: Array | None = None) -> tuple[Observed, State]:
        """Begins an episode: at rest at the start of a mission, facing its goal.

        Args:
            key: consumed.
            params: as `make` returned them.
            mission: [] int, which one; None draws one.
        """
        mission = None if mission is None else jnp.asarray(mission, jnp.int32)
        flight, seen = self.task.reset(params.world, key, mission)
        return self.observe(params, seen), State(flight)

    @as_tested
    def step(
        self, key: Array, state: State, action: Array, params: Params
    ) -> tuple[Observed, State, Array, Array, Array, dict[str, Array]]:
        """Flies one decision of 0.26 s, or resets a drone whose episode has ended.

        The observation after an episode's last decision is its final one. The step after it ignores the move and
        returns the first observation of a new episode, with reward 0 and `is_reset`: no transition, to be left out of
        what is learnt.

        Args:
            key: consumed, in place of the state's own; with `state.flight.key` flights are those of `edqn_jax.make`.
            action: [] int, 0..26; with another `env.actions` numbers [A] in [-1, 1], beyond which they are clipped.
                Within `jax.jit`, `jax.vmap` and `jax.lax.scan` its numbers are not known yet: there another move flies
                in place of one that does not exist, and numbers that are not finite end the episode as diverged.

        Returns:
            observation, state, reward [], terminated [] bool: goal, collision, volume left or diverged, truncated []
            bool: out of time, and info: `outcome` [] int32 of `edqn_jax.Outcome`, `is_success` [] bool, `is_reset` []
            bool, `episode_return` [] and `episode_length` [] int32 of the episode so far.

        Raises:
            ConfigError: if there is no such action.
        """
        action = checked_action(self.config, action)
        flight, step = self.task.step(params.world, dataclasses.replace(state.flight, key=key), action)
        info = {
            "outcome": step.outcome,
            "is_success": step.outcome == Outcome.GOAL,
            "is_reset": step.is_reset,
            "episode_return": step.episode_return,
            "episode_length": step.episode_length,
        }
        observed = self.observe(params, step.observation)
        truncated = step.outcome == Outcome.TIME_OUT
        return observed, State(flight), step.reward, is_terminal(step.outcome), truncated, info

    @as_tested
    def step_autoreset(
        self, key: Array, state: State, action: Array, params: Params
    ) -> tuple[Observed, State, Array, Array, Array, dict[str, Any]]:
        """Flies one decision, and begins a new episode at once where it ended one.

        As `step`, but where an episode ends, the observation and the state are the first of a new one, no step is spent
        on it, and `is_reset` is never true. `info["final_observation"]` is what the decision led to, at an end or
        not: what a bootstrap must look at. Both observations are computed at every step, so with a camera `step`
        takes little more than half the time.
        """
        key, again = jax.random.split(key)
        observed, after, reward, terminated, truncated, info = self.step(key, state, action, params)
        first, fresh = self.reset(again, params)
        ended = terminated | truncated
        choose = lambda new, old: jax.tree.map(lambda x, y: jnp.where(ended, x, y), new, old)  # noqa: E731
        info["final_observation"] = observed
        return choose(first, observed), choose(fresh, after), reward, terminated, truncated, info

    def observe(self, params: Params, seen: Observation) -> Observed:
        """Returns what is observed of what the drone knows: `seen` in the form that `observation` names."""
        own, motion = _numbers(seen.own), _numbers(seen.motion)
        if self.observation == "kinematics":
            return jnp.concatenate([own, motion])
        if self.observation == "code":
            code = AgentActor(self.config).embed(PolicyParams(params.encoder, q={}), seen)
            assert code is not None
            return jnp.concatenate([_numbers(code), own, motion])
        image = sensor_of(self.config).numbers(self.config, seen.sensed)
        return {"image": _numbers(image), "own": own, "motion": motion}


@as_tested
def make(
    world: str | Path | None = None,
    config: Config | None = None,
    *,
    observation: Kind = "image",
    policy: Policy | None = None,
    worlds: int | None = None,
    world_seed: int = 0,
    reward: Reward | None = None,
) -> tuple[FunctionalEnv, Params]:
    """Makes an environment and its parameters.

    Args:
        world: `paper`, the name of random worlds or an MJCF file; None takes that of `config` or `policy`.
        config: of drone, camera, sensor and task; without it the default for that world.
        observation: `image` is a dict of `image`, `own` [10] and `motion` [7]: the image holds the signed number of
            events of each pixel as a logarithm, [H, W], or what another sensor of the configuration shows. `code` is
            one vector of code, own state and own motion. `kinematics` is own state and motion, without a sensor.
        policy: for `code`: whose encoder makes the codes.
        worlds: random worlds, of which each reset draws one; None is `WORLDS`, and 1 for a world from a file.
        world_seed: which random worlds, of those that training draws from.
        reward: of every decision, in place of the configured one: a function of a `Transition`.

    Raises:
        ConfigError: if the arguments do not fit each other, or the world cannot be flown.
    """
    check_config(config)
    if observation not in get_args(Kind):
        raise ConfigError(f"observation must be one of {', '.join(get_args(Kind))}, not '{observation}'")
    if (policy is not None) != (observation == "code"):
        raise ConfigError("observation 'code' needs a policy, whose encoder makes the codes, and the others need none")
    if policy is not None:
        check_has_params(policy, "observation 'code'")
        if config is not None:
            raise ConfigError("config must be None with a policy, which has its own")
        if not embedding.has_code(policy.config):
            raise ConfigError(f"the policy's sensor '{policy.config.env.sensor}' has no encoder, so there are no codes")
        config = policy.config
    elif config is None:
        config = make_config(str(world) if world is not None else None)
    if observation == "kinematics":
        config = dataclasses.replace(config, env=dataclasses.replace(config.env, sensor="blind"))
    if observation == "image" and not sensor_of(config).shapes(config):
        raise ConfigError(f"the sensor '{config.env.sensor}' shows nothing; set observation to 'kinematics'")
    name = str(world) if world is not None else config.world.name
    if worlds is None:
        worlds = WORLDS if name in FAMILIES else 1
    made = make_environment(name, config, worlds=worlds, seed=world_seed, reward=reward)
    encoder = {} if policy is None else policy.params.encoder
    return FunctionalEnv(config, observation), Params(made.world, encoder)


def _numbers(x: Array) -> Array:
    """Returns any numbers as float32 within `LARGEST`."""
    return jnp.clip(x.astype(jnp.float32), -LARGEST, LARGEST)


def _image_of(config: Config) -> Array:
    sensor = sensor_of(config)
    return sensor.numbers(config, sensor.example(config))


def _box(*shape: int) -> Box:
    return Box(-LARGEST, LARGEST, shape)
