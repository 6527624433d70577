"""The tables of `runtime.py`: results of each method, learners at equal budget, and the paper's Table 3."""

from __future__ import annotations

import statistics
from collections.abc import Sequence, Set
from typing import Any

from rivals.planners.planner import IMPROVING
from rivals.rows import EXACT, Row, Worth, figures, worth
from rivals.stack import STACK

PAPER_SOURCE = "Chao, Dillmann, Roennau, Xiong, Biomimetics 2024, 9(4), 238, Table 3"
PAPER_RUN_TIME_S = {"E-DQN": 41.364, "DQN": 161.88, "SNN": 155.4}
"""Figures of the paper; one run each."""

COLUMNS = (
    "method",
    "knows the map",
    "trains, s (decisions)",
    "plans, ms",
    "flies, s",
    "decisions",
    "path / shortest",
    "planned / shortest",
    "success",
    "least clearance, m",
    "memory, MB",
    "device",
)

EXPLAINED = """\
- Trains: seconds of training, and decisions, until the first validation in which nine of ten missions from the world's
  start, or near it, succeed; medians over seeds, "never" if the median seed never does. Compilation and validation are
  not counted.
- Plans: computation from start to goal, without simulation and compilation. For a learner the sum over the decisions of
  a flight, each from an observation on the host to the action on the host; for a planner the time until the path that
  is flown. RRT* and BIT* use their whole budget, given after their name, unless they find the straight line; in the
  rows "first path" they end with their first path.
- Flies (simulated seconds), decisions, path, plans: medians of the flights that reached the goal. A flight ends within
  the goal's radius, the shortest path (A*'s) at the goal itself. Clearance is the minimum of these flights. Planned
  paths are flown at 4 m/s at most; learners fly up to 4 m/s along each axis, 6.9 m/s along the diagonal of all three.
  This limits the comparison of flight times.
- Planned: length of the planned path. Planners keep a reserve beyond the body's radius for the follower, whose flights
  are judged by the same rules.
- Success: with Wilson's 95 % interval; over seeds and missions, with a bootstrap of both. A deterministic planner
  counts once.
- Memory: peak memory of the method's process and its workers, with JAX and the airframe, plus that of the
  accelerator."""

BOUNDS = "- DQN depth and DQN ranges have exact sensors, which no real drone has: they are upper bounds."

PARAGRAPH = """\
The paper says that "the running time of the entire planning process was 41.364 s" and calls these figures
path-planning time, but does not say what was computed in it. For its flight of 188 steps 41.364 s is 0.22 s per step,
so it probably includes the time to fly the plan through the API of a simulator. It then corresponds to "flies" rather
than to "plans": a method is faster because its path is shorter or its simulator faster, not because it computes less.
It is unlikely to be the time to learn. The figures are of one run each, on the authors' map and machine, without an
interval, so their ratio to ours has no meaning."""


def text(rows: Sequence[Row], rates: Sequence[dict[str, Any]]) -> str:
    """Returns all tables as Markdown."""
    parts = []
    for world in dict.fromkeys(row["world"] for row in rows):
        own = [row for row in rows if row["world"] == world]
        parts.append(f"## {world}\n\n{methods(own)}")
    parts += [explain({row["name"] for row in rows}), paper()]
    parts += [worth_table(one) for one in worth(rows)]
    parts += [rates_table(one) for one in rates]
    return "\n\n".join(parts)


def explain(names: Set[str]) -> str:
    """Returns what the columns mean, and of methods of these names what else must be known."""
    return "\n".join([EXPLAINED, *([BOUNDS] if names & EXACT else [])])


def methods(rows: Sequence[Row]) -> str:
    """Returns the rows of one world as a table, with the reasons of empty rows."""
    lines = [f"| {' | '.join(COLUMNS)} |", "| --- | --- |" + " ---: |" * (len(COLUMNS) - 3) + " --- |"]
    notes = []
    for row in rows:
        shown = figures(row)
        name = row["name"]
        if row["kind"] == "learner" and row["settings"].get("quick"):
            name += " (quick)"
        elif name in IMPROVING:
            name += f", {row['settings']['budget_seconds']:g} s"
        if row["reason"] is not None:
            notes.append(f"{row['name']}: {row['reason']}.")
        elif shown["reasons"] and not shown["success"]:
            notes.append(f"{row['name']}: {shown['reasons'][0]}.")
        lines.append(f"| {name} | {'yes' if row['knows_map'] else 'no'} | {' | '.join(_cells(row, shown))} |")
    return "\n".join([*lines, *([""] if notes else []), *(f"- {note}" for note in notes)])


