"""Files of meshes and height fields that a world names, put into its text, which is then one file.

They lie in the folder of the world or below it. MuJoCo gets their numbers in its own attributes, so that scale,
reference and defaults mean what they mean there.
"""

from __future__ import annotations

import io
import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mesh_field import MOST_TRIANGLES

KINDS = ("obj", "stl", "ply", "msh")
"""Endings of the mesh files that a world may name; `.msh` is MuJoCo's own."""

MAX_FILE_BYTES = 100_000_000
"""Of all files that a world names."""

MOST_BYTES = 1_000_000_000
"""Of a scan, which is read whole."""

MAX_HEIGHTS = 250_000
"""Of a height field, rows times columns."""

FARTHEST = 1e7
"""Of a mesh's coordinates, in its own units; beyond it MuJoCo finds no hull."""

_HEADER = 10_000  # bytes that hold the counts of a file
_STL_BYTES = 50  # of a triangle
_FIELD_KINDS = ("png", "bin")


def inline_files(tree: ElementTree.Element, path: Path) -> bool:
    """Puts the numbers of the mesh and height field files that a world's elements name in place of the names.

    Args:
        tree: of the world at `path`.
        path: of the world.

    Returns:
        whether there was any.

    Raises:
        ConfigError: if a file is missing, lies outside of the world's folder, is too large or cannot be read.
    """
    named = [element for element in tree.iter() if element.tag in ("mesh", "hfield") and element.get("file")]
    folder, left = mesh_folder(tree), MAX_FILE_BYTES
    for element in named:
        file = find_file(path, folder, str(element.get("file")), element.tag)
        left -= file.stat().st_size
        if left < 0:
            raise ConfigError(f"{path} names files of more than {MAX_FILE_BYTES:,} bytes together; thin them out")
        element.attrib.pop("content_type", None)
        element.attrib.pop("file")
        element.attrib.setdefault("name", file.stem)
        if element.tag == "mesh":
            vertices, faces = read_mesh(file)
            element.set("vertex", " ".join(f"{x:.9g}" for x in vertices.ravel()))
            element.set("face", " ".join(map(str, faces.ravel())))
        else:
            for name, value in _read_field(file).items():
                element.set(name, value)
    return bool(named)


def mesh_folder(tree: ElementTree.Element) -> str:
    """Returns the folder in which a world's mesh files lie, as its compiler elements have it."""
    found = ""
    for element in tree.iter("compiler"):
        found = element.get("meshdir", element.get("assetdir", found))
    return found


def find_file(path: Path, folder: str, name: str, tag: str) -> Path:
    """Returns the file that a world names.

    Args:
        path: of the world.
        folder: below its own in which such files lie.
        name: of the file.
        tag: of the element that names it.

    Raises:
        ConfigError: if it is no file in the folder of the world.
    """
    home = path.parent.resolve()
    try:
        file = (home / folder / name).resolve()
        exists = file.is_file()
    except (OSError, ValueError, RuntimeError):
        raise ConfigError(f"{path} names the file {name!r} in <{tag}>, which is no path") from None
    if not file.is_relative_to(home):
        raise ConfigError(
            f"{path} names the file '{name}' in <{tag}>, which lies outside of the world's folder; copy it there"
        )
    if not exists:
        raise ConfigError(f"{path} names the file '{name}' in <{tag}>, and there is none in {file.parent}")
    return file


