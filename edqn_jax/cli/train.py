"""`edqn train`: its arguments, and from them to a trained, flown and drawn run."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console
from tyro.conf import arg

from edqn_jax.cli.arguments import check_flags, flags_of_group
from edqn_jax.cli.help import TRAIN, asks_for_help, flag_of, show_train_help
from edqn_jax.cli.process.parsing import parse_or_say
from edqn_jax.cli.process.signals import Stops
from edqn_jax.cli.process.status import BEGAN, end_status, last_time, show_phase
from edqn_jax.cli.process.variables import check_devices, platforms_named, start_jax
from edqn_jax.config import FAMILIES, Config
from edqn_jax.config.loading import apply_layer, load_layer, resolve_config, to_yaml
from edqn_jax.config.presets import gpu_layers
from edqn_jax.config.rules import check_learns, validate
from edqn_jax.devices.hardware import detect_hardware
from edqn_jax.devices.launch import Distributed, how_to_join
from edqn_jax.errors import ConfigError
from edqn_jax.extras import SINKS
from edqn_jax.policies import no_run, policy_folder
from edqn_jax.runs.continuation import find_run, resume_config
from edqn_jax.runs.directory import Resume, RunDirectory, plan_run_directory

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from edqn_jax.interop import tracking
    from edqn_jax.learn.policy import Policy
    from edqn_jax.runs.record import Draw
    from edqn_jax.sim.scene.scene import Scene
    from edqn_jax.training.progress import Progress


SHORT_NAMES = {
    "--world": "--world.name",
    "--num-envs": "--train.num-envs",
    "--total-steps": "--train.total-steps",
    "--seed": "--train.seed",
    "--learner": "--agent.learner",
    "--debug": "--train.debug",
}
"""Short names of common options."""

PROFILE = "--events.profile"


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
    start_from: Annotated[Path | None, arg(metavar="POLICY", help_behavior_hint="")] = None
    """Begin with the networks of a policy: the folder of a run, or one of the package, such as `pretrained-looks`.
    Camera, sensor, encoder and network are then its own, the encoder learns no more unless `encoder.warmup_decisions`
    says so, and a tenth of the moves are random at first."""
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
class _Named:
    """A world's name, alone among all options: they take a third of a second to be read."""

    name: str


@dataclass(frozen=True)
class _World:
    world: _Named


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
    options, _ = parse_or_say(
        lambda: tyro.cli(TrainOptions, args=argv, prog=TRAIN, return_unknown_args=True, add_help=False), TRAIN
    )
    if options.seeds is not None and options.seeds < 1:
        raise ConfigError(f"--seeds must be at least 1, not {options.seeds}")
    tuned_for = detect_hardware() if options.tuned_for == "auto" else options.tuned_for
    options = dataclasses.replace(options, tuned_for=tuned_for)
    folder = None if options.resume == "never" else options.run_dir
    run = None if folder is None else find_run(folder)
    if run is not None and not _names_defaults(argv):
        begins = run.config
    else:
        world = _parse_world(argv, resolve_config(options.preset, options.config).world.name)
        begins = resolve_config(options.preset, options.config, world, tuned_for)
    if options.start_from is not None:
        begins = begin_with(begins, options.start_from)
    if any(word.partition("=")[0] == PROFILE for word in argv):
        # What else is given changes one of the profile's figures.
        profile = _parse_config(argv, begins).events.profile
        begins = apply_layer(begins, {"events": {"profile": profile}}, "the command line")
    if helped:
        show_train_help(TrainOptions(), begins, SHORT_NAMES, everything=everything)
    config = _with_whole_paths(_parse_config(argv, begins))
    validate(config)
    check_learns(config)
    if run is not None and folder is not None:
        options = dataclasses.replace(options, seeds=run.seeds if options.seeds is None else options.seeds)
        config = resume_config(folder, run, config, options.seeds)
    return options, config


