"""The drone: dynamics, by MJX by default, and a cascaded controller: velocity -> attitude -> body rate -> rotor thrust.

Frames: the world has z up; the body has x ahead, y left, z up, its origin at the centre of mass. A
quaternion (w, x, y, z) turns body vectors into world vectors.

Heading is the quaternion's turn about the world's z, 2 atan2(z, w): what remains when the tilt is undone by
the shortest rotation, as a gimbal does. Unlike the Euler angle it does not change when a drone only tilts.

Inside the scan everything is computed in scalars, one per coordinate (MJX by `scalarize.py`): mapped over environments
they are contiguous rows that XLA fuses into a few loops.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.config import Config, DroneConfig
from edqn_jax.errors import ConfigError
from edqn_jax.sim.physics import disturbances
from edqn_jax.sim.physics.disturbances import Disturbance, Load
from edqn_jax.sim.physics.rigid_body import rigid_body_step
from edqn_jax.sim.physics.scalarize import number_by_number
from edqn_jax.xla import materialised

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp, which is not used here, is missing
    from mujoco import mjx

AIRFRAME_FILE = Path(__file__).with_name("skydio_x2.xml")
"""Mass, inertia and rotor layout."""

LEAST_LEVELNESS = 0.4
"""Cosine of the tilt beyond which thrust no longer increases to hold the height."""


@struct.dataclass
class Airframe:
    """Constants of the airframe, of controller, rotors and `rigid_body`. R = 4 rotors.

    MJX flies mass, inertia and gravity of the MJCF file (`_mjx_template`), whatever these say.
    """

    mass: Array  # [] kg
    inertia: Array  # [3] kg m^2 about the body's axes
    gravity: Array  # [] m/s^2
    max_thrust: Array  # [] newtons of one rotor
    wrench: Array  # [4, R] collective thrust (N) and torque about x, y, z (N m) per rotor thrust (N)
    mixer: Array  # [R, 4] its inverse


@struct.dataclass
class DroneState:
    """State of the body and of its heading setpoint."""

    position: Array  # [3] of the centre of mass, metres, world
    quaternion: Array  # [4] w, x, y, z; body to world
    velocity: Array  # [3] m/s, world
    angular_velocity: Array  # [3] rad/s, body
    yaw_setpoint: Array  # [] radians


@struct.dataclass
class VelocityCommand:
    """What the whole controller holds for one decision."""

    velocity: Array  # [3] m/s, world
    heading: Array  # [] radians, where the heading setpoint moves to


@struct.dataclass
class RateCommand:
    """What the innermost loop alone holds for one decision; velocity, attitude and heading are the pilot's."""

    thrust: Array  # [] newtons of all rotors together
    rates: Array  # [3] rad/s about the body's axes


Command = VelocityCommand | RateCommand


@struct.dataclass
class Flight:
    """Poses and velocities of one decision: n physics steps, each entry taken after its step."""

    position: Array  # [n, 3] metres, world
    quaternion: Array  # [n, 4]
    velocity: Array  # [n, 3] m/s, world
    time: Array | None = None  # [n] seconds of the episode, in a world that moves


def c_model(config: DroneConfig) -> mujoco.MjModel:
    """Returns the Skydio X2 as C MuJoCo compiles it, without the shapes that only a viewer needs."""
    spec = mujoco.MjSpec.from_file(str(AIRFRAME_FILE))
    spec.option.timestep = config.physics_dt_s
    # MJX solves a sparse mass matrix by unrolled arithmetic, a dense one by a LAPACK call per environment.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    for shape in list(spec.geoms):
        spec.delete(shape)
    return spec.compile()


def wrench_of_thrust(model: mujoco.MjModel) -> np.ndarray:
    """Returns the [4, R] collective thrust and torque about x, y, z (N m) per rotor thrust (N) of the rotor layout."""
    arm = model.site_pos[model.actuator_trnid[:, 0]]
    push, twist = model.actuator_gear[:, 2], model.actuator_gear[:, 5]
    return np.stack([push, arm[:, 1] * push, -arm[:, 0] * push, twist])


def mixer_of(model: mujoco.MjModel) -> np.ndarray:
    """Returns the [R, 4] rotor thrusts per collective thrust (N) and torque about x, y, z (N m) of the rotor layout."""
    return np.linalg.inv(wrench_of_thrust(model))


def load_airframe(config: DroneConfig) -> Airframe:
    """Returns the constants of the Skydio X2, with the mixer that follows from its rotor layout.

    Raises:
        ConfigError: if the airframe's file has something that a physics step would ignore.
    """
    model = c_model(config)
    _check(model)
    return Airframe(
        mass=jnp.float32(model.body_mass[1]),
        inertia=jnp.asarray(model.body_inertia[1], jnp.float32),
        gravity=jnp.float32(-model.opt.gravity[2]),
        max_thrust=jnp.float32(model.actuator_ctrlrange[0, 1]),
        wrench=jnp.asarray(wrench_of_thrust(model), jnp.float32),
        mixer=jnp.asarray(mixer_of(model), jnp.float32),
    )


