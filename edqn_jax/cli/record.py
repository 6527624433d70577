"""`edqn record`: flies a policy once and writes the flight as a GIF or MP4, or the events of its camera."""

from __future__ import annotations

from rich.console import Console

from edqn_jax.cli.arguments import RecordArgs
from edqn_jax.interop.flight_files import record
from edqn_jax.report.style import OUTCOME_LABELS
from edqn_jax.runs.policies import find_policy, worlds_replaced


def record_command(args: RecordArgs) -> None:
    """Runs `edqn record` with these arguments.

    Raises:
        ConfigError: if the policy, the world or the file to write is not as it should be.
        MissingPackageError: if the file to write needs an extra that is not installed.
    """
    policy = find_policy(args.run, args.world)
    done = record(policy, args.file, args.world, start=args.start, goal=args.goal, seed=args.seed, size=args.size)
    notes = [] if args.world is not None else worlds_replaced(args.run)
    for note in (*notes, *([done.missions.note] if done.missions.note is not None else [])):
        Console().print(note, soft_wrap=True, markup=False, highlight=False)
    Console().print(
        f"{OUTCOME_LABELS[done.outcome]} after {done.seconds:.1f} s; '{args.file}' has "
        f"{args.file.stat().st_size / 1e6:.1f} MB",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