def begin_with(config: Config, policy: Path) -> Config:
    """Returns options with those of a policy that its networks depend on.

    Raises:
        ConfigError: if there is no such policy.
    """
    file = policy_folder(policy) / "config.yaml"
    if not file.is_file():
        raise no_run(file.parent)
    known = apply_layer(Config(), load_layer(file), str(file))
    task, learns = dataclasses.asdict(known), ("warmup_decisions", "retrain_at", "batch_size", "replay_size")
    layer = {group: task[group] for group in ("camera", "surface", "events", "exposure", "light")}
    layer["env"] = {name: task["env"][name] for name in ("sensor", "actions", "position", "heading")}
    layer["encoder"] = {name: value for name, value in task["encoder"].items() if name not in learns}
    layer["encoder"] |= {"warmup_decisions": 0, "retrain_at": ()}
    names = ("network", "hidden", "history", "last_move", "code_scale", "layer_norm", "dueling")
    layer["agent"] = {name: task["agent"][name] for name in names} | {"exploration_start": 0.1}
    return apply_layer(config, layer, f"the policy '{policy}'")


def _names_defaults(argv: Sequence[str]) -> bool:
    """Returns whether the words of a command say what options begin with, instead of those of the run."""
    return any(word.partition("=")[0] in ("--preset", "--config", "--tuned-for", "--tuned_for") for word in argv)


def _with_whole_paths(config: Config) -> Config:
    """Returns the configuration with whole paths of its worlds' files and its teacher's folder."""
    world = dataclasses.replace(
        config.world, name=_find_world(config.world.name), flown=_find_world(config.world.flown)
    )
    teacher = config.imitation.teacher
    if teacher and Path(teacher).is_dir():
        teacher = str(Path(teacher).resolve())
    return dataclasses.replace(config, world=world, imitation=dataclasses.replace(config.imitation, teacher=teacher))


def _find_world(world: str) -> str:
    """Returns the name of a world; of a file, its whole path, by which it is found again from any folder."""
    return str(Path(world).resolve()) if world not in FAMILIES and Path(world).is_file() else world


def train_flags() -> set[str]:
    """Returns every flag of `edqn train`."""
    flags = {flag_of(option.name) for option in dataclasses.fields(TrainOptions)} | set(SHORT_NAMES) | {"--help-all"}
    for group in dataclasses.fields(Config):
        names = [option.name for option in dataclasses.fields(getattr(Config(), group.name))]
        flags |= {flag for flag, _ in flags_of_group(group.name, names)}
    return flags


def _long_name(word: str) -> str:
    name, equals, value = word.partition("=")
    return SHORT_NAMES.get(name.replace("_", "-"), name) + equals + value


def _parse_config(argv: Sequence[str], base: Config) -> Config:
    begins = TrainCommand(config=base)
    return parse_or_say(lambda: tyro.cli(TrainCommand, args=argv, prog=TRAIN, default=begins), TRAIN).config


def _parse_world(argv: Sequence[str], default: str) -> str:
    named = _World(_Named(default))
    parse = partial(tyro.cli, _World, args=argv, prog=TRAIN, default=named, return_unknown_args=True, add_help=False)
    return parse_or_say(parse, TRAIN)[0].world.name


def _prepare_gallery(config: Config, scene: Scene, pool: Executor) -> Draw:
    """Does `report.gallery.prepare_gallery`, whose imports take a second, once there is something to draw."""
    from edqn_jax.report.gallery import prepare_gallery

    return prepare_gallery(config, scene, pool)