@functools.cache
def _mjx_template(config: DroneConfig) -> tuple[mjx.Model, mjx.Data]:
    """Returns the Skydio X2 as MJX has it, and data that hold its factored mass matrix; known when tracing."""
    model = c_model(config)
    rest = mujoco.MjData(model)
    mujoco.mj_forward(model, rest)
    here = jax.local_devices()[0]  # MJX's own choice may be another process's
    with jax.ensure_compile_time_eval():
        placed = mjx.put_model(model, device=here, impl="jax"), mjx.put_data(model, rest, device=here, impl="jax")
    # Arrays of JAX belong to the mesh under which they are made, and are kept here for programs of other meshes.
    return jax.tree.map(np.asarray, placed)


def _check(model: mujoco.MjModel) -> None:
    free = model.nq == 7 and model.nv == 6 and not model.ngeom
    in_vacuum = not model.opt.density and not model.opt.viscosity and not model.opt.wind.any()
    centred = np.allclose(model.body_ipos[1], 0.0) and np.allclose(np.abs(model.body_iquat[1]), [1, 0, 0, 0])
    rotors = model.actuator_trnid[:, 0]
    # Otherwise `mjx.euler` computes accelerations of its own.
    undamped = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    upright = not model.actuator_gear[:, [0, 1, 3, 4]].any() and np.allclose(model.site_quat[rotors], [1, 0, 0, 0])
    if not (free and in_vacuum and centred and upright and undamped):
        raise ConfigError(
            f"'{AIRFRAME_FILE.name}' must be one free body in a vacuum, its frame at the centre of mass and along the "
            "principal axes of inertia, under rotors that push along its z, with eulerdamp disabled; no other model is "
            "supported"
        )


def hover(position: Array, yaw: Array) -> DroneState:
    """Returns the state at rest and level at `position` [3] metres, nose and setpoint at `yaw` [] radians."""
    zero = jnp.zeros((), jnp.float32)
    yaw = jnp.asarray(yaw, jnp.float32)
    return DroneState(
        position=jnp.asarray(position, jnp.float32),
        quaternion=jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)]),
        velocity=jnp.zeros(3, jnp.float32),
        angular_velocity=jnp.zeros(3, jnp.float32),
        yaw_setpoint=wrap_angle(yaw),
    )


def wrap_angle(angle: Array) -> Array:
    """Returns the same angle within [-pi, pi], radians, any shape."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def yaw_of(quaternion: Array) -> Array:
    """Returns the heading [...] in [-pi, pi] of quaternions [..., 4], radians (see the module docstring)."""
    return wrap_angle(2 * jnp.arctan2(quaternion[..., 3], quaternion[..., 0]))


def yaw_rate_of(state: DroneState) -> Array:
    """Returns the rate [] of the heading of `yaw_of`, rad/s; of a level body, its angular velocity about z."""
    w, x, y, z = state.quaternion
    p, q, r = state.angular_velocity
    turn = w * (w * r + x * q - y * p) + z * (x * p + y * q + z * r)
    return turn / jnp.maximum(w * w + z * z, 1e-9)


Scalars = tuple[Array, Array, Array]
"""One vector, a scalar [] for each coordinate."""


def thrusts(config: DroneConfig, airframe: Airframe, state: DroneState, velocity_command: Array) -> Array:
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

    force = _wanted_force(config, airframe, (vx, vy, vz))
    axes = _body_axes(w, x, y, z)
    direction = _in_body_frame(axes, force)
    turn = _wanted_yaw_rate(config, w, z, cos_half_yaw, sin_half_yaw)
    rates = _wanted_rates(config, direction, turn)
    torque = _torque(config, airframe, rates, (p, q, r))
    collective = _collective_thrust(airframe, force[2], axes[2][2])
    # Computed once, and not again for each rotor.
    return _allocate(config, airframe, *materialised(jnp.stack([*torque, collective])))


def rate_thrusts(config: DroneConfig, airframe: Airframe, state: DroneState, command: RateCommand) -> Array:
    """Returns rotor thrusts [4] newtons towards commanded thrust and body rates, within the limits of `thrusts`."""
    p, q, r = command.rates
    torque = _torque(config, airframe, (p, q, r), tuple(state.angular_velocity))
    return _allocate(config, airframe, *materialised(jnp.stack([*torque, command.thrust])))


def _wanted_force(config: DroneConfig, airframe: Airframe, error: Scalars) -> Scalars:
    """Returns the wanted specific force m/s^2 (world): acceleration plus gravity, for a velocity `error` m/s.

    Within the largest accelerations and the largest tilt.
    """
    vx, vy, vz = error
    fz = airframe.gravity + jnp.clip(config.climb_gain * vz, -config.max_descent_m_s2, config.max_climb_m_s2)
    fx, fy = config.velocity_gain * vx, config.velocity_gain * vy
    most = jnp.minimum(config.max_horizontal_m_s2, float(np.tan(config.max_tilt_rad)) * fz)
    scale = jnp.minimum(1.0, most * jax.lax.rsqrt(fx * fx + fy * fy + 1e-9))
    return fx * scale, fy * scale, fz


def _body_axes(w: Array, x: Array, y: Array, z: Array) -> tuple[Scalars, Scalars, Scalars]:
    """Returns the world's x, y and z axis in the body frame, for the attitude quaternion w, x, y, z."""
    up = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    ahead = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    left = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    return ahead, left, up


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


