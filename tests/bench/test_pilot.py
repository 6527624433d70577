"""The pilot: it reaches a goal behind a wall that it was not told about, and sees only by its sensor."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.mapping import pilot
from edqn_jax.mapping.pilot import POINTS, Orders, PilotConfig, Piloted
from edqn_jax.mapping.route import Router
from edqn_jax.planners.follow import SPACING_M
from edqn_jax.sim import drone
from edqn_jax.sim.env import World
from edqn_jax.sim.missions import own_missions
from edqn_jax.sim.mjcf import load_world
from edqn_jax.sim.outcomes import Outcome
from edqn_jax.sim.scene import stack_scenes
from tests.policies import CONFIG, fresh

CONFIG = dataclasses.replace(CONFIG, camera=dataclasses.replace(CONFIG.camera, width=32, height=24))

WALL = """<mujoco><worldbody>
  <geom type="plane" size="0 0 1"/>
  <geom type="box" pos="12 {y} 4" size="1 8 4"/>
  <site name="start" pos="3 10 4"/><site name="goal" pos="21 10 4"/>
  <site name="volume" type="box" pos="12 10 4" size="12 10 4"/>
</worldbody></mujoco>"""

TRUE = PilotConfig(depth="true")


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> World:
    """A wall across that leaves 4 m at one side, and its mirror image."""
    scenes = []
    for y in (8, 12):
        file = tmp_path_factory.mktemp("worlds") / "wall.xml"
        file.write_text(WALL.format(y=y))
        scenes.append(load_world(file).scene)
    pool = stack_scenes(scenes)
    return World(drone.load_airframe(CONFIG.drone), pool, own_missions(pool))


@functools.cache
def params():
    return fresh(CONFIG, 0)


@pytest.mark.slow
def test_with_true_depth_it_flies_around_a_wall_on_the_side_that_is_open(course: World) -> None:
    sides: list[np.ndarray] = []

    def watch(flying: Piloted, orders: Orders) -> None:
        sides.append(np.array(flying.drone.position))

    flights, seconds = pilot.fly(CONFIG, TRUE, course, params(), jax.random.key(0), batch=2, watch=watch)
    assert list(flights.outcome) == [Outcome.GOAL, Outcome.GOAL]
    # The openings are where y > 16 and y < 4; the way there and on to the goal is 18.9 m without the goal's 2 m.
    at = np.array(sides)
    assert at[:, 0, 1].max() > 16 and at[:, 1, 1].min() < 4
    assert np.all(flights.path_length_m > 18.0) and np.all(flights.path_length_m < 30.0)
    assert len(seconds) == flights.decisions.sum() and np.all(seconds > 0)


@pytest.mark.slow
def test_it_does_not_know_what_its_sensor_does_not_show(course: World, monkeypatch) -> None:
    # A camera that sees nothing: the straight line leads into the wall.
    nothing = lambda config, *_: jnp.full((config.height, config.width), jnp.inf)  # noqa: E731
    monkeypatch.setattr(pilot.camera, "depth", nothing)
    pilot._programs.cache_clear()
    flights, _ = pilot.fly(CONFIG, TRUE, course, params(), jax.random.key(0), batch=2)
    pilot._programs.cache_clear()
    assert list(flights.outcome) == [Outcome.COLLISION, Outcome.COLLISION]
    # The cells' middles beside the straight line are 0.25 m off it.
    np.testing.assert_allclose(flights.closest.position[:, :2], [[10.64, 10], [10.64, 10]], atol=0.3)


@pytest.mark.slow
def test_flights_do_not_depend_on_which_fly_side_by_side(course: World) -> None:
    together, alone = (pilot.fly(CONFIG, TRUE, course, params(), jax.random.key(0), batch=n)[0] for n in (3, 1))
    np.testing.assert_array_equal(together.outcome, alone.outcome)
    # Programs of another batch round the last bits otherwise, and a plan may then take another one of two equal ways.
    np.testing.assert_allclose(together.path_length_m, alone.path_length_m, rtol=0.1)


@pytest.mark.slow
def test_decoded_depth_comes_from_the_sensor_alone(course: World) -> None:
    # With events of a still camera there are none, so both worlds look the same and the maps stay as they were.
    decoded = PilotConfig(depth="decoded", seeing_m_s=0.0)
    begin, _ = pilot._programs("cpu")
    number, keys = jnp.arange(2), jax.random.split(jax.random.key(0))[jnp.zeros(2, int)]
    shape = pilot.grid_shape(decoded.map, course.pool.volume)
    first = begin(CONFIG, decoded, shape, course, params(), number, keys)
    np.testing.assert_array_equal(first.grid.log_odds[0], first.grid.log_odds[1])
    assert np.any(first.grid.log_odds != 0.0)
    blind = dataclasses.replace(decoded, seeing_m_s=0.5)
    assert np.all(begin(CONFIG, blind, shape, course, params(), number, keys).grid.log_odds == 0.0)
    true = begin(CONFIG, TRUE, shape, course, params(), number, keys)
    assert np.any(true.grid.log_odds[0] != true.grid.log_odds[1])


def test_decoded_depth_is_what_the_policy_says_it_is() -> None:
    memory = jax.random.normal(jax.random.key(1), (CONFIG.agent.history, 100))
    code = memory[-1, : CONFIG.encoder.code_size] / CONFIG.agent.code_scale
    drawn = pilot.decoded_depth(CONFIG, params(), memory)
    np.testing.assert_allclose(drawn, pilot.policy.Policy(CONFIG, params()).depth(code), rtol=1e-5)
    assert drawn.shape == (CONFIG.camera.height, CONFIG.camera.width)


def test_it_flies_as_fast_as_it_can_stop_within_what_it_has_seen() -> None:
    volume = np.array([[0.0, 0.0, 0.0], [24.0, 20.0, 8.0]])
    router = Router(TRUE.route, TRUE.map.cell_m, volume)
    known = np.full((48, 40, 16), -1.0, np.float32)
    here, goal = np.array([3.25, 10.25, 4.25]), np.array([21.25, 10.25, 4.25])
    assert pilot.order(TRUE, router, known, here, goal)[1] == TRUE.speed_m_s
    known[11:] = 0.0  # from x = 5.5 on, so from 5 on the body might touch it, 1.75 m ahead
    _, speed, _ = pilot.order(TRUE, router, known, here, goal)
    stop = speed * TRUE.reaction_s + speed**2 / (2 * TRUE.braking_m_s2)
    assert stop == pytest.approx(1.75, abs=TRUE.map.cell_m / 2) and speed < TRUE.speed_m_s
    known[:] = 0.0
    assert pilot.order(TRUE, router, known, here, goal)[1] == TRUE.least_m_s
    at_once = dataclasses.replace(TRUE, braking_m_s2=0.0)
    assert pilot.order(at_once, router, known, here, goal)[1] == TRUE.speed_m_s


def test_the_follower_gets_points_at_its_spacing() -> None:
    points = pilot.sampled(np.array([[0.0, 0.0, 1.0], [3.0, 0.0, 1.0], [3.0, 4.0, 1.0]]))
    assert points.shape == (POINTS, 3)
    np.testing.assert_allclose(points[45], [3.0, 1.5, 1.0], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(np.diff(points[:30], axis=0), axis=1), SPACING_M, atol=1e-6)
    np.testing.assert_allclose(points[71:], np.broadcast_to([3.0, 4.0, 1.0], (POINTS - 71, 3)))


def test_the_command_never_exceeds_the_limit_and_a_flight_that_is_over_stays_so(course: World) -> None:
    shape = pilot.grid_shape(TRUE.map, course.pool.volume)
    flying = pilot.at_rest(CONFIG, TRUE, shape, course, jnp.zeros((), jnp.int32), jax.random.key(0))
    points = pilot.sampled(np.array([[3.0, 10.0, 4.0], [9.0, 10.0, 4.0]]))
    step = jax.jit(functools.partial(pilot.decide, CONFIG, TRUE, course, params()))
    for _ in range(4):
        flying = step(jnp.zeros((), jnp.int32), flying, points, jnp.float32(1.5))
    over = dataclasses.replace(flying.flights, outcome=jnp.int32(Outcome.GOAL))
    ended = dataclasses.replace(flying, flights=over)
    after = step(jnp.zeros((), jnp.int32), ended, points, jnp.float32(1.5))
    np.testing.assert_array_equal(after.drone.position, flying.drone.position)  # a flight that is over stays so
    assert int(after.flights.outcome) == Outcome.GOAL and int(after.flights.decisions) == int(over.decisions)
    # What a velocity loop overshoots is a few per cent.
    assert float(np.linalg.norm(flying.drone.velocity)) == pytest.approx(1.5, abs=0.1)


def test_what_cannot_be_flown_is_a_sentence() -> None:
    blind = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, sensor="blind"))
    with pytest.raises(ConfigError, match="draws no distances"):
        pilot.check_can_fly(blind, PilotConfig(depth="decoded"))
    pilot.check_can_fly(blind, TRUE)
    with pytest.raises(ConfigError, match="speed_m_s of a pilot must be more than 0"):
        PilotConfig(speed_m_s=0.0)
