"""The task: outcomes, rewards, own state, resets; checked by hand where possible, elsewhere on a flown mission."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edqn_jax.config import Config, EnvConfig, EventsConfig, get_preset
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.camera import camera
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.drone import DroneState, Flight
from edqn_jax.sim.scene.scene import UprightBoxes, build_scene, stack_scenes
from edqn_jax.sim.sensors import event_laws, event_memory, sensor
from edqn_jax.sim.task import decision, env, outcomes
from edqn_jax.sim.task.action_sets import heading_setpoint, heading_to_goal, velocity_command
from edqn_jax.sim.task.decision import Decision, Payment, Situation, reset_decision
from edqn_jax.sim.task.missions import Missions, own_missions
from edqn_jax.sim.task.observation import (
    MAX_YAW_RATE,
    MOTION_SIZE,
    OWN_SIZE,
    mirrored_motion,
    motion_size,
    own_motion,
    own_state,
    rotate_own_state,
    with_lean,
)
from edqn_jax.sim.task.outcomes import Outcome, Verdict, judge_decision
from edqn_jax.sim.task.reward import configured_reward
from edqn_jax.sim.worlds import geodesic
from tests.support.drawn_scenes import GROUND, rotation_of
from tests.support.marks import in_whole
from tests.support.small_worlds import box, small_world

CONFIG = Config(env=EnvConfig(reward="sparse", step_reward=-0.25, left_volume_reward=-70.0))
GREY = np.full(3, 0.5)
VOLUME = np.array([[0.0, 0.0, 0.0], [60.0, 60.0, 25.0]])
WALL = UprightBoxes(position=[30, 30, 6], half=[1, 8, 6], yaw=0.0, albedo=GREY)
SCENE = build_scene([GROUND, WALL], volume=VOLUME, start=[5, 5, 5], goal=[50, 50, 5])
GOAL = jnp.array([50.0, 50.0, 5.0])
N = CONFIG.drone.physics_steps


# ----------------------------------------------------------------------------------------- outcomes


@jax.jit
def judged(goal, before, positions, decision):
    still = Flight(position=positions, quaternion=jnp.zeros((N, 4)), velocity=jnp.zeros((N, 3)))
    return judge_decision(CONFIG, SCENE, goal, before, still, decision)


def verdict(*, goal=GOAL, before=(10.0, 10.0, 10.0), decision=1, **at):
    """Outcome, end step and contact of a flight that rests at `before` but for some steps: `s3=(x, y, z)`."""
    positions = np.tile(np.asarray(before, np.float32), (N, 1))
    for name, where in at.items():
        positions[int(name[1:]) - 1] = where
    outcome, end, contact = judged(goal, jnp.asarray(before), positions, decision)
    return Outcome(int(outcome)), int(end), float(contact)


INSIDE_WALL = (30.0, 30.0, 5.0)
OUTSIDE = (10.0, 10.0, 25.5)
AT_GOAL = (50.0, 48.5, 5.0)
NOWHERE = (np.nan, 10.0, 10.0)


def test_a_quiet_decision_goes_on():
    assert verdict() == (Outcome.RUNNING, N, 1.0)


@pytest.mark.parametrize(
    "where,outcome",
    [
        (INSIDE_WALL, Outcome.COLLISION),
        (OUTSIDE, Outcome.LEFT_VOLUME),
        (AT_GOAL, Outcome.GOAL),
        (NOWHERE, Outcome.DIVERGED),
    ],
)
@pytest.mark.parametrize("step", [1, 7, N])
def test_every_ending_is_seen_at_any_physics_step(where, outcome, step):
    before = where if outcome is Outcome.COLLISION and step == 1 else (10.0, 10.0, 10.0)
    if outcome is Outcome.GOAL:
        before = (50.0, 47.0, 5.0)
    assert verdict(before=before, **{f"s{step}": where})[:2] == (outcome, step)


@pytest.mark.parametrize(
    "first,second,outcome",
    [
        (AT_GOAL, INSIDE_WALL, Outcome.GOAL),
        (OUTSIDE, NOWHERE, Outcome.LEFT_VOLUME),
        (INSIDE_WALL, OUTSIDE, Outcome.COLLISION),
        (NOWHERE, AT_GOAL, Outcome.DIVERGED),
        (OUTSIDE, AT_GOAL, Outcome.LEFT_VOLUME),
    ],
)
def test_the_earliest_physics_step_wins(first, second, outcome):
    assert verdict(s4=first, s5=second)[:2] == (outcome, 4)


def test_at_the_same_step_contact_comes_before_the_fence_and_the_fence_before_the_goal():
    low = (10.0, 10.0, -0.1)  # below the ground and below the volume
    assert verdict(s6=low)[:2] == (Outcome.COLLISION, 6)
    assert verdict(goal=jnp.asarray(low), s6=low)[0] is Outcome.COLLISION
    assert verdict(goal=jnp.asarray(OUTSIDE), s6=OUTSIDE)[0] is Outcome.LEFT_VOLUME


def test_the_goal_is_less_than_two_metres_away():
    near, far = (50.0, 48.01, 5.0), (50.0, 47.99, 5.0)
    assert verdict(s8=near)[0] is Outcome.GOAL and verdict(s8=far)[0] is Outcome.RUNNING
    above = (50.0 - 1.1, 50.0 + 1.1, 5.0 + 1.1)  # 1.9 m along the diagonal: all three axes count
    assert verdict(s8=above)[0] is Outcome.GOAL
    beyond = (50.0 - 1.2, 50.0 + 1.2, 5.0 + 1.2)
    assert verdict(s8=beyond)[0] is Outcome.RUNNING


def test_contact_between_two_physics_steps_is_a_collision_at_the_right_moment():
    # 0.1 m per step towards the face at x = 29; the sphere of 0.36 m touches at 28.64, half way in step 4.
    xs = 28.29 + 0.1 * np.arange(1, N + 1)
    positions = np.stack([xs, np.full(N, 30.0), np.full(N, 6.0)], axis=1).astype(np.float32)
    outcome, end, contact = judged(GOAL, jnp.array([28.29, 30.0, 6.0]), positions, 1)
    assert (outcome, end) == (Outcome.COLLISION, 4)
    np.testing.assert_allclose(contact, 0.5, atol=0.01)  # float32 at 30 m


@pytest.mark.parametrize("wall", [(0.1, 10, 10), (10, 59.9, 10), (10, 10, 24.9)])
def test_the_volume_is_free_up_to_its_faces(wall):
    assert verdict(before=(wall))[0] is Outcome.RUNNING


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [0, 1])
def test_every_face_of_the_volume_is_a_fence(axis, side):
    high = np.array([10.0, 10.0, 10.0])
    high[axis] = VOLUME[side, axis] + (0.01 if side else -0.01)
    expected = Outcome.COLLISION if (axis, side) == (2, 0) else Outcome.LEFT_VOLUME  # the ground comes first
    assert verdict(s2=tuple(high))[0] is expected


def test_time_runs_out_at_the_limit_and_not_before_and_only_if_nothing_else_happens():
    limit = CONFIG.env.max_decisions
    assert verdict(decision=limit - 1)[0] is Outcome.RUNNING
    assert verdict(decision=limit)[:2] == (Outcome.TIME_OUT, N)
    assert verdict(decision=limit, s9=AT_GOAL)[:2] == (Outcome.GOAL, 9)
    assert verdict(decision=limit, s9=OUTSIDE)[:2] == (Outcome.LEFT_VOLUME, 9)


def test_only_a_time_out_is_a_truncation():
    ends = {outcome: bool(outcomes.is_terminal(jnp.int32(outcome))) for outcome in Outcome}
    assert ends == {
        Outcome.RUNNING: False,
        Outcome.GOAL: True,
        Outcome.COLLISION: True,
        Outcome.LEFT_VOLUME: True,
        Outcome.TIME_OUT: False,
        Outcome.DIVERGED: True,
    }


# ------------------------------------------------------------------------------------------ rewards


def rewarded(config, outcome, before, after):
    return float(configured_reward(config, jnp.int32(outcome), jnp.float32(before), jnp.float32(after)))


def test_the_papers_reward_is_eq_8_to_the_letter():
    config = get_preset("paper").env
    expected = {Outcome.GOAL: 100.0, Outcome.COLLISION: -100.0}
    for outcome in Outcome:
        assert rewarded(config, outcome, 9.0, 5.0) == expected.get(outcome, 0.0)


def test_the_options_add_to_eq_8():
    config = CONFIG.env
    assert rewarded(config, Outcome.RUNNING, 9.0, 5.0) == -0.25
    assert rewarded(config, Outcome.LEFT_VOLUME, 9.0, 5.0) == -70.25
    assert rewarded(config, Outcome.GOAL, 9.0, 5.0) == 99.75


def test_progress_charges_for_the_metres_flown_and_the_other_forms_do_not():
    for form, cost in (("progress", 0.5 * 6.0), ("potential", 0.0), ("sparse", 0.0)):
        config = EnvConfig(reward=form, path_weight=0.5)
        distances = jnp.float32(9.0), jnp.float32(5.0)
        still, moved = (
            configured_reward(config, jnp.int32(Outcome.RUNNING), *distances, jnp.float32(metres))
            for metres in (0.0, 6.0)
        )
        assert still - moved == pytest.approx(cost)


def test_closeness_costs_in_proportion_and_nothing_from_its_distance_on():
    config = EnvConfig(reward="progress", closeness_weight=3.0, closeness_m=0.6)
    far, *near = (
        float(configured_reward(config, jnp.int32(Outcome.RUNNING), 9.0, 5.0, 4.0, jnp.float32(clearance)))
        for clearance in (0.6, 2.0, 0.3, 0.0, -0.1)
    )
    assert [far - each for each in near] == pytest.approx([0.0, 1.5, 3.0, 3.0], abs=1e-5)
    plain = dataclasses.replace(config, closeness_weight=0.0)
    assert far == float(configured_reward(plain, jnp.int32(Outcome.RUNNING), 9.0, 5.0, 4.0))


@pytest.mark.parametrize("metres", [0.1, 0.4, 1.0])
def test_a_decision_pays_for_how_close_it_ended_to_an_obstacle(metres):
    """The wall's face is the plane x = 29."""
    radius, weight, reach = CONFIG.drone.body_radius_m, 3.0, 0.6
    end = body((29.0 - radius - metres, 30.0, 5.0))
    before = Situation(SCENE, GOAL, body((20.0, 30.0, 5.0)), jnp.int32(0), jnp.zeros((), bool))
    payment = Payment(None, None, jnp.int32(0))
    paid = [
        float(decision_reward(Config(env=EnvConfig(closeness_weight=w, closeness_m=reach)), payment, before, end))
        for w in (0.0, weight)
    ]
    assert paid[0] - paid[1] == pytest.approx(weight * max(0.0, 1.0 - metres / reach), abs=1e-4)


