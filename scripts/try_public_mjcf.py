"""Tries a folder of others' MJCF files: which open as worlds, and why others do not.

    python scripts/try_public_mjcf.py FOLDER --out table.tsv
    python scripts/try_public_mjcf.py FOLDER --out table.tsv --still SCRATCH

A file counts if MuJoCo opens it and it has a solid geom at rest that is no plane. Start and goal are free places in
opposite corners of its flight volume; a world is flown if `edqn check` finds a way between them. With --still, what
moves is taken away first, and what acts on it: MuJoCo writes each file to a folder of its own in SCRATCH, together with
the meshes and height fields that are left; and what is said of meshes that are not closed is done, they get a
thickness. One row a file: its path, `flown`, `refused` or `crashed`, how many meshes got a thickness, seconds, the
reason.
"""

from __future__ import annotations

import argparse
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

from edqn_jax import load_policy
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.world_check import check_world
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.mjcf import check_volume, load_world
from edqn_jax.sim.scene.mjcf_parts.geoms import is_solid
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


def free_corners(path: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Returns free places far apart in the volume of a world.

    Raises:
        ConfigError: if there are none, or the file is no world.
    """
    scene = load_world(path).scene
    low, high = check_volume(scene, path.name)
    axes = [np.linspace(a + ROOM_M, b - ROOM_M, 9) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = jax.jit(jax.vmap(lambda point: signed_distance(scene, point)))(jnp.asarray(points, jnp.float32))
    free = points[np.asarray(distance) >= ROOM_M]
    if len(free) < 2:
        raise ConfigError("it has no two free places")
    away = (free - low) @ np.array([1.0, 1.0, 0.2])
    return tuple(map(float, free[np.argmin(away)])), tuple(map(float, free[np.argmax(away)]))


def outcome_of(path: Path) -> tuple[str, str]:
    """Returns what became of a file, and why."""
    try:
        start, goal = free_corners(path)
        found = check_world(load_policy("pretrained").config, str(path), start=start, goal=goal)  # type: ignore[arg-type]
        return ("flown", "") if found.refusal is None else ("refused", found.refusal)
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
    counts: Counter[str] = Counter()
    with args.out.open("w", encoding="utf-8") as table:
        for file in sorted(args.folder.rglob("*.xml")):
            if not is_counted(file):
                continue
            begin, name, thickened = time.monotonic(), file.relative_to(args.folder), 0
            try:
                tried = file if args.still is None else write_still(file, args.still / name.with_suffix(""))
                if args.still is not None:
                    thickened = add_thickness(tried)
                outcome, reason = outcome_of(tried)
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
