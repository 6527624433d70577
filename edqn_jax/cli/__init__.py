"""The command line: arguments, the commands, signals and exit codes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NoReturn


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code, see `cli.commands.run_command`."""
    from edqn_jax.cli.process.status import shown_status
    from edqn_jax.cli.process.streams import exit_code, lasting_streams

    words = list(sys.argv[1:] if argv is None else argv)
    with lasting_streams() as outputs:
        with shown_status(words, outputs):  # before anything that takes a while is imported
            from edqn_jax.cli.process.signals import listen_to_signals
            from edqn_jax.cli.process.variables import prepare_process

            prepare_process()
            with listen_to_signals() as stops:
                from edqn_jax.cli.commands import run_command  # takes a while: a signal may come meanwhile

                code = run_command(words, stops)
        return exit_code(outputs, code)


def run() -> NoReturn:
    """Runs the command of this process, and ends it."""
    from edqn_jax.cli.process.ending import end_process

    end_process(main())


__all__ = ["main", "run"]
