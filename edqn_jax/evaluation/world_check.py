"""Will it fly here? What a world is, the tightest way through it, and what of it differs from what a policy knows."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from edqn_jax.config import FAMILIES, Config
from edqn_jax.devices.memory import bytes_of
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import MissionSet, check_group
from edqn_jax.evaluation.places import Point, check_seed, moved_ends, place_in_file, place_world
from edqn_jax.planning.path import point_text
from edqn_jax.planning.widest import WidestWay, find_widest_way, is_roomy
from edqn_jax.policies.sizes import describe_larger, sorted_sides
from edqn_jax.policies.unseen import describe_unseen
from edqn_jax.sim.camera.native import FIELDS, kinds_for_jax
from edqn_jax.sim.scene.distance import distances_to_shapes
from edqn_jax.sim.scene.mjcf import LoadedWorld, SceneError, check_scene, check_volume, load_world, resolve_world
from edqn_jax.sim.scene.scene import Scene, scene_shapes
from edqn_jax.sim.scene.shapes.kind import kind_of
from edqn_jax.sim.scene.survey import Survey, survey_world
from edqn_jax.sim.task import group
from edqn_jax.sim.worlds.families import Family, Mixture

MARGIN_M = 0.6
"""Metres of clearance beyond the body's radius below which a way is called tight.

