"""History of a run on the host: metrics of each chunk, ended episodes, validations."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from edqn_jax.config import Config
from edqn_jax.errors import DivergedError
from edqn_jax.learn.learner import VAE_METRICS, learner_of
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import Episodes, Health, Losses
from edqn_jax.sim.task.outcomes import Outcome

MAX_DIVERGED_STEPS = 100
"""Training steps without a useful update, or with as many diverged decisions, after which a run is given up."""

_IN_WORDS = {int(outcome): outcome.name.lower() for outcome in Outcome}


@dataclasses.dataclass(frozen=True)
class EndedEpisodes:
    """Episodes that ended in a chunk, in order. E of them."""

    step: np.ndarray  # [E] int, decisions of all environments when it ended
    episode_return: np.ndarray  # [E] undiscounted
    length: np.ndarray  # [E] int, decisions
    outcome: np.ndarray  # [E] int, an `Outcome`

    @classmethod
    def from_chunk(cls, episodes: Episodes, first: int, envs: int) -> EndedEpisodes:
        """Returns the episodes that ended in a chunk whose first training step is `first`."""
        outcome, length, gain = (
            np.asarray(x).reshape(len(x), -1) for x in (episodes.outcome, episodes.length, episodes.episode_return)
        )
        rows, columns = np.nonzero(outcome)
        return cls((first + rows + 1) * envs, gain[rows, columns], length[rows, columns], outcome[rows, columns])

    def outcome_names(self) -> list[str]:
        """Returns the outcomes in words."""
        return [_IN_WORDS[kind] for kind in self.outcome.tolist()]


@dataclasses.dataclass
class History:
    """A run so far."""

    metrics: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """One dictionary a chunk, as in `metrics.jsonl`."""
    episodes: list[EndedEpisodes] = dataclasses.field(default_factory=list)
    """Episodes that ended in each chunk."""
    validations: list[tuple[int, float, float]] = dataclasses.field(default_factory=list)
    """Decisions, seconds since the start and success rate near the start of each validation."""

    earlier_episodes: int = 0
    """Episodes that had ended when the run was continued; neither they nor the metrics before are held here."""

    @property
    def episode_count(self) -> int:
        """Returns the number of episodes that have ended."""
        return self.earlier_episodes + sum(len(ended.step) for ended in self.episodes)

    def column(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns decisions and values, each [n], of the chunks that have the metric `name`."""
        rows = [(row["decisions"], row[name]) for row in self.metrics if row.get(name) is not None]
        return np.array([d for d, _ in rows]), np.array([v for _, v in rows])


def chunk_metrics(
    config: Config, first: int, ended: EndedEpisodes, losses: Losses, seconds: float, episodes: int
) -> dict[str, Any]:
    """Returns the metrics of a chunk, None for what did not happen in it: a line of `metrics.jsonl`.

    Args:
        first: number of the chunk's first training step.
        ended: what ended in the chunk.
        losses: [K] each; what perception and learner tell of themselves has the names that they give it.
        seconds: that the chunk took.
        episodes: ended in all, this chunk included.
    """
    envs, steps = config.train.num_envs, _steps(losses)
    whole = ended.episode_return[ended.outcome != Outcome.DIVERGED]
    return {
        "phase": _phase(Schedule.from_config(config), first + steps - 1),
        "decisions": (first + steps) * envs,
        "decisions_per_second": steps * envs / seconds,
        "episodes": episodes,
        "success_rate": float(np.mean(ended.outcome == Outcome.GOAL)) if len(ended.outcome) else None,
        "mean_return": float(np.mean(whole)) if len(whole) else None,
        "diverged": int(np.sum(ended.outcome == Outcome.DIVERGED)),
        "skipped_updates": int(np.sum(losses.health.gradient)),
        **{name: _mean(values) for name, values in losses.metrics.items()},
        "warm_up": _warm_up(config, first, losses),
    }


