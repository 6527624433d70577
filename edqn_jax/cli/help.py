"""Help texts: what a command does, an example of it, and its options from the same dataclasses that parse them."""

from __future__ import annotations

import dataclasses
import re
import sys
import typing
from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, NoReturn

import docstring_parser
import tyro

from edqn_jax.config import Config
from edqn_jax.config.registry import AIRFRAMES, ENCODERS, FAMILIES, LEARNERS, NETWORKS, SENSORS, Registry
from edqn_jax.config.simulation import LOOKS

TRAIN, EVALUATE, RECORD, REPORT = "edqn train", "edqn evaluate", "edqn record", "edqn report"
VERIFY, EXPORT, EVENTS, COMPLETION = "edqn verify", "edqn export", "edqn events", "edqn completion"
CHECK, WORLD, FLY = "edqn check", "edqn world", "edqn fly"

ABOUT = {
    "edqn": """Train drones to fly through unknown obstacles from the events of a simulated camera, and fly them.

The options of a command: `edqn COMMAND --help`. The versions of packages: `edqn --version`. With `--import FILE.py` (or
the name of a module), before or after a command, it knows the sensors, worlds, learners and networks that this file
registers (docs/howto/own_sensor.md).

Examples:
  edqn check mine.xml                        will it fly there?
  edqn train                                 train in random worlds for some minutes; files under runs/
  edqn evaluate pretrained --world mine.xml  fly the policy that comes with the package
  edqn record pretrained flight.gif          see it fly
  edqn report runs/DIR                       see a whole run in a browser""",
    TRAIN: """Train a drone to fly from events, evaluate it and draw figures.

Examples:
  edqn train                                       medium random worlds, then the paper's map, unseen
  edqn train --world mine.xml --run-dir runs/mine  your own world; the same command continues the run
  edqn train --preset paper --world paper          Table 1 of the paper""",
    WORLD: """Make a world of a scan, a mesh or a cloud of points: an MJCF file, and the mesh that it names.

Examples:
  edqn world house.ply --out house
  edqn world site.glb --out site --scale 0.001 --thickness 0.1
  edqn world room.obj --out room --up y --start 1 1 1.5 --goal 8 4 1.5""",
    CHECK: """Say whether a policy can fly in a world: what its geoms became, its tightest way, its size, what it costs.

Ends with 0 if it can be flown, 1 if it cannot, and 2 for a file that cannot be read.

Examples:
  edqn check mine.xml --out mine.png
  edqn check mine.xml --policy runs/DIR --start 2 2 3 --goal 40 30 6
  edqn check rooms --seed 3""",
    EVALUATE: """Fly a policy on missions in any world and print metrics.

Options with a group, such as --air.gusts-m-s, disturb the flights, which otherwise are as in training;
`edqn evaluate --help-all` shows those, too.

Examples:
  edqn evaluate pretrained --world dense --missions 100
  edqn evaluate pretrained --world medium --missions 300 --air.gusts-m-s 5
  edqn evaluate runs/DIR --world mine.xml --start 2 2 3 --goal 40 30 6 --json figures.json
  edqn evaluate mine.py:policy --world medium --missions 100""",
    RECORD: """Fly a policy once and write the flight as a GIF or MP4, or the events of a camera that watches it.

Examples:
  edqn record runs/DIR flight.gif
  edqn record pretrained flight.mp4 --world dense --seed 3
  edqn record pretrained events.h5 --size 640 480""",
    REPORT: """Write one HTML file with runs' flights in 3D, what the drone saw, curves, figures and options.

Examples:
  edqn report runs/DIR
  edqn report runs/ONE runs/ANOTHER --out both.html""",
    VERIFY: """Verify a finished run: derive its summary anew, fly its flights again, have C MuJoCo judge them.

Example:
  edqn verify runs/DIR --json findings.json""",
    EXPORT: """Write a policy as ONNX, for a computer without JAX, and beside it the runner that flies it; compare both.

Example:
  edqn export pretrained --out policy.onnx""",
    EVENTS: """Say what a file of events holds; see it as a policy does; write it in another form.

Examples:
  edqn events recording.h5
  edqn events recording.raw --policy pretrained --picture seen.png
  edqn events recording.aedat4 --start 2 --stop 4 --out part.npz""",
    FLY: """Fly an exported policy over MAVLink (extra `fly`), play a flight again, or simulate flights over the wire.

Nothing is armed: a pilot takes off, and the policy takes over in offboard mode.

Examples:
  edqn fly pretrained-looks --simulate medium
  edqn fly policy.onnx --events dv:127.0.0.1:7777 --goal 40 0 3 --volume -5 -20 0 60 20 10 --out flight
  edqn fly policy.onnx --replay flight""",
    COMPLETION: """Print a script that completes commands, options and their values in a shell.

Examples:
  eval "$(edqn completion bash)"        in ~/.bashrc
  edqn completion zsh > ~/.zfunc/_edqn  a folder of $fpath, before compinit
  edqn completion fish > ~/.config/fish/completions/edqn.fish""",
}
"""What each command does, with examples."""

