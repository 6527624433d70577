"""The methods of the rivals' benchmark, each as the process that runs it finds it."""

from __future__ import annotations

import dataclasses
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edqn_jax.cli.train import parse_train
from edqn_jax.config import Config
from edqn_jax.config.loading import to_yaml
from edqn_jax.sim.scene.mjcf import write_scene
from rivals import learners, planning, rival, table
from tests.support.benchmarks.turns import row
from tests.support.benchmarks.uninstalled import hide
from tests.support.miniature import MINIATURE
from tests.support.small_worlds import WITHOUT_A_WAY, small_world

TINY = (
    *(*MINIATURE, "--total-steps", "512", "--train.chunk-steps", "8", "--train.validation-every", "256"),
    *("--drone.physics", "rigid_body"),  # compiles sooner
)


def answers_of(name: str, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: str) -> list[Any]:
    """What the child of a method says, run in this process."""
    file = tmp_path / "config.yaml"
    file.write_text(to_yaml(config))
    monkeypatch.setattr(sys, "argv", ["rival.py", name, str(file), "1.0", "1"])
    monkeypatch.setattr(sys, "stdin", io.StringIO(asked))
    monkeypatch.setattr(rival, "use_cpu_devices", lambda: None)
    stream = io.StringIO()
    rival.main(stream)
    return [json.loads(line) for line in stream.getvalue().splitlines()]


@pytest.mark.parametrize("name", ["RRT*", "Conventional stack", "Conventional stack, steady"])
def test_a_missing_package_is_a_reason(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "numba", "ompl")
    (said,) = answers_of(name, parse_train(MINIATURE)[1], tmp_path, monkeypatch, "0\n")
    assert said == {"reason": "numba is not installed; run pip install 'edqn-jax[bench]'"}


@pytest.mark.slow
def test_a_planner_says_no_path_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shut = tmp_path / "shut.xml"
    write_scene(WITHOUT_A_WAY["wall across"].scene, shut, title="shut")
    _, config = parse_train(["--world", str(shut)])
    about, *turns = answers_of("SNN", config, tmp_path, monkeypatch, "0\n1\n")
    assert about["workload"]["obstacles"] == 1 and about["device"]
    assert [turn["seed"] for turn in turns] == [0, 1]
    for one in turns:
        assert one["flights"]["outcome"] == ["no_path"]
        assert one["flights"]["reason"][0].startswith("no path")
        assert one["peak_bytes"] > 10**7
        one["flights"]["shortest_m"] = [None]
    shown = table.methods([row("SNN", turns, "shut.xml")])
    assert "| 0 of 1: 0% (" in shown and "- SNN: no path: the wave does not reach the start." in shown


@pytest.mark.slow
def test_the_judged_worlds_are_those_that_training_ends_with() -> None:
    _, config = parse_train([*MINIATURE, "--world", "medium", "--world.flown", "", "--world.pool-size", "4"])
    scenes = planning.judged_scenes(config, 2)
    final = learners.run_missions(config).final.env_params
    for index, scene in enumerate(scenes):
        np.testing.assert_array_equal(scene.start, final.missions.start[index])
        np.testing.assert_array_equal(scene.goal, final.missions.goal[index])


@pytest.mark.slow
def test_many_worlds_have_the_shortest_paths_of_each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [small_world().scene, WITHOUT_A_WAY["wall across"].scene, small_world().scene]
    alone = planning.shortest_lengths(Config(), scenes)
    monkeypatch.setattr(planning, "MANY", 2)
    assert planning.shortest_lengths(Config(), scenes) == alone
    assert alone[1] is None and alone[0] == alone[2] and alone[0] is not None


@pytest.mark.slow
def test_a_learner_compiles_once_and_a_seed_comes_to_the_same_whatever_came_before(tmp_path: Path) -> None:
    clear = tmp_path / "clear.xml"
    write_scene(small_world().scene, clear, title="clear")
    _, config = parse_train([*TINY, "--world", str(clear)])
    # Blind, since it compiles soonest: it has no camera and no VAE.
    learner = learners.Learner(learners.sensing(config, "DQN blind"))
    first, second, again = (learner.turn(seed) for seed in (0, 1, 0))
    assert first["decisions"] == 512 and len(first["curve"]) == 2
    assert [point["decisions"] for point in first["curve"]] == [256, 512]
    assert first["curve"][0]["seconds"] < first["train_seconds"]
    for one in (first, second, again):
        del one["train_seconds"], one["first_success_seconds"], one["flights"]["planning_seconds"]
        for point in one["curve"]:
            del point["seconds"]
    assert first == again
    assert first != second
    assert len(first["flights"]["outcome"]) == len(first["curve"][0]["test"]) == 1


def test_learners_differ_in_what_they_see_and_in_nothing_else() -> None:
    _, config = parse_train([*MINIATURE, "--env.sensor", "depth"])
    seen = [learners.sensing(config, name) for name in learners.LEARNERS]
    assert [one.env.sensor for one in seen] == ["events", "frames", "frame-pair", "blind", "depth", "ranges"]
    same = [dataclasses.replace(one, env=dataclasses.replace(one.env, sensor="depth")) for one in seen]
    assert all(one == config for one in same)
