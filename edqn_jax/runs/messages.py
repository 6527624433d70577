"""Screen messages of a recorded run: devices, continuation, stop and results."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from edqn_jax.config import FAMILIES, Config
from edqn_jax.evaluation.metrics import clearance_text, format_duration
from edqn_jax.learn.schedule import Schedule
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.training.setup import TrainingSetup
from edqn_jax.user_code import IMPORTED

HOVERS = 0.5
"""Share of the validation missions that run out of time from which on a policy is said to hover."""
LEAST_PRICE = -5
"""Reward of a collision nearest to zero that is proposed."""


def describe_start(preparation: TrainingSetup, seeds: int | None) -> str:
    """Returns a line on the devices that a run trains on, and another on its missions if there is a note."""
    world, devices = preparation.config.world, preparation.devices
    text = f"{world.pool_size:,} random {world.name} worlds" if world.name in FAMILIES else f"world '{world.name}'"
    text += "" if seeds is None else f", {seeds} seeds"
    text += f", {len(devices)} {devices[0].platform} devices"
    processes = len({device.process_index for device in devices})
    text += f" of {processes} processes" if processes > 1 else ""
    note = preparation.missions[0].training.note
    return text if note is None else f"{text}\n{note}"


def describe_continuation(schedule: Schedule, done: int, config: Config) -> str:
    """Returns lines for the screen on the continuation of a run and its effect on schedules."""
    envs = config.train.num_envs
    text = f"continued after {done * envs:,} of {schedule.total * envs:,} decisions"
    if schedule.scheduled < schedule.total:
        text += (
            f"; exploration and step size were planned for {schedule.scheduled * envs:,} and stay from there on "
            "what they are at that end, and the encoder is not trained again"
        )
    return text


def describe_stop(run: RunDirectory | None, decisions: int, seeds: int | None) -> str:
    """Returns the message of a stopped run, with the location of its policy."""
    what = "the policy" if seeds is None else "the policies"
    if run is None:
        where = f"the first process saves {what}"
    else:
        where = f"the policy is in '{run.checkpoints}'" if seeds is None else f"the policies are in '{run.path}'"
        where += f"; {_train_command(run.path)} goes on from there"
    return f"stopped after {decisions:,} decisions; {where}"


def verdict(summary: dict[str, Any], run: RunDirectory, config: Config) -> str:
    """Returns the last lines on the screen, of one agent's run or of several seeds, with what may come next.

    Args:
        summary: content of `summary.json`.
        run: which was written.
        config: of the run.
    """
    text = _of_seeds(summary) if "seeds" in summary else _of_one(summary, config)
    return f"{text} {run.path}\n{_next_commands(summary, run, config)}"


def _next_commands(summary: dict[str, Any], run: RunDirectory, config: Config) -> str:
    """Returns the commands that show a run, fly it and go on with it, a line each."""
    flies = run.of_seed(summary["seeds"][0]).path if "seeds" in summary else run.path
    more = 2 * max(config.train.total_steps, summary["train_decisions"])
    return "\n".join(
        (
            f"see it:       edqn report {_word(run.path)}{_imports()}",
            f"fly it:       edqn evaluate {_word(flies)} --missions 100{_imports()}",
            f"train longer: {_train_command(run.path)} --total-steps {more}",
        )
    )


def _train_command(folder: Path) -> str:
    """Returns the command that goes on with the run in a folder, whose options are its own."""
    return f"edqn train --run-dir {_word(folder)}{_imports()}"


def _imports() -> str:
    """Returns the words by which a command imports what this one did."""
    return "".join(f" --import {_word(name)}" for name in IMPORTED)


def _word(path: Path | str) -> str:
    """Returns a path as a word of a shell."""
    return shlex.quote(str(path))


def _of_one(summary: dict[str, Any], config: Config) -> str:
    ending = {
        "goal": "reached the goal",
        "collision": "ended in a collision",
        "left_volume": "left the flight volume",
        "time_out": "ran out of time",
        "diverged": "diverged",
    }[summary["outcome"]]
    text = (
        f"Validation: {summary['validation_success']:.0%} of {_count(config.train.validation_missions, 'mission')} "
        f"reached the goal, after {_count(summary['parameters_from_decisions'], 'decision')} of training.\n"
        f"{_hovering(summary, config)}"
        f"{_flight(summary)} {ending} after {_count(summary['steps'], 'decision')} "
        f"({summary['flight_seconds']:.1f} s): {summary['path_length_m']:.1f} m flown, "
        f"shortest path to the goal's centre {summary['shortest_path_m']:.1f} m. "
        f"{_nearest(summary)}"
    )
    if "test" in summary:
        test = summary["test"]
        low, high = test["interval"]
        text += (
            f"\nUnseen test worlds: {test['successes']} of {test['missions']} reached the goal "
            f"({test['success_rate']:.0%}, 95 % Wilson interval {low:.0%} to {high:.0%})."
        )
    return f"{text}\nTook {_durations(summary)}. Everything is in"


def _hovering(summary: dict[str, Any], config: Config) -> str:
    """Returns a line with a remedy if most validation missions of an agent's run ran out of time."""
    share, price = summary.get("validation_timed_out", 0.0), round(config.env.collision_reward / 3)
    if share < HOVERS or price > LEAST_PRICE:
        return ""
    left = f" --env.left-volume-reward {price}" if config.env.left_volume_reward < price else ""
    return (
        f"{share:.0%} ran out of time: where a collision costs much, a policy may learn to hover. Try a lower price, "
        f"with --env.collision-reward {price}{left}.\n"
    )


