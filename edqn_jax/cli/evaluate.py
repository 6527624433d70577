"""`edqn evaluate`: flies a policy, prints the figures, writes what was asked for."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from edqn_jax.cli.arguments import EvaluateArgs
from edqn_jax.config.presets import Layer
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.evaluate import evaluate
from edqn_jax.evaluation.latency import decision_latency_ms
from edqn_jax.evaluation.metrics import clearance_text
from edqn_jax.evaluation.trajectories import write_trajectories
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.learn.policy import Policy
from edqn_jax.policies import function_named
from edqn_jax.policies.functions import FunctionPolicy, actor_of, config_of
from edqn_jax.runs.directory import plain
from edqn_jax.runs.policies import find_policy, policy_digest, worlds_replaced
from edqn_jax.runs.provenance import source_record, versions


def evaluate_command(args: EvaluateArgs) -> None:
    """`edqn evaluate`: flies, prints, writes.

    Raises:
        ConfigError: if the run, the world or a file to write is not as it should be.
    """
    for file in (args.json, args.trajectories):
        if file is not None:
            check_can_write(file)
    if args.json is not None and args.trajectories is not None and args.json.resolve() == args.trajectories.resolve():
        raise ConfigError(f"--json and --trajectories are both '{args.json}'; give two files")
    policy = find_policy(args.run, args.world)
    evaluation = evaluate(
        policy,
        args.world,
        missions=args.missions,
        seed=args.seed,
        start=args.start,
        goal=args.goal,
        record=args.trajectories is not None,
        shuffle_codes=args.shuffle_codes,
        conditions=args.conditions,
    )
    config = config_of(policy)
    figures = {
        "run": str(args.run),
        **_told_of(policy, args.run),
        "versions": versions(),
        "world": evaluation.missions.name,
        "seed": args.seed,
        "shuffled_codes": args.shuffle_codes,
        "conditions": dict(_named(args.conditions)),
        **evaluation.figures,
        "decision_latency_ms": decision_latency_ms(config, policy.params, actor=actor_of(policy, config)),
    }
    notes = [] if args.world is not None else worlds_replaced(args.run)
    for note in (*notes, *([evaluation.missions.note] if evaluation.missions.note is not None else [])):
        Console().print(note, soft_wrap=True, markup=False, highlight=False)
    Console().print(report(figures))
    if args.json is not None:
        write_atomically(args.json, json.dumps(plain(figures), indent=2, allow_nan=False) + "\n")
    if args.trajectories is not None:
        write_trajectories(config, evaluation.missions, evaluation.flights, args.trajectories)


def _told_of(policy: Policy | FunctionPolicy, run: Path) -> dict[str, Any]:
    """Returns the SHA-256 of a saved policy, or the name of a function with that of its source."""
    if isinstance(policy, FunctionPolicy):
        return {"policy_function": source_record(policy.function)}
    return {} if function_named(run) else {"policy_sha256": policy_digest(run)}


def _named(conditions: Layer) -> Iterator[tuple[str, Any]]:
    for group, options in conditions.items():
        for option, value in options.items():
            yield f"{group}.{option}", value


def report(figures: dict[str, Any]) -> Table:
    """Returns the figures as a table for people."""

    def number(value: float | None, form: str) -> str:
        return "–" if value is None else form.format(value)

    low, high = figures["interval"]
    latency = figures["decision_latency_ms"]
    title = f"{figures['world']}, seed {figures['seed']}" + (", shuffled codes" if figures["shuffled_codes"] else "")
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column()
    table.add_column(justify="right")
    for name, value in figures["conditions"].items():
        table.add_row(name, str(value), end_section=name == list(figures["conditions"])[-1])
    table.add_row("all flights", "", style="bold")
    rate = f"{figures['successes']} of {figures['missions']} ({figures['success_rate']:.1%})"
    table.add_row("reached the goal", rate)
    table.add_row("95 % Wilson interval", f"{low:.1%} – {high:.1%}")
    for name in ("collisions", "left_volume", "timeouts", "diverged"):
        table.add_row(name.replace("_", " "), str(figures[name]))
        if name == "collisions" and "groups" in figures:
            table.add_row("– with another drone", str(figures["collisions_with_drones"]))
            table.add_row("– with the world", str(figures["collisions"] - figures["collisions_with_drones"]))
    if "groups" in figures:
        table.add_row("groups of which all arrived", f"{figures['groups_arrived']} of {figures['groups']}")
    table.add_row("SPL", number(figures["spl"], "{:.3f}"))
    table.add_section()
    table.add_row("flights that reached the goal", "", style="bold")
    table.add_row("path / shortest path", number(figures["path_over_shortest"], "{:.3f}"))
    table.add_row("path", number(figures["path_length_m"], "{:.1f} m"))
    table.add_row("decisions", number(figures["decisions"], "{:.1f}"))
    table.add_row("flight time", number(figures["flight_seconds"], "{:.1f} s"))
    table.add_row("least clearance", clearance_text(figures["min_clearance_m"]))
    table.add_section()
    table.add_row("one decision", "", style="bold")
    table.add_row("latency, median", f"{latency['median']:.2f} ms")
    table.add_row("latency, 99th percentile", f"{latency['p99']:.2f} ms")
    return table
