"""A cascaded controller: velocity -> attitude -> body rate -> rotor thrust.

Everything is computed in scalars, one per coordinate: mapped over environments they are contiguous rows that XLA fuses
into a few loops.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.config import DroneConfig
from edqn_jax.sim.physics.airframe import Airframe
from edqn_jax.sim.physics.drone import DroneState, Scalars, body_axes, wrap_angle
from edqn_jax.xla import materialise_tree

LEAST_LEVELNESS = 0.4
"""Cosine of the tilt beyond which thrust no longer increases to hold the height."""


@struct.dataclass
class VelocityCommand:
    """Setpoints of the controller for one decision."""

    velocity: Array  # [3] m/s, world
    heading: Array  # [] radians, where the heading setpoint moves to


@struct.dataclass
class RateCommand:
    """Setpoints of the innermost loop for one decision: thrust and body rates."""

    thrust: Array  # [] newtons of all rotors together
    rates: Array  # [3] rad/s about the body's axes


Command = VelocityCommand | RateCommand


class Control(NamedTuple):
    """A controller during one decision."""

    thrusts: Callable[[DroneState, Any], Array]
    """(state, inputs of the physics step) → rotor thrusts [4] newtons."""
    inputs: Any
    """[physics_steps, ...]; None where there are none."""
    yaw_setpoint: Array
    """[] radians, after the decision."""


def control_of(
    config: DroneConfig, airframe: Airframe, state: DroneState, command: Command, velocities: Array | None = None
) -> Control:
    """Returns the controller of the decision that begins at `state` [...] and holds a command.

    `velocities` [physics_steps, 3] m/s (world) replace the one velocity that is commanded.
    """
    if isinstance(command, RateCommand):
        return Control(lambda now, _: rate_thrusts(config, airframe, now, command), None, state.yaw_setpoint)
    yaws = _setpoints(config, state, command.heading)

    def thrusts(now: DroneState, given: tuple[Array, Array, Array | None]) -> Array:
        cos, sin, velocity = given
        return _thrusts(config, airframe, now, command.velocity if velocity is None else velocity, cos, sin)

    return Control(thrusts, (jnp.cos(yaws / 2), jnp.sin(yaws / 2), velocities), wrap_angle(yaws[-1]))


def _setpoints(config: DroneConfig, state: DroneState, target_yaw: Array) -> Array:
    """Returns the yaw setpoints [physics_steps] radians of one decision, not wrapped."""
    steps = jnp.arange(1, config.physics_steps + 1, dtype=jnp.float32)
    most = config.max_yaw_rate_rad_s * config.physics_dt_s * steps
    return state.yaw_setpoint + jnp.clip(wrap_angle(target_yaw - state.yaw_setpoint), -most, most)


def rotor_thrusts(config: DroneConfig, airframe: Airframe, state: DroneState, velocity_command: Array) -> Array:
    """Returns rotor thrusts [4] newtons towards `velocity_command` [3] m/s (world) and the state's yaw setpoint.

    The velocity error gives a wanted specific force, its direction a wanted tilt of the body, the missing turn wanted
    body rates, their error a wanted torque. Within the rotors' limits torque about x and y comes first, then
    collective thrust, then torque about z.
    """
    half_yaw = state.yaw_setpoint / 2
    return _thrusts(config, airframe, state, velocity_command, jnp.cos(half_yaw), jnp.sin(half_yaw))


def _thrusts(
    config: DroneConfig,
    airframe: Airframe,
    state: DroneState,
    velocity_command: Array,
    cos_half_yaw: Array,
    sin_half_yaw: Array,
) -> Array:
    w, x, y, z = state.quaternion
    p, q, r = state.angular_velocity
    vx, vy, vz = velocity_command - state.velocity

    force = _target_force(config, airframe, (vx, vy, vz))
    axes = body_axes(w, x, y, z)
    direction = _in_body_frame(axes, force)
    turn = _wanted_yaw_rate(config, w, z, cos_half_yaw, sin_half_yaw)
    rates = _wanted_rates(config, direction, turn)
    torque = _torque(config, airframe, rates, (p, q, r))
    collective = _collective_thrust(airframe, force[2], axes[2][2])
    # Computed once, and not again for each rotor.
    return _allocate(config, airframe, *materialise_tree(jnp.stack([*torque, collective])))


def rate_thrusts(config: DroneConfig, airframe: Airframe, state: DroneState, command: RateCommand) -> Array:
    """Returns rotor thrusts [4] newtons for commanded thrust and body rates, within limits of `rotor_thrusts`."""
    p, q, r = command.rates
    torque = _torque(config, airframe, (p, q, r), tuple(state.angular_velocity))
    return _allocate(config, airframe, *materialise_tree(jnp.stack([*torque, command.thrust])))


def _target_force(config: DroneConfig, airframe: Airframe, error: Scalars) -> Scalars:
    """Returns the wanted specific force m/s^2 (world): acceleration plus gravity, for a velocity `error` m/s.

    Within the largest accelerations and the largest tilt.
    """
    vx, vy, vz = error
    fz = airframe.gravity + jnp.clip(config.climb_gain * vz, -config.max_descent_m_s2, config.max_climb_m_s2)
    fx, fy = config.velocity_gain * vx, config.velocity_gain * vy
    most = jnp.minimum(config.max_horizontal_m_s2, float(np.tan(config.max_tilt_rad)) * fz)
    scale = jnp.minimum(1.0, most * jax.lax.rsqrt(fx * fx + fy * fy + 1e-9))
    return fx * scale, fy * scale, fz


def _in_body_frame(axes: tuple[Scalars, Scalars, Scalars], force: Scalars) -> Scalars:
    """Returns the unit direction of `force` in the body frame; its x and y are the tilt that is still missing."""
    (ahead_x, ahead_y, ahead_z), (left_x, left_y, left_z), (up_x, up_y, up_z) = axes
    fx, fy, fz = force
    norm = jax.lax.rsqrt(fx * fx + fy * fy + fz * fz)
    return (
        (ahead_x * fx + left_x * fy + up_x * fz) * norm,
        (ahead_y * fx + left_y * fy + up_y * fz) * norm,
        (ahead_z * fx + left_z * fy + up_z * fz) * norm,
    )


def _wanted_rates(config: DroneConfig, direction: Scalars, yaw_rate: Array) -> Scalars:
    """Returns wanted body rates rad/s that turn the body's z axis to `direction` (body frame).

    2 sin(angle / 2) stands for the angle: no arc functions, strong up to 180 degrees.
    """
    ex, ey, ez = direction
    gain = jnp.minimum(
        config.attitude_gain * jax.lax.rsqrt(jnp.maximum(0.5 + 0.5 * ez, 1e-2)),
        config.max_body_rate_rad_s * jax.lax.rsqrt(ex * ex + ey * ey + 1e-9),
    )
    return -gain * ey, gain * ex, yaw_rate


def _wanted_yaw_rate(config: DroneConfig, w: Array, z: Array, cos_half_yaw: Array, sin_half_yaw: Array) -> Array:
    """Returns the wanted rate about z [] rad/s from the heading error, 2 sin(angle / 2) for the angle as above."""
    cos_error = w * cos_half_yaw + z * sin_half_yaw
    sin_error = w * sin_half_yaw - z * cos_half_yaw
    rate = 2 * config.yaw_gain * sin_error * jnp.sign(cos_error) * jax.lax.rsqrt(w * w + z * z + 1e-6)
    return jnp.clip(rate, -config.max_yaw_rate_rad_s, config.max_yaw_rate_rad_s)


def _torque(config: DroneConfig, airframe: Airframe, wanted: Scalars, rates: Scalars) -> Scalars:
    """Returns the torque N m (body) from rates to `wanted` rates rad/s, gyroscopic torque included."""
    (wanted_p, wanted_q, wanted_r), (p, q, r) = wanted, rates
    ix, iy, iz = airframe.inertia
    return (
        ix * config.rate_gain * (wanted_p - p) + (iz - iy) * q * r,
        iy * config.rate_gain * (wanted_q - q) + (ix - iz) * p * r,
        iz * config.yaw_rate_gain * (wanted_r - r) + (iy - ix) * p * q,
    )


def _collective_thrust(airframe: Airframe, fz: Array, levelness: Array) -> Array:
    """Returns the thrust [] newtons with vertical specific force `fz` at cos(tilt) `levelness`; 0 upside down."""
    return airframe.mass * fz * jnp.maximum(levelness, 0.0) / jnp.maximum(levelness * levelness, LEAST_LEVELNESS**2)


def _allocate(
    config: DroneConfig, airframe: Airframe, torque_x: Array, torque_y: Array, torque_z: Array, collective: Array
) -> Array:
    """Returns rotor thrusts [4] newtons within their limits: torque about x and y, then collective, then torque z."""
    rotors = range(airframe.mixer.shape[0])
    mixer, limit = airframe.mixer, airframe.max_thrust
    tilting = [mixer[i, 1] * torque_x + mixer[i, 2] * torque_y for i in rotors]
    low, high = _least(tilting), -_least([-t for t in tilting])
    scale = jnp.minimum(1.0, config.max_tilt_share * limit / (high - low + 1e-9))
    shared = jnp.clip(mixer[0, 0] * collective, -scale * low, limit - scale * high)
    levelled = [shared + scale * t for t in tilting]
    margin = jnp.maximum(0.0, _least([jnp.minimum(t, limit - t) for t in levelled]))
    turning = jnp.clip(jnp.abs(mixer[0, 3]) * torque_z, -margin, margin)
    spins = [jnp.sign(mixer[i, 3]) for i in rotors]
    return jnp.stack([jnp.clip(t + spins[i] * turning, 0.0, limit) for i, t in enumerate(levelled)])


def _least(values: list[Array]) -> Array:
    least = values[0]
    for value in values[1:]:
        least = jnp.minimum(least, value)
    return least
