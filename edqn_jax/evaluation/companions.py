"""The other drones of a recorded flight's group, in the world that its pictures are drawn of."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.evaluation.missions import MissionSet
from edqn_jax.sim import group
from edqn_jax.sim.flights import Flights
from edqn_jax.sim.motion import Flown
from edqn_jax.sim.scene import PARKED, Scene


def scene_of_flight(config: Config, missions: MissionSet, flights: Flights | None = None, mission: int = 0) -> Scene:
    """Returns the world of a mission, of several drones with the others where they were throughout the flight.

    Args:
        config: of the flight.
        missions: that were flown.
        flights: all of the group, recorded; None is before they are flown: the arrays have the same shapes, and no
            other drone is there.
        mission: which one.

    Raises:
        ValueError: if the flights were not recorded.
    """
    scene = jax.tree.map(np.asarray, missions.scene(mission))
    if not group.several(config):
        return scene
    count, steps = config.env.drones, config.drone.physics_steps
    first = mission - mission % count
    others = [number for number in range(first, first + count) if number != mission]
    ends = missions.world.missions
    path = np.full((count - 1, 1 + config.env.max_decisions * steps, 3), PARKED, np.float32)
    if flights is not None:
        if flights.record is None:
            raise ValueError("the flights were not recorded; fly them with record=True")
        path[:, 0] = np.asarray(ends.start)[others]
        flown = np.asarray(flights.record.position)[others]
        path[:, 1:] = np.where(np.isnan(flown), PARKED, flown)
    table = Flown(
        path=jnp.asarray(path),
        radius=jnp.full(count - 1, config.drone.body_radius_m),
        began=jnp.zeros(()),
        step_s=jnp.float32(config.drone.physics_dt_s),
    )
    own = {name: np.asarray(getattr(ends, name)[mission]) for name in ("start", "goal")}
    return dataclasses.replace(scene, **own, drones=jax.tree.map(np.asarray, table))
