"""A finished run, verified: its summary derived anew from its raw files, its flights flown again and judged again.

What the summary says of training and flying is derived anew: metrics and episodes are added up, the recorded flight is
judged by C MuJoCo, the policy flies the final missions once more, and the last checkpoint must have the recorded
digest. Clocks, versions and machine are taken on trust (`NOT_DERIVED`).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.devices.hardware import describe_processor
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.metrics import flight_summary
from edqn_jax.evaluation.missions import RunMissions, missions_of_runs
from edqn_jax.evaluation.rollouts import ShowPhase, fly_on_all_devices
from edqn_jax.evaluation.trajectories import flight_trajectory
from edqn_jax.evaluation.verdicts import check_verdicts, judges_of
from edqn_jax.learn import saved_state
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.trainer import Trainer
from edqn_jax.planning.astar import shortest_path
from edqn_jax.policies import no_run
from edqn_jax.runs.checkpointer import agent_array_name
from edqn_jax.runs.checkpoints import states
from edqn_jax.runs.checkpoints.states import Checkpoint
from edqn_jax.runs.continuation import find_run
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.policies import load_run
from edqn_jax.runs.provenance import describe_workload, digest_of, package_versions
from edqn_jax.runs.summaries import summarize_seeds, summarize_tests
from edqn_jax.runs.verification.derived import DIGITS, from_metrics, from_trajectory, is_same
from edqn_jax.runs.world_copy import COPIES
from edqn_jax.sim.task import group
from edqn_jax.sim.task.flights import Flights
from edqn_jax.training.selection import first_success

_OF_A_CHECKPOINT = ("resumed_at_decisions", "reward", "first_success_seconds")
"""Keys of a summary that only a checkpoint can verify."""

NOT_DERIVED = (
    *("compile_seconds", "total_seconds", "checkpoint_seconds", "devices", "processor", "versions", "figures"),
    *("state_digest", "trained_together"),
)
"""Keys of `summary.json` about clocks and machine, which cannot be derived, and keys that are verified separately."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that was verified."""

    what: str
    says: str
    """What was found; where it is not as recorded, both."""
    right: bool | None
    """None where there is nothing left to compare."""


def verify_run(
    folder: Path, message: Callable[[str], None] = lambda _: None, phase: ShowPhase | None = None
) -> list[Finding]:
    """Verifies a finished run, or those of all seeds that were trained together.

    Args:
        folder: of the run.
        message: told of what takes time.
        phase: called as a phase of flying begins, and as flights end.

    Raises:
        ConfigError: if there is no finished run, or a file of it is not as a run writes it.
    """
    try:
        return _verified(folder, message, phase)
    except ConfigError:
        raise
    except (ArithmeticError, AttributeError, LookupError, OSError, RecursionError, TypeError, ValueError) as error:
        raise ConfigError(f"a file of the run in '{folder}' is not as a run writes it: {error!r}"[:300]) from None


def _verified(folder: Path, message: Callable[[str], None], phase: ShowPhase | None) -> list[Finding]:
    found = find_run(folder)
    if found is None:
        raise no_run(folder)
    run = RunDirectory(folder)
    runs = [run] if found.seeds is None else [run.of_seed(found.config.train.seed + k) for k in range(found.seeds)]
    policies = [load_run(each.path) for each in runs]
    configs, summaries = [config for config, _ in policies], [_read_summary(each) for each in runs]
    if group.is_multi_drone(configs[0]):
        raise ConfigError(
            f"`edqn verify` is for runs of one drone, and env.drones is {configs[0].env.drones}: "
            "C MuJoCo, which judges collisions, knows of no other drones"
        )
    missions = missions_of_runs(configs)
    checkpoint, findings = _last_checkpoint(run)
    if checkpoint is not None:
        recorded = [summary["state_digest"] for summary in summaries]
        findings += _verify_checkpoint(checkpoint, run, runs, configs, missions, recorded, found.seeds)
        findings.append(_verify_policies(checkpoint, configs, [params for _, params in policies]))
    flights_of_seeds = []
    for number, (each, summary, of_run) in enumerate(zip(runs, summaries, missions, strict=True)):
        config, params = policies[number]
        message(f"flying {of_run.final.env_params.missions.scene.shape[0]} missions of '{each.path}' again")
        world, seed = of_run.final.env_params, config.train.seed
        flights = fly_on_all_devices(config, world, params, seed, record=True, phase=phase)
        agent = None if checkpoint is None else _Saved.of(checkpoint, number)
        name = "" if found.seeds is None else f"{each.path.name}: "
        findings += [
            dataclasses.replace(finding, what=name + finding.what)
            for finding in _verify_agent(each, config, of_run, summary, flights, agent)
        ]
        flights_of_seeds.append(flights)
    if found.seeds is not None:
        derived = summarize_seeds(configs[0], missions[0].tests, flights_of_seeds, summaries)
        findings.append(_compare_values("summary.json of all seeds", _read_summary(run), derived))
    return findings


