"""Planners in `runtime.py`: they plan on the map, and what they planned is flown."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from edqn_jax.config import DENSITIES, Config
from edqn_jax.parallel.devices import processor
from edqn_jax.planners.astar import NoPathError, shortest_path
from edqn_jax.planners.follow import FollowConfig, compiled_follower, reserved, sampled
from edqn_jax.planners.planner import Budget, Task, load_planner
from edqn_jax.runs.provenance import workload
from edqn_jax.sim import worlds
from edqn_jax.sim.drone import load_airframe
from edqn_jax.sim.mjcf import check_scene, load_world, resolve_world
from edqn_jax.sim.outcomes import Outcome
from edqn_jax.sim.scene import Scene, take_scene
from measurement import json_report

NOT_FLOWN = {"outcome": "no_path", "decisions": 0, "flight_seconds": 0.0, "path_length_m": 0.0, "clearance_m": None}


def judged_scenes(config: Config, count: int) -> list[Scene]:
    """The worlds that are flown from their own start to their own goal: `count` test worlds, or the one of a file.

    Raises:
        ConfigError: if there is no such world, or no drone can stand where the mission starts or ends.
    """
    name, radius = config.world.name, config.drone.body_radius_m
    if name in DENSITIES:
        pool = jax.tree.map(np.asarray, worlds.random_pool(name, worlds.world_keys("test", count)))
        return [take_scene(pool, index) for index in range(count)]
    loaded = load_world(resolve_world(name))
    check_scene(loaded.scene, radius, names=loaded.names, title=f"'{name}'")
    return [loaded.scene]


def shortest_length(radius: float, scene: Scene) -> float | None:
    """Length of A*'s path for a sphere of that radius from start to goal, metres; None where there is none."""
    try:
        return shortest_path(scene, scene.start, scene.goal, radius).length_m
    except NoPathError:
        return None


class Planning:
    """A planner that knows the map, and the airframe that flies its paths."""

    def __init__(self, name: str, config: Config, seconds: float, count: int) -> None:
        """`seconds` is the budget of each plan; in random worlds `count` missions are planned and flown.

        Raises:
            MissingPackageError: if a package that it needs is not installed.
            ConfigError: if the world cannot be flown in.
        """
        self.name, self.config, self.budget = name, config, Budget(seconds=seconds)
        self.plan = load_planner(name)
        self.scenes = judged_scenes(config, count)
        self.airframe = load_airframe(config.drone)
        self.follower = compiled_follower()
        machine = json_report.machine(jax.devices())
        if name != "SNN":  # the others compute on the CPU, whatever JAX prefers
            machine |= {"device": processor(), "devices": []}
        self.about = {**machine, "workload": workload(config, self.scenes[0])}
        self._mission(self.scenes[0], 0)  # compiles what the planner itself does not compile before its clock starts

    def turn(self, seed: int) -> dict[str, Any]:
        """Every mission planned and flown.

        Returns:
            `flights`: as of a learner, with the reason where there is no path. `planning_seconds` is what it
            took to plan what was flown, `planned_m` how long that path is as drawn.
        """
        count = len(self.scenes)
        missions = [self._mission(scene, seed * count + index) for index, scene in enumerate(self.scenes)]
        return {"seed": seed, "flights": {key: [mission[key] for mission in missions] for key in missions[0]}}

    def _mission(self, scene: Scene, seed: int) -> dict[str, Any]:
        config, follow = self.config, FollowConfig()
        task = Task.of(scene, body_radius=config.drone.body_radius_m, goal_radius=config.env.goal_radius_m)
        plan = self.plan(reserved(task, follow), self.budget, seed)
        said = {"reason": plan.reason, "planning_seconds": plan.seconds}
        if plan.path is None:
            return {**NOT_FLOWN, **said, "planned_m": None}
        goal, points = np.float32(task.goal), sampled(plan.path)
        flown = jax.device_get(self.follower(config, follow, self.airframe, scene, goal, points))
        return {
            "outcome": Outcome(int(flown.outcome)).name.lower(),
            "decisions": int(flown.decisions),
            "flight_seconds": float(flown.flight_seconds),
            "path_length_m": float(flown.path_length_m),
            "clearance_m": float(flown.closest.distance),
            **said,
            "planned_m": plan.length_m,
        }
