"""A finished run, verified: its summary derived anew from its raw files, its flights flown again and judged again.

Nothing that the summary says is taken from it: metrics and episodes are added up, the recorded flight is judged by C
MuJoCo, the policy flies the final missions once more, and the last checkpoint must have the recorded digest.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.judge import Judge, clearance, replay_contact
from edqn_jax.evaluation.metrics import EMPTY_M, flight_summary
from edqn_jax.evaluation.missions import RunMissions, missions_of_runs
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.trajectories import trajectory
from edqn_jax.evaluation.verdicts import CONTACT_TOLERANCE_M, check_verdicts, judges_of
from edqn_jax.learn import saved_state
from edqn_jax.learn.trainer import Trainer
from edqn_jax.parallel.devices import processor
from edqn_jax.planners.astar import shortest_path
from edqn_jax.runs import states
from edqn_jax.runs.continuation import begun
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.policies import load_run
from edqn_jax.runs.provenance import digest_of, versions, workload
from edqn_jax.sim.flights import Flights
from edqn_jax.sim.outcomes import Outcome
from edqn_jax.training.selection import FLIES
from edqn_jax.training.summaries import of_all_seeds, of_tests

DIGITS = 1e-5
"""Relative error of what is derived from files with six or seven digits."""

CLEARANCE_M = 2e-3
"""Largest difference of a clearance, in single precision by us and in double precision by C MuJoCo."""

POSITION_M = 1e-4
"""Largest distance of two equal flights, one of which was written with seven digits."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that was verified."""

    what: str
    says: str
    """What was found; where it is not as recorded, both."""
    right: bool | None
    """None where there is nothing left to compare."""


def verify(folder: Path, message: Callable[[str], None] = lambda _: None) -> list[Finding]:
    """Verifies a finished run, or those of all seeds that were trained together.

    Args:
        folder: of the run.
        message: told of what takes time.

    Raises:
        ConfigError: if there is no finished run, or something of it cannot be read.
    """
    held = begun(folder)
    if held is None:
        raise ConfigError(f"there is no run in '{folder}': it holds no config.yaml")
    run = RunDirectory(folder)
    folders = [run] if held.seeds is None else [run.of_seed(held.config.train.seed + k) for k in range(held.seeds)]
    policies = [load_run(each.path) for each in folders]
    configs = [config for config, _ in policies]
    summaries = [_summary(each) for each in folders]
    findings = [Finding("policy", "its files have the checksums that they were saved with", True)]
    missions = missions_of_runs(configs)
    findings += _of_checkpoint(run, configs, missions, [summary["state_digest"] for summary in summaries], held.seeds)
    flown = []
    for each, (config, params), of_run, summary in zip(folders, policies, missions, summaries, strict=True):
        message(f"flying {of_run.final.world.missions.scene.shape[0]} missions of '{each.path}' again")
        flights = fly_on_all_devices(config, of_run.final.world, params, config.train.seed, record=True)
        found = _of_run(each, config, of_run, summary, flights)
        name = "" if held.seeds is None else f"{each.path.name}: "
        findings += [dataclasses.replace(finding, what=name + finding.what) for finding in found]
        flown.append(flights)
    if held.seeds is not None:
        derived = of_all_seeds(configs[0], missions[0].tests, flown, summaries)
        findings.append(_compared("summary.json of all seeds", _summary(run), derived, {}))
    return findings


def _summary(run: RunDirectory) -> dict[str, Any]:
    """Returns a run's `summary.json`.

    Raises:
        ConfigError: if there is none.
    """
    if not run.finished:
        raise ConfigError(
            f"the run in '{run.path}' is not finished; continue it with edqn train --run-dir '{run.path}'"
        )
    try:
        summary = json.loads(run.summary_file.read_text(encoding="utf-8"))
        if not isinstance(summary, dict):
            raise ValueError
    except (OSError, ValueError, RecursionError):
        raise ConfigError(f"'{run.summary_file}' is no summary of a run") from None
    return summary


