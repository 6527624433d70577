"""Comparison of the verdicts on recorded flights with those of C MuJoCo, or trimesh, on the worlds' MJCF."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from edqn_jax.config import Config
from edqn_jax.evaluation.judge import (
    FlightTrack,
    MujocoWorld,
    Way,
    clearance,
    load_judge,
    max_obstacle_speed,
    replay_contact,
)
from edqn_jax.evaluation.missions import MissionSet
from edqn_jax.sim.scene.scene import PARKED
from edqn_jax.sim.scene.shapes.kind import kind_of
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
    """Name of the geom that is found touched; empty without a contact."""
    judge: str = "C MuJoCo"
    """Who found it: of a mesh that is not convex, and of a height field, `trimesh`."""
    slack_m: float = 0.0
    """Most metres that distances of a kind of shape in the world may be too small; 0 where all are exact."""
    left_m: float | None = None
    """Metres between body and solids at the stated contact, where there is slack."""
    depth_m: float = 0.0
    """Metres that the body was in a solid by the end of the step of the contact that was found."""

    @property
    def agrees(self) -> bool:
        """Whether both find a contact at the same moment, or neither finds one.

        Where distances may be too small, a contact may be stated that far before one, and beside what is passed.
        """
        if self.stated is None and self.found is None:
            return True
        if self.apart_m is not None and self.apart_m <= CONTACT_TOLERANCE_M:
            return True
        if not self.slack_m:
            return False
        if self.stated is None:
            return self.depth_m <= CONTACT_TOLERANCE_M
        return self.left_m is not None and -CONTACT_TOLERANCE_M <= self.left_m <= self.slack_m


def check_verdicts(config: Config, missions: MissionSet, flights: Flights) -> list[Agreement]:
    """Replays every recorded flight in C MuJoCo, along the segments between physics steps, and compares.

    Args:
        config: gives the radius of the body.
        missions: that were flown; a world from a file is judged by that file.
        flights: recorded flights of these missions.

    Raises:
        ValueError: if the flights were not recorded.
    """
    judges, slacks = judges_of(config, missions), slacks_of(missions)
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
        judge, left, slack = judges[scene], None, slacks[scene]
        if slack and stated is not None:
            left, _ = clearance(judge, _path_at(path, stated), step_s * stated, target)
        touched, by, depth = (
            ("", "C MuJoCo", 0.0) if contact is None else (contact.geom, judge.judge_of(contact.geom), contact.depth)
        )
        results.append(Agreement(i, Outcome(int(outcome)), stated, found, apart, touched, by, slack, left, depth))
    return results


def _path_at(path: np.ndarray, moment: float) -> np.ndarray:
    """Returns the place [3] on a path [K + 1, 3], a point for each physics step, at a moment, metres."""
    number = min(int(moment), len(path) - 2)
    return path[number] + (moment - number) * (path[number + 1] - path[number])


def slacks_of(missions: MissionSet) -> list[float]:
    """Returns how much too small distances may be in each of the worlds, metres."""
    pool = missions.env_params.pool
    there = [(kind_of(shapes)[1].slack, np.asarray(shapes.position)) for shapes in pool.shapes().values()]
    return [
        max([0.0, *(slack for slack, places in there if np.any(np.abs(places[i]) < PARKED / 2))])
        for i in range(pool.start.shape[0])
    ]


def judges_of(config: Config, missions: MissionSet) -> list[MujocoWorld]:
    """Returns the worlds of missions in C MuJoCo, each with a probe of the drone's radius."""
    radius, volumes = config.drone.body_radius_m, np.asarray(missions.env_params.pool.volume)
    specs = (mujoco.MjSpec.from_string(text) for text in missions.mjcf())
    return [load_judge(spec, radius, volume) for spec, volume in zip(specs, volumes, strict=True)]
