"""The pilot: it reaches a goal behind a wall that it was not told about, and sees only by its sensor."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import Policy
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.mjcf import load_world
from edqn_jax.sim.scene.scene import stack_scenes
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.outcomes import Outcome
from rivals.mapping import pilot
from rivals.mapping.pilot import POINTS, Orders, PilotConfig, Piloted
from rivals.mapping.route import RouteConfig, Router
from rivals.planners.follow import SPACING_M, sample_path
from tests.support.policies import CONFIG, fresh

CONFIG = dataclasses.replace(CONFIG, camera=dataclasses.replace(CONFIG.camera, width=32, height=24))

WALL = """<mujoco><worldbody>
  <geom type="plane" size="0 0 1"/>
  <geom type="box" pos="12 {y} 4" size="1 8 4"/>
  <site name="start" pos="3 10 4"/><site name="goal" pos="21 10 4"/>
  <site name="volume" type="box" pos="12 10 4" size="12 10 4"/>
</worldbody></mujoco>"""

TRUE = PilotConfig(depth="true")


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> EnvParams:
    """A wall across that leaves 4 m at one side, and its mirror image."""
    scenes = []
    for y in (8, 12):
        file = tmp_path_factory.mktemp("worlds") / "wall.xml"
        file.write_text(WALL.format(y=y))
        scenes.append(load_world(file).scene)
    pool = stack_scenes(scenes)
    return EnvParams(load_airframe(CONFIG.drone), pool, own_missions(pool))


@functools.cache
def params():
    return fresh(CONFIG, 0)


@pytest.mark.slow
def test_with_true_depth_it_flies_around_a_wall_on_the_side_that_is_open(course: EnvParams) -> None:
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
def test_it_does_not_know_what_its_sensor_does_not_show(course: EnvParams, monkeypatch) -> None:
    # A camera that sees nothing: the straight line leads into the wall.
    nothing = lambda config, *_: jnp.full((config.height, config.width), jnp.inf)  # noqa: E731
    monkeypatch.setattr(pilot.camera, "render_depth", nothing)
    pilot._programs.cache_clear()
    flights, _ = pilot.fly(CONFIG, TRUE, course, params(), jax.random.key(0), batch=2)
    pilot._programs.cache_clear()
    assert list(flights.outcome) == [Outcome.COLLISION, Outcome.COLLISION]
    # The cells' middles beside the straight line are 0.25 m off it.
    np.testing.assert_allclose(flights.closest.position[:, :2], [[10.64, 10], [10.64, 10]], atol=0.3)


@pytest.mark.slow
def test_flights_do_not_depend_on_which_fly_side_by_side(course: EnvParams) -> None:
    together, alone = (pilot.fly(CONFIG, TRUE, course, params(), jax.random.key(0), batch=n)[0] for n in (3, 1))
    np.testing.assert_array_equal(together.outcome, alone.outcome)
    # Programs of another batch round the last bits otherwise, and a plan may then take another one of two equal ways.
    np.testing.assert_allclose(together.path_length_m, alone.path_length_m, rtol=0.1)


@pytest.mark.slow
def test_decoded_depth_comes_from_the_sensor_alone(course: EnvParams) -> None:
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
    np.testing.assert_allclose(drawn, Policy(CONFIG, params()).depth(code), rtol=1e-5)
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
    volume = np.array([[0.0, 0.0, 0.0], [24.0, 20.0, 8.0]])
    router = Router(TRUE.route, TRUE.map.cell_m, volume)
    known = np.full((48, 40, 16), -1.0, np.float32)
    points, _, _ = pilot.order(TRUE, router, known, np.array([3.25, 10.25, 4.25]), np.array([21.25, 10.25, 4.25]))
    assert points.shape == (POINTS, 3)
    np.testing.assert_allclose(points[:95, 0], 3.25 + SPACING_M * np.arange(95), atol=1e-5)
    # A way of 10 m, in whole cells; its end is repeated.
    np.testing.assert_allclose(points[105:], np.broadcast_to([13.25, 10.25, 4.25], (POINTS - 105, 3)), atol=1e-5)


def test_the_command_never_exceeds_the_limit_and_a_flight_that_is_over_stays_so(course: EnvParams) -> None:
    shape = pilot.grid_shape(TRUE.map, course.pool.volume)
    flying = pilot.at_rest(CONFIG, TRUE, shape, course, jnp.zeros((), jnp.int32), jax.random.key(0))
    points = sample_path(np.array([[3.0, 10.0, 4.0], [9.0, 10.0, 4.0]]))
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


MOVING = """<mujoco>
  <custom><text name="motion:it" data="{motion}"/></custom>
  <worldbody>
    <site name="start" pos="3 10 4"/><site name="goal" pos="21 10 4"/>
    <site name="volume" type="box" pos="12 10 4" size="12 10 4"/>
    <body name="it" mocap="true" pos="{place}"><geom type="{kind}" size="{size}"/></body>
  </worldbody>
