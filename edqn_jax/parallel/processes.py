"""Several processes that train one policy: how they find each other, and what they tell one another.

Each process runs the same program on its own devices, and JAX joins all devices into one mesh. So whatever steers
the host loop must be decided alike everywhere: a process that goes another way leaves the others waiting for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.errors import ConfigError

T = TypeVar("T")
Tree = TypeVar("Tree")

LONGEST_SENTENCE = 1024
"""Bytes of an error that the other processes are told."""


def join(arguments: Mapping[str, Any]) -> int:
    """Waits for all processes, at most five minutes, and becomes one of them; before JAX is first used.

    JAX ends the program, without an exception, if they do not all come.

    Args:
        arguments: of `jax.distributed.initialize`; what is missing JAX finds in Slurm's, Open MPI's or
            Kubernetes' variables.

    Returns:
        this process's number; number 0 is the one that writes.

    Raises:
        ConfigError: if there is no cluster to be found, or its processes differ in their number of devices.
    """
    # Or JAX would take SIGTERM for itself, until somebody takes it back.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(**arguments)
    except ValueError as error:
        raise ConfigError(
            "JAX finds no cluster to join here; give --coordinator-address, --num-processes and --process-id, "
            f"or --distributed never ({error})"
        ) from None
    counts = Counter(device.process_index for device in jax.devices())
    if len(set(counts.values())) > 1:
        raise ConfigError(
            f"every process must have equally many devices, not {min(counts.values())} and {max(counts.values())}; "
            "on CPUs --train.devices gives all of them as many"
        )
    return jax.process_index()


def together(work: Callable[[], T]) -> T:
    """What `work()` returns; every process must call this, and none goes on if one of them cannot.

    Raises:
        ConfigError: on every process, if `work` raises it on any; the words are those of the first that did.
    """
    if not jax.distributed.is_initialized():
        return work()
    result, sentence = None, ""
    try:
        result = work()
    except ConfigError as error:
        sentence = str(error)
    padded = np.zeros(LONGEST_SENTENCE, np.uint8)
    encoded = np.frombuffer(sentence.encode()[:LONGEST_SENTENCE], np.uint8)
    padded[: len(encoded)] = encoded
    for told in multihost_utils.process_allgather(padded):
        if told.any():
            raise ConfigError(told.tobytes().rstrip(b"\0").decode(errors="ignore"))
    return result  # type: ignore[return-value]


def on_any(flag: bool) -> bool:
    """Whether `flag` is true on any process; every process must call this."""
    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def replicate(tree: Any, mesh: Mesh) -> Any:
    """The arrays of `tree`, the same on every process, onto every device of a mesh that may span processes."""
    # By way of the host: MJX commits its arrays to one device, and an array leaves that for no other process.
    return jax.device_put(jax.tree.map(np.asarray, tree), NamedSharding(mesh, PartitionSpec()))


def fetch(tree: Tree) -> Tree:
    """The whole of each array of a mesh of all processes, on each one's host; every process must call this."""
    return multihost_utils.process_allgather(tree, tiled=True)
