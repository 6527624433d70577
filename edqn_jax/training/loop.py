"""Training: the host loop around compiled chunks.

Run a chunk; fetch a handful of numbers; log, validate, report; again. Of several processes each runs this loop on the
same numbers; all validate, and what steers the loop is decided alike on all of them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, Protocol

import jax
import numpy as np
from jax.sharding import Mesh

from edqn_jax.config import Config
from edqn_jax.config.limits import validate
from edqn_jax.evaluation import rollouts
from edqn_jax.evaluation.missions import MissionSet, run_missions
from edqn_jax.learn.policy import Policy, PolicyParams, fresh_policy
from edqn_jax.learn.trainer import Trainer, TrainState, policy_of
from edqn_jax.parallel import processes
from edqn_jax.parallel.devices import choose_devices
from edqn_jax.planners.astar import Path as ShortestPath
from edqn_jax.planners.astar import shortest_path
from edqn_jax.random import run_streams
from edqn_jax.sim.env import World
from edqn_jax.sim.flights import Flights
from edqn_jax.sim.reward import Reward
from edqn_jax.training.history import EndedEpisodes, History, check_finite, chunk_metrics
from edqn_jax.training.selection import Candidate, choose, is_due, validated


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


Callback = Callable[[Chunk], bool | None]
"""Called after each chunk; training stops where it returns True."""


class Display(Protocol):
    """Interface of a progress display."""

    def phase(self, name: str, *, total: int = 0) -> None:
        """Shows that the phase `name` begins; `total` is the number of decisions if it is training."""

    def update(self, metrics: dict[str, Any]) -> None:
        """Shows the metrics of a chunk."""


class Silent:
    """Shows nothing."""

    def phase(self, name: str, *, total: int = 0) -> None:
        pass

    def update(self, metrics: dict[str, Any]) -> None:
        pass


@dataclasses.dataclass(frozen=True)
class TrainingResult:
    """Result of training."""

    policy: Policy
    """With the parameters that `train.keep` asks for."""
    history: History
    kept: Candidate
    """The policy's parameters, and their validation."""
    state: TrainState
    """Train state after the last chunk."""
    decisions: int
    stopped: bool
    """Whether a callback ended it early."""
    train_seconds: float
    compile_seconds: float


class Preparation:
    """Devices, missions, programs and the first state of a run; made by `prepared`."""

    def __init__(self, config: Config, reward: Reward | None, display: Display, pool: Executor) -> None:
        """Compiles in the background while the shortest path is searched and the first state is made.

        Raises:
            ConfigError: if the configuration is invalid or the world cannot be flown.
        """
        validate(config)
        self.config, self.display, self.pool, self.began = config, display, pool, time.perf_counter()
        display.phase("preparing worlds")
        self.devices = choose_devices(config.train.devices, config.train.shards)
        # A world's file may be missing on one host.
        self.missions = processes.together(lambda: run_missions(config, reward))
        self.trainer = Trainer(config, self.missions.training.world, self.devices)
        self.mesh = Mesh(np.asarray(self.devices), ("mission",))
        display.phase("compiling")
        self.compiled = _in_background(pool, self.trainer.compile)
        self.rollouts_compiled = _in_background(pool, self._compile_rollouts)
        self.shortest = processes.together(self._shortest)

    def fly(self, missions: MissionSet, params: PolicyParams) -> Flights:
        """Returns the missions, flown greedily and recorded; sensor noise is the same each time."""
        placed = self._placed(missions, params)
        return processes.fetch(rollouts.fly_missions(self.config, *placed, record=True, mesh=self.mesh))

    def _shortest(self) -> ShortestPath:
        scene = self.missions.scene
        return shortest_path(scene, scene.start, scene.goal, self.config.drone.body_radius_m)

    def _compile_rollouts(self) -> None:
        placed = self._placed(self.missions.validation, fresh_policy(self.config))
        rollouts.prepare(self.config, *placed, record=True, mesh=self.mesh)

    def _placed(self, missions: MissionSet, params: PolicyParams) -> tuple[World, PolicyParams, jax.Array]:
        """World, parameters and key as `fly_missions` takes them."""
        return *processes.replicate((missions.world, params), self.mesh), run_streams(self.config.train.seed).flights


@contextlib.contextmanager
def prepared(config: Config, reward: Reward | None = None, display: Display | None = None) -> Iterator[Preparation]:
    """Prepares a run; where the block ends with an error, nobody waits for what is still being compiled.

    Raises:
        ConfigError: if the configuration is invalid or the world cannot be flown.
    """
    pool = ThreadPoolExecutor(max_workers=2, thread_name_prefix="compiling")
    try:
        yield Preparation(config, reward, display or Silent(), pool)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _in_background(pool: Executor, work: Callable[[], None]) -> Future[float]:
    """Runs `work` in a thread; the future holds the elapsed seconds.

    Of several processes none works ahead: all must meet in one order.
    """

    def timed() -> float:
        began = time.perf_counter()
        work()
        return time.perf_counter() - began

    future = pool.submit(timed)
    if jax.process_count() > 1:
        future.result()
    return future


