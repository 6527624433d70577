"""Reward of a decision: Eq. 8 of the paper, its shaped forms, and reward functions of users."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.config import EnvConfig
from edqn_jax.errors import ConfigError
from edqn_jax.sim.task.outcomes import Outcome, is_terminal
from edqn_jax.user_code import check_takes, describe_object


@struct.dataclass
class Transition:
    """One decision of one drone: the argument of a user's reward function."""

    before: Array  # [3] metres, position when it was taken
    after: Array  # [3] metres, position 0.26 s later
    goal: Array  # [3] metres
    clearance: Array  # [] metres between the body's sphere and the nearest shape afterwards; negative inside one
    move: Array  # [] int32, 0..26, or numbers [A], see `env.actions`; as chosen, also where it is flown later
    outcome: Array  # [] int32, an `Outcome`
    configured: Array  # [] the reward that the configuration asks for


Reward = Callable[[Transition], Array]
"""A user's reward: one decision of one drone to a float32 []; it is traced by JAX and mapped over environments."""


def check_reward(function: Reward | None) -> None:
    """Raises unless a reward can be called with a transition; None is the configured one.

    Raises:
        ConfigError: says what it must take.
    """
    if function is not None:
        check_takes(function, "transition", "a reward")


def reward_of(function: Reward, transition: Transition) -> Array:
    """Returns the reward [] float32 of a user's function.

    Raises:
        ConfigError: if it returns anything but one number.
    """
    found = function(transition)
    if not isinstance(found, Array | np.ndarray | np.generic | int | float):
        raise ConfigError(f"a reward must return one number, a float32 [], not {describe_object(found)}")
    if jnp.shape(found):
        raise ConfigError(f"a reward must return one number, a float32 [], not an array of shape {jnp.shape(found)}")
    return jnp.asarray(found, jnp.float32)


def configured_reward(
    config: EnvConfig,
    outcome: Array,
    before: Array,
    after: Array,
    path_m: Array | float = 0.0,
    clearance: Array | None = None,
) -> Array:
    """Returns the configured reward [] of one decision.

    `sparse` is Eq. 8. `progress` adds the metres gained towards the goal, times a weight, and
    subtracts a weight for each metre flown; `geodesic` uses distances around obstacles. `potential` adds
    gamma * Phi(s') - Phi(s) with Phi = -weight * distance and gamma `env.potential_discount`, and Phi = 0 at terminal
    states: the form that leaves the optimal policy unchanged (Ng et al. 1999). With `closeness_weight`, all of them
    lose the more the nearer the decision ended to an obstacle.

    Args:
        before, after: [] distances to the goal, metres; straight, or along the shortest way (`geodesic`).
        path_m: [] metres flown.
        clearance: [] metres to the nearest obstacle afterwards; needed with `closeness_weight`.
    """
    at_end = jnp.select(
        [outcome == Outcome.GOAL, outcome == Outcome.COLLISION, outcome == Outcome.LEFT_VOLUME],
        [config.goal_reward, config.collision_reward, config.left_volume_reward],
        0.0,
    )
    total = at_end + config.step_reward
    if config.reward in ("progress", "geodesic"):
        total = total + config.progress_weight * (before - after) - config.path_weight * path_m
    elif config.reward == "potential":
        terminal = is_terminal(outcome)
        total = total + config.progress_weight * (before - jnp.where(terminal, 0.0, config.potential_discount * after))
    if config.closeness_weight:
        assert clearance is not None, "closeness needs the clearance"
        total = total - config.closeness_weight * jnp.clip(1.0 - clearance / config.closeness_m, 0.0, 1.0)
    return jnp.where(outcome == Outcome.DIVERGED, 0.0, total)
