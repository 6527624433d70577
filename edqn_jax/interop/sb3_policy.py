"""A model of stable-baselines3 as a policy that flies wherever ours do; it needs what the model needs, and no extra.

    from edqn_jax.interop.sb3_policy import sb3_policy

    edqn_jax.evaluate(sb3_policy(PPO.load("ppo.zip"), observation="kinematics"), "medium", missions=100)

The model runs on the host, for all drones at once: each decision of the flights' compiled program calls it back.
"""

from __future__ import annotations

import dataclasses
from typing import Any, get_args

import jax
import numpy as np
from jax import Array

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.interop.functional import Box, FunctionalEnv, Kind, Params
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import FunctionPolicy
from edqn_jax.sim.task.action_sets import describe_space
from edqn_jax.sim.task.env import Observation


def sb3_policy(
    model: Any,
    config: Config | None = None,
    *,
    observation: Kind = "image",
    policy: Policy | None = None,
    deterministic: bool = True,
) -> FunctionPolicy:
    """Returns a trained model as a policy for `evaluate`, `record` and `write_report`.

    Args:
        model: of stable-baselines3, or whatever has `predict(observations, deterministic=...)` and the spaces.
        config: of drone, camera, sensor and task, as the model's environment had; None is the default of
            `make_config()`, with a policy that of the policy.
        observation: as the model's environment had, see `DroneEnv`.
        policy: for `code`: whose encoder made the codes.
        deterministic: take the likeliest action, as an evaluation does, instead of a random one.

    Raises:
        ConfigError: if the model was trained with other observations or actions, or the arguments do not fit each
            other.
    """
    if observation not in get_args(Kind):
        raise ConfigError(f"observation must be one of {', '.join(get_args(Kind))}, not '{observation}'")
    if (policy is not None) != (observation == "code"):
        raise ConfigError("observation 'code' needs a policy, whose encoder makes the codes, and the others need none")
    config = config or (make_config() if policy is None else policy.config)
    if observation == "kinematics":
        config = dataclasses.replace(config, env=dataclasses.replace(config.env, sensor="blind"))
    env = FunctionalEnv(config, observation)
    _check_fits(model, env)
    params = Params(world=None, encoder={} if policy is None else policy.params.encoder)  # type: ignore[arg-type]
    answer = jax.ShapeDtypeStruct(model.action_space.shape, _kind_of(model.action_space.dtype))

    def predict(observed: Any) -> np.ndarray:
        observed = jax.tree.map(np.asarray, observed)
        return np.asarray(model.predict(observed, deterministic=deterministic)[0], answer.dtype)

    def act(seen: Observation, memory: Array, key: Array) -> tuple[Array, Array]:
        observed = env.observe(params, seen)
        return jax.pure_callback(predict, answer, observed, vmap_method="broadcast_all"), memory

    return FunctionPolicy(act, config)


def _kind_of(kind: Any) -> Any:
    """Returns the type of an action in our programs: moves are int32 there, and of others float32."""
    return np.int32 if np.issubdtype(np.dtype(kind), np.integer) else np.float32


def _check_fits(model: Any, env: FunctionalEnv) -> None:
    """Raises unless a model's observations and actions are those of an environment.

    Raises:
        ConfigError: names both.
    """
    space, shown = model.observation_space, env.observation_space()
    trained = (
        {name: tuple(part.shape) for name, part in space.spaces.items()} if hasattr(space, "spaces") else space.shape
    )
    wanted = tuple(shown.shape) if isinstance(shown, Box) else {name: part.shape for name, part in shown.items()}
    if trained != wanted:
        raise ConfigError(
            f"this model was trained with observations {trained}, and '{env.observation}' with the sensor "
            f"'{env.config.env.sensor}' is {wanted}; give `observation` and `config` of its environment"
        )
    actions = env.action_space()
    kind = _kind_of(model.action_space.dtype)
    if tuple(model.action_space.shape) != actions.shape or kind != _kind_of(actions.dtype):
        raise ConfigError(
            f"this model's actions are {np.dtype(kind)}{list(model.action_space.shape)}, and an action of "
            f"'{env.config.env.actions}' is {describe_space(actions)}; give `config` of its environment"
        )
