"""Reads and writes worlds as MJCF, MuJoCo's file format.

An MJCF file can be read that names no other file but meshes, height fields and MJCF to include in its folder; pictures
of textures are not looked for. A world for the drone consists of

* its static geoms (on the world body or on bodies welded to it) of any registered kind of shape (`shapes/`), at any
  rotation. Planes are solid below and infinite. A geom is read if it is visible in
  MuJoCo's viewer (groups 0 to 2) or if MuJoCo would collide with it (contype or conaffinity set): every
  visible geom is solid, and every solid geom is visible. Colour is the material's or the geom's own `rgba`; alpha
  and textures are ignored. Patterns and light are those of `<custom>` numerics (`mjcf_parts/looks.py`).
* its moving geoms, of any kind but planes, on mocap bodies whose motion a text says (`mjcf_parts/motion.py`).
* two sites `start` and `goal`, of which only the positions are read.
* a box site `volume`, not rotated: the space that the drone may fly in. Without one, the box around all
  shapes and sites, `VOLUME_MARGIN` wider on every side, but not below a level plane; an evaluation whose start or goal
  lies outside that box widens it (`widen_volume`).
"""

from __future__ import annotations

import dataclasses
import difflib
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from edqn_jax.config import FAMILIES
from edqn_jax.sim.scene.distance import distances_to_shapes
from edqn_jax.sim.scene.mjcf_parts import looks as mjcf_looks
from edqn_jax.sim.scene.mjcf_parts.files import SceneError, load_checked_text
from edqn_jax.sim.scene.mjcf_parts.geoms import check_grids, geom_name, is_solid, shape_of
from edqn_jax.sim.scene.mjcf_parts.looks import numbers_text
from edqn_jax.sim.scene.mjcf_parts.motion import PREFIX, motions_of, set_in_motion, text_of
from edqn_jax.sim.scene.motion import Throw, ball_positions, steady_aim
from edqn_jax.sim.scene.scene import Planes, Scene, Shape, Spheres, build_scene, scene_shapes
from edqn_jax.sim.scene.shapes.kind import LEVEL, kind_of, kinds, reach_of

VOLUME_MARGIN = 5.0
"""Metres around shapes and sites where a world names no `volume`."""

LONGEST_VOLUME = 500.0
"""Most metres along an axis of a flight volume; A*'s lattice must hold it."""

SCANS = (".ply", ".stl", ".obj", ".glb", ".bt", ".xyz", ".pcd")
"""Endings of files of which `edqn world` makes worlds."""

MAX_SHAPES = 500
"""Geoms of a world: 2 000 of them take 8 GB to train in."""


@dataclasses.dataclass(frozen=True)
class LoadedWorld:
    """A scene and the names of its shapes."""

    scene: Scene
    names: Mapping[str, tuple[str, ...]]
    """For every kind of shape, the name of each of its shapes, in order."""
    path: Path
    has_volume: bool
    """Whether the file says where the drone may fly."""


