"""Missions between random free points."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from edqn_jax.sim.scene.scene import Spheres, build_scene, stack_scenes
from edqn_jax.sim.task.missions import AWAY, random_missions, spread_missions
from edqn_jax.sim.worlds.families import random_pool, world_keys
from edqn_jax.sim.worlds.free_points import CLEARANCE, FAR, TRIES, first_free, scatter_points
from tests.support.drawn_scenes import clearances

WORLDS, MISSIONS = 24, 512


@pytest.fixture(scope="module")
def paper():
    return stack_scenes([load_scene(resolve_world("paper"))])


@pytest.mark.slow
def test_random_missions_fly_far_between_free_points_of_every_world():
    pool = random_pool("dense", world_keys("validation", WORLDS))
    missions = random_missions(pool, MISSIONS, jax.random.key(0))
    assert missions.scene.dtype == jnp.int32 and set(np.asarray(missions.scene)) == set(range(WORLDS))
    assert (np.linalg.norm(missions.start - missions.goal, axis=1) >= FAR).all()
    for points in (missions.start, missions.goal):
        assert (clearances(pool, missions, points) >= CLEARANCE).all()
        assert (points[:, 2] >= 1.5).all() and (points[:, 2] <= 20.0).all()


@pytest.mark.slow
def test_missions_to_the_worlds_own_goals_begin_as_far_from_them():
    pool = random_pool("rooms", world_keys("validation", WORLDS))
    missions = random_missions(pool, MISSIONS, jax.random.key(0), own_goals=True)
    np.testing.assert_array_equal(missions.goal, np.asarray(pool.goal)[np.asarray(missions.scene)])
    assert (clearances(pool, missions, missions.start) >= CLEARANCE).all()
    far = np.linalg.norm(missions.start - missions.goal, axis=1) >= 18.0
    # Three in 100,000 find no free point that far.
    assert far.all()


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
    points = scatter_points(scene, jax.random.uniform(jax.random.key(0), (TRIES, 3)))
    point = first_free(scene, points, 3.0)
    assert signed_distance(scene, point) > -0.5
