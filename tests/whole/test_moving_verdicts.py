"""Flights among moving obstacles, judged by C MuJoCo with mocap bodies that it moves alike."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from edqn_jax.config.loading import make_config
from edqn_jax.evaluation.flight_scene import scene_of_flight
from edqn_jax.evaluation.judge import FlightTrack, clearance, load_judge, max_obstacle_speed, replay_contact
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.rollouts import Extras, fly_missions
from edqn_jax.evaluation.verdicts import check_verdicts
from edqn_jax.sim.scene.distance import path_contact, signed_distance
from edqn_jax.sim.scene.mjcf import load_world
from edqn_jax.sim.scene.scene import scene_at
from edqn_jax.sim.task.missions import random_missions
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.policies import CONFIG, always

RADIUS = 0.36
WORLD = """
<mujoco>
  <custom>
    <text name="motion:door" data="oscillate 0 3 0.5 4 0.1"/>
    <text name="motion:cart" data="bounce 2.5 -1 0"/>
    <text name="motion:ring" data="circle 2 -5 0.3"/>
    <text name="motion:egg" data="ellipse 1 0 1 0 2 0 1.3 0.4; bounce -2 0 0 12 0 0 31 0 0"/>
    <text name="motion:straight" data="throw 0.4 2 6 20 10 0 4"/>
    <text name="motion:curved" data="throw 0.7 2.5 7 -35 5 9.81 4"/>
  </custom>
  <worldbody>
    <site name="start" pos="3 10 5"/> <site name="goal" pos="37 10 6"/>
    <site name="volume" type="box" pos="20 10 6" size="20 10 6"/>
    <geom type="plane" size="0 0 1"/>
    <geom name="wall" type="box" pos="36 3 6" size="1 2 6" euler="0 0 20"/>
    <body name="door" mocap="true" pos="15 10 5" euler="0 0 30"><geom type="box" size="0.5 2 3"/></body>
    <body name="cart" mocap="true" pos="22 12 3">
      <geom type="box" size="1 2 1" euler="0 0 45"/>
      <geom type="cylinder" size="0.5 1.5" pos="0 2.5 1" euler="30 20 0"/>
      <body pos="0 0 2"><geom type="capsule" size="0.3 1" euler="50 0 10"/></body>
    </body>
    <body name="ring" mocap="true" pos="28 8 4"><geom type="cylinder" size="1 4"/></body>
    <body name="egg" mocap="true" pos="20 6 6"><geom type="sphere" size="1.2"/></body>
    <body name="straight" mocap="true" pos="20 10 6"><geom type="sphere" size="0.4"/></body>
    <body name="curved" mocap="true" pos="30 10 6"><geom type="sphere" size="0.4"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    file = tmp_path_factory.mktemp("worlds") / "moving.xml"
    file.write_text(WORLD)
    return load_world(file).scene


@pytest.fixture(scope="module")
def judge():
    return load_judge(mujoco.MjSpec.from_string(WORLD), RADIUS)


@jax.jit
def distances(scene, points, times):
    return jax.vmap(lambda p, t: signed_distance(scene_at(scene, t), p))(points, times)


def test_both_have_everything_in_the_same_place_at_every_time(world, judge):
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0.5), (40, 20, 12), (600, 3)).astype(np.float32)
    times = rng.uniform(0, 52, 600).astype(np.float32)
    times[:200] = rng.uniform(1.5, 8, 200)  # while balls fly
    ours = np.asarray(distances(world, points, times)) - RADIUS
    theirs = np.array([clearance(judge, point, float(time))[0] for point, time in zip(points, times, strict=True)])
    outside = ours > 0  # within several shapes the depths are bounds of different kinds
    assert outside.sum() > 300
    # Float32: 52 s at 2.5 m/s.
    np.testing.assert_allclose(ours[outside], theirs[outside], atol=3e-4)
    assert (theirs[~outside] < 1e-3).all()
    still = np.array([clearance(judge, point)[0] for point in points])
    assert np.abs(still - theirs).max() > 1  # at time 0 it is another world


def test_each_ball_is_absent_before_its_launch_in_both(world, judge):
    names = {clearance(judge, point, time)[1] for point, time in (((17.2, 10, 5.4), 3.4), ((17.2, 10, 5.4), 1.2))}
    assert len(names) == 2
    ball = [body for body in judge.moving if body.specs[0][0] == "throw"]
    for each in ball:
        present = [np.abs(each.at(t, judge.target)).max() < 1e5 for t in np.arange(0, 30, 0.1)]
        assert not present[0] and any(present) and not present[-1]


@jax.jit
def contact_of(scene, path, times):
    return path_contact(scene, path, RADIUS, times)


def test_contacts_are_where_mujoco_finds_them(world, judge):
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(120):
        n, begin = 65, 0
        times = (0.02 * (begin + np.arange(n + 1))).astype(np.float32)
        here = rng.uniform((10, 2, 2), (32, 18, 8))
        speed = rng.uniform(-4, 4, 3) * (rng.random() < 0.7)  # some hover
        path = (here + times[:, None] * speed * np.array([1, 1, 0.2])).astype(np.float32)
        expected = replay_contact(judge, path, 0.02)
        touch, fraction = map(np.asarray, contact_of(world, path, times))
        if expected is None:
            assert not touch.any()
            continue
        if expected.depth < 1e-3 and not touch.any():
            continue  # a graze
        segment = int(np.argmax(touch))
        assert touch.any(), expected
        moment = segment + float(fraction[segment]), expected.segment + expected.fraction
        # Steps of body and obstacle together of up to 0.2 m.
        assert abs(moment[0] - moment[1]) < 0.08, (moment, expected)
        found += 1
    assert found > 20


