"""An occupancy grid of the flight volume that grows with each depth image: a pure function of depth and own pose.

Each cell holds the log-odds of being occupied, 0 where nothing was seen (Moravec and Elfes, ICRA 1985). With an image
the log-odds of cells in which a ray ends grow, and those of cells that rays only pass fall (the inverse sensor model of
Thrun, Burgard and Fox, *Probabilistic Robotics*, 2005, chapter 9), both within limits, so that a cell can change its
mind (Hornung et al., OctoMap, *Autonomous Robots* 34, 2013). As in OctoMap a cell changes once per image, and an end
takes precedence over passing rays.

A ray enters a new cell wherever it crosses a plane between cells, so the cells of all rays are known in closed form
from the crossings with the planes of each axis; they need not be walked one after the other (the cells are those of
Amanatides and Woo, Eurographics 1987). Only the part of the grid within reach is touched.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from edqn_jax.config import CameraConfig
from edqn_jax.errors import ConfigError
from edqn_jax.sim.camera import raycast
from edqn_jax.sim.scene.shapes.kind import TINY, safe_inverse

MOST_CELLS = 40_000_000
"""Cells of the largest grid, as of the planners' largest lattice."""


@dataclasses.dataclass(frozen=True)
class MapConfig:
    """The grid and its sensor model. Log-odds and their limits default to OctoMap's."""

    cell_m: float = 0.5
    """Edge of the cells, metres."""
    range_m: float = 12.0
    """Longest ray, metres: what ends further away only frees cells up to here."""
    hit: float = 0.85
    """Log-odds that a cell gains in which a ray ends."""
    miss: float = -0.4
    """Log-odds that a cell gains through which rays pass, below 0."""
    least: float = -2.0
    """Smallest log-odds of a cell."""
    most: float = 3.5
    """Largest log-odds of a cell."""
    free_share: float = 1.0
    """Share of a ray, from the camera on, along which it frees cells; below 1 where depth is uncertain."""

    def __post_init__(self) -> None:
        """Checks the limits.

        Raises:
            ConfigError: names the first option that is out of its limits.
        """
        _require(0 < self.cell_m < math.inf, "cell_m", "more than 0", self.cell_m)
        _require(self.cell_m <= self.range_m < math.inf, "range_m", f"at least cell_m ({self.cell_m:g})", self.range_m)
        _require(0 < self.hit < math.inf, "hit", "more than 0", self.hit)
        _require(-math.inf < self.miss < 0, "miss", "less than 0", self.miss)
        _require(-math.inf < self.least < 0, "least", "less than 0", self.least)
        _require(0 < self.most < math.inf, "most", "more than 0", self.most)
        _require(0 < self.free_share <= 1, "free_share", "more than 0 and at most 1", self.free_share)


def _require(holds: bool, name: str, limits: str, value: float) -> None:
    if not holds:
        raise ConfigError(f"{name} of a map must be {limits}, not {value:g}")


@struct.dataclass
class Grid:
    """What is known of the flight volume."""

    log_odds: Array  # [X, Y, Z] of being occupied; 0 is unknown
    corner: Array  # [3] metres, the lower corner of cell (0, 0, 0)


def grid_shape(config: MapConfig, volume: np.ndarray | Array) -> tuple[int, int, int]:
    """Returns the number of cells along each axis that hold volumes [..., 2, 3], metres; static.

    Raises:
        ConfigError: if there are too many.
    """
    sides = np.asarray(volume, np.float64)
    longest = (sides[..., 1, :] - sides[..., 0, :]).reshape(-1, 3).max(axis=0)
    x, y, z = (max(1, math.ceil(side / config.cell_m - 1e-5)) for side in longest)
    if x * y * z > MOST_CELLS:
        raise ConfigError(
            f"a map of {' x '.join(f'{side:g}' for side in longest)} m has {x * y * z / 1e6:,.0f} million cells of "
            f"{config.cell_m:g} m, at most {MOST_CELLS / 1e6:,.0f} million are possible; give larger cells"
        )
    return x, y, z


def empty_grid(shape: tuple[int, int, int], volume: Array) -> Grid:
    """Returns the grid of `shape` cells of a volume [2, 3], metres, of which nothing is known."""
    return Grid(log_odds=jnp.zeros(shape), corner=jnp.asarray(volume)[0])


