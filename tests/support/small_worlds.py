"""Small worlds for planners, some without a path, and the properties of a valid path."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import itertools

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.planning.path import PlanningTask
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Planes, Scene, Shape, UprightBoxes, build_scene

RADIUS = 0.36
GREY = np.full(3, 0.5)
GROUND = Planes(position=np.zeros(3), normal=np.array([0.0, 0.0, 1.0]), albedo=GREY)
SIZE = (12.0, 12.0, 6.0)


def small_world(*shapes: Shape, start=(2.0, 6.0, 3.0), goal=(10.0, 6.0, 3.0)) -> PlanningTask:
    """A task in a small volume over level ground; its capacities never vary, so that it compiles once."""
    volume = [(0.0, 0.0, 0.0), SIZE]
    scene = build_scene([GROUND, *shapes], volume=volume, start=start, goal=goal, capacities={"boxes": 8})
    return PlanningTask.from_scene(scene, body_radius=RADIUS)


def box(lower, upper) -> UprightBoxes:
    lower, upper = np.array(lower, float), np.array(upper, float)
    return UprightBoxes(position=(lower + upper) / 2, half=(upper - lower) / 2, yaw=np.float32(0), albedo=GREY)


def enclosure(middle, inner: float = 1.0, wall: float = 0.2) -> list[Shape]:
    """Six walls around a cube of half width `inner`; a sphere fits in, and never out."""
    middle, outer = np.array(middle), inner + wall
    walls: list[Shape] = []
    for axis, side in itertools.product(range(3), (-1.0, 1.0)):
        half = np.full(3, outer)
        half[axis] = wall / 2
        place = middle + side * (inner + wall / 2) * np.eye(3)[axis]
        walls.append(box(place - half, place + half))
    return walls


WITHOUT_A_WAY = {
    "goal enclosed": small_world(*enclosure((10.0, 6.0, 3.0))),
    "start enclosed": small_world(*enclosure((2.0, 6.0, 3.0))),
    "wall across": small_world(box((5.5, -1, -1), (6.5, 13, 7))),
}


def random_small_world(seed: int, shapes: int = 7) -> PlanningTask:
    """Turned blocks at random around a free start and goal; there need not be a way."""
    rng = np.random.default_rng(seed)
    ends = np.array([(1.0, 1.0, 1.0), (11.0, 11.0, 5.0)])
    blocks: list[Shape] = []
    while len(blocks) < shapes:
        place, half = rng.uniform((1, 1, 0), (11, 11, 6)), rng.uniform(0.3, 2.0, 3)
        if np.all(np.linalg.norm(ends - place, axis=1) > np.linalg.norm(half) + RADIUS + 0.1):
            blocks.append(UprightBoxes(position=place, half=half, yaw=rng.uniform(0, 3), albedo=GREY))
    return small_world(*blocks, start=tuple(ends[0]), goal=tuple(ends[1]))


_distances = jax.jit(lambda scene, points: jax.vmap(lambda point: signed_distance(scene, point))(points))


def true_distances(scene: Scene, points: NDArray) -> NDArray:
    """Signed distances [K] of points [K, 3], padded so that few programs are compiled."""
    padded = np.zeros((1 << max(len(points) - 1, 1).bit_length(), 3), np.float32)
    padded[: len(points)] = points
    return np.asarray(_distances(scene, padded))[: len(points)]


def assert_flyable(task: PlanningTask, path: NDArray | None, tolerance: float = 0.0) -> None:
    """From start to goal, within the volume, and nothing nearer than the radius at any whole centimetre."""
    assert path is not None
    np.testing.assert_allclose(path[[0, -1]], [task.start, task.goal], atol=1e-9)
    legs = [
        a + np.linspace(0, 1, 2 + int(100 * np.linalg.norm(b - a)))[:, None] * (b - a)
        for a, b in itertools.pairwise(path)
    ]
    assert true_distances(task.scene, np.concatenate(legs)).min() >= task.body_radius - tolerance
    lower, upper = np.asarray(task.scene.volume)
    assert np.all((path >= lower) & (path <= upper))
