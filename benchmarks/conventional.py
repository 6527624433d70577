"""How fast is the conventional stack, and where does its time go?

Trains on the reference workload with C MuJoCo, numba, PyTorch and stable-baselines3, with the VAE learning throughout,
in one process and in two. The settings take turns, because the speed of a shared machine changes; each row is the
median of its turns.

    python benchmarks/conventional.py --decisions 20480 --json conventional.json
    python benchmarks/conventional.py -- --num-envs 256

Arguments after -- are options of train.py.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from importlib import metadata
from typing import Any

import jax

from conventional_stack.settings import DRONES, PACKAGES, SETTINGS, supported_config
from edqn_jax.cli.process.status import show_phase
from edqn_jax.config import Config
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from measurement import json_report
from measurement.command import Parser, at_least_one, in_a_sentence
from measurement.flags import parse_config, split
from measurement.whole import steady

DECISIONS = 20_480
REPEATS = 5


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, Config]:
    """Returns the parsed arguments, and the configuration that is timed.

    Raises:
        ConfigError: if the options after -- are invalid, or the file cannot be written.
    """
    words, flags = split(argv)
    parser = Parser("conventional", __doc__)
    parser.add_argument(
        "--decisions", type=at_least_one, default=DECISIONS, help=f"decisions of each turn (default {DECISIONS})"
    )
    parser.add_argument("--repeats", type=at_least_one, default=REPEATS, help=f"turns of each row (default {REPEATS})")
    args = parser.parse(words)
    return args, steady(supported_config(parse_config(["--num-envs", str(DRONES), *flags])), 4)


def measure(config: Config, decisions: int, repeats: int) -> dict[str, Any]:
    """Measures and returns the report that `--json` writes.

    Raises:
        ConfigError: if this stack does not support the configuration.
        MissingPackageError: if a package of the extra `bench` is not installed.
    """
    from conventional_stack.fleet import Course
    from conventional_stack.train import Steady

    show_phase("compiling and warming up")
    course = Course.of(run_missions(config).training.env_params)
    turns: dict[tuple[int, int], list[float]] = {setting: [] for setting in SETTINGS}
    with ExitStack() as stack:
        runs = {setting: stack.enter_context(Steady(config, course, *setting)) for setting in SETTINGS}
        for _ in range(repeats):  # in turns, so that a change in the machine's speed affects all settings
            for setting, run in runs.items():
                show_phase("measuring", sum(map(len, turns.values())), repeats * len(SETTINGS))
                turns[setting].append(run.turn(decisions))
        rows = [
            {
                "name": "conventional_stack",
                "processes": processes,
                "torch_threads": threads,
                "decisions_per_second": statistics.median(turns[processes, threads]),
                "shares": run.shares(),
                "turns": turns[processes, threads],
            }
            for (processes, threads), run in runs.items()
        ]
    machine = json_report.machine(jax.devices())
    machine["versions"] |= {name: metadata.version(name) for name in PACKAGES}
    return {
        "workload": {
            **describe_workload(config, load_scene(resolve_world(config.world.name))),
            "physics": "c_mujoco",
            "world": config.world.name,
        },
        **machine,
        "decisions_per_second": max(row["decisions_per_second"] for row in rows),
        "decisions_per_turn": decisions,
        "repeats": repeats,
        "rows": rows,
    }


def table(report: dict[str, Any]) -> str:
    """Returns the report as Markdown."""
    stated, rows = report["workload"], report["rows"]
    names = [f"{row['processes']} processes, PyTorch {row['torch_threads']} threads" for row in rows]
    lines = [
        f"{report['device']}, {stated['num_envs']} drones, {stated['replayed_samples_per_decision']:g} replayed and "
        f"{stated['vae_samples_per_decision']:g} VAE samples per decision; medians of {report['repeats']}",
        "",
        f"| conventional stack | {' | '.join(names)} |",
        f"| --- |{' ---: |' * len(rows)}",
        f"| decisions/s | {' | '.join(format(row['decisions_per_second'], ',.0f') for row in rows)} |",
    ]
    for part in rows[0]["shares"]:
        shares = " | ".join(format(row["shares"][part], ".1%") for row in rows)
        lines.append(f"| {part.replace('_', ' ')} | {shares} |")
    return "\n".join(lines)


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    use_cpu_devices()
    args, config = parse(argv)
    report = measure(config, args.decisions, args.repeats)
    print(table(report))
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
