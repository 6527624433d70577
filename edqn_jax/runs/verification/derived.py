"""Derives the summary of a run from its raw files alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np

from edqn_jax.config import Config
from edqn_jax.evaluation.judge import FlightTrack, MujocoWorld, clearance, replay_contact
from edqn_jax.evaluation.metrics import EMPTY_M
from edqn_jax.evaluation.missions import RunMissions
from edqn_jax.evaluation.trajectories import POSITION, columns_of
from edqn_jax.evaluation.verdicts import CONTACT_TOLERANCE_M, slacks_of
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.training.selection import FLIES

DIGITS = 1e-5
"""Relative error of what is derived from files with six or seven digits."""

CLEARANCE_M = 2e-3
"""Largest difference of a clearance, in single precision by us and in double precision by C MuJoCo."""


def from_metrics(config: Config, metrics: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the expected training entries of `summary.json`, from the lines of `metrics.jsonl`."""
    checked = [row for row in metrics if row.get("validation_spl") is not None]
    # Of equal ones the latest.
    best = max(enumerate(checked), key=lambda each: (each[1]["validation_spl"], each[0]))[1] if checked else None
    kept = checked[-1] if checked and config.train.keep == "last" else best
    flew = [row["decisions"] for row in checked if row["validation_mission"] >= FLIES]
    decisions = [0, *(row["decisions"] for row in metrics)]
    seconds = sum(
        (row["decisions"] - before) / row["decisions_per_second"]
        for before, row in zip(decisions, metrics, strict=False)
    )
    share = "validation_timed_out"  # which older runs do not have, nor runs without a validation
    return {
        **({share: kept[share]} if kept and share in kept else {}),
        "train_decisions": decisions[-1],
        "train_seconds": seconds,
        "decisions_per_second": decisions[-1] / seconds if seconds else None,
        "episodes": metrics[-1]["episodes"] if metrics else 0,
        "first_success_decisions": flew[0] if flew else None,
        "validation_success": kept["validation_success"] if kept else 0.0,
        "validation_spl": kept["validation_spl"] if kept else -1.0,
        "parameters_from_decisions": kept["decisions"] if kept else 0,
    }


def from_trajectory(
    config: Config, missions: RunMissions, judge: MujocoWorld, recorded: Mapping[str, np.ndarray]
) -> tuple[dict[str, Any], dict[str, float]]:
    """Returns what `summary.json` must say of the recorded flight, and how far numbers may be off; C MuJoCo judges."""
    pool_missions = missions.final.env_params.missions
    start, goal = np.asarray(pool_missions.start[0], np.float64), np.asarray(pool_missions.goal[0], np.float64)
    positions = columns_of(recorded, POSITION)
    path = np.concatenate([start[None], positions])
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    steps, seconds, decision = len(positions), float(recorded["t"][-1]), config.drone.physics_steps
    step_s = config.drone.physics_dt_s
    target = FlightTrack(start, goal, path[::decision], step_s * decision)
    contact = replay_contact(judge, path, step_s, target)
    ends = [clearance(judge, point, step_s * row, target)[0] for row, point in enumerate(path)]
    if contact is not None:
        cut = 1.0 - contact.fraction if contact.segment == steps - 1 else math.inf  # sooner: not as recorded
        lengths[-1] *= 1.0 - cut
        seconds -= cut * config.drone.physics_dt_s
        ends[-1] = 0.0
    low, high = np.asarray(missions.scene.volume, np.float64)
    # Where distances may be too small, a contact is stated that far before one.
    beside = slacks_of(missions.final)[int(pool_missions.scene[0])]
    is_beside = contact is None and 0 < ends[-1] <= beside
    if contact is not None:
        outcome = Outcome.COLLISION
    elif np.any(positions[-1] < low) or np.any(positions[-1] > high):
        outcome = Outcome.LEFT_VOLUME
    elif np.linalg.norm(positions[-1] - goal) < config.env.goal_radius_m:
        outcome = Outcome.GOAL
    else:
        other = Outcome.COLLISION if is_beside else Outcome.DIVERGED
        outcome = Outcome.TIME_OUT if steps == config.env.max_decisions * decision else other
    rewards = recorded["reward"][::decision]
    values = {
        "success": outcome == Outcome.GOAL,
        "outcome": outcome.name.lower(),
        "steps": -(-steps // decision),
        "path_length_m": float(np.sum(lengths)),
        "flight_seconds": seconds,
        "return": float(np.sum(rewards)),
        "min_clearance_m": min(float(min(ends)), EMPTY_M),
    }
    slack = CONTACT_TOLERANCE_M if contact is not None else 0.0
    if beside and (contact is not None or is_beside):
        slack = float(np.linalg.norm(path[-1] - path[-2]))  # anywhere in the last step
    speed = lengths[-1] / config.drone.physics_dt_s if slack else 1.0
    return values, {
        "path_length_m": slack,
        "flight_seconds": slack / max(speed, 1e-3),
        "return": DIGITS * float(np.sum(np.abs(rewards))),
        "min_clearance_m": CLEARANCE_M + slack + beside,
    }


def is_same(one: Any, other: Any, within: float = 0.0) -> bool:
    """Returns whether two values of JSON are equal, numbers up to the digits of files or `within`."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(is_same(one[name], other[name]) for name in one)
    if isinstance(one, Sequence) and isinstance(other, Sequence) and not isinstance(one, str):
        return len(one) == len(other) and all(map(is_same, one, other))
    if _is_number(one) and _is_number(other):
        if min(one, other) >= EMPTY_M:  # clearances where there is nothing to hit
            return True
        return abs(one - other) <= max(within, DIGITS * max(abs(one), abs(other)))
    return one == other


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
