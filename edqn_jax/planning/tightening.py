"""Shortens paths as `astar.shorten_path` does, within a compiled program: arrays of fixed sizes, many legs at once."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax

from edqn_jax.planning.lattice import touches_on_leg
from edqn_jax.sim.scene.scene import Scene

CORNERS = 64
"""Points of a shortened path at most."""

_STRIDE_M = 0.05  # longer than that of a check, and the sphere is larger by what such strides can miss
_HALVINGS = 7  # of a leg that is cut: to 1 %
_GAIN_M = 0.01  # of a round that is worth another one


def tighten(scene: Scene, points: Array, count: Array, radius: Array) -> tuple[Array, Array, Array]:
    """Shortens a path by line of sight and by cutting corners until a round gains less than 1 cm.

    Args:
        scene: one world.
        points: [K, 3] metres, of which the first `count` [] are the path.
        radius: [] metres, of the sphere.

    Returns:
        points: [CORNERS, 3] metres. count: [] of them; `CORNERS` where there were more. length: [] metres.
    """
    # Between two samples a stride apart the sphere can penetrate by (stride / 2)^2 / 2 r.
    radius = radius + (_STRIDE_M / 2) ** 2 / (2 * radius)

    def again(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        points, count, length, _ = state
        cut, many = _cut_corners(scene, points, count, radius)
        tighter, fewer = _skip_ahead(scene, cut, jnp.minimum(many, CORNERS), radius)
        shorter = path_length(tighter, fewer)
        gains = (shorter <= length - _GAIN_M) & (many <= CORNERS)
        return (
            jnp.where(gains, tighter, points),
            jnp.where(gains, fewer, count),
            jnp.where(gains, shorter, length),
            gains,
        )

    points, count = _skip_ahead(scene, points, count, radius)
    first = points, count, path_length(points, count), count > 2
    return lax.while_loop(lambda state: state[3], again, first)[:3]


def path_length(points: Array, count: Array) -> Array:
    """Returns the length [] of the first `count` points [K, 3], metres."""
    legs = jnp.sqrt(jnp.sum((points[1:] - points[:-1]) ** 2, axis=1))
    return jnp.sum(jnp.where(jnp.arange(1, points.shape[0]) < count, legs, 0.0))


def _touches(scene: Scene, starts: Array, ends: Array, radius: Array) -> Array:
    """Returns [N] whether a sphere touches anything from each of `starts` [N, 3] to each of `ends` [N, 3]."""
    return jax.vmap(lambda start, end: touches_on_leg(scene, start, end, radius, _STRIDE_M))(starts, ends)


def _skip_ahead(scene: Scene, points: Array, count: Array, radius: Array) -> tuple[Array, Array]:
    """Keeps, after each kept point, only the furthest later point to which the straight line is free."""
    number = jnp.arange(points.shape[0])

    def skip(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        here, kept, many = state
        later = (number > here + 1) & (number < count)
        starts = jnp.broadcast_to(points[here], points.shape)
        ends = jnp.where(later[:, None], points, starts)  # no leg costs no steps
        free = later & ~_touches(scene, starts, ends, radius)
        there = jnp.maximum(jnp.max(jnp.where(free, number, 0)), here + 1)
        return there, kept.at[many].set(points[there]), many + 1

    kept = jnp.zeros((CORNERS, 3)).at[0].set(points[0])
    first = jnp.zeros((), number.dtype), kept, jnp.ones((), number.dtype)
    _, kept, many = lax.while_loop(lambda state: (state[0] < count - 1) & (state[2] < CORNERS), skip, first)
    return kept, many


def _cut_corners(scene: Scene, points: Array, count: Array, radius: Array) -> tuple[Array, Array]:
    """Cuts off each corner as far up its two legs, at most half of each, as the short cut stays free.

    Returns:
        points: [CORNERS, 3]. count: [] of them, more than `CORNERS` where some are left out.
    """
    number = jnp.arange(CORNERS)
    is_corner = (number > 0) & (number < count - 1)
    before, after = (jnp.where(is_corner[:, None], jnp.roll(points, by, axis=0) - points, 0.0) for by in (1, -1))

    def ends(share: Array) -> tuple[Array, Array]:
        return points + share[:, None] / 2 * before, points + share[:, None] / 2 * after

    def halve(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        free, blocked = state
        share = (free + blocked) / 2
        touches = _touches(scene, *ends(share), radius)
        return jnp.where(touches, free, share), jnp.where(touches, share, blocked)

    free, _ = lax.fori_loop(0, _HALVINGS, halve, (jnp.zeros(CORNERS), jnp.ones(CORNERS)))
    is_cut = is_corner & (free > 0.0)
    first, second = ends(free)
    places = jnp.where(number < count, 1 + is_cut, 0)
    at = jnp.cumsum(places) - places
    cut = jnp.zeros((CORNERS, 3))
    cut = cut.at[jnp.where(number < count, at, CORNERS)].set(first)  # an uncut corner is its own first point
    cut = cut.at[jnp.where(is_cut, at + 1, CORNERS)].set(second)
    return cut, jnp.sum(places)