@partial(jax.jit, static_argnums=0)
def decision_reward(config, payment, before, end):
    return decision._reward(config, payment, before, end, jnp.int32(22), jnp.int32(Outcome.RUNNING))


def test_progress_telescopes_to_the_distance_covered():
    config = EnvConfig(reward="progress", progress_weight=2.0, step_reward=0.0, path_weight=0.0)
    distances = [40.0, 37.5, 38.0, 30.0, 21.0]
    steps = [rewarded(config, Outcome.RUNNING, a, b) for a, b in zip(distances, distances[1:], strict=False)]
    assert sum(steps) == pytest.approx(2.0 * (40.0 - 21.0))
    # The metres of the last decision count as well.
    assert rewarded(config, Outcome.GOAL, 4.0, 1.5) == pytest.approx(100.0 + 2.0 * 2.5)


@pytest.mark.parametrize(
    "last", [Outcome.RUNNING, Outcome.TIME_OUT, Outcome.GOAL, Outcome.COLLISION, Outcome.LEFT_VOLUME]
)
def test_potential_shaping_shifts_every_discounted_return_by_the_first_potential(last):
    distances, discount = [40.0, 37.5, 38.0, 30.0, 21.0], 0.9
    config = EnvConfig(reward="potential", progress_weight=2.0, step_reward=-0.5, potential_discount=discount)
    plain = dataclasses.replace(config, reward="sparse")
    outcomes = [Outcome.RUNNING] * 3 + [last]
    steps = list(zip(outcomes, distances, distances[1:], strict=False))
    difference = sum(discount**t * (rewarded(config, *step) - rewarded(plain, *step)) for t, step in enumerate(steps))
    # Sum of gamma^t (gamma Phi(t+1) - Phi(t)) = gamma^T Phi(T) - Phi(0), Phi = -2 d, and 0 at a terminal end.
    final = 0.0 if last in (Outcome.GOAL, Outcome.COLLISION, Outcome.LEFT_VOLUME) else -2.0 * 21.0
    assert difference == pytest.approx(discount**4 * final + 2.0 * 40.0, rel=1e-5)


