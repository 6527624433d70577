"""What a benchmark is asked for in train.py's own words, which stand after --."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from edqn_jax.cli.arguments import parse_train
from edqn_jax.config import Config

SAMPLES = 4
"""Replayed samples per decision unless the flags say otherwise."""


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """A benchmark's own words, and those after -- that are train.py's."""
    words = list(words)
    cut = words.index("--") if "--" in words else len(words)
    return words[:cut], words[cut + 1 :]


def configured(flags: Sequence[str]) -> Config:
    """The configuration that train.py's flags ask for, with `SAMPLES` unless they say how much to replay.

    Raises:
        ConfigError: if it cannot be run.
    """
    _, config = parse_train(flags)
    if any(flag.replace("_", "-").startswith(("--agent.updates-per-step", "--config")) for flag in flags):
        return config
    updates = math.ceil(SAMPLES * config.train.num_envs / config.agent.batch_size)
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, updates_per_step=updates))
