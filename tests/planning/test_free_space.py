"""From where there is a way to the goal: as A* finds, cell by cell."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from edqn_jax.devices import cache
from edqn_jax.errors import ConfigError
from edqn_jax.planning import free_space, widest
from edqn_jax.planning.astar import shortest_path
from edqn_jax.planning.free_space import find_reachable, kept_reachable
from edqn_jax.planning.lattice import NoPathError
from edqn_jax.planning.widest import is_roomy
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from edqn_jax.sim.scene.scene import Shape, stack_scenes
from edqn_jax.sim.task.missions import spread_missions
from edqn_jax.sim.worlds.free_points import cells_of
from tests.support.small_worlds import RADIUS, SIZE, box, enclosure, small_world

GOAL = np.array([10.0, 6.0, 3.0])


def wall(gap: float) -> list[Shape]:
    """A wall across the volume with a door of this width, as high."""
    low, high = 6.0 - gap / 2, 6.0 + gap / 2
    sides = [box((5.9, 0, 0), (6.1, low, 6)), box((5.9, high, 0), (6.1, 12, 6))]
    return [*sides, box((5.9, low, 3.0 + gap / 2), (6.1, high, 6)), box((5.9, low, 0), (6.1, high, 3.0 - gap / 2))]


def a_path(scene, start: np.ndarray) -> bool:
    try:
        shortest_path(scene, start, GOAL, RADIUS)
    except NoPathError:
        return False
    return True


@pytest.mark.parametrize(
    ("shapes", "closed"),
    [
        pytest.param([], False, id="open", marks=pytest.mark.whole),
        pytest.param(enclosure((3.0, 3.0, 3.0)), True, id="closed room"),
        pytest.param(wall(0.6), True, id="too narrow", marks=pytest.mark.whole),
        pytest.param(wall(0.8), False, id="just wide enough", marks=pytest.mark.whole),
        pytest.param(wall(1.5), False, id="wide", marks=pytest.mark.whole),
        pytest.param([*wall(1.0), *enclosure((9.0, 2.5, 3.0))[:4]], False, id="door and tunnel"),
    ],
)
def test_there_is_a_way_from_where_astar_finds_one(shapes: list[Shape], closed: bool) -> None:
    scene = small_world(*shapes, goal=tuple(GOAL)).scene
    found = find_reachable(scene, RADIUS, 0.5)
    draw = np.random.default_rng(0)
    free = 0
    for _ in range(60):
        index = draw.integers(0, found.is_way.shape)
        point = found.corner + found.edge_m * index
        try:
            way = a_path(scene, point)
        except ConfigError:
            way = False
        assert found.is_way[tuple(index)] == way, point
        free += way
    assert free > 10
    assert (found.lost > 0.0) == closed


def test_what_is_open_is_seen_on_a_coarse_lattice() -> None:
    assert find_reachable(small_world(goal=tuple(GOAL)).scene, RADIUS).edge_m == 1.0
    closed = small_world(*wall(0.6), start=(8.0, 6.0, 3.0), goal=tuple(GOAL)).scene
    assert find_reachable(closed, RADIUS).edge_m == 0.5


def test_the_papers_world_is_open() -> None:
    found = find_reachable(load_scene(resolve_world("paper")), RADIUS)
    assert (found.edge_m, found.lost) == (1.0, 0.0)


def test_a_door_between_the_cells_is_found_with_finer_ones() -> None:
    low, high = 5.24, 6.26  # a metre, and no middle of half-metre cells is further than the radius from both sides
    sides = [box((5.9, 0, 0), (6.1, low, 6)), box((5.9, high, 0), (6.1, 12, 6))]
    scene = small_world(*sides, start=(2.0, 6.0, 3.0), goal=(10.0, 6.0, 3.0)).scene
    start, goal = np.asarray(scene.start), np.asarray(scene.goal)
    for cell in (0.5, None):
        with pytest.raises(NoPathError) if cell else contextlib.nullcontext():
            assert shortest_path(scene, start, goal, RADIUS, cell).length_m == pytest.approx(8.0, abs=0.1)
    found = find_reachable(scene, RADIUS)
    assert (found.edge_m, found.lost) == (0.25, 0.0)


def test_a_goal_in_a_wall_and_a_volume_without_end_are_refused() -> None:
    scene = small_world(box((9.5, 5.5, 2.5), (10.5, 6.5, 3.5)), goal=tuple(GOAL)).scene
    with pytest.raises(NoPathError, match=r"does not fit at the goal \(10, 6, 3\)"):
        find_reachable(scene, RADIUS)
    huge = dataclasses.replace(scene, volume=np.array([(0.0, 0.0, 0.0), (500.0, 500.0, 400.0)], np.float32))
    with pytest.raises(ConfigError, match="volume of 500 x 500 x 400 m has 10. million cells of 1 m"):
        find_reachable(huge, RADIUS)


@pytest.mark.parametrize("own", [0.0, 1.0])
def test_missions_begin_where_there_is_a_way(own: float) -> None:
    """Behind the wall is more than half of the volume; the own start is beside it, on the goal's side."""
    scene = small_world(*wall(0.6), start=(6.8, 6.0, 3.0), goal=tuple(GOAL)).scene
    found = find_reachable(scene, RADIUS)
    cells = cells_of(scene, found.is_way, found.corner, found.edge_m)
    missions = spread_missions(stack_scenes([scene]), 256, own, 3.0, jax.random.key(0), cells)
    starts = np.asarray(missions.start)
    assert starts[:, 0].min() > 6.1 and (starts > 0).all() and (starts < SIZE).all()
    # All over what is open: not at the middles of cells, and with the clearance that there is.
    assert np.ptp(starts, axis=0).min() > 2.0 and len(np.unique(starts[:, 0])) > 200
    everywhere = spread_missions(stack_scenes([scene]), 256, own, 3.0, jax.random.key(0))
    assert np.asarray(everywhere.start)[:, 0].min() < 5.9


def test_what_a_command_has_searched_the_next_one_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "_enabled", [tmp_path])
    scene = small_world(*enclosure((4.0, 4.0, 3.0)), goal=tuple(GOAL)).scene
    first, roomy = kept_reachable(scene, RADIUS), is_roomy(scene, RADIUS, 0.5)
    plain = find_reachable(scene, RADIUS)
    for name in ("is_way", "corner", "edge_m", "lost"):
        np.testing.assert_array_equal(getattr(first, name), getattr(plain, name))
    assert first.lost > 0
    monkeypatch.setattr(free_space, "find_reachable", None)
    monkeypatch.setattr(widest, "_open_lattice", None)
    again = kept_reachable(scene, RADIUS)
    assert again.is_way.dtype == bool and is_roomy(scene, RADIUS, 0.5) == roomy
    assert is_roomy(scene, RADIUS, -1.0) and not is_roomy(scene, RADIUS, 100.0)  # the width is kept, not the answer
    for name in ("is_way", "corner", "edge_m", "lost"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for other in ((scene, RADIUS / 2), (small_world(goal=tuple(GOAL)).scene, RADIUS)):
        with pytest.raises(TypeError):  # of another body, and in another world, it is searched anew
            kept_reachable(*other)