def test_a_diverged_decision_earns_nothing_whatever_the_distance():
    for form in ("sparse", "progress", "potential"):
        config = EnvConfig(reward=form)
        assert rewarded(config, Outcome.DIVERGED, 9.0, np.nan) == 0.0


# -------------------------------------------------------------------------- actions, own state, poses


def test_the_moves_are_all_of_minus_one_zero_one_cubed():
    assert ACTIONS.shape == (27, 3) and len({tuple(move) for move in ACTIONS}) == 27
    assert set(np.unique(ACTIONS)) == {-1, 0, 1}
    np.testing.assert_array_equal(ACTIONS[13], [0, 0, 0])


def action(*move):
    return jnp.int32(np.flatnonzero((ACTIONS == move).all(axis=1))[0])


def test_moves_are_commanded_in_the_heading_frame():
    config = EnvConfig(speed_m_s=4.0)
    command = partial(velocity_command, config)
    np.testing.assert_allclose(command(action(1, 0, 0), jnp.float32(0.0)), [4, 0, 0], atol=1e-6)
    # Heading north: ahead is +y, left is -x.
    north = jnp.float32(np.pi / 2)
    np.testing.assert_allclose(command(action(1, 0, 0), north), [0, 4, 0], atol=1e-6)
    np.testing.assert_allclose(command(action(0, 1, 0), north), [-4, 0, 0], atol=1e-6)
    np.testing.assert_allclose(command(action(0, 0, -1), north), [0, 0, -4], atol=1e-6)
    diagonal = command(action(1, 1, 1), jnp.float32(np.pi / 4))
    np.testing.assert_allclose(diagonal, [0, 4 * np.sqrt(2), 4], atol=1e-5)


def body(position, yaw=0.0, velocity=(0.0, 0.0, 0.0), setpoint=None):
    state = drone.hover_state(jnp.asarray(position, jnp.float32), jnp.float32(yaw))
    state = dataclasses.replace(state, velocity=jnp.asarray(velocity, jnp.float32))
    return state if setpoint is None else dataclasses.replace(state, yaw_setpoint=jnp.float32(setpoint))


def test_own_state_by_hand():
    # From (20, 10, 5) the goal (50, 50, 8) is 30 m east and 40 m north; nose north, 2 m/s west, 1 m/s up.
    state = body((20, 10, 5), np.pi / 2, velocity=(-2.0, 0.0, 1.0))
    own = own_state(CONFIG.env, SCENE, jnp.array([50.0, 50.0, 8.0]), state)
    expected = [
        1.956211, 1.194763,  # asinh(50 / 2) / 2 and asinh(3 / 2)
        0.0, 1.0,  # cosine and sine of the heading
        -1 / 3, -2 / 3, -0.6,  # of a volume of 60 x 60 x 25 m
        0.0, 0.5, 0.25,  # 2 m/s to the left and 1 m/s up, in units of 4
    ]  # fmt: skip
    assert own.shape == (OWN_SIZE,)
    np.testing.assert_allclose(own, expected, atol=1e-6)


