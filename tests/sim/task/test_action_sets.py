"""Action sets: what they command, how it is flown, and what becomes of numbers that are no action."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.config.registry import ACTION_SETS
from edqn_jax.config.rules import check_learns, validate
from edqn_jax.errors import ConfigError
from edqn_jax.sim.actions import ACTIONS, Discrete
from edqn_jax.sim.physics.airframe import load_airframe, mixer_of
from edqn_jax.sim.physics.controller import RateCommand
from edqn_jax.sim.physics.drone import hover_state
from edqn_jax.sim.physics.flight import fly_command
from edqn_jax.sim.task import env
from edqn_jax.sim.task.action_sets import BODY_RATES, MOVES, VELOCITY, ActionSet, action_of, action_set, clip_action
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import task_of
from tests.oracles import drone_mujoco
from tests.support.miniature import miniature_world


def configured(actions: str, **options: object) -> Config:
    config = Config()
    return dataclasses.replace(
        config,
        drone=dataclasses.replace(config.drone, physics="rigid_body"),
        env=dataclasses.replace(config.env, sensor="blind", actions=actions, **options),
    )


CONFIG = configured("body-rates")
LATE = configured("velocity", action_delay=1)
AIRFRAME = load_airframe(CONFIG.drone)
BODY = hover_state(jnp.zeros(3), jnp.float32(0.0))
WEIGHT = float(AIRFRAME.mass * AIRFRAME.gravity)


def stepper(config: Config):
    """A state at a start in the air, and the compiled step."""
    world = miniature_world(config)
    world = dataclasses.replace(world, missions=jax.tree.map(lambda x: x[:1], world.missions))
    state, _ = env.reset(config, world, jax.random.key(0))
    return state, jax.jit(partial(env.step, config, world))


@pytest.fixture(scope="module")
def late():
    return stepper(LATE)


@pytest.fixture(scope="module")
def rates():
    return stepper(CONFIG)


@pytest.mark.parametrize("heading", ["goal", "flight"])
def test_a_velocity_that_is_a_move_commands_the_same_to_the_bit(heading):
    config = configured("moves", heading=heading, position=heading == "goal")
    body, goal = hover_state(jnp.array([3.0, 4.0, 5.0]), jnp.float32(0.7)), jnp.array([30.0, -2.0, 8.0])
    by_number = jax.vmap(lambda a: MOVES.command(config, AIRFRAME, body, goal, a))(jnp.arange(27))
    by_vector = jax.vmap(lambda a: VELOCITY.command(config, AIRFRAME, body, goal, a))(jnp.asarray(ACTIONS, jnp.float32))
    jax.tree.map(np.testing.assert_array_equal, by_number, by_vector)
    np.testing.assert_array_equal(MOVES.direction(body, jnp.arange(27)), ACTIONS)


@pytest.mark.whole
@pytest.mark.slow
def test_a_velocity_that_is_a_move_flies_the_same_flight_also_a_decision_late(late):
    state, step = late
    other, by_number = stepper(dataclasses.replace(LATE, env=dataclasses.replace(LATE.env, actions="moves")))
    for move in (22, 25, 4):
        state, flown = step(state, jnp.asarray(ACTIONS[move], jnp.float32))
        other, same = by_number(other, move)
        np.testing.assert_allclose(flown.flight.position, same.flight.position, rtol=0, atol=1e-5)
        np.testing.assert_allclose(flown.observation.motion, same.observation.motion, rtol=0, atol=1e-5)
        np.testing.assert_array_equal(flown.observation.motion[4:], ACTIONS[move])
        np.testing.assert_allclose(flown.reward, same.reward, atol=1e-4)
    np.testing.assert_array_equal(state.disturbance.move, ACTIONS[4])


@pytest.mark.whole
@pytest.mark.slow
def test_what_is_beyond_the_bounds_is_clipped_and_what_is_not_finite_diverges(late, rates):
    for state, step, size in ((*late, 3), (*rates, 4)):
        inside, beyond = (step(state, jnp.full(size, value))[0] for value in (1.0, 70.0))
        np.testing.assert_array_equal(inside.drone.position, beyond.drone.position)
        for value in (jnp.nan, jnp.inf):
            after, found = step(state, jnp.full(size, value))
            if size == 3:  # a decision late
                assert found.outcome == Outcome.RUNNING
                after, found = step(after, jnp.zeros(size))
            assert found.outcome == Outcome.DIVERGED and bool(after.ended) and found.reward == 0.0
            assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(found))


@pytest.mark.slow
def test_no_rate_and_the_weight_hover_and_twice_the_weight_rises_with_gravity(rates):
    state, step = rates
    still, _ = step(state, jnp.asarray(task_of(CONFIG).still))
    np.testing.assert_allclose(still.drone.position, state.drone.position, atol=1e-4)
    up, found = step(state, jnp.array([1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(up.drone.velocity, [0.0, 0.0, 9.81 * 0.26], atol=2e-3)
    np.testing.assert_allclose(found.observation.motion[4:], [0.0, 0.0, 1.0], atol=1e-5)
    # Two decisions pitch it by about 0.26 rad each: it leans and flies ahead, and the thrust's direction says so.
    for _ in range(2):
        state, found = step(state, jnp.array([0.0, 0.0, 1.0 / 6.0, 0.0]))
    ahead, left, height = found.observation.motion[4:]
    assert ahead == pytest.approx(np.sin(0.5), abs=0.06) and abs(left) < 1e-3
    assert height == pytest.approx(np.cos(0.5), abs=0.06) and found.observation.motion[0] > 0.1


def test_body_rates_fly_as_c_mujoco_under_a_plain_control_law():
    """The law in NumPy: torque from the rates' error and the gyroscopic torque, through the rotors' layout inverted."""
    config, thrust, wanted = CONFIG.drone, 1.2 * WEIGHT, np.array([0.8, -0.5, 0.1])
    start = hover_state(jnp.array([1.0, -2.0, 30.0]), jnp.float32(0.4))
    command = RateCommand(jnp.float32(thrust), jnp.asarray(wanted, jnp.float32))
    _, flight = jax.jit(lambda state: fly_command(config, AIRFRAME, state, command))(start)

    model, data = drone_mujoco.load()
    assert model.opt.timestep == config.physics_dt_s
    data.qpos[:] = np.concatenate([start.position, start.quaternion])
    inertia, gains = model.body_inertia[1], np.array([config.rate_gain, config.rate_gain, config.yaw_rate_gain])
    for place, attitude in zip(flight.position, flight.quaternion, strict=True):
        rate = data.qvel[3:]
        torque = inertia * gains * (wanted - rate) + np.cross(rate, inertia * rate)
        data.ctrl[:] = mixer_of(model) @ [thrust, *torque]
        assert data.ctrl.min() > 0.0 and data.ctrl.max() < float(AIRFRAME.max_thrust)  # no limit is reached
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(place, data.qpos[:3], atol=1e-4)
        np.testing.assert_allclose(attitude, data.qpos[3:], atol=1e-4)
    np.testing.assert_allclose(data.qvel[3:], wanted, atol=0.1)  # it is reached


def test_a_body_rate_of_1_is_the_largest_of_the_drones_options():
    command = BODY_RATES.command(CONFIG, AIRFRAME, BODY, jnp.ones(3), jnp.array([-1.0, 1, -1, 1]))
    assert isinstance(command, RateCommand) and float(command.thrust) == 0.0
    np.testing.assert_allclose(command.rates, [6.0, -6.0, 2.0])


def test_the_direction_of_body_rates_is_that_of_the_rotors_in_the_heading_frame():
    quaternions = np.random.default_rng(0).normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    for quaternion in quaternions:
        body = dataclasses.replace(BODY, quaternion=jnp.asarray(quaternion, jnp.float32))
        matrix, yaw = np.zeros(9), 2 * np.arctan2(quaternion[3], quaternion[0])
        mujoco.mju_quat2Mat(matrix, quaternion)
        x, y, z = matrix.reshape(3, 3)[:, 2]
        expected = [np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, z]
        np.testing.assert_allclose(BODY_RATES.direction(body, jnp.zeros(4)), expected, atol=1e-5)


@pytest.mark.parametrize("given", [[0.0, 1.0], [0.0, np.nan, 0.0], "ahead", 3])
def test_what_is_no_velocity_is_refused_in_words(given):
    with pytest.raises(ConfigError, match="an action of 'velocity' is 3 finite numbers from -1 to 1, not"):
        action_of(LATE, given)


def test_an_action_of_another_shape_is_refused_where_numbers_are_not_known_yet():
    with pytest.raises(ConfigError, match=r"an action is 4 finite numbers from -1 to 1, not an array of shape \(3,\)"):
        jax.eval_shape(partial(clip_action, BODY_RATES.space), jnp.zeros(3))


def test_an_action_set_of_ones_own_is_found_by_its_name():
    def command(config, airframe, state, goal, action):
        return VELOCITY.command(config, airframe, state, goal, jnp.where(action == 1, 1.0, -1.0) * jnp.ones(3))

    ACTION_SETS.register("two-ways", ActionSet(Discrete(2), np.int32(0), command, VELOCITY.direction))
    config = configured("two-ways")
    validate(config)
    assert action_set(config).space.shape == () and task_of(config).actions == Discrete(2)
    assert action_of(config, 1) == 1
    with pytest.raises(ConfigError, match="an action of 'two-ways' is a whole number from 0 to 1, not 2"):
        action_of(config, 2)


def test_actions_that_there_are_not_are_answered_with_the_nearest():
    with pytest.raises(ConfigError, match="there is no set of actions 'velocities'; did you mean 'velocity'"):
        validate(configured("velocities"))


@pytest.mark.parametrize("learner", ["dqn", "pqn"])
def test_the_learners_of_the_package_refuse_other_actions_than_moves(learner):
    config = configured("body-rates")
    config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, learner=learner))
    validate(config)
    with pytest.raises(ConfigError, match=f"agent.learner '{learner}' chooses among moves: env.actions must be moves"):
        check_learns(config)
