"""Turns and rows of the rivals' benchmark, made up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rivals.planners.planner import PLANNERS


def flights(*outcomes: str, **changes: Any) -> dict[str, list[Any]]:
    """Flights that ended so, each of them otherwise alike."""
    alike = {
        "decisions": 120,
        "flight_seconds": 31.0,
        "path_length_m": 130.0,
        "clearance_m": 0.5,
        "planning_seconds": 0.06,
        "shortest_m": 125.0,
        **changes,
    }
    return {"outcome": list(outcomes), **{key: [value] * len(outcomes) for key, value in alike.items()}}


def turn(seed: int, flown: dict[str, list[Any]], seconds: float = 40.0, **changes: Any) -> dict[str, Any]:
    """A learner's turn, with one point in the middle of its curve, by when nothing was flown."""
    bits = "".join("01"[outcome == "goal"] for outcome in flown["outcome"])
    curve = [
        {"decisions": 500, "seconds": seconds / 2, "validation_success": 0.25, "test": "0" * len(bits)},
        {"decisions": 1000, "seconds": seconds, "validation_success": 0.5, "test": bits},
    ]
    since = {"first_success_decisions": 1000, "first_success_seconds": seconds}
    memory = {"peak_bytes": 10**9, "device_peak_bytes": None}
    return {"seed": seed, "decisions": 1000, "train_seconds": seconds, **since, "curve": curve, "flights": flown} | (
        memory | changes
    )


def row(name: str, turns: Sequence[dict[str, Any]], world: str = "medium", **changes: Any) -> dict[str, Any]:
    kind = "planner" if name in PLANNERS else "learner"
    own = {"settings": {"quick": False, "budget_seconds": 5.0}, "device": "a machine", "reason": None}
    return {"name": name, "world": world, "kind": kind, "knows_map": kind == "planner", "turns": list(turns)} | (
        own | {"devices": [], "versions": {}, "workload": {"width": 32}} | changes
    )
