"""How does the cost of a decision grow? Varies pixels, obstacles, environments, physics steps and devices in turn.

Times the whole training step with the VAE learning throughout, as `throughput.py` does, at several sizes of each. The
sizes of a curve take turns, forwards and backwards, each followed by C MuJoCo's threaded rollout, so that a change in
the machine's speed affects all of them. The slope of a curve is that between its ends on logarithmic axes. The bytes of
an environment and of a slot of the replay are counted as well.

    python benchmarks/scaling.py --json scaling.json --figure scaling.png
    python benchmarks/scaling.py --curves pixels obstacles -- --world medium

Takes about 12 minutes on two cores, with --quick about 4, because each size is compiled. Arguments after -- are
options of train.py; sizes are multiples of the values that they set.

    python benchmarks/scaling.py --cores 1 2 4 8 16 --environments 128 512 --lines cores.jsonl

trains on so many cores alone, with as many environments on each, in turns with the fewest cores and with C MuJoCo's
rollout on as many threads. Rows are printed and written as they end, each after about a minute.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import dataclasses
import itertools
import json
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from curves.cores import HEAD, Plan, line, measure_rows, with_cores
from curves.figure import draw_scaling
from curves.sizes import CURVES, Curve, replace_options
from curves.state_bytes import StateBytes, state_bytes
from edqn_jax.config import Config
from edqn_jax.devices.devices import choose_devices, use_cpu_devices
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import RunMissions, run_missions
from edqn_jax.files import check_can_write
from edqn_jax.runs.directory import to_plain_json
from edqn_jax.runs.provenance import describe_workload
from measurement import json_report
from measurement.ceilings import Rollout
from measurement.flags import parse_config, split
from measurement.whole import WholeStep, steady

REPEATS, QUICK_REPEATS = 7, 3
DECISIONS, QUICK_DECISIONS = 4096, 2048
"""Approximate number of decisions in a chunk, unless these are less than `STEPS` steps."""
STEPS = 16
"""Minimum number of steps in a chunk; with one, beginning and ending chunks takes a quarter of the time."""
TURN_SECONDS = 0.5
"""Minimum duration of a turn of one size."""
MILLION = 1_000_000
ENVIRONMENTS, LIMIT_S = 128, 180
"""Environments on each core as in the reference workload on two, and seconds of a row of `--cores`."""


# --------------------------------------------------------------------------------- what is measured


class Runner:
    """The compiled training step of one point of a curve."""

    def __init__(self, config: Config, missions: RunMissions) -> None:
        self.config, self.scene = config, missions.scene
        self.devices = choose_devices(config.train.devices, config.train.shards)
        self.whole = WholeStep(config, missions.training.env_params, self.devices)
        self.chunks = math.ceil(TURN_SECONDS * self.whole.turn() / self.whole.decisions)

    @property
    def temporary_bytes_per_environment(self) -> float:
        return self.whole.temporary_bytes * len(self.devices) / self.config.train.num_envs

    def turn(self) -> tuple[float, float]:
        """Returns the seconds of a decision, and the average number of busy cores."""
        began, busy = time.perf_counter(), time.process_time()
        seconds = sum(self.whole.decisions / self.whole.turn() for _ in range(self.chunks))
        cores = (time.process_time() - busy) / (time.perf_counter() - began)
        return seconds / (self.chunks * self.whole.decisions), cores


def with_chunks_of(config: Config, decisions: int) -> Config:
    """Returns the steady workload in chunks of about `decisions`, with a short warm-up, which is not timed."""
    config = steady(config, max(STEPS, decisions // config.train.num_envs))
    return dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, warmup_updates_per_step=1))


def measure(base: Config, names: Sequence[str], quick: bool, repeats: int) -> dict[str, Any]:
    """Measures and returns the report that `--json` writes.

    Raises:
        ConfigError: if a size is invalid, or there is nothing to measure.
    """
    used = choose_devices(base.train.devices, base.train.shards)
    base = replace_options(base, train={"devices": len(used)})
    decisions = QUICK_DECISIONS if quick else DECISIONS
    if used[0].platform != "cpu":  # the start of a chunk this short would take a large part of its time
        decisions = max(decisions, base.train.num_envs * base.train.chunk_steps)
    rollout = Rollout(base)
    rows, summaries = [], []
    reference = run_missions(base)
    laid: dict[Any, RunMissions] = {(base.world, base.drone): reference}
    temporary = None
    runners: dict[Config, Runner] = {}
    with tempfile.TemporaryDirectory() as folder:
        curves = [CURVES[name](base, quick, Path(folder)) for name in names]
        # A curve needs two points; one device gives only one.
        curves = [curve for curve in curves if len(curve.points) > 1]
        if not curves:
            raise ConfigError("there is only one device, so there is no curve of devices")
        for number, curve in enumerate(curves):
            configs = [with_chunks_of(point.config, decisions) for point in curve.points]
            for point, config in zip(curve.points, configs, strict=True):
                where = (config.world, config.drone)
                if where not in laid:
                    laid[where] = run_missions(config)
                if config not in runners:
                    print(f"{curve.name}: compiling {point.label}", file=sys.stderr, flush=True)
                    runners[config] = Runner(config, laid[where])
                if config == with_chunks_of(base, decisions):
                    temporary = runners[config].temporary_bytes_per_environment
            some, summary = _measure_curve(curve, [runners[config] for config in configs], rollout, repeats)
            rows += some
            summaries.append(summary)
            # Runners that later curves share are kept; the memory of the others is freed.
            later = {
                with_chunks_of(point.config, decisions) for after in curves[number + 1 :] for point in after.points
            }
            runners = {config: runner for config, runner in runners.items() if config in later}
    return {
        "workload": {**describe_workload(steady(base, 1), reference.scene), "world": base.world.name},
        **json_report.machine(used),
        "repeats": repeats,
        "curves": summaries,
        "memory": memory_of(state_bytes(base, reference.training.env_params), temporary),
        "rows": rows,
    }


def _measure_curve(
    curve: Curve, runners: Sequence[Runner], rollout: Rollout, repeats: int
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Returns the curve's rows and its summary."""
    count = len(runners)
    seconds: list[list[float]] = [[] for _ in range(count)]
    cores: list[list[float]] = [[] for _ in range(count)]
    c_mujoco: list[list[float]] = [[] for _ in range(count)]
    for repeat in range(repeats):
        for place in range(count) if repeat % 2 == 0 else reversed(range(count)):
            took, busy = runners[place].turn()
            seconds[place].append(took)
            cores[place].append(busy)
            c_mujoco[place].append(rollout.turn())
    rows = []
    for place, (point, runner) in enumerate(zip(curve.points, runners, strict=True)):
        many, stated = len(runner.devices), describe_workload(runner.config, runner.scene)
        us = [1e6 * many * each for each in seconds[place]]
        as_steps = [each * rate for each, rate in zip(seconds[place], c_mujoco[place], strict=True)]
        rows.append(
            {
                "name": f"{curve.name} {point.label}",
                "curve": curve.name,
                "x": point.x,
                "label": point.label,
                "us_per_decision": statistics.median(us),
                "us_low": min(us),
                "us_high": max(us),
                "us_turns": us,
                "decisions_per_second": 1.0 / statistics.median(seconds[place]),
                "c_mujoco_steps_per_decision": statistics.median(as_steps),
                "c_mujoco_steps_per_second": statistics.median(c_mujoco[place]),
                "cores_busy": statistics.median(cores[place]),
                "compile_seconds": runner.whole.compile_seconds,
                "temporary_bytes_per_environment": runner.temporary_bytes_per_environment,
                "devices": many,
                "pixels": stated["width"] * stated["height"],
                **{key: stated[key] for key in ("num_envs", "obstacles", "physics_steps_per_decision")},
                "replayed_samples_per_decision": stated["replayed_samples_per_decision"],
            }
        )
    return rows, summarise(curve.name, curve.linear, rows)