def test_a_world_that_moves_needs_the_time_of_a_step(judge):
    with pytest.raises(ValueError, match="the world moves: .* step_s"):
        replay_contact(judge, [[3, 10, 5], [4, 10, 5]])
    # The fastest is the curved ball: 7 m/s, and gravity for half of its 2.5 s and for 3 s more.
    assert abs(max_obstacle_speed(judge, 3.0) - (7 + 9.81 * (1.25 + 3.0))) < 1e-9


def test_a_still_world_is_judged_as_before():
    still = load_judge(mujoco.MjSpec.from_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"), RADIUS)
    contact = replay_contact(still, [[-3, 0, 0], [3, 0, 0]])
    assert contact == replay_contact(still, [[-3, 0, 0], [3, 0, 0]], 0.02, FlightTrack((0, 0, 0), (1, 0, 0)))
    assert contact is not None and abs(contact.fraction - (3 - 1.36) / 6) < 1e-6
    assert still.moving == ()


@pytest.fixture(scope="module")
def course() -> MissionSet:
    moving = {"moving_share": 0.8, "moving_speed_m_s": 4.0, "balls": 4}
    course = load_missions(make_config("medium", world=moving), "medium", 60)
    # Balls are thrown at the missions' drones, which begin elsewhere than the worlds' own.
    missions = random_missions(course.env_params.pool, 60, jax.random.key(5))
    return dataclasses.replace(course, env_params=dataclasses.replace(course.env_params, missions=missions))


@pytest.mark.slow
@pytest.mark.parametrize("move", [(1, 0, 0), (0, 0, 0)])
def test_every_verdict_on_a_flight_among_moving_obstacles_is_mujocos(course, move):
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, max_decisions=50))
    flights = jax.tree.map(
        np.asarray, fly_missions(config, course.env_params, always(move), jax.random.key(0), extras=Extras(record=True))
    )
    results = check_verdicts(config, course, flights)
    outcomes = np.array([result.outcome for result in results])
    assert (outcomes == Outcome.COLLISION).sum() > 5
    assert all(result.agrees for result in results), [result for result in results if not result.agrees]
    touched = {result.touched for result in results if result.outcome == Outcome.COLLISION}
    bodies = course.mjcf()[0]
    assert 'mocap="true"' in bodies and len(touched) > 3
    # Judged as if nothing moved, or a decision later, verdicts differ.
    late = dataclasses.replace(config, drone=dataclasses.replace(config.drone, physics_dt_s=0.03))
    assert not all(result.agrees for result in check_verdicts(late, course, flights))


@pytest.mark.slow
@pytest.mark.parametrize("physics_steps", [13, 6])
def test_a_drone_is_hit_by_balls_where_the_world_of_its_flight_has_them(physics_steps):
    config = dataclasses.replace(
        CONFIG,
        drone=dataclasses.replace(CONFIG.drone, physics_steps=physics_steps),
        env=dataclasses.replace(CONFIG.env, max_decisions=90),
        world=make_config("sparse", world={"balls": 3}).world,
    )
    course = load_missions(config, "sparse", 16)
    flights = fly_missions(config, course.env_params, always((0, 0, 0)), jax.random.key(0), extras=Extras(record=True))
    flights = jax.tree.map(np.asarray, flights)
    assert (flights.outcome == Outcome.COLLISION).sum() > 12  # they hover
    assert all(result.agrees for result in check_verdicts(config, course, flights))
    steady = 0
    for i in np.flatnonzero(flights.outcome == Outcome.COLLISION):
        steps, part = int(flights.physics_steps[i]), float(flights.contact[i])
        before, after = flights.record.position[i, steps - 2 : steps]
        point, when = before + part * (after - before), np.float32(0.02 * (steps - 1 + part))
        gaps = [
            float(signed_distance(scene_at(scene, jnp.float32(when)), point)) - RADIUS
            for scene in (scene_of_flight(config, course, flights, int(i)), course.scene(int(i)))
        ]
        assert abs(gaps[0]) < 0.02, (i, gaps)  # found within a step of 0.12 m
        steady += gaps[1] < 0.02
    assert steady < 4  # thrown at a drone of steady pace they would have missed nearly all


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [1, -1])
def test_late_balls_hit_where_mujoco_has_them(ahead):
    late = {"balls": 8, "ball_seconds": (0.3, 1.0), "ball_speed_m_s": 12.0, "ball_slowest": 0.5}
    config = dataclasses.replace(
        CONFIG,
        drone=dataclasses.replace(CONFIG.drone, physics_steps=2),
        env=dataclasses.replace(CONFIG.env, max_decisions=300),
        world=make_config("sparse", world={**late, "ball_radii_m": (0.15, 0.3)}).world,
    )
    course = load_missions(config, "sparse", 24)
    moves = always((ahead, 0, 0))  # who flies away from a late ball's launch has it thrown at where it is
    flights = fly_missions(config, course.env_params, moves, jax.random.key(0), extras=Extras(record=True))
    flights = jax.tree.map(np.asarray, flights)
    results = check_verdicts(config, course, flights)
    assert all(result.agrees for result in results), [result for result in results if not result.agrees]
    hits = [result for result in results if result.outcome == Outcome.COLLISION and "sphere" in str(result.touched)]
    assert len(hits) > (5 if ahead > 0 else 0), [result.touched for result in results]
