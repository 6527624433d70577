"""Flies an exported policy: from a packet of events and the drone's own state to a velocity command.

    runner = Runner("policy.onnx", camera=(346, 260), camera_fov_deg=70.0, contrast=0.2)
    runner.reset()
    decide = functools.partial(runner.decide, goal=goal, volume=volume)
    command = decide(packet, until_us, position=p, quaternion=q, velocity=v, yaw_rate=r)
    command.velocity  # m/s in the world, to be held until the next decision

Needs NumPy and onnxruntime, nothing else: `edqn export` writes a copy of this file beside the policy. Positions and
velocities are in a world whose z points up; a heading is the angle from x to the drone's nose, to the left.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

METADATA = "edqn_jax"
"""Key under which the ONNX file holds `Runner.about`, as JSON."""

FORMAT = 1
"""Number of the form of an exported policy that this file reads."""

OLDEST_ONNXRUNTIME = (1, 14)
"""The oldest version of onnxruntime that runs the operators of exported policies."""

FIELDS = ("t", "x", "y", "p")
"""Fields of a packet of events, which are microseconds, column, row, and polarity in {-1, 1}."""


@dataclasses.dataclass(frozen=True)
class Command:
    """What the policy wants until its next decision."""

    move: int
    """Number of the move, 0..26."""
    velocity: NDArray[np.float32]
    """[3] m/s in the world: x, y, up."""
    yaw: float
    """Heading to turn to, radians from the world's x to the left."""
    values: NDArray[np.float32]
    """[27] of the Q-network, one for each move."""


