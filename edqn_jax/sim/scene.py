"""A world as padded arrays, one per kind of shape, and its signed distance.

The same arrays are what the drone collides with and what the camera sees. Every kind has a static
capacity; unused entries are parked `PARKED` metres away with zero size, so that no ray
meets them, they affect no distance, and no code needs a mask.

Shapes may move (`motion.py`): their `position` is that at time 0, and `scene_at` is the world at another time, in
which nothing moves any more. What does not ask for a time sees the world at time 0. A kind without motion has None in
place of the arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from edqn_jax.sim.motion import (
    OUTSIDE_M,
    Motion,
    Throw,
    at_rest,
    displacement,
    in_flight,
    not_thrown,
    thrown_to,
    top_speed,
    top_throw_speed,
)

PARKED = 1e6
"""Coordinate of absent shapes, metres along each axis."""


@struct.dataclass
class UprightBoxes:
    """Boxes rotated about the vertical only. N is the capacity."""

    position: Array  # [N, 3] centre, metres
    half: Array  # [N, 3] half extents, metres
    yaw: Array  # [N] rotation about world z, radians
    albedo: Array  # [N, 3] RGB reflectance in [0, 1]
    motion: Motion | None = None


@struct.dataclass
class UprightCylinders:
    """Cylinders whose axis is world z."""

    position: Array  # [N, 3] centre, metres
    radius: Array  # [N] metres
    half_height: Array  # [N] metres
    albedo: Array  # [N, 3]
    motion: Motion | None = None


@struct.dataclass
class Spheres:
    position: Array  # [N, 3] centre, metres
    radius: Array  # [N] metres
    albedo: Array  # [N, 3]
    motion: Motion | None = None
    throw: Throw | None = None


@struct.dataclass
class TiltedBoxes:
    """Boxes at any rotation."""

    position: Array  # [N, 3] centre, metres
    half: Array  # [N, 3] half extents, metres
    rotation: Array  # [N, 3, 3] body-to-world; columns are the box's axes
    albedo: Array  # [N, 3]
    motion: Motion | None = None


@struct.dataclass
class Capsules:
    position: Array  # [N, 3] centre, metres
    axis: Array  # [N, 3] unit direction
    half_length: Array  # [N] metres, of the straight part
    radius: Array  # [N] metres
    albedo: Array  # [N, 3]
    motion: Motion | None = None


@struct.dataclass
class TiltedCylinders:
    """Cylinders with any axis."""

    position: Array  # [N, 3] centre, metres
    axis: Array  # [N, 3] unit direction
    half_length: Array  # [N] metres
    radius: Array  # [N] metres
    albedo: Array  # [N, 3]
    motion: Motion | None = None


@struct.dataclass
class Planes:
    """Half-spaces: solid below the plane, free on the side that the normal points to."""

    position: Array  # [N, 3] any point of the plane, metres
    normal: Array  # [N, 3] unit
    albedo: Array  # [N, 3]


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


Shape = UprightBoxes | UprightCylinders | Spheres | TiltedBoxes | Capsules | TiltedCylinders | Planes
"""One shape: a kind's dataclass whose fields lack the leading axis."""

KINDS: dict[str, type[Shape]] = {
    "boxes": UprightBoxes,
    "cylinders": UprightCylinders,
    "spheres": Spheres,
    "tilted_boxes": TiltedBoxes,
    "capsules": Capsules,
    "tilted_cylinders": TiltedCylinders,
    "planes": Planes,
}
"""The kinds of shape by the name of their field in `Scene`."""

S = TypeVar("S", bound=Shape)

_MOVING = {"motion": at_rest, "throw": not_thrown}
"""The fields of a kind that are None where nothing moves, and what stands for a shape that does not."""

_TINY = 1e-20  # under a square root, so that its gradient is finite; 1e-10 m is nothing


def moves(scene: Scene) -> bool:
    """Returns whether any kind of shape has motion. Static: known when a program is traced."""
    return any(_moves(getattr(scene, kind)) for kind in KINDS)


def _moves(shapes: Shape) -> bool:
    return getattr(shapes, "motion", None) is not None or getattr(shapes, "throw", None) is not None