def _dot(row: Array, column: Array) -> Array:
    """Returns a dot product, summed term by term: XLA compiles a sum along an axis to a separate call."""
    total = row[0] * column[0]
    for index in range(1, row.shape[0]):
        total = total + row[index] * column[index]
    return total


def _least(values: list[Array]) -> Array:
    least = values[0]
    for value in values[1:]:
        least = jnp.minimum(least, value)
    return least


def physics_step(
    config: DroneConfig, airframe: Airframe, state: DroneState, thrust: Array, load: Load | None = None
) -> DroneState:
    """Returns the state after one step of `config.physics` under rotor thrusts [4] newtons.

    Only position and velocity are carried from step to step.

    Args:
        config: engine and length of the step.
        airframe: nominal.
        state: before the step.
        thrust: [4] newtons; with a load also beyond what a nominal rotor gives.
        load: what else acts, and mass and inertia that are flown; None flies the nominal airframe in a vacuum.
    """
    if config.physics == "rigid_body":
        mass, inertia, push = airframe.mass, airframe.inertia, None
        if load is not None:
            mass, inertia, push = _scaled(mass, load.mass), _scaled(inertia, load.inertia), load.force
        moved = rigid_body_step(
            *(config.physics_dt_s, mass, inertia, airframe.gravity),
            jnp.stack([_dot(row, thrust) for row in airframe.wrench]),
            *(state.position, state.quaternion, state.velocity, state.angular_velocity),
            push,
        )
    else:
        moved = _mjx_step(config, state, _applied(airframe, state, thrust, load or Load()))
    position, quaternion, velocity, angular_velocity = moved
    return dataclasses.replace(
        state, position=position, quaternion=quaternion, velocity=velocity, angular_velocity=angular_velocity
    )


def _scaled(value: Array, share: Array | None) -> Array:
    return value if share is None else share * value


def _applied(airframe: Airframe, state: DroneState, thrust: Array, load: Load) -> Array:
    """Returns the force (N, world) and torque (N m, body) [6] that accelerate the nominal body as the flown one.

    m' a = F - m' g and s I w' = t - w x (s I w), so that the nominal mass m and inertia I need F m / m' and t / s:
    gravity and gyroscopic torque accelerate alike. The mass matrix stays the template's.
    """
    collective, *torque = (_dot(row, thrust) for row in airframe.wrench)
    ahead, left, up = _body_axes(*state.quaternion)
    force = [axis[2] * collective for axis in (ahead, left, up)]
    if load.force is not None:
        force = [part + push for part, push in zip(force, load.force, strict=True)]
    if load.mass is not None:
        force = [part / load.mass for part in force]
    if load.inertia is not None:
        torque = [part / load.inertia for part in torque]
    return jnp.stack([*force, *torque])


@functools.partial(jax.jit, static_argnums=0, inline=True)  # traced once, not wherever a drone flies
def _mjx_step(config: DroneConfig, state: DroneState, applied: Array) -> tuple[Array, Array, Array, Array]:
    """Returns position, quaternion, velocity and angular velocity after one MJX step.

    These are the stages of `mjx.step` for this model: with the body frame at the centre of mass and no joint
    below it, the mass matrix is constant, the template's, and there are no collisions, constraints or damping. What the
    rotors do comes as an applied force.

    Args:
        config: of the drone.
        state: before the step.
        applied: [6] force (N, world) and torque (N m, body).
    """
    model, template = _mjx_template(config)

    def at(state: DroneState) -> mjx.Data:
        return template.replace(
            qpos=jnp.concatenate([state.position, state.quaternion]),
            qvel=jnp.concatenate([state.velocity, state.angular_velocity]),
        )

    def acceleration(state: DroneState, applied: Array) -> Array:
        data = mjx.com_pos(model, mjx.kinematics(model, at(state).replace(qfrc_applied=applied)))
        data = mjx.rne(model, mjx.com_vel(model, data))
        return mjx.fwd_acceleration(model, data).qacc_smooth

    def integrated(state: DroneState, acceleration: Array) -> tuple[Array, Array, Array, Array]:
        data = mjx.euler(model, at(state).replace(qacc=acceleration))
        return data.qpos[:3], data.qpos[3:], data.qvel[:3], data.qvel[3:]

    with jax.numpy_rank_promotion("allow"):  # MJX's own arithmetic relies on it
        # Computed once, and not again for each number that is read.
        force = materialised(applied)
        return number_by_number(integrated)(state, materialised(number_by_number(acceleration)(state, force)))


