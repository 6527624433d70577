"""Properties of every planner that knows the map."""

from __future__ import annotations

import numpy as np
import pytest

from edqn_jax.planning.path import PlanningTask
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from edqn_jax.sim.worlds.families import random_scene, world_key
from rivals.planners.planner import PLANNERS, Budget, load_planner
from tests.support.small_worlds import RADIUS, WITHOUT_A_WAY, assert_flyable, random_small_world, small_world

# A* hugs what it passes: its legs are checked every 2 cm, which misses 0.14 mm, and the judge is float32.
TOLERANCE = {"A*": 2e-4, "A* 1 m": 2e-4}
BUDGET = Budget(seconds=1.0)


def assert_path_is_free(name: str, task: PlanningTask, samples: int) -> None:
    plan = load_planner(name)(task, Budget(seconds=600.0, steps=samples if name in ("RRT*", "BIT*") else None))
    if name == "APF" and not plan.found:
        assert "local minimum" in plan.reason or "drives the drone into" in plan.reason
        return
    assert_flyable(task, plan.path, TOLERANCE.get(name, 0.0))
    assert plan.reason == ""


@pytest.mark.parametrize("world", WITHOUT_A_WAY)
@pytest.mark.parametrize("name", PLANNERS)
def test_without_a_way_it_says_no_path(name, world):
    plan = load_planner(name)(WITHOUT_A_WAY[world], BUDGET)
    assert not plan.found and plan.path is None
    assert plan.reason.startswith("no path: ")
    assert np.isnan(plan.length_m) and np.isnan(plan.first_seconds)


@pytest.mark.parametrize("name", PLANNERS)
def test_a_goal_in_a_wall_is_no_path(name):
    plan = load_planner(name)(small_world(goal=(10.0, 6.0, 0.1)), BUDGET)
    assert plan.reason == "no path: a sphere of 0.36 m does not fit at the goal (10, 6, 0.1)"


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", PLANNERS)
def test_every_path_in_a_small_world_is_free(name, seed):
    task = random_small_world(seed)
    assert_path_is_free(name, task, samples=2000)


@pytest.mark.slow
@pytest.mark.parametrize("world", ["paper", "medium 0", "medium 1", "dense 0"])
@pytest.mark.parametrize("name", PLANNERS)
def test_every_path_in_a_large_world_is_free(name, world):
    kind, *index = world.split()
    scene = random_scene(kind, world_key("test", int(index[0]))) if index else load_scene(resolve_world(kind))
    task = PlanningTask.from_scene(scene, body_radius=RADIUS)
    assert_path_is_free(name, task, samples=4000)
