"""RRT* and BIT*: seeds, budgets, and the effect of a larger budget."""

from __future__ import annotations

import numpy as np
import pytest

from edqn_jax.extras import MissingPackageError
from rivals.planners.planner import Budget, load_planner
from tests.support.benchmarks.uninstalled import hide
from tests.support.small_worlds import WITHOUT_A_WAY, assert_flyable, box, small_world

LONG = 600.0  # seconds; the steps end it


@pytest.fixture(params=["RRT*", "BIT*"])
def planner(request):
    return load_planner(request.param)


def test_a_seed_is_a_path_and_another_is_another(planner):
    task, budget = small_world(box((5, 0, 0), (6, 9, 6))), Budget(LONG, 1500)
    first, again, other = (planner(task, budget, seed).path for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or np.any(first != other)


def test_more_steps_shorten_the_path(planner):
    task = small_world(box((5, 0, 0), (6, 9, 6)))
    short, long = (planner(task, Budget(LONG, steps), 0) for steps in (500, 5000))
    assert long.length_m < short.length_m
    assert short.steps <= 501 and long.steps > 4000
    for plan in (short, long):
        assert_flyable(task, plan.path)
        assert plan.length_m <= plan.first_length_m
        assert 0.0 < plan.first_seconds <= plan.seconds
    # The same draws until the first path.
    assert short.first_length_m == long.first_length_m


def test_asked_for_the_first_path_it_ends_with_it(planner, request):
    task, budget = small_world(box((5, 0, 0), (6, 9, 6))), Budget(LONG, 5000)
    first = load_planner(f"{request.node.callspec.params['planner']} first path")(task, budget, 0)
    whole = planner(task, budget, 0)
    assert_flyable(task, first.path)
    # One is our sum, the other OMPL's.
    assert first.length_m == pytest.approx(first.first_length_m, rel=1e-9)
    assert first.first_length_m == whole.first_length_m > whole.length_m
    assert first.steps < whole.steps


def test_a_budget_in_seconds_ends_it(planner):
    plan = planner(WITHOUT_A_WAY["wall across"], Budget(seconds=0.3))
    assert plan.seconds >= 0.3 and plan.steps > 0
    assert plan.reason.startswith("no path: none found within 0.")


@pytest.mark.parametrize("name", ["RRT*", "BIT*"])
def test_without_ompl_it_says_how_to_install_it(name, monkeypatch):
    hide(monkeypatch, "ompl")
    with pytest.raises(MissingPackageError, match=r"ompl is not installed; run pip install 'edqn-jax\[bench\]'"):
        load_planner(name)
