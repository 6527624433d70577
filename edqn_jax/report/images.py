"""Pictures of what the drone sees: RGB beside what its sensor shows (Fig. 6 of the paper), and what its code keeps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from edqn_jax.config.registry import SENSORS
from edqn_jax.evaluation.decoder import NEAR_M, median_error
from edqn_jax.report.style import COUNTS, INK, POLARITY, frame, open_figure
from edqn_jax.sim.sensors.sensor import DEPTH_SCALE, HALF_NEAR_M


@dataclasses.dataclass(frozen=True)
class Look:
    """Label, unit and colours of a sensor's image in figures."""

    name: str
    unit: str
    colours: str | Colormap
    signed: bool = False
    """Whether values are negative where the image became darker."""


def look_of(sensor: str) -> Look:
    """Returns the look of the image that a sensor of this name shows; it must show one."""
    image = SENSORS.get(sensor).image
    assert image is not None, f"the sensor '{sensor}' shows no image"
    return Look(image.label, image.unit, POLARITY if image.signed else "gray", image.signed)


EVENTS, NEARNESS = look_of("events"), look_of("depth")

PHOTOGRAPH = Look("picture", "brightness of 255", "gray")
"""A picture that a camera took beside its events."""

RECONSTRUCTED_EVENTS = Look("events", "events per pixel\n(ON + OFF)", COUNTS)
"""The VAE's reconstruction of events, as their number per pixel, whatever the sign."""


def plot_sight(
    rgb: np.ndarray,
    native_rgb: np.ndarray,
    shown: np.ndarray,
    file: Path,
    times_s: Sequence[float] | None = None,
    look: Look = EVENTS,
) -> Figure:
    """Draws RGB, fine and as the drone's camera has it, above what the sensor shows, one column a moment.

    Args:
        rgb: [M, H, W, 3] brightness in [0, 1] at any resolution.
        native_rgb: [M, h, w, 3] brightness in [0, 1] at the camera's own.
        shown: [M, h, w] events, negative where it grew darker, or pictures.
        file: PNG to write.
        times_s: [M] seconds into the flight, for the titles.
        look: of what is shown.
    """
    height, width = np.shape(shown)[1:]
    size = f"{width} × {height}"
    rows = [("RGB", rgb), (f"RGB, {size}", native_rgb), (f"{look.name}, {size}", shown)]
    moments = len(shown)
    scale = scale_of(shown, look)
    with open_figure(1.75 * moments + 0.9, 4.1, file) as figure:
        grid = figure.subplots(len(rows), moments, squeeze=False)
        for row, (name, pictures) in enumerate(rows):
            for column, picture in enumerate(np.asarray(pictures)):
                axes = grid[row, column]
                _show(axes, picture, scale, look)
                if row == 0 and times_s is not None:
                    axes.set_title(f"t = {times_s[column]:.1f} s", weight="normal", loc="center", fontsize=8)
                if row == 2 and look.signed:
                    total = int(np.abs(picture).sum())
                    axes.set_xlabel(f"{total:,} events", fontsize=7, labelpad=2)
            grid[row, 0].set_ylabel(name, fontsize=8)
        signs = "\n(− darker, + brighter)" if look.signed else ""
        _colour_bar(figure, scale, grid, look, f"{look.unit}{signs}")
    return figure


