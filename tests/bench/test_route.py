"""A* on an occupancy grid: the cheapest way, held against Dijkstra's, and what it does where none is free."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from rivals.mapping.route import OCCUPIED_WEIGHT, TOUCHED_WEIGHT, RouteConfig, Router

CELL = 0.5
VOLUME = np.array([[2.0, -1.0, 0.0], [8.0, 4.0, 3.0]])
SHAPE = (12, 10, 6)
OPEN = RouteConfig(unknown_weight=1.0, fence_m=0.25, ahead_m=100.0)
START, GOAL = np.array([2.75, 1.25, 1.25]), np.array([7.25, 1.25, 1.25])


def free() -> np.ndarray:
    return np.full(SHAPE, -1.0, np.float32)


def weights_of(config: RouteConfig, log_odds: np.ndarray) -> np.ndarray:
    """The weight of each cell, from its distance to each occupied one."""
    cells = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), -1).reshape(-1, 3)
    occupied = cells[(log_odds > config.occupied_above).ravel()]
    unknown, weight = cells[(log_odds == 0.0).ravel()], np.ones(len(cells))
    for n, cell in enumerate(cells):
        if CELL * np.linalg.norm(unknown - cell, axis=1).min(initial=np.inf) <= config.body_m:
            weight[n] = config.unknown_weight
        apart = CELL * np.linalg.norm(occupied - cell, axis=1).min(initial=np.inf)
        if apart <= config.near_m:
            weight[n] = max(weight[n], config.near_weight)
        if apart <= config.touch_m:
            weight[n] = OCCUPIED_WEIGHT if apart == 0.0 else TOUCHED_WEIGHT
    return weight.reshape(SHAPE)


def cheapest(config: RouteConfig, log_odds: np.ndarray, source: tuple, target: tuple) -> float:
    """The cost of the cheapest way between two cells, in cells, by Dijkstra's algorithm."""
    weight = weights_of(config, log_odds).ravel()
    number = np.arange(weight.size).reshape(SHAPE)
    pairs = []
    for step in itertools.product((-1, 0, 1), repeat=3):
        if any(step):
            here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, SHAPE, strict=True))
            there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, SHAPE, strict=True))
            a, b = number[here].ravel(), number[there].ravel()
            pairs.append((a, b, np.linalg.norm(step) * (weight[a] + weight[b]) / 2))
    a, b, cost = (np.concatenate(part) for part in zip(*pairs, strict=True))
    graph = coo_array((cost, (a, b)), (weight.size, weight.size)).tocsr()
    return float(dijkstra(graph, indices=number[source])[number[target]])


def cost_of(config: RouteConfig, log_odds: np.ndarray, points: np.ndarray) -> float:
    """The cost of a way, in cells, summed over small steps."""
    weight, total = weights_of(config, log_odds), 0.0
    for a, b in itertools.pairwise(points):
        shares = (np.arange(400) + 0.5) / 400
        at = np.floor((a + shares[:, None] * (b - a) - VOLUME[0]) / CELL).astype(int)
        total += np.linalg.norm(b - a) / CELL * weight[tuple(np.clip(at, 0, np.array(SHAPE) - 1).T)].mean()
    return total


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), unknown=st.sampled_from([1.0, 1.5]))
def test_no_way_costs_less_or_no_more_than_the_unknown_may(seed: int, unknown: float) -> None:
    random = np.random.default_rng(seed)
    log_odds = random.choice(np.array([-1.0, 0.0, 1.0], np.float32), SHAPE, p=[0.7, 0.26, 0.04])
    config = RouteConfig(touch_m=0.5, near_m=0.75, near_weight=3.0, unknown_weight=unknown, fence_m=0.25, ahead_m=100.0)
    source, target = (tuple(random.integers(0, SHAPE)) for _ in range(2))
    start, goal = (VOLUME[0] + CELL * (np.array(cell) + 0.5) for cell in (source, target))
    found = Router(config, CELL, VOLUME).cells(log_odds, start, goal)
    least = cheapest(config, log_odds, source, target)
    assert least * (1 - 1e-5) <= found[1] <= unknown * least * (1 + 1e-5)  # weights are float32
    np.testing.assert_allclose(found[0][[0, -1]], [source, target])


