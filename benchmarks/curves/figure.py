"""The picture of `scaling.py`: a panel for each curve, and one for the bytes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from edqn_jax.report.style import INK, LINE, MUTED, SECOND_LINE, open_figure

COLUMNS = 3
COST = "µs of one device per decision"


def draw_scaling(report: dict[str, Any], file: Path) -> Figure:
    """Writes the report of `scaling.measure` as a PNG and returns the figure."""
    curves = report["curves"]
    rows = math.ceil((len(curves) + 1) / COLUMNS)
    with open_figure(8.4, 0.5 + 2.5 * rows, file) as figure:
        grid = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
        # The same range of costs in all panels, so that they can be compared.
        costs = [row[key] for row in report["rows"] for key in ("us_low", "us_high")]
        for number, (axes, curve) in enumerate(zip(grid, curves, strict=False)):
            _draw_curve(axes, curve, [row for row in report["rows"] if row["curve"] == curve["name"]])
            axes.set_ylim(min(costs) / 1.6, max(costs) * 1.6)
            if number % COLUMNS == 0:
                axes.set_ylabel(COST)
        _draw_memory(grid[len(curves)], report)
        for axes in grid[len(curves) + 1 :]:
            axes.set_axis_off()
        figure.suptitle(_title(report), fontsize=8, color=MUTED, x=0.01, ha="left")
    return figure


def _title(report: dict[str, Any]) -> str:
    stated = report["workload"]
    return (
        f"{report['device']}, {len(report['devices'])} devices. Unless stated otherwise: "
        f"{stated['width']} × {stated['height']} pixels, {stated['obstacles']} obstacles, {stated['num_envs']} "
        f"environments, {stated['physics_steps_per_decision']} physics steps per decision."
    )


def _draw_curve(axes: Axes, curve: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Draws medians with the smallest and largest turn, and the line of linear growth through the first."""
    x, cost, low, high = (np.array([row[key] for row in rows]) for key in ("x", "us_per_decision", "us_low", "us_high"))
    linear = cost[0] * (x / x[0]) ** curve["linear_slope"]
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.plot(x, linear, color=MUTED, lw=1.0, ls=(0, (4, 3)), gid="linear")
    axes.errorbar(x, cost, [cost - low, high - cost], color=LINE, marker="o", ms=4, capsize=2, elinewidth=0.8)
    for at, value, least in zip(x, cost, low, strict=True):
        text = f"{value:,.0f}" if value >= 10 else f"{value:.2g}"
        axes.annotate(text, (at, least), (0, -11), textcoords="offset points", ha="center", fontsize=7, color=INK)
    axes.set_xlim(x[0] / (x[-1] / x[0]) ** 0.15, x[-1] * (x[-1] / x[0]) ** 0.15)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(x, [row["label"].replace(" ", "") for row in rows])
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axes.set_xlabel(curve["name"])
    axes.set_title(f"{x[-1] / x[0]:.3g} × {curve['name']}, {cost[-1] / cost[0]:.3g} × cost")
    ground = {"facecolor": axes.get_facecolor(), "edgecolor": "none", "pad": 1.5}  # covers the line behind the text
    axes.text(0.03, 0.97, _verdict(curve), transform=axes.transAxes, va="top", fontsize=7, color=MUTED, bbox=ground)


def _verdict(curve: dict[str, Any]) -> str:
    text = f"slope {curve['slope']:.2f}, linear (dashed) {curve['linear_slope']:g}"
    return text if curve["efficiency"] is None else f"{text}\nefficiency {curve['efficiency']:.0%}"


def _draw_memory(axes: Axes, report: dict[str, Any]) -> None:
    """Draws the bytes on a logarithmic axis, with their values."""
    memory = report["memory"]
    named = {
        "a replay of 1 000 000 transitions": memory["bytes_of_a_million_transitions"],
        "parameters, optimisers, keys, samples": memory["bytes_of_the_rest"],
        "one environment, in the compiled step": memory["temporary_bytes_per_environment"],
        "one environment, between steps": memory["bytes_per_environment"],
        "one slot of the replay": memory["bytes_per_replay_slot"],
    }
    shown = {name: value for name, value in named.items() if value is not None}
    lowest, highest = min(shown.values()) / 4, max(shown.values()) * 60
    for place, (name, value) in zip(range(len(shown))[::-1], shown.items(), strict=True):
        axes.plot([lowest, value], [place, place], color=SECOND_LINE, lw=1.0)
        axes.plot(value, place, color=SECOND_LINE, marker="o", ms=4)
        axes.annotate(name, (lowest, place), (3, 8), textcoords="offset points", fontsize=7, color=MUTED)
        axes.annotate(_bytes(value), (value, place), (6, 0), textcoords="offset points", fontsize=8, va="center")
    axes.set_xscale("log")
    axes.set_xlim(lowest, highest)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _bytes(value)))
    axes.set_ylim(-0.4, len(shown) - 0.4)
    axes.set_yticks([])
    axes.set_title("Memory")


def _bytes(value: float) -> str:
    """Returns `value` with three digits, in bytes, kB, MB or GB."""
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"
