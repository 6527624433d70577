"""The conventional environment is ours: flights, outcomes, rewards, own states and motions on the same actions."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conventional_stack import task
from conventional_stack.env import DroneEnv
from conventional_stack.fleet import Fleet, Record
from edqn_jax.config import (
    AirConfig,
    CameraConfig,
    Config,
    DroneConfig,
    EncoderConfig,
    EnvConfig,
    EventsConfig,
    LightConfig,
)
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.drone import DroneState
from edqn_jax.sim.sensors import event_memory
from edqn_jax.sim.task import env, outcomes
from edqn_jax.sim.task.env import EnvState
from edqn_jax.sim.task.observation import MAX_YAW_RATE, own_state
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.reward import configured_reward
from tests.support.benchmarks.conventional_course import course_of, fleet_of, paper, world_of

gymnasium_check = require_extra("gymnasium.utils.env_checker")
stable_baselines3_check = require_extra("stable_baselines3.common.env_checker")

CONFIG = Config()

STARTS = np.array([[1.0, 1.0, 3.0], [40.0, 22.0, 6.0], [86.0, 86.0, 9.0], [60.0, 3.0, 5.0]])
GOALS = np.tile([[90.0, 90.0, 10.0]], (4, 1))
DRONE = DroneEnv(CONFIG, course_of(STARTS, GOALS))

# Ours is float32, which knows a place 110 m away to 8 micrometres and adds 13 steps; theirs is float64.
POSITION_M, VELOCITY, ATTITUDE = 1e-4, 5e-4, 1e-4

BORDER_M = 5 * POSITION_M
"""Who is this near to touching, to the goal's radius or to the fence may be judged either way."""


@partial(jax.jit, static_argnums=0)
def stepped(config, world, state, action):
    """Our environment's step without the pictures: what is not returned is not computed."""
    state, step = jax.vmap(lambda s, a: env.step(config, world, s, a))(state, action)
    ended = step.end_step - 1 + step.contact
    return state, (step.flight, step.outcome, step.reward, step.observation, ended)


def begun(bodies: DroneState, decision) -> EnvState:
    """Returns our environments at their start, drone i on mission i."""
    count = len(decision)
    return EnvState(
        drone=bodies,
        mission=jnp.arange(count),
        decision=jnp.asarray(decision, jnp.int32),
        ended=jnp.zeros(count, bool),
        memory=event_memory.reset_memory(CONFIG.events, CONFIG.camera.height, CONFIG.camera.width, jax.random.key(0)),
        episode_return=jnp.zeros(count),
        key=jax.random.split(jax.random.key(0), count),
    )


def drawn(count: int, seed: int):
    """Drones at all places and in all attitudes: many close to a shape, the fence, the ground or the goal."""
    rng = np.random.default_rng(seed)
    lower, upper = np.asarray(paper().volume)
    position = rng.uniform(lower, upper, (count, 3))
    boxes = paper().boxes
    beside = rng.integers(boxes.yaw.shape[0], size=count)
    near = np.asarray(boxes.position)[beside] + rng.uniform(-1.3, 1.3, (count, 3)) * np.asarray(boxes.half)[beside]
    fence = np.where(rng.random((count, 3)) < 0.5, lower + 0.5, upper - 0.5)
    kind = rng.integers(4, size=count)
    goal = rng.uniform(lower + 1, upper - 1, (count, 3))
    position[kind == 0] = near[kind == 0]
    at_fence = (kind == 1)[:, None] & (rng.random((count, 3)) < 0.5)
    position = np.where(at_fence, fence, position)
    towards = rng.normal(size=(count, 3))
    towards *= rng.uniform(1.6, 3.0, (count, 1)) / np.linalg.norm(towards, axis=1, keepdims=True)
    goal = np.where((kind == 2)[:, None], position + towards, goal)
    tilt = rng.normal(size=(count, 4)) * np.array([1.0, 0.25, 0.25, 1.0])
    state = np.zeros((count, 13))
    state[:, :3] = position
    state[:, 3:7] = tilt / np.linalg.norm(tilt, axis=1, keepdims=True)
    state[:, 7:10] = rng.normal(size=(count, 3)) * 3.0
    state[:, 10:] = rng.normal(size=(count, 3)) * 1.5
    as_ours = state.astype(np.float32)
    return as_ours, goal.astype(np.float32), rng.uniform(-np.pi, np.pi, count).astype(np.float32), rng


