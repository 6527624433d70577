"""A world as padded arrays, one per kind of shape, and its signed distance.

The same arrays are what the drone collides with and what the camera sees. Every kind has a static
capacity; unused entries are parked `PARKED` metres away with zero size, so that no ray
meets them, they affect no distance, and no code needs a mask.

Shapes may move (`motion.py`): their `position` is that at time 0, and `scene_at` is the world at another time, in
which nothing moves any more. What does not ask for a time sees the world at time 0. A kind without motion has None in
place of the arrays.

Where shapes have no surface (`surface.py`), all carry the plaid of the camera's options.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from edqn_jax.config.registry import SHAPES
from edqn_jax.sim.scene.motion import (
    OUTSIDE_M,
    Aim,
    DroneTracks,
    Throw,
    at_rest,
    ball_positions,
    displacement,
    in_flight,
    not_thrown,
    positions_at,
    steady_aim,
    throw_speeds,
    top_speeds,
)
from edqn_jax.sim.scene.shapes.capsule import Capsules
from edqn_jax.sim.scene.shapes.kind import PARKED, kind_of
from edqn_jax.sim.scene.shapes.plane import Planes
from edqn_jax.sim.scene.shapes.sphere import Spheres
from edqn_jax.sim.scene.shapes.tilted_box import TiltedBoxes
from edqn_jax.sim.scene.shapes.tilted_cylinder import TiltedCylinders
from edqn_jax.sim.scene.shapes.upright_box import UprightBoxes
from edqn_jax.sim.scene.shapes.upright_cylinder import UprightCylinders
from edqn_jax.sim.scene.surface import Daylight, Surface, blank_surfaces

DRONE_RGB = (0.08, 0.08, 0.1)
"""Reflectance of other drones: dark, as airframes of carbon fibre are."""


Shape = Any
"""One shape: a kind's dataclass whose fields lack the leading axis."""

FIELDS = ("boxes", "cylinders", "spheres", "tilted_boxes", "capsules", "tilted_cylinders", "planes")
"""Kinds that are fields of every `Scene`; any other registered kind is in `Scene.others` of those that have some."""


@struct.dataclass
class Scene:
    """One world. A pool of worlds is the same dataclass with a leading axis on every array."""

    boxes: UprightBoxes
    cylinders: UprightCylinders
    spheres: Spheres
    tilted_boxes: TiltedBoxes
    capsules: Capsules
    tilted_cylinders: TiltedCylinders
    planes: Planes
    volume: Array  # [2, 3] lower and upper corner of the flight volume, metres
    start: Array  # [3] metres
    goal: Array  # [3] metres
    others: dict[str, Any] = dataclasses.field(default_factory=dict)  # shapes of further kinds, by kind
    drones: DroneTracks | None = None  # the others of a group, within one decision; in no pool of worlds
    aim: Aim | None = None  # of balls at the drone that flies; in no pool of worlds
    daylight: Daylight | None = None  # None: that of the camera's options

    def shapes(self) -> dict[str, Any]:
        """Returns the arrays of every kind of shape of the world, by kind."""
        return {kind: getattr(self, kind) for kind in FIELDS} | self.others

    def with_shapes(self, shapes: Mapping[str, Any]) -> Scene:
        """Returns the same world with other shapes of these kinds."""
        others = self.others | {kind: each for kind, each in shapes.items() if kind not in FIELDS}
        fields = {kind: each for kind, each in shapes.items() if kind in FIELDS}
        return dataclasses.replace(self, **fields, others=others)


_MOVING = {"motion": at_rest, "throw": not_thrown}
"""The fields of a kind that are None where nothing moves, and what stands for a shape that does not."""


def has_motion(scene: Scene) -> bool:
    """Returns whether any kind of shape has motion. Static: known when a program is traced."""
    return scene.drones is not None or any(map(_moves, scene.shapes().values()))


def _moves(shapes: Shape) -> bool:
    return getattr(shapes, "motion", None) is not None or getattr(shapes, "throw", None) is not None


def scene_at(scene: Scene, time: Array | None) -> Scene:
    """Returns the scene at `time` [] seconds of the episode, without motion; a static scene is returned as it is.

    The one place where shapes move: the camera and the collisions both see what it returns.

    Args:
        scene: one world; balls fly as its `aim` says, without one as `steady_aim`.
        time: None is time 0, before anything is thrown.
    """
    there = {kind: _standing(scene, shapes, time) for kind, shapes in scene.shapes().items() if _moves(shapes)}
    now = dataclasses.replace(scene.with_shapes(there), aim=None)
    if scene.drones is None:
        return now
    return with_drones(
        now, positions_at(scene.drones, scene.drones.began if time is None else time), scene.drones.radius
    )


