"""Which of two commits is faster, and by how much? Both are timed in one run, in turns.

Each commit is checked out into a temporary folder and timed by a process of its own that runs the commit's own package
and benchmarks. The two processes take turns, A B, B A, A B ..., one row at a time, so that a change in the machine's
speed affects both. The ratio is the median of the ratios of the pairs. With at least six turns its interval contains
the true median with a probability of at least 95 %; with fewer it is the smallest and the largest ratio. Compare a
commit with itself to see the difference between two processes of the same code. If the meaning of a row changed between
the commits, its ratio compares two different things.

    python benchmarks/compare.py main HEAD
    python benchmarks/compare.py v1 HEAD --rows whole_training_step rendering -- --num-envs 1024

A commit can be compared if it has a worker, benchmarks/measurement/worker.py or, in older commits,
benchmarks/worker.py: that is every commit since this script was added. The layout of the rest of the commit does not
matter, because its own worker times it. Both commits must run with the packages that are installed here.

    python benchmarks/compare.py HEAD HEAD --rows whole_training_step -- --world medium -- --surface.pattern drawn

Arguments after -- are options of train.py; both commits are timed with them, so both must have them. Those after a
second -- are for B alone, so that a commit shows what options cost.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import contextlib
import json
import shlex
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from edqn_jax.errors import ConfigError
from measurement import json_report
from measurement.child import Child, ChildEndedError
from measurement.flags import parse_config, split
from measurement.intervals import median_interval
from measurement.parts import PARTS
from measurement.whole import WHOLE

ROOT = Path(__file__).resolve().parents[1]
REPEATS, QUICK_REPEATS = 10, 6
TIMED = ("edqn_jax", "benchmarks", "scenes")
"""Folders of a checkout whose content affects what is timed."""
WORKERS = ("benchmarks/measurement/worker.py", "benchmarks/worker.py")
"""Where a commit has its worker: in its present place or its older one. The interface of all workers is the same."""

# ------------------------------------------------------------------------------------------ commits


def find_commit(root: Path, name: str) -> str:
    """Returns the full hash of a commit.

    Raises:
        ConfigError: if there is no such commit, or it has no worker.
    """
    found = _git(root, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{name}^{{commit}}")
    if found.returncode:
        raise ConfigError(f"there is no commit '{name}' in '{root}'")
    commit = found.stdout.strip()
    if all(_git(root, "cat-file", "-e", f"{commit}:{worker}").returncode for worker in WORKERS):
        raise ConfigError(
            f"commit '{name}' cannot be compared: it is older than compare.py, with neither {' nor '.join(WORKERS)}"
        )
    return commit


def check_committed(root: Path, commits: Mapping[str, str]) -> None:
    """Raises ConfigError if a commit is checked out at `root` and the working tree differs from it.

    Args:
        root: the repository.
        commits: full hashes by the names that the user gave.
    """
    head = _git(root, "rev-parse", "HEAD").stdout.strip()
    changed = _git(root, "status", "--porcelain", "--", *TIMED).stdout.splitlines()
    for name, commit in commits.items():
        if commit == head and changed:
            raise ConfigError(
                f"'{name}' is checked out here with uncommitted changes, such as in '{changed[0][3:]}'; "
                "commit or stash them, because only commits are timed"
            )


@contextlib.contextmanager
def check_out(root: Path, commit: str, folder: Path) -> Iterator[Path]:
    """Checks the commit out into a worktree at `folder`, which is removed after the block.

    Raises:
        ConfigError: if git cannot create the worktree.
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
    return (text.strip().splitlines() or ["git printed no error"])[-1]


# ------------------------------------------------------------------------------------------ workers


class Worker(Child):
    """The process that times one commit: the commit's own `worker.py`."""

    def __init__(self, checkout: Path, rows: Sequence[str], words: Sequence[str], log: Path) -> None:
        self.checkout = checkout
        script = next(file for worker in WORKERS if (file := checkout / worker).is_file())
        super().__init__(checkout, script, [json.dumps(list(rows)), *words], log)
        self.about: dict[str, Any] = {}

    def wait_until_ready(self) -> None:
        """Waits until everything is compiled.

        Raises:
            ConfigError: if the commit cannot be timed.
        """
        self.about = self.answer()
        if not Path(self.about["package"]).is_relative_to(self.checkout):
            raise ConfigError(f"edqn_jax was imported from '{self.about['package']}', not from '{self.checkout}'")

    def answer(self) -> Any:
        """Returns the worker's next answer: first its description, then microseconds of one device per decision.

        Raises:
            ConfigError: if the commit cannot be timed.
        """
        try:
            return super().answer()
        except ChildEndedError as error:
            raise ConfigError(f"commit {self.checkout.name} cannot be timed: {error}") from None