</mujoco>"""


def hovering(tmp_path: Path, decisions: int, motion: str, place: str, size: str, kind: str = "box") -> list[Piloted]:
    """A drone that stays at its start while something moves in front of it; it after 0, 1, ... decisions."""
    file = tmp_path / "moving.xml"
    file.write_text(MOVING.format(motion=motion, place=place, kind=kind, size=size))
    pool = stack_scenes([load_world(file).scene])
    flown = EnvParams(load_airframe(CONFIG.drone), pool, own_missions(pool))
    number, shape = jnp.zeros((), jnp.int32), pilot.grid_shape(TRUE.map, pool.volume)
    flying = jax.jit(functools.partial(pilot._begin, CONFIG, TRUE, shape, flown, params()))(number, jax.random.key(0))
    step = jax.jit(functools.partial(pilot.decide, CONFIG, TRUE, flown, params()))
    points = sample_path(np.array([[3.0, 10.0, 4.0], [3.5, 10.0, 4.0]]))
    seen = [flying]
    for _ in range(decisions):
        seen.append(step(number, seen[-1], points, jnp.float32(1e-4)))
    return seen


def test_what_an_obstacle_has_left_becomes_free_again(tmp_path: Path) -> None:
    # Its face is 4 m ahead at x = 7, and its middle moves from y = 8 to y = 14 in 3 s; without images of the world at
    # their own times it would stay where it is drawn.
    seen = hovering(tmp_path, 26, "bounce 0 2 0  8 8 4  8 14 4", place="8 8 4", size="1 1 4")
    cell = lambda y: (14, int(2 * y), 8)  # noqa: E731
    first, hit = np.asarray(seen[0].grid.log_odds), TRUE.map.hit
    assert first[cell(8.25)] == pytest.approx(hit) and first[cell(12.25)] < 0
    # 3.12 s later it has passed the middle and turns back at the end of its way; what it had hit twice takes 5 images.
    after = np.asarray(seen[12].grid.log_odds)
    assert after[cell(8.25)] < 0 < after[cell(13.25)]
    # And back at y = 8 again after 6 s, where it is seen at once.
    back = np.asarray(seen[24].grid.log_odds)
    assert back[cell(13.25)] < 0 < back[cell(8.25)]


def test_an_obstacle_that_flies_into_a_hovering_drone_is_a_collision_at_its_own_time(tmp_path: Path) -> None:
    # Its face is 3 m from the drone's middle and comes at 2 m/s: it touches the body 1.32 s after the start.
    seen = hovering(tmp_path, 7, "bounce -2 0 0  2 10 4  7 10 4", place="7 10 4", size="1 1 1")
    end = seen[-1].flights
    assert int(end.outcome) == Outcome.COLLISION and int(end.decisions) == 6
    assert float(end.flight_seconds) == pytest.approx((3 - CONFIG.drone.body_radius_m) / 2, abs=0.01)


def test_a_ball_is_thrown_at_where_the_pilot_hovers(tmp_path: Path) -> None:
    # Due 0.7 s after the start, so thrown as the third decision begins, 2 s before it would meet the drone's middle.
    end = hovering(tmp_path, 12, "throw 0.6 2 6 10 0 0 4", place="12 2 2", size="0.4", kind="sphere")[-1].flights
    assert int(end.outcome) == Outcome.COLLISION
    expected = 2 * 0.26 + 2 - (0.4 + CONFIG.drone.body_radius_m) / 6
    assert float(end.flight_seconds) == pytest.approx(expected, abs=0.02)


def test_a_flight_that_is_over_keeps_the_map_of_its_last_command(tmp_path: Path) -> None:
    seen = hovering(tmp_path, 7, "bounce -2 0 0  2 10 4  7 10 4", place="7 10 4", size="1 1 1")
    last, before, over = (np.asarray(seen[n].grid.log_odds) for n in (5, 4, 7))
    assert np.any(last != before)
    np.testing.assert_array_equal(over, last)


@pytest.mark.slow
def test_what_has_landed_comes_with_its_number(course: EnvParams) -> None:
    short = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, max_decisions=2))
    found: list[tuple[int, int]] = []

    def landed(missions: np.ndarray, flying: Piloted) -> None:
        # The walls reach from y = 0 to 16 and from 4 to 20; the floor is below them.
        beyond = np.asarray(flying.grid.log_odds)[:, :, 33:, 4:].max(axis=(1, 2, 3)) > 0
        found.extend((int(m), int(beyond[lane])) for lane, m in enumerate(missions))

    pilot.fly(short, TRUE, course, params(), jax.random.key(0), batch=1, landed=landed)
    assert found == [(0, 0), (1, 1)]
    found.clear()
    pilot.fly(short, TRUE, course, params(), jax.random.key(0), batch=3, landed=landed)
    assert found == [(0, 0), (1, 1)]  # and without the one that fills the batch


def test_what_cannot_be_flown_is_a_sentence() -> None:
    for group, option, value in (
        ("air", "wind_m_s", 1.0),
        ("noise", "position_m", 0.1),
        ("motors", "lag_s", 0.05),
        ("env", "action_delay", 1),
    ):
        part = dataclasses.replace(getattr(CONFIG, group), **{option: value})
        with pytest.raises(ConfigError, match="the pilot flies without disturbances"):
            pilot.check_can_fly(dataclasses.replace(CONFIG, **{group: part}), TRUE)
    several = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, drones=2))
    with pytest.raises(ConfigError, match="one drone in a world, not 2"):
        pilot.check_can_fly(several, TRUE)
    large = dataclasses.replace(CONFIG, drone=dataclasses.replace(CONFIG.drone, body_radius_m=0.6))
    with pytest.raises(ConfigError, match="for bodies of at most 0.5 m, not of 0.6 m"):
        pilot.check_can_fly(large, TRUE)
    pilot.check_can_fly(large, dataclasses.replace(TRUE, route=RouteConfig(body_m=0.6)))
    blind = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, sensor="blind"))
    with pytest.raises(ConfigError, match="draws no distances"):
        pilot.check_can_fly(blind, PilotConfig(depth="decoded"))
    pilot.check_can_fly(blind, TRUE)
    with pytest.raises(ConfigError, match="speed_m_s of a pilot must be more than 0"):
        PilotConfig(speed_m_s=0.0)
