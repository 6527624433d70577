"""The example of a search: what a trial trains, and that a search that was stopped goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from edqn_jax.config import Config
from edqn_jax.extras import require_extra
from tests.support.interop.tiny import tiny_trial
from tests.support.miniature import WORLD

optuna = require_extra("optuna", extra="sweep")
sweep = require_extra("sweep_optuna")


def tiny(storage: Path, trials: int) -> Any:
    return sweep.Settings(trials=trials, storage=storage, world=str(WORLD), total_steps=2048)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = sweep.configured
    monkeypatch.setattr(sweep, "configured", lambda settings, trial: tiny_trial(whole(settings, trial)))


@pytest.mark.filterwarnings("ignore::Warning:optuna.*", "ignore::Warning:sqlalchemy.*")
def test_a_search_that_was_stopped_goes_on(tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = tmp_path / "sweep.db"
    trained = []
    train = sweep.spl_of

    def stopped_at_the_third(trial: Any, config: Config) -> float:
        trained.append((trial.number, config.train.seed, config.agent.learning_rate))
        if len(trained) == 3:
            raise KeyboardInterrupt
        return train(trial, config)

    monkeypatch.setattr(sweep, "spl_of", stopped_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        sweep.search(tiny(storage, 3))
    study = sweep.search(tiny(storage, 3))
    values = [trial.value for trial in study.trials if trial.state.name == "COMPLETE"]
    assert len(values) == 3 and all(0 <= value <= 1 for value in values)
    assert [number for number, *_ in trained] == [0, 1, 2, 3]  # the interrupted one is made up for
    assert all(number == seed for number, seed, _ in trained) and len({rate for *_, rate in trained}) == 4
    assert study.trials[0].intermediate_values  # of its validations
    again = sweep.search(tiny(storage, 3))
    assert len(again.trials) == len(trained) == 4  # nothing is missing


@pytest.mark.filterwarnings("ignore::Warning:optuna.*", "ignore::Warning:sqlalchemy.*")
def test_a_trial_that_is_pruned_stops_training(tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optuna.Trial, "should_prune", lambda self: True)
    study = sweep.search(tiny(tmp_path / "sweep.db", 1))
    assert [trial.state.name for trial in study.trials] == ["PRUNED"]
