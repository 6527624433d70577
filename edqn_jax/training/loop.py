"""Training: the host loop around compiled chunks.

Run a chunk; fetch a handful of numbers; log, validate, report; again. Of several processes each runs this loop on the
same numbers; all validate, and what steers the loop is decided alike on all of them.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.config.loading import check_config, make_config
from edqn_jax.devices import processes
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.evaluation.missions import MissionSet, RunMissions
from edqn_jax.learn.policy import Policy, PolicyParams
from edqn_jax.learn.state import TrainState
from edqn_jax.learn.step import policy_of
from edqn_jax.learn.trainer import Trainer
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.reward import Reward
from edqn_jax.training.history import DivergenceMonitor, EndedEpisodes, History, chunk_metrics, mean_metrics
from edqn_jax.training.progress import shown_progress
from edqn_jax.training.selection import Candidate, choose_candidate, is_due, make_candidate
from edqn_jax.training.setup import TrainingSetup, set_up_training


@dataclasses.dataclass(frozen=True)
class Chunk:
    """Argument of the callback, after each chunk."""

    metrics: dict[str, Any]
    """As a line of `metrics.jsonl`: `decisions`, `success_rate`, `q_loss` and so on; None for what did not happen."""
    episodes: EndedEpisodes
    """Episodes that ended in the chunk."""
    kept: Candidate
    """Parameters that the run would end with by now, and their validation."""
    policy: Callable[[], Policy]
    """Returns the newest policy; to be called during the callback only, the state is donated to the next chunk."""
    agent: int = 0
    """Which of the agents that train in one program."""
    validation: tuple[MissionSet, Flights] | None = None
    """Missions of the validation after the chunk and their recorded flights; None if there was none."""


Callback = Callable[[Chunk], bool | None]
"""Called after each chunk; training stops where it returns True."""


@dataclasses.dataclass(frozen=True)
class AgentProgress:
    """Progress of an agent after a chunk, on the host."""

    kept: Candidate
    episodes: int
    """That have ended."""
    validations: list[tuple[int, float, float]]
    """As in `History`."""


@dataclasses.dataclass(frozen=True)
class RunProgress:
    """State of a run after a chunk, complete for continuing it."""

    state: TrainState
    done: int
    """Training steps."""
    checked: int
    """Decisions before the last validation."""
    train_seconds: float
    elapsed_s: float
    """Since the run began, interruptions left out."""
    agents: list[AgentProgress]
    healthy: bool = True
    """Whether every agent learnt something in the chunk."""

    def policies(self, trainer: Trainer, configs: Sequence[Config]) -> list[PolicyParams]:
        """Returns the parameters that each agent would end with if nothing came after this chunk."""
        newest = _policies(trainer, self.state)
        return [
            agent.kept.params if config.train.keep == "best" and agent.kept.decisions > 0 else params
            for config, agent, params in zip(configs, self.agents, newest, strict=True)
        ]


Saver = Callable[[RunProgress, bool], None]
"""Called after each chunk with where the run stands, and whether the chunk was the last; every process calls it."""


@dataclasses.dataclass(frozen=True)
class TrainingResult:
    """Result of training."""

    policy: Policy
    """With the parameters that `train.keep` asks for."""
    history: History
    kept: Candidate
    """The policy's parameters, and their validation."""
    state: TrainState
    """Train state after the last chunk; of several agents, of all of them."""
    decisions: int
    stopped: bool
    """Whether a callback ended it early."""
    train_seconds: float
    compile_seconds: float


@as_tested
def train(
    config: Config | None = None,
    *,
    reward: Reward | None = None,
    callback: Callback | None = None,
    start: Policy | None = None,
    progress: bool | None = None,
) -> TrainingResult:
    """Trains a policy and returns it with the history of its training; nothing is written.

    Args:
        config: without it what `train.py` trains without flags, on a CPU; `edqn_jax.make_config` makes others.
        reward: replaces the configured reward; see `sim.task.reward.Transition` for what it is given.
        callback: called after each chunk; training stops where it returns True.
        start: policy whose networks training begins with; camera, sensor, encoder and network are as in its config.
        progress: whether phases, clocks and metrics are shown on standard error, or below a notebook's cell. Without it
            they are on a terminal and in a notebook.

    Raises:
        ConfigError: if the configuration is invalid, the world cannot be flown, or `start` has networks of other
            shapes.
        DivergedError: if numbers are not finite for so long that nothing is learnt any more.
        CheckError: with `train.debug`, at the first fault.
    """
    given = _given(config)
    with shown_progress(progress) as display, set_up_training(given, reward, display, start=start) as preparation:
        return run_chunks(preparation, callback)[0]


