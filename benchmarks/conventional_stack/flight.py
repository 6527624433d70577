"""The drone in C MuJoCo with the cascaded controller of `edqn_jax/sim/physics/controller.py`, in numba."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from conventional_stack.c_mujoco import mj_step
from edqn_jax.config import Config, DroneConfig
from edqn_jax.extras import require_extra
from edqn_jax.sim.physics.airframe import c_model, mixer_of
from edqn_jax.sim.physics.controller import LEAST_LEVELNESS

numba = require_extra("numba")

STATE = 13
"""Number of values of a drone's state: qpos (position, quaternion), qvel (velocity in the world, rates in the body)."""


class Airframe(NamedTuple):
    """Gains and limits, with the names of `DroneConfig`, and values of the model."""

    velocity_gain: float
    climb_gain: float
    attitude_gain: float
    rate_gain: float
    yaw_gain: float
    yaw_rate_gain: float
    max_body_rate: float
    max_lean: float  # tangent of the largest tilt
    max_horizontal: float
    max_climb: float
    max_descent: float
    max_tilt_share: float
    max_yaw_rate: float
    physics_dt: float
    mass: float
    gravity: float
    max_thrust: float
    inertia: NDArray[np.float64]  # [3]
    mixer: NDArray[np.float64]  # [4, 4], see `edqn_jax.sim.physics.airframe.Airframe`


class Command(NamedTuple):
    """Converts an action to a command of the controller."""

    moves: NDArray[np.float64]  # [27, 3] m/s in the heading frame
    heading_hold: float  # metres


class Engine(NamedTuple):
    """The airframe's compiled model, and its data, which the drones of a process use one after another."""

    model: mujoco.MjModel
    data: mujoco.MjData


def load_engine(config: DroneConfig) -> Engine:
    """Returns the Skydio X2 without contacts and constraints."""
    model = c_model(config)
    # Without reset to the origin, so that divergence can be detected.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return Engine(model, mujoco.MjData(model))


def airframe_of(config: DroneConfig, model: mujoco.MjModel) -> Airframe:
    """Returns the values of configuration and model for the compiled loops."""
    return Airframe(
        velocity_gain=config.velocity_gain,
        climb_gain=config.climb_gain,
        attitude_gain=config.attitude_gain,
        rate_gain=config.rate_gain,
        yaw_gain=config.yaw_gain,
        yaw_rate_gain=config.yaw_rate_gain,
        max_body_rate=config.max_body_rate_rad_s,
        max_lean=math.tan(config.max_tilt_rad),
        max_horizontal=config.max_horizontal_m_s2,
        max_climb=config.max_climb_m_s2,
        max_descent=config.max_descent_m_s2,
        max_tilt_share=config.max_tilt_share,
        max_yaw_rate=config.max_yaw_rate_rad_s,
        physics_dt=config.physics_dt_s,
        mass=float(model.body_mass[1]),
        gravity=float(-model.opt.gravity[2]),
        max_thrust=float(model.actuator_ctrlrange[0, 1]),
        inertia=model.body_inertia[1].copy(),
        mixer=mixer_of(model),
    )


def command_of(config: Config, actions: NDArray[np.int64]) -> Command:
    """Returns the table of actions [27, 3] times the commanded speed."""
    return Command(moves=(actions * config.env.speed_m_s).astype(np.float64), heading_hold=config.env.heading_hold_m)


@numba.njit(cache=True, inline="always")
def clip(x, low, high):
    return min(max(x, low), high)


@numba.njit(cache=True)
def wrap_angle(angle):
    """Returns the same angle within [-pi, pi], radians."""
    return angle - 2 * math.pi * round(angle / (2 * math.pi))


