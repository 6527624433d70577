"""The occupancy grid in NumPy and float64: each ray is walked in small steps, one after the other."""

from __future__ import annotations

import math

import numpy as np

from edqn_jax.config import CameraConfig
from rivals.mapping.grid import MapConfig

STEP = 0.01
"""Cells between two steps. A cell of which a ray only clips a corner can lie between them."""


def ray_directions(camera: CameraConfig, rotation: np.ndarray) -> np.ndarray:
    """Returns the unit direction [H, W, 3] of each pixel's middle ray; a camera of mount `body`."""
    directions = np.empty((camera.height, camera.width, 3))
    half = math.tan(math.radians(camera.horizontal_fov_deg) / 2)
    pixel = 2 * half / camera.width
    for row in range(camera.height):
        for column in range(camera.width):
            left = -pixel * (column + 0.5 - camera.width / 2)
            up = -pixel * (row + 0.5 - camera.height / 2)
            ray = rotation @ np.array([1.0, left, up])
            directions[row, column] = ray / np.linalg.norm(ray)
    return directions


def update(
    config: MapConfig,
    log_odds: np.ndarray,
    corner: np.ndarray,
    depth: np.ndarray,
    position: np.ndarray,
    directions: np.ndarray,
) -> np.ndarray:
    """Returns the log-odds [X, Y, Z] after an image; `depth` [H, W] and the others in metres, directions [H, W, 3]."""
    passed, ended = set(), set()
    start = (position - corner) / config.cell_m
    for metres, direction in zip(depth.ravel(), directions.reshape(-1, 3), strict=True):
        length = min(metres, config.range_m) / config.cell_m
        for along in np.arange(0.0, config.free_share * length, STEP):
            passed.add(tuple(np.floor(start + along * direction).astype(int)))
        if metres < config.range_m:
            ended.add(tuple(np.floor(start + length * direction).astype(int)))
    after = log_odds.astype(np.float64)
    for cell in np.ndindex(log_odds.shape):
        if cell in ended:
            after[cell] = min(max(after[cell] + config.hit, config.least), config.most)
        elif cell in passed:
            after[cell] = min(max(after[cell] + config.miss, config.least), config.most)
    return after


def longest_chord(cell: tuple[int, ...], start: np.ndarray, directions: np.ndarray, lengths: np.ndarray) -> float:
    """Returns how far, in cells, the ray that goes furthest through a cell does so.

    Args:
        cell: its index.
        start: [3] of all rays, in cells.
        directions: [N, 3] unit vectors.
        lengths: [N] of the rays, in cells.
    """
    faces = np.stack([np.array(cell) - start, np.array(cell) + 1 - start])[:, None] / directions  # [2, N, 3]
    enter = np.maximum(faces.min(axis=0).max(axis=1), 0.0)
    leave = np.minimum(faces.max(axis=0).min(axis=1), lengths)
    return float(np.max(leave - enter, initial=0.0))
