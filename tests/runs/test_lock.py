"""Two runs never write into one folder."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import filelock
import pytest

from edqn_jax.config import Config, WorldConfig
from edqn_jax.errors import ConfigError
from edqn_jax.runs.directory import RunDirectory, plan_run_directory
from edqn_jax.runs.lock import LOCK, Lock
from edqn_jax.runs.record import train_run
from edqn_jax.runs.stopping import Stop
from edqn_jax.training.progress import Progress
from tests.support.processes import PATIENCE_S

HOLDER = """
import sys, time
from pathlib import Path
from edqn_jax.runs.lock import Lock
with Lock(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(600)
"""


def test_a_folder_that_a_run_holds_is_refused_whole_and_free_when_it_has_ended(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    with run.hold_lock():
        run.begin([Config()])
        run.append_metrics({"decisions": 1})
        again = plan_run_directory(run.path, Config(), "never")
        with pytest.raises(ConfigError, match=r"run' is in use: process \d+ on .* writes a run there; give another"):
            again.hold_lock().__enter__()
        assert run.read_metrics() == [{"decisions": 1}]
    assert not (run.path / LOCK).exists()
    with again.hold_lock():
        pass


def test_a_folder_is_locked_before_anything_is_prepared(tmp_path: Path) -> None:
    # Preparing takes minutes; here it would fail at once, since there is no such world.
    config = dataclasses.replace(Config(), world=WorldConfig(name=str(tmp_path / "missing.xml")))
    run = RunDirectory(tmp_path / "run")
    with run.hold_lock(), pytest.raises(ConfigError, match="is in use"):
        train_run(config, run, Progress(), Stop())


def test_a_process_that_is_killed_leaves_no_lock(tmp_path: Path) -> None:
    words = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "locked\n"
        with pytest.raises(ConfigError, match=f"process {holder.pid} on"):
            Lock(tmp_path)
        holder.kill()
        holder.wait(PATIENCE_S)
    assert (tmp_path / LOCK).exists()  # the file, but nobody holds it
    assert plan_run_directory(tmp_path, Config()).path == tmp_path  # nor does it make the folder somebody's
    with Lock(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


def test_a_lock_is_on_the_file_that_is_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The holder before may remove its file between the moments at which another opens and locks it."""
    locked: list[int] = []

    def removed_meanwhile(opened: int, *, blocking: bool) -> bool:
        locked.append(opened)
        if len(locked) == 1:
            (tmp_path / LOCK).unlink()
        return lock(opened, blocking=blocking)

    lock = filelock.lock_descriptor
    monkeypatch.setattr(filelock, "lock_descriptor", removed_meanwhile)
    with Lock(tmp_path):
        assert len(locked) == 2 and (tmp_path / LOCK).exists()
        with pytest.raises(ConfigError, match="is in use"):
            Lock(tmp_path)
