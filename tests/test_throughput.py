"""The throughput benchmark: what it times is what training does, and its figures are put together rightly."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from edqn_jax.learn.trainer import Plan

FILE = Path(__file__).parents[1] / "benchmarks" / "throughput.py"
SMALL = ["--num-envs", "16", "--agent.batch-size", "16", "--agent.replay-size", "512", "--camera.width", "8"]
SMALL += ["--camera.height", "6", "--train.validation-missions", "2", "--world.missions", "16"]


@pytest.fixture(scope="module")
def throughput() -> ModuleType:
    spec = importlib.util.spec_from_file_location("throughput", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their annotations up
    spec.loader.exec_module(module)
    return module


def test_the_vae_learns_throughout_and_four_samples_are_replayed(throughput: ModuleType) -> None:
    _, config = throughput.parse([])
    assert config.encoder.keep_learning
    assert config.agent.updates_per_step * config.agent.batch_size == 4 * config.train.num_envs
    plan = Plan.of(config)
    # The timed chunks come after the beginning, in which less is learnt.
    assert plan.warmup == config.train.chunk_steps and plan.learn_from <= 2 * config.train.chunk_steps


def test_flags_that_say_how_much_to_replay_are_obeyed(throughput: ModuleType) -> None:
    _, config = throughput.parse(["--", "--agent.updates-per-step", "7", "--num-envs", "64"])
    assert (config.agent.updates_per_step, config.train.num_envs) == (7, 64)


@pytest.mark.slow
def test_a_quick_run_measures_the_whole_every_part_and_c_mujoco(throughput: ModuleType, tmp_path: Path, capsys) -> None:
    file = tmp_path / "figures.json"
    args, config = throughput.parse(["--quick", "--json", str(file), "--", *SMALL])
    report = throughput.measure(config, 1, True)
    rows = {row["name"]: row for row in report["rows"]}
    assert rows["whole_training_step"]["decisions_per_second"] == report["decisions_per_second"] > 0
    assert rows["c_mujoco_rollout"]["physics_steps_per_second"] > 0
    for name in ("physics", "rendering", "events", "encoder", "replay", "vae_update", "dqn_update_and_sampling"):
        assert rows[name]["us_per_decision"] > rows[name]["floor_us"] > 0
    assert report["workload"]["vae_samples_per_decision"] == 1
    ratio = rows["whole_training_step"]["over_c_mujoco_rollout"]
    steps = rows["whole_training_step"]["physics_steps_per_second"]
    assert ratio == pytest.approx(steps / rows["c_mujoco_rollout"]["physics_steps_per_second"])
    assert "C MuJoCo rollout" in throughput.table(report)
    assert json.dumps(throughput.plain(report), allow_nan=False)
