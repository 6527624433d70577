"""Policies of other people: a function of an observation, a memory and a key, that flies wherever ours do."""

from __future__ import annotations

import dataclasses
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.checks import tree_form
from edqn_jax.config import Config
from edqn_jax.config.loading import check_config, make_config, suggest_nearest
from edqn_jax.errors import ConfigError
from edqn_jax.learn.actor import Actor, AgentActor
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.policy import Policy
from edqn_jax.policies import function_named
from edqn_jax.sim.actions import Discrete
from edqn_jax.sim.task.action_sets import action_of, action_set, clip_action
from edqn_jax.sim.task.env import Observation
from edqn_jax.sim.task.observation import motion_size
from edqn_jax.user_code import check_takes, load_module

Function = Callable[[Observation, Any, Array], tuple[Any, Any]]
"""(observation of one drone, memory, key consumed) → action, memory for the next observation; traced by JAX."""

TAKES = "a function (observation, memory, key) -> (action, memory)"
"""What a policy of one's own is, in messages."""

_ASKED_TOO_SOON = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
"""What JAX raises where Python asks for a number that is known in flight alone."""


@dataclasses.dataclass(frozen=True)
class FunctionActor(Actor):
    """Acts by a function; what it decides on is its memory and the observation as it is."""

    function: Function
    memory: Callable[[], Any] | None = None
    config: Config = dataclasses.field(default_factory=Config)

    def init(self) -> Any:
        """Returns the memory of one drone at the beginning of an episode, as arrays; None where there is none."""
        begins = None if self.memory is None else self.memory()
        # An explicit type: a memory of Python's numbers would take that of what the function makes of them.
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype), begins)

    def encode(self, params: None, memory: Any, observation: Observation) -> tuple[Any, Observation]:
        """Returns memory and observation."""
        return memory, observation

    def decide(self, params: None, seen: tuple[Any, Observation], key: Array) -> tuple[Array, Any]:
        """Returns the action as it is flown, a move as its number [] int32, and the memory.

        Raises:
            ConfigError: if the function does not return an action and a memory like the one that it was given, or asks
                for numbers that are known in flight alone.
        """
        memory, observation = seen
        try:
            result = self.function(observation, memory, key)
        except _ASKED_TOO_SOON as error:
            raise ConfigError(
                f"a policy's function is traced by JAX, so its numbers are known in flight alone, and `if`, `and`, "
                f"float() or NumPy cannot ask for them{_line_of(error)}; write jnp.where, and jax.numpy for numpy"
            ) from None
        if not (isinstance(result, tuple) and len(result) == 2):
            raise ConfigError(f"a policy is {TAKES}; this one returned {type(result).__name__}")
        action, after = result
        before, now = tree_form(memory), tree_form(after)
        if before != now:
            raise ConfigError(
                f"a policy's function must return a memory like the one that it is given, {before}, not {now}; "
                "`memory` of FunctionPolicy returns the first one"
            )
        if action is None:
            raise ConfigError(f"a policy is {TAKES}; this one returned None in place of an action")
        return self._flown(action), after

    def _flown(self, action: Any) -> Array:
        """Returns an action as it is flown and recorded: what is computed is cut off at the bounds of its space."""
        space = action_set(self.config).space
        if not isinstance(space, Discrete):
            return clip_action(space, action_of(self.config, action))
        if not isinstance(action, str) and jnp.issubdtype(jnp.asarray(action).dtype, jnp.floating):
            return jnp.asarray(action)  # no number of an action; what flies it says so
        return jnp.clip(action_of(self.config, action), 0, space.n - 1)


def _line_of(error: Exception) -> str:
    """Returns the last line that is neither JAX's nor of this file, in words: where a function went wrong."""
    library = str(Path(jax.__file__).parent)
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if frame.filename != __file__ and not frame.filename.startswith(library):
            return f" (line {frame.lineno} of '{Path(frame.filename).name}': {frame.line})"
    return ""


