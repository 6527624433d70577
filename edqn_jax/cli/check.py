"""`edqn check`: whether a policy can fly in a world, in a table and a picture."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import Point, check_run, parse_arguments
from edqn_jax.cli.help import CHECK
from edqn_jax.cli.process.status import show_phase
from edqn_jax.errors import CheckError, ConfigError
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.policies import PRETRAINED

if TYPE_CHECKING:
    from edqn_jax.evaluation.world_check import Cost, WorldCheck
    from edqn_jax.sim.scene.survey import GeomFate

MOST_NAMES = 4
"""Geoms that a row of the table names; the JSON has all."""


@dataclass(frozen=True)
class CheckArgs:
    """Say whether a policy can fly in a world: what its geoms became, its tightest way, its size, what it costs."""

    world: Annotated[Positional[str], arg(metavar="WORLD")]
    """`paper`, an MJCF file, or a family of random worlds."""
    policy: Annotated[Path, arg(metavar="POLICY")] = Path(PRETRAINED)
    """Folder of a run, a policy of the package, or a function, as `edqn evaluate` takes it: the world is compared with
    its body, and with the sizes of the worlds that it was trained in."""
    start: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Start, metres (default: the world's)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal, metres (default: the world's)."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Number of the test world of a family."""
    out: Annotated[Path | None, arg(metavar="FILE.png", help_behavior_hint="")] = None
    """Also draw the world, if it can be read, with its widest way; without this nothing is drawn."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write all that was found as JSON, every geom included."""


