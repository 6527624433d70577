"""When a run validates, and which of its parameters it ends with."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest

from edqn_jax.config import Config, TrainConfig, WorldConfig
from edqn_jax.config.loading import make_config
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.schedule import Schedule
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.training.selection import Candidate, choose_candidate, first_success, is_due, make_candidate


@pytest.mark.parametrize(
    ("keep", "spls", "ends_with"),
    [
        ("best", [0.5, 0.9, 0.7], 200),
        ("best", [0.9, 0.5, 0.9], 300),  # the latest among equals
        ("best", [0.0], 100),  # what flies nowhere still comes before what was never flown
        ("last", [0.5, 0.9, 0.7], 300),
        ("best", [], 0),
        ("last", [], 0),
    ],
)
def test_a_run_ends_with_the_parameters_of_the_best_spl_or_the_last(
    keep: Literal["best", "last"], spls: list[float], ends_with: int
) -> None:
    params = PolicyParams(encoder={}, q={})
    kept = Candidate(params)
    for number, weighted in enumerate(spls, 1):
        # The success rate falls all the while: it must not count.
        kept = choose_candidate(keep, kept, Candidate(params, weighted, 1 / number, decisions=100 * number))
    assert kept.decisions == ends_with


def test_a_validation_is_scored_by_how_its_flights_ended() -> None:
    config = make_config("paper", train={"validation_missions": 4})
    missions = run_missions(config)
    of_all = len(missions.validation.env_params.missions.scene)
    ended = np.full(of_all, Outcome.TIME_OUT)
    ended[0], ended[1] = Outcome.GOAL, Outcome.COLLISION
    flights = SimpleNamespace(outcome=ended, path_length_m=np.full(of_all, 30.0))
    found = make_candidate(config, missions, flights, PolicyParams(encoder={}, q={}), 64)  # type: ignore[arg-type]
    assert (found.success, found.timed_out, found.decisions) == (1 / of_all, (of_all - 2) / of_all, 64)


def test_a_policy_flies_the_mission_from_its_first_good_validation() -> None:
    rates = [(100, 1.0, 0.5), (200, 2.0, 0.89), (300, 3.0, 0.9), (400, 4.0, 0.8)]
    assert first_success(rates) == (300, 3.0)
    assert first_success(rates[:2]) == (None, None)
    assert first_success([]) == (None, None)


@pytest.mark.parametrize(
    ("every", "checked", "done", "due"),
    [
        (100, 96, 6, False),  # 96 decisions of 16 environments
        (100, 96, 7, True),  # 112: a multiple is crossed, though not met
        (100, 112, 12, False),
        (100, 112, 13, True),
        (100, 0, 5, False),  # nothing is learnt before step 5
        (64, 0, 5, False),
        (64, 0, 6, True),
        (0, 96, 100, False),
    ],
)
def test_a_validation_is_due_where_a_multiple_is_crossed_once_there_was_learning(
    every: int, checked: int, done: int, due: bool
) -> None:
    config = Config(train=TrainConfig(num_envs=16, validation_every=every))
    assert is_due(config, Schedule(total=200, scheduled=200, warmup=0, starts=5, vae_training=()), checked, done) is due


@pytest.mark.whole
@pytest.mark.slow
def test_half_of_the_validation_begins_near_the_start_and_all_of_it_in_random_worlds() -> None:
    few = TrainConfig(validation_missions=16)
    own, random = Config(train=few), Config(train=few, world=WorldConfig(name="sparse", pool_size=2, missions=8))
    assert run_missions(own).near_start.sum() == own.train.validation_missions // 2
    assert run_missions(random).near_start.all()