def judged_with(fleet: Fleet, path: np.ndarray, margin: float) -> np.ndarray:
    """Outcomes [N] when everything that ends an episode reaches `margin` further."""
    rules = fleet.rules._replace(radius=fleet.rules.radius + margin, goal_radius=fleet.rules.goal_radius + margin)
    seen = fleet.world.geoms
    geoms = seen._replace(lower=seen.lower + margin, upper=seen.upper - margin)
    outcome, end_step = np.zeros((2, len(path)), np.int64)
    reward, contact = np.zeros((2, len(path)))
    decision = fleet.decision - 1
    task.judge(geoms, rules, fleet.goal, path.copy(), fleet.state.copy(), decision, outcome, reward, end_step, contact)
    return outcome


def test_one_decision_from_any_state_ends_where_ours_does_and_is_judged_alike():
    count = 1200
    state, goal, setpoint, rng = drawn(count, seed=3)
    action = rng.integers(27, size=count)
    decision = rng.integers(0, 200, count)  # some at their last

    body = DroneState(
        position=jnp.asarray(state[:, :3]),
        quaternion=jnp.asarray(state[:, 3:7]),
        velocity=jnp.asarray(state[:, 7:10]),
        angular_velocity=jnp.asarray(state[:, 10:]),
        yaw_setpoint=jnp.asarray(setpoint),
    )
    world = world_of(CONFIG, state[:, :3], goal)
    after, (flight, outcome, reward, seen, ended) = stepped(CONFIG, world, begun(body, decision), jnp.asarray(action))

    fleet = fleet_of(CONFIG, state[:, :3], goal)
    fleet.state[:], fleet.yaw_setpoint[:], fleet.decision[:] = state, setpoint, decision
    fleet.record.action[:] = action
    fleet.step(restart=False)

    np.testing.assert_allclose(fleet.path[:, 1:, :3], flight.position, atol=POSITION_M)
    np.testing.assert_allclose(fleet.path[:, 1:, 3:], flight.quaternion, atol=ATTITUDE)
    np.testing.assert_allclose(fleet.state[:, 7:10], flight.velocity[:, -1], atol=VELOCITY)
    np.testing.assert_allclose(fleet.state[:, 10:], after.drone.angular_velocity, atol=10 * VELOCITY)
    wider, narrower = (judged_with(fleet, fleet.path, margin) for margin in (BORDER_M, -BORDER_M))
    sure = wider == narrower
    assert sure.mean() > 0.97
    np.testing.assert_array_equal(fleet.record.outcome[sure], np.asarray(outcome)[sure])
    for ending in (Outcome.RUNNING, Outcome.GOAL, Outcome.COLLISION, Outcome.LEFT_VOLUME):
        assert np.sum(np.asarray(outcome)[sure] == ending) > 40, ending
    assert np.sum(np.asarray(outcome)[sure] == Outcome.TIME_OUT) > 0
    # A physics step is some 10 cm long, so 10 POSITION_M is a hundredth of one where the way is steep enough.
    np.testing.assert_allclose((fleet.end_step - 1 + fleet.contact)[sure], np.asarray(ended)[sure], atol=0.01)
    # Three metres' worth of reward a metre, from two rounded distances.
    np.testing.assert_allclose(fleet.record.reward[sure], np.asarray(reward)[sure], atol=10 * POSITION_M)
    # Velocities in units of 4 m/s; near the goal a metre is half of a unit.
    np.testing.assert_allclose(fleet.record.final_own, seen.own, atol=VELOCITY)
    motion, ours = fleet.record.motion, np.asarray(seen.motion)
    np.testing.assert_allclose(motion[:, :3], ours[:, :3], atol=VELOCITY)
    # The heading of a body on its back turns at any rate.
    upright = fleet.state[:, 3] ** 2 + fleet.state[:, 6] ** 2 > 0.5
    assert upright.mean() > 0.9
    np.testing.assert_allclose(motion[upright, 3], ours[upright, 3], atol=10 * VELOCITY)
    assert np.abs(motion[:, 3]).max() <= MAX_YAW_RATE
    np.testing.assert_array_equal(motion[:, 4:], ours[:, 4:])


