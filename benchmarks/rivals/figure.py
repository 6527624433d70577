"""The picture of `runtime.py`: planning time, path length and success of each method for each world."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator, PercentFormatter

from edqn_jax.config import FAMILIES
from edqn_jax.report.style import INK, LINE, MUTED, SECOND_LINE, open_figure
from rivals.rows import EXACT, Row, figures

OURS = "E-DQN"
LEARNER, PLANNER = LINE, SECOND_LINE
CURVES = {
    "E-DQN": LINE,
    "DQN frames": "#e69f00",
    "DQN frame pair": "#56b4e9",
    "DQN blind": "#7a7a7a",
    "DQN depth": "#009e73",
    "DQN ranges": "#cc79a7",
}
"""Colours of Okabe and Ito."""


def draw_runtime(rows: Sequence[Row], file: Path) -> Figure:
    """Writes the rows as a PNG, with a line of panels for each world, and returns the figure."""
    worlds = list(dict.fromkeys(row["world"] for row in rows)) or ["no"]
    most = max((len([row for row in rows if row["world"] == world]) for world in worlds), default=1)
    with open_figure(11.0, 0.4 + len(worlds) * (1.2 + 0.21 * most), file) as figure:
        parts = figure.subfigures(len(worlds), 1, squeeze=False)[:, 0]
        for part, world in zip(parts, worlds, strict=True):
            there = [row for row in rows if row["world"] == world]
            part.suptitle(_title(world, there), fontsize=11, fontweight="bold", x=0.01, ha="left")
            line = part.subplots(1, 4, width_ratios=(1.2, 1.0, 1.1, 1.5))
            _draw_world(line, there)
        figure.supxlabel(_caption(rows), fontsize=7, color=MUTED, x=0.01, ha="left")
    return figure


def _title(world: str, rows: Sequence[Row]) -> str:
    seeds = [len(row["turns"]) for row in rows if row["turns"]]
    if not seeds:
        return _name(world)
    fewest, most = min(seeds), max(seeds)
    return f"{_name(world)}, {most if fewest == most else f'{fewest} to {most}'} seed{'s' if most > 1 else ''}"


def _name(world: str) -> str:
    if world.endswith(".xml"):
        return world
    return f"Unseen {world} worlds" if world in FAMILIES else f"The {world}'s world"


def _caption(rows: Sequence[Row]) -> str:
    devices = ", ".join(dict.fromkeys(row["device"] for row in rows if row["device"]))
    quick = "; quick" if any(row["settings"].get("quick") for row in rows) else ""
    exact = (
        "DQN depth and DQN ranges have exact sensors: upper bounds. " if EXACT & {row["name"] for row in rows} else ""
    )
    return (
        f"{devices}{quick}. Blue: learners, without a map. Orange: planners, with the map. "
        "Planning: computation alone; medians of flights that arrived. Bars: 95 % intervals.\n"
        f"{exact}The paper's world is our reconstruction."
    )


def _draw_world(line: Sequence[Axes], rows: Sequence[Row]) -> None:
    shown = [figures(row) for row in rows]
    several = len({row["device"] for row in rows if row["device"]}) > 1
    names = [f"{row['name']}, {row['device']}" if several and row["device"] else row["name"] for row in rows]
    planning, path, success, curves = line
    places = np.arange(len(rows))[::-1]
    for axes in (planning, path, success):
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_yticks(places, names if axes is planning else [""] * len(rows))
        axes.tick_params(axis="y", length=0)
    for label, row in zip(planning.get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if row["name"] == OURS else "normal")
    planning.set_title("Planning, start to goal")
    path.set_title("Path / shortest")
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
    _widen(planning, path)
    _tick_times(planning)
    success.set_xlim(-0.03, 1.36)
    success.set_xticks([0.0, 0.25, 0.5, 0.75, 1.0])
    success.xaxis.set_major_formatter(PercentFormatter(1.0))
    _draw_curves(curves, rows)


def _dot(axes: Axes, value: float, place: float, colour: str, text: str) -> None:
    axes.plot(value, place, "o", color=colour, ms=4.5)
    axes.annotate(text, (value, place), (6, 0), textcoords="offset points", fontsize=7, color=INK, va="center")


def _aside(axes: Axes, place: float, text: str) -> None:
    """Writes a text in place of a dot."""
    axes.text(0.02, place, text, transform=axes.get_yaxis_transform(), fontsize=7, color=MUTED, va="center")


def _time(seconds: float) -> str:
    if seconds >= 999.5:
        return f"{seconds:,.0f} s"
    for unit, scale in (("s", 1.0), ("ms", 1e3)):
        if seconds * scale >= 0.9995:
            return f"{seconds * scale:.3g} {unit}"
    return f"{seconds * 1e6:.3g} µs"


def _tick_times(axes: Axes) -> None:
    """Sets at least two ticks on a logarithmic axis of seconds."""
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 50 * low else (1.0,)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _time(value)))


def _widen(planning: Axes, path: Axes) -> None:
    """Extends both axes to the right for the texts beside the dots; that of times covers at least a decade."""
    low, high = planning.get_xlim()
    low = min(low, high / 10)
    planning.set_xlim(low, high * (high / low) ** 0.3)
    low, high = path.get_xlim()
    path.set_xlim(low, high + 0.3 * (high - low))


def _draw_curves(axes: Axes, rows: Sequence[Row]) -> None:
    """Draws the validation success over training time, a line for each seed."""
    axes.set_title("Validation success")
    axes.set_ylim(-0.03, 1.03)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("training time (log scale)")
    for row in rows:
        colour, number = CURVES.get(row["name"], INK), 0
        for turn in row["turns"] if row["kind"] == "learner" else []:
            points = np.array([(point["seconds"], point["validation_success"]) for point in turn["curve"]])
            if len(points):
                label = row["name"] if number == 0 else None
                width = 1.6 if row["name"] == OURS else 1.0
                axes.plot(*points.T, ".-", color=colour, lw=width, ms=3, alpha=0.8, label=label)
                number += 1
    if axes.get_lines():
        axes.set_xscale("log")
        _tick_times(axes)
        # Beside the panel, because within it the legend would cover lines.
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
