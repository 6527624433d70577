"""`edqn verify`: a finished run, derived, flown and judged again."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import check_is_saved, parse_arguments
from edqn_jax.cli.help import VERIFY
from edqn_jax.cli.process.status import say_phase, show_phase
from edqn_jax.errors import CheckError, ConfigError
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.policies import SHIPPED, no_run

if TYPE_CHECKING:
    from edqn_jax.runs.verification.verify import Finding


@dataclass(frozen=True)
class VerifyArgs:
    """Verify a finished run: derive its summary from its raw files, fly its flights again, have C MuJoCo judge them."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of the run, or of the runs of several seeds."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write what was found as JSON."""


def parse_verify(argv: Sequence[str]) -> VerifyArgs:
    """Returns the arguments of `edqn verify`.

    Raises:
        ConfigError: if there is no run.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = parse_arguments(VerifyArgs, argv, VERIFY)
    check_is_saved(args.run, VERIFY)
    if not (args.run / "config.yaml").is_file():
        if str(args.run) in SHIPPED:
            raise ConfigError(f"'{args.run}' comes with the package, without the run; give the folder of a run")
        raise no_run(args.run)
    return args


def verify_command(args: VerifyArgs) -> None:
    """Runs `edqn verify` with these arguments.

    Raises:
        CheckError: if something is not as it was recorded.
        ConfigError: if there is no finished run, or the file to write cannot be written.
    """
    from edqn_jax.runs.verification.verify import verify_run

    show_phase("reading the run")
    if args.json is not None:
        check_can_write(args.json)
    findings = verify_run(args.run, say_phase, show_phase)
    Console().print(findings_table(findings))
    if args.json is not None:
        found = {"run": str(args.run), "findings": [dataclasses.asdict(finding) for finding in findings]}
        write_atomically(args.json, json.dumps(found, indent=2) + "\n")
    wrong, unknown = (sum(finding.right is kind for finding in findings) for kind in (False, None))
    left = f"; {unknown} could not be compared" if unknown else ""
    print(f"{len(findings) - wrong - unknown} of {len(findings)} verified{left}")
    if wrong:
        raise CheckError(f"{wrong} of {len(findings)} things in '{args.run}' are not as they were recorded")


def findings_table(findings: list[Finding]) -> Table:
    """Returns the findings as a table for people."""
    table = Table(title_justify="left")
    table.add_column("verified")
    table.add_column("found")
    table.add_column("")
    marks = {True: "✓", False: "✗", None: "–"}
    for finding in findings:
        table.add_row(finding.what, finding.says, marks[finding.right], style="red" if finding.right is False else None)
    return table
