"""The drone: its airframe, MJX against C MuJoCo, and the controller's bars."""

from __future__ import annotations

import dataclasses
import inspect

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from edqn_jax.config import Config
from edqn_jax.sim.physics import flight
from edqn_jax.sim.physics.airframe import Airframe, load_airframe
from edqn_jax.sim.physics.controller import rotor_thrusts
from edqn_jax.sim.physics.drone import DroneState, hover_state, wrap_angle, yaw_of
from edqn_jax.sim.physics.flight import _mjx_template, fly_decision, physics_step
from tests.oracles import drone_mujoco
from tracking import Decide, batched_fly, manoeuvres, measure

CONFIG = Config().drone
SPEED = Config().env.speed_m_s
BATCH = len(manoeuvres(SPEED)[0])  # one shape, so that `fly_decision` compiles once
ROTORS = np.array([[-0.14, -0.18, 0.05], [-0.14, 0.18, 0.05], [0.14, 0.18, 0.08], [0.14, -0.18, 0.08]])
MAX_THRUST = 13.0


@pytest.fixture(scope="module")
def airframe() -> Airframe:
    return load_airframe(CONFIG)


@pytest.fixture(scope="module")
def decide() -> Decide:
    return batched_fly(CONFIG)


@pytest.fixture(scope="module")
def step(airframe):
    return jax.jit(lambda state, thrust: physics_step(CONFIG, airframe, state, thrust))


@pytest.fixture(scope="module")
def thrust_of(airframe):
    return jax.jit(lambda state, command: rotor_thrusts(CONFIG, airframe, state, command))


def tumbling(seed: int, count: int) -> DroneState:
    """States [count] that no controller would choose: any attitude, fast, spinning."""
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    fields = (
        rng.normal(size=(count, 3)),
        quaternion,
        5 * rng.normal(size=(count, 3)),
        5 * rng.normal(size=(count, 3)),
        rng.uniform(-np.pi, np.pi, count),
    )
    return DroneState(*(jnp.asarray(field, jnp.float32) for field in fields))


def tilted(angle: np.ndarray, about: np.ndarray) -> DroneState:
    """At rest, leaning by angle [B] about horizontal axes at azimuth about [B], radians."""
    cos, sin = np.cos(angle / 2), np.sin(angle / 2)
    quaternion = np.stack([cos, sin * np.cos(about), sin * np.sin(about), 0 * sin], axis=1)
    level = jax.vmap(hover_state)(jnp.zeros((len(angle), 3)), jnp.zeros(len(angle)))
    return dataclasses.replace(level, quaternion=jnp.asarray(quaternion, jnp.float32))


def one(states: DroneState, index: int) -> DroneState:
    return jax.tree.map(lambda leaf: leaf[index], states)


# The airframe


def test_mass_and_inertia_are_those_of_the_five_solid_ellipsoids():
    parts = [(0.25, (0.13, 0.13, 0.01), place) for place in ROTORS]
    parts.append((0.325, (0.16, 0.04, 0.02), np.array([0.0, 0.0, 0.02])))
    mass = sum(part[0] for part in parts)
    centre = sum(part[0] * part[2] for part in parts) / mass
    inertia = np.zeros((3, 3))
    for part_mass, axes, place in parts:
        squares, arm = np.square(axes), place - centre
        inertia += part_mass / 5 * np.diag(squares.sum() - squares)
        inertia += part_mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    model, _ = drone_mujoco.load()
    assert model.body_mass[1] == pytest.approx(mass) == pytest.approx(1.325)
    np.testing.assert_allclose(model.body_inertia[1], np.diag(inertia), rtol=1e-5)  # written with six digits
    np.testing.assert_allclose(model.body_ipos[1], 0.0)
    np.testing.assert_allclose(model.site_pos, ROTORS - centre, atol=1e-6)


def test_rotors_across_turn_the_same_way_and_neighbours_do_not():
    model, _ = drone_mujoco.load()
    site = model.site_pos[model.actuator_trnid[:, 0]]
    spin = np.sign(model.actuator_gear[:, 5])
    across = np.sign(site[:, 0] * site[:, 1])
    assert abs(spin @ across) == 4
    np.testing.assert_allclose(np.abs(model.actuator_gear[:, 5]), 0.0201)
    np.testing.assert_allclose(model.actuator_ctrlrange, [[0, MAX_THRUST]] * 4)


