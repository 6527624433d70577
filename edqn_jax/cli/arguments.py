"""Arguments of the commands; a string under a field is its help text."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from edqn_jax.config import DENSITIES, Config
from edqn_jax.config.limits import validate
from edqn_jax.config.loading import resolve
from edqn_jax.errors import ConfigError
from edqn_jax.parallel.launch import Distributed
from edqn_jax.runs.directory import Resume

Point = tuple[float, float, float]


SHORT_NAMES = {
    "--world": "--world.name",
    "--num-envs": "--train.num-envs",
    "--total-steps": "--train.total-steps",
    "--seed": "--train.seed",
}
"""What people reach for first, and the knob that it stands for."""


@dataclass(frozen=True)
class TrainOptions:
    preset: Literal["default", "paper"] = "default"
    """`default`: the best that we know. `paper`: Table 1 to the letter."""
    config: Annotated[Path | None, arg(metavar="FILE.yaml", help_behavior_hint="")] = None
    """Knobs by group; the file wins over the preset, flags win over the file."""
    run_dir: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """What the run leaves behind goes here (default: a fresh, dated folder under runs/)."""
    resume: Resume = "auto"
    """What to do with an unfinished run in --run-dir. It cannot be continued yet: `auto` and `must` refuse it with a
    sentence, `never` starts it over."""
    distributed: Distributed = "auto"
    """Whether to train together with other processes, on one host or many: `auto` where --coordinator-address is given
    or Slurm's srun has started several tasks, `must` in any cluster that JAX finds, `never` not at all."""
    coordinator_address: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="")] = None
    """Where process 0 listens for the others. Every process is given this and the next two."""
    num_processes: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """How many processes train together."""
    process_id: Annotated[int | None, arg(metavar="I", help_behavior_hint="")] = None
    """Number of this process; process 0 writes the run directory."""


@dataclass(frozen=True)
class TrainCommand:
    """Train a drone to fly from events, fly the result, draw it."""

    options: Annotated[TrainOptions, arg(name="")] = field(default_factory=TrainOptions)
    knobs: Annotated[Config, arg(name="")] = field(default_factory=Config)


@dataclass(frozen=True)
class EvaluateArgs:
    """Fly a saved run greedily on missions of any world, and measure."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of the run."""
    world: Annotated[str | None, arg(metavar="paper|sparse|medium|dense|FILE.xml", help_behavior_hint="")] = None
    """Where to fly (default: the world of the run)."""
    start: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Start of every mission, metres (default: the world's; random free ones with --missions)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal of every mission, metres (default: the world's; random free ones on random worlds)."""
    missions: Annotated[int, arg(metavar="N")] = 1
    """How many missions."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of the missions."""
    shuffle_codes: Annotated[bool, arg(help_behavior_hint="")] = False
    """Give each drone the events of another one at each decision: how much does the policy fly by its events? Of
    a policy with another sensor, what that shows."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write the figures as JSON."""
    trajectories: Annotated[Path | None, arg(metavar="FILE.npz", help_behavior_hint="")] = None
    """Also write every flight, a pose per physics step."""


@dataclass(frozen=True)
class RecordArgs:
    """Fly a saved run once and write the flight as an animated GIF: the view, what the drone sees, and its path."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of the run."""
    file: Annotated[Positional[Path], arg(metavar="FILE.gif")]
    """GIF to write; it replaces a file of that name."""
    world: Annotated[str | None, arg(metavar="paper|sparse|medium|dense|FILE.xml", help_behavior_hint="")] = None
    """Where to fly (default: the world of the run)."""
    start: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Start of the flight, metres (default: the world's)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal of the flight, metres (default: the world's)."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Number of the test world of a random density; elsewhere it only changes the sensor's noise."""


TRAIN = "edqn train"


def parse_train(argv: Sequence[str]) -> tuple[TrainOptions, Config]:
    """The options and the checked configuration that the arguments of `edqn train` ask for.

    Raises:
        ConfigError: if the preset, the file or a limit is not met.
        SystemExit: after printing, for --help and for what does not parse.
    """
    argv = [_long_name(word) for word in argv]
    # Preset, file and world decide the defaults that the other flags change and that --help shows.
    early = [word for word in argv if word not in ("-h", "--help")]
    options, _ = tyro.cli(TrainOptions, args=early, prog=TRAIN, return_unknown_args=True, add_help=False)
    base = resolve(options.preset, options.config)
    world = _parse_knobs(early, base).world.name
    config = _parse_knobs(argv, resolve(options.preset, options.config, world))
    validate(config)
    # A file must be found again from any folder.
    if config.world.name not in DENSITIES and Path(config.world.name).is_file():
        world = dataclasses.replace(config.world, name=str(Path(config.world.name).resolve()))
        config = dataclasses.replace(config, world=world)
    return options, config


def _long_name(word: str) -> str:
    name, equals, value = word.partition("=")
    return SHORT_NAMES.get(name.replace("_", "-"), name) + equals + value


def _parse_knobs(argv: Sequence[str], base: Config) -> Config:
    names = ", ".join(f"{short} for {long}" for short, long in SHORT_NAMES.items())
    description = f"{TrainCommand.__doc__}\n\nEvery knob is a flag. Short names: {names}."
    default = TrainCommand(knobs=base)
    return tyro.cli(TrainCommand, args=argv, prog=TRAIN, description=description, default=default).knobs


def parse_evaluate(argv: Sequence[str]) -> EvaluateArgs:
    """Returns the checked arguments of `edqn evaluate`.

    Raises:
        ConfigError: if one is out of its limits.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = tyro.cli(EvaluateArgs, args=argv, prog="edqn evaluate")
    if args.missions < 1:
        raise ConfigError(f"--missions must be at least 1, not {args.missions}")
    _check_run(args.run)
    return args


def parse_record(argv: Sequence[str]) -> RecordArgs:
    """Returns the checked arguments of `edqn record`.

    Raises:
        ConfigError: if the file is no GIF, or there is no run.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = tyro.cli(RecordArgs, args=argv, prog="edqn record")
    if args.file.suffix.lower() != ".gif":
        raise ConfigError(f"'{args.file}' must end in .gif; only animated GIFs are written")
    _check_run(args.run)
    return args


def _check_run(folder: Path) -> None:
    if not (folder / "config.yaml").is_file():
        raise ConfigError(f"there is no run in '{folder}': it holds no config.yaml")
