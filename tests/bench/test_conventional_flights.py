"""Flights of the conventional stack are judged and tallied as ours are."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from conventional_stack.fleet import Course
from conventional_stack.flights import fly_missions
from edqn_jax.config import CameraConfig, Config, EnvConfig
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation import rollouts as our_flights
from edqn_jax.evaluation.metrics import summarise_flights
from edqn_jax.policies.functions import FunctionActor
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.scene.scene import stack_scenes
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.benchmarks.conventional_course import course_of, paper, world_of

CONFIG = dataclasses.replace(Config(), camera=CameraConfig(width=8, height=6), env=EnvConfig(max_decisions=40))
STARTS = np.array(
    [
        [86.0, 78.0, 7.0],  # to the goal
        [40.0, 22.0, 6.0],  # into a block
        [14.4, 73.4, 15.9],  # further than the time allows
        [60.0, 3.0, 20.0],  # out of the volume, whose ceiling its goal is above
        [88.5, 88.5, 10.0],  # to the goal within one decision
    ]
)
GOALS = np.array([[90.0, 90.0, 10.0]] * 3 + [[90.0, 30.0, 40.0], [90.0, 90.0, 10.0]])

AHEAD, DOWN, UP = 22, 21, 23


def towards_the_goal(xp, own):
    """A policy that both stacks can fly: ahead, and up or down to the goal's height, as `own` [..., 10] says."""
    return xp.where(own[..., 1] > 0.3, UP, xp.where(own[..., 1] < -0.3, DOWN, AHEAD))


def by_own_state(events, own, motion):
    return towards_the_goal(np, own)


def test_outcome_path_clearance_and_time_are_ours():
    def act(observation, memory, key):
        return towards_the_goal(jnp, observation.own), memory

    # This policy does not look, so its pictures need not be compiled.
    blind = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, sensor="blind"))
    world = world_of(CONFIG, STARTS, GOALS)
    ours = our_flights.fly_missions(blind, world, None, jax.random.key(0), actor=FunctionActor(act))
    got = fly_missions(CONFIG, course_of(STARTS, GOALS), by_own_state)
    assert {Outcome.GOAL, Outcome.COLLISION, Outcome.TIME_OUT, Outcome.LEFT_VOLUME} == set(map(Outcome, got.outcome))
    for name in ("outcome", "decisions", "physics_steps"):
        np.testing.assert_array_equal(getattr(got, name), getattr(ours, name), err_msg=name)
    # Ours is float32; its positions drift by up to a millimetre in a flight.
    for name in ("contact", "episode_return", "path_length_m", "flight_seconds"):
        np.testing.assert_allclose(getattr(got, name), getattr(ours, name), rtol=1e-4, atol=5e-3, err_msg=name)
    for name in ("distance", "position", "quaternion"):
        expected = getattr(ours.closest, name)
        np.testing.assert_allclose(getattr(got.closest, name), expected, atol=5e-3, err_msg=name)
    np.testing.assert_allclose(got.closest.time, ours.closest.time, atol=1e-3)
    figures = summarise_flights(got)
    assert figures["successes"] == 2 and figures["path_length_m"] == pytest.approx(np.mean(got.path_length_m[[0, 4]]))


def test_a_mission_flies_alike_alone_and_beside_others():
    together = fly_missions(CONFIG, course_of(STARTS, GOALS), by_own_state)
    for i in (0, 3):
        alone = fly_missions(CONFIG, course_of(STARTS[i : i + 1], GOALS[i : i + 1]), by_own_state)
        for mine, theirs in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
            np.testing.assert_array_equal(mine[0], theirs[i])


def test_a_flight_is_shown_its_own_motion():
    moves = [13]  # nothing is flown before the first decision

    def act(events, own, motion):
        np.testing.assert_array_equal(motion[:, :3], own[:, 7:])
        np.testing.assert_array_equal(motion[0, 4:], ACTIONS[moves[-1]])
        moves.append(int(towards_the_goal(np, own)[0]))
        return np.array(moves[-1:])

    fly_missions(CONFIG, course_of(STARTS[:1], GOALS[:1]), act)
    assert {AHEAD, UP} <= set(moves)


def test_a_course_is_our_missions():
    course = Course.of(world_of(CONFIG, STARTS, GOALS))
    expected = course_of(STARTS, GOALS)
    assert course.mjcf == expected.mjcf
    np.testing.assert_allclose(course.start, STARTS)
    np.testing.assert_allclose(course.goal, GOALS)


def test_missions_in_several_worlds_are_declined_in_one_sentence():
    world = dataclasses.replace(world_of(CONFIG, STARTS, GOALS), pool=stack_scenes([paper(), paper()]))
    with pytest.raises(ConfigError, match="supports one world, 'paper' or an MJCF file, not 2"):
        Course.of(world)
