"""Evaluation of several drones: which missions they fly; their collisions are those of the recorded flights."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config.loading import make_config, with_conditions
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.evaluate import evaluate
from edqn_jax.evaluation.flight_scene import scene_of_flight
from edqn_jax.evaluation.metrics import summarise_flights
from edqn_jax.evaluation.missions import final_missions, load_missions, run_missions
from edqn_jax.runs.policies import load_policy
from edqn_jax.sim.scene.scene import PARKED, scene_at
from edqn_jax.sim.task.outcomes import Outcome

pytestmark = pytest.mark.whole

DRONES = 4
GROUPS = 3
REACH = 2 * 0.36


@pytest.fixture(scope="module")
def flown():
    policy = load_policy("pretrained")
    conditions = {"env": {"drones": DRONES}}
    return (
        with_conditions(policy.config, conditions, "test"),
        evaluate(policy, "medium", missions=DRONES * GROUPS, conditions=conditions, record=True),
    )


def paths_of(evaluation):
    """Returns the places [M, 1 + T, 3] of all flights, and when each ended [M], in physics steps."""
    flights, missions = evaluation.flights, evaluation.missions.env_params.missions
    paths = np.concatenate([np.asarray(missions.start)[:, None], flights.record.position], axis=1)
    return paths.astype(np.float64), flights.physics_steps - 1 + flights.contact


def at_time(path, time):
    step = min(int(time), len(path) - 2)
    return path[step] + (time - step) * (path[step + 1] - path[step])


def test_collisions_with_drones_are_those_of_the_recorded_flights(flown):
    _, evaluation = flown
    paths, ends = paths_of(evaluation)
    hit = evaluation.flights.hit_drone
    assert 2 <= hit.sum() < len(hit)  # flown by a policy that has never seen another drone
    assert (evaluation.flights.outcome[hit] == Outcome.COLLISION).all()
    for i in range(len(paths)):
        mates = [j for j in range(len(paths)) if j // DRONES == i // DRONES and j != i]
        if hit[i]:
            # Somebody touched it then, and ended, too.
            with_whom = [j for j in mates if hit[j] and ends[j] == ends[i]]
            apart = [np.linalg.norm(at_time(paths[i], ends[i]) - at_time(paths[j], ends[j])) for j in with_whom]
            assert apart and min(apart) == pytest.approx(REACH, abs=1e-3)
        for j in mates:
            # Before, none that were there came as near.
            times = np.arange(0, min(ends[i], ends[j]), 0.25)
            assert all(np.linalg.norm(at_time(paths[i], t) - at_time(paths[j], t)) > REACH - 1e-3 for t in times)


def test_figures_count_drones_groups_and_what_was_hit(flown):
    config, evaluation = flown
    figures, arrived = evaluation.figures, evaluation.flights.outcome == Outcome.GOAL
    assert figures["missions"] == DRONES * GROUPS and figures["groups"] == GROUPS
    assert figures["success_rate"] == arrived.mean()
    assert figures["groups_arrived"] == arrived.reshape(GROUPS, DRONES).all(1).sum()
    assert figures["collisions_with_drones"] == evaluation.flights.hit_drone.sum() <= figures["collisions"]
    alone = summarise_flights(dataclasses.replace(evaluation.flights, hit_drone=None))
    assert not {"groups", "collisions_with_drones"} & set(alone)


def test_the_others_are_in_a_flights_pictures_where_they_were_and_only_while_they_flew(flown):
    config, evaluation = flown
    paths, _ = paths_of(evaluation)
    mission, steps, dt = DRONES + 1, evaluation.flights.physics_steps, config.drone.physics_dt_s
    before = scene_of_flight(config, evaluation.missions)
    scene = scene_of_flight(config, evaluation.missions, evaluation.flights, mission)
    assert before.drones is not None and scene.drones is not None
    assert [np.shape(x) for x in before.drones.path] == [np.shape(x) for x in scene.drones.path]
    assert (before.drones.path == PARKED).all()
    assert np.array_equal(scene.goal, evaluation.missions.env_params.missions.goal[mission])
    others = [DRONES, DRONES + 2, DRONES + 3]
    for step in (0, 1, int(min(steps[others])), int(max(steps[others])) + 3):
        seen = np.asarray(scene_at(scene, jnp.float32(step * dt)).spheres.position)[-3:]
        for place, other in zip(seen, others, strict=True):
            assert (
                np.allclose(place, paths[other, step], atol=1e-5) if step <= steps[other] else (place == PARKED).all()
            )


def test_one_block_of_missions_is_flown_in_each_test_world_and_blocks_of_other_seeds_in_others():
    config = make_config("medium", env={"drones": DRONES})
    alone = load_missions(make_config("medium"), "medium", 6)
    first, second = (load_missions(config, "medium", DRONES * 3, seed) for seed in (0, 1))
    assert np.array_equal(first.env_params.missions.scene, np.repeat(np.arange(3), DRONES))
    for part, of in ((first, slice(0, 3)), (second, slice(3, 6))):
        assert np.array_equal(part.env_params.pool.boxes.position, alone.env_params.pool.boxes.position[of])
    assert not np.isin(np.asarray(first.env_params.missions.start), np.asarray(second.env_params.missions.start)).any()
    # The same however many are flown.
    more = load_missions(config, "medium", DRONES * 5)
    assert np.array_equal(more.env_params.missions.start[: DRONES * 3], first.env_params.missions.start)


def test_a_run_is_validated_and_judged_by_whole_groups_the_first_of_them_in_the_flown_world():
    config = make_config(
        "medium", env={"drones": DRONES}, world={"pool_size": 4, "missions": 32}, train={"validation_missions": 16}
    )
    missions = run_missions(config)
    scenes = [
        np.asarray(each.env_params.missions.scene) for each in (missions.training, missions.validation, missions.final)
    ]
    assert [len(each) for each in scenes] == [32, 16, 16] and missions.tests == 12
    for of in scenes:
        assert (of.reshape(-1, DRONES) == of[::DRONES, None]).all()
    final = missions.final.env_params
    assert np.array_equal(final.pool.start, final.missions.start[::DRONES])
    assert np.array_equal(final_missions(config, 10).env_params.missions.start, final.missions.start[:8])
    assert len(final.missions.start) == len(np.unique(np.asarray(final.missions.start), axis=0))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"missions": 6}, "missions must be a multiple of env.drones (4), not 6"),
        ({"world": "paper", "missions": 8}, "env.drones 4 needs a random world"),
        ({"missions": 4, "start": (5.0, 5.0, 5.0)}, "--start cannot be given with env.drones 4: their missions cross"),
    ],
)
def test_what_several_drones_cannot_fly_is_said_in_a_sentence(arguments, said):
    arguments = {"world": "medium"} | arguments
    with pytest.raises(ConfigError) as error:
        evaluate(load_policy("pretrained"), conditions={"env": {"drones": DRONES}}, **arguments)
    assert str(error.value).startswith(said)


def test_a_number_of_drones_that_training_could_not_have_is_flown():
    policy = load_policy("pretrained")  # trained with 16,384 environments, in worlds with the reward geodesic
    assert with_conditions(policy.config, {"env": {"drones": 3}}, "test").env.drones == 3