def test_the_mixer_gives_the_wrench_asked_for_in_c_mujoco(airframe):
    wrench = np.array([20.0, 0.3, -0.2, 0.05])  # newtons, newton metres
    thrust = np.asarray(airframe.mixer) @ wrench
    level = np.array([0, 0, 0, 1, 0, 0, 0.0])
    got = drone_mujoco.acceleration(level, np.zeros(6), thrust)
    expected = np.array([0, 0, 20 / 1.325 - 9.81, 0.3 / 0.0366517, -0.2 / 0.0254117, 0.05 / 0.060528])
    np.testing.assert_allclose(got, expected, atol=1e-4)  # the mixer is float32


# MJX


@pytest.mark.slow
def test_a_hundred_steps_agree_with_c_mujoco_within_a_millimetre(step):
    drone_mujoco.check_hundred_steps(step)


@pytest.mark.slow
def test_our_stages_are_the_whole_of_mjx_step(airframe, step):
    model, _ = drone_mujoco.load()
    whole_model, whole_data = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
    thrust = jnp.array([2.0, 13.0, 0.0, 5.0])
    whole_step = jax.jit(mjx.step)
    for index in range(5):
        state = one(tumbling(2, 5), index)
        data = whole_step(
            whole_model,
            whole_data.replace(
                qpos=jnp.concatenate([state.position, state.quaternion]),
                qvel=jnp.concatenate([state.velocity, state.angular_velocity]),
                ctrl=thrust,
            ),
        )
        ours = step(state, thrust)
        # float32: accelerations of a tumbling body reach 500 rad/s^2
        np.testing.assert_allclose(jnp.concatenate([ours.position, ours.quaternion]), data.qpos, atol=2e-6)
        np.testing.assert_allclose(jnp.concatenate([ours.velocity, ours.angular_velocity]), data.qvel, atol=2e-5)