def read_mesh(file: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns vertices [V, 3] and triangles [F, 3] of a mesh file, equal vertices as one.

    Raises:
        ConfigError: if it is of another kind, has too many triangles, or cannot be read.
    """
    kind = file.suffix.lower().removeprefix(".")
    if kind not in KINDS:
        raise ConfigError(f"the mesh file '{file}' must end in {', '.join(f'.{each}' for each in KINDS)}")
    found = _load_msh(file) if kind == "msh" else load_geometry(file, kind)
    faces = np.asarray(getattr(found, "faces", np.zeros((0, 3))), np.int64)
    if not len(faces):
        raise ConfigError(f"the mesh file '{file}' has no triangles; `edqn world` makes a world of points")
    check_number(file, len(faces))
    vertices, number = np.unique(np.asarray(found.vertices, np.float64), axis=0, return_inverse=True)
    if not np.all(np.isfinite(vertices)):
        raise ConfigError(f"the mesh file '{file}' has a vertex that is not finite; give it numbers")
    if np.abs(vertices).max() >= FARTHEST:
        raise ConfigError(
            f"the mesh file '{file}' has a vertex {np.abs(vertices).max():.2g} away; mend it, or scale it"
        )
    return vertices, number.reshape(-1)[faces]


def load_geometry(file: Path, kind: str, most: int = MOST_TRIANGLES) -> Any:
    """Returns what trimesh reads of a file of at most so many triangles: a mesh, or a cloud of points.

    Raises:
        ConfigError: if it has too many triangles or cannot be read.
    """
    import trimesh

    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise ConfigError(
                f"the mesh file '{file}' has {size / 1e9:.1f} GB; it may have {MOST_BYTES / 1e9:g}, so simplify it"
            )
        with file.open("rb") as opened:
            check_number(file, _announced(opened.read(_HEADER), kind, size), most)
        content = file.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read the mesh file '{file}': {error.strerror}") from None
    check_number(file, _counted(content, kind), most)
    try:
        found: Any = trimesh.load(io.BytesIO(content), file_type=kind, process=False)
        if isinstance(found, trimesh.Scene):
            found = found.to_geometry()
    except Exception as error:  # trimesh passes on whatever a file makes its readers raise
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"the mesh file '{file}' cannot be read as .{kind}: {reason}") from None
    _check_corners(file, np.asarray(getattr(found, "faces", ())), len(found.vertices))
    return found


def _load_msh(file: Path) -> Any:
    """Returns what is in a mesh file of MuJoCo's own kind, which may lack triangles: four counts, then what they count.

    Raises:
        ConfigError: if it is of another length, has too many triangles, or names vertices that it does not have.
    """
    import trimesh

    try:
        content = file.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read the mesh file '{file}': {error.strerror}") from None
    counts = np.frombuffer(content[:16], "<i4").astype(np.int64) if len(content) >= 16 else np.full(4, -1)
    vertices, normals, places, faces = map(int, counts)
    if counts.min() < 0 or len(content) != 16 + 4 * (3 * vertices + 3 * normals + 2 * places + 3 * faces):
        raise ConfigError(f"the mesh file '{file}' cannot be read as .msh: its length is not that of what it counts")
    check_number(file, faces)
    numbers = np.frombuffer(content[16 : 16 + 12 * vertices], "<f4").reshape(-1, 3)
    rings = np.frombuffer(content[len(content) - 12 * faces :], "<i4").reshape(-1, 3)
    _check_corners(file, rings, vertices)
    return trimesh.Trimesh(numbers, rings, process=False)


def _check_corners(file: Path, faces: NDArray[np.integer], vertices: int) -> None:
    """Raises ConfigError if a triangle of [F, 3] has a corner that is none of so many vertices."""
    if len(faces) and not (faces.min() >= 0 and faces.max() < vertices):
        raise ConfigError(f"the mesh file '{file}' has a triangle of vertices that it does not have")


def check_number(file: Path, count: int, most: int = MOST_TRIANGLES) -> None:
    """Raises ConfigError if a file has too many triangles.

    Raises:
        ConfigError: says how many it may have.
    """
    if count > most:
        raise ConfigError(f"the mesh file '{file}' has {count:,} triangles; it may have {most:,}, so thin it out")


def _announced(header: bytes, kind: str, size: int) -> int:
    """Returns how many triangles a file says that it has; 0 if it does not say it."""
    if kind == "stl" and len(header) >= 84:
        count = int.from_bytes(header[80:84], "little")
        return count if size >= 84 + _STL_BYTES * count else 0
    found = re.search(rb"element face (\d{1,18})", header) if kind == "ply" else None
    return int(found[1]) if found else 0


def _counted(content: bytes, kind: str) -> int:
    """Returns how many triangles, at least, are in a file that does not say it at its beginning."""
    if kind == "obj":
        return sum(content.count(b"\nf" + blank) for blank in (b" ", b"\t"))
    if kind == "stl" and content[:5].lower() == b"solid":
        return max(content.count(b"endfacet"), content.count(b"ENDFACET"))
    return _counted_in_glb(content) if kind == "glb" else 0


def _counted_in_glb(content: bytes) -> int:
    """Returns how many triangles the nodes of a .glb have together; 0 if it is none."""
    try:
        told = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
        counts = [each["count"] for each in told["accessors"]]
        of_mesh = [
            sum(counts[part.get("indices", part["attributes"]["POSITION"])] // 3 for part in mesh["primitives"])
            for mesh in told["meshes"]
        ]
        return int(sum(of_mesh[node["mesh"]] for node in told["nodes"] if "mesh" in node))
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError):
        return 0


def _heights_in(content: bytes, kind: str) -> tuple[int, int]:
    """Returns the rows and columns that the file of a height field says that it has."""
    if kind == "png":
        return int.from_bytes(content[20:24], "big"), int.from_bytes(content[16:20], "big")
    rows, columns = (int.from_bytes(content[i : i + 4], "little", signed=True) for i in (0, 4))
    return rows, columns


def _read_field(file: Path) -> dict[str, str]:
    """Returns rows, columns and heights of a height field's file, as MuJoCo reads it.

    Raises:
        ConfigError: if it does not.
    """
    kind = file.suffix.lower().removeprefix(".")
    if kind not in _FIELD_KINDS:
        raise ConfigError(f"the height field's file '{file}' must end in .png or .bin")
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read the height field's file '{file}': {error.strerror}") from None
    rows, columns = _heights_in(content, kind)
    # Before it is unpacked: a picture of a few bytes may be a large one.
    if not (min(rows, columns) >= 2 and rows * columns <= MAX_HEIGHTS):
        raise ConfigError(
            f"the height field's file '{file}' is of {rows} x {columns}; it must be 2 x 2 to {MAX_HEIGHTS:,} heights"
        )
    text = (
        f'<mujoco><asset><hfield name="h" file="h.{kind}" size="1 1 1 1"/></asset><worldbody>'
        '<geom type="hfield" hfield="h"/></worldbody></mujoco>'
    )
    try:
        model = mujoco.MjModel.from_xml_string(text, {f"h.{kind}": content})
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"the height field's file '{file}' cannot be read: {reason}") from None
    rows, columns = int(model.hfield_nrow[0]), int(model.hfield_ncol[0])
    heights = model.hfield_data.reshape(rows, columns)[::-1]  # in a file's text the first row is the furthest along y
    return {"nrow": str(rows), "ncol": str(columns), "elevation": " ".join(f"{x:.7g}" for x in heights.ravel())}
