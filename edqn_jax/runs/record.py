"""A recorded run: trained, flown once by the result, drawn, and written to a run directory."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

import jax
import numpy as np

from edqn_jax.config import FAMILIES, Config
from edqn_jax.devices import processes
from edqn_jax.errors import ConfigError, StoppedError
from edqn_jax.evaluation.companions import scene_of_flight
from edqn_jax.evaluation.metrics import clearance_text, clock, flight_summary
from edqn_jax.evaluation.trajectories import trajectory
from edqn_jax.learn import saved_state
from edqn_jax.learn.plan import Plan
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.state import TrainState
from edqn_jax.learn.trainer import Trainer
from edqn_jax.runs import summaries, world_copy
from edqn_jax.runs.directory import TO_BE_DRAWN, RunDirectory
from edqn_jax.runs.keeper import Keeper
from edqn_jax.runs.provenance import state_digest
from edqn_jax.runs.stopping import Stop
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.reward import Reward
from edqn_jax.training.loop import Callback, Chunk, Standing, TrainingResult, run_chunks
from edqn_jax.training.setup import Display, Preparation, prepared


class Screen(Display, Protocol):
    """Interface of a progress display that also prints lines."""

    def message(self, text: str) -> None:
        """Prints a line that stays."""

    def stop(self) -> None:
        """Ends the display; what it shows stays."""


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
) -> dict[str, Any]:
    """Trains, validates, flies and draws; writes everything to the run directory.

    Args:
        config: the same on every process.
        run: None on a process that writes nothing, which is every one but the first of those that train together.
        progress: display of the progress.
        stop: asked after each chunk; where one process is to stop, all do.
        reward, callback: as in `train`.
        drawing: of the run's pictures; None draws none.

    Returns:
        the content of `summary.json`.

    Raises:
        ConfigError: before anything is written, if the run cannot be made; later, if one of its files cannot be.
        DivergedError: as `train`; the policy of the last checkpoint stays.
        StoppedError: after saving the policy, if it was asked to.
    """
    with locked(run), prepared(config, reward, progress) as preparation:
        progress.message(f"{trained_in(config)}, {described(preparation.devices)}")
        if (note := preparation.missions[0].training.note) is not None:
            progress.message(note)
        keeper = Keeper(preparation, run, [run], reward, progress.message)
        begin = opened(preparation, run, keeper, progress)
        preparation.ready(begins=begin is None)  # until then a signal ends the command: nothing is lost yet
        with stop.obeyed():
            (result,) = run_chunks(
                preparation, recorded(lambda _: run, callback, stop.requested), keeper.save_if_due, begin
            )
        if processes.on_any(result.stopped or stop.requested()):
            raise StoppedError(f"stopped after {result.decisions:,} decisions; {where_saved(run)}")
        progress.phase("flying the mission")
        draw = None if run is None else prepare_to_draw(preparation, drawing)
        flights = preparation.fly(preparation.missions[0].final, result.policy.params)
        digest = state_digest(needed(preparation.trainer, result))  # the last that all processes do together
        summary = summaries.of_run(preparation, result, flights, digest, reward) | keeper.facts
        if run is not None:
            progress.phase("drawing")
            finish(run, preparation, draw, result, flights, summary, progress)
            progress.stop()
            progress.message(_verdict(summary, run))
    return summary


@contextlib.contextmanager
def locked(run: RunDirectory | None) -> Iterator[None]:
    """Keeps other runs out of the folder, which is made if there is none; every process must call this.

    Raises:
        ConfigError: if the folder cannot be made, or another run goes on in it.
    """
    with contextlib.ExitStack() as held:
        processes.together(lambda: None if run is None else held.enter_context(run.locked()))
        yield


def opened(
    preparation: Preparation, run: RunDirectory | None, keeper: Keeper, progress: Screen, seeds: bool = False
) -> Standing | None:
    """Returns where the run in the locked folder stood if it is continued; else begins it.

    Raises:
        ConfigError: if the folder cannot be written, or its run cannot be continued.
    """
    configs = preparation.configs
    begin = None
    if processes.on_any(run is not None and run.resume != "never"):
        begin = keeper.restored()

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
            world_copy.keep(run.path, preparation.config)
            for folder in keeper.folders if seeds else []:
                assert folder is not None
                world_copy.keep(folder.path, preparation.config)

    processes.together(prepare)
    if begin is not None:
        progress.message(_continued(preparation.trainer.plan, begin.done, preparation.config))
    elif run is not None and run.resume != "never":
        progress.message("there is no checkpoint of the interrupted run; it begins anew")
    return begin


def _continued(plan: Plan, done: int, config: Config) -> str:
    """Returns that a run goes on, and what that means for its schedules, as lines for the screen."""
    envs = config.train.num_envs
    text = f"continued after {done * envs:,} of {plan.total * envs:,} decisions"
    if plan.scheduled < plan.total:
        text += (
            f"; exploration and step size were planned for {plan.scheduled * envs:,} and stay from there on what they "
            "are at that end, and the encoder is not trained again"
        )
    return text


def recorded(
    run_of: Callable[[Chunk], RunDirectory | None], callback: Callback | None, stop: Callable[[], bool]
) -> Callback:
    """Returns the callback of a recorded run: writes the chunk to the run of its agent, then calls `callback`.

    Training ends where that returns True, or where `stop` does.
    """

    def after(chunk: Chunk) -> bool:
        record(run_of(chunk), chunk)
        ended = callback is not None and callback(chunk) is True
        return ended or stop()

    return after


def record(run: RunDirectory | None, chunk: Chunk) -> None:
    """Appends a chunk to the files of the run.

    Raises:
        ConfigError: if one cannot be written.
    """
    if run is None:
        return
    ended = chunk.episodes
    # As Python's numbers: a GPU ends thousands of episodes in a chunk.
    columns = (column.tolist() for column in (ended.step, ended.episode_return, ended.length))
    run.append_episodes(zip(*columns, ended.named(), strict=True))
    run.append_metrics(chunk.metrics)


def where_saved(run: RunDirectory | None) -> str:
    return "the first process saves the policy" if run is None else f"the policy is in '{run.checkpoints}'"


def prepare_to_draw(preparation: Preparation, drawing: PrepareDrawing | None) -> Draw | None:
    """Starts to compile the programs that draw the final flight, while it is flown."""
    if drawing is None:
        return None
    scene = scene_of_flight(preparation.config, preparation.missions[0].final)
    return drawing(preparation.config, scene, preparation.pool)


def finish(
    run: RunDirectory,
    preparation: Preparation,
    draw: Draw | None,
    result: TrainingResult,
    flights: Flights,
    summary: dict[str, Any],
    progress: Screen,
) -> None:
    """Writes the flight of the mission that the run is judged by, the summary and all pictures.

    Whatever keeps pictures from being drawn, the run is finished and its summary is there.

    Raises:
        ConfigError: if flight or summary cannot be written.
    """
    run.write_trajectory(trajectory(preparation.config, flights))
    summary["total_seconds"] = time.perf_counter() - preparation.began
    run.write_summary({**summary, "figures": TO_BE_DRAWN})
    try:
        if draw is None:
            summary["figures"] = "not asked for"
        else:
            draw(
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


def needed(trainer: Trainer, result: TrainingResult) -> TrainState:
    """Returns the last state of a run without what no later step would read."""
    return saved_state.needed(trainer, result.state, result.decisions // trainer.config.train.num_envs)


def trained_in(config: Config) -> str:
    """Returns what the training worlds are, for the screen."""
    name = config.world.name
    return f"{config.world.pool_size:,} random {name} worlds" if name in FAMILIES else f"world '{name}'"


def described(devices: Sequence[jax.Device]) -> str:  # pyright: ignore[reportInvalidTypeForm]
    count = len({device.process_index for device in devices})
    return f"{len(devices)} {devices[0].platform} devices" + (f" of {count} processes" if count > 1 else "")


def _verdict(summary: dict[str, Any], run: RunDirectory) -> str:
    """Returns the last lines on the screen."""
    ending = {
        "goal": "reached the goal",
        "collision": "ended in a collision",
        "left_volume": "left the flight volume",
        "time_out": "ran out of time",
        "diverged": "diverged",
    }[summary["outcome"]]
    text = (
        f"{_flight(summary)} {ending} after {count(summary['steps'], 'decision')} ({summary['flight_seconds']:.1f} s): "
        f"{summary['path_length_m']:.1f} m flown, shortest path {summary['shortest_path_m']:.1f} m. "
        f"{_nearest(summary)}"
    )
    if "test" in summary:
        test = summary["test"]
        low, high = test["interval"]
        text += (
            f"\nUnseen test worlds: {test['successes']} of {test['missions']} reached the goal "
            f"({test['success_rate']:.0%}, 95 % Wilson interval {low:.0%} to {high:.0%})."
        )
    return (
        f"{text}\nTook {clock(summary['total_seconds'])} in all, {clock(summary['train_seconds'])} of it training. "
        f"Everything is in {run.path}"
    )


def _flight(summary: dict[str, Any]) -> str:
    """Returns which flight the verdict is about."""
    if summary["flown"] == summary["world"]:
        return "The greedy flight"
    return f"The greedy flight through {unseen(summary)},"


def unseen(summary: dict[str, Any]) -> str:
    """Returns what the world of the last flight of a run in random worlds is, for the screen."""
    where = "the paper's map" if summary["flown"] == "paper" else f"'{summary['flown']}'"
    return f"{where}, which training never used"


def _nearest(summary: dict[str, Any]) -> str:
    """Returns the closest approach as a sentence."""
    if summary["outcome"] == "collision":
        return f"It touched {'another drone' if summary.get('hit_drone') else 'an obstacle or the ground'}."
    return f"The least clearance was {clearance_text(summary['min_clearance_m'])}."


def count(number: int, noun: str) -> str:
    """Returns `1 decision`, `2 decisions`."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")