@pytest.mark.parametrize("name", ["sparse", "progress", "potential"])
def test_every_reward_is_ours_for_every_outcome(name):
    config = dataclasses.replace(CONFIG, env=EnvConfig(reward=name, left_volume_reward=-70.0))
    rules, rng = task.rules_of(config), np.random.default_rng(0)
    for outcome in Outcome:
        before, after, flown = rng.uniform(0, 100, 3)
        ours = configured_reward(config.env, jnp.int32(outcome), jnp.float32(before), jnp.float32(after), flown)
        np.testing.assert_allclose(
            task.reward_of(rules, int(outcome), before, after, flown), ours, rtol=1e-5, atol=1e-4
        )


@settings(max_examples=25, deadline=None)
@given(
    mission=st.integers(0, 3),
    legs=st.lists(st.tuples(st.integers(0, 26), st.integers(1, 8)), min_size=1, max_size=6),
)
def test_whole_flights_are_ours_until_they_end_and_end_alike(mission, legs):
    start = STARTS[mission].astype(np.float32)
    world = world_of(CONFIG, start[None], GOALS[:1])
    ahead = GOALS[0] - start
    body = drone.hover_state(jnp.asarray(start), jnp.arctan2(ahead[1], ahead[0]))
    state = begun(jax.tree.map(lambda x: x[None], body), np.zeros(1))
    DRONE.reset(options={"mission": mission})
    fleet = DRONE.fleet
    for action in [action for action, times in legs for _ in range(times)]:
        state, (flight, code, reward, *_) = stepped(CONFIG, world, state, jnp.asarray([action]))
        _, got, terminated, truncated, info = DRONE.step(action)
        # The controller holds the velocity, so differences add up to a drift and do not grow by themselves.
        np.testing.assert_allclose(fleet.path[0, 1:, :3], flight.position[0], atol=10 * POSITION_M)
        wider, narrower = (judged_with(fleet, fleet.path, margin)[0] for margin in (10 * BORDER_M, -10 * BORDER_M))
        if wider != narrower:
            return
        outcome = Outcome(int(code[0]))
        assert info["outcome"] == outcome.name
        assert terminated == bool(outcomes.is_terminal(jnp.int32(outcome))) and not truncated
        np.testing.assert_allclose(got, reward[0], atol=0.01)
        if outcome is not Outcome.RUNNING:
            return


def test_a_reset_is_ours():
    start, goal = STARTS[1], GOALS[1]
    body = drone.hover_state(jnp.asarray(start), jnp.arctan2(goal[1] - start[1], goal[0] - start[0]))
    DRONE.reset(options={"mission": 1})
    assert DRONE.step(22)[0]["motion"].any()
    got, info = DRONE.reset(seed=1, options={"mission": 1})
    np.testing.assert_allclose(got["own"], own_state(CONFIG.env, paper(), jnp.asarray(goal), body), atol=1e-6)
    np.testing.assert_allclose(DRONE.fleet.state[0, 3:7], body.quaternion, atol=1e-6)
    np.testing.assert_allclose(DRONE.fleet.yaw_setpoint[0], body.yaw_setpoint, atol=1e-6)
    assert not got["events"].any() and not got["motion"].any() and info["outcome"] == "RUNNING"