def scene_at(scene: Scene, time: Array | None) -> Scene:
    """Returns the world as it stands at `time` [] seconds of the episode, without motion; a still world is returned.

    The one place where shapes move: the camera and the collisions both see what it returns.

    Args:
        scene: one world; balls are thrown at a drone on its way from the scene's start to its goal.
        time: None is time 0, before anything is thrown.
    """
    moving = [kind for kind in KINDS if _moves(getattr(scene, kind))]
    return dataclasses.replace(scene, **{kind: _standing(scene, getattr(scene, kind), time) for kind in moving})


def _standing(scene: Scene, shapes: Any, time: Array | None) -> Any:
    """Returns the shapes of one kind where they stand at a time."""
    place = shapes.position
    if shapes.motion is not None and time is not None:
        place = place + displacement(shapes.motion, place, time)
    if not isinstance(shapes, Spheres):
        return dataclasses.replace(shapes, position=place, motion=None)
    if shapes.throw is not None and time is not None:
        ends = scene.start, scene.goal
        ball = thrown_to(shapes.throw, *ends, time)
        beyond = (shapes.radius + OUTSIDE_M)[:, None]
        outside = jnp.any((ball < scene.volume[0][None] - beyond) | (ball > scene.volume[1][None] + beyond), axis=1)
        place = jnp.where(in_flight(shapes.throw, *ends, time, outside)[:, None], ball, place)
    return dataclasses.replace(shapes, position=place, motion=None, throw=None)


def fastest(scene: Scene, time: Array | None) -> Array:
    """Returns a bound [] m/s of the speed of every shape of one world at `time` [] seconds."""
    kinds = [getattr(scene, kind) for kind in KINDS]
    speeds = [top_speed(shapes.motion) for shapes in kinds if getattr(shapes, "motion", None) is not None]
    if scene.spheres.throw is not None and time is not None:
        speeds.append(top_throw_speed(scene.spheres.throw, scene.start, scene.goal, time))
    return jnp.max(jnp.stack([jnp.zeros(()), *speeds]))


# ------------------------------------------------------------------------------------- distances


def shape_distances(scene: Scene, point: Array) -> dict[str, Array]:
    """Returns the signed distance from `point` to every single shape.

    Args:
        scene: one world.
        point: [3] metres.

    Returns:
        For every kind whose capacity is not zero, [N] metres: positive outside, negative inside, exact on
        both sides of the surface.
    """
    x, y, z = point[0], point[1], point[2]
    rules = {
        "boxes": _upright_boxes,
        "cylinders": _upright_cylinders,
        "spheres": _spheres,
        "tilted_boxes": _tilted_boxes,
        "capsules": _capsules,
        "tilted_cylinders": _tilted_cylinders,
        "planes": _planes,
    }
    return {
        kind: rule(getattr(scene, kind), x, y, z)
        for kind, rule in rules.items()
        if getattr(scene, kind).position.shape[0]
    }


def signed_distance(scene: Scene, point: Array) -> Array:
    """Returns metres from `point` [3] to the nearest surface of the scene, negative inside a shape.

    Exact outside. Where shapes overlap, the depth inside is that of the shape whose own surface is
    furthest away, a lower bound of the depth in the union. A scene without shapes is `PARKED` away.
    """
    nearest = [jnp.min(distance) for distance in shape_distances(scene, point).values()]
    if not nearest:
        return jnp.full((), PARKED, jnp.float32)
    return jnp.min(jnp.stack(nearest))


