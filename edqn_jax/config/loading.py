"""Merging defaults, preset and file into one `Config`; unknown keys and wrong types are errors.

Precedence: defaults < preset < what world and hardware ask for < file, and flags over all of them. A layer is a
nested dict, `{"agent": {"batch_size": 512}}`, that names only what it changes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import yaml

from edqn_jax.config.limits import value_text
from edqn_jax.config.options import CONDITIONS, Config
from edqn_jax.config.presets import WORLD, Hardware, Layer, world_layers
from edqn_jax.config.presets import get_preset as named_preset
from edqn_jax.config.profiles import PROFILES
from edqn_jax.config.retired import LAST_COMMIT, RETIRED, is_off
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError, suggest_nearest
from edqn_jax.user_code import describe_object

MAX_BYTES = 1_000_000
"""Of a file of options that is worth reading."""

MAX_SHOWN = 80
"""Characters of a word that a message repeats."""


def resolve_config(
    preset_name: str = "default", file: Path | None = None, world: str | None = None, tuned_for: Hardware = "cpu"
) -> Config:
    """Returns the named preset, changed first by world and hardware and then by the file; checks types, not limits.

    Args:
        preset_name: one of `config.PRESETS`; world and hardware change only `default`.
        file: a YAML file.
        world: name of the world given by a flag; None takes that of the file, else `config.presets.WORLD`, or the
            paper's in the preset `paper`.
        tuned_for: hardware that the defaults are chosen for.

    Raises:
        ConfigError: names the key or the file, and what would be right.
    """
    layer = load_layer(file) if file is not None else {}
    config = apply_layer(named_preset(preset_name), layer, str(file))
    if world is None and preset_name == "default" and "name" not in layer.get("world", {}):
        world = WORLD
    if world is not None:
        config = apply_layer(config, {"world": {"name": world}}, "the command line")
    if preset_name != "default":
        return config
    tuned = named_preset(preset_name)
    for changes in world_layers(config.world.name, tuned_for):
        tuned = apply_layer(tuned, changes, "the world")
    tuned = apply_layer(tuned, layer, str(file))
    return dataclasses.replace(tuned, world=dataclasses.replace(tuned.world, name=config.world.name))


def make_config(
    world: str | None = None,
    /,
    *,
    preset: str = "default",
    tuned_for: Hardware = "cpu",
    file: str | Path | None = None,
    **groups: Mapping[str, Any],
) -> Config:
    """Returns a checked configuration: preset < what world and hardware ask for < file < `groups`.

        make_config("medium", train={"total_steps": 100_000}, agent={"n_step": 5})

    Args:
        world: `paper`, the name of random worlds (`FAMILIES`) or an MJCF file; None leaves it to the file, else it is
            `medium` (`paper` in the preset of that name).
        preset: one of `config.PRESETS`.
        tuned_for: `cpu` or `gpu`: what environments, batches, networks and decisions are chosen for.
        file: a YAML file with groups of options.
        groups: options by group, as in a file.

    Raises:
        ConfigError: names the option and what would be right.
    """
    if world is not None and not isinstance(world, str | Path):
        raise ConfigError(
            f"make_config: the first argument must be the name of a world, not {describe_object(world)}; groups of "
            "options are given by their names, such as make_config('medium', train={'seed': 1})"
        )
    given = groups.get("world")
    if world is None and isinstance(given, Mapping) and isinstance(given.get("name"), str):
        world = given["name"]
    if tuned_for not in typing.get_args(Hardware):
        raise ConfigError(f"make_config: tuned_for must be 'cpu' or 'gpu', not {tuned_for!r}")
    config = apply_layer(
        resolve_config(preset, None if file is None else Path(file), world, tuned_for), groups, "make_config"
    )
    validate(config)
    return config


def check_config(config: object) -> None:
    """Raises unless something is a configuration, or None for the default.

    Raises:
        ConfigError: says what makes one.
    """
    if config is not None and not isinstance(config, Config):
        raise ConfigError(
            f"config must be an edqn_jax.Config, such as edqn_jax.make_config('medium') returns, not "
            f"{describe_object(config)}"
        )


def with_conditions(config: Config, conditions: Layer, source: str) -> Config:
    """Returns the checked configuration of a policy that is flown under other conditions than it was trained under.

    A profile is flown in full, and thresholds that are given are the contrast that a policy which knows it is told,
    unless the options of what is drawn are given beside them.

    Args:
        config: of the policy.
        conditions: options of `CONDITIONS` by group.
        source: of them, for messages.

    Raises:
        ConfigError: if there is no such option, it is none of `CONDITIONS`, or it is out of its limits; if it would
            give a contrast to a policy that knows none, or take it away.
    """
    if not isinstance(conditions, Mapping):
        raise ConfigError(
            f"{source}: conditions must be options by group, such as {{'air': {{'gusts_m_s': 5.0}}}}, not "
            f"{describe_object(conditions)}"
        )
    changed = _with_known_contrast(config, apply_layer(config, conditions, source), conditions, source)
    for group, options in conditions.items():
        for option in options:
            if option not in CONDITIONS.get(group, ()):
                raise ConfigError(
                    f"{source}: '{group}.{option}' is a policy's own; conditions are {', '.join(CONDITIONS)} "
                    f"(of env {', '.join(CONDITIONS['env'])} alone, of events the pixels' thresholds and faults)"
                )
    validate(changed, trains=False)
    return changed


def _with_known_contrast(config: Config, changed: Config, conditions: Layer, source: str) -> Config:
    """Returns `changed` with the event sensor that `conditions` describe in place of one that is drawn.

    Raises:
        ConfigError: if the policy of `config` cannot know its contrast, or has to.
    """
    given, law = conditions.get("events", {}), changed.events
    knows, drawn = config.events.most_contrast > 0, law.most_contrast > 0
    if not knows and (drawn or law.least_contrast > 0):
        raise ConfigError(
            f"{source}: this policy was trained without events.most_contrast and knows no contrast; give "
            "events.threshold and events.tolerance instead"
        )
    if knows and not drawn and {"least_contrast", "most_contrast"} & set(given):
        raise ConfigError(
            f"{source}: this policy knows the contrast of its sensor: events.least_contrast and events.most_contrast "
            f"must be between 0.01 and 1, not {law.least_contrast:g} and {law.most_contrast:g}"
        )
    options: dict[str, Any] = {}
    if "profile" in given and "faults_share" not in given:
        options["faults_share"] = 0.0
    thresholds = {"paper": {"tolerance", "threshold"}, "esim": {"contrast_on", "contrast_off"}}
    named = {*given, *PROFILES[law.profile]} if "profile" in given else set(given)
    sets = thresholds.get(law.law, {"airsim_tolerance"}) & named
    if knows and sets and not {"least_contrast", "most_contrast"} & set(given):
        contrast = {"paper": law.tolerance, "airsim": law.airsim_tolerance, "esim": law.contrast_on}[law.law]
        options |= {"least_contrast": contrast, "most_contrast": contrast}
    return dataclasses.replace(changed, events=dataclasses.replace(law, **options))


def load_layer(file: Path) -> Layer:
    """Returns the layer that a YAML file holds; {} for an empty file.

    Raises:
        ConfigError: if it cannot be read, is too large, is not YAML, or names a key twice.
    """
    try:
        with file.open("rb") as opened:
            held = opened.read(MAX_BYTES + 1)
        text = held.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise ConfigError(f"cannot read the configuration file '{file}': {reason}") from None
    if len(held) > MAX_BYTES:
        raise ConfigError(f"'{file}' has more than {MAX_BYTES:,} bytes, so it is no file of options")
    return parse_layer(text, f"'{file}'")


def parse_layer(text: str, source: str) -> Layer:
    """Returns the layer that YAML holds; {} for an empty text.

    Raises:
        ConfigError: as `load_layer`.
    """
    try:
        layer = yaml.load(text, Loader=_StrictLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it does not parse"
        raise ConfigError(f"{source} is not valid YAML{where}: {problem}") from None
    except RecursionError:
        raise ConfigError(f"{source} is nested too deeply for a file of options") from None
    except ValueError as error:  # of a number or a date that YAML knows and Python does not
        raise ConfigError(f"{source} is not valid YAML: {error}") from None
    if layer is None:
        return {}
    if not isinstance(layer, dict):
        raise ConfigError(f"{source} must hold groups of keys such as 'agent:', not {_describe(layer)}")
    return layer


def apply_layer(config: Config, layer: Layer, source: str) -> Config:
    """Returns `config` with every key of the layer replaced; `events.profile` also replaces what it stands for.

    Options that the layer names beside a profile are not the profile's.

    Raises:
        ConfigError: if a group or key is unknown (names the nearest known one) or a type is wrong.
    """
    groups = [field.name for field in dataclasses.fields(config)]
    changed = {}
    for group, values in layer.items():
        if group not in groups:
            owners = [f"'{name}:'" for name in groups if str(group) in _keys(getattr(config, name))]
            hint = f"; it belongs under {' or '.join(owners)}" if owners else suggest_nearest(group, groups)
            raise ConfigError(f"{source}: there is no group '{_shorten_word(group)}'{hint}")
        if not isinstance(values, Mapping):
            raise ConfigError(
                f"{source}: '{group}' must hold keys such as '{_example(config, group)}', not {_describe(values)}"
            )
        section = getattr(config, group)
        hints = typing.get_type_hints(type(section))
        values = {key: value for key, value in values.items() if not _has_gone(f"{group}.{key}", value, source)}
        for key in values:
            if key not in hints:
                raise ConfigError(
                    f"{source}: there is no key '{group}.{_shorten_word(key)}'{suggest_nearest(key, hints)}"
                )
        checked = {key: convert_type(value, hints[key], f"{source}: '{group}.{key}'") for key, value in values.items()}
        profile = PROFILES[checked["profile"]] if group == "events" and "profile" in checked else {}
        changed[group] = dataclasses.replace(section, **{**profile, **checked})
    return dataclasses.replace(config, **changed)


def _has_gone(name: str, value: Any, source: str) -> bool:
    """Returns whether an option is a retired one that is off.

    Raises:
        ConfigError: if it is a retired one that is on.
    """
    if name in RETIRED and not is_off(name, value):
        raise ConfigError(
            f"{source}: '{name}' is no longer an option, and {_describe(value)} is not what happens without it; "
            f"commit {LAST_COMMIT} is the last that has it"
        )
    return name in RETIRED


def convert_type(value: Any, hint: Any, name: str) -> Any:
    """Returns `value` as the type `hint`.

    Converts whole numbers to floats and lists to tuples, and nothing else.

    Raises:
        ConfigError: `<name> must be <what would be right>, not <what it is>`.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal and value in arguments:
        return value
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):  # a whole number may be too large
            return float(value)
    if hint in (int, str, bool) and type(value) is hint:
        return value
    if origin is tuple and isinstance(value, list | tuple):
        if arguments[-1] is Ellipsis:
            return tuple(convert_type(item, arguments[0], f"each of {name}") for item in value)
        if len(value) == len(arguments):
            pairs = zip(value, arguments, strict=True)
            return tuple(convert_type(item, argument, f"each of {name}") for item, argument in pairs)
    raise ConfigError(f"{name} must be {_wanted(hint)}, not {_describe(value)}")


