"""Textbook shortest path on a small 26-connected lattice: every cell, every edge, one heap."""

from __future__ import annotations

import heapq
import itertools
import math

import jax
import numpy as np

from edqn_jax.planning.lattice import edge_margin
from edqn_jax.sim.scene.distance import segment_contact, signed_distance
from edqn_jax.sim.scene.scene import Scene


def shortest_length(
    scene: Scene, start: tuple[int, int, int], goal: tuple[int, int, int], radius: float, cell: float
) -> float:
    """Length in metres between two cells; cell (i, j, k) has its middle at `volume[0] + cell * (i, j, k)`."""
    lower, upper = np.asarray(scene.volume)
    shape = tuple(int(n) for n in np.round((upper - lower) / cell) + 1)
    cells = list(itertools.product(*map(range, shape)))
    steps = [step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)]
    edges = []
    for a in cells:
        for step in steps:
            b = tuple(i + s for i, s in zip(a, step, strict=True))
            if all(0 <= n < m for n, m in zip(b, shape, strict=True)):
                edges.append((a, b))
    middle = lower + cell * np.array(cells, np.float32)
    fits = _distances(scene, middle) >= radius
    free = dict(zip(cells, np.asarray(fits), strict=True))
    ends = lower + cell * np.array(edges, np.float32)
    # An edge is sampled, and keeps off by what the sphere can sink in unnoticed between two samples.
    touch = _touches(scene, ends, radius + edge_margin(cell, radius))
    neighbours = {a: [] for a in cells}
    for (a, b), touches in zip(edges, np.asarray(touch), strict=True):
        if free[a] and free[b] and not touches:
            neighbours[a].append((b, cell * math.dist(a, b)))

    best, heap = {start: 0.0}, [(0.0, start)]
    while heap:
        length, a = heapq.heappop(heap)
        if a == goal:
            return length
        if length > best[a]:
            continue
        for b, step in neighbours[a]:
            if length + step < best.get(b, math.inf):
                best[b] = length + step
                heapq.heappush(heap, (best[b], b))
    return math.inf


@jax.jit
def _distances(scene, points):
    return jax.vmap(lambda point: signed_distance(scene, point))(points)


@jax.jit
def _touches(scene, ends, radius):
    return jax.vmap(lambda pair: segment_contact(scene, pair[0], pair[1], radius)[0])(ends)
