"""Processes that train together: what they tell one another, and that they have the same options."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from edqn_jax.cli.train import options_to_compare, parse_train
from edqn_jax.devices import processes
from edqn_jax.errors import ConfigError
from edqn_jax.sim.camera import camera
from tests.support.processes import WORLD


def test_a_process_alone_does_its_work_and_hears_itself() -> None:
    def fail() -> None:
        raise ConfigError("a world that is missing")

    assert processes.run_synchronised(lambda: 3) == 3
    with pytest.raises(ConfigError, match="a world that is missing"):
        processes.run_synchronised(fail)
    assert processes.any_process(True) and not processes.any_process(False)


@pytest.mark.parametrize(("theirs", "alike"), [("train: {seed: 0}", True), ("train: {seed: 1}", False)])
def test_processes_with_different_options_all_hear_of_it(theirs: str, alike: bool, monkeypatch) -> None:
    ours = "train: {seed: 0}"
    processes.check_equal(ours)  # alone there is nobody to differ from
    digest = np.frombuffer(hashlib.sha256(theirs.encode()).digest(), np.uint8)
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(processes.multihost_utils, "process_allgather", lambda own: np.stack([own, digest]))
    if alike:
        processes.check_equal(ours)
    else:
        with pytest.raises(ConfigError, match="the processes have different options or world files"):
            processes.check_equal(ours)


def test_processes_may_keep_a_world_file_in_different_folders_but_not_another_world(tmp_path: Path) -> None:
    def said(folder: str, text: str, *words: str) -> str:
        file = tmp_path / folder / "map.xml"
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
        return options_to_compare(parse_train([*words, str(file), "--tuned-for", "cpu"])[1])

    for words in (["--world"], ["--world", "medium", "--world.flown"]):
        here = said("here", WORLD, *words)
        assert said("there", WORLD, *words) == here
        assert said("elsewhere", WORLD.replace('pos="10 15 5"', 'pos="11 15 5"'), *words) != here


@pytest.mark.parametrize(("count", "draws"), [(1, []), (2, [True, False])])
def test_of_several_processes_all_must_draw_in_c_or_none_and_one_does_not_wait_for_the_compiler(
    count: int, draws: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list(draws)
    monkeypatch.setattr(jax, "process_count", lambda: count)
    monkeypatch.setattr(camera.native, "is_available", lambda _: asked.pop(0))
    config = parse_train(["--tuned-for", "cpu"])[1]
    first, second = (options_to_compare(config) for _ in range(2))
    assert (first == second) is (count == 1) and not asked


@pytest.fixture
def joined(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """JAX's own joining, stood in for; the calls that reached it."""
    calls: list[dict] = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **arguments: calls.append(arguments))
    return calls


def test_a_process_joins_as_it_was_told_and_keeps_sigterm_for_itself(joined) -> None:
    jax.config.update("jax_enable_preemption_service", True)
    assert processes.join_cluster({"process_id": 0}) == 0
    assert joined == [{"process_id": 0, "heartbeat_timeout_seconds": processes.HEARTBEAT_S}]
    assert not jax.config.values["jax_enable_preemption_service"]


def test_processes_with_different_numbers_of_devices_are_refused(joined, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(process_index=process) for process in (0, 0, 1)])
    with pytest.raises(ConfigError, match="equally many devices, not 1 and 2; on CPUs --train.devices"):
        processes.join_cluster({})


def test_where_there_is_no_cluster_the_flags_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def initialize(**_: int) -> None:
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    with pytest.raises(ConfigError, match="no cluster to join; give --coordinator-address, .*should be defined"):
        processes.join_cluster({})
