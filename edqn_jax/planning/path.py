"""Paths through known worlds, and the task of finding one."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from edqn_jax.sim.scene.scene import Scene

MARGIN = 1e-3
"""Metres of clearance beyond the body, so that neither sampling nor float32 of a check finds a contact."""


@dataclasses.dataclass(frozen=True)
class PlanningTask:
    """Find a path for a sphere through a known world; its centre stays within the scene's flight volume."""

    scene: Scene
    start: np.ndarray  # [3] metres
    goal: np.ndarray  # [3] metres
    body_radius: float
    """Radius of the sphere, metres."""
    goal_radius: float
    """Metres. A planner that need not end at the goal itself may end this near, if the straight line there is free."""

    @classmethod
    def from_scene(cls, scene: Scene, *, body_radius: float, goal_radius: float = 2.0) -> PlanningTask:
        """Returns the task from the scene's own start to its goal; radii in metres."""
        start, goal = (np.asarray(point, np.float64) for point in (scene.start, scene.goal))
        return cls(scene, start, goal, body_radius, goal_radius)


@dataclasses.dataclass(frozen=True)
class PlannedPath:
    """The result of a planner. Seconds are of wall time, with reading the map and without compilation."""

    path: np.ndarray | None
    """[N, 3] metres from start to goal, straight between the points; None if no path was found."""
    reason: str
    """Why there is no path, a sentence that begins with "no path"; empty if there is a path."""
    seconds: float
    steps: int
    """Steps used; 0 where a planner counts none."""
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


def path_as_plan(path: npt.ArrayLike, seconds: float, steps: int) -> PlannedPath:
    """Returns the plan of a planner that finds only one path [n, 3] metres."""
    path = np.asarray(path, np.float64)
    return PlannedPath(path, "", seconds, steps, seconds, path_length(path))


def not_found(why: str, seconds: float = 0.0, steps: int = 0) -> PlannedPath:
    """Returns a plan without a path; `why` follows "no path: "."""
    return PlannedPath(None, f"no path: {why}", seconds, steps, float("nan"), float("nan"))


def path_length(points: np.ndarray) -> float:
    """Returns the length of the line through points [N, 3], metres."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def point_text(point: np.ndarray) -> str:
    """Returns a point [3], metres, as text: "(x, y, z)"."""
    return "(" + ", ".join(f"{value:g}" for value in point) + ")"
