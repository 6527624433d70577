"""Tries every command under settings of a process that are not ours: variables, locales, streams that are closed.

    python scripts/fuzz_settings.py                                   # all of them
    python scripts/fuzz_settings.py --commands evaluate events --settings JAX_ --jobs 2

A command does what it does without the setting, or ends with a sentence that names it, and exit code 2; anything else,
such as a traceback or no end, is a fault. Prints a table, and exits with 1 if there is a fault. The tests try a few.
"""

from __future__ import annotations

import argparse
import collections
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.fuzz.settings import COMMANDS, SETTINGS, Ending, Setting, fault, prepare, run  # noqa: E402


def main(argv: Sequence[str] | None = None) -> int:
    """Returns 0 if there was no fault, else 1."""
    parser = argparse.ArgumentParser(
        prog="python scripts/fuzz_settings.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS), help="which (default all)")
    parser.add_argument("--settings", default="", help="only those with this text in them")
    parser.add_argument("--jobs", type=int, default=1, help="commands that run at once (default 1)")
    args = parser.parse_args(argv)
    chosen = [setting for setting in SETTINGS if args.settings in setting.name]
    faults = collections.Counter[str]()
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(args.jobs) as pool:
        folder = Path(name)
        prepare(folder)
        print(" | ".join(["setting", *args.commands]), flush=True)

        def tried(setting: Setting, command: str) -> Ending:
            return run(setting, COMMANDS[command], folder, f"fresh-{SETTINGS.index(setting)}-{command}")

        rows = [[pool.submit(tried, setting, command) for command in args.commands] for setting in chosen]
        for setting, row in zip(chosen, rows, strict=True):
            endings = [ending.result() for ending in row]
            wrong = [fault(setting, ending) for ending in endings]
            cells = [why or str(ending.code) for why, ending in zip(wrong, endings, strict=True)]
            print(" | ".join([setting.name or "none", *cells]), flush=True)
            for command, why, ending in zip(args.commands, wrong, endings, strict=True):
                if why:
                    faults[why] += 1
                    print(f"  {command}: {why}\n{ending.said[-3000:]}", file=sys.stderr, flush=True)
    count = len(chosen) * len(args.commands)
    print(f"{count:,} commands, {sum(faults.values())} faults {dict(faults) or ''}".strip())
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
