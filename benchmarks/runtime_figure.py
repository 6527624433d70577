"""The picture of `runtime.py`: for each world how long each method plans, how far it flies and how often it arrives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator, PercentFormatter

from edqn_jax.report.style import INK, LINE, MUTED, SECOND_LINE, drawing
from rows import Row, figures

OURS = "E-DQN"
LEARNER, PLANNER = LINE, SECOND_LINE
CURVES = {
    "E-DQN": LINE,
    "DQN frames": "#e69f00",
    "DQN blind": "#7a7a7a",
    "DQN depth": "#009e73",
    "DQN ranges": "#cc79a7",
}
"""Okabe and Ito's colours again."""


def draw_runtime(rows: Sequence[Row], file: Path) -> Figure:
    """The rows as a PNG: a line of panels for each world."""
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    most = max((len([row for row in rows if row["world"] == world]) for world in worlds), default=1)
    with drawing(11.0, 0.7 + len(worlds) * (1.0 + 0.22 * most), file) as figure:
        grid = figure.subplots(len(worlds), 4, squeeze=False, width_ratios=(1.2, 0.9, 0.9, 1.2))
        for line, world in zip(grid, worlds, strict=True):
            _draw_world(line, world, [row for row in rows if row["world"] == world])
        figure.suptitle(_title(rows), fontsize=8, color=MUTED, x=0.01, ha="left")
    return figure


def _title(rows: Sequence[Row]) -> str:
    devices = ", ".join(dict.fromkeys(row["device"] for row in rows if row["device"]))
    seeds = max((len(row["turns"]) for row in rows), default=0)
    quick = "; a quick run, learners have not converged" if any(row["settings"].get("quick") for row in rows) else ""
    return f"{devices}; {seeds} seeds{quick}. Blue: learns, has no map. Orange: plans on the map."


def _draw_world(line: Sequence[Axes], world: str, rows: Sequence[Row]) -> None:
    names, shown = [], [figures(row) for row in rows]
    several = len({row["device"] for row in rows if row["device"]}) > 1
    for row in rows:
        names.append(f"{row['name']}, {row['device']}" if several and row["device"] else row["name"])
    planning, path, success, curves = line
    places = np.arange(len(rows))[::-1]
    for axes in (planning, path, success):
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_yticks(places, names if axes is planning else [""] * len(rows))
        axes.tick_params(axis="y", length=0)
    for label, row in zip(planning.get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if row["name"] == OURS else "normal")
    title = f"{world} world" if not world.endswith(".xml") else world
    planning.set_title(f"{title}: planning, start to goal")
    path.set_title("Flown path / shortest")
    success.set_title("Success")
    for place, row, figure in zip(places, rows, shown, strict=True):
        colour = PLANNER if row["kind"] == "planner" else LEARNER
        if not figure:
            _aside(planning, place, "not measured")
            continue
        if figure["planning_seconds"] is None:
            _aside(planning, place, "never arrived")
        else:
            _dot(planning, figure["planning_seconds"], place, colour, _time(figure["planning_seconds"]))
        if figure["path_over_shortest"] is not None:
            _dot(path, figure["path_over_shortest"], place, colour, f"{figure['path_over_shortest']:.2f}")
        low, high = figure["interval"]
        success.plot([low, high], [place, place], color=colour, lw=3.0, alpha=0.35, solid_capstyle="butt")
        success.plot(figure["success"], place, "o", color=colour, ms=4.5)
        count = f"{figure['successes']} of {figure['flights']}"
        success.annotate(count, (1.06, place), fontsize=7, color=MUTED, va="center")
    planning.set_xscale("log")
    planning.xaxis.set_major_locator(LogLocator())
    planning.xaxis.set_minor_locator(NullLocator())
    planning.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _time(value)))
    _widen(planning, path)
    success.set_xlim(-0.03, 1.36)
    success.set_xticks([0.0, 0.25, 0.5, 0.75, 1.0])
    success.xaxis.set_major_formatter(PercentFormatter(1.0))
    _draw_curves(curves, rows)


def _dot(axes: Axes, value: float, place: float, colour: str, text: str) -> None:
    axes.plot(value, place, "o", color=colour, ms=4.5)
    axes.annotate(text, (value, place), (6, 0), textcoords="offset points", fontsize=7, color=INK, va="center")


def _aside(axes: Axes, place: float, text: str) -> None:
    """What stands in the place of a dot."""
    axes.text(0.02, place, text, transform=axes.get_yaxis_transform(), fontsize=7, color=MUTED, va="center")


def _time(seconds: float) -> str:
    for unit, scale in (("s", 1.0), ("ms", 1e3)):
        if seconds * scale >= 0.9995:
            return f"{seconds * scale:.3g} {unit}"
    return f"{seconds * 1e6:.3g} µs"


def _widen(planning: Axes, path: Axes) -> None:
    """Room on the right for what stands beside the dots."""
    low, high = planning.get_xlim()
    planning.set_xlim(low, high * (high / low) ** 0.3)
    low, high = path.get_xlim()
    path.set_xlim(low, high + 0.3 * (high - low))


def _draw_curves(axes: Axes, rows: Sequence[Row]) -> None:
    """Share of validation missions flown after so many seconds of training, a thin line a seed."""
    axes.set_title("Learning: validation missions flown")
    axes.set_ylim(-0.03, 1.03)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("seconds of training")
    for row in rows:
        if row["kind"] != "learner" or not row["turns"]:
            continue
        colour = CURVES.get(row["name"], INK)
        for number, turn in enumerate(row["turns"]):
            points = [(0.0, 0.0), *((point["seconds"], point["validation_success"]) for point in turn["curve"])]
            label = row["name"] if number == 0 else None
            axes.plot(*np.array(points).T, color=colour, lw=1.6 if row["name"] == OURS else 1.0, alpha=0.8, label=label)
    if axes.get_lines():
        axes.legend(loc="lower right")
