"""Orthographic views of a world, and the light in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SUN = np.array([-0.45, -0.6, 0.66])
"""Direction towards the light of the pictures; a unit vector, near enough."""
GROUND = "#f4f3ef"
PALE = 0.3
"""Share of its own colour that an open solid has on a map; the rest is the ground's."""


@dataclass(frozen=True)
class View:
    """An orthographic view of the world. Angles in degrees; elevation 90 is a map with x to the right."""

    azimuth: float
    elevation: float

    @property
    def towards(self) -> np.ndarray:
        """Unit vector from the world to the eye, [3]."""
        a, e = np.radians([self.azimuth, self.elevation])
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Returns points [..., 3] of the world, metres, on the picture: [..., 2] metres, x to the right and y up."""
        a, e = np.radians([self.azimuth, self.elevation])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
        return np.asarray(points) @ np.stack([right, up], axis=1)


MAP = View(azimuth=-90.0, elevation=90.0)
"""From straight above, x to the right and y up."""


def shaded(colour: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Returns colours [..., 3], RGB in [0, 1], as the sun lights sides of unit normals [..., 3]."""
    light = 0.55 + 0.45 * np.maximum(normal @ SUN, 0.0)
    return np.clip(colour * light[..., None] * 1.15, 0.0, 1.0)


def pale(colour: np.ndarray) -> np.ndarray:
    """Returns colours [..., 3], RGB in [0, 1], as they are where a map is open."""
    ground = np.array([int(GROUND[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return PALE * colour + (1 - PALE) * ground
