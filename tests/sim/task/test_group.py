"""Several drones in one world: what they hit, see and wait for."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.sim.actions import move_number
from edqn_jax.sim.environment import make
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.scene import build_scene, stack_scenes
from edqn_jax.sim.sensors.event_field import event_image
from edqn_jax.sim.task import env, group
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.missions import Missions
from edqn_jax.sim.task.outcomes import Outcome
from tests.oracles.group_plain import walked
from tests.support.drawn_scenes import GROUND
from tests.support.marks import in_whole

VOLUME = np.array([[0.0, 0.0, 0.0], [60.0, 40.0, 20.0]])
AHEAD, HOVER, UP = (int(move_number(name)) for name in ("ahead", "hover", "up"))
PARTS = 400


def configured(drones: int, **env_options: Any) -> Config:
    config = make_config(
        "medium",
        drone={"physics": "rigid_body"},
        events={"frame_times_s": [-0.04, 0.0]},
        env={"max_decisions": 40, **env_options},
        encoder={"code_size": 4},
    )
    # Not checked: groups of three need not fit the default number of environments.
    return dataclasses.replace(config, env=dataclasses.replace(config.env, drones=drones))


CONFIG = configured(2)
N, RADIUS = CONFIG.drone.physics_steps, CONFIG.drone.body_radius_m


def world_of(*ends) -> EnvParams:
    """Level ground, and one mission for each (start, goal)."""
    starts, goals = (np.array(points, np.float32) for points in zip(*ends, strict=True))
    scene = build_scene([GROUND], volume=VOLUME, start=starts[0], goal=goals[0])
    missions = Missions(jnp.zeros(len(ends), jnp.int32), jnp.asarray(starts), jnp.asarray(goals))
    return EnvParams(load_airframe(CONFIG.drone), stack_scenes([scene]), missions)


@partial(jax.jit, static_argnums=0)
def begin(config: Config, world: EnvParams, keys, number):
    return jax.vmap(partial(env.before_reset, config, world))(keys, number)


@partial(jax.jit, static_argnums=(0, 1))
def step_of(config: Config, free: bool, world: EnvParams, states, moves, number):
    """The world is an argument, so that one program flies in all."""
    one = lambda s, a, m: env.step(config, world, s, a, None if free else m)  # noqa: E731
    return group.map_drones(config, one)(states, moves, number)


def fly(world: EnvParams, moves, config: Config = CONFIG, missions=None, key: int = 0, free: bool = False):
    """Steps of all drones: the reset, and one for each row of moves [N]; with the states after each."""
    count = world.missions.scene.shape[0]
    number = jnp.arange(count) if missions is None else jnp.asarray(missions)
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(key)))(number)
    states = [begin(config, world, keys, number)]
    steps = []
    for row in [[HOVER] * count, *moves]:
        state, done = step_of(config, free, world, states[-1], jnp.asarray(row, jnp.int32), number)
        states.append(state)
        steps.append(done)
    return states[1:], steps


def first_end(steps, drone: int) -> int:
    return next(i for i, step in enumerate(steps) if int(step.outcome[drone]) != Outcome.RUNNING)


def numbers(steps):
    return jax.tree.map(np.asarray, [(s.outcome, s.end_step, s.contact, s.reward, s.flight.position) for s in steps])


# ------------------------------------------------------------------------------------------- what is hit


def test_two_drones_that_fly_head_on_collide_at_the_same_moment_where_their_spheres_touch():
    world = world_of(((10, 20, 6), (50, 20, 6)), ((30, 20, 6), (2, 20, 6)))
    _, steps = fly(world, [[AHEAD, AHEAD]] * 14)
    ends = first_end(steps, 0)
    last = steps[ends]
    assert ends == first_end(steps, 1) and list(last.outcome) == [Outcome.COLLISION] * 2 and all(last.hit_drone)
    assert int(last.end_step[0]) == int(last.end_step[1]) and float(last.contact[0]) == float(last.contact[1])
    assert 0 < float(last.contact[0]) < 1
    assert np.allclose(last.reward, CONFIG.env.collision_reward, atol=40)  # and what the last metres brought
    row = int(last.end_step[0]) - 1
    path = np.concatenate([np.asarray(steps[ends - 1].flight.position)[:, -1:], last.flight.position], axis=1)
    at = path[:, row] + float(last.contact[0]) * (path[:, row + 1] - path[:, row])
    assert np.linalg.norm(at[0] - at[1]) == pytest.approx(2 * RADIUS, abs=1e-5)
    # The end of the physics step is within: nothing was missed before.
    assert (
        np.linalg.norm(path[0, row + 1] - path[1, row + 1]) < 2 * RADIUS < np.linalg.norm(path[0, row] - path[1, row])
    )


@pytest.mark.parametrize(("aside", "hits"), [(2 * RADIUS + 0.01, False), (2 * RADIUS - 0.01, True)])
def test_drones_that_pass_a_centimetre_apart_do_not_collide_and_a_centimetre_nearer_they_do(aside, hits):
    y = np.float32(20 + aside)
    world = world_of(((10, 20, 6), (55, 20, 6)), ((30, y, 6), (1, y, 6)))
    _, steps = fly(world, [[AHEAD, AHEAD]] * 14)
    apart = min(np.abs(s.flight.position[0] - s.flight.position[1])[:, 0].min() for s in steps)
    assert apart < 0.2 or hits  # they have passed
    assert any(bool(step.hit_drone.any()) for step in steps) == hits
    if not hits:
        assert all((np.asarray(step.outcome) == Outcome.RUNNING).all() for step in steps)


def test_a_drone_that_has_ended_is_neither_hit_nor_seen_and_its_group_is_reset_when_all_have_ended():
    # The second arrives in the way of the first, 4 m before it; then the first flies through the place.
    config = configured(2, sensor="depth", goal_radius_m=0.5)
    world = world_of(((10, 20, 17), (24, 20, 17)), ((14, 25, 17), (14, 20, 17)))
    states, steps = fly(world, [[HOVER, AHEAD]] * 7 + [[AHEAD, AHEAD]] * 20, config)
    gone, arrived = first_end(steps, 1), first_end(steps, 0)
    assert int(steps[gone].outcome[1]) == Outcome.GOAL and int(steps[arrived].outcome[0]) == Outcome.GOAL
    path = np.concatenate([np.asarray(step.flight.position[0]) for step in steps[gone + 1 : arrived + 1]])
    assert np.linalg.norm(path - np.asarray(states[gone].drone.position[1]), axis=1).min() < RADIUS
    near = [np.asarray(step.observation.sensed)[0, 0].max() for step in steps[: arrived + 1]]
    assert max(near[gone:]) < 0.5 < 1.2 < max(near[:gone])  # the ground alone, 17 m below; and the other drone
    for i in range(gone + 1, arrived + 1):
        assert list(steps[i].waits) == [False, True] and bool(steps[i].is_reset[1]) and bool(states[i].ended[1])
        assert float(steps[i].reward[1]) == 0.0 and int(steps[i].outcome[1]) == Outcome.RUNNING
        assert np.array_equal(steps[i].flight.position[1], np.repeat(states[gone].drone.position[1:], N, axis=0))
        assert int(states[i].decision[1]) == int(states[gone].decision[1])
        assert float(states[i].episode_return[1]) == float(states[gone].episode_return[1])
    after = steps[arrived + 1]
    assert all(after.is_reset) and not any(after.waits) and not any(states[arrived + 1].ended)
    assert list(states[arrived + 1].decision) == [0, 0]
    assert np.allclose(states[arrived + 1].drone.position, world.missions.start)


@pytest.mark.whole
def test_all_of_a_group_are_reset_to_the_missions_of_one_block_in_their_order():
    ends = [((10 + 2 * i, 5 + 7 * k, 6), (50, 5 + 7 * k, 6)) for k in range(5) for i in range(3)]
    config, world = configured(3, sensor="blind"), world_of(*ends)
    keys = jax.random.split(jax.random.key(3), 30)
    state = group.map_drones(config, partial(env.before_reset, config, world))(keys)
    state, _ = jax.jit(group.map_drones(config, partial(env.step, config, world)))(state, jnp.zeros(30, jnp.int32))
    drawn = np.asarray(state.mission).reshape(10, 3)
    assert np.array_equal(drawn % 3, np.tile(np.arange(3), (10, 1)))
    assert np.array_equal(drawn // 3, np.repeat(drawn[:, :1] // 3, 3, axis=1))
    assert len(np.unique(drawn[:, 0])) > 2


LENGTHS = st.integers(2, 5)


@st.composite
def flights_of_groups(draw):
    """Paths of up to 5 drones close to each other, at up to 15 m/s; some have ended, some end for another reason."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(LENGTHS)
    # On a grid of 1 m, so that none touch at first: which of them hit each other then would be anybody's choice.
    corners = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), -1).reshape(-1, 3)
    begin = (rng.permutation(corners)[:count] + rng.uniform(-0.1, 0.1, (count, 3)))[:, None]
    steady = rng.uniform(-0.15, 0.15, (count, 1, 3))
    path = begin + np.concatenate(
        [np.zeros((count, 1, 3)), np.cumsum(steady + rng.uniform(-0.03, 0.03, (count, N, 3)), 1)], axis=1
    )
    flies = rng.random(count) < 0.85
    until = np.where(rng.random(count) < 0.3, rng.uniform(0.0, N, count), np.inf)
    return path.astype(np.float32), flies, until.astype(np.float32)


