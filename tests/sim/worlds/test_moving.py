"""Random worlds that move: what moves and how fast, that starts are free at first, and whom balls are thrown at."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import FAMILIES
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.sim.environment import make
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.motion import launch_times
from edqn_jax.sim.scene.scene import PARKED, Scene, build_scene, has_motion, scene_at, take_scene
from edqn_jax.sim.scene.shapes.kind import Geom, read_shape
from edqn_jax.sim.task.missions import own_missions, random_missions
from edqn_jax.sim.worlds import canyon, families, forest
from edqn_jax.sim.worlds.families import random_pool, world_keys
from edqn_jax.sim.worlds.free_points import CLEARANCE, EARLY_S
from edqn_jax.sim.worlds.moving import MOVING_SHARE, Moving
from tests.support.marks import in_whole
from tests.support.meshes import bracket
from tests.support.registries import keep_as_they_are

WORLDS = 8
KEYS = world_keys("validation", WORLDS)
RADIUS = 0.36
KINDS = ("boxes", "cylinders", "spheres")
EVERYTHING = Moving(share=0.7, speed_m_s=4.0, balls=3, ball_gravity_m_s2=2.0)


@pytest.fixture(scope="module")
def pools() -> dict[str, Scene]:
    """Medium worlds, standing, moving as by default, and with all there is."""
    drawn = {"still": random_pool("medium", KEYS), "moving": random_pool("moving", KEYS)}
    return drawn | {"everything": random_pool("medium", KEYS, EVERYTHING)}


@jax.jit
def places(scene: Scene, times):
    now = jax.vmap(lambda t: scene_at(scene, t))(times)
    return {kind: getattr(now, kind).position for kind in KINDS}


@pytest.mark.whole
def test_at_time_zero_a_moving_world_is_the_still_one_of_the_same_key(pools):
    still = pools["still"]
    assert not has_motion(still)
    for name in ("moving", "everything"):
        assert has_motion(pools[name])
        now = jax.jit(jax.vmap(lambda scene: scene_at(scene, jnp.float32(0.0))))(pools[name])
        for kind in KINDS:
            ours, theirs = (jax.tree.map(np.asarray, getattr(each, kind)) for each in (now, still))
            many = theirs.position.shape[1]
            # Two programs: float32 sums may differ in the last digit.
            np.testing.assert_allclose(ours.position[:, :many], theirs.position, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(pools[name].start, still.start, atol=1e-4)


@pytest.mark.whole
def test_half_of_the_obstacles_move_in_the_worlds_moving_and_the_option_says_how_many(pools):
    shares = {}
    for name in ("moving", "everything"):
        at = [places(take_scene(pools[name], i), jnp.float32([0.0, 0.4])) for i in range(WORLDS)]
        apart = [np.linalg.norm(x["boxes"][1] - x["boxes"][0], axis=-1) for x in at]
        present = np.concatenate([np.asarray(x["boxes"][0])[:, 0] < PARKED / 2 for x in at])
        shares[name] = (np.concatenate(apart) > 1e-3)[present].mean()
    # 170 blocks: a standard deviation of 0.04; some stand since they would come near the start or the goal.
    assert abs(shares["moving"] - MOVING_SHARE) < 0.12 and abs(shares["everything"] - 0.7) < 0.12


@pytest.mark.parametrize(("name", "top"), [("moving", 3.0), ("everything", 4.0)])
def test_obstacles_are_as_fast_as_the_option_says_and_all_three_motions_occur(pools, name, top):
    times = jnp.arange(0, 30, 0.1, dtype=jnp.float32)
    sorts = {"runs": 0, "sways": 0, "circles": 0}
    for i in range(WORLDS):
        scene = take_scene(pools[name], i)
        for kind in KINDS:
            # Balls apart, which are thrown.
            many = getattr(take_scene(pools["still"], i), kind).position.shape[0]
            at = np.asarray(places(scene, times)[kind], np.float64)[:, :many]
            speed = np.linalg.norm(np.diff(at, axis=0), axis=-1) / 0.1
            assert np.ptp(at[..., 2], axis=0).max() == 0 and speed.max() <= top * 1.001 + 1e-2
            fastest = speed.max(0)[speed.max(0) > 0.05]
            assert (fastest > 0.3 * top * 0.97).all()
            motion = getattr(scene, kind).motion
            runs, swings = (
                np.abs(np.asarray(x)).reshape(len(x), -1).max(1) > 0 for x in (motion.velocity, motion.swing)
            )
            a, b = np.asarray(motion.swing)[:, 0], np.asarray(motion.swing)[:, 1]
            circles = np.abs(np.cross(a, b)).max(-1) > 0.1  # at least 1 m^2; of one that sways they are parallel
            sways = swings & ~circles
            sorts["runs"] += runs.sum()
            sorts["sways"] += sways.sum()
            sorts["circles"] += circles.sum()
            assert not (runs & swings).any()
    counts = np.array(list(sorts.values()))
    assert (np.abs(counts / counts.sum() - 1 / 3) < 0.12).all(), sorts


def test_what_runs_stays_between_the_faces_of_the_volume(pools):
    times, found = jnp.linspace(0, 52, 200), 0
    for i in range(WORLDS):
        scene = take_scene(pools["everything"], i)
        assert scene.cylinders.motion is not None
        runs = np.abs(np.asarray(scene.cylinders.motion.velocity)).max(-1) > 0
        at = np.asarray(places(scene, times)["cylinders"])[:, runs]
        beyond = np.asarray(scene.cylinders.radius)[runs][None, :, None]
        lower, upper = np.asarray(scene.volume)
        assert (at[..., :2] - beyond >= lower[:2] - 1e-3).all() and (at[..., :2] + beyond <= upper[:2] + 1e-3).all()
        found += runs.sum()
    assert found > 5


@jax.jit
def _nearest(scene, point, times):
    unthrown = dataclasses.replace(scene, spheres=dataclasses.replace(scene.spheres, throw=None))
    return jnp.min(jax.vmap(lambda t: signed_distance(scene_at(unthrown, t), point))(times))


@pytest.mark.whole
@pytest.mark.parametrize("name", ["moving", *in_whole("everything")])
def test_who_hovers_at_a_start_is_left_alone_for_two_seconds(pools, name):
    times = jnp.arange(0, EARLY_S + 1e-6, 0.02)
    pool = pools[name]
    for missions in (own_missions(pool), random_missions(pool, 40, jax.random.key(0))):
        for index, *points in zip(missions.scene, missions.start, missions.goal, strict=True):
            scene = take_scene(pool, index)
            for point in points:
                # Between two samples 0.25 s apart what moves at 4 m/s comes 0.5 m nearer at most.
                assert float(_nearest(scene, point, times)) >= CLEARANCE - 0.5


@pytest.mark.whole
@pytest.mark.slow
def test_no_worlds_own_start_is_swept_in_the_first_seconds():
    pool = random_pool("dense", world_keys("validation", 128), Moving(share=1.0, speed_m_s=5.0))
    times = jnp.arange(0, EARLY_S + 1e-6, 0.02)
    for points in (pool.start, pool.goal):
        least = jax.jit(jax.vmap(_nearest, in_axes=(0, 0, None)))(pool, points, times)
        assert float(least.min()) >= CLEARANCE - 0.625  # at 5 m/s, 0.125 s from a sample


@pytest.mark.whole
def test_without_the_care_for_the_first_seconds_starts_would_be_swept(pools):
    """So the test before can fail: free points of the still world are not free in the moving one."""
    missions = random_missions(pools["still"], 200, jax.random.key(0))
    times = jnp.arange(0, EARLY_S + 1e-6, 0.02)
    least = [
        float(_nearest(take_scene(pools["everything"], index), start, times))
        for index, start in zip(missions.scene, missions.start, strict=True)
    ]
    assert min(least) < RADIUS


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "bodies"), [("canyon", canyon.BODIES), pytest.param("forest", forest.BODIES, marks=pytest.mark.whole)]
)
def test_what_belongs_together_moves_together(family, bodies):
    pool = random_pool(family, KEYS[:3], Moving(share=0.6))
    for i in range(3):
        found = places(take_scene(pool, i), jnp.float32([0.0, 1.3, 7.7]))
        shifts: dict[int, list[np.ndarray]] = {}
        for kind, numbers in bodies.items():
            at = np.asarray(found[kind])
            for shape in np.flatnonzero(at[0, :, 0] < PARKED / 2):
                shifts.setdefault(numbers[shape], []).append(at[:, shape] - at[0, shape])
        assert any(len(each) > 1 and np.abs(each).max() > 0.5 for each in shifts.values())
        for each in shifts.values():
            np.testing.assert_allclose(each, np.broadcast_to(each[0], np.shape(each)), atol=1e-4)


@pytest.mark.whole
def test_meshes_of_a_family_of_ones_own_move(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = Geom("mesh", np.zeros(3), np.eye(3), np.zeros(3), np.full(3, 0.5), mesh=bracket())
    shapes = [dataclasses.replace(read_shape(mesh), position=place) for place in ([10.0, 4, 4], [20.0, 14, 4])]
    world = build_scene(shapes, volume=[[0, 0, 0], [30, 20, 10]], start=[2, 10, 4], goal=[28, 10, 4])
    keep_as_they_are(monkeypatch)
    family = families.Family(lambda key: world, (30.0, 20.0, 10.0), edge_m=None, bodies={"fields": (0, 1)})
    FAMILIES.register("brackets", family)
    pool = random_pool("brackets", KEYS[:4], Moving(share=1.0))
    now = jax.vmap(lambda scene: scene_at(scene, jnp.float32(2.3)))(pool)
    away = np.asarray(now.others["fields"].position - world.others["fields"].position)
    assert np.all(np.linalg.norm(away, axis=2) > 0.1) and np.all(away[..., 2] == 0)


@pytest.mark.whole
@pytest.mark.slow
def test_walls_of_rooms_stand_while_balls_are_thrown():
    pool = random_pool("rooms", KEYS[:2], Moving(share=1.0, balls=2))
    assert pool.boxes.motion is None and pool.spheres.throw is not None
    assert pool.spheres.radius.shape == (2, 2)


@pytest.mark.whole
@pytest.mark.slow
def test_a_moving_world_of_a_mixture_is_that_of_its_family():
    moving = Moving(share=0.5, balls=1)
    pool, dense = random_pool("open", KEYS, moving), random_pool("dense", KEYS, moving)
    times, same = jnp.float32([0.0, 3.3, 6.1]), 0
    for i in range(WORLDS):
        ours, theirs = (places(take_scene(each, i), times)["boxes"] for each in (pool, dense))
        same += bool(np.allclose(ours, theirs, atol=1e-3))
    assert 0 < same < WORLDS


def test_balls_meet_a_drone_that_flies_straight_and_come_from_ahead(pools):
    pool = random_pool("medium", KEYS, Moving(balls=3))
    bearings = []
    for i in range(WORLDS):
        scene = take_scene(pool, i)
        throw = jax.tree.map(lambda x: x[-3:], scene.spheres.throw)
        hits = np.asarray(launch_times(throw, scene.start, scene.goal) + throw.early)
        assert (np.diff(hits) > 0).all() and (hits >= np.asarray(throw.early)).all()
        way = np.asarray(scene.goal - scene.start, np.float64)
        for ball, hit in enumerate(hits):
            times = jnp.float32([hit - 1.0, hit])
            before, at = np.asarray(places(scene, times)["spheres"], np.float64)[:, -3 + ball]
            drone = np.asarray(scene.start) + way / np.linalg.norm(way) * min(4.0 * hit, np.linalg.norm(way))
            np.testing.assert_allclose(at, drone, atol=2e-3)
            flown = at - before
            assert abs(np.linalg.norm(flown) - 6.0) < 1e-2
            turned = np.arctan2(-flown[1], -flown[0]) - np.arctan2(way[1], way[0])
            bearings.append(np.degrees((turned + np.pi) % (2 * np.pi) - np.pi))
        assert np.asarray(places(scene, jnp.float32([0.0]))["spheres"])[0, -3:].min() == PARKED
    assert np.abs(bearings).max() <= 40.01 and np.ptp(bearings) > 50


def test_balls_are_as_late_as_fast_and_as_large_as_the_options_say():
    late = {"ball_seconds": (0.3, 1.0), "ball_speed_m_s": 12.0, "ball_slowest": 0.5, "ball_radii_m": (0.15, 0.3)}
    config = make_config("medium", world={"balls": 8, **late}, surface={"pattern": "plaid"})
    pool = random_pool("medium", KEYS, Moving.from_config(config))
    throw = jax.tree.map(lambda leaf: np.asarray(leaf)[:, -8:], pool.spheres.throw)
    for values, (least, most) in ((throw.early, (0.3, 1.0)), (throw.speed, (6.0, 12.0))):
        assert least <= values.min() < least + 0.1 * (most - least)
        assert most - 0.1 * (most - least) < values.max() <= most
    radius = np.asarray(pool.spheres.radius)[:, -8:]
    assert 0.15 <= radius.min() < 0.17 and 0.28 < radius.max() <= 0.3
    # Speeds are drawn apart: the other numbers do not follow them.
    assert abs(np.corrcoef(throw.early.ravel(), throw.speed.ravel())[0, 1]) < 0.3


def test_no_ball_comes_near_the_start_in_the_first_seconds(pools):
    pool = random_pool("medium", KEYS, Moving(balls=4))
    for i in range(WORLDS):
        scene = take_scene(pool, i)
        at = np.asarray(places(scene, jnp.arange(0, EARLY_S, 0.05))["spheres"])[:, -4:]
        assert np.linalg.norm(at - np.asarray(scene.start), axis=-1).min() > 3.0


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize("family", ["sparse", pytest.param("forest", marks=pytest.mark.whole)])
def test_moving_worlds_reuse_no_key_and_promote_no_rank(family):
    with jax.debug_key_reuse(True), jax.numpy_rank_promotion("raise"), jax.checking_leaks():
        # Not by `random_pool`, which draws in threads, where none of this holds.
        pool = families._sample_worlds(family, world_keys("training", 2), EVERYTHING)
        random_missions(pool, 4, jax.random.key(0))
        jax.jit(lambda pool: scene_at(take_scene(pool, 0), jnp.float32(1.0)))(pool)


@pytest.mark.whole
def test_environments_and_evaluations_fly_in_what_the_configuration_says():
    moving = {"moving_share": 1.0, "moving_speed_m_s": 2.0, "balls": 2}
    config = make_config("medium", world=moving, surface={"pattern": "plaid"})
    expected = random_pool("medium", world_keys("test", 2), Moving(share=1.0, speed_m_s=2.0, balls=2))
    for pool in (
        make("medium", config, worlds=2, split="test").world.pool,
        load_missions(config, "medium", 2).env_params.pool,
    ):
        assert jax.tree.structure(pool) == jax.tree.structure(expected)
        jax.tree.map(np.testing.assert_array_equal, pool, expected)
    flown = load_missions(make_config("medium"), "moving", 2).env_params.pool
    assert has_motion(flown) and flown.spheres.throw is None


@pytest.mark.parametrize(
    ("world", "options", "said"),
    [
        ("medium", {"moving_share": 1.5}, r"world.moving_share must be between 0 and 1, not 1.5"),
        ("medium", {"moving_speed_m_s": 6.0}, r"world.moving_speed_m_s must be at most 5, not 6.0"),
        ("medium", {"balls": -1}, r"world.balls must be 0 or more, not -1"),
        ("medium", {"balls": 65}, r"world.balls must be at most 64, not 65"),
        ("medium", {"ball_speed_m_s": 0.0}, r"world.ball_speed_m_s must be at least 2, not 0.0"),
        ("medium", {"ball_seconds": (1.0, 0.5)}, r"world.ball_seconds must be two numbers above 0, the least and the"),
        (
            "medium",
            {"balls": 1, "ball_seconds": (0.2, 1.0)},
            r"ball_seconds must be at least 0.25 and more: a ball",
        ),
        ("paper", {"moving_share": 0.5}, r"world.moving_share is for random worlds .* give --world.moving-share 0"),
        ("paper", {"balls": 2}, r"world.balls is for random worlds .* in 'paper' the file says what moves"),
    ],
)
def test_what_cannot_move_is_refused_in_one_sentence(world, options, said):
    with pytest.raises(ConfigError, match=said):
        make_config(world, world=options)
