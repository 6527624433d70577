"""A search over options with Optuna, on the public API; one that was stopped goes on.

    pip install 'edqn-jax[sweep]'
    python examples/sweep_optuna.py --trials 20 --storage sweep.db
    python examples/sweep_optuna.py --trials 40 --storage sweep.db   # goes on to forty

Trials are in the storage as soon as they have ended. Several processes of one machine may search together.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import optuna  # pyright: ignore[reportMissingImports]
import tyro
from optuna.trial import TrialState  # pyright: ignore[reportMissingImports]

import edqn_jax


@dataclasses.dataclass(frozen=True)
class Settings:
    """Searches step size, discount and length of returns of the agent."""

    trials: int = 20
    """Trials in all, those of earlier calls included."""
    storage: Path = Path("sweep.db")
    """SQLite file of the search."""
    world: str = "medium"
    """Where to train."""
    total_steps: int = 500_000
    """Decisions of each trial."""


def configured(settings: Settings, trial: optuna.Trial) -> edqn_jax.Config:
    """Returns the configuration of a trial: what is searched, and how long a trial trains."""
    agent = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        "discount": 1 - trial.suggest_float("one_minus_discount", 0.01, 0.1, log=True),
        "n_step": trial.suggest_int("n_step", 1, 7),
    }
    train = {
        "total_steps": settings.total_steps,
        "validation_every": max(1, settings.total_steps // 4),
        "seed": trial.number,
    }
    return edqn_jax.make_config(settings.world, agent=agent, train=train)


def spl_of(trial: optuna.Trial, config: edqn_jax.Config) -> float:
    """Trains, and returns the SPL of the kept policy on validation missions, which no test uses.

    Raises:
        optuna.TrialPruned: if a validation was worse than the median of other trials at as many decisions.
    """

    def report(chunk: edqn_jax.Chunk) -> bool:
        spl = chunk.metrics.get("validation_spl")
        if spl is not None:
            trial.report(spl, step=chunk.metrics["decisions"])
        return trial.should_prune()

    try:
        result = edqn_jax.train(config, callback=report)
    except edqn_jax.DivergedError:
        return 0.0
    if result.stopped:
        raise optuna.TrialPruned
    return result.kept.spl


def search(settings: Settings) -> optuna.Study:
    """Runs the trials that the study of the storage still lacks, and returns it."""
    study = optuna.create_study(
        study_name=f"{settings.world}-{settings.total_steps}",
        storage=f"sqlite:///{settings.storage}",
        load_if_exists=True,
        direction="maximize",
        pruner=optuna.pruners.MedianPruner(n_startup_trials=5),
    )
    ended = study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))
    missing = settings.trials - len(ended)
    if missing > 0:
        study.optimize(lambda trial: spl_of(trial, configured(settings, trial)), n_trials=missing)
    return study


def main(settings: Settings) -> None:
    """Searches and prints the best trial."""
    edqn_jax.use_cpu_devices()
    study = search(settings)
    print(f"{len(study.trials)} trials; the best is {study.best_trial.number} with SPL {study.best_value:.3f}:")
    for name, value in study.best_params.items():
        print(f"  {name} {value:.4g}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
