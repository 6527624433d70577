"""How a part of the training step is timed, and the minimum time that it could take."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.devices.devices import compiler_options
from edqn_jax.learn.trainer import AXIS
from edqn_jax.native.own_programs import own_program

TURN_SECONDS = 0.4
"""Approximate duration of a turn of a part."""

Body = Callable[[Any, Any], Any]
"""(constant, carry) -> carry"""


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of the step for the environments of one device: `body` maps `carry` to the next one."""

    name: str
    body: Body
    constant: Any  # read in every iteration
    carry: Any  # read and written in every iteration
    specs: tuple[Any, Any] = (PartitionSpec(), PartitionSpec(AXIS))  # layout of both on the devices
    scans: int = 1  # iterations of a scan inside whose operations are counted once
    counted: Body | None = None  # its operations are counted instead of those of `body`, `scans` times
    products: bool = False  # whether its arithmetic consists of matrix products
    by_hand: float | None = None  # operations of all decisions, if XLA cannot count them
    countable: bool = True  # whether its operations can be counted: not if only some of them are in a scan
    moved: int | None = None  # minimum bytes that an iteration reads and writes; None for twice those of the carry


def depending_on(value: Array, *results: Any) -> Array:
    """Returns `value` so that the compiler must compute all of `results`."""
    total = sum(jnp.sum(leaf.astype(jnp.float32)) for leaf in jax.tree.leaves(results))
    return jnp.where(total > 1e30, value + 1, value)


def force_computation(before: Any, after: Any, value: Array) -> Any:
    """Returns `before` so that the compiler must compute all of `after`; `value` must not be negative anywhere."""
    never = jnp.any(value < 0)
    return jax.tree.map(lambda old, new: jnp.where(never, new, old), before, after)


class Timed:
    """A part, compiled as a loop on all devices."""

    def __init__(self, part: Part, mesh: Mesh, decisions: int) -> None:
        self.part, self.decisions, self.devices = part, decisions, mesh.size
        layout = partial(jax.tree.map, lambda spec: NamedSharding(mesh, spec), is_leaf=_is_spec)
        self.inputs = tuple(
            _lay(x, layout(spec)) for x, spec in zip((part.constant, part.carry), part.specs, strict=True)
        )

        def turn(constant: Any, _: Any, carry: Any) -> Any:
            # The barrier keeps constant computations in the loop.
            return part.body(*jax.lax.optimization_barrier((constant, carry)))

        def loop(constant: Any, carry: Any, times: Array) -> Any:
            return jax.lax.fori_loop(0, times, partial(turn, constant), carry)

        specs = (*part.specs, PartitionSpec())
        spread = jax.shard_map(loop, mesh=mesh, in_specs=specs, out_specs=part.specs[1], check_vma=False)
        options = compiler_options(mesh.devices.flat[0].platform)
        with own_program():  # as a trainer's programs are
            lowered = jax.jit(spread).lower(*self.inputs, jnp.int32(1))
        self.loop = lowered.compile(options)
        first = min(self.seconds(1) for _ in range(2))
        self.times = max(1, round(TURN_SECONDS / first))

    def seconds(self, times: int) -> float:
        """Returns the seconds of `times` iterations."""
        began = time.perf_counter()
        jax.block_until_ready(self.loop(*self.inputs, jnp.int32(times)))
        return time.perf_counter() - began

    def turn(self) -> float:
        """Returns the microseconds of one device per decision."""
        return 1e6 * self.seconds(self.times) * self.devices / (self.times * self.decisions)

    def floor(self, ceilings: dict[str, float]) -> dict[str, float]:
        """Returns operations and bytes of a decision, and the minimum time they take, in microseconds of one device.

        Operations are XLA's count before optimisation, with a transcendental as one; the compiler may remove some of
        them. Bytes are those of the part's inputs and outputs, each once.
        """
        part = self.part
        once = operations(part) if part.countable else None
        if once is None:
            return {}
        count = part.scans * once / self.decisions
        size = (2 * size_of(part.carry) if part.moved is None else part.moved) / self.decisions
        rate = ceilings["product_flops" if part.products else "vector_flops"]
        floor = 1e6 * max(count / rate, size / ceilings["copy_bytes"])
        return {"operations": count, "bytes": size, "floor_us": floor}


def operations(part: Part) -> float | None:
    """Returns XLA's count for all decisions, with the body of a scan once; None if XLA does not count (on a GPU)."""
    alone = Mesh(np.asarray(jax.devices()[:1]), (AXIS,))
    if part.by_hand is not None:
        return part.by_hand
    body = part.counted or part.body
    once = jax.shard_map(body, mesh=alone, in_specs=part.specs, out_specs=part.specs[1], check_vma=False)
    return operations_of(once, part.constant, part.carry)


def operations_of(function: Callable[..., Any], *inputs: Any) -> float | None:
    """Returns XLA's count of a function's operations, with a transcendental as one; None if XLA does not count."""
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), inputs)
    counted: Any = jax.jit(function).lower(*shapes).cost_analysis()
    return None if counted is None else counted.get("flops", 0.0) + counted.get("transcendentals", 0.0)


def size_of(tree: Any) -> int:
    """Returns the bytes of all arrays, or of all shapes from `jax.eval_shape`, in a tree."""
    shapes = jax.eval_shape(partial(jax.tree.map, _raw), tree)
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))


def _raw(leaf: Array) -> Array:
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _is_spec(x: Any) -> bool:
    return isinstance(x, PartitionSpec)


def _lay(tree: Any, layout: Any) -> Any:
    """Returns `tree` on the devices; `layout` is a prefix of it."""
    if isinstance(layout, tuple):
        return tuple(_lay(x, y) for x, y in zip(tree, layout, strict=True))
    return jax.device_put(tree, layout)