COMMON = {
    "world.name": "where to train: paper, an MJCF file, or random worlds",
    "world.flown": "world of the last flight of a run in random worlds",
    "run_dir": "folder of the run (default: a new, dated one under runs/)",
    "resume": "what to do with a run in --run-dir",
    "config": "YAML file of options by group; flags override it",
    "preset": "the best agent that we know, or Table 1 of the paper",
    "tuned_for": "hardware that defaults are chosen for",
    "seeds": "policies to train side by side, of the seeds from --seed on",
    "track": "also write the metrics for tensorboard, wandb or both (extra `track`)",
    "view": "also write metrics and flights for rerun, and show them (extra `viz`)",
    "train.seed": "random seed",
    "train.total_steps": "decisions in all, of 0.26 s each",
    "train.num_envs": "parallel environments",
    "train.devices": "devices to use; 0: as many as fit",
    "env.sensor": "what the drone observes",
    "env.speed_m_s": "commanded speed per axis, m/s",
    "env.reward": "goal and collision alone (Eq. 8), or metres gained, too",
    "drone.physics": "MJX, or its equations in closed form",
    "camera.width": "pixels across",
    "camera.height": "pixels down",
    "surface.pattern": "what surfaces look like: one plaid, or drawn for each shape",
    "events.threshold": "change of log-brightness that makes an event",
    "agent.learner": "how it learns",
    "agent.learning_rate": "Adam step size at the start",
    "agent.batch_size": "replayed samples per update",
    "agent.discount": "gamma, per decision",
}
"""Options that `edqn train --help` shows, with what it says of them; `--help-all` has their whole texts."""

REGISTERED: dict[str, Registry] = {
    **{registry.option: registry for registry in (AIRFRAMES, SENSORS, ENCODERS, LEARNERS, NETWORKS, FAMILIES)},
    "world": FAMILIES,
}
"""Registries of what an option names, by the option; of `world` and `world.name` also files."""

NAMED: Mapping[str, Collection[str]] = {**REGISTERED, "surface.pattern": LOOKS}
"""The names that an option takes, by the option."""

METAVARS = {int: "N", float: "X", str: "WORLD", "track": "WHICH [WHICH]", "view": "WHICH"}
"""What stands for a value of a type, or of one option, in the short help."""


def show_train_help(options: Any, config: Config, short_names: Mapping[str, str], *, everything: bool) -> NoReturn:
    """Prints the help of `edqn train` and exits.

    Args:
        options: instance of the options that stand in no group.
        config: whose values are shown as defaults.
        short_names: short flags, and the long ones that they stand for.
        everything: all options by group instead of `COMMON`.
    """
    if everything:
        print_help(all_of_train(options, config, short_names), TRAIN, ABOUT[TRAIN])
    short = {long: short for short, long in short_names.items()}
    fields = []
    for name, text in COMMON.items():
        group, _, option = name.rpartition(".")
        owner = getattr(config, group) if group else options
        flag = flag_of(name)
        kind = typing.get_type_hints(type(owner), include_extras=True)[option]
        metavar = METAVARS.get(name, METAVARS.get(_bare(kind)))
        if typing.get_origin(kind) is typing.Literal:
            metavar, text = "WHICH", f"{text}: {', '.join(typing.get_args(kind))}"
        elif name in NAMED:
            metavar, text = "WORLD" if group == "world" else "WHICH", f"{text}: {', '.join(NAMED[name])}"
        said = Annotated[kind, tyro.conf.arg(name=short.get(flag, flag)[2:], metavar=metavar, help=text)]
        fields.append((name.replace(".", "_"), said, dataclasses.field(default=getattr(owner, option))))
    groups = [options, *(getattr(config, group.name) for group in dataclasses.fields(Config))]
    count = sum(len(dataclasses.fields(group)) for group in groups)
    does, _, examples = ABOUT[TRAIN].partition("\n\n")
    about = (
        f"{does}\n\nThese options are the ones that people use; `{TRAIN} --help-all` shows all {count}.\n\n{examples}"
    )
    print_help(dataclasses.make_dataclass("Train", fields), TRAIN, about)


