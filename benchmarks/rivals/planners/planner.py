"""The interface of planners that know the map, and the planners by name.

plan = load_planner("A*")(Task.of(scene, body_radius=0.36), Budget(), seed=0)
"""

from __future__ import annotations

import dataclasses
import importlib
from typing import Protocol

import jax
import numpy as np

from edqn_jax.planning.path import MARGIN, PlannedPath, PlanningTask, point_text
from edqn_jax.sim.scene.distance import signed_distance


@dataclasses.dataclass(frozen=True)
class Budget:
    """When a planner stops. Each module defines its step; only sampling planners use `seconds`."""

    seconds: float = 5.0
    steps: int | None = None
    """None for the planner's own limit."""


class Planner(Protocol):
    """Returns a plan for a task. Only planners that sample use the seed."""

    def __call__(self, task: PlanningTask, budget: Budget = ..., seed: int = ...) -> PlannedPath: ...


PLANNERS = {
    "SNN": "snn.plan",
    "A*": "astar_compiled.plan",
    "A* 1 m": "astar_compiled.plan_coarse",
    "RRT*": "sampling.rrt_star",
    "RRT* first path": "sampling.rrt_star_first",
    "BIT*": "sampling.bit_star",
    "BIT* first path": "sampling.bit_star_first",
    "APF": "potential_field.plan",
}
"""Module and function within `rivals.planners` by name."""

IMPROVING = "RRT*", "BIT*"
"""Planners that go on after their first path until the budget is used up."""

SAMPLING = (*IMPROVING, "RRT* first path", "BIT* first path")
"""Planners that sample at random, so that the path depends on the seed."""


def refusal(task: PlanningTask) -> str | None:
    """Returns why there cannot be a path if start or goal is outside the volume or not free, else None."""
    lower, upper = np.asarray(task.scene.volume, np.float64)
    for role, point in (("start", task.start), ("goal", task.goal)):
        if not np.all((point >= lower) & (point <= upper)):
            return f"the {role} {point_text(point)} lies outside the flight volume"
        if _distance(task.scene, np.float32(point)) < task.body_radius + MARGIN:
            return f"a sphere of {task.body_radius:g} m does not fit at the {role} {point_text(point)}"
    return None


def load_planner(name: str) -> Planner:
    """Returns the planner of that name.

    Raises:
        KeyError: if there is no such planner.
        MissingPackageError: if a package of the extra `bench` that it needs is not installed.
    """
    module, function = PLANNERS[name].split(".")
    return getattr(importlib.import_module(f"rivals.planners.{module}"), function)


_distance = jax.jit(signed_distance)
