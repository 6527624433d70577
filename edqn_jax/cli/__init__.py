"""The command line: arguments, the commands, signals and exit codes."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code, see `cli.commands.run`."""
    from edqn_jax.cli.signals import heard

    with heard() as stops:
        from edqn_jax.cli.commands import run  # takes a while: a signal may come meanwhile

        return run(argv, stops)


__all__ = ["main"]
