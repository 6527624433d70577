"""`edqn evaluate`: flies a saved policy, prints the figures, writes what was asked for."""

from __future__ import annotations

import json
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from edqn_jax.cli.arguments import EvaluateArgs
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.latency import decision_latency_ms
from edqn_jax.evaluation.metrics import shortest_paths, summarise
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.trajectories import write_trajectories
from edqn_jax.runs.directory import plain
from edqn_jax.runs.files import check_can_write, write_whole
from edqn_jax.runs.policies import load_run
from edqn_jax.sim.outcomes import Outcome
from edqn_jax.sim.sensor import Form, sensor_of


def evaluate_command(args: EvaluateArgs) -> None:
    """`edqn evaluate`: flies, prints, writes.

    Raises:
        ConfigError: if the run, the world or a file to write is not as it should be.
    """
    for file in (args.json, args.trajectories):
        if file is not None:
            check_can_write(file)
    least = 2 * len(jax.devices())
    if args.shuffle_codes and args.missions < least:
        raise ConfigError(f"--shuffle-codes needs --missions of at least {least}, not {args.missions}")
    config, params = load_run(args.run)
    if args.shuffle_codes and sensor_of(config).form is Form.NOTHING:
        raise ConfigError(f"--shuffle-codes has nothing to shuffle: the policy of '{args.run}' sees nothing but itself")
    name = args.world or config.world.name
    course = load_missions(config, name, args.missions, args.seed, args.start, args.goal)
    record = args.trajectories is not None
    flights = fly_on_all_devices(
        config, course.world, params, args.seed, record=record, shuffle_codes=args.shuffle_codes
    )
    shortest = shortest_paths(config, course.world, np.asarray(flights.outcome) == Outcome.GOAL)
    figures = {
        "world": course.name,
        "seed": args.seed,
        "shuffled_codes": args.shuffle_codes,
        **summarise(flights, shortest),
        "decision_latency_ms": decision_latency_ms(config, params),
    }
    Console().print(report(figures))
    if args.json is not None:
        write_whole(args.json, json.dumps(plain(figures), indent=2, allow_nan=False) + "\n")
    if args.trajectories is not None:
        write_trajectories(config, course, flights, args.trajectories)


def report(figures: dict[str, Any]) -> Table:
    """The figures as a table for people."""

    def number(value: float | None, form: str) -> str:
        return "–" if value is None else form.format(value)

    low, high = figures["interval"]
    latency = figures["decision_latency_ms"]
    title = f"{figures['world']}, seed {figures['seed']}" + (", shuffled codes" if figures["shuffled_codes"] else "")
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column()
    table.add_column(justify="right")
    rate = f"{figures['successes']} of {figures['missions']} ({figures['success_rate']:.1%})"
    table.add_row("reached the goal", rate)
    table.add_row("95 % interval", f"{low:.1%} – {high:.1%}")
    for name in ("collisions", "left_volume", "timeouts", "diverged"):
        table.add_row(name.replace("_", " "), str(figures[name]))
    table.add_section()
    table.add_row("SPL", number(figures["spl"], "{:.3f}"))
    table.add_row("path / shortest path", number(figures["path_over_shortest"], "{:.3f}"))
    table.add_row("path", number(figures["path_length_m"], "{:.1f} m"))
    table.add_row("decisions", number(figures["decisions"], "{:.1f}"))
    table.add_row("flight time", number(figures["flight_seconds"], "{:.1f} s"))
    table.add_row("least clearance", number(figures["min_clearance_m"], "{:.2f} m"))
    table.add_section()
    table.add_row("decision latency, median", f"{latency['median']:.2f} ms")
    table.add_row("decision latency, 99th percentile", f"{latency['p99']:.2f} ms")
    return table