def test_a_wall_is_flown_around_at_a_distance() -> None:
    log_odds = free()
    log_odds[6, :7] = 1.0  # a wall across, open towards large y
    route = Router(OPEN, CELL, VOLUME).plan(log_odds, START, GOAL)
    legs = [a + share * (b - a) for a, b in itertools.pairwise(route.points) for share in np.linspace(0, 1, 50)]
    occupied = VOLUME[0] + CELL * (np.argwhere(log_odds > 0) + 0.5)
    # Half the diagonal of a cell less than from middle to middle.
    assert min(np.linalg.norm(occupied - at, axis=1).min() for at in legs) > OPEN.touch_m - CELL * np.sqrt(3) / 2
    assert np.allclose(route.points[[0, -1]], [START, GOAL])


def test_the_straight_line_is_flown_where_it_is_free() -> None:
    route = Router(OPEN, CELL, VOLUME).plan(free(), START, GOAL)
    np.testing.assert_allclose(route.points, [START, GOAL])


def test_unknown_cells_are_free_unless_they_cost_something() -> None:
    log_odds = free()
    log_odds[5:7, 2:8, 1:5] = 0.0
    straight = Router(OPEN, CELL, VOLUME).plan(log_odds, START, GOAL)
    np.testing.assert_allclose(straight.points, [START, GOAL])
    dear = dataclasses.replace(OPEN, unknown_weight=20.0)
    around = Router(dear, CELL, VOLUME).plan(log_odds, START, GOAL)
    assert cost_of(OPEN, log_odds, around.points) > cost_of(OPEN, log_odds, straight.points)
    assert cost_of(dear, log_odds, around.points) < cost_of(dear, log_odds, straight.points)


def test_where_every_way_is_closed_it_goes_through_the_thinnest_place() -> None:
    log_odds = free()
    log_odds[6:9] = 1.0
    log_odds[7:9, 1:3, 3] = -1.0  # a hole of two of three layers
    route = Router(OPEN, CELL, VOLUME).plan(log_odds, START, GOAL)
    assert cost_of(OPEN, log_odds, route.points) < 2.5 * OCCUPIED_WEIGHT
    assert np.allclose(route.points[-1], GOAL)


def test_a_drone_beside_an_obstacle_leaves_it_first() -> None:
    log_odds = free()
    log_odds[1, 4, 2] = 1.0  # the drone's own cell
    route = Router(OPEN, CELL, VOLUME).plan(log_odds, START, GOAL)
    assert np.allclose(route.points[[0, -1]], [START, GOAL])


def test_only_the_next_part_is_returned() -> None:
    route = Router(dataclasses.replace(OPEN, ahead_m=2.0), CELL, VOLUME).plan(free(), START, GOAL)
    assert np.linalg.norm(route.points[-1] - START) == pytest.approx(2.0, abs=CELL)


def test_what_is_seen_of_a_way_ends_where_the_body_might_touch_what_is_unknown_or_occupied() -> None:
    router = Router(OPEN, CELL, VOLUME)
    way = np.array([START, GOAL])
    assert router.known_length_m(free(), way) == pytest.approx(np.linalg.norm(GOAL - START))
    unknown = free()
    unknown[6:] = 0.0  # from x = 5 on, so from 4.5 on the body might touch it
    assert router.known_length_m(unknown, way) == pytest.approx(4.5 - START[0], abs=CELL / 2)
    beside = free()
    beside[6, 5] = 0.0  # one cell beside the way
    assert router.known_length_m(beside, way) == pytest.approx(5.0 - START[0], abs=CELL / 2)
    wall = free()
    wall[9, 4, 2] = 1.0  # its middle at x = 6.75, so cells from 6.75 - 0.75 on touch
    assert router.known_length_m(wall, way) == pytest.approx(7.0 - OPEN.touch_m - START[0], abs=CELL)


def test_a_way_keeps_its_distance_from_the_fence_except_at_the_goal() -> None:
    router = Router(dataclasses.replace(OPEN, fence_m=1.0), CELL, VOLUME)
    log_odds = free()
    log_odds[6, 2:8, :4] = 1.0
    route = router.plan(log_odds, START, np.array([7.25, 1.25, 0.3]))
    inner = route.points[1:-1]
    assert np.all(inner[:, 1] > VOLUME[0, 1] + 1.0 - CELL) and np.all(inner[:, 1] < VOLUME[1, 1] - 1.0 + CELL)
    np.testing.assert_allclose(route.points[-1], [7.25, 1.25, 0.3])