def mean_metrics(agents: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns the metrics of a chunk, averaged over agents: numbers over those that have them, others of the first."""
    first, *others = agents
    if not others:
        return first
    means = {}
    for name, value in first.items():
        values = [agent[name] for agent in agents if agent[name] is not None]
        numbers = values and all(isinstance(value, int | float) for value in values)
        means[name] = float(np.mean(values)) if numbers else value
    return means


def _phase(schedule: Schedule, step: int) -> str:
    """Returns the name of what training step `step` belongs to."""
    if step < schedule.warmup:
        return "warm-up"
    return "retraining" if bool(schedule.trains_vae(np.asarray(step))) else "training"


def _warm_up(config: Config, first: int, losses: Losses) -> dict[str, Any] | None:
    """Returns the VAE's losses at each training step of the warm-up; None if the chunk has none of them.

    The warm-up is a chunk or two, whose means alone show nothing. The run's first step is left out: all environments
    begin in it, and nothing moves.
    """
    steps = np.arange(first, first + _steps(losses))
    wanted = (steps > 0) & (steps < Schedule.from_config(config).warmup)
    if not wanted.any():
        return None
    return {
        "decisions": ((steps[wanted] + 1) * config.train.num_envs).tolist(),
        **{name: np.asarray(losses.metrics[name])[wanted].astype(float).tolist() for name in VAE_METRICS},
    }


class DivergenceMonitor:
    """Counts how long a run has learnt nothing because numbers were not finite."""

    def __init__(self) -> None:
        """Begins with a healthy run."""
        self._ill_steps = 0
        self._first = ""  # quantity and training step

    @property
    def healthy(self) -> bool:
        """Whether something was learnt in the newest chunk."""
        return self._ill_steps == 0

    def check(self, schedule: Schedule, config: Config, done: int, losses: Losses) -> None:
        """Takes in a chunk that ended with training step `done`.

        A chunk is ill if every update in it was skipped, or if a quarter of its decisions diverged.

        Raises:
            DivergedError: after `MAX_DIVERGED_STEPS` training steps of ill chunks in a row; names the quantity that was
            the
                first not to be finite, the step and the run's seed.
        """
        steps, health = _steps(losses), losses.health
        numbers = np.arange(done - steps, done)
        learns = np.asarray(learner_of(config).updates(config, schedule.replay_time(numbers)))
        updates = np.where(numbers >= schedule.warmup, learns, 0)
        trained = np.asarray(schedule.trains_vae(numbers))
        rest = int(config.encoder.keep_learning and bool(schedule.vae_training))
        updates = updates + np.where(trained, config.encoder.warmup_updates_per_step, rest)
        skipped = int(np.sum(health.gradient))
        diverged = int(np.sum(health.physics_state) + np.sum(health.observation) + np.sum(health.reward))
        useless = 0 < int(np.sum(updates)) <= skipped
        if not useless and 4 * diverged < steps * config.train.num_envs:
            self._ill_steps = 0
            return
        if self._ill_steps == 0:
            self._first = _first_broken(health, numbers)
        self._ill_steps += steps
        if self._ill_steps >= MAX_DIVERGED_STEPS:
            raise DivergedError(
                f"training with seed {config.train.seed} diverged: {self._first}, and nothing was learnt in "
                f"{self._ill_steps} training steps after it"
            )


def _first_broken(health: Health, steps: np.ndarray) -> str:
    """Returns which quantity was the first not to be finite, and when: of one step, the one that spoils the others."""
    counts = {field.name: np.asarray(getattr(health, field.name)) for field in dataclasses.fields(health)}
    begins = {name: int(np.argmax(count > 0)) for name, count in counts.items() if np.any(count > 0)}
    name = min(begins, key=lambda name: begins[name])  # of equals the first
    return f"NaN or Inf in the {name.replace('_', ' ')} at training step {steps[begins[name]]}"


def _steps(losses: Losses) -> int:
    """Returns the training steps of a chunk."""
    return len(losses.health.gradient)


def _mean(values: Any) -> float | None:
    """Mean over the steps of a chunk that learnt; None if none did."""
    finite = np.asarray(values)
    finite = finite[~np.isnan(finite)]
    return float(np.mean(finite)) if len(finite) else None
