"""Dispatch of `edqn`'s commands, and exit codes."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from importlib import metadata

import tyro

from edqn_jax.cli.check import CheckArgs, check_command, parse_check
from edqn_jax.cli.completion import CompletionArgs, completion_script, parse_completion
from edqn_jax.cli.evaluate import EvaluateArgs, evaluate_command, parse_evaluate
from edqn_jax.cli.events import EventsArgs, events_command, parse_events
from edqn_jax.cli.export import ExportArgs, export_command, parse_export
from edqn_jax.cli.fly import FlyArgs, fly_command, parse_fly
from edqn_jax.cli.help import ABOUT
from edqn_jax.cli.process.signals import Stops
from edqn_jax.cli.process.status import show_phase
from edqn_jax.cli.process.variables import check_devices, start_jax
from edqn_jax.cli.record import RecordArgs, parse_record, record_command
from edqn_jax.cli.report import ReportArgs, parse_report, report_command
from edqn_jax.cli.train import TrainCommand, train_command
from edqn_jax.cli.verify import VerifyArgs, parse_verify, verify_command
from edqn_jax.cli.world import WorldArgs, parse_world, world_command
from edqn_jax.errors import CheckError, ConfigError, DivergedError, StoppedError, error_sentence, suggest_nearest
from edqn_jax.extras import MissingPackageError
from edqn_jax.native.shipped import describe_library
from edqn_jax.user_code import IMPORTED, load_module
from edqn_jax.version import package_version

DONE = 0
FAILED = 1
BAD_INPUT = 2
DIVERGED = 3
BY_SIGNAL = 128
"""What the number of a signal is added to: 130 for SIGINT, 143 for SIGTERM."""

COMMANDS = {
    "train": TrainCommand,
    "evaluate": EvaluateArgs,
    "world": WorldArgs,
    "check": CheckArgs,
    "record": RecordArgs,
    "report": ReportArgs,
    "verify": VerifyArgs,
    "export": ExportArgs,
    "events": EventsArgs,
    "fly": FlyArgs,
    "completion": CompletionArgs,
}

IMPORT = "--import"
"""Option of every command: what to import first."""

VERSIONS = ("jax", "mujoco", "mujoco-mjx")
"""Packages whose versions `edqn --version` names below its own."""

RUN_COMMANDS = {
    "evaluate": (parse_evaluate, evaluate_command),
    "world": (parse_world, world_command),
    "check": (parse_check, check_command),
    "record": (parse_record, record_command),
    "report": (parse_report, report_command),
    "verify": (parse_verify, verify_command),
    "export": (parse_export, export_command),
    "events": (parse_events, events_command),
}
"""Commands on a finished run, a world or a file: what parses their arguments, without JAX, and what runs them."""


def run_command(argv: Sequence[str], stops: Stops) -> int:
    """Runs one command and returns its exit code.

    0 is done, 1 a check failed, 2 bad input, 3 diverged, 130 stopped by SIGINT, and 143 by SIGTERM.
    """
    IMPORTED.clear()
    return _exit_code_of(list(argv), stops)


def _exit_code_of(argv: list[str], stops: Stops) -> int:
    """Runs one command and returns the exit code of its ending."""
    try:
        return _dispatch(argv, stops)
    except SystemExit as ending:  # tyro has printed the help, or what is wrong
        return int(ending.code or DONE)
    except MissingPackageError as missing:
        print(f"edqn: {error_sentence(missing)}", file=sys.stderr)
        return BAD_INPUT
    except (CheckError, ConfigError, DivergedError, StoppedError) as ending:
        print(f"edqn: {error_sentence(ending)}", file=sys.stderr)
        if isinstance(ending, StoppedError):  # by a signal to this process, or to another of the cluster
            return BY_SIGNAL + (stops.number or signal.SIGTERM)
        if isinstance(ending, CheckError):
            return FAILED
        return BAD_INPUT if isinstance(ending, ConfigError) else DIVERGED
    except (MemoryError, RuntimeError) as error:
        from edqn_jax.devices.memory import memory_error

        if (full := memory_error(error, argv[0])) is None:
            raise
        print(f"edqn: {error_sentence(full)}", file=sys.stderr)
        return BAD_INPUT


def _dispatch(argv: Sequence[str], stops: Stops) -> int:
    argv, modules = take_imports(argv)
    for module in modules:
        import_module_or_file(module)
    command, rest = argv[0] if argv else "--help", argv[1:]
    if command == "train":
        train_command(rest, stops)
    elif command in RUN_COMMANDS:
        _dispatch_run_command(command, rest)
    elif command == "fly":
        flight = parse_fly(rest)
        if flight.simulate is not None:  # whoever flies a drone needs no JAX
            _start_jax_on_cpus()
        fly_command(flight, stops)
    elif command == "completion":
        print(completion_script(parse_completion(rest).shell, COMMANDS))
    elif command == "--version":
        print(f"edqn-jax {package_version()}")
        for package in VERSIONS:
            print(f"{package} {metadata.version(package)}")
        print(f"library in C: {describe_library()}")
    elif command in ("-h", "--help"):
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="edqn", description=ABOUT["edqn"], args=["--help"])
    else:
        raise ConfigError(
            f"there is no command '{command}'{suggest_nearest(command, [*COMMANDS, '--help', '--version'])}"
        )
    return DONE


def take_imports(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns the words of a command without `--import`, and the modules and files that it names.

    Raises:
        ConfigError: if it names none.
    """
    words, modules = iter(argv), []
    rest: list[str] = []
    for word in words:
        flag, equals, value = word.partition("=")
        if flag != IMPORT:
            rest.append(word)
            continue
        modules.append(value if equals else next(words, ""))
        if not modules[-1]:
            raise ConfigError(f"{IMPORT} must be followed by a Python file or the name of a module")
    return rest, modules


def import_module_or_file(name: str) -> None:
    """Imports what registers a user's own entries: a file that ends in .py, or a module, also of the current folder.

    Raises:
        ConfigError: as `load_module`, or if it makes arrays while it is imported, which fixes JAX's devices too soon.
    """
    start_jax()

    from edqn_jax.devices.forks import has_found_devices

    load_module(name)
    if name not in IMPORTED:
        IMPORTED.append(name)
    if has_found_devices():
        raise ConfigError(
            f"'{name}' computes with JAX while it is imported, before the devices are known; make its arrays within "
            "functions, or with NumPy"
        )


def _dispatch_run_command(command: str, argv: Sequence[str]) -> None:
    """Runs a command on a finished run, a world or a file; JAX is imported once the arguments are known to be right."""
    parse, run_command = RUN_COMMANDS[command]
    args = parse(argv)
    _start_jax_on_cpus()
    run_command(args)


def _start_jax_on_cpus() -> None:
    show_phase("starting JAX")
    start_jax()

    from edqn_jax.devices.cache import enable_compilation_cache
    from edqn_jax.devices.devices import use_cpu_devices

    use_cpu_devices()
    check_devices()
    enable_compilation_cache()
