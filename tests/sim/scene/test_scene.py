"""Compares signed distance and contact with MuJoCo and with numbers worked out by hand."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.sim.scene import distance
from edqn_jax.sim.scene.distance import path_contact, segment_contact, shape_distances, signed_distance
from edqn_jax.sim.scene.mjcf import load_world
from edqn_jax.sim.scene.scene import (
    FIELDS,
    PARKED,
    Capsules,
    Planes,
    Scene,
    Spheres,
    TiltedBoxes,
    TiltedCylinders,
    UprightBoxes,
    UprightCylinders,
    build_scene,
    obstacle_count,
    scene_shapes,
    stack_scenes,
    take_scene,
    with_equal_capacities,
)
from edqn_jax.sim.scene.shapes.kind import kinds
from tests.oracles import mujoco_distance

EVERY_KIND = """
<mujoco>
  <worldbody>
    <site name="start" pos="-10 0 5"/> <site name="goal" pos="10 0 5"/>
    <geom name="ground" type="plane" size="1 1 1"/>
    <geom name="slope" type="plane" size="0 0 1" pos="0 0 -3" euler="10 20 0"/>
    <geom name="block" type="box" size="1 2 3" pos="3 1 3" euler="0 0 25"/>
    <geom name="lying block" type="box" size="1 2 3" pos="-8 8 2" euler="90 0 0"/>
    <geom name="pillar" type="cylinder" size="1.5 3" pos="-4 -3 3"/>
    <geom name="ball" type="sphere" size="2" pos="0 6 4"/>
    <geom name="capsule" type="capsule" size="0.7 2" pos="7 -6 4" euler="30 40 50"/>
    <body pos="-6 4 5" euler="20 0 70">
      <geom name="tilted block" type="box" size="2 1 0.5" pos="0.5 0 0" euler="0 35 0"/>
      <geom name="tilted pillar" type="cylinder" size="0.8 2.5" pos="0 0 4" euler="0 60 10"/>
    </body>
  </worldbody>
</mujoco>
"""

GREY = np.full(3, 0.5)
VOLUME = np.array([[0.0, 0.0, 0.0], [10.0, 10.0, 10.0]])


def scene_of(*shapes, **capacities) -> Scene:
    return build_scene(shapes, volume=VOLUME, start=VOLUME[0], goal=VOLUME[1], capacities=capacities)


@jax.jit
def distances_at(scene, points):
    return jax.vmap(lambda point: signed_distance(scene, point))(points)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "every_kind.xml"
    path.write_text(EVERY_KIND)
    return load_world(path)


@pytest.fixture(scope="module")
def compared(world):
    """For each kind: ours [K, N] and MuJoCo's [K, N], at points all around and inside every shape."""
    rng = np.random.default_rng(0)
    around = rng.uniform((-14, -14, -4), (14, 14, 14), (300, 3))
    centres = [np.asarray(s.position) for s in scene_shapes(world.scene) if not isinstance(s, Planes)]
    inside = np.concatenate([c + rng.uniform(-1, 1, (100, 3)) for c in centres])
    points = np.concatenate([around, inside]).astype(np.float32)
    ours = jax.jit(jax.vmap(lambda p: shape_distances(world.scene, p)))(points)
    theirs = mujoco_distance.distances(world.path, points)
    return {
        kind: (np.asarray(d), np.stack([theirs[name] for name in world.names[kind]], axis=1))
        for kind, d in ours.items()
    }


@pytest.mark.parametrize("kind", FIELDS)
def test_distance_outside_agrees_with_mujoco(compared, kind):
    ours, theirs = compared[kind]
    outside = theirs > 0.01
    assert outside.sum() > 200
    # The bar of the project. float32 alone costs some 1e-5 m at these distances.
    np.testing.assert_allclose(ours[outside], theirs[outside], atol=1e-4)


@pytest.mark.parametrize("kind", FIELDS)
def test_inside_is_negative_exactly_where_mujoco_says_so(compared, kind):
    ours, theirs = compared[kind]
    clear = np.abs(theirs) > 1e-4
    assert (theirs < -0.05).sum() >= 20
    np.testing.assert_array_equal(ours[clear] < 0, theirs[clear] < 0)


