"""`edqn report`: writes the page of runs."""

from __future__ import annotations

from rich.console import Console

from edqn_jax.cli.arguments import ReportArgs
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.report.page.document import report


def report_command(args: ReportArgs) -> None:
    """Runs `edqn report` with these arguments.

    Raises:
        ConfigError: if a run or the file to write is not as it should be.
    """
    assert args.out is not None
    check_can_write(args.out)
    console = Console()
    page = report(
        args.runs, args.missions, lambda text: console.print(text, soft_wrap=True, markup=False, highlight=False)
    ).encode()
    write_atomically(args.out, page)
    said = f"'{args.out}' has {len(page) / 1e6:.1f} MB; open it in a browser"
    console.print(said, soft_wrap=True, markup=False, highlight=False)