@dataclasses.dataclass(frozen=True)
class _Saved:
    """Facts of an agent's run in the last checkpoint, beside its state."""

    agent: dict[str, Any]
    host: dict[str, Any]
    reward: Any
    versions: dict[str, str]

    @classmethod
    def of(cls, checkpoint: Checkpoint, number: int) -> _Saved:
        facts = checkpoint.facts
        return cls(checkpoint.host["agents"][number], checkpoint.host, json.loads(facts["reward"]), facts)


def _read_summary(run: RunDirectory) -> dict[str, Any]:
    """Returns a run's `summary.json`.

    Raises:
        ConfigError: if there is none.
    """
    if not run.is_finished:
        raise ConfigError(
            f"the run in '{run.path}' is not finished; continue it with edqn train --run-dir '{run.path}'"
        )
    summary = json.loads(run.summary_file.read_text(encoding="utf-8"))
    if not isinstance(summary, dict):
        raise ConfigError(f"'{run.summary_file}' is no summary of a run")
    return summary


def _last_checkpoint(run: RunDirectory) -> tuple[Checkpoint | None, list[Finding]]:
    """Returns the last checkpoint, and findings if it cannot be read."""
    said: list[str] = []
    try:
        checkpoint = states.newest_checkpoint(run.checkpoints, lambda _: None, said.append, set_aside=False)
    except ConfigError as error:
        return None, [Finding("last checkpoint", said[0] if said else str(error), False)]
    if said:
        return None, [Finding("last checkpoint", said[0], False)]
    if checkpoint is None:
        nothing = "there is none any more: what only it could vouch for is not verified"
        return None, [Finding("last checkpoint", nothing, None)]
    return checkpoint, []


def _verify_checkpoint(
    checkpoint: Checkpoint,
    run: RunDirectory,
    runs: Sequence[RunDirectory],
    configs: Sequence[Config],
    missions: Sequence[RunMissions],
    recorded: Sequence[str],
    seeds: int | None,
) -> list[Finding]:
    """Returns whether the state, the options and the growing files are those of the last checkpoint, a sealed one."""
    worlds = [each.training.env_params for each in missions]
    trainer = Trainer(configs[0], worlds[0] if seeds is None else worlds, jax.devices()[:1])
    done = checkpoint.host["done"]
    expected = saved_state.state_shapes(trainer, done).items()
    arrays = [checkpoint.arrays.get(name, np.zeros(shape, kind)) for name, (shape, kind) in expected]
    digests = [digest_of(arrays if seeds is None else [array[k] for array in arrays]) for k in range(len(configs))]
    alike = digests == list(recorded)
    findings = [
        Finding(
            "last checkpoint", f"its state, after training step {done:,}, has {_not(alike)}the recorded digest", alike
        )
    ]
    alike = checkpoint.config == run.config_file.read_text(encoding="utf-8")
    findings.append(Finding("config.yaml", f"it is {_not(alike)}as at the last checkpoint", alike))
    said = checkpoint.host["files"]
    files = {str(f.relative_to(run.path)): f for each in runs for f in (each.metrics_file, each.episodes_file)}
    differ = [name for name, file in files.items() if states.log_digests({name: file}) != {name: said.get(name)}]
    findings.append(
        Finding(
            "metrics.jsonl and episodes.csv",
            f"{' and '.join(differ)} changed after the last checkpoint" if differ else "as at the last checkpoint",
            not differ,
        )
    )
    return findings


