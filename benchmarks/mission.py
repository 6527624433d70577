"""Does training succeed for every seed? Runs `train.py` for one seed after another.

Each seed runs in a process of its own, which compiles everything anew unless --kept-programs is given, and the wall
time of the whole command is measured. A seed passes if its greedy flight reaches the goal in at most 188 decisions and
with at most 1.15 times the length of A*'s path, and the command took less than three minutes. No seed is run twice:
results of earlier runs in the same folder are read, and a seed whose training failed counts as failed. The flight ends
within the goal's radius, A*'s path at the goal itself.

In random worlds that flight is through `world.flown`; the bars are those of the paper's world.

    python benchmarks/mission.py --seeds 20 --out runs/mission --json mission.json

Arguments after -- are options of train.py.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import hashlib
import json
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edqn_jax.cli.train import parse_train
from edqn_jax.config.loading import to_yaml
from edqn_jax.devices.hardware import describe_processor
from edqn_jax.evaluation.metrics import wilson_interval
from edqn_jax.files import write_atomically
from measurement import json_report
from measurement.flags import split

TRAIN = Path(__file__).resolve().parents[1] / "train.py"

MOST_DECISIONS = 188
"""Decisions of the flight in the paper."""
MOST_PATH = 1.15
"""Length of the flight over that of A*'s path."""
MOST_SECONDS = 180.0
"""Wall time of the whole command."""

QUICK = ("--total-steps", "49152", "--encoder.warmup-decisions", "16384")
"""Options of train.py for `--quick`: long enough to run every part, too short to learn."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments; `flags` are those after --, for train.py."""
    words, flags = split(argv)
    parser = Parser("mission", __doc__)
    parser.add_argument("--seeds", type=at_least_one, default=20, help="number of seeds (default 20)")
    parser.add_argument("--first-seed", type=int, default=0, help="the first seed (default 0)")
    parser.add_argument("--world", default="paper", help="--world of train.py (default paper)")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/mission"), help="folder of the runs (default runs/mission)"
    )
    parser.add_argument(
        "--kept-programs", action="store_true", help="let runs use what was compiled before; else each compiles anew"
    )
    parser.add_argument("--quick", action="store_true", help="two seeds, too short to learn")
    args = parser.parse(words)
    args.flags = flags
    if args.quick:
        args.seeds, args.flags = min(args.seeds, 2), [*QUICK, *args.flags]
    return args


def command(args: argparse.Namespace, seed: int, folder: Path) -> list[str]:
    """Returns the command for a seed."""
    # An interrupted run starts from the beginning, because whole runs are measured.
    options = ["--seed", str(seed), "--world", args.world, "--run-dir", str(folder), "--resume", "never"]
    return [sys.executable, str(TRAIN), *options, *args.flags]


def environment(args: argparse.Namespace) -> dict[str, str]:
    """Returns the variables of a seed's process."""
    return dict(os.environ) if args.kept_programs else os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}


def options_digest(args: argparse.Namespace) -> str:
    """Returns a digest of all options but the seed, to recognise runs with other options."""
    _, config = parse_train(command(args, 0, args.out)[2:])
    return hashlib.sha256(to_yaml(config).encode()).hexdigest()[:16]


class Ledger:
    """Wall time and exit code of each seed, in a file in the folder of the runs."""

    def __init__(self, file: Path, asked: dict[str, Any]) -> None:
        self.file, self.asked = file, asked
        self.seeds: dict[str, dict[str, Any]] = {}
        if file.is_file():
            kept = json.loads(file.read_text(encoding="utf-8"))
            if {"kept_programs": False} | kept["asked"] != asked:  # older ledgers do not say
                raise ValueError(f"the runs in '{file.parent}' were made with {kept['asked']}; choose another --out")
            self.seeds = kept["seeds"]

    def note(self, seed: int, wall_seconds: float, exit_code: int) -> None:
        self.seeds[str(seed)] = {"wall_seconds": wall_seconds, "exit_code": exit_code}
        kept = {"asked": self.asked, "seeds": self.seeds}
        write_atomically(self.file, json.dumps(kept, indent=1) + "\n")


