"""`edqn record`: flies a policy once and writes the flight as a GIF or MP4, or the events of its camera."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import Point, check_run, parse_arguments, print_notes
from edqn_jax.cli.help import RECORD
from edqn_jax.cli.process.status import show_phase
from edqn_jax.errors import ConfigError
from edqn_jax.files import EVENT_FILES, VIDEO, check_can_write, check_shown


@dataclass(frozen=True)
class RecordArgs:
    """Fly a policy once and write the flight as a GIF or MP4, or the events of a camera that watches it."""

    run: Annotated[Positional[Path], arg(metavar="POLICY")]
    """Folder of a run, or a policy of the package, such as `pretrained`; or any function of your own, as
    `module:name` or `path/to/file.py:name`."""
    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """What to write; it replaces a file of that name. FILE.gif or .mp4 (extra `video`): the view, what the drone sees,
    and its path. FILE.h5, .npz or .txt (extra `events`): the events of a camera with a frame at every physics step."""
    size: Annotated[tuple[int, int] | None, arg(metavar="W H", help_behavior_hint="")] = None
    """Pixels across and down: of a video (default: 800 540), or of the camera whose events are written (default: those
    of the policy's)."""
    speed: Annotated[float | None, arg(metavar="TIMES", help_behavior_hint="")] = None
    """How many times as fast as flown a video is; 1 is as flown (default: a frame a decision, at most 120)."""
    fps: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """Frames a second of a video (default: 10)."""
    world: Annotated[str | None, arg(metavar="WORLD", help_behavior_hint="")] = None
    """Where to fly: `paper`, an MJCF file, or a family of random worlds (default: that of the run's last flight)."""
    start: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Start of the flight, metres (default: the world's)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal of the flight, metres (default: the world's)."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Number of the test world of a family; elsewhere it only changes the sensor's noise."""


def parse_record(argv: Sequence[str]) -> RecordArgs:
    """Returns the checked arguments of `edqn record`.

    Raises:
        ConfigError: if the file's ending, its size or a missing package forbids it, or there is no run.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = parse_arguments(RecordArgs, argv, RECORD)
    suffix = args.file.suffix.lower()
    if suffix not in VIDEO + EVENT_FILES:
        raise ConfigError(f"'{args.file}' must end in .gif or .mp4 for a video, or in .h5, .npz or .txt for events")
    check_shown(args.file, args.size, args.speed, args.fps)
    if suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ConfigError("an .mp4 needs imageio_ffmpeg; run pip install 'edqn-jax[video]', or write a .gif")
    check_can_write(args.file)
    check_run(args.run)
    return args


def record_command(args: RecordArgs) -> None:
    """Runs `edqn record` with these arguments.

    Raises:
        ConfigError: if the policy, the world or the file to write is not as it should be.
        MissingPackageError: if the file to write needs an extra that is not installed.
    """
    show_phase("loading the policy")

    from edqn_jax.interop.flight_files import record
    from edqn_jax.report.style import OUTCOME_LABELS
    from edqn_jax.runs.policies import find_policy

    policy = find_policy(args.run, args.world)
    done = record(
        policy,
        args.file,
        args.world,
        start=args.start,
        goal=args.goal,
        seed=args.seed,
        size=args.size,
        pace=(args.speed, args.fps),
        phase=show_phase,
        announce=partial(print_notes, policy, args.run, args.world),
    )
    print(
        f"{OUTCOME_LABELS[done.outcome]} after {done.seconds:.1f} s; '{args.file}' has "
        f"{args.file.stat().st_size / 1e6:.1f} MB",
    )
