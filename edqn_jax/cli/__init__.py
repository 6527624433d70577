"""The command line: arguments, the commands, signals and exit codes."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code, see `cli.commands.run`."""
    from edqn_jax.cli.process.streams import lasting_streams, lost

    with lasting_streams() as outputs:
        from edqn_jax.cli.process.signals import heard
        from edqn_jax.cli.process.variables import prepare_process

        prepare_process()
        with heard() as stops:
            from edqn_jax.cli.commands import run  # takes a while: a signal may come meanwhile

            code = run(argv, stops)
        return lost(outputs, code)


__all__ = ["main"]