def measure(args: argparse.Namespace) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Trains every seed that has not been run yet and returns `(rows, summaries of the complete runs)`.

    Raises:
        ValueError: if the folder contains runs with other options.
    """
    asked = {
        "world": args.world,
        "flags": args.flags,
        "options": options_digest(args),
        "kept_programs": args.kept_programs,
    }  # raises before the folder exists
    args.out.mkdir(parents=True, exist_ok=True)
    ledger = Ledger(args.out / "ledger.json", asked)
    rows, summaries = [], []
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        folder = args.out / f"s{seed}"
        file = folder / "summary.json"
        if str(seed) not in ledger.seeds and not file.is_file():
            print(f"seed {seed} ...", file=sys.stderr, flush=True)
            began = time.perf_counter()
            with (args.out / f"s{seed}.log").open("w", encoding="utf-8") as log:
                done = subprocess.run(
                    command(args, seed, folder), stdout=log, stderr=subprocess.STDOUT, env=environment(args)
                )
            ledger.note(seed, time.perf_counter() - began, done.returncode)
        known = ledger.seeds.get(str(seed), {"wall_seconds": None, "exit_code": 0})
        if known["exit_code"]:
            rows.append(failed_row(seed, known["exit_code"], known["wall_seconds"]))
            continue
        summaries.append(json.loads(file.read_text(encoding="utf-8")))
        rows.append(row_of(seed, summaries[-1], known["wall_seconds"]))
    return rows, summaries


def row_of(seed: int, summary: dict[str, Any], wall_seconds: float | None) -> dict[str, Any]:
    """Returns the row of a seed that was trained.

    Args:
        seed: of the run.
        summary: content of its `summary.json`.
        wall_seconds: None if they were not measured; the seed then does not pass.
    """
    ratio = summary["path_length_m"] / summary["shortest_path_m"]
    goal = summary["outcome"] == "goal"
    verdicts = {
        "goal": goal,
        "decisions_ok": goal and summary["steps"] <= MOST_DECISIONS,
        "path_ok": goal and ratio <= MOST_PATH,
        "time_ok": wall_seconds is not None and wall_seconds < MOST_SECONDS,
    }
    return {
        "name": f"seed {seed}",
        "seed": seed,
        "exit_code": 0,
        "outcome": summary["outcome"],
        "decisions": summary["steps"],
        "path_over_shortest": ratio,
        "min_clearance_m": summary["min_clearance_m"],
        "wall_seconds": wall_seconds,
        "train_seconds": summary["train_seconds"],
        "compile_seconds": summary["compile_seconds"],
        "flies_seconds": flies_seconds(summary, wall_seconds),
        "flies_decisions": summary["first_success_decisions"],
        "decisions_per_second": summary["decisions_per_second"],
        "validation_success": summary["validation_success"],
        "test_success_rate": summary["test"]["success_rate"] if "test" in summary else None,
        **verdicts,
        "passes": all(verdicts.values()),
    }


def flies_seconds(summary: dict[str, Any], wall_seconds: float | None) -> float | None:
    """Returns the seconds from the start of the command to the first success of the policy; None without one."""
    if wall_seconds is None or summary["first_success_seconds"] is None:
        return None
    # The run measures its time from after the imports.
    return summary["first_success_seconds"] + max(0.0, wall_seconds - summary["total_seconds"])


def failed_row(seed: int, exit_code: int, wall_seconds: float) -> dict[str, Any]:
    """Returns the row of a seed whose training failed: it meets no criterion."""
    nothing = dict.fromkeys(
        [
            "decisions",
            "path_over_shortest",
            "min_clearance_m",
            "train_seconds",
            "compile_seconds",
            "flies_seconds",
            "flies_decisions",
            "decisions_per_second",
            "validation_success",
            "test_success_rate",
        ]
    )
    verdicts = dict.fromkeys(["goal", "decisions_ok", "path_ok", "time_ok", "passes"], False)
    return {
        "name": f"seed {seed}",
        "seed": seed,
        "exit_code": exit_code,
        "outcome": f"exit code {exit_code}",
        **nothing,
        "wall_seconds": wall_seconds,
        **verdicts,
    }


def totals(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns how many seeds meet each criterion, Wilson's interval of the share that meets all, and medians.

    The medians of decisions and path are over the flights that reached the goal.
    """
    counts = {key: sum(row[key] for row in rows) for key in ("goal", "decisions_ok", "path_ok", "time_ok", "passes")}
    arrived = [row for row in rows if row["goal"]]

    def middle(key: str, among: Sequence[dict[str, Any]]) -> float | None:
        known = [row[key] for row in among if row[key] is not None]
        return statistics.median(known) if known else None

    return {
        "seeds": len(rows),
        **counts,
        "goal_interval": list(wilson_interval(counts["goal"], len(rows))),
        "passes_interval": list(wilson_interval(counts["passes"], len(rows))),
        "median_decisions": middle("decisions", arrived),
        "median_path_over_shortest": middle("path_over_shortest", arrived),
        "median_min_clearance_m": middle("min_clearance_m", arrived),
        "median_wall_seconds": middle("wall_seconds", rows),
        "median_compile_seconds": middle("compile_seconds", rows),
        # Seeds without a success count as slower than all others.
        "median_flies_seconds": _median_or_never([row["flies_seconds"] for row in rows]),
        "median_decisions_per_second": middle("decisions_per_second", rows),
    }


