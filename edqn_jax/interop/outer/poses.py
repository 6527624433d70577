"""Where a camera was: poses of a flight at any time."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray


@dataclasses.dataclass(frozen=True)
class Body:
    """What a drone knows of itself at a decision."""

    position: NDArray[np.float64]
    """[3] metres."""
    quaternion: NDArray[np.float64]
    """[4] w, x, y, z, from the body to the world."""
    velocity: NDArray[np.float64]
    """[3] m/s in the world."""
    yaw_rate: float
    """Of the heading, rad/s to the left."""


@dataclasses.dataclass(frozen=True)
class Track:
    """Poses of a flight; K of them, in the order of time."""

    time: NDArray[np.float64]
    """[K] seconds since the flight began."""
    position: NDArray[np.float64]
    """[K, 3] metres."""
    quaternion: NDArray[np.float64]
    """[K, 4] w, x, y, z, from the body (x ahead, y left, z up) to the world."""

    def then(self, other: Track) -> Track:
        """Returns this track and then the other one."""
        parts = ((getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self))
        return Track(*(np.concatenate(part) for part in parts))

    def at(self, time: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns position [3] and quaternion [4] at a time, linear between poses; the first pose before them."""
        after = int(np.clip(np.searchsorted(self.time, time), 1, max(len(self.time) - 1, 1)))
        if len(self.time) == 1 or time <= self.time[0]:
            return self.position[0], self.quaternion[0]
        span = self.time[after] - self.time[after - 1]
        share = float(np.clip((time - self.time[after - 1]) / span, 0.0, 1.0))
        first, last = self.quaternion[after - 1], self.quaternion[after]
        last = last if first @ last >= 0 else -last
        turned = (1 - share) * first + share * last
        position = (1 - share) * self.position[after - 1] + share * self.position[after]
        return position, turned / np.linalg.norm(turned)


def heading_of(quaternion: NDArray[np.float64]) -> float:
    """Returns the heading of an attitude [4], radians from the world's x to the left."""
    return 2 * float(np.arctan2(quaternion[3], quaternion[0]))


def camera_rotation(quaternion: NDArray[np.float64], mount: str) -> NDArray[np.float64]:
    """Returns the camera's rotation [3, 3] to the world, x ahead: the heading alone where the mount is `level`."""
    w, x, y, z = quaternion
    if mount == "level":
        half = heading_of(quaternion) / 2
        w, x, y, z = np.cos(half), 0.0, 0.0, np.sin(half)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
