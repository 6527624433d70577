"""How many unseen worlds does a policy fly? Trains several seeds in one program and flies test worlds, row by row.

A row is a world with a sensor. It is written when it is done, with the policies, and a row that is written already is
not measured again: a command that was stopped goes on where it was, and several may share the rows. No row is begun
that would not end in time. With --train-only a machine with a GPU trains; the same command without it flies, on any
machine, at the same commit and with the same options (-- --tuned-for gpu).

    python benchmarks/success.py --out runs/success
    python benchmarks/success.py --out runs/success --worlds medium --sensors events depth -- --total-steps 9000000
    python benchmarks/success.py --out runs/success --runs runs/seed-0 runs/seed-1 --worlds medium
    python benchmarks/success.py --out runs/success --runs runs/seed-0 runs/seed-1 --worlds rooms --shuffle-codes
    python benchmarks/success.py --out runs/success --report

With --runs nothing is trained: the policies of these runs, which differ in their seeds alone, fly; with
--shuffle-codes each drone gets what the sensor of another one shows: codes as they ought to be, but useless. Arguments
after -- are options of train.py; defaults are those of the hardware. The interval is a bootstrap over seeds and
missions. A* for the SPL takes 0.4 s a world and core, once for each world, when there is time after the rows; --no-spl
leaves it out.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import contextlib
import dataclasses
import functools
import hashlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import filelock
import jax
import numpy as np
import yaml

from edqn_jax.cli.process.status import show_phase
from edqn_jax.config import FAMILIES, Config
from edqn_jax.config.loading import apply_layer, to_yaml
from edqn_jax.devices.devices import most_that_divide, use_cpu_devices
from edqn_jax.devices.hardware import count_cores
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.intervals import interquartile_mean, rate_interval
from edqn_jax.evaluation.metrics import fill_unknown_lengths, spl
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.files import check_can_make
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.policies import load_policy, save_policy
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.training.loop import train_seeds
from measurement import json_report
from measurement.flags import parse_options, split, with_test_worlds_only
from rivals.learners import flight_columns
from rivals.planning import judged_scenes, shortest_lengths

Row = dict[str, Any]

TRAINED = "trained.json"
"""In a folder of policies: says that all seeds of a row have been trained, and what that took."""

FIRST_ROW_S = 240.0
"""Assumed duration of a row before one has been measured."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments; `flags` are those after --."""
    words, flags = split(argv)
    parser = Parser("success", __doc__, json=None)
    worlds = ["sparse", "medium", "dense"]
    parser.add_argument("--out", type=Path, required=True, help="folder of rows and policies")
    parser.add_argument("--worlds", nargs="+", default=worlds, choices=FAMILIES, help="(default sparse medium dense)")
    parser.add_argument("--sensors", nargs="+", default=["events"], help="env.sensor of each row (default events)")
    parser.add_argument("--seeds", type=at_least_one, default=5, help="training seeds, in one program (default 5)")
    parser.add_argument("--runs", nargs="+", type=Path, help="fly the policies of these runs instead of training")
    parser.add_argument("--shuffle-codes", action="store_true", help="give each drone what another one sees (--runs)")
    parser.add_argument("--missions", type=at_least_one, default=1000, help="test missions of each seed (default 1000)")
    parser.add_argument("--minutes", type=float, default=9.0, help="begin no row that would end later (default 9)")
    parser.add_argument("--train-only", action="store_true", help="leave the flights to a later call, on any machine")
    parser.add_argument("--no-spl", action="store_true", help="do not search shortest paths")
    parser.add_argument("--report", action="store_true", help="measure no row, print those in --out, with SPL")
    args = parser.parse(words)
    args.flags = flags
    if args.runs and (flags or args.sensors != ["events"]):
        parser.error("--runs have their own sensor and options; leave out --sensors and the arguments after --")
    if args.shuffle_codes and not args.runs:
        parser.error("--shuffle-codes needs the --runs that fly with them")
    if args.runs and (args.report or args.train_only):
        parser.error("--report and --train-only fly nothing; leave out --runs")
    if args.report and args.train_only:
        parser.error("--report measures nothing; leave out --train-only")
    return args


