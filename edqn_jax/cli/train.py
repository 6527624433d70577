"""`edqn train`: from arguments to a trained, flown and drawn run."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from edqn_jax.cli.arguments import TrainOptions, parse_train
from edqn_jax.cli.signals import Stops
from edqn_jax.cli.variables import check_devices, platforms_named, start_jax
from edqn_jax.config import FAMILIES, Config
from edqn_jax.config.loading import gpu_layers, to_yaml
from edqn_jax.devices.launch import how_to_join
from edqn_jax.errors import ConfigError
from edqn_jax.extras import SINKS
from edqn_jax.runs.directory import RunDirectory, plan_run_directory

if TYPE_CHECKING:
    from edqn_jax.interop import tracking


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

    start_jax(alone=arguments is None)

    import jax

    from edqn_jax.devices import memory, processes
    from edqn_jax.devices.cache import keep_programs
    from edqn_jax.devices.devices import most_that_divide, use_cpu_devices
    from edqn_jax.devices.hardware import cores
    from edqn_jax.report.gallery import prepare_gallery
    from edqn_jax.report.progress import Progress
    from edqn_jax.runs.stopping import Stop

    most = 1 if config.train.debug else most_that_divide(config.train.shards, cores())
    use_cpu_devices(config.train.devices or most)
    if arguments is None:  # of several processes only the first could keep any
        keep_programs()
    process = 0
    if arguments is not None:
        print("edqn: waiting for the other processes, five minutes at most", file=sys.stderr)
        with platforms_named():
            process = processes.join(arguments)
    check_devices()
    processes.together(lambda: _check_gpu() if tuned_for_gpu(options, config) else None)
    processes.check_alike(processes.together(lambda: options_to_compare(config)))
    writes = process == 0
    run = processes.together(lambda: plan_run_directory(options.run_dir, config, options.resume) if writes else None)
    progress = Progress(Console(quiet=not writes))
    if tuned_for_gpu(options, config):
        progress.message(_chosen(config))
    sinks = None if run is None else _sinks_of(options, config, run, progress.message)
    stop = Stop(stops.requested, lambda: stops.obeyed(progress.message))
    try:
        from edqn_jax.runs.record import train_run

        train_run(config, run, progress, stop, callback=sinks, drawing=prepare_gallery, seeds=options.seeds)
    except jax.errors.JaxRuntimeError as error:
        if arguments is None:
            raise
        processes.leave(error, memory.memory_error(error, "train"))
    finally:
        if sinks is not None:
            sinks.close()
        progress.stop()


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


def tuned_for_gpu(options: TrainOptions, config: Config) -> bool:
    """Returns whether defaults were chosen for a GPU."""
    return options.preset == "default" and bool(gpu_layers(config.world.name, options.tuned_for))


def options_to_compare(config: Config) -> str:
    """Returns what processes must have alike: all options, and in place of a world file's path what it holds.

    Also whether their devices draw in C, since all must run the same program.

    Raises:
        ConfigError: if there is no such file, or it cannot be read.
    """
    import jax

    from edqn_jax.sim.camera.camera import native

    world = dataclasses.replace(config.world, name=_held(config.world.name), flown=_held(config.world.flown))
    in_c = native.is_at_hand("cpu" if jax.default_backend() == "cpu" else "cuda")
    return f"{to_yaml(dataclasses.replace(config, world=world))}in_c: {in_c}\n"


def _held(world: str) -> str:
    """Returns the name of a random world or of none, and of a file the SHA-256 of what it holds.

    Raises:
        ConfigError: as `options_to_compare`.
    """
    from edqn_jax.sim.scene.mjcf import resolve_world

    if not world or world in FAMILIES:
        return world
    file = resolve_world(world)
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
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


def _chosen(config: Config) -> str:
    """Returns what was chosen for a GPU, as a line for the screen."""
    train, agent = config.train, config.agent
    return (
        f"Tuned for a GPU: {train.num_envs:,} environments, {agent.updates_per_step} updates of {agent.batch_size:,} "
        f"a step, a replay of {agent.replay_size:,}, {train.total_steps:,} decisions; flags override any of them"
    )