def _verify_policies(checkpoint: Checkpoint, configs: Sequence[Config], policies: Sequence[PolicyParams]) -> Finding:
    """Returns whether the saved policies are those that the last checkpoint says the run ended with."""
    compared = 0
    for number, (config, params) in enumerate(zip(configs, policies, strict=True)):
        if config.train.keep == "best" and checkpoint.host["agents"][number]["decisions"] == 0:
            continue  # ended before its first validation: the checkpoint holds none
        compared += 1
        for path, leaf in jax.tree_util.tree_leaves_with_path(params):
            held = checkpoint.arrays.get(agent_array_name(number, path))
            if np.size(leaf) and (held is None or not np.array_equal(held, leaf)):
                return Finding("policy", "it is not the one that the last checkpoint says the run ended with", False)
    if compared == 0:
        return Finding("policy", "the run ended before its first validation: no checkpoint holds it", None)
    return Finding("policy", "it is the one that the run ended with, by its last checkpoint", True)


def _verify_agent(
    run: RunDirectory,
    config: Config,
    missions: RunMissions,
    summary: Mapping[str, Any],
    flights: Flights,
    saved: _Saved | None,
) -> list[Finding]:
    """Returns the findings of one agent's run."""
    first = judges_of(config, missions.final)[int(missions.final.env_params.missions.scene[0])]
    metrics, recorded = run.read_metrics(), run.read_trajectory()
    of_training = from_metrics(config, metrics)
    of_flight, within = from_trajectory(config, missions, first, recorded)
    scene = missions.scene
    described = {
        "shortest_path_m": shortest_path(scene, scene.start, scene.goal, config.drone.body_radius_m).length_m,
        "seed": config.train.seed,
        "workload": describe_workload(config, missions.training.scene()),
    }
    worlds = {"world": config.world.name, "flown": config.world.flown or config.world.name}
    # The file of a world that has moved is the run's own copy.
    described |= {name: value for name, value in worlds.items() if COPIES not in Path(value).parts[-2:]}
    told = {} if saved is None else _from_checkpoint(saved)
    agreed = check_verdicts(config, missions.final, flights)
    wrong = [each.mission for each in agreed if not each.agrees]
    elsewhere = _describe_recording(summary, saved)
    return [
        _episodes_and_metrics(run, metrics),
        _compare_values("summary.json from metrics.jsonl", summary, of_training),
        _compare_values("summary.json from trajectory.csv", summary, of_flight, within),
        _compare_values("summary.json from config.yaml and world", summary, described),
        *([] if saved is None else [_compare_values("summary.json from the last checkpoint", summary, told)]),
        *_unverified_keys(summary, {*of_training, *of_flight, *described, *told, *worlds}, missions.tests > 0),
        _fly_again(config, summary, recorded, flights, elsewhere),
        *_tests_again(missions, summary, flights, elsewhere),
        Finding(
            "verdicts by C MuJoCo",
            f"{len(agreed) - len(wrong)} of {len(agreed)} flights"
            + (", of meshes that are not convex by trimesh" if first.meshes else "")
            + (f"; not missions {wrong[:10]}" if wrong else ""),
            not wrong,
        ),
    ]


def _unverified_keys(summary: Mapping[str, Any], derived: set[str], tests: bool) -> list[Finding]:
    """Returns a finding for keys of a summary that cannot be verified, if there are any."""
    known = derived | {*NOT_DERIVED, *_OF_A_CHECKPOINT} | ({"test"} if tests else set())
    more = sorted(summary.keys() - known)
    return [Finding("summary.json", f"it has {', '.join(more)}, which no run has", False)] if more else []


def _from_checkpoint(saved: _Saved) -> dict[str, Any]:
    """Returns the expected training entries of `summary.json`, from the last checkpoint."""
    since = first_success([(found[0], found[1], found[2]) for found in saved.agent["validations"]])
    timed_out = saved.agent.get("timed_out")  # of older runs none has it
    return {
        "train_seconds": saved.host["train_seconds"],
        "resumed_at_decisions": saved.host["resumed_at"],
        "reward": saved.reward,
        "first_success_decisions": since[0],
        "first_success_seconds": since[1],
        "episodes": saved.agent["episodes"],
        "validation_success": saved.agent["success"],
        "validation_spl": saved.agent["spl"],
        "parameters_from_decisions": saved.agent["decisions"],
        **({} if timed_out is None else {"validation_timed_out": timed_out}),
    }


def _not(same: bool) -> str:
    return "" if same else "not "


