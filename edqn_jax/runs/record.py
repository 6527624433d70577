"""A recorded run: trained, flown once by the result, drawn, and written to a run directory."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

import numpy as np

from edqn_jax.config import Config
from edqn_jax.devices import processes
from edqn_jax.errors import ConfigError, StoppedError
from edqn_jax.evaluation.flight_scene import scene_of_flight
from edqn_jax.evaluation.metrics import flight_summary
from edqn_jax.evaluation.trajectories import flight_trajectory
from edqn_jax.learn import saved_state
from edqn_jax.learn.policy import Policy, PolicyParams
from edqn_jax.runs import messages, summaries, world_copy
from edqn_jax.runs.checkpointer import Checkpointer
from edqn_jax.runs.directory import TO_BE_DRAWN, RunDirectory
from edqn_jax.runs.provenance import state_digest
from edqn_jax.runs.stopping import Stop
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.reward import Reward
from edqn_jax.training.loop import Callback, Chunk, RunProgress, TrainingResult, run_chunks
from edqn_jax.training.setup import Display, TrainingSetup, set_up_training


class Screen(Display, Protocol):
    """Interface of a progress display that also prints lines."""

    @property
    def elapsed_s(self) -> float:
        """Seconds since the command began."""
        ...

    def message(self, text: str) -> None:
        """Prints a line that stays."""

    def stop(self) -> None:
        """Ends the display and leaves its last state on the screen."""


Draw = Callable[[RunDirectory, Scene, PolicyParams, np.ndarray, str], None]
"""Draws a run's pictures from its directory: the world of the flight, the policy that flew, points [P, 3] of the
shortest path in metres, and the flight's outcome."""

PrepareDrawing = Callable[[Config, Scene, Executor], Draw]
"""Starts to compile what draws flights in a world of this shape, as `report.gallery.prepare_gallery`."""


def train_run(
    config: Config,
    run: RunDirectory | None,
    progress: Screen,
    stop: Stop,
    reward: Reward | None = None,
    callback: Callback | None = None,
    drawing: PrepareDrawing | None = None,
    seeds: int | None = None,
    start: Policy | None = None,
) -> dict[str, Any]:
    """Trains, validates, flies and draws; writes everything to the run directory.

    Args:
        config: the same on every process.
        run: None on a process that writes nothing, which is every one but the first of those that train together.
        progress: display of the progress.
        stop: asked after each chunk; where one process is to stop, all do.
        reward, callback: as in `train`.
        drawing: of the run's pictures; None draws none.
        seeds: trains so many agents in one program, whose seeds count up from `train.seed`; each has a run of its own
            within `run`, which holds a summary of all. None is one agent, whose run is `run` itself.
        start: policy whose networks training begins with, unless it continues a run.

    Returns:
        the content of `summary.json`, of several seeds that of all.

    Raises:
        ConfigError: before anything is written, if the run cannot be made; later, if one of its files cannot be.
        DivergedError: as `train`; the policy of the last checkpoint stays.
        StoppedError: after saving the policy, if it was asked to.
    """
    begins = run is None or run.resume == "never"
    with lock_run(run), set_up_training(config, reward, progress, seeds, start, begins) as preparation:
        progress.message(messages.describe_start(preparation, seeds))
        folders = [run if run is None or seeds is None else run.of_seed(c.train.seed) for c in preparation.configs]
        keeper = Checkpointer(preparation, run, folders, reward, progress.message)
        begin = open_run(preparation, run, keeper, progress, seeds is not None)
        preparation.ready(begins=begin is None)  # until then a signal ends the command: nothing is lost yet
        with stop.obey_signals():
            after = recording_callback(lambda chunk: folders[chunk.agent], callback, stop.is_requested)
            results = run_chunks(preparation, after, keeper.save_if_due, begin)
        if processes.any_process(results[0].stopped or stop.is_requested()):
            raise StoppedError(messages.describe_stop(run, results[0].decisions, seeds))
        progress.phase("flying the mission" if seeds is None else "flying the missions")
        plot = None if run is None else prepare_to_plot(preparation, drawing)
        flights = [preparation.fly(preparation.missions[k].final, r.policy.params, k) for k, r in enumerate(results)]
        of_each = _summaries(preparation, results, flights, reward, keeper.facts, seeds)
        if run is not None:
            progress.phase("drawing")
            for folder, result, flown, of_run in zip(folders, results, flights, of_each, strict=True):
                assert folder is not None
                finish_run(folder, preparation, plot, result, flown, of_run, progress)
        summary = of_each[0]
        if seeds is not None:
            summary = summaries.summarize_seeds(config, preparation.missions[0].tests, flights, of_each)
            summary["total_seconds"] = time.perf_counter() - preparation.began
        if run is not None:
            if seeds is not None:
                run.write_summary(summary)
            progress.stop()
            # With what passed before worlds were prepared; of a run that was continued with what passed before that.
            told = summary | {"total_seconds": max(progress.elapsed_s, summary["total_seconds"])}
            progress.message(messages.verdict(told, run, config))
    return summary