def with_drones(scene: Scene, position: Array, radius: Array) -> Scene:
    """Returns a static world with K drones: spheres at `position` [K, 3] of `radius` [K], metres."""
    drones = Spheres(position, radius, jnp.broadcast_to(jnp.asarray(DRONE_RGB), position.shape))
    if scene.spheres.surface is not None:
        drones = dataclasses.replace(drones, surface=blank_surfaces(scene.spheres.surface.patterns, len(position)))
    spheres = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), scene.spheres, drones)
    return dataclasses.replace(scene, spheres=spheres, drones=None)


def _standing(scene: Scene, shapes: Any, time: Array | None) -> Any:
    """Returns the shapes of one kind at their positions at a time, without motion."""
    place = shapes.position
    if shapes.motion is not None and time is not None:
        place = place + displacement(shapes.motion, place, time)
    if not isinstance(shapes, Spheres):
        return dataclasses.replace(shapes, position=place, motion=None)
    if shapes.throw is not None and time is not None:
        aim = aim_of(scene, shapes.throw)
        ball = ball_positions(shapes.throw, aim, time)
        beyond = (shapes.radius + OUTSIDE_M)[:, None]
        outside = jnp.any((ball < scene.volume[0][None] - beyond) | (ball > scene.volume[1][None] + beyond), axis=1)
        place = jnp.where(in_flight(shapes.throw, aim, time, outside)[:, None], ball, place)
    return dataclasses.replace(shapes, position=place, motion=None, throw=None)


def aim_of(scene: Scene, throw: Throw) -> Aim:
    """Returns the aim of the balls of one world."""
    return steady_aim(throw, scene.start, scene.goal) if scene.aim is None else scene.aim


def speed_bounds(scene: Scene, time: Array) -> dict[str, Array]:
    """Returns a bound [N] m/s of the speed of every shape at `time` [] seconds, of the kinds that move.

    Between two times no shape moves further than at the mean of its bounds there, but for a ball that is launched in
    between, which is then `LEAST_FLOWN_M` away or further. Other drones are not among them.
    """
    shapes = scene.shapes().items()
    bounds = {kind: top_speeds(each.motion) for kind, each in shapes if getattr(each, "motion", None)}
    throw = scene.spheres.throw
    if throw is not None:
        bounds["spheres"] = bounds.get("spheres", 0.0) + throw_speeds(throw, aim_of(scene, throw), time)
    return bounds


# ----------------------------------------------------------------------- building, pools of worlds


def absent_like(shapes: Any) -> Any:
    """Returns one absent shape of the kind of `shapes`, which stands still where they have arrays of motion."""
    rest: dict[str, Any] = {name: still() for name, still in _MOVING.items() if getattr(shapes, name, None) is not None}
    if getattr(shapes, "surface", None) is not None:
        rest["surface"] = blank_surfaces(shapes.surface.patterns)
    rest |= {name: getattr(shapes, name) for name in _static_names(shapes)}
    return dataclasses.replace(kind_of(shapes)[1].parked, **rest)


def _static_names(shapes: Any) -> list[str]:
    """Returns the fields of a kind's dataclass that are no arrays."""
    return [field.name for field in dataclasses.fields(shapes) if not field.metadata.get("pytree_node", True)]


def _shared(kind: str, several: Sequence[Any]) -> list[Any]:
    """Returns shapes of one kind with equal static fields."""
    share = SHAPES.get(kind).share
    return list(several if share is None or not several else share(several))


def _with_shared(scenes: Sequence[Any]) -> list[Any]:
    """Returns worlds, or pools, in which each kind has equal static fields."""
    found = list(scenes)
    for kind in _kinds_of(scenes):
        has = [i for i, scene in enumerate(found) if kind in scene.shapes()]
        for i, shapes in zip(has, _shared(kind, [found[i].shapes()[kind] for i in has]), strict=True):
            found[i] = found[i].with_shapes({kind: shapes})
    return found