def test_without_the_position_the_goal_is_so_far_ahead_and_to_the_left():
    config = dataclasses.replace(CONFIG.env, position=False)
    state = body((20, 10, 5), np.pi / 2, velocity=(-2.0, 0.0, 1.0))
    own = own_state(config, SCENE, jnp.array([50.0, 50.0, 8.0]), state)
    expected = [
        1.844752, 1.194763,  # asinh(40 / 2) / 2 and asinh(3 / 2)
        0.0, 1.0,  # cosine and sine of the heading
        0.0, 0.0, -1.701153,  # 30 m to the right
        0.0, 0.5, 0.25,
    ]  # fmt: skip
    np.testing.assert_allclose(own, expected, atol=1e-6)
    facing = body((20, 10, 5), np.arctan2(40, 30))
    own, placed = (own_state(each, SCENE, jnp.array([50.0, 50.0, 8.0]), facing) for each in (config, CONFIG.env))
    np.testing.assert_allclose(own[jnp.array([0, 6])], [float(placed[0]), 0.0], atol=1e-6)


@pytest.mark.parametrize("position", [True, False])
@pytest.mark.parametrize("quarters", range(4))
def test_a_turned_own_state_is_that_of_the_turned_world(quarters, position):
    config = dataclasses.replace(CONFIG.env, position=position)
    angle = np.pi / 2 * quarters
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    middle = np.array([30.0, 30.0, 0.0])  # of a volume of 60 x 60 x 25 m

    def own(position, goal, yaw, velocity):
        state = body(position, yaw, velocity=velocity)
        return own_state(config, SCENE, jnp.asarray(goal, jnp.float32), state)

    start, goal, velocity = np.array([20.0, 10, 5]), np.array([50.0, 45, 8]), np.array([-2.0, 0.5, 1.0])
    there = turn @ (start - middle) + middle, turn @ (goal - middle) + middle, 0.4 + angle, turn @ velocity
    found = rotate_own_state(own(start, goal, 0.4, velocity), jnp.int32(quarters))
    np.testing.assert_allclose(found, own(*there), atol=2e-6)


def test_own_motion_by_hand():
    # Nose north, 2 m/s west, 1 m/s up, turning left at 0.7 rad/s; the last move was ahead and down.
    state = body((20, 10, 5), np.pi / 2, velocity=(-2.0, 0.0, 1.0))
    state = dataclasses.replace(state, angular_velocity=jnp.array([0.3, -0.2, 0.7]))
    motion = own_motion(CONFIG.env, state, jnp.array([1.0, 0.0, -1.0]))
    assert motion.shape == (MOTION_SIZE,)
    np.testing.assert_allclose(motion, [0.0, 0.5, 0.25, 0.7, 1.0, 0.0, -1.0], atol=1e-6)


def test_roll_and_pitch_are_the_last_of_three_turns():
    turns = Rotation.from_quat(np.random.default_rng(3).normal(size=(200, 4)))
    _, pitch, roll = turns.as_euler("ZYX").T
    found = drone.roll_and_pitch_of(jnp.asarray(np.roll(turns.as_quat(), 1, axis=1)))
    np.testing.assert_allclose(found, np.stack([roll, pitch], axis=1), atol=2e-6)


@pytest.mark.parametrize("mount", ["level", "body"])
def test_a_drone_whose_camera_leans_knows_how_it_leant_at_each_frame(mount):
    config = dataclasses.replace(CONFIG, camera=dataclasses.replace(CONFIG.camera, mount=mount))
    angles = np.array([[0.5, 0.2, -0.3], [0.6, -0.1, 0.4]])  # about z, y and x at both frames
    attitudes, mirrored = (
        jnp.asarray(np.roll(Rotation.from_euler("ZYX", each).as_quat(), 1, axis=1))
        for each in (angles, angles * [-1, 1, -1])
    )
    motion = with_lean(config, attitudes, jnp.arange(7.0))
    np.testing.assert_allclose(motion, [*range(7), *([-0.3, 0.2, 0.4, -0.1] if mount == "body" else [])], atol=1e-6)
    factors = jnp.array(mirrored_motion(config))
    assert len(factors) == motion_size(config) == len(motion)
    np.testing.assert_allclose(with_lean(config, mirrored, (motion * factors)[:7]), motion * factors, atol=1e-6)


def test_the_yaw_rate_is_that_of_the_heading_however_the_drone_leans():
    # Turned by a small rotation in the body's frame, as in 1e-3 s at this angular velocity.
    rng, step_s = np.random.default_rng(2), 1e-3
    for _ in range(5):
        attitude, rates = rng.normal(size=4) + [3, 0, 0, 0], rng.normal(size=3)
        attitude /= np.linalg.norm(attitude)
        after = np.zeros(4)
        half = np.concatenate([[1.0], rates * step_s / 2])
        mujoco.mju_mulQuat(after, attitude, half / np.linalg.norm(half))
        turned = 2 * (np.arctan2(after[3], after[0]) - np.arctan2(attitude[3], attitude[0]))
        state = dataclasses.replace(
            body((0, 0, 5)), quaternion=jnp.asarray(attitude), angular_velocity=jnp.asarray(rates)
        )
        np.testing.assert_allclose(drone.yaw_rate_of(state), turned / step_s, atol=5e-3)  # of first order in 1e-3 s


def test_the_yaw_rate_of_a_drone_on_its_back_is_bounded():
    over = jnp.array([1e-3, 0.0, 1.0, 0.0], jnp.float32)  # pitched by nearly half a turn, and rolling
    state = dataclasses.replace(body((0, 0, 5)), quaternion=over, angular_velocity=jnp.array([3.0, 0.0, 0.0]))
    assert float(drone.yaw_rate_of(state)) < -1000.0
    np.testing.assert_array_equal(own_motion(CONFIG.env, state, jnp.zeros(3))[3], -MAX_YAW_RATE)


