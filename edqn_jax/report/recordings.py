"""Pictures of recorded events: windows of the camera's own, and what a policy sees and makes of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray
from PIL import Image

from edqn_jax.report.animation import encode_gif
from edqn_jax.report.images import Look, scale_of
from edqn_jax.report.style import MUTED, STYLE, frame, open_figure

MOMENTS = 6
"""Moments of a still picture."""

MAX_FRAMES = 120
"""Frames of the longest GIF; of a longer recording every other window is shown, or fewer."""

COLOURS = 256
"""Of a GIF: greys are to stay grey beside the tints of events."""

DOTS_PER_INCH = 100
SLOWEST_S, FASTEST_S = 0.5, 0.05
"""Longest and shortest time for which a frame is shown, seconds."""


@dataclasses.dataclass(frozen=True)
class Strip:
    """Pictures of one kind, one for each moment."""

    title: str
    pictures: NDArray
    """[M, H, W]; of different strips they may differ in size."""
    look: Look


def pick_windows(windows: int, most: int) -> NDArray[np.int64]:
    """Returns the numbers [M] of at most `most` windows, evenly from the first to the last."""
    return np.unique(np.linspace(0, windows - 1, min(windows, most)).round().astype(np.int64))


def plot_recording(strips: Sequence[Strip], times_s: Sequence[float], file: Path) -> Figure:
    """Draws strips of pictures under each other, one column a moment.

    Args:
        strips: with M pictures each.
        times_s: [M] seconds since the first event.
        file: PNG to write.
    """
    with open_figure(1.75 * len(times_s) + 0.6, 1.45 * len(strips) + 0.2, file) as figure:
        grid = figure.subplots(len(strips), len(times_s), squeeze=False)
        for line, strip in zip(grid, strips, strict=True):
            scale = scale_of(strip.pictures, strip.look)
            for axes, picture in zip(line, strip.pictures, strict=True):
                _image(axes, picture, strip, scale)
                if strip.look.signed:
                    axes.set_xlabel(f"{int(np.abs(picture).sum()):,} net events", fontsize=7, labelpad=2)
            line[0].set_ylabel(strip.title, fontsize=7)
        for axes, time in zip(grid[0], times_s, strict=True):
            axes.set_title(f"t = {time:.2f} s", weight="normal", loc="center", fontsize=8)
    return figure


def animate_recording(strips: Sequence[Strip], times_s: Sequence[float], period_s: float) -> bytes:
    """Returns strips of pictures beside each other as a GIF, one frame a moment.

    Args:
        strips: with M pictures each.
        times_s: [M] seconds since the first event.
        period_s: for which a frame is shown, within what people can follow.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(3.2 * len(strips) + 0.2, 3.0), dpi=DOTS_PER_INCH, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        shown = []
        for axes, strip in zip(figure.subplots(1, len(strips), squeeze=False)[0], strips, strict=True):
            axes.set_title(strip.title.replace("\n", " "), fontsize=9)
            shown.append(_image(axes, strip.pictures[0], strip, scale_of(strip.pictures, strip.look)))
        clock = figure.text(0.99, 0.01, "", ha="right", va="bottom", fontsize=8, color=MUTED)
        frames = []
        for number, time in enumerate(times_s):
            for image, strip in zip(shown, strips, strict=True):
                image.set_data(strip.pictures[number])
            clock.set_text(f"t = {time:.2f} s")
            canvas.draw()
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    return encode_gif(frames, [float(np.clip(period_s, FASTEST_S, SLOWEST_S))] * len(frames), COLOURS)


def _image(axes, picture: NDArray, strip: Strip, scale) -> AxesImage:
    frame(axes)
    # A camera has more pixels than a picture: single events would be lost between its dots.
    return axes.imshow(picture, cmap=strip.look.colours, norm=scale, interpolation="antialiased")
