"""What commands share: flags that there are, runs that are named, notes on what was flown."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import tyro

from edqn_jax.cli.help import ABOUT, asks_for_help, flag_of, print_help, with_help_texts
from edqn_jax.cli.process.parsing import parse_or_say
from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.policies import function_named, no_run, policy_folder

if TYPE_CHECKING:
    from edqn_jax.evaluation.missions import MissionSet
    from edqn_jax.learn.policy import Policy
    from edqn_jax.policies.functions import FunctionPolicy

Point = tuple[float, float, float]

Args = TypeVar("Args")

MEANINGS = {
    "lr": "learning-rate",
    "step-size": "learning-rate",
    "alpha": "learning-rate",
    "gamma": "discount",
    "discount-factor": "discount",
    "envs": "num-envs",
    "n-envs": "num-envs",
    "environments": "num-envs",
    "steps": "total-steps",
    "num-steps": "total-steps",
    "timesteps": "total-steps",
    "total-timesteps": "total-steps",
    "batch": "batch-size",
    "minibatch-size": "batch-size",
    "buffer-size": "replay-size",
    "memory-size": "replay-size",
    "epsilon": "exploration-start",
    "tau": "target-rate",
    "env": "world",
    "map": "world",
    "scene": "world",
    "num-missions": "missions",
    "log-dir": "run-dir",
    "output-dir": "run-dir",
    "algorithm": "learner",
    "speed": "speed-m-s",
    "fov": "horizontal-fov-deg",
}
"""Names that people know from elsewhere, and the last part of the option that means it, where a command has one."""


def parse_arguments(kind: type[Args], argv: Sequence[str], command: str) -> Args:
    """Returns the arguments of a command.

    Raises:
        ConfigError: if there is no such flag, or a value does not parse.
        SystemExit: after printing, for --help.
    """
    check_flags(argv, flags_of(kind), command)
    if asks_for_help(argv):
        print_help(with_help_texts(kind), command, ABOUT[command])
    return parse_or_say(lambda: tyro.cli(kind, args=argv, prog=command), command)


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


def _initials(flag: str) -> str:
    """Returns a flag with the initials of its last name: `agent.lr` of `--agent.learning-rate`."""
    group, dot, name = flag.removeprefix("--").rpartition(".")
    return group + dot + "".join(word[:1] for word in name.split("-"))


def _nearest_flag(flag: str, known: Iterable[str]) -> str | None:
    """Returns the flag nearest to an unknown one: shortened, without its group or misspelt; None if none is near.

    Flags that mean the same come first, then those that begin with the given one, then those of that name in a group,
    then those of these initials
    (`lr`, `agent.lr`), then similar spellings.
    """
    shortest_first = sorted(known, key=lambda name: (len(name), name))
    bare = flag.removeprefix("--")
    group, dot, last_name = bare.rpartition(".")
    if (meant := MEANINGS.get(last_name)) is not None:
        for ending in (f"--{group}{dot}{meant}", f"--{meant}", f".{meant}"):
            if same := [name for name in shortest_first if name.endswith(ending)]:
                return same[0]
    for is_meant in (
        lambda name: len(bare) > 1 and name.startswith(flag),
        lambda name: name.endswith(f".{bare}"),
        lambda name: len(bare) > 1 and name.rpartition(".")[2].startswith(bare),
        lambda name: len(bare) > 1 and _initials(name) in (bare, f"{name.removeprefix('--').partition('.')[0]}.{bare}"),
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


def flags_of_group(group: str, names: Iterable[str]) -> list[tuple[str, str]]:
    """Returns every flag of a group's options of these names, and which of the options it gives."""
    kinds = {option.name: option.type for option in dataclasses.fields(getattr(Config(), group))}
    return [
        (f"--{group}.{no}{name.replace('_', '-')}", name)
        for name in names
        for no in (("", "no-") if kinds[name] == "bool" else ("",))
    ]


def flags_of(kind: type) -> set[str]:
    """Returns every flag of a dataclass of arguments."""
    return {
        flag_of(f"{no}{option.name}")
        for option in dataclasses.fields(kind)
        if "tyro.conf.Fixed" not in str(option.type)
        for no in (("", "no_") if option.type == "bool" else ("",))
    }


def check_is_saved(run: Path, what: str) -> None:
    """Raises ConfigError if `run` names a function."""
    if function_named(run) is not None:
        raise ConfigError(f"'{what}' needs a saved policy, with its parameters, and '{run}' is a function")


def check_run(folder: Path) -> None:
    """Raises ConfigError if `folder` is no run, and names no function of a file that is there."""
    named = function_named(folder)
    if named is not None:
        if named[0].endswith(".py") and not Path(named[0]).is_file():
            raise ConfigError(f"there is no file '{named[0]}'")
        return
    if not (policy_folder(folder) / "config.yaml").is_file():
        raise no_run(folder)


def print_notes(policy: Policy | FunctionPolicy, run: Path, world: str | None, missions: MissionSet) -> None:
    """Prints, before a flight, what differs from what it would have been, and what the policy was not trained for.

    Args:
        policy: that is to fly.
        run: as it was named.
        world: that was asked for; None is the run's own.
        missions: to be flown.
    """
    from edqn_jax.evaluation.world_check import warn_of_missions
    from edqn_jax.policies.functions import config_of
    from edqn_jax.runs.policies import worlds_replaced

    replaced = worlds_replaced(run) if world is None else ()
    notes = () if missions.note is None else (missions.note,)
    for each in (*replaced, *notes, *warn_of_missions(config_of(policy), missions)):
        print(each, flush=True)
