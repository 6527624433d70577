"""Shows that tests can fail: applies each mutant of `mutants.toml` to a copy of the checkout and runs its tests.

    python tests/mutants/run.py [--only NAME ...] [--list] [--verbose] [--skip-unmutated]

Works on a copy of the tracked files as they are in the working tree. A mutant is killed if one of its tests fails;
errors outside of a test do not count. Exits with 1 if a mutant survives. Run by hand, not in CI.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests.mutants.mutant import Mutant, MutantError, find_test, load_mutants, put_into  # noqa: E402

LIMIT_S = 600
"""Seconds after which a test run is ended."""


def copy_checkout(to: Path) -> None:
    """Copies the tracked files as they are in the working tree.

    Raises:
        MutantError: if git cannot list them.
    """
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        raise MutantError(f"git cannot list the files of '{ROOT}': {listed.stderr.strip()}")
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():  # it may have been deleted
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name)


def run_tests(copy: Path, tests: Sequence[str]) -> tuple[int, str]:
    """Returns pytest's exit code in the copy, 2 where it took more than `LIMIT_S`, and its output."""
    paths = os.pathsep.join(map(str, (copy, copy / "benchmarks")))
    # Without byte code: the mutated and the restored file may have the same size and second of change.
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "200"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", "--tb=short", *tests]
    try:
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        return 2, f"the tests took more than {LIMIT_S} s"
    return done.returncode, done.stdout + done.stderr


def failure(code: int, output: str) -> str | None:
    """Returns pytest's line on the test that failed; None if all passed or the error was outside of a test."""
    failed = [line for line in output.splitlines() if line.startswith("FAILED ")]
    return failed[0].removeprefix("FAILED ") if code == 1 and failed else None


def check_unmutated(copy: Path, mutants: Sequence[Mutant]) -> None:
    """Raises MutantError if a test of the mutants fails without them.

    Raises:
        MutantError: names the test.
    """
    began = time.perf_counter()
    tests = list(dict.fromkeys(find_test(test, copy) for mutant in mutants for test in mutant.tests))
    code, output = run_tests(copy, tests)
    if code:
        last = (output.strip().splitlines() or ["no output"])[-1]
        raise MutantError(f"the tests must pass without a mutant: {failure(code, output) or last}")
    print(f"{len(tests)} tests pass without a mutant, {time.perf_counter() - began:.0f} s", flush=True)


def try_mutant(copy: Path, mutant: Mutant, verbose: bool) -> bool:
    """Applies a mutant, runs its tests, prints the verdict, restores the file, and returns whether it was killed."""
    began = time.perf_counter()
    bug = put_into(mutant, copy)
    file = copy / bug.file
    original = file.read_text(encoding="utf-8")
    file.write_text(bug.text, encoding="utf-8")
    try:
        code, output = run_tests(copy, [find_test(test, copy) for test in mutant.tests])
    finally:
        file.write_text(original, encoding="utf-8")
    killer = failure(code, output)
    seconds = time.perf_counter() - began
    print(f"{mutant.name:32}{'killed' if killer else 'SURVIVED':>10}{seconds:8.1f} s   {mutant.says}", flush=True)
    if killer is None:
        why = "all tests passed" if code == 0 else f"pytest ended with {code}: {output.strip().splitlines()[-1]}"
        print(f"    {why}", flush=True)
    elif verbose:
        print(f"    {killer}", flush=True)
    return killer is not None


def chosen(mutants: Sequence[Mutant], names: Sequence[str] | None) -> list[Mutant]:
    """Returns the mutants of these names, all without names.

    Raises:
        MutantError: if there is none of a name.
    """
    if names is None:
        return list(mutants)
    if unknown := set(names) - {mutant.name for mutant in mutants}:
        raise MutantError(f"there is no mutant '{min(unknown)}'; --list shows what there is")
    return [mutant for mutant in mutants if mutant.name in names]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code: 1 if a mutant survived or cannot be applied."""
    parser = argparse.ArgumentParser(description="Apply deliberate bugs one by one and see a test fail for each.")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only these mutants")
    parser.add_argument("--list", action="store_true", help="print the mutants and stop")
    parser.add_argument("--skip-unmutated", action="store_true", help="do not run the tests without mutants first")
    parser.add_argument("--verbose", action="store_true", help="print the failure that killed each mutant")
    options = parser.parse_args(arguments)
    try:
        mutants = chosen(load_mutants(), options.only)
        files = {mutant.name: put_into(mutant, ROOT).file for mutant in mutants}
        if options.list:
            for mutant in mutants:
                print(f"{mutant.name:32}{files[mutant.name]:40}{mutant.says}")
            return 0
        with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
            copy = Path(folder)
            copy_checkout(copy)
            if not options.skip_unmutated:
                check_unmutated(copy, mutants)
            began = time.perf_counter()
            survived = [mutant.name for mutant in mutants if not try_mutant(copy, mutant, options.verbose)]
    except MutantError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    print(f"{len(mutants) - len(survived)} of {len(mutants)} mutants killed, {time.perf_counter() - began:.0f} s")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
