"""Pictures of where the drone flies: the world (Fig. 5 of the paper) and the flown path in it (Fig. 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.evaluation.trajectories import POSITION, VELOCITY, columns_of
from edqn_jax.report.style import INK, MUTED, OUTCOME_COLOURS, OUTCOME_LABELS, open_figure
from edqn_jax.report.worlds.solids import (
    Solid,
    is_occluded,
    make_cutaway,
    plot_outlines,
    plot_passable,
    plot_shadows,
    plot_solids,
    static_scene,
)
from edqn_jax.report.worlds.views import GROUND, MAP, View
from edqn_jax.sim.scene.scene import PARKED, Scene

OBLIQUE = View(azimuth=-62.0, elevation=34.0)
SPEED_COLOURS = "viridis"
START_COLOUR = "#0072b2"
GOAL_COLOUR = OUTCOME_COLOURS["goal"]
SHORTEST_COLOUR = "#c2185b"
HALO = 1.4  # points by which a halo is wider than its line
OTHER_COLOUR = "#5a5a66"
"""Of the other drones of a group, and of their paths."""
TICK: dict[str, Any] = {"fontsize": 7, "color": INK, "ha": "center", "va": "center"}
PATH_POINTS = 1500
"""A flight is thinned to about this many points; more cannot be seen."""


@as_tested
def plot_world(scene: Scene, file: Path) -> Figure:
    """Draws the world's solids with start and goal, in proportion, written to `file` as PNG."""
    start, goal = _ends(scene)
    volume = np.asarray(scene.volume, np.float64)
    with open_figure(7.0, 4.0, file) as figure:
        axes = figure.add_subplot()
        _plot_ground(axes, OBLIQUE, volume)
        _plot_obstacles(axes, OBLIQUE, scene)
        for point, name, colour in ((start, "start", START_COLOUR), (goal, "goal", GOAL_COLOUR)):
            _plot_stem(axes, OBLIQUE, point, colour)
            x, y = OBLIQUE.project(point)
            label = f"{name} ({point[0]:g}, {point[1]:g}, {point[2]:g})"
            axes.annotate(
                label,
                (x, y),
                xytext=(8, 0),
                textcoords="offset points",
                va="center",
                weight="bold",
                color=colour,
                bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.8},
                zorder=9,
            )
        plot_end_marks(axes, OBLIQUE, start, goal)
    return figure


@as_tested
def draw_map(axes: Axes, scene: Scene, goal_radius_m: float = 2.0) -> None:
    """Draws a world from above, metres, with its start and goal, on axes to which paths may be added.

    Args:
        axes: of matplotlib.
        scene: one world.
        goal_radius_m: the circle around the goal.
    """
    plot_stage(axes, MAP, scene, goal_radius_m)
    plot_end_marks(axes, MAP, *_ends(scene))