def test_depth_inside_is_the_way_to_the_nearest_surface():
    boxes = scene_of(UprightBoxes(position=[5, 5, 5], half=[1, 2, 3], yaw=np.pi / 2, albedo=GREY))
    # Turned by 90 degrees the box reaches 2 m in x and 1 m in y.
    np.testing.assert_allclose(signed_distance(boxes, jnp.array([5.5, 5.25, 5.0])), -0.75, atol=1e-5)
    pillars = scene_of(UprightCylinders(position=[5, 5, 5], radius=2, half_height=3, albedo=GREY))
    np.testing.assert_allclose(signed_distance(pillars, jnp.array([5.0, 6.0, 7.5])), -0.5, atol=1e-5)


def test_the_nearest_shape_of_any_kind_counts(world):
    points = np.random.default_rng(1).uniform(-10, 10, (50, 3)).astype(np.float32)
    nearest = distances_at(world.scene, points)
    each = jax.jit(jax.vmap(lambda p: shape_distances(world.scene, p)))(points)
    # Two compilations may differ in the last digit.
    np.testing.assert_allclose(nearest, np.concatenate(list(each.values()), axis=1).min(axis=1), atol=1e-5)


def test_an_empty_scene_is_infinitely_wide():
    assert signed_distance(scene_of(), jnp.zeros(3)) == PARKED


def test_parked_shapes_change_nothing():
    ball = Spheres(position=[5, 5, 5], radius=1, albedo=GREY)
    alone, padded = scene_of(ball), scene_of(ball, **dict.fromkeys(FIELDS, 3))
    points = np.random.default_rng(2).uniform(0, 10, (20, 3)).astype(np.float32)
    np.testing.assert_allclose(distances_at(alone, points), distances_at(padded, points), atol=1e-5)
    assert obstacle_count(padded) == 1
    for kind in kinds().values():
        assert obstacle_count(scene_of(kind.parked)) == 0


@pytest.mark.slow
def test_the_gradient_is_the_direction_away_from_the_surface_and_finite_everywhere(world):
    gradient = jax.jit(jax.vmap(jax.grad(lambda p: signed_distance(world.scene, p))))
    points = np.random.default_rng(3).uniform(-12, 12, (400, 3)).astype(np.float32)
    length = np.linalg.norm(gradient(points), axis=1)
    np.testing.assert_allclose(length, 1.0, atol=1e-3)
    # On axes and at centres there is no direction away; what comes back must still be a number.
    points[:3] = [[0.0, 6.0, 4.0], [-4.0, -3.0, 3.0], [3.0, 1.0, 3.0]]
    assert np.isfinite(gradient(points)).all()


def test_pools_of_equal_capacities_hold_the_worlds_that_they_held(world):
    ball = Spheres(position=[5, 5, 5], radius=1, albedo=GREY)
    city, balls = stack_scenes([world.scene] * 2), stack_scenes([scene_of(ball, spheres=9)])
    grown = with_equal_capacities([city, balls])
    joined = jax.tree.map(lambda *parts: jnp.concatenate(parts), *grown)  # equal capacities, or this would not do
    points = np.random.default_rng(2).uniform(0, 10, (20, 3)).astype(np.float32)
    for index, alone in enumerate([world.scene, world.scene, scene_of(ball)]):
        found = take_scene(joined, index)
        np.testing.assert_allclose(distances_at(found, points), distances_at(alone, points), atol=1e-5)
        assert obstacle_count(found) == obstacle_count(alone)
        np.testing.assert_array_equal(found.volume, alone.volume)


def test_too_many_shapes_for_a_capacity_are_refused():
    ball = Spheres(position=[5, 5, 5], radius=1, albedo=GREY)
    with pytest.raises(ValueError, match="2 spheres exceed the capacity of 1"):
        scene_of(ball, ball, spheres=1)


def test_a_pool_gives_every_world_back():
    first = scene_of(Spheres(position=[5, 5, 5], radius=1, albedo=GREY))
    second = scene_of(
        UprightBoxes(position=[5, 5, 5], half=[1, 2, 3], yaw=0.3, albedo=GREY),
        UprightBoxes(position=[8, 5, 5], half=[1, 1, 3], yaw=0.0, albedo=GREY),
        Capsules(position=[2, 2, 2], axis=[1, 0, 0], half_length=1, radius=0.5, albedo=GREY),
        TiltedBoxes(position=[2, 8, 5], half=[1, 2, 3], rotation=np.eye(3), albedo=GREY),
        TiltedCylinders(position=[2, 8, 5], axis=[0, 1, 0], half_length=1, radius=1, albedo=GREY),
    )
    pool = stack_scenes([first, second])
    assert pool.boxes.position.shape == (2, 2, 3) and pool.spheres.radius.shape == (2, 1)
    for index, scene in enumerate((first, second)):
        taken = take_scene(pool, index)
        assert obstacle_count(taken) == obstacle_count(scene)
        for ours, theirs in zip(scene_shapes(taken), scene_shapes(scene), strict=True):
            jax.tree.map(np.testing.assert_array_equal, ours, theirs)