def _of_checkpoint(
    run: RunDirectory,
    configs: Sequence[Config],
    missions: Sequence[RunMissions],
    recorded: Sequence[str],
    seeds: int | None,
) -> list[Finding]:
    """Returns whether the last checkpoint holds the states with the digests [K] that the summaries name."""
    worlds = [each.training.world for each in missions]
    trainer = Trainer(configs[0], worlds[0] if seeds is None else worlds, jax.devices()[:1])
    said: list[str] = []
    try:
        checkpoint = states.newest(run.checkpoints, lambda _: None, said.append, set_aside=False)
    except ConfigError as error:
        return [Finding("last checkpoint", str(error), False)]
    if said:
        return [Finding("last checkpoint", said[0], False)]
    if checkpoint is None:
        return [Finding("last checkpoint", "there is none any more, so the last state cannot be compared", None)]
    done = checkpoint.host["done"]
    expected = saved_state.expected(trainer, done).items()
    arrays = [checkpoint.arrays.get(name, np.zeros(shape, kind)) for name, (shape, kind) in expected]
    digests = [digest_of(arrays if seeds is None else [array[k] for array in arrays]) for k in range(len(configs))]
    if digests == list(recorded):
        return [Finding("last checkpoint", f"the state after training step {done:,} has the recorded digest", True)]
    return [Finding("last checkpoint", f"the state after training step {done:,} is not the recorded one", False)]


def _of_run(
    run: RunDirectory, config: Config, missions: RunMissions, summary: Mapping[str, Any], flights: Flights
) -> list[Finding]:
    """Returns what is found of one agent's run."""
    judges = judges_of(config, missions.final)
    first = judges[int(missions.final.world.missions.scene[0])]
    metrics, recorded = _metrics(run), _recorded(run)
    from_metrics = _from_metrics(config, metrics)
    from_flight, within = _from_trajectory(config, missions, first, recorded)
    scene = missions.scene
    shortest = shortest_path(scene, scene.start, scene.goal, config.drone.body_radius_m)
    described = {
        "shortest_path_m": shortest.length_m,
        "seed": config.train.seed,
        "workload": workload(config, missions.training.scene()),
    }
    agreed = check_verdicts(config, missions.final, flights)
    wrong = [each.mission for each in agreed if not each.agrees]
    return [
        _of_episodes(run, metrics),
        _compared("summary.json from metrics.jsonl", summary, from_metrics, {}),
        _compared("summary.json from trajectory.csv", summary, from_flight, within),
        _compared("summary.json from config.yaml and world", summary, described, {}),
        _flown_again(config, summary, recorded, flights),
        *_tests_again(missions, summary, flights),
        Finding(
            "verdicts by C MuJoCo",
            f"{len(agreed) - len(wrong)} of {len(agreed)} flights" + (f"; not missions {wrong[:10]}" if wrong else ""),
            not wrong,
        ),
    ]


def _metrics(run: RunDirectory) -> list[dict[str, Any]]:
    try:
        return run.read_metrics()
    except (OSError, ValueError) as error:
        raise ConfigError(f"'{run.metrics_file}' cannot be read: {error}") from None


def _recorded(run: RunDirectory) -> dict[str, np.ndarray]:
    try:
        return run.read_trajectory()
    except (OSError, ValueError) as error:
        raise ConfigError(f"'{run.trajectory_file}' cannot be read: {error}") from None