def segment_contact(
    scene: Scene,
    start: Array,
    end: Array,
    radius: ArrayLike,
    samples: int = 8,
    times: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Returns whether a sphere that moves straight from `start` to `end` touches anything, and where first.

    The distance is taken at `samples` points, both ends included. Along a line the distance to a convex
    shape is convex and at distance r bends by at most 1/r, so between two points h apart the sphere can
    penetrate undetected by at most (h / 2)^2 / 2 r: 0.09 mm for a step of 0.11 m and r = 0.36 m. Wherever
    the two ends alone prove the segment free (d0 + d1 > L + 2 r) all samples agree.

    At each point every shape is where it is when the sphere is there. Over one physics step shapes move nearly
    straight, so that the bound holds with h the relative motion; where one turns at a wall within the step, it may
    hide h / 2 more.

    Args:
        scene: one world.
        start: [3] metres.
        end: [3] metres.
        radius: metres.
        samples: points at which the distance is taken, static.
        times: [] seconds each, at the start and at the end; None is a world as it stands at time 0.

    Returns:
        touch: bool. fraction: in [0, 1], the first contact's share of the segment; 1 if there is none.
    """
    fractions = jnp.linspace(0.0, 1.0, samples)

    def distance(f: Array) -> Array:
        there = scene if times is None else scene_at(scene, times[0] + f * (times[1] - times[0]))
        return signed_distance(there, start + f * (end - start))

    gap = jax.vmap(distance)(fractions) - radius
    fall = gap[:-1] - gap[1:]
    # The contact lies between the last free sample and the first touching one: interpolate linearly.
    crossing = fractions[:-1] + (fractions[1:] - fractions[:-1]) * gap[:-1] / jnp.where(fall > 0, fall, 1.0)
    entered = (gap[:-1] > 0) & (gap[1:] <= 0)
    fraction = jnp.min(jnp.where(entered, crossing, 1.0))
    return jnp.any(gap <= 0), jnp.where(gap[0] <= 0, 0.0, jnp.clip(fraction, 0.0, 1.0))


def path_contact(scene: Scene, path: Array, radius: ArrayLike, times: Array | None = None) -> tuple[Array, Array]:
    """Returns `segment_contact` of each segment of a path up to the first that touches.

    One distance at each point proves most segments free (d0 + d1 > L + 2 r, with L the length of the relative motion
    at most); the others are searched one by one, so that the usual path costs an eighth.

    Args:
        path: [n + 1, 3] metres.
        radius: metres.
        times: [n + 1] seconds of the episode; None is a world as it stands at time 0.

    Returns:
        touch: [n] bool, True for the first segment that touches alone. fraction: [n], 1 where nothing touches.
    """
    if not moves(scene):
        times = None
    gap = jax.vmap(lambda point, time: signed_distance(scene_at(scene, time), point))(path, times) - radius
    length = jnp.sqrt(jnp.sum((path[1:] - path[:-1]) ** 2, axis=1))
    if times is not None:
        speed = jax.vmap(lambda time: fastest(scene, time))(times)
        length = length + jnp.maximum(speed[1:], speed[:-1]) * (times[1:] - times[:-1])
    near = ~(gap[:-1] + gap[1:] > length)  # a path that is not finite is near everything
    number = jnp.arange(length.shape[0])

    def search(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        near, touch, fraction = carry
        first = jnp.argmax(near)
        when = None if times is None else (times[first], times[first + 1])
        touches, at = segment_contact(scene, path[first], path[first + 1], radius, times=when)
        here = number == first
        return near & ~here & ~touches, touch | (here & touches), jnp.where(here, at, fraction)

    nothing = (near, jnp.zeros_like(near), jnp.ones_like(length))
    return lax.while_loop(lambda carry: jnp.any(carry[0]), search, nothing)[1:]


def _norm(*components: Array) -> Array:
    return jnp.sqrt(jnp.maximum(sum(c * c for c in components), _TINY))


def _solid(*gaps: Array) -> Array:
    """Returns the signed distance, given the distances beyond each pair of faces (negative: within)."""
    outside = _norm(*(jnp.maximum(gap, 0.0) for gap in gaps))
    deepest = gaps[0]
    for gap in gaps[1:]:
        deepest = jnp.maximum(deepest, gap)
    return jnp.where(deepest > 0, outside, deepest)


def _offset(position: Array, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
    return x - position[:, 0], y - position[:, 1], z - position[:, 2]


def _upright_boxes(boxes: UprightBoxes, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = _offset(boxes.position, x, y, z)
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    return _solid(
        jnp.abs(c * dx + s * dy) - boxes.half[:, 0],
        jnp.abs(c * dy - s * dx) - boxes.half[:, 1],
        jnp.abs(dz) - boxes.half[:, 2],
    )


def _tilted_boxes(boxes: TiltedBoxes, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = _offset(boxes.position, x, y, z)
    r = boxes.rotation
    return _solid(*(jnp.abs(r[:, 0, i] * dx + r[:, 1, i] * dy + r[:, 2, i] * dz) - boxes.half[:, i] for i in range(3)))


def _upright_cylinders(cylinders: UprightCylinders, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = _offset(cylinders.position, x, y, z)
    return _solid(_norm(dx, dy) - cylinders.radius, jnp.abs(dz) - cylinders.half_height)


def _tilted_cylinders(cylinders: TiltedCylinders, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = _offset(cylinders.position, x, y, z)
    ax, ay, az = cylinders.axis[:, 0], cylinders.axis[:, 1], cylinders.axis[:, 2]
    along = dx * ax + dy * ay + dz * az
    radial = _norm(dx - along * ax, dy - along * ay, dz - along * az)
    return _solid(radial - cylinders.radius, jnp.abs(along) - cylinders.half_length)


def _spheres(spheres: Spheres, x: Array, y: Array, z: Array) -> Array:
    return _norm(*_offset(spheres.position, x, y, z)) - spheres.radius


def _capsules(capsules: Capsules, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = _offset(capsules.position, x, y, z)
    ax, ay, az = capsules.axis[:, 0], capsules.axis[:, 1], capsules.axis[:, 2]
    along = jnp.clip(dx * ax + dy * ay + dz * az, -capsules.half_length, capsules.half_length)
    return _norm(dx - along * ax, dy - along * ay, dz - along * az) - capsules.radius


def _planes(planes: Planes, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = _offset(planes.position, x, y, z)
    return dx * planes.normal[:, 0] + dy * planes.normal[:, 1] + dz * planes.normal[:, 2]


# ----------------------------------------------------------------------- building, pools of worlds


def parked_shape(kind: type[S]) -> S:
    """Returns one absent shape of the kind (its dataclass): parked far away, with zero size."""
    names = [field.name for field in dataclasses.fields(kind) if field.name not in _MOVING]
    values: dict[str, Any] = {name: np.float32(0.0) for name in names} | {
        "position": np.array([0.0, 0.0, -PARKED]) if "normal" in names else np.full(3, PARKED),
        "half": np.zeros(3),
        "rotation": np.eye(3),
        "axis": np.array([0.0, 0.0, 1.0]),
        "normal": np.array([0.0, 0.0, 1.0]),
        "albedo": np.full(3, 0.5),
    }
    return kind(**{name: values[name] for name in names})


def parked_like(shapes: S) -> S:
    """Returns one absent shape of the kind of `shapes`, which stands still where they have arrays of motion."""
    rest = {name: still() for name, still in _MOVING.items() if getattr(shapes, name, None) is not None}
    return dataclasses.replace(parked_shape(type(shapes)), **rest)


def no_shapes(kind: type[S]) -> S:
    """Returns the kind's dataclass with capacity 0."""
    return jax.tree.map(lambda leaf: jnp.zeros((0, *np.shape(leaf)), jnp.float32), parked_shape(kind))


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
    fields = {}
    for kind, dataclass in KINDS.items():
        members = [shape for shape in shapes if isinstance(shape, dataclass)]
        capacity = (capacities or {}).get(kind, len(members))
        if len(members) > capacity:
            raise ValueError(
                f"{len(members)} {kind} exceed the capacity of {capacity}; it must be at least their number"
            )
        members += [parked_shape(dataclass)] * (capacity - len(members))
        if not members:
            fields[kind] = no_shapes(dataclass)
            continue
        fields[kind] = dataclass(
            **{field.name: _stacked(members, field.name) for field in dataclasses.fields(dataclass)}
        )
    return Scene(
        **fields,
        volume=jnp.asarray(volume, jnp.float32),
        start=jnp.asarray(start, jnp.float32),
        goal=jnp.asarray(goal, jnp.float32),
    )


def _stacked(members: Sequence[Any], name: str) -> Any:
    """Returns one field of single shapes as arrays [N, ...]; None where none of them moves in this manner."""
    values = [getattr(member, name) for member in members]
    if name not in _MOVING:
        # jax.tree would treat a position given as a list as a subtree, so fields are stacked by name.
        return jnp.asarray(np.stack(values), jnp.float32)
    if all(value is None for value in values):
        return None
    rest = _MOVING[name]()
    whole = [rest if value is None else value for value in values]
    return type(rest)(**{field.name: _stacked(whole, field.name) for field in dataclasses.fields(rest)})


def scene_shapes(scene: Scene) -> list[Shape]:
    """Returns the shapes of one world that are not parked, kind by kind, as single shapes on the host.

    Balls yet to be thrown are among them, parked; shapes that stand still have no motion.
    """
    shapes: list[Shape] = []
    for kind in KINDS:
        arrays = jax.tree.map(np.asarray, getattr(scene, kind))
        present = np.all(np.abs(arrays.position) < PARKED / 2, axis=-1)
        if getattr(arrays, "throw", None) is not None:
            present |= arrays.throw.early > 0
        for i in np.flatnonzero(present):
            shapes.append(_without_rest(jax.tree.map(lambda leaf, i=i: leaf[i], arrays)))
    return shapes


def _without_rest(shape: Shape) -> Shape:
    """Returns a single shape with None in place of a motion or a throw that moves nothing."""
    motion, throw = getattr(shape, "motion", None), getattr(shape, "throw", None)
    if motion is not None and not np.any(motion.velocity) and not (np.any(motion.swing) and motion.rate):
        shape = dataclasses.replace(shape, motion=None)
    if throw is not None and not throw.early:
        shape = dataclasses.replace(shape, throw=None)
    return shape


def obstacle_count(scene: Scene) -> int:
    """Returns the number of shapes in one world without ground and other planes. On the host."""
    return sum(not isinstance(shape, Planes) for shape in scene_shapes(scene))


def stack_scenes(scenes: Sequence[Scene]) -> Scene:
    """Returns a pool of worlds: the scenes with a leading axis, each kind padded to its largest capacity.

    Where a kind moves in any of the worlds, it has arrays of motion in all.
    """
    capacities = {kind: max(getattr(s, kind).position.shape[0] for s in scenes) for kind in KINDS}
    padded = [
        build_scene(scene_shapes(s), volume=s.volume, start=s.start, goal=s.goal, capacities=capacities) for s in scenes
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *[_able_to_move(s, padded) for s in padded])


def _able_to_move(scene: Any, others: Sequence[Any]) -> Any:
    """Returns a world, or a pool, with arrays of motion wherever any of the others has some."""

    def filled(shapes: Any, kind: str) -> Any:
        absent = [
            name
            for name in _MOVING
            if getattr(shapes, name, 0) is None and any(getattr(getattr(o, kind), name) is not None for o in others)
        ]
        return dataclasses.replace(shapes, **{name: _MOVING[name](*shapes.position.shape[:-1]) for name in absent})

    return dataclasses.replace(scene, **{kind: filled(getattr(scene, kind), kind) for kind in KINDS})


def with_equal_capacities(pools: Sequence[Scene], like: Sequence[Any] = ()) -> list[Scene]:
    """Returns the pools, every kind of shape padded to its largest capacity in any of them. On the host.

    Where a kind moves in any of them, it has arrays of motion in all.

    Args:
        pools: of worlds.
        like: more pools whose capacities count, or the shapes of their arrays.
    """

    def padded(kind: str, pool: Scene) -> Shape:
        shapes = getattr(pool, kind)
        worlds, capacity = shapes.position.shape[:2]
        missing = max(getattr(other, kind).position.shape[1] for other in (*pools, *like)) - capacity

        def joined(here: Array, absent: npt.ArrayLike) -> Array:
            more = np.broadcast_to(np.asarray(absent, np.float32), (worlds, missing, *np.shape(absent)))
            return jnp.asarray(np.concatenate([np.asarray(here), more], axis=1))

        return jax.tree.map(joined, shapes, parked_like(shapes))

    able = [_able_to_move(pool, [*pools, *like]) for pool in pools]
    return [dataclasses.replace(pool, **{kind: padded(kind, pool) for kind in KINDS}) for pool in able]


def take_scene(pool: Scene, index: ArrayLike) -> Scene:
    """Returns world `index` [] of a pool."""
    return jax.tree.map(lambda leaf: leaf[index], pool)