def update(
    config: MapConfig,
    camera: CameraConfig,
    grid: Grid,
    depth: Array,
    position: Array,
    rotation: Array,
    counts: ArrayLike = True,
) -> Grid:
    """Returns the grid with one more depth image.

    Args:
        config, camera: static.
        grid: so far.
        depth: [H, W] metres along each pixel's middle ray, inf where it meets nothing.
        position: [3] of the camera, metres.
        rotation: [3, 3] of the camera, body-to-world, see `sensor.mount_rotation`.
        counts: [] bool, whether the image tells anything; the grid stays as it is if not.
    """
    size = tuple(min(n, 2 * math.ceil(config.range_m / config.cell_m) + 2) for n in grid.log_odds.shape)
    start = (position - grid.corner) / config.cell_m
    first = jnp.floor(start).astype(jnp.int32) - jnp.asarray([side // 2 for side in size])
    first = jnp.clip(first, 0, jnp.asarray(grid.log_odds.shape) - jnp.asarray(size))
    part = jax.lax.dynamic_slice(grid.log_odds, first, size)
    rays = raycast.camera_rays(camera, rotation)
    passed, ended = _find_free_cells(config, size, start - first, _directions(rays, depth.shape), depth.ravel())
    change = jnp.where(ended, config.hit, jnp.where(passed, config.miss, 0.0)) * counts
    part = jnp.clip(part + change, config.least, config.most)
    return dataclasses.replace(grid, log_odds=jax.lax.dynamic_update_slice(grid.log_odds, part, first))


def _directions(rays: raycast.Rays, shape: tuple[int, ...]) -> Array:
    """Returns the unit directions [H W, 3] of rays, of which components broadcast to [H, W]."""
    ray = jnp.stack([jnp.broadcast_to(each, shape).ravel() for each in (rays.dx, rays.dy, rays.dz)], axis=1)
    return ray / jnp.sqrt(jnp.sum(ray**2, axis=1, keepdims=True))


def _find_free_cells(
    config: MapConfig, size: tuple[int, ...], start: Array, direction: Array, depth: Array
) -> tuple[Array, Array]:
    """Returns which cells of a grid of `size` rays pass, their own first one included, and in which rays end.

    Args:
        config: of the map.
        size: X, Y, Z.
        start: [3] of the rays, in cells.
        direction: [N, 3] unit vectors.
        depth: [N] metres.

    Returns:
        [X, Y, Z] bool each.
    """
    meets = depth < config.range_m
    length = jnp.minimum(depth, config.range_m) / config.cell_m
    freed = config.free_share * length
    here = jnp.floor(start)
    cells = [jnp.broadcast_to(here, direction.shape)[:, None]]  # [N, K, 3] each
    entered = [jnp.zeros((direction.shape[0], 1))]  # [N, K] cells from the start, each
    planes = jnp.arange(math.ceil(config.range_m / config.cell_m) + 1)
    for axis in range(3):
        along = direction[:, axis]
        # The planes that bound the cells along this axis, in the order in which the ray crosses them.
        plane = jnp.where(along[:, None] > 0, here[axis] + 1 + planes, here[axis] - planes)
        at = jnp.where(jnp.abs(along[:, None]) > TINY, (plane - start[axis]) * safe_inverse(along)[:, None], jnp.inf)
        reached = jnp.where(jnp.isfinite(at), at, 0.0)[..., None] * direction[:, None] + start
        cell = jnp.floor(reached).at[..., axis].set(jnp.where(along[:, None] > 0, plane, plane - 1))
        cells.append(cell)
        entered.append(at)
    when = jnp.concatenate(entered, axis=1)
    passed = _mark_cells(size, jnp.concatenate(cells, axis=1), when < freed[:, None])
    end = jnp.floor(start + length[:, None] * direction)
    return passed, _mark_cells(size, end, meets)


def _mark_cells(size: tuple[int, ...], cells: Array, wanted: Array) -> Array:
    """Returns [X, Y, Z] bool: whether a cell is among those of `cells` [..., 3] that are `wanted` [...] and inside."""
    inside = jnp.all((cells >= 0) & (cells < jnp.asarray(size, cells.dtype)), axis=-1)
    index = jnp.clip(cells, 0, jnp.asarray(size, cells.dtype) - 1).astype(jnp.int32)
    flat = (index[..., 0] * size[1] + index[..., 1]) * size[2] + index[..., 2]
    count = math.prod(size)
    # One more cell takes what is not wanted.
    flat = jnp.where(wanted & inside, flat, count).ravel()
    return jnp.zeros(count + 1, bool).at[flat].set(True)[:count].reshape(size)
