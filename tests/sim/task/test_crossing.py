"""Missions of several drones that cross."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Scene, has_motion, scene_at, take_scene
from edqn_jax.sim.task.crossing import APART, crossing_missions, own_crossings, sample_crossing
from edqn_jax.sim.worlds.families import random_pool, world_keys
from edqn_jax.sim.worlds.free_points import CLEARANCE, FAR, early_times
from edqn_jax.sim.worlds.moving import Moving

WORLDS = 24
ROUNDING = 1e-3


def blocks_of(family: str, drones: int) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Returns the worlds of a family, and starts and goals [P, N, 3] in them."""
    pool = random_pool(family, world_keys("validation", WORLDS), Moving())
    missions = own_crossings(pool, drones, jax.random.split(jax.random.key(5), WORLDS))
    assert np.array_equal(missions.scene, np.repeat(np.arange(WORLDS), drones))
    start, goal = (np.asarray(ends).reshape(WORLDS, drones, 3) for ends in (missions.start, missions.goal))
    return pool, start, goal


def clearance(pool: Scene, points: np.ndarray) -> np.ndarray:
    """Returns the distance [P, N] of points to the nearest surface at any of the first two seconds."""

    def one(world, point):
        scene = take_scene(pool, world)
        times = early_times() if has_motion(scene) else jnp.zeros(1)
        return jnp.min(jax.vmap(lambda time: signed_distance(scene_at(scene, time), point))(times))

    return np.asarray(jax.vmap(lambda world, of: jax.vmap(partial(one, world))(of))(jnp.arange(WORLDS), points))


# Each family and each number of drones; every pair would be another program to compile.
@pytest.mark.whole
@pytest.mark.parametrize(
    ("family", "drones"),
    [
        ("medium", 4),
        *(
            pytest.param(*pair, marks=pytest.mark.whole)
            for pair in (("moving", 2), ("dense", 8), ("rooms", 4), ("forest", 8), ("canyon", 2))
        ),
    ],
)
def test_starts_and_goals_are_free_apart_and_far_as_those_of_other_missions(family, drones):
    pool, start, goal = blocks_of(family, drones)
    volume = np.asarray(pool.volume)[:, :, None]
    for ends in (start, goal):
        assert (ends > volume[:, 0] + 0.99).all() and (ends < volume[:, 1] - 0.99).all()
        assert clearance(pool, ends).min() >= CLEARANCE - ROUNDING
        apart = np.linalg.norm(ends[:, :, None] - ends[:, None], axis=-1) + 1e3 * np.eye(drones)
        assert apart.min() >= APART - ROUNDING
    least = np.minimum(FAR, np.asarray(pool.volume)[:, 1, 0] / 2)[:, None]
    assert (np.linalg.norm(goal - start, axis=-1) >= least - ROUNDING).all()


@pytest.mark.parametrize("drones", [2, 8])
def test_drones_at_one_steady_speed_on_their_straight_ways_nearly_all_meet_somebody(drones):
    _, start, goal = blocks_of("medium", drones)
    way = goal - start
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    flown = np.linspace(0, 70, 1401)[:, None, None, None]
    at = start + np.minimum(flown, length) * way / length
    apart = np.linalg.norm(at[:, :, :, None] - at[:, :, None], axis=-1) + 1e3 * np.eye(drones)
    nearest = apart.min(axis=(0, 3))  # [P, N]
    assert np.quantile(nearest, 0.8) < 1.0 and nearest.max() < 12.0
    # From opposite sides: no two start in the same direction from where they meet.
    middle = (start + goal).mean(axis=1, keepdims=True) / 2
    angle = np.sort(np.arctan2(*np.moveaxis((start - middle)[..., :2], -1, 0)[::-1]), axis=1)
    gaps = np.diff(angle, axis=1, append=angle[:, :1] + 2 * np.pi)
    assert gaps.max() < 2 * 2 * np.pi / drones


def test_each_block_is_of_one_world_and_another_key_gives_other_blocks():
    pool = random_pool("medium", world_keys("training", 8), Moving())
    one, same, other = (crossing_missions(pool, 4, 40, jax.random.key(seed)) for seed in (1, 1, 2))
    worlds = np.asarray(one.scene).reshape(40, 4)
    assert (worlds == worlds[:, :1]).all() and len(np.unique(worlds)) == 8
    for a, b, c in zip(*(jax.tree.leaves(missions) for missions in (one, same, other)), strict=True):
        assert np.array_equal(a, b) and not np.array_equal(a, c)


@pytest.mark.whole
def test_where_no_candidate_is_free_of_all_the_one_that_violates_least_is_taken_and_no_number_is_lost():
    pool = random_pool("rooms", world_keys("validation", 1), Moving())
    start, goal = sample_crossing(take_scene(pool, 0), 40, jax.random.key(0))  # there is no place for forty
    assert np.isfinite(start).all() and np.isfinite(goal).all()
    lower, upper = np.asarray(pool.volume[0])
    assert (np.asarray(start) > lower).all() and (np.asarray(goal) < upper).all()
