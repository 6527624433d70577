"""The follower: it arrives where there is enough clearance, and collides on a path that leads into a wall."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.planning.path import PlanningTask, path_length
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.flight import fly_decision
from edqn_jax.sim.scene.motion import not_thrown
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome
from rivals.planners import snn
from rivals.planners.follow import SPACING_M, FollowConfig, compiled_follower, sample_path, steer, with_reserve
from tests.support.small_worlds import RADIUS, SIZE, assert_flyable, box, enclosure, random_small_world, small_world

CONFIG, FOLLOW = Config(), FollowConfig()
AIRFRAME = load_airframe(CONFIG.drone)


def flown(task: PlanningTask, path) -> Flights:
    goal, points = np.float32(task.goal), sample_path(np.asarray(path, np.float64))
    return jax.device_get(compiled_follower()(CONFIG, FOLLOW, AIRFRAME, task.scene, goal, points))


@pytest.mark.slow
def test_in_the_open_it_flies_straight_to_the_goal_about_as_fast_as_a_learner_may():
    task = small_world()
    flight = flown(task, [task.start, task.goal])
    assert flight.outcome == Outcome.GOAL
    # 8 m less the goal's radius; it takes part of a second to be as fast as it may.
    assert 6.0 <= flight.path_length_m < 6.3
    assert 6.0 / CONFIG.env.speed_m_s < flight.flight_seconds < 6.0 / CONFIG.env.speed_m_s + 0.8
    assert (flight.decisions - 1) * 0.26 < flight.flight_seconds <= flight.decisions * 0.26 + 1e-5


def test_planned_paths_are_not_flown_where_balls_are_thrown():
    task = small_world()
    balls = dataclasses.replace(task.scene.spheres, throw=not_thrown(len(task.scene.spheres.radius)))
    thrown = dataclasses.replace(task.scene, spheres=balls)
    with pytest.raises(ConfigError, match=r"^planned paths are flown where no balls are thrown; world.balls must be 0"):
        flown(dataclasses.replace(task, scene=thrown), [task.start, task.goal])


# Two walls across the world that are open at opposite sides, 2 m wide: enough for a body of 0.36 m and its reserve.
CHICANE = small_world(box((3.6, -1, -1), (4.2, 10, 7)), box((7.2, 2, -1), (7.8, 13, 7)))


@pytest.mark.slow
def test_through_gaps_it_stays_on_the_path_as_closely_as_the_reserve_asks():
    flight = flown(CHICANE, [CHICANE.start, (3.0, 10.8, 3), (4.8, 10.8, 3), (6.6, 1.2, 3), (8.4, 1.2, 3), CHICANE.goal])
    assert flight.outcome == Outcome.GOAL
    # No leg comes nearer to an edge than 0.72 m: as near as a planner with the reserve may draw it.
    assert flight.closest.distance > 0.1


@pytest.mark.slow
def test_beside_a_straight_path_it_comes_back_without_crossing_it_by_more_than_the_tolerance():
    points = sample_path(np.array([(0.0, 6.0, 3.0), (12.0, 6.0, 3.0)]))
    fly_on = jax.jit(lambda state, command: fly_decision(CONFIG.drone, AIRFRAME, state, command, jnp.zeros(())))
    state, nearest = drone.hover_state(jnp.array([1.0, 7.0, 3.0]), jnp.array(0.0)), np.int32(0)
    beside = []
    for _ in range(20):
        command, nearest = _steer()(points, nearest, state)
        state, flight = fly_on(state, command)
        beside += [float(y) - 6.0 for y in flight.position[:, 1]]
    assert nearest == 120  # it has not stopped beside the path, but come to its end: 11 m in 5.2 s
    assert min(beside) > -FOLLOW.tolerance_m
    assert abs(beside[-1]) < FOLLOW.tolerance_m


@pytest.mark.slow
def test_a_path_through_a_wall_is_a_collision_at_the_wall():
    flight = flown(CHICANE, [CHICANE.start, CHICANE.goal])
    assert flight.outcome == Outcome.COLLISION
    # The body's sphere touches the wall's near face.
    assert flight.path_length_m == pytest.approx(3.6 - 2.0 - RADIUS, abs=0.02)
    assert flight.closest.distance == pytest.approx(0.0, abs=0.01)


@pytest.mark.slow
def test_a_path_out_of_the_volume_leaves_it_and_one_that_ends_early_runs_out_of_time():
    task = small_world()
    assert flown(task, [task.start, (2.0, 14.0, 3.0)]).outcome == Outcome.LEFT_VOLUME
    waiting = flown(task, [task.start, (5.0, 6.0, 3.0)])
    assert waiting.outcome == Outcome.TIME_OUT and waiting.decisions == CONFIG.env.max_decisions
    assert waiting.path_length_m < 5.0  # it stops at the end of the path


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.slow
def test_what_a_planner_draws_with_the_reserve_is_flown_without_contact(seed):
    task = random_small_world(seed, shapes=3)
    held = with_reserve(task, FOLLOW)
    plan = snn.plan(held)
    if plan.path is None:
        assert plan.reason.startswith("no path")
        return
    assert_flyable(held, plan.path)
    flight = flown(task, plan.path)
    assert flight.outcome == Outcome.GOAL and flight.closest.distance > 0.0


def test_the_reserve_enlarges_the_body_and_draws_in_the_fence_but_for_the_ends():
    task = small_world(start=(0.1, 6.0, 3.0), goal=(10.0, 12.0, 3.0))
    held = with_reserve(task, FOLLOW)
    assert held.body_radius == pytest.approx(RADIUS + FOLLOW.reserve_m)
    lower, upper = np.asarray(held.scene.volume)
    np.testing.assert_allclose(lower, (0.1, FOLLOW.reserve_m, FOLLOW.reserve_m), atol=1e-6)
    np.testing.assert_allclose(upper, (SIZE[0] - FOLLOW.reserve_m, 12.0, SIZE[2] - FOLLOW.reserve_m), atol=1e-5)
    assert np.all((lower <= task.start) & (task.goal <= upper))


def test_a_goal_that_only_the_reserve_does_not_fit_at_is_refused_in_a_sentence():
    task = small_world(*enclosure((10.0, 6.0, 3.0), inner=0.5))
    assert snn.plan(with_reserve(task, FOLLOW)).reason.startswith(
        "no path: a sphere of 0.66 m does not fit at the goal"
    )


POINT = st.tuples(*[st.floats(0.0, side) for side in SIZE])


@settings(max_examples=50, deadline=None)
@given(st.lists(POINT, min_size=2, max_size=6))
def test_samples_stand_on_the_path_at_most_a_spacing_apart(points):
    path = np.array(points)
    samples = sample_path(path)
    np.testing.assert_allclose(samples[[0, -1]], path[[0, -1]], atol=1e-5)
    assert np.linalg.norm(np.diff(samples, axis=0), axis=1).max() <= SPACING_M + 1e-5
    begin, leg = path[:-1], np.diff(path, axis=0)
    share = np.einsum("kni,ni->kn", samples[:, None] - begin, leg) / np.maximum(np.sum(leg**2, axis=1), 1e-12)
    nearest = begin + np.clip(share, 0, 1)[..., None] * leg
    assert np.linalg.norm(samples[:, None] - nearest, axis=-1).min(axis=1).max() < 1e-4
    assert path_length(samples) <= path_length(path) + 1e-3


@functools.cache
def _steer():
    return jax.jit(lambda points, nearest, state: steer(CONFIG.env, FOLLOW, points, nearest, state))


@settings(max_examples=50, deadline=None)
@given(POINT, POINT, st.integers(0, 60))
@pytest.mark.slow
def test_it_is_never_faster_than_a_learner_along_an_axis_and_never_goes_back(at, velocity, nearest):
    points = sample_path(np.array([(1.0, 1.0, 1.0), (6.0, 1.0, 1.0), (6.0, 6.0, 5.0)]))
    state = drone.hover_state(jnp.array(at), jnp.array(0.3))
    state = dataclasses.replace(state, velocity=jnp.array(velocity) - 3.0)
    command, now = _steer()(points, np.int32(nearest), state)
    assert np.linalg.norm(command) <= CONFIG.env.speed_m_s + 1e-4
    assert nearest <= now < nearest + round(FOLLOW.window_m / SPACING_M)