def train(
    config: Config | None = None, *, reward: Reward | None = None, callback: Callback | None = None
) -> TrainingResult:
    """Trains a policy and returns it with the history of its training; nothing is written.

    Args:
        config: the `default` preset without it; `edqn_jax.make_config` makes one.
        reward: replaces the configured reward; see `sim.reward.Transition` for what it is given.
        callback: called after each chunk; training stops where it returns True.

    Raises:
        ConfigError: if the configuration is invalid or the world cannot be flown.
        DivergedError: if a loss becomes NaN or Inf.
    """
    with prepared(config or Config(), reward) as preparation:
        return run_chunks(preparation, callback)


def run_chunks(preparation: Preparation, callback: Callback | None = None) -> TrainingResult:
    """Trains what was prepared, chunk after chunk.

    Raises:
        DivergedError: if a loss becomes NaN or Inf.
    """
    config, trainer = preparation.config, preparation.trainer
    state = trainer.init(config.train.seed)
    compile_seconds = preparation.compiled.result()
    loop = _Loop(preparation, callback, Candidate(_on_host(policy_of(state))))
    preparation.display.phase("training", total=trainer.plan.total * config.train.num_envs)
    while not loop.ended:
        state = loop.advance(state)
    return TrainingResult(
        policy=Policy(config, loop.kept.params if loop.keeps_validated else _on_host(policy_of(state))),
        history=loop.history,
        kept=loop.kept,
        state=state,
        decisions=loop.done * config.train.num_envs,
        stopped=loop.stopped,
        train_seconds=loop.train_seconds,
        compile_seconds=compile_seconds,
    )


class _Loop:
    """State of the host loop, which changes from chunk to chunk."""

    def __init__(self, preparation: Preparation, callback: Callback | None, first: Candidate) -> None:
        self.preparation, self.callback = preparation, callback
        self.config, self.plan = preparation.config, preparation.trainer.plan
        self.history, self.kept = History(), first
        self.done, self.checked = 0, 0  # training steps; decisions before the last validation
        self.train_seconds = 0.0
        self.stopped = False

    @property
    def finished(self) -> bool:
        """Whether the requested number of decisions or episodes is reached."""
        most = self.config.train.max_episodes
        return self.done >= self.plan.total or 0 < most <= self.history.episode_count

    @property
    def ended(self) -> bool:
        return self.finished or self.stopped

    @property
    def keeps_validated(self) -> bool:
        """Whether the run ends with validated parameters instead of the newest."""
        return not self.stopped or (self.config.train.keep == "best" and self.kept.decisions > 0)

    def advance(self, state: TrainState) -> TrainState:
        """Runs one chunk; validates, reports and calls the callback where due."""
        state, ended, metrics = self._run(state)
        if self.finished or is_due(self.config, self.plan, self.checked, self.done):
            metrics |= self._validate(_on_host(policy_of(state)))
        self.history.metrics.append(metrics)
        self.preparation.display.update(metrics)
        newest = Chunk(metrics, ended, self.kept, lambda: Policy(self.config, _on_host(policy_of(state))))
        stop = self.callback is not None and self.callback(newest) is True
        self.stopped = processes.on_any(stop) and not self.finished
        return state

    def _run(self, state: TrainState) -> tuple[TrainState, EndedEpisodes, dict[str, Any]]:
        """Runs the compiled chunk; returns the state, what ended, and its metrics."""
        first, began = self.done, time.perf_counter()
        state, (episodes, losses) = self.preparation.trainer.chunk(state, first)
        losses = jax.tree.map(np.asarray, losses)
        seconds = time.perf_counter() - began
        self.train_seconds += seconds
        self.done += self.config.train.chunk_steps
        ended = EndedEpisodes.of(processes.fetch(episodes), first, self.config.train.num_envs)
        self.history.episodes.append(ended)
        check_finite(self.plan, self.done, losses)
        return state, ended, chunk_metrics(self.config, first, ended, losses, seconds, self.history.episode_count)

    def _validate(self, params: PolicyParams) -> dict[str, Any]:
        """Flies the validation missions, keeps the better parameters, and returns the metrics."""
        preparation = self.preparation
        preparation.display.phase("validating")
        preparation.rollouts_compiled.result()
        self.checked = self.done * self.config.train.num_envs
        flights = preparation.fly(preparation.missions.validation, params)
        latest = validated(self.config, preparation.missions, flights, params, self.checked)
        self.kept = choose(self.config.train.keep, self.kept, latest)
        since = time.perf_counter() - preparation.began
        self.history.validations.append((self.checked, since, latest.success_near_start))
        preparation.display.phase("training")
        return {
            "validation_success": latest.success,
            "validation_mission": latest.success_near_start,
            "validation_spl": latest.spl,
        }


def _on_host(params: PolicyParams) -> PolicyParams:
    return jax.tree.map(np.asarray, params)
