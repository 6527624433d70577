"""Where a recording's camera was, from a file of poses: text as of the TUM benchmark, or columns with names."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.interop.deployment.runner import heading_of
from edqn_jax.interop.outer.poses import Track
from edqn_jax.interop.recordings.recording import MICROSECONDS, Recording

COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
"""Order without names: TUM's."""

STEP_US = 20_000
"""Between poses of a flight; velocities are means over two, which noise of a millimetre changes by 0.04 m/s."""


def with_poses(recording: Recording, file: Path, of: Literal["camera", "body"], speed_m_s: float) -> Recording:
    """Returns a recording with the flight that a file of poses tells of, as far as both go.

    Args:
        recording: on the same clock as the poses, in whatever unit.
        file: a line each of time, position in metres and quaternion: `t x y z qx qy qz qw` unless a first line names
            the columns; world with z up.
        of: whose poses they are: of the camera, z ahead, x to the right, y down; or of a body, x ahead, y to the left,
            z up, on which the camera looks ahead.
        speed_m_s: that a policy commands, to say which of its moves was nearest.

    Raises:
        ConfigError: if the file is not as it should be, or its times are not those of the events.
    """
    table = _read(file)
    quaternion = table[:, [7, 4, 5, 6]]
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    if not np.all(np.abs(length - 1.0) < 0.01):
        raise ConfigError(f"'{file}' has quaternions that are not of length 1; are its columns {' '.join(COLUMNS)}?")
    quaternion /= length
    if of == "camera":
        quaternion = _body_of(quaternion)
    times = _on_the_clock(file, table[:, 0], recording)
    begin = max(times[0], float(recording.events["t"][0]))
    end = min(times[-1], float(recording.events["t"][-1]))
    t = np.arange(int(np.ceil(begin)), int(end) + 1, STEP_US, dtype=np.int64)
    if len(t) < 3:
        raise ConfigError(f"'{file}' and the events have less than {3e-6 * STEP_US:g} s in common")
    track = Track(times, table[:, 1:4], quaternion)
    placed = [track.at(float(each)) for each in t]
    position, attitude = (np.stack([each[part] for each in placed]) for part in (0, 1))
    velocity = np.gradient(position, STEP_US * 1e-6, axis=0)
    flight = {"t": t, "position": position, "quaternion": attitude, "velocity": velocity}
    return _with_flight(recording, flight, speed_m_s)


def _with_flight(recording: Recording, flight: Mapping[str, NDArray], speed_m_s: float) -> Recording:
    yaw = np.array([heading_of(each) for each in flight["quaternion"]])
    vx, vy, vz = flight["velocity"].T
    ahead = np.stack([np.cos(yaw) * vx + np.sin(yaw) * vy, np.cos(yaw) * vy - np.sin(yaw) * vx, vz], axis=1)
    move = np.clip(np.rint(ahead / speed_m_s), -1, 1).astype(np.int8)
    return dataclasses.replace(recording, flight={**flight, "move": move})


def _body_of(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns attitudes [N, 4] w, x, y, z of a body, x ahead, of those of its camera, z ahead."""
    w, x, y, z = quaternion.T
    # Times the turn of the body within the camera's frame, (1, 1, -1, 1) / 2.
    return 0.5 * np.stack([w - x + y - z, w + x + y + z, -w - x + y + z, w - x - y + z], axis=1)


def _on_the_clock(file: Path, times: NDArray[np.float64], recording: Recording) -> NDArray[np.float64]:
    """Returns times in microseconds, of the unit in which poses and events have most of their time in common."""
    if not np.all(np.diff(times) > 0):
        raise ConfigError(f"the times of '{file}' must grow from line to line")
    first, last = float(recording.events["t"][0]), float(recording.events["t"][-1])
    shared = {factor: _shared(times * factor, first, last) for factor in MICROSECONDS.values()}
    if max(shared.values()) <= 0.0:
        raise ConfigError(
            f"'{file}' has times from {times[0]:g} to {times[-1]:g}, which in no unit are those of the events, from "
            f"{1e-6 * first:g} to {1e-6 * last:g} s"
        )
    return times * max(shared, key=lambda factor: shared[factor])


def _shared(times: NDArray[np.float64], first: float, last: float) -> float:
    """Returns what share of both stretches of time, taken together, they have in common."""
    return (min(times[-1], last) - max(times[0], first)) / (max(times[-1], last) - min(times[0], first))


def _read(file: Path) -> NDArray[np.float64]:
    """Returns the columns [N, 8] of `COLUMNS`."""
    try:
        lines = [line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"there is no file of poses '{file}': {error}") from None
    rows = [line for line in lines if re.match(r"[-+.\d]", line)]
    names = next((found for line in lines if line not in rows and (found := _named(line)) is not None), None)
    order = list(range(len(COLUMNS))) if names is None else names
    try:
        return np.array([[float(_words(line)[place]) for place in order] for line in rows]).reshape(-1, len(COLUMNS))
    except (ValueError, IndexError):
        raise ConfigError(f"'{file}' must have lines of {' '.join(COLUMNS)}, or a first line that names them") from None


def _named(line: str) -> list[int] | None:
    """Returns where each of `COLUMNS` stands by a line of names, as `p_RS_R_x [m]`; None if it names none."""
    found: dict[str, int] = {}
    for place, word in enumerate(_words(re.sub(r"\[[^\]]*\]", "", line.lstrip("# ")))):
        name = word.lower()
        if name in ("t", "time", "timestamp", "stamp"):
            found["t"] = place
        elif match := re.fullmatch(r"(q|p|t|pos|position)?(?:_|_.*_)?([xyzw])", name):
            found.setdefault(("q" if match[1] == "q" else "") + match[2], place)
    return [found[name] for name in COLUMNS] if found.keys() >= set(COLUMNS) else None


def _words(line: str) -> list[str]:
    return [word for word in re.split(r"[,;\s]+", line) if word]