@numba.njit(cache=True, error_model="numpy")
def control(airframe, state, vx, vy, vz, cos_half_yaw, sin_half_yaw, thrust):
    """Computes rotor thrusts as `edqn_jax.sim.physics.controller.rotor_thrusts` does, line by line.

    Args:
        state: [13].
        vx, vy, vz: commanded velocity, m/s, world.
        cos_half_yaw, sin_half_yaw: of the yaw setpoint.
    """
    w, x, y, z = state[3], state[4], state[5], state[6]
    p, q, r = state[10], state[11], state[12]
    vx, vy, vz = vx - state[7], vy - state[8], vz - state[9]

    # Velocity -> specific force, within the largest accelerations and tilt.
    fz = airframe.gravity + clip(airframe.climb_gain * vz, -airframe.max_descent, airframe.max_climb)
    fx, fy = airframe.velocity_gain * vx, airframe.velocity_gain * vy
    lean = min(1.0, min(airframe.max_horizontal, airframe.max_lean * fz) / math.sqrt(fx * fx + fy * fy + 1e-9))
    fx, fy = fx * lean, fy * lean
    norm = 1.0 / math.sqrt(fx * fx + fy * fy + fz * fz)

    # Its direction in the body frame.
    up_x, up_y, up_z = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    ahead_x, ahead_y, ahead_z = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    left_x, left_y, left_z = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    ex = (ahead_x * fx + left_x * fy + up_x * fz) * norm
    ey = (ahead_y * fx + left_y * fy + up_y * fz) * norm
    ez = (ahead_z * fx + left_z * fy + up_z * fz) * norm

    # Attitude -> body rates.
    tilt = min(
        airframe.attitude_gain / math.sqrt(max(0.5 + 0.5 * ez, 1e-2)),
        airframe.max_body_rate / math.sqrt(ex * ex + ey * ey + 1e-9),
    )
    cos_error = w * cos_half_yaw + z * sin_half_yaw
    sin_error = w * sin_half_yaw - z * cos_half_yaw
    sign = 1.0 if cos_error > 0 else (-1.0 if cos_error < 0 else 0.0)
    turn = 2 * airframe.yaw_gain * sin_error * sign / math.sqrt(w * w + z * z + 1e-6)
    turn = clip(turn, -airframe.max_yaw_rate, airframe.max_yaw_rate)

    # Body rates -> torque.
    ix, iy, iz = airframe.inertia[0], airframe.inertia[1], airframe.inertia[2]
    torque_x = ix * airframe.rate_gain * (-tilt * ey - p) + (iz - iy) * q * r
    torque_y = iy * airframe.rate_gain * (tilt * ex - q) + (ix - iz) * p * r
    torque_z = iz * airframe.yaw_rate_gain * (turn - r) + (iy - ix) * p * q
    collective = airframe.mass * fz * max(up_z, 0.0) / max(up_z * up_z, LEAST_LEVELNESS**2)

    # Rotor limits: torque about x and y, then collective thrust, then torque about z.
    mixer, limit, low, high = airframe.mixer, airframe.max_thrust, math.inf, -math.inf
    for i in range(4):
        thrust[i] = mixer[i, 1] * torque_x + mixer[i, 2] * torque_y
        low, high = min(low, thrust[i]), max(high, thrust[i])
    scale = min(1.0, airframe.max_tilt_share * limit / (high - low + 1e-9))
    shared = clip(mixer[0, 0] * collective, -scale * low, limit - scale * high)
    reserve = math.inf
    for i in range(4):
        thrust[i] = shared + scale * thrust[i]
        reserve = min(reserve, thrust[i], limit - thrust[i])
    reserve = max(reserve, 0.0)
    turning = clip(abs(mixer[0, 3]) * torque_z, -reserve, reserve)
    for i in range(4):
        thrust[i] = clip(thrust[i] + math.copysign(turning, turning * mixer[i, 3]), 0.0, limit)


@numba.njit(cache=True, error_model="numpy")
def fly(model, data, qpos, qvel, ctrl, airframe, command, action, goal, state, yaw_setpoint, path):
    """Simulates one decision of N drones: controller and `mj_step`, n times each.

    Args:
        model, data: addresses of those of the engine; qpos [7], qvel [6], ctrl [4]: arrays of that data.
        action: [N] int.
        goal: [N, 3] metres.
        state: [N, 13], updated.
        yaw_setpoint: [N] radians, updated.
        path: [N, n + 1, 7] positions and quaternions before the first physics step and after each, output.
    """
    for i in range(len(action)):
        qpos[:], qvel[:] = state[i, :7], state[i, 7:]
        path[i, 0] = qpos
        # Command in the heading frame; the heading setpoint is towards the goal, or held when the goal is overhead.
        heading = wrap_angle(2 * math.atan2(qpos[6], qpos[3]))
        cos, sin = math.cos(heading), math.sin(heading)
        ahead, left, vz = command.moves[action[i]]
        vx, vy = cos * ahead - sin * left, sin * ahead + cos * left
        east, north = goal[i, 0] - qpos[0], goal[i, 1] - qpos[1]
        near = east * east + north * north < command.heading_hold**2
        turn = 0.0 if near else wrap_angle(math.atan2(north, east) - yaw_setpoint[i])
        yaw = yaw_setpoint[i]
        for step in range(1, path.shape[1]):
            most = airframe.max_yaw_rate * airframe.physics_dt * step
            yaw = yaw_setpoint[i] + clip(turn, -most, most)
            control(airframe, state[i], vx, vy, vz, math.cos(yaw / 2), math.sin(yaw / 2), ctrl)
            mj_step(model, data)
            state[i, :7], state[i, 7:] = qpos, qvel
            path[i, step] = qpos
        yaw_setpoint[i] = wrap_angle(yaw)
