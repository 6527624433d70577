"""The rows of `runtime.py`: turns of one method on one world, and the figures that they come to.

A row keeps its turns, one for each seed, so that rows of several files can be put together.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.planners.planner import SAMPLING
from rivals.intervals import difference_interval, rate_interval

Row = dict[str, Any]


def joined(rows: Iterable[Row]) -> list[Row]:
    """Rows of one method, world, device and setting as one row with the seeds of all.

    Of a method that ran in one place and could not in another the row that says why is left out.

    Raises:
        ConfigError: if a seed is there twice.
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
                raise ConfigError(f"seed {turn['seed']} of {row['name']} on {row['world']} is there twice")
            first["turns"].append(turn)
        first["reason"] = first["reason"] or row["reason"]
    ran = {(row["name"], row["world"]) for row in together.values() if row["turns"]}
    return [row for row in together.values() if row["turns"] or (row["name"], row["world"]) not in ran]


def success(row: Row) -> np.ndarray:
    """Which flights reached the goal: [seeds, missions] bool. Of a planner that draws nothing one seed is all."""
    turns = row["turns"][:1] if row["kind"] == "planner" and row["name"] not in SAMPLING else row["turns"]
    return np.array([[outcome == "goal" for outcome in turn["flights"]["outcome"]] for turn in turns], bool)


def figures(row: Row) -> dict[str, Any]:
    """What a row's turns come to; None where there is nothing to tell.

    Times, decisions, paths and clearance are medians (clearance the least) of the flights that reached the goal;
    the planned path's are of all that were planned. Seeds that never flew nine of ten count as slower than any.
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


# ------------------------------------------------------------------------- what events are worth


@dataclasses.dataclass(frozen=True)
class Worth:
    """Learners on the same missions, with the same budget, on the same device."""

    world: str
    device: str
    decisions: int
    seconds: float
    """What the fastest learner needed for its budget: median over its seeds."""
    rates: list[dict[str, Any]]
    """For each learner `name`, `seconds` of its whole training, and rate and interval `at_decisions`, `at_seconds`."""
    differences: list[dict[str, Any]]
    """E-DQN less each other one, likewise."""


def worth(rows: Sequence[Row]) -> list[Worth]:
    """What events are worth, for each set of learners' rows that can be compared.

    At equal decisions each learner flies what it ends with. At equal wall time it flies what it had kept by then:
    the last point of its curve that lies within the time the fastest one needed; before its first it has nothing.
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
    flown = {row["name"]: {"at_decisions": success(row), "at_seconds": kept_by(row, seconds)} for row in rows}
    rates = [
        {"name": name, "seeds": len(cut["at_decisions"]), "seconds": whole[name]}
        | {at: {"rate": float(bits.mean()), "interval": rate_interval(bits)} for at, bits in cut.items()}
        for name, cut in flown.items()
    ]
    ours = flown.get("E-DQN")
    differences = [
        {"name": name}
        | {
            at: {
                "difference": float(ours[at].mean() - cut[at].mean()),
                "interval": difference_interval(ours[at], cut[at]),
            }
            for at in ours
        }
        for name, cut in flown.items()
        if ours is not None and name != "E-DQN"
    ]
    first = rows[0]
    return Worth(first["world"], first["device"], first["turns"][0]["decisions"], seconds, rates, differences)


def kept_by(row: Row, seconds: float) -> np.ndarray:
    """Which judged missions [seeds, missions] a learner flies with what it has after so many seconds of training."""
    missions = len(row["turns"][0]["flights"]["outcome"])
    bits = []
    for turn in row["turns"]:
        # The median of an even number of seeds lies between two of them.
        points = [point for point in turn["curve"] if point["seconds"] <= seconds * (1 + 1e-9)]
        bits.append([digit == "1" for digit in points[-1]["test"]] if points else [False] * missions)
    return np.array(bits, bool)
