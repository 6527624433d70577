"""Ways on nodes of `sim.worlds.geodesic`, by a library's Dijkstra over every pair of neighbours whose balls meet."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra


def remaining(is_free: np.ndarray, clearance: np.ndarray, seeds: np.ndarray, edge: float) -> np.ndarray:
    """Returns the lengths of the shortest ways from nodes [X, Y, Z] to the seeds, whose own lengths are finite."""
    shape = is_free.shape
    number = np.arange(is_free.size).reshape(shape)
    begins, ends, lengths = [], [], []
    for step in itertools.product((-1, 0, 1), repeat=3):
        if not any(step):
            continue
        length = edge * np.linalg.norm(step)
        for here in itertools.product(*map(range, shape)):
            there = tuple(np.add(here, step))
            if all(0 <= i < n for i, n in zip(there, shape, strict=True)) and is_free[here] and is_free[there]:
                if clearance[here] + clearance[there] >= length:
                    begins.append(number[here])
                    ends.append(number[there])
                    lengths.append(length)
    # One more node, the goal, from which the ways to the seeds begin.
    for at in np.argwhere(np.isfinite(seeds)):
        begins.append(is_free.size)
        ends.append(number[tuple(at)])
        lengths.append(max(seeds[tuple(at)], 1e-9))
    graph = coo_array((lengths, (begins, ends)), (is_free.size + 1, is_free.size + 1)).tocsr()
    return dijkstra(graph, indices=is_free.size)[:-1].reshape(shape)