@pytest.mark.slow
def test_contact_is_reported_where_it_happens():
    wall = scene_of(UprightBoxes(position=[5, 5, 5], half=[1, 5, 5], yaw=0.0, albedo=GREY))
    touch, fraction = segment_contact(wall, jnp.array([3.0, 5.0, 5.0]), jnp.array([4.0, 5.0, 5.0]), 0.36)
    # The face is at x = 4: the sphere touches with its centre at 3.64.
    assert touch
    np.testing.assert_allclose(fraction, 0.64, atol=1e-5)


def test_a_pass_at_a_hands_breadth_is_no_contact():
    wall = scene_of(UprightBoxes(position=[5, 5, 5], half=[1, 1, 5], yaw=0.0, albedo=GREY))
    touch, fraction = segment_contact(wall, jnp.array([3.5, 3.0, 5.0]), jnp.array([6.5, 3.0, 5.0]), 0.36)
    assert not touch and fraction == 1.0


def test_contact_between_two_free_ends_is_found():
    # Past the edge of a box, its corner 1 mm inside the sphere half way along a physics step of 0.11 m.
    box = scene_of(UprightBoxes(position=[5, 5, 5], half=[1, 1, 5], yaw=np.pi / 4, albedo=GREY))
    y = 5 - np.sqrt(2) - 0.359
    start, end = jnp.array([4.945, y, 5.0]), jnp.array([5.055, y, 5.0])
    assert signed_distance(box, start) > 0.36 and signed_distance(box, end) > 0.36
    touch, fraction = segment_contact(box, start, end, 0.36)
    # The sphere of 0.36 m meets the edge where its centre is sqrt(0.36^2 - 0.359^2) before the middle.
    expected = 0.5 - np.sqrt(0.36**2 - 0.359**2) / 0.11
    assert touch
    np.testing.assert_allclose(fraction, expected, atol=0.05)  # a third of the spacing of the samples


def test_a_segment_that_begins_in_contact_touches_at_once():
    ball = scene_of(Spheres(position=[5, 5, 5], radius=1, albedo=GREY))
    touch, fraction = segment_contact(ball, jnp.array([5.0, 5.0, 5.5]), jnp.array([5.0, 5.0, 9.0]), 0.36)
    assert touch and fraction == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("way", ["cpu", "default"])
def test_a_path_is_searched_no_less_than_its_segments(world, way, monkeypatch):
    """On CPUs one segment after the other, elsewhere all of them at once."""
    monkeypatch.setattr(distance.lax, "platform_dependent", lambda *given, **ways: ways[way](*given))
    rng = np.random.default_rng(6)
    begin = rng.uniform(-10, 10, (3000, 1, 3))
    steps = rng.normal(size=(3000, 1, 3)) * 0.06 + rng.normal(size=(3000, 13, 3)) * 0.03
    paths = jnp.asarray(np.concatenate([begin, begin + np.cumsum(steps, axis=1)], axis=1), jnp.float32)
    touch, fraction = jax.jit(jax.vmap(lambda path: path_contact(world.scene, path, 0.36)))(paths)
    segments = jax.vmap(lambda a, b: segment_contact(world.scene, a, b, 0.36))
    each, at = jax.jit(jax.vmap(segments))(paths[:, :-1], paths[:, 1:])
    some, first = np.asarray(each).any(axis=1), np.argmax(each, axis=1)
    # Enough of both kinds, and contacts in the middle of a path.
    assert 100 < some.sum() < 2900 and ((first > 0) & some).sum() > 50
    np.testing.assert_array_equal(np.asarray(touch).any(axis=1), some)
    rows = np.flatnonzero(some)
    np.testing.assert_array_equal(np.argmax(touch, axis=1)[rows], first[rows])
    np.testing.assert_allclose(np.asarray(fraction)[rows, first[rows]], np.asarray(at)[rows, first[rows]], atol=1e-5)