def test_the_heading_setpoint_is_the_bearing_and_is_held_near_the_goal():
    towards = partial(heading_to_goal, CONFIG.env)
    np.testing.assert_allclose(towards(body((50, 40, 5)), GOAL), np.pi / 2, atol=1e-6)
    np.testing.assert_allclose(towards(body((55, 50, 20)), GOAL), np.pi, atol=1e-6)
    # 1.9 m beside it, however high above: what it was.
    np.testing.assert_allclose(towards(body((51.9, 50, 20), setpoint=0.3), GOAL), 0.3)
    np.testing.assert_allclose(towards(body((52.1, 50, 20), setpoint=0.3), GOAL), np.pi, atol=1e-6)


def test_a_free_heading_follows_the_commanded_velocity_and_stays_without_one():
    config = dataclasses.replace(CONFIG.env, heading="flight", position=False)
    setpoint = partial(heading_setpoint, config, body((50, 40, 5), setpoint=0.3), GOAL)
    np.testing.assert_allclose(setpoint(jnp.array([-4.0, 4.0, 4.0])), 3 * np.pi / 4, atol=1e-6)
    np.testing.assert_allclose(setpoint(jnp.array([0.0, 0.0, 4.0])), 0.3)
    np.testing.assert_allclose(setpoint(jnp.zeros(3)), 0.3)
    towards = heading_setpoint(CONFIG.env, body((50, 40, 5), setpoint=0.3), GOAL, jnp.array([-4.0, 4.0, 4.0]))
    np.testing.assert_allclose(towards, np.pi / 2, atol=1e-6)


def quaternion_of(roll, pitch, yaw):
    """Product of the three turns, Hamilton's rule written out."""

    def times(p, q):
        a, b = p[0] * q[0] - np.dot(p[1:], q[1:]), p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
        return np.concatenate([[a], b])

    turns = [np.cos(angle / 2) * np.eye(4)[0] + np.sin(angle / 2) * axis
             for angle, axis in zip((yaw, pitch, roll), np.eye(4)[[3, 2, 1]], strict=True)]  # fmt: skip
    return times(times(turns[0], turns[1]), turns[2])


def test_a_body_camera_turns_with_the_quaternion():
    config = dataclasses.replace(CONFIG, camera=dataclasses.replace(CONFIG.camera, mount="body"))
    for angles in np.random.default_rng(0).uniform(-1, 1, (5, 3)) * np.array([0.6, 0.6, np.pi]):
        rotation = sensor.mount_rotation(config, jnp.asarray(quaternion_of(*angles), jnp.float32))
        np.testing.assert_allclose(rotation, rotation_of(*angles), atol=1e-6)


def test_a_level_camera_turns_with_the_heading_alone():
    for yaw in (-3.0, 0.2, 2.0):
        # Undo the tilt the shortest way and the turn about z is what is left (drone.py).
        leaned = quaternion_of(0.0, 0.0, yaw)
        rotation = sensor.mount_rotation(CONFIG, jnp.asarray(leaned, jnp.float32))
        np.testing.assert_allclose(rotation, rotation_of(0, 0, yaw), atol=1e-6)
    tilted = jnp.asarray(quaternion_of(0.3, -0.4, 1.0), jnp.float32)
    rotation = np.asarray(sensor.mount_rotation(CONFIG, tilted))
    np.testing.assert_allclose(rotation, rotation_of(0, 0, float(drone.yaw_of(tilted))), atol=1e-6)


def test_frames_are_rendered_at_the_configured_physics_steps():
    assert sensor.frame_steps(CONFIG) == (11, 13)
    many = dataclasses.replace(CONFIG, events=EventsConfig(frame_times_s=(-0.26, -0.14, -0.02, 0.0)))
    assert sensor.frame_steps(many) == (0, 6, 12, 13)


def test_a_reset_is_at_the_start_and_earns_nothing():
    start = body((5, 5, 5))
    still = Flight(position=jnp.ones((N, 3)), quaternion=jnp.zeros((N, 4)), velocity=jnp.ones((N, 3)))
    flown = Decision(
        drone=body((9, 9, 9)),
        flight=still,
        verdict=Verdict(jnp.int32(Outcome.COLLISION), jnp.int32(3), jnp.float32(0.5)),
        reward=jnp.float32(-100.0),
        broken=jnp.ones((), bool),
        unrewarded=jnp.ones((), bool),
    )
    fresh = reset_decision(flown, start)
    assert fresh.reward == 0.0 and fresh.verdict.outcome == Outcome.RUNNING and not (fresh.broken | fresh.unrewarded)
    np.testing.assert_array_equal(fresh.flight.position, np.full((N, 3), 5.0))
    np.testing.assert_array_equal(fresh.flight.velocity, np.zeros((N, 3)))


# ------------------------------------------------------------------------------------ flown missions

