"""Type, lines and colours of every picture of the project, and how a picture is written to a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.spines import Spine

OUTCOME_COLOURS = {
    "goal": "#009e73",
    "collision": "#d55e00",
    "left_volume": "#cc79a7",
    "time_out": "#e69f00",
    "diverged": "#000000",
}
"""Colour of each outcome, of Okabe and Ito's palette, which colour-blind readers can tell apart."""

OUTCOME_LABELS = {
    "goal": "goal",
    "collision": "collision",
    "left_volume": "left the volume",
    "time_out": "time-out",
    "diverged": "diverged",
}

INK = "#222222"
MUTED = "#7a7a7a"
LINE = "#0072b2"
SECOND_LINE = "#d55e00"

POLARITY = LinearSegmentedColormap.from_list("polarity", ["#1f4fb4", "#8fb0e6", "#ffffff", "#f0988b", "#c4221f"])
"""Signed event counts: blue darker, white nothing, red brighter."""

COUNTS = LinearSegmentedColormap.from_list("counts", ["#ffffff", "#c5b3d9", "#6a3d9a", "#2d1245"])
"""Event counts whatever their sign: white nothing, violet many."""

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "lines.linewidth": 1.4,
}

DOTS_PER_INCH = 220


@contextmanager
def open_figure(width: float, height: float, file: Path) -> Iterator[Figure]:
    """Makes a figure of `width` x `height` inches in the project's style, written to `file` at the end of the block."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), dpi=DOTS_PER_INCH, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        yield figure
        file.parent.mkdir(parents=True, exist_ok=True)
        canvas.print_png(file)  # `savefig` lays everything out twice


def frame(axes: Axes, linewidth: float = 0.5, **style: Any) -> list[Spine]:
    """Draws a line around a picture, without ticks and grid, and returns its four sides."""
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set(visible=True, color=MUTED, linewidth=linewidth, **style)
    return list(axes.spines.values())
