"""How long does one decision take at deployment?

The time is measured from an event field and the own state on the host, batch 1, to the action on the host, with
dispatch. The process is restricted to one core, so only one of its threads runs at a time.

    python benchmarks/decision.py --json decision.json
    python benchmarks/decision.py -- --preset paper

Arguments after -- are options of train.py. Parameters are untrained, which does not change the time.
"""

from __future__ import annotations

from measurement.command import Parser, in_a_sentence

import argparse
import statistics
import sys
from collections.abc import Sequence
from typing import Any

import jax

from edqn_jax.config import Config
from edqn_jax.evaluation.latency import decision_latency_ms
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.runs.provenance import describe_workload
from measurement import json_report
from measurement.cores import keep_to, own_cores
from measurement.flags import parse_config, split

REPEATS, CALLS = 5, 2000


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, Config]:
    """Returns the parsed arguments, and the configuration of the policy.

    Raises:
        ConfigError: if the options after -- are invalid, or the file cannot be written.
    """
    words, flags = split(argv)
    parser = Parser("decision", __doc__)
    parser.add_argument("--quick", action="store_true", help=f"{CALLS // 10} decisions instead of {REPEATS} x {CALLS}")
    args = parser.parse(words)
    return args, parse_config(flags)


def measure(config: Config, repeats: int, calls: int) -> dict[str, Any]:
    """Returns the report that `--json` writes: medians over `repeats` of the percentiles of `calls` decisions."""
    params = fresh_policy(config, 0)
    turns = [decision_latency_ms(config, params, calls) for _ in range(repeats)]
    return {
        "workload": describe_workload(config, run_missions(config).scene),
        **json_report.machine(jax.devices()),
        "cores": 1,
        "decisions": repeats * calls,
        "rows": [
            {
                "name": "one_decision",
                **{f"{key}_ms": statistics.median(turn[key] for turn in turns) for key in turns[0]},
            }
        ],
    }


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    args, config = parse(argv)
    keep_to(own_cores()[:1])  # before JAX starts its threads
    report = measure(config, *((1, CALLS // 10) if args.quick else (REPEATS, CALLS)))
    row = report["rows"][0]
    print(
        f"One decision on one core: median {row['median_ms']:.2f} ms, 99th percentile {row['p99_ms']:.2f} ms "
        f"({report['decisions']:,} decisions, {report['device']})"
    )
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