def _episodes_and_metrics(run: RunDirectory, metrics: Sequence[Mapping[str, Any]]) -> Finding:
    """Returns whether `episodes.csv` and `metrics.jsonl` agree on every chunk."""
    what, episodes = "episodes.csv and metrics.jsonl", run.read_episodes()
    before = 0
    for row in metrics:
        until = int(np.searchsorted(episodes["step"], row["decisions"], side="right"))
        ended = episodes["outcome"][before:until]
        whole = episodes["return"][before:until][ended != "diverged"]
        share = float(np.mean(ended == "goal")) if len(ended) else None
        mean = float(np.mean(whole)) if len(whole) else None
        alike = row["episodes"] == until and row["diverged"] == np.count_nonzero(ended == "diverged")
        if not (alike and is_same(row["success_rate"], share) and is_same(row["mean_return"], mean, DIGITS * 1e3)):
            return Finding(what, f"they differ in the chunk that ends with decision {row['decisions']:,}", False)
        before = until
    if before != len(episodes["step"]):
        return Finding(what, f"{len(episodes['step']) - before} episodes ended after the last chunk", False)
    return Finding(what, f"they agree on {before:,} episodes in {len(metrics):,} chunks", True)


def _fly_again(
    config: Config,
    summary: Mapping[str, Any],
    recorded: Mapping[str, np.ndarray],
    flights: Flights,
    elsewhere: str | None,
) -> Finding:
    """Returns whether the policy flies the recorded flight once more, column by column."""
    what = "the flight, flown again"
    again, path = flight_summary(flights), flight_trajectory(config, flights)
    ended = f"{again['outcome']} after {again['steps']} decisions"
    if elsewhere is not None:
        alike = "as recorded" if again["outcome"] == summary["outcome"] else f"recorded as {summary['outcome']}"
        return Finding(what, f"{ended}, {alike} {elsewhere}, where rounding is another", None)
    if len(path["t"]) != len(recorded["t"]):
        return Finding(what, f"{ended}, not {summary['outcome']} after {summary['steps']}", False)
    apart = {name: float(np.max(np.abs(path[name] - recorded[name]))) for name in path}
    differ = [name for name in path if apart[name] > max(DIGITS, 2e-6 * float(np.max(np.abs(path[name]))))]
    if differ:
        return Finding(what, f"{ended}; it differs from the recorded one in {', '.join(differ)}", False)
    return Finding(what, f"{ended}, at most {1000 * max(apart[axis] for axis in 'xyz'):.2g} mm apart", True)


def _tests_again(
    missions: RunMissions, summary: Mapping[str, Any], flights: Flights, elsewhere: str | None
) -> list[Finding]:
    """Returns whether the test worlds end as recorded when they are flown once more."""
    if not missions.tests:
        return []
    what, again = "the test worlds, flown again", summarize_tests(missions.tests, flights)
    if elsewhere is not None:
        says = f"{again['successes']} of {again['missions']} reach the goal, {summary['test']['successes']} {elsewhere}"
        return [Finding(what, says, None)]
    return [_compare_values(what, summary.get("test") or {}, again)]


def _describe_recording(summary: Mapping[str, Any], saved: _Saved | None) -> str | None:
    """Returns on what other hardware or with what other versions a run was recorded; None if they are those here."""
    device = str(summary["devices"][0]).partition(":")[0]
    if device != jax.default_backend() and (device, jax.default_backend()) != ("cuda", "gpu"):
        return f"on a {device.upper()}"
    here = package_versions()
    recorded = dict(summary["versions"]) | ({} if saved is None else {"jax": saved.versions["jax"]})
    other = {name: said for name, said in recorded.items() if here.get(name) != said}
    if other:
        return "with " + ", ".join(f"{name} {said}" for name, said in other.items())
    machine = _model(summary.get("processor"))
    return None if machine in (None, _model(describe_processor())) else f"on an {machine}"


def _model(described: str | None) -> str | None:
    """Returns a processor's name without the number of its cores."""
    return None if described is None else described.rpartition(",")[0]


def _compare_values(
    what: str, recorded: Mapping[str, Any], found: Mapping[str, Any], within: Mapping[str, float] | None = None
) -> Finding:
    """Returns whether all values that were found are those recorded."""
    differ = [
        f"{name} is {recorded.get(name)} and should be {value}"
        for name, value in found.items()
        if not is_same(recorded.get(name), value, (within or {}).get(name, 0.0))
    ]
    if differ:
        return Finding(what, "; ".join(differ), False)
    return Finding(what, f"{len(found)} values agree", True)
