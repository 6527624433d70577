"""Disturbances: a disturbed body against C MuJoCo with a changed model, gusts against Dryden's formulas, the task."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from edqn_jax.config import AirConfig, BodyConfig, Config, EnvConfig, MotorsConfig, NoiseConfig
from edqn_jax.config.loading import apply_layer, load_layer
from edqn_jax.policies import policy_folder
from edqn_jax.sim.actions import ACTIONS, move_number
from edqn_jax.sim.physics import disturbances
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.controller import VelocityCommand
from edqn_jax.sim.physics.disturbances import Disturbance, Load
from edqn_jax.sim.physics.drone import DroneState, hover_state
from edqn_jax.sim.physics.flight import fly_disturbed, physics_step
from edqn_jax.sim.scene.scene import build_scene, stack_scenes
from edqn_jax.sim.task import decision, env
from edqn_jax.sim.task.missions import Missions
from tests.oracles import drone_mujoco
from tests.support.drawn_scenes import GROUND

MAX_THRUST = 13.0
ENGINES = ("mjx", "rigid_body")


def with_engine(engine: Any, config: Config = Config()) -> Config:  # noqa: B008
    return dataclasses.replace(config, drone=dataclasses.replace(config.drone, physics=engine))


# ------------------------------------------------------------------------------------------- bodies


@pytest.mark.parametrize("engine", ENGINES)
def test_a_step_of_another_body_in_wind_is_that_of_c_mujoco_with_a_changed_model(engine):
    rng, count = np.random.default_rng(0), 16
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    velocity, turning = 5 * rng.normal(size=(2, count, 3))
    place, thrust = rng.uniform(-5, 5, (count, 3)), rng.uniform(0, 1.2 * MAX_THRUST, (count, 4))
    force, mass, inertia = 10 * rng.normal(size=(count, 3)), *rng.uniform(0.5, 1.5, (2, count))
    config = with_engine(engine).drone
    single = lambda *given: [jnp.asarray(each, jnp.float32) for each in given]  # noqa: E731
    states = DroneState(*single(place, quaternion, velocity, turning, np.zeros(count)))
    step = jax.jit(jax.vmap(partial(physics_step, config, load_airframe(config))))
    ours = step(states, *single(thrust), Load(*single(force, mass, inertia)))
    for i in range(count):
        begins = np.concatenate([place[i], quaternion[i]]), np.concatenate([velocity[i], turning[i]])
        # Thrusts beyond a nominal rotor's are made by its gain.
        gain = np.maximum(thrust[i] / MAX_THRUST, 1.0)
        (where,), (speed,) = drone_mujoco.fly_loaded(
            *begins,
            thrust[i : i + 1] / gain,
            mass=mass[i],
            inertia=inertia[i],
            gain=gain,
            push=lambda velocity, i=i: force[i],
        )
        # As in test_rigid_body: float32, and accelerations of up to 1000 rad/s^2.
        np.testing.assert_allclose(ours.position[i], where[:3], atol=2e-6)
        np.testing.assert_allclose(ours.quaternion[i], where[3:], atol=4e-6)
        np.testing.assert_allclose(ours.velocity[i], speed[:3], atol=2e-5)
        np.testing.assert_allclose(ours.angular_velocity[i], speed[3:], atol=1e-4)


AIR = AirConfig(wind_m_s=8.0, gusts_m_s=2.0)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_hundred_steps_in_wind_with_slow_uneven_motors_agree_with_c_mujoco_within_a_millimetre(engine):
    rng = np.random.default_rng(1)
    # Slow motors and a heavier body need more thrust to stay in the air.
    sequence = np.clip(3.6 + rng.normal(0, 0.4, (100, 4)), 0, MAX_THRUST)
    gain, wind = np.array([0.9, 1.1, 1.05, 0.97]), np.array([3.0, -4.0, 0.0])
    config = with_engine(engine, Config(air=AIR, motors=MotorsConfig(gain_share=0.2, lag_s=0.1)))
    airframe = load_airframe(config.drone)
    disturbance = Disturbance(
        ahead=jnp.array([0.6, -0.8]),
        wind=jnp.float32(5.0),
        mass=jnp.float32(1.15),
        inertia=jnp.float32(0.85),
        gain=jnp.asarray(gain, jnp.float32),
        lag_s=jnp.float32(0.05),
        thrust=jnp.full(4, 3.25),
    )

    @jax.jit
    def step(state, now, thrust):
        now, thrust = disturbances.motor_step(config.motors, config.drone.physics_dt_s, now, thrust)
        load = disturbances.load_of(config.air, now, state.velocity)
        return physics_step(config.drone, airframe, state, thrust, load), now

    def push(velocity):
        apart = wind - velocity
        return (0.4 + 0.5 * 1.225 * 0.05 * np.linalg.norm(apart)) * apart

    state = hover_state(jnp.array([1.0, -2.0, 30.0]), jnp.float32(0.4))
    state = dataclasses.replace(state, angular_velocity=jnp.array([0.5, -0.3, 0.2]))
    qpos = np.concatenate([state.position, state.quaternion])
    qvel = np.concatenate([state.velocity, state.angular_velocity])
    places, speeds = drone_mujoco.fly_loaded(
        *(qpos, qvel, sequence), mass=1.15, inertia=0.85, gain=gain, lag_s=0.05, first=3.25, push=push
    )
    assert np.linalg.norm(places[-1, :3] - qpos[:3]) > 5  # it went somewhere
    for thrust, place, speed in zip(sequence, places, speeds, strict=True):
        state, disturbance = step(state, disturbance, jnp.asarray(thrust, jnp.float32))
        np.testing.assert_allclose(state.position, place[:3], atol=1e-3)
        np.testing.assert_allclose(state.quaternion, place[3:], atol=2e-4)
        np.testing.assert_allclose(state.velocity, speed[:3], atol=1e-3)
        np.testing.assert_allclose(state.angular_velocity, speed[3:], atol=1e-3)


def test_without_a_lag_thrusts_are_their_commands_and_with_one_they_come_nearer_by_the_same_share():
    motors, command = MotorsConfig(lag_s=0.1), jnp.array([0.0, 2.0, 4.0, 13.0])
    begun = Disturbance(lag_s=jnp.float32(0.0), thrust=jnp.full(4, 3.0))
    np.testing.assert_array_equal(disturbances.motor_step(motors, 0.02, begun, command)[1], command)
    begun = dataclasses.replace(begun, lag_s=jnp.float32(0.04))
    for _ in range(3):
        begun, thrust = disturbances.motor_step(motors, 0.02, begun, command)
    # Exact: three steps are one of three times the length.
    np.testing.assert_allclose(thrust, command + np.exp(-0.06 / 0.04) * (3.0 - np.asarray(command)), rtol=1e-6)
    assert disturbances.motor_step(MotorsConfig(), 0.02, Disturbance(), command)[1] is command


# -------------------------------------------------------------------------------------------- gusts


def linear(function, size: int) -> np.ndarray:
    """The matrix of a linear function of one vector [size]."""
    return np.array(jax.vmap(function)(jnp.eye(size)), np.float64).T


@pytest.mark.parametrize("dt", [0.02, 0.5, 30.0])
def test_a_step_of_the_gusts_is_exact_at_any_length(dt):
    air = AirConfig(gusts_m_s=1.0, gust_height_m=20.0, gust_airspeed_m_s=7.0)
    scales, n = disturbances.gust_scales(air), disturbances.GUST_STATES
    level, vertical = scales.level_m / 7.0, scales.vertical_m / 7.0
    # x' = A x + B n of white noise n: u, then v and w with two states each, of which the first has a variance of 1.
    drift, drive = np.zeros((n, n)), np.zeros((n, 3))
    drift[0, 0], drive[0, 0] = -1 / level, np.sqrt(2 / level)
    for first, column, time in ((1, 1, level), (3, 2, vertical)):
        drift[first : first + 2, first : first + 2] = np.array([[-1.0, 0.0], [1.0, -1.0]]) / time
        drive[first, column] = np.sqrt(2 / time)
    transition = scipy.linalg.expm(drift * dt)
    stationary = scipy.linalg.solve_continuous_lyapunov(drift, -drive @ drive.T)
    noise = stationary - transition @ stationary @ transition.T
    none = jnp.zeros(n)
    ours = linear(lambda x: disturbances.next_gusts(air, dt, x, none), n)
    driven = linear(lambda white: disturbances.next_gusts(air, dt, none, white), n)
    np.testing.assert_allclose(ours, transition, atol=1e-6)  # float32
    np.testing.assert_allclose(driven @ driven.T, noise, atol=1e-6, rtol=1e-3)


@pytest.mark.whole
@pytest.mark.slow
def test_gusts_have_the_deviations_and_the_correlation_times_of_dryden_from_their_first_step_on():
    air = AirConfig(gusts_m_s=5.0, gust_height_m=3.048, gust_airspeed_m_s=20.0)  # quick, so that a run is long
    scales, dt, runs, steps = disturbances.gust_scales(air), 0.05, 256, 20_000
    assert scales.level_m == pytest.approx(3.048 / (0.177 + 0.00823) ** 1.2)
    assert scales.vertical_m_s == pytest.approx(5.0 * (0.177 + 0.00823) ** 0.4)

    @jax.jit
    def flown(key):
        first, rest = jax.random.split(key)
        begun = jax.vmap(disturbances.stationary_gusts)(jax.random.split(first, runs))

        def step(gusts, key):
            white = jax.random.normal(key, gusts.shape)
            after = jax.vmap(partial(disturbances.next_gusts, air, dt))(gusts, white)
            return after, jnp.stack(jax.vmap(partial(disturbances.gust_velocity, air))(gusts))

        return jax.lax.scan(step, begun, jax.random.split(rest, steps))[1]

    speeds = np.asarray(flown(jax.random.key(0)), np.float64)  # [steps, 3, runs]
    wanted = np.array([scales.level_m_s, scales.level_m_s, scales.vertical_m_s])
    # 256 runs of 1000 s, 870 correlation times each: the deviation is known to 0.3 %, a correlation to 0.005.
    np.testing.assert_allclose(speeds.std(axis=(0, 2)), wanted, rtol=0.01)
    np.testing.assert_allclose(np.mean(speeds, axis=(0, 2)), 0.0, atol=0.05)
    unit = speeds / wanted[:, None]
    times = np.array([scales.level_m, scales.level_m, scales.vertical_m]) / 20.0
    for lag in (1, 3, 10, 23, 60):
        found = np.mean(unit[lag:] * unit[:-lag], axis=(0, 2))
        share = lag * dt / times
        across = (1 - share / 2) * np.exp(-share)
        np.testing.assert_allclose(found, [np.exp(-share[0]), across[1], across[2]], atol=0.01)
    crossed = [np.mean(unit[:, i] * unit[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(crossed, 0.0, atol=0.01)
    begun = jax.vmap(disturbances.stationary_gusts)(jax.random.split(jax.random.key(1), 40_000))
    first = np.stack(jax.vmap(partial(disturbances.gust_velocity, air))(begun))
    np.testing.assert_allclose(first.std(axis=1), wanted, rtol=0.015)  # 40,000 draws: 0.4 %


# ------------------------------------------------------------------------------------------- flying


# One program for flights of the same configuration, however many there are.
fly, reset, step = (jax.jit(each, static_argnums=0) for each in (fly_disturbed, env.reset, env.step))


def flown_disturbed(config: Config, disturbance: Disturbance, command, decisions: int, key=0):
    """State and disturbance after decisions at a held command, and all flights."""
    airframe = load_airframe(config.drone)
    state, flights = hover_state(jnp.array([0.0, 0.0, 50.0]), jnp.float32(0.0)), []
    held = VelocityCommand(jnp.asarray(command, jnp.float32), jnp.float32(0.0))
    for each in jax.random.split(jax.random.key(key), decisions):
        state, disturbance, flight = fly(config, airframe, state, disturbance, held, each)
        flights.append(flight)
    return state, disturbance, flights


def test_a_hovering_drone_drifts_downwind_until_its_controller_leans_as_hard_as_the_wind_pushes():
    config = with_engine("rigid_body", Config(air=AirConfig(wind_m_s=8.0)))
    disturbance = Disturbance(ahead=jnp.array([0.6, 0.8]), wind=jnp.float32(8.0))
    state, _, _ = flown_disturbed(config, disturbance, (0, 0, 0), 30)
    velocity = np.asarray(state.velocity, np.float64)
    apart = np.array([4.8, 6.4, 0.0]) - velocity
    push = (0.4 + 0.5 * 1.225 * 0.05 * np.linalg.norm(apart)) * apart
    np.testing.assert_allclose(1.325 * config.drone.velocity_gain * velocity[:2], push[:2], rtol=1e-3)
    assert 0.5 < np.linalg.norm(velocity) < 1.5


def test_the_velocity_that_is_held_changes_no_faster_than_the_autopilot_lets_it():
    config = with_engine("rigid_body", Config(env=EnvConfig(setpoint_m_s2=4.0)))
    drone, dt_s = config.drone, config.drone.physics_dt_s
    disturbance = Disturbance(ramp=jnp.float32(1 / 5.0), held=jnp.array([0.0, -1.0, 0.0]))
    plain = np.array([0.0, -1.0, 0.0])
    for command in ((3.0, 1.0, 0.5), (0.0, 0.0, -2.0)):  # the second is asked before the first is held
        disturbance, given = disturbances.held_velocities(drone, disturbance, jnp.array(command))
        for velocity in np.asarray(given):
            change = np.array(command) - plain
            plain = plain + change * min(1.0, 5.0 * dt_s / max(float(np.linalg.norm(change)), 1e-9))
            np.testing.assert_allclose(velocity, plain, atol=1e-5)
    assert plain[2] > -1.5


def test_a_velocity_that_may_jump_is_flown_as_without_an_autopilot_and_a_slow_one_later():
    config = with_engine("rigid_body", Config(env=EnvConfig(setpoint_m_s2=4.0)))
    jumps, slow = (Disturbance(ramp=jnp.float32(ramp), held=jnp.zeros(3)) for ramp in (0.0, 0.25))
    free = flown_disturbed(config, Disturbance(), (4, 0, 0), 2)[0].velocity
    np.testing.assert_allclose(flown_disturbed(config, jumps, (4, 0, 0), 2)[0].velocity, free, atol=1e-4)
    # 0.52 s of 4 m/s^2, less what the drone lags behind: one time constant of its controller and some of its attitude
    late = float(flown_disturbed(config, slow, (4, 0, 0), 2)[0].velocity[0])
    assert 0.8 < late < 2.08 < free[0]
    held: Any = flown_disturbed(config, slow, (4, 0, 0), 2)[1].held
    np.testing.assert_allclose(held, [2.08, 0, 0], atol=1e-4)


def drawn_often(config: Config) -> Any:
    """The disturbances of 2,000 episodes."""
    draw = partial(disturbances.sample_disturbance, config, jnp.float32(1.0))
    return jax.vmap(draw)(jax.random.split(jax.random.key(0), 2000))


def test_the_autopilot_limits_a_share_of_the_episodes():
    config = dataclasses.replace(QUIET, env=dataclasses.replace(QUIET.env, setpoint_m_s2=4.0, setpoint_share=0.3))

    ramps = np.asarray(drawn_often(config).ramp)
    assert 0.25 < np.mean(ramps > 0) < 0.35  # five deviations of 2,000 draws
    assert 0.23 < ramps.max() <= 0.25


def test_the_controller_gives_the_nominal_thrust_so_that_a_light_drone_rises_and_a_weak_one_sinks():
    config = with_engine("rigid_body", Config(body=BodyConfig(mass_share=0.2), motors=MotorsConfig(gain_share=0.2)))
    gain = config.drone.climb_gain
    for mass, share in ((0.8, 1.0), (1.0, 0.8), (1.2, 1.1)):
        disturbance = Disturbance(mass=jnp.float32(mass), gain=jnp.full(4, share))
        state, _, _ = flown_disturbed(config, disturbance, (0, 0, 0), 12)
        # share (g - gain v) = mass g in steady flight
        np.testing.assert_allclose(state.velocity, [0, 0, 9.81 * (1 - mass / share) / gain], atol=1e-3)


@pytest.mark.slow
def test_both_engines_fly_the_same_disturbed_flight():
    given = Config(air=AIR, body=BodyConfig(0.2, 0.2), motors=MotorsConfig(0.2, 0.05))
    disturbance = disturbances.sample_disturbance(given, jnp.float32(3.25), jax.random.key(2))
    assert disturbance is not None
    (mjx, _, _), (closed, _, _) = (
        flown_disturbed(with_engine(engine, given), disturbance, (3.0, -2.0, 1.0), 12) for engine in ENGINES
    )
    assert np.linalg.norm(mjx.position - jnp.array([0, 0, 50.0])) > 5
    np.testing.assert_allclose(closed.position, mjx.position, atol=1e-3)
    np.testing.assert_allclose(closed.velocity, mjx.velocity, atol=1e-3)


# ----------------------------------------------------------------------------------------- the task

QUIET = with_engine("rigid_body", Config(env=EnvConfig(sensor="blind", max_decisions=3)))
VOLUME = np.array([[0.0, 0.0, 0.0], [60.0, 60.0, 25.0]])
START, GOAL = (5.0, 5.0, 10.0), (50.0, 50.0, 10.0)
AHEAD, BACK = move_number("ahead"), move_number("back")

EVERYTHING = dataclasses.replace(
    QUIET,
    env=dataclasses.replace(QUIET.env, action_delay=1, setpoint_m_s2=4.0),
    air=AIR,
    body=BodyConfig(0.2, 0.2),
    motors=MotorsConfig(0.2, 0.05),
    noise=NoiseConfig(0.5, 0.3, 0.4, 0.2),
)


@pytest.fixture(scope="module")
def world() -> env.EnvParams:
    scene = build_scene([GROUND], volume=VOLUME, start=list(START), goal=list(GOAL))
    missions = Missions(scene=jnp.zeros(1, jnp.int32), start=jnp.array([START]), goal=jnp.array([GOAL]))
    return env.EnvParams(airframe=load_airframe(QUIET.drone), pool=stack_scenes([scene]), missions=missions)


def flown(config: Config, world: env.EnvParams, moves, seed: int = 0) -> tuple[list[Any], Any, list[Any]]:
    """States after a reset and after each move, the first observation, and what the moves led to."""
    state, observation = reset(config, world, jax.random.key(seed))
    states, steps = [state], []
    for move in moves:
        state, result = step(config, world, state, move)
        states.append(state)
        steps.append(result)
    return states, observation, steps


def test_with_everything_off_there_is_no_state_and_nothing_is_drawn(world):
    assert not disturbances.any_on(Config()) and not disturbances.changes_flight(Config())
    assert flown(QUIET, world, [AHEAD])[0][1].disturbance is None
    assert disturbances.sample_disturbance(Config(), jnp.float32(3.0), jax.random.key(0)) is None


@pytest.mark.parametrize(
    ("change", "fields"),
    [
        ({"air": AirConfig(wind_m_s=3.0)}, {"ahead", "wind"}),
        ({"air": AirConfig(gusts_m_s=3.0)}, {"ahead", "gusts"}),
        ({"air": AirConfig(drag=True)}, set()),
        ({"body": BodyConfig(mass_share=0.2)}, {"mass"}),
        ({"body": BodyConfig(inertia_share=0.2)}, {"inertia"}),
        ({"motors": MotorsConfig(gain_share=0.2)}, {"gain"}),
        ({"motors": MotorsConfig(lag_s=0.1)}, {"lag_s", "thrust"}),
        ({"env": EnvConfig(setpoint_m_s2=4.0)}, {"ramp", "held"}),
        ({"env": EnvConfig(action_delay=1)}, set()),  # the move that is flown late belongs to the task
        ({"noise": NoiseConfig(position_m=0.5)}, set()),
        ({"noise": NoiseConfig(velocity_bias_m_s=0.5)}, {"velocity_bias"}),
    ],
)
def test_every_switch_turns_on_its_own_disturbance_alone(change, fields):
    config = dataclasses.replace(Config(), **change)
    drawn = disturbances.sample_disturbance(config, jnp.float32(3.0), jax.random.key(0))
    assert drawn is not None
    assert {name for name, value in vars(drawn).items() if value is not None} == fields


def test_draws_are_uniform_within_their_limits_and_differ_between_episodes():
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn: Any = jax.vmap(lambda key: disturbances.sample_disturbance(EVERYTHING, jnp.float32(3.0), key))(keys)
    # Mean and deviation of 4000 uniform numbers: to 0.5 % and 1 % of the range.
    for value, low, high in (
        (drawn.mass, 0.8, 1.2),
        (drawn.inertia, 0.8, 1.2),
        (drawn.gain, 0.8, 1.2),
        (drawn.wind, 0.0, 8.0),
        (drawn.lag_s, 0.0, 0.05),
        (drawn.ramp, 0.0, 0.25),
    ):
        assert low <= value.min() and value.max() <= high
        np.testing.assert_allclose(value.mean(), (low + high) / 2, atol=0.02 * (high - low))
        np.testing.assert_allclose(value.std(), (high - low) / np.sqrt(12), rtol=0.03)
    np.testing.assert_allclose(drawn.ahead.mean(axis=0), 0.0, atol=0.05)
    np.testing.assert_allclose(jnp.sum(drawn.ahead**2, axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(drawn.position_bias.std(), 0.4, rtol=0.03)
    np.testing.assert_allclose(drawn.velocity_bias.std(), 0.2, rtol=0.03)
    # Nothing depends on anything else.
    numbers = np.stack(
        [drawn.mass, drawn.inertia, *drawn.gain.T, drawn.wind, drawn.lag_s, drawn.ramp, drawn.ahead[:, 0]]
    )
    assert np.abs(np.corrcoef(numbers) - np.eye(len(numbers))).max() < 0.06  # four deviations of 1 / sqrt(4000)


@pytest.mark.whole
def test_an_episode_keeps_what_it_drew_and_the_next_one_draws_anew(world):
    states, _, steps = flown(EVERYTHING, world, [AHEAD] * 4)
    assert [bool(step.is_reset) for step in steps] == [False, False, False, True]
    begun, *_, last, fresh = (state.disturbance for state in states)
    constant = ("ahead", "wind", "mass", "inertia", "gain", "lag_s", "position_bias", "velocity_bias")
    for name in constant:
        np.testing.assert_array_equal(getattr(begun, name), getattr(last, name))
        assert np.all(np.asarray(getattr(begun, name)) != np.asarray(getattr(fresh, name)))
    for name in ("gusts", "thrust"):
        assert np.all(np.asarray(getattr(begun, name)) != np.asarray(getattr(last, name)))
    np.testing.assert_allclose(fresh.thrust, 1.325 * 9.81 / 4, rtol=1e-6)
    assert fresh.move == move_number("hover")


def test_the_same_key_flies_the_same_disturbed_flight_and_another_key_another_one(world):
    ends = [np.asarray(flown(EVERYTHING, world, [AHEAD] * 3, seed)[0][-1].drone.position) for seed in (3, 3, 4)]
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.all(ends[0] != ends[2])


@pytest.mark.whole
@pytest.mark.parametrize("engine", ENGINES)
def test_with_everything_on_no_key_is_used_twice_and_no_rank_is_promoted(engine, world):
    config = with_engine(engine, EVERYTHING)
    with jax.numpy_rank_promotion("raise"), jax.debug_key_reuse(True):  # tracing is enough
        state, _ = jax.jit(partial(env.reset, config, world)).trace(jax.random.key(0)).out_info
        after, _ = jax.jit(partial(env.step, config, world)).trace(state, AHEAD).out_info
    assert isinstance(after.disturbance, Disturbance)


def test_a_delayed_move_is_flown_one_decision_later_and_known_at_once(world):
    moves = [AHEAD, BACK, move_number("left")]
    delayed = dataclasses.replace(QUIET, env=dataclasses.replace(QUIET.env, action_delay=1))
    states, begun, late = flown(delayed, world, moves)
    _, _, prompt = flown(QUIET, world, [move_number("hover"), *moves[:2]])
    for ours, theirs in zip(late, prompt, strict=True):
        np.testing.assert_allclose(ours.flight.position, theirs.flight.position, atol=1e-6)  # two programs
    assert np.ptp(late[0].flight.position, axis=0).max() < 1e-4 < np.ptp(late[1].flight.position, axis=0).max()
    np.testing.assert_array_equal(begun.motion[4:], 0)
    for move, step, state in zip(moves, late, states[1:], strict=True):
        np.testing.assert_array_equal(step.observation.motion[4:], ACTIONS[move])
        assert state.disturbance.move == move


def test_a_share_of_the_episodes_is_late_and_each_from_its_first_decision_to_its_last():
    config = dataclasses.replace(QUIET, env=dataclasses.replace(QUIET.env, action_delay=1, delay_share=0.3))

    assert 0.25 < np.mean(drawn_often(config).late) < 0.35  # five deviations of 2,000 draws
    assert moves_flown(config, late=False) == [AHEAD, BACK]
    assert moves_flown(config, late=True) == [0, AHEAD]


def moves_flown(config: Config, late: bool) -> list[int]:
    """The moves that are flown of ahead and back, after move 0."""
    disturbance, moves = Disturbance(late=jnp.asarray(late), move=jnp.int32(0)), []
    for action in (AHEAD, BACK):
        move, disturbance = decision._delay_action(config, disturbance, jnp.int32(action))
        assert disturbance is not None and disturbance.move == action
        moves.append(int(move))
    return moves


def test_noise_changes_what_is_known_and_nothing_that_is_flown(world):
    noisy = dataclasses.replace(QUIET, noise=NoiseConfig(0.5, 0.3))
    states, _, steps = flown(noisy, world, [AHEAD] * 3)
    sure, _, clear = flown(QUIET, world, [AHEAD] * 3)
    for ours, theirs in zip(states, sure, strict=True):
        np.testing.assert_allclose(ours.drone.position, theirs.drone.position, atol=1e-6)  # two programs
    for ours, theirs in zip(steps, clear, strict=True):
        np.testing.assert_array_equal(ours.outcome, theirs.outcome)
        changed = np.asarray(ours.observation.own) != np.asarray(theirs.observation.own)
        # All but the heading: distance, height, place and velocity.
        np.testing.assert_array_equal(changed, [True, True, False, False] + 6 * [True])
        np.testing.assert_array_equal(ours.observation.own[7:], ours.observation.motion[:3])
        np.testing.assert_array_equal(ours.observation.motion[3:], theirs.observation.motion[3:])


def test_noise_is_white_and_a_bias_stays():
    noise = NoiseConfig(position_m=0.5, velocity_m_s=0.3)
    biased = Disturbance(position_bias=jnp.array([1.0, 2.0, 3.0]))
    keys = jax.random.split(jax.random.key(0), 20_000)
    place, speed = jax.vmap(lambda key: disturbances.estimate_state(noise, biased, jnp.ones(3), jnp.zeros(3), key))(
        keys
    )
    # 20,000 draws: means to 1/140 of a deviation.
    np.testing.assert_allclose(place.mean(axis=0), [2.0, 3.0, 4.0], atol=0.02)
    np.testing.assert_allclose(place.std(axis=0), 0.5, rtol=0.02)
    np.testing.assert_allclose(speed.mean(axis=0), 0.0, atol=0.01)
    np.testing.assert_allclose(speed.std(axis=0), 0.3, rtol=0.02)
    crossed = np.corrcoef(np.concatenate([place, speed], axis=1).T)
    assert np.abs(crossed - np.eye(6)).max() < 0.03


def test_a_policy_that_was_saved_before_there_were_disturbances_loads_without_any():
    saved = load_layer(policy_folder(Path("pretrained")) / "config.yaml")
    assert not {"air", "body", "motors", "noise"} & set(saved) and "action_delay" not in saved["env"]
    assert not disturbances.any_on(apply_layer(Config(), saved, "config.yaml"))
