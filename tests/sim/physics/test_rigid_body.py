"""Compares the closed form with MJX and C MuJoCo, from any state, for a step and for a flight."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from edqn_jax.cli.train import parse_train
from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.runs.provenance import workload
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.drone import AIRFRAME_FILE, DroneState, hover, load_airframe, physics_step
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from tests.oracles import drone_mujoco
from tracking import batched_fly

MJX = Config().drone
CLOSED = dataclasses.replace(MJX, physics="rigid_body")
MAX_THRUST = 13.0
COUNT = 256


def tumbling(rng: np.random.Generator) -> DroneState:
    """States [COUNT] that no controller would choose: anywhere, any attitude, fast, spinning; the first at rest."""
    quaternion = rng.normal(size=(COUNT, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    velocity, turning = 5 * rng.normal(size=(2, COUNT, 3))
    turning[0] = 0.0
    fields = (rng.uniform(0, (110, 110, 25), (COUNT, 3)), quaternion, velocity, turning, np.zeros(COUNT))
    return DroneState(*(jnp.asarray(field, jnp.float32) for field in fields))


def assert_close(ours: DroneState, theirs: DroneState, **tolerances: float) -> None:
    for name, tolerance in tolerances.items():
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=tolerance, rtol=0, err_msg=name)


@pytest.mark.parametrize("dt", [0.02, 0.004])
@pytest.mark.slow
def test_from_any_state_a_step_is_that_of_mjx(dt: float) -> None:
    rng = np.random.default_rng(0)
    states = tumbling(rng)
    thrusts = jnp.asarray(rng.uniform(0, MAX_THRUST, (COUNT, 4)), jnp.float32).at[0].set(0.0)
    ends = []
    for config in (MJX, CLOSED):
        config = dataclasses.replace(config, physics_dt_s=dt)
        step = jax.vmap(partial(physics_step, config, load_airframe(config)))
        ends.append(jax.jit(step)(states, thrusts))
    # float32: accelerations of a tumbling body reach 500 rad/s^2, of which a step adds up to 10 rad/s. Beside 110 m
    # there is nothing finer than 7.6e-6 m, and MJX takes the rotors' arms as differences of such places.
    assert_close(ends[1], ends[0], position=1.6e-5, quaternion=2e-6, velocity=2e-5, angular_velocity=2e-4)
    np.testing.assert_allclose(jnp.linalg.norm(ends[1].quaternion, axis=1), 1.0, atol=1e-6)


def test_far_from_the_origin_it_turns_as_c_mujoco_does() -> None:
    rng = np.random.default_rng(3)
    states, thrusts = tumbling(rng), rng.uniform(0, MAX_THRUST, (COUNT, 4))
    step = jax.jit(jax.vmap(partial(physics_step, CLOSED, load_airframe(CLOSED))))
    ours = step(states, jnp.asarray(thrusts, jnp.float32))
    for i in range(0, COUNT, 8):
        qpos = np.concatenate([states.position[i], states.quaternion[i]])
        qvel = np.concatenate([states.velocity[i], states.angular_velocity[i]])
        (place,), (speed,) = drone_mujoco.fly_thrusts(qpos, qvel, thrusts[i : i + 1])
        np.testing.assert_allclose(ours.position[i], place[:3], atol=1.6e-5)
        np.testing.assert_allclose(ours.quaternion[i], place[3:], atol=2e-6)
        np.testing.assert_allclose(ours.velocity[i], speed[:3], atol=2e-5)
        np.testing.assert_allclose(ours.angular_velocity[i], speed[3:], atol=2e-5)


def test_a_hundred_steps_agree_with_c_mujoco_within_a_millimetre() -> None:
    rng = np.random.default_rng(1)
    sequence = np.clip(3.25 + rng.normal(0, 0.4, (100, 4)), 0, MAX_THRUST)
    airframe = load_airframe(CLOSED)
    step = jax.jit(lambda state, thrust: physics_step(CLOSED, airframe, state, thrust))
    state = hover(jnp.array([1.0, -2.0, 30.0]), jnp.float32(0.4))
    state = dataclasses.replace(state, angular_velocity=jnp.array([0.5, -0.3, 0.2]))
    qpos = np.concatenate([state.position, state.quaternion])
    places, speeds = drone_mujoco.fly_thrusts(qpos, np.concatenate([state.velocity, state.angular_velocity]), sequence)
    assert np.linalg.norm(places[-1, :3] - qpos[:3]) > 5  # it went somewhere
    for thrust, place, speed in zip(sequence, places, speeds, strict=True):
        state = step(state, jnp.asarray(thrust, jnp.float32))
        np.testing.assert_allclose(state.position, place[:3], atol=1e-3)
        np.testing.assert_allclose(state.quaternion, place[3:], atol=1e-4)
        np.testing.assert_allclose(state.velocity, speed[:3], atol=1e-3)
        np.testing.assert_allclose(state.angular_velocity, speed[3:], atol=1e-3)


@pytest.mark.slow
def test_flights_of_random_moves_are_those_of_mjx() -> None:
    rng = np.random.default_rng(2)
    start = jax.vmap(hover)(jnp.zeros((COUNT, 3)), jnp.zeros(COUNT))
    flies = [batched_fly(drone) for drone in (MJX, CLOSED)]
    states = [start, start]
    for _ in range(20):
        commands = jnp.asarray(4.0 * rng.integers(-1, 2, (COUNT, 3)), jnp.float32)
        yaws = jnp.asarray(rng.uniform(-np.pi, np.pi, COUNT), jnp.float32)
        flown = [fly(state, commands, yaws) for fly, state in zip(flies, states, strict=True)]
        states = [state for state, _ in flown]
    (mjx, _), (closed, _) = flown
    assert np.linalg.norm(mjx.position, axis=1).mean() > 5  # it went somewhere
    # The controller pulls both to the same velocity, so that rounding adds up in the place alone.
    assert_close(closed, mjx, position=1e-3, quaternion=1e-3, velocity=1e-3, angular_velocity=1e-3)


def with_air(spec: mujoco.MjSpec) -> None:
    spec.option.density = 1.2


def with_a_joint(spec: mujoco.MjSpec) -> None:
    arm = spec.bodies[1].add_body(mass=0.1, inertia=[0.1, 0.1, 0.1])
    arm.add_joint()


def with_a_tilted_rotor(spec: mujoco.MjSpec) -> None:
    spec.sites[1].quat = [0.9, 0.1, 0.0, 0.0]


def with_a_load(spec: mujoco.MjSpec) -> None:
    spec.bodies[1].ipos = [0.0, 0.0, -0.1]


def with_damping(spec: mujoco.MjSpec) -> None:
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)


@pytest.mark.parametrize("change", [with_air, with_a_joint, with_a_tilted_rotor, with_a_load, with_damping])
def test_an_airframe_that_a_step_would_fly_wrongly_is_refused(change, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = mujoco.MjSpec.from_file(str(AIRFRAME_FILE))
    for shape in list(spec.geoms):
        spec.delete(shape)
    monkeypatch.setattr(drone, "c_model", lambda config: spec.compile())
    load_airframe(MJX)
    change(spec)
    with pytest.raises(ConfigError, match=r"^'skydio_x2.xml' must be one free body in a vacuum"):
        load_airframe(MJX)


def test_it_is_asked_for_by_a_flag_and_every_report_says_so() -> None:
    scene = load_scene(resolve_world("paper"))
    for words, physics in (([], "mjx"), (["--drone.physics", "rigid_body"], "rigid_body")):
        _, config = parse_train(words)
        assert config.drone.physics == workload(config, scene)["physics"] == physics