def parse_check(argv: Sequence[str]) -> CheckArgs:
    """Returns the checked arguments of `edqn check`.

    Raises:
        ConfigError: if the picture is no PNG, or there is no such policy.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = parse_arguments(CheckArgs, argv, CHECK)
    if args.out is not None and args.out.suffix.lower() != ".png":
        raise ConfigError(f"--out '{args.out}' must end in .png")
    if args.out is not None and args.json is not None and args.out.resolve() == args.json.resolve():
        raise ConfigError(f"--out and --json are both '{args.out}'; give two files")
    check_run(args.policy)
    return args


def check_command(args: CheckArgs) -> None:
    """Runs `edqn check` with these arguments.

    Raises:
        CheckError: if it cannot be flown there; says why.
        ConfigError: if the policy, the world or a file to write is not as it should be.
    """
    show_phase("looking at the world")

    from edqn_jax.evaluation.world_check import check_world
    from edqn_jax.runs.directory import to_plain_json
    from edqn_jax.runs.policies import find_config

    for file in (args.out, args.json):
        if file is not None:
            check_can_write(file)
    config = find_config(args.policy, args.world)
    found = check_world(config, args.world, seed=args.seed, start=args.start, goal=args.goal)
    Console().print(check_table(found, str(args.policy)))
    for line in (*filter(None, [found.note]), *found.warnings):
        print(line)
    if args.json is not None:
        figures = to_plain_json({"policy": str(args.policy), **found.figures()})
        write_atomically(args.json, json.dumps(figures, indent=2, allow_nan=False) + "\n")
    if args.out is not None and found.scene is not None:
        show_phase("drawing")

        from edqn_jax.report.worlds.check_map import plot_check

        title = f"{Path(found.name).name}: {_verdict(found)}"
        radii = config.drone.body_radius_m, config.env.goal_radius_m
        plot_check(
            found.scene,
            found.way,
            radii[0],
            title,
            _summary(found),
            args.out,
            flies=found.refusal is None,
            goal_radius_m=radii[1],
        )
    if found.refusal is not None:
        raise CheckError(found.refusal)


def _verdict(found: WorldCheck) -> str:
    """Returns whether a world can be flown, in words for a title; how well, no check says."""
    return "it can be flown" if found.refusal is None else "it cannot be flown"


def check_table(found: WorldCheck, policy: str) -> Table:
    """Returns what was found as a table for people."""
    table = Table(title=escape(f"{found.name}: {_verdict(found)}"), show_header=False, title_justify="left")
    table.add_column()
    table.add_column()
    if found.survey is not None:
        geoms = found.survey.geoms
        for (geom, became), fates in _grouped(fate for fate in geoms if fate.became is not None).items():
            _add_row(table, f"{len(fates)} × {geom}", f"{_words(became)}: {_names(fates)}")
        for why, fates in _by_reason(geoms).items():
            refused = fates[0].is_refused
            row = "refused" if refused else "left out"
            _add_row(table, f"{len(fates)} × {row}", f"{_names(fates)}: {why}", style="red" if refused else None)
        for each in found.survey.ignored:
            _add_row(table, "not used", each)
        table.add_section()
    else:
        for kind, count in found.shapes.items():
            _add_row(table, f"{count} ×", _words(kind))
        table.add_section()
    if found.scene is not None:
        _add_space(table, found, policy)
    if found.cost is not None:
        table.add_section()
        _add_cost(table, found.cost)
    return table


def _add_space(table: Table, found: WorldCheck, policy: str) -> None:
    """Adds volume and way."""
    assert found.scene is not None
    low, high = np.asarray(found.scene.volume, np.float64)
    _add_row(table, "flight volume", f"{_sides(high - low)} m")
    if found.trained_in:
        names: dict[str, list[str]] = {}
        for name, size in found.trained_in.items():
            names.setdefault(f"{_sides(size)} m", []).append(name)
        sizes = "\n".join(f"{size} ({', '.join(of_size)})" for size, of_size in names.items())
        _add_row(table, f"'{policy}' knows", sizes)
    if found.moving:
        _add_row(table, "shapes that move", f"{found.moving}; the way is that at the start")
    if found.way is None:
        return
    way, radius = found.way, found.config.drone.body_radius_m
    at = ", ".join(f"{x:.1f}" for x in way.points[way.tightest])
    _add_row(table, "widest way", f"{way.length_m:.1f} m long")
    _add_row(
        table,
        "its tightest place",
        f"{way.clearance_m:.2f} m of clearance, {way.clearance_m / radius:.1f} body radii; at ({at}), beside "
        f"{found.nearest}",
        style="bold",
    )


def _add_cost(table: Table, cost: Cost) -> None:
    """Adds what a world takes."""
    by = f"JAX, because of its {_words(*cost.drawn_by_jax)}" if cost.drawn_by_jax else "C"
    if not cost.drawn_by_jax:
        kinds = cost.drawn_by_jax_on_gpus
        by += f", on GPUs JAX, because of its {_words(*kinds)}" if kinds else ", on GPUs CUDA"
    _add_row(table, "pictures are drawn by", f"{by}; about {_rounded(cost.picture_us)} µs each on two CPU cores")
    rate = f"some {_rounded(cost.decisions_per_s)} decisions/s on two CPU cores while the encoder learns, then more"
    _add_row(table, "training", rate)
    _add_row(
        table,
        "memory",
        f"{_bytes(cost.world_bytes)}; in a training of {cost.num_envs} environments some "
        f"{_bytes(cost.training_bytes)} more",
    )


def _add_row(table: Table, name: str, value: str, style: str | None = None) -> None:
    """Adds a row of plain text: names in files may look like the markup of tables."""
    table.add_row(escape(name), escape(value), style=style)


def _grouped(fates: Iterable[GeomFate]) -> dict[tuple[str, str], list[GeomFate]]:
    """Returns geoms by their kind and what they became."""
    groups: dict[tuple[str, str], list[GeomFate]] = {}
    for fate in fates:
        groups.setdefault((fate.geom, fate.became or ""), []).append(fate)
    return groups


def _by_reason(fates: Iterable[GeomFate]) -> dict[str, list[GeomFate]]:
    """Returns the geoms that became nothing, by the reason."""
    groups: dict[str, list[GeomFate]] = {}
    for fate in fates:
        if fate.became is None:
            groups.setdefault(fate.why, []).append(fate)
    return groups


def _names(fates: Sequence[GeomFate]) -> str:
    """Returns the first names of geoms."""
    more = len(fates) - MOST_NAMES
    names = ", ".join(fate.name for fate in fates[:MOST_NAMES])
    return names if more <= 0 else f"{names} and {more} more"


def _words(*kinds: str) -> str:
    return " and ".join(kind.replace("_", " ") for kind in kinds)


def _sides(sides: Iterable[float]) -> str:
    return " × ".join(f"{side:.4g}" for side in sides)


def _rounded(value: float) -> str:
    """Returns an estimate with one digit."""
    return f"{float(f'{value:.0e}'):,.0f}"


def _bytes(count: int) -> str:
    return f"{count / 2**20:.1f} MiB" if count >= 2**20 else f"{count / 2**10:.1f} KiB"


def _summary(found: WorldCheck) -> str:
    """Returns the line below the picture's title."""
    assert found.scene is not None
    low, high = np.asarray(found.scene.volume, np.float64)
    shapes = ", ".join(f"{_words(kind)}: {count}" for kind, count in found.shapes.items())
    return f"{_sides(high - low)} m; {shapes}" + (f"\n{found.refusal}" if found.refusal else "")
