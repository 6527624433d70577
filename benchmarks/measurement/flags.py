"""Options of train.py in the arguments of a benchmark, after --."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence

from edqn_jax.cli.train import parse_train
from edqn_jax.config import Config

SAMPLES = 4
"""Replayed samples per decision unless the options set another number."""


ONE_LOOK = ("--surface.pattern", "plaid")
"""What is flown unless options say otherwise: the figures of the pages are of one plaid unless their row says more."""


def split(argv: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Returns the arguments of the benchmark, by default the process's, and those after --: options of train.py."""
    words = list(sys.argv[1:] if argv is None else argv)
    cut = words.index("--") if "--" in words else len(words)
    return words[:cut], words[cut + 1 :]


def parse_options(flags: Sequence[str]) -> Config:
    """Returns the configuration of train.py with these options, in worlds of one look unless they name another.

    Raises:
        ConfigError: if it is invalid.
    """
    named = any(flag.partition("=")[0] in ("--surface.pattern", "--config") for flag in flags)
    return parse_train([*(() if named else ONE_LOOK), *flags])[1]


def with_test_worlds_only(config: Config) -> Config:
    """Returns the configuration with test worlds alone at the end of a run in random worlds."""
    return dataclasses.replace(config, world=dataclasses.replace(config.world, flown=""))


def parse_config(flags: Sequence[str]) -> Config:
    """Returns the configuration of train.py with these options, with `SAMPLES` unless they set the updates per step.

    Without a world or a file among them it is the reference workload: the paper's world.

    Raises:
        ConfigError: if it is invalid.
    """
    named = any(flag.partition("=")[0] in ("--world", "--world.name", "--config") for flag in flags)
    config = with_test_worlds_only(parse_options(flags if named else ["--world", "paper", *flags]))
    if any(flag.replace("_", "-").startswith(("--agent.updates-per-step", "--config")) for flag in flags):
        return config
    updates = math.ceil(SAMPLES * config.train.num_envs / config.agent.batch_size)
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, updates_per_step=updates))