def _of_episodes(run: RunDirectory, metrics: Sequence[Mapping[str, Any]]) -> Finding:
    """Returns whether `episodes.csv` and `metrics.jsonl` say the same of every chunk."""
    what = "episodes.csv and metrics.jsonl"
    try:
        episodes = run.read_episodes()
    except (OSError, ValueError, IndexError) as error:
        raise ConfigError(f"'{run.episodes_file}' cannot be read: {error}") from None
    before = 0
    for row in metrics:
        until = int(np.searchsorted(episodes["step"], row["decisions"], side="right"))
        ended = episodes["outcome"][before:until]
        share = float(np.mean(ended == "goal")) if len(ended) else None
        if row["episodes"] != until or not _same(row["success_rate"], share):
            return Finding(what, f"they differ in the chunk that ends with decision {row['decisions']:,}", False)
        before = until
    if before != len(episodes["step"]):
        return Finding(what, f"{len(episodes['step']) - before} episodes ended after the last chunk", False)
    return Finding(what, f"they agree on {before:,} episodes in {len(metrics):,} chunks", True)


def _from_metrics(config: Config, metrics: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns what `summary.json` must say of the training, from the lines of `metrics.jsonl`."""
    checked = [row for row in metrics if row.get("validation_spl") is not None]
    # Of equal ones the latest.
    best = max(enumerate(checked), key=lambda each: (each[1]["validation_spl"], each[0]))[1] if checked else None
    kept = checked[-1] if checked and config.train.keep == "last" else best
    flew = [row["decisions"] for row in checked if row["validation_mission"] >= FLIES]
    decisions = [0, *(row["decisions"] for row in metrics)]
    seconds = sum(
        (row["decisions"] - before) / row["decisions_per_second"]
        for before, row in zip(decisions, metrics, strict=False)
    )
    return {
        "train_decisions": decisions[-1],
        "train_seconds": seconds,
        "decisions_per_second": decisions[-1] / seconds if seconds else None,
        "episodes": metrics[-1]["episodes"] if metrics else 0,
        "first_success_decisions": flew[0] if flew else None,
        "validation_success": kept["validation_success"] if kept else 0.0,
        "validation_spl": kept["validation_spl"] if kept else -1.0,
        "parameters_from_decisions": kept["decisions"] if kept else 0,
    }


def _from_trajectory(
    config: Config, missions: RunMissions, judge: Judge, recorded: Mapping[str, np.ndarray]
) -> tuple[dict[str, Any], dict[str, float]]:
    """Returns what `summary.json` must say of the recorded flight, and how far numbers may be off; C MuJoCo judges."""
    flown = missions.final.world.missions
    start, goal = np.asarray(flown.start[0], np.float64), np.asarray(flown.goal[0], np.float64)
    positions = np.column_stack([recorded[axis] for axis in "xyz"])
    path = np.concatenate([start[None], positions])
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    steps, seconds, decision = len(positions), float(recorded["t"][-1]), config.drone.physics_steps
    contact = replay_contact(judge, path)
    ends = [clearance(judge, point)[0] for point in path]
    if contact is not None:
        cut = 1.0 - contact.fraction if contact.segment == steps - 1 else math.inf  # sooner: not as recorded
        lengths[-1] *= 1.0 - cut
        seconds -= cut * config.drone.physics_dt_s
        ends[-1] = 0.0
    low, high = np.asarray(missions.scene.volume, np.float64)
    if contact is not None:
        outcome = Outcome.COLLISION
    elif np.any(positions[-1] < low) or np.any(positions[-1] > high):
        outcome = Outcome.LEFT_VOLUME
    elif np.linalg.norm(positions[-1] - goal) < config.env.goal_radius_m:
        outcome = Outcome.GOAL
    else:
        outcome = Outcome.TIME_OUT if steps == config.env.max_decisions * decision else Outcome.DIVERGED
    rewards = recorded["reward"][::decision]
    values = {
        "success": outcome == Outcome.GOAL,
        "outcome": outcome.name.lower(),
        "steps": -(-steps // decision),
        "path_length_m": float(np.sum(lengths)),
        "flight_seconds": seconds,
        "return": float(np.sum(rewards)),
        "min_clearance_m": min(float(min(ends)), EMPTY_M),
    }
    slack = CONTACT_TOLERANCE_M if contact is not None else 0.0
    speed = lengths[-1] / config.drone.physics_dt_s if contact is not None else 1.0
    return values, {
        "path_length_m": slack,
        "flight_seconds": slack / max(speed, 1e-3),
        "return": DIGITS * float(np.sum(np.abs(rewards))),
        "min_clearance_m": CLEARANCE_M + slack,
    }


def _flown_again(
    config: Config, summary: Mapping[str, Any], recorded: Mapping[str, np.ndarray], flights: Flights
) -> Finding:
    """Returns whether the policy flies the recorded flight once more."""
    what = "the flight, flown again"
    again, path = flight_summary(flights), trajectory(config, flights)
    ended = f"{again['outcome']} after {again['steps']} decisions"
    if (elsewhere := _recorded_elsewhere(summary)) is not None:
        right = again["outcome"] == summary["outcome"]
        return Finding(what, f"{ended}; recorded {elsewhere}, so rounding differs", right)
    if len(path["t"]) != len(recorded["t"]):
        return Finding(what, f"{ended}, not {summary['outcome']} after {summary['steps']}", False)
    apart = max(float(np.max(np.abs(path[axis] - recorded[axis]))) for axis in "xyz")
    right = apart <= POSITION_M and np.array_equal(path["action"], recorded["action"])
    return Finding(what, f"{ended}, at most {1000 * apart:.2g} mm from the recorded one", bool(right))


def _tests_again(missions: RunMissions, summary: Mapping[str, Any], flights: Flights) -> list[Finding]:
    """Returns whether the test worlds end as recorded when they are flown once more."""
    if not missions.tests:
        return []
    again, before = of_tests(missions.tests, flights), summary.get("test") or {}
    if (elsewhere := _recorded_elsewhere(summary)) is not None:
        low, high = before.get("interval", (0.0, 0.0))
        says = f"{again['successes']} of {again['missions']} reach the goal; recorded {elsewhere}, so rounding differs"
        return [Finding("the test worlds, flown again", says, low <= again["success_rate"] <= high)]
    return [_compared("the test worlds, flown again", before, again, {})]


def _recorded_elsewhere(summary: Mapping[str, Any]) -> str | None:
    """Returns what other hardware or versions a run was recorded with; None if they are those here."""
    device = str((summary.get("devices") or ["unknown"])[0]).partition(":")[0]
    if device != jax.default_backend() and (device, jax.default_backend()) != ("cuda", "gpu"):
        return f"on a {device.upper()}"
    other = {name: said for name, said in (summary.get("versions") or {}).items() if versions().get(name) != said}
    if other:
        return "with " + ", ".join(f"{name} {said}" for name, said in other.items())
    machine = _model(summary.get("processor"))
    return None if machine in (None, _model(processor())) else f"on an {machine}"


def _model(described: str | None) -> str | None:
    """Returns a processor's name without the number of its cores."""
    return None if described is None else described.rpartition(",")[0]


def _compared(what: str, recorded: Mapping[str, Any], found: Mapping[str, Any], within: Mapping[str, float]) -> Finding:
    """Returns whether all values that were found are those recorded."""
    differ = [
        f"{name} is {recorded.get(name)} and should be {value}"
        for name, value in found.items()
        if not _same(recorded.get(name), value, within.get(name, 0.0))
    ]
    if differ:
        return Finding(what, "; ".join(differ), False)
    return Finding(what, f"{len(found)} values agree", True)


def _same(one: Any, other: Any, within: float = 0.0) -> bool:
    """Returns whether two values of JSON are equal, numbers up to the digits of files or `within`."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(one[name], other[name]) for name in one)
    if isinstance(one, Sequence) and isinstance(other, Sequence) and not isinstance(one, str):
        return len(one) == len(other) and all(map(_same, one, other))
    if _is_number(one) and _is_number(other):
        if min(one, other) >= EMPTY_M:  # clearances where there is nothing to hit
            return True
        return abs(one - other) <= max(within, DIGITS * max(abs(one), abs(other)))
    return one == other


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
