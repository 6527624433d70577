"""The rows of `runtime.py`: the results of one method on one world, one for each seed, and the figures of them all.

A row keeps the result of each seed (`turns`), so that rows of several files can be joined.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.intervals import rate_interval
from measurement.intervals import difference_interval
from rivals.planners.planner import SAMPLING

Row = dict[str, Any]

EXACT = {"DQN depth", "DQN ranges"}
"""Learners with sensors that no real drone has."""


def join_rows(rows: Iterable[Row]) -> list[Row]:
    """Joins the rows of the same method, world, device and settings into one row with all seeds.

    A row of a method that could not run is left out if the method ran in another row of that world.

    Raises:
        ConfigError: if a seed occurs twice.
    """
    together: dict[str, Row] = {}
    for row in rows:
        key = str([row[part] for part in ("name", "world", "device", "settings")])
        if key not in together:
            together[key] = {**row, "turns": list(row["turns"])}
            continue
        first = together[key]
        seeds = {turn["seed"] for turn in first["turns"]}
        for turn in row["turns"]:
            if turn["seed"] in seeds:
                raise ConfigError(f"seed {turn['seed']} of {row['name']} on {row['world']} occurs twice")
            first["turns"].append(turn)
        first["reason"] = first["reason"] or row["reason"]
    ran = {(row["name"], row["world"]) for row in together.values() if row["turns"]}
    return [row for row in together.values() if row["turns"] or (row["name"], row["world"]) not in ran]


def success(row: Row) -> np.ndarray:
    """Returns which flights reached the goal, [seeds, missions] bool; of a deterministic planner only one seed."""
    turns = row["turns"][:1] if row["kind"] == "planner" and row["name"] not in SAMPLING else row["turns"]
    return np.array([[outcome == "goal" for outcome in turn["flights"]["outcome"]] for turn in turns], bool)


def figures(row: Row) -> dict[str, Any]:
    """Returns the figures of a row; None where there is no value.

    Times, decisions and path lengths are medians, and clearance the minimum, of the flights that reached the goal;
    planned lengths are of all planned paths. Training times of seeds without a first success count as infinite.
    """
    turns = row["turns"]
    if not turns:
        return {}
    arrived = success(row)
    low, high = rate_interval(arrived)
    flights = [
        dict(zip(turn["flights"], values, strict=True))
        for turn in turns
        for values in zip(*turn["flights"].values(), strict=True)
    ]
    good = [flight for flight in flights if flight["outcome"] == "goal"]
    planned = [flight for flight in flights if flight["outcome"] != "no_path"]
    since = [turn.get("first_success_seconds") for turn in turns]
    after = [turn.get("first_success_decisions") for turn in turns]
    return {
        "success": float(arrived.mean()),
        "successes": int(arrived.sum()),
        "flights": int(arrived.size),
        "interval": [low, high],
        "train_seconds": _median_or_never(since),
        "train_decisions": _median_or_never(after),
        "budget_seconds": _median([turn.get("train_seconds") for turn in turns]),
        "planning_seconds": _median([flight["planning_seconds"] for flight in good]),
        "flight_seconds": _median([flight["flight_seconds"] for flight in good]),
        "decisions": _median([flight["decisions"] for flight in good]),
        "path_over_shortest": _median([_ratio(flight, "path_length_m") for flight in good]),
        "planned_over_shortest": _median([_ratio(flight, "planned_m") for flight in planned]),
        "clearance_m": min((flight["clearance_m"] for flight in good), default=None),
        "peak_bytes": max(turn["peak_bytes"] for turn in turns),
        "device_peak_bytes": max(turn["device_peak_bytes"] or 0 for turn in turns) or None,
        "reasons": sorted({flight["reason"] for flight in flights if flight.get("reason")}),
    }


def _ratio(flight: dict[str, Any], key: str) -> float | None:
    if flight.get(key) is None or flight["shortest_m"] is None:
        return None
    return flight[key] / flight["shortest_m"]


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _median_or_never(values: Sequence[float | None]) -> float | None:
    median = statistics.median([np.inf if value is None else value for value in values])
    return float(median) if np.isfinite(median) else None


# ------------------------------------------------------------------------ learners at equal budget


@dataclasses.dataclass(frozen=True)
class Worth:
    """Learners compared on the same missions, with the same budget, on the same device."""

    world: str
    device: str
    decisions: int
    seconds: float
    """Training time of the fastest learner: median over its seeds."""
    rates: list[dict[str, Any]]
    """For each learner `name`, `seconds` of its whole training, and rate and interval `at_decisions`, `at_seconds`."""
    differences: list[dict[str, Any]]
    """The same for E-DQN minus each other learner."""


def worth(rows: Sequence[Row]) -> list[Worth]:
    """Compares the learners of each set of rows that can be compared.

    At equal decisions each learner flies its final parameters. At equal wall time it flies those that it had kept when
    the fastest learner ended: the last point of its curve within that time. Before its first point it has no success.
    """
    sets: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        if row["kind"] == "learner" and row["turns"] and len(row["turns"][0]["flights"]["outcome"]) > 1:
            key = row["world"], row["device"], str(row["settings"])
            sets.setdefault(key, []).append(row)
    return [_worth(rows) for rows in sets.values() if len(rows) > 1]


def _worth(rows: Sequence[Row]) -> Worth:
    whole = {row["name"]: statistics.median(turn["train_seconds"] for turn in row["turns"]) for row in rows}
    seconds = min(whole.values())
    successes = {row["name"]: {"at_decisions": success(row), "at_seconds": kept_by(row, seconds)} for row in rows}
    rates = [
        {"name": name, "seeds": len(cut["at_decisions"]), "seconds": whole[name]}
        | {at: {"rate": float(bits.mean()), "interval": rate_interval(bits)} for at, bits in cut.items()}
        for name, cut in successes.items()
    ]
    ours = successes.get("E-DQN")
    differences = [
        {"name": name}
        | {
            at: {
                "difference": float(ours[at].mean() - cut[at].mean()),
                "interval": difference_interval(ours[at], cut[at]),
            }
            for at in ours
        }
        for name, cut in successes.items()
        if ours is not None and name != "E-DQN"
    ]
    first = rows[0]
    return Worth(first["world"], first["device"], first["turns"][0]["decisions"], seconds, rates, differences)


def kept_by(row: Row, seconds: float) -> np.ndarray:
    """Returns which test missions a learner completes after so many seconds of training, [seeds, missions] bool."""
    missions = len(row["turns"][0]["flights"]["outcome"])
    bits = []
    for turn in row["turns"]:
        # The median of an even number of seeds lies between two of them.
        points = [point for point in turn["curve"] if point["seconds"] <= seconds * (1 + 1e-9)]
        bits.append([digit == "1" for digit in points[-1]["test"]] if points else [False] * missions)
    return np.array(bits, bool)
