"""What every planner that knows the map takes and gives back, and the planners by name.

plan = load_planner("A*")(Task.of(scene, body_radius=0.36), Budget(), seed=0)
"""

from __future__ import annotations

import dataclasses
import importlib
from typing import Protocol

import jax
import numpy as np
import numpy.typing as npt

from edqn_jax.sim.scene import Scene, signed_distance

MARGIN = 1e-3
"""Metres that paths stay off contact, so that no judge's sampling or float32 finds one."""


@dataclasses.dataclass(frozen=True)
class Task:
    """Fly a sphere through a known world; its middle stays within the scene's flight volume."""

    scene: Scene
    start: np.ndarray  # [3] metres
    goal: np.ndarray  # [3] metres
    body_radius: float
    """Metres; nothing may be nearer."""
    goal_radius: float
    """Metres. A planner that need not come to rest on the goal is done this near, if nothing is between."""

    @classmethod
    def of(cls, scene: Scene, *, body_radius: float, goal_radius: float = 2.0) -> Task:
        """The scene's own start and goal."""
        start, goal = (np.asarray(point, np.float64) for point in (scene.start, scene.goal))
        return cls(scene, start, goal, body_radius, goal_radius)


@dataclasses.dataclass(frozen=True)
class Budget:
    """Where a planner gives up. Each module says what its step is; only sampling planners watch the clock."""

    seconds: float = 5.0
    steps: int | None = None
    """None is the planner's own limit."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """What came of it. Seconds are of the wall clock; compilation is not counted, reading the map is."""

    path: np.ndarray | None
    """[N, 3] metres from start to goal, straight between; None if none was found."""
    reason: str
    """Why there is none, one sentence that begins with "no path"; empty if there is one."""
    seconds: float
    steps: int
    """How much of the budget's steps was used."""
    first_seconds: float
    """When the first path was known; `seconds` for planners that know one only. Not a number without a path."""
    first_length_m: float
    """Length of that path."""

    @property
    def found(self) -> bool:
        """Whether there is a path."""
        return self.path is not None

    @property
    def length_m(self) -> float:
        """Metres; not a number without a path."""
        return float("nan") if self.path is None else path_length(self.path)


class Planner(Protocol):
    """From a task to a plan. The seed matters to planners that draw; the others give one plan for all seeds."""

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
"""Where each is: module and function within `edqn_jax.planners`."""

IMPROVING = "RRT*", "BIT*"
"""Those that go on after their first path, until the budget is spent."""

DRAWING = (*IMPROVING, "RRT* first path", "BIT* first path")
"""Those that draw at random, so that another seed is another path."""


def load_planner(name: str) -> Planner:
    """The planner of that name.

    Raises:
        KeyError: if there is none.
        MissingPackageError: if a package of the extra `bench` that it needs is not installed.
    """
    module, function = PLANNERS[name].split(".")
    return getattr(importlib.import_module(f"edqn_jax.planners.{module}"), function)


def found(path: npt.ArrayLike, seconds: float, steps: int) -> Plan:
    """The plan of a planner that finds one path only."""
    path = np.asarray(path, np.float64)
    return Plan(path, "", seconds, steps, seconds, path_length(path))


def not_found(why: str, seconds: float = 0.0, steps: int = 0) -> Plan:
    """No path, and why."""
    return Plan(None, f"no path: {why}", seconds, steps, float("nan"), float("nan"))


def refusal(task: Task) -> str | None:
    """Why there cannot be a path, as seen from the two ends alone; None if they are free."""
    lower, upper = np.asarray(task.scene.volume, np.float64)
    for role, point in (("start", task.start), ("goal", task.goal)):
        if not np.all((point >= lower) & (point <= upper)):
            return f"the {role} {point_text(point)} lies outside the flight volume"
        if _distance(task.scene, np.float32(point)) < task.body_radius + MARGIN:
            return f"a sphere of {task.body_radius:g} m does not fit at the {role} {point_text(point)}"
    return None


def path_length(points: np.ndarray) -> float:
    """Metres along points [N, 3]."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def point_text(point: np.ndarray) -> str:
    """A point [3] for people."""
    return "(" + ", ".join(f"{value:g}" for value in point) + ")"


_distance = jax.jit(signed_distance)
