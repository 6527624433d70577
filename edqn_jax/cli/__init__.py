"""The command line: arguments, the commands, signals and exit codes."""

from edqn_jax.cli.main import main

__all__ = ["main"]
