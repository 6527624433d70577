"""The closed form beside MJX and C MuJoCo, from any state, for a step, a decision and a flight."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.cli import parse_train
from edqn_jax.config import Config
from edqn_jax.provenance import workload
from edqn_jax.sim.drone import DroneState, hover, load_airframe, physics_step
from edqn_jax.sim.mjcf import load_scene, resolve_world
from tests.oracles import drone_mujoco
from tracking import batched_fly

MJX = Config().drone
CLOSED = dataclasses.replace(MJX, physics="rigid_body")
MAX_THRUST = 13.0
COUNT = 256


def tumbling(rng: np.random.Generator) -> DroneState:
    """States [COUNT] that no controller would choose: any attitude, fast, spinning; the first at rest."""
    quaternion = rng.normal(size=(COUNT, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    velocity, turning = 5 * rng.normal(size=(2, COUNT, 3))
    turning[0] = 0.0
    fields = (rng.normal(size=(COUNT, 3)), quaternion, velocity, turning, np.zeros(COUNT))
    return DroneState(*(jnp.asarray(field, jnp.float32) for field in fields))


def assert_close(ours: DroneState, theirs: DroneState, place: float, speed: float) -> None:
    for name, tolerance in (
        ("position", place),
        ("quaternion", place),
        ("velocity", speed),
        ("angular_velocity", speed),
    ):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=tolerance, rtol=0, err_msg=name)


@pytest.mark.parametrize("dt", [0.02, 0.004])
def test_from_any_state_a_step_is_that_of_mjx(dt: float) -> None:
    rng = np.random.default_rng(0)
    states = tumbling(rng)
    thrusts = jnp.asarray(rng.uniform(0, MAX_THRUST, (COUNT, 4)), jnp.float32).at[0].set(0.0)
    ends = []
    for drone in (MJX, CLOSED):
        drone = dataclasses.replace(drone, physics_dt_s=dt)
        airframe = load_airframe(drone)
        step = jax.vmap(
            lambda state, thrust, drone=drone, airframe=airframe: physics_step(drone, airframe, state, thrust)
        )
        ends.append(jax.jit(step)(states, thrusts))
    # float32: accelerations of a tumbling body reach 500 rad/s^2, of which a step adds up to 10 rad/s
    assert_close(ends[1], ends[0], 2e-6, 2e-5)
    np.testing.assert_allclose(jnp.linalg.norm(ends[1].quaternion, axis=1), 1.0, atol=1e-6)


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
    assert_close(closed, mjx, 1e-3, 1e-3)


def test_it_is_asked_for_by_a_flag_and_every_report_says_so() -> None:
    scene = load_scene(resolve_world("paper"))
    for words, physics in (([], "mjx"), (["--drone.physics", "rigid_body"], "rigid_body")):
        _, config = parse_train(words)
        assert config.drone.physics == workload(config, scene)["physics"] == physics
