"""One picture of whether a world can be flown: from above, the widest way, its tightest place, its clearance."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.planning.lattice import clearances
from edqn_jax.planning.widest import COMFORT_M, ENDS_M, WidestWay
from edqn_jax.report.style import INK, MUTED, OUTCOME_COLOURS, open_figure
from edqn_jax.report.worlds.flights import draw_map, plot_coloured
from edqn_jax.report.worlds.solids import is_occluded, make_cutaway
from edqn_jax.report.worlds.views import MAP
from edqn_jax.sim.scene.mesh_field import spread_directions
from edqn_jax.sim.scene.scene import Scene

TIGHT_COLOUR = "#c4221f"
CLEARANCE = LinearSegmentedColormap.from_list("clearance", [TIGHT_COLOUR, "#e69f00", "#7fb2d6", "#0072b2"])
"""Tight is red, wide is blue."""

_CLOSE_UP_M = 2.5  # half the side of the section around the tightest place, at least
_WIDE = 1.5  # width of it over its height
_PIXELS = 241  # along each side of it
_BEYOND = 0.03  # of the volume's longer side, shown around it
_CHARACTERS = 150  # of a line of text
_DIRECTIONS = 500  # in which the nearest surface is looked for
_STEEP = 0.7  # of a unit vector: what is nearest is then above or below


@as_tested
def plot_check(
    scene: Scene,
    way: WidestWay | None,
    radius: float,
    title: str,
    text: str,
    file: Path,
    *,
    flies: bool,
    goal_radius_m: float = 2.0,
) -> Figure:
    """Draws a world and the widest way through it, written to `file` as PNG.

    Args:
        scene: one world.
        way: None where there is none; the map then stands alone.
        radius: of the body, metres.
        title: says whether it can be flown.
        text: below the picture.
        file: where to write.
        flies: whether it can be flown.
        goal_radius_m: the circle around the goal.
    """
    colour = OUTCOME_COLOURS["goal"] if flies else TIGHT_COLOUR
    with open_figure(9.6 if way is not None else 6.4, 5.0, file) as figure:
        plain = {"x": 0.01, "ha": "left", "parse_math": False}  # a file's name may hold dollars
        figure.suptitle(title, fontsize=13, weight="bold", color=colour, **plain)
        lines = (textwrap.fill(line, _CHARACTERS) for line in text.splitlines())
        figure.supxlabel("\n".join(lines), fontsize=7.5, color=MUTED, **plain)
        if way is None:
            _plot_map(figure.add_subplot(), scene, goal_radius_m)
            return figure
        grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1.0), height_ratios=(1.45, 1.0))
        scale = Normalize(radius, radius + COMFORT_M)
        above = figure.add_subplot(grid[:, 0])
        _plot_map(above, scene, goal_radius_m)
        hidden = is_occluded(way.points, make_cutaway(scene, MAP).hiding, MAP)
        _plot_way(above, way.points[:, :2], way.clearance, scale, hidden)
        reach = max(_CLOSE_UP_M, 1.4 * way.clearance_m)
        _mark(above, way.points[way.tightest][:2], reach)
        _plot_section(figure.add_subplot(grid[0, 1]), scene, way, radius, reach, scale)
        _plot_profile(figure.add_subplot(grid[1, 1]), way, radius, scale)
    return figure


def _plot_map(axes: Axes, scene: Scene, goal_radius_m: float) -> None:
    """Draws the world from above as far as its volume reaches, however large its shapes are."""
    draw_map(axes, scene, goal_radius_m)
    (x0, y0, _), (x1, y1, _) = np.asarray(scene.volume, np.float64)
    beyond = _BEYOND * max(x1 - x0, y1 - y0)
    axes.set(xlim=(x0 - beyond, x1 + beyond), ylim=(y0 - beyond, y1 + beyond))


def _plot_way(
    axes: Axes, flat: np.ndarray, clearance: np.ndarray, scale: Normalize, hidden: np.ndarray | None = None
) -> None:
    """Draws a way [K, 2], metres, coloured by its clearance [K] metres; faint where it is `hidden` [K]."""
    thin = np.unique(np.linspace(0, len(flat) - 1, min(1500, len(flat))).round().astype(int))
    faint = np.zeros(len(thin) - 1, bool) if hidden is None else hidden[thin][1:]
    plot_coloured(axes, flat[thin], clearance[thin], faint, width=2.6, cmap=CLEARANCE, norm=scale)


def _mark(axes: Axes, place: np.ndarray, reach: float) -> None:
    """Marks the part of the map that the section shows, around `place` [2] metres."""
    axes.add_patch(Circle((place[0], place[1]), reach, fill=False, ec=TIGHT_COLOUR, lw=1.4, zorder=8))
    axes.annotate(
        "tightest: shown right",
        (place[0], place[1] + reach),
        xytext=(0, 3),
        textcoords="offset points",
        ha="center",
        va="bottom",
        weight="bold",
        color=TIGHT_COLOUR,
        bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
        zorder=9,
    )


def _plot_section(axes: Axes, scene: Scene, way: WidestWay, radius: float, reach: float, scale: Normalize) -> None:
    """Draws a section of the world at the tightest place: level, or upright where the nearest lies above or below."""
    spot, room = way.points[way.tightest], way.clearance_m
    directions = np.concatenate([np.eye(3), -np.eye(3), spread_directions(_DIRECTIONS)])
    nearest = directions[np.argmin(clearances(scene, spot + room * directions))]
    upright = abs(nearest[2]) > _STEEP
    across, up = np.eye(3)[0], np.eye(3)[1]
    if upright:
        along = (way.points[min(way.tightest + 25, len(way.points) - 1)] - way.points[max(way.tightest - 25, 0)])[:2]
        turn = np.arctan2(along[1], along[0]) if np.any(along) else 0.0
        across, up = np.array([np.cos(turn), np.sin(turn), 0.0]), np.eye(3)[2]
    wide, sides = np.linspace(-_WIDE * reach, _WIDE * reach, _PIXELS), np.linspace(-reach, reach, _PIXELS)
    points = spot + wide[None, :, None] * across + sides[:, None, None] * up
    distance = clearances(scene, points.reshape(-1, 3)).reshape(points.shape[:2])
    left, low = (0.0, spot[2]) if upright else (spot[0], spot[1])
    x, y = left + wide, low + sides
    axes.contourf(x, y, distance, levels=[-1e9, 0.0, 1e9], colors=["#8d8a83", "#f4f3ef"], zorder=0)
    axes.contour(x, y, distance, levels=[0.0], colors=[INK], linewidths=0.9, zorder=1)
    axes.contour(x, y, distance, levels=np.arange(0.5, reach, 0.5), colors=["#d8d5cc"], linewidths=0.5, zorder=1)
    flat = np.stack([left + (way.points - spot) @ across, low + (way.points - spot) @ up], axis=1)
    _plot_way(axes, flat, way.clearance, scale)
    axes.add_patch(Circle((left, low), room, fill=False, ec=TIGHT_COLOUR, lw=1.2, ls=(0, (3, 2)), zorder=8))
    axes.add_patch(Circle((left, low), radius, fc=INK, ec="white", lw=0.6, alpha=0.85, zorder=8))
    touch = np.array([left, low]) + room * np.array([nearest @ across, nearest @ up])
    axes.annotate(
        "",
        (touch[0], touch[1]),
        (left, low),
        arrowprops={"arrowstyle": "-|>", "color": TIGHT_COLOUR, "lw": 1.4},
        zorder=9,
    )
    axes.set_title(f"tightest: {room:.2f} m, {room / radius:.1f} body radii")
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), aspect="equal")
    axes.set_xlabel("along the way, m" if upright else f"x, m (section at z = {spot[2]:.1f} m)")
    axes.set_ylabel("z, m" if upright else "y, m")
    axes.grid(False)


def _plot_profile(axes: Axes, way: WidestWay, radius: float, scale: Normalize) -> None:
    """Draws the clearance along a way."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way.points, axis=0), axis=1))])
    axes.axhspan(0.0, radius, color=TIGHT_COLOUR, alpha=0.12, lw=0)
    axes.axhline(radius, color=TIGHT_COLOUR, lw=0.8)
    axes.text(along[-1], radius, f"body {radius:g} m ", ha="right", va="bottom", fontsize=7, color=TIGHT_COLOUR)
    for low, high in ((0.0, ENDS_M), (along[-1] - ENDS_M, along[-1])):
        axes.axvspan(low, high, color="#eeeeee", lw=0, zorder=0)
    axes.plot(along, way.clearance, lw=0.0)  # the axes' limits
    _plot_way(axes, np.stack([along, way.clearance], axis=1), way.clearance, scale)
    axes.plot(along[way.tightest], way.clearance_m, "o", ms=5, mfc=TIGHT_COLOUR, mec="white", mew=0.8, zorder=9)
    axes.set(xlim=(0.0, along[-1]), ylim=(0.0, None), xlabel="along the way, m", ylabel="clearance, m")