MISSIONS = {
    "short": ((45.5, 50.0, 10.0), (50.0, 50.0, 10.0)),
    "wall": ((26.0, 30.0, 5.0), (50.0, 30.0, 5.0)),
    "fence": ((58.5, 50.0, 10.0), (50.0, 50.0, 10.0)),
    "long": ((5.0, 5.0, 5.0), (50.0, 50.0, 10.0)),
}
MISSION = {name: jnp.int32(i) for i, name in enumerate(MISSIONS)}
FLOWN = dataclasses.replace(
    CONFIG,
    env=EnvConfig(
        reward="progress",
        progress_weight=2.0,
        path_weight=0.5,
        goal_reward=100.0,
        collision_reward=-100.0,
        step_reward=-0.25,
        max_decisions=4,
    ),
    drone=dataclasses.replace(CONFIG.drone, physics="rigid_body"),  # is traced in less time
    events=EventsConfig(threshold=0.02, tolerance=0.02),  # there is little to see in this world
)


@pytest.fixture(scope="module")
def world():
    return env.EnvParams(
        airframe=load_airframe(FLOWN.drone),
        pool=stack_scenes([SCENE]),
        missions=Missions(
            scene=jnp.zeros(len(MISSIONS), jnp.int32),
            start=jnp.array([a for a, _ in MISSIONS.values()]),
            goal=jnp.array([b for _, b in MISSIONS.values()]),
        ),
    )


@pytest.fixture(scope="module")
def reset(world):
    return jax.jit(lambda key, mission: env.reset(FLOWN, world, key, mission))


@pytest.fixture(scope="module")
def step(world):
    return jax.jit(lambda state, action: env.step(FLOWN, world, state, action))


def fly(reset, step, mission, actions, seed=0):
    state, _ = reset(jax.random.key(seed), MISSION[mission])
    steps = []
    for each in actions:
        state, result = step(state, each)
        steps.append(result)
    return state, steps


AHEAD, BACK, STAY = action(1, 0, 0), action(-1, 0, 0), action(0, 0, 0)


def same(a, b):
    def plain(x):
        return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x

    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(plain, a), jax.tree.map(plain, b))


@pytest.mark.slow
def test_a_fresh_environment_rests_at_its_start_and_faces_its_goal(reset):
    state, observation = reset(jax.random.key(0), MISSION["fence"])
    np.testing.assert_array_equal(state.drone.position, MISSIONS["fence"][0])
    np.testing.assert_array_equal(state.drone.velocity, 0.0)
    np.testing.assert_allclose(abs(drone.yaw_of(state.drone.quaternion)), np.pi, atol=1e-6)
    assert not state.ended and state.decision == 0 and state.episode_return == 0.0
    assert int(jnp.sum(observation.sensed.count)) == 0


@pytest.mark.slow
def test_the_first_step_of_an_ended_environment_shows_what_a_reset_shows(reset, world):
    begun, seen = reset(jax.random.key(0), MISSION["fence"])
    waiting = env.before_reset(FLOWN, world, jax.random.key(0))
    state, first = jax.jit(lambda s: env.step(FLOWN, world, s, AHEAD, MISSION["fence"]))(waiting)
    assert bool(first.is_reset) and not state.ended and state.mission == MISSION["fence"]
    assert first.outcome == Outcome.RUNNING and first.reward == 0.0 and first.episode_length == 0
    # Two programs, rounded apart.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), first.observation, seen)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), state.drone, begun.drone)


@pytest.mark.slow
def test_a_flight_ahead_reaches_its_goal_and_the_next_step_is_the_reset(reset, step, world):
    state, steps = fly(reset, step, "short", [AHEAD] * 4)
    *before, last = steps
    assert all(s.outcome == Outcome.RUNNING and not s.is_reset for s in before)
    assert last.outcome == Outcome.GOAL and last.episode_length == 4 and bool(state.ended)
    inside = np.linalg.norm(np.asarray(last.flight.position) - np.array([50, 50, 10]), axis=1) < 2.0
    assert int(last.end_step) == 1 + int(np.argmax(inside)) and inside.any()
    np.testing.assert_allclose(last.episode_return, sum(float(s.reward) for s in steps), rtol=1e-5)
    covered = 4.5 - np.linalg.norm(np.asarray(state.drone.position) - np.array([50, 50, 10]))
    # All in a straight line, but for the first few centimetres of sinking: metres flown are metres covered.
    np.testing.assert_allclose(last.episode_return, 100.0 + (2.0 - 0.5) * covered - 4 * 0.25, atol=0.02)

    fresh, back = step(state, AHEAD)
    other, ignored = step(state, BACK)
    same((fresh, back), (other, ignored))  # whatever the action, it changes nothing
    assert bool(back.is_reset) and back.outcome == Outcome.RUNNING and not fresh.ended
    assert back.reward == 0.0 and back.episode_return == 0.0 and back.episode_length == 0
    np.testing.assert_array_equal(fresh.drone.position, world.missions.start[fresh.mission])
    np.testing.assert_array_equal(back.flight.position, np.tile(fresh.drone.position, (N, 1)))
    assert int(jnp.sum(back.observation.sensed.count)) == 0  # at rest nothing moves
    goal = world.missions.goal[fresh.mission]
    np.testing.assert_allclose(back.observation.own, own_state(FLOWN.env, SCENE, goal, fresh.drone), atol=1e-6)
    np.testing.assert_array_equal(back.observation.motion, np.zeros(MOTION_SIZE))  # at rest, after no move
    np.testing.assert_array_equal(last.observation.motion[4:], ACTIONS[AHEAD])


@pytest.mark.slow
def test_resets_draw_every_mission(reset, step):
    state, _ = fly(reset, step, "fence", [BACK] * 3)
    assert bool(state.ended)
    drawn = set()
    for seed in range(24):
        fresh, result = step(dataclasses.replace(state, key=jax.random.key(seed)), STAY)
        assert bool(result.is_reset)
        drawn.add(int(fresh.mission))
    assert drawn == set(range(len(MISSIONS)))


