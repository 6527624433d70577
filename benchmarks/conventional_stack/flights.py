"""Greedy flights of missions in parallel, with outcomes and figures as in `edqn_jax/evaluation/rollouts.py`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conventional_stack.fleet import Course, Fleet, Record
from conventional_stack.task import RUNNING, signed_distance
from edqn_jax.config import Config
from edqn_jax.extras import require_extra
from edqn_jax.sim.task.flights import Closest, Flights

numba = require_extra("numba")

Act = Callable[[NDArray[np.int8], NDArray[np.float32], NDArray[np.float32]], NDArray[np.int64]]
"""Returns the actions [M] for event counts [M, H, W], own states [M, 10] and own motions [M, 7]."""


def fly_missions(config: Config, course: Course, act: Act) -> Flights:
    """Flies each of the course's M missions once; a drone whose flight has ended continues without being counted.

    Returns:
        the result of `evaluation.rollouts.fly_missions` in NumPy without a record, for `metrics.summarise_flights`.

    Raises:
        ConfigError: if this stack does not support the configuration.
    """
    missions = len(course.start)
    record = Record.empty(config, missions)
    fleet = Fleet(config, course, record, seed=0)
    fleet.reset(range(missions))
    geoms, radius, dt = fleet.world.geoms, fleet.rules.radius, fleet.airframe.physics_dt
    gap = np.array([signed_distance(geoms, x, y, z) - radius for x, y, z in course.start])
    nearest: Any = gap, np.zeros(missions), fleet.state[:, :3].copy(), fleet.state[:, 3:7].copy()
    outcome, decisions, physics_steps = np.zeros((3, missions), np.int64)
    episode_return, length, seconds = np.zeros((3, missions))
    contact = np.ones(missions)
    while np.any(running := outcome == RUNNING):
        record.action[:] = act(record.events, record.own, record.motion)
        fleet.step()
        _tally(geoms, radius, dt, running, fleet.path, fleet.end_step, fleet.contact, length, seconds, nearest)
        decisions += running
        physics_steps += running * fleet.end_step
        episode_return += running * record.reward
        contact = np.where(running, fleet.contact, contact)
        outcome = np.where(running, record.outcome, outcome)
    figures: Any = outcome, decisions, physics_steps, contact, episode_return, length, seconds
    return Flights(*figures, closest=Closest(*nearest), record=None)


@numba.njit(cache=True, error_model="numpy")
def _tally(geoms, radius, dt, running, path, end_step, contact, length, seconds, nearest):
    """Adds length and time of one decision up to the end of the episode, and updates the closest approach.

    Args:
        running: [M] bool; the others are not changed.
        path: [M, n + 1, 7].
        end_step, contact: [M], as in `edqn_jax.sim.task.env.Step`.
        length, seconds: [M], updated.
        nearest: distance [M], time [M], position [M, 3] and quaternion [M, 4], updated.
    """
    distance, time, position, quaternion = nearest
    for i in np.flatnonzero(running):
        for step in range(1, end_step[i] + 1):
            share = contact[i] if step == end_step[i] else 1.0
            before, after = path[i, step - 1], path[i, step]
            dx, dy, dz = after[0] - before[0], after[1] - before[1], after[2] - before[2]
            x, y, z = before[0] + share * dx, before[1] + share * dy, before[2] + share * dz
            length[i] += share * math.sqrt(dx * dx + dy * dy + dz * dz)
            seconds[i] += share * dt
            gap = signed_distance(geoms, x, y, z) - radius
            if gap < distance[i]:
                distance[i], time[i] = gap, seconds[i]
                position[i, 0], position[i, 1], position[i, 2] = x, y, z
                quaternion[i] = after[3:]
