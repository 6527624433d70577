"""Compares the compiled A* with the plain one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edqn_jax.planning import astar, lattice
from edqn_jax.planning.path import PlannedPath, PlanningTask
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from edqn_jax.sim.worlds.families import random_scene, world_key
from rivals.planners import astar_compiled, snn
from rivals.planners.planner import Budget
from rivals.planners.solids import solid_table
from tests.support.small_worlds import RADIUS, assert_flyable, box, random_small_world, small_world


def lattice_length(task: PlanningTask, cell: float = 0.5) -> float:
    """Returns the length of the compiled search's path, including the last leg to the goal; inf if there is no path."""
    lower, upper = np.asarray(task.scene.volume, np.float64)
    margin = lattice.edge_margin(cell, task.body_radius)
    table = solid_table(task.scene)
    limits = task.body_radius, margin, 10**9
    _, points, length, _ = astar_compiled.search(table, task.start, task.goal, lower, upper, cell, *limits)
    return length + np.linalg.norm(task.goal - points[-1]) if len(points) else np.inf


def assert_like_the_plain_one(task: PlanningTask, plan: PlannedPath, cell: float = 0.5) -> None:
    try:
        plain = astar.shortest_path(task.scene, task.start, task.goal, task.body_radius, cell)
    except astar.NoPathError:
        assert not plan.found
        assert lattice_length(task, cell) == np.inf
        return
    # Ties are broken by a billionth of the length, and the plain one stops within as much.
    assert lattice_length(task, cell) == pytest.approx(plain.grid_length_m, abs=1e-6)
    # 0.14 mm deeper in than the radius is what a stride of 2 cm may miss; the rest is float32.
    assert_flyable(task, plan.path, tolerance=2e-4)
    assert plan.length_m <= plain.grid_length_m + 1e-6
    # Of many shortest lattice paths each takes one, and they are shortened to different lengths.
    assert plan.length_m == pytest.approx(plain.length_m, rel=0.05)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), shapes=st.integers(0, 7))
def test_in_random_small_worlds_the_lattice_path_is_as_short_as_the_plain_ones(seed, shapes):
    task = random_small_world(seed, shapes)
    assert_like_the_plain_one(task, astar_compiled.plan(task))


@pytest.mark.slow
@pytest.mark.parametrize("world", ["paper", "medium 0", "medium 1", "dense 0"])
def test_in_large_worlds_too(world):
    name, *index = world.split()
    scene = random_scene(name, world_key("test", int(index[0]))) if index else load_scene(resolve_world(name))
    task = PlanningTask.from_scene(scene, body_radius=RADIUS)
    assert_like_the_plain_one(task, astar_compiled.plan(task))


@pytest.mark.parametrize("seed", range(4))
def test_the_coarse_one_searches_a_lattice_of_a_metre(seed):
    task = random_small_world(seed)
    coarse, fine = astar_compiled.plan_coarse(task), astar_compiled.plan(task)
    assert_like_the_plain_one(task, coarse, cell=1.0)
    assert 0 < coarse.steps < fine.steps


def test_no_other_planner_of_lattices_is_shorter():
    task = small_world(box((5, 0, 0), (6, 9, 6)))
    assert astar_compiled.plan(task).length_m <= snn.plan(task).length_m


def test_ends_between_cells_are_met():
    task = small_world(start=(2.13, 6.0, 3.0), goal=(9.87, 6.4, 3.3))
    path = astar_compiled.plan(task).path
    assert path is not None
    np.testing.assert_allclose(path, [task.start, task.goal])


def test_the_budget_ends_the_search():
    plan = astar_compiled.plan(random_small_world(3), Budget(steps=5))
    assert plan.reason == "no path: the goal was not reached within 5 cells"
    assert plan.steps == 5
