"""Arguments of the commands; a string under a field is its help text."""

from __future__ import annotations

import dataclasses
import difflib
import importlib.util
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro
from tyro.conf import Positional, arg

from edqn_jax.cli.help import (
    ABOUT,
    COMPLETION,
    EVALUATE,
    EVENTS,
    EXPORT,
    RECORD,
    REPORT,
    TRAIN,
    VERIFY,
    asks_for_help,
    described,
    flag_of,
    show,
    show_train_help,
    with_conditions,
)
from edqn_jax.config import CONDITIONS, FAMILIES, Config
from edqn_jax.config.loading import apply, resolve
from edqn_jax.config.presets import Layer
from edqn_jax.config.rules import check_learns, validate
from edqn_jax.devices.hardware import hardware
from edqn_jax.devices.launch import Distributed
from edqn_jax.errors import ConfigError
from edqn_jax.files import EVENT_FILES, VIDEO
from edqn_jax.policies import function_named, no_run, policy_folder
from edqn_jax.runs.continuation import begun, continued
from edqn_jax.runs.directory import Resume

Point = tuple[float, float, float]

Args = TypeVar("Args")


SHORT_NAMES = {
    "--world": "--world.name",
    "--num-envs": "--train.num-envs",
    "--total-steps": "--train.total-steps",
    "--seed": "--train.seed",
    "--debug": "--train.debug",
}
"""Short names of common options."""


@dataclass(frozen=True)
class TrainOptions:
    preset: Literal["default", "paper"] = "default"
    """`default`: the best agent known to us. `paper`: exactly Table 1 of the paper."""
    tuned_for: Literal["auto", "cpu", "gpu"] = "auto"
    """Hardware that environments, batches, networks and decisions are chosen for; `auto`: a GPU where a card and JAX's
    plugin for it are found. The preset `paper` is the same on both."""
    config: Annotated[Path | None, arg(metavar="FILE.yaml", help_behavior_hint="")] = None
    """YAML file of options by group; overrides the preset, and flags override the file."""
    seeds: Annotated[int | None, arg(metavar="K", help_behavior_hint="")] = None
    """Train K policies, of the seeds from --seed on, side by side in one program; each gets a folder `seed-N` in the
    folder of the run, whose summary has every seed's success and their interquartile mean."""
    run_dir: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder for the files of the run (default: a new, dated folder under runs/)."""
    resume: Resume = "auto"
    """What to do with a run in --run-dir: `auto` continues it from its newest checkpoint, `must` refuses to begin one,
    `never` starts an unfinished one over. A run goes on with its own options; those that are given must be the same,
    but for --total-steps, which may be more."""
    track: Annotated[tuple[Literal["tensorboard", "wandb"], ...], arg(help_behavior_hint="")] = ()
    """Also write the metrics for TensorBoard, or for Weights & Biases offline, or both, into the folder of the run
    (extra `track`)."""
    view: Annotated[Literal["rerun"] | None, arg(help_behavior_hint="")] = None
    """Also write metrics and validation flights as `training.rrd` into the folder of the run and, where there is a
    screen, show them live in the Rerun viewer (extra `viz`)."""
    distributed: Distributed = "auto"
    """Whether to train together with other processes, on one host or many: `auto` where --coordinator-address is given
    or Slurm's srun has started several tasks, `must` in any cluster that JAX finds, `never` not at all."""
    coordinator_address: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="")] = None
    """Address of process 0. Give this and the next two options to every process."""
    num_processes: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Number of processes that train together."""
    process_id: Annotated[int | None, arg(metavar="I", help_behavior_hint="")] = None
    """Number of this process, from 0; process 0 writes the run directory."""


@dataclass(frozen=True)
class TrainCommand:
    """Train a drone to fly from events, evaluate it and draw figures."""

    options: Annotated[TrainOptions, arg(name="")] = field(default_factory=TrainOptions)
    config: Annotated[Config, arg(name="")] = field(default_factory=Config)


@dataclass(frozen=True)
class EvaluateArgs:
    """Fly a policy on missions in any world and print metrics."""

    run: Annotated[Positional[Path], arg(metavar="POLICY")]
    """Folder of a run, or `pretrained`: the policy that comes with the package; or any function of your own, as
    `module:name` or `path/to/file.py:name`."""
    world: Annotated[str | None, arg(metavar="WORLD", help_behavior_hint="")] = None
    """Where to fly: `paper`, an MJCF file, or test worlds of a family (default: where training was)."""
    start: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Start of every mission, metres (default: the world's; random free ones with --missions)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal of every mission, metres (default: the world's; random free ones on random worlds)."""
    missions: Annotated[int, arg(metavar="N")] = 1
    """Number of missions."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of the missions."""
    shuffle_codes: Annotated[bool, arg(help_behavior_hint="")] = False
    """Give each drone the events of another one at each decision, which measures how much the policy depends on its
    events. For other sensors, permutes that observation."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write the metrics as JSON."""
    trajectories: Annotated[Path | None, arg(metavar="FILE.npz", help_behavior_hint="")] = None
    """Also write every flight, one pose per physics step."""
    conditions: Annotated[Layer, tyro.conf.Fixed] = field(default_factory=dict)
    """Options of `config.CONDITIONS` in place of the policy's own."""