In 40 x 20 x 6 m with three walls, each with a door as high, `pretrained` flew 26 % of 200 missions from random starts
where doors were 1.4 m wide, 48 % of 1.7 m, 64 % of 2 m and 78 % of 2.6 m."""

_PICTURE_US = {"c": 4.0, "jax": 45.0}
"""Microseconds of a picture of 32 x 24 pixels on two cores of a server without shapes, as measured."""

_SHAPE_US = {"c": 0.1, "jax": 20.0, "fields": 120.0, "fields_by_jax": 320.0}
"""What each shape adds: drawn in C; by JAX; a field that fills the picture, in C; by JAX along rays that C follows."""

_REST_US = 21.0
"""Of a decision of training on two cores but for its two pictures: some 34,000 a second (docs/performance.md)."""

_FIELDS_AGAIN = 1.25
"""How many pictures of its fields a decision costs beside those of the camera while the encoder learns: the label, and
what else a training pays there. The ground floor makes 1,191 decisions/s on one core (docs/howto/own_world.md)."""

_SHAPE_BYTES = {"jax": 4.4, "fields_by_jax": 9.6}
"""Bytes of a pixel that JAX holds for each shape while it draws a batch, as measured."""

_COPIES = 2
"""Of a grid: in a program, and where it runs."""


@dataclasses.dataclass(frozen=True)
class Cost:
    """What a world takes, estimated."""

    drawn_by_jax: list[str]
    """Kinds of shape because of which pictures are drawn by JAX alone; empty if C draws them."""
    drawn_by_jax_on_gpus: list[str]
    """The same on GPUs; empty if CUDA draws them."""
    picture_us: float
    """Microseconds of a picture on two CPU cores."""
    decisions_per_s: float
    """Of training on two CPU cores while the encoder learns, the slower part."""
    world_bytes: int
    training_bytes: int
    """Of the world and its pictures in a training of `num_envs` environments."""
    num_envs: int


@dataclasses.dataclass(frozen=True)
class WorldCheck:
    """What was found out about a world."""

    name: str
    config: Config
    """Of the policy."""
    survey: Survey | None = None
    """Of a file."""
    scene: Scene | None = None
    """None if it cannot be read, or has no volume."""
    way: WidestWay | None = None
    nearest: str = ""
    """Shape nearest to the tightest place."""
    trained_in: Mapping[str, Point] = dataclasses.field(default_factory=dict)
    """Sides, metres, of the volumes that the policy was trained in."""
    cost: Cost | None = None
    warnings: tuple[str, ...] = ()
    refusal: str | None = None
    """Why it cannot be flown, a sentence; None if it can."""
    note: str | None = None

    @property
    def shapes(self) -> dict[str, int]:
        """Returns how many shapes of each kind the world has."""
        return {} if self.scene is None else dict(Counter(kind_of(shape)[0] for shape in scene_shapes(self.scene)))

    @property
    def moving(self) -> int:
        """Returns how many of the shapes move."""
        shapes = [] if self.scene is None else scene_shapes(self.scene)
        return sum(
            getattr(each, "motion", None) is not None or getattr(each, "throw", None) is not None for each in shapes
        )

    def figures(self) -> dict[str, Any]:
        """Returns all of it as plain values."""
        scene, way, survey = self.scene, self.way, self.survey
        radius = self.config.drone.body_radius_m
        return {
            "world": self.name,
            "flies": self.refusal is None,
            "refusal": self.refusal,
            "warnings": list(self.warnings),
            "note": self.note,
            "geoms": None if survey is None else [dataclasses.asdict(fate) for fate in survey.geoms],
            "ignored": None if survey is None else list(survey.ignored),
            "shapes": self.shapes,
            "moving_shapes": self.moving,
            "volume_m": None if scene is None else np.asarray(scene.volume).tolist(),
            "start_m": None if scene is None else np.asarray(scene.start).tolist(),
            "goal_m": None if scene is None else np.asarray(scene.goal).tolist(),
            "body_radius_m": radius,
            "way": None if way is None else {**_way_figures(way, radius), "nearest": self.nearest},
            "trained_in_m": dict(self.trained_in),
            "cost": None if self.cost is None else dataclasses.asdict(self.cost),
        }


def _way_figures(way: WidestWay, radius: float) -> dict[str, Any]:
    return {
        "clearance_m": way.clearance_m,
        "body_radii": way.clearance_m / radius,
        "at_m": way.points[way.tightest].tolist(),
        "length_m": way.length_m,
    }


def check_world(
    config: Config, name: str, *, seed: int = 0, start: Point | None = None, goal: Point | None = None
) -> WorldCheck:
    """Checks whether a policy can fly a mission in a world.

    Args:
        config: of the policy.
        name: of `config.FAMILIES`, of a scene, or an MJCF file.
        seed: number of the test world of a family.
        start: of the mission, metres; None is the world's own.
        goal: likewise.

    Raises:
        ConfigError: if there is no such world, the file cannot be read, or an argument is invalid.
    """
    if group.is_multi_drone(config):
        check_group(config, name, config.env.drones, moved_ends(start, goal))
    check_seed(seed)
    found = WorldCheck(name, config, trained_in=trained_sizes(config))
    if name in FAMILIES:
        placed = place_world(config, name, seed, start, goal)
    else:
        found, loaded = _survey(found, name)
        if loaded is None:
            return found
        placed = place_in_file(config, name, loaded, moved_ends(start, goal))
    scene, radius = placed.scene, config.drone.body_radius_m
    try:
        check_volume(scene, placed.title)
    except SceneError as error:
        return dataclasses.replace(found, refusal=str(error))
    found = dataclasses.replace(found, scene=scene, note=placed.note, cost=estimate_cost(config, scene))
    try:
        check_scene(scene, radius, names=placed.names, title=placed.title, goal_radius=config.env.goal_radius_m)
        way = find_widest_way(scene, radius)
    except ConfigError as error:
        return dataclasses.replace(found, refusal=str(error))
    if way is None:
        closed = f"{placed.title} has no way from its start to its goal: all are closed, or far too narrow; open one"
        return dataclasses.replace(found, refusal=closed)
    found = dataclasses.replace(found, way=way, nearest=_nearest_shape(scene, way, placed.names or {}))
    if not way.fits:
        return dataclasses.replace(found, refusal=_describe_misfit(found, placed.title))
    unseen = describe_unseen(config, config, scene if name not in FAMILIES else None)
    return dataclasses.replace(found, warnings=(*_warnings(found, placed.title), *unseen))


def warn_of_missions(config: Config, missions: MissionSet) -> tuple[str, ...]:
    """Returns the warnings of `check_world` for missions in a world from a file; of random worlds, of their size."""
    if missions.file is None:
        return tuple(_warn_of_family(config, missions.name, trained_sizes(config)))
    return _warn_quickly(config, missions.name, missions.scene(), trained_sizes(config))


def warn_of_training(config: Config, start: Config | None = None) -> tuple[str, ...]:
    """Returns the warnings of `check_world` for the file that a policy is to be trained in; of random worlds, of size.

    A file that is no world has none: training refuses it.

    Args:
        config: of the training.
        start: of the policy that it begins with, and whose worlds had other sizes; None is none.
    """
    name, trained_in = config.world.name, {} if start is None else trained_sizes(start)
    if name in FAMILIES:
        return tuple(_warn_of_family(config, name, trained_in))
    try:
        scene = load_world(resolve_world(name)).scene
    except ConfigError:
        return ()
    return _warn_quickly(config, name, scene, trained_in)


def _warn_of_family(config: Config, name: str, trained_in: Mapping[str, Point]) -> list[str]:
    """Returns a warning if some of a family's worlds are much larger than those that the policy was trained in."""
    there = dataclasses.replace(config, world=dataclasses.replace(config.world, name=name))
    sizes = [] if name not in FAMILIES else [sorted_sides(size) for size in trained_sizes(there).values()]
    return describe_larger(np.max(sizes, axis=0), trained_in.values()) if sizes else []


