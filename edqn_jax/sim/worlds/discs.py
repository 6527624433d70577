"""Discs on the floor that keep apart: where the shapes of a random world stand, seen from above."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.sim.scene.scene import PARKED

PLACES = 64
"""Candidate positions for each disc."""


def place_discs(reach: Array, candidates: Array, gap: float) -> tuple[Array, Array, Array]:
    """Returns positions for discs that are `gap` apart, chosen one after the other.

    Args:
        reach: [N] radii, metres.
        candidates: [N, K, 2] metres, positions that each may have; the first that is free is chosen.
        gap: metres between any two.

    Returns:
        x, y: [N] metres. placed: [N] bool; a disc for which no candidate was free is not, and is `PARKED`.
    """
    count = reach.shape[0]

    def choose(discs: tuple[Array, Array, Array], item: tuple[Array, Array, Array]):
        x, y, taken = discs
        number, radius, places = item
        apart = jnp.hypot(places[:, 0, None] - x[None], places[:, 1, None] - y[None])
        free = jnp.all(apart >= radius + taken[None] + gap, axis=1)
        chosen = places[jnp.argmax(free)]
        found = jnp.any(free)
        x = x.at[number].set(jnp.where(found, chosen[0], PARKED))
        y = y.at[number].set(jnp.where(found, chosen[1], PARKED))
        return (x, y, taken.at[number].set(radius)), found

    parked = jnp.full(count, PARKED)
    discs = jnp.arange(count), reach, candidates
    (x, y, _), placed = jax.lax.scan(choose, (parked, parked, jnp.zeros(count)), discs)
    return x, y, placed


def candidates_inside(reach: Array, uniforms: Array, size: tuple[float, float], margin: float) -> Array:
    """Returns candidates [N, K, 2] for discs that end `margin` metres inside a floor, from uniform draws [N, K, 2]."""
    lower = jnp.broadcast_to(margin + reach[:, None, None], (reach.shape[0], 1, 2))
    upper = jnp.array(size)[None, None] - lower
    return lower + uniforms * (upper - lower)


def across_the_edge(reach: Array, uniforms: Array, size: tuple[float, float], room: float) -> Array:
    """Returns candidates [N, K, 2] for discs with their middles on a floor, from uniform draws [N, K, 2].

    A disc may reach over one side of the floor, so that nobody can fly along its edge, but it stays `room` metres from
    at least one side of each corner: no corner is cut off.
    """
    sides = jnp.array(size)[None, None]
    places = uniforms * sides
    least = reach[:, None, None] + room
    in_a_corner = jnp.all(jnp.minimum(places, sides - places) < least, axis=2, keepdims=True)
    # Moved out of the corner along y.
    along = least[..., 0] + uniforms[..., 1] * (sides[..., 1] - 2.0 * least[..., 0])
    moved = jnp.stack([places[..., 0], along], axis=2)
    return jnp.where(in_a_corner, moved, places)
