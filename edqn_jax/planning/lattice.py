"""The lattice of a flight volume: which of its cells a drone fits in, and between which it passes straight.

Cells are cubes, one of them around a given point. A cell is free if a sphere of the body's radius fits around its
middle, and two of the 26 neighbours are joined if the sphere passes straight between them.
"""

from __future__ import annotations

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.errors import ConfigError
from edqn_jax.kept_programs import kept_jit
from edqn_jax.planning.path import point_text
from edqn_jax.sim.scene.distance import segment_contact, signed_distance
from edqn_jax.sim.scene.scene import Scene

STEPS = np.array([step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)])
"""From a cell to its neighbours, [26, 3] cells."""

MAX_CELLS = 40_000_000
"""Cells of the largest lattice: ten times those of the paper's world in cells of 0.5 m, and more."""

CELL_M, FINE_M = 0.5, 0.25
"""Edge of the cells, and of finer ones, which the middle of any door passes that is 0.25 m wider than the drone."""

_MOST_FINE = 4_000_000  # cells that a second search may take

STRIDE_M = 0.02
"""Shortest step of a check along a leg; undetected penetration of at most 0.01^2 / 2 r = 0.14 mm."""

_LANES = (64, 4096, 32768)  # batches are padded to one of these, to compile few programs


def is_small(scene: Scene, cell: float) -> bool:
    """Returns whether a volume has so few cells of this edge, metres, that it can be searched once more."""
    lower, upper = np.asarray(scene.volume, np.float64)
    return bool(np.prod((upper - lower) / cell + 1.0) <= _MOST_FINE)


