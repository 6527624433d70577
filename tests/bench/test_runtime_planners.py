"""Every planner as a row of the rivals' benchmark: what it plans is flown, and a missing path is reported."""

from __future__ import annotations

from pathlib import Path

import pytest

from edqn_jax.cli.train import parse_train
from edqn_jax.config import Config
from edqn_jax.sim.scene.mjcf import write_scene
from rivals.planners.planner import PLANNERS
from rivals.planning import Planning
from tests.support.small_worlds import WITHOUT_A_WAY, box, small_world

BUDGET_SECONDS = 0.5
MISSIONS = {"open": small_world(box((4, -1, 0), (6, 5, 7))), **WITHOUT_A_WAY}
"""A wall beside the straight line, and worlds without a way."""


def configured(world: str, folder: Path) -> Config:
    file = folder / "world.xml"
    write_scene(MISSIONS[world].scene, file, title=world)
    return parse_train(["--world", str(file)])[1]


@pytest.mark.parametrize("name", PLANNERS)
def test_a_planned_path_is_flown_to_the_goal(name: str, tmp_path: Path) -> None:
    rival = Planning(name, configured("open", tmp_path), BUDGET_SECONDS, 1)
    flown = rival.turn(0)["flights"]
    assert flown["outcome"] == ["goal"] and flown["reason"] == [""]
    assert 0.0 < flown["planning_seconds"][0]
    if name.endswith("first path"):
        assert flown["planning_seconds"][0] < BUDGET_SECONDS
    if name == "RRT*":  # BIT* ends when it has found the straight way
        assert flown["planning_seconds"][0] >= BUDGET_SECONDS
    # From start to goal there are 8 m; the flight ends within the goal's radius.
    assert 8.0 <= flown["planned_m"][0]
    assert 5.9 < flown["path_length_m"][0] < 12.0
    assert flown["clearance_m"][0] > 0.0


@pytest.mark.parametrize("world", WITHOUT_A_WAY)
@pytest.mark.parametrize("name", PLANNERS)
def test_where_there_is_no_way_it_says_so_and_comes_back(name: str, world: str, tmp_path: Path) -> None:
    rival = Planning(name, configured(world, tmp_path), BUDGET_SECONDS, 1)
    flown = rival.turn(0)["flights"]
    assert flown["outcome"] == ["no_path"] and flown["reason"][0].startswith("no path")
    assert flown["path_length_m"] == [0.0] and flown["planned_m"] == [None]
