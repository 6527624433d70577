"""Two processes on this machine, over loopback: they train one policy, and agree on when to stop."""

from __future__ import annotations

import dataclasses
import json
import signal
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.config.loading import to_yaml
from edqn_jax.runs.checkpoints.params import load_params
from edqn_jax.runs.directory import RunDirectory
from tests.support.configs import TINY_RUN
from tests.support.processes import PATIENCE_S, WORLD, by_srun, one_process, to_the_end, two_processes


def arguments_for(config: Config, folder: Path) -> list[str]:
    """Arguments of `edqn train` for this configuration in a small world; both are left in files in `folder`."""
    world, options = folder / "sphere.xml", folder / "options.yaml"
    world.write_text(WORLD, encoding="utf-8")
    config = dataclasses.replace(
        config,
        drone=dataclasses.replace(config.drone, physics="rigid_body"),  # quicker to compile as well
        world=dataclasses.replace(config.world, name=str(world)),
    )
    options.write_text(to_yaml(config), encoding="utf-8")
    return ["--config", str(options), "--run-dir", "run"]


@pytest.mark.slow
def test_two_processes_train_the_policy_that_one_process_trains_on_two_devices(tmp_path: Path) -> None:
    together, alone = tmp_path / "together", tmp_path / "alone"
    together.mkdir()
    alone.mkdir()
    argv = arguments_for(TINY_RUN, tmp_path)
    with two_processes(together, argv) as processes, one_process(alone, argv) as process:
        for code, output in to_the_end(*processes, process):
            assert code == 0, output
    notes = [json.loads(note.read_text()) for note in sorted(together.glob("note-*.json"))]
    # The shards, and the environments in them, are shared out: none is flown twice.
    assert [note["shards"] for note in notes] == [[[0, 1, 2, 3]], [[4, 5, 6, 7]]]
    assert [note["environments"] for note in notes] == [TINY_RUN.train.num_envs // 2] * 2
    # Both end with one train state, to the last bit, and with the same flights.
    first, second = (note["summary"] for note in notes)
    assert first["state_digest"] == second["state_digest"]
    assert first["devices"] == second["devices"] and len(set(first["devices"])) == 2
    assert _without_times(first) == _without_times(second)
    # One writes, and what it writes is one run.
    assert sorted(path.name for path in together.iterdir()) == ["note-0.json", "note-1.json", "run"]
    run = RunDirectory(together / "run")
    assert json.loads(run.summary_file.read_text()) == first
    assert [row["decisions"] for row in run.read_metrics()] == list(range(64, 513, 64))
    assert len(run.read_episodes()["step"]) == first["episodes"]
    # What they have learnt is what one process learns.
    assert json.loads((alone / "note.json").read_text())["shards"] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    learnt, expected = (load_params(RunDirectory(folder / "run").checkpoints) for folder in (together, alone))
    for ours, theirs in zip(jax.tree.leaves(learnt), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def _without_times(summary: dict) -> dict:
    return {name: value for name, value in summary.items() if not name.endswith("seconds") and "per_second" not in name}


@pytest.mark.slow
def test_sigterm_for_one_process_of_slurms_stops_both_and_one_saves(tmp_path: Path) -> None:
    config = dataclasses.replace(
        TINY_RUN,
        train=dataclasses.replace(TINY_RUN.train, total_steps=10**6, validation_every=0, checkpoint_every_s=0.0),
    )
    argv = ["--no-learning", *arguments_for(config, tmp_path)]
    with two_processes(tmp_path, argv, by_srun) as processes:
        run, begun = RunDirectory(tmp_path / "run"), time.monotonic()
        while not run.metrics_file.exists():
            assert time.monotonic() < begun + PATIENCE_S
            for process in processes:
                assert process.poll() is None, process.communicate()[0]
            time.sleep(0.2)
        processes[1].send_signal(signal.SIGTERM)
        (first, said), (second, echoed) = to_the_end(*processes)
    assert (first, second) == (143, 143), said + echoed
    assert "the policy is in 'run/checkpoints'" in said
    assert "the first process saves the policy" in echoed
    load_params(run.checkpoints)
    assert not run.summary_file.exists()


@pytest.mark.slow
def test_what_the_first_process_may_not_write_stops_both_with_its_sentence(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").touch()
    with two_processes(tmp_path, ["--run-dir", "run"]) as processes:
        for code, output in to_the_end(*processes):
            assert code == 2, output
            assert "edqn: --run-dir 'run' holds files that are not an edqn run" in output
