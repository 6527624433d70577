"""`edqn verify`: a finished run, derived, flown and judged again."""

from __future__ import annotations

import dataclasses
import json

from rich.console import Console
from rich.table import Table

from edqn_jax.cli.arguments import VerifyArgs
from edqn_jax.errors import CheckError
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.runs.verification.verify import Finding, verify


def verify_command(args: VerifyArgs) -> None:
    """Runs `edqn verify` with these arguments.

    Raises:
        CheckError: if something is not as it was recorded.
        ConfigError: if there is no finished run, or the file to write cannot be written.
    """
    if args.json is not None:
        check_can_write(args.json)
    console = Console()
    findings = verify(args.run, lambda text: console.print(text, soft_wrap=True, markup=False, highlight=False))
    console.print(report(findings))
    if args.json is not None:
        found = {"run": str(args.run), "findings": [dataclasses.asdict(finding) for finding in findings]}
        write_atomically(args.json, json.dumps(found, indent=2) + "\n")
    wrong, unknown = (sum(finding.right is kind for finding in findings) for kind in (False, None))
    console.print(f"{len(findings) - wrong - unknown} of {len(findings)} verified", highlight=False, end="")
    console.print(f"; {unknown} could not be compared" if unknown else "", highlight=False)
    if wrong:
        raise CheckError(f"{wrong} of {len(findings)} things in '{args.run}' are not as they were recorded")


def report(findings: list[Finding]) -> Table:
    """Returns the findings as a table for people."""
    table = Table(title_justify="left")
    table.add_column("verified")
    table.add_column("found")
    table.add_column("")
    marks = {True: "✓", False: "✗", None: "–"}
    for finding in findings:
        table.add_row(finding.what, finding.says, marks[finding.right], style="red" if finding.right is False else None)
    return table