@dataclass(frozen=True)
class RecordArgs:
    """Fly a policy once and write the flight as a GIF or MP4, or the events of a camera that watches it."""

    run: Annotated[Positional[Path], arg(metavar="POLICY")]
    """Folder of a run, or `pretrained`: the policy that comes with the package; or any function of your own, as
    `module:name` or `path/to/file.py:name`."""
    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """What to write; it replaces a file of that name. FILE.gif or .mp4 (extra `video`): the view, what the drone sees,
    and its path. FILE.h5, .npz or .txt (extra `events`): the events of a camera with a frame at every physics step."""
    size: Annotated[tuple[int, int] | None, arg(metavar="W H", help_behavior_hint="")] = None
    """Pixels across and down of the camera whose events are written (default: those of the policy's)."""
    world: Annotated[str | None, arg(metavar="WORLD", help_behavior_hint="")] = None
    """Where to fly: `paper`, an MJCF file, or a family of random worlds (default: that of the run's last flight)."""
    start: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Start of the flight, metres (default: the world's)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal of the flight, metres (default: the world's)."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Number of the test world of a family; elsewhere it only changes the sensor's noise."""


@dataclass(frozen=True)
class VerifyArgs:
    """Verify a finished run: derive its summary from its raw files, fly its flights again, have C MuJoCo judge them."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of the run, or of the runs of several seeds."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write what was found as JSON."""


@dataclass(frozen=True)
class ReportArgs:
    """Write one HTML file with runs' flights in 3D, what the drone saw, curves, figures and options."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN [RUN ...]", help_behavior_hint="")]
    """Folders of runs, or `pretrained`; the folder of several seeds stands for the run of each seed. Or functions of
    your own, as `module:name` or `path/to/file.py:name`."""
    out: Annotated[Path | None, arg(metavar="FILE.html", help_behavior_hint="")] = None
    """HTML file to write; it replaces a file of that name (default: report.html in the first run's folder, of
    `pretrained` in the current one)."""
    missions: Annotated[int, arg(metavar="N")] = 128
    """Evaluation flights of each run at most; of all runs together at most 256."""


@dataclass(frozen=True)
class ExportArgs:
    """Write a policy as ONNX, for a computer without JAX, and beside it the runner that flies it; compare both."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of the run, or `pretrained`: the policy that comes with the package."""
    out: Annotated[Path, arg(metavar="FILE.onnx")]
    """File to write; it replaces one of that name."""
    checks: Annotated[int, arg(metavar="N")] = 1000
    """Random inputs on which ONNX and JAX must choose the same moves, with values that agree to 1e-5 of the largest."""