def all_of_train(
    options: Any, config: Config, short_names: Mapping[str, str], kinds: Mapping[str, Any] | None = None
) -> type:
    """Returns a dataclass of all options of `edqn train`, by group; arguments as in `show_train_help`.

    Args:
        kinds: types that options have instead of their own, by group and name.
    """
    groups = [_nested("options", with_help_texts(type(options), options), "")]
    for group in dataclasses.fields(Config):
        value = getattr(config, group.name)
        kind = with_help_texts(type(value), value, f"{group.name}.", short_names, kinds)
        groups.append(_nested(group.name, kind, group.name))
    return dataclasses.make_dataclass("Train", groups)


def with_conditions(kind: type, conditions: Mapping[str, Collection[str]]) -> type:
    """Returns a dataclass of arguments and, by group, of options that may be given in place of a policy's own.

    Args:
        kind: the arguments, as `with_help_texts` returns them.
        conditions: names of these options by group.
    """
    config = Config()
    groups = [
        _nested(name, with_help_texts(type(group), group, f"{name}.", only=options), name)
        for name, options in conditions.items()
        for group in (getattr(config, name),)
    ]
    return dataclasses.make_dataclass(kind.__name__, groups, bases=(kind,), namespace={"__doc__": kind.__doc__})


def print_help(kind: type, command: str, about: str) -> NoReturn:
    """Prints the help of a dataclass of options and exits."""
    tyro.cli(kind, args=["--help"], prog=command, description=about)
    sys.exit(0)


def with_help_texts(
    kind: type,
    instance: Any = None,
    group: str = "",
    short_names: Mapping[str, str] | None = None,
    kinds: Mapping[str, Any] | None = None,
    only: Collection[str] | None = None,
) -> type:
    """Returns a dataclass with the fields of another one, each with its whole help text in flowing lines.

    Fields that no flag gives are left out.

    Args:
        kind: a dataclass with a string below each field.
        instance: whose values are the defaults; None takes those of the class.
        group: of the options, with a dot at its end.
        short_names: short flags, which become second names of the long ones that they stand for.
        kinds: types that options have instead of their own, by group and name.
        only: names of the fields to take, whose defaults are left unsaid; None takes all.
    """
    short = {long: short for short, long in (short_names or {}).items()}
    hints = typing.get_type_hints(kind, include_extras=True)
    texts = {text.arg_name: text.description or "" for text in docstring_parser.parse_from_object(kind).params}
    fields = []
    for option in dataclasses.fields(kind):
        if tyro.conf.Fixed in typing.get_args(hints[option.name]) or (only is not None and option.name not in only):
            continue
        name = f"{group}{option.name}"
        alias = short.get(flag_of(name))
        text = re.sub(r"\s+", " ", texts[option.name])
        if name in REGISTERED:
            text = f"{text} {REGISTERED[name].describe()}."
        said = tyro.conf.arg(
            help=text,
            aliases=[alias] if alias else None,
            help_behavior_hint=None if only is None else "",
        )
        default = option.default if instance is None else getattr(instance, option.name)
        hint = (kinds or {}).get(name, hints[option.name])
        fields.append((option.name, Annotated[hint, said], dataclasses.field(default=default)))
    return dataclasses.make_dataclass(kind.__name__, fields, namespace={"__doc__": kind.__doc__})


def _bare(kind: Any) -> Any:
    """Returns a type without its limits."""
    return typing.get_args(kind)[0] if typing.get_origin(kind) is Annotated else kind


def _nested(name: str, kind: type, shown: str) -> tuple[str, Any, Any]:
    return name, Annotated[kind, tyro.conf.arg(name=shown)], dataclasses.field(default_factory=kind)


def flag_of(name: str) -> str:
    """Returns the flag of an option's name."""
    return f"--{name.replace('_', '-')}"


def asks_for_help(argv: Sequence[str]) -> bool:
    """Returns whether the words of a command ask for its help."""
    return any(word in ("-h", "--help") for word in argv)
