"""What processes that train together tell one another. That they train one policy is shown in test_run.py."""

from __future__ import annotations

import dataclasses
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from edqn_jax import cluster
from edqn_jax.checkpoint import load_policy
from edqn_jax.config import ConfigError
from edqn_jax.rundir import RunDirectory
from tests.learn.test_trainer import CONFIG
from tests.processes import PATIENCE_S, arguments_for, by_srun, to_the_end, two_processes


@pytest.mark.slow
def test_sigterm_for_one_process_of_slurms_stops_both_and_one_saves(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, total_steps=10**6, validation_every=0))
    argv = ["--no-learning", *arguments_for(config, tmp_path), "--run-dir", "run"]
    with two_processes(tmp_path, argv, by_srun) as processes:
        run, begun = RunDirectory(tmp_path / "run"), time.monotonic()
        while not run.metrics_file.exists():
            assert time.monotonic() < begun + PATIENCE_S
            for process in processes:
                assert process.poll() is None, process.communicate()[0]
            time.sleep(0.2)
        processes[1].send_signal(signal.SIGTERM)
        (first, said), (second, echoed) = to_the_end(processes)
    assert (first, second) == (143, 143), said + echoed
    assert "the policy is in 'run/checkpoints'" in said
    assert "the first process saves the policy" in echoed
    load_policy(run.checkpoints)
    assert not run.summary_file.exists()


@pytest.mark.slow
def test_what_the_first_process_may_not_write_stops_both_with_its_sentence(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").touch()
    with two_processes(tmp_path, ["--run-dir", "run"]) as processes:
        for code, output in to_the_end(processes):
            assert code == 2, output
            assert "edqn: --run-dir 'run' holds files that are no run of edqn" in output


def test_a_process_alone_does_its_work_and_hears_itself() -> None:
    def fail() -> None:
        raise ConfigError("a world that is missing")

    assert cluster.together(lambda: 3) == 3
    with pytest.raises(ConfigError, match="a world that is missing"):
        cluster.together(fail)
    assert cluster.on_any(True) and not cluster.on_any(False)


@pytest.fixture
def joined(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """JAX's own joining, stood in for; the calls that reached it."""
    calls: list[dict] = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **arguments: calls.append(arguments))
    return calls


def test_processes_with_different_numbers_of_devices_are_refused(joined, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cluster.join({"process_id": 0}) == 0
    assert joined == [{"process_id": 0}]
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(process_index=process) for process in (0, 0, 1)])
    with pytest.raises(ConfigError, match="equally many devices, not 1 and 2; on CPUs --train.devices"):
        cluster.join({})


def test_where_there_is_no_cluster_the_flags_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def initialize() -> None:
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    with pytest.raises(ConfigError, match="no cluster to join here; give --coordinator-address, .*should be defined"):
        cluster.join({})