def scenes_folder() -> Path:
    """Returns the folder of the project's own worlds: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).resolve().parents[2]
    packed = package / "scenes"
    return packed if packed.is_dir() else package.parent / "scenes"


def resolve_world(name: str) -> Path:
    """Returns the MJCF file of a world, given by its path or by its name in `scenes/`.

    Raises:
        SceneError: if the file does not exist.
    """
    path = Path(name).expanduser()
    if path.is_file():
        if path.suffix.lower() in SCANS:
            raise SceneError(f"'{name}' is a scan; `edqn world {name} --out {path.stem}` makes a world of it")
        return path
    folder = scenes_folder()
    named = folder / f"{name}.xml"
    if path.name == name and named.is_file():
        return named
    if path.is_dir():
        raise SceneError(f"'{name}' is a folder; give a MuJoCo file")
    scenes = sorted(file.stem for file in folder.glob("*.xml"))
    known = f"scenes known by name: {', '.join(scenes) or 'none'}"
    if path.suffix == ".xml" or path.name != name:
        searched = path.parent.resolve()
        raise SceneError(f"there is no scene file '{path.name}' in {searched}; {known}")
    close = difflib.get_close_matches(name, [*FAMILIES, *scenes], n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    raise SceneError(f"there is no scene '{name}' in {folder}; {known}; random worlds: {', '.join(FAMILIES)}{hint}")


def load_scene(path: str | Path) -> Scene:
    """Returns `load_world(path).scene`."""
    return load_world(path).scene


def load_world(path: str | Path) -> LoadedWorld:
    """Reads a world from an MJCF file.

    Where the file has no site `start` or `goal`, that point is NaN in the scene; `check_scene` raises an error
    unless the caller has replaced it.

    Raises:
        SceneError: if the file is missing or does not parse, or has an unsupported geom.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"there is no scene file '{path.name}' in {path.parent.resolve()}")
    model = compile_model(path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    motions = motions_of(model, str(path))
    shapes: list[Shape] = []
    bodies: list[int] = []  # 0 of shapes that stand
    geoms: list[str] = []
    names: dict[str, list[str]] = {kind: [] for kind in kinds()}
    for geom in range(model.ngeom):
        if not is_solid(model, geom):
            continue
        body = int(model.body_rootid[model.geom_bodyid[geom]])
        shape = shape_of(model, data, geom, str(path), moves=body in motions)
        shapes.append(shape)
        check_grids(shapes, str(path))
        geoms.append(geom_name(model, geom))
        bodies.append(body if body in motions else 0)
        names[kind_of(shape)[0]].append(geoms[-1])
    sites = {model.site(i).name: data.site_xpos[i] for i in range(model.nsite)}
    for name, where in sites.items():
        if not np.all(np.isfinite(where)):
            raise SceneError(f"{path}: the site '{name}' stands at no finite point; give its pos three numbers")
    unknown = np.full(3, np.nan)
    thrown = {body for body, motion in motions.items() if motion[0][0] == "throw"}
    stays = [shape for shape, body in zip(shapes, bodies, strict=True) if body not in thrown]
    volume = _volume(model, data, stays, path)
    for body, motion in motions.items():
        title = f"{path}: the body '{model.body(body).name}'"
        of = [i for i, each in enumerate(bodies) if each == body]
        if not of:
            raise SceneError(f"{title} moves and has no solid geom; give it one")
        faces = volume if "volume" in sites else None
        moving = set_in_motion([shapes[i] for i in of], motion, data.xpos[body], faces, title)
        for i, shape in zip(of, moving, strict=True):
            shapes[i] = shape
    shapes = mjcf_looks.with_surfaces(model, shapes, geoms, str(path))
    ends = {role: sites.get(role, unknown) for role in ("start", "goal")}
    daylight = mjcf_looks.daylight_of(model, str(path))
    scene = dataclasses.replace(build_scene(shapes, volume=volume, **ends), daylight=daylight)
    return LoadedWorld(scene, {kind: tuple(members) for kind, members in names.items()}, path, "volume" in sites)


def compile_model(path: Path) -> mujoco.MjModel:
    """Returns the model of a file, with the files in its folder that it names.

    Raises:
        SceneError: if MuJoCo cannot read it, or it has more geoms than `MAX_SHAPES`.
    """
    text = load_checked_text(path)
    mujoco.set_mju_user_warning(lambda _: None)  # otherwise MuJoCo writes a log into the working folder
    try:
        model = mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise SceneError(f"{path} is not an MJCF that MuJoCo can read: {reason}") from None
    finally:
        mujoco.set_mju_user_warning(None)
    if model.ngeom > MAX_SHAPES:
        raise SceneError(f"{path} has {model.ngeom:,} geoms; a world may have {MAX_SHAPES}")
    return model


def widen_volume(scene: Scene, points: Mapping[str, ArrayLike], title: str) -> Scene:
    """Returns a scene whose flight volume also holds `points`, each [3], with `VOLUME_MARGIN` around those outside.

    Args:
        scene: one world.
        points: by what they are, for the message.
        title: name of the world in the message.

    Raises:
        SceneError: if the volume would be longer than `LONGEST_VOLUME` along an axis.
    """
    lower, upper = np.asarray(scene.volume)
    for role, point in points.items():
        place = np.asarray(point)
        lower = np.where(place < lower, place - VOLUME_MARGIN, lower)
        upper = np.where(place > upper, place + VOLUME_MARGIN, upper)
        if not np.all(upper - lower <= LONGEST_VOLUME):
            raise SceneError(
                f"the {role} {_point(place)} is too far from the shapes of {title}; its flight volume would be longer "
                f"than {LONGEST_VOLUME:g} m"
            )
    return dataclasses.replace(scene, volume=jnp.asarray(np.stack([lower, upper]), jnp.float32))


def check_volume(scene: Scene, title: str) -> np.ndarray:
    """Returns the lower and upper corner of a flight volume, [2, 3] metres.

    Raises:
        SceneError: if the volume is empty or longer than `LONGEST_VOLUME` along an axis.
    """
    lower, upper = volume = np.asarray(scene.volume)
    if not np.all(upper > lower):
        raise SceneError(f"the flight volume of {title}, {_point(lower)} to {_point(upper)}, is empty")
    if not np.all(upper - lower <= LONGEST_VOLUME):
        raise SceneError(
            f"the flight volume of {title}, {_point(lower)} to {_point(upper)}, is longer than {LONGEST_VOLUME:g} m"
        )
    return volume


def check_scene(
    scene: Scene,
    body_radius: float,
    *,
    names: Mapping[str, tuple[str, ...]] | None = None,
    title: str = "the world",
    goal_radius: float | None = None,
) -> None:
    """Checks that a drone of this radius fits at the start and at the goal.

    Args:
        scene: one world.
        body_radius: metres.
        names: as in `LoadedWorld`, for the message.
        title: name of the world in the message.
        goal_radius: metres within which a drone has arrived; None if it does not matter where the start is.

    Raises:
        SceneError: if either is missing, outside the flight volume or too close to a shape, if the start is at the goal
            already, or if the volume is empty or longer than `LONGEST_VOLUME` along an axis.
    """
    lower, upper = check_volume(scene, title)
    for role, where in (("start", scene.start), ("goal", scene.goal)):
        point = np.asarray(where)
        if not np.all(np.isfinite(point)):
            raise SceneError(f'{title} does not say where its {role} is; add a site, <site name="{role}" pos="x y z"/>')
        for axis, value, low, high in zip("xyz", point, lower, upper, strict=True):
            if not low <= value <= high:
                raise SceneError(
                    f"the {role} {_point(point)} lies outside the flight volume of {title}: "
                    f"{axis} = {value:g} is not within {low:g} to {high:g}"
                )
        for kind, distances in distances_to_shapes(scene, jnp.asarray(point, jnp.float32)).items():
            nearest = int(np.argmin(distances))
            distance = float(distances[nearest])
            if distance > body_radius:
                continue
            known = (names or {}).get(kind, ())
            name = f"'{known[nearest]}'" if nearest < len(known) else f"{kind}[{nearest}]"
            if distance < 0:
                raise SceneError(f"the {role} {_point(point)} of {title} lies inside {name}; move either")
            raise SceneError(
                f"the {role} {_point(point)} of {title} is {distance:.2f} m from {name}, "
                f"closer than the drone's radius of {body_radius:g} m"
            )

    apart = float(np.linalg.norm(np.asarray(scene.goal) - np.asarray(scene.start)))
    if goal_radius is not None and apart <= goal_radius:
        raise SceneError(
            f"the start {_point(np.asarray(scene.start))} of {title} is {apart:.2f} m from the goal, where a drone has "
            f"arrived within {goal_radius:g} m; move either"
        )


def write_scene(scene: Scene, path: str | Path, *, title: str = "world") -> None:
    """Writes one world as the file of `mjcf_of`."""
    Path(path).write_text(mjcf_of(scene, title=title), encoding="utf-8")


def mjcf_of(scene: Scene, *, title: str = "world") -> str:
    """Returns one world as MJCF that MuJoCo opens and that loads back to the same scene.

    Parked shapes are left out. A tilted shape that is upright loads back as an upright one.
    """
    root = ElementTree.Element("mujoco", model=title)
    ElementTree.SubElement(root, "compiler", angle="radian")
    asset = mjcf_looks.add_visuals(root, scene)
    world = ElementTree.SubElement(root, "worldbody")
    mjcf_looks.add_sun(world, scene)
    for role, where in (("start", scene.start), ("goal", scene.goal)):
        if np.all(np.isfinite(where)):
            colour = "0.1 0.6 1 1" if role == "start" else "0.1 0.8 0.2 1"
            _add_site(world, role, pos=numbers_text(where), size="0.5", rgba=colour)
    lower, upper = np.asarray(scene.volume)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    _add_site(world, "volume", type="box", pos=numbers_text(middle), size=numbers_text(half), rgba="0.2 0.4 1 0.1")
    custom = ElementTree.Element("custom")
    shapes = named_shapes(scene)
    for name, shape in shapes:
        attributes = _attributes(shape)
        made, numbers = kind_of(shape)[1].asset, kind_of(shape)[1].custom
        for word, values in ({} if numbers is None else numbers(shape)).items():
            ElementTree.SubElement(custom, "numeric", name=f"{word}{name}", data=numbers_text(values))
        if made is not None:
            mesh = {key: numbers_text(values) for key, values in made(shape).items()}
            ElementTree.SubElement(asset, "mesh", {"name": name, **mesh})
            attributes["mesh"] = name
        parent, text = world, text_of(shape)
        if text is not None:
            throw = shape.throw if isinstance(shape, Spheres) else None
            place = shape.position if throw is None else _launch(scene, throw)
            attributes.pop("pos")
            parent = ElementTree.SubElement(world, "body", name=f"moving {name}", mocap="true", pos=numbers_text(place))
            ElementTree.SubElement(custom, "text", name=f"{PREFIX}moving {name}", data=text)
        ElementTree.SubElement(parent, "geom", {"name": name, **attributes})
    mjcf_looks.add_numbers(custom, scene, shapes)
    if len(custom):
        root.append(custom)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def named_shapes(scene: Scene) -> list[tuple[str, Shape]]:
    """Returns the shapes of `scene_shapes`, each after the name of its geom in `mjcf_of`."""
    counts: Counter[str] = Counter()
    named = []
    for shape in scene_shapes(scene):
        geom = kind_of(shape)[1].geom
        counts[geom] += 1
        named.append((f"{geom}{counts[geom]}", shape))
    return named


def _add_site(world: ElementTree.Element, name: str, **attributes: str) -> None:
    """Adds a site in group 3, which the viewer and cameras do not show unless asked to."""
    ElementTree.SubElement(world, "site", {"name": name, "group": "3", **attributes})


def _launch(scene: Scene, one: Throw) -> np.ndarray:
    """Returns where a ball is launched at a drone between the world's own start and goal, [3] metres."""
    throw = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], one)
    aim = steady_aim(throw, scene.start, scene.goal)
    return np.asarray(ball_positions(throw, aim, aim.launch[0]))[0]


