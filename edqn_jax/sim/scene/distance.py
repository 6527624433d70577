"""Signed distances to the shapes of a world, and contact of a sphere that moves through it.

Fast where it matters: one array per coordinate, so that all shapes of a kind are one vectorised expression.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from edqn_jax.config.registry import SHAPES
from edqn_jax.kept_programs import kept_jit
from edqn_jax.sim.scene.scene import PARKED, Scene, has_motion, scene_at, speed_bounds


def shape_distances(scene: Scene, point: Array) -> dict[str, Array]:
    """Returns the signed distance from `point` to every single shape.

    Args:
        scene: one world.
        point: [3] metres.

    Returns:
        For every kind whose capacity is not zero, [N] metres: positive outside, negative inside; of the built-in
        kinds exact on both sides of the surface.
    """
    x, y, z = point[0], point[1], point[2]
    return {
        kind: SHAPES.get(kind).distance(shapes, x, y, z)
        for kind, shapes in scene.shapes().items()
        if shapes.position.shape[0]
    }


distances_to_shapes = kept_jit()(shape_distances)
"""`shape_distances` as one program, for what is asked on the host."""


def signed_distance(scene: Scene, point: Array) -> Array:
    """Returns metres from `point` [3] to the nearest surface of the scene, negative inside a shape.

    Exact outside. Where shapes overlap, the depth inside is that of the shape whose own surface is
    furthest away, a lower bound of the depth in the union. A scene without shapes is `PARKED` away.
    """
    return _least(shape_distances(scene, point))


def _least(distances: dict[str, Array]) -> Array:
    nearest = [jnp.min(distance) for distance in distances.values()]
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
    at most); only the others are searched, so that the usual path costs a CPU an eighth. Each shape's distance is less
    what it may move itself by the middle of the segment, so that a fast one far away makes no segment near.

    Args:
        path: [n + 1, 3] metres.
        radius: metres.
        times: [n + 1] seconds of the episode; None is a world as it stands at time 0.

    Returns:
        touch: [n] bool, True for the first segment that touches alone. fraction: [n], 1 where nothing touches.
    """
    if not has_motion(scene):
        times = None
    if times is None:
        gap = jax.vmap(lambda point: signed_distance(scene, point))(path) - radius
    else:
        half = 0.5 * jnp.max(times[1:] - times[:-1])
        gap = jax.vmap(lambda point, time: _room(scene, point, time, half))(path, times) - radius
    length = jnp.sqrt(jnp.sum((path[1:] - path[:-1]) ** 2, axis=1))
    near = ~(gap[:-1] + gap[1:] > length)  # a path that is not finite is near everything
    given = (scene, path, radius, times, near)
    return lax.platform_dependent(*given, cpu=_search_in_turn, default=_search_at_once)


def _contact_in(
    scene: Scene, path: Array, radius: ArrayLike, times: Array | None, number: Array
) -> tuple[Array, Array]:
    """Returns `segment_contact` of one segment of a path."""
    when = None if times is None else (times[number], times[number + 1])
    return segment_contact(scene, path[number], path[number + 1], radius, times=when)


def _search_in_turn(
    scene: Scene, path: Array, radius: ArrayLike, times: Array | None, near: Array
) -> tuple[Array, Array]:
    """Searches the segments that are near, one after the other, up to the first that touches."""
    numbers = jnp.arange(near.shape[0])

    def search(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        near, touch, fraction = carry
        first = jnp.argmax(near)
        touches, at = _contact_in(scene, path, radius, times, first)
        here = numbers == first
        return near & ~here & ~touches, touch | (here & touches), jnp.where(here, at, fraction)

    nothing = (near, jnp.zeros_like(near), jnp.ones(near.shape))
    return lax.while_loop(lambda carry: jnp.any(carry[0]), search, nothing)[1:]


def _search_at_once(
    scene: Scene, path: Array, radius: ArrayLike, times: Array | None, near: Array
) -> tuple[Array, Array]:
    """Searches all segments at once: on a GPU a check whether any is left takes longer than the search."""
    numbers = jnp.arange(near.shape[0])
    touches, at = jax.vmap(lambda number: _contact_in(scene, path, radius, times, number))(numbers)
    touches &= near
    touch = touches & (numbers == jnp.argmax(touches))
    return touch, jnp.where(touch, at, 1.0)


def _room(scene: Scene, point: Array, time: Array, seconds: Array) -> Array:
    """Returns `signed_distance` at `time` [] minus the most that each shape can move within `seconds` []."""
    distances = shape_distances(scene_at(scene, time), point)
    for kind, speed in speed_bounds(scene, time).items():
        distances[kind] = distances[kind] - speed * seconds
    return _least(distances)
