"""RRT* and BIT*: sampling planners that keep shortening their path, from the library OMPL.

RRT*: Karaman and Frazzoli, "Sampling-based Algorithms for Optimal Motion Planning", Int. J. Robotics Research
30(7), 2011. BIT*: Gammell, Srinivasa and Barfoot, "Batch Informed Trees", ICRA 2015. OMPL: Sucan, Moll and
Kavraki, "The Open Motion Planning Library", IEEE Robotics & Automation Magazine 19(4), 2012, with its default settings.

Both use the whole budget, in seconds or in OMPL's iterations, whichever ends first; BIT* ends earlier if its path
cannot be shortened. The variants `*_first` end with the first path. OMPL checks segments instead of points; each check
uses the exact distances of the scene in compiled code.
"""

from __future__ import annotations

import functools
import math
import time
from typing import Any

import numpy as np

from edqn_jax.extras import require_extra
from edqn_jax.planning.path import MARGIN, PlannedPath, PlanningTask, not_found, path_length
from rivals.planners.planner import Budget, refusal
from rivals.planners.solids import leg_free, solid_table

base = require_extra("ompl.base")
geometric = require_extra("ompl.geometric")
util = require_extra("ompl.util")


class _Legs(base.MotionValidator):
    """Checks whether the drone's sphere passes straight between two states."""

    def __init__(self, information: Any, table: np.ndarray, radius: float):
        super().__init__(information)
        self.table, self.radius = table, radius

    def checkMotion(self, start: Any, end: Any) -> bool:  # noqa: N802 (OMPL's name)
        return leg_free(self.table, tuple(start[0:3]), tuple(end[0:3]), self.radius)


def rrt_star(task: PlanningTask, budget: Budget = Budget(), seed: int = 0) -> PlannedPath:  # noqa: B008 (it is frozen)
    """Returns the shortest path that RRT* finds within the budget."""
    return _plan(geometric.RRTstar, task, budget, seed)


def rrt_star_first(task: PlanningTask, budget: Budget = Budget(), seed: int = 0) -> PlannedPath:  # noqa: B008
    """Returns the first path that RRT* finds within the budget."""
    return _plan(geometric.RRTstar, task, budget, seed, ends_with_first=True)


def bit_star(task: PlanningTask, budget: Budget = Budget(), seed: int = 0) -> PlannedPath:  # noqa: B008
    """Returns the shortest path that BIT* finds within the budget."""
    return _plan(geometric.BITstar, task, budget, seed)


def bit_star_first(task: PlanningTask, budget: Budget = Budget(), seed: int = 0) -> PlannedPath:  # noqa: B008
    """Returns the first path that BIT* finds within the budget."""
    return _plan(geometric.BITstar, task, budget, seed, ends_with_first=True)


def _plan(algorithm: Any, task: PlanningTask, budget: Budget, seed: int, ends_with_first: bool = False) -> PlannedPath:
    refused = refusal(task)
    if refused:
        return not_found(refused)
    _compile()
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed + 1)  # OMPL does not accept 0
    began = time.perf_counter()
    table, radius = solid_table(task.scene), task.body_radius + MARGIN
    lower, upper = np.asarray(task.scene.volume, np.float64)
    space, bounds = base.RealVectorStateSpace(3), base.RealVectorBounds(3)
    bounds.low, bounds.high = lower.tolist(), upper.tolist()
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(lambda state: leg_free(table, tuple(state[0:3]), tuple(state[0:3]), radius))
    information.setMotionValidator(_Legs(information, table, radius))
    information.setup()
    problem = base.ProblemDefinition(information)
    ends = space.allocState(), space.allocState()
    for state, point in zip(ends, (task.start, task.goal), strict=True):
        state[0:3] = point.tolist()
    problem.setStartAndGoalStates(*ends)
    problem.setOptimizationObjective(base.PathLengthOptimizationObjective(information))
    planner = algorithm(information)
    planner.setProblemDefinition(problem)
    planner.setup()

    first: list[float] = []
    steps = math.inf if budget.steps is None else budget.steps

    def is_over() -> bool:
        elapsed = time.perf_counter() - began
        if not first:
            best = planner.bestCost().value()
            if math.isfinite(best):
                first.extend((elapsed, best))
        done = bool(first) and ends_with_first
        return done or elapsed >= budget.seconds or planner.numIterations() >= steps

    planner.solve(base.PlannerTerminationCondition(is_over))
    seconds, taken = time.perf_counter() - began, planner.numIterations()
    if not problem.hasExactSolution():
        return not_found(f"none found within {seconds:.3g} s and {taken} iterations", seconds, taken)
    path = np.array([state[0:3] for state in problem.getSolutionPath().getStates()])
    if not first:  # found by the last iteration
        first = [seconds, path_length(path)]
    return PlannedPath(path, "", seconds, taken, first[0], first[1])


@functools.lru_cache(maxsize=1)
def _compile() -> None:
    """Makes numba compile before time is measured."""
    point = 0.0, 0.0, 0.0
    leg_free(np.zeros((0, 17)), point, point, 0.0)