def _volume(model: mujoco.MjModel, data: mujoco.MjData, shapes: list[Shape], path: Path) -> np.ndarray:
    for i in range(model.nsite):
        if model.site(i).name == "volume":
            turned = np.abs(data.site_xmat[i].reshape(3, 3) - np.eye(3)).max() > LEVEL
            if model.site_type[i] != mujoco.mjtGeom.mjGEOM_BOX or turned:
                raise SceneError(f"{path}: the site 'volume' must be a box that is not rotated")
            return data.site_xpos[i] + np.array([[-1.0], [1.0]]) * model.site_size[i]
    corners = [data.site_xpos[i] for i in range(model.nsite)]
    floors = []
    for shape in shapes:
        reach = reach_of(shape)
        if np.all(np.isfinite(reach)):
            corners += [shape.position - reach, shape.position + reach]
        elif isinstance(shape, Planes) and shape.normal[2] > 1 - LEVEL:
            floors.append(shape.position[2])
    if not corners:
        raise SceneError(f"{path}: the size of the world is unknown; add a box site named 'volume'")
    lower, upper = np.min(corners, axis=0) - VOLUME_MARGIN, np.max(corners, axis=0) + VOLUME_MARGIN
    if floors:
        lower[2] = max(lower[2], max(floors))
    return np.stack([lower, upper])


def _attributes(shape: Shape) -> dict[str, str]:
    """Returns the MJCF attributes of a geom."""
    kind = kind_of(shape)[1]
    numbers = {**kind.write(shape), "pos": shape.position, "rgba": [*np.asarray(shape.albedo), 1.0]}
    return {"type": kind.geom, **{name: numbers_text(values) for name, values in numbers.items()}}


def _point(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:g}" for value in point) + ")"
