"""The task in worlds that move: times of frames, collisions, tallies, and what the drone may know."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.evaluation.rollouts import Extras, fly_missions
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.sim.actions import move_number
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.launches import aim_along
from edqn_jax.sim.scene.motion import Motion, Throw, aim_at, ball_positions, throw_speeds
from edqn_jax.sim.scene.scene import PARKED, Spheres, UprightBoxes, build_scene, scene_at, stack_scenes
from edqn_jax.sim.sensors import built_in, sensor
from edqn_jax.sim.sensors.event_field import event_image
from edqn_jax.sim.task import env
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.drawn_scenes import GROUND
from tests.support.marks import in_whole

CONFIG = make_config(
    "medium",
    drone={"physics": "rigid_body"},
    events={"frame_times_s": [-0.04, 0.0]},
    env={"max_decisions": 40},
    encoder={"code_size": 4},
)
N, DT = CONFIG.drone.physics_steps, CONFIG.drone.physics_dt_s
GREY, DARK = np.full(3, 0.8), np.full(3, 0.1)
VOLUME = np.array([[0.0, 0.0, 0.0], [60.0, 40.0, 20.0]])
START, GOAL = (10.0, 20.0, 6.0), (50.0, 20.0, 6.0)
HOVER = move_number("hover")


def sliding(velocity=(0.0, 2.0, 0.0)) -> Motion:
    """Back and forth through the whole volume."""
    return Motion(velocity, VOLUME[0], VOLUME[1], np.zeros((2, 3)), 0.0)


def pillar(motion: Motion | None, x=18.0, y=16.0) -> UprightBoxes:
    return UprightBoxes(position=[x, y, 6], half=[0.5, 1, 6], yaw=0.2, albedo=DARK, motion=motion)


def world_of(*shapes) -> EnvParams:
    scene = build_scene([GROUND, *shapes], volume=VOLUME, start=START, goal=GOAL)
    pool = stack_scenes([scene])
    return EnvParams(load_airframe(CONFIG.drone), pool, own_missions(pool))


def configured(name: str) -> Config:
    return dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, sensor=name))


def fly(world: EnvParams, actions, config: Config = CONFIG):
    """Steps of one environment from its start: the states before them, and what they led to."""
    state, first = jax.jit(env.reset, static_argnums=0)(config, world, jax.random.key(0), jnp.int32(0))
    step = jax.jit(env.step, static_argnums=0)
    states, steps = [state], []
    for action in actions:
        state, done = step(config, world, states[-1], jnp.int32(action))
        states.append(state)
        steps.append(done)
    return states, first, steps


@pytest.fixture(scope="module")
def hovered():
    """Hovering before a pillar that passes, and before one that stands."""
    return {moves: fly(world_of(pillar(sliding() if moves else None)), [HOVER] * 8) for moves in (True, False)}


# ---------------------------------------------------------------------------------------- what is seen


@pytest.mark.whole
def test_an_obstacle_makes_events_by_its_own_motion_while_the_drone_hovers(hovered):
    counts = {}
    for moving, (_, first, steps) in hovered.items():
        seen = [first, *(step.observation for step in steps)]
        counts[moving] = [int(jnp.sum(jnp.abs(event_image(each.sensed)))) for each in seen]
        assert max(np.abs(step.flight.position - np.float32(START)).max() for step in steps) < 0.02  # it hovers
    assert max(counts[False]) <= 2  # of the controller's own last motion
    # The pillar moves 8 cm between the frames, and its edges with it, from the first observation on.
    assert min(counts[True]) > 20


@pytest.mark.whole
def test_events_are_where_the_obstacles_edges_are(hovered):
    states, _, steps = hovered[True]
    image = np.abs(np.asarray(event_image(steps[3].observation.sensed)))
    y = 16.0 + 2.0 * 4 * N * DT - 20.0  # of the pillar's middle, to the left of the drone
    columns = 15.5 - 16 * np.array([y - 1.2, y + 1.2]) / 8.0  # 90 degrees over 32 pixels, 8 m ahead
    around = np.abs(np.arange(32)[:, None] - columns[None]).min(1) < 2.5
    assert image.sum() > 20 and image[:, around].sum() == image.sum()
    assert int(states[4].decision) == 4


@pytest.mark.whole
@pytest.mark.parametrize("name", ["ranges", *in_whole("frame-pair", "frames", "depth")])
def test_every_frame_sees_the_world_at_its_own_time(name):
    config, world = configured(name), world_of(pillar(sliding()))
    _, first, steps = fly(world, [HOVER] * 3, config)
    scene, key = env.scene_of(world, jnp.int32(0)), jax.random.key(0)
    for decision, observed in enumerate([first, *(step.observation for step in steps)]):
        flight = steps[max(decision - 1, 0)].flight
        rows = np.array(sensor.frame_steps(config)) - 1 if decision else np.zeros(len(sensor.frame_steps(config)), int)
        at, to = (jnp.asarray(np.asarray(x)[rows]) for x in (flight.position, flight.quaternion))
        if not decision:
            at = jnp.broadcast_to(jnp.float32(START), at.shape)
        times = (decision * N + np.array(sensor.frame_steps(config)) - N) * DT
        # One sensor without times in a world that stands at each of them.
        alone = []
        for row, time in enumerate(times):
            still = scene_at(scene, jnp.float32(time))
            poses = drone.Flight(*(jnp.stack([x[row]] * len(times)) for x in (at, to, at)))
            alone.append(np.asarray(sensor.sense(config, still, poses, None, key)[0]))
        if name == "frame-pair":
            expected = np.stack([alone[1][0], (alone[1][0] - alone[0][0]) / built_in.CHANGE_SCALE])
        else:
            expected = alone[-1]
        # Brightness is linear; its logarithm's change is divided by 0.1.
        np.testing.assert_allclose(observed.sensed, expected, atol=2e-3, err_msg=f"{decision}")


@pytest.mark.whole
@pytest.mark.slow
def test_true_depth_with_the_obstacles_motion_shows_who_comes_and_not_that_the_drone_flies():
    config, ahead = configured("depth-motion"), move_number("ahead")
    coming = UprightBoxes([30.0, 20, 6], [1, 2, 6], 0.0, GREY, motion=sliding((-3.0, 0.0, 0.0)))
    world, still = world_of(coming), world_of(dataclasses.replace(coming, motion=None))
    step = fly(world, [ahead] * 8, config)[2][-1]
    near, rate = np.asarray(step.observation.sensed)
    assert near[10:14, 14:18].min() > 0.5 and rate[:, 14:18].max() > 0.3
    assert np.abs(rate[:, :6]).max() == 0  # nothing moves there but the drone itself
    # By hand, for a pixel of its near face: how nearness changed within 0.04 s, at 3 m/s.
    away = float(np.asarray(sensor.distance_of(near[12, 16] / sensor.DEPTH_SCALE)))
    slant = away / (29 - 3 * 8 * N * DT - float(step.flight.position[-1, 0]))  # of the pixel's ray
    before = sensor.DEPTH_SCALE * sensor.nearness(away + 0.12 * slant)
    expected = np.tanh((near[12, 16] - before) / 0.04 / built_in.CLOSING_SCALE)
    assert abs(rate[12, 16] - expected) < 0.01
    there = np.asarray(fly(still, [ahead] * 3, config)[2][-1].observation.sensed)
    depth = np.asarray(fly(still, [ahead] * 3, configured("depth"))[2][-1].observation.sensed)
    np.testing.assert_allclose(there, np.stack([depth[0], np.zeros_like(depth[0])]), atol=1e-5)


@pytest.mark.whole
def test_a_window_as_long_as_a_decision_begins_at_its_beginning():
    config = configured("frame-pair")
    window = (-N * DT, 0.0)
    config = dataclasses.replace(config, events=dataclasses.replace(config.events, frame_times_s=window))
    world = world_of(pillar(sliding()))
    _, _, steps = fly(world, [HOVER] * 2, config)
    seen = [np.asarray(step.observation.sensed) for step in steps]
    # The frame at the end of one decision is that at the beginning of the next.
    first = seen[1][0] - built_in.CHANGE_SCALE * seen[1][1]
    np.testing.assert_allclose(first, seen[0][0], atol=1e-3)
    assert np.abs(seen[1][1]).max() > 1


def test_the_labels_of_the_encoder_are_of_the_moment(hovered):
    states, _, _ = hovered[True]
    world = world_of(pillar(sliding()))
    for decisions in (0, 5):
        label = env.nearness(CONFIG, world, states[decisions])
        still = scene_at(env.scene_of(world, jnp.int32(0)), jnp.float32(decisions * N * DT))
        body = states[decisions].drone
        expected = sensor.nearness_image(CONFIG, still, body.position, body.quaternion)
        np.testing.assert_allclose(label, expected, atol=1e-5)


def test_the_own_state_knows_nothing_of_what_moves(hovered):
    for ours, theirs in zip(hovered[True][2], hovered[False][2], strict=True):
        np.testing.assert_array_equal(ours.observation.own, theirs.observation.own)
        np.testing.assert_array_equal(ours.observation.motion, theirs.observation.motion)


@pytest.mark.whole
def test_pictures_for_people_show_the_moment():
    world = world_of(pillar(sliding()))
    environment = Environment(CONFIG, world)
    state, _ = environment.reset(mission=0)
    for _ in range(5):
        state, _ = environment.step(state, "hover")
    later = environment.depth(state)
    nearest = np.nanmin(np.where(np.isfinite(later), later, np.nan), axis=0)
    y = 16.0 + 2.0 * 5 * N * DT - 20.0
    assert abs(np.argmin(nearest) - (15.5 - 16 * y / 8.0)) < 3
    assert np.abs(environment.picture(state) - environment.picture(environment.reset(mission=0)[0])).max() > 0.2


def test_a_stream_of_a_hovering_flight_has_the_events_of_what_moves(hovered):
    streams = {}
    for moving, (_, _, steps) in hovered.items():
        world = world_of(pillar(sliding() if moving else None))
        flight = jax.tree.map(lambda *x: jnp.concatenate(x), *(step.flight for step in steps))
        streams[moving] = Environment(CONFIG, world).stream(flight)
    assert len(streams[True]) > 300 and len(streams[False]) < 20


# ---------------------------------------------------------------------------------------- what is hit


def test_a_hovering_drone_is_hit_and_the_moment_is_right():
    # The near face is 7 m away and comes at 2 m/s; it turns at no wall before.
    wall = UprightBoxes([18.5, 20, 6], [1, 5, 6], 0.0, GREY, motion=sliding((-2.0, 0.0, 0.0)))
    _, _, steps = fly(world_of(wall), [HOVER] * 14)
    ends = [Outcome(int(step.outcome)) for step in steps]
    hit = ends.index(Outcome.COLLISION)
    moment = (hit * N + int(steps[hit].end_step) - 1 + float(steps[hit].contact)) * DT
    # The drone has moved by less than 5 mm.
    assert abs(moment - (17.5 - 10.0 - 0.36) / 2.0) < 0.01
    assert ends[:hit] == [Outcome.RUNNING] * hit


BALL = Spheres(np.full(3, PARKED), 0.4, GREY, throw=Throw(0.5, 2.0, 6.0, 0.3, 0.1, 0.0, 4.0))
"""Due at 3 s: half of 40 m at 4 m/s, less 2 s. It is thrown as decision 11 begins, at 2.86 s."""


@pytest.mark.parametrize("move", ["ahead", "hover"])
def test_a_ball_hits_who_goes_on_as_before(move):
    outcomes = [int(step.outcome) for step in fly(world_of(BALL), [move_number(move)] * 22)[2]]
    assert Outcome.COLLISION in outcomes
    # At 4.86 s, earlier by what the spheres of 0.36 and 0.4 m need to come together at 6 m/s, and later by lag.
    assert 4.5 < (outcomes.index(Outcome.COLLISION) + 1) * N * DT < 5.4


@pytest.mark.parametrize("then", ["left", "back", "up"])
def test_a_ball_misses_who_turns_away_after_its_launch(then):
    moves = [move_number("ahead")] * 12 + [move_number(then)] * 10
    outcomes = [int(step.outcome) for step in fly(world_of(BALL), moves)[2]]
    assert Outcome.COLLISION not in outcomes


def test_a_ball_is_where_the_drones_last_decision_has_sent_it():
    world = world_of(BALL)
    states, _, steps = fly(world, [move_number("ahead left")] * 14)
    launches = [float(state.aim.launch[0]) for state in states]
    thrown = next(i for i, launch in enumerate(launches) if launch < 100)
    here, last = (np.asarray(states[i].drone.position, np.float64) for i in (thrown, thrown - 1))
    assert int(states[thrown].decision) == 11 and abs(launches[thrown] - 11 * N * DT) < 1e-6
    aim = here + (here - last) * 2.0 / (N * DT)
    assert len({np.asarray(state.aim.point[0]).tobytes() for state in states[thrown:]}) == 1
    np.testing.assert_allclose(states[-1].aim.point[0], aim, atol=1e-4)
    goal = np.asarray(world.missions.goal[0]) - here
    bearing, elevation = np.arctan2(goal[1], goal[0]) + 0.3, 0.1
    comes = np.array([np.cos(elevation) * np.cos(bearing), np.cos(elevation) * np.sin(bearing), np.sin(elevation)])
    scene = env.scene_of(world, jnp.int32(0), states[-1].aim)
    place = lambda t: np.asarray(scene_at(scene, jnp.float32(t)).spheres.position[0])  # noqa: E731
    for after in (0.1, 0.9, 2.0):
        np.testing.assert_allclose(place(launches[thrown] + after), aim + 6.0 * (2.0 - after) * comes, atol=1e-3)
    assert np.abs(place(launches[thrown])).max() == PARKED  # it appears just after
    # The same from the recorded places alone.
    start = np.asarray(world.missions.start[0])
    places = np.stack([start, *(np.asarray(step.flight.position[-1]) for step in steps)])
    whole = aim_along(CONFIG, scene, np.concatenate([places, np.full((3, 3), np.nan)]))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), whole, states[-1].aim)


def test_a_recording_shows_the_balls_of_its_flight():
    world = world_of(BALL)
    states, _, steps = fly(world, [HOVER] * 18)
    first = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *[step.flight for step in steps])
    environment, aim = Environment(CONFIG, world), states[-1].aim
    shown, steady = environment.stream(first, aim=aim), environment.stream(first)
    assert len(shown) > len(steady) + 100  # the ball comes close to the drone that hovers


def test_no_ball_begins_close_to_the_drone_and_none_is_slower_than_it_may_be():
    many = 400
    rng = np.random.default_rng(0)
    spread = lambda low, high: jnp.asarray(rng.uniform(low, high, many), jnp.float32)  # noqa: E731
    throw = Throw(
        share=spread(0, 1), early=spread(0.6, 3), speed=spread(5, 7), bearing=spread(-3, 3), elevation=spread(-1, 1),
        gravity=spread(-9, 9), pace=spread(2, 6),
    )  # fmt: skip
    here = jnp.asarray(rng.uniform([3, 3, 3], [57, 37, 17], (many, 3)), jnp.float32)
    moved = jnp.asarray(rng.uniform(-1.7, 1.7, (many, 3)), jnp.float32)
    with jax.numpy_rank_promotion("raise"):
        aim = aim_at(throw, jnp.float32([50, 20, 6]), jnp.asarray(VOLUME, jnp.float32), 1.3, here, moved, 0.26)
        ball_positions(throw, aim, jnp.float32(2.0))
    begin = np.asarray(ball_positions(throw, aim, jnp.float32(1.3)), np.float64)
    assert np.linalg.norm(begin - np.asarray(here), axis=1).min() >= 3.0 - 1e-3
    at_drone = np.abs(np.asarray(aim.point - here)).max(1) == 0
    assert 0 < at_drone.mean() < 0.3
    for time in np.linspace(1.32, 5, 12):
        one, two = (np.asarray(ball_positions(throw, aim, jnp.float32(t)), np.float64) for t in (time, time + 0.02))
        bound = np.maximum(*(np.asarray(throw_speeds(throw, aim, jnp.float32(t))) for t in (time, time + 0.02)))
        assert (np.linalg.norm(two - one, axis=1) / 0.02 <= bound * 1.001 + 2e-3).all()


def test_a_late_ball_from_ahead_is_aimed_at_where_the_drone_will_be():
    late = Throw(*(jnp.full(2, value) for value in (0.5, 0.3, 6.0, 0.0, 0.0, 0.0, 4.0)))
    here, ahead = jnp.float32([20, 20, 6]), jnp.float32([[1.04, 0, 0], [-1.04, 0, 0]])
    aim = aim_at(late, jnp.float32([50, 20, 6]), jnp.asarray(VOLUME, jnp.float32), 1.3, here, ahead, 0.26)
    # Who flies away from it would be 0.6 m from its launch: it is thrown at where that drone is.
    np.testing.assert_allclose(aim.point, [[21.2, 20, 6], [20, 20, 6]], atol=1e-5)


def test_a_mission_has_its_balls_thrown_at_its_own_drone():
    world = world_of(BALL)
    start, goal = jnp.float32([[10, 5, 4]]), jnp.float32([[50, 5, 4]])
    moved = dataclasses.replace(world, missions=dataclasses.replace(world.missions, start=start, goal=goal))
    outcomes = [int(step.outcome) for step in fly(moved, [move_number("ahead")] * 22)[2]]
    assert Outcome.COLLISION in outcomes


@pytest.mark.whole
def test_the_clearance_of_a_flight_is_to_shapes_as_they_move():
    world = world_of(pillar(sliding(), x=14.0))
    flights = fly_missions(CONFIG, world, fresh_policy(CONFIG), jax.random.key(0), extras=Extras(record=True))
    record, scene = flights.record, env.scene_of(world, jnp.int32(0))
    assert record is not None
    steps = int(flights.physics_steps[0]) - 1  # the last may be cut off at a contact
    times = DT * np.arange(1, steps + 1, dtype=np.float32)
    expected = jax.vmap(lambda p, t: signed_distance(scene_at(scene, t), p))(record.position[0, :steps], times) - 0.36
    np.testing.assert_allclose(record.clearance[0, :steps], expected, atol=1e-4)
    still = jax.vmap(lambda p: signed_distance(scene_at(scene, None), p))(record.position[0, :steps]) - 0.36
    assert np.abs(np.asarray(still - expected)).max() > 0.5
    assert float(flights.closest.distance[0]) <= float(expected.min()) + 1e-4


def test_an_episode_begins_at_time_zero_again():
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, max_decisions=3))
    states, first, steps = fly(world_of(pillar(sliding())), [HOVER] * 5, config)
    assert [bool(step.is_reset) for step in steps] == [False, False, False, True, False]
    np.testing.assert_allclose(steps[3].flight.time[-1], 0.0, atol=1e-6)
    np.testing.assert_allclose(steps[4].flight.time, DT * np.arange(1, N + 1), atol=1e-6)
    np.testing.assert_array_equal(event_image(steps[3].observation.sensed), event_image(first.sensed))


@pytest.mark.whole
def test_a_reward_is_told_the_clearance_at_the_decisions_end():
    told = []

    def reward(transition):
        told.append(1)
        return transition.clearance

    world = dataclasses.replace(world_of(pillar(sliding(), x=14.0)), reward=reward)
    states, _, steps = fly(world, [HOVER] * 3)
    scene = env.scene_of(world, jnp.int32(0))
    for decided, (state, step) in enumerate(zip(states[1:], steps, strict=True), start=1):
        expected = signed_distance(scene_at(scene, jnp.float32(decided * N * DT)), state.drone.position) - 0.36
        np.testing.assert_allclose(step.reward, expected, atol=1e-4)
    assert told


@pytest.mark.whole
def test_many_environments_at_different_times_are_as_one_by_one():
    world = world_of(pillar(sliding()))
    states, _, steps = fly(world, [HOVER] * 6)
    many = jax.tree.map(lambda *x: jnp.stack(x), states[1], states[4], states[5])
    after = jax.jit(jax.vmap(lambda s: env.step(CONFIG, world, s, jnp.int32(HOVER))[1]))(many)
    for row, at in enumerate((1, 4, 5)):
        ours = np.asarray(event_image(jax.tree.map(lambda x, row=row: x[row], after.observation.sensed)))
        np.testing.assert_array_equal(ours, event_image(steps[at].observation.sensed))
