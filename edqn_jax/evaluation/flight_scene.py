"""The scene of a recorded flight, for pictures: its world with other drones and balls."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.evaluation.missions import MissionSet
from edqn_jax.sim.scene.launches import aim_along
from edqn_jax.sim.scene.motion import DroneTracks
from edqn_jax.sim.scene.scene import PARKED, Scene
from edqn_jax.sim.task import group
from edqn_jax.sim.task.flights import Flights


def scene_of_flight(config: Config, missions: MissionSet, flights: Flights | None = None, mission: int = 0) -> Scene:
    """Returns the scene of a mission during its flight: with balls as they were thrown and the other drones.

    Args:
        config: of the flight.
        missions: that were flown.
        flights: all of the group, recorded; None is before they are flown: the arrays have the same shapes, no other
            drone is there, and no ball is thrown.
        mission: which one.

    Raises:
        ValueError: if the flights were not recorded.
    """
    scene = jax.tree.map(np.asarray, missions.scene(mission))
    ends = missions.env_params.missions
    if scene.spheres.throw is not None:
        own = np.asarray(ends.start[mission])[None]
        if flights is not None:
            own = np.concatenate([own, np.asarray(flights.get_record().position[mission])])
        aim = aim_along(config, scene, own[:: config.drone.physics_steps])
        scene = dataclasses.replace(scene, aim=jax.tree.map(np.asarray, aim))
    if not group.is_multi_drone(config):
        return scene
    count, steps = config.env.drones, config.drone.physics_steps
    first = mission - mission % count
    others = [number for number in range(first, first + count) if number != mission]
    path = np.full((count - 1, 1 + config.env.max_decisions * steps, 3), PARKED, np.float32)
    if flights is not None:
        path[:, 0] = np.asarray(ends.start)[others]
        recorded = np.asarray(flights.get_record().position)[others]
        path[:, 1:] = np.where(np.isnan(recorded), PARKED, recorded)
    table = DroneTracks(
        path=jnp.asarray(path),
        radius=jnp.full(count - 1, config.drone.body_radius_m),
        began=jnp.zeros(()),
        step_s=jnp.float32(config.drone.physics_dt_s),
    )
    own = {name: np.asarray(getattr(ends, name)[mission]) for name in ("start", "goal")}
    return dataclasses.replace(scene, **own, drones=jax.tree.map(np.asarray, table))
