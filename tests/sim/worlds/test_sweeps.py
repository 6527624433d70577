"""Sweeps over a lattice against a library's Dijkstra."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from edqn_jax.sim.worlds.sweeps import spread, steps_aside

SHAPE = (9, 7, 5)
EDGES = np.array([0.8, 1.0, 1.3])


def dijkstra_lengths(balls: np.ndarray, seed: tuple[int, ...], reach: int, room: float) -> np.ndarray:
    """Lengths [X, Y, Z] to one node over every pair whose balls overlap by `room`, at most `reach` along each axis."""
    steps = [step for step in itertools.product(range(-reach, reach + 1), repeat=3) if 1 in np.abs(step)]
    number = np.arange(balls.size).reshape(SHAPE)
    edges = {}
    for here in np.ndindex(SHAPE):
        for step in steps:
            there, length = tuple(np.add(here, step)), float(np.linalg.norm(EDGES * step))
            if (
                all(0 <= i < n for i, n in zip(there, SHAPE, strict=True))
                and balls[here] + balls[there] >= length + room
            ):
                edges[number[here], number[there]] = length
    begins, ends = np.array([*edges]).T
    graph = coo_array(([*edges.values()], (begins, ends)), (balls.size, balls.size)).tocsr()
    return dijkstra(graph, indices=number[seed]).reshape(SHAPE)


@pytest.mark.parametrize(("reach", "room"), [(1, 0.0), (2, 0.0), (2, 0.3)])
def test_lengths_are_those_that_dijkstra_finds(reach: int, room: float) -> None:
    rng = np.random.default_rng(reach)
    balls = rng.uniform(0.3, 2.0, SHAPE).astype(np.float32)
    balls[rng.uniform(size=SHAPE) < 0.3] = -np.inf
    seed = tuple(np.argwhere(np.isfinite(balls))[0])
    across = steps_aside(reach)
    lengths = np.array(
        [
            np.linalg.norm(np.insert(across * np.delete(EDGES, axis), axis, EDGES[axis], axis=1), axis=1)
            for axis in range(3)
        ]
    )
    seeds = jnp.full(SHAPE, jnp.inf).at[seed].set(0.0)
    found = np.asarray(jax.jit(spread)(seeds, balls, jnp.asarray(lengths), room))
    expected = dijkstra_lengths(balls, seed, reach, room)
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(expected))
    assert np.count_nonzero(np.isfinite(expected)) > 20
    # A round that shortens nothing by a millimetre is the last.
    np.testing.assert_allclose(found[np.isfinite(found)], expected[np.isfinite(found)], atol=2e-3)
