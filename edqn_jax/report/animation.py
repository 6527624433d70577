"""A flight as an animated GIF or an MP4: what a person would see, what the sensor shows, and the path so far."""

from __future__ import annotations

import dataclasses
import io
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Wedge
from PIL import Image

from edqn_jax.config import DroneConfig
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.decoder import NEAR_M
from edqn_jax.evaluation.rollouts import ShowPhase, show_nothing
from edqn_jax.evaluation.trajectories import POSITION, columns_of
from edqn_jax.extras import require_extra
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.report.images import error_caption, look_of, scale_of
from edqn_jax.report.sights import FlightRenderer, decision_rows, times_of, trajectory_poses
from edqn_jax.report.style import INK, LINE, MUTED, OUTCOME_COLOURS, OUTCOME_LABELS, STYLE, frame
from edqn_jax.report.worlds.flights import OBLIQUE, OTHER_COLOUR, others_paths, plot_end_marks, plot_stage
from edqn_jax.report.worlds.solids import faces_seen, is_occluded, moving_solids
from edqn_jax.report.worlds.views import MAP, View
from edqn_jax.sim.camera.camera import on_screen
from edqn_jax.sim.scene.scene import has_motion

SIZE = (800, 540)
"""Width and height that a flight is laid out for, pixels."""
FPS = 10.0
"""Frames a second."""
LAST_FRAME_S = 2.5
"""Seconds for which the last frame is shown, with the outcome."""
MAX_FRAMES = 120
"""Frames of the longest GIF but for the last; a longer flight shows every other decision, or fewer."""
MOST_PIXELS = 5 * MAX_FRAMES * SIZE[0] * SIZE[1]
"""Pixels of all frames together at most, which are held in memory."""
COLOURS = 128
"""Colours of all frames together; more make the file larger and no better to look at."""
VIVID_COLOURS = 48
"""Those of them that are kept for vivid colours."""
VIVID = 60
"""Difference of the channels, of 255, from which on a colour is vivid."""
EXACT_COLOURS = (*OUTCOME_COLOURS.values(), LINE)
"""Colours that a palette has as they are if a frame has them: what they mean is lost in the nearest other."""
DISTANCE_COLOURS = "inferno_r"
"""Bright is near, black far away."""
DOTS_PER_INCH = 100
SIGHT_M = 9.0
"""Length of the field of view on the map, metres, in a volume of 100 m; it is as much shorter in a smaller one."""


@dataclasses.dataclass(frozen=True)
class Film:
    """Pace and size of a video."""

    speed: float | None = None
    """Times as fast as flown; None shows a decision a frame, or fewer so that there are at most `MAX_FRAMES`."""
    fps: float = FPS
    """Frames a second; those of a GIF last whole hundredths of a second."""
    size: tuple[int, int] = SIZE
    """Width and height, pixels; what `SIZE` in its proportions leaves is white."""


def animate_flight(
    sights: FlightRenderer,
    params: PolicyParams | None,
    trajectory: Mapping[str, np.ndarray],
    outcome: str,
    title: str,
    form: str = ".gif",
    film: Film = Film(),  # noqa: B008, it is frozen
    phase: ShowPhase = show_nothing,
) -> bytes:
    """Returns a flight as an animated GIF, which repeats for ever, or as an MP4 (H.264).

    Args:
        sights: of the world in which the flight was flown.
        params: of the policy that flew; None of a function.
        trajectory: the columns of `trajectory.csv`, each [rows].
        outcome: how the flight ended, a key of `OUTCOME_LABELS`.
        title: stands above the world.
        form: `.gif` or `.mp4`, which needs the extra `video`.
        film: its pace and size.
        phase: called after each frame.

    Raises:
        ConfigError: if it would have too many frames.
        MissingPackageError: if the extra is not installed.
    """
    frame_s = 1 / film.fps if form == ".mp4" else max(round(100 / film.fps), 2) / 100
    shown, speed = _rows_shown(sights.config.drone, trajectory, film.speed, frame_s)
    if len(shown) * film.size[0] * film.size[1] > MOST_PIXELS:
        raise ConfigError(f"the video would have {len(shown)} frames, too many of its size; choose a higher speed")
    with matplotlib.rc_context(STYLE):
        pace = "as fast as flown" if speed == 1 else f"{speed:.3g} times as fast as flown"
        stage = _Stage(sights, params, trajectory, f"{title}, {pace}", film.size)
        frames = []
        for row in shown:
            frames.append(stage.frame(int(row)))
            phase("drawing", len(frames), len(shown) + 1)
        frames.append(stage.frame(len(trajectory["t"]) - 1, outcome))
    phase("writing")
    if form == ".mp4":
        return _mp4(frames + [frames[-1]] * (round(LAST_FRAME_S / frame_s) - 1), film.fps)
    return encode_gif(frames, [frame_s] * len(shown) + [LAST_FRAME_S])


