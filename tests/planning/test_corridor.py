"""Lengths of shortest paths for SPL: against lengths worked out by hand, and against A*."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.devices.jax_settings import use_tested_settings
from edqn_jax.planning import corridor
from edqn_jax.planning.astar import shorten_path, shortest_path
from edqn_jax.planning.corridor import shortest_lengths
from edqn_jax.planning.lattice import leg_touches
from edqn_jax.planning.path import path_length
from edqn_jax.planning.tightening import CORNERS, tighten
from edqn_jax.sim.scene.scene import Scene, stack_scenes, take_scene, with_equal_capacities
from edqn_jax.sim.worlds.families import random_pool, world_keys
from tests.support.small_worlds import RADIUS, WITHOUT_A_WAY, box, small_world

WORLDS = 10  # of each family


def lengths_in(*scenes: Scene) -> np.ndarray:
    pool = jax.tree.map(np.asarray, stack_scenes(list(scenes)))
    return shortest_lengths(pool, np.arange(len(scenes)), pool.start, pool.goal, RADIUS)


@pytest.fixture
def asked_astar(monkeypatch) -> list[Scene]:
    asked = []

    def search(scene: Scene, *rest):
        asked.append(scene)
        return shortest_path(scene, *rest)

    monkeypatch.setattr(corridor, "shortest_path", search)
    return asked


def test_in_the_open_it_is_the_straight_line():
    task = small_world(start=(1.0, 1.0, 1.0), goal=(9.0, 7.0, 3.0))
    assert lengths_in(task.scene)[0] == pytest.approx(math.sqrt(8**2 + 6**2 + 2**2), rel=1e-6)


def test_around_a_wall_it_is_the_taut_string(asked_astar):
    # Its edge is 1 m beside the straight line.
    wall = box((5.9, -1.0, -1.0), (6.1, 7.0, 7.0))
    reach = math.hypot(3.9, 1.0)
    arc = math.pi / 2 + math.atan2(1.0, 3.9) - math.acos(RADIUS / reach)
    taut = 2 * math.sqrt(reach**2 - RADIUS**2) + 2 * RADIUS * arc + 0.2
    found = lengths_in(small_world(wall).scene)[0]
    assert taut - 2e-3 <= found <= 1.01 * taut
    assert asked_astar == []


def test_straight_up_it_is_found_too(asked_astar):
    shelf = box((5.0, 4.0, 2.9), (6.3, 8.0, 3.1))
    up = small_world(shelf, start=(6.0, 6.0, 1.0), goal=(6.0, 6.0, 5.0)).scene
    assert 4.1 < lengths_in(up)[0] <= 1.01 * shortest_path(up, up.start, up.goal, RADIUS).length_m
    assert asked_astar == []


def test_around_a_long_wall_it_is_astars(asked_astar):
    scene = small_world(box((5.9, -1.0, -1.0), (6.1, 11.0, 7.0))).scene
    assert lengths_in(scene)[0] == shortest_path(scene, scene.start, scene.goal, RADIUS).length_m
    assert len(asked_astar) == 1


@pytest.mark.whole
def test_where_there_is_no_path_it_is_nan():
    inside = small_world(box((1.5, 5.5, 2.5), (2.5, 6.5, 3.5))).scene  # the start is within the block
    outside = small_world(start=(-1.0, 6.0, 3.0)).scene
    free = small_world().scene
    blocked = [task.scene for task in WITHOUT_A_WAY.values()]
    found = lengths_in(*blocked, inside, outside, free)
    np.testing.assert_array_equal(np.isnan(found), [True] * 5 + [False])


def test_missions_are_those_of_their_worlds():
    wall = small_world(box((5.9, -1.0, -1.0), (6.1, 7.0, 7.0))).scene
    pool = jax.tree.map(np.asarray, stack_scenes([small_world().scene, wall]))
    starts, goals = pool.start[[0, 0, 1]], pool.goal[[0, 0, 1]]
    starts[1], goals[1] = (2.0, 10.0, 3.0), (10.0, 10.0, 3.0)  # beside the wall
    found = shortest_lengths(pool, np.array([1, 1, 0]), starts, goals, RADIUS)
    assert found[0] > found[2] + 0.2
    assert found[2] == pytest.approx(8.0)
    assert found[1] == pytest.approx(np.linalg.norm(goals[1] - starts[1]), rel=1e-6)


def test_threads_keep_the_settings_that_were_tested():
    scenes = [small_world().scene] * 3
    jax.config.update("jax_enable_x64", True)
    try:
        with use_tested_settings():
            np.testing.assert_allclose(lengths_in(*scenes), 8.0, rtol=1e-6)
    finally:
        jax.config.update("jax_enable_x64", False)


def test_of_no_missions_there_are_no_lengths():
    pool = stack_scenes([small_world().scene])
    assert shortest_lengths(pool, np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), RADIUS).shape == (0,)


def test_a_path_is_shortened_as_astar_shortens_it():
    scene = small_world(box((5.0, -1.0, -1.0), (7.0, 8.0, 7.0))).scene
    points = np.array([[2, 6, 3], [3, 8, 3], [3, 10, 3], [5, 11, 4], [8, 11, 4], [9, 9, 3], [10, 6, 3]], np.float32)
    plain = shorten_path(points, functools.partial(leg_touches, scene, radius=RADIUS))
    padded = jnp.zeros((20, 3)).at[: len(points)].set(points)
    tight, count, length = jax.jit(tighten)(scene, padded, jnp.array(len(points)), jnp.float32(RADIUS))
    assert length == pytest.approx(path_length(plain), rel=2e-3)
    assert length < path_length(points) - 2.0
    assert 2 < count < CORNERS
    tight = np.asarray(tight)[: int(count)]
    np.testing.assert_array_equal(tight[[0, -1]], points[[0, -1]])
    assert not any(leg_touches(scene, a, b, RADIUS) for a, b in zip(tight, tight[1:], strict=False))


@pytest.mark.whole
@pytest.mark.slow
def test_in_random_worlds_it_is_at_most_2_percent_more_than_astars(asked_astar):
    keys = world_keys("test", WORLDS, 500)
    # Of equal capacities: one program for all.
    pools = with_equal_capacities([random_pool(family, keys) for family in ("medium", "rooms", "forest")])
    pool = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pools)
    found = shortest_lengths(pool, np.arange(3 * WORLDS), pool.start, pool.goal, RADIUS)
    assert asked_astar == []
    scenes = [take_scene(pool, i) for i in range(3 * WORLDS)]
    over = found / [shortest_path(scene, scene.start, scene.goal, RADIUS).length_m for scene in scenes] - 1.0
    # A* may take a longer way, since on its lattice lengths are up to an eighth too long.
    assert over.max() < 0.02
    assert over.min() > -0.06
    assert np.abs(over).mean() < 0.01
    straight = np.linalg.norm(pool.goal - pool.start, axis=1)
    assert np.all(found >= straight * (1 - 1e-6))
    assert np.count_nonzero(found > 1.01 * straight) > WORLDS  # many are no straight lines
