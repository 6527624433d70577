"""Compares the closed form with MJX and C MuJoCo, from any state, for a step and for a flight."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from edqn_jax.cli.train import parse_train
from edqn_jax.config import Config, DroneConfig
from edqn_jax.config.registry import AIRFRAMES
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.physics.airframe import SKYDIO_X2, load_airframe
from edqn_jax.sim.physics.drone import DroneState, hover_state
from edqn_jax.sim.physics.flight import physics_step
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from tests.oracles import drone_mujoco
from tests.support.marks import in_whole
from tests.support.registries import keep_as_they_are
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


@pytest.mark.parametrize("dt", [0.02, *in_whole(0.004)])
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
    airframe = load_airframe(CLOSED)
    drone_mujoco.check_hundred_steps(jax.jit(lambda state, thrust: physics_step(CLOSED, airframe, state, thrust)))


@pytest.mark.slow
def test_flights_of_random_moves_are_those_of_mjx() -> None:
    rng = np.random.default_rng(2)
    start = jax.vmap(hover_state)(jnp.zeros((COUNT, 3)), jnp.zeros(COUNT))
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
    arm = spec.bodies[1].add_body(mass=0.1, inertia=[0.1, 0.1, 0.1], explicitinertial=True, ipos=[0, 0, 0])
    arm.add_joint()


def with_a_tilted_rotor(spec: mujoco.MjSpec) -> None:
    spec.sites[1].quat = [0.9, 0.1, 0.0, 0.0]


def with_a_load(spec: mujoco.MjSpec) -> None:
    spec.bodies[1].ipos = [0.0, 0.0, -0.1]


def with_damping(spec: mujoco.MjSpec) -> None:
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)


def with_a_stronger_rotor(spec: mujoco.MjSpec) -> None:
    spec.actuators[0].ctrlrange = [0.0, 14.0]


def with_a_longer_arm(spec: mujoco.MjSpec) -> None:
    spec.sites[0].pos = [-0.2, -0.18, 0.0]


def without_yaw(spec: mujoco.MjSpec) -> None:
    for actuator in spec.actuators:
        actuator.gear = [0, 0, 1, 0, 0, 0]


def registered(spec: mujoco.MjSpec, folder: Path, monkeypatch: pytest.MonkeyPatch) -> DroneConfig:
    """The drone of an airframe of one's own, `mine`."""
    keep_as_they_are(monkeypatch)
    (folder / "mine.xml").write_text(spec.to_xml(), encoding="utf-8")
    AIRFRAMES.register("mine", folder / "mine.xml")
    return dataclasses.replace(MJX, airframe="mine")


FREE, QUADROTOR = "be one free body in a vacuum", "have four rotors of the same range"


@pytest.mark.parametrize(
    ("change", "what"),
    [
        *((change, FREE) for change in (with_air, with_a_joint, with_a_tilted_rotor, with_a_load, with_damping)),
        *((change, QUADROTOR) for change in (with_a_stronger_rotor, with_a_longer_arm, without_yaw)),
    ],
)
def test_an_airframe_that_would_be_flown_wrongly_is_refused(
    change: Callable[[mujoco.MjSpec], None], what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = mujoco.MjSpec.from_file(str(SKYDIO_X2))
    config = registered(spec, tmp_path, monkeypatch)
    load_airframe(config)
    change(spec)
    (tmp_path / "mine.xml").write_text(spec.to_xml(), encoding="utf-8")
    with pytest.raises(ConfigError, match=f"^the airframe 'mine' must {what}"):
        load_airframe(config)


def test_another_quadrotor_is_a_file_and_an_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = mujoco.MjSpec.from_file(str(SKYDIO_X2))
    spec.bodies[1].mass *= 1.5
    spec.bodies[1].inertia = 1.2 * np.array(spec.bodies[1].inertia)
    heavy = registered(spec, tmp_path, monkeypatch)
    validate(dataclasses.replace(Config(), drone=heavy))
    airframe = load_airframe(heavy)
    np.testing.assert_allclose(float(airframe.mass), 1.5 * 1.325, rtol=1e-6)
    for physics in ("mjx", "rigid_body"):
        config = dataclasses.replace(heavy, physics=physics)
        state = hover_state(jnp.zeros(3), jnp.float32(0.0))
        push = jnp.full(4, airframe.mass * 9.81 / 4 + 0.5)
        risen = jax.jit(partial(physics_step, config, airframe))(state, push)
        np.testing.assert_allclose(risen.velocity, [0, 0, 2.0 / (1.5 * 1.325) * config.physics_dt_s], atol=1e-5)


def test_an_airframe_that_mujoco_cannot_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = registered(mujoco.MjSpec.from_file(str(SKYDIO_X2)), tmp_path, monkeypatch)
    for break_it in ((tmp_path / "mine.xml").write_bytes, lambda _: (tmp_path / "mine.xml").unlink()):
        break_it(b"<mujoco>")
        with pytest.raises(ConfigError, match="^the airframe 'mine' is no MJCF that MuJoCo can read: [^\\n]*$"):
            load_airframe(config)


def test_an_airframe_that_there_is_not_is_refused() -> None:
    with pytest.raises(ConfigError, match="drone.airframe: there is no airframe 'skydio_x3'; did you mean 'skydio_x2'"):
        validate(dataclasses.replace(Config(), drone=dataclasses.replace(MJX, airframe="skydio_x3")))


def test_it_is_asked_for_by_a_flag_and_every_report_says_so() -> None:
    scene = load_scene(resolve_world("paper"))
    for words, physics in (([], "mjx"), (["--drone.physics", "rigid_body"], "rigid_body")):
        _, config = parse_train(words)
        assert config.drone.physics == describe_workload(config, scene)["physics"] == physics
