"""A train state as arrays on the host, by name, and back: what a checkpoint holds.

Names and values depend neither on devices nor on processes. What no later step reads is left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.devices import processes
from edqn_jax.errors import ConfigError
from edqn_jax.learn.state import TrainState
from edqn_jax.learn.trainer import Trainer

Shape = tuple[tuple[int, ...], str]
"""Shape and type of an array on the host."""


def drop_spent_samples(trainer: Trainer, state: TrainState, done: int) -> TrainState:
    """Returns the state after `done` steps without the VAE's samples if the VAE never learns again."""
    if trainer.schedule.reads_samples(trainer.config, done):
        return state
    return dataclasses.replace(state, actors=dataclasses.replace(state.actors, samples=None))


def to_host(trainer: Trainer, state: TrainState, done: int) -> dict[str, np.ndarray]:
    """Returns the arrays of the state after `done` steps; every process must call this."""
    return {
        name: processes.fetch_global(_plain(leaf))
        for name, leaf in _named(drop_spent_samples(trainer, state, done)).items()
    }


def state_shapes(trainer: Trainer, done: int) -> dict[str, Shape]:
    """Returns the names, shapes and types of the arrays of a state after `done` steps."""
    shapes = jax.eval_shape(
        lambda state: jax.tree.map(_plain, state), drop_spent_samples(trainer, trainer.shapes(), done)
    )
    return {name: (leaf.shape, str(leaf.dtype)) for name, leaf in _named(shapes).items()}


def check_shapes(found: Mapping[str, Shape], wanted: Mapping[str, Shape]) -> None:
    """Raises unless a saved state has the arrays that a run needs.

    Raises:
        ConfigError: names the first array that is missing, too many or different.
    """
    for name in sorted(set(found) | set(wanted)):
        if name not in found:
            raise ConfigError(f"it has no '{name}'")
        if name not in wanted:
            raise ConfigError(f"it has '{name}', which this version does not know")
        if found[name] != wanted[name]:
            raise ConfigError(f"its '{name}' is {_text(found[name])} where {_text(wanted[name])} is needed")


def from_host(trainer: Trainer, arrays: Mapping[str, np.ndarray]) -> TrainState:
    """Returns the state of arrays as `state_shapes` describes them, laid out over the devices."""

    def placed(path: Any, leaf: jax.ShapeDtypeStruct) -> Array:
        found = arrays.get(jax.tree_util.keystr(path))
        if _is_key(leaf):
            assert found is not None
            return jax.jit(jax.random.wrap_key_data, out_shardings=leaf.sharding)(found)
        if found is None:  # what no later step reads
            return jax.jit(lambda: jnp.zeros(leaf.shape, leaf.dtype), out_shardings=leaf.sharding)()
        assert leaf.sharding is not None
        return jax.make_array_from_callback(leaf.shape, leaf.sharding, lambda index: found[index])

    return jax.tree_util.tree_map_with_path(placed, trainer.shapes())


def _named(tree: Any) -> dict[str, Any]:
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def _plain(leaf: Any) -> Any:
    """Returns the words of typed keys; other arrays as they are."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _text(shape: Shape) -> str:
    return f"{shape[1]} {list(shape[0])}"