def train_command(argv: Sequence[str], stops: Stops) -> None:
    """Runs `edqn train` with these arguments.

    Raises:
        ConfigError: if the input is invalid.
        DivergedError, StoppedError: as `training.train`.
    """
    options, config = parse_train(argv)
    _check_sinks(options)
    several = options.coordinator_address, options.num_processes, options.process_id
    arguments = how_to_join(options.distributed, *several, os.environ)

    show_phase("starting JAX")
    start_jax(alone=arguments is None)

    import jax

    from edqn_jax.devices import memory, processes
    from edqn_jax.devices.cache import enable_compilation_cache
    from edqn_jax.devices.devices import most_that_divide, use_cpu_devices
    from edqn_jax.devices.hardware import count_cores
    from edqn_jax.runs.policies import load_policy
    from edqn_jax.runs.stopping import Stop

    most = 1 if config.train.debug else most_that_divide(config.train.shards, count_cores())
    use_cpu_devices(config.train.devices or most)
    if arguments is None:  # of several processes only the first could keep any
        enable_compilation_cache()
    process = 0
    if arguments is not None:
        print("edqn: waiting for the other processes, five minutes at most", file=sys.stderr)
        with platforms_named():
            process = processes.join_cluster(arguments)
    check_devices()
    processes.run_synchronised(lambda: _check_gpu() if is_tuned_for_gpu(options, config) else None)
    processes.check_equal(processes.run_synchronised(lambda: options_to_compare(config)))
    writes = process == 0
    run = processes.run_synchronised(
        lambda: plan_run_directory(options.run_dir, config, options.resume) if writes else None
    )
    progress = _open_progress(writes)
    if is_tuned_for_gpu(options, config):
        progress.message(_describe_choice(config))
    start = None if options.start_from is None else load_policy(options.start_from)
    for warning in _warnings(config, start) if writes else ():
        progress.message(warning)
    sinks = None if run is None else _sinks_of(options, config, run, progress.message)
    stop = Stop(stops.is_requested, lambda: stops.obey_signals(progress.message))
    try:
        from edqn_jax.runs.record import train_run

        others = {"drawing": _prepare_gallery, "seeds": options.seeds, "start": start}
        train_run(config, run, progress, stop, callback=sinks, **others)
    except jax.errors.JaxRuntimeError as error:
        if arguments is None:
            raise
        processes.abort_process(error, memory.memory_error(error, "train"))
    finally:
        if sinks is not None:
            sinks.close()
        progress.stop()


def _open_progress(writes: bool) -> Progress:
    """Returns what shows the progress of a run, in place of the status where that is a panel with clocks of its own."""
    from edqn_jax.training.progress import Progress
    from edqn_jax.watchers import has_panel

    console = Console(quiet=not writes)

    def tell(name: str, done: int = 0, total: int = 0) -> None:
        if has_panel(console):
            end_status()
        show_phase(name, done, total)

    return Progress(console, tell=tell, began=BEGAN, last_time=last_time)


def _warnings(config: Config, start: Policy | None) -> tuple[str, ...]:
    """Returns what is worth saying of the world of a training, and of what the policy that it begins with never met."""
    from edqn_jax.evaluation.world_check import warn_of_training
    from edqn_jax.policies.unseen import describe_unseen

    if start is None:
        return (*_idle_cores(config), *warn_of_training(config))
    unseen = describe_unseen(start.config, config)
    return (*_idle_cores(config), *warn_of_training(config, start.config), *unseen)


def _idle_cores(config: Config) -> tuple[str, ...]:
    """Returns what to do about CPU cores that the run leaves idle, where nobody said how many it is to use."""
    import jax

    from edqn_jax.devices.devices import describe_idle_cores
    from edqn_jax.devices.hardware import count_cores

    train = config.train
    if train.debug or train.devices or jax.default_backend() != "cpu" or jax.process_count() > 1:
        return ()
    batches = train.num_envs // config.env.drones, config.agent.batch_size, config.encoder.batch_size
    said = describe_idle_cores(train.shards, batches, count_cores())
    return (said,) if said else ()


def _check_sinks(options: TrainOptions) -> None:
    """Raises if a package that `--track` or `--view` needs is not installed.

    Raises:
        ConfigError: names the command that installs it.
    """
    for flag, names in (("--track", options.track), ("--view", (options.view,) if options.view else ())):
        for name in names:
            package, extra = SINKS[name]
            if importlib.util.find_spec(package) is None:
                raise ConfigError(f"{flag} {name} needs {package}; run pip install 'edqn-jax[{extra}]'")