def _warn_quickly(config: Config, name: str, scene: Scene, trained_in: Mapping[str, Point]) -> tuple[str, ...]:
    """Returns the warnings of a world from a file; its way is looked at more closely if coarse cells leave a doubt."""
    found, radius = WorldCheck(name, config, scene=scene, trained_in=trained_in), config.drone.body_radius_m
    try:
        check_scene(scene, radius)
        if not is_roomy(scene, radius, radius + MARGIN_M):
            way = find_widest_way(scene, radius)
            if way is not None and way.fits:
                names = load_world(resolve_world(name)).names
                found = dataclasses.replace(found, way=way, nearest=_nearest_shape(scene, way, names))
    except ConfigError:  # what flies there refuses it, or its missions have other starts
        pass
    return _warnings(found, f"'{name}'")


def trained_sizes(config: Config) -> dict[str, Point]:
    """Returns the sides, metres, of the volumes that a policy was trained in, by the name of its worlds."""
    name = config.world.name
    if name in FAMILIES:
        entry = FAMILIES.get(name)
        families = {each: FAMILIES.get(each) for each in entry.shares} if isinstance(entry, Mixture) else {name: entry}
        return {each: family.size for each, family in families.items() if isinstance(family, Family)}
    try:
        low, high = np.asarray(load_world(resolve_world(name)).scene.volume)
    except SceneError:  # its file is gone
        return {}
    x, y, z = map(float, high - low)
    return {name: (x, y, z)}


def estimate_cost(config: Config, scene: Scene) -> Cost:
    """Returns what a world will take of time and memory."""
    by_jax = kinds_for_jax(scene, shadows=config.camera.shadows)
    pixels = config.camera.width * config.camera.height
    counts = {kind: shapes.position.shape[-2] for kind, shapes in scene.shapes().items()}
    rows = dict.fromkeys(counts, "jax" if by_jax else "c")
    if by_jax:  # upright ones are drawn in columns, as cheap as in C beside others
        rows |= {kind: "c" for kind in counts if kind not in by_jax}
    if FIELDS in counts:
        rows[FIELDS] = "fields_by_jax" if by_jax else "fields"
    of_kind = {kind: _SHAPE_US[rows[kind]] * count for kind, count in counts.items()}
    held = sum(_SHAPE_BYTES.get(rows[kind], 0.0) * count for kind, count in counts.items())
    world = bytes_of(scene)
    grids = sum(grid.values.nbytes for shapes in scene.shapes().values() for grid in getattr(shapes, "grids", ()))
    envs = Config().train.num_envs
    pictures = len(config.events.frame_times_s) * pixels * held
    size = pixels / (32 * 24)
    picture_us = (_PICTURE_US["jax" if by_jax else "c"] + sum(of_kind.values())) * size
    label_us = _FIELDS_AGAIN * of_kind.get(FIELDS, 0.0) * size
    return Cost(
        drawn_by_jax=by_jax,
        drawn_by_jax_on_gpus=kinds_for_jax(scene, "cuda", config.camera.shadows),
        picture_us=picture_us,
        decisions_per_s=1e6 / (len(config.events.frame_times_s) * picture_us + label_us + _REST_US),
        world_bytes=world + grids,
        training_bytes=int(_COPIES * grids + envs * (world + pictures)),
        num_envs=envs,
    )


