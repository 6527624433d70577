"""Planners by name, and the message where a package is missing."""

from __future__ import annotations

import numpy as np
import pytest

from edqn_jax.extras import MissingPackageError, require_extra
from rivals.planners import snn
from rivals.planners.planner import PLANNERS, load_planner, refusal
from tests.support.benchmarks.uninstalled import hide
from tests.support.small_worlds import box, small_world


def test_a_planner_of_the_core_needs_nothing_else():
    assert load_planner("SNN") is snn.plan


@pytest.mark.parametrize("name", [name for name in PLANNERS if name != "SNN"])
def test_without_its_package_a_planner_says_how_to_install_it(name, monkeypatch):
    hide(monkeypatch, "numba", "ompl")
    with pytest.raises(MissingPackageError) as raised:
        load_planner(name)
    assert str(raised.value) == "numba is not installed; run pip install 'edqn-jax[bench]'"


def test_a_broken_package_is_not_a_missing_one(tmp_path, monkeypatch):
    (tmp_path / "broken_inside.py").write_text("import nothing_of_this_name\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="nothing_of_this_name") as raised:
        require_extra("broken_inside")
    assert not isinstance(raised.value, MissingPackageError)


@pytest.mark.parametrize(
    ("ends", "said"),
    [
        ({}, None),
        ({"start": (5.0, 6.0, 3.0)}, "a sphere of 0.36 m does not fit at the start (5, 6, 3)"),
        ({"goal": (10.0, 6.0, 0.3)}, "does not fit at the goal (10, 6, 0.3)"),
        ({"goal": (13.0, 6.0, 3.0)}, "the goal (13, 6, 3) lies outside the flight volume"),
    ],
)
def test_ends_where_nothing_can_stand_are_refused(ends, said):
    task = small_world(box((4, 5, 0), (6, 7, 4)), **ends)
    answer = refusal(task)
    if said is None:
        assert answer is None
        return
    assert answer is not None
    plan = snn.plan(task)
    assert plan.reason == f"no path: {answer}" and np.isnan(plan.first_seconds)
    assert said in answer