class Runner:
    """An exported policy with its memory; one for each drone."""

    def __init__(
        self,
        file: str | Path,
        *,
        camera: tuple[int, int] | None = None,
        camera_fov_deg: float | None = None,
        contrast: float | None = None,
        directions: ArrayLike | None = None,
        threads: int = 1,
    ) -> None:
        """Loads a policy.

        Args:
            file: ONNX, as `edqn export` writes it.
            camera: width and height of the camera's image, pixels; None is the policy's own resolution.
            camera_fov_deg: the camera's horizontal field of view; None takes its whole image for the policy's.
            contrast: change of log brightness that makes an event in the camera, which a policy that knows it is told;
                None is the policy's own, or the middle of those that it was trained with.
            directions: [H, W, 2] of a calibrated lens, in place of `camera_fov_deg`: where each pixel of the camera
                looks, how far to the right and down for one ahead; not finite where it sees nothing.
            threads: of onnxruntime; the network is so small that one is fastest.

        Raises:
            ValueError: if the file is no exported policy, or the camera cannot stand for the policy's, or the contrast
                is not above 0.
        """
        import onnxruntime  # pyright: ignore[reportMissingImports]

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        path = Path(file)
        if not path.is_file():
            raise ValueError(f"there is no file '{path}'")
        try:
            session = onnxruntime.InferenceSession(path.read_bytes(), options, ["CPUExecutionProvider"])
        except Exception as error:
            raise ValueError(_why_not(path, error, onnxruntime.__version__)) from error
        self._session: Any = session
        self.about = _about(self._session.get_modelmeta().custom_metadata_map, path)
        """What the policy expects, as `edqn export` wrote it."""
        self._grid = Grid.of(self.about, camera, camera_fov_deg, directions)
        self._contrast = camera_contrast(self.about, contrast)
        self._actions = np.asarray(self.about["actions"], np.float32)
        shape = next(given.shape for given in self._session.get_inputs() if given.name == "memory")
        self._empty = np.zeros(shape, np.float32)
        self.reset()

    def reset(self) -> None:
        """Forgets what was seen: to be called before each flight."""
        self._memory = self._empty
        self._last_move = np.zeros(3, np.float32)
        self._yaw: float | None = None

    @property
    def period_s(self) -> float:
        """Seconds from one decision to the next."""
        return self.about["decision_s"]

    @property
    def window_us(self) -> int:
        """Microseconds of events before a decision that the policy sees."""
        times = self.about["frame_times_us"]
        return times[-1] - times[0]

    def decide(
        self,
        packet: NDArray,
        until_us: int,
        *,
        position: ArrayLike,
        quaternion: ArrayLike,
        velocity: ArrayLike,
        yaw_rate: float,
        goal: ArrayLike,
        volume: ArrayLike,
        last_move: ArrayLike | None = None,
        attitudes: ArrayLike | None = None,
    ) -> Command:
        """Returns the command for the next `period_s` seconds, and remembers the observation.

        Args:
            packet: structured array [N] with the fields `t` (microseconds, any order), `x`, `y` and `p` (-1 or 1);
                events that are not in the window [until_us - window_us, until_us) are left out. Or how many there are
                [F, 2, H, W]: sums of `count` for each pair of frames.
            until_us: time of the decision, on the events' clock.
            position: [3] metres in the world.
            quaternion: [4] w, x, y, z, from the body (x ahead, y left, z up) to the world.
            velocity: [3] m/s in the world.
            yaw_rate: of the heading, rad/s to the left.
            goal: [3] metres in the world.
            volume: [2, 3] lowest and highest corner of the flight volume, metres in the world.
            last_move: [3] of -1, 0 and 1, as flown since the last decision; None is the move that this runner chose.
            attitudes: [F, 4] quaternions at `about["frame_times_us"]` from now, for a camera that leans with the body.

        Raises:
            ValueError: if an argument is missing or of another shape or not finite, or an event outside of the image.
        """
        place, speed = _numbers("position", position, (3,)), _numbers("velocity", velocity, (3,))
        attitude = _numbers("quaternion", quaternion, (4,))
        aim, bounds = _numbers("goal", goal, (3,)), _numbers("volume", volume, (2, 3))
        if not np.all(bounds[0] < bounds[1]):
            raise ValueError("volume must be its lowest and its highest corner, each coordinate of the first the lower")
        turn = _numbers("yaw_rate", yaw_rate, ())
        move = self._last_move if last_move is None else _numbers("last_move", last_move, (3,))
        yaw = heading_of(attitude)
        number, pairs = packet, len(self.about["frame_times_us"]) - 1
        if getattr(packet, "shape", None) != (pairs, 2, *self._grid.pixels.shape):
            number = _numbers_of(self.about, packet, until_us - self.window_us, self._grid)
        counts = _counts_of(self.about, number, self._grid, self._contrast)
        values, memory = self._session.run(
            ["values", "memory_after"],
            {
                "counts": counts[None],
                "own": self._told(own_state(self.about, place, yaw, speed, aim, bounds)),
                "motion": self._told(with_lean(self.about, attitudes, own_motion(self.about, yaw, speed, turn, move))),
                "memory": self._memory,
            },
        )
        self._memory = memory
        best = int(np.argmax(values[0]))
        self._last_move = self._actions[best]
        wanted = self.velocity_of(best, float(yaw))
        self._yaw = self._setpoint(place, float(yaw), aim, wanted)
        return Command(best, wanted, self._yaw, values[0])

    def count(self, packet: NDArray) -> NDArray[np.int64] | None:
        """Returns how many events of a packet [N] are in each of the policy's pixels [2, H, W], ON and OFF.

        Packets can be counted as they come, so that a decision has less to do. None, where `decide` would refuse them.
        """
        try:
            _check_packet(packet)
            _check_pixels(packet, self._grid)
        except ValueError:
            return None
        times = np.zeros(packet.size, np.int64)
        return _number_in(self.about, packet, times, self._grid, pairs=1)[0]

    def _told(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns own values as the network takes them, [1, N]."""
        return with_contrast(self.about, values, self._contrast)[None]

    def velocity_of(self, move: int, yaw: float) -> NDArray[np.float32]:
        """Returns the velocity [3] m/s in the world that a move commands at a heading in radians."""
        ahead, left, up = self._actions[move] * np.float32(self.about["speed_m_s"])
        cos, sin = np.cos(np.float32(yaw)), np.sin(np.float32(yaw))
        return np.stack([cos * ahead - sin * left, sin * ahead + cos * left, up])

    def _setpoint(self, position: NDArray, yaw: float, goal: NDArray, wanted: NDArray) -> float:
        """Returns the heading to turn to: towards the goal unless it is near, or along the commanded velocity."""
        kept = yaw if self._yaw is None else self._yaw
        if self.about["heading"] == "goal":
            across = goal - position
            near = across[0] ** 2 + across[1] ** 2 < self.about["heading_hold_m"] ** 2
            return kept if near else float(np.arctan2(across[1], across[0]))
        still = wanted[0] ** 2 + wanted[1] ** 2 == 0.0
        return kept if still else float(np.arctan2(wanted[1], wanted[0]))


@dataclasses.dataclass(frozen=True)
class Grid:
    """Which of the policy's pixels each pixel of a camera belongs to."""

    cells: NDArray[np.int32]
    """[camera height, camera width] row times width plus column of the policy's pixel; -1 is outside of its view."""
    pixels: NDArray[np.int64]
    """[H, W] of the camera that belong to each pixel of the policy."""

    @classmethod
    def of(
        cls,
        about: Mapping[str, Any],
        camera: tuple[int, int] | None = None,
        camera_fov_deg: float | None = None,
        directions: ArrayLike | None = None,
    ) -> Grid:
        """Returns the grid of a camera that looks the same way as the policy's.

        Without directions both are pinholes, with square pixels where a field of view is given.

        Args:
            about: `width`, `height` and `horizontal_fov_deg` of the policy's camera.
            camera: width and height; None is the policy's own.
            camera_fov_deg: horizontal; None stretches the camera's image over the policy's.
            directions: as of `Runner`.

        Raises:
            ValueError: if the camera has fewer pixels in the policy's view than the policy, or the directions are not
                those of its pixels.
        """
        width, height = about["width"], about["height"]
        across, down = camera or (width, height)
        half = np.tan(np.radians(about["horizontal_fov_deg"]) / 2)
        if directions is not None:
            towards = np.asarray(directions, np.float64)
            if camera_fov_deg is not None or towards.shape != (down, across, 2):
                raise ValueError(
                    f"directions must be given without camera_fov_deg, {down} x {across} x 2 of them for a camera of "
                    f"{across} x {down} pixels, not {' x '.join(map(str, towards.shape))}"
                )
            columns = _within(towards[..., 0] * width / (2 * half) + width / 2, width)
            rows = _within(towards[..., 1] * width / (2 * half) + height / 2, height)
        elif camera_fov_deg is None:
            columns, rows = (np.arange(many) * size // many for many, size in ((across, width), (down, height)))
            rows = rows[:, None]
        else:
            if not 0.0 < camera_fov_deg < 180.0:
                raise ValueError(f"camera_fov_deg must be between 0 and 180, not {camera_fov_deg}")
            # Pixels of the policy per pixel of the camera.
            scale = np.tan(np.radians(camera_fov_deg) / 2) / across
            scale /= half / width
            columns, rows = _places(across, width, scale), _places(down, height, scale)[:, None]
        cells = np.where((columns >= 0) & (rows >= 0), rows * width + columns, -1).astype(np.int32)
        many = np.bincount(cells[cells >= 0], minlength=width * height).reshape(height, width)
        if _has_holes(many > 0) or _has_holes(many.T > 0):
            raise ValueError(
                f"a camera of {across} x {down} pixels has fewer in the policy's view than the policy, which sees "
                f"{width} x {height}; take one with more"
            )
        return cls(cells, many)


def _places(many: int, size: int, scale: float) -> NDArray[np.int64]:
    """Returns the policy's pixel [many] of each pixel of a camera along one axis; -1 outside of the policy's view."""
    return _within((np.arange(many) + 0.5 - many / 2) * scale + size / 2, size)


def _within(places: NDArray[np.floating], size: int) -> NDArray[np.int64]:
    """Returns the pixels that places along an axis are in; -1 outside of its `size` pixels, or where not finite."""
    inside = (places >= 0) & (places < size)
    return np.floor(np.where(inside, places, -1.0)).astype(np.int64)


def _has_holes(seen: NDArray[np.bool_]) -> bool:
    """Returns whether in a row of pixels [H, W] one is not seen between two that are."""
    before, after = np.logical_or.accumulate(seen, 1), np.logical_or.accumulate(seen[:, ::-1], 1)[:, ::-1]
    return bool(np.any(before & after & ~seen))


def camera_contrast(about: Mapping[str, Any], contrast: float | None = None) -> float | None:
    """Returns the contrast of a camera: as given, or as a policy that knows it was trained with; None is its own.

    Raises:
        ValueError: if it is not above 0.
    """
    if contrast is not None and not 0.0 < contrast < np.inf:
        raise ValueError(
            "contrast must be more than 0, the change of log brightness that makes an event in the camera, not "
            f"{contrast}"
        )
    known = about.get("known_contrast")
    return known["default"] if contrast is None and known else contrast


def with_contrast(about: Mapping[str, Any], values: NDArray[np.float32], contrast: float | None) -> NDArray[np.float32]:
    """Returns own values [N] with that of the camera's contrast after them, for a policy that knows it."""
    known = about.get("known_contrast")
    if not known:
        return values
    own = known["default"] if contrast is None else contrast
    return np.append(values, np.float32(np.log(own / known["middle"]) / known["half_range"]))


def count_events(
    about: Mapping[str, Any],
    packet: NDArray,
    start_us: int,
    *,
    grid: Grid | None = None,
    contrast: float | None = None,
) -> NDArray[np.int32]:
    """Returns the events of a window as the policy counts them, [F, 2, H, W]: pairs of frames, ON and OFF.

    An event says that log brightness changed by the camera's contrast. The changes of the camera's pixels that belong
    to one of the policy's are averaged, and the policy's own threshold and tolerance (Eq. 2 and 4) make events of the
    mean change. So a pixel's ON and OFF events within one pair of frames cancel, as they do for two frames; only a
    policy that was trained with sensor noise counts them apart. At the policy's own resolution and contrast every count
    is that of the events themselves. A policy that knows the contrast counts in the camera's own; of one that was
    trained with the mean of many pixels, a count is that of so many pixels together, and of a finer camera the ON and
    OFF events of all of them cancel: a picture that is finer than the policy's pixels makes both at once, of which it
    has learnt the mean alone.

    Args:
        about: of the policy, see `Runner.about`.
        packet: as in `Runner.decide`.
        start_us: beginning of the window.
        grid: of the camera; None is the policy's own resolution.
        contrast: of the camera; None is the policy's own.

    Raises:
        ValueError: if the packet is no array of events, or one of them is outside of the image.
    """
    grid = Grid.of(about) if grid is None else grid
    return _counts_of(about, _numbers_of(about, packet, start_us, grid), grid, contrast)


def _numbers_of(about: Mapping[str, Any], packet: NDArray, start_us: int, grid: Grid) -> NDArray[np.int64]:
    """Returns how many events of a window are in each of the policy's pixels, [F, 2, H, W].

    Raises:
        ValueError: as `count_events`.
    """
    _check_packet(packet)
    edges = np.asarray(about["frame_times_us"], np.int64)
    since = packet["t"].astype(np.int64) - start_us
    inside = (since >= 0) & (since < edges[-1] - edges[0])
    if not inside.all():
        packet, since = packet[inside], since[inside]
    _check_pixels(packet, grid)
    # A comparison for each of the few frames is faster than a search for each of the many events.
    pair = np.zeros(since.size, np.int32)
    for edge in edges[1:-1] - edges[0]:
        pair += since >= edge
    return _number_in(about, packet, pair, grid, pairs=edges.size - 1)


def _number_in(
    about: Mapping[str, Any], packet: NDArray, pair: NDArray, grid: Grid, *, pairs: int
) -> NDArray[np.int64]:
    """Returns how many events [N], each of its pair of frames, are in each of the policy's pixels."""
    shape = (pairs, 2, about["height"], about["width"])
    place = packet["y"].astype(np.int32) * np.int32(grid.cells.shape[1]) + packet["x"].astype(np.int32)
    cell = grid.cells.ravel()[place]
    where = ((2 * pair + (packet["p"] < 0)) * (shape[2] * shape[3])) + cell
    if cell.size and cell.min() < 0:
        where = where[cell >= 0]
    return np.bincount(where, minlength=int(np.prod(shape))).reshape(shape)


def _counts_of(
    about: Mapping[str, Any], number: NDArray, grid: Grid, contrast: float | None = None
) -> NDArray[np.int32]:
    """Returns events as the policy counts them, of those of the camera [F, 2, H, W]."""
    told = contrast is None or about.get("known_contrast")
    per_event = [1.0 if told else contrast / own for own in (about["contrast_on"], about["contrast_off"])]
    # In contrasts of the policy, means over the camera's pixels.
    change = number * np.asarray(per_event)[:, None, None] / np.maximum(grid.pixels, 1)
    is_finer, together = bool(grid.pixels.max() > 1), about.get("sensor_pixels", 1)
    if about["counts_net"] or (together > 1 and is_finer):
        # Contrasts may differ between ON and OFF.
        log_change = change[:, 0] * about["contrast_on"] - change[:, 1] * about["contrast_off"]
        change = np.stack([log_change / about["contrast_on"], -log_change / about["contrast_off"]], axis=1)
    if together > 1:
        return np.rint(np.maximum(change, 0.0) * together).astype(np.int32)
    # Rounding must not take away what is exactly one event.
    counts = np.floor(np.maximum(change, 0.0) + 1e-6).astype(np.int32)
    return np.where(counts >= about["least_count"], counts, 0).astype(np.int32)


def heading_of(quaternion: NDArray[np.float32]) -> np.float32:
    """Returns the heading of an attitude [4], radians: its twist about the vertical."""
    angle = np.float32(2) * np.arctan2(quaternion[3], quaternion[0])
    return angle - np.float32(2 * np.pi) * np.round(angle / np.float32(2 * np.pi))


def own_state(
    about: Mapping[str, Any],
    position: NDArray[np.float32],
    yaw: np.float32,
    velocity: NDArray[np.float32],
    goal: NDArray[np.float32],
    volume: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Returns the drone's own ten values [10], as the policy was trained with them.

    Distance and height to the goal, cosine and sine of the heading, position in the volume (3), velocity in the heading
    frame (3). Without `knows_position`, metres ahead and to the left take the place of distance and position.
    """
    cos, sin = np.cos(yaw), np.sin(yaw)
    way = goal - position
    if about["knows_position"]:
        distance = np.sqrt(way[0] ** 2 + way[1] ** 2)
        place = 2 * (position - volume[0]) / (volume[1] - volume[0]) - 1
    else:
        distance, left = cos * way[0] + sin * way[1], cos * way[1] - sin * way[0]
        place = np.stack([np.float32(0), np.float32(0), np.arcsinh(left / 2) / 2])
    towards = np.stack([np.arcsinh(distance / 2) / 2, np.arcsinh(way[2] / 2), cos, sin])
    return np.concatenate([towards, place, _ahead(about, yaw, velocity)]).astype(np.float32)


def own_motion(
    about: Mapping[str, Any], yaw: np.float32, velocity: NDArray[np.float32], yaw_rate: Any, move: NDArray
) -> NDArray[np.float32]:
    """Returns the drone's own motion [7]: velocity in the heading frame (3), yaw rate, last move (3)."""
    most = about["most_yaw_rate"]
    rate = np.clip(np.float32(yaw_rate), -most, most)
    return np.concatenate([_ahead(about, yaw, velocity), [rate], move]).astype(np.float32)


def with_lean(
    about: Mapping[str, Any], attitudes: ArrayLike | None, motion: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Returns an own motion [7] with roll and pitch of attitudes [F, 4], radians, for a policy that knows them.

    Raises:
        ValueError: if they are not given, or not one for each frame.
    """
    if not about.get("knows_lean"):
        return motion
    frames = len(about["frame_times_us"])
    if attitudes is None:
        raise ValueError(f"this policy's camera leans with the body; give its {frames} attitudes, one for each frame")
    w, x, y, z = _numbers("attitudes", attitudes, (frames, 4)).T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.concatenate([motion, np.stack([roll, pitch], axis=1).ravel()]).astype(np.float32)


def _ahead(about: Mapping[str, Any], yaw: np.float32, velocity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns a velocity [3] in the heading frame, in commanded speeds."""
    vx, vy, vz = velocity / np.float32(about["speed_m_s"])
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([cos * vx + sin * vy, cos * vy - sin * vx, vz])


def _why_not(file: Path, error: Exception, version: str) -> str:
    """Returns why onnxruntime of a version did not load a file, in a sentence."""
    reason = " ".join(str(error).split())
    if type(error).__name__ == "InvalidProtobuf" or "No graph was found" in reason:
        return f"'{file}' is not an ONNX file"
    oldest = ".".join(map(str, OLDEST_ONNXRUNTIME))
    if tuple(int(part) for part in re.findall(r"\d+", version)[:2]) < OLDEST_ONNXRUNTIME:
        return f"onnxruntime {version} is too old for exported policies; install {oldest} or newer to fly '{file}'"
    return f"onnxruntime {version} cannot run '{file}'; export it again, or install a newer version: {reason}"


def _about(metadata: Mapping[str, str], file: Path) -> dict[str, Any]:
    if METADATA not in metadata:
        raise ValueError(f"'{file}' is not a policy that `edqn export` wrote: it does not say what the policy expects")
    about = json.loads(metadata[METADATA])
    if about["format"] != FORMAT:
        raise ValueError(
            f"'{file}' has the form {about['format']} of an exported policy, and this runner reads the form {FORMAT}; "
            "take the runner that was written beside it"
        )
    return about


def _check_packet(packet: NDArray) -> None:
    names = getattr(getattr(packet, "dtype", None), "names", None) or ()
    if not set(FIELDS) <= set(names) or packet.ndim != 1:
        raise ValueError("a packet of events must be a structured array [N] with the fields t, x, y and p")
    if packet.size and not np.all((packet["p"] == 1) | (packet["p"] == -1)):
        raise ValueError("the polarity p of an event must be -1 or 1; with 0 and 1, give 2 * p - 1")
    if packet.size and any(packet[name].dtype.kind == "i" and packet[name].min() < 0 for name in ("x", "y")):
        raise ValueError("the pixels x and y of events must be at least 0")


def _check_pixels(packet: NDArray, grid: Grid) -> None:
    x, y, (down, across) = packet["x"], packet["y"], grid.cells.shape
    if x.size and (x.max() >= across or y.max() >= down):
        raise ValueError(
            f"an event is at pixel ({x.max()}, {y.max()}), outside of an image of {across} x {down}; say how large "
            "the camera's is"
        )


def _numbers(name: str, given: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    numbers = np.asarray(given, np.float32)
    if numbers.shape != shape or not np.all(np.isfinite(numbers)):
        wanted = "one finite number" if shape == () else f"{' x '.join(map(str, shape))} finite numbers"
        raise ValueError(f"{name} must be {wanted}, not {given!r}")
    return numbers
