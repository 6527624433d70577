"""Random scenes and poses, with every kind of shape."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import SurfaceConfig
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import (
    PARKED,
    Capsules,
    Planes,
    Scene,
    Shape,
    Spheres,
    TiltedBoxes,
    TiltedCylinders,
    UprightBoxes,
    UprightCylinders,
    build_scene,
    stack_scenes,
    take_scene,
)
from edqn_jax.sim.scene.surface import PATTERNS, Surface
from edqn_jax.sim.worlds.looks import with_looks

VOLUME = np.array([[0.0, 0.0, 0.0], [60.0, 60.0, 25.0]])
GROUND = Planes(position=np.zeros(3), normal=np.array([0.0, 0.0, 1.0]), albedo=np.array([0.37, 0.43, 0.35]))

BROWN, BLUE = np.array([0.6, 0.5, 0.4]), np.array([0.2, 0.3, 0.7])


def scene_of(*shapes: Shape, **capacities: int) -> Scene:
    return build_scene(shapes, volume=VOLUME, start=VOLUME[0], goal=VOLUME[1], capacities=capacities)


def rotation_of(roll: float, pitch: float, yaw: float) -> NDArray:
    """[3, 3] body-to-world: yaw about z, then pitch about y, then roll about x."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    turn = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    lean = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return turn @ lean @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])


def every_kind(rng: np.random.Generator, each: int = 4) -> Scene:
    """`each` shapes of every kind over level ground, some flying and overlapping; capacities never vary."""
    shapes: list[Shape] = [GROUND]
    for _ in range(each):
        rotation = rotation_of(*rng.uniform(-np.pi, np.pi, 3))
        axis = rotation[:, 2]
        place = [rng.uniform((0, 0, 0), (60, 60, 20)) for _ in range(6)]
        albedo = [rng.uniform(0.1, 0.9, 3) for _ in range(6)]
        half = [rng.uniform(0.5, 5, 3) for _ in range(2)]
        size = rng.uniform(0.4, 4, 8)
        shapes += [
            UprightBoxes(position=place[0], half=half[0], yaw=rng.uniform(-3, 3), albedo=albedo[0]),
            UprightCylinders(position=place[1], radius=size[0], half_height=2 * size[1], albedo=albedo[1]),
            Spheres(position=place[2], radius=size[2], albedo=albedo[2]),
            TiltedBoxes(position=place[3], half=half[1], rotation=rotation, albedo=albedo[3]),
            Capsules(position=place[4], axis=axis, half_length=size[4], radius=size[5], albedo=albedo[4]),
            TiltedCylinders(position=place[5], axis=axis, half_length=size[6], radius=size[7], albedo=albedo[5]),
        ]
    return scene_of(*shapes)


_distances = jax.jit(lambda scene, points: jax.vmap(lambda p: signed_distance(scene, p))(points))


def free_points(scene: Scene, rng: np.random.Generator, count: int, clearance: float = 0.5) -> NDArray:
    """[count, 3] points of the flight volume at least `clearance` metres from everything."""
    lower, upper = np.asarray(scene.volume)
    points = rng.uniform(lower + 1, upper - 1, (64 * count, 3)).astype(np.float32)
    return points[np.asarray(_distances(scene, jnp.asarray(points))) > clearance][:count]


def box(x, y, z, hx, hy, hz, yaw=0.0):
    return UprightBoxes(position=[x, y, z], half=[hx, hy, hz], yaw=yaw, albedo=BROWN)


def pillar(x, y, z, radius, half_height):
    return UprightCylinders(position=[x, y, z], radius=radius, half_height=half_height, albedo=BLUE)


def ball(x, y, z, radius):
    return Spheres(position=[x, y, z], radius=radius, albedo=BROWN)


def closed_room() -> Scene:
    """A room of 14 m without an opening: walls that touch each other, the ground and a roof."""
    places = ((8, 0), (-8, 0), (0, 8), (0, -8))
    walls = [box(30 + x, 30 + y, 3, 1 + 9 * abs(y) / 8, 1 + 9 * abs(x) / 8, 3) for x, y in places]
    return scene_of(GROUND, *walls, box(30, 30, 7, 10, 10, 1))


@jax.jit
def clearances(pool, missions, points):
    """Metres [M] from points [M, 3] to the nearest surface in the worlds of M missions."""
    at = jax.vmap(lambda index, point: signed_distance(take_scene(pool, index), point))
    return at(missions.scene, points)


def one_of_each_kind() -> Scene:
    """One shape of every kind, and a parked one of each."""

    def points(*point: float) -> jax.Array:
        return jnp.array([point, [PARKED] * 3])

    grey, ones, long = jnp.full((2, 3), 0.5), jnp.ones(2), jnp.full(2, 4.0)
    leaning = jnp.array([[0.6, 0.0, 0.8]] * 2)
    return Scene(
        boxes=UprightBoxes(points(30, 30, 5), jnp.array([[4.0, 6, 5], [0, 0, 0]]), jnp.array([0.3, 0]), grey),
        cylinders=UprightCylinders(points(60, 20, 6), 3 * ones, 6 * ones, grey),
        spheres=Spheres(points(50, 55, 9), 4 * ones, jnp.array([[0.9, 0.8, 0.1]] * 2)),
        tilted_boxes=TiltedBoxes(points(80, 40, 9), jnp.ones((2, 3)), jnp.stack([jnp.eye(3)] * 2), grey),
        capsules=Capsules(points(20, 70, 8), leaning, long, ones, grey),
        tilted_cylinders=TiltedCylinders(points(70, 75, 8), leaning, long, ones, grey),
        planes=Planes(jnp.zeros((1, 3)), jnp.array([[0, 0, 1.0]]), grey[:1]),
        volume=jnp.array([[0.0, 0, 0], [110, 110, 25]]),
        start=jnp.array([1.0, 1, 3]),
        goal=jnp.array([90.0, 90, 10]),
    )


PATTERNS_AT_ONCE = tuple(name for name in PATTERNS if name != "blank")


def looking(scene: Scene, seed: int = 0) -> Scene:
    """A world whose shapes have surfaces of every pattern, and a light of its own."""
    number, parts = 0, []
    for name in PATTERNS_AT_ONCE:
        dressed = with_looks(stack_scenes([scene]), jax.random.key(seed)[None], SurfaceConfig(pattern=name))
        parts.append(take_scene(dressed, 0))
    for kind, shapes in scene.shapes().items():
        which = (np.arange(shapes.position.shape[0]) + number) % len(parts)
        number += len(which)
        of_kind = [part.shapes()[kind] for part in parts]
        numbers = np.stack([np.asarray(each.surface.numbers) for each in of_kind])[which, np.arange(len(which))]
        albedo = np.stack([np.asarray(each.albedo) for each in of_kind])[which, np.arange(len(which))]
        surface = Surface(jnp.asarray(numbers), PATTERNS_AT_ONCE)
        scene = scene.with_shapes({kind: dataclasses.replace(shapes, albedo=jnp.asarray(albedo), surface=surface)})
    return dataclasses.replace(scene, daylight=parts[0].daylight)