def _sinks_of(
    options: TrainOptions, config: Config, run: RunDirectory, warn: Callable[[str], None]
) -> tracking.Sinks | None:
    """Returns what else gets the metrics of a run, in the folder of each agent; None if nothing was asked for."""
    if not options.track and options.view is None:
        return None

    from edqn_jax.interop import tracking

    def folder(agent: int) -> Path:
        return run.path if options.seeds is None else run.of_seed(config.train.seed + agent).path

    def wandb(agent: int) -> tracking.Wandb:
        train = dataclasses.replace(config.train, seed=config.train.seed + agent)
        name = run.path.name if options.seeds is None else f"{run.path.name}/{folder(agent).name}"
        return tracking.Wandb(folder(agent), dataclasses.replace(config, train=train), name)

    makers: dict[str, tracking.Maker] = {
        "tensorboard": lambda agent: tracking.TensorBoard(folder(agent) / "tensorboard"),
        "wandb": wandb,
        "rerun": lambda agent: tracking.Rerun(folder(agent) / "training.rrd"),
    }
    asked = {*options.track, options.view}
    return tracking.Sinks({name: maker for name, maker in makers.items() if name in asked}, warn)


def is_tuned_for_gpu(options: TrainOptions, config: Config) -> bool:
    """Returns whether defaults were chosen for a GPU."""
    return options.preset == "default" and bool(gpu_layers(config.world.name, options.tuned_for))


def options_to_compare(config: Config) -> str:
    """Returns what processes must have alike: all options, and in place of a world file's path what it holds.

    Of several also whether their devices draw in C, since all must run the same program; one alone need not wait for
    the compiler to know.

    Raises:
        ConfigError: if there is no such file, or it cannot be read.
    """
    import jax

    from edqn_jax.sim.camera.camera import native

    world = dataclasses.replace(
        config.world, name=_world_digest(config.world.name), flown=_world_digest(config.world.flown)
    )
    platform = "cpu" if jax.default_backend() == "cpu" else "cuda"
    in_c = jax.process_count() == 1 or native.is_available(platform)
    return f"{to_yaml(dataclasses.replace(config, world=world))}in_c: {in_c}\n"


def _world_digest(world: str) -> str:
    """Returns the name of a random world or of none, and of a file the SHA-256 of what it holds.

    Raises:
        ConfigError: as `options_to_compare`.
    """
    from edqn_jax.sim.scene.mjcf import resolve_world
    from edqn_jax.sim.scene.mjcf_parts.files import self_contained_bytes

    if not world or world in FAMILIES:
        return world
    file = resolve_world(world)
    try:
        return hashlib.sha256(self_contained_bytes(file)).hexdigest()
    except OSError as error:
        raise ConfigError(f"cannot read the world '{file}': {error.strerror}") from None


def _check_gpu() -> None:
    """Raises where a GPU was found or asked for, and JAX runs on the CPU.

    Raises:
        ConfigError: says what to do.
    """
    import jax

    if jax.default_backend() == "cpu":
        hidden = os.environ.get("CUDA_VISIBLE_DEVICES")
        hides = "" if hidden is None else f" with CUDA_VISIBLE_DEVICES='{hidden}'"
        raise ConfigError(
            f"the options are tuned for a GPU, but JAX can use none here{hides}; install its plugin with "
            "pip install 'jax[cuda13]', or give --tuned-for cpu"
        )


def _describe_choice(config: Config) -> str:
    """Returns what was chosen for a GPU, as a line for the screen."""
    train, agent = config.train, config.agent
    return (
        f"Tuned for a GPU: {train.num_envs:,} environments, {agent.updates_per_step} updates of {agent.batch_size:,} "
        f"a step, a replay of {agent.replay_size:,}, {train.total_steps:,} decisions; flags override any of them"
    )