def slope(x: Sequence[float], cost: Sequence[float]) -> float:
    """Returns the slope between the ends of a curve on logarithmic axes: 1 if twice the x costs twice as much."""
    return math.log(cost[-1] / cost[0]) / math.log(x[-1] / x[0])


def summarise(name: str, linear: float, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns a curve's slopes: of the medians, and the smallest and largest of single turns."""
    x = [row["x"] for row in rows]
    turns = [slope(x, cost) for cost in zip(*(row["us_turns"] for row in rows), strict=True)]
    return {
        "name": name,
        "slope": slope(x, [row["us_per_decision"] for row in rows]),
        "slope_low": min(turns),
        "slope_high": max(turns),
        "steepest": max(map(slope, itertools.pairwise(x), itertools.pairwise(row["us_per_decision"] for row in rows))),
        "slope_over_c_mujoco": slope(x, [row["c_mujoco_steps_per_decision"] for row in rows]),
        "linear_slope": linear,
        # Rate of all devices over that of one device times their number.
        "efficiency": rows[0]["us_per_decision"] / rows[-1]["us_per_decision"] if name == "devices" else None,
    }


def memory_of(counted: StateBytes, temporary: float | None) -> dict[str, Any]:
    """Returns the bytes that training takes; `temporary` are those of the compiled chunk for each environment."""
    return {
        "temporary_bytes_per_environment": temporary,
        "bytes_per_environment": counted.environment,
        "bytes_per_replay_slot": counted.replay_slot,
        "bytes_of_a_million_transitions": MILLION * counted.replay_slot,
        "bytes_of_the_rest": counted.rest,
        "num_envs": counted.environments,
        "replay_slots": counted.replay_slots,
    }


# ------------------------------------------------------------------------------------------- report


def table(report: dict[str, Any]) -> str:
    """Returns the report as Markdown."""
    stated = report["workload"]
    lines = [
        f"{report['device']}, {len(report['devices'])} devices; unless stated otherwise {stated['num_envs']} "
        f"environments, {stated['width']} × {stated['height']} pixels, {stated['obstacles']} obstacles, "
        f"{stated['physics_steps_per_decision']} physics steps by {stated['physics']}; medians of {report['repeats']}",
    ]
    for curve in report["curves"]:
        lines += [
            "",
            f"| {curve['name']} | µs of one device per decision | smallest - largest | C MuJoCo steps in that time "
            "| decisions/s | cores busy | temporary kB per environment |",
            "| ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
        ]
        for row in report["rows"]:
            if row["curve"] == curve["name"]:
                lines.append(
                    f"| {row['label']} | {row['us_per_decision']:.3g} | {row['us_low']:.3g} - {row['us_high']:.3g} "
                    f"| {row['c_mujoco_steps_per_decision']:.0f} | {row['decisions_per_second']:,.0f} "
                    f"| {row['cores_busy']:.2f} | {row['temporary_bytes_per_environment'] / 1e3:.1f} |"
                )
        lines += ["", sentence(curve)]
    lines += ["", *memory_lines(report["memory"])]
    return "\n".join(lines)


def sentence(curve: dict[str, Any]) -> str:
    """Returns a curve's slope as a sentence."""
    text = (
        f"{curve['name'].capitalize()}: slope {curve['slope']:.2f} ({curve['slope_low']:.2f} to "
        f"{curve['slope_high']:.2f}), at most {curve['steepest']:.2f} between neighbours; linear growth would be "
        f"{curve['linear_slope']:g}."
    )
    if curve["efficiency"] is None:
        text += f" Measured in steps of C MuJoCo, which uses all cores, {curve['slope_over_c_mujoco']:.2f}."
    else:
        text += f" All devices together reach {curve['efficiency']:.0%} of the rate of one device times their number."
    return text


def memory_lines(memory: dict[str, Any]) -> list[str]:
    """Returns the bytes as lines of a Markdown table."""
    temporary = memory["temporary_bytes_per_environment"]
    lines = [
        "| memory | bytes |",
        "| --- | ---: |",
        f"| state of one environment | {memory['bytes_per_environment']:,} |",
        f"| one slot of the replay | {memory['bytes_per_replay_slot']:,} |",
        f"| a replay of 1 000 000 transitions | {memory['bytes_of_a_million_transitions']:,} |",
        f"| parameters, optimisers, keys, samples of the encoder | {memory['bytes_of_the_rest']:,} |",
    ]
    if temporary is not None:
        lines.append(f"| temporary in the compiled chunk, per environment | {temporary:,.0f} |")
    return lines


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, Config]:
    """Returns the parsed arguments, and the configuration whose values the sizes are multiples of.

    Raises:
        ConfigError: if the options after -- are invalid, or a file cannot be written.
    """
    words, flags = split(argv)
    parser = Parser("scaling", __doc__)
    parser.add_argument("--quick", action="store_true", help="fewer sizes and shorter turns")
    parser.add_argument(
        "--curves", nargs="+", choices=CURVES, default=list(CURVES), help="curves to measure (default: all)"
    )
    parser.add_argument(
        "--repeats", type=at_least_one, help=f"turns of each size (default {REPEATS}, quick {QUICK_REPEATS})"
    )
    parser.add_argument("--figure", type=Path, help="write a picture of the curves to this PNG file")
    many = parser.add_argument_group("training on more and more cores, instead of the curves")
    many.add_argument("--cores", nargs="+", type=at_least_one, metavar="N", help="numbers of cores")
    many.add_argument(
        "--environments",
        nargs="+",
        type=at_least_one,
        default=[ENVIRONMENTS],
        metavar="N",
        help=f"environments on each core (default {ENVIRONMENTS})",
    )
    many.add_argument("--lines", type=Path, help="append each row to this file when it ends, as a line of JSON")
    many.add_argument(
        "--row-limit", type=at_least_one, default=LIMIT_S, help=f"seconds a row may take (default {LIMIT_S})"
    )
    args = parser.parse(words)
    if args.lines is not None:
        check_can_write(args.lines)
    if args.repeats is None:
        args.repeats = QUICK_REPEATS if args.quick else REPEATS
    if args.cores:
        keep_to_cpu()
    config = parse_config(flags)
    for count, environments in itertools.product(args.cores or (), args.environments):
        with_cores(config, count, environments)  # says what is invalid before anything is measured
    args.flags = tuple(flags)
    return args, config


def keep_to_cpu() -> None:
    """Keeps JAX, here and in processes that are started, from cards."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    jax.config.update("jax_platforms", "cpu")


def measure_cores(args: argparse.Namespace) -> dict[str, Any]:
    """Prints the rows of `--cores` as they end, and writes each as a line; returns the report that `--json` writes."""
    plan = Plan(tuple(args.cores), tuple(args.environments), args.repeats, args.row_limit, args.flags)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for row in measure_rows(plan, Path(folder)):
            print(f"{'' if rows else HEAD}\n{line(row)}".lstrip("\n"), flush=True)
            rows.append(row)
            if args.lines is not None:
                with args.lines.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(to_plain_json(row), allow_nan=False) + "\n")
    return {"benchmark": "cores", "repeats": args.repeats, "rows": rows}


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    use_cpu_devices()
    args, config = parse(argv)
    if args.cores:
        json_report.write(args.json, measure_cores(args))
        return 0
    report = measure(config, args.curves, args.quick, args.repeats)
    print(table(report))
    json_report.write(args.json, report)
    if args.figure is not None:
        draw_scaling(report, args.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
