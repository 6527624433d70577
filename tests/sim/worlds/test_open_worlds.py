"""Open worlds: sparse, medium and dense."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from edqn_jax.sim.scene.scene import PARKED, Planes, UprightBoxes, obstacle_count, scene_shapes, take_scene
from edqn_jax.sim.worlds.families import random_pool, world_keys
from edqn_jax.sim.worlds.open_worlds import GAP, HALF_WIDTHS, SHAPES, SIZE

WORLDS = 24


@pytest.fixture(scope="module")
def pools():
    return {density: random_pool(density, world_keys("validation", WORLDS)) for density in SHAPES}


def footprint(shape) -> tuple[float, float, float]:
    """Middle and radius of the circle around a shape seen from above."""
    reach = np.hypot(*shape.half[:2]) if isinstance(shape, UprightBoxes) else shape.radius
    return float(shape.position[0]), float(shape.position[1]), float(reach)


@pytest.mark.whole
@pytest.mark.parametrize(("density", "least", "most"), [("sparse", 12, 12), ("medium", 28, 30), ("dense", 54, 60)])
@pytest.mark.slow
def test_a_density_has_its_number_of_shapes_and_their_widths(pools, density, least, most):
    for i in range(WORLDS):
        scene = take_scene(pools[density], i)
        assert least <= obstacle_count(scene) <= most
        widths = np.asarray(scene.boxes.half)[np.asarray(scene.boxes.position[:, 2]) < PARKED / 2, :2]
        narrow, wide = HALF_WIDTHS[density]
        assert widths.min() >= narrow and widths.max() <= wide


@pytest.mark.parametrize("density", SHAPES)
def test_footprints_keep_their_gap_so_that_free_space_is_connected(pools, density):
    for i in range(WORLDS):
        shapes = [s for s in scene_shapes(take_scene(pools[density], i)) if not isinstance(s, Planes)]
        discs = [footprint(shape) for shape in shapes]
        for (x, y, r), (u, v, s) in itertools.combinations(discs, 2):
            assert np.hypot(x - u, y - v) - r - s > GAP - 1e-3
        for x, y, r in discs:
            assert min(x, y, SIZE[0] - x, SIZE[1] - y) - r > GAP - 1e-3


@pytest.mark.parametrize("density", SHAPES)
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
