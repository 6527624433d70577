"""Meshes, and worlds that hold them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

CUBE = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(8, 3)
"""Corners of a cube."""

LUMP = '<mesh name="lump" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'
"""A mesh for a geom of the kind sdf, which nothing reads."""


def hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and triangles [F, 3], anticlockwise from outside, of the convex hull of points."""
    found = ConvexHull(points)
    a, b, c = np.moveaxis(points[found.simplices], 1, 0)
    inwards = np.sum(np.cross(b - a, c - a) * found.equations[:, :3], axis=1) < 0
    return points, np.where(inwards[:, None], found.simplices[:, ::-1], found.simplices)


def ball(count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of corners on the unit sphere."""
    number = np.arange(count) + 0.5
    height, turn = 1 - 2 * number / count, np.pi * (1 + 5**0.5) * number
    around = np.sqrt(1 - height**2)
    return hull(np.stack([around * np.cos(turn), around * np.sin(turn), height], axis=1))


def bracket() -> tuple[np.ndarray, np.ndarray]:
    """A mesh that is not convex: an upright board with a shelf, two boxes side by side."""
    parts = [hull(CUBE * [0.2, 0.9, 0.8] + [-0.6, 0, 0.2]), hull(CUBE * [0.6, 0.5, 0.2] + [0.2, 0, -0.3])]
    return np.concatenate([part[0] for part in parts]), np.concatenate([parts[0][1], parts[1][1] + 8])


def mesh_asset(name: str, vertices: np.ndarray, faces: np.ndarray) -> str:
    """The mesh as MJCF has it."""
    vertex, face = " ".join(f"{x:.9g}" for x in np.ravel(vertices)), " ".join(map(str, np.ravel(faces)))
    return f'<mesh name="{name}" vertex="{vertex}" face="{face}"/>'


def mesh_world(folder: Path, geoms: str, **meshes: tuple[np.ndarray, np.ndarray]) -> Path:
    """An MJCF file with a ground, these geoms and these meshes."""
    made = "".join(mesh_asset(name, *mesh) for name, mesh in meshes.items())
    sites = '<site name="start" pos="1 5 3"/><site name="goal" pos="19 5 3"/>'
    sites += '<site name="volume" type="box" pos="10 5 3" size="10 5 3" group="3"/>'
    file = folder / "meshes.xml"
    ground = '<geom type="plane" size="0 0 1"/>'
    file.write_text(f"<mujoco><asset>{made}</asset><worldbody>{sites}{ground}{geoms}</worldbody></mujoco>")
    return file
