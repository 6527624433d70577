"""Faces of round and square solids, for pictures: rings of corners [k, 3], metres, of one shape."""

from __future__ import annotations

import numpy as np

AROUND = 36
"""Corners of a circle."""


def faces_of_box(position: np.ndarray, half: np.ndarray, rotation: np.ndarray) -> list[np.ndarray]:
    """Returns the six faces of a box of `half` [3] extents, metres, turned by `rotation` [3, 3], body-to-world."""
    faces = []
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1.0, 1.0):
            ring = np.zeros((4, 3))
            ring[:, axis] = side
            ring[:, one] = [-1, 1, 1, -1]
            ring[:, other] = [-1, -1, 1, 1]
            faces.append(position + (ring * half) @ rotation.T)
    return faces


def faces_of_tube(position: np.ndarray, axis: np.ndarray, radius: float, half: float) -> list[np.ndarray]:
    """Returns the faces of a cylinder about `axis` [3], unit, of `radius` and `half` its length, metres."""
    rings = _rings(position, axis, np.full(2, radius), np.array([-half, half]))
    return [*faces_between(rings), rings[0], rings[1]]


def faces_of_capsule(position: np.ndarray, axis: np.ndarray, radius: float, half: float) -> list[np.ndarray]:
    """Returns the faces of a capsule, metres, of a sphere where `half` is 0; flat poles keep faces from shrinking."""
    angle = np.linspace(-np.pi / 2 + 0.05, np.pi / 2 - 0.05, 18)
    along = radius * np.sin(angle) + half * np.sign(angle)
    rings = _rings(position, axis, radius * np.cos(angle), along)
    return [*faces_between(rings), rings[0], rings[-1]]


def faces_between(rings: np.ndarray) -> list[np.ndarray]:
    """Returns the four-cornered faces between neighbouring rings [rings, k, 3]."""
    following = np.roll(rings, -1, axis=1)
    corners = np.stack([rings[:-1], following[:-1], following[1:], rings[1:]], axis=2)
    return list(corners.reshape(-1, 4, 3))


def _rings(position: np.ndarray, axis: np.ndarray, radii: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Returns circles around an axis, [circles, AROUND, 3]."""
    aside = np.eye(3)[np.argmin(np.abs(axis))]
    one = np.cross(axis, aside)
    one /= np.linalg.norm(one)
    other = np.cross(axis, one)
    angle = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)[:, None]
    circle = np.cos(angle) * one + np.sin(angle) * other
    return position + radii[:, None, None] * circle + along[:, None, None] * axis
