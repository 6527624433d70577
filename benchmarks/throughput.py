"""How fast is training, and where does its time go?

Times the whole training step of the reference workload, with the VAE learning throughout, and each of its parts alone,
with the minimum time that the part's arithmetic and memory traffic would take on this machine. C MuJoCo's threaded
rollout of the same airframe is timed as well. The rows take turns, because the speed of a shared machine changes: every
row is the median of repeats in each of which every row ran once.

    python benchmarks/throughput.py --json throughput.json
    python benchmarks/throughput.py -- --num-envs 1024 --agent.updates-per-step 16
    python benchmarks/throughput.py --whole-only --hours benchmarks/hours.tsv

Arguments after -- are options of train.py.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from edqn_jax.config import Config
from edqn_jax.devices.devices import choose_devices, use_cpu_devices
from edqn_jax.devices.hardware import count_cores
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.trainer import AXIS
from edqn_jax.runs.provenance import describe_workload
from measurement import hours, json_report
from measurement.ceilings import Rollout, ceilings
from measurement.conditions import Watch, conditions
from measurement.flags import parse_config, split
from measurement.parts import parts_of
from measurement.timing import Timed
from measurement.whole import WHOLE, WholeStep, steady

REPEATS = 5

DIFFERENCES: dict[str, tuple[str, ...]] = {
    "resets": ("environment", "environment_without_resets"),
    "resets_and_rest_of_environment": ("environment", "physics", "outcome", "rendering", "events"),
    "dqn_update": ("dqn_update_and_sampling", "sampling"),
}
"""Rows that cannot run alone: the time of the first part minus the times of the others."""


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, Config]:
    """Returns the parsed arguments, and the configuration that is timed.

    Raises:
        ConfigError: if the options after -- are invalid, a file cannot be written or is no table of runs, or a
            short turn would be added to one.
    """
    words, flags = split(argv)
    parser = Parser("throughput", __doc__)
    parser.add_argument("--repeats", type=at_least_one, default=REPEATS, help=f"turns of each row (default {REPEATS})")
    parser.add_argument("--quick", action="store_true", help="one short turn of each row")
    parser.add_argument("--whole-only", action="store_true", help="do not time the parts")
    parser.add_argument("--hours", type=Path, help="add the run to this table, and show the medians of its runs")
    args = parser.parse(words)
    args.options = flags
    if args.hours is not None:
        hours.read(args.hours)
        if args.quick:
            raise ConfigError("a short turn does not belong into a table of runs; leave out --quick or --hours")
    config = parse_config(flags)
    if config.env.sensor != "events" and not args.whole_only:
        raise ConfigError(f"parts can be timed only for env.sensor events; {config.env.sensor} needs --whole-only")
    if config.env.drones > 1 and not args.whole_only:
        raise ConfigError("parts can be timed only for drones that fly alone; env.drones above 1 needs --whole-only")
    return args, steady(config, 8 if args.quick else config.train.chunk_steps)


def measure(config: Config, repeats: int, parts: bool) -> dict[str, Any]:
    """Measures and returns the report that `--json` writes."""
    missions = run_missions(config)
    devices = choose_devices(config.train.devices, config.train.shards)
    mesh = Mesh(np.asarray(devices), (AXIS,))
    whole = WholeStep(config, missions.training.env_params, devices)
    # A copy, because the next chunk is given the state itself.
    host = jax.tree.map(lambda x: jax.device_put(x, devices[0]).copy(), whole.state)
    timed = (
        [Timed(part, mesh, config.train.num_envs) for part in parts_of(config, missions.training.env_params, host)]
        if parts
        else []
    )
    limits = ceilings(mesh) if parts else {}
    c_mujoco = Rollout(config)

    turns: dict[str, list[float]] = {}
    watch = Watch()
    for _ in range(repeats):  # in turns, so that a change in the machine's speed affects all rows
        turns.setdefault("whole", []).append(whole.turn())
        turns.setdefault("c_mujoco_rollout", []).append(c_mujoco.turn())
        for name, turn in limits.items():
            turns.setdefault(name, []).append(turn())
        for part in timed:
            turns.setdefault(part.part.name, []).append(part.turn())
    seen = conditions(watch)
    middle = {name: statistics.median(values) for name, values in turns.items()}

    rate, physics = middle["whole"], config.drone.physics_steps
    ratios = [physics * a / b for a, b in zip(turns["whole"], turns["c_mujoco_rollout"], strict=True)]
    rows: list[dict[str, Any]] = [
        {
            "name": WHOLE,
            "decisions_per_second": rate,
            "physics_steps_per_second": physics * rate,
            "us_per_decision": 1e6 * len(devices) / rate,
            "over_c_mujoco_rollout": statistics.median(ratios),
        },
        {"name": "c_mujoco_rollout", "physics_steps_per_second": middle["c_mujoco_rollout"], "threads": count_cores()},
    ]
    for part in timed:
        us = middle[part.part.name]
        floor = part.floor(middle)
        beyond = {"over_floor": us / floor["floor_us"]} if floor else {}
        rows.append({"name": part.part.name, "us_per_decision": us, **floor, **beyond})
    rows += differences(middle)
    rows += [{"name": name, "per_device": middle[name]} for name in limits]
    return {
        "workload": {**describe_workload(config, missions.scene), "world": config.world.name},
        **json_report.machine(devices),
        "conditions": seen,
        "decisions_per_second": rate,
        "compile_seconds": whole.compile_seconds,
        "repeats": repeats,
        "turns": turns,
        "rows": rows,
    }


def differences(us: dict[str, float]) -> list[dict[str, Any]]:
    """Returns the rows of `DIFFERENCES` whose terms were all timed."""
    rows = []
    for name, (first, *others) in DIFFERENCES.items():
        if {first, *others} <= us.keys():
            left = us[first] - sum(us[other] for other in others)
            rows.append({"name": name, "us_per_decision": left, "by_subtraction": " - ".join([first, *others])})
    return rows


def table(report: dict[str, Any]) -> str:
    """Returns the report as Markdown."""
    rows = {row["name"]: row for row in report["rows"]}
    whole, rollout_row = rows[WHOLE], rows["c_mujoco_rollout"]
    stated = report["workload"]
    lines = [
        f"{report['device']}, {len(report['devices'])} devices, {stated['num_envs']} environments, "
        f"{stated['replayed_samples_per_decision']:g} replayed and {stated['vae_samples_per_decision']:g} VAE samples "
        f"per decision, physics by {stated['physics']}; medians of {report['repeats']}",
        "",
        "| what | measured |",
        "| --- | ---: |",
        f"| whole training step | {whole['decisions_per_second']:,.0f} decisions/s |",
        f"| 500 000 decisions | {5e5 / whole['decisions_per_second']:.1f} s |",
        f"| physics steps inside it | {whole['physics_steps_per_second']:,.0f} /s |",
        f"| C MuJoCo rollout, {rollout_row['threads']} threads | {rollout_row['physics_steps_per_second']:,.0f} /s |",
        f"| ratio of the two | {whole['over_c_mujoco_rollout']:.3f} |",
        f"| compiling the chunk | {report['compile_seconds']:.1f} s |",
    ]
    parts = [row for row in report["rows"] if "us_per_decision" in row]
    if len(parts) > 1:
        lines += [
            "",
            "| part | µs of one device per decision | minimum, µs | times the minimum |",
            "| --- | ---: | ---: | ---: |",
        ]
        for row in parts:
            floor = f"{row['floor_us']:.2f} | {row['over_floor']:.1f}" if "floor_us" in row else " | "
            name = row["name"].replace("_", " ")
            if "by_subtraction" in row:
                name += f" (by subtraction: {row['by_subtraction'].replace('_', ' ').replace(' - ', ' − ')})"
            lines.append(f"| {name} | {row['us_per_decision']:.1f} | {floor} |")
        lines += [
            "",
            "Highest rates of one device with all devices busy: "
            + ", ".join(
                f"{rows[name]['per_device'] / 1e9:.1f} {unit}"
                for name, unit in (
                    ("product_flops", "Gflop/s in matrix products"),
                    ("vector_flops", "Gflop/s in fused loops"),
                    ("copy_bytes", "GB/s copied"),
                )
            )
            + ".",
        ]
    return "\n".join(lines)


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    use_cpu_devices()
    args, config = parse(argv)
    report = measure(config, 1 if args.quick else args.repeats, not args.whole_only)
    print(table(report))
    json_report.write(args.json, report)
    if args.hours is not None:
        row = hours.row_of(report, args.options)
        print(hours.summary(hours.add(args.hours, row), row))
    return 0


if __name__ == "__main__":
    sys.exit(main())