@dataclass(frozen=True)
class EventsArgs:
    """Say what a file of events holds; see it as a policy does; write it in another form."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """HDF5 in DSEC's layout (.h5, .hdf5), NumPy (.npz), text (.txt, .csv), or a camera's own file: .aedat4, .raw (EVT2,
    EVT3), .dat, .es."""
    size: Annotated[tuple[int, int] | None, arg(metavar="W H", help_behavior_hint="")] = None
    """Pixels across and down, where the file does not say (default: what the file says)."""
    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, arg(help_behavior_hint="")] = None
    """Unit of the times, where the file does not say (default: the only plausible one)."""
    columns: Annotated[str | None, arg(metavar="t,x,y,p", help_behavior_hint="")] = None
    """Order of a text's columns, where no line names them (default: t,x,y,p, refused where another order fits)."""
    stream: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Which stream of events of an .aedat4 that has several, such as those of two cameras."""
    start: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """Leave out what is before this, seconds from the first event."""
    stop: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """Leave out what is from this on, seconds from the first event."""
    policy: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint="")] = None
    """Run, or `pretrained`, at whose resolution and in whose windows the events are shown, and which encodes them."""
    contrast: Annotated[float | None, arg(metavar="C", help_behavior_hint="")] = None
    """Change of log brightness that makes an event in the camera (default: that of the policy)."""
    fov: Annotated[float | None, arg(metavar="DEG", help_behavior_hint="")] = None
    """The camera's horizontal field of view, degrees (default: its whole image is taken for the policy's)."""
    velocity: Annotated[Point, arg(metavar="X Y Z")] = (0.0, 0.0, 0.0)
    """Velocity ahead, to the left and up, m/s, where the file has no flight: the encoder reads events with it."""
    yaw_rate: Annotated[float, arg(metavar="R")] = 0.0
    """Yaw rate, rad/s to the left, likewise."""
    window: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """Length of a window in pictures in seconds (default: 0.05, a policy's own with --policy)."""
    picture: Annotated[Path | None, arg(metavar="FILE.png|gif", help_behavior_hint="")] = None
    """Also draw windows: six moments as a .png, or up to 120 as a .gif."""
    out: Annotated[Path | None, arg(metavar="FILE.h5|npz|txt", help_behavior_hint="")] = None
    """Also write the events, from --start to --stop."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write what was found as JSON."""


@dataclass(frozen=True)
class CompletionArgs:
    """Print a script that completes commands, options and their values in a shell."""

    shell: Annotated[Positional[Literal["bash", "zsh", "fish"]], arg(metavar="SHELL")]
    """`bash`, `zsh` or `fish`."""


PROFILE = "--events.profile"


def parse_train(argv: Sequence[str]) -> tuple[TrainOptions, Config]:
    """Returns the options, hardware decided, and the checked configuration of the arguments of `edqn train`.

    Raises:
        ConfigError: if the preset, the file or a value is invalid.
        SystemExit: after printing, for --help, --help-all and for arguments that do not parse.
    """
    check_flags(argv, train_flags(), TRAIN)
    argv = [_long_name(word) for word in argv]
    # Preset, file and world decide the defaults that the other flags change and that --help shows.
    everything = "--help-all" in argv
    helped = everything or asks_for_help(argv)
    argv = [word for word in argv if word not in ("-h", "--help", "--help-all")]
    options, _ = tyro.cli(TrainOptions, args=argv, prog=TRAIN, return_unknown_args=True, add_help=False)
    if options.seeds is not None and options.seeds < 1:
        raise ConfigError(f"--seeds must be at least 1, not {options.seeds}")
    tuned_for = hardware() if options.tuned_for == "auto" else options.tuned_for
    options = dataclasses.replace(options, tuned_for=tuned_for)
    folder = None if options.resume == "never" else options.run_dir
    run = None if folder is None else begun(folder)
    if run is not None and not _names_defaults(argv):
        begins = run.config
    else:
        world = _parse_config(argv, resolve(options.preset, options.config)).world.name
        begins = resolve(options.preset, options.config, world, tuned_for)
    if any(word.partition("=")[0] == PROFILE for word in argv):
        # What else is given changes one of the profile's figures.
        profile = _parse_config(argv, begins).events.profile
        begins = apply(begins, {"events": {"profile": profile}}, "the command line")
    if helped:
        show_train_help(TrainOptions(), begins, SHORT_NAMES, everything=everything)
    config = _found_worlds(_parse_config(argv, begins))
    validate(config)
    check_learns(config)
    if run is not None and folder is not None:
        options = dataclasses.replace(options, seeds=run.seeds if options.seeds is None else options.seeds)
        config = continued(folder, run, config, options.seeds)
    return options, config


def _names_defaults(argv: Sequence[str]) -> bool:
    """Returns whether the words of a command say what options begin with, instead of those of the run."""
    return any(word.partition("=")[0] in ("--preset", "--config", "--tuned-for", "--tuned_for") for word in argv)


def _found_worlds(config: Config) -> Config:
    """Returns the configuration with whole paths of its worlds' files."""
    world = dataclasses.replace(config.world, name=_found(config.world.name), flown=_found(config.world.flown))
    return dataclasses.replace(config, world=world)


def _found(world: str) -> str:
    """Returns the name of a world; of a file, its whole path, by which it is found again from any folder."""
    return str(Path(world).resolve()) if world not in FAMILIES and Path(world).is_file() else world


def check_flags(argv: Sequence[str], known: Iterable[str], command: str) -> None:
    """Raises if a word that begins with `--` is no flag of the command.

    Raises:
        ConfigError: names the flag and the nearest one that there is.
    """
    known = {"--help", *known}
    for word in argv:
        flag = word.partition("=")[0].replace("_", "-")
        if flag.startswith("--") and flag not in known:
            near = _nearest_flag(flag, known)
            every = "--help-all" if "--help-all" in known else "--help"
            hint = f"did you mean '{near}'?" if near else f"'{command} {every}' lists what there is"
            raise ConfigError(f"there is no option '{flag}'; {hint}")


def _nearest_flag(flag: str, known: Iterable[str]) -> str | None:
    """Returns the flag that somebody meant who shortened, misspelt or left out the group of one; None if none is near.

    A flag that goes on as the given one does comes first, then one of that name in a group, then one spelt alike.
    """
    shortest_first = sorted(known, key=lambda name: (len(name), name))
    bare = flag.removeprefix("--")
    for is_meant in (
        lambda name: len(bare) > 1 and name.startswith(flag),
        lambda name: name.endswith(f".{bare}"),
        lambda name: len(bare) > 1 and name.rpartition(".")[2].startswith(bare),
    ):
        meant = [name for name in shortest_first if is_meant(name)]
        if meant:
            return meant[0]
    # Names are compared without dashes, which all have, and also without the group, which may have been left out.
    whole = {name.removeprefix("--"): name for name in shortest_first}
    last = {name.rpartition(".")[2].removeprefix("--"): name for name in reversed(shortest_first)}
    for names, cutoff in ((last, 0.75), (whole, 0.6)):
        close = difflib.get_close_matches(bare, names, n=1, cutoff=cutoff)
        if close:
            return names[close[0]]
    return None


def train_flags() -> set[str]:
    """Returns every flag of `edqn train`."""
    flags = {flag_of(option.name) for option in dataclasses.fields(TrainOptions)} | set(SHORT_NAMES) | {"--help-all"}
    for group in dataclasses.fields(Config):
        names = [option.name for option in dataclasses.fields(getattr(Config(), group.name))]
        flags |= {flag for flag, _ in _named_by(group.name, names)}
    return flags


def _named_by(group: str, names: Iterable[str]) -> list[tuple[str, str]]:
    """Returns every flag of a group's options of these names, and which of the options it gives."""
    kinds = {option.name: option.type for option in dataclasses.fields(getattr(Config(), group))}
    return [
        (f"--{group}.{no}{name.replace('_', '-')}", name)
        for name in names
        for no in (("", "no-") if kinds[name] == "bool" else ("",))
    ]


def _flags_of(kind: type) -> set[str]:
    """Returns every flag of a dataclass of arguments."""
    return {
        flag_of(f"{no}{option.name}")
        for option in dataclasses.fields(kind)
        if "tyro.conf.Fixed" not in str(option.type)
        for no in (("", "no_") if option.type == "bool" else ("",))
    }


def _long_name(word: str) -> str:
    name, equals, value = word.partition("=")
    return SHORT_NAMES.get(name.replace("_", "-"), name) + equals + value


def _parse_config(argv: Sequence[str], base: Config) -> Config:
    return tyro.cli(TrainCommand, args=argv, prog=TRAIN, default=TrainCommand(config=base)).config


def _parsed(kind: type[Args], argv: Sequence[str], command: str) -> Args:
    """Returns the arguments of a command.

    Raises:
        ConfigError: if there is no such flag.
        SystemExit: after printing, for --help and for arguments that do not parse.
    """
    check_flags(argv, _flags_of(kind), command)
    if asks_for_help(argv):
        show(described(kind), command, ABOUT[command])
    return tyro.cli(kind, args=argv, prog=command)


def parse_evaluate(argv: Sequence[str]) -> EvaluateArgs:
    """Returns the checked arguments of `edqn evaluate`.

    Raises:
        ConfigError: if one is out of its limits, or there is no such run.
        SystemExit: after printing, for --help and for arguments that do not parse.
    """
    kind = with_conditions(described(EvaluateArgs), CONDITIONS)
    flags = {flag: (group, option) for group, names in CONDITIONS.items() for flag, option in _named_by(group, names)}
    check_flags(argv, _flags_of(EvaluateArgs) | set(flags), EVALUATE)
    if asks_for_help(argv):
        show(kind, EVALUATE, ABOUT[EVALUATE])
    parsed: Any = tyro.cli(kind, args=argv, prog=EVALUATE)
    conditions: dict[str, dict[str, Any]] = {}
    for word in argv:
        group, option = flags.get(word.partition("=")[0].replace("_", "-"), ("", ""))
        if group:
            conditions.setdefault(group, {})[option] = getattr(getattr(parsed, group), option)
    own = {name: value for name, value in vars(parsed).items() if name not in CONDITIONS}
    args = EvaluateArgs(**own, conditions=conditions)
    if args.missions < 1:
        raise ConfigError(f"--missions must be at least 1, not {args.missions}")
    _check_run(args.run)
    return args


def parse_record(argv: Sequence[str]) -> RecordArgs:
    """Returns the checked arguments of `edqn record`.

    Raises:
        ConfigError: if the file's ending, its size or a missing package forbids it, or there is no run.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = _parsed(RecordArgs, argv, RECORD)
    suffix = args.file.suffix.lower()
    if suffix not in VIDEO + EVENT_FILES:
        raise ConfigError(f"'{args.file}' must end in .gif or .mp4 for a video, or in .h5, .npz or .txt for events")
    if args.size is not None and suffix in VIDEO:
        raise ConfigError(f"--size is only for files of events, and '{args.file}' is a video")
    if args.size is not None and min(args.size) < 1:
        raise ConfigError(f"--size must be two whole numbers of at least 1, not {args.size[0]} {args.size[1]}")
    if suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ConfigError("an .mp4 needs imageio_ffmpeg; run pip install 'edqn-jax[video]', or write a .gif")
    _check_run(args.run)
    return args


def parse_verify(argv: Sequence[str]) -> VerifyArgs:
    """Returns the arguments of `edqn verify`.

    Raises:
        ConfigError: if there is no run.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = _parsed(VerifyArgs, argv, VERIFY)
    _check_is_saved(args.run, VERIFY)
    if not (args.run / "config.yaml").is_file():
        raise no_run(args.run)
    return args


def parse_report(argv: Sequence[str]) -> ReportArgs:
    """Returns the checked arguments of `edqn report`.

    Raises:
        ConfigError: if a folder holds no run, or another argument is out of its limits.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = _parsed(ReportArgs, argv, REPORT)
    if not args.runs:
        raise ConfigError("give the folder of a run, such as edqn report runs/DIR")
    if args.missions < 1:
        raise ConfigError(f"--missions must be at least 1, not {args.missions}")
    for run in args.runs:
        _check_run(run)
    first = args.runs[0] / "report.html"
    out = args.out or (first if args.runs[0].is_dir() else Path("report.html"))
    if out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"--out '{out}' must end in .html")
    return dataclasses.replace(args, out=out)


def parse_export(argv: Sequence[str]) -> ExportArgs:
    """Returns the checked arguments of `edqn export`.

    Raises:
        ConfigError: if one is out of its limits, or there is no such run.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = _parsed(ExportArgs, argv, EXPORT)
    if args.checks < 1000:
        raise ConfigError(f"--checks must be at least 1000, not {args.checks}")
    _check_is_saved(args.run, EXPORT)
    _check_run(args.run)
    return args


def parse_events(argv: Sequence[str]) -> EventsArgs:
    """Returns the checked arguments of `edqn events`.

    Raises:
        ConfigError: if one is out of its limits, or there is no such file or policy.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = _parsed(EventsArgs, argv, EVENTS)
    if args.file.is_dir():
        raise ConfigError(f"'{args.file}' is a folder; give a file of events")
    if not args.file.is_file():
        raise ConfigError(f"there is no file '{args.file}'")
    for name, number in (("--contrast", args.contrast), ("--window", args.window)):
        if number is not None and not number > 0.0:
            raise ConfigError(f"{name} must be above 0, not {number}")
    if args.window is not None and args.policy is not None:
        raise ConfigError("--window and --policy cannot both be given: a policy has a window of its own")
    if args.picture is not None and args.picture.suffix.lower() not in (".png", ".gif"):
        raise ConfigError(f"'{args.picture}' must end in .png or .gif")
    if args.policy is not None:
        _check_is_saved(args.policy, "--policy")
        _check_run(args.policy)
    return args


def parse_completion(argv: Sequence[str]) -> CompletionArgs:
    """Returns the arguments of `edqn completion`.

    Raises:
        ConfigError: if there is no such flag.
        SystemExit: after printing, for --help and for what does not parse.
    """
    return _parsed(CompletionArgs, argv, COMPLETION)


def _check_is_saved(run: Path, what: str) -> None:
    """Raises ConfigError if `run` names a function."""
    if function_named(run) is not None:
        raise ConfigError(f"'{what}' needs a saved policy, with its parameters, and '{run}' is a function")


def _check_run(folder: Path) -> None:
    named = function_named(folder)
    if named is not None:
        if named[0].endswith(".py") and not Path(named[0]).is_file():
            raise ConfigError(f"there is no file '{named[0]}'")
        return
    if not (policy_folder(folder) / "config.yaml").is_file():
        raise no_run(folder)
