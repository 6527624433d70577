"""What does a policy see and fly when surfaces look otherwise?

Flies a policy through the same test missions under every `surface.pattern`, and prints success with its Wilson
interval, collisions, and the error of the distance that the decoder predicts, over pixels nearer than 10 m:
median and 90th percentile, relative to the true distance and in metres. A policy without such a decoder has
dashes there.

    python benchmarks/looks.py --policy pretrained --world rooms --missions 200 --json looks.json
    python benchmarks/looks.py --policy pretrained-looks --world rooms --missions 1000 --seed 7 --exact
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from edqn_jax.cli.process.status import show_phase
from edqn_jax.config.simulation import LOOKS
from edqn_jax.evaluation.evaluate import evaluate_look
from edqn_jax.runs.policies import load_policy
from measurement import json_report

HEAD = (
    "| surface.pattern | reached the goal | collisions | error, median | 90th percentile | frames |\n"
    "| --- | --- | ---: | ---: | ---: | ---: |"
)


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments.

    Raises:
        ConfigError: if the file of `--json` cannot be written.
    """
    parser = Parser("looks", __doc__)
    parser.add_argument("--policy", type=Path, default=Path("pretrained"), help="folder of a run, or pretrained")
    parser.add_argument("--world", default="rooms", help="random worlds by name (default rooms)")
    parser.add_argument("--looks", nargs="+", default=list(LOOKS), choices=LOOKS, help="(default all)")
    parser.add_argument("--missions", type=at_least_one, default=200, help="number for each look (default 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the missions (default 0)")
    parser.add_argument("--exact", action="store_true", help="without the disturbances of the policy's training")
    return parser.parse(argv)


def measure(args: argparse.Namespace, show: Callable[[str], None] = print) -> dict[str, Any]:
    """Returns the report that `--json` writes, and shows a row for each look."""
    policy = load_policy(args.policy)
    show(HEAD)
    looks = []
    for number, look in enumerate(args.looks):
        show_phase("flying under each look", number, len(args.looks))
        flown = evaluate_look(policy, args.world, look, missions=args.missions, seed=args.seed, exact=args.exact)
        looks.append({"pattern": look, **flown.figures})
        show(row(looks[-1]))
    cell = {"policy": str(args.policy), "world": args.world, "seed": args.seed, "exact": args.exact}
    return {**json_report.machine(jax.devices()), "cell": cell, "looks": looks}


def row(look: dict[str, Any]) -> str:
    """Returns a look's figures as a row of a Markdown table."""
    low, high = look["interval"]
    success = f"{look['success_rate']:.1%} ({100 * low:.1f} to {100 * high:.1f})"
    decoder = look.get("decoder", {})
    errors = (_error(decoder, which) for which in ("median", "p90"))
    frames = f"{decoder['frames']:,}" if decoder else "–"
    return f"| `{look['pattern']}` | {success} | {look['collisions']} | {' | '.join(errors)} | {frames} |"


def _error(decoder: dict[str, Any], which: str) -> str:
    relative, metres = (decoder.get(f"{unit}_{which}") for unit in ("relative", "metres"))
    return "–" if relative is None or metres is None else f"{relative:.0%}, {metres:.2f} m"


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0, or 2 for invalid input."""
    args = parse(argv)
    json_report.write(args.json, measure(args))
    return 0


if __name__ == "__main__":
    sys.exit(main())