@as_tested
def train_seeds(
    seeds: int,
    config: Config | None = None,
    *,
    reward: Reward | None = None,
    callback: Callback | None = None,
    start: Policy | None = None,
    progress: bool | None = None,
) -> list[TrainingResult]:
    """Trains one policy for each of several seeds, in one compiled program; arguments and errors as `train`.

    Args:
        seeds: how many; they are `train.seed`, `train.seed + 1` and so on.
    """
    given = _given(config)
    with shown_progress(progress) as display, set_up_training(given, reward, display, seeds, start) as preparation:
        return run_chunks(preparation, callback)


def _given(config: Config | None) -> Config:
    check_config(config)
    return make_config() if config is None else config


def run_chunks(
    preparation: TrainingSetup,
    callback: Callback | None = None,
    saver: Saver | None = None,
    begin: RunProgress | None = None,
) -> list[TrainingResult]:
    """Trains what was prepared, chunk after chunk; returns the result of each agent.

    Args:
        preparation: of the run.
        callback: as in `train`.
        saver: may save where the run stands.
        begin: where a run stood that is continued; None begins one.

    Raises:
        ConfigError: if `saver` raises it.
        DivergedError: if numbers are not finite for so long that nothing is learnt any more.
    """
    trainer = preparation.trainer
    compile_seconds = preparation.ready(begins=begin is None)
    if begin is None:
        state = preparation.take_first()
        loop = _Loop(preparation, callback, [Candidate(params) for params in _policies(trainer, state)])
    else:
        state = begin.state
        loop = _Loop.resume_from(preparation, callback, begin)
        del begin  # its state is donated
    envs = preparation.config.train.num_envs
    preparation.display.phase("training", total=trainer.schedule.total * envs, done=loop.done * envs)
    while not loop.ended:
        state = loop.advance(state)
        if saver is not None:
            saver(loop.standing(state), loop.ended)
    return [
        TrainingResult(
            policy=Policy(agent.config, agent.kept.params if loop.keeps_validated(agent) else newest),
            history=agent.history,
            kept=agent.kept,
            state=state,
            decisions=loop.done * agent.config.train.num_envs,
            stopped=loop.stopped,
            train_seconds=loop.train_seconds,
            compile_seconds=compile_seconds,
        )
        for agent, newest in zip(loop.agents, _policies(trainer, state), strict=True)
    ]


@dataclasses.dataclass
class _Agent:
    """Host-side state of an agent."""

    config: Config
    missions: RunMissions
    kept: Candidate
    history: History = dataclasses.field(default_factory=History)
    watch: DivergenceMonitor = dataclasses.field(default_factory=DivergenceMonitor)