def _survey(found: WorldCheck, name: str) -> tuple[WorldCheck, LoadedWorld | None]:
    """Returns what became of a file's geoms, and its world, None of one that is refused.

    Raises:
        ConfigError: if it cannot be read at all.
    """
    path = resolve_world(name)
    try:
        loaded = load_world(path)
    except SceneError:
        survey = survey_world(path, None)
        if not survey.refused:
            raise
        first, more = survey.refused[0], len(survey.refused) - 1
        others = f", and {more} more" if more else ""
        refusal = f"'{name}' has geoms that cannot be flown: '{first.name}' {first.why}{others}"
        return dataclasses.replace(found, survey=survey, refusal=refusal), None
    return dataclasses.replace(found, survey=survey_world(path, loaded)), loaded


def _warnings(found: WorldCheck, title: str) -> tuple[str, ...]:
    """Returns what is worth saying of a world that will be flown."""
    assert found.scene is not None
    ways = (
        [] if found.way is None else [*_warn_of_way(found, found.way, title), *_warn_of_length(found.config, found.way)]
    )
    return (*ways, *_warn_of_size(found, found.scene), *_warn_of_pictures(found.scene, title))


def _warn_of_way(found: WorldCheck, way: WidestWay, title: str) -> list[str]:
    """Returns a warning if a way is tight."""
    radius = found.config.drone.body_radius_m
    if way.clearance_m >= radius + MARGIN_M:
        return []
    return [
        f"the widest way of {title} is tight at {point_text(np.round(way.points[way.tightest], 1))}: it passes "
        f"{found.nearest} at {way.clearance_m:.2f} m, {way.clearance_m / radius:.1f} radii of the body"
    ]


def _describe_misfit(found: WorldCheck, title: str) -> str:
    """Returns why the widest way of a world does not do."""
    way, radius = found.way, found.config.drone.body_radius_m
    assert way is not None
    place = (
        f"{title} has no way from its start to its goal that is wide enough: the widest passes {found.nearest} at "
        f"{point_text(np.round(way.points[way.tightest], 1))} at {way.clearance_m:.2f} m"
    )
    if way.clearance_m < radius:
        return f"{place}, closer than the drone's radius of {radius:g} m; make it wider there"
    return f"{place}, and missions, whose ways are searched on a lattice, need more beside the radius of {radius:g} m"


def _warn_of_length(config: Config, way: WidestWay) -> list[str]:
    """Returns a warning if a flight ends before it can have flown the way."""
    seconds = config.env.max_decisions * config.drone.physics_steps * config.drone.physics_dt_s
    most = seconds * config.env.speed_m_s
    if way.length_m <= most:
        return []
    return [
        f"the way to the goal is {way.length_m:.0f} m long, and in {config.env.max_decisions} decisions a flight of "
        f"{config.env.speed_m_s:g} m/s covers {most:.0f} m"
    ]


def _warn_of_size(found: WorldCheck, scene: Scene) -> list[str]:
    """Returns a warning if a world is much larger than those that the policy was trained in."""
    return describe_larger(np.subtract(*np.asarray(scene.volume, np.float64)[::-1]), found.trained_in.values())


def _warn_of_pictures(scene: Scene, title: str) -> list[str]:
    """Returns a warning if a world's pictures are drawn by JAX alone."""
    kinds = " and ".join(kinds_for_jax(scene)).replace("_", " ")
    return [f"C and CUDA alone do not draw the {kinds} of {title}: pictures take longer"] if kinds else []


def _nearest_shape(scene: Scene, way: WidestWay, names: Mapping[str, tuple[str, ...]]) -> str:
    """Returns the name of the shape nearest to the tightest place of a way, or its kind and number."""
    point = jnp.asarray(way.points[way.tightest], jnp.float32)
    distances = {kind: np.asarray(each) for kind, each in distances_to_shapes(scene, point).items()}
    if not distances:
        return "nothing"
    kind = min(distances, key=lambda each: distances[each].min())
    number, known = int(np.argmin(distances[kind])), names.get(kind, ())
    return f"'{known[number]}'" if number < len(known) else f"{kind}[{number}]"