@pytest.mark.whole
@settings(max_examples=150, deadline=None)
@given(flights_of_groups())
def test_hits_are_those_of_a_walk_in_small_steps(given):
    path, flies, until = given
    # The walk overlooks what is over within a part, and rounding decides what only grazes: with spheres larger or
    # smaller by a tenth of a millimetre the same must hit, or the case says nothing.
    first, last = (walked(path, flies, until, 2 * RADIUS + by, PARTS) for by in (1e-4, -1e-4))
    if not np.array_equal(np.isfinite(first), np.isfinite(last)) or np.nanmax(np.abs(_differ(first, last))) > 0.1:
        return
    found = np.asarray(ENCOUNTERS(path, flies, until))
    assert np.array_equal(np.isfinite(found), np.isfinite(first))
    hit = np.isfinite(found)
    assert np.all(found[hit] >= first[hit] - 1.5 / PARTS) and np.all(found[hit] <= last[hit] + 1e-3)


def _differ(a, b):
    return np.where(np.isfinite(a) & np.isfinite(b), a - np.where(np.isfinite(b), b, 0.0), 0.0)


@jax.jit
def ENCOUNTERS(path, flies, until):
    return group.contact_times(path, flies, until, 2 * RADIUS)


def test_who_has_been_hit_hits_nobody_any_more():
    # The first two meet in step 2; the third flies through the second's place later, and would have hit it.
    path = np.zeros((3, N + 1, 3), np.float32)
    path[0, :, 0] = np.linspace(-1.0, -1.0 + 0.1 * N, N + 1)
    path[2, :, 1] = np.linspace(1.5, 1.5 - 0.1 * N, N + 1)
    hit = np.asarray(ENCOUNTERS(path, np.ones(3, bool), np.full(3, np.inf)))
    assert hit[0] == hit[1] == pytest.approx(2.8, abs=1e-4) and hit[2] == np.inf
    alone = np.asarray(ENCOUNTERS(path, np.array([False, True, True]), np.full(3, np.inf)))
    assert alone[0] == np.inf and alone[1] == alone[2] == pytest.approx(7.8, abs=1e-4)
    ended = np.asarray(ENCOUNTERS(path, np.ones(3, bool), np.array([2.5, np.inf, np.inf], np.float32)))
    assert ended[0] == np.inf and ended[1] == pytest.approx(7.8, abs=1e-4)