@pytest.mark.slow
def test_a_flight_into_a_wall_is_a_collision_and_one_over_the_fence_leaves(reset, step):
    # 2.64 m of free way before the wall: a decision to get going and 1 m with every other.
    _, steps = fly(reset, step, "wall", [AHEAD] * 4)
    assert [int(s.outcome) for s in steps[-1:]] == [Outcome.COLLISION]
    assert steps[-1].reward < -90
    x = np.asarray(steps[-1].flight.position)[int(steps[-1].end_step) - 1, 0]
    assert x > 28.6 and 0.0 <= float(steps[-1].contact) <= 1.0
    _, steps = fly(reset, step, "fence", [BACK] * 3)
    assert [int(s.outcome) for s in steps] == [0, 0, Outcome.LEFT_VOLUME]


@pytest.mark.slow
def test_the_limit_ends_an_episode_at_exactly_its_last_decision_without_cutting_the_bootstrap(reset, step):
    state, steps = fly(reset, step, "long", [STAY] * 6)
    assert [int(s.outcome) for s in steps] == [0, 0, 0, Outcome.TIME_OUT, 0, 0]
    assert [bool(s.is_reset) for s in steps] == [False] * 4 + [True, False]
    assert [int(s.episode_length) for s in steps] == [1, 2, 3, 4, 0, 1]
    assert not bool(outcomes.is_terminal(steps[3].outcome))


@pytest.mark.slow
def test_events_are_those_between_the_configured_frames_of_the_flight(reset, step):
    _, steps = fly(reset, step, "wall", [action(0, 1, 1)] * 3)
    result = steps[-1]
    see = jax.jit(lambda p, q: camera.render_luma(FLOWN.camera, SCENE, p, sensor.mount_rotation(FLOWN, q)))
    frames = jnp.stack([see(result.flight.position[i], result.flight.quaternion[i]) for i in (10, 12)])
    memory = event_memory.reset_memory(FLOWN.events, 24, 32, jax.random.key(0))
    field, _ = event_laws.generate_events(FLOWN.events, memory, frames, (-0.04, 0.0), jax.random.key(1))
    got = result.observation.sensed
    assert int(jnp.sum(field.count)) > 20
    # Two compilations may differ in the last digit, and with it in a rare event on the threshold.
    assert np.mean(np.asarray(field.count * field.polarity != got.count * got.polarity)) < 0.005


@pytest.mark.slow
def test_the_action_is_taken_in_the_heading_at_the_decision_and_the_nose_turns_to_the_goal(reset, step):
    state, _ = reset(jax.random.key(0), MISSION["long"])
    # Turned away by a quarter: ahead is where the nose was, though it turns while flying.
    away = np.arctan2(45.0, 45.0) + np.pi / 2
    state = dataclasses.replace(state, drone=body((20.0, 20.0, 10.0), away))
    after, result = step(state, AHEAD)
    way = np.asarray(after.drone.velocity)[:2] / np.linalg.norm(after.drone.velocity[:2])
    np.testing.assert_allclose(way, [np.cos(away), np.sin(away)], atol=0.05)  # the controller's, not exact
    bearing = np.arctan2(30.0, 30.0)
    turned = away - float(after.drone.yaw_setpoint)
    np.testing.assert_allclose(turned, 0.26 * FLOWN.drone.max_yaw_rate_rad_s, rtol=1e-3)
    assert away > float(drone.yaw_of(after.drone.quaternion)) > bearing


@pytest.mark.slow
def test_with_a_free_heading_the_nose_turns_to_where_the_drone_is_told_to_fly(world):
    task = dataclasses.replace(FLOWN.env, sensor="blind", heading="flight", position=False)
    config = dataclasses.replace(FLOWN, env=task)
    state = dataclasses.replace(
        env.before_reset(config, world, jax.random.key(0), MISSION["long"]), ended=jnp.array(False)
    )
    yaw = float(state.drone.yaw_setpoint)
    take = jax.jit(partial(env.step, config, world))
    left, step = take(state, action(0, 1, 0))
    turned = float(left.drone.yaw_setpoint) - yaw
    np.testing.assert_allclose(turned, 0.26 * FLOWN.drone.max_yaw_rate_rad_s, rtol=1e-3)
    assert float(drone.yaw_of(left.drone.quaternion)) > yaw
    assert float(step.observation.own[6]) < 0.0  # the goal is to the right by now
    still, _ = take(left, STAY)
    assert float(still.drone.yaw_setpoint) == float(left.drone.yaw_setpoint)


@pytest.mark.slow
def test_a_diverged_flight_ends_with_finite_numbers(reset, step):
    state, _ = reset(jax.random.key(0), MISSION["long"])
    # So fast a spin overflows in the first physics step.
    mad = dataclasses.replace(
        state, drone=dataclasses.replace(state.drone, angular_velocity=jnp.full(3, 1e30, jnp.float32))
    )
    after, result = step(mad, AHEAD)
    assert result.outcome == Outcome.DIVERGED and bool(after.ended) and result.reward == 0.0
    for leaf in jax.tree.leaves((result, after.drone, after.episode_return)):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()
    fresh, back = step(after, AHEAD)
    assert bool(back.is_reset) and not fresh.ended
    np.testing.assert_array_equal(fresh.drone.angular_velocity, 0.0)


