"""The throughput benchmark: what it times is what training does, and its figures are put together rightly."""

from __future__ import annotations

import importlib.util
import json
import statistics
import sys
from pathlib import Path
from types import ModuleType

import pytest

from edqn_jax.learn.trainer import Plan

FILE = Path(__file__).parents[1] / "benchmarks" / "throughput.py"
SMALL = ["--num-envs", "16", "--agent.batch-size", "16", "--agent.replay-size", "512", "--agent.learning-starts", "64"]
SMALL += ["--camera.width", "8", "--camera.height", "6", "--train.validation-missions", "2", "--world.missions", "16"]


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
def test_parts_are_timed_beside_their_floors_and_c_mujoco(
    throughput: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Whole:
        """Stands for the compiled chunk, which other tests compile."""

        compile_seconds = 1.0

        def __init__(self, config, world, devices) -> None:
            self.state = throughput.Trainer(config, world, devices).init(0)

        def turn(self) -> float:
            return 1000.0

    every = throughput.parts_of
    monkeypatch.setattr(throughput, "WholeStep", Whole)
    cheap = {"acting", "replay"}
    monkeypatch.setattr(throughput, "parts_of", lambda *args: [part for part in every(*args) if part.name in cheap])
    _, config = throughput.parse(["--quick", "--", *SMALL])
    report = throughput.measure(config, 2, True)
    rows = {row["name"]: row for row in report["rows"]}
    for name in cheap:
        row = rows[name]
        assert row["operations"] > 0 and row["bytes"] > 0
        assert row["over_floor"] == pytest.approx(row["us_per_decision"] / row["floor_us"])
    assert rows["whole_training_step"]["decisions_per_second"] == report["decisions_per_second"] == 1000.0
    assert rows["whole_training_step"]["physics_steps_per_second"] == 13_000.0
    turns = report["turns"]
    ratios = [13 * step / rollout for step, rollout in zip(turns["whole"], turns["c_mujoco_rollout"], strict=True)]
    assert rows["whole_training_step"]["over_c_mujoco_rollout"] == pytest.approx(statistics.median(ratios))
    assert report["workload"]["vae_samples_per_decision"] == 1
    assert "C MuJoCo rollout" in throughput.table(report)
    assert json.dumps(throughput.plain(report), allow_nan=False)