# ------------------------------------------------------------------------------------------- what is seen


@pytest.mark.parametrize("there", [True, False])
def test_a_drone_that_hovers_sees_events_where_another_flies_through_its_view(there):
    y = 16 if there else 1
    world = world_of(((10, 20, 6), (50, 20, 6)), ((15, y, 6), (15, y + 12, 6)))
    _, steps = fly(world, [[HOVER, AHEAD]] * 4)
    seen = np.array([np.abs(event_image(jax.tree.map(lambda x: x[0], s.observation.sensed))).sum() for s in steps[2:]])
    assert (seen > 5).all() if there else (seen <= 2).all()


@pytest.mark.parametrize("sensor", ["depth-motion", *in_whole("depth", "ranges")])
def test_true_distances_are_to_the_surface_of_the_other_where_it_is_at_the_end_of_the_decision(sensor):
    config = configured(2, sensor=sensor)
    world = world_of(((10, 20, 10), (50, 20, 10)), ((13, 20, 10), (50, 20, 10)))
    states, steps = fly(world, [[HOVER, AHEAD]] * 4, config)
    for state, step in zip(states, steps, strict=True):
        one, other = np.asarray(state.drone.position)
        metres = np.linalg.norm(other - one) - RADIUS
        shown = np.asarray(step.observation.sensed)[0]
        if sensor == "ranges":
            assert shown[int(AHEAD) - (AHEAD > 13)] == pytest.approx(1 / (1 + metres / 4), rel=2e-3)
            continue
        # Pixels' rays pass beside the middle of the sphere, and meet it between its surface and its middle.
        assert 3 / (1 + (metres + RADIUS) / 4) < shown[0].max() < 3 / (1 + metres / 4) + 1e-4
    if sensor == "depth-motion":  # it flies away, and does not move before it starts
        assert shown[1].min() < -0.3 and np.abs(np.asarray(steps[0].observation.sensed)[0, 1]).max() == 0.0


