"""Tries a folder of others' MJCF files: which open as worlds, and why others do not.

    python scripts/try_public_mjcf.py FOLDER --out table.tsv
    python scripts/try_public_mjcf.py FOLDER --out table.tsv --still SCRATCH

A file counts if MuJoCo opens it and it has a solid geom at rest that is no plane. Start and goal are free places in
opposite corners of its flight volume; a world is flown if there is a way between them for the drone. With --still, what
moves is taken away first, and what acts on it: MuJoCo writes each file to a folder of its own in SCRATCH, together with
the meshes and height fields that are left; and what is said of meshes that are not closed is done, they get a
thickness. One row a file: its path, `flown`, `refused` or `crashed`, how many meshes got a thickness, seconds, the
reason. Rows that the table has already are kept.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import sys
import time
import traceback
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.planning.lattice import clearances
from edqn_jax.planning.widest import find_widest_way, is_roomy
from edqn_jax.sim.scene.mjcf import check_scene, check_volume, load_world
from edqn_jax.sim.scene.mjcf_parts.geoms import is_solid
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.shapes.kind import THICKNESS
from edqn_jax.sim.scene.survey import survey_world

THICKNESS_M = 0.05
"""Of surfaces that close nothing."""

ROOM_M = 0.9
"""Clearance of start and goal."""

MOVING = (
    "camera",
    "light",
    "actuator",
    "sensor",
    "tendon",
    "equality",
    "keyframe",
    "contact",
    "deformable",
    "extension",
)
"""Elements that say how things move, what is measured of it, or what looks at it."""

JOINTS = {"joint", "freejoint"}


def is_counted(path: Path) -> bool:
    """Returns whether MuJoCo opens a file and it has a solid geom at rest that is no plane."""
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError:
        return False
    return any(
        is_solid(model, geom)
        and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE
        and not model.body_weldid[model.geom_bodyid[geom]]
        for geom in range(model.ngeom)
    )


def write_still(path: Path, folder: Path) -> Path:
    """Writes what of a file stands still, in one piece, to a folder, with the files that it names; returns it."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compile()
    root = ElementTree.fromstring(spec.to_xml())
    home = path.parent / (spec.meshdir or "")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in MOVING or (child.tag == "body" and _moves(child)):
                parent.remove(child)
    used = {geom.get(kind) for geom in root.iter("geom") for kind in ("mesh", "hfield")}
    for parent in list(root.iter("asset")):
        for number, element in enumerate(list(parent)):
            if element.tag not in ("mesh", "hfield"):
                continue
            name = element.get("file")
            element.attrib.setdefault("name", Path(name or "").stem)
            if element.get("name") not in used:
                parent.remove(element)
            elif name is not None:
                element.set("file", f"{number}{Path(name).suffix}")
                shutil.copyfile(home / name, folder / f"{number}{Path(name).suffix}")
    for number, geom in enumerate(geom for world in root.iter("worldbody") for geom in world.iter("geom")):
        geom.attrib.setdefault("name", f"geom {number}")
    for compiler in root.iter("compiler"):
        for key in ("meshdir", "assetdir", "texturedir"):
            compiler.attrib.pop(key, None)
    made = folder / "world.xml"
    made.write_bytes(ElementTree.tostring(root))
    return made


def _moves(body: ElementTree.Element) -> bool:
    return body.get("mocap") == "true" or any(child.tag in JOINTS for child in body)


def add_thickness(path: Path) -> int:
    """Says in a file that those of its meshes that are not closed have a thickness; returns how many they are."""
    try:
        open_ones = [fate.name for fate in survey_world(path, None).refused if "watertight" in fate.why]
    except ConfigError:
        return 0
    root = ElementTree.fromstring(path.read_bytes())
    custom = ElementTree.SubElement(root, "custom")
    for name in open_ones:
        ElementTree.SubElement(custom, "numeric", name=f"{THICKNESS}{name}", data=f"{THICKNESS_M}")
    path.write_bytes(ElementTree.tostring(root))
    return len(open_ones)


def with_free_ends(path: Path) -> Scene:
    """Returns a world with start and goal at free places far apart in its volume.

    Raises:
        ConfigError: if there are none, or the file is no world.
    """
    scene = load_world(path).scene
    low, high = check_volume(scene, path.name)
    axes = [np.linspace(a + ROOM_M, b - ROOM_M, 9) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    free = points[clearances(scene, points) >= ROOM_M]
    if len(free) < 2:
        raise ConfigError(f"it has no two free places, {ROOM_M:g} m from all that is there")
    away = (free - low) @ np.array([1.0, 1.0, 0.2])
    start, goal = (jnp.asarray(free[pick(away)], jnp.float32) for pick in (np.argmin, np.argmax))
    return dataclasses.replace(scene, start=start, goal=goal)


def outcome_of(path: Path, radius: float) -> tuple[str, str]:
    """Returns what became of a file, and why."""
    try:
        scene = with_free_ends(path)
        check_scene(scene, radius)
        if is_roomy(scene, radius, radius) or ((way := find_widest_way(scene, radius)) is not None and way.fits):
            return "flown", ""
        return "refused", "there is no way between two free places"
    except ConfigError as error:
        return "refused", str(error)
    except Exception as error:
        traceback.print_exc()
        return "crashed", repr(error)


def main() -> None:
    """Tries all files below a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="table to write")
    parser.add_argument("--still", type=Path, help="folder for the files without what moves")
    args = parser.parse_args()
    mujoco.set_mju_user_warning(lambda _: None)
    rows = [line.split("\t") for line in args.out.read_text().splitlines()] if args.out.is_file() else []
    counts, known = Counter(row[1] for row in rows), {row[0] for row in rows}
    radius = Config().drone.body_radius_m
    with args.out.open("a", encoding="utf-8") as table:
        for file in sorted(args.folder.rglob("*.xml")):
            if str(file.relative_to(args.folder)) in known or not is_counted(file):
                continue
            begin, name, thickened = time.monotonic(), file.relative_to(args.folder), 0
            try:
                tried = file if args.still is None else write_still(file, args.still / name.with_suffix(""))
                if args.still is not None:
                    thickened = add_thickness(tried)
                outcome, reason = outcome_of(tried, radius)
                reason = reason.replace(str(tried), file.name)
            except (ValueError, OSError, ElementTree.ParseError) as error:
                outcome, reason = "not made still", " ".join(str(error).split())
            counts[outcome] += 1
            row = (str(name), outcome, str(thickened), f"{time.monotonic() - begin:.1f}", " ".join(reason.split()))
            print("\t".join(row), file=table, flush=True)
            jax.clear_caches()
    print(", ".join(f"{count} {outcome}" for outcome, count in counts.items()), file=sys.stderr)


if __name__ == "__main__":
    main()
