"""How fast is the conventional stack, and where does its time go?

Trains on the reference workload with C MuJoCo, numba, PyTorch and stable-baselines3, with the VAE learning throughout,
in one process and in two. The settings take turns, because the speed of a shared machine changes; each row is the
median of its turns. `--camera columns` gives the stack our own camera's method in numba, and `--edqn` lets E-DQN's
training, with its own defaults, take turns with all of them.

    python benchmarks/conventional.py --decisions 20480 --json conventional.json
    python benchmarks/conventional.py --camera rays columns --edqn --repeats 3
    python benchmarks/conventional.py -- --num-envs 256

Arguments after -- are options of train.py.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

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
from edqn_jax.devices.devices import choose_devices, use_cpu_devices
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from measurement import json_report
from measurement.conditions import Watch, conditions, sentence
from measurement.flags import parse_config, split
from measurement.whole import WholeStep, steady

DECISIONS = 20_480
REPEATS = 5

CAMERAS = ("rays", "columns")
"""Names of the stack's cameras, `conventional_stack.fleet.CAMERAS`."""

EDQN = "edqn"
"""Name of the row of E-DQN's training."""


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, Config, Config | None]:
    """Returns the parsed arguments, the configuration that is timed, and that of E-DQN if it is timed too.

    Raises:
        ConfigError: if the options after -- are invalid, or the file cannot be written.
    """
    words, flags = split(argv)
    parser = Parser("conventional", __doc__)
    parser.add_argument(
        "--decisions", type=at_least_one, default=DECISIONS, help=f"decisions of each turn (default {DECISIONS})"
    )
    parser.add_argument("--repeats", type=at_least_one, default=REPEATS, help=f"turns of each row (default {REPEATS})")
    parser.add_argument("--camera", nargs="+", choices=CAMERAS, default=["rays"], help="of the stack; default rays")
    parser.add_argument("--edqn", action="store_true", help="time E-DQN's training in the same turns")
    args = parser.parse(words)
    config = steady(supported_config(parse_config(["--num-envs", str(DRONES), *flags])), 4)
    if not args.edqn:
        return args, config, None
    ours = parse_config(flags)
    return args, config, steady(ours, ours.train.chunk_steps)


class Ours:
    """E-DQN's steady training in turns of about as many decisions."""

    def __init__(self, config: Config) -> None:
        """Compiles and warms up; `config` is of `measurement.whole.steady`."""
        devices = choose_devices(config.train.devices, config.train.shards)
        self.whole = WholeStep(config, run_missions(config).training.env_params, devices)

    def turn(self, decisions: int) -> float:
        """Trains for so many decisions, rounded up to whole chunks, and returns decisions per second."""
        return statistics.harmonic_mean([self.whole.turn() for _ in range(-(-decisions // self.whole.decisions))])


def measure(
    config: Config,
    decisions: int,
    repeats: int,
    cameras: Sequence[str] = ("rays",),
    ours: Config | None = None,
) -> dict[str, Any]:
    """Measures and returns the report that `--json` writes.

    Args:
        config: of the stack.
        decisions: of a turn.
        repeats: turns of each row.
        cameras: of the stack, of `CAMERAS`.
        ours: E-DQN's configuration if it is to be timed, see `parse`.

    Raises:
        ConfigError: if this stack does not support the configuration.
        MissingPackageError: if a package of the extra `bench` is not installed.
    """
    from conventional_stack.fleet import Course
    from conventional_stack.train import Steady

    show_phase("compiling and warming up")
    course = Course.of(run_missions(config).training.env_params)
    turns: dict[tuple[str, int, int], list[float]] = {
        (camera, *setting): [] for camera in dict.fromkeys(cameras) for setting in SETTINGS
    }
    edqn: list[float] = []
    with ExitStack() as stack:
        runs = {
            (camera, processes, threads): stack.enter_context(Steady(config, course, processes, threads, camera))
            for camera, processes, threads in turns
        }
        own = None if ours is None else Ours(ours)
        watch = Watch()
        for _ in range(repeats):  # in turns, so that a change in the machine's speed affects all settings
            for setting, run in runs.items():
                show_phase("measuring", sum(map(len, turns.values())), repeats * len(runs))
                turns[setting].append(run.turn(decisions))
            if own is not None:
                edqn.append(own.turn(decisions))
        seen = conditions(watch)
        rows: list[dict[str, Any]] = [
            {
                "name": "conventional_stack",
                "camera": camera,
                "processes": processes,
                "torch_threads": threads,
                "decisions_per_second": statistics.median(rates),
                "shares": runs[camera, processes, threads].shares(),
                "turns": rates,
            }
            for (camera, processes, threads), rates in turns.items()
        ]
    best = max(row["decisions_per_second"] for row in rows)
    for row in rows if edqn else []:
        row["edqn_over_it"] = statistics.median(ours / its for ours, its in zip(edqn, row["turns"], strict=True))
    if ours is not None:
        workload = describe_workload(ours, load_scene(resolve_world(ours.world.name)))
        about = {"name": EDQN, "workload": workload, "products": ours.train.products}
        rows.append({**about, "decisions_per_second": statistics.median(edqn), "turns": edqn})
    machine = json_report.machine(jax.devices())
    machine["versions"] |= {name: metadata.version(name) for name in PACKAGES}
    return {
        "workload": {
            **describe_workload(config, load_scene(resolve_world(config.world.name))),
            "physics": "c_mujoco",
            "world": config.world.name,
        },
        **machine,
        "conditions": seen,
        "decisions_per_second": best,
        "decisions_per_turn": decisions,
        "repeats": repeats,
        "rows": rows,
    }


def table(report: dict[str, Any]) -> str:
    """Returns the report as Markdown."""
    stated = report["workload"]
    rows = [row for row in report["rows"] if row["name"] != EDQN]
    names = [f"{row['camera']}, {row['processes']} processes, PyTorch {row['torch_threads']} threads" for row in rows]
    lines = [
        f"{report['device']}, {stated['num_envs']} drones, {stated['replayed_samples_per_decision']:g} replayed and "
        f"{stated['vae_samples_per_decision']:g} VAE samples per decision; medians of {report['repeats']}; "
        f"{sentence(report['conditions'])}",
        "",
        f"| conventional stack, camera by | {' | '.join(names)} |",
        f"| --- |{' ---: |' * len(rows)}",
        f"| decisions/s | {' | '.join(format(row['decisions_per_second'], ',.0f') for row in rows)} |",
    ]
    for ours in report["rows"]:
        if ours["name"] == EDQN:
            title = f"E-DQN's {ours['decisions_per_second']:,.0f} decisions/s over it (products {ours['products']})"
            lines.append(f"| {title} | {' | '.join(format(row['edqn_over_it'], '.2f') for row in rows)} |")
    for part in rows[0]["shares"]:
        shares = " | ".join(format(row["shares"][part], ".1%") for row in rows)
        lines.append(f"| {part.replace('_', ' ')} | {shares} |")
    return "\n".join(lines)


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    use_cpu_devices()
    args, config, ours = parse(argv)
    report = measure(config, args.decisions, args.repeats, args.camera, ours)
    print(table(report))
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