@dataclasses.dataclass(frozen=True)
class FunctionPolicy:
    """A policy that is a function, for `evaluate`, `record` and `write_report`.

    The function sees one drone and is traced by JAX, so it is written with `jnp.where` instead of `if`; what else it
    uses must not change after the first flight.
    """

    function: Function
    """Returns action and memory of an observation, a memory and a key; an action is a move's number, vector or name,
    or what `env.actions` of the configuration says."""
    config: Config | None = None
    """Drone, camera, sensor and task; None is the default for the world that is flown."""
    memory: Callable[[], Any] | None = None
    """Returns the memory at the beginning of an episode, any arrays; without it the memory is None."""

    def __post_init__(self) -> None:
        """Checks what can be checked before it flies.

        Raises:
            ConfigError: if the function or `memory` cannot be called, the function has no hash or other arguments, or
                `config` is no configuration.
        """
        check_config(self.config)
        if not callable(self.function) or isinstance(self.function, type):
            raise ConfigError(f"a policy is {TAKES}, not {self.function!r}")
        try:
            hash(self.function)
        except TypeError:
            raise ConfigError(
                f"a policy's function must be hashable, as functions and frozen dataclasses are, not {self.function!r}"
            ) from None
        if self.memory is not None and not callable(self.memory):
            raise ConfigError(f"memory must be a function that returns the first memory, not {self.memory!r}")
        check_takes(self.function, "observation, memory, key", "a policy")
        if self.memory is not None:
            check_takes(self.memory, "", "memory")

    @property
    def params(self) -> None:
        """Returns None: a function has no parameters."""
        return None


def as_policy(policy: Policy | FunctionPolicy | Function, world: str | Path | None = None) -> Policy | FunctionPolicy:
    """Returns a policy as it is, and a function as one; the configuration that is not given is that of the world.

    Raises:
        ConfigError: if it is neither.
    """
    if isinstance(policy, Policy):
        return policy
    if isinstance(policy, str | Path):
        raise ConfigError(f"a policy is {TAKES}, or what edqn_jax.load_policy('{policy}') returns, not its name")
    own = policy if isinstance(policy, FunctionPolicy) else FunctionPolicy(policy)
    if own.config is None:
        return dataclasses.replace(own, config=make_config(None if world is None else str(world)))
    return own


def config_of(policy: Policy | FunctionPolicy) -> Config:
    """Returns the configuration of what `as_policy` returned."""
    assert policy.config is not None
    return policy.config


def actor_of(policy: Policy | FunctionPolicy, config: Config) -> Actor:
    """Returns what flies a policy under a configuration, which may have other conditions than the policy's own.

    Raises:
        ConfigError: if its encoder would be given another number of values of the own motion than it knows.
    """
    if isinstance(policy, FunctionPolicy):
        return FunctionActor(policy.function, policy.memory, config)
    known, given = motion_size(policy.config), motion_size(config)
    if known != given and embedding.has_code(config):
        raise ConfigError(
            f"this policy's encoder knows {known} values of the own motion and would be given {given}, with roll "
            f"and pitch at each pose from which the sensor '{config.env.sensor}' looks, as camera.mount is body; "
            "exposure.real, longest_s, rate_hz and latency_s must be those that it was trained with"
        )
    return AgentActor(config)


def check_has_params(policy: Policy | FunctionPolicy, what: str) -> None:
    """Raises unless a policy was trained here.

    Raises:
        ConfigError: says what needs it.
    """
    if not isinstance(policy, Policy):
        raise ConfigError(f"{what} needs a policy of `train` or `load_policy`, with parameters, not a function")


def load_function(name: str) -> Policy | FunctionPolicy | Function:
    """Returns what `module:name` or `path/to/file.py:name` names.

    Modules are searched for in the current folder, too, and what a file imports in the file's folder.

    Raises:
        ConfigError: if it does not load, or is not what can fly.
    """
    found = function_named(name)
    assert found is not None
    where, attribute = found
    module = load_module(where)
    if not hasattr(module, attribute):
        names = [each for each in vars(module) if not each.startswith("_")]
        raise ConfigError(f"'{where}' has no '{attribute}'{suggest_nearest(attribute, names)}")
    policy = getattr(module, attribute)
    if not isinstance(policy, Policy | FunctionPolicy) and (not callable(policy) or isinstance(policy, type)):
        raise ConfigError(f"'{name}' is of the type {type(policy).__name__}; a policy is {TAKES}, or a FunctionPolicy")
    return policy  # pyright: ignore[reportReturnType]  # what it takes is seen when it is called
