"""The scaling benchmark: what it varies, what it counts, and what it makes of its figures."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

import scaling
from curves.boxes import MOST, world_of_boxes
from curves.figure import draw_scaling
from curves.state_bytes import StateBytes, state_bytes
from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.state import init_state
from edqn_jax.runs.directory import to_plain_json
from edqn_jax.sim.scene.mjcf import check_scene, load_scene
from edqn_jax.sim.scene.scene import obstacle_count
from measurement.flags import parse_config
from measurement.timing import size_of
from tests.support.miniature import MINIATURE

BASE = apply_layer(parse_config([]), {"train": {"devices": 2}}, "the test")


def test_a_slope_is_the_power_between_the_ends() -> None:
    assert scaling.slope([10, 20, 1000], [3.0, 99.0, 300.0]) == pytest.approx(1.0)
    assert scaling.slope([64, 4096], [5.0, 5.0]) == 0.0
    # An affine cost is a power below one: ten times the units, 5.5 times the cost.
    assert scaling.slope([1, 10], [1.0 + 1.0, 1.0 + 10.0]) == pytest.approx(np.log10(5.5))


def test_a_curve_says_how_its_turns_differ_and_devices_how_good_they_are() -> None:
    rows = [
        {"x": 1, "us_per_decision": 100.0, "us_turns": [100.0, 100.0, 90.0], "c_mujoco_steps_per_decision": 50.0},
        {"x": 2, "us_per_decision": 125.0, "us_turns": [125.0, 200.0, 90.0], "c_mujoco_steps_per_decision": 25.0},
    ]
    summary = scaling.summarise("devices", 0.0, rows)
    assert summary["slope"] == pytest.approx(np.log2(1.25))
    assert (summary["slope_low"], summary["slope_high"]) == pytest.approx((0.0, 1.0))
    assert summary["slope_over_c_mujoco"] == pytest.approx(-1.0)
    assert summary["efficiency"] == pytest.approx(0.8)
    assert scaling.summarise("pixels", 1.0, rows)["efficiency"] is None


def test_a_curve_that_bends_upwards_cannot_hide_it_between_its_ends() -> None:
    alike = {"us_turns": [1.0], "c_mujoco_steps_per_decision": 1.0}
    rows = [{"x": x, "us_per_decision": cost, **alike} for x, cost in ((1, 4.0), (2, 2.0), (4, 8.0), (8, 8.0))]
    summary = scaling.summarise("pixels", 1.0, rows)
    assert summary["slope"] == pytest.approx(1 / 3)
    assert summary["steepest"] == pytest.approx(2.0)
    assert "at most 2.00 between neighbours" in scaling.sentence({"name": "pixels", **summary})


@pytest.mark.parametrize("quick", [True, False])
def test_each_curve_changes_one_thing_in_multiples_of_what_was_asked_for(quick: bool, tmp_path: Path) -> None:
    curves = {name: make(BASE, quick, tmp_path) for name, make in scaling.CURVES.items()}
    for curve in curves.values():
        x = [point.x for point in curve.points]
        assert len(x) > 1 and x == sorted(x)
    for point in curves["pixels"].points:
        assert point.x == point.config.camera.width * point.config.camera.height
        assert dataclasses.replace(point.config, camera=BASE.camera) == BASE
    for point in curves["physics_steps"].points:
        assert point.x == point.config.drone.physics_steps
        assert point.x * point.config.drone.physics_dt_s == pytest.approx(0.26)
    for point in (*curves["environments"].points, *curves["devices"].points):
        agent, many = point.config.agent, point.config.train.num_envs
        assert agent.updates_per_step * agent.batch_size == 4 * many
    assert [point.config.train.num_envs // point.x for point in curves["devices"].points] == [128, 128]
    assert [point.config.train.devices for point in curves["devices"].points] == [1, 2]
    for point in curves["obstacles"].points:
        assert obstacle_count(load_scene(point.config.world.name)) == point.x


def test_a_size_that_cannot_be_run_is_told_in_a_sentence(tmp_path: Path) -> None:
    odd = apply_layer(BASE, {"camera": {"width": 1}}, "the test")
    with pytest.raises(ConfigError, match="camera"):
        scaling.CURVES["pixels"](odd, False, tmp_path)


@pytest.mark.slow
def test_one_device_has_no_curve_of_devices() -> None:
    with pytest.raises(ConfigError, match="only one device"):
        scaling.measure(parse_config([*MINIATURE, "--train.devices", "1"]), ["devices"], True, 1)


def test_worlds_of_fewer_boxes_are_a_part_of_those_of_more_and_can_be_flown() -> None:
    few, most = world_of_boxes(8), world_of_boxes(MOST)
    assert (obstacle_count(few), obstacle_count(most)) == (8, MOST)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[:8]), few.boxes, most.boxes)
    check_scene(most, Config().drone.body_radius_m, title="all boxes")
    with pytest.raises(ValueError, match=f"from 0 to {MOST} boxes, not {MOST + 1}"):
        world_of_boxes(MOST + 1)


def test_there_is_a_gap_between_any_two_boxes() -> None:
    boxes = jax.tree.map(np.asarray, world_of_boxes(MOST).boxes)
    reach = np.hypot(boxes.half[:, 0], boxes.half[:, 1])
    gap = np.linalg.norm(boxes.position[:, None, :2] - boxes.position[None, :, :2], axis=-1) - reach - reach[:, None]
    assert np.min(gap[~np.eye(MOST, dtype=bool)]) > 2 * Config().drone.body_radius_m


@pytest.mark.slow
def test_state_bytes_are_exactly_those_of_the_arrays() -> None:
    config = parse_config(MINIATURE)
    world = run_missions(config).training.env_params
    counted = state_bytes(config, world)
    state = jax.eval_shape(lambda world, key: init_state(config, world, key), world, jax.random.key(0))
    flown, stored = counted.environments * counted.environment, counted.replay_slots * counted.replay_slot
    assert flown + stored + counted.rest == size_of(state)
    assert (counted.environments, counted.replay_slots) == (16, config.agent.replay_size)
    # 32 values of the code, 10 of the own state and the reward in four bytes; outcome, reset and move in one.
    assert counted.replay_slot == (32 + 10 + 1) * 4 + 3


def test_a_million_transitions_take_a_million_slots() -> None:
    row = scaling.memory_of(StateBytes(262, 175, 1000, 256, 4096), 12.5)
    assert row["bytes_of_a_million_transitions"] == 175_000_000
    assert "| a replay of 1 000 000 transitions | 175,000,000 |" in scaling.memory_lines(row)
    assert not any(
        "temporary" in line for line in scaling.memory_lines(row | {"temporary_bytes_per_environment": None})
    )


@pytest.mark.slow
def test_sizes_take_turns_and_the_report_says_what_came_of_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    order = []

    class Whole:
        """Stands for the compiled chunk, which other tests compile: a decision costs a nanosecond a pixel."""

        compile_seconds = 1.0
        temporary_bytes = 1600

        def __init__(self, config, world, devices) -> None:
            self.decisions = config.train.chunk_steps * config.train.num_envs
            self.pixels = config.camera.width * config.camera.height

        def turn(self) -> float:
            order.append(self.pixels)
            return 1e9 / self.pixels

    monkeypatch.setattr(scaling, "WholeStep", Whole)
    monkeypatch.setattr(scaling, "TURN_SECONDS", 1e-9)
    monkeypatch.setattr(scaling, "REPEATS", 2)
    json_file, figure = tmp_path / "scaling.json", tmp_path / "scaling.png"
    words = ["--curves", "pixels", "devices", "--repeats", "2", "--json", str(json_file), "--figure", str(figure)]
    args, config = scaling.parse([*words, "--", *MINIATURE])
    report = scaling.measure(config, args.curves, args.quick, args.repeats)
    # One turn of each to see how long it takes, then there and back; the reference is not made again for devices.
    sizes = [12, 48, 192, 432]
    assert order == [*sizes, *sizes, *reversed(sizes), 48, 48, 48, 48, 48]
    rows = {row["name"]: row for row in report["rows"]}
    assert rows["pixels 16 × 12"]["us_per_decision"] == pytest.approx(2 * 0.192)
    assert rows["devices 1"]["us_per_decision"] == pytest.approx(0.048)
    curves = {curve["name"]: curve for curve in report["curves"]}
    assert curves["pixels"]["slope"] == curves["pixels"]["slope_high"] == pytest.approx(1.0)
    assert curves["devices"]["efficiency"] == pytest.approx(0.5)
    assert report["memory"]["temporary_bytes_per_environment"] == 1600 * 2 / 16
    assert report["workload"]["vae_samples_per_decision"] == 1
    assert json.dumps(to_plain_json(report), allow_nan=False)
    shown = scaling.table(report)
    assert "Pixels: slope 1.00" in shown and "All devices together reach 50%" in shown
    drawn = draw_scaling(report, figure)
    assert figure.stat().st_size > 10_000
    titles = [axes.get_title(loc="left") for axes in drawn.axes]
    assert titles[:3] == ["36 × pixels, 36 × cost", "2 × devices, 2 × cost", "Memory"]


@pytest.mark.parametrize("words", [["--repeats", "0"], ["--curves", "colours"]])
def test_bad_words_end_with_exit_code_2(words: list[str]) -> None:
    with pytest.raises(SystemExit) as ending:
        scaling.parse(words)
    assert ending.value.code == 2


def test_files_that_cannot_be_written_are_told_before_anything_is_measured() -> None:
    with pytest.raises(ConfigError, match="there is no folder"):
        scaling.parse(["--figure", "no/such/folder/scaling.png"])
