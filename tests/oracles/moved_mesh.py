"""A mesh that moves with its body, in the plainest way: its triangles are moved, and all of them asked."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from tests.oracles.mesh_distance import signed_distances
from tests.oracles.motion_plain import bounced, swung


@dataclasses.dataclass(frozen=True)
class MovedMesh:
    """A closed mesh on a body that runs between walls and swings on an ellipse at once."""

    triangles: NDArray[np.float64]
    """[F, 3, 3] metres, in the mesh's own axes."""
    rotation: NDArray[np.float64]
    """[3, 3] mesh-to-world."""
    position: NDArray[np.float64]
    """[3] of the body at time 0, metres."""
    velocity: tuple[float, float, float]
    """At time 0, m/s."""
    low: NDArray[np.float64]
    """[3] metres, between which and `high` the body runs."""
    high: NDArray[np.float64]
    half_axes: NDArray[np.float64]
    """[2, 3] metres."""
    rate: float
    """rad/s"""
    phase: float
    """rad"""

    def place(self, time: float) -> NDArray[np.float64]:
        """Returns the position [3] of the body at a time, metres."""
        run = [
            bounced(self.position[axis], self.velocity[axis], self.low[axis], self.high[axis], time, steps=2000)
            for axis in range(3)
        ]
        return np.array(run) + swung(self.half_axes[0], self.half_axes[1], self.rate, self.phase, time)

    def at(self, time: float) -> NDArray[np.float64]:
        """Returns the triangles [F, 3, 3] at a time, metres, in the world's frame."""
        place = self.place(time)
        return np.array([[self.rotation @ corner + place for corner in each] for each in self.triangles])

    def distances(self, points: NDArray[np.floating], time: float) -> NDArray[np.float64]:
        """Returns the signed distances [P] of points [P, 3] at a time, metres."""
        return signed_distances(self.at(time), np.asarray(points, np.float64))

    def ray_depths(self, origin: NDArray[np.floating], rays: NDArray[np.floating], time: float) -> NDArray[np.float64]:
        """Returns metres from `origin` [3] along unit rays [R, 3] to the first triangle at a time, inf without one."""
        triangles = self.at(time)
        return np.array([min(_depth(corners, np.asarray(origin, float), ray) for corners in triangles) for ray in rays])


def _depth(corners: NDArray[np.float64], origin: NDArray[np.float64], ray: NDArray[np.floating]) -> float:
    """Returns how far along a ray a triangle is met: origin + t ray = a + u (b - a) + v (c - a)."""
    a, b, c = corners
    system = np.stack([b - a, c - a, -ray], axis=1)
    if abs(np.linalg.det(system)) < 1e-12:
        return np.inf
    u, v, t = np.linalg.solve(system, origin - a)
    return t if u >= 0 and v >= 0 and u + v <= 1 and t > 0 else np.inf
