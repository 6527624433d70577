"""How many unseen worlds does a policy fly? Trains several seeds in one program and flies test worlds, row by row.

A row is a world with a sensor. It is written when it is done, with the policies, and a row that is written already is
not measured again: a command that was stopped goes on where it was. No row is begun that would not end in time.

    python benchmarks/success.py --out runs/success
    python benchmarks/success.py --out runs/success --worlds medium --sensors events depth -- --total-steps 9000000
    python benchmarks/success.py --out runs/success --report

Arguments after -- are options of train.py; defaults are those of the hardware. The interval is a bootstrap over seeds
and missions. A* for the SPL takes 0.4 s a world and core, once for each density, when there is time after the rows;
--no-spl leaves it out.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import hashlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from edqn_jax.cli.arguments import parse_train
from edqn_jax.config import DENSITIES, Config
from edqn_jax.config.loading import to_yaml
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.intervals import interquartile_mean, rate_interval
from edqn_jax.evaluation.metrics import known_lengths, spl
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.learn.policy import Policy
from edqn_jax.parallel.devices import cores, most_that_divide, use_cpu_devices
from edqn_jax.runs.files import check_can_make
from edqn_jax.runs.policies import save_policy
from edqn_jax.training.loop import train_seeds
from measurement import json_report
from measurement.flags import split
from rivals.learners import flight_columns
from rivals.planning import judged_scenes, shortest_lengths

Row = dict[str, Any]

FIRST_ROW_S = 240.0
"""Assumed duration of a row before one has been measured."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments; `flags` are those after --."""
    words, flags = split(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(
        prog="python benchmarks/success.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    worlds = ["sparse", "medium", "dense"]
    parser.add_argument("--out", type=Path, required=True, help="folder of rows and policies")
    parser.add_argument("--worlds", nargs="+", default=worlds, choices=DENSITIES, help="(default sparse medium dense)")
    parser.add_argument("--sensors", nargs="+", default=["events"], help="env.sensor of each row (default events)")
    parser.add_argument("--seeds", type=int, default=5, help="training seeds, in one program (default 5)")
    parser.add_argument("--missions", type=int, default=1000, help="test missions of each seed (default 1000)")
    parser.add_argument("--minutes", type=float, default=9.0, help="begin no row that would end later (default 9)")
    parser.add_argument("--no-spl", action="store_true", help="do not search shortest paths")
    parser.add_argument("--report", action="store_true", help="only print the rows that there are")
    args = parser.parse_args(words)
    args.flags = flags
    for name in ("seeds", "missions"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1, not {getattr(args, name)}")
    return args


def config_of(world: str, sensor: str, flags: Sequence[str]) -> Config:
    """Returns the configuration of a row's first seed.

    Raises:
        ConfigError: if the options are invalid.
    """
    _, config = parse_train(["--world", world, "--env.sensor", sensor, *flags])
    # What is flown at the end is what was learnt at the end: no choice by validation, no time for it.
    train = dataclasses.replace(config.train, validation_every=0, validation_missions=1, keep="last")
    return dataclasses.replace(config, train=train)


def row_file(out: Path, config: Config, seeds: int, missions: int) -> Path:
    """Returns the file of a row; rows with other options, seeds or missions, or of another commit, have other names."""
    measured = f"{seeds} {missions} {_commit()}\n{to_yaml(config)}"
    digest = hashlib.sha256(measured.encode()).hexdigest()[:10]
    return out / f"{config.world.name}-{config.env.sensor}-{digest}.json"


@functools.cache
def _commit() -> str | None:
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


def measure(config: Config, seeds: int, missions: int, policies: Path) -> Row:
    """Trains the seeds of a row, saves their policies, flies the test missions, and returns the row."""
    began = time.perf_counter()
    shutil.rmtree(policies, ignore_errors=True)  # of a row that was cut short
    results = train_seeds(seeds, config)
    course = load_missions(config, config.world.name, missions)
    turns = []
    for result in results:
        seed = result.policy.config.train.seed
        save_policy(Policy(result.policy.config, result.policy.params), policies / f"seed-{seed}")
        flights = fly_on_all_devices(config, course.world, result.policy.params)
        turns.append({"seed": seed, "flights": flight_columns(flights, missions)})
    return {
        "benchmark": "success",
        "world": config.world.name,
        "sensor": config.env.sensor,
        "missions": missions,
        "decisions": results[0].decisions,
        "train_seconds": results[0].train_seconds,
        "compile_seconds": results[0].compile_seconds,
        "row_seconds": time.perf_counter() - began,
        "commit": _commit(),
        "options": to_yaml(config),
        "turns": turns,
        **json_report.machine(jax.devices()),
    }


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
    json_report.write(file, {"world": config.world.name, "lengths": lengths})
    return np.array(lengths, float)


def figures(row: Row, shortest: np.ndarray | None) -> dict[str, Any]:
    """Returns success with its interval, and SPL if the lengths [M] of shortest paths are given."""
    arrived = np.array([[outcome == "goal" for outcome in turn["flights"]["outcome"]] for turn in row["turns"]])
    flown = np.array([turn["flights"]["path_length_m"] for turn in row["turns"]], float)
    rates = arrived.mean(axis=1)
    weights = None
    if shortest is not None:
        weights = [spl(arrived[k], flown[k], known_lengths(shortest, flown[k])) for k in range(len(arrived))]
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
        found = figures(row, shortest.get(f"{row['world']} {row['missions']}"))
        low, high = found["interval"]
        each = ", ".join(f"{100 * rate:.1f}" for rate in found["rates"])
        weight = "–" if found["spl"] is None else f"{found['spl']:.3f}"
        lines.append(
            f"| {row['world']} | {row['sensor']} | {len(row['turns'])} x {row['missions']} | {found['success']:.2%} "
            f"| {low:.2%} to {high:.2%} | {found['iqm']:.2%} | {each} | {weight} "
            f"| {row['decisions']:,} | {row['train_seconds']:.0f} |"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 when every row is there, 3 when rows are left for another call, 2 for invalid input."""
    began = time.perf_counter()
    args = parse(argv)
    try:
        check_can_make(args.out)
        wanted = [config_of(world, sensor, args.flags) for world in args.worlds for sensor in args.sensors]
        rows = read_rows(args.out)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    use_cpu_devices(most_that_divide(wanted[0].train.shards, cores()))
    files = [row_file(args.out, config, args.seeds, args.missions) for config in wanted]
    left = [] if args.report else [at for at, file in enumerate(files) if not file.is_file()]
    longest = FIRST_ROW_S
    while left and (time.perf_counter() - began + longest < 60 * args.minutes):
        config, file = wanted[left[0]], files[left[0]]
        try:
            row = measure(config, args.seeds, args.missions, args.out / "policies" / file.stem)
            json_report.write(file, row)
        except ConfigError as error:
            print(error, file=sys.stderr)
            return 2
        rows.append(row)
        longest = max(row["row_seconds"] for row in rows[-len(files) :])
        left.pop(0)
        print(f"{file.name}: {figures(row, None)['success']:.2%}, {row['row_seconds']:.0f} s", file=sys.stderr)
    shortest: dict[str, np.ndarray | None] = {}
    for config in [] if args.no_spl else wanted:
        # Two cores search 1 000 worlds in 200 s.
        in_time = time.perf_counter() - began + 0.4 * args.missions / cores() < 60 * args.minutes
        shortest[f"{config.world.name} {args.missions}"] = shortest_paths(
            args.out, config, args.missions, search=in_time and not args.report
        )
    print(table(rows, shortest))
    if left:
        print(f"{len(left)} rows are left; the same command goes on with them", file=sys.stderr)
    return 3 if left else 0


if __name__ == "__main__":
    sys.exit(main())
