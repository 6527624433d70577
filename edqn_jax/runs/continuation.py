"""Whether a folder holds a run that can be continued, with which options, and which may change."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer, load_layer
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError
from edqn_jax.runs.directory import SEED_FOLDER, RunDirectory

MAY_CHANGE = (
    *("train.total_steps", "train.schedule_steps", "train.devices"),
    *("train.checkpoint_every_s", "train.checkpoints", "train.debug"),
)
"""Options that a run may be continued with other values of; the rest decides what it is."""


@dataclasses.dataclass(frozen=True)
class ExistingRun:
    """A run that a folder holds."""

    config: Config
    seeds: int | None
    """Agents with folders of their own; None for a run of one agent."""


def find_run(folder: Path) -> ExistingRun | None:
    """Returns the run that a folder holds; None where there is none.

    Raises:
        ConfigError: if its `config.yaml` is empty or does not fit this version.
    """
    run = RunDirectory(folder)
    try:
        if not run.config_file.is_file():
            return None
        seeds = len(list(folder.glob(f"{SEED_FOLDER}*/")))
    except OSError:  # a name that the file system does not accept; `plan_run_directory` says so
        return None
    layer = load_layer(run.config_file)
    if not layer:
        raise ConfigError(f"'{run.config_file}' is empty: it does not say what the run in '{folder}' is")
    config = apply_layer(Config(), layer, str(run.config_file))
    validate(config)
    return ExistingRun(config, seeds or None)


def resume_config(folder: Path, run: ExistingRun, config: Config, seeds: int | None) -> Config:
    """Returns the options of a continued run: its own, with the given ones where they may change.

    Args:
        folder: of the run, for messages.
        run: what is in it.
        config, seeds: what was asked for.

    Raises:
        ConfigError: lists the options that differ and must not, or says that the run has no more to do.
    """
    if seeds != run.seeds:
        raise ConfigError(
            f"'{folder}' holds {_described(run.seeds)}, not {_described(seeds)}; leave --seeds out to continue it, or "
            "give another folder"
        )
    differ = [name for name in option_differences(run.config, config) if name not in MAY_CHANGE]
    if differ:
        said = "; ".join(f"{name} was {_of(run.config, name)} and is now {_of(config, name)}" for name in differ)
        raise ConfigError(
            f"the run in '{folder}' has other options: {said}; leave them out to continue it, or give another folder"
        )
    before, wanted = run.config.train.total_steps, config.train.total_steps
    if wanted < before:
        raise ConfigError(f"the run in '{folder}' is of {before:,} decisions, so --total-steps must be at least that")
    if wanted == before:
        return dataclasses.replace(config, train=dataclasses.replace(config.train, schedule_steps=_schedule(run)))
    schedule = _schedule(run) or before
    return dataclasses.replace(config, train=dataclasses.replace(config.train, schedule_steps=schedule))


def option_differences(one: Config, other: Config) -> list[str]:
    """Returns the names of the options in which two configurations differ, such as `agent.n_step`."""
    return [
        f"{group.name}.{option.name}"
        for group in dataclasses.fields(one)
        for option in dataclasses.fields(getattr(one, group.name))
        if _of(one, f"{group.name}.{option.name}") != _of(other, f"{group.name}.{option.name}")
    ]


def _schedule(run: ExistingRun) -> int:
    return run.config.train.schedule_steps


def _of(config: Config, name: str) -> object:
    group, option = name.split(".")
    return getattr(getattr(config, group), option)


def _described(seeds: int | None) -> str:
    return "one run" if seeds is None else f"runs of {seeds} seeds"
