"""Checks what the functions of a learner of one's own return, in shapes and types, before anything is compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.checks import first_difference
from edqn_jax.config import LEARNERS, Config
from edqn_jax.errors import ConfigError
from edqn_jax.learn import replay
from edqn_jax.learn.actor import observation_size
from edqn_jax.learn.learner import (
    RUN_METRICS,
    VAE_METRICS,
    Exploration,
    Learner,
    Rings,
    UpdateStats,
    learner_of,
)
from edqn_jax.learn.schedule import Schedule
from edqn_jax.user_code import describe_object


def check_learner(config: Config) -> None:
    """Raises unless the functions of a learner of one's own return what `Learner` says; the package's own do.

    What a function raises itself is not caught.

    Raises:
        ConfigError: names the function, what it must return, and what it returns.
    """
    if config.agent.learner not in LEARNERS.own:
        return
    learner, shards = learner_of(config), config.train.shards
    envs, size = config.train.num_envs // shards, observation_size(config)
    length = _whole_number(config, learner, "ring_length", 1)
    _whole_number(config, learner, "starts", 0)
    _check_integers(config, "updates", _shapes(config, "updates", learner.updates, config, _numbers(3)), 3)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), shards))
    state = _shapes(config, "init", learner.init, config, jax.eval_shape(lambda: jax.random.key(0)))
    params = _shapes(config, "policy", learner.policy, state)
    _shapes(config, "network", learner.network, state)
    memory = jax.ShapeDtypeStruct((shards, envs, config.agent.history, size), jnp.float32)
    moves = _shapes(config, "decide", learner.decide, config, params, memory)
    _check_integers(config, "decide", moves, shards, envs)

    total = (Schedule.from_config(config).scheduled - Schedule.from_config(config).warmup) * config.train.num_envs

    def act(state: Any, memory: Any, keys: Any, decisions: Any, episodes: Any, advice: Any) -> Any:
        return learner.act(config, state, memory, keys, Exploration(decisions, total, episodes, advice))

    advised = learner.teacher is not None
    advice = _numbers(shards, envs) if advised else None
    moves, acted = _pair(config, "act", act, state, memory, keys, _numbers(), _numbers(shards, envs), advice)
    _check_integers(config, "act", moves, shards, envs)
    _check_metrics(config, "act", acted)
    rows: Any = jax.eval_shape(partial(replay.empty_ring, length, envs, size, advised=advised))
    rows = jax.tree.map(lambda x: jax.ShapeDtypeStruct((shards, *x.shape), x.dtype), rows)
    last = jax.ShapeDtypeStruct((), jnp.float32)
    update = partial(learner.update, config, None)
    stats, after = _pair(config, "update", update, state, Rings(rows, _numbers(), keys), last)
    if not isinstance(stats, UpdateStats):
        raise _wrong(config, "update", "UpdateStats and the state", f"{describe_object(stats)} in place of the first")
    _check_metrics(config, "update", stats.metrics)
    twice = sorted(set(acted) & set(stats.metrics))
    if twice:
        raise _wrong(config, "update", f"other metrics than `act`, which has '{twice[0]}', too", "the same")
    difference = first_difference(state, after)
    if difference:
        raise _wrong(config, "update", "a state like the one that it is given", f"one in which {difference}")


def _wrong(config: Config, function: str, wanted: str, found: str) -> ConfigError:
    return ConfigError(f"`{function}` of the learner '{config.agent.learner}' must return {wanted}, not {found}")


def _numbers(*shape: int) -> Any:
    """Returns shape and type of whole numbers [*shape]."""
    return jax.ShapeDtypeStruct(shape, jnp.int32)


def _whole_number(config: Config, learner: Learner, name: str, least: int) -> int:
    found = getattr(learner, name)(config)
    if not isinstance(found, int | np.integer) or found < least:
        raise _wrong(config, name, f"a whole number of at least {least}", describe_object(found))
    return int(found)


def _shapes(config: Config, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Returns shapes and types of what a function returns; the configuration is no array."""
    fixed, arrays = (arguments[:1], arguments[1:]) if arguments[0] is config else ((), arguments)

    def run(*arrays: Any) -> Any:
        found = function(*fixed, *arrays)
        for leaf in jax.tree.leaves(found):
            if not isinstance(leaf, jax.Array | np.ndarray | np.generic | int | float):
                raise _wrong(config, name, "arrays", describe_object(leaf))
        return found

    return jax.eval_shape(run, *arrays)


def _pair(config: Config, name: str, function: Callable[..., Any], *arguments: Any) -> tuple[Any, Any]:
    found = _shapes(config, name, function, *arguments)
    if not (isinstance(found, tuple) and len(found) == 2):
        raise _wrong(config, name, "two things", describe_object(found))
    return found


def _check_integers(config: Config, name: str, found: Any, *shape: int) -> None:
    wanted = f"int32{list(shape)} for an input of such a size"
    if not isinstance(found, jax.ShapeDtypeStruct):
        raise _wrong(config, name, wanted, describe_object(found))
    if found.shape != shape or not jnp.issubdtype(found.dtype, jnp.integer):
        raise _wrong(config, name, wanted, f"{found.dtype}{list(found.shape)}")


def _check_metrics(config: Config, name: str, metrics: Any) -> None:
    wanted = "metrics as a dict of float32[] by name"
    if not isinstance(metrics, dict):
        raise _wrong(config, name, wanted, describe_object(metrics))
    for metric, value in metrics.items():
        if not isinstance(metric, str) or not isinstance(value, jax.ShapeDtypeStruct) or value.shape:
            shape = f" of shape {value.shape}" if isinstance(value, jax.ShapeDtypeStruct) else ""
            raise _wrong(config, name, wanted, f"{metric!r}{shape}")
        if metric in (*RUN_METRICS, *VAE_METRICS):
            raise _wrong(config, name, "metrics of other names than those that every run has", f"'{metric}'")