def lattice_shape(scene: Scene, start: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the index [3] of the cell around `start` [3], and the number of cells along each axis [3].

    Args:
        cell: edge of the cells, metres.

    Raises:
        ConfigError: if the volume has too many cells.
    """
    lower, upper = np.asarray(scene.volume, np.float64)
    # Rounded up a little: float32 may put a point on the boundary just outside the volume.
    origin = np.floor((start - lower) / cell + 1e-5).astype(np.int64)
    shape = origin + np.floor((upper - start) / cell + 1e-5).astype(np.int64) + 1
    size = math.prod(map(int, np.maximum(shape, 1)))
    if size > MAX_CELLS:
        sides = " x ".join(f"{side:g}" for side in upper - lower)
        raise ConfigError(
            f"the flight volume of {sides} m has {size / 1e6:,.0f} million cells of {cell:g} m, and a way is "
            f"searched in at most {MAX_CELLS / 1e6:,.0f} million; give a smaller site 'volume'"
        )
    return origin, shape


class NoPathError(ConfigError):
    """There is no path from start to goal; the message says why."""


class Lattice:
    """Cells of the volume by flat index, with the distances computed so far."""

    def __init__(self, scene: Scene, start: np.ndarray, radius: float, cell: float):
        """Prepares a lattice with a cell around `start` [3]; radius of the sphere and edge of the cells in metres.

        Raises:
            ConfigError: if the volume has too many cells.
        """
        self.scene, self.radius, self.cell, self.start = scene, radius, cell, start
        self.lower, self.upper = np.asarray(scene.volume, np.float64)
        self.origin, self.shape = lattice_shape(scene, start, cell)
        self.distance = np.full(int(np.prod(np.maximum(self.shape, 1))), np.nan, np.float32)

    def flat(self, index: np.ndarray) -> np.ndarray:
        """Returns the flat index [...] of cells [..., 3]."""
        return (index[..., 0] * self.shape[1] + index[..., 1]) * self.shape[2] + index[..., 2]

    def index(self, flat: np.ndarray) -> np.ndarray:
        """Returns the cells [..., 3] of flat indices [...]."""
        return np.stack(np.unravel_index(flat, tuple(self.shape)), axis=-1)

    def middle(self, flat: np.ndarray) -> np.ndarray:
        """Returns the middles [..., 3] metres of the cells of flat indices [...]."""
        return self.start + self.cell * (self.index(flat) - self.origin)

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Returns the signed distances [E] metres of points [E, 3]."""
        return clearances(self.scene, points)

    def compute_all_distances(self) -> None:
        """Computes the distances of all cells."""
        self.distance[:] = self.distances(self.middle(np.arange(self.distance.size)))

    def compute_distances(self, cells: np.ndarray) -> None:
        """Computes the distances, metres, of those of the cells [E], by flat index, that are not known yet."""
        unknown = np.unique(cells[np.isnan(self.distance[cells])])
        if unknown.size:
            self.distance[unknown] = self.distances(self.middle(unknown))

    def passable(self, origins: np.ndarray, cells: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Returns [E] bool: the sphere fits at `cells` [E] and passes from `origins` [E], `lengths` [E] metres off."""
        self.compute_distances(cells)
        passable = self.distance[cells] >= self.radius
        # The distance changes by at most one metre per metre, which proves most edges free.
        slack = self.distance[origins] + self.distance[cells] - lengths - 2 * self.radius
        narrow = np.flatnonzero(passable & (slack < 0))
        if narrow.size:
            ends = np.concatenate([self.middle(origins[narrow]), self.middle(cells[narrow])], axis=1)
            passable[narrow] = ~_batched(_touches, self.scene, ends, self.radius + edge_margin(self.cell, self.radius))
        return passable

    def cell_near(self, point: np.ndarray) -> int:
        """Returns the nearest cell from which the sphere passes straight to the point [3] metres.

        Raises:
            NoPathError: if there is none.
        """
        base = np.floor((point - self.start) / self.cell + 1e-5).astype(np.int64) + self.origin
        corners = base + np.array(list(itertools.product((0, 1), repeat=3)))
        corners = corners[np.all((corners >= 0) & (corners < self.shape), axis=1)]
        middles = self.start + self.cell * (corners - self.origin)
        for i in np.argsort(np.linalg.norm(middles - point, axis=1), kind="stable"):
            if not leg_touches(self.scene, middles[i], point, self.radius):
                return int(self.flat(corners[i]))
        raise NoPathError(f"there is no path: the goal {point_text(point)} is enclosed within {self.cell:g} m")


def clearances(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Returns the signed distances [E] metres from points [E, 3], metres, to the nearest surface of a scene."""
    return _batched(_signed_distances, scene, points)


def edge_margin(cell: float, radius: float) -> float:
    """Returns the metres by which a sphere can penetrate between two samples of an edge at most, (h / 2)^2 / 2 r.

    Edges are checked with a radius that is larger by this margin. `segment_contact` takes 8 samples, so h is a seventh
    of the longest edge, sqrt(3) cells.
    """
    return (math.sqrt(3) * cell / 14) ** 2 / (2 * radius)


def leg_touches(scene: Scene, start: np.ndarray, end: np.ndarray, radius: float) -> bool:
    """Returns whether a sphere touches anything on the straight leg from `start` [3] to `end` [3], metres."""
    return bool(_touches_on_leg(scene, np.float32(start), np.float32(end), np.float32(radius)))


def touches_on_leg(scene: Scene, start: Array, end: Array, radius: Array, stride: float = STRIDE_M) -> Array:
    """Returns whether the sphere touches anything on a straight leg of any length, in steps of the clearance.

    Args:
        scene: one world.
        start: [3] metres.
        end: [3] metres.
        radius: [] metres.
        stride: metres, of the shortest step.
    """
    length = jnp.sqrt(jnp.sum((end - start) ** 2))
    direction = (end - start) / jnp.maximum(length, 1e-9)

    def gap(along: Array) -> Array:
        return signed_distance(scene, start + along * direction) - radius

    def walk(state: tuple[Array, Array]) -> tuple[Array, Array]:
        along, free = state
        along = jnp.minimum(along + jnp.maximum(free, stride), length)
        return along, gap(along)

    # From a stride before the start: the distance is written once in the program, which is then compiled sooner.
    before = jnp.asarray(-stride, jnp.float32), jnp.zeros(())
    _, free = jax.lax.while_loop(lambda s: (s[0] < length) & (s[1] >= 0), walk, before)
    return free < 0


_touches_on_leg = kept_jit()(touches_on_leg)


@kept_jit()
def _signed_distances(scene: Scene, points: Array) -> Array:
    return jax.vmap(lambda point: signed_distance(scene, point))(points)


@kept_jit()
def _touches(scene: Scene, ends: Array, radius: Array) -> Array:
    return jax.vmap(lambda pair: segment_contact(scene, pair[:3], pair[3:], radius)[0])(ends)


def _batched(function, scene: Scene, rows: np.ndarray, *rest: float) -> np.ndarray:
    """Returns `function(scene, rows, *rest)`, computed in batches of a few fixed sizes."""
    parts, done = [], 0
    while done < len(rows):
        part = rows[done : done + _LANES[-1]]
        lanes = next(lanes for lanes in _LANES if lanes >= len(part))
        padded = np.zeros((lanes, rows.shape[1]), np.float32)
        padded[: len(part)] = part
        parts.append(np.asarray(function(scene, padded, *map(np.float32, rest)))[: len(part)])
        done += len(part)
    return np.concatenate(parts)
