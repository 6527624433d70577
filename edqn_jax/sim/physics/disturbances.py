"""Disturbances: wind, gusts and drag, body and motors that differ from the controller's model,
moves that are delayed by a decision, velocities that an autopilot changes slowly, and errors of the state estimate.

All is drawn anew for each episode; with every option off there is no state and nothing is computed.

Gusts are Dryden's model as MIL-F-8785C has it at low altitude: three white noises through linear filters,

    H_u(s) = sigma_u sqrt(2 T_u / pi) / (1 + T_u s)                              T_u = L_u / V
    H_v(s) = sigma_v sqrt(T_v / pi) (1 + sqrt(3) T_v s) / (1 + T_v s)^2          T_v = L_v / V, w likewise

whose autocorrelations are sigma_u^2 exp(-t / T_u) and sigma_v^2 (1 - t / (2 T_v)) exp(-t / T_v). The filters are
stepped exactly: a step of any length has the covariance of the continuous process.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import AirConfig, Config, DroneConfig, MotorsConfig, NoiseConfig

AIR_DENSITY = 1.225
"""Density of air at sea level, kg/m^3 (International Standard Atmosphere)."""

METRES_PER_FOOT = 0.3048

GUST_STATES = 5
"""Numbers that the filters of gusts carry: one along, two across, two up."""


@struct.dataclass
class Disturbance:
    """Disturbances of an episode, with the state they carry from step to step; None for all that are off. R = 4."""

    ahead: Array | None = None  # [2] horizontal unit vector that the wind blows along, and u of the gusts
    wind: Array | None = None  # [] m/s, steady
    gusts: Array | None = None  # [GUST_STATES] of the filters, without a unit
    mass: Array | None = None  # [] flown mass per nominal mass
    inertia: Array | None = None  # [] flown inertia per nominal inertia
    gain: Array | None = None  # [R] flown thrust per commanded thrust
    lag_s: Array | None = None  # [] time constant of the thrusts
    thrust: Array | None = None  # [R] newtons, before the gain, as motors that lag have it now
    ramp: Array | None = None  # [] s^2/m, least time in which the velocity that is held changes by 1 m/s
    held: Array | None = None  # [3] m/s, velocity that the controller holds now, world
    late: Array | None = None  # [] bool, whether moves are delayed; None where they are in every episode, or in none
    move: Array | None = (
        None  # action chosen in the decision before, flown in the next one; None in what `sample_disturbance` returns
    )
    position_bias: Array | None = None  # [3] metres
    velocity_bias: Array | None = None  # [3] m/s


@struct.dataclass
class Load:
    """External load on a body in one physics step, and its mass and inertia; None is nominal."""

    force: Array | None = None  # [3] newtons at the centre of mass, world
    mass: Array | None = None  # [] flown mass per nominal mass
    inertia: Array | None = None  # [] flown inertia per nominal inertia


def any_on(config: Config) -> bool:
    """Returns whether any disturbance is on; if not, an environment has no `Disturbance`."""
    return changes_flight(config) or bool(config.env.action_delay) or has_noise(config.noise)


def changes_flight(config: Config) -> bool:
    """Returns whether the body's dynamics differ from the controller's model."""
    body, motors = config.body, config.motors
    own = (body.mass_share, body.inertia_share, motors.gain_share, motors.lag_s, config.env.setpoint_m_s2)
    return has_air(config.air) or any(own)


def has_air(air: AirConfig) -> bool:
    """Returns whether there is drag."""
    return air.drag or any((air.wind_m_s, air.gusts_m_s))


def has_noise(noise: NoiseConfig) -> bool:
    """Returns whether the estimate of the drone's position or velocity has errors."""
    return any((noise.position_m, noise.velocity_m_s, noise.position_bias_m, noise.velocity_bias_m_s))


def sample_disturbance(config: Config, hover_thrust: Array, key: Array) -> Disturbance | None:
    """Samples the disturbances of an episode; None if all are off.

    Args:
        config: which disturbances there are, and their sizes.
        hover_thrust: [] newtons of one rotor at the start, where the drone hovers.
        key: consumed.
    """
    if not any_on(config):
        return None
    late = None
    if config.env.action_delay and config.env.delay_share < 1:
        key, delay = jax.random.split(key)
        late = jax.random.bernoulli(delay, config.env.delay_share)
    ramp = None
    if config.env.setpoint_m_s2:
        key, slow = jax.random.split(key)
        ramp = jax.random.uniform(slow, maxval=1 / config.env.setpoint_m_s2)
        if config.env.setpoint_share < 1:
            key, limits = jax.random.split(key)
            ramp = jnp.where(jax.random.bernoulli(limits, config.env.setpoint_share), ramp, 0.0)
    azimuth, wind, gusts, mass, inertia, gain, lag, place, speed = jax.random.split(key, 9)
    air, body, motors, noise = config.air, config.body, config.motors, config.noise
    angle = jax.random.uniform(azimuth, maxval=2 * math.pi)
    blows = air.wind_m_s or air.gusts_m_s
    return Disturbance(
        ahead=jnp.stack([jnp.cos(angle), jnp.sin(angle)]) if blows else None,
        wind=jax.random.uniform(wind, maxval=air.wind_m_s) if air.wind_m_s else None,
        gusts=stationary_gusts(gusts) if air.gusts_m_s else None,
        mass=_share(body.mass_share, (), mass),
        inertia=_share(body.inertia_share, (), inertia),
        gain=_share(motors.gain_share, (4,), gain),
        lag_s=jax.random.uniform(lag, maxval=motors.lag_s) if motors.lag_s else None,
        thrust=jnp.full(4, hover_thrust) if motors.lag_s else None,
        ramp=ramp,
        held=None if ramp is None else jnp.zeros(3),
        late=late,
        position_bias=_normal(noise.position_bias_m, place),
        velocity_bias=_normal(noise.velocity_bias_m_s, speed),
    )