@pytest.mark.slow
def test_a_decision_is_its_physics_steps_one_by_one(decide, thrust_of, step):
    states = tilted(np.linspace(0, 0.5, BATCH), np.linspace(0, 6, BATCH))
    commands = jnp.asarray(manoeuvres(SPEED)[1], jnp.float32)
    yaws = jnp.linspace(-3, 3, BATCH)
    ends, flights = decide(states, commands, yaws)
    for index in (0, BATCH // 2, BATCH - 1):
        state, target = one(states, index), float(yaws[index])
        most = CONFIG.max_yaw_rate_rad_s * CONFIG.physics_dt_s
        for i in range(CONFIG.physics_steps):
            state = dataclasses.replace(state, yaw_setpoint=jnp.clip(target, -(i + 1) * most, (i + 1) * most))
            state = step(state, thrust_of(state, commands[index]))
            np.testing.assert_allclose(flights.position[index, i], state.position, atol=1e-5)
            np.testing.assert_allclose(flights.quaternion[index, i], state.quaternion, atol=1e-4)
            np.testing.assert_allclose(flights.velocity[index, i], state.velocity, atol=1e-4)
        np.testing.assert_allclose(ends.yaw_setpoint[index], state.yaw_setpoint, atol=1e-6)
        np.testing.assert_allclose(ends.position[index], flights.position[index, -1])


# Heading


@pytest.mark.slow
def test_heading_is_the_yaw_of_a_level_drone_and_a_lean_does_not_move_it():
    yaws = jnp.linspace(-3.1, 3.1, 7)
    np.testing.assert_allclose(
        jax.vmap(lambda yaw: yaw_of(hover_state(jnp.zeros(3), yaw).quaternion))(yaws), yaws, atol=1e-6
    )
    leaning = tilted(np.full(BATCH, 1.1), np.linspace(0, 6, BATCH))
    np.testing.assert_allclose(yaw_of(leaning.quaternion), 0.0, atol=1e-6)
    np.testing.assert_allclose(wrap_angle(jnp.array([3.5, -3.5])), [3.5 - 2 * np.pi, 2 * np.pi - 3.5], atol=1e-6)


@pytest.mark.parametrize("error", [0.3, -0.3, 3.0, -3.0])
def test_a_heading_error_turns_the_drone_the_way_that_shrinks_it(thrust_of, error):
    state = hover_state(jnp.zeros(3), jnp.float32(1.0))
    state = dataclasses.replace(state, yaw_setpoint=wrap_angle(jnp.float32(1.0 + error)))
    thrust = thrust_of(state, jnp.zeros(3))
    qpos = np.concatenate([state.position, state.quaternion])
    turning = drone_mujoco.acceleration(qpos, np.zeros(6), np.asarray(thrust))[5]
    assert np.sign(turning) == np.sign(error)
    assert abs(turning) > 1.0


@pytest.mark.slow
def test_the_setpoint_moves_at_its_rate_limit_by_the_shorter_way_and_the_drone_follows(decide):
    states = jax.vmap(hover_state)(jnp.zeros((BATCH, 3)), jnp.full(BATCH, 3.0))
    targets = jnp.linspace(-3.0, 2.0, BATCH)
    commands = jnp.zeros((BATCH, 3))
    most = CONFIG.max_yaw_rate_rad_s * CONFIG.physics_dt_s * CONFIG.physics_steps
    for decision in range(16):
        before = states
        states, flight = decide(states, commands, targets)
        moved = wrap_angle(states.yaw_setpoint - before.yaw_setpoint)
        assert jnp.abs(moved).max() <= most + 1e-5
        if decision == 0:  # 3.0 to -3.0 is +0.28 rad by the shorter way
            assert moved[0] == pytest.approx(2 * np.pi - 6.0, abs=1e-5)
            assert moved[-1] == pytest.approx(-most, abs=1e-5)
    np.testing.assert_allclose(wrap_angle(states.yaw_setpoint - targets), 0.0, atol=1e-5)
    np.testing.assert_allclose(wrap_angle(yaw_of(states.quaternion) - targets), 0.0, atol=0.02)
    assert jnp.linalg.norm(flight.velocity, axis=-1).max() < 0.01  # turning does not push it about


# Rotor limits


def test_rotor_thrusts_stay_within_limits_in_any_state(airframe, thrust_of):
    states = tumbling(3, 4096)
    commands = SPEED * jax.random.randint(jax.random.key(0), (4096, 3), -1, 2).astype(jnp.float32)
    got = jax.vmap(thrust_of)(states, commands)
    assert jnp.isfinite(got).all()
    assert got.min() == 0.0 and got.max() == pytest.approx(MAX_THRUST)  # and the limits do bind
    assert got.max() <= airframe.max_thrust


def torque_about_x(airframe: Airframe, thrust: jax.Array) -> float:
    return float((np.linalg.inv(np.asarray(airframe.mixer)) @ np.asarray(thrust))[1])


@pytest.mark.parametrize("climb", [-40.0, 40.0])
def test_neither_climb_nor_turn_weakens_the_torque_that_rights_the_drone(airframe, thrust_of, climb):
    level = hover_state(jnp.zeros(3), jnp.float32(0.0))
    rolling = dataclasses.replace(level, angular_velocity=jnp.array([4.0, 0, 0]))
    alone = torque_about_x(airframe, thrust_of(rolling, jnp.zeros(3)))
    busy = dataclasses.replace(rolling, yaw_setpoint=jnp.float32(2.0))
    together = torque_about_x(airframe, thrust_of(busy, jnp.array([0, 0, climb])))
    assert alone == pytest.approx(-4 * CONFIG.rate_gain * 0.0366517, rel=1e-3)  # as the rate loop asks
    assert together == pytest.approx(alone, rel=1e-3)


# Tracking (the table of docs/drone.md comes from the same measurement)


@pytest.fixture(scope="module")
def rows(decide):
    return measure(CONFIG, SPEED, decide)


@pytest.mark.slow
def test_every_action_is_reached_in_six_tenths_of_a_second_without_overshoot_beyond_a_tenth(rows):
    actions = [row for row in rows if row["kind"] == "from rest"]
    assert len(actions) == 26
    for row in actions:
        assert row["rise_s"] <= 0.6, row
        assert row["overshoot_percent"] <= 10, row
        assert row["steady_error_m_s"] <= 0.01, row


def test_level_manoeuvres_keep_their_height_and_heading(rows):
    level = [row for row in rows if row["height_change_m"] is not None]
    assert len(level) == 8 + 4 + 1
    for row in level:
        assert row["height_change_m"] <= 0.1, row
        assert row["heading_change_deg"] <= 5, row


def test_full_reversals_take_about_a_second_and_do_not_overshoot(rows):
    reversals = [row for row in rows if row["kind"] == "reversal"]
    assert len(reversals) == 6
    for row in reversals:
        assert row["rise_s"] <= 1.1, row
        assert row["overshoot_percent"] <= 5, row


def test_hover_does_not_drift(rows):
    (row,) = [row for row in rows if row["kind"] == "hover"]
    assert row["drift_m"] <= 1e-4  # rounding of 312 steps in float32
    assert row["steady_error_m_s"] <= 1e-4


def test_the_drone_recovers_from_a_tilt_of_45_degrees_on_the_spot(decide):
    states = tilted(np.full(BATCH, np.pi / 4), np.linspace(0, 2 * np.pi, BATCH))
    places = []
    for _ in range(10):
        states, flight = decide(states, jnp.zeros((BATCH, 3)), jnp.zeros(BATCH))
        places.append(flight.position)
    assert jnp.linalg.norm(jnp.concatenate(places, axis=1), axis=-1).max() < 0.5
    assert jnp.concatenate(places, axis=1)[..., 2].min() > -0.1
    assert jnp.linalg.norm(states.velocity, axis=-1).max() < 0.01


@pytest.mark.whole
@pytest.mark.slow
def test_a_hundred_thousand_random_decisions_never_diverge_nor_tip_the_drone_over(decide):
    rng = np.random.default_rng(4)
    states = jax.vmap(hover_state)(jnp.zeros((BATCH, 3)), jnp.zeros(BATCH))
    fastest, steepest = 0.0, 1.0
    for _ in range(-(-100_000 // BATCH)):
        commands = SPEED * rng.integers(-1, 2, (BATCH, 3)).astype(np.float32)
        yaws = rng.uniform(-np.pi, np.pi, BATCH).astype(np.float32)
        states, flight = decide(states, jnp.asarray(commands), jnp.asarray(yaws))
        velocity, quaternion = np.asarray(flight.velocity), np.asarray(flight.quaternion)
        assert np.isfinite(np.asarray(flight.position)).all()
        fastest = max(fastest, np.linalg.norm(velocity, axis=-1).max())
        steepest = min(steepest, (1 - 2 * (quaternion[..., 1] ** 2 + quaternion[..., 2] ** 2)).min())
    # Commands that flip in mid-turn outrun the command for a moment; measured 8.9 m/s and 69 degrees.
    assert fastest <= 1.5 * SPEED * np.sqrt(3)
    assert steepest > np.cos(np.radians(80))


def test_fly_traces_to_one_scan_without_callbacks(airframe):
    state = hover_state(jnp.zeros(3), jnp.float32(0.0))
    program = str(
        jax.make_jaxpr(lambda s, c, y: fly_decision(CONFIG, airframe, s, c, y))(state, jnp.zeros(3), jnp.float32(0.0))
    )
    assert "callback" not in program
    assert program.count("length=13") == 1


@pytest.mark.parametrize("axis", ["env", "mission"])  # one after the other, in one process
def test_it_flies_in_programs_of_different_meshes(airframe, axis, monkeypatch):
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), (axis,))
    spec = jax.sharding.PartitionSpec(axis)
    monkeypatch.setattr(flight, "_mjx_step", inspect.unwrap(flight._mjx_step))  # traced in each, not once
    if axis == "env":  # the first: the template is made in its mesh
        _mjx_template.cache_clear()

    def fall(place: jax.Array) -> jax.Array:
        return physics_step(CONFIG, airframe, hover_state(place, jnp.float32(0.0)), jnp.zeros(4)).velocity

    falling = jax.shard_map(jax.vmap(fall), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    np.testing.assert_allclose(jax.jit(falling)(jnp.zeros((2, 3)))[:, 2], -9.81 * CONFIG.physics_dt_s, rtol=1e-5)


def test_the_airframe_file_holds_nothing_that_collides_and_no_air():
    model, _ = drone_mujoco.load()
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    assert model.opt.density == model.opt.viscosity == 0
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert model.opt.timestep == pytest.approx(CONFIG.physics_dt_s)
