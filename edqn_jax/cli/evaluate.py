"""`edqn evaluate`: flies a policy, prints the figures, writes what was asked for."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import Point, check_flags, check_run, flags_of, flags_of_group, print_notes
from edqn_jax.cli.help import ABOUT, EVALUATE, asks_for_help, print_help, with_conditions, with_help_texts
from edqn_jax.cli.process.parsing import parse_or_say
from edqn_jax.cli.process.status import show_phase
from edqn_jax.config import CONDITIONS
from edqn_jax.config.presets import Layer
from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.policies import function_named

if TYPE_CHECKING:
    from edqn_jax.learn.policy import Policy
    from edqn_jax.policies.functions import FunctionPolicy


@dataclass(frozen=True)
class EvaluateArgs:
    """Fly a policy on missions in any world and print metrics."""

    run: Annotated[Positional[Path], arg(metavar="POLICY")]
    """Folder of a run, or `pretrained`, `pretrained-looks`, `pretrained-late` or `pretrained-body`, which come with the
    package; or any function of your own, as `module:name` or `path/to/file.py:name`."""
    world: Annotated[str | None, arg(metavar="WORLD", help_behavior_hint="")] = None
    """Where to fly: `paper`, an MJCF file, or test worlds of a family (default: where training was)."""
    start: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Start of every mission, metres (default: the world's; random free ones with --missions)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal of every mission, metres (default: the world's; random free ones on random worlds)."""
    missions: Annotated[int, arg(metavar="N")] = 1
    """Number of missions."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of the missions."""
    shuffle_codes: Annotated[bool, arg(help_behavior_hint="")] = False
    """Give each drone the events of another one at each decision, which measures how much the policy depends on its
    events. For other sensors, permutes that observation."""
    decoder: Annotated[bool, arg(help_behavior_hint="")] = False
    """Also measure the error of the distances that the decoder predicts from the code, over pixels nearer than 10 m."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write the metrics as JSON."""
    trajectories: Annotated[Path | None, arg(metavar="FILE.npz", help_behavior_hint="")] = None
    """Also write every flight, one pose per physics step."""
    conditions: Annotated[Layer, tyro.conf.Fixed] = field(default_factory=dict)
    """Options of `config.CONDITIONS` in place of the policy's own."""


def parse_evaluate(argv: Sequence[str]) -> EvaluateArgs:
    """Returns the checked arguments of `edqn evaluate`.

    Raises:
        ConfigError: if one is out of its limits, or there is no such run.
        SystemExit: after printing, for --help, --help-all and for arguments that do not parse.
    """
    kind = with_conditions(with_help_texts(EvaluateArgs), CONDITIONS)
    flags = {
        flag: (group, option) for group, names in CONDITIONS.items() for flag, option in flags_of_group(group, names)
    }
    check_flags(argv, flags_of(EvaluateArgs) | set(flags) | {"--help-all"}, EVALUATE)
    if "--help-all" in argv or asks_for_help(argv):
        print_help(kind if "--help-all" in argv else with_help_texts(EvaluateArgs), EVALUATE, ABOUT[EVALUATE])
    parsed: Any = parse_or_say(lambda: tyro.cli(kind, args=argv, prog=EVALUATE), EVALUATE)
    conditions: dict[str, dict[str, Any]] = {}
    for word in argv:
        group, option = flags.get(word.partition("=")[0].replace("_", "-"), ("", ""))
        if group:
            conditions.setdefault(group, {})[option] = getattr(getattr(parsed, group), option)
    own = {name: value for name, value in vars(parsed).items() if name not in CONDITIONS}
    args = EvaluateArgs(**own, conditions=conditions)
    if args.missions < 1:
        raise ConfigError(f"--missions must be at least 1, not {args.missions}")
    check_run(args.run)
    return args


def evaluate_command(args: EvaluateArgs) -> None:
    """`edqn evaluate`: flies, prints, writes.

    Raises:
        ConfigError: if the run, the world or a file to write is not as it should be.
    """
    show_phase("loading the policy")

    from edqn_jax.evaluation.evaluate import evaluate
    from edqn_jax.evaluation.latency import decision_latency_ms
    from edqn_jax.evaluation.trajectories import write_trajectories
    from edqn_jax.policies.functions import actor_of, config_of
    from edqn_jax.runs.directory import to_plain_json
    from edqn_jax.runs.policies import find_policy
    from edqn_jax.runs.provenance import package_versions

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
        decoder=args.decoder,
        conditions=args.conditions,
        phase=show_phase,
        announce=partial(print_notes, policy, args.run, args.world),
    )
    config = config_of(policy)
    show_phase("measuring the latency")
    figures = {
        "run": str(args.run),
        **_policy_source(policy, args.run),
        "versions": package_versions(),
        "world": evaluation.missions.name,
        "seed": args.seed,
        "shuffled_codes": args.shuffle_codes,
        "conditions": dict(_flatten_conditions(args.conditions)),
        **evaluation.figures,
        "decision_latency_ms": decision_latency_ms(config, policy.params, actor=actor_of(policy, config)),
    }
    Console().print(figures_table(figures))
    if args.json is not None:
        write_atomically(args.json, json.dumps(to_plain_json(figures), indent=2, allow_nan=False) + "\n")
    if args.trajectories is not None:
        write_trajectories(config, evaluation.missions, evaluation.flights, args.trajectories)


def _policy_source(policy: Policy | FunctionPolicy, run: Path) -> dict[str, Any]:
    """Returns the SHA-256 of a saved policy, or the name of a function with that of its source."""
    from edqn_jax.policies.functions import FunctionPolicy
    from edqn_jax.runs.policies import policy_digest
    from edqn_jax.runs.provenance import source_record

    if isinstance(policy, FunctionPolicy):
        return {"policy_function": source_record(policy.function)}
    return {} if function_named(run) else {"policy_sha256": policy_digest(run)}


def _flatten_conditions(conditions: Layer) -> Iterator[tuple[str, Any]]:
    for group, options in conditions.items():
        for option, value in options.items():
            yield f"{group}.{option}", value


def figures_table(figures: dict[str, Any]) -> Table:
    """Returns the figures as a table for people."""
    from edqn_jax.evaluation.metrics import clearance_text

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
    table.add_row("path / shortest path to the centre", number(figures["path_over_shortest"], "{:.3f}"))
    table.add_row("path", number(figures["path_length_m"], "{:.1f} m"))
    table.add_row("decisions", number(figures["decisions"], "{:.1f}"))
    table.add_row("flight time", number(figures["flight_seconds"], "{:.1f} s"))
    table.add_row("least clearance", clearance_text(figures["min_clearance_m"]))
    if "decoder" in figures:
        _add_decoder(table, figures["decoder"])
    table.add_section()
    table.add_row("one decision", "", style="bold")
    table.add_row("latency, median", f"{latency['median']:.2f} ms")
    table.add_row("latency, 99th percentile", f"{latency['p99']:.2f} ms")
    return table


def _add_decoder(table: Table, figures: dict[str, Any]) -> None:
    """Adds the error of the predicted distance."""

    def error(which: str) -> str:
        relative, metres = figures[f"relative_{which}"], figures[f"metres_{which}"]
        return "–" if relative is None or metres is None else f"{relative:.0%}, {metres:.2f} m"

    table.add_section()
    table.add_row(f"predicted distance below {figures['near_m']:.0f} m", "", style="bold")
    table.add_row("error, median", error("median"))
    table.add_row("error, 90th percentile", error("p90"))
    table.add_row("frames", f"{figures['frames']:,}")
