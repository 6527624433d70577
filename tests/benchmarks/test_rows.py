"""What the turns of a rival come to, and what events are worth."""

from __future__ import annotations

import statistics
from typing import Any

import pytest

from edqn_jax.errors import ConfigError
from rivals import rows, table
from rivals.planners.planner import PLANNERS
from tests.support.benchmarks.turns import flights, row, turn


def test_figures_are_of_flights_that_arrived_and_success_is_of_all() -> None:
    first = turn(0, flights("goal", "collision", "goal"))
    first["flights"]["flight_seconds"] = [30.0, 1.0, 34.0]
    first["flights"]["clearance_m"] = [0.4, -0.1, 0.7]
    shown = rows.figures(row("E-DQN", [first, turn(1, flights("goal", "goal", "goal"), 60.0)]))
    assert (shown["successes"], shown["flights"]) == (5, 6)
    assert shown["flight_seconds"] == statistics.median([30.0, 34.0, 31.0, 31.0, 31.0])
    assert shown["clearance_m"] == 0.4
    assert shown["path_over_shortest"] == pytest.approx(1.04)
    assert shown["train_seconds"] == 50.0 and shown["peak_bytes"] == 10**9


def test_most_seeds_that_never_fly_make_the_training_time_never() -> None:
    never: dict[str, Any] = {"first_success_seconds": None, "first_success_decisions": None}
    some = [turn(0, flights("goal")), turn(1, flights("goal")), turn(2, flights("collision"), **never)]
    assert rows.figures(row("E-DQN", some))["train_seconds"] == 40.0
    lost = row("E-DQN", [some[0], turn(1, flights("collision"), **never), some[2]])
    assert rows.figures(lost)["train_seconds"] is None
    assert "| never |" in table.methods([lost])


@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_that_draws_nothing_counts_once_but_is_timed_every_time(name: str) -> None:
    turns = [turn(seed, flights("goal", planning_seconds=float(seed), planned_m=130.0)) for seed in (1, 2, 3)]
    shown = rows.figures(row(name, turns, "paper"))
    assert shown["flights"] == (3 if "RRT*" in name or "BIT*" in name else 1)
    assert shown["planning_seconds"] == 2.0


def test_rows_of_several_files_become_one_with_the_seeds_of_all() -> None:
    parts = [row("E-DQN", [turn(seed, flights("goal", "goal"))]) for seed in (0, 1)]
    elsewhere = row("E-DQN", [turn(0, flights("goal", "goal"))], device="another machine")
    joined = rows.join_rows([*parts, elsewhere])
    assert [[one["seed"] for one in row["turns"]] for row in joined] == [[0, 1], [0]]
    assert len(parts[0]["turns"]) == 1  # what was read stays as it was
    with pytest.raises(ConfigError, match="seed 0 of E-DQN on medium occurs twice"):
        rows.join_rows([parts[0], parts[0]])


def test_a_row_that_could_not_run_gives_way_to_one_that_ran_elsewhere() -> None:
    missing = row("A*", [], device=None, reason="numba is not installed")
    assert rows.join_rows([missing, row("SNN", [])]) == [missing, row("SNN", [])]
    ran = row("A*", [turn(0, flights("goal"))])
    assert rows.join_rows([missing, ran]) == [ran]


def test_events_are_worth_what_flies_at_equal_decisions_and_at_equal_wall_time() -> None:
    mixed = flights("goal", "goal", "collision", "goal")
    fast = row(
        "DQN blind", [turn(seed, flights("goal", "collision", "collision", "collision"), 10.0) for seed in (0, 1)]
    )
    slow = row("E-DQN", [turn(seed, mixed, 18.0) for seed in (0, 1, 2)])
    (one,) = rows.worth([slow, fast, row("A*", [turn(0, mixed)])])
    assert (one.seconds, one.decisions) == (10.0, 1000)
    ours, blind = one.rates
    assert (ours["name"], ours["seeds"], ours["at_decisions"]["rate"]) == ("E-DQN", 3, 0.75)
    # After 10 s it has what it had kept after 9 s: nothing that flies.
    assert ours["at_seconds"]["rate"] == 0.0 and blind["at_seconds"]["rate"] == 0.25
    (less,) = one.differences
    assert less["name"] == "DQN blind"
    assert (less["at_decisions"]["difference"], less["at_seconds"]["difference"]) == (0.5, -0.25)
    low, high = less["at_decisions"]["interval"]
    assert 0.0 <= low < 0.5 < high <= 1.0
    shown = table.worth_table(one)
    assert "10.0 s of training" in shown and "| E-DQN minus DQN blind | | | +50.0 % (" in shown
    assert "| E-DQN | 3 | 18.0 | 75.0 % (" in shown


def test_before_its_first_validation_a_learner_has_nothing() -> None:
    learner = row("E-DQN", [turn(0, flights("goal", "goal"), 18.0)])
    assert not rows.kept_by(learner, 8.9).any()
    assert rows.kept_by(learner, 18.0).all()


def test_learners_of_other_devices_or_budgets_are_not_compared() -> None:
    many = [turn(0, flights("goal", "collision"))]
    assert not rows.worth([row("E-DQN", many), row("DQN blind", many, device="another machine")])
    assert not rows.worth([row("E-DQN", many), row("DQN blind", many, settings={"quick": True})])
    assert not rows.worth([row(name, [turn(0, flights("goal"))], "paper") for name in ("E-DQN", "DQN blind")])
