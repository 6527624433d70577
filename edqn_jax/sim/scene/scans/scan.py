"""A scan, a mesh, a cloud of points or an OctoMap, as a world: an MJCF file and the mesh that it names.

What is closed stays as it is. Anything else is a surface with a thickness, of which a point is a small triangle; of a
map the points are the middles of its occupied voxels.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.free_ends import find_ends
from edqn_jax.sim.scene.grid_boxes import clustered
from edqn_jax.sim.scene.mesh_field import Grid, check_mesh, grid_of_mesh
from edqn_jax.sim.scene.mjcf_parts.assets import load_geometry
from edqn_jax.sim.scene.scans.octomap import read_octomap
from edqn_jax.sim.scene.scans.point_files import POINT_KINDS, read_points
from edqn_jax.sim.scene.shapes.kind import THICKNESS

KINDS = ("ply", "stl", "obj", "glb", "bt", *POINT_KINDS)
"""Endings of scans."""

MOST_READ = 5_000_000
"""Triangles, or points, of a scan."""

MOST_KEPT = 200_000
"""Triangles of the mesh that is written of a surface with a thickness."""

SMALLEST_M, LARGEST_M = 1.0, 400.0
"""Between which the longest side of a scan is plausible."""

CLOUD_THICKNESS_M = 0.1

VOXEL_THICKNESS = 1.5
"""Sides of a voxel; neighbours then leave no gap."""

MARGIN_M = 2.0
"""Metres of the flight volume around a scan, and above it."""

NAME = "scan"
"""Of the geom, and of the mesh's file."""

Point = tuple[float, float, float]
_GROUNDED_M = 0.02  # below the lowest point
_NEAREST = 2000  # points of which the neighbours are looked for


@dataclass(frozen=True)
class ScanOptions:
    """How a scan becomes a world."""

    scale: float = 1.0
    """Metres of a unit of the file."""
    up: str | None = None
    """Axis of the file that points up; None: y of .glb, z of the others."""
    thickness: float | None = None
    """Metres of a surface that is not closed; None: a cloud has `CLOUD_THICKNESS_M`, a map `VOXEL_THICKNESS` of its
    voxels' sides, and a mesh is closed."""
    start: Point | None = None
    """Metres, in the world; None: free places far apart are found."""
    goal: Point | None = None


@dataclass(frozen=True)
class Scan:
    """Triangles in metres, z up, on the ground at 0."""

    vertices: NDArray[np.float64]
    """[V, 3]"""
    faces: NDArray[np.int64]
    """[F, 3]"""
    thickness: float
    """Metres; 0 of a closed mesh."""
    was: str
    """What was read, for people."""


def read_scan(file: Path, options: ScanOptions) -> Scan:
    """Returns a scan in metres, z up, its lowest point at 0 and its box from 0 on along x and y.

    Raises:
        ConfigError: if the file cannot be read, or what is in it is not plausible.
    """
    kind = file.suffix.lower().removeprefix(".")
    if kind not in KINDS:
        raise ConfigError(f"'{file}' is no known scan; it must end in {', '.join(f'.{each}' for each in KINDS)}")
    if not file.is_file():
        raise ConfigError(f"there is no file '{file}'")
    usual = CLOUD_THICKNESS_M
    if kind == "bt":
        vertices, side = read_octomap(file)
        faces, was, usual = None, f"{len(vertices):,} voxels", VOXEL_THICKNESS * side * options.scale
        _check_points(file, vertices)
    elif kind in POINT_KINDS:
        vertices = read_points(file, kind, MOST_READ)
        faces, was = None, f"{len(vertices):,} points"
        _check_vertices(file, vertices)
    else:
        vertices, faces, was = _content(file, load_geometry(file, kind, MOST_READ))
    up = options.up or ("y" if kind == "glb" else "z")
    vertices = options.scale * vertices @ _turn(up).T
    _check_size(file, np.ptp(vertices, axis=0), options)
    vertices = vertices - vertices.min(0)
    if faces is None:
        thickness = options.thickness or usual
        _check_spacing(file, vertices, thickness)
        return Scan(*_triangles_of_points(_thinned(vertices, thickness / 2), thickness / 4), thickness, was)
    vertices, number = np.unique(np.round(vertices, 4), axis=0, return_inverse=True)
    faces = number.reshape(-1)[faces]
    if not options.thickness:
        try:
            check_mesh(vertices, faces)
        except ConfigError as error:
            hint = "; or give --thickness, metres, to fly around its surface" if "watertight" in str(error) else ""
            raise ConfigError(f"'{file}': {error}{hint}") from None
        return Scan(vertices, faces, 0.0, was)
    step = 0.0
    while len(faces) > MOST_KEPT:
        step = max(1.5 * step, options.thickness / 4)
        if step > options.thickness:
            raise ConfigError(
                f"'{file}' has {len(faces):,} triangles, even where those within {options.thickness:g} m "
                "are one; give a larger --thickness, or a smaller part of it"
            )
        vertices, faces = clustered(vertices, faces, step)
    return Scan(vertices, faces, options.thickness, was)