# ------------------------------------------------------------------------------------------ figures


def take_turns(workers: Sequence[Worker], rows: Sequence[str], repeats: int) -> dict[str, list[list[float]]]:
    """Returns the measurements of both workers for each row, taken in the order A B, B A, A B ..."""
    turns: dict[str, list[list[float]]] = {row: [[] for _ in workers] for row in rows}
    for repeat in range(repeats):
        sides = list(range(len(workers)))
        for row in rows:
            for side in sides if repeat % 2 == 0 else reversed(sides):
                turns[row][side].append(workers[side].ask(row))
    return turns


def compared(name: str, first: Sequence[float], second: Sequence[float]) -> dict[str, Any]:
    """Returns a row: the median of each commit, and the ratio of the second to the first with its interval.

    Args:
        name: of the row.
        first, second: costs by turn; those at the same index were measured one after the other.
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


def measure(
    root: Path,
    names: Sequence[str],
    rows: Sequence[str],
    repeats: int,
    quick: bool,
    options: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """Times both commits and returns the report that `--json` writes.

    Args:
        root: the repository.
        names: of the commits.
        rows: that are timed, all where empty.
        repeats: turns of each row.
        quick: whether the turns are short.
        options: of train.py: `both` of both sides, `b` of B alone.

    Raises:
        ConfigError: if a commit does not exist or cannot be timed.
    """
    commits = [find_commit(root, name) for name in names]
    check_committed(root, dict(zip(names, commits, strict=True)))
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        workers = []
        for side, commit in zip("ab", commits, strict=True):
            words = [*(["--quick"] if quick else []), "--", *options["both"], *(options["b"] if side == "b" else ())]
            checkout = stack.enter_context(check_out(root, commit, folder / f"{side}-{commit[:10]}"))
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
        "options": {side: list(flags) for side, flags in options.items()},
        "differing": differing(first, second),
        "repeats": repeats,
        "rows": [compared(row, *turns[row]) for row in common],
    }


def differing(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Returns the entries in which the two workloads differ, as [first, second] by key."""
    a, b = first["workload"], second["workload"]
    return {key: [a.get(key), b.get(key)] for key in sorted(a.keys() | b.keys()) if a.get(key) != b.get(key)}


def table(report: dict[str, Any]) -> str:
    """Returns the report as a Markdown table."""
    a, b = report["commits"]
    lines = [
        f"A is {a['name']} ({a['commit'][:10]}), B is {b['name']} ({b['commit'][:10]}){_own(report)}; "
        f"{report['device']}, {len(report['devices'])} devices, {report['workload']['num_envs']} environments; "
        f"{report['repeats']} turns each. Below 1, B is faster.",
        "",
        "| µs of one device per decision | A | B | B / A | interval |",
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


def _own(report: Mapping[str, Any]) -> str:
    """Returns the options of B alone, for people."""
    return f" with {shlex.join(report['options']['b'])}" if report["options"]["b"] else ""


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, dict[str, list[str]]]:
    """Returns the parsed arguments, and the options of train.py, see `measure`.

    Raises:
        ConfigError: if a row is unknown, the options after -- are invalid, or the file cannot be written.
    """
    words, flags = split(argv)
    both, own = split(flags)
    parser = Parser("compare", __doc__, epilog="All rows take about five minutes on two cores.")
    parser.add_argument("a", metavar="COMMIT_A", help="the commit to compare with")
    parser.add_argument("b", metavar="COMMIT_B", help="the commit to compare")
    parser.add_argument("--rows", nargs="+", default=[], metavar="ROW", help="rows to time (default: all common rows)")
    parser.add_argument(
        "--repeats", type=at_least_one, help=f"turns of each row (default {REPEATS}, quick {QUICK_REPEATS})"
    )
    parser.add_argument("--quick", action="store_true", help="fewer and shorter turns")
    args = parser.parse(words)
    if args.repeats is None:
        args.repeats = QUICK_REPEATS if args.quick else REPEATS
    for row in args.rows:
        if row not in (WHOLE, *PARTS):
            raise ConfigError(f"there is no row '{row}'; there are {', '.join((WHOLE, *PARTS))}")
    for flags in (both, [*both, *own]):
        parse_config(flags)  # raises before anything is checked out
    return args, {"both": both, "b": own}


@in_a_sentence
def main(argv: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Returns exit code 0 after both commits were timed, 2 for invalid input."""
    args, options = parse(argv)
    report = measure(root, [args.a, args.b], args.rows, args.repeats, args.quick, options)
    print(table(report))
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