def to_yaml(config: Config) -> str:
    """Returns the whole configuration as YAML; `load_layer` reads it back unchanged."""
    plain = dataclasses.asdict(
        config, dict_factory=lambda items: {k: list(v) if isinstance(v, tuple) else v for k, v in items}
    )
    return yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=100)


class _StrictLoader(yaml.SafeLoader):
    """YAML in which a repeated key is an error and 1e-3 is a number."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    problem="a key must be a word", problem_mark=key_node.start_mark
                )
            key = key_node.value
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"the key '{_shorten_word(key)}' is given twice", problem_mark=key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(?:\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def _keys(section: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(section)]


def _example(config: Config, group: str) -> str:
    key = _keys(getattr(config, group))[0]
    return f"{key}: {getattr(getattr(config, group), key)}"


def _wanted(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin is tuple:
        plural = {int: "whole numbers", float: "numbers", str: "words"}[arguments[0]]
        return f"a list of {'' if arguments[-1] is Ellipsis else f'{len(arguments)} '}{plural}"
    return {int: "a whole number", float: "a number", str: "text", bool: "true or false"}[hint]


def _describe(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return "a group of keys"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    return f"the text '{_shorten_word(value)}'" if isinstance(value, str) else value_text(value)


def _shorten_word(word: object) -> str:
    """Returns a word of a file as text, the beginning alone of one that is very long."""
    text = str(word)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"