def config_of(world: str, sensor: str, flags: Sequence[str]) -> Config:
    """Returns the configuration of a row's first seed.

    Raises:
        ConfigError: if the options are invalid.
    """
    config = with_test_worlds_only(parse_options(["--world", world, "--env.sensor", sensor, *flags]))
    # What is flown at the end is what was learnt at the end: no choice by validation, no time for it.
    train = dataclasses.replace(config.train, validation_every=0, validation_missions=config.env.drones, keep="last")
    return dataclasses.replace(config, train=train)


def config_of_runs(world: str, policies: Sequence[Policy]) -> Config:
    """Returns the configuration of a row that flies policies of one training.

    Raises:
        ConfigError: if their options differ in more than the seed.
    """
    first = policies[0].config
    for other in policies[1:]:
        seed = dataclasses.replace(other.config.train, seed=first.train.seed)
        if dataclasses.replace(other.config, train=seed) != first:
            raise ConfigError("the runs of a row must have the same options but train.seed; these differ in others")
    return dataclasses.replace(first, world=dataclasses.replace(first.world, name=world))


def row_file(out: Path, config: Config, missions: int, identity: str) -> Path:
    """Returns the file of a row; rows with other options or missions, or of another commit, have other names.

    Args:
        out: folder of rows.
        config: of the first seed.
        missions: of each seed.
        identity: what else tells rows apart.
    """
    text = f"{identity} {missions} {commit()}\n{to_yaml(config)}"
    digest = hashlib.sha256(text.encode()).hexdigest()[:10]
    return out / f"{config.world.name}-{config.env.sensor}-{digest}.json"


def policies_of(file: Path) -> Path:
    """Returns the folder of the policies of a row's file."""
    return file.parent / "policies" / file.stem


