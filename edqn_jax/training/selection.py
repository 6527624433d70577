"""Validation: when it is due, its scores, and which parameters a run keeps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from edqn_jax.config import Config
from edqn_jax.evaluation.metrics import spl
from edqn_jax.evaluation.missions import RunMissions
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.schedule import Schedule
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.missions import Missions
from edqn_jax.sim.task.outcomes import Outcome

FLIES = 0.9
"""Success rate, in the validation missions that begin at or near a world's own start, from which a policy is said to
fly the mission."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Parameters that a run may end with, and their validation; by default none yet."""

    params: PolicyParams
    spl: float = -1.0  # below what any validation gives
    success: float = 0.0  # share of validation missions
    success_near_start: float = 0.0  # share of those that begin at or near their world's own start
    decisions: int = 0  # trained before that validation, in all environments
    timed_out: float | None = None  # share of validation missions; of older runs that go on it is not known


def is_due(config: Config, schedule: Schedule, checked: int, done: int) -> bool:
    """Returns whether a validation is due after `done` training steps, the last one after `checked` decisions."""
    every = config.train.validation_every
    # On crossing a multiple, never on equality: right for any number of environments.
    return every > 0 and done * config.train.num_envs // every > checked // every and done > schedule.learn_from


def make_candidate(
    config: Config, missions: RunMissions, flights: Flights, params: PolicyParams, decisions: int
) -> Candidate:
    """Returns the candidate for parameters, scored by the flights of their validation."""
    outcome = np.asarray(flights.outcome)
    arrived = outcome == Outcome.GOAL
    straight = _straight(missions.validation.env_params.missions, config.env.goal_radius_m)
    return Candidate(
        params,
        spl=spl(arrived, np.asarray(flights.path_length_m), straight),
        success=float(np.mean(arrived)),
        success_near_start=float(np.mean(arrived[missions.near_start])),
        decisions=decisions,
        timed_out=float(np.mean(outcome == Outcome.TIME_OUT)),
    )


def _straight(missions: Missions, goal_radius_m: float) -> np.ndarray:
    """[M] metres from each start straight to the goal's sphere: a lower bound that needs no search."""
    apart = np.linalg.norm(np.asarray(missions.goal) - np.asarray(missions.start), axis=1)
    return np.maximum(apart - goal_radius_m, 1e-3)


def choose_candidate(keep: Literal["best", "last"], kept: Candidate, latest: Candidate) -> Candidate:
    """Returns which of the two a run would end with: `best` by SPL, the latest among equals; `last` the latest."""
    return latest if keep == "last" or latest.spl >= kept.spl else kept


def first_success(validations: Sequence[tuple[int, float, float]]) -> tuple[int | None, float | None]:
    """Returns decisions and seconds at the first validation in which the mission was flown.

    Args:
        validations: decisions, seconds and success rate near the start of each, in order.

    Returns:
        (None, None) if none reached `FLIES`.
    """
    return next(((decisions, seconds) for decisions, seconds, rate in validations if rate >= FLIES), (None, None))
