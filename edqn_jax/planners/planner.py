"""The interface of planners that know the map, and the planners by name.

plan = load_planner("A*")(Task.of(scene, body_radius=0.36), Budget(), seed=0)
"""

from __future__ import annotations

import dataclasses
import importlib
from typing import Protocol

import jax
import numpy as np
import numpy.typing as npt

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Scene

MARGIN = 1e-3
"""Metres of clearance beyond the body, so that neither sampling nor float32 of a check finds a contact."""


@dataclasses.dataclass(frozen=True)
class Task:
    """Find a path for a sphere through a known world; its centre stays within the scene's flight volume."""

    scene: Scene
    start: np.ndarray  # [3] metres
    goal: np.ndarray  # [3] metres
    body_radius: float
    """Radius of the sphere, metres."""
    goal_radius: float
    """Metres. A planner that need not end at the goal itself may end this near, if the straight line there is free."""

    @classmethod
    def of(cls, scene: Scene, *, body_radius: float, goal_radius: float = 2.0) -> Task:
        """Returns the task from the scene's own start to its goal; radii in metres."""
        start, goal = (np.asarray(point, np.float64) for point in (scene.start, scene.goal))
        return cls(scene, start, goal, body_radius, goal_radius)


@dataclasses.dataclass(frozen=True)
class Budget:
    """When a planner stops. Each module defines its step; only sampling planners use `seconds`."""

    seconds: float = 5.0
    steps: int | None = None
    """None for the planner's own limit."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """The result of a planner. Seconds are of wall time, with reading the map and without compilation."""

    path: np.ndarray | None
    """[N, 3] metres from start to goal, straight between the points; None if no path was found."""
    reason: str
    """Why there is no path, a sentence that begins with "no path"; empty if there is a path."""
    seconds: float
    steps: int
    """Steps used."""
    first_seconds: float
    """Time to the first path; equals `seconds` for planners that find only one. NaN without a path."""
    first_length_m: float
    """Length of the first path. NaN without a path."""

    @property
    def found(self) -> bool:
        """Returns whether there is a path."""
        return self.path is not None

    @property
    def length_m(self) -> float:
        """Returns the length of the path in metres, NaN without a path."""
        return float("nan") if self.path is None else path_length(self.path)


class Planner(Protocol):
    """Returns a plan for a task. Only planners that sample use the seed."""

    def __call__(self, task: Task, budget: Budget = ..., seed: int = ...) -> Plan: ...


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
"""Module and function within `edqn_jax.planners` by name."""

IMPROVING = "RRT*", "BIT*"
"""Planners that go on after their first path until the budget is used up."""

SAMPLING = (*IMPROVING, "RRT* first path", "BIT* first path")
"""Planners that sample at random, so that the path depends on the seed."""


def load_planner(name: str) -> Planner:
    """Returns the planner of that name.

    Raises:
        KeyError: if there is no such planner.
        MissingPackageError: if a package of the extra `bench` that it needs is not installed.
    """
    module, function = PLANNERS[name].split(".")
    return getattr(importlib.import_module(f"edqn_jax.planners.{module}"), function)


def plan(
    scene: Scene,
    planner: str = "SNN",
    *,
    body_radius: float = 0.36,
    budget: Budget = Budget(),
    seed: int = 0,
) -> Plan:
    """Plans a path from a world's start to its goal with a planner that is given the whole map.

    Args:
        scene: one world, such as `Environment.scene` returns.
        planner: a name of `PLANNERS`, such as `SNN`, `A*` or `RRT*`.
        body_radius: of the sphere that must touch nothing, metres.
        budget: when the planner stops.
        seed: of planners that sample.

    Raises:
        ConfigError: if there is no such planner.
        MissingPackageError: if a package of the extra `bench` that it needs is not installed.
    """
    if planner not in PLANNERS:
        raise ConfigError(f"there is no planner '{planner}'; there are {', '.join(PLANNERS)}")
    return load_planner(planner)(Task.of(scene, body_radius=body_radius), budget, seed)


def found(path: npt.ArrayLike, seconds: float, steps: int) -> Plan:
    """Returns the plan of a planner that finds only one path [n, 3] metres."""
    path = np.asarray(path, np.float64)
    return Plan(path, "", seconds, steps, seconds, path_length(path))


def not_found(why: str, seconds: float = 0.0, steps: int = 0) -> Plan:
    """Returns a plan without a path; `why` follows "no path: "."""
    return Plan(None, f"no path: {why}", seconds, steps, float("nan"), float("nan"))


def refusal(task: Task) -> str | None:
    """Returns why there cannot be a path if start or goal is outside the volume or not free, else None."""
    lower, upper = np.asarray(task.scene.volume, np.float64)
    for role, point in (("start", task.start), ("goal", task.goal)):
        if not np.all((point >= lower) & (point <= upper)):
            return f"the {role} {point_text(point)} lies outside the flight volume"
        if _distance(task.scene, np.float32(point)) < task.body_radius + MARGIN:
            return f"a sphere of {task.body_radius:g} m does not fit at the {role} {point_text(point)}"
    return None


def path_length(points: np.ndarray) -> float:
    """Returns the length of the line through points [N, 3], metres."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def point_text(point: np.ndarray) -> str:
    """Returns a point [3], metres, as text: "(x, y, z)"."""
    return "(" + ", ".join(f"{value:g}" for value in point) + ")"


_distance = jax.jit(signed_distance)
