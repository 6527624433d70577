"""Several recorded runs in one program: a run of each seed, and what all of them say together."""

from __future__ import annotations

import time
from typing import Any

from edqn_jax.config import Config
from edqn_jax.devices import processes
from edqn_jax.errors import StoppedError
from edqn_jax.evaluation.metrics import clock
from edqn_jax.runs import summaries
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.keeper import Keeper
from edqn_jax.runs.provenance import state_digest
from edqn_jax.runs.record import (
    PrepareDrawing,
    Screen,
    described,
    finish,
    locked,
    needed,
    opened,
    prepare_to_draw,
    recorded,
    trained_in,
    unseen,
)
from edqn_jax.runs.stopping import Stop
from edqn_jax.sim.task.reward import Reward
from edqn_jax.training.loop import Callback, run_chunks
from edqn_jax.training.setup import prepared


def train_seeds_run(
    config: Config,
    seeds: int,
    run: RunDirectory | None,
    progress: Screen,
    stop: Stop,
    reward: Reward | None = None,
    callback: Callback | None = None,
    drawing: PrepareDrawing | None = None,
) -> dict[str, Any]:
    """Trains an agent of each seed in one program; writes a run of each, and a summary of all.

    Args:
        config: of the first seed.
        seeds: how many agents; their seeds count up from `train.seed`.
        run: the folder that holds those of the seeds, or None; all others as in `train_run`.

    Returns:
        the content of the `summary.json` of all.

    Raises:
        ConfigError, DivergedError, StoppedError: as `train_run`.
    """
    with locked(run), prepared(config, reward, progress, agents=seeds) as preparation:
        configs, agents = preparation.configs, range(seeds)
        progress.message(f"{trained_in(config)}, {seeds} seeds, {described(preparation.devices)}")
        folders = [None if run is None else run.of_seed(each.train.seed) for each in configs]
        keeper = Keeper(preparation, run, folders, reward, progress.message)
        begin = opened(preparation, run, keeper, progress, seeds=True)
        preparation.ready(begins=begin is None)  # as in `train_run`
        with stop.obeyed():
            results = run_chunks(
                preparation,
                recorded(lambda chunk: folders[chunk.agent], callback, stop.requested),
                keeper.save_if_due,
                begin,
            )
        if processes.on_any(results[0].stopped or stop.requested()):
            where = "the first process saves the policies" if run is None else f"the policies are in '{run.path}'"
            raise StoppedError(f"stopped after {results[0].decisions:,} decisions; {where}")
        progress.phase("flying the missions")
        flights = [preparation.fly(preparation.missions[k].final, results[k].policy.params, k) for k in agents]
        # One after the other: a state may be large. The last that all processes do together.
        state = needed(preparation.trainer, results[0])
        digests = [state_digest(preparation.trainer.of_agent(state, k)) for k in agents]
        together = {"trained_together": seeds, **keeper.facts}
        of_each = [summaries.of_run(preparation, results[k], flights[k], digests[k], reward) | together for k in agents]
        began = {"total_seconds": of_each[0]["total_seconds"]}
        whole = summaries.of_all_seeds(config, preparation.missions[0].tests, flights, of_each) | began
        if run is not None:
            progress.phase("drawing")
            draw = prepare_to_draw(preparation, drawing)
            for folder, result, flown, summary in zip(folders, results, flights, of_each, strict=True):
                assert folder is not None
                finish(folder, preparation, draw, result, flown, summary, progress)
            whole["total_seconds"] = time.perf_counter() - preparation.began
            run.write_summary(whole)
            progress.stop()
            progress.message(_verdict(whole, run))
    return whole


def _verdict(summary: dict[str, Any], run: RunDirectory) -> str:
    """Returns the last lines on the screen."""
    low, high = summary["success_interval"]
    each = ", ".join(
        f"seed {seed}: {rate:.1%}" for seed, rate in zip(summary["seeds"], summary["success_rates"], strict=True)
    )
    flown = summary["flown"] != summary["world"]
    missions = "unseen test worlds" if summary["missions"] > 1 or flown else "the mission"
    last = f"\n{summary['flown_successes']} of {len(summary['seeds'])} reached the goal of {unseen(summary)}."
    return (
        f"Reached the goal in {missions}: {each}.\nInterquartile mean {summary['success_iqm']:.1%}, mean "
        f"{summary['success_mean']:.1%} (95 % interval {low:.1%} to {high:.1%}).{last if flown else ''}\n"
        f"Took {clock(summary['total_seconds'])} in all, {clock(summary['train_seconds'])} of it training. Each seed's "
        f"run is in {run.path}"
    )