def digest_of(policies: Sequence[Policy]) -> str:
    """Returns a digest of the parameters of policies."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves([policy.params for policy in policies]):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


@functools.cache
def commit() -> str | None:
    """Returns the commit of this checkout; None where git does not say."""
    try:
        said = subprocess.run(["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True)
    except OSError:
        return None
    return said.stdout.strip() or None


def read_rows(out: Path) -> list[Row]:
    """Returns the rows of a folder, the oldest first.

    Raises:
        ConfigError: if a file is none of ours.
    """
    files = sorted((file for file in out.glob("*-*-*.json")), key=lambda file: file.stat().st_mtime)
    rows = []
    for file in files:
        try:
            rows.append(json.loads(file.read_text(encoding="utf-8")))
        except ValueError:
            raise ConfigError(f"'{file}' is not a row that this benchmark wrote; move it away") from None
    return rows


def train_row(config: Config, seeds: int, missions: int, folder: Path) -> Row:
    """Trains the seeds of a row as `trained` does, flies the test missions, and returns the row."""
    began = time.perf_counter()
    known = (folder / TRAINED).is_file()
    policies, training = trained(config, seeds, folder)
    began -= training["seconds"] if known else 0.0
    took = {name: training[name] for name in ("train_seconds", "compile_seconds")}
    return _row(config, policies, missions, training["decisions"], took, began) | {"training": training}


def trained(config: Config, seeds: int, folder: Path) -> tuple[list[Policy], dict[str, Any]]:
    """Trains the seeds of a row and saves their policies in `folder`, or loads them if that has been done.

    Returns:
        The policies, and what their training took, where and with which commit.
    """
    file = folder / TRAINED
    if file.is_file():
        training = json.loads(file.read_text(encoding="utf-8"))
        return [load_policy(folder / name) for name in training["policies"]], training
    began = time.perf_counter()
    shutil.rmtree(folder, ignore_errors=True)  # of a training that was cut short
    results = train_seeds(seeds, config)
    policies = [Policy(result.policy.config, result.policy.params) for result in results]
    names = [f"seed-{policy.config.train.seed}" for policy in policies]
    for policy, name in zip(policies, names, strict=True):
        save_policy(policy, folder / name)
    training = {
        "policies": names,
        "decisions": results[0].decisions,
        "train_seconds": results[0].train_seconds,
        "compile_seconds": results[0].compile_seconds,
        "seconds": time.perf_counter() - began,
        "commit": commit(),
        **json_report.machine(jax.devices()),
    }
    json_report.write_row(file, training)
    return policies, training


def fly_row(
    config: Config, policies: Sequence[Policy], runs: Sequence[Path], missions: int, shuffle_codes: bool = False
) -> Row:
    """Flies policies of runs through the test missions, and returns the row; what their training took is added up.

    Args:
        config: of the row, with the world that is flown.
        policies: one a run.
        runs: folders.
        missions: of each policy.
        shuffle_codes: give each drone what the sensor of another one shows.

    Raises:
        ConfigError: if a run has no summary.
    """
    began = time.perf_counter()
    summaries = [_summary(run) for run in runs]
    # Runs that were trained together have the times of all of them.
    took = {
        key: sum(summary[key] / summary.get("trained_together", 1) for summary in summaries)
        for key in ("train_seconds", "compile_seconds")
    }
    row = _row(config, policies, missions, summaries[0]["train_decisions"], took, began, shuffle_codes)
    return row | {"runs": [str(run) for run in runs], "trained_in": policies[0].config.world.name}


def _summary(run: Path) -> dict[str, Any]:
    file = run / "summary.json"
    if not file.is_file():
        raise ConfigError(f"'{run}' holds no summary.json, so it is no finished run of train.py")
    return json.loads(file.read_text(encoding="utf-8"))


def _row(
    config: Config,
    policies: Sequence[Policy],
    missions: int,
    decisions: int,
    took: Mapping[str, float],
    began: float,
    shuffle_codes: bool = False,
) -> Row:
    """Flies the test missions and returns the row."""
    course = load_missions(config, config.world.name, missions)
    turns = turns_of(config, policies, course.env_params, missions, shuffle_codes)
    return {
        "benchmark": "success",
        "world": config.world.name,
        "sensor": config.env.sensor,
        "missions": missions,
        "shuffled": shuffle_codes,
        "decisions": decisions,
        **took,
        "row_seconds": time.perf_counter() - began,
        "commit": commit(),
        "options": to_yaml(config),
        "turns": turns,
        **json_report.machine(jax.devices()),
    }


def turns_of(
    config: Config, policies: Sequence[Policy], world: EnvParams, missions: int, shuffle_codes: bool = False
) -> list[dict[str, Any]]:
    """Returns the flights of each policy through the same missions."""
    turns = []
    for policy in policies:
        flights = fly_on_all_devices(config, world, policy.params, shuffle_codes=shuffle_codes)
        turns.append({"seed": policy.config.train.seed, "flights": flight_columns(flights, missions)})
    return turns


def shortest_paths(out: Path, config: Config, missions: int, search: bool) -> np.ndarray | None:
    """Returns the lengths [M] of A*'s paths of the test missions, NaN without a path; None if not yet searched.

    Args:
        out: folder of rows.
        config: gives world and body.
        missions: M.
        search: whether to search where no earlier call has.
    """
    file = out / f"shortest_{config.world.name}_{missions}_{config.drone.body_radius_m:g}.json"
    if file.is_file():
        return np.array(json.loads(file.read_text(encoding="utf-8"))["lengths"], float)
    if not search:
        return None
    lengths = shortest_lengths(config, judged_scenes(config, missions))
    json_report.write_row(file, {"world": config.world.name, "lengths": lengths})
    return np.array(lengths, float)


def figures(row: Row, shortest: np.ndarray | None) -> dict[str, Any]:
    """Returns success with its interval, and SPL if the lengths [M] of shortest paths are given."""
    arrived = np.array([[outcome == "goal" for outcome in turn["flights"]["outcome"]] for turn in row["turns"]])
    flown = np.array([turn["flights"]["path_length_m"] for turn in row["turns"]], float)
    rates = arrived.mean(axis=1)
    weights = None
    if shortest is not None:
        weights = [spl(arrived[k], flown[k], fill_unknown_lengths(shortest, flown[k])) for k in range(len(arrived))]
    return {
        "success": float(rates.mean()),
        "interval": rate_interval(arrived),
        "iqm": interquartile_mean(rates),
        "rates": rates.tolist(),
        "spl": None if weights is None else float(np.mean(weights)),
    }


def table(rows: Sequence[Row], shortest: dict[str, np.ndarray | None]) -> str:
    """Returns the rows as a Markdown table."""
    lines = [
        "| world | sensor | seeds x missions | success | 95 % interval | interquartile mean | each seed | SPL "
        "| decisions | training, all seeds, s |",
        "| --- | --- | ---: | ---: | ---: | ---: | --- | ---: | ---: | ---: |",
    ]
    for row in rows:
        found = figures(row, shortest.get(_course(row)))
        low, high = found["interval"]
        each = ", ".join(f"{100 * rate:.1f}" for rate in found["rates"])
        weight = "–" if found["spl"] is None else f"{found['spl']:.3f}"
        world = row["world"]
        if row.get("trained_in", world) != world:
            world += f", trained in {row['trained_in']}"
        if row.get("shuffled"):
            world += ", codes of another drone"
        lines.append(
            f"| {world} | {row['sensor']} | {len(row['turns'])} x {row['missions']} | {found['success']:.2%} "
            f"| {low:.2%} to {high:.2%} | {found['iqm']:.2%} | {each} | {weight} "
            f"| {row['decisions']:,} | {row['train_seconds']:.0f} |"
        )
    return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class Wanted:
    """A row that was asked for."""

    file: Path
    measure: Callable[[], Row]
    train: Callable[[], object] | None = None  # what `measure` does first; None where nothing is to be trained
    says: Callable[[Row], str] = lambda row: f"{figures(row, None)['success']:.2%}"  # of the row, on the screen


def measure(wanted: Sequence[Wanted], rows: list[Row], until: float, first_row_s: float = FIRST_ROW_S) -> int:
    """Measures, writes and appends the rows that are not written yet, while there is time; returns how many are left.

    A row that another process measures is left to it; so several may be given the same rows and folder.

    Args:
        wanted: rows.
        rows: that are written already.
        until: when the last row must have ended, in seconds of `time.perf_counter`.
        first_row_s: assumed duration of a row before one has been measured.

    Raises:
        ConfigError: if a row cannot be measured.
    """
    took: list[float] = []
    for number, one in enumerate(wanted):
        if one.file.is_file():
            continue
        if time.perf_counter() + max(took, default=first_row_s) >= until:
            break
        show_phase("measuring rows", number, len(wanted))
        one.file.parent.mkdir(parents=True, exist_ok=True)
        with _claim(one.file) as is_ours:
            if not is_ours or one.file.is_file():
                continue
            row = one.measure()
            json_report.write_row(one.file, row)
        rows.append(row)
        took.append(row["row_seconds"])
        print(f"{one.file.name}: {one.says(row)}, {row['row_seconds']:.0f} s", file=sys.stderr)
    left = sum(not one.file.is_file() for one in wanted)
    if left:
        print(f"{left} rows are left; the same command goes on with them", file=sys.stderr)
    return left


@contextlib.contextmanager
def _claim(file: Path) -> Iterator[bool]:
    """Yields whether this process may train and measure a file's row; the claim ends with the process, however that
    ends.
    """
    lock = filelock.FileLock(file.with_name(file.name + ".lock"), blocking=False)
    try:
        lock.acquire()
    except filelock.Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()


def train_all(wanted: Sequence[Wanted], until: float) -> None:
    """Trains the rows that are not written yet, one after the other, while there is time for one more.

    A row that another process trains or measures is left to it.
    """
    took: list[float] = []
    for number, one in enumerate(wanted):
        if one.train is None or one.file.is_file() or (policies_of(one.file) / TRAINED).is_file():
            continue
        began = time.perf_counter()
        if began + max(took, default=FIRST_ROW_S) > until:
            print("trainings are left; the same command goes on with them", file=sys.stderr)
            return
        show_phase("training rows", number, len(wanted))
        one.file.parent.mkdir(parents=True, exist_ok=True)
        with _claim(one.file) as is_ours:
            if not is_ours or (policies_of(one.file) / TRAINED).is_file():
                continue
            one.train()
        took.append(time.perf_counter() - began)
        print(f"{policies_of(one.file)}: trained, {took[-1]:.0f} s", file=sys.stderr)


def _select_rows(args: argparse.Namespace) -> list[Wanted]:
    """Returns the rows that the arguments ask for, and makes JAX present as many devices as they use.

    Raises:
        ConfigError: if an option is invalid, or a run cannot be flown.
    """
    if args.runs:
        use_cpu_devices(count_cores())
        runs = {run: load_policy(run) for run in args.runs}
        by_seed = sorted(runs, key=lambda run: runs[run].config.train.seed)
        policies = [runs[run] for run in by_seed]
        configs = [config_of_runs(world, policies) for world in args.worlds]
        identity = digest_of(policies) + (" shuffled" if args.shuffle_codes else "")
        files = [row_file(args.out, config, args.missions, identity) for config in configs]
        return [
            Wanted(file, functools.partial(fly_row, config, policies, by_seed, args.missions, args.shuffle_codes))
            for file, config in zip(files, configs, strict=True)
        ]
    configs = [config_of(world, sensor, args.flags) for world in args.worlds for sensor in args.sensors]
    use_cpu_devices(most_that_divide(configs[0].train.shards, count_cores()))
    files = [row_file(args.out, config, args.missions, str(args.seeds)) for config in configs]
    return [
        Wanted(
            file,
            functools.partial(train_row, config, args.seeds, args.missions, policies_of(file)),
            functools.partial(trained, config, args.seeds, policies_of(file)),
        )
        for file, config in zip(files, configs, strict=True)
    ]


def _config_in(row: Row) -> Config:
    """Returns the configuration that a row was measured with."""
    return apply_layer(Config(), yaml.safe_load(row["options"]), "a row")


def _course(row: Row) -> str:
    """Returns what decides the shortest paths of a row: test worlds and body."""
    return f"{row['world']} {row['missions']} {_config_in(row).drone.body_radius_m:g}"


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 when every row is there, 3 when rows are left for another call, 2 for invalid input."""
    began = time.perf_counter()
    args = parse(argv)
    check_can_make(args.out)
    rows = read_rows(args.out)
    wanted = [] if args.report else _select_rows(args)
    if args.train_only:
        train_all(wanted, began + 60 * args.minutes)
        return 3
    left = measure(wanted, rows, began + 60 * args.minutes)
    shortest: dict[str, np.ndarray | None] = {}
    for row in [] if args.no_spl else rows:
        # Two cores search 1 000 worlds in 200 s.
        in_time = time.perf_counter() - began + 0.4 * row["missions"] / count_cores() < 60 * args.minutes
        shortest[_course(row)] = shortest_paths(args.out, _config_in(row), row["missions"], in_time)
    print(table(rows, shortest))
    return 3 if left else 0


if __name__ == "__main__":
    sys.exit(main())
