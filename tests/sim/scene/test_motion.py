"""Shapes that move: where they are, what they touch, and that a still world knows nothing of it."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edqn_jax.sim.scene.distance import path_contact, segment_contact, signed_distance
from edqn_jax.sim.scene.motion import Motion, Throw, at_rest
from edqn_jax.sim.scene.scene import (
    PARKED,
    Capsules,
    Scene,
    Spheres,
    UprightBoxes,
    UprightCylinders,
    build_scene,
    has_motion,
    scene_at,
    scene_shapes,
    speed_bounds,
    stack_scenes,
    take_scene,
    with_equal_capacities,
)
from tests.oracles import motion_plain

GREY = np.full(3, 0.5)
VOLUME = np.array([[0.0, 0.0, 0.0], [40.0, 30.0, 12.0]])
START, GOAL = np.array([4.0, 6.0, 5.0]), np.array([36.0, 24.0, 6.0])
RADIUS = 0.36


def scene_of(*shapes, **capacities) -> Scene:
    return build_scene(shapes, volume=VOLUME, start=START, goal=GOAL, capacities=capacities)


def motion(velocity=(0, 0, 0), low=(0, 0, 0), high=(0, 0, 0), a=(0, 0, 0), b=(0, 0, 0), rate=0.0, phase=0.0) -> Motion:
    a, b, cos, sin = np.array(a, float), np.array(b, float), np.cos(phase), np.sin(phase)
    swing = np.array([cos * a + sin * b, cos * b - sin * a])  # a cos(phase + x) + b sin(phase + x)
    return Motion(velocity=velocity, low=low, high=high, swing=swing, rate=rate)


def ball(position, radius=0.4, **fields) -> Spheres:
    return Spheres(position=position, radius=radius, albedo=GREY, **fields)


def throw(share=0.5, early=2.0, speed=6.0, bearing=0.0, elevation=0.0, gravity=0.0, pace=4.0) -> Throw:
    return Throw(share, early, speed, bearing, elevation, gravity, pace)


def thrown(**fields) -> Spheres:
    return ball(np.full(3, PARKED), throw=throw(**fields))


BOUNCING = motion(velocity=(3, -2, 0.5), low=(5, 4, 2), high=(20, 9, 4))
CIRCLE = ((3, 0, 0), (0, -3, 0), 1.0, 0.7)
SWAY = ((0, 0, 0), (0, 1.5, 0.5), 1.9, -2.0)
"""Half axes, rate and phase."""
CIRCLING, SWAYING = (motion(a=a, b=b, rate=rate, phase=phase) for a, b, rate, phase in (CIRCLE, SWAY))


def moving_world() -> Scene:
    """Every way to move, in three kinds, with shapes that stand."""
    return scene_of(
        UprightBoxes(position=[10, 6, 3], half=[1, 2, 2], yaw=0.3, albedo=GREY, motion=BOUNCING),
        UprightBoxes(position=[30, 6, 3], half=[1, 2, 3], yaw=0.3, albedo=GREY),
        UprightCylinders(position=[18, 20, 4], radius=1.0, half_height=4.0, albedo=GREY, motion=CIRCLING),
        ball([25, 15, 5], radius=1.5, motion=SWAYING),
        ball([33, 12, 5]),
        thrown(bearing=0.6, elevation=0.2),
        thrown(share=0.6, gravity=9.81, bearing=-0.4),
        boxes=3,
        spheres=5,
    )


@jax.jit
def places(scene: Scene, times):
    still = jax.vmap(lambda t: scene_at(scene, t))(times)
    return {kind: getattr(still, kind).position for kind in ("boxes", "cylinders", "spheres")}


# ---------------------------------------------------------------------------------------- where they are


def test_a_still_world_is_the_same_object_at_every_time():
    still = scene_of(ball([5, 5, 5]))
    assert not has_motion(still)
    at = scene_at(still, jnp.float32(3.0))
    assert all(a is b for a, b in zip(jax.tree.leaves(at), jax.tree.leaves(still), strict=True))
    traced = jax.make_jaxpr(lambda p, t: path_contact(still, p, RADIUS, t))(jnp.zeros((4, 3)), jnp.zeros(4))
    without = jax.make_jaxpr(lambda p, t: path_contact(still, p, RADIUS))(jnp.zeros((4, 3)), jnp.zeros(4))
    assert str(traced) == str(without)


def test_shapes_stand_at_their_positions_at_time_zero_and_nothing_moves_in_the_world_at_a_time():
    scene = moving_world()
    assert has_motion(scene)
    at = jax.jit(scene_at)(scene, jnp.float32(0.0))
    assert not has_motion(at)
    for kind in ("boxes", "cylinders", "spheres"):
        np.testing.assert_array_equal(getattr(at, kind).position, getattr(scene, kind).position, err_msg=kind)
    later = jax.jit(scene_at)(scene, jnp.float32(1.0))
    apart = np.linalg.norm(np.asarray(later.boxes.position - scene.boxes.position), axis=1)
    assert apart[0] > 1 and apart[1] == apart[2] == 0  # the second stands, the third is parked


def test_a_shape_bounces_between_its_walls_as_one_that_is_stepped():
    scene = moving_world()
    times = np.array([0.3, 1.7, 4.4, 11.9, 51.9], np.float32)
    found = np.asarray(places(scene, times)["boxes"])[:, 0]
    for time, place in zip(times, found, strict=True):
        for axis in range(3):
            velocity, low, high = (float(np.asarray(x)[axis]) for x in (BOUNCING.velocity, BOUNCING.low, BOUNCING.high))
            expected = motion_plain.bounced(float(scene.boxes.position[0, axis]), velocity, low, high, float(time))
            # 150 m of way in float32; the stepped one turns back exactly, whatever its step.
            assert abs(place[axis] - expected) < 1e-4, (time, axis)


@pytest.mark.parametrize(("kind", "number", "how"), [("cylinders", 0, CIRCLE), ("spheres", 0, SWAY)])
def test_a_shape_swings_on_its_ellipse(kind, number, how):
    scene = moving_world()
    times = np.linspace(-0.08, 50, 40, dtype=np.float32)
    found = np.asarray(places(scene, times)[kind])[:, number]
    a, b, rate, phase = how
    away = np.array([motion_plain.swung(np.array(a), np.array(b), rate, phase, float(t)) for t in times])
    np.testing.assert_allclose(found, np.asarray(getattr(scene, kind).position[number]) + away, atol=3e-5)


def test_a_circling_shape_keeps_its_distance_from_the_middle_and_its_speed():
    times = np.linspace(0, 9, 901, dtype=np.float32)
    found = np.asarray(places(moving_world(), times)["cylinders"])[:, 0].astype(np.float64)
    middle = np.array([18, 20, 4]) - np.array([3 * np.cos(0.7), -3 * np.sin(0.7), 0])
    np.testing.assert_allclose(np.linalg.norm(found - middle, axis=1), 3.0, atol=1e-5)
    speed = np.linalg.norm(np.diff(found, axis=0), axis=1) / 0.01
    np.testing.assert_allclose(speed, 3.0, rtol=2e-3)  # float32 positions, 0.01 s apart


@pytest.mark.parametrize("number", [2, 3])
def test_a_ball_is_absent_before_its_launch_meets_the_drone_and_is_absent_when_it_has_flown_out(number):
    scene = moving_world()
    how = jax.tree.map(lambda leaf: leaf[number], scene.spheres.throw)
    length = float(np.linalg.norm(GOAL - START))
    hit = float(how.share) * length / 4.0
    times = np.linspace(0, 30, 1501, dtype=np.float32)
    found = np.asarray(places(scene, times)["spheres"])[:, number]
    there = np.abs(found).max(1) < PARKED / 2
    assert not there[times < hit - 2.0 - 1e-3].any() and there[(times > hit - 2.0 + 1e-3) & (times < hit)].all()
    assert not there[-1] and np.diff(there.astype(int)).clip(0).sum() == 1  # it comes once, and goes
    beyond = np.maximum(VOLUME[0] - found, found - VOLUME[1]).max(1)
    assert beyond[there].max() <= 1.4 + 1e-4  # a metre and its radius beyond the volume
    aim = START + float(how.share) * (GOAL - START)
    np.testing.assert_allclose(np.asarray(places(scene, jnp.float32([hit]))["spheres"])[0, number], aim, atol=1e-4)
    for time in (hit - 1.9, hit - 0.5, hit + 0.2):
        expected = motion_plain.thrown(how, START, GOAL, time)
        assert expected is not None
        at = np.asarray(places(scene, jnp.float32([time]))["spheres"])[0, number]
        np.testing.assert_allclose(at, expected, atol=2e-4)


def test_a_ball_comes_from_ahead_of_the_drone_at_its_speed():
    scene = scene_of(thrown(bearing=0.6, elevation=0.2))
    hit = 0.5 * np.linalg.norm(GOAL - START) / 4.0
    one, two = np.asarray(places(scene, jnp.float32([hit - 1, hit - 0.5]))["spheres"])[:, 0]
    flown = (two - one) / 0.5
    assert abs(np.linalg.norm(flown) - 6.0) < 1e-3
    way = GOAL - START
    turned = np.arctan2(-flown[1], -flown[0]) - np.arctan2(way[1], way[0])
    assert abs(turned - 0.6) < 1e-3 and abs(np.arcsin(-flown[2] / 6.0) - 0.2) < 1e-3


def test_a_ball_is_thrown_at_the_mission_that_is_flown():
    scene = scene_of(thrown())
    other = dataclasses.replace(scene, start=jnp.float32([4, 20, 3]), goal=jnp.float32([36, 20, 3]))
    at = scene_at(other, jnp.float32(4.0)).spheres.position[0]  # half of 32 m at 4 m/s
    np.testing.assert_allclose(at, [20, 20, 3], atol=1e-4)


finite = st.floats(-4, 4, width=32)


@settings(max_examples=60, deadline=None)
@given(
    v=st.tuples(finite, finite, finite),
    a=st.tuples(finite, finite, finite),
    b=st.tuples(finite, finite, finite),
    rate=st.floats(-3, 3, width=32),
    gravity=st.floats(0, 10, width=32),
    time=st.floats(0, 20, width=32),
)
def test_nothing_is_faster_than_the_bound(v, a, b, rate, gravity, time):
    scene = _one_of_each(v, a, b, rate, gravity)
    steps = time + 0.01 * np.arange(3, dtype=np.float32)
    found = _positions(scene, steps)
    bound = float(max(_fastest(scene, steps)))
    moved = np.linalg.norm(np.diff(np.asarray(found, np.float64), axis=0), axis=-1)
    moved = moved[moved < 1e3]  # a ball that appears
    assert moved.max() <= 0.01 * bound * 1.001 + 2e-5  # float32 positions of tens of metres


def _one_of_each(v, a, b, rate, gravity) -> Scene:
    how = motion(velocity=v, low=(0, 0, 0), high=(40, 30, 12), a=a, b=b, rate=rate)
    return scene_of(ball([20, 15, 6], motion=how), thrown(gravity=gravity))


@jax.jit
def _positions(scene, times):
    return jax.vmap(lambda t: scene_at(scene, t).spheres.position)(times)


@jax.jit
def _fastest(scene, times):
    return jax.vmap(lambda t: jnp.max(speed_bounds(scene, t)["spheres"]))(times)


def test_the_bound_of_an_ellipse_is_its_top_speed():
    scene = scene_of(UprightCylinders(position=[1, 1, 1], radius=1, half_height=1, albedo=GREY, motion=CIRCLING))
    np.testing.assert_allclose(speed_bounds(scene, jnp.float32(0))["cylinders"], [3.0], rtol=1e-6)
    swaying = scene_of(ball([5, 5, 5], motion=SWAYING))
    np.testing.assert_allclose(speed_bounds(swaying, jnp.float32(0))["spheres"], [1.9 * np.hypot(1.5, 0.5)], rtol=1e-6)


# ---------------------------------------------------------------------------------------- pools


def test_a_pool_gives_moving_and_still_worlds_back():
    first, second = moving_world(), scene_of(ball([5, 5, 5]), Capsules([2, 2, 2], [1, 0, 0], 1.0, 0.5, GREY))
    pool = stack_scenes([first, second])
    assert pool.boxes.motion is not None and pool.capsules.motion is None
    for index, scene in enumerate((first, second)):
        for ours, theirs in zip(scene_shapes(take_scene(pool, index)), scene_shapes(scene), strict=True):
            jax.tree.map(np.testing.assert_array_equal, ours, theirs)
    times = jnp.float32([0.0, 2.0, 5.1])
    for kind, expected in places(first, times).items():
        present = expected[2, :, 0] < PARKED  # the pool's are packed
        np.testing.assert_array_equal(
            places(take_scene(pool, 0), times)[kind][:, : present.sum()], expected[:, present]
        )
    one = jax.jit(lambda t: scene_at(take_scene(pool, 1), t))(jnp.float32(7.0))
    np.testing.assert_array_equal(one.spheres.position[0], [5, 5, 5])


def test_pools_of_equal_capacities_move_as_before():
    moving, still = stack_scenes([moving_world()]), stack_scenes([scene_of(*[ball([5, 5, 5])] * 7)])
    ours, other = with_equal_capacities([moving, still])
    assert jax.tree.structure(ours) == jax.tree.structure(other)
    assert ours.spheres.position.shape == (1, 7, 3)
    times = jnp.float32([0.0, 2.0, 5.1])
    for kind, expected in places(take_scene(moving, 0), times).items():
        found = places(take_scene(ours, 0), times)[kind]
        np.testing.assert_array_equal(found[:, : expected.shape[1]], expected)
    np.testing.assert_array_equal(places(take_scene(other, 0), times)["spheres"][2], [[5, 5, 5]] * 7)


def test_shapes_that_never_move_have_no_motion():
    scene = scene_of(ball([5, 5, 5], motion=at_rest()), ball([8, 5, 5], motion=SWAYING))
    first, second = scene_shapes(scene)
    assert isinstance(first, Spheres) and isinstance(second, Spheres)
    assert first.motion is None and second.motion is not None


# ---------------------------------------------------------------------------------------- contact


def densely(scene: Scene, path, times, radius, each: int = 400):
    """First contact as segments and fraction by dense sampling, [] or inf, and the least gap."""
    f = np.linspace(0, 1, each, endpoint=False)
    begin, end = np.asarray(path[:-1], np.float64), np.asarray(path[1:], np.float64)
    points = (begin[:, None] + f[None, :, None] * (end - begin)[:, None]).reshape(-1, 3)
    when = (times[:-1, None] + f[None] * np.diff(times)[:, None]).ravel()
    gap = np.asarray(_gaps(scene, jnp.asarray(points, jnp.float32), jnp.asarray(when, jnp.float32))) - radius
    touching = np.flatnonzero(gap <= 0)
    return (touching[0] / each if len(touching) else np.inf), gap.min()


@jax.jit
def _gaps(scene, points, times):
    return jax.vmap(lambda p, t: signed_distance(scene_at(scene, t), p))(points, times)


@jax.jit
def _contact(scene, path, times):
    return path_contact(scene, path, RADIUS, times)


def random_moving_scene(rng: np.random.Generator) -> Scene:
    def how():
        if rng.random() < 0.5:
            return motion(velocity=rng.uniform(-3, 3, 3), low=(0, 0, 0), high=VOLUME[1])
        return motion(
            a=rng.uniform(-2, 2, 3), b=rng.uniform(-2, 2, 3), rate=rng.uniform(-2, 2), phase=rng.uniform(-3, 3)
        )

    def place():
        return rng.uniform(VOLUME[0] + 1, VOLUME[1] - 1)

    shapes = []
    for _ in range(8):
        half = rng.uniform(0.3, 2, 3)
        shapes += [
            UprightBoxes(position=place(), half=half, yaw=rng.uniform(-3, 3), albedo=GREY, motion=how()),
            UprightCylinders(position=place(), radius=half[0], half_height=half[1], albedo=GREY, motion=how()),
            ball(place(), radius=half[2], motion=how()),
            thrown(share=rng.uniform(0.1, 1), bearing=rng.uniform(-1, 1), gravity=rng.choice([0.0, 9.81])),
        ]
    return scene_of(*shapes)


def close_by(scene: Scene, time: float, rng: np.random.Generator):
    """A point [3] at which the body is free and half a metre or less from a shape."""
    points = rng.uniform(VOLUME[0], VOLUME[1], (4096, 3)).astype(np.float32)
    gap = np.asarray(_gaps(scene, jnp.asarray(points), jnp.full(4096, time))) - RADIUS
    return points[np.argmax((gap > 0) & (gap < 0.5))]


@pytest.mark.whole
def test_contact_with_moving_shapes_is_where_dense_sampling_finds_it():
    rng = np.random.default_rng(0)
    touched = free = 0
    for _ in range(60):
        scene = random_moving_scene(rng)
        n = 13
        times = (rng.uniform(0, 9) + 0.02 * np.arange(n + 1)).astype(np.float32)
        here = close_by(scene, float(times[0]), rng)
        path = here + np.cumsum(np.vstack([np.zeros(3), 0.02 * rng.uniform(-5, 5, 3) + rng.normal(0, 0.02, (n, 3))]), 0)
        path = path.astype(np.float32)
        expected, least = densely(scene, path, times, RADIUS)
        touch, fraction = map(np.asarray, _contact(scene, path, times))
        if not np.isfinite(expected):
            free += 1
            assert not touch.any(), least
            continue
        if least > -5e-4:
            continue  # a graze, which eight samples may miss
        touched += 1
        segment = int(np.argmax(touch))
        # Of a relative motion of 0.2 m at most in a segment, interpolated between samples 0.03 m apart.
        assert touch.sum() == 1 and abs(segment + fraction[segment] - expected) < 0.06, (segment, expected)
    assert touched > 10 and free > 10


def test_a_hovering_drone_is_hit_by_what_moves_into_it():
    wall = UprightBoxes(
        position=[10, 6, 5],
        half=[0.5, 3, 3],
        yaw=0,
        albedo=GREY,
        motion=motion(a=(-3, 0, 0), rate=1.0, phase=-np.pi / 2),
    )
    scene, still = scene_of(wall), scene_of(dataclasses.replace(wall, motion=None))
    path, times = jnp.tile(jnp.float32([[8.6, 6, 5]]), (14, 1)), 0.02 * jnp.arange(14, dtype=jnp.float32)
    # The face leaves x = 9.5 and has 3 sin(t) behind it; it touches at 8.96.
    touch, fraction = map(np.asarray, _contact(scene, path, times))
    at = float(times[np.argmax(touch)] + 0.02 * fraction[np.argmax(touch)])
    assert touch.sum() == 1 and abs(at - np.arcsin(0.54 / 3)) < 1e-4
    assert not np.asarray(_contact(still, path, times)[0]).any()
    assert not np.asarray(path_contact(scene, path, RADIUS)[0]).any()  # without times the world stands as at time 0


@pytest.mark.whole
def test_a_fast_ball_does_not_pass_through_between_two_physics_steps():
    # 30 m/s: 0.6 m in a step, with 0.1 + 0.1 m of radii; at both ends of the step it is free.
    fast = ball([10, 6, 5], radius=0.1, motion=motion(velocity=(30, 0, 0), low=(0, 0, 0), high=(40, 30, 12)))
    scene = scene_of(fast)
    path, times = jnp.tile(jnp.float32([[10.9, 6, 5]]), (4, 1)), 0.02 * jnp.arange(4, dtype=jnp.float32)
    touch, fraction = path_contact(scene, path, 0.1, times)
    assert np.asarray(touch).tolist() == [False, True, False]
    assert abs(float(fraction[1]) - (0.7 / 30 - 0.02) / 0.02) < 0.02
    alone = segment_contact(scene, path[1], path[2], 0.1, times=(times[1], times[2]))
    assert bool(alone[0]) and abs(float(alone[1]) - float(fraction[1])) < 1e-5


@pytest.mark.whole
def test_the_search_of_a_path_finds_no_less_than_the_search_of_each_segment():
    rng = np.random.default_rng(1)
    for _ in range(20):
        scene = random_moving_scene(rng)
        times = (rng.uniform(0, 9) + 0.02 * np.arange(14)).astype(np.float32)
        path = np.cumsum(np.vstack([rng.uniform(VOLUME[0], VOLUME[1]), rng.normal(0, 0.08, (13, 3))]), 0)
        path = path.astype(np.float32)
        touch, fraction = map(np.asarray, _contact(scene, path, times))
        alone = np.asarray(_each(scene, path, times)[0])
        assert touch.any() == alone.any()
        if touch.any():
            first = int(np.argmax(alone))
            assert touch[first] and abs(fraction[first] - _each(scene, path, times)[1][first]) < 1e-5


@jax.jit
def _each(scene, path, times):
    one = lambda a, b, s, t: segment_contact(scene, a, b, RADIUS, times=(s, t))  # noqa: E731
    return jax.vmap(one)(path[:-1], path[1:], times[:-1], times[1:])
