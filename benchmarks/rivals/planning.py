"""Planners in `runtime.py`: they plan on the map, and the follower flies the path."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import jax
import numpy as np

from edqn_jax.config import FAMILIES, Config
from edqn_jax.devices.hardware import count_cores, describe_processor
from edqn_jax.planning.astar import shortest_path
from edqn_jax.planning.lattice import NoPathError
from edqn_jax.planning.path import PlanningTask
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.mjcf import check_scene, load_world, resolve_world
from edqn_jax.sim.scene.scene import Scene, take_scene
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.worlds import families
from edqn_jax.sim.worlds.moving import Moving
from measurement import json_report
from rivals.planners.follow import FollowConfig, compiled_follower, sample_path, with_reserve
from rivals.planners.planner import Budget, load_planner

MANY = 64
"""Number of worlds from which on shortest paths are computed in several processes."""

NOT_FLOWN = {"outcome": "no_path", "decisions": 0, "flight_seconds": 0.0, "path_length_m": 0.0, "clearance_m": None}


def judged_scenes(config: Config, count: int) -> list[Scene]:
    """Returns the worlds of the test missions: `count` random test worlds, or the one world of a file.

    Raises:
        ConfigError: if there is no such world, or its start or goal is not free.
    """
    name, radius = config.world.name, config.drone.body_radius_m
    if name in FAMILIES:
        pool = jax.tree.map(
            np.asarray, families.random_pool(name, families.world_keys("test", count), Moving.from_config(config))
        )
        return [take_scene(pool, index) for index in range(count)]
    loaded = load_world(resolve_world(name))
    check_scene(loaded.scene, radius, names=loaded.names, title=f"'{name}'")
    return [loaded.scene]


def _shortest_length(radius: float, scene: Scene) -> float | None:
    """Returns the length of A*'s path from start to goal for a sphere of that radius, metres; None without a path."""
    try:
        return shortest_path(scene, scene.start, scene.goal, radius).length_m
    except NoPathError:
        return None


def keep_to_cpu() -> None:
    """Restricts JAX to the CPU, because the children use the accelerator if there is one."""
    jax.config.update("jax_platforms", "cpu")


def shortest_lengths(config: Config, scenes: Sequence[Scene]) -> list[float | None]:
    """Returns the length of A*'s path in each world, metres, None without a path. Uses all cores for many worlds."""
    length = partial(_shortest_length, config.drone.body_radius_m)
    if len(scenes) < MANY:
        return [length(scene) for scene in scenes]
    fresh = multiprocessing.get_context("spawn")  # because JAX's threads do not survive a fork
    with ProcessPoolExecutor(count_cores(), fresh, initializer=keep_to_cpu) as pool:
        return list(pool.map(length, scenes, chunksize=8))


class Planning:
    """A planner, and the follower that flies its paths."""

    def __init__(self, name: str, config: Config, seconds: float, count: int) -> None:
        """Loads the planner. `seconds` is the budget of a plan, `count` the number of missions in random worlds.

        Raises:
            MissingPackageError: if a package that it needs is not installed.
            ConfigError: if the world cannot be used.
        """
        self.name, self.config, self.budget = name, config, Budget(seconds=seconds)
        self.plan = load_planner(name)
        self.scenes = judged_scenes(config, count)
        self.airframe = load_airframe(config.drone)
        self.follower = compiled_follower()
        machine = json_report.machine(jax.devices())
        if name != "SNN":  # the others run on the CPU, whatever JAX's default device
            machine |= {"device": describe_processor(), "devices": []}
        self.about = {**machine, "workload": describe_workload(config, self.scenes[0])}
        self._mission(self.scenes[0], 0)  # compiles what the planner does not compile before it measures time

    def turn(self, seed: int) -> dict[str, Any]:
        """Plans and flies every mission.

        Returns:
            `flights` as of a learner, with the `reason` where there is no path. `planning_seconds` is the time of the
            plan, `planned_m` the length of the planned path.
        """
        count = len(self.scenes)
        missions = [self._mission(scene, seed * count + index) for index, scene in enumerate(self.scenes)]
        return {"seed": seed, "flights": {key: [mission[key] for mission in missions] for key in missions[0]}}

    def _mission(self, scene: Scene, seed: int) -> dict[str, Any]:
        config, follow = self.config, FollowConfig()
        task = PlanningTask.from_scene(
            scene, body_radius=config.drone.body_radius_m, goal_radius=config.env.goal_radius_m
        )
        plan = self.plan(with_reserve(task, follow), self.budget, seed)
        said = {"reason": plan.reason, "planning_seconds": plan.seconds}
        if plan.path is None:
            return {**NOT_FLOWN, **said, "planned_m": None}
        goal, points = np.float32(task.goal), sample_path(plan.path)
        flight = jax.device_get(self.follower(config, follow, self.airframe, scene, goal, points))
        return {
            "outcome": Outcome(int(flight.outcome)).name.lower(),
            "decisions": int(flight.decisions),
            "flight_seconds": float(flight.flight_seconds),
            "path_length_m": float(flight.path_length_m),
            "clearance_m": float(flight.closest.distance),
            **said,
            "planned_m": plan.length_m,
        }
