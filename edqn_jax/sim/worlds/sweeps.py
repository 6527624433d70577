"""Lengths of shortest ways over a lattice of free balls, by sweeps: for the reward `geodesic` and for SPL.

Each node has a ball, with the radius of its clearance, in which nothing is. A way leads straight from node to node
where their two balls overlap.
"""

from __future__ import annotations

import itertools
import math

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

_CHANGE_M = 1e-3  # of no node in a round: no way is shortened any more


def steps_aside(reach: int) -> np.ndarray:
    """Returns how far aside a way can come from in the plane before, [S, 2] nodes, at most `reach` along each axis."""
    return np.array([*itertools.product(range(-reach, reach + 1), repeat=2)])


def spread(seeds: Array, balls: Array, lengths: Array, room: Array | float = 0.0) -> Array:
    """Returns the lengths [X, Y, Z] of the shortest ways to the seeds, from the seeds' own lengths [X, Y, Z].

    Sweeps plane by plane along each axis, there and back, until nothing becomes shorter: a way with few bends takes few
    rounds, however long it is.

    Args:
        seeds: metres, inf where there is none.
        balls: [X, Y, Z] metres, radii of the balls, -inf where a node is not free.
        lengths: [3, S] metres, of the steps from one plane to the next along each axis, in the order of
            `steps_aside`, which are along the other two axes.
        room: metres by which the balls of two joined nodes overlap at least.
    """

    def round_of_sweeps(state: tuple[Array, Array]) -> tuple[Array, Array]:
        before, _ = state
        after = before
        for axis in range(3):
            planes, around = jnp.moveaxis(after, axis, 0), jnp.moveaxis(balls, axis, 0)
            after = jnp.moveaxis(_there_and_back(planes, around, lengths[axis], room), 0, axis)
        # inf - inf is NaN, and no change.
        return after, jnp.any(before - after > _CHANGE_M)

    return lax.while_loop(lambda state: state[1], round_of_sweeps, (seeds, jnp.array(True)))[0]


def _there_and_back(planes: Array, around: Array, lengths: Array, room: Array | float) -> Array:
    """Returns lengths [N, A, B], swept from the first plane to the last and back; in a loop, to compile it once."""

    def sweep(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        planes, around = state
        return jnp.flip(_swept(planes, around, lengths, room), axis=0), jnp.flip(around, axis=0)

    return lax.fori_loop(0, 2, sweep, (planes, around))[0]


def _swept(planes: Array, around: Array, lengths: Array, room: Array | float) -> Array:
    """Returns lengths [N, A, B], each plane shortened by ways over the one before it; `around` are the balls."""
    reach = (math.isqrt(lengths.shape[0]) - 1) // 2

    def plane(before: tuple[Array, Array], here: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        (way, ball), (own, own_ball) = before, here
        neighbours = _neighbours(way, jnp.inf, reach), _neighbours(ball, -jnp.inf, reach)
        # One by one: an array of all of them would be written to memory and read again.
        for other_way, other_ball, step in zip(*neighbours, lengths, strict=True):
            own = jnp.minimum(own, jnp.where(other_ball + own_ball >= step + room, other_way + step, jnp.inf))
        return (own, own_ball), own

    nothing = jnp.full_like(planes[0], jnp.inf), jnp.full_like(around[0], -jnp.inf)
    return lax.scan(plane, nothing, (planes, around))[1]


def _neighbours(plane: Array, fill: float, reach: int) -> list[Array]:
    """Returns a plane [A, B] as seen from each of its neighbours, S of [A, B] in the order of `steps_aside`."""
    padded = jnp.pad(plane, reach, constant_values=fill)
    a, b = plane.shape
    return [padded[reach + i : reach + i + a, reach + j : reach + j + b] for i, j in steps_aside(reach)]