@pytest.mark.whole
def test_the_label_shows_the_others_where_they_are_after_the_decision():
    config = configured(2, sensor="depth")
    world = world_of(((10, 20, 10), (50, 20, 10)), ((13, 20, 10), (50, 20, 10)))
    states, steps = fly(world, [[HOVER, AHEAD]] * 3, config)
    label = jax.jit(group.map_drones(config, partial(env.nearness, config, world)))(states[-1])
    # `depth` shows the same: one way through the decision's path, the other through the states alone.
    assert np.allclose(label, np.asarray(steps[-1].observation.sensed)[:, 0], atol=1e-4)
    assert float(label[0].max()) > 1.0
    over = dataclasses.replace(states[-1], ended=jnp.array([False, True]))
    assert float(jax.jit(group.map_drones(config, partial(env.nearness, config, world)))(over)[0].max()) < 0.9


# ------------------------------------------------------------------------------------------- groups


@pytest.mark.whole
@pytest.mark.slow
def test_another_order_of_the_drones_in_a_group_gives_the_same_flights_in_that_order():
    config = configured(3)
    ends = [((10, 20, 6), (50, 20, 6)), ((30, 20.3, 6), (2, 20.3, 6)), ((20, 10, 6), (20, 36, 6))]
    moves, order = np.array([[AHEAD, AHEAD, UP]] + [[AHEAD, AHEAD, AHEAD]] * 12), [2, 0, 1]
    _, steps = fly(world_of(*ends), moves, config)
    # Missions keep their numbers, and with them keys; only the places in the group are others.
    _, turned = fly(world_of(*ends), moves[:, order], config, missions=order)
    assert any(bool(step.hit_drone.any()) for step in steps)
    for a, b in zip(numbers(steps), numbers(turned), strict=True):
        for x, y in zip(a, b, strict=True):
            assert np.allclose(x[np.array(order)], y, atol=1e-5)


@pytest.mark.whole
def test_a_drone_that_meets_nobody_flies_and_sees_as_alone():
    ends = (((10, 20, 6), (50, 20, 6)), ((4, 38, 6), (1, 39, 6)))
    _, steps = fly(world_of(*ends), [[AHEAD, HOVER]] * 6)
    _, alone = fly(world_of(ends[0]), [[AHEAD]] * 6, configured(1))
    for step, one in zip(steps, alone, strict=True):
        assert one.waits is None and one.hit_drone is None and one.flight.time is None
        assert np.array_equal(step.flight.position[:1], one.flight.position) and int(step.outcome[0]) == Outcome.RUNNING
        assert np.allclose(step.observation.own[:1], one.observation.own, atol=1e-6)  # two programs
        assert np.array_equal(event_image(step.observation.sensed)[:1], event_image(one.observation.sensed))


def test_one_drone_is_mapped_as_ever_and_asks_nobody():
    config, world = configured(1), world_of(((10, 20, 6), (50, 20, 6)))
    states = jax.vmap(partial(env.before_reset, config, world))(
        jax.random.split(jax.random.key(0), 3), jnp.zeros(3, jnp.int32)
    )
    moves = jnp.zeros(3, jnp.int32)
    step = partial(env.step, config, world)
    mapped, plain = (
        [equation.primitive.name for equation in jax.make_jaxpr(each(step))(states, moves).jaxpr.eqns]
        for each in (partial(group.map_drones, config), jax.vmap)
    )
    assert mapped == plain and "all_gather" not in mapped


def test_a_drone_that_waits_is_replaced_by_the_first_of_its_group_that_flies():
    waits = jnp.array([False, True, True, True, True, False, False, False, False])
    assert list(group.active_partner_index(configured(3), waits)) == [0, 0, 0, 5, 5, 5, 6, 7, 8]


def test_what_flies_one_drone_refuses_several_in_a_sentence():
    with pytest.raises(ConfigError, match=r"^edqn_jax.make flies one drone: env.drones must be 1, not 2; .*several$"):
        make(config=CONFIG)
