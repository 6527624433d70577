"""`edqn report`: writes the page of runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import check_run, parse_arguments
from edqn_jax.cli.help import REPORT
from edqn_jax.cli.process.status import say_phase, show_phase
from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_write, write_atomically


@dataclass(frozen=True)
class ReportArgs:
    """Write one HTML file with runs' flights in 3D, what the drone saw, curves, figures and options."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN [RUN ...]", help_behavior_hint="")]
    """Folders of runs, or `pretrained`; the folder of several seeds stands for the run of each seed. Or functions of
    your own, as `module:name` or `path/to/file.py:name`. Or one folder of a flight that `edqn fly` logged."""
    out: Annotated[Path | None, arg(metavar="FILE.html", help_behavior_hint="")] = None
    """HTML file to write; it replaces a file of that name (default: report.html in the first run's folder, of
    `pretrained` in the current one)."""
    missions: Annotated[int, arg(metavar="N")] = 128
    """Evaluation flights of each run at most; of all runs together at most 256."""


def parse_report(argv: Sequence[str]) -> ReportArgs:
    """Returns the checked arguments of `edqn report`.

    Raises:
        ConfigError: if a folder holds no run, or another argument is out of its limits.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = parse_arguments(ReportArgs, argv, REPORT)
    if not args.runs:
        raise ConfigError("give the folder of a run, such as edqn report runs/DIR")
    if args.missions < 1:
        raise ConfigError(f"--missions must be at least 1, not {args.missions}")
    if not _is_flight(args):
        for run in args.runs:
            check_run(run)
    first = args.runs[0] / "report.html"
    out = args.out or (first if args.runs[0].is_dir() else Path("report.html"))
    if out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"--out '{out}' must end in .html")
    return dataclasses.replace(args, out=out)


def _is_flight(args: ReportArgs) -> bool:
    """Returns whether the page is that of a flight.

    Raises:
        ConfigError: if more than a flight is asked for.
    """
    from edqn_jax.fly.records import RECORDS

    flights = [run for run in args.runs if (run / RECORDS).is_file()]
    if flights and len(args.runs) > 1:
        raise ConfigError(f"a page shows one flight, or runs; give '{flights[0]}' alone")
    return bool(flights)


def report_command(args: ReportArgs) -> None:
    """Runs `edqn report` with these arguments.

    Raises:
        ConfigError: if a run or the file to write is not as it should be.
    """
    assert args.out is not None
    check_can_write(args.out)
    if _is_flight(args):
        from edqn_jax.fly.page import flight_page

        page = flight_page(args.runs[0]).encode()
    else:
        show_phase("preparing worlds")

        from edqn_jax.report.page.document import build_report

        page = build_report(args.runs, args.missions, say_phase, show_phase).encode()
    write_atomically(args.out, page)
    print(f"'{args.out}' has {len(page) / 1e6:.1f} MB; open it in a browser")