def _cells(row: Row, shown: dict[str, Any]) -> list[str]:
    if not shown:
        return ["–"] * (len(COLUMNS) - 3) + [row["device"] or "–"]
    trains = "–"
    if row["kind"] == "learner":
        seconds, decisions = shown["train_seconds"], shown["train_decisions"]
        trains = "never" if seconds is None else f"{seconds:.1f} ({decisions:,.0f})"
    low, high = shown["interval"]
    memory = f"{shown['peak_bytes'] / 1e6:,.0f}"
    if shown["device_peak_bytes"]:
        memory += f" + {shown['device_peak_bytes'] / 1e6:,.0f}"
    return [
        trains,
        _number(shown["planning_seconds"], "{:,.1f}", 1e3),
        _number(shown["flight_seconds"], "{:.1f}"),
        _number(shown["decisions"], "{:g}"),
        _number(shown["path_over_shortest"], "{:.3f}"),
        _number(shown["planned_over_shortest"], "{:.3f}"),
        f"{shown['successes']} of {shown['flights']}: {shown['success']:.0%} ({low:.0%} - {high:.0%})",
        _number(shown["clearance_m"], "{:.2f}"),
        memory,
        row["device"],
    ]


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "–" if value is None else form.format(scale * value)


def paper() -> str:
    """Returns Table 3 of the paper, with its interpretation."""
    lines = ["## Table 3 of the paper (its authors' figures)", "", "| method | run time, s |", "| --- | ---: |"]
    lines += [f"| {name} | {seconds:g} |" for name, seconds in PAPER_RUN_TIME_S.items()]
    return "\n".join([*lines, "", f"{PAPER_SOURCE}. {PARAGRAPH}"])


def worth_table(one: Worth) -> str:
    """Returns the comparison of learners at equal decisions and equal wall time."""
    lines = [
        f"## Learners at equal budget: {one.world}, {one.device}",
        "",
        f"Equal decisions are {one.decisions:,}; equal wall time is {one.seconds:.1f} s of training, the time of the "
        "fastest learner without compilation. The slower ones are then in the middle of their schedules of "
        "exploration and learning rate, which extend over all decisions.",
        "",
        "| learner | seeds | whole training, s | at equal decisions | at equal wall time |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    cuts = "at_decisions", "at_seconds"
    for rate in one.rates:
        cells = [_rate(rate[at]["rate"], rate[at]["interval"]) for at in cuts]
        lines.append(f"| {rate['name']} | {rate['seeds']} | {rate['seconds']:.1f} | {' | '.join(cells)} |")
    for less in one.differences:
        cells = [_rate(less[at]["difference"], less[at]["interval"], "+") for at in cuts]
        lines.append(f"| E-DQN minus {less['name']} | | | {' | '.join(cells)} |")
    return "\n".join(lines)


def rates_table(one: dict[str, Any]) -> str:
    """Returns the training rates, and the ratio of E-DQN's median to that of the best conventional setting."""
    title = f"## Training rates: {one.get('device') or 'not measured'}"
    if one["reason"] is not None:
        return f"{title}\n\n- {one['reason']}."
    medians = {name: statistics.median(turns) for name, turns in one["turns"].items()}
    ours, theirs = (max(v for n, v in medians.items() if n.startswith(f"{who},")) for who in ("E-DQN", STACK))
    stated = one["workload"]
    lines = [
        title,
        "",
        f"Steady training on the paper's world, {stated['num_envs']} environments, "
        f"{stated['replayed_samples_per_decision']:g} replayed and {stated['vae_samples_per_decision']:g} VAE samples "
        "per decision; medians of turns.",
        "",
        "| method | decisions/s |",
        "| --- | ---: |",
        *(f"| {name} | {rate:,.0f} |" for name, rate in medians.items()),
        f"| E-DQN / {STACK}, best setting | {ours / theirs:.1f} |",
    ]
    return "\n".join(lines)


def _rate(rate: float, interval: Sequence[float], sign: str = "") -> str:
    low, high = interval
    return f"{100 * rate:{sign}.1f} % ({100 * low:{sign}.1f} - {100 * high:{sign}.1f})"
