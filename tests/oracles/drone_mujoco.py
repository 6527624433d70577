"""The drone in C MuJoCo: the airframe's MJCF as it stands in the file, stepped by `mj_step`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from edqn_jax.sim.physics.airframe import SKYDIO_X2
from edqn_jax.sim.physics.drone import DroneState, hover_state


def load() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_path(str(SKYDIO_X2))
    return model, mujoco.MjData(model)


def fly_thrusts(qpos: np.ndarray, qvel: np.ndarray, thrusts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """qpos [n, 7] and qvel [n, 6] after each step of thrusts [n, 4] newtons, from qpos [7] and qvel [6]."""
    model, data = load()
    data.qpos[:], data.qvel[:] = qpos, qvel
    places, speeds = [], []
    for thrust in thrusts:
        data.ctrl[:] = thrust
        mujoco.mj_step(model, data)
        places.append(data.qpos.copy())
        speeds.append(data.qvel.copy())
    return np.array(places), np.array(speeds)


def check_hundred_steps(step: Callable[[DroneState, jax.Array], DroneState]) -> None:
    """Asserts that 100 steps under random thrusts stay within a millimetre of those of C MuJoCo."""
    sequence = np.clip(3.25 + np.random.default_rng(1).normal(0, 0.4, (100, 4)), 0, 13.0)
    state = hover_state(jnp.array([1.0, -2.0, 30.0]), jnp.float32(0.4))
    state = dataclasses.replace(state, angular_velocity=jnp.array([0.5, -0.3, 0.2]))
    qpos = np.concatenate([state.position, state.quaternion])
    places, speeds = fly_thrusts(qpos, np.concatenate([state.velocity, state.angular_velocity]), sequence)
    assert np.linalg.norm(places[-1, :3] - qpos[:3]) > 5  # it went somewhere
    for thrust, place, speed in zip(sequence, places, speeds, strict=True):
        state = step(state, jnp.asarray(thrust, jnp.float32))
        np.testing.assert_allclose(state.position, place[:3], atol=1e-3)
        np.testing.assert_allclose(state.quaternion, place[3:], atol=1e-4)
        np.testing.assert_allclose(state.velocity, speed[:3], atol=1e-3)
        np.testing.assert_allclose(state.angular_velocity, speed[3:], atol=1e-3)


def acceleration(qpos: np.ndarray, qvel: np.ndarray, thrust: np.ndarray) -> np.ndarray:
    """[6]: linear acceleration (world, m/s^2) and angular (body, rad/s^2) under rotor thrusts [4] newtons."""
    model, data = load()
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, thrust
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def fly_loaded(
    qpos: np.ndarray,
    qvel: np.ndarray,
    thrusts: np.ndarray,
    *,
    mass: float = 1.0,
    inertia: float = 1.0,
    gain: np.ndarray | None = None,
    lag_s: float | None = None,
    first: float = 0.0,
    push: Callable[[np.ndarray], np.ndarray] = lambda velocity: np.zeros(3),
) -> tuple[np.ndarray, np.ndarray]:
    """qpos [n, 7] and qvel [n, 6] as `fly_thrusts`, of another machine: everything is changed in the model itself.

    Args:
        mass, inertia: per those of the file.
        gain: [4] thrust of each rotor per its command.
        lag_s: time constant of the rotors, which begin at `first` newtons.
        push: force [3] newtons at the centre of mass at a velocity [3] m/s, world.
    """
    spec = mujoco.MjSpec.from_file(str(SKYDIO_X2))
    body = spec.bodies[1]
    body.mass *= mass
    body.inertia = inertia * np.asarray(body.inertia)
    for rotor, actuator in enumerate(spec.actuators):
        actuator.gainprm[0] = 1.0 if gain is None else gain[rotor]
        if lag_s is not None:
            actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
            actuator.dynprm[0] = lag_s
            actuator.actearly = True
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = qpos, qvel, first
    places, speeds = [], []
    for thrust in thrusts:
        data.ctrl[:] = thrust
        data.xfrc_applied[1, :3] = push(data.qvel[:3])
        mujoco.mj_step(model, data)
        places.append(data.qpos.copy())
        speeds.append(data.qvel.copy())
    return np.array(places), np.array(speeds)