def plot_reconstruction(
    targets: np.ndarray,
    decoded: np.ndarray,
    file: Path,
    look: Look = RECONSTRUCTED_EVENTS,
    seen: tuple[np.ndarray, Look] | None = None,
    distances: tuple[np.ndarray, np.ndarray] | None = None,
) -> Figure:
    """Plots the decoder's targets above its reconstructions, on one colour scale.

    Args:
        targets: [N, h, w] blurred events, ON plus OFF, blurred pictures or blurred nearness.
        decoded: [N, h, w] by the decoder, in the same units.
        file: PNG to write.
        look: of both.
        seen: [N, h, w] what the sensor showed, and its look, for a row above.
        distances: predicted and true [N, h, w] metres; the captions then say the error of these.
    """
    targets, decoded = np.asarray(targets), np.asarray(decoded)
    scale = Normalize(0.0, _largest(targets)) if look is RECONSTRUCTED_EVENTS else scale_of(targets, look)
    name = look.name if seen is None else f"true {look.name}"
    rows = [(f"{name}, blurred", targets, scale, look), ("from the code", decoded, scale, look)]
    if seen is not None:
        rows.insert(0, (seen[1].name, np.asarray(seen[0]), scale_of(seen[0], seen[1]), seen[1]))
    with open_figure(1.35 * len(targets) + 0.9, 1.15 * len(rows) + 0.15, file) as figure:
        grid = figure.subplots(len(rows), len(targets), squeeze=False)
        for line, (name, pictures, colours, row_look) in zip(grid, rows, strict=True):
            for axes, picture in zip(line, pictures, strict=True):
                _show(axes, picture, colours, row_look)
            line[0].set_ylabel(name, fontsize=8)
        for number, axes in enumerate(grid[-1]):
            if distances is None:
                caption = f"RMS error {np.sqrt(np.mean((targets[number] - decoded[number]) ** 2)):.2f}"
            else:
                caption = error_caption(distances[0][number], distances[1][number])
            axes.set_xlabel(caption, fontsize=7, labelpad=2)
        _colour_bar(figure, scale, grid, look, look.unit)
    return figure


def error_caption(predicted: np.ndarray, true: np.ndarray) -> str:
    """Returns the median error of predicted distances [..., h, w] for people, or that nothing is near."""
    error = median_error(predicted, true)
    if error is None:
        return f"nothing within {NEAR_M:.0f} m"
    return f"distance off by {error:.0%}" if np.isfinite(error) else "predicted far away"


def scale_of(shown: np.ndarray, look: Look, share: float = 0.98) -> Normalize:
    """Returns one colour scale for all of `shown` [M, h, w]: around 0 for signed events, else from least to most.

    `share` of the pixels with events are within it.
    """
    if look.signed:
        return Normalize(-_largest(shown, share), _largest(shown, share))
    return Normalize(float(np.min(shown)), float(np.max(shown)))


def _largest(counts: np.ndarray, share: float = 0.98) -> float:
    """Returns the end of a scale of event counts that a few hot pixels do not flatten."""
    busy = np.abs(counts[counts != 0])
    return float(np.ceil(np.quantile(busy, share))) if busy.size else 1.0


def _show(axes: Axes, picture: np.ndarray, scale: Normalize, look: Look) -> None:
    if picture.ndim == 3:
        axes.imshow(np.clip(picture, 0.0, 1.0), interpolation="nearest")
    else:
        axes.imshow(picture, cmap=look.colours, norm=scale, interpolation="nearest")
    frame(axes)


def _colour_bar(figure: Figure, scale: Normalize, beside: np.ndarray, look: Look, label: str) -> None:
    # As high as one row, at the foot of the grid, so that all rows keep one width.
    bar = figure.colorbar(
        ScalarMappable(scale, look.colours),
        ax=beside.ravel().tolist(),
        shrink=0.9 / len(beside),
        anchor=(0.0, 0.03),
        aspect=14,
        pad=0.01,
        extend="max" if scale.vmin == 0 else "both",
    )
    bar.set_label(label, color=INK, fontsize=7)
    if look is NEARNESS:
        near = {f"{metres} m": DEPTH_SCALE / (1 + metres / HALF_NEAR_M) for metres in (0, 1, 2, 4, 8, 16, 32)}
        near = {name: value for name, value in near.items() if (scale.vmin or 0) <= value <= (scale.vmax or 0)}
        bar.set_ticks(list(near.values()), labels=list(near))
        bar.set_label("distance, bright is near", color=INK, fontsize=7)
    if not look.signed:
        return
    top = int(scale.vmax or 1)
    bar.set_ticks([-top, 0, top] if top < 2 else [-top, -(top // 2), 0, top // 2, top])