def no_shapes(kind: str, *lead: int) -> Any:
    """Returns the arrays [*lead, 0, ...] of a kind without shapes."""
    parked = SHAPES.get(kind).parked
    return jax.tree.map(lambda leaf: jax.device_put(np.zeros((*lead, 0, *np.shape(leaf)), np.float32)), parked)


def build_scene(
    shapes: Sequence[Shape],
    *,
    volume: npt.ArrayLike,
    start: npt.ArrayLike,
    goal: npt.ArrayLike,
    capacities: Mapping[str, int] | None = None,
) -> Scene:
    """Returns a scene from a list of single shapes, on the host.

    Args:
        shapes: of any kinds in any order; within a kind the order is kept.
        volume: [2, 3] lower and upper corner, metres.
        start: [3] metres.
        goal: [3] metres.
        capacities: by the name of the kind's field in `Scene`; the default is the number of its shapes.

    Raises:
        ValueError: if a kind has more shapes than its capacity.
    """
    of_kind: dict[str, list[Shape]] = {kind: [] for kind in (*FIELDS, *(capacities or {}))}
    for shape in shapes:
        of_kind.setdefault(kind_of(shape)[0], []).append(shape)
    arrays = {}
    for kind, members in of_kind.items():
        capacity = (capacities or {}).get(kind, len(members))
        if len(members) > capacity:
            raise ValueError(
                f"{len(members)} {kind} exceed the capacity of {capacity}; it must be at least their number"
            )
        parked = SHAPES.get(kind).parked
        members = _shared(kind, [*members, *[parked] * (capacity - len(members))])
        names = [field.name for field in dataclasses.fields(parked) if field.name not in _static_names(parked)]
        stacked = {name: _stack_field(members, name) for name in names if members}
        arrays[kind] = dataclasses.replace(members[0], **stacked) if members else no_shapes(kind)
    arrays = _all_with_surfaces(arrays)
    return Scene(
        **{kind: arrays.pop(kind) for kind in FIELDS},
        others=arrays,
        volume=jnp.asarray(volume, jnp.float32),
        start=jnp.asarray(start, jnp.float32),
        goal=jnp.asarray(goal, jnp.float32),
    )