class _Loop:
    """State of the host loop, which changes from chunk to chunk."""

    def __init__(self, preparation: TrainingSetup, callback: Callback | None, first: Sequence[Candidate]) -> None:
        self.preparation, self.callback = preparation, callback
        self.config, self.schedule = preparation.config, preparation.trainer.schedule
        self.agents = [_Agent(*each) for each in zip(preparation.configs, preparation.missions, first, strict=True)]
        self.done, self.checked = 0, 0  # training steps; decisions before the last validation
        self.train_seconds = 0.0
        self.stopped = False

    @classmethod
    def resume_from(cls, preparation: TrainingSetup, callback: Callback | None, begin: RunProgress) -> _Loop:
        """Returns the loop restored from a run's progress."""
        loop = cls(preparation, callback, [agent.kept for agent in begin.agents])
        loop.done, loop.checked, loop.train_seconds = begin.done, begin.checked, begin.train_seconds
        preparation.began -= begin.elapsed_s
        for agent, stood in zip(loop.agents, begin.agents, strict=True):
            agent.history = History(validations=list(stood.validations), earlier_episodes=stood.episodes)
        return loop

    def standing(self, state: TrainState) -> RunProgress:
        """Returns the run's progress."""
        return RunProgress(
            state=state,
            done=self.done,
            checked=self.checked,
            train_seconds=self.train_seconds,
            elapsed_s=time.perf_counter() - self.preparation.began,
            healthy=all(agent.watch.healthy for agent in self.agents),
            agents=[
                AgentProgress(agent.kept, agent.history.episode_count, list(agent.history.validations))
                for agent in self.agents
            ],
        )

    @property
    def is_finished(self) -> bool:
        """Whether the requested number of decisions, or of episodes by every agent, is reached."""
        most = self.config.train.max_episodes
        return self.done >= self.schedule.total or 0 < most <= min(agent.history.episode_count for agent in self.agents)

    @property
    def ended(self) -> bool:
        return self.is_finished or self.stopped

    def keeps_validated(self, agent: _Agent) -> bool:
        """Whether the run ends with validated parameters instead of the newest."""
        return not self.stopped or (self.config.train.keep == "best" and agent.kept.decisions > 0)

    def advance(self, state: TrainState) -> TrainState:
        """Runs one chunk; validates, reports and calls the callback where due."""
        state, chunks = self._run(state)
        policies = functools.cache(lambda: _policies(self.preparation.trainer, state))
        metrics = [measured for _, measured in chunks]
        validation_flights: list[tuple[MissionSet, Flights] | None] = [None] * len(self.agents)
        if self.is_finished or is_due(self.config, self.schedule, self.checked, self.done):
            validations = self._validate(policies())
            metrics = [before | found for before, (found, _) in zip(metrics, validations, strict=True)]
            validation_flights = [flights for _, flights in validations]
        self.preparation.display.update(mean_metrics(metrics))
        stop = False
        for number, agent in enumerate(self.agents):
            agent.history.metrics.append(metrics[number])
            if self.callback is not None:
                newest = functools.partial(
                    lambda agent, number: Policy(agent.config, policies()[number]), agent, number
                )
                chunk = Chunk(
                    metrics[number], chunks[number][0], agent.kept, newest, number, validation_flights[number]
                )
                stop |= self.callback(chunk) is True
        self.stopped = processes.any_process(stop) and not self.is_finished
        return state

    def _run(self, state: TrainState) -> tuple[TrainState, list[tuple[EndedEpisodes, dict[str, Any]]]]:
        """Runs the compiled chunk; returns the state, and of each agent what ended and its metrics."""
        first, began, trainer = self.done, time.perf_counter(), self.preparation.trainer
        state, (episodes, losses) = trainer.chunk(state, first)
        losses = jax.tree.map(np.asarray, losses)
        seconds = time.perf_counter() - began
        self.train_seconds += seconds
        self.done += self.config.train.chunk_steps
        chunks = []
        for agent, ended, lost in zip(
            self.agents, trainer.each(processes.fetch_global(episodes)), trainer.each(losses), strict=True
        ):
            ended = EndedEpisodes.from_chunk(ended, first, self.config.train.num_envs)
            agent.history.episodes.append(ended)
            agent.watch.check(self.schedule, agent.config, self.done, lost)
            count = agent.history.episode_count
            chunks.append((ended, chunk_metrics(self.config, first, ended, lost, seconds, count)))
        return state, chunks

    def _validate(self, policies: Sequence[PolicyParams]) -> list[tuple[dict[str, Any], tuple[MissionSet, Flights]]]:
        """Flies the validation missions, keeps the better parameters of each agent; returns metrics and flights."""
        preparation = self.preparation
        preparation.display.phase("validating")
        self.checked = self.done * self.config.train.num_envs
        found = []
        for number, (agent, params) in enumerate(zip(self.agents, policies, strict=True)):
            flights = preparation.fly(agent.missions.validation, params, number)
            latest = make_candidate(self.config, agent.missions, flights, params, self.checked)
            agent.kept = choose_candidate(self.config.train.keep, agent.kept, latest)
            since = time.perf_counter() - preparation.began
            agent.history.validations.append((self.checked, since, latest.success_near_start))
            metrics = {
                "validation_success": latest.success,
                "validation_mission": latest.success_near_start,
                "validation_spl": latest.spl,
                "validation_timed_out": latest.timed_out,
            }
            found.append((metrics, (agent.missions.validation, flights)))
        preparation.display.phase("training")
        return found


def _policies(trainer: Trainer, state: TrainState) -> list[PolicyParams]:
    """Returns the newest policy of each agent, on the host."""
    return trainer.each(jax.tree.map(np.asarray, policy_of(trainer.config, state)))
