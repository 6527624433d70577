"""Missions flown in parallel: what is counted, what is not, and the verdict of another engine."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.evaluation import rollouts
from edqn_jax.evaluation.metrics import flight_summary
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.rollouts import Extras, fly_missions, fly_on_all_devices
from edqn_jax.evaluation.trajectories import TRAJECTORY_COLUMNS, flight_trajectory
from edqn_jax.evaluation.verdicts import check_verdicts
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import take_scene
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.policies import CONFIG, always, that_sees

pytestmark = [pytest.mark.slow, pytest.mark.whole]

MISSIONS = 80
DT = CONFIG.drone.physics_dt_s
N = CONFIG.drone.physics_steps


@pytest.fixture(scope="module")
def course() -> MissionSet:
    """The paper's world, each mission level with the goal: straight ahead is the goal, or a block first."""
    course = load_missions(CONFIG, "paper", MISSIONS)
    missions = course.env_params.missions
    level = dataclasses.replace(missions, start=missions.start.at[:, 2].set(missions.goal[:, 2]))
    # A lowered or raised start may stand in a block: such a flight collides at once, which is a case as well.
    return dataclasses.replace(course, env_params=dataclasses.replace(course.env_params, missions=level))


@pytest.fixture(scope="module")
def ahead(course) -> Flights:
    return fly_on_all_devices(CONFIG, course.env_params, always((1, 0, 0)), record=True)


def test_straight_ahead_ends_at_the_goal_or_at_a_block(ahead):
    outcomes = {Outcome(int(kind)) for kind in ahead.outcome}
    assert outcomes == {Outcome.GOAL, Outcome.COLLISION}


def test_straight_up_leaves_the_volume_and_hovering_runs_out_of_time(course):
    up = fly_on_all_devices(CONFIG, course.env_params, always((0, 0, 1)), record=True)
    inside = np.asarray(up.physics_steps) > 1  # not begun in a block
    assert set(up.outcome[inside]) == {Outcome.LEFT_VOLUME}
    still = fly_on_all_devices(CONFIG, course.env_params, always((0, 0, 0)), record=True)
    assert set(still.outcome[inside]) == {Outcome.TIME_OUT}
    assert set(still.decisions[inside]) == {CONFIG.env.max_decisions}
    seconds = CONFIG.env.max_decisions * N * DT
    np.testing.assert_allclose(still.flight_seconds[inside], seconds, rtol=1e-5)  # float32
    assert np.all(still.path_length_m[inside] < 0.05)  # the hover's drift, see docs/drone.md


def test_missions_flown_again_are_not_traced_again(course, ahead):
    traced: list[str] = []

    def listen(event: str, *_: object, **__: object) -> None:
        traced.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    again = fly_on_all_devices(CONFIG, course.env_params, always((1, 0, 0)), record=True)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert np.array_equal(again.outcome, ahead.outcome)
    assert "/jax/core/compile/jaxpr_trace_duration" not in traced