def test_gymnasium_and_stable_baselines3_accept_the_environment():
    gymnasium_check.check_env(DRONE, skip_render_check=True)
    # Of dictionaries it warns: its policies would rather have flat observations, and get them from `CodedDrones`.
    stable_baselines3_check.check_env(DRONE, warn=False)


def test_the_episode_limit_truncates():
    config = dataclasses.replace(CONFIG, env=EnvConfig(max_decisions=3))
    flown = DroneEnv(config, course_of(np.array([[60.0, 3.0, 12.0]]), np.array([[90.0, 90.0, 10.0]])))
    flown.reset()
    ends = [flown.step(13)[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_a_body_that_diverges_is_put_back_and_seen_as_such(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a note of it where it runs
    fleet = fleet_of(CONFIG, np.array([[20.0, 40.0, 12.0]]), np.array([[90.0, 90.0, 10.0]]))
    fleet.state[0, 7] = np.inf
    fleet.step(restart=False)
    assert fleet.record.outcome[0] == Outcome.DIVERGED and fleet.record.reward[0] == 0.0
    np.testing.assert_array_equal(fleet.state[0, :3], [20.0, 40.0, 12.0])
    assert np.isfinite(fleet.record.final_own).all() and np.isfinite(fleet.record.motion).all()


def test_who_ended_starts_anew_within_the_step():
    start, goal = np.array([[20.0, 40.0, 12.0]] * 2), np.array([[90.0, 90.0, 10.0]] * 2)
    fleet = fleet_of(CONFIG, start, goal)
    fleet.state[0, :3] = [89.0, 90.0, 10.0]
    fleet.record.action[:] = 13
    fleet.step()
    assert fleet.record.outcome.tolist() == [Outcome.GOAL, Outcome.RUNNING]
    np.testing.assert_array_equal(fleet.state[0, :3], start[0])
    assert fleet.decision.tolist() == [0, 1]
    assert abs(fleet.record.final_own[0, 0]) < 0.5 < abs(fleet.record.own[0, 0])
    np.testing.assert_array_equal(fleet.record.final_own[1], fleet.record.own[1])


@pytest.mark.parametrize(
    "change",
    [
        {"events": EventsConfig(law="esim")},
        {"events": EventsConfig(shot_rate_hz=1.0)},
        {"events": EventsConfig(bandwidth_hz=30.0)},
        {"light": LightConfig(1.0, 100.0)},
        {"events": EventsConfig(frame_times_s=(-0.08, -0.04, 0.0))},
        {"events": EventsConfig(least_contrast=0.1, most_contrast=0.2)},
        {"events": EventsConfig(sensor_pixels=4)},
        {"camera": CameraConfig(mount="body")},
        {"encoder": EncoderConfig(retrain_at=(0.5,))},
        {"env": EnvConfig(position=False)},
        {"env": EnvConfig(reward="geodesic")},
        {"air": AirConfig(gusts_m_s=1.0)},
        {"env": EnvConfig(action_delay=1)},
        {"env": EnvConfig(drones=2)},
    ],
)
def test_what_this_stack_does_not_have_is_said_before_it_flies(change):
    config = dataclasses.replace(CONFIG, **change)
    with pytest.raises(ConfigError, match="the conventional stack supports only"):
        Fleet(config, course_of(np.zeros((1, 3)), np.ones((1, 3))), Record.empty(config, 1), seed=0)


def test_frames_are_taken_at_the_configured_steps():
    config = dataclasses.replace(CONFIG, drone=DroneConfig(physics_steps=5, physics_dt_s=0.02))
    fleet = fleet_of(config, np.array([[20.0, 40.0, 12.0]]), np.array([[90.0, 90.0, 10.0]]))
    assert fleet.frames == (3, 5) and fleet.path.shape == (1, 6, 7)
