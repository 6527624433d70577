"""An autopilot's frames and ours.

Ours: z up, body x ahead and y left, headings from x to the left. MAVLink's local frame is north, east, down, its body
frame ahead, right, down, its yaw from north to the right. Our x is east, our y north.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def from_ned(vector: ArrayLike) -> NDArray[np.float64]:
    """Returns a vector [3] of north, east, down as x (east), y (north), z (up); its own inverse."""
    north, east, down = np.asarray(vector, np.float64)
    return np.array([east, north, -down])


to_ned = from_ned


def quaternion_from_ned(quaternion: ArrayLike) -> NDArray[np.float64]:
    """Returns an attitude [4] w, x, y, z from MAVLink's body to its local frame in our frames; its own inverse."""
    w, x, y, z = np.asarray(quaternion, np.float64)
    return np.sqrt(0.5) * np.array([w + z, x + y, x - y, w - z])


def yaw_to_ned(yaw: float) -> float:
    """Returns a heading from east to the left as one from north to the right, in [-pi, pi); its own inverse."""
    return float((np.pi / 2 - yaw + np.pi) % (2 * np.pi) - np.pi)


def quaternion_of_angles(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """Returns the attitude [4] w, x, y, z of angles in radians, turned about z, then y, then x."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.array([roll, pitch, yaw]) / 2) for f in (np.cos, np.sin))
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def angles_of(quaternion: ArrayLike) -> tuple[float, float, float]:
    """Returns roll, pitch and yaw, radians, of an attitude [4]."""
    w, x, y, z = np.asarray(quaternion, np.float64)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return float(roll), float(pitch), float(yaw)


def heading_rate(roll: float, pitch: float, pitch_rate: float, yaw_rate: float) -> float:
    """Returns the rate of the heading, rad/s, from rates about the body's y and z; to the right where z points down."""
    return float((np.sin(roll) * pitch_rate + np.cos(roll) * yaw_rate) / max(np.cos(pitch), 0.1))


def rotate(quaternion: ArrayLike, vector: ArrayLike) -> NDArray[np.float64]:
    """Returns a vector [3] turned by an attitude [4] w, x, y, z."""
    q, v = np.asarray(quaternion, np.float64), np.asarray(vector, np.float64)
    across = 2.0 * np.cross(q[1:], v)
    return v + q[0] * across + np.cross(q[1:], across)


def between(first: NDArray[np.float64], last: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Returns the attitude [4] at a share of the way from one to another, linear and normed."""
    last = last if first @ last >= 0.0 else -last
    turned = (1.0 - share) * first + share * last
    return turned / np.linalg.norm(turned)