def _rows_shown(
    drone: DroneConfig, trajectory: Mapping[str, np.ndarray], speed: float | None, frame_s: float
) -> tuple[np.ndarray, float]:
    """Returns the rows of a trajectory that frames show, and how many times as fast as flown that is."""
    steps, count = drone.physics_steps, len(trajectory["t"])
    if speed is None:
        decisions = max(count // steps, 1)
        every = -(-decisions // MAX_FRAMES)
        shown = np.arange(every, decisions + 1, every) * steps - 1
        return np.minimum(shown, count - 1), every * steps * drone.physics_dt_s / frame_s
    pace = speed * frame_s / drone.physics_dt_s  # rows a frame
    passed = np.round(np.arange(1, max(int(count / pace), 1) + 1) * pace).astype(int)
    return np.clip(passed, 1, count) - 1, speed


@dataclasses.dataclass(frozen=True)
class _Layout:
    """Where things are in the figure: left, bottom, width and height, as shares of its own."""

    sensor: tuple[float, float, float, float]
    map: tuple[float, float, float, float]
    state: tuple[float, float]
    ending: tuple[float, float]
    state_separator: str
    title_size: float


WITHOUT_DISTANCE = _Layout((0.015, 0.06, 0.375, 0.415), (0.44, 0.045, 0.29, 0.40), (0.77, 0.37), (0.77, 0.10), "\n", 10)
WITH_DISTANCE = _Layout(
    (0.015, 0.06, 0.235, 0.26), (0.795, 0.045, 0.2, 0.31), (0.015, 0.44), (0.755, 0.413), "      ", 9
)
"""With predicted and true distance beside what the sensor shows."""


class _Stage:
    """The figure of which all frames are pictures; what moves is drawn over a background that is drawn once."""

    def __init__(
        self,
        sights: FlightRenderer,
        params: PolicyParams | None,
        trajectory: Mapping[str, np.ndarray],
        title: str,
        size: tuple[int, int],
    ) -> None:
        self._sights, self._trajectory, self._size = sights, trajectory, size
        self._seen = decision_rows(sights.config, trajectory)[:, -1]
        self._points = columns_of(trajectory, POSITION)
        scale = min(size[0] / SIZE[0], size[1] / SIZE[1])
        wide, high = (side / DOTS_PER_INCH for side in SIZE)
        self._figure = Figure(figsize=(wide, high), dpi=DOTS_PER_INCH * scale)
        self._canvas = FigureCanvasAgg(self._figure)
        self._moving: list[Artist] = []
        self._shown = sights.shown(params, trajectory) if sights.has_image else None
        predicts = self._shown is not None and self._shown.predicted is not None
        self._layout = WITH_DISTANCE if predicts else WITHOUT_DISTANCE
        self._add_pictures()
        self._add_distances()
        self._oblique = self._add_view((0.405, 0.47, 0.59, 0.435), OBLIQUE)
        self._map = self._add_view(self._layout.map, MAP)
        self._figure.text(0.41, 0.963, title, fontsize=9, color=MUTED)
        self._add_sight()
        self._text = self._words(*self._layout.state, fontsize=12, va="top", linespacing=1.6)
        self._ending = self._words(*self._layout.ending, fontsize=14, weight="bold")
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    def frame(self, row: int, outcome: str = "") -> Image.Image:
        """Returns the picture of a row of the trajectory, with the path so far and what was sensed last."""
        decision = max(int(np.searchsorted(self._seen, row, side="right")) - 1, 0)
        seen_at = np.minimum(row, self._seen[-1])
        self._rgb.set_data(
            on_screen(
                self._sights.rgb(*trajectory_poses(self._trajectory, seen_at), times_of(self._trajectory, seen_at))
            )
        )
        if self._shown is not None:
            self._sensed.set_data(self._shown.image[decision])
        self._show_distances(decision)
        for view in (self._oblique, self._map):
            view.advance(row, float(self._trajectory["t"][row]))
        self._sight.set_center(tuple(self._points[row, :2]))
        heading = _heading_deg(*(self._trajectory[name][row] for name in ("qw", "qz")))
        half = self._sights.config.camera.horizontal_fov_deg / 2
        self._sight.set_theta1(heading - half)
        self._sight.set_theta2(heading + half)
        self._text.set_text(self._state(row))
        self._ending.set_text("goal reached" if outcome == "goal" else OUTCOME_LABELS.get(outcome, ""))
        self._ending.set_color(OUTCOME_COLOURS.get(outcome, INK))
        return self._picture()

    def _picture(self) -> Image.Image:
        self._canvas.restore_region(self._background)
        for artist in sorted(self._moving, key=lambda artist: artist.get_zorder()):
            self._figure.draw_artist(artist)
        picture = Image.fromarray(np.asarray(self._canvas.buffer_rgba())[..., :3])
        if picture.size == self._size:
            return picture
        page = Image.new("RGB", self._size, "white")
        page.paste(picture, ((self._size[0] - picture.width) // 2, (self._size[1] - picture.height) // 2))
        return page

    def _state(self, row: int) -> str:
        trajectory = self._trajectory
        speed = np.linalg.norm([trajectory[name][row] for name in ("vx", "vy", "vz")])
        away = np.linalg.norm(self._points[row] - np.asarray(self._sights.scene.goal))
        told = f"time  {trajectory['t'][row]:.1f} s", f"speed  {speed:.1f} m/s", f"to the goal  {away:.0f} m"
        return self._layout.state_separator.join(told)

    def _words(self, x: float, y: float, **style: Any) -> Any:
        text = self._figure.text(x, y, "", color=INK, animated=True, **style)
        self._moving.append(text)
        return text

    def _add_pictures(self) -> None:
        """Adds the view for people above what the sensor shows."""
        sights, camera = self._sights, self._sights.config.camera
        above, below = (self._figure.add_axes(place) for place in ((0.015, 0.533, 0.375, 0.415), self._layout.sensor))
        for axes in (above, below):
            self._moving += frame(axes, linewidth=0.8, animated=True, zorder=2.5)
        above.set_title("What a person would see", fontsize=10)
        self._rgb = above.imshow(np.zeros((2, 2, 3)), animated=True, aspect="auto", interpolation="antialiased")
        self._moving.append(self._rgb)
        name = sights.config.env.sensor
        if self._shown is None:
            below.set_title("What the drone sees", fontsize=10)
            below.text(
                0.5, 0.5, f"no image: its sensor is '{name}'", ha="center", fontsize=10, transform=below.transAxes
            )
            return
        look = look_of(name)
        title = f"{look.name}, {camera.width} × {camera.height}"
        full = self._layout is WITHOUT_DISTANCE
        below.set_title(f"What the drone sees: {title}" if full else title, fontsize=self._layout.title_size)
        if look.signed:
            words = "red where it grows brighter, blue where darker" if full else "red brighter, blue darker"
            below.set_xlabel(words, color=MUTED, fontsize=8, labelpad=3)
        scale = scale_of(self._shown.image, look, share=0.75)  # quiet moments are to be seen, too
        self._sensed = below.imshow(
            self._shown.image[0], cmap=look.colours, norm=scale, animated=True, aspect="auto", interpolation="nearest"
        )
        self._moving.append(self._sensed)

    def _add_distances(self) -> None:
        """Adds the distance that the decoder predicts and the true one, if it predicts any."""
        self._distances: list[tuple[Any, np.ndarray]] = []
        shown = self._shown
        if shown is None or shown.predicted is None or shown.distance is None:
            return
        left, bottom, width, height = self._layout.sensor
        for column, (name, metres) in enumerate((("predicted", shown.predicted), ("true", shown.distance)), start=1):
            axes = self._figure.add_axes((left + column * (width + 0.012), bottom, width, height))
            self._moving += frame(axes, linewidth=0.8, animated=True, zorder=2.5)
            axes.set_title(f"{name} distance", fontsize=self._layout.title_size)
            picture = axes.imshow(
                metres[0], cmap=DISTANCE_COLOURS, vmin=0.0, vmax=2 * NEAR_M, animated=True, aspect="auto"
            )
            self._distances.append((picture, metres))
            self._moving.append(picture)
        words = f"bright is near, dark {2 * NEAR_M:.0f} m or more"
        self._figure.text(left + 2.5 * width + 0.024, 0.022, words, fontsize=8, color=MUTED, ha="center")
        self._error = self._words(left + 1.5 * width + 0.012, 0.022, fontsize=8, ha="center")

    def _show_distances(self, decision: int) -> None:
        for picture, metres in self._distances:
            picture.set_data(np.minimum(metres[decision], 2 * NEAR_M))
        if self._distances:
            self._error.set_text(error_caption(*(metres[decision] for _, metres in self._distances)))

    def _add_view(self, place: tuple[float, float, float, float], view: View) -> _PathView:
        axes = self._figure.add_axes(place)
        path = _PathView(axes, view, self._sights, self._points)
        self._moving += path.moving
        return path

    def _add_sight(self) -> None:
        """Adds the field of view to the map."""
        lower, upper = np.asarray(self._sights.scene.volume, np.float64)
        reach = SIGHT_M * float((upper - lower)[:2].max()) / 100
        self._sight = Wedge((0, 0), reach, 0, 90, color=LINE, alpha=0.25, lw=0, animated=True, zorder=6.5)
        self._map.axes.add_patch(self._sight)
        self._moving.append(self._sight)


class _PathView:
    """The world from one side, and the path so far in it: faint where a solid hides it."""

    def __init__(self, axes: Axes, view: View, sights: FlightRenderer, points: np.ndarray) -> None:
        self.axes, self._view, self._scene = axes, view, sights.scene
        solids = plot_stage(axes, view, sights.scene, sights.config.env.goal_radius_m, outlines=False)
        plot_end_marks(axes, view, points[0], np.asarray(sights.scene.goal, np.float64))
        axes.set_aspect("equal", anchor="C")
        self._flat = view.project(points)
        covered = is_occluded(points, solids, view)[:, None]
        self._visible = np.where(covered, np.nan, self._flat)
        styles = ({"lw": 1.4, "alpha": 0.4, "color": LINE}, {"lw": 4.4, "color": "white"}, {"lw": 2.4, "color": LINE})
        self._lines = [
            axes.plot([], [], animated=True, zorder=7 + 0.1 * order, solid_capstyle="round", **style)[0]
            for order, style in enumerate(styles)
        ]
        (self._drone,) = axes.plot([], [], "o", ms=8, mfc=LINE, mec="white", mew=1.5, animated=True, zorder=9.5)
        self._obstacles = PolyCollection([], animated=True, linewidths=0.3, zorder=5)
        axes.add_collection(self._obstacles, autolim=False)
        self._others = [view.project(path) for path in others_paths(sights.scene)]
        style = {"color": OTHER_COLOUR, "lw": 0.9, "alpha": 0.7, "zorder": 6.8}
        self._trails = [axes.plot([], [], animated=True, **style)[0] for _ in self._others]
        (self._swarm,) = axes.plot([], [], "o", ms=5, mfc=OTHER_COLOUR, mec="white", mew=0.8, animated=True, zorder=9)
        self.moving: list[Artist] = [self._obstacles, *self._trails, *self._lines, self._swarm, self._drone]

    def advance(self, row: int, time: float) -> None:
        """Draws the path up to a row of the trajectory, and the obstacles that move where they are at its time."""
        if has_motion(self._scene):
            rings, colours = faces_seen(self._view, moving_solids(self._scene, time))
            self._obstacles.set(verts=rings, facecolors=colours, edgecolors=colours)
        for line, points in zip(self._lines, (self._flat, self._visible, self._visible), strict=True):
            line.set_data(*points[: row + 1].T)
        self._drone.set_data(*self._flat[row : row + 1].T)
        # Row k of the trajectory stands after physics step k + 1, with which entry k + 1 of the others' paths begins.
        for trail, path in zip(self._trails, self._others, strict=True):
            trail.set_data(*path[: row + 2].T)
        there = [path[row + 1] for path in self._others if row + 1 < len(path)]
        self._swarm.set_data(*np.array(there).reshape(-1, 2).T)


def _heading_deg(w: float, z: float) -> float:
    """Returns the heading of an attitude, degrees from +x: its twist about z."""
    return float(np.degrees(2 * np.arctan2(z, w)))


def encode_gif(frames: list[Image.Image], seconds: list[float], colours: int = COLOURS) -> bytes:
    """Returns the frames as a GIF with one palette, of which each frame stores what has changed.

    Args:
        frames: of one size.
        seconds: for which each is shown.
        colours: in the palette, at most 256.
    """
    palette = _palette(frames, colours)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    file = io.BytesIO()
    first.save(
        file,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=[round(1000 * each) for each in seconds],
        loop=0,
        disposal=1,
        optimize=True,
    )
    return file.getvalue()


def _mp4(frames: list[Image.Image], fps: float) -> bytes:
    """Returns the frames as an MP4 that browsers and slides play."""
    ffmpeg = require_extra("imageio_ffmpeg", extra="video")
    with tempfile.TemporaryDirectory() as folder:  # an MP4 is finished by going back in the file
        file = Path(folder) / "flight.mp4"
        writer = ffmpeg.write_frames(
            str(file),
            frames[0].size,
            fps=fps,
            codec="libx264",
            pix_fmt_out="yuv420p",
            macro_block_size=2,
            quality=None,
            output_params=["-crf", "20", "-movflags", "+faststart"],
        )
        with warnings.catch_warnings():
            # JAX warns of every fork; here a program takes the child's place at once.
            warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
            writer.send(None)
        try:
            for frame in frames:
                writer.send(np.asarray(frame.convert("RGB")).tobytes())
        finally:
            writer.close()
        return file.read_bytes()


def _palette(frames: list[Image.Image], number: int) -> Image.Image:
    """Returns an image with the palette of all frames.

    Vivid colours have a share of their own: they are few pixels, but marks, events and paths are made of them. Those of
    `EXACT_COLOURS` are of it.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, 8).round().astype(int))
    pixels = np.concatenate([np.asarray(frames[i]).reshape(-1, 3) for i in chosen])
    marks = (255 * to_rgba_array(EXACT_COLOURS)[:, :3]).round().astype(np.uint8)
    exact = marks[[bool((pixels == mark).all(axis=1).any()) for mark in marks]]
    vivid = np.ptp(pixels.astype(int), axis=1) > VIVID
    colours = [
        exact,
        _main_colours(pixels[vivid], VIVID_COLOURS - len(exact)),
        _main_colours(pixels[~vivid], number - VIVID_COLOURS),
    ]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate(colours).astype(np.uint8).tobytes())
    return palette


def _main_colours(pixels: np.ndarray, many: int) -> np.ndarray:
    """Returns at most `many` colours [n, 3] that stand for the pixels [P, 3], by median cut."""
    if len(pixels) == 0:
        return np.zeros((0, 3), np.uint8)
    palette = Image.fromarray(pixels[None]).quantize(many, dither=Image.Dither.NONE).getpalette()
    return np.unique(np.array(palette, np.uint8).reshape(-1, 3)[:many], axis=0)
