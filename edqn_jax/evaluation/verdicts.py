"""Comparison of the simulator's verdicts on recorded flights with C MuJoCo's, on the worlds' MJCF."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from edqn_jax.config import Config
from edqn_jax.evaluation.judge import FlightTrack, MujocoWorld, Way, load_judge, max_obstacle_speed, replay_contact
from edqn_jax.evaluation.missions import MissionSet
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome

CONTACT_TOLERANCE_M = 0.01
"""Largest distance along the path between the two moments of one contact. `segment_contact` samples the distance
seven times a segment and interpolates: it may miss a graze 0.1 mm deep, which at a grazing angle is
sqrt(2 x 0.36 m x 0.1 mm) = 8.5 mm of path. Where obstacles move, the path is that of body and obstacle together."""


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Both verdicts on one flight. A moment is a number of physics steps, with its fraction."""

    mission: int
    outcome: Outcome
    """Verdict of the simulator."""
    stated: float | None
    """Moment of the contact by the simulator's verdict; None if it is not a collision."""
    found: float | None
    """Moment of the first contact that C MuJoCo finds; None if it finds none."""
    apart_m: float | None
    """Metres of path between the two moments, where obstacles move at most so many; None unless both exist."""
    touched: str
    """Name of the geom that C MuJoCo finds touched; empty without a contact."""

    @property
    def agrees(self) -> bool:
        """Whether both find a contact at the same moment, or neither finds one."""
        if self.apart_m is None:
            return self.stated is self.found  # neither
        return self.apart_m <= CONTACT_TOLERANCE_M


def check_verdicts(config: Config, missions: MissionSet, flights: Flights) -> list[Agreement]:
    """Replays every recorded flight in C MuJoCo, along the segments between physics steps, and compares.

    Args:
        config: gives the radius of the body.
        missions: that were flown; a world from a file is judged by that file.
        flights: recorded flights of these missions.

    Raises:
        ValueError: if the flights were not recorded.
    """
    judges = judges_of(config, missions)
    pool_missions = missions.env_params.missions
    scenes, starts, goals = (
        np.asarray(pool_missions.scene),
        np.asarray(pool_missions.start),
        np.asarray(pool_missions.goal),
    )
    step_s, of_decision = config.drone.physics_dt_s, config.drone.physics_steps
    positions = np.asarray(flights.get_record().position)
    outcomes, steps = np.asarray(flights.outcome), np.asarray(flights.physics_steps)
    results = []
    for i, (scene, outcome, count) in enumerate(zip(scenes, outcomes, steps, strict=True)):
        path = np.concatenate([starts[i][None], positions[i, :count]]).astype(np.float64)
        target = FlightTrack(starts[i], goals[i], path[::of_decision], step_s * of_decision)
        contact = replay_contact(judges[scene], path, step_s, target)
        stated = count - 1 + float(flights.contact[i]) if outcome == Outcome.COLLISION else None
        found = None if contact is None else contact.segment + contact.fraction
        apart = None
        if stated is not None and found is not None:
            way = Way(path, max_obstacle_speed(judges[scene], step_s * count) * step_s)
            apart = abs(float(np.diff(np.interp([stated, found], np.arange(count + 1), way.travelled))[0]))
        touched = "" if contact is None else contact.geom
        results.append(Agreement(i, Outcome(int(outcome)), stated, found, apart, touched))
    return results


def judges_of(config: Config, missions: MissionSet) -> list[MujocoWorld]:
    """Returns the worlds of missions in C MuJoCo, each with a probe of the drone's radius."""
    radius, volumes = config.drone.body_radius_m, np.asarray(missions.env_params.pool.volume)
    specs = (mujoco.MjSpec.from_string(text) for text in missions.mjcf())
    return [load_judge(spec, radius, volume) for spec, volume in zip(specs, volumes, strict=True)]