def plot_path(
    scene: Scene,
    trajectory: Mapping[str, np.ndarray],
    shortest: np.ndarray | None,
    file: Path,
    outcome: str = "goal",
    goal_radius_m: float = 2.0,
) -> Figure:
    """Draws the flown path in 3-D, from above and as altitude, coloured by speed, written to `file` as PNG.

    What a solid hides is faint; the shortest path is dashed; those of other drones in the world are grey.

    Args:
        scene: one world.
        trajectory: columns `x`, `y`, `z` (metres) and `vx`, `vy`, `vz` (m/s), each [T].
        shortest: corners of the A* path, [K, 3] metres, or None.
        file: where to write.
        outcome: how the flight ended; unless it is `goal` its end is marked.
        goal_radius_m: the circle around the goal.
    """
    points, velocity = columns_of(trajectory, POSITION), columns_of(trajectory, VELOCITY)
    thin = np.unique(np.linspace(0, len(points) - 1, min(PATH_POINTS, len(points))).round().astype(int))
    points, speed = points[thin], np.linalg.norm(velocity[thin], axis=1)
    scale = Normalize(0.0, max(float(np.ceil(speed.max())), 1.0))
    start, goal = points[0], _ends(scene)[1]
    with open_figure(9.6, 4.9, file) as figure:
        grid = figure.add_gridspec(2, 2, width_ratios=(1.75, 1.0), height_ratios=(3.2, 1.0))
        oblique, above = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
        for axes, view in ((oblique, OBLIQUE), (above, MAP)):
            solids = plot_stage(axes, view, scene, goal_radius_m)
            if view is OBLIQUE:
                floor = view.project(points * [1, 1, 0])
                axes.plot(*floor.T, color=MUTED, lw=0.7, alpha=0.7, zorder=1.5)
            if shortest is not None:
                _plot_shortest(axes, view, np.asarray(shortest, np.float64), solids)
            for other in others_paths(scene):
                axes.plot(
                    *view.project(other[:: len(other) // PATH_POINTS + 1]).T, color=OTHER_COLOUR, lw=1.0, zorder=5.5
                )
            _plot_flown(axes, view, points, speed, scale, solids)
            plot_end_marks(axes, view, start, goal)
            if outcome != "goal":
                x, y = view.project(points[-1])
                axes.plot(x, y, "X", ms=8, mfc=OUTCOME_COLOURS[outcome], mec="white", mew=0.8, zorder=10)
        profile = figure.add_subplot(grid[1, 1])
        _plot_altitude(profile, points, speed, scale, shortest, np.asarray(scene.volume, np.float64))
        bar = figure.colorbar(
            ScalarMappable(scale, SPEED_COLOURS), ax=[above, profile], shrink=0.75, aspect=28, pad=0.03
        )
        bar.set_label("speed, m/s")
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        figure.legend(handles=_path_legend(shortest is not None, outcome), loc="outside lower center", ncols=5)
    return figure


def others_paths(scene: Scene) -> list[np.ndarray]:
    """Returns the paths [T, 3], metres, of the other drones in a flight's world, each up to its end."""
    if scene.drones is None:
        return []
    paths = np.asarray(scene.drones.path, np.float64)
    return [path[path[:, 0] < PARKED / 2] for path in paths]


def plot_stage(axes: Axes, view: View, scene: Scene, goal_radius_m: float, outlines: bool = True) -> list[Solid]:
    """Draws the world in which a flight is shown, its goal marked; returns the solids that hide what is behind them.

    Args:
        axes: to draw on.
        view: `OBLIQUE` or `MAP`.
        scene: one world.
        goal_radius_m: the circle around the goal on the map.
        outlines: whether what moves is outlined where it is at time 0.
    """
    goal = _ends(scene)[1]
    _plot_ground(axes, view, np.asarray(scene.volume, np.float64))
    solids = _plot_obstacles(axes, view, scene if outlines else static_scene(scene))
    if view is MAP:
        circle = Circle((goal[0], goal[1]), goal_radius_m, fill=False, ec=GOAL_COLOUR, lw=0.8)
        axes.add_patch(circle).set_zorder(6)
    else:
        _plot_stem(axes, view, goal, GOAL_COLOUR)
    return solids


def _plot_obstacles(axes: Axes, view: View, scene: Scene) -> list[Solid]:
    """Draws the world without what would hide it, says so, and returns the solids that hide what is behind them."""
    world = make_cutaway(scene, view)
    if view is not MAP:
        plot_shadows(axes, view, world.hiding, _corners(np.asarray(scene.volume, np.float64)))
    plot_passable(axes, view, world.passable)
    plot_solids(axes, view, world.shown, world.meshes)
    plot_outlines(axes, view, [*world.near_walls, *world.moving])
    if world.note:
        axes.set_title(world.note, fontsize=7, weight="normal", color=MUTED)
    return world.hiding


def _ends(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(scene.start, np.float64), np.asarray(scene.goal, np.float64)


def _plot_ground(axes: Axes, view: View, volume: np.ndarray) -> None:
    """Draws the volume's floor with a 10 m grid, labelled edges and a scale of height."""
    (x0, y0, _), (x1, y1, top) = volume
    floor = [view.project(_corners(volume))]
    axes.add_collection(PolyCollection(floor, facecolors=GROUND, edgecolors=MUTED, linewidths=0.6, zorder=0))
    lines = [[[x, y0, 0], [x, y1, 0]] for x in _ticks(x0, x1, 10)] + [
        [[x0, y, 0], [x1, y, 0]] for y in _ticks(y0, y1, 10)
    ]
    grid = LineCollection(list(view.project(np.array(lines, np.float64))), colors="white", linewidths=0.7, zorder=0.5)
    axes.add_collection(grid)
    step = 20 if max(x1 - x0, y1 - y0) > 60 else 10
    out = 0.022 * (x1 - x0)
    from_above = view.elevation >= 89
    y_edge, outwards = (x0, -1.4 * out) if from_above else (x1, 1.4 * out)
    for x in _ticks(x0, x1, step):
        _label(axes, view, np.array([x, y0 - 1.4 * out, 0]), f"{x:g}")
    for y in _ticks(y0, y1, step):
        _label(axes, view, np.array([y_edge + outwards, y, 0]), f"{y:g}")
    _label(axes, view, np.array([(x0 + x1) / 2, y0 - 4 * out, 0]), "x, m")
    _label(axes, view, np.array([y_edge + 3.4 * outwards, (y0 + y1) / 2, 0]), "y, m")
    if not from_above:
        post = view.project(np.array([[x0, y0, 0], [x0, y0, top]], np.float64))
        axes.plot(*post.T, color=MUTED, lw=0.8, zorder=3)
        ticks = next(step for step in (1, 2, 5, 10, 20, 50, 100) if step == 100 or top / step < 4)
        for z in np.arange(ticks, top + 1e-6, ticks):
            x, y = view.project(np.array([x0, y0, z]))
            axes.plot([x - 0.6 * out, x], [y, y], color=MUTED, lw=0.8, zorder=3)
            axes.text(x - 1.4 * out, y, f"{z:g}", **TICK)
        x, y = view.project(np.array([x0, y0, top]))
        axes.text(x, y + out, "z, m", **TICK)
    axes.set_aspect("equal")
    axes.axis("off")
    axes.autoscale_view()


def _ticks(low: float, high: float, step: float) -> np.ndarray:
    """Returns the multiples of `step` from `low` to `high`; + 0.0 makes -0.0, which would be written so, a 0."""
    return np.arange(np.ceil(low / step) * step, high + 1e-6, step) + 0.0


def _label(axes: Axes, view: View, point: np.ndarray, text: str) -> None:
    x, y = view.project(point)
    axes.text(x, y, text, **TICK)


def _corners(volume: np.ndarray) -> np.ndarray:
    """Returns the floor's corners, [4, 3]."""
    (x0, y0, _), (x1, y1, _) = volume
    return np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])


def _plot_stem(axes: Axes, view: View, point: np.ndarray, colour: str) -> None:
    stem = view.project(np.stack([point * [1, 1, 0], point]))
    axes.plot(*stem.T, color=colour, lw=0.8, zorder=8)
    axes.plot(*stem[0], "o", ms=2.0, color=colour, zorder=8)


def plot_end_marks(axes: Axes, view: View, start: np.ndarray, goal: np.ndarray) -> None:
    """Marks start and goal, each [3] metres, above all else."""
    axes.plot(*view.project(start), "o", ms=6, mfc="white", mec=START_COLOUR, mew=1.8, zorder=9)
    axes.plot(*view.project(goal), "*", ms=12, mfc=GOAL_COLOUR, mec="white", mew=0.8, zorder=9)


def _plot_shortest(axes: Axes, view: View, corners: np.ndarray, solids: Sequence[Solid]) -> None:
    legs = [np.linspace(one, other, 200) for one, other in zip(corners, corners[1:], strict=False)]
    points = np.concatenate(legs)
    flat, covered = view.project(points), is_occluded(points, solids, view)[:, None]
    style: dict[str, Any] = {"color": SHORTEST_COLOUR, "ls": (0, (4, 2.5)), "zorder": 5}
    axes.plot(*np.where(covered, flat, np.nan).T, lw=0.7, alpha=0.45, **style)
    axes.plot(*np.where(covered, np.nan, flat).T, lw=1.2, **style)


def _plot_flown(
    axes: Axes, view: View, points: np.ndarray, speed: np.ndarray, scale: Normalize, solids: Sequence[Solid]
) -> None:
    covered = is_occluded((points[:-1] + points[1:]) / 2, solids, view)
    plot_coloured(axes, view.project(points), speed, covered, cmap=SPEED_COLOURS, norm=scale)


def _plot_altitude(
    axes: Axes,
    points: np.ndarray,
    speed: np.ndarray,
    scale: Normalize,
    shortest: np.ndarray | None,
    volume: np.ndarray,
) -> None:
    """Draws height over the distance flown, and that of the shortest path over its own, up to the volume's top."""
    along = _lengths(points)
    if shortest is not None:
        corners = np.asarray(shortest, np.float64)
        axes.plot(_lengths(corners), corners[:, 2], color=SHORTEST_COLOUR, ls=(0, (4, 2.5)), lw=1.0, zorder=5)
    shown = np.zeros(len(points) - 1, bool)
    plot_coloured(
        axes, np.stack([along, points[:, 2]], axis=1), speed, shown, width=1.8, cmap=SPEED_COLOURS, norm=scale
    )
    axes.set(xlim=(0, max(along[-1], 1.0)), ylim=(volume[0, 2], volume[1, 2]))
    axes.set_xlabel("distance flown, m")
    axes.set_ylabel("altitude, m")


def _lengths(points: np.ndarray) -> np.ndarray:
    """Returns the length of the way up to each of points [K, 3], metres."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def plot_coloured(
    axes: Axes, flat: np.ndarray, values: np.ndarray, faint: np.ndarray, *, width: float = 2.0, **colours: Any
) -> None:
    """Draws a line through points [K, 2], coloured by values [K], with a halo; thin where a piece [K - 1] is `faint`.

    Args:
        width: points.
        colours: `cmap` and `norm` of the values.
    """
    pieces, middle = np.stack([flat[:-1], flat[1:]], axis=1), (values[:-1] + values[1:]) / 2
    halo = LineCollection(list(pieces[~faint]), colors="white", linewidths=width + HALO, capstyle="round", zorder=6)
    axes.add_collection(halo)
    for which, wide, alpha in ((faint, 0.6 * width, 0.45), (~faint, width, 1.0)):
        line = LineCollection(list(pieces[which]), linewidths=wide, alpha=alpha, capstyle="round", **colours)
        line.set_array(middle[which])
        line.set_zorder(7)
        axes.add_collection(line)


def _path_legend(with_shortest: bool, outcome: str) -> list[Line2D]:
    entries = [
        Line2D([], [], ls="", marker="o", ms=6, mfc="white", mec=START_COLOUR, mew=1.8, label="start"),
        Line2D([], [], ls="", marker="*", ms=11, mfc=GOAL_COLOUR, mec="white", label="goal"),
        Line2D([], [], color="#21918c", lw=2.0, label="flown (faint where a solid hides it)"),
    ]
    if with_shortest:
        entries.append(
            Line2D([], [], color=SHORTEST_COLOUR, lw=1.1, ls="--", label="shortest path (A*, knows the map)")
        )
    if outcome != "goal":
        colour = OUTCOME_COLOURS[outcome]
        entries.append(Line2D([], [], ls="", marker="X", ms=8, mfc=colour, mec="white", label=OUTCOME_LABELS[outcome]))
    return entries
