"""A* against lengths worked out by hand and against plain Dijkstra."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import jax
import numpy as np
import pytest

from edqn_jax.devices import cache
from edqn_jax.errors import ConfigError
from edqn_jax.planning import astar
from edqn_jax.planning.astar import main, shortest_path
from edqn_jax.planning.lattice import NoPathError
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Scene, Shape, Spheres, UprightBoxes, UprightCylinders, build_scene
from tests.oracles import dijkstra
from tests.support.small_worlds import box

RADIUS = 0.36
GREY = np.full(3, 0.5)
CAPACITIES = {"boxes": 6, "cylinders": 2, "spheres": 2}  # the same in every test: one compilation


def small_world(*shapes, size=(10.0, 10.0, 4.0)) -> Scene:
    return build_scene(shapes, volume=[(0, 0, 0), size], start=[0, 0, 0], goal=size, capacities=CAPACITIES)


def test_in_the_open_the_path_is_the_straight_line():
    path = shortest_path(small_world(), np.array([1.0, 1, 1]), np.array([9.0, 7.0, 3.0]), RADIUS)
    # 16 x 12 x 4 cells: 4 space diagonals, 8 plane diagonals, 4 straight steps.
    assert path.grid_length_m == pytest.approx(0.5 * (4 * math.sqrt(3) + 8 * math.sqrt(2) + 4))
    assert path.length_m == pytest.approx(math.sqrt(8**2 + 6**2 + 2**2), rel=1e-6)
    np.testing.assert_allclose(path.points, [[1, 1, 1], [9, 7, 3]])


def test_around_a_wall_it_is_the_taut_string():
    wall = box((4.9, 0, 0), (5.1, 7, 4))
    path = shortest_path(small_world(wall), np.array([2.0, 5, 2]), np.array([8.0, 5, 2]), RADIUS)
    # Two tangents to the circle of the body's radius around the wall's edge, two arcs, the wall's thickness.
    reach = math.hypot(2.9, 2.0)
    arc = math.pi / 2 + math.atan2(2.0, 2.9) - math.acos(RADIUS / reach)
    taut = 2 * math.sqrt(reach**2 - RADIUS**2) + 2 * RADIUS * arc + 0.2
    assert path.length_m >= taut - 2e-3  # two edges may be cut by 0.14 mm of depth each, centimetres along
    assert path.length_m <= 1.02 * taut  # corners are cut until a round gains less than 1 cm
    assert path.length_m <= path.grid_length_m


@pytest.mark.slow
def test_every_point_of_the_path_is_free():
    scene = small_world(box((4, 0, 0), (6, 6, 4)), box((7, 4, 0), (8, 10, 3)), box((2, 3, 0), (3, 10, 4)))
    path = shortest_path(scene, np.array([1.0, 9, 1]), np.array([9.0, 9, 1]), RADIUS)
    distance = jax.jit(jax.vmap(lambda point: signed_distance(scene, point)))
    legs = [a + np.linspace(0, 1, 2000)[:, None] * (b - a) for a, b in itertools.pairwise(path.points)]
    # The check walks 2 cm at a time past what it hugs: 0.14 mm, and float32.
    assert distance(np.concatenate(legs).astype(np.float32)).min() > RADIUS - 2e-4
    np.testing.assert_allclose(path.points[[0, -1]], [[1, 9, 1], [9, 9, 1]])


@pytest.mark.parametrize("seed", range(16))
@pytest.mark.slow
def test_the_grid_path_is_as_short_as_dijkstras(seed):
    rng = np.random.default_rng(seed)
    size, cell = np.array([5.0, 5.0, 3.0]), 0.5
    shapes: list[Shape] = []
    shapes += [
        UprightBoxes(position=rng.uniform(1, size - 1), half=rng.uniform(0.2, 1, 3), yaw=rng.uniform(0, 3), albedo=GREY)
        for _ in range(5)
    ]
    shapes.append(Spheres(position=rng.uniform(1, size - 1), radius=0.7, albedo=GREY))
    shapes.append(UprightCylinders(position=size / 2, radius=0.1, half_height=1.5, albedo=GREY))
    scene = small_world(*shapes, size=size)
    expected = dijkstra.shortest_length(scene, (0, 0, 1), (10, 10, 5), RADIUS, cell)
    start, goal = np.array([0, 0, 0.5]), np.array([5.0, 5.0, 2.5])
    if math.isinf(expected):
        with pytest.raises(NoPathError):
            shortest_path(scene, start, goal, RADIUS, cell)
        return
    path = shortest_path(scene, start, goal, RADIUS, cell)
    assert path.grid_length_m == pytest.approx(expected, abs=1e-6)
    assert path.length_m <= path.grid_length_m + 1e-6


def test_a_goal_between_cells_is_reached_exactly():
    path = shortest_path(small_world(), np.array([1.0, 1, 1]), np.array([8.73, 6.11, 2.9]), RADIUS)
    np.testing.assert_allclose(path.points[-1], [8.73, 6.11, 2.9])
    assert path.length_m == pytest.approx(np.linalg.norm([7.73, 5.11, 1.9]), rel=1e-6)


def test_a_wall_across_leaves_no_path():
    wall = box((4.9, 0, 0), (5.1, 10, 4))
    with pytest.raises(NoPathError, match="every path is blocked") as raised:
        shortest_path(small_world(wall), np.array([2.0, 5, 2]), np.array([8.0, 5, 2]), RADIUS)
    assert isinstance(raised.value, ConfigError)


def test_a_door_is_passed_only_by_what_fits():
    door = [box((4.9, 0, 0), (5.1, 4.5, 4)), box((4.9, 5.5, 0), (5.1, 10, 4))]
    start, goal = np.array([2.0, 5, 2]), np.array([8.0, 5, 2])
    assert shortest_path(small_world(*door), start, goal, 0.45).length_m == pytest.approx(6.0, rel=1e-6)
    with pytest.raises(NoPathError):
        shortest_path(small_world(*door), start, goal, 0.55)


@pytest.mark.parametrize(("start", "said"), [([5.0, 5, 2], "does not fit"), ([-1.0, 5, 2], "outside")])
def test_a_bad_start_says_so(start, said):
    scene = small_world(box((4, 4, 0), (6, 6, 4)))
    with pytest.raises(NoPathError, match=said):
        shortest_path(scene, np.array(start), np.array([8.0, 5, 2]), RADIUS)


@pytest.mark.slow
def test_it_runs_alone(capsys, tmp_path):
    world = tmp_path / "small.xml"
    world.write_text(
        '<mujoco><worldbody><site name="start" pos="1 1 1"/><site name="goal" pos="9 1 1"/>'
        '<geom name="post" type="box" size="0.5 0.5 2" pos="5 1 2"/></worldbody></mujoco>'
    )
    assert main(["--world", str(world)]) == 0
    assert "straight line          8.00 m" in capsys.readouterr().out
    assert main(["--world", "nowhere"]) == 2
    assert "there is no scene 'nowhere'" in capsys.readouterr().err


def test_a_command_finds_the_path_that_an_earlier_one_has_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ends = {"start": np.ones(3), "goal": np.array([9.0, 9, 3])}
    worlds = [dataclasses.replace(small_world(box((x, 3, 0), (x + 1, 7, 3))), **ends) for x in (4.0, 6.0)]
    found = [astar.kept_shortest_path(world, RADIUS) for world in worlds]
    assert found[0].length_m != found[1].length_m
    monkeypatch.setattr(cache, "_enabled", [tmp_path])
    kept = [astar.kept_shortest_path(world, RADIUS) for world in worlds]
    assert len(list(tmp_path.glob("path-*"))) == 2
    monkeypatch.setattr(astar, "shortest_path", None)
    again = [astar.kept_shortest_path(world, RADIUS) for world in worlds]
    for paths in zip(found, kept, again, strict=True):
        for other in paths[1:]:
            np.testing.assert_array_equal(paths[0].points, other.points)
            assert (paths[0].length_m, paths[0].grid_length_m) == (other.length_m, other.grid_length_m)