def _all_with_surfaces(kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the shapes of every kind; where any kind has surfaces, with blank ones for those that have none yet."""
    some = next((each.surface for each in kinds.values() if getattr(each, "surface", None) is not None), None)
    if some is None:
        return dict(kinds)
    return {
        kind: dataclasses.replace(each, surface=blank_surfaces(some.patterns, *each.position.shape[:-1]))
        if getattr(each, "surface", each) is None
        else each
        for kind, each in kinds.items()
    }


def _stack_field(members: Sequence[Any], name: str) -> Any:
    """Returns one field of single shapes as arrays [N, ...]; None where none of them moves in this manner."""
    values = [getattr(member, name) for member in members]
    if name == "surface":
        return _stack_surfaces(values)
    if name not in _MOVING:
        # jax.tree would treat a position given as a list as a subtree, so fields are stacked by name.
        return jnp.asarray(np.stack(values), jnp.float32)
    if all(value is None for value in values):
        return None
    rest = _MOVING[name]()
    whole = [rest if value is None else value for value in values]
    return type(rest)(**{field.name: _stack_field(whole, field.name) for field in dataclasses.fields(rest)})


def _stack_surfaces(surfaces: Sequence[Surface | None]) -> Surface | None:
    """Returns the surfaces of single shapes as arrays [N, ...]; None where none has any."""
    some = next((surface for surface in surfaces if surface is not None), None)
    if some is None:
        return None
    blank = np.zeros_like(some.numbers)
    numbers = np.stack([blank if surface is None else surface.numbers for surface in surfaces])
    return dataclasses.replace(some, numbers=jnp.asarray(numbers, jnp.float32))


def scene_shapes(scene: Scene) -> list[Shape]:
    """Returns the shapes of one world that are not parked, kind by kind, as single shapes on the host.

    Balls yet to be thrown are among them, parked; shapes that stand still have no motion.
    """
    shapes: list[Shape] = []
    for each in scene.shapes().values():
        arrays = jax.tree.map(np.asarray, each)
        present = np.all(np.abs(arrays.position) < PARKED / 2, axis=-1)
        if getattr(arrays, "throw", None) is not None:
            present |= arrays.throw.early > 0
        for i in np.flatnonzero(present):
            shapes.append(_without_rest(jax.tree.map(lambda leaf, i=i: leaf[i], arrays)))
    return shapes


def _without_rest(shape: Shape) -> Shape:
    """Returns a single shape in which motion or throw is None if it is zero."""
    motion, throw = getattr(shape, "motion", None), getattr(shape, "throw", None)
    if motion is not None and not np.any(motion.velocity) and not (np.any(motion.swing) and motion.rate):
        shape = dataclasses.replace(shape, motion=None)
    if throw is not None and not throw.early:
        shape = dataclasses.replace(shape, throw=None)
    return shape


def obstacle_count(scene: Scene) -> int:
    """Returns the number of shapes in one world without ground and other planes. On the host."""
    return sum(kind_of(shape)[1].reach is not None for shape in scene_shapes(scene))


def stack_scenes(scenes: Sequence[Scene]) -> Scene:
    """Returns a pool of worlds: the scenes with a leading axis, each kind padded to its largest capacity.

    Where a kind moves in any of the worlds, it has arrays of motion in all.
    """
    capacities = {kind: _capacity(kind, scenes) for kind in _kinds_of(scenes)}
    padded = [
        dataclasses.replace(
            build_scene(scene_shapes(s), volume=s.volume, start=s.start, goal=s.goal, capacities=capacities),
            daylight=s.daylight,
        )
        for s in scenes
    ]
    padded = _with_shared(padded)
    # `jnp.stack` and `jnp.asarray` would compile a program for every shape of array.
    return jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *[_able_to_move(s, padded) for s in padded])


def _able_to_move(scene: Any, others: Sequence[Any]) -> Any:
    """Returns a world, or a pool, with arrays of motion for every kind that has them in any of the others."""

    def filled(kind: str, shapes: Any) -> Any:
        absent = [
            name
            for name in _MOVING
            if getattr(shapes, name, 0) is None and any(getattr(each, name) is not None for each in others_of(kind))
        ]
        return dataclasses.replace(shapes, **{name: _MOVING[name](*shapes.position.shape[:-1]) for name in absent})

    def others_of(kind: str) -> list[Any]:
        return [other.shapes()[kind] for other in others if kind in other.shapes()]

    return scene.with_shapes({kind: filled(kind, shapes) for kind, shapes in scene.shapes().items()})


def _kinds_of(scenes: Sequence[Any]) -> list[str]:
    """Returns the kinds that have a capacity above 0 in any of these worlds or pools."""
    return list(dict.fromkeys(kind for scene in scenes for kind in scene.shapes()))


def _capacity(kind: str, scenes: Sequence[Any]) -> int:
    """Returns the largest capacity of a kind in these worlds, or pools."""
    return max(scene.shapes()[kind].position.shape[-2] if kind in scene.shapes() else 0 for scene in scenes)


def with_equal_capacities(pools: Sequence[Scene], like: Sequence[Any] = ()) -> list[Scene]:
    """Returns the pools, every kind of shape padded to its largest capacity in any of them. On the host.

    Where a kind moves in any of them, it has arrays of motion in all.

    Args:
        pools: of worlds.
        like: more pools whose capacities count, or the shapes of their arrays.
    """

    def padded(kind: str, pool: Scene) -> Any:
        shapes = pool.shapes()[kind]
        worlds, capacity = shapes.position.shape[:2]
        missing = _capacity(kind, [*pools, *like]) - capacity

        def joined(here: Array, absent: npt.ArrayLike) -> Array:
            more = np.broadcast_to(np.asarray(absent, np.float32), (worlds, missing, *np.shape(absent)))
            return jax.device_put(np.concatenate([np.asarray(here), more], axis=1))

        return jax.tree.map(joined, shapes, absent_like(shapes))

    names = _kinds_of([*pools, *like])
    whole = [
        pool.with_shapes({kind: no_shapes(kind, pool.volume.shape[0]) for kind in names if kind not in pool.shapes()})
        for pool in pools
    ]
    whole = [pool.with_shapes(_all_with_surfaces(pool.shapes())) for pool in whole]
    whole = _with_shared([*like, *whole])[len(like) :]
    able = [_able_to_move(pool, [*whole, *like]) for pool in whole]
    return [pool.with_shapes({kind: padded(kind, pool) for kind in pool.shapes()}) for pool in able]


@partial(jax.jit, inline=True)  # one program, not one for each shape of array
def take_scene(pool: Scene, index: ArrayLike) -> Scene:
    """Returns world `index` [] of a pool."""
    return jax.tree.map(lambda leaf: leaf[index], pool)