@pytest.mark.slow
def test_what_cannot_be_seen_or_rewarded_has_diverged_and_is_told_apart(world, reset, monkeypatch):
    def ill(config, scene, poses, memory, key):  # beyond 100 m
        return jnp.where(poses.position[-1, 0] > 100.0, jnp.nan, jnp.ones((2, 3))), memory

    monkeypatch.setattr(sensor, "sense", ill)
    unpaid = dataclasses.replace(world, reward=lambda t: jnp.where(t.move == BACK, jnp.inf, 1.0))
    broken_step = jax.jit(lambda state, action: env.step(FLOWN, unpaid, state, action))
    state, _ = reset(jax.random.key(0), MISSION["long"])
    far = dataclasses.replace(state, drone=body((105.0, 20.0, 10.0)))
    for start, move, names in (
        (state, AHEAD, []),
        (state, BACK, ["reward"]),
        (far, AHEAD, ["observation"]),
        (far, BACK, ["observation", "reward"]),
    ):
        after, result = broken_step(start, move)
        found = [field.name for field in dataclasses.fields(result.broken) if getattr(result.broken, field.name)]
        assert found == names
        assert (result.outcome == Outcome.DIVERGED) == bool(names) == bool(after.ended)
        assert result.reward == (0.0 if "reward" in names else 1.0)
        for leaf in jax.tree.leaves((result, after.drone, after.episode_return)):
            assert np.isfinite(np.asarray(leaf, np.float64)).all()


@pytest.mark.slow
def test_many_environments_at_once_are_the_same_as_one_by_one(reset, step):
    names, moves = list(MISSIONS), jnp.stack([AHEAD, AHEAD, BACK, action(-1, 1, 1)])
    keys = jax.random.split(jax.random.key(7), len(names))
    states = [reset(key, MISSION[name])[0] for key, name in zip(keys, names, strict=True)]
    many = jax.tree.map(lambda *x: jnp.stack(x), *states)
    together = jax.jit(jax.vmap(step))
    for _ in range(3):
        many, result = together(many, moves)
        singles = [step(state, move) for state, move in zip(states, moves, strict=True)]
        states = [state for state, _ in singles]
        for i, (_, single) in enumerate(singles):
            mine = jax.tree.map(lambda x, i=i: x[i], result)
            for name in ("outcome", "is_reset", "episode_length", "end_step"):
                np.testing.assert_array_equal(getattr(mine, name), getattr(single, name))
            # float32 in another order; a flight of metres.
            np.testing.assert_allclose(mine.flight.position, single.flight.position, atol=1e-4)
            np.testing.assert_allclose(mine.observation.own, single.observation.own, atol=1e-4)
            np.testing.assert_allclose(mine.reward, single.reward, atol=1e-3)
            wrong = mine.observation.sensed.count != single.observation.sensed.count
            assert np.mean(np.asarray(wrong)) < 0.01  # a rare event on the threshold


@pytest.mark.whole
@pytest.mark.parametrize("law", ["paper", *in_whole("esim")])
@pytest.mark.slow
def test_no_key_is_used_twice_and_no_rank_is_promoted(world, law):
    # Leak checks do not get past MJX. Tracing is enough: both checks are made there.
    task = dataclasses.replace(FLOWN.env, reward="geodesic")
    config = dataclasses.replace(
        FLOWN, drone=CONFIG.drone, env=task, events=EventsConfig(law=law, threshold_mismatch=0.1)
    )
    world = dataclasses.replace(world, distances=geodesic.distance_fields(world.pool, 0.36))
    with jax.numpy_rank_promotion("raise"), jax.debug_key_reuse(True):
        state, _ = jax.jit(partial(env.reset, config, world)).trace(jax.random.key(0)).out_info
        after, _ = jax.jit(partial(env.step, config, world)).trace(state, AHEAD).out_info
    assert isinstance(after.drone, DroneState)


@pytest.mark.whole
@pytest.mark.slow
def test_nobody_is_paid_for_a_way_through_a_wall():
    """A drone that crashes into a thin wall ends the decision behind it, where the goal is many metres nearer."""
    scene = small_world(box((5.9, -1.0, -1.0), (6.1, 10.0, 7.0)), start=(4.9, 2.0, 3.0), goal=(10.0, 2.0, 3.0)).scene
    pool = stack_scenes([scene])
    fields = geodesic.distance_fields(pool, 0.36)
    world = env.EnvParams(load_airframe(CONFIG.drone), pool, own_missions(pool), distances=fields)
    task = EnvConfig(sensor="blind", reward="geodesic", progress_weight=1.0, path_weight=0.0, step_reward=0.0)
    config = dataclasses.replace(CONFIG, drone=FLOWN.drone, env=task)
    step = jax.jit(partial(env.step, config, world))
    state, _ = jax.jit(partial(env.reset, config, world))(jax.random.key(0))
    left = [float(geodesic.distance_to_goal(fields, jnp.int32(0), scene.goal, state.drone.position))]
    while not state.ended:
        before = state.drone.position
        state, done = step(state, AHEAD)
        left.append(float(geodesic.distance_to_goal(fields, jnp.int32(0), scene.goal, state.drone.position)))
        moved = float(jnp.linalg.norm(state.drone.position - before))
        crashed = done.outcome == Outcome.COLLISION
        assert float(done.reward) - (task.collision_reward if crashed else 0.0) <= 1.13 * moved + 1e-4
    assert crashed and left[-2] - left[-1] > 5.0