def test_nothing_counts_after_the_end(ahead):
    record = ahead.record
    assert record is not None
    flown = np.arange(record.position.shape[1]) < ahead.physics_steps[:, None]
    decided = np.arange(CONFIG.env.max_decisions) < ahead.decisions[:, None]
    for rows in (record.position, record.quaternion, record.velocity, record.clearance):
        missing = np.isnan(rows).reshape(*flown.shape, -1)
        assert np.array_equal(missing.all(axis=2), ~flown) and np.array_equal(missing.any(axis=2), ~flown)
    assert np.array_equal(record.action >= 0, decided)
    assert np.array_equal(np.isfinite(record.reward), decided)
    np.testing.assert_allclose(np.nansum(record.reward, axis=1), ahead.episode_return, atol=1e-3)  # float32
    assert np.array_equal(-(-ahead.physics_steps // N), ahead.decisions)


def test_tallies_are_those_of_the_recorded_path_cut_at_the_contact(course, ahead):
    pool = course.env_params.pool
    distance = jax.jit(jax.vmap(lambda at: signed_distance(take_scene(pool, 0), at)))
    for i in range(20):
        steps = ahead.physics_steps[i]
        path = np.concatenate([course.env_params.missions.start[i][None], ahead.record.position[i, :steps]])
        path[-1] = path[-2] + ahead.contact[i] * (path[-1] - path[-2])
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert ahead.path_length_m[i] == pytest.approx(length, rel=1e-4)  # float32 sums of 100 m
        assert ahead.flight_seconds[i] == pytest.approx(DT * (steps - 1 + ahead.contact[i]), rel=1e-4)
        padded = np.tile(path[:1], (1 + ahead.record.position.shape[1], 1))
        padded[: len(path)] = path
        clearance = np.asarray(distance(jnp.asarray(padded)))[: len(path)] - CONFIG.drone.body_radius_m
        least = int(np.argmin(clearance))
        assert ahead.closest.distance[i] == pytest.approx(clearance[least], abs=1e-4)
        closest = ahead.closest.position[i]
        assert clearance[least] == pytest.approx(
            float(signed_distance(take_scene(pool, 0), closest)) - CONFIG.drone.body_radius_m, abs=1e-4
        )
        np.testing.assert_allclose(ahead.record.clearance[i, :steps], clearance[1:], atol=1e-4)


def test_a_collision_is_closest_at_its_contact(ahead):
    hit = (ahead.outcome == Outcome.COLLISION) & (ahead.physics_steps > 1)
    assert hit.sum() >= 5
    np.testing.assert_allclose(ahead.closest.distance[hit], 0.0, atol=1e-3)
    np.testing.assert_allclose(ahead.closest.time[hit], ahead.flight_seconds[hit], rtol=1e-5)


def test_a_goal_is_reached_within_its_radius_at_the_last_step_and_not_before(course, ahead):
    for i in np.flatnonzero(ahead.outcome == Outcome.GOAL):
        path = ahead.record.position[i, : ahead.physics_steps[i]]
        apart = np.linalg.norm(path - np.asarray(course.env_params.missions.goal[i]), axis=1)
        assert apart[-1] < CONFIG.env.goal_radius_m <= apart[-2]


def test_every_verdict_is_c_mujocos_too(course, ahead):
    results = check_verdicts(CONFIG, course, ahead)
    assert len(results) == MISSIONS
    assert all(result.agrees for result in results)
    # The same step to the number, and apart by what float32 leaves of a metre.
    assert max(result.apart_m for result in results if result.apart_m is not None) < 1e-3


def test_a_wrong_verdict_is_noticed(course, ahead):
    goal = int(np.flatnonzero(ahead.outcome == Outcome.GOAL)[0])
    hit = int(np.flatnonzero((ahead.outcome == Outcome.COLLISION) & (ahead.physics_steps > 1))[0])

    def agree(**changed) -> list[bool]:
        return [result.agrees for result in check_verdicts(CONFIG, course, dataclasses.replace(ahead, **changed))]

    swapped = np.array(ahead.outcome)
    swapped[goal], swapped[hit] = Outcome.COLLISION, Outcome.GOAL
    assert np.flatnonzero(~np.array(agree(outcome=swapped))).tolist() == sorted([goal, hit])
    # A contact stated half a physics step (4 cm) from where it is.
    moved = np.array(ahead.contact)
    moved[hit] = (moved[hit] + 0.5) % 1.0
    assert np.flatnonzero(~np.array(agree(contact=moved))).tolist() == [hit]


def test_shuffling_moves_the_codes_and_nothing_else(course):
    world = course.env_params

    def decisions(codes: bool, own: bool, shuffled: bool) -> np.ndarray:
        params = that_sees(codes, own)
        if not shuffled:  # on two devices
            flown = fly_on_all_devices(CONFIG, world, params, record=True)
        else:  # on one: the layout must not matter either
            flown = fly_missions(
                CONFIG, world, params, jax.random.key(0), extras=Extras(shuffle_codes=True, record=True)
            )
        assert flown.record is not None
        return np.asarray(flown.record.action)

    assert np.array_equal(decisions(False, True, False), decisions(False, True, True))
    kept, moved = decisions(True, False, False), decisions(True, False, True)
    both = (kept >= 0) & (moved >= 0)
    assert np.mean(kept[both] != moved[both]) > 0.2  # most views differ, but moves are few


def test_the_ends_of_flights_are_told_as_they_fly_and_change_no_flight(course, monkeypatch):
    count = MISSIONS - 1  # a mission is flown twice to fill up the devices
    world = dataclasses.replace(
        course.env_params, missions=jax.tree.map(lambda leaf: leaf[:count], course.env_params.missions)
    )
    told: list[tuple[Any, ...]] = []
    whole = fly_on_all_devices(CONFIG, world, always((1, 0, 0)), record=True)
    monkeypatch.setattr(rollouts, "DRONES_A_PIECE", MISSIONS)
    pieces = fly_on_all_devices(CONFIG, world, always((1, 0, 0)), record=True, phase=lambda *words: told.append(words))
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(pieces), strict=True):
        assert np.array_equal(one, other, equal_nan=True) and len(one) == count
    assert told[:2] == [("compiling",), ("flying the missions", 0, count)]
    ended = [done for name, done, total in told[1:] if (name, total) == ("flying the missions", count)]
    assert len(ended) == len(told) - 1 and ended == sorted(ended) and ended[-1] == count and len(set(ended)) > 3
    # Each of 2 devices flies 2 or 3 decisions a piece; the count is one piece late.
    assert len(ended) <= whole.decisions.max() // 2 + 3


def test_one_mission_has_nobody_to_shuffle_with(course):
    world = course.env_params
    alone = dataclasses.replace(world, missions=jax.tree.map(lambda leaf: leaf[:1], world.missions))
    with pytest.raises(ValueError, match="at least two missions"):
        fly_missions(CONFIG, alone, always((0, 0, 0)), jax.random.key(0), extras=Extras(shuffle_codes=True))


def test_a_recorded_flight_becomes_columns_and_a_summary_and_compiles_nothing_anew(course):
    mesh = Mesh(np.asarray(jax.devices()), ("mission",))
    layout = NamedSharding(mesh, PartitionSpec())
    world, params = jax.device_put((course.env_params, always((1, 0, 0))), layout)
    key = jax.random.key(0)
    options: Any = {"extras": Extras(record=True), "mesh": mesh}
    options["programs"] = rollouts.trace_missions(CONFIG, world, lambda: params, key, **options)()
    another_key = jax.random.key(1)
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.append(event))
    flown = fly_missions(CONFIG, world, params, key, **options)
    fly_missions(CONFIG, world, params, another_key, **options)
    jax.monitoring.clear_event_listeners()
    assert "/jax/core/compile/backend_compile_duration" not in compiled
    mission = int(np.flatnonzero(np.asarray(flown.outcome) == Outcome.COLLISION)[0])
    start = np.asarray(world.missions.start[mission])
    columns = flight_trajectory(CONFIG, flown, mission)
    summary = flight_summary(flown, mission)
    assert tuple(columns) == TRAJECTORY_COLUMNS
    assert {len(column) for column in columns.values()} == {int(flown.physics_steps[mission])}
    np.testing.assert_allclose([columns[axis][0] for axis in "xyz"], start, atol=0.01)  # one physics step from rest
    np.testing.assert_allclose(columns["t"][[0, -1]], [DT, DT * len(columns["t"])])
    assert summary["outcome"] == "collision" and not summary["success"]
    assert summary["steps"] == -(-len(columns["t"]) // N)
    rewards = columns["reward"][::N]
    assert summary["return"] == pytest.approx(rewards.sum(), abs=1e-3)
    straight = np.linalg.norm(np.array([columns[axis][-1] for axis in "xyz"]) - start)
    assert straight - 0.1 <= summary["path_length_m"] <= straight + 1.0