def fly(
    config: DroneConfig, airframe: Airframe, state: DroneState, velocity_command: Array, target_yaw: Array
) -> tuple[DroneState, Flight]:
    """Flies one decision: `physics_steps` steps at a held `velocity_command` [3] m/s (world).

    The yaw setpoint moves towards `target_yaw` [] radians in the shorter direction, at most `max_yaw_rate_rad_s` fast.
    """
    return fly_command(config, airframe, state, VelocityCommand(velocity_command, target_yaw))


def fly_command(
    config: DroneConfig, airframe: Airframe, state: DroneState, command: Command
) -> tuple[DroneState, Flight]:
    """Flies one decision: `physics_steps` steps under a held command."""
    control = _control(config, airframe, state, command)

    def body(state: DroneState, given: Any) -> tuple[DroneState, Flight]:
        thrust = control.thrusts(state, given)
        state = physics_step(config, airframe, state, thrust)
        return state, Flight(state.position, state.quaternion, state.velocity)

    state, flight = jax.lax.scan(body, state, control.inputs, config.physics_steps)
    return dataclasses.replace(state, yaw_setpoint=control.yaw_setpoint), flight


def fly_disturbed(
    config: Config, airframe: Airframe, state: DroneState, disturbance: Disturbance, command: Command, key: Array
) -> tuple[DroneState, Disturbance, Flight]:
    """Flies one decision as `fly_command`, against a disturbance that the controller does not know of.

    Args:
        config: of drone, air and motors.
        airframe: that the controller believes in.
        state, command: as in `fly_command`.
        disturbance: of the episode, as of the decision before.
        key: consumed by gusts.
    """
    control = _control(config.drone, airframe, state, command)
    dt_s = config.drone.physics_dt_s

    def body(
        flying: tuple[DroneState, Disturbance], given: tuple[Any, Array | None]
    ) -> tuple[tuple[DroneState, Disturbance], Flight]:
        (state, now), (inputs, white) = flying, given
        wanted = control.thrusts(state, inputs)
        now, thrust = disturbances.motor_step(config.motors, dt_s, now, wanted)
        load = disturbances.load_of(config.air, now, state.velocity)
        state = physics_step(config.drone, airframe, state, thrust, load)
        if white is not None:
            now = disturbances.gust_step(config.air, dt_s, now, white)
        return (state, now), Flight(state.position, state.quaternion, state.velocity)

    given = control.inputs, disturbances.white_noise(config, key)
    (state, disturbance), flight = jax.lax.scan(body, (state, disturbance), given, config.drone.physics_steps)
    return dataclasses.replace(state, yaw_setpoint=control.yaw_setpoint), disturbance, flight


class _Control(NamedTuple):
    """A controller during one decision."""

    thrusts: Callable[[DroneState, Any], Array]
    """(state, inputs of the physics step) → rotor thrusts [4] newtons."""
    inputs: Any
    """[physics_steps, ...]; None where there are none."""
    yaw_setpoint: Array
    """[] radians, after the decision."""


def _control(config: DroneConfig, airframe: Airframe, state: DroneState, command: Command) -> _Control:
    if isinstance(command, RateCommand):
        return _Control(lambda now, _: rate_thrusts(config, airframe, now, command), None, state.yaw_setpoint)
    yaws = _setpoints(config, state, command.heading)

    def thrusts(now: DroneState, half_yaw: tuple[Array, Array]) -> Array:
        return _thrusts(config, airframe, now, command.velocity, *half_yaw)

    return _Control(thrusts, (jnp.cos(yaws / 2), jnp.sin(yaws / 2)), wrap_angle(yaws[-1]))


def _setpoints(config: DroneConfig, state: DroneState, target_yaw: Array) -> Array:
    """Returns the yaw setpoints [physics_steps] radians of one decision, not wrapped."""
    steps = jnp.arange(1, config.physics_steps + 1, dtype=jnp.float32)
    most = config.max_yaw_rate_rad_s * config.physics_dt_s * steps
    return state.yaw_setpoint + jnp.clip(wrap_angle(target_yaw - state.yaw_setpoint), -most, most)
