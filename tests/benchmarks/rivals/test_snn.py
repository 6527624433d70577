"""Compares the wave with breadth-first search and the lattice with true distances; checks the paths of both."""

# pyright: reportArgumentType=false

from __future__ import annotations

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.planning.path import MARGIN, PlanningTask
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from edqn_jax.sim.worlds.families import random_scene, world_key
from rivals.planners import snn
from rivals.planners.planner import Budget
from tests.oracles.breadth_first import hop_counts
from tests.support.drawn_scenes import every_kind
from tests.support.small_worlds import (
    RADIUS,
    WITHOUT_A_WAY,
    assert_flyable,
    box,
    random_small_world,
    small_world,
    true_distances,
)

CONFIG = snn.SnnConfig()
SMALL = (12, 12, 6)

_synapses = jax.jit(snn.synapses, static_argnums=(2, 3))
_wave = jax.jit(snn.spike_wave, static_argnums=0)
_follow = jax.jit(snn.follow, static_argnums=0)


def one_cell(*index: int, shape=SMALL) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[index] = True
    return mask


# --------------------------------------------------------------------------------------- lattice


def test_the_whole_volume_of_the_paper_is_one_lattice_of_metres():
    assert snn.lattice_shape(np.array([(0, 0, 0), (110, 110, 25)], np.float32)) == (110, 110, 25)


@pytest.mark.slow
def test_cells_stand_in_the_middle_of_their_cubes():
    middles = _synapses(small_world().scene, RADIUS, SMALL, 1.0).middles
    np.testing.assert_allclose(middles[0, 0, 0], [0.5, 0.5, 0.5])
    np.testing.assert_allclose(middles[3, 4, 5], [3.5, 4.5, 5.5])


def test_a_volume_without_room_for_a_cell_says_so():
    with pytest.raises(ValueError, match="holds no place cell"):
        snn.lattice_shape(np.array([(0, 0, 0), (5, 0.5, 5)]))


def test_along_the_ground_every_edge_is_there():
    # The lowest cells stand 0.5 m over the ground: only an edge's own course says that it is free.
    network = _synapses(small_world().scene, RADIUS, SMALL, 1.0)
    assert bool(network.free.all())
    inner = np.asarray(network.joined)[1:-1, 1:-1, 1:-1]
    assert np.all(inner == 2**26 - 1)
    level = [k for k, step in enumerate(snn.DIRECTIONS) if step[2] == 0]
    lowest = np.asarray(network.joined)[1:-1, 1:-1, 0]
    assert all(np.all(lowest >> k & 1) for k in level)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.slow
def test_no_edge_touches_anything_and_none_with_clearance_is_missing(seed):
    rng = np.random.default_rng(seed)
    scene = every_kind(rng)
    network = jax.device_get(_synapses(scene, RADIUS, (60, 60, 25), 1.0))
    # Edges near a surface are the ones that matter.
    clearance = true_distances(scene, network.middles.reshape(-1, 3)).reshape(network.free.shape)
    np.testing.assert_array_equal(network.free, clearance >= RADIUS)
    cells = rng.permutation(np.argwhere(network.free & (clearance < 2.0)))[:3000]
    steps = rng.integers(0, 26, len(cells))
    there = cells + snn.DIRECTIONS[steps]
    inside = np.all((there >= 0) & (there < network.free.shape), axis=1)
    joined = (network.joined[tuple(cells.T)] >> steps & 1) == 1
    assert not np.any(joined & ~inside)
    starts, moves = network.middles[tuple(cells.T)][:, None], snn.DIRECTIONS[steps][:, None]
    along = (starts + np.linspace(0, 1, 65)[:, None] * moves).reshape(-1, 3)
    least = true_distances(scene, along).reshape(len(cells), -1).min(axis=1)
    assert least[joined].min() >= RADIUS - 1e-5  # float32 over 60 m
    assert np.all(joined[inside & (least >= RADIUS + np.sqrt(3) / 2)])
    # Not by refusing whatever is near: most of the free edges are there.
    assert joined.sum() > 0.8 * (inside & (least >= RADIUS)).sum()


