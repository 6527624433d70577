"""The throughput benchmark: what it times is what training does, and its figures are put together rightly."""

from __future__ import annotations

import json
import statistics

import pytest

import throughput
from edqn_jax.errors import ConfigError
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.trainer import Trainer
from edqn_jax.runs.directory import to_plain_json
from measurement.parts import parts_of
from tests.support.miniature import MINIATURE


def test_the_vae_learns_throughout_and_four_samples_are_replayed() -> None:
    _, config = throughput.parse([])
    assert config.encoder.keep_learning
    assert config.agent.updates_per_step * config.agent.batch_size == 4 * config.train.num_envs
    plan = Schedule.from_config(config)
    # The timed chunks come after the beginning, in which less is learnt.
    assert plan.warmup == config.train.chunk_steps and plan.learn_from <= 2 * config.train.chunk_steps


def test_flags_that_say_how_much_to_replay_are_obeyed() -> None:
    _, config = throughput.parse(["--", "--agent.updates-per-step", "7", "--num-envs", "64"])
    assert (config.agent.updates_per_step, config.train.num_envs) == (7, 64)


def test_another_sensor_is_timed_as_a_whole_only() -> None:
    words = ["--", "--env.sensor", "blind"]
    with pytest.raises(ConfigError, match="blind needs --whole-only"):
        throughput.parse(words)
    args, config = throughput.parse(["--whole-only", *words])
    assert args.whole_only and config.env.sensor == "blind" and Schedule.from_config(config).warmup == 0


@pytest.mark.slow
def test_parts_are_timed_beside_their_floors_and_c_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    class Whole:
        """Stands for the compiled chunk, which other tests compile."""

        compile_seconds = 1.0

        def __init__(self, config, world, devices) -> None:
            self.state = Trainer(config, world, devices).init(0)

        def turn(self) -> float:
            return 1000.0

    monkeypatch.setattr(throughput, "WholeStep", Whole)
    cheap = ("acting", "replay", "sampling")
    monkeypatch.setattr(throughput, "parts_of", lambda *moment: parts_of(*moment, names=cheap))
    _, config = throughput.parse(["--quick", "--", *MINIATURE])
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
    assert "dqn_update" not in rows  # what it is subtracted from was not timed
    assert report["workload"]["vae_samples_per_decision"] == 1
    assert "C MuJoCo rollout" in throughput.table(report)
    assert json.dumps(to_plain_json(report), allow_nan=False)


def test_rows_by_subtraction_say_so() -> None:
    us = {"environment": 100.0, "environment_without_resets": 97.0, "dqn_update_and_sampling": 30.0, "sampling": 4.0}
    rows = {row["name"]: row for row in throughput.differences(us)}
    assert {name: row["us_per_decision"] for name, row in rows.items()} == {"resets": 3.0, "dqn_update": 26.0}
    assert rows["dqn_update"]["by_subtraction"] == "dqn_update_and_sampling - sampling"
    whole = {
        "name": "whole_training_step",
        "decisions_per_second": 7000.0,
        "physics_steps_per_second": 91_000.0,
        "us_per_decision": 286.0,
        "over_c_mujoco_rollout": 0.1,
    }
    rollout = {"name": "c_mujoco_rollout", "physics_steps_per_second": 1e6, "threads": 2}
    limits = [{"name": name, "per_device": 1e9} for name in ("product_flops", "vector_flops", "copy_bytes")]
    report = {
        "device": "a device",
        "devices": ["cpu:0"],
        "workload": {
            **{"num_envs": 256, "replayed_samples_per_decision": 4.0, "vae_samples_per_decision": 1.0},
            "physics": "rigid_body",
        },
        "repeats": 5,
        "compile_seconds": 20.0,
        "rows": [whole, rollout, *rows.values(), *limits],
    }
    shown = throughput.table(report)
    assert "physics by rigid_body" in shown  # the bar is on MJX
    assert "| dqn update (by subtraction: dqn update and sampling − sampling) | 26.0 |  |  |" in shown
