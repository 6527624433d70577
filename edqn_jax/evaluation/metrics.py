"""Metrics of a set of flights: success with its interval, SPL, path, time and clearance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from edqn_jax.config import Config
from edqn_jax.planning.corridor import shortest_lengths
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome

EMPTY_M = 1e5
"""A clearance beyond this is that of a world without shapes, metres: absent shapes are parked further away."""


def wilson_interval(successes: int, missions: int) -> tuple[float, float]:
    """Returns the 95 % Wilson score interval of a success rate (Wilson 1927)."""
    if missions == 0:
        return 0.0, 1.0
    z = 1.959964  # standard deviations that hold 95 % of a normal distribution
    rate = successes / missions
    scale = 1.0 + z * z / missions
    middle = (rate + z * z / (2 * missions)) / scale
    half = z / scale * math.sqrt(rate * (1 - rate) / missions + z * z / (4 * missions**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def spl(success: np.ndarray, path_lengths: np.ndarray, shortest: np.ndarray) -> float:
    """Returns success weighted by path length (Anderson et al. 2018): mean of S l / max(p, l) over missions [M].

    The shortest path of a failed mission is not used and may be NaN.
    """
    weight = shortest[success] / np.maximum(path_lengths[success], shortest[success])
    return float(np.sum(weight) / len(success))


def fill_unknown_lengths(shortest: np.ndarray, path_lengths: np.ndarray) -> np.ndarray:
    """Returns lengths [M] of shortest paths, metres, where unknown those flown, which have a weight of 1 in the SPL."""
    return np.where(np.isfinite(shortest), shortest, path_lengths)


def shortest_paths(config: Config, env_params: EnvParams, wanted: np.ndarray) -> np.ndarray:
    """Returns the length [M] of the shortest path of each `wanted` [M] mission, metres; NaN for others, and without."""
    missions, chosen = env_params.missions, np.flatnonzero(wanted)
    scene_of, starts, goals = (np.asarray(x)[chosen] for x in (missions.scene, missions.start, missions.goal))
    lengths = np.full(len(wanted), np.nan)
    lengths[chosen] = shortest_lengths(env_params.pool, scene_of, starts, goals, config.drone.body_radius_m)
    return lengths


def summarise_flights(flights: Flights, shortest: np.ndarray | None = None, drones: int = 1) -> dict[str, Any]:
    """Returns the metrics of a set of flights.

    Args:
        flights: M flights.
        shortest: [M] lengths of the shortest paths, metres, NaN where unknown; without them `spl` and
            `path_over_shortest` are None.
        drones: in a group; flights of a group are in a row. 1 leaves out the figures of groups.

    Returns:
        The content of `edqn evaluate --json` without world, seed and latency. `spl` and the mean `return` are
        over all flights; the means of path, decisions and seconds, and the least clearance, over successes
        only (None if there is none). A flight ends at the goal's radius, the shortest path at the goal. Of several
        drones also the collisions with a drone, of which each counts for both, the groups, and those of which all
        arrived; the interval then takes drones for independent, which those of a group are not.
    """
    outcome = np.asarray(flights.outcome)
    counts = {kind: int(np.sum(outcome == kind)) for kind in Outcome}
    success = outcome == Outcome.GOAL
    low, high = wilson_interval(counts[Outcome.GOAL], len(outcome))
    path_lengths = np.asarray(flights.path_length_m, np.float64)

    def mean(values: Any, over: np.ndarray) -> float | None:
        chosen = np.asarray(values, np.float64)[over]
        return float(np.mean(chosen)) if chosen.size else None

    figures: dict[str, Any] = {
        "missions": len(outcome),
        "successes": counts[Outcome.GOAL],
        "success_rate": counts[Outcome.GOAL] / len(outcome),
        "interval": [low, high],
        "collisions": counts[Outcome.COLLISION],
        "left_volume": counts[Outcome.LEFT_VOLUME],
        "timeouts": counts[Outcome.TIME_OUT],
        "diverged": counts[Outcome.DIVERGED],
        "spl": None,
        "path_over_shortest": None,
        "decisions": mean(flights.decisions, success),
        "flight_seconds": mean(flights.flight_seconds, success),
        "path_length_m": mean(path_lengths, success),
        "return": mean(flights.episode_return, np.ones_like(success)),
        "min_clearance_m": float(np.min(flights.closest.distance[success])) if success.any() else None,
    }
    if flights.hit_drone is not None:
        figures["collisions_with_drones"] = int(np.sum(flights.hit_drone))
    if drones > 1:
        whole = success.reshape(-1, drones).all(axis=1)
        figures |= {"groups": len(whole), "groups_arrived": int(whole.sum())}
    if shortest is not None:
        known = success & np.isfinite(shortest)
        figures["spl"] = spl(success, path_lengths, fill_unknown_lengths(shortest, path_lengths))
        figures["path_over_shortest"] = mean(path_lengths / np.where(known, shortest, 1.0), known)
    return figures


def clearance_text(metres: float | None) -> str:
    """Returns a clearance for people: metres, or words where there is none, or nothing to hit."""
    if metres is None:
        return "–"
    if metres > EMPTY_M:
        return "unlimited: nothing to hit"
    return f"{max(metres, 0.0):.2f} m"


def flight_summary(flights: Flights, mission: int = 0) -> dict[str, Any]:
    """Returns what `summary.json` holds of one flight, without the shortest path."""
    outcome = Outcome(int(flights.outcome[mission]))
    return {
        "success": outcome == Outcome.GOAL,
        "outcome": outcome.name.lower(),
        "steps": int(flights.decisions[mission]),
        "path_length_m": float(flights.path_length_m[mission]),
        "return": float(flights.episode_return[mission]),
        "min_clearance_m": float(flights.closest.distance[mission]),
        "flight_seconds": float(flights.flight_seconds[mission]),
        **({} if flights.hit_drone is None else {"hit_drone": bool(flights.hit_drone[mission])}),
    }


def format_duration(seconds: float) -> str:
    """Returns `m:ss`, or `h:mm:ss` from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
