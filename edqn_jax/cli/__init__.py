"""The command line: arguments, the commands, signals and exit codes."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code, see `cli.commands.run_command`."""
    from edqn_jax.cli.process.streams import exit_code, lasting_streams

    with lasting_streams() as outputs:
        from edqn_jax.cli.process.signals import listen_to_signals
        from edqn_jax.cli.process.variables import prepare_process

        prepare_process()
        with listen_to_signals() as stops:
            from edqn_jax.cli.commands import run_command  # takes a while: a signal may come meanwhile

            code = run_command(argv, stops)
        return exit_code(outputs, code)


__all__ = ["main"]
