"""Training with everything checked, for `--debug`: indices, numbers, random keys and shapes.

Checkify takes no loop of a batch whose length differs from drone to drone, nor an index that differs within a batch.
Drones therefore decide one after the other, batches check their indices themselves (`check_index`), and after each
chunk the next decision is taken once more on trial, with every index in it checked.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax import Array
from jax.experimental import checkify

from edqn_jax.config import Config
from edqn_jax.errors import CheckError
from edqn_jax.learn.learner import learner_of
from edqn_jax.learn.updates import merge_shards
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.task.env import EnvParams, EnvState, Step
from edqn_jax.sim.task.task import task_of

Run = Callable[[EnvParams, Any, Array], tuple[Any, Any]]
"""A chunk: from world, train state and the numbers of its steps to the state and what it returns."""


def one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """Maps a function over the leading axis of its arguments as `jax.vmap`, but one after the other."""
    return lambda *args: jax.lax.map(lambda each: function(*each), args)


class CheckedChunk:
    """Runs chunks and raises at the first fault."""

    def __init__(self, config: Config, run: Run, env_params: EnvParams, state: Any, steps: Array) -> None:
        """Compiles.

        Args:
            config: of the run.
            run: does not spread over devices.
            env_params, state, steps: as chunks get them; of the state, the shapes are enough.

        Raises:
            CheckError: if a random key is used twice.
        """
        self._config = config
        errors = checkify.nan_checks | checkify.div_checks | checkify.user_checks
        trial = checkify.checkify(partial(_decide, config), errors=checkify.index_checks)
        try:
            with jax.debug_key_reuse(True):
                self._run = jax.jit(checkify.checkify(run, errors=errors)).lower(env_params, state, steps).compile()
                self._trial = jax.jit(trial).lower(env_params, state.actors.env).compile()
        except jax.errors.KeyReuseError as reuse:
            raise CheckError(f"--debug: a random key is used twice: {_line(reuse)}") from reuse

    def __call__(self, env_params: EnvParams, state: Any, steps: Array) -> tuple[Any, Any]:
        """Returns what the chunk returns.

        Raises:
            CheckError: names what is wrong, and where.
        """
        _check_shapes(self._config, state)
        error, (after, found) = self._run(env_params, state, steps)
        on_trial, _ = self._trial(env_params, after.actors.env)
        first = f"in training steps {int(steps[0])} to {int(steps[-1])}"
        for failed in (error, on_trial):
            if (said := failed.get()) is not None:
                raise CheckError(f"--debug: {first}: {said}")
        _check_shapes(self._config, after)
        return after, found


def _decide(config: Config, env_params: EnvParams, state: EnvState) -> Step:
    """Takes a decision of every environment [S, E], each with another move."""
    state = jax.tree.map(merge_shards, state)
    count = state.decision.shape[0]
    moves = jnp.arange(count, dtype=jnp.int32) % len(ACTIONS)
    return one_by_one(lambda state, move: task_of(config).step(env_params, state, move)[1])(state, moves)


def _check_shapes(config: Config, state: Any) -> None:
    """Raises where an array of the train state has not the axes that it is documented with.

    Raises:
        CheckError: names the array.
    """
    shards, envs = config.train.shards, config.train.num_envs // config.train.shards
    actors, learner = state.actors, state.learner
    try:
        of_each = actors.env, actors.memory, actors.reward, actors.outcome, actors.is_reset, actors.manoeuvre
        chex.assert_tree_shape_prefix((of_each, actors.episodes), (shards, envs))
        rings = actors.replay, *([] if actors.samples is None else [actors.samples])
        chex.assert_tree_shape_prefix((rings, actors.key), (shards,))
        for ring in rings:
            chex.assert_equal_shape_prefix(jax.tree.leaves(ring), 3)
        of_agent = learner_of(config)
        chex.assert_trees_all_equal_shapes_and_dtypes(of_agent.network(learner.agent), of_agent.policy(learner.agent))
        chex.assert_shape(state.step, ())
    except AssertionError as wrong:
        raise CheckError(f"--debug: the train state has a wrong shape: {_line(wrong)}") from wrong


def _line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]
