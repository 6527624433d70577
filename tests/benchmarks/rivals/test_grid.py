"""The map that grows: which cells a depth image frees and fills, what stays unknown, and its limits."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edqn_jax.config import CameraConfig
from edqn_jax.errors import ConfigError
from rivals.mapping.grid import Grid, MapConfig, empty_grid, grid_shape, update
from tests.oracles import grid_plain

CAMERA = CameraConfig(width=5, height=4, mount="body")
CONFIG = MapConfig(range_m=4.0)
VOLUME = np.array([[-1.0, 2.0, 0.0], [7.0, 8.0, 4.0]])  # smaller along z than the reach, larger along x
AHEAD = np.eye(3)

grow = jax.jit(update, static_argnums=(0, 1))


def empty(config: MapConfig = CONFIG) -> Grid:
    return empty_grid(grid_shape(config, VOLUME), jnp.asarray(VOLUME, jnp.float32))


def any_rotation(random: np.random.Generator) -> np.ndarray:
    """A rotation [3, 3] in single precision."""
    rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return (rotation * np.sign(np.linalg.det(rotation))).astype(np.float32)


def cell_at(point: tuple[float, float, float]) -> tuple[int, ...]:
    return tuple(np.floor((np.array(point) - VOLUME[0]) / CONFIG.cell_m).astype(int))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([1.0, 0.8]))
def test_the_cells_are_those_of_rays_walked_in_small_steps(seed: int, share: float) -> None:
    random = np.random.default_rng(seed)
    config = dataclasses.replace(CONFIG, free_share=share)
    # Single precision throughout, so that both begin with the same numbers.
    rotation = any_rotation(random)
    position = random.uniform(VOLUME[0] + 0.1, VOLUME[1] - 0.1).astype(np.float32)
    depth = random.uniform(0.2, 6.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth[random.random(depth.shape) < 0.2] = np.inf
    before = random.uniform(config.least, config.most, empty().log_odds.shape).astype(np.float32)
    grid = dataclasses.replace(empty(), log_odds=jnp.asarray(before))
    found = np.asarray(grow(config, CAMERA, grid, depth, position, rotation).log_odds)

    directions = grid_plain.ray_directions(CAMERA, rotation.astype(np.float64))
    wanted = grid_plain.update(config, before, VOLUME[0], depth, position.astype(np.float64), directions)
    start = (position.astype(np.float64) - VOLUME[0]) / config.cell_m
    lengths = share * np.minimum(depth, config.range_m).ravel() / config.cell_m
    differ = np.argwhere(np.abs(found - wanted) > 1e-5)  # of values up to 3.5 in single precision
    for cell in differ:
        # The steps of the plain version leave out cells of which a ray clips less than a step, a hundredth of a cell;
        # in single precision a point is off by a millionth of one.
        chord = grid_plain.longest_chord(tuple(cell), start, directions.reshape(-1, 3), lengths)
        assert chord < grid_plain.STEP + 1e-4, (cell, chord)
        assert found[tuple(cell)] < wanted[tuple(cell)]  # freed
    assert len(differ) <= 2 + 0.05 * np.sum(wanted != before)  # a ray clips less than a hundredth seldom


def test_a_wall_is_occupied_before_it_is_free_and_behind_it_is_unknown() -> None:
    position = np.array([0.25, 5.25, 2.25], np.float32)
    directions = grid_plain.ray_directions(CAMERA, AHEAD)
    depth = 3.1 / directions[..., 0]  # a wall across, 3.1 m ahead
    config = dataclasses.replace(CONFIG, range_m=8.0)
    log_odds = np.asarray(grow(config, CAMERA, empty(config), depth, position, AHEAD.astype(np.float32)).log_odds)
    assert log_odds[cell_at((3.36, 5.25, 2.6))] == np.float32(config.hit)
    assert log_odds[cell_at((1.75, 5.25, 2.25))] == np.float32(config.miss)
    assert log_odds[cell_at((0.25, 5.25, 2.25))] == np.float32(config.miss)  # where it is itself
    assert np.all(log_odds[cell_at((3.6, 5.25, 2.25))[0] :] == 0.0)
    assert np.all(log_odds[: cell_at((0.25, 0, 0))[0]] == 0.0)  # and behind the camera


def test_a_ray_that_meets_nothing_frees_as_far_as_the_range() -> None:
    position = np.array([-0.75, 5.25, 2.25], np.float32)
    depth = np.full((CAMERA.height, CAMERA.width), np.inf, np.float32)
    log_odds = np.asarray(grow(CONFIG, CAMERA, empty(), depth, position, AHEAD.astype(np.float32)).log_odds)
    assert log_odds.max() == 0.0
    freed = np.argwhere(log_odds < 0)
    assert freed[:, 0].max() == cell_at((-0.75 + 0.97 * CONFIG.range_m, 5.25, 2.25))[0]


def test_a_cell_stays_within_the_limits_and_can_change_its_mind() -> None:
    # No ray ends at a cell's face or passes an edge, where rounding says which cells it meets.
    position = np.array([0.21, 5.28, 2.19], np.float32)
    look = functools.partial(grow, CONFIG, CAMERA, position=position, rotation=AHEAD.astype(np.float32))
    near, far = (np.full((CAMERA.height, CAMERA.width), metres, np.float32) for metres in (2.0, 3.9))
    grid = empty()
    for _ in range(20):
        grid = look(grid=grid, depth=near)
    most = float(np.max(grid.log_odds))
    assert most == CONFIG.most and float(np.min(grid.log_odds)) == CONFIG.least
    filled = np.asarray(grid.log_odds) == CONFIG.most
    most_left = []
    for _ in range(9):  # 3.5 / 0.4, rounded up; without the limit 20 x 0.85 / 0.4 = 43
        grid = look(grid=grid, depth=far)
        most_left.append(np.max(np.asarray(grid.log_odds)[filled]))
    assert most_left[-2] > 0 >= most_left[-1]


def test_one_image_changes_a_cell_once_however_many_rays_pass_it() -> None:
    many = CameraConfig(width=40, height=40, mount="body")
    position, rotation = np.array([0.25, 5.25, 2.25], np.float32), AHEAD.astype(np.float32)
    depth = np.full((40, 40), 1.0, np.float32)
    log_odds = np.asarray(grow(CONFIG, many, empty(), depth, position, rotation).log_odds)
    assert set(np.unique(log_odds)) == {np.float32(CONFIG.miss), 0.0, np.float32(CONFIG.hit)}


def test_drones_side_by_side_have_maps_of_their_own() -> None:
    random = np.random.default_rng(3)
    depth = random.uniform(0.5, 6.0, (3, CAMERA.height, CAMERA.width)).astype(np.float32)
    position = random.uniform(VOLUME[0], VOLUME[1], (3, 3)).astype(np.float32)
    rotation = np.stack([any_rotation(random) for _ in range(3)])
    one = functools.partial(update, CONFIG, CAMERA, empty())
    many = jax.jit(jax.vmap(one))(depth, position, rotation).log_odds
    for n in range(3):
        alone = grow(CONFIG, CAMERA, empty(), depth[n], position[n], rotation[n]).log_odds
        np.testing.assert_array_equal(many[n], alone)


def test_the_grid_holds_the_largest_volume() -> None:
    volumes = np.array([[[0, 0, 0], [10, 4, 3]], [[0, 0, 0], [5, 4.2, 3]]], np.float32)
    assert grid_shape(MapConfig(cell_m=0.5), volumes) == (20, 9, 6)


def test_what_cannot_be_mapped_is_a_sentence() -> None:
    with pytest.raises(ConfigError, match="give larger cells"):
        grid_shape(MapConfig(cell_m=0.01), np.array([[0, 0, 0], [50, 50, 10.0]]))
    for name, value in (("cell_m", 0.0), ("miss", 0.1), ("hit", -1.0), ("range_m", 0.2), ("free_share", 1.5)):
        with pytest.raises(ConfigError, match=f"{name} of a map must be"):
            MapConfig(**{name: value})
