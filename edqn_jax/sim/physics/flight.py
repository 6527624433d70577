"""How a drone flies one decision: physics steps, by MJX by default, under the controller's thrusts.

Inside the scan everything is computed in scalars (MJX by `scalarize.py`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from edqn_jax.config import Config, DroneConfig
from edqn_jax.sim.physics import disturbances
from edqn_jax.sim.physics.airframe import Airframe, c_model
from edqn_jax.sim.physics.controller import Command, VelocityCommand, control_of
from edqn_jax.sim.physics.disturbances import Disturbance, Load
from edqn_jax.sim.physics.drone import DroneState, Flight, body_axes
from edqn_jax.sim.physics.rigid_body import RigidBody, rigid_body_step
from edqn_jax.sim.physics.scalarize import scalarize
from edqn_jax.xla import materialise_tree

if TYPE_CHECKING:
    from mujoco import mjx


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
            config.physics_dt_s,
            RigidBody(mass, inertia, airframe.gravity),
            jnp.stack([_dot(row, thrust) for row in airframe.wrench]),
            (state.position, state.quaternion, state.velocity, state.angular_velocity),
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
    ahead, left, up = body_axes(*state.quaternion)
    force = [axis[2] * collective for axis in (ahead, left, up)]
    if load.force is not None:
        force = [part + push for part, push in zip(force, load.force, strict=True)]
    if load.mass is not None:
        force = [part / load.mass for part in force]
    if load.inertia is not None:
        torque = [part / load.inertia for part in torque]
    return jnp.stack([*force, *torque])


@functools.cache
def _mjx_module() -> ModuleType:
    """Imports MJX, which takes as long as importing JAX, where a program is traced: one that was kept needs none."""
    # Its constants must not belong to what is being traced, and it prints that Warp, not used here, is missing.
    with jax.ensure_compile_time_eval(), contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


@functools.cache
def _mjx_template(config: DroneConfig) -> tuple[mjx.Model, mjx.Data]:
    """Returns the airframe as MJX has it, and data that hold its factored mass matrix; known when tracing."""
    mjx = _mjx_module()
    model = c_model(config)
    rest = mujoco.MjData(model)
    mujoco.mj_forward(model, rest)
    here = jax.local_devices()[0]  # MJX's own choice may be another process's
    with jax.ensure_compile_time_eval():
        placed = mjx.put_model(model, device=here, impl="jax"), mjx.put_data(model, rest, device=here, impl="jax")
    # Arrays of JAX belong to the mesh under which they are made, and are kept here for programs of other meshes.
    return jax.tree.map(np.asarray, placed)


def _dot(row: Array, column: Array) -> Array:
    """Returns a dot product, summed term by term: XLA compiles a sum along an axis to a separate call."""
    total = row[0] * column[0]
    for index in range(1, row.shape[0]):
        total = total + row[index] * column[index]
    return total


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
    mjx = _mjx_module()
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
        force = materialise_tree(applied)
        return scalarize(integrated)(state, materialise_tree(scalarize(acceleration)(state, force)))


def fly_decision(
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
    control = control_of(config, airframe, state, command)

    def body(state: DroneState, given: Any) -> tuple[DroneState, Flight]:
        thrust = control.thrusts(state, given)
        state = physics_step(config, airframe, state, thrust)
        return state, Flight(state.position, state.quaternion, state.velocity)

    state, flight = jax.lax.scan(body, state, control.inputs, config.physics_steps)
    return dataclasses.replace(state, yaw_setpoint=control.yaw_setpoint), flight


def fly_disturbed(
    config: Config, airframe: Airframe, state: DroneState, disturbance: Disturbance, command: Command, key: Array
) -> tuple[DroneState, Disturbance, Flight]:
    """Flies one decision as `fly_command`, under a disturbance that is unknown to the controller.

    Args:
        config: of drone, air and motors.
        airframe: that the controller believes in.
        state, command: as in `fly_command`.
        disturbance: of the episode, as of the decision before.
        key: consumed by gusts.
    """
    velocities = None
    if isinstance(command, VelocityCommand):
        disturbance, velocities = disturbances.held_velocities(config.drone, disturbance, command.velocity)
    control = control_of(config.drone, airframe, state, command, velocities)
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
