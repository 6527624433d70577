"""Action sets: what a number or a vector of the policy commands the drone to do.

An action set is named in `env.actions` and found in `config.registry.ACTION_SETS`:

    from edqn_jax.config.registry import ACTION_SETS

    ACTION_SETS.register("mine", ActionSet(space=..., still=..., command=..., direction=...))

`moves` (default) are 27 directions at one speed; `velocity` is any velocity in the same box; `body-rates` are thrust
and rates about the body's axes, without the loops that hold velocity, attitude and heading.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from edqn_jax.checks import check_finite, check_index
from edqn_jax.config import Config, EnvConfig
from edqn_jax.config.registry import ACTION_SETS
from edqn_jax.errors import ConfigError
from edqn_jax.sim.actions import ACTIONS, HOVER, Box, Discrete, move_number, parse_move
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.airframe import Airframe
from edqn_jax.sim.physics.controller import Command, RateCommand, VelocityCommand
from edqn_jax.sim.physics.drone import DroneState
from edqn_jax.user_code import check_functions, describe_object


@dataclasses.dataclass(frozen=True, eq=False)
class ActionSet:
    """What actions are, and what they command. All functions are pure and of one drone."""

    space: Discrete | Box
    still: ArrayLike
    """An action that holds the drone where it is; with `env.action_delay` the first decision flies it."""
    command: Callable[[Config, Airframe, DroneState, Array, Array], Command]
    """(config, airframe, state, goal [3], action) → what the controller holds for one decision."""
    direction: Callable[[DroneState, Array], Array]
    """(state after the decision, action) → the commanded direction [3] in the heading frame, each value of order 1:
    the end of the own motion."""

    def __post_init__(self) -> None:
        """Checks the space, the action that stands still, and what each function takes.

        Raises:
            ConfigError: names the field and what it must be.
        """
        if not isinstance(self.space, Discrete | Box):
            raise ConfigError(f"`space` of ActionSet must be Discrete or Box, not {describe_object(self.space)}")
        if not are_actions(self.space, np.asarray(self.still)):
            raise ConfigError(f"`still` of ActionSet must be {describe_space(self.space)}, not {self.still!r}")
        check_functions(self, {"command": "config, airframe, state, goal, action", "direction": "state, action"})


def action_set(config: Config) -> ActionSet:
    """Returns the action set that a configuration names.

    Raises:
        ConfigError: if there is none of that name.
    """
    return ACTION_SETS.get(config.env.actions)


def clip_action(space: Discrete | Box, action: Array) -> Array:
    """Returns an action [] or [A] as it is flown: in a box clipped to its bounds, NaN where it is not finite.

    NaN lets the decision diverge, as any other number that is not finite.

    Raises:
        ConfigError: if it has another shape.
    """
    action = jnp.asarray(action, space.dtype)
    if action.shape != space.shape:
        raise ConfigError(f"an action is {describe_space(space)}, not an array of shape {action.shape}")
    if isinstance(space, Discrete):
        check_index(action, space.n, "the moves")
        return action
    check_finite(action, "an action")
    return jnp.where(jnp.isfinite(action), jnp.clip(action, space.low, space.high), jnp.nan)


def action_of(config: Config, given: str | ArrayLike) -> Array:
    """Returns an action [] or [A] that a person gave: of moves also by vector or name, see `actions.move_number`.

    Raises:
        ConfigError: if there is no such action. Numbers that JAX is tracing are taken as they are.
    """
    return move_number(given) if config.env.actions == "moves" else checked_action(config, given)


def checked_action(config: Config, given: str | ArrayLike) -> Array:
    """Returns an action [] or [A] in the type of its space.

    Raises:
        ConfigError: if there is no such action. Numbers that JAX is tracing are taken as they are.
    """
    if isinstance(given, Tracer):
        return given
    space = action_set(config).space
    try:
        numbers = np.asarray(given)
    except ValueError:  # rows of several lengths
        numbers = np.array(None)
    if not are_actions(space, numbers):
        told = given.tolist() if isinstance(given, Array | np.ndarray) else given
        raise ConfigError(f"an action of '{config.env.actions}' is {describe_space(space)}, not {told!r}")
    return jnp.asarray(numbers, space.dtype)


def are_actions(space: Discrete | Box, numbers: np.ndarray, many: tuple[int, ...] = ()) -> bool:
    """Returns whether numbers [*many, ...] are actions of a space, which clips those of a box to its bounds."""
    if numbers.shape != (*many, *space.shape):
        return False
    if isinstance(space, Discrete):
        return np.issubdtype(numbers.dtype, np.integer) and bool(np.all((numbers >= 0) & (numbers < space.n)))
    return np.issubdtype(numbers.dtype, np.number) and bool(np.isfinite(numbers).all())


def describe_space(space: Discrete | Box) -> str:
    """Returns what an action is, in words."""
    if isinstance(space, Discrete):
        return f"a whole number from 0 to {space.n - 1}"
    return f"{space.shape[0]} finite numbers from {space.low:g} to {space.high:g}"


def velocity_command(config: EnvConfig, action: Array, yaw: Array) -> Array:
    """World velocity [3] m/s that the move `action` (0..26) commands at heading `yaw`."""
    return world_velocity(config, jnp.asarray(ACTIONS, jnp.float32)[action], yaw)


def world_velocity(config: EnvConfig, direction: Array, yaw: Array) -> Array:
    """World velocity [3] m/s of `direction` [3] in the heading frame, in commanded speeds, at heading `yaw`."""
    move = direction * config.speed_m_s
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos * move[0] - sin * move[1], sin * move[0] + cos * move[1], move[2]])


def heading_to_goal(config: EnvConfig, state: DroneState, goal: Array) -> Array:
    """Heading setpoint [] radians of the next decision: towards the goal [3], or held when it is (nearly) overhead."""
    ahead = goal - state.position
    near = ahead[0] ** 2 + ahead[1] ** 2 < config.heading_hold_m**2
    return jnp.where(near, state.yaw_setpoint, jnp.arctan2(ahead[1], ahead[0]))


def heading_setpoint(config: EnvConfig, state: DroneState, goal: Array, command: Array) -> Array:
    """Heading setpoint [] radians of the next decision: `heading_to_goal`, or along the commanded velocity.

    Args:
        command: [3] m/s in the world; without a horizontal part the setpoint stays.
    """
    if config.heading == "goal":
        return heading_to_goal(config, state, goal)
    level = command[0] ** 2 + command[1] ** 2
    return jnp.where(level > 0, jnp.arctan2(command[1], command[0]), state.yaw_setpoint)


def _towards(config: Config, state: DroneState, goal: Array, velocity: Array) -> VelocityCommand:
    return VelocityCommand(velocity, heading_setpoint(config.env, state, goal, velocity))


def _move(config: Config, airframe: Airframe, state: DroneState, goal: Array, action: Array) -> Command:
    return _towards(config, state, goal, velocity_command(config.env, action, drone.yaw_of(state.quaternion)))


MOVES = ActionSet(
    space=Discrete(len(ACTIONS)),
    still=np.int32(parse_move(HOVER)),
    command=_move,
    direction=lambda state, action: jnp.asarray(ACTIONS, jnp.float32)[action],
)
"""27 moves, {-1, 0, 1}^3 in the heading frame: one commanded speed on each axis, or none."""


def _velocity(config: Config, airframe: Airframe, state: DroneState, goal: Array, action: Array) -> Command:
    return _towards(config, state, goal, world_velocity(config.env, action, drone.yaw_of(state.quaternion)))


VELOCITY = ActionSet(
    space=Box(-1.0, 1.0, (3,)),
    still=np.zeros(3, np.float32),
    command=_velocity,
    direction=lambda state, action: jnp.where(jnp.isfinite(action), action, 0.0),
)
"""Velocity [3] ahead, left and up in the heading frame, in commanded speeds; the drone turns as with moves."""


def _rates(config: Config, airframe: Airframe, state: DroneState, goal: Array, action: Array) -> Command:
    level, turn = config.drone.max_body_rate_rad_s, config.drone.max_yaw_rate_rad_s
    weight = airframe.mass * airframe.gravity
    return RateCommand(thrust=weight * (1.0 + action[0]), rates=action[1:] * jnp.array([level, level, turn]))


def _pushes(state: DroneState, action: Array) -> Array:
    """Returns the direction of the thrust [3] in the heading frame, which tells the tilt."""
    w, x, y, z = state.quaternion
    # The quaternion with the turn about the world's z axis taken off has no z.
    level = jnp.sqrt(w * w + z * z)
    cos, sin = w / jnp.maximum(level, 1e-9), z / jnp.maximum(level, 1e-9)  # of half the heading
    roll, pitch = cos * x + sin * y, cos * y - sin * x
    return jnp.stack([2 * level * pitch, -2 * level * roll, 1 - 2 * (x * x + y * y)])


BODY_RATES = ActionSet(
    space=Box(-1.0, 1.0, (4,)),
    still=np.zeros(4, np.float32),
    command=_rates,
    direction=_pushes,
)
"""Thrust, and rates about the body's axes x, y and z [4]. Thrust is nothing at -1, the weight at 0 and twice the weight
at 1. A rate of 1 is `drone.max_body_rate_rad_s` about x and y and `drone.max_yaw_rate_rad_s` about z."""