def world_of_scan(scan: Scan, options: ScanOptions, body_radius: float) -> tuple[str, str, Grid]:
    """Returns a world as MJCF, the mesh that it names as .obj, and the grid of its distances.

    Args:
        scan: that was read.
        options: with start and goal.
        body_radius: metres, of what is to fly there.

    Raises:
        ConfigError: if the mesh is too large, or there is no room for a flight.
    """
    grid, middle = grid_of_mesh(scan.vertices, scan.faces, thickness=scan.thickness)
    size = np.ptp(scan.vertices, axis=0)
    low, high = np.array([-MARGIN_M, -MARGIN_M, -_GROUNDED_M]), size + MARGIN_M
    start, goal = find_ends(grid, middle, (low, high), body_radius, options.start, options.goal)
    root = ElementTree.Element("mujoco", model=NAME)
    asset = ElementTree.SubElement(root, "asset")
    ElementTree.SubElement(asset, "mesh", name=NAME, file=f"{NAME}.obj", inertia="shell")
    if scan.thickness:
        custom = ElementTree.SubElement(root, "custom")
        ElementTree.SubElement(custom, "numeric", name=f"{THICKNESS}{NAME}", data=f"{scan.thickness:g}")
    world = ElementTree.SubElement(root, "worldbody")
    ElementTree.SubElement(
        world, "light", directional="true", pos=_text([*size[:2] / 2, size[2] + 20]), dir=".5 .3 -.8"
    )
    for name, place in (("start", start), ("goal", goal)):
        ElementTree.SubElement(world, "site", name=name, pos=_text(place), size="0.3", group="3")
    box = {"pos": _text((low + high) / 2), "size": _text((high - low) / 2)}
    ElementTree.SubElement(
        world, "site", {"name": "volume", "type": "box", "group": "3", "rgba": "0.2 0.4 1 0.1", **box}
    )
    ElementTree.SubElement(
        world, "geom", name="ground", type="plane", size="0 0 1", pos=f"0 0 {-_GROUNDED_M:g}", rgba="0.4 0.42 0.36 1"
    )
    ElementTree.SubElement(world, "geom", name=NAME, type="mesh", mesh=NAME, rgba="0.72 0.69 0.64 1")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n", obj_text(scan.vertices, scan.faces), grid


def obj_text(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> str:
    """Returns a mesh as the text of an .obj file, to a tenth of a millimetre."""
    places = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in vertices]
    rings = [f"f {a} {b} {c}" for a, b, c in np.asarray(faces) + 1]
    return "\n".join([*places, *rings]) + "\n"


def _content(file: Path, found: Any) -> tuple[NDArray[np.float64], NDArray[np.int64] | None, str]:
    """Returns vertices, triangles (None of a cloud of points), and what they are."""
    vertices = np.asarray(found.vertices, np.float64)
    faces = np.asarray(getattr(found, "faces", np.zeros((0, 3))), np.int64)
    count, what = (len(faces), "triangles") if len(faces) else (len(vertices), "points")
    if count > MOST_READ:
        raise ConfigError(f"'{file}' has {count:,} {what}; it may have {MOST_READ:,}, so thin it out")
    _check_vertices(file, vertices)
    return vertices, faces if len(faces) else None, f"{count:,} {what}"


def _check_vertices(file: Path, vertices: NDArray[np.float64]) -> None:
    """Raises ConfigError if vertices [V, 3] are too few, or not finite."""
    _check_points(file, vertices)
    if not np.all(np.isfinite(vertices)):
        raise ConfigError(f"'{file}' has a point that is not finite; give it numbers")


def _check_points(file: Path, points: NDArray[np.float64]) -> None:
    """Raises ConfigError if a scan has too few points [P, 3]."""
    if len(points) < 4:
        raise ConfigError(f"'{file}' has {len(points)} points; a world needs more")


def _turn(up: str) -> NDArray[np.float64]:
    """Returns the rotation [3, 3] that takes an axis of a file up."""
    axis = "xyz".index(up[-1])
    turn = np.roll(np.eye(3), 2 - axis, axis=0)
    return np.diag([-1.0, 1.0, -1.0]) @ turn if up.startswith("-") else turn


def _check_size(file: Path, size: NDArray[np.float64], options: ScanOptions) -> None:
    """Raises if a scan is too small or too large to fly in, or lies on its side.

    Raises:
        ConfigError: names the option that would change it.
    """
    sides = " x ".join(f"{side:,.4g}" for side in size)
    if size.max() < SMALLEST_M:
        raise ConfigError(
            f"'{file}' measures {sides} m, too little to fly in; give --scale, metres of a unit of the file"
        )
    if size.max() > LARGEST_M:
        millimetres = size.max() / 1000 <= LARGEST_M and options.scale == 1
        guess = ", 0.001 if it is in millimetres" if millimetres else ", or a part of it"
        raise ConfigError(f"'{file}' measures {sides} m, more than {LARGEST_M:g}; give a smaller --scale{guess}")
    if options.up is None and size[2] > size[:2].max():
        raise ConfigError(f"'{file}' is taller than it is wide, {sides} m; say which axis points up: --up y, or --up z")


def _check_spacing(file: Path, points: NDArray[np.float64], thickness: float) -> None:
    """Raises if the points of a cloud lie further apart than its surface is thick.

    Raises:
        ConfigError: says how far.
    """
    some = points[:: max(1, len(points) // _NEAREST)]
    apart = float(np.quantile(scipy.spatial.KDTree(points).query(some, k=2)[0][:, 1], 0.9))
    if apart > thickness:
        raise ConfigError(
            f"the points of '{file}' lie {apart:.2g} m apart, and a surface of {thickness:g} m would have holes; give "
            "--thickness, or more points"
        )


def _thinned(points: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Returns one of the points [P, 3] in each cube of sides `step`, larger where there are too many."""
    while True:
        _, first = np.unique(np.floor(points / step).astype(np.int64), axis=0, return_index=True)
        if len(first) <= MOST_KEPT:
            return points[np.sort(first)]
        step *= 1.25


def _triangles_of_points(points: NDArray[np.float64], radius: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns a small level triangle about each point."""
    turn = 2 * np.pi * np.arange(3) / 3
    corners = radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=1)
    vertices = np.round(points[:, None] + corners, 4).reshape(-1, 3)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _text(values: Any) -> str:
    return " ".join(f"{float(value):.4g}" for value in values)