def _median_or_never(values: Sequence[float | None]) -> float | None:
    median = statistics.median([math.inf if value is None else value for value in values] or [math.inf])
    return median if math.isfinite(median) else None


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the rows as a Markdown table."""

    def shown(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    lines = [
        "| seed | outcome | decisions | path / shortest | clearance, m | compiling, s | flies after, s | wall, s "
        "| decisions/s | passes |",
        "| ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for row in rows:
        missed = [bar for bar in ("goal", "decisions_ok", "path_ok", "time_ok") if not row[bar]]
        verdict = "yes" if row["passes"] else "no: " + ", ".join(bar.removesuffix("_ok") for bar in missed)
        lines.append(
            f"| {row['seed']} | {row['outcome'].replace('_', ' ')} | {shown(row['decisions'], 'd')} "
            f"| {shown(row['path_over_shortest'], '.3f')} | {shown(row['min_clearance_m'], '.2f')} "
            f"| {shown(row['compile_seconds'], '.1f')} | {shown(row['flies_seconds'], '.0f')} "
            f"| {shown(row['wall_seconds'], '.0f')} | {shown(row['decisions_per_second'], ',.0f')} "
            f"| {verdict} |"
        )
    return "\n".join(lines)


def sentences(total: dict[str, Any]) -> str:
    """Returns the totals as sentences."""
    low, high = total["passes_interval"]
    text = (
        f"{total['passes']} of {total['seeds']} seeds pass (95 % interval {low:.0%} to {high:.0%}): "
        f"{total['goal']} reach the goal, {total['decisions_ok']} in at most {MOST_DECISIONS} decisions, "
        f"{total['path_ok']} within {MOST_PATH} of the shortest path; "
        f"{total['time_ok']} took less than {MOST_SECONDS:.0f} s."
    )
    if total["median_decisions"] is not None:
        text += (
            f"\nMedians of those at the goal: {total['median_decisions']:g} decisions, "
            f"{total['median_path_over_shortest']:.3f} of the shortest path, "
            f"clearance {total['median_min_clearance_m']:.2f} m."
        )
    if total["median_wall_seconds"] is not None:
        text += f"\nMedian wall time: {total['median_wall_seconds']:.0f} s."
    if total["median_flies_seconds"] is not None:
        text += f"\nMedian time to a policy that flies the mission: {total['median_flies_seconds']:.0f} s."
    return text


def report_of(
    args: argparse.Namespace, rows: Sequence[dict[str, Any]], summaries: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Returns the report that `--json` writes; workload and versions are those of the runs."""
    stated = summaries[0] if summaries else {"workload": {}, "versions": {}, "devices": []}
    return {
        "workload": {**stated["workload"], "world": args.world, "flags": args.flags},
        "device": describe_processor(),
        "devices": stated["devices"],
        "versions": stated["versions"],
        "criteria": {"decisions": MOST_DECISIONS, "path_over_shortest": MOST_PATH, "wall_seconds": MOST_SECONDS},
        "totals": totals(rows),
        "rows": list(rows),
    }


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, whatever the results; 2 for invalid input."""
    args = parse(argv)
    try:
        rows, summaries = measure(args)
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    report = report_of(args, rows, summaries)
    print(f"{table(rows)}\n\n{sentences(report['totals'])}\n{report['device']}")
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
