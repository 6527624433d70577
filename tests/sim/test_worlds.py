"""Random worlds, their seeds, and missions."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import DENSITIES
from edqn_jax.errors import ConfigError
from edqn_jax.planners.astar import shortest_path
from edqn_jax.sim.free_points import CLEARANCE, FAR, free_point
from edqn_jax.sim.missions import AWAY, own_missions, random_missions, spread_missions
from edqn_jax.sim.mjcf import check_scene, load_scene, resolve_world
from edqn_jax.sim.scene import (
    PARKED,
    Planes,
    Spheres,
    UprightBoxes,
    build_scene,
    obstacle_count,
    scene_shapes,
    signed_distance,
    stack_scenes,
    take_scene,
)
from edqn_jax.sim.worlds import (
    GAP,
    HALF_WIDTHS,
    SIZE,
    SPLITS,
    random_pool,
    random_scene,
    world_key,
    world_keys,
)

RADIUS = 0.36
WORLDS = 24
MISSIONS = 512


@pytest.fixture(scope="module")
def pools():
    return {density: random_pool(density, world_keys("validation", WORLDS)) for density in DENSITIES}


@pytest.fixture(scope="module")
def paper():
    return stack_scenes([load_scene(resolve_world("paper"))])


@jax.jit
def clearances(pool, missions, points):
    at = jax.vmap(lambda index, point: signed_distance(take_scene(pool, index), point))
    return at(missions.scene, points)


def footprint(shape) -> tuple[float, float, float]:
    """Middle and radius of the circle around a shape seen from above."""
    reach = np.hypot(*shape.half[:2]) if isinstance(shape, UprightBoxes) else shape.radius
    return float(shape.position[0]), float(shape.position[1]), float(reach)


def test_the_splits_never_share_a_world():
    keys = [jax.random.key_data(world_keys(split, 5000)) for split in SPLITS]
    rows = np.concatenate([np.asarray(key) for key in keys])
    assert len(np.unique(rows, axis=0)) == 3 * 5000


def test_a_worlds_key_depends_on_its_split_and_index_alone():
    batch = jax.random.key_data(world_keys("test", 3, first=7))
    single = jax.random.key_data(world_key("test", 9))
    np.testing.assert_array_equal(batch[2], single)


@pytest.mark.parametrize(("density", "least", "most"), [("sparse", 12, 12), ("medium", 28, 30), ("dense", 54, 60)])
@pytest.mark.slow
def test_a_density_has_its_number_of_shapes(pools, density, least, most):
    counts = [obstacle_count(take_scene(pools[density], i)) for i in range(WORLDS)]
    assert least <= min(counts) and max(counts) <= most


@pytest.mark.slow
def test_mixed_worlds_are_of_every_density(pools):
    ranges = {"sparse": range(12, 13), "medium": range(28, 31), "dense": range(54, 61)}
    seen = dict.fromkeys(ranges, 0)
    for i in range(WORLDS):
        scene = take_scene(pools["mixed"], i)
        (density,) = [name for name, counts in ranges.items() if obstacle_count(scene) in counts]
        seen[density] += 1
        widths = np.asarray(scene.boxes.half)[np.asarray(scene.boxes.position[:, 2]) < PARKED / 2, :2]
        narrow, wide = HALF_WIDTHS[density]
        assert widths.min() >= narrow and widths.max() <= wide
    # Of 24 worlds 8 are expected of each density; 2 or fewer come once in 200 draws of keys, which are fixed.
    assert min(seen.values()) > 2, seen


@pytest.mark.parametrize("density", DENSITIES)
def test_footprints_keep_their_gap_so_that_free_space_is_connected(pools, density):
    for i in range(WORLDS):
        shapes = [s for s in scene_shapes(take_scene(pools[density], i)) if not isinstance(s, Planes)]
        discs = [footprint(shape) for shape in shapes]
        for (x, y, r), (u, v, s) in itertools.combinations(discs, 2):
            assert np.hypot(x - u, y - v) - r - s > GAP - 1e-3
        for x, y, r in discs:
            assert min(x, y, SIZE[0] - x, SIZE[1] - y) - r > GAP - 1e-3


@pytest.mark.parametrize("density", DENSITIES)
def test_shapes_stand_on_the_ground_and_below_the_ceiling(pools, density):
    pool = pools[density]
    for position, half in (
        (pool.boxes.position[..., 2], pool.boxes.half[..., 2]),
        (pool.cylinders.position[..., 2], pool.cylinders.half_height),
    ):
        present = np.asarray(position) < PARKED / 2
        np.testing.assert_allclose((position - half)[present], 0.0, atol=1e-5)
        assert ((position + half)[present] <= SIZE[2]).all()
    low, high = pool.spheres.position[..., 2] - pool.spheres.radius, pool.spheres.position[..., 2]
    present = np.asarray(high) < PARKED / 2
    assert (np.asarray(low)[present] > -1e-4).all()


@pytest.mark.parametrize("density", DENSITIES)
@pytest.mark.slow
def test_start_and_goal_are_free_and_far_apart(pools, density):
    pool = pools[density]
    missions = own_missions(pool)
    assert (np.linalg.norm(missions.start - missions.goal, axis=1) >= FAR).all()
    assert (clearances(pool, missions, missions.start) >= CLEARANCE).all()
    assert (clearances(pool, missions, missions.goal) >= CLEARANCE).all()
    for i in range(WORLDS):
        check_scene(take_scene(pool, i), RADIUS)


@pytest.mark.parametrize("density", DENSITIES)
@pytest.mark.slow
def test_there_is_a_path_in_every_random_world(pools, density):
    for i in range(2):
        scene = take_scene(pools[density], i)
        assert shortest_path(scene, scene.start, scene.goal, RADIUS).length_m >= FAR


def test_a_key_makes_one_world_and_another_key_another(pools):
    again = random_scene("sparse", world_key("validation", 0))
    first, second = take_scene(pools["sparse"], 0), take_scene(pools["sparse"], 1)
    # Compiled for one and for many, float32 sums may differ in the last digit.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4), again, first)
    assert not np.allclose(first.boxes.position, second.boxes.position)


def test_an_unknown_density_names_those_there_are():
    with pytest.raises(ConfigError, match="'thick'; the densities are sparse, medium, dense, mixed"):
        random_scene("thick", world_key("test", 0))


@pytest.mark.slow
def test_random_missions_fly_far_between_free_points_of_every_world(pools):
    pool = pools["dense"]
    missions = random_missions(pool, MISSIONS, jax.random.key(0))
    assert missions.scene.dtype == jnp.int32 and set(np.asarray(missions.scene)) == set(range(WORLDS))
    assert (np.linalg.norm(missions.start - missions.goal, axis=1) >= FAR).all()
    for points in (missions.start, missions.goal):
        assert (clearances(pool, missions, points) >= CLEARANCE).all()
        assert (points[:, 2] >= 1.5).all() and (points[:, 2] <= 20.0).all()


def test_spread_missions_begin_near_the_start_or_anywhere_and_end_at_the_goal(paper):
    missions = spread_missions(paper, MISSIONS, 0.25, 1.0, jax.random.key(0))
    own = (np.abs(missions.start - paper.start) <= 1.0 + 1e-5).all(axis=1)
    assert own.sum() == MISSIONS // 4
    assert len(np.unique(np.asarray(missions.start)[own], axis=0)) > MISSIONS // 8
    assert (clearances(paper, missions, missions.start) >= CLEARANCE).all()
    np.testing.assert_array_equal(missions.goal, np.broadcast_to(paper.goal, (MISSIONS, 3)))
    rest = np.asarray(missions.start)[~own]
    assert (np.linalg.norm(rest - paper.goal, axis=1) >= AWAY).all()
    # The whole volume: each octant has its share.
    octants = (rest > np.asarray([55.0, 55.0, 12.0])) @ np.array([1, 2, 4])
    assert np.bincount(octants, minlength=8).min() > 0.05 * len(rest)


def test_missions_without_jitter_begin_at_the_start_itself(paper):
    missions = spread_missions(paper, MISSIONS, 1.0, 0.0, jax.random.key(0))
    np.testing.assert_array_equal(missions.start, np.broadcast_to(paper.start, (MISSIONS, 3)))


def test_missions_are_the_keys_alone(paper):
    one, same, other = (spread_missions(paper, MISSIONS, 0.25, 1.0, jax.random.key(k)) for k in (3, 3, 4))
    np.testing.assert_array_equal(one.start, same.start)
    assert not np.allclose(one.start, other.start)


def test_a_free_point_in_a_crowded_world_is_the_least_bad_one():
    # A ball that leaves free only the corners of the volume, none of them by 3 m.
    ball = Spheres(position=[5, 5, 5], radius=6, albedo=np.full(3, 0.5))
    scene = build_scene([ball], volume=[[0, 0, 0], [10, 10, 10]], start=[0, 0, 0], goal=[9, 9, 9])
    point = free_point(scene, jax.random.key(0), clearance=3.0)
    assert signed_distance(scene, point) > -0.5


@pytest.mark.slow
def test_worlds_and_missions_reuse_no_key_and_promote_no_rank():
    with jax.debug_key_reuse(True), jax.numpy_rank_promotion("raise"), jax.checking_leaks():
        pool = random_pool("sparse", world_keys("training", 2))
        random_missions(pool, 4, jax.random.key(0))
        spread_missions(pool, 4, 0.5, 1.0, jax.random.key(1))
