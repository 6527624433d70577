"""Compares the compiled distances with those of `sim.scene`, for every kind of shape."""

# pyright: reportArgumentType=false

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.sim.scene.distance import shape_distances
from edqn_jax.sim.scene.scene import PARKED, scene_shapes
from rivals.planners.solids import distance, leg_free, shape_distance, solid_table
from tests.support.drawn_scenes import ball, every_kind, scene_of
from tests.support.small_worlds import box, small_world, true_distances


@pytest.mark.parametrize("seed", range(4))
def test_distances_are_the_scenes(seed):
    rng = np.random.default_rng(seed)
    scene = every_kind(rng)
    table = solid_table(scene)
    assert len(table) == len(scene_shapes(scene)) == 25
    points = rng.uniform((-5, -5, -2), (65, 65, 30), (2000, 3))
    # Half of them near or inside a shape.
    points[::2] = table[rng.integers(0, 24, 1000), 2:5] + rng.normal(0, 2, (1000, 3))
    compiled = [distance(table, *point) for point in points]
    # The scene's are float32: 1e-5 at 60 m, and a little more where differences cancel.
    np.testing.assert_allclose(compiled, true_distances(scene, points), atol=1e-4)


def test_each_shape_has_its_own_distance():
    scene = every_kind(np.random.default_rng(9))
    rows = iter(solid_table(scene))
    for point in ([3.0, 50.0, 7.0], [30.0, 30.0, 1.0]):
        rows = iter(solid_table(scene))
        for values in shape_distances(scene, jnp.array(point)).values():
            for expected, row in zip(np.asarray(values), itertools.islice(rows, len(values)), strict=True):
                assert shape_distance(row, *point) == pytest.approx(float(expected), abs=1e-4)


def test_parked_places_and_empty_scenes_are_far_away():
    assert distance(solid_table(scene_of()), 1.0, 2.0, 3.0) == PARKED
    table = solid_table(scene_of(ball(10, 10, 10, 1), spheres=5, boxes=3, planes=1))
    assert len(table) == 1
    assert distance(table, 10.0, 10.0, 14.0) == pytest.approx(3.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_leg_is_free_if_every_point_of_it_is(seed):
    rng = np.random.default_rng(seed)
    scene = every_kind(rng)
    table = solid_table(scene)
    starts, ends = rng.uniform((0, 0, 0), (60, 60, 20), (2, 300, 3))
    ends[::2] = starts[::2] + rng.normal(0, 1, (150, 3))
    share = np.linspace(0, 1, 2001)[:, None]
    least = np.array([true_distances(scene, a + share * (b - a)).min() for a, b in zip(starts, ends, strict=True)])
    free = np.array([leg_free(table, a, b, 0.36) for a, b in zip(starts, ends, strict=True)])
    # Strides of 2 cm miss 0.14 mm; 2001 points miss 1 mm on the longest legs.
    assert free[least > 0.36 + 1e-3].all()
    assert not free[least < 0.36 - 2e-4].any()
    assert 30 < free.sum() < 270


def test_a_leg_without_length_is_its_point():
    table = solid_table(small_world(box((4, 4, 0), (6, 6, 3))).scene)
    point = np.array([6.5, 5.0, 1.0])
    assert leg_free(table, point, point, 0.49)
    assert not leg_free(table, point, point, 0.51)
