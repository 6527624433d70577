"""What a sensor remembers as an episode begins, drawn for those environments alone that are reset.

In a step these are few, and a sensor's faults are several random numbers for each pixel. `vmap` would draw them for
every environment, so it has a rule of its own here: however often it maps, all environments are one array, and those
that are reset are taken from it in portions. M environments.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_batching import custom_vmap

from edqn_jax.config import Config
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.sensors.sensor import SensorMemory
from edqn_jax.sim.task.decision import select_tree

PORTIONS = 16
"""Number in which all environments would be drawn; one usually has room for those that are reset."""


def renew(config: Config, is_reset: Array, key: Array, memory: SensorMemory) -> SensorMemory:
    """Returns the sensor's memory at rest where `is_reset` [] holds, else `memory`; `key` is consumed."""
    at_rest = partial(sensor.at_rest, config)
    # A loop costs more than a few numbers do, and Checkify does not look into a function with a rule for `vmap`.
    if config.train.debug or _size(memory) < config.camera.width * config.camera.height:
        return select_tree(is_reset, at_rest(key), memory)
    alone = jax.tree.map(lambda x: jnp.asarray(x)[None], (is_reset, key, memory))
    return jax.tree.map(lambda x: x[0], _mapped_as_one(at_rest)(*alone))


def _size(tree: Any) -> int:
    return sum(jnp.size(leaf) for leaf in jax.tree.leaves(tree))


def _mapped_as_one(at_rest: Callable[[Array], Any]) -> Callable[[Array, Array, Any], Any]:
    """Returns `_renew_all` of a sensor, with a rule for `vmap` that merges a mapped axis into the leading [M]."""
    renew_all = custom_vmap(partial(_renew_all, at_rest))

    @renew_all.def_vmap
    def merge(size: int, is_mapped: list[Any], *arguments: Any) -> tuple[Any, Any]:
        def merged(x: Array, mapped: bool) -> Array:
            rows = x if mapped else jnp.broadcast_to(x, (size, *x.shape))
            return rows.reshape(size * rows.shape[1], *rows.shape[2:])

        renewed = renew_all(*jax.tree.map(merged, arguments, tuple(is_mapped)))
        return jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), renewed), jax.tree.map(lambda x: True, renewed)

    return renew_all


def _renew_all(at_rest: Callable[[Array], Any], is_reset: Array, key: Array, memory: Any) -> Any:
    """Returns the memories [M, ...] at rest where `is_reset` [M] holds, else `memory`."""
    count, wanted = is_reset.shape[0], jnp.sum(is_reset)
    portion = -(-count // PORTIONS)
    # Places beyond the last that is reset are no environment's: what is drawn for them is dropped.
    (places,) = jnp.nonzero(is_reset, size=portion * PORTIONS, fill_value=count)

    def goes_on(carried: tuple[Array, Any]) -> Array:
        return carried[0] * portion < wanted

    def renew_portion(carried: tuple[Array, Any]) -> tuple[Array, Any]:
        number, memory = carried
        here = lax.dynamic_slice_in_dim(places, number * portion, portion)
        fresh = jax.vmap(at_rest)(key.at[here].get(mode="clip"))
        return number + 1, jax.tree.map(lambda old, new: old.at[here].set(new, mode="drop"), memory, fresh)

    return lax.while_loop(goes_on, renew_portion, (jnp.int32(0), memory))[1]
