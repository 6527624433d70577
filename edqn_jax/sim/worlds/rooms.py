"""Rooms: three by three under one ceiling, with a door or a window in every wall between two of them."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from edqn_jax.keys import uniform_parts
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.worlds import building
from edqn_jax.sim.worlds.free_points import TRIES

SIDE = 36.0
"""Of the floor, metres."""
ROOMS = 3
"""Rooms along each side of the floor."""
SHIFT = 2.0
"""A wall stands at most so many metres from where it would make all rooms equally wide."""
HEIGHT = (4.0, 8.0)
"""Of the ceiling, metres."""
THICKNESS = 0.3
"""Of the walls, metres."""
OPENING_WIDTH = (2.2, 3.5)
"""Of doors and windows, metres."""
DOOR_HEIGHT = (2.4, 3.6)
WINDOW_HEIGHT = (2.0, 2.6)
SILL_M = 0.6
"""Of wall at least below and above a window."""
WINDOWS, MISSING = 0.4, 0.15
"""Share of openings that are windows, and of walls that are left out."""

_PIER = 1.2  # metres of wall at least beside an opening
_WALLS = 2 * ROOMS * (ROOMS - 1)
_PIECES = 4  # of a wall: left and right of its opening, below, above
_OF_A_WALL = 6


def sample_rooms(key: Array) -> Scene:
    """Returns random rooms, a start and a goal.

    The free space is connected by construction: every wall between two rooms has an opening, a window of 2.2 by 2.0 m
    at least, and a room is a box with nothing in it.

    Args:
        key: consumed.
    """
    shapes = _WALLS * _PIECES + 4
    plan, walls, shades, ends = _uniforms(key)
    height, stands = _lay_out(plan)

    # Walls across x come first, then walls across y: where each stands, and from where to where it runs.
    across = jnp.repeat(stands[:, 1:-1], ROOMS, axis=1).reshape(_WALLS)
    begin = jnp.tile(stands[::-1, :-1], (1, ROOMS - 1)).reshape(_WALLS)
    end = jnp.tile(stands[::-1, 1:], (1, ROOMS - 1)).reshape(_WALLS)
    opening = _openings(walls.reshape(_WALLS, _OF_A_WALL), begin, end, height)
    low, high, there = _pieces(opening, begin, end, height)
    middle = jnp.broadcast_to(across[:, None, None], low[..., :1].shape)
    low = jnp.concatenate([middle - THICKNESS / 2, low], axis=-1).reshape(-1, 3)
    high = jnp.concatenate([middle + THICKNESS / 2, high], axis=-1).reshape(-1, 3)
    turned = jnp.arange(_WALLS * _PIECES)[:, None] >= _WALLS * _PIECES // 2
    low, high = (jnp.where(turned, corner[:, jnp.array([1, 0, 2])], corner) for corner in (low, high))

    outer_low, outer_high = _outer_walls(height)
    low, high = jnp.concatenate([low, outer_low]), jnp.concatenate([high, outer_high])
    albedo = building.make_albedos(shades.reshape(_WALLS + 5, -1))
    of_walls = jnp.concatenate([jnp.repeat(albedo[:_WALLS], _PIECES, axis=0), albedo[_WALLS:-1]])
    present = jnp.concatenate([there.reshape(-1), jnp.ones(4, bool)])
    return building.build_scene(
        (SIDE, SIDE, height),
        ends.reshape(2, TRIES, 3),
        building.floor_and_ceiling(height, albedo[-1]),
        building.make_boxes(present, (low + high) / 2, (high - low) / 2, jnp.zeros(shapes), of_walls),
    )


def lay_out(key: Array) -> tuple[Array, Array]:
    """Returns how high the rooms of `sample_rooms` of this key are, and where their walls stand.

    Returns:
        height: [] metres. stands: [2, ROOMS + 1] metres along x and along y, outer walls included.
    """
    return _lay_out(_uniforms(key)[0])


def _uniforms(key: Array) -> list[Array]:
    """Returns the draws of a world: of its plan, walls, colours, start and goal."""
    lines, colours = 2 * (ROOMS - 1), (_WALLS + 5) * building.COLOUR_DRAWS
    return uniform_parts(key, (1 + lines, _WALLS * _OF_A_WALL, colours, 2 * TRIES * 3))


def _lay_out(uniforms: Array) -> tuple[Array, Array]:
    """Returns what `lay_out` does, from the draws of a plan."""
    even = SIDE / ROOMS * jnp.arange(1, ROOMS)[None]
    stands = even + SHIFT * (2.0 * uniforms[1:].reshape(2, ROOMS - 1) - 1.0)
    stands = jnp.concatenate([jnp.zeros((2, 1)), stands, jnp.full((2, 1), SIDE)], axis=1)
    return building.scale_uniforms(HEIGHT, uniforms[0]), stands


def _openings(uniforms: Array, begin: Array, end: Array, height: Array) -> Array:
    """Returns the openings of N walls [N, 4], metres: from, to along the wall, and from, to in height.

    A wall that is left out is all opening.
    """
    width = building.scale_uniforms(OPENING_WIDTH, uniforms[:, 0])
    room = end - begin - width - 2 * _PIER
    left = begin + _PIER + room * uniforms[:, 1]
    is_window, is_missing = uniforms[:, 2] < WINDOWS, uniforms[:, 3] < MISSING
    tall = jnp.where(
        is_window,
        building.scale_uniforms(WINDOW_HEIGHT, uniforms[:, 4]),
        building.scale_uniforms(DOOR_HEIGHT, uniforms[:, 4]),
    )
    tall = jnp.minimum(tall, height - 2 * SILL_M)
    bottom = jnp.where(is_window, SILL_M + (height - 2 * SILL_M - tall) * uniforms[:, 5], 0.0)
    openings = jnp.stack([left, left + width, bottom, bottom + tall], axis=1)
    whole = jnp.stack([begin, end, jnp.zeros_like(begin), jnp.broadcast_to(height, begin.shape)], axis=1)
    return jnp.where(is_missing[:, None], whole, openings)


def _pieces(opening: Array, begin: Array, end: Array, height: Array) -> tuple[Array, Array, Array]:
    """Returns the pieces of N walls around their openings: corners along wall and height, and whether there is one.

    Returns:
        low, high: [N, 4, 2] metres. there: [N, 4] bool.
    """
    left, right, bottom, top = (opening[:, i] for i in range(4))
    none, full = jnp.zeros_like(begin), jnp.broadcast_to(height, begin.shape)
    low = jnp.stack([begin, none, right, none, left, none, left, top], axis=1).reshape(-1, _PIECES, 2)
    high = jnp.stack([left, full, end, full, right, bottom, right, full], axis=1).reshape(-1, _PIECES, 2)
    return low, high, jnp.all(high - low > 0.0, axis=-1)


def _outer_walls(height: Array) -> tuple[Array, Array]:
    """Returns the corners [4, 3] of the walls just inside the faces of the volume."""
    inner = SIDE - THICKNESS
    low = jnp.array([[0.0, 0.0, 0.0], [inner, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, inner, 0.0]])
    high = jnp.array([[THICKNESS, SIDE, 0.0], [SIDE, SIDE, 0.0], [SIDE, THICKNESS, 0.0], [SIDE, SIDE, 0.0]])
    return low, high.at[:, 2].set(height)