def _share(largest: float, shape: tuple[int, ...], key: Array) -> Array | None:
    """Returns factors that are uniform within 1 +- `largest`; None for 0."""
    return jax.random.uniform(key, shape, minval=1 - largest, maxval=1 + largest) if largest else None


def _normal(deviation: float, key: Array) -> Array | None:
    return deviation * jax.random.normal(key, (3,)) if deviation else None


# ---------------------------------------------------------------------------------------------- air


class GustScales(NamedTuple):
    """Lengths and standard deviations of gusts."""

    level_m: float
    """L_u and L_v."""
    vertical_m: float
    """L_w."""
    level_m_s: float
    """sigma_u and sigma_v."""
    vertical_m_s: float
    """sigma_w."""


def gust_scales(air: AirConfig) -> GustScales:
    """Returns the scales of gusts at `air.gust_height_m` (MIL-F-8785C, 10 to 1000 feet).

    With the height h in feet L_w = h, L_u = L_v = h / (0.177 + 0.000823 h)^1.2 and
    sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4.
    """
    feet = air.gust_height_m / METRES_PER_FOOT
    shear = 0.177 + 0.000823 * feet
    return GustScales(
        level_m=air.gust_height_m / shear**1.2,
        vertical_m=air.gust_height_m,
        level_m_s=air.gusts_m_s,
        vertical_m_s=air.gusts_m_s * shear**0.4,
    )


def stationary_gusts(key: Array) -> Array:
    """Returns states of the gusts' filters [GUST_STATES] that are distributed as after a long time; `key` is consumed.

    A filter of two states x, y has the covariance [[1, 1/2], [1/2, 1/2]].
    """
    u, v, v_part, w, w_part = jax.random.normal(key, (GUST_STATES,))
    return jnp.stack([u, v, (v + v_part) / 2, w, (w + w_part) / 2])


def next_gusts(air: AirConfig, dt_s: float, gusts: Array, white: Array) -> Array:
    """Returns the states of the gusts' filters [GUST_STATES] after `dt_s` seconds, exactly.

    Args:
        air: scales of the gusts.
        dt_s: seconds.
        gusts: [GUST_STATES] before.
        white: [GUST_STATES] independent standard normal numbers.
    """
    scales = gust_scales(air)
    u, v, v_late, w, w_late = gusts
    level, vertical = (dt_s * air.gust_airspeed_m_s / length for length in (scales.level_m, scales.vertical_m))
    u = math.exp(-level) * u + math.sqrt(-math.expm1(-2 * level)) * white[0]
    v, v_late = _second_order(level, v, v_late, white[1], white[2])
    w, w_late = _second_order(vertical, w, w_late, white[3], white[4])
    return jnp.stack([u, v, v_late, w, w_late])


def gust_step(air: AirConfig, dt_s: float, disturbance: Disturbance, white: Array) -> Disturbance:
    """Returns the disturbance with the gusts of `dt_s` seconds later; arguments as in `next_gusts`."""
    assert disturbance.gusts is not None
    return dataclasses.replace(disturbance, gusts=next_gusts(air, dt_s, disturbance.gusts, white))