def _summaries(
    preparation: TrainingSetup,
    results: Sequence[TrainingResult],
    flights: Sequence[Flights],
    reward: Reward | None,
    facts: dict[str, Any],
    seeds: int | None,
) -> list[dict[str, Any]]:
    """Returns the content of each agent's `summary.json`; the last that all processes do together."""
    trainer, steps = preparation.trainer, results[0].decisions // preparation.config.train.num_envs
    state = saved_state.drop_spent_samples(trainer, results[0].state, steps)  # what a later step would read
    together = facts if seeds is None else {"trained_together": seeds, **facts}
    # One after the other: a state may be large.
    digests = [state_digest(trainer.of_agent(state, number)) for number in range(len(results))]
    return [
        summaries.summarize_run(preparation, result, flown, digest, reward) | together
        for result, flown, digest in zip(results, flights, digests, strict=True)
    ]


@contextlib.contextmanager
def lock_run(run: RunDirectory | None) -> Iterator[None]:
    """Keeps other runs out of the folder, which is made if there is none; every process must call this.

    Raises:
        ConfigError: if the folder cannot be made, or another run goes on in it.
    """
    with contextlib.ExitStack() as held:
        processes.run_synchronised(lambda: None if run is None else held.enter_context(run.hold_lock()))
        yield


def open_run(
    preparation: TrainingSetup, run: RunDirectory | None, keeper: Checkpointer, progress: Screen, seeds: bool = False
) -> RunProgress | None:
    """Returns the progress of the run in the locked folder if it is continued; else begins it.

    Raises:
        ConfigError: if the folder cannot be written, or its run cannot be continued.
    """
    configs = preparation.configs
    begin = None
    if processes.any_process(run is not None and run.resume != "never"):
        begin = keeper.restore_newest()

    def prepare() -> None:
        if run is None:
            return
        if begin is not None:
            run.reopen(configs, seeds)
            keeper.save_policies(begin)  # they belong to the options, which may be others now
        elif run.resume == "must":
            raise ConfigError(
                f"--resume must: the run in '{run.path}' was interrupted before its first checkpoint; --resume never "
                "starts it over"
            )
        elif run.resume != "never" and run.holds_results:
            raise ConfigError(
                f"the run in '{run.path}' has no checkpoint to go on from, and what it holds would be lost; give "
                "another folder, or --resume never to start an unfinished run over"
            )
        else:
            run.begin(configs, seeds)
            world_copy.copy_worlds(run.path, preparation.config)
            for folder in keeper.folders if seeds else []:
                assert folder is not None
                world_copy.copy_worlds(folder.path, preparation.config)

    processes.run_synchronised(prepare)
    if begin is not None:
        progress.message(messages.describe_continuation(preparation.trainer.schedule, begin.done, preparation.config))
    elif run is not None and run.resume != "never":
        progress.message("there is no checkpoint of the interrupted run; it begins anew")
    return begin


def recording_callback(
    run_of: Callable[[Chunk], RunDirectory | None], callback: Callback | None, stop: Callable[[], bool]
) -> Callback:
    """Returns the callback of a recorded run: writes the chunk to the run of its agent, then calls `callback`.

    Training ends where that returns True, or where `stop` does.
    """

    def after(chunk: Chunk) -> bool:
        record_chunk(run_of(chunk), chunk)
        ended = callback is not None and callback(chunk) is True
        return ended or stop()

    return after


def record_chunk(run: RunDirectory | None, chunk: Chunk) -> None:
    """Appends a chunk to the files of the run.

    Raises:
        ConfigError: if one cannot be written.
    """
    if run is None:
        return
    ended = chunk.episodes
    # As Python's numbers: a GPU ends thousands of episodes in a chunk.
    columns = (column.tolist() for column in (ended.step, ended.episode_return, ended.length))
    run.append_episodes(zip(*columns, ended.outcome_names(), strict=True))
    run.append_metrics(chunk.metrics)


def prepare_to_plot(preparation: TrainingSetup, drawing: PrepareDrawing | None) -> Draw | None:
    """Starts to compile the programs that draw the final flight, while it is flown."""
    if drawing is None:
        return None
    scene = scene_of_flight(preparation.config, preparation.missions[0].final)
    return drawing(preparation.config, scene, preparation.pool)


def finish_run(
    run: RunDirectory,
    preparation: TrainingSetup,
    plot: Draw | None,
    result: TrainingResult,
    flights: Flights,
    summary: dict[str, Any],
    progress: Screen,
) -> None:
    """Writes the flight of the mission that the run is judged by, the summary and all pictures.

    If pictures cannot be drawn, the run still finishes with its summary.

    Raises:
        ConfigError: if flight or summary cannot be written.
    """
    run.write_trajectory(flight_trajectory(preparation.config, flights))
    summary["total_seconds"] = time.perf_counter() - preparation.began
    run.write_summary({**summary, "figures": TO_BE_DRAWN})
    try:
        if plot is None:
            summary["figures"] = "not asked for"
        else:
            plot(
                run,
                scene_of_flight(preparation.config, preparation.missions[0].final, flights),
                result.policy.params,
                np.asarray(preparation.shortest.points),
                flight_summary(flights)["outcome"],
            )
    except (OSError, ConfigError) as error:
        summary["figures"] = f"incomplete: {error}"
        progress.message(f"the figures are incomplete: {error}; everything else is in '{run.path}'")
    summary["total_seconds"] = time.perf_counter() - preparation.began
    run.write_summary(summary)
