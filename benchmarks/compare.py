"""Which of two commits is faster, and by how much? Both timed in one run, turn by turn.

Each commit is checked out into a temporary folder and timed by a process of its own, with its own package and its
own `benchmarks/throughput.py`. Both processes stay alive and are asked in turns, A B, B A, A B ..., one row at a
time, so that a slow minute hits both alike. The ratio is the median of the pairs' ratios. Its interval holds the
true median in at least 95 of 100 runs, from six turns on; with fewer it is the least and the largest ratio. Compare
a commit with itself to see what two processes of the same code differ by. A row whose meaning changed between the
commits compares two things.

    python benchmarks/compare.py main HEAD
    python benchmarks/compare.py v1 HEAD --rows whole_training_step rendering -- --num-envs 1024

What stands after -- goes to both commits' configuration as it would for train.py.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from edqn_jax.errors import ConfigError
from edqn_jax.runs.files import check_can_write
from measurement import json_report
from measurement.child import Child, ChildEndedError
from measurement.flags import configured, split
from measurement.parts import PARTS
from measurement.worker import WHOLE

ROOT = Path(__file__).resolve().parents[1]
REPEATS, QUICK_REPEATS = 10, 6
TIMED = ("edqn_jax", "benchmarks", "scenes")
"""What of a checkout decides about its speed."""

# ------------------------------------------------------------------------------------------ commits


def find_commit(root: Path, name: str) -> str:
    """The commit's full name.

    Raises:
        ConfigError: if there is none of that name, or nothing in it to time it with.
    """
    found = _git(root, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{name}^{{commit}}")
    commit = found.stdout.strip()
    if found.returncode:
        raise ConfigError(f"there is no commit '{name}' in '{root}'")
    if _git(root, "cat-file", "-e", f"{commit}:benchmarks/throughput.py").returncode:
        raise ConfigError(f"commit '{name}' cannot be timed: it has no benchmarks/throughput.py")
    return commit


def check_committed(root: Path, commits: Mapping[str, str]) -> None:
    """Nothing, unless one of the commits is checked out here and the working tree is not that commit.

    Args:
        commits: the names that were asked for, and the commits' full ones.

    Raises:
        ConfigError: since what would be timed is not what is on the disk.
    """
    head = _git(root, "rev-parse", "HEAD").stdout.strip()
    changed = _git(root, "status", "--porcelain", "--", *TIMED).stdout.splitlines()
    for name, commit in commits.items():
        if commit == head and changed:
            raise ConfigError(
                f"'{name}' is checked out here with changes that are in no commit, such as in "
                f"'{changed[0][3:]}'; commit or stash them, for only commits are timed"
            )


@contextlib.contextmanager
def checked_out(root: Path, commit: str, folder: Path) -> Iterator[Path]:
    """A worktree of the commit at `folder`, gone after the block.

    Raises:
        ConfigError: if git cannot make it.
    """
    made = _git(root, "worktree", "add", "--quiet", "--detach", str(folder), commit)
    if made.returncode:
        raise ConfigError(f"commit {commit[:10]} cannot be checked out: {_last_line(made.stderr)}")
    try:
        yield folder
    finally:
        _git(root, "worktree", "remove", "--force", str(folder))


def _git(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True)


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it said nothing"])[-1]


# ------------------------------------------------------------------------------------------ workers


class Worker(Child):
    """A process that times one commit, as `worker.py` says."""

    def __init__(self, checkout: Path, rows: Sequence[str], words: Sequence[str], complaints: Path) -> None:
        self.checkout = checkout
        script = ROOT / "benchmarks" / "measurement" / "worker.py"
        super().__init__(checkout, script, [json.dumps(list(rows)), *words], complaints)
        self.about: dict[str, Any] = {}

    def wait_until_ready(self) -> None:
        """Until everything is compiled.

        Raises:
            ConfigError: if the commit cannot be timed.
        """
        self.about = self.answer()
        if not Path(self.about["package"]).is_relative_to(self.checkout):
            raise ConfigError(f"the package was taken from '{self.about['package']}', not from '{self.checkout}'")

    def answer(self) -> Any:
        """What the worker says next: what it is, then microseconds of one device a decision.

        Raises:
            ConfigError: if the commit cannot be timed.
        """
        try:
            return super().answer()
        except ChildEndedError as error:
            raise ConfigError(f"commit {self.checkout.name} cannot be timed: {error}") from None


# ------------------------------------------------------------------------------------------ figures


def take_turns(workers: Sequence[Worker], rows: Sequence[str], repeats: int) -> dict[str, list[list[float]]]:
    """For each row the turns of both workers: A B, then B A, and so on."""
    turns: dict[str, list[list[float]]] = {row: [[] for _ in workers] for row in rows}
    for repeat in range(repeats):
        sides = list(range(len(workers)))
        for row in rows:
            for side in sides if repeat % 2 == 0 else reversed(sides):
                turns[row][side].append(workers[side].ask(row))
    return turns


def compared(name: str, first: Sequence[float], second: Sequence[float]) -> dict[str, Any]:
    """A row: medians of both, and the ratio of the second to the first with its interval.

    Args:
        first, second: costs; those in one place were taken one after the other.
    """
    ratios = sorted(b / a for a, b in zip(first, second, strict=True))
    low, high = median_interval(ratios)
    return {
        "name": name,
        "us_per_decision_a": statistics.median(first),
        "us_per_decision_b": statistics.median(second),
        "ratio": statistics.median(ratios),
        "ratio_low": low,
        "ratio_high": high,
        "turns_a": list(first),
        "turns_b": list(second),
    }


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """An interval of 95 % at least for the median of what `values` are draws of, whatever its distribution.

    Between two of the values, as far in as a fair coin allows: the median lies below the k-th smallest of n only
    if fewer than k of n tosses are heads. Fewer than six values cannot be that sure; it is then all of their range.
    """
    ordered, count = sorted(values), len(values)
    left_out = 0
    while sum(math.comb(count, heads) for heads in range(left_out + 2)) <= 0.025 * 2**count:
        left_out += 1
    return ordered[left_out], ordered[-1 - left_out]


def measure(
    root: Path, names: Sequence[str], rows: Sequence[str], repeats: int, words: Sequence[str]
) -> dict[str, Any]:
    """Everything that `--json` holds.

    Raises:
        ConfigError: if one of the commits is none, or cannot be timed.
    """
    commits = [find_commit(root, name) for name in names]
    check_committed(root, dict(zip(names, commits, strict=True)))
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        workers = []
        for side, commit in zip("ab", commits, strict=True):
            checkout = stack.enter_context(checked_out(root, commit, folder / f"{side}-{commit[:10]}"))
            workers.append(stack.enter_context(Worker(checkout, rows, words, folder / f"{side}.log")))
        for worker in workers:
            worker.wait_until_ready()
        first, second = (worker.about for worker in workers)
        for name, about in zip(names, (first, second), strict=True):
            missing = [row for row in rows if row not in about["rows"]]
            if missing:
                raise ConfigError(f"commit '{name}' has no row '{missing[0]}'")
        common = [row for row in first["rows"] if row in second["rows"]]
        turns = take_turns(workers, common, repeats)
    return {
        "workload": second["workload"],
        "device": second["device"],
        "devices": second["devices"],
        "versions": second["versions"],
        "commits": [{"name": name, "commit": commit} for name, commit in zip(names, commits, strict=True)],
        "differing": differing(first, second),
        "repeats": repeats,
        "rows": [compared(row, *turns[row]) for row in common],
    }


def differing(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, list[Any]]:
    """What the workloads do not have in common: both values of each. A ratio then compares two workloads."""
    a, b = first["workload"], second["workload"]
    return {key: [a.get(key), b.get(key)] for key in sorted(a.keys() | b.keys()) if a.get(key) != b.get(key)}


def table(report: dict[str, Any]) -> str:
    """The figures for people, in Markdown."""
    a, b = report["commits"]
    lines = [
        f"A is {a['name']} ({a['commit'][:10]}), B is {b['name']} ({b['commit'][:10]}); {report['device']}, "
        f"{len(report['devices'])} devices, {report['workload']['num_envs']} environments; {report['repeats']} turns "
        "each. Below 1, B is faster.",
        "",
        "| µs of one device a decision | A | B | B / A | interval |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for row in report["rows"]:
        lines.append(
            f"| {row['name'].replace('_', ' ')} | {row['us_per_decision_a']:.1f} | {row['us_per_decision_b']:.1f} "
            f"| {row['ratio']:.3f} | {row['ratio_low']:.3f} - {row['ratio_high']:.3f} |"
        )
    if report["differing"]:
        told = ", ".join(f"{key} {x} and {y}" for key, (x, y) in report["differing"].items())
        lines += ["", f"The workloads differ: {told}."]
    return "\n".join(lines)


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, list[str]]:
    """The arguments, and the words that both workers give to their `throughput.py`.

    Raises:
        ConfigError: if a row is unknown, the flags after -- cannot be run, or the file cannot be written.
    """
    words, flags = split(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").partition("\n")[0],
        epilog="All rows take about five minutes on two cores. Flags after -- are train.py's.",
    )
    parser.add_argument("a", metavar="COMMIT_A", help="what is compared with")
    parser.add_argument("b", metavar="COMMIT_B", help="what is compared")
    parser.add_argument("--rows", nargs="+", default=[], metavar="ROW", help="which (default: all that both have)")
    parser.add_argument("--repeats", type=int, help=f"turns of each row (default {REPEATS}, quick {QUICK_REPEATS})")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter turns")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    args = parser.parse_args(words)
    if args.repeats is None:
        args.repeats = QUICK_REPEATS if args.quick else REPEATS
    if args.repeats < 1:
        parser.error(f"--repeats must be at least 1, not {args.repeats}")
    for row in args.rows:
        if row not in (WHOLE, *PARTS):
            raise ConfigError(f"there is no row '{row}'; there are {', '.join((WHOLE, *PARTS))}")
    if args.json is not None:
        check_can_write(args.json)
    configured(flags)  # or a sentence, before anything is checked out
    return args, [*(["--quick"] if args.quick else []), "--", *flags]


def main(argv: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Exit code 0 when both were measured, 2 for bad input."""
    try:
        args, words = parse(argv)
        report = measure(root, [args.a, args.b], args.rows, args.repeats, words)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    print(table(report))
    if args.json is not None:
        json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
