"""Signed distances to triangles, each point against each triangle: trimesh's nearest points, and solid angles."""

from __future__ import annotations

import numpy as np
from trimesh.triangles import closest_point


def signed_distances(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns the distances [P] of points [P, 3] to a closed mesh [F, 3, 3], metres, negative inside."""
    found = np.empty(len(points))
    for i, point in enumerate(points):
        nearest = closest_point(triangles, np.repeat(point[None], len(triangles), axis=0))
        found[i] = np.linalg.norm(nearest - point, axis=1).min() * (-1 if _turns(triangles - point) > 0.5 else 1)
    return found


def _turns(triangles: np.ndarray) -> float:
    """Returns how often a mesh goes around the origin: its solid angle, by van Oosterom and Strackee."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    x, y, z = (np.linalg.norm(each, axis=1) for each in (a, b, c))
    over = np.sum(a * np.cross(b, c), axis=1)
    under = x * y * z + np.sum(a * b, axis=1) * z + np.sum(b * c, axis=1) * x + np.sum(a * c, axis=1) * y
    return float(np.sum(np.arctan2(over, under)) / (2 * np.pi))
