"""Fields of ways: as Dijkstra finds them, never through a wall, and about as long as A*'s."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.planning.astar import shortest_path
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.mjcf import load_scene, scenes_folder
from edqn_jax.sim.scene.scene import Scene, stack_scenes, take_scene
from edqn_jax.sim.worlds import geodesic
from edqn_jax.sim.worlds.families import random_pool, world_keys
from tests.oracles import geodesic_plain
from tests.support.marks import in_whole
from tests.support.meshes import CUBE, hull, mesh_world
from tests.support.small_worlds import RADIUS, WITHOUT_A_WAY, box, random_small_world, small_world

left = jax.jit(geodesic.distance_to_goal)


def one(scene: Scene) -> geodesic.Field:
    return geodesic.distance_fields(stack_scenes([scene]), RADIUS)


@pytest.mark.slow
def test_lengths_are_those_that_dijkstra_finds(monkeypatch):
    monkeypatch.setattr(geodesic, "FINEST_M", 1.0)  # the plain version takes its time
    longer = 0
    for seed in range(4):
        scene = random_small_world(seed).scene
        found = jax.tree.map(lambda leaf: np.asarray(leaf)[0], one(scene))
        is_free = found.clearance > 0.0
        grid = np.stack(np.meshgrid(*map(np.arange, is_free.shape), indexing="ij"), -1)
        apart = np.linalg.norm(found.corner + found.edge * grid - np.asarray(scene.goal), axis=-1)
        reach = np.maximum(found.clearance, float(signed_distance(scene, scene.goal)))
        seeds = np.where(is_free & (apart <= reach), apart, np.inf)
        expected = geodesic_plain.remaining(is_free, found.clearance, seeds, float(found.edge))
        np.testing.assert_array_equal(np.isfinite(found.remaining), np.isfinite(expected))
        ours, theirs = found.remaining[np.isfinite(expected)], expected[np.isfinite(expected)]
        # A round that shortens nothing by a millimetre is the last.
        np.testing.assert_allclose(ours, theirs, atol=2e-3)
        longer += (theirs > apart[np.isfinite(expected)] + 1.0).sum()
    assert longer > 50  # some ways have bends


@pytest.mark.slow
@pytest.mark.parametrize("name", ["corridor", *in_whole("courtyard", "flat", "storeys", "warehouse")])
def test_the_way_from_the_start_is_about_as_long_as_astars(name):
    scene = load_scene(scenes_folder() / "examples" / f"{name}.xml")
    way = float(left(one(scene), jnp.int32(0), scene.goal, scene.start))
    shortest = shortest_path(scene, scene.start, scene.goal, RADIUS).length_m
    # On the lattice ways are up to an eighth longer, and they may pass nearer to corners than the body.
    assert 0.97 * shortest < way < 1.15 * shortest


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize("family", ["rooms", "forest", "canyon", "dense"])
def test_worlds_of_a_pool_have_ways_of_their_own_and_none_is_shorter_than_the_straight_line(family):
    pool = random_pool(family, world_keys("validation", 3))
    fields = geodesic.distance_fields(pool, RADIUS)
    assert fields.remaining.shape == (3, *geodesic.POOL_NODES)
    for i in range(3):
        scene = take_scene(pool, i)
        way = float(left(fields, jnp.int32(i), scene.goal, scene.start))
        assert (
            np.linalg.norm(scene.goal - scene.start)
            <= way
            < 1.15 * shortest_path(scene, scene.start, scene.goal, RADIUS).length_m + float(fields.edge[i])
        )


def test_through_a_thin_wall_it_is_the_way_around():
    # A wall of 0.2 m with a gap at one side: a step through it would be 1 m.
    scene = small_world(box((5.9, -1.0, -1.0), (6.1, 10.0, 7.0))).scene
    field = one(scene)
    before, behind = (left(field, jnp.int32(0), scene.goal, jnp.array([x, 2.0, 3.0])) for x in (5.4, 6.6))
    assert before - behind > 10.0


@pytest.mark.whole
def test_through_a_thin_wall_of_a_mesh_it_is_the_way_around(tmp_path):
    # As above: of two boxes side by side, so that the mesh is not convex.
    parts = [hull(CUBE * [0.1, 4.0, 4.0] + [10, 4, 3]), hull(CUBE * [0.3, 0.5, 4.0] + [10, 1, 3])]
    mesh = np.concatenate([part[0] for part in parts]), np.concatenate([parts[0][1], parts[1][1] + 8])
    scene = load_scene(mesh_world(tmp_path, '<geom type="mesh" mesh="wall"/>', wall=mesh))
    assert scene.others["fields"].position.shape[-2] == 1
    field = one(scene)
    before, behind = (left(field, jnp.int32(0), scene.goal, jnp.array([x, 2.5, 3.0])) for x in (8.8, 11.2))
    assert before - behind > 8.0  # through it 2.4


def test_ways_do_not_jump_along_a_straight_flight():
    scene = small_world(box((5.5, -1.0, -1.0), (6.5, 9.0, 7.0)), start=(2.0, 2.0, 3.0)).scene
    field = one(scene)
    points = jnp.stack([jnp.linspace(1.0, 5.0, 400), jnp.linspace(1.5, 11.0, 400), jnp.full(400, 3.0)], axis=1)
    ways = np.asarray(jax.vmap(lambda point: left(field, jnp.int32(0), scene.goal, point))(points))
    step = float(jnp.linalg.norm(points[1] - points[0]))
    # Lattice ways are up to an eighth longer; near the wall fewer balls hold the point from one step to the next.
    assert np.abs(np.diff(ways)).max() < 3.0 * step


def test_where_there_is_no_way_it_is_the_straight_line():
    scene = WITHOUT_A_WAY["wall across"].scene
    straight = float(jnp.linalg.norm(scene.goal - scene.start))
    assert float(left(one(scene), jnp.int32(0), scene.goal, scene.start)) == pytest.approx(straight)