def _second_order(ratio: float, x: Array, late: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Returns x and y of T x' = -x + noise and T y' = x - y after `ratio` times T.

    The state decays by e^-r [[1, 0], [r, 1]], and the noise of the step has what is then missing of the covariance.
    """
    decay, left = math.exp(-ratio), math.exp(-2 * ratio)
    variance = 1 - left
    shared = 0.5 - left * (ratio + 0.5)
    late_variance = 0.5 - left * (ratio * ratio + ratio + 0.5)
    spread = math.sqrt(variance)
    along = shared / spread
    apart = math.sqrt(max(late_variance - along * along, 0.0))
    return decay * x + spread * first, decay * (ratio * x + late) + along * first + apart * second


def gust_velocity(air: AirConfig, gusts: Array) -> tuple[Array, Array, Array]:
    """Returns the gusts' velocity u along, v across and w up, m/s, from the states of the filters."""
    scales = gust_scales(air)
    u, v, v_late, w, w_late = gusts
    # (1 + sqrt(3) T s) / (1 + T s) of x is sqrt(3) x + (1 - sqrt(3)) y, whose variance is 2.
    now, late = math.sqrt(3 / 2), (1 - math.sqrt(3)) / math.sqrt(2)
    return (
        scales.level_m_s * u,
        scales.level_m_s * (now * v + late * v_late),
        scales.vertical_m_s * (now * w + late * w_late),
    )


def air_velocity(air: AirConfig, disturbance: Disturbance) -> Array:
    """Returns the velocity of the air [3] m/s, world: steady wind and gusts."""
    along, across, up = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    if disturbance.gusts is not None:
        along, across, up = gust_velocity(air, disturbance.gusts)
    if disturbance.wind is not None:
        along = along + disturbance.wind
    if disturbance.ahead is None:
        return jnp.zeros(3)
    cos, sin = disturbance.ahead
    return jnp.stack([cos * along - sin * across, sin * along + cos * across, up])


def drag_force(air: AirConfig, velocity: Array, through: Array) -> Array:
    """Returns the drag [3] newtons on a body at `velocity` [3] m/s in air that moves at `through` [3] m/s, world.

    (c + rho / 2 C_d A abs(v)) v with v the velocity of the air relative to the body: linear for the rotors (Faessler,
    Franchi and Scaramuzza 2018, here alike in all directions), quadratic for the body.
    """
    x, y, z = through - velocity
    speed = jnp.sqrt(x * x + y * y + z * z)
    factor = air.linear_drag_kg_s + 0.5 * AIR_DENSITY * air.drag_area_m2 * speed
    return jnp.stack([factor * x, factor * y, factor * z])


# -------------------------------------------------------------------------------------- body, motors


def white_noise(config: Config, key: Array) -> Array | None:
    """Returns the white noise of one decision's gusts, [physics steps, GUST_STATES]; None without gusts."""
    if not config.air.gusts_m_s:
        return None
    return jax.random.normal(key, (config.drone.physics_steps, GUST_STATES))


def load_of(air: AirConfig, disturbance: Disturbance, velocity: Array) -> Load:
    """Returns the external load on a body at `velocity` [3] m/s (world)."""
    force = drag_force(air, velocity, air_velocity(air, disturbance)) if has_air(air) else None
    return Load(force=force, mass=disturbance.mass, inertia=disturbance.inertia)


def held_velocities(drone: DroneConfig, disturbance: Disturbance, commanded: Array) -> tuple[Disturbance, Array | None]:
    """Returns the disturbance after a decision, and the velocities [physics_steps, 3] m/s that the controller is given.

    They go straight from the one that is held to `commanded` [3] m/s, world. None where they may jump.
    """
    if disturbance.ramp is None or disturbance.held is None:
        return disturbance, None
    change = commanded - disturbance.held
    needed = disturbance.ramp * jnp.sqrt(jnp.sum(change * change))
    time = drone.physics_dt_s * jnp.arange(1, drone.physics_steps + 1, dtype=jnp.float32)
    share = jnp.minimum(1.0, time / jnp.maximum(needed, 1e-6))
    velocities = disturbance.held[None] + share[:, None] * change[None]
    return dataclasses.replace(disturbance, held=velocities[-1]), velocities


def motor_step(
    motors: MotorsConfig, dt_s: float, disturbance: Disturbance, command: Array
) -> tuple[Disturbance, Array]:
    """Returns the disturbance after a physics step under commanded thrusts [R], and the step's thrusts [R] newtons.

    A lagging thrust follows T t' = command - t, exactly for a held command; the step has the thrust of its end, as
    MuJoCo's `filterexact` with `actearly`. The gain comes after the lag.
    """
    thrust = command
    if motors.lag_s and disturbance.thrust is not None and disturbance.lag_s is not None:
        left = jnp.exp(-dt_s / jnp.maximum(disturbance.lag_s, 1e-6))
        thrust = command + left * (disturbance.thrust - command)
        disturbance = dataclasses.replace(disturbance, thrust=thrust)
    if disturbance.gain is not None:
        thrust = disturbance.gain * thrust
    return disturbance, thrust


# ------------------------------------------------------------------------------------ what is known


def estimate_state(
    noise: NoiseConfig, disturbance: Disturbance, position: Array, velocity: Array, key: Array
) -> tuple[Array, Array]:
    """Returns the drone's estimate of its position [3] metres and velocity [3] m/s; `key` is consumed."""
    first, second = jax.random.split(key)
    position = _sum(position, disturbance.position_bias, _normal(noise.position_m, first))
    return position, _sum(velocity, disturbance.velocity_bias, _normal(noise.velocity_m_s, second))


def _sum(value: Array, *errors: Array | None) -> Array:
    for error in errors:
        value = value if error is None else value + error
    return value