@pytest.mark.parametrize("seed", range(4))
def test_synapses_come_in_pairs(seed):
    joined = np.asarray(_synapses(random_small_world(seed).scene, RADIUS, SMALL, 1.0).joined)
    for k, step in enumerate(snn.DIRECTIONS):
        for cell in np.argwhere(joined >> k & 1)[::17]:
            assert joined[tuple(cell + step)] >> (25 - k) & 1


@pytest.mark.slow
def test_a_point_belongs_to_the_cells_that_it_sees():
    task = small_world(box((5.9, 0, 0), (6.1, 12, 6)))
    network = _synapses(task.scene, 0.1, SMALL, 1.0)
    seen = snn.cells_at(task.scene, network, jnp.array([5.5, 6.0, 3.0]), 0.1)
    # Around (5.5, 6, 3) stand cells at x = 5.5 and, beyond the wall, x = 6.5.
    found = np.argwhere(np.asarray(seen))
    assert sorted(map(tuple, found)) == list(itertools.product((5,), (5, 6), (2, 3)))


# ------------------------------------------------------------------------------------------ wave


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.slow
def test_the_wave_arrives_in_the_order_of_breadth_first_hops(seed):
    scene = random_small_world(seed).scene
    network = _synapses(scene, RADIUS, SMALL, 1.0)
    goal = np.asarray(snn.cells_at(scene, network, scene.goal, RADIUS))
    hops, _ = _wave(CONFIG, network, goal)
    joined = np.asarray(network.joined)

    def neighbours(cell):
        return [tuple(cell + step) for k, step in enumerate(snn.DIRECTIONS) if joined[cell] >> k & 1]

    expected = np.full(SMALL, -1)
    for cell, count in hop_counts(map(tuple, np.argwhere(goal)), neighbours).items():
        expected[cell] = count
    np.testing.assert_array_equal(hops, expected)
    assert expected.max() > 8


def test_a_blocked_cell_never_fires():
    network = _synapses(small_world(box((5.2, 0, 0), (6.8, 12, 6))).scene, RADIUS, SMALL, 1.0)
    hops, _ = _wave(CONFIG, network, one_cell(9, 6, 3))
    assert np.all(np.asarray(hops)[~np.asarray(network.free)] == -1)
    assert np.all(np.asarray(hops)[:5] == -1)
    assert np.all(np.asarray(hops)[8:] >= 0)


def test_the_wave_ends_where_it_is_told_to():
    network = _synapses(small_world().scene, RADIUS, SMALL, 1.0)
    hops, taken = _wave(CONFIG, network, one_cell(0, 6, 3), one_cell(4, 6, 3))
    assert (int(taken), int(hops.max()), int(hops[4, 6, 3])) == (4, 4, 4)
    hops, taken = _wave(CONFIG, network, one_cell(0, 6, 3), one_cell(11, 6, 3), 3)
    assert (int(taken), int(hops.max())) == (3, 3)


def test_cells_that_one_spike_cannot_fire_are_refused():
    # 40 mV drive a resting cell to 40 (1 - exp(-1/2)) = 15.7 mV within a time step of 1 ms.
    snn.SnnConfig(threshold_v=0.0157)
    with pytest.raises(ValueError, match=r"raises a place cell to 0\.0157388 V, below its threshold of 0\.0158 V"):
        snn.SnnConfig(threshold_v=0.0158)


# ----------------------------------------------------------------------------- plasticity, paths


def test_the_window_strengthens_what_fired_before_and_weakens_what_fired_after():
    lag = jnp.array([-0.0337, -0.001, 0.0, 0.001, 0.0168])
    expected = [-np.exp(-1), -np.exp(-1 / 33.7), 0.0, np.exp(-1 / 16.8), np.exp(-1)]
    np.testing.assert_allclose(snn.stdp(CONFIG, lag), expected, rtol=1e-5)


def test_in_the_open_the_field_points_along_the_wave():
    network = _synapses(small_world().scene, RADIUS, SMALL, 1.0)
    hops, _ = _wave(CONFIG, network, one_cell(1, 6, 3))
    asymmetries = snn.asymmetry(CONFIG, network, hops, jnp.array([8, 6, 3]))
    # Nine neighbours fired a step before and nine a step after, each one cell along x.
    each = np.exp(-1 / 16.8) + np.exp(-1 / 33.7)
    np.testing.assert_allclose(snn.synaptic_field(asymmetries), [-18 * each, 0, 0], atol=1e-4)


