"""When checkpoints are saved, and which of them a run is continued from."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from edqn_jax.config import Config, TrainConfig
from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.runs import checkpointer
from edqn_jax.runs.checkpointer import MAX_OVERHEAD, Checkpointer
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.sim.task.reward import Reward
from edqn_jax.training.loop import AgentProgress, RunProgress
from edqn_jax.training.selection import Candidate

CONFIG = Config(train=TrainConfig(checkpoint_every_s=15.0))
PARAMS = PolicyParams(encoder={"w": np.ones(3, np.float32)}, q={"w": np.zeros((2, 2), np.float32)})
STATE = {"x": np.arange(4.0, dtype=np.float32)}


class Clock:
    """Stands for `time`: moves only when told."""

    now, saving = 0.0, 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    clock = Clock()
    monkeypatch.setattr(checkpointer, "time", clock)
    monkeypatch.setattr(checkpointer.saved_state, "to_host", lambda trainer, state, done: dict(STATE))
    shapes = {name: (array.shape, str(array.dtype)) for name, array in STATE.items()}
    monkeypatch.setattr(checkpointer.saved_state, "state_shapes", lambda trainer, done: shapes)
    monkeypatch.setattr(checkpointer.saved_state, "from_host", lambda trainer, arrays: arrays)
    monkeypatch.setattr(RunProgress, "policies", lambda self, trainer, configs: [PARAMS])
    yield clock


def kept(tmp_path: Path, config: Config = CONFIG, reward: Reward | None = None) -> tuple[Checkpointer, list[str]]:
    run, said = RunDirectory(tmp_path / "run"), []
    if not run.path.exists():
        with run.hold_lock():
            run.begin([config])
    newest = jax.tree.map(lambda leaf: leaf + 7.0, PARAMS)
    learner = SimpleNamespace(encoder=newest.encoder, agent=SimpleNamespace(average=newest.q))
    trainer = SimpleNamespace(shapes=lambda: SimpleNamespace(learner=learner), each=lambda tree: [tree])
    preparation = SimpleNamespace(config=config, configs=[config], trainer=trainer)
    return Checkpointer(preparation, run, [run], reward, said.append), said  # type: ignore[arg-type]


def standing(done: int) -> RunProgress:
    agent = AgentProgress(Candidate(PARAMS, spl=0.5, success=0.75, decisions=256), 12, [(256, 1.5, 0.5)])
    return RunProgress(state=None, done=done, checked=256, train_seconds=2.0, elapsed_s=9.0, agents=[agent])  # type: ignore[arg-type]


def steps(tmp_path: Path) -> list[int]:
    return [int(place.stem[5:]) for place in sorted((tmp_path / "run" / "checkpoints").glob("step-*"))]


def test_checkpoints_are_so_far_apart_that_saving_takes_little_time(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, _ = kept(tmp_path, dataclasses.replace(CONFIG, train=TrainConfig(checkpoint_every_s=15.0, checkpoints=99)))
    save = checkpointer.states.save_checkpoint

    def slow(*arguments):
        clock.now += 1.5
        return save(*arguments)

    monkeypatch.setattr(checkpointer.states, "save_checkpoint", slow)
    for second in range(1, 200):
        clock.now = max(clock.now, float(second))
        made.save_if_due(standing(second), last=second == 199)
    assert steps(tmp_path) == [15, 67, 119, 171, 199]  # then every 1.5 s / 3 % after the end of the one before
    assert 1.5 / MAX_OVERHEAD == 50.0 and made.facts["checkpoint_seconds"] == 5 * 1.5


def test_none_is_saved_where_none_is_asked_for(tmp_path: Path, clock: Clock) -> None:
    made, _ = kept(tmp_path, Config(train=TrainConfig(checkpoint_every_s=0.0)))
    made.save_if_due(standing(4), last=True)
    assert steps(tmp_path) == []


def test_a_full_disk_does_not_end_a_training_before_its_end(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, said = kept(tmp_path)
    made.save_if_due(standing(1), last=True)

    def full(*_):
        raise ConfigError("'there' cannot be written: No space left on device")

    monkeypatch.setattr(checkpointer.states, "save_checkpoint", full)
    clock.now = 20.0
    made.save_if_due(standing(2), last=False)
    assert said == [
        "no checkpoint after 512 decisions: 'there' cannot be written: No space left on device; training goes on"
    ]
    with pytest.raises(ConfigError, match="No space left"):
        made.save_if_due(standing(3), last=True)
    assert steps(tmp_path) == [1]


def test_a_run_stands_where_it_stood(tmp_path: Path, clock: Clock) -> None:
    kept(tmp_path)[0].save_if_due(standing(8), last=True)
    made, said = kept(tmp_path)
    found = made.restore_newest()
    assert found is not None and not said
    plain = dataclasses.replace(found, state=None, agents=[])  # type: ignore[arg-type]
    assert plain == dataclasses.replace(standing(8), agents=[])
    (agent,), (expected,) = found.agents, standing(8).agents
    jax.tree.map(np.testing.assert_array_equal, agent.kept.params, PARAMS)
    assert dataclasses.replace(agent.kept, params=None) == dataclasses.replace(expected.kept, params=None)  # type: ignore[arg-type]
    assert (agent.episodes, agent.validations) == (expected.episodes, expected.validations)
    assert made.facts["resumed_at_decisions"] == [8 * CONFIG.train.num_envs]
    np.testing.assert_array_equal(found.state["x"], STATE["x"])  # type: ignore[index]


def test_a_run_of_before_time_outs_were_counted_goes_on_without_their_share(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = checkpointer._scores()
    monkeypatch.setattr(checkpointer, "_scores", lambda: [name for name in scores if name != "timed_out"])
    kept(tmp_path)[0].save_if_due(standing(8), last=True)
    monkeypatch.setattr(checkpointer, "_scores", lambda: scores)
    found = kept(tmp_path)[0].restore_newest()
    assert found is not None and found.agents[0].kept.timed_out is None and found.agents[0].kept.success == 0.75


def test_where_a_file_of_the_run_was_changed_the_checkpoint_before_is_used(tmp_path: Path, clock: Clock) -> None:
    made, _ = kept(tmp_path)
    made.save_if_due(standing(1), last=True)
    assert made.run is not None
    made.run.append_metrics({"decisions": 1})
    made.save_if_due(standing(2), last=True)
    made.run.metrics_file.write_text('{"decisions": 2}\n')
    again, said = kept(tmp_path)
    found = again.restore_newest()
    assert found is not None and found.done == 1 and "is passed over: " in said[0]
    assert not made.run.metrics_file.exists()  # there was none then


def test_another_reward_is_refused_by_name(tmp_path: Path, clock: Clock) -> None:
    kept(tmp_path)[0].save_if_due(standing(1), last=True)

    def mine(transition):
        return transition.configured

    with pytest.raises(ConfigError, match=r"trained with the reward 'progress', not with '.*mine' \([0-9a-f]{8}\)"):
        kept(tmp_path, reward=mine)[0].restore_newest()
    assert steps(tmp_path) == [1]  # nothing is wrong with it


@pytest.mark.parametrize("which", ["edqn_jax", "jax"])
def test_another_version_is_named(tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, which: str) -> None:
    versions = checkpointer.states.checkpoint_versions()
    with monkeypatch.context() as older:
        older.setattr(checkpointer.states, "checkpoint_versions", lambda: {**versions, which: "0.0.9"})
        kept(tmp_path)[0].save_if_due(standing(1), last=True)
    made, said = kept(tmp_path)
    refused = pytest.raises(ConfigError, match="saved by edqn_jax 0.0.9, which edqn_jax .* cannot continue")
    with refused if which == "edqn_jax" else contextlib.nullcontext():
        assert made.restore_newest() is not None
    assert said == ([] if which == "edqn_jax" else [f"jax is {jax.__version__} and was 0.0.9: rounding may differ"])
