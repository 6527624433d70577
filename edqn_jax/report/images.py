"""Pictures of what the drone sees: RGB beside events (Fig. 6 of the paper), and what its code keeps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from edqn_jax.report.style import INK, MUTED, POLARITY, drawing


def draw_events(
    rgb: np.ndarray,
    native_rgb: np.ndarray,
    counts: np.ndarray,
    file: Path,
    times_s: Sequence[float] | None = None,
) -> Figure:
    """RGB, fine and as the drone's camera has it, above the event image, one column a moment.

    Args:
        rgb: [M, H, W, 3] brightness in [0, 1] at any resolution.
        native_rgb: [M, h, w, 3] brightness in [0, 1] at the camera's own.
        counts: [M, h, w] events, negative where it grew darker.
        file: PNG to write.
        times_s: [M] seconds into the flight, for the titles.
    """
    height, width = np.shape(counts)[1:]
    rows = [("RGB", rgb), (f"RGB, {width} × {height}", native_rgb), (f"events, {width} × {height}", counts)]
    moments = len(counts)
    scale = _symmetric(counts)
    with drawing(1.75 * moments + 0.9, 4.1, file) as figure:
        grid = figure.subplots(len(rows), moments, squeeze=False)
        for row, (name, pictures) in enumerate(rows):
            for column, picture in enumerate(np.asarray(pictures)):
                axes = grid[row, column]
                _show(axes, picture, scale)
                if row == 0 and times_s is not None:
                    axes.set_title(f"t = {times_s[column]:.1f} s", weight="normal", loc="center", fontsize=8)
                if row == 2:
                    total = int(np.abs(picture).sum())
                    axes.set_xlabel(f"{total:,} events", fontsize=7, labelpad=2)
            grid[row, 0].set_ylabel(name, fontsize=8)
        _colour_bar(figure, scale, grid, "events per pixel\n(− darker, + brighter)")
    return figure


def draw_reconstruction(counts: np.ndarray, reconstructions: np.ndarray, file: Path) -> Figure:
    """Event images above what the VAE makes of their codes, all on one colour scale.

    Args:
        counts: [N, h, w] signed events.
        reconstructions: [N, h, w] the decoder's, in the same units.
        file: PNG to write.
    """
    counts, reconstructions = np.asarray(counts), np.asarray(reconstructions)
    scale = _symmetric(counts)
    with drawing(1.35 * len(counts) + 0.9, 2.45, file) as figure:
        grid = figure.subplots(2, len(counts), squeeze=False)
        for row, (name, pictures) in enumerate((("events", counts), ("reconstruction", reconstructions))):
            for axes, picture in zip(grid[row], pictures, strict=True):
                _show(axes, picture, scale)
            grid[row, 0].set_ylabel(name, fontsize=8)
        for axes, seen, made in zip(grid[1], counts, reconstructions, strict=True):
            error = float(np.sqrt(np.mean((seen - made) ** 2)))
            axes.set_xlabel(f"RMS error {error:.2f}", fontsize=7, labelpad=2)
        _colour_bar(figure, scale, grid, "events per pixel")
    return figure


def _symmetric(counts: np.ndarray) -> Normalize:
    """A scale around 0 that a few hot pixels do not flatten."""
    busy = np.abs(counts[counts != 0])
    top = float(np.ceil(np.percentile(busy, 98))) if busy.size else 1.0
    return Normalize(-top, top)


def _show(axes: Axes, picture: np.ndarray, scale: Normalize) -> None:
    if picture.ndim == 3:
        axes.imshow(np.clip(picture, 0.0, 1.0), interpolation="nearest")
    else:
        axes.imshow(picture, cmap=POLARITY, norm=scale, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(MUTED)
        spine.set_linewidth(0.5)


def _colour_bar(figure: Figure, scale: Normalize, beside: np.ndarray, label: str) -> None:
    # As high as one row, at the foot of the grid, so that all rows keep one width.
    bar = figure.colorbar(
        ScalarMappable(scale, POLARITY),
        ax=beside.ravel().tolist(),
        shrink=0.9 / len(beside),
        anchor=(0.0, 0.03),
        aspect=14,
        pad=0.01,
        extend="both",
    )
    bar.set_label(label, color=INK, fontsize=7)
    top = int(scale.vmax or 1)
    bar.set_ticks([-top, 0, top] if top < 2 else [-top, -(top // 2), 0, top // 2, top])
