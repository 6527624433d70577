"""The widest way: as wide as the gap that it leads through, free along its whole length, and none through a wall."""

from __future__ import annotations

import numpy as np
import pytest

from edqn_jax.planning.astar import shortest_path
from edqn_jax.planning.lattice import NoPathError
from edqn_jax.planning.widest import find_widest_way, is_roomy
from edqn_jax.sim.scene.scene import Shape
from tests.support.small_worlds import (
    RADIUS,
    WITHOUT_A_WAY,
    assert_flyable,
    box,
    random_small_world,
    small_world,
    true_distances,
)


def wall(*doors: tuple[float, float], thick: float = 0.2) -> list[Shape]:
    """A wall across the volume, with doors from and to these y, metres, as high as the volume."""
    ends = [0.0, *(end for door in doors for end in door), 12.0]
    low, high = 6 - thick / 2, 6 + thick / 2
    return [box((low, a, 0), (high, b, 6)) for a, b in zip(ends[::2], ends[1::2], strict=True)]


@pytest.mark.parametrize(
    "door", [(5.5, 6.5), (5.24, 6.26), (5.13, 6.6), (2.0, 4.4)], ids=["on cells", "between", "askew", "aside"]
)
def test_the_tightest_place_of_a_way_through_a_door_is_half_as_wide_as_the_door(door: tuple[float, float]) -> None:
    task = small_world(*wall(door))
    way = find_widest_way(task.scene, RADIUS)
    assert way is not None and way.fits
    assert way.clearance_m == pytest.approx((door[1] - door[0]) / 2, abs=0.01)
    assert way.points[way.tightest][:2] == pytest.approx([6.0, sum(door) / 2], abs=0.15)
    assert_flyable(task, way.points)


def test_a_way_takes_the_wider_of_two_doors_though_it_is_the_longer() -> None:
    way = find_widest_way(small_world(*wall((1.0, 2.6), (5.5, 6.5))).scene, RADIUS)
    assert way is not None and way.clearance_m == pytest.approx(0.8, abs=0.01)
    assert way.length_m > 10.0


def test_the_clearance_is_that_of_each_point() -> None:
    scene = small_world(*wall((5.0, 6.5))).scene
    way = find_widest_way(scene, RADIUS)
    assert way is not None
    np.testing.assert_allclose(way.clearance, true_distances(scene, way.points), atol=1e-5)
    assert np.linalg.norm(np.diff(way.points, axis=0), axis=1).max() <= 0.0201


def test_a_start_on_the_ground_is_not_the_tightest_place() -> None:
    way = find_widest_way(small_world(*wall((5.4, 6.6)), start=(2.0, 6.0, 0.4)).scene, RADIUS)
    assert way is not None and way.clearance[0] == pytest.approx(0.4, abs=1e-5)
    assert way.clearance_m == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize("name", WITHOUT_A_WAY)
def test_there_is_no_way_out_of_what_is_closed(name: str) -> None:
    assert find_widest_way(WITHOUT_A_WAY[name].scene, RADIUS) is None


def test_no_way_leads_through_a_wall_that_is_thinner_than_a_cell() -> None:
    assert find_widest_way(small_world(*wall(thick=0.01)).scene, RADIUS) is None


def test_a_door_that_is_narrower_than_the_body_is_measured_and_does_not_fit() -> None:
    way = find_widest_way(small_world(*wall((5.7, 6.3))).scene, RADIUS)
    assert way is not None and not way.fits
    assert way.clearance_m == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("seed", range(6))
def test_a_way_fits_where_astar_finds_one(seed: int) -> None:
    task = random_small_world(seed)
    try:
        shortest_path(task.scene, task.start, task.goal, RADIUS)
        exists = True
    except NoPathError:
        exists = False
    way = find_widest_way(task.scene, RADIUS)
    assert (way is not None and way.fits) == exists
    if way is not None and way.fits:
        assert_flyable(task, way.points)


def test_coarse_cells_tell_a_roomy_way_from_a_tight_one() -> None:
    assert is_roomy(small_world().scene, RADIUS, 1.0)
    assert not is_roomy(small_world(*wall((5.2, 6.8))).scene, RADIUS, 1.0)
