"""The map that grows, at several moments of a flight: what is known at the drone's height, and its plan."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from PIL import Image

from edqn_jax.report.animation import encode_gif
from edqn_jax.report.style import LINE, MUTED, SECOND_LINE, STYLE, open_figure
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Scene, scene_at
from edqn_jax.sim.sensors.sensor import nearness

UNKNOWN, FREE, OCCUPIED = range(3)
"""What is known of a cell, in the order of `COLOURS`."""
COLOURS = "#c9c9c9", "#ffffff", "#3b4252"
"""Of cells that are unknown, free and occupied."""
LAYERS = 1
"""Layers of cells above and below the drone's that are drawn as one."""
FRAME_S, LAST_FRAME_S = 0.26, 2.5
"""Seconds for which a frame of the GIF is shown, a decision of the flight, and the last one."""
DOTS_PER_INCH = 110


@dataclasses.dataclass(frozen=True)
class Moment:
    """What a drone knows at one decision."""

    time_s: float
    log_odds: np.ndarray
    """[X, Y, Z] of the grid."""
    flown: np.ndarray
    """[N, 3] metres, where it was at each decision so far, the last now."""
    plan: np.ndarray
    """[K, 3] metres."""
    depth: np.ndarray
    """[H, W] metres, the newest image that the map has."""


def known_at(log_odds: np.ndarray, layer: int) -> np.ndarray:
    """Returns what is known [X, Y] around a layer of cells: occupied if one of `LAYERS` each way is, free if one is.

    Args:
        log_odds: [X, Y, Z].
        layer: index along Z.
    """
    part = log_odds[:, :, max(0, layer - LAYERS) : layer + LAYERS + 1]
    known = np.where((part < 0).any(axis=2), FREE, UNKNOWN)
    return np.where((part > 0).any(axis=2), OCCUPIED, known)


def draw_growth(scene: Scene, cell_m: float, moments: Sequence[Moment], file: Path) -> Figure:
    """Draws the map at several moments side by side, and under each the distances that were put into it last.

    Args:
        scene: the true world, drawn as outlines; the drone does not know it.
        cell_m: edge of the cells, metres.
        moments: in order.
        file: PNG to write.
    """
    lower, upper = np.asarray(scene.volume)
    tall = (upper[1] - lower[1]) / (upper[0] - lower[0])
    wide = 2.5
    with open_figure(wide * len(moments) + 0.2, wide * tall + wide * 0.75 + 0.8, file) as figure:
        rows = figure.subplots(2, len(moments), squeeze=False, gridspec_kw={"height_ratios": [tall, 0.75]})
        for above, below, moment in zip(*rows, moments, strict=True):
            _draw_known(above, scene, cell_m, moment)
            above.set_title(f"t = {moment.time_s:.1f} s", weight="normal", loc="center")
            _draw_depth(below, moment.depth)
        rows[0][0].set_ylabel("y, m")
        figure.legend(handles=_legend(), loc="outside lower center", ncols=7, frameon=False, fontsize=7)
    return figure


def animate_growth(scene: Scene, cell_m: float, moments: Sequence[Moment], title: str) -> bytes:
    """Returns the growing map as a GIF, a frame a moment; the arguments are those of `draw_growth`."""
    lower, upper = np.asarray(scene.volume)
    tall = (upper[1] - lower[1]) / (upper[0] - lower[0])
    frames = []
    with matplotlib.rc_context(STYLE):
        for moment in moments:
            figure = Figure(figsize=(7.6, 4.4 * tall + 0.8), dpi=DOTS_PER_INCH, layout="constrained")
            canvas = FigureCanvasAgg(figure)
            left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.6, 1.0]})
            _draw_known(left, scene, cell_m, moment)
            left.set(ylabel="y, m", title=title)
            _draw_depth(right, moment.depth)
            right.set_title(f"t = {moment.time_s:.1f} s", weight="normal")
            figure.legend(handles=_legend(), loc="outside lower center", ncols=7, frameon=False, fontsize=7)
            canvas.draw()
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    return encode_gif(frames, [FRAME_S] * (len(frames) - 1) + [LAST_FRAME_S])


def _draw_known(axes: Axes, scene: Scene, cell_m: float, moment: Moment) -> None:
    lower, upper = np.asarray(scene.volume)
    here = moment.flown[-1]
    layer = int(np.clip((here[2] - lower[2]) // cell_m, 0, moment.log_odds.shape[2] - 1))
    known = known_at(moment.log_odds, layer)
    far = lower[:2] + cell_m * np.array(known.shape)
    axes.imshow(
        known.T,
        cmap=ListedColormap(COLOURS),
        vmin=UNKNOWN,
        vmax=OCCUPIED,
        origin="lower",
        extent=(lower[0], far[0], lower[1], far[1]),
        interpolation="nearest",
    )
    x, y, clearance = _clearance_at(scene_at(scene, jnp.float32(moment.time_s)), float(here[2]))
    axes.contour(x, y, clearance.T, levels=[0.0], colors=SECOND_LINE, linewidths=0.7)
    axes.plot(*moment.plan[:, :2].T, color="#009e73", linewidth=1.4)
    axes.plot(*moment.flown[:, :2].T, color=LINE, linewidth=1.4)
    axes.plot(*here[:2], "o", color=LINE, markersize=4)
    goal = np.asarray(scene.goal)
    axes.add_patch(Circle((float(goal[0]), float(goal[1])), 2.0, fill=False, color="#009e73", linewidth=1.0))
    axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal", xlabel="x, m")
    axes.grid(False)


def _clearance_at(scene: Scene, height: float, points: int = 160) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns x [P], y [P] and the signed distance [P, P] to the true shapes at one height, all in metres."""
    lower, upper = np.asarray(scene.volume)
    x, y = (np.linspace(lower[axis], upper[axis], points) for axis in range(2))
    at = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((points, points), height)], axis=-1)
    distance = _distances(scene, jnp.asarray(at.reshape(-1, 3), jnp.float32))
    return x, y, np.asarray(distance).reshape(points, points)


_distances = jax.jit(jax.vmap(signed_distance, in_axes=(None, 0)))


def _draw_depth(axes: Axes, depth: np.ndarray) -> None:
    axes.imshow(np.asarray(nearness(jnp.asarray(depth))), cmap="gray", vmin=0.0, vmax=1.0)
    axes.set(xticks=[], yticks=[], xlabel="what the map is given: bright is near")
    axes.grid(False)


def _legend() -> list[Patch | Line2D]:
    cells = [
        Patch(facecolor=colour, edgecolor=MUTED, label=label)
        for colour, label in zip(COLOURS, ("unknown", "free", "occupied"), strict=True)
    ]
    return [
        *cells,
        Line2D([], [], color=SECOND_LINE, linewidth=0.7, label="true shapes (not known)"),
        Line2D([], [], color=LINE, marker="o", markersize=4, label="flown"),
        Line2D([], [], color="#009e73", label="plan, goal"),
    ]
