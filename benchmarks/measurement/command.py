"""What the commands of all benchmarks share: help, `--json`, a clock, and a sentence and code 2 for invalid input.

A benchmark imports this module before any other: JAX and the rest take seconds, and the clock begins here.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from edqn_jax.cli.process.status import open_status, show_phase
from edqn_jax.errors import CheckError, ConfigError
from edqn_jax.extras import MissingPackageError
from edqn_jax.files import check_can_write


class Parser(argparse.ArgumentParser):
    """Parses the options of a benchmark."""

    def __init__(
        self, name: str, about: str | None, *, json: str | None = "write the report to this file", epilog: str = ""
    ) -> None:
        """Holds no option but `--json`.

        Args:
            name: of the file in `benchmarks/`.
            about: its docstring.
            json: help of `--json`; None for a benchmark that has no such option.
            epilog: last line of the help.
        """
        super().__init__(
            prog=f"python benchmarks/{name}.py",
            description=about,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if json is not None:
            self.add_argument("--json", type=Path, help=json)

    def add_flights(self, run: str, missions: int) -> None:
        """Adds the run whose policy flies, and where: `run`, `--world`, `--missions` and `--seed`.

        Args:
            run: help of the run.
            missions: flown unless another number is given.
        """
        self.add_argument("run", type=Path, help=run)
        self.add_argument("--world", help="--world of train.py (default: that of the run)")
        self.add_argument("--missions", type=int, default=missions, help=f"number of missions (default {missions})")
        self.add_argument("--seed", type=int, default=0, help="seed of the missions (default 0)")

    def parse(self, words: Sequence[str] | None) -> argparse.Namespace:
        """Returns the options, after which the clock shows that the benchmark measures.

        Raises:
            ConfigError: if the file of `--json`, `--figure` or `--hours` cannot be written.
        """
        args = self.parse_args(words)
        for name in ("json", "figure", "hours"):
            if getattr(args, name, None) is not None:
                check_can_write(getattr(args, name))
        show_phase("measuring")
        return args


def at_least_one(text: str) -> int:
    """Returns an option's whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, not {text}")
    return int(text)


def in_a_sentence(main: Callable[..., int]) -> Callable[..., int]:
    """Returns a `main` that prints what is wrong with its input, or which package is missing, and returns 2.

    What a check finds wrong is printed as well, and 1 returned.

    The clock of this process, if it runs a benchmark, ends with it.
    """

    @functools.wraps(main)
    def command(*arguments: object) -> int:
        try:
            with _clock.pop_all():
                return main(*arguments)
        except (ConfigError, MissingPackageError) as error:
            print(error, file=sys.stderr)
            return 2
        except CheckError as error:
            print(error, file=sys.stderr)
            return 1

    return command


def _is_benchmark(program: Path) -> bool:
    """Returns whether a file is one of `benchmarks/`."""
    return program.resolve().parent == Path(__file__).resolve().parents[1]


_program = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
_clock = open_status(_program.stem) if _is_benchmark(_program) else contextlib.ExitStack()
atexit.register(_clock.close)  # of a benchmark that ends without `main`, such as for want of a package
