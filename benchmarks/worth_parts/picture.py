"""The map of `worth.py` as one picture: who leads where, with "no difference" as a colour of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

import success
from edqn_jax.errors import ConfigError
from edqn_jax.report.style import INK, MUTED, open_figure
from worth_parts import traffic
from worth_parts.axes import AXES, BLIND, CLOCK, DEPTH, RATES_HZ
from worth_parts.table import Cell, best_of, rows_of, verdict_of

WHITE = "#ffffff"

COLOURS = {
    "events": "#e69f00",
    "frames": "#56b4e9",
    "frame-pair": "#3f7fbf",
    "frame-difference": "#7f6fc4",
    "frames or pairs": "#9cc3e0",
    **{f"frame-pair{CLOCK}{rate}": "#3f7fbf" for rate in RATES_HZ},
    "depth": "#009e73",
    "depth-late-1": "#a6d9c7",
    "depth-late-2": "#d3ece4",
    "no difference": "#d9d9d9",
    "–": WHITE,
}
"""By verdict; those of the bytes are `events`, `frames` and `no difference`."""

DEEP = {"depth", *(verdict for verdict in COLOURS if verdict.startswith("frame-"))}
"""Verdicts whose colours want light letters."""

LABELS = {
    "events": "events lead (bytes: events cost less)",
    "frames": "one frame leads (bytes: frames cost less)",
    "frame-pair": "frame pair leads",
    "frame-difference": "difference of the pair leads",
    "frames or pairs": "frames or pairs, events behind",
    **{f"frame-pair{CLOCK}{rate}": f"frame pair at {rate} a second leads" for rate in RATES_HZ},
    "depth": "fresh depth ahead of older",
    "depth-late-1": "depth one observation old leads",
    "depth-late-2": "depth two observations old leads",
    "no difference": "no difference",
}

SHORT = {
    **{"frames": "frame", "frame-pair": "pair", "frame-difference": "diff.", BLIND: "blind"},
    **{f"frame-pair{CLOCK}{rate}": f"{rate} Hz" for rate in RATES_HZ},
    **{DEPTH: "fresh", "depth-late-1": "1 late", "depth-late-2": "2 late"},
}

CONTRASTS = (0.05, 0.2)
"""Of the sensors whose bytes are drawn; tables have others, and more resolutions than the smallest and the largest."""

HATCH, PARTIAL = "//", "hatched: not every sensor of the axis was flown"
"""Of cells, and what the legend says of it."""

MOST_NAMED = 3
"""Sensors that are named in a cell; more are counted."""

FEWEST_COLUMNS = 6
"""For which a panel has room, so that its title has."""

ROW_IN, LABEL_IN, CELL_IN, HEAD_IN = 0.42, 2.1, 1.02, 0.62
"""Height of a row, width of row labels, width of a column, and height over a panel, inches."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """A grid of cells."""

    title: str
    rows: list[str]
    columns: list[str]
    cells: dict[tuple[str, str], tuple[str, str]]
    """By row and column: who leads, and what is written there."""
    partial: set[tuple[str, str]] = dataclasses.field(default_factory=set)
    """Those in which a sensor of the axis was not flown."""


def draw_map(rows: Sequence[success.Row], cells: Mapping[str, Sequence[Cell]], file: Path) -> Figure:
    """Writes the map as a PNG, a panel for each axis of which there are rows, and returns the figure.

    Args:
        rows: all.
        cells: of `table.all_cells`.
        file: that is written.

    Raises:
        ConfigError: if there are no rows.
    """
    panels = [_flights_panel(name, found) for name, found in cells.items()]
    if counted := rows_of(rows, "bytes"):
        panels.append(_bytes_panel(counted))
    if not panels:
        raise ConfigError(f"there are no rows of this benchmark beside '{file}'; measure some with --axis first")
    heights = [HEAD_IN + ROW_IN * len(panel.rows) for panel in panels]
    width = LABEL_IN + CELL_IN * max(FEWEST_COLUMNS, *(len(panel.columns) for panel in panels)) + 0.2
    shown = {who for panel in panels for who, _ in panel.cells.values()}
    foot = 0.3 + 0.2 * -(-(len(shown) + any(panel.partial for panel in panels)) // 3)
    height = sum(heights) + foot
    with open_figure(width, height, file) as figure:
        figure.set_layout_engine("none")  # panels are placed to the inch
        top = height
        for panel, tall in zip(panels, heights, strict=True):
            top -= tall
            across = CELL_IN * len(panel.columns)
            box = (LABEL_IN / width, top / height, across / width, ROW_IN * len(panel.rows) / height)
            _draw_panel(figure.add_axes(box), panel)
        marks = [Patch(color=COLOURS[who], label=LABELS[who]) for who in LABELS if who in shown]
        if any(panel.partial for panel in panels):
            marks.append(Patch(facecolor=COLOURS["no difference"], hatch=HATCH, edgecolor="white", label=PARTIAL))
        figure.legend(handles=marks, loc="lower left", ncols=3, frameon=False, fontsize=7, bbox_to_anchor=(0.01, 0.0))
    return figure


def _flights_panel(name: str, cells: Sequence[Cell]) -> Panel:
    axis, found, heads, sides, partial = AXES[name], {}, [], [], set()
    for cell in cells:
        column, _, aside = cell.flown.partition(", ")
        parts = [cell.world, f"trained: {cell.trained}", aside]
        side = ", ".join(part for part in parts if part)
        heads += [column] if column not in heads else []
        sides += [side] if side not in sides else []
        best = best_of(cell)
        found[side, column] = verdict_of(best, cell.rivals), _written(cell, best)
        if cell.missing:
            partial.add((side, column))
    return Panel(f"{axis.question}: success in %, blind → best → depth", sides, heads, found, partial)


def _written(cell: Cell, best: Sequence[str]) -> str:
    """Returns success as blind → best → depth, the best and who is level with it, and whether blind is ahead of it."""
    named = [sensor for sensor in (BLIND, *best[:1], DEPTH) if sensor in cell.arrived]
    rates = " → ".join(f"{100 * cell.arrived[sensor].mean():.0f}" for sensor in dict.fromkeys(named))
    tied = f"{len(best)} of {len(cell.rivals)} alike" if len(best) > MOST_NAMED else _named(best)
    blinded = BLIND in cell.arrived and best and cell.lead(BLIND, best[0])[0] > 0
    return f"{rates}\n{tied}" + ("\nblind is ahead" if blinded else "")


def _named(sensors: Sequence[str]) -> str:
    return ", ".join(SHORT.get(sensor, sensor) for sensor in sensors)


def _bytes_panel(rows: Sequence[success.Row]) -> Panel:
    found, sides = {}, []
    columns = {(each, rate): f"{each:g}, {rate} a second" for each in CONTRASTS for rate in traffic.FRAME_RATES}
    ends = {of([row["width"] for row in rows]) for of in (min, max)}
    for row in sorted(rows, key=lambda row: (traffic.WORLDS.index(row["world"]), row["width"])):
        if row["width"] not in ends:
            continue
        side = f"{row['world']}, {row['look']}, {row['width']} × {row['height']}"
        sides.append(side)
        for (contrast, rate), column in columns.items():
            even, low, high = traffic.break_even(row, str(contrast), traffic.EVENT_BYTES[0])
            who = "events" if high < rate else "frames" if low > rate else "no difference"
            found[side, column] = who, f"{even / rate:.2g}"
    title = (
        f"Bytes of events, by contrast and {traffic.EVENT_BYTES[0]} each, over those of so many 8-bit frames a second; "
        "below 1 events cost less"
    )
    return Panel(title, sides, list(columns.values()), found)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for (row, column), (who, said) in panel.cells.items():
        x, y = panel.columns.index(column), panel.rows.index(row)
        hatch = HATCH if (row, column) in panel.partial else None
        edge = "#d9d9d9" if COLOURS[who] == WHITE and hatch else WHITE
        axes.add_patch(Rectangle((x, y), 1, 1, facecolor=COLOURS[who], edgecolor=edge, linewidth=1.5, hatch=hatch))
        ink = WHITE if who in DEEP else INK
        under = {"facecolor": COLOURS[who], "edgecolor": "none", "pad": 1} if hatch else None
        axes.text(
            x + 0.5, y + 0.5, said, ha="center", va="center", fontsize=6.5, color=ink, linespacing=1.3, bbox=under
        )
    axes.set_xlim(0, len(panel.columns))
    axes.set_ylim(len(panel.rows), 0)
    axes.set_xticks([x + 0.5 for x in range(len(panel.columns))], panel.columns, fontsize=7)
    axes.set_yticks([y + 0.5 for y in range(len(panel.rows))], panel.rows, fontsize=7)
    axes.xaxis.tick_top()
    axes.tick_params(length=0, colors=MUTED)
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_title(panel.title, fontsize=8, loc="left", pad=16, color=INK)
