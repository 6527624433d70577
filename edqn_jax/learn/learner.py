"""The contract of a learner: the pure functions that the training step calls.

A learner is a bag of pure functions, named in `agent.learner` and found in `config.registry.LEARNERS`:

    from edqn_jax.config.registry import LEARNERS

    LEARNERS.register("mine", Learner(init=..., act=..., decide=..., ...))

The training step flies, encodes and stores one row a decision (`learn.replay.Rows`) in a ring of the length that the
learner asks for, one ring for each of S logical shards with E environments each, and calls `update` after every step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.config.registry import LEARNERS
from edqn_jax.learn import replay
from edqn_jax.user_code import check_functions

State = Any
"""Parameters and optimisers of a learner, a pytree; the same on every device."""

Params = Any
"""Parameters that fly, a pytree."""

Metrics = dict[str, Array]
"""[] float32 by name, NaN where nothing was learnt; `metrics.jsonl`, the live display and the figures show them."""

RUN_METRICS = (
    *("phase", "decisions", "decisions_per_second", "episodes", "success_rate", "mean_return", "diverged"),
    *("skipped_updates", "warm_up", "validation_success", "validation_mission", "validation_spl"),
    "validation_timed_out",
)
"""What `metrics.jsonl` has of every run, whatever learns in it."""

VAE_METRICS = ("reconstruction_loss", "kl")
"""What it has of perception."""


def learner_metrics(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Returns the names of the learner's own numbers in lines of `metrics.jsonl`, in the order in which they come."""
    own: dict[str, None] = {}
    for row in rows:
        for name, value in row.items():
            if name not in (*RUN_METRICS, *VAE_METRICS) and isinstance(value, int | float):
                own[name] = None
    return list(own)


class Exploration(NamedTuple):
    """Progress of a run, for schedules."""

    decisions: Array  # [] int32, of all environments since the learner began
    total: int  # decisions that it will have
    episodes: Array  # [S, E] that each environment has finished since then

    advice: Array | None = None  # [S, E] moves of the teacher here; None without one


@dataclasses.dataclass(frozen=True)
class Teacher:
    """A policy that advises a learner in training."""

    config: Config
    params: Params


class Rings(NamedTuple):
    """Inputs of an update."""

    rows: replay.Rows  # [S, L, E, ...] the shards of this device
    time: Array  # [] int32, of the newest row, counted since the rings began
    keys: Array  # [S] of the shards, consumed


@struct.dataclass
class UpdateStats:
    """Mean loss, metrics and counts of non-finite updates of one network in one training step."""

    metrics: Metrics
    ill_losses: Array
    """[] int32 updates whose loss was not finite."""
    ill_gradients: Array
    """[] int32 updates whose gradient was not finite, which were skipped."""

    @classmethod
    def without_updates(cls, *names: str) -> UpdateStats:
        """Returns the statistics of a step without updates, with these metrics."""
        return cls({name: jnp.float32(jnp.nan) for name in names}, jnp.int32(0), jnp.int32(0))

    @classmethod
    def from_updates(
        cls, loss: Array, metrics: Metrics, gradient_is_finite: Array, made: Array | int | None = None
    ) -> UpdateStats:
        """Returns the statistics of updates [U], or of the first `made` [] of them.

        Metrics [U] are averaged over those with a finite loss.
        """
        is_made = jnp.arange(len(loss)) < (len(loss) if made is None else made)
        finite = jnp.isfinite(loss) & is_made
        count = jnp.sum(finite)
        means = {name: jnp.sum(jnp.where(finite, x, 0.0)) / jnp.maximum(count, 1) for name, x in metrics.items()}
        return cls(
            {name: jnp.where(count > 0, mean, jnp.nan) for name, mean in means.items()},
            jnp.sum(is_made & ~finite, dtype=jnp.int32),
            jnp.sum(is_made & ~gradient_is_finite, dtype=jnp.int32),
        )


@dataclasses.dataclass(frozen=True)
class Learner:
    """Pure functions of one learner; the configuration is their first argument."""

    init: Callable[[Config, Array], State]
    """(config, key) → state that has learnt nothing; the key is consumed."""
    act: Callable[[Config, State, Array, Array, Exploration], tuple[Array, Metrics]]
    """(config, state, memory [S, E, H, D], keys [S] consumed, exploration) → moves [S, E] for training, and
    metrics that are averaged over the shards."""
    decide: Callable[[Config, Params, Array], Array]
    """(config, params, memory [..., H, D]) → moves [...] int32, greedily."""
    ring_length: Callable[[Config], int]
    """Rows that each ring must hold."""
    starts: Callable[[Config], int]
    """Rows of a ring before the first update."""
    updates: Callable[[Config, Array], Array]
    """(config, number [...] of the newest row) → updates [...] int32 that `update` makes then."""
    update: Callable[[Config, str | None, State, Rings, Array | float], tuple[UpdateStats, State]]
    """(config, mesh axis that the shards are spread over or None, state, rings, a result of the sum over the devices
    before, see `all_sum`) → statistics, state. Called at every step; `updates` tells at which it learns."""
    network: Callable[[State], Params]
    """Returns the parameters that learn, which are watched for numbers that are not finite."""
    policy: Callable[[State], Params]
    """Returns the parameters that fly."""
    begin_from: Callable[[Config, State, Params], State] | None = None
    """(config, state that has learnt nothing, parameters that fly) → state that begins with them; None if it never
    does."""
    teacher: Callable[[Config], Teacher] | None = None
    """(config) → a policy of the sensor `depth`, whose greedy moves are stored in every row (`Rows.advice`), and given
    to `act` in the exploration; None if it has none. Called where programs are traced."""

    def __post_init__(self) -> None:
        """Checks what each function takes.

        Raises:
            ConfigError: names the function and its arguments.
        """
        check_functions(
            self,
            {
                "begin_from": "config, state, params",
                "teacher": "config",
                "init": "config, key",
                "act": "config, state, memory, keys, exploration",
                "decide": "config, params, memory",
                "ring_length": "config",
                "starts": "config",
                "updates": "config, number",
                "update": "config, axis, state, rings, after",
                "network": "state",
                "policy": "state",
            },
        )


def learner_of(config: Config) -> Learner:
    """Returns the learner that a configuration names.

    Raises:
        ConfigError: if there is none of that name.
    """
    return LEARNERS.get(config.agent.learner)