def test_the_path_takes_as_many_steps_as_the_wave():
    network = _synapses(small_world().scene, RADIUS, SMALL, 1.0)
    goal = one_cell(1, 2, 3)
    hops, _ = _wave(CONFIG, network, goal)
    cells, count, arrived = _follow(CONFIG, network, hops, jnp.array([10, 6, 3]), goal)
    assert bool(arrived) and int(count) == 1 + 9
    np.testing.assert_array_equal(np.abs(np.diff(cells[: int(count)], axis=0)).max(axis=1), 1)
    # Straight along x first, then diagonally: the shortest that steps between 26 neighbours allow.
    length = np.linalg.norm(np.diff(cells[: int(count)], axis=0), axis=1).sum()
    assert length == pytest.approx(5 + 4 * np.sqrt(2))


@pytest.mark.slow
def test_with_the_window_upside_down_no_path_is_found(monkeypatch):
    right = snn.stdp
    monkeypatch.setattr(snn, "stdp", lambda config, lag: -right(config, lag))
    snn._compiled.cache_clear()
    plan = snn.plan(small_world())
    snn._compiled.cache_clear()
    assert plan.reason == "no path: the synaptic vector field does not lead to the goal"


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.slow
def test_every_path_in_a_small_world_is_free(seed):
    task = random_small_world(seed)
    plan = snn.plan(task)
    assert_flyable(task, plan.path)
    assert plan.length_m == plan.first_length_m
    # Each step is one hop, from the first cell that sees the start to one that sees the goal.
    assert len(plan.path) == plan.steps + 3


# In both the hops count along x alone; in the second the start is as far from all cells around it.
@pytest.mark.parametrize(("start", "goal"), [((2.4, 2.4, 2.9), (10.4, 8.4, 2.9)), ((2.0, 2.0, 3.0), (10.0, 8.0, 3.0))])
@pytest.mark.slow
def test_the_path_does_not_begin_backwards(start, goal):
    task = small_world(start=start, goal=goal)
    path = snn.plan(task).path
    assert path is not None
    assert np.linalg.norm(task.goal - path[1]) < np.linalg.norm(task.goal - task.start)
    assert np.all(path[1, :2] > task.start[:2])


@pytest.mark.slow
@pytest.mark.parametrize("world", ["paper", "medium 0", "medium 1", "dense 0", "dense 1", "dense 2"])
def test_every_path_in_a_large_world_is_free(world):
    name, *index = world.split()
    scene = random_scene(name, world_key("test", int(index[0]))) if index else load_scene(resolve_world(name))
    task = PlanningTask.from_scene(scene, body_radius=RADIUS)
    plan = snn.plan(task)
    assert_flyable(task, plan.path)
    # A path of steps between 26 neighbours is at most 1.13 times too long in the open, and obstacles cost more.
    assert plan.length_m < 1.3 * np.linalg.norm(task.goal - task.start)


@pytest.mark.parametrize("world", WITHOUT_A_WAY)
@pytest.mark.slow
def test_without_a_way_it_says_so(world):
    plan = snn.plan(WITHOUT_A_WAY[world])
    assert not plan.found and plan.path is None and np.isnan(plan.length_m)
    assert plan.reason == "no path: the wave does not reach the start"


def test_the_budget_ends_the_wave():
    plan = snn.plan(small_world(), Budget(steps=3))
    assert plan.reason == "no path: no spike reached the start within 3 time steps"


@pytest.mark.slow
def test_it_is_strict(strict_jax):
    task = random_small_world(0)
    solve = jax.jit(partial(snn.solve, CONFIG, shape=SMALL))
    ends = jnp.asarray(task.start, jnp.float32), jnp.asarray(task.goal, jnp.float32)
    walk = solve(task.scene, *ends, jnp.float32(RADIUS + MARGIN), jnp.int32(100))
    assert bool(walk.arrived)
