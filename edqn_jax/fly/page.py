"""The page of a logged flight: one HTML file with its path, its course in time, and what happened when."""

from __future__ import annotations

import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.fly.machine import Phase
from edqn_jax.fly.records import read_records
from edqn_jax.report.style import INK, LINE, MUTED, SECOND_LINE, STYLE

COLOURS = {
    Phase.WAITING: "#f2f2f2",
    Phase.READY: "#e3eef6",
    Phase.FLYING: "#ffffff",
    Phase.HOVERING: "#fdf0d5",
    Phase.HOLDING: "#f3e2ec",
    Phase.LANDING: "#f3e2ec",
    Phase.ENDED: "#f2f2f2",
}
"""Behind each phase."""


def flight_page(folder: Path) -> str:
    """Returns the HTML page of the flight in a folder.

    Raises:
        ConfigError: if there is none, or it was cut off before it began.
    """
    records = read_records(folder)
    ticks = [each for each in records if each["kind"] == "tick"]
    begun = next((each for each in records if each["kind"] == "settings"), None)
    if begun is None or not ticks:
        raise ConfigError(f"the flight in '{folder}' was cut off before it began")
    end = next((each for each in reversed(records) if each["kind"] == "end"), {})
    decisions = [each for each in records if each["kind"] == "decision"]
    began = ticks[0]["now"]
    outcome = end.get("outcome", "the log was cut off")
    told = f"{outcome}, {end.get('seconds', ticks[-1]['now'] - began):.1f} s, {len(decisions):,} decisions"
    tables = {
        "What happened": _table(("s", "what"), happenings(records, began)),
        "Newest event to setpoint, ms": _table(
            ("part", "median", "99 %"),
            [(name, f"{a:.1f}", f"{b:.1f}") for name, (a, b) in end.get("latency", {}).items()],
        ),
        "Settings": _table(("what", "value"), [(name, str(value)) for name, value in begun["settings"].items()]),
    }
    parts = "".join(f"<h2>{escape(name)}</h2>{table}" for name, table in tables.items())
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{escape(str(folder))}</title>"
        "<style>body{font:15px sans-serif;max-width:62em;margin:2em auto;padding:0 1em}td,th{text-align:left;"
        "padding:.1em 1em .1em 0;vertical-align:top}svg{max-width:100%;height:auto}</style>"
        f"<h1>{escape(str(folder))}</h1><p>{escape(told)}</p>{_drawn(ticks, begun['settings'], began)}{parts}</html>\n"
    )


def happenings(records: Sequence[dict[str, Any]], began: float) -> list[tuple[str, str]]:
    """Returns when the phase changed and why, and what the vehicle said: seconds since `began`, and words."""
    found, phase = [], None
    for record in records:
        if record["kind"] == "tick" and record["phase"] != phase:
            phase = record["phase"]
            found.append((f"{record['now'] - began:.2f}", phase))
        elif record["kind"] == "said":
            found.append((f"{record['now'] - began:.2f}", f"vehicle: {record['text']}"))
        elif record["kind"] == "end":
            found.append(("", f"outcome: {record['outcome']}"))
    return found


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    if not rows:
        return "<p>Nothing is known.</p>"
    top = "".join(f"<th>{escape(each)}</th>" for each in head)
    lines = "".join("<tr>" + "".join(f"<td>{escape(each)}</td>" for each in row) + "</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{lines}</table>"


def _drawn(ticks: Sequence[dict[str, Any]], settings: dict[str, Any], began: float) -> str:
    """Returns the pictures as SVG: the path from above, and height, speed and events in time."""
    time = np.array([each["now"] for each in ticks]) - began
    own = [each["inputs"]["odometry"] for each in ticks]
    place = np.array([[np.nan] * 3 if each is None else each["position"] for each in own])
    speed = np.linalg.norm([[np.nan] * 3 if each is None else each["velocity"] for each in own], axis=1)
    sent = [each["output"]["velocity"] for each in ticks]
    wanted = np.linalg.norm([[np.nan] * 3 if each is None else each for each in sent], axis=1)
    rate = np.array([each["inputs"]["rate_hz"] for each in ticks])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 8.5), layout="constrained")
        above, height, fast, seen = figure.subplots(4, 1, height_ratios=[2.2, 1, 1, 1])
        _path(above, place, np.array(settings["fence"]), np.array(settings["goal"]))
        height.plot(time, place[:, 2], color=LINE)
        fast.plot(time, speed, color=LINE, label="flown")
        fast.plot(time, wanted, color=SECOND_LINE, linewidth=0.9, label="sent")
        fast.legend(loc="upper right")
        seen.plot(time, rate, color=LINE)
        for axes, name in ((height, "height, m"), (fast, "speed, m/s"), (seen, "events per second")):
            axes.set(ylabel=name, xlim=(time[0], max(time[-1], time[0] + 1e-3)))
            _phases(axes, time, [each["phase"] for each in ticks])
        seen.set_xlabel("seconds since the log began; behind: yellow hovering, violet holding or landing")
        svg = io.StringIO()
        figure.savefig(svg, format="svg")
    text = svg.getvalue()
    return text[text.index("<svg") :]


def _path(axes: Axes, place: NDArray[np.float64], fence: NDArray[np.float64], goal: NDArray[np.float64]) -> None:
    (left, near, _), (right, far, _) = fence
    axes.plot([left, right, right, left, left], [near, near, far, far, near], color=MUTED, linewidth=0.8, label="fence")
    axes.plot(place[:, 0], place[:, 1], color=LINE, label="path")
    axes.plot(goal[0], goal[1], "*", color=SECOND_LINE, markersize=9, label="goal")
    known = place[np.isfinite(place[:, 0])]
    if len(known):
        axes.plot(*known[0, :2], "o", color=INK, markersize=4, label="first seen")
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _phases(axes: Axes, time: NDArray[np.float64], phases: Sequence[str]) -> None:
    changes = [0, *(k for k in range(1, len(phases)) if phases[k] != phases[k - 1]), len(phases) - 1]
    for first, last in zip(changes, changes[1:], strict=False):
        axes.axvspan(time[first], time[last], color=COLOURS[Phase(phases[first])], zorder=-1, linewidth=0)
