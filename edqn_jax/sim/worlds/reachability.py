"""A quick check whether a path leads from a world's start to its goal; it reports none that does not exist.

Nodes of a lattice are free where a sphere of radius and half an edge fits, so a drone passes straight between two
neighbours along an axis. Shapes are taken for upright prisms around them. A column of nodes is one word, a bit each.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.shapes.kind import reach_of
from edqn_jax.sim.worlds.free_points import CLEARANCE

KNOWN = ("boxes", "cylinders", "spheres", "planes")
"""Kinds of shape of which the footprint is known; of any other it is the box around a shape."""

LEVELS = 32
"""Bits of a word: the most nodes above each other."""


def has_way(scene: Scene, size: tuple[float, float, float], radius: float, edge: float) -> Array:
    """Returns whether a path for the sphere leads from start to goal, [] bool; may be False wrongly in narrow places.

    Args:
        scene: one world; its planes are level.
        size: the volume's extent at most, metres: the lattice has as many nodes as fit into it.
        radius: of the sphere, metres; start and goal are `CLEARANCE` from all surfaces.
        edge: of the lattice, metres.

    Raises:
        ValueError: if there are more nodes above each other than `LEVELS`.
    """
    across, along, levels = (int(side / edge) for side in size)
    if levels > LEVELS:
        raise ValueError(f"{levels} nodes above each other; there may be {LEVELS}, so edge must be larger")
    x, y, z = (scene.volume[0, axis] + edge * (jnp.arange(n) + 0.5) for axis, n in enumerate((across, along, levels)))
    x, y = x[:, None], y[None, :]
    need = radius + edge / 2
    free = _without_planes(scene, z, need, (across, along))
    for footprint, low, high in _prisms(scene, x, y):
        blocked = _word((z[None] > low[:, None] - need) & (z[None] < high[:, None] + need))
        free = _without(free, footprint, blocked, need)
    seeds, ends = (free & _near(point, x, y, z, CLEARANCE - radius) for point in (scene.start, scene.goal))

    def spread(state: tuple[Array, Array]) -> tuple[Array, Array]:
        reached, _ = state
        grown = reached | (reached << 1) | (reached >> 1)
        row = jnp.zeros((1, along), jnp.uint32)
        grown |= jnp.concatenate([reached[1:], row]) | jnp.concatenate([row, reached[:-1]])
        column = jnp.zeros((across, 1), jnp.uint32)
        grown |= jnp.concatenate([reached[:, 1:], column], 1) | jnp.concatenate([column, reached[:, :-1]], 1)
        return grown & free, reached

    def goes_on(state: tuple[Array, Array]) -> Array:
        reached, before = state
        return jnp.any(reached != before) & ~jnp.any(reached & ends)

    reached, _ = lax.while_loop(goes_on, spread, (seeds, jnp.zeros_like(seeds)))
    return jnp.any((reached & ends) != 0)


def _word(bits: Array) -> Array:
    """Returns bits [..., Z] as words [...] uint32."""
    weights = jnp.left_shift(jnp.uint32(1), jnp.arange(bits.shape[-1], dtype=jnp.uint32))
    weights = jnp.broadcast_to(weights, bits.shape)
    return jnp.sum(jnp.where(bits, weights, jnp.uint32(0)), axis=-1, dtype=jnp.uint32)


def _near(point: Array, x: Array, y: Array, z: Array, within: float) -> Array:
    """Returns the nodes [X, Y] words within so many metres of a point [3]."""
    level = (x - point[0]) ** 2 + (y - point[1]) ** 2
    return _word(level[:, :, None] + (z - point[2])[None, None] ** 2 < within**2)


def _without_planes(scene: Scene, z: Array, need: float, shape: tuple[int, int]) -> Array:
    """Returns the nodes [X, Y] words that are inside the volume and above all planes, which are level."""
    below = jnp.sum(scene.planes.normal[:, 2:] * (z[None] - scene.planes.position[:, 2:]) < need, axis=0) > 0
    return jnp.broadcast_to(_word(~below & (z < scene.volume[1, 2])), shape)


def _prisms(scene: Scene, x: Array, y: Array):
    """Yields, kind by kind, footprints as functions of a shape's number, and their low and high ends [N], metres."""
    boxes, cylinders, spheres = scene.boxes, scene.cylinders, scene.spheres

    def box(number: Array) -> Array:
        dx, dy = x - boxes.position[number, 0], y - boxes.position[number, 1]
        cos, sin = jnp.cos(boxes.yaw[number]), jnp.sin(boxes.yaw[number])
        beyond_x = jnp.maximum(jnp.abs(cos * dx + sin * dy) - boxes.half[number, 0], 0.0)
        beyond_y = jnp.maximum(jnp.abs(cos * dy - sin * dx) - boxes.half[number, 1], 0.0)
        return jnp.sqrt(beyond_x**2 + beyond_y**2)

    def disc(shapes, number: Array) -> Array:
        dx, dy = x - shapes.position[number, 0], y - shapes.position[number, 1]
        return jnp.sqrt(dx**2 + dy**2) - shapes.radius[number]

    def around(shapes):
        """The axis-aligned box around a shape of any other kind."""
        reach = reach_of(shapes)

        def footprint(number: Array) -> Array:
            beyond_x = jnp.maximum(jnp.abs(x - shapes.position[number, 0]) - reach[number, 0], 0.0)
            beyond_y = jnp.maximum(jnp.abs(y - shapes.position[number, 1]) - reach[number, 1], 0.0)
            return jnp.sqrt(beyond_x**2 + beyond_y**2)

        return shapes, footprint, reach[:, 2]

    ends = (
        (boxes, box, boxes.half[:, 2]),
        (cylinders, lambda number: disc(cylinders, number), cylinders.half_height),
        (spheres, lambda number: disc(spheres, number), spheres.radius),
        *(around(shapes) for kind, shapes in scene.shapes().items() if kind not in KNOWN and shapes.position.shape[0]),
    )
    for shapes, footprint, half in ends:
        if shapes.position.shape[0]:
            yield footprint, shapes.position[:, 2] - half, shapes.position[:, 2] + half


def _without(free: Array, footprint, words: Array, need: float) -> Array:
    """Returns the free nodes [X, Y] without those that N prisms, which block `words` [N], come too near."""

    def remove(number: Array, free: Array) -> Array:
        return free & ~jnp.where(footprint(number) < need, words[number], jnp.uint32(0))

    return lax.fori_loop(0, words.shape[0], remove, free)