def _of_seeds(summary: dict[str, Any]) -> str:
    low, high = summary["success_interval"]
    each = ", ".join(
        f"seed {seed}: {rate:.1%}" for seed, rate in zip(summary["seeds"], summary["success_rates"], strict=True)
    )
    has_final_world = summary["flown"] != summary["world"]
    missions = "unseen test worlds" if summary["missions"] > 1 or has_final_world else "the mission"
    last = f"\n{summary['flown_successes']} of {len(summary['seeds'])} reached the goal of {_last_world(summary)}."
    return (
        f"Reached the goal in {missions}: {each}.\nInterquartile mean {summary['success_iqm']:.1%}, mean "
        f"{summary['success_mean']:.1%} (95 % interval {low:.1%} to {high:.1%}).{last if has_final_world else ''}\n"
        f"Took {_durations(summary)}. Each seed's run is in"
    )


def _durations(summary: dict[str, Any]) -> str:
    """Returns how long a run took, over all of its sessions where it was continued."""
    sessions = ", over all of its sessions" if summary.get("resumed_at_decisions") else ""
    return (
        f"{format_duration(summary['total_seconds'])} in all, "
        f"{format_duration(summary['train_seconds'])} of it training{sessions}"
    )


def _flight(summary: dict[str, Any]) -> str:
    """Returns which flight the verdict is about."""
    if summary["flown"] == summary["world"]:
        return "The greedy flight"
    return f"The greedy flight through {_last_world(summary)},"


def _last_world(summary: dict[str, Any]) -> str:
    """Describes the world of the last flight of a run in random worlds, for the screen."""
    where = "the paper's map" if summary["flown"] == "paper" else f"'{summary['flown']}'"
    return f"{where}, which training never used"


def _nearest(summary: dict[str, Any]) -> str:
    """Returns the closest approach as a sentence."""
    if summary["outcome"] == "collision":
        return f"It touched {'another drone' if summary.get('hit_drone') else 'an obstacle or the ground'}."
    return f"The least clearance was {clearance_text(summary['min_clearance_m'])}."


def _count(number: int, noun: str) -> str:
    """Returns `1 decision`, `2 decisions`."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")
