"""Several processes that train one policy: joining them, and collectives on the host.

Each process runs the same program on its own devices, and JAX joins all devices into one mesh. So every process must
take the same branches in the host loop: one that takes another branch leaves the others waiting for it.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NoReturn, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.errors import ConfigError

T = TypeVar("T")
Tree = TypeVar("Tree")

HEARTBEAT_S = 40
"""Silence of a process after which the others end; less than a minute, more than a busy host's pauses."""

LONGEST_SENTENCE = 1024
"""Bytes of an error message that are sent to the other processes."""


def join_cluster(arguments: Mapping[str, Any]) -> int:
    """Joins the other processes, waiting at most five minutes; must be called before JAX is first used.

    JAX ends the program, without an exception, if a process is missing.

    Args:
        arguments: of `jax.distributed.initialize`; JAX takes missing ones from the variables of Slurm, Open MPI
            or Kubernetes.

    Returns:
        the number of this process; process 0 writes the run directory.

    Raises:
        ConfigError: if no cluster is detected, or its processes have different numbers of devices.
    """
    # Otherwise JAX installs its own handler of SIGTERM.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(**arguments, heartbeat_timeout_seconds=HEARTBEAT_S)
    except ValueError as error:
        raise ConfigError(
            "JAX detects no cluster to join; give --coordinator-address, --num-processes and --process-id, "
            f"or --distributed never ({error})"
        ) from None
    counts = Counter(device.process_index for device in jax.devices())
    if len(set(counts.values())) > 1:
        raise ConfigError(
            f"every process must have equally many devices, not {min(counts.values())} and {max(counts.values())}; "
            "on CPUs --train.devices sets the same number for all"
        )
    return jax.process_index()


def abort_process(error: Exception, own: ConfigError | None = None) -> NoReturn:
    """Ends this process, with a sentence, after an error that others of the cluster may have caused.

    At once: JAX would wait at the exit for those that are gone.

    Args:
        error: of JAX.
        own: what to say if this process alone caused it; the exit code is then 2, else 1.
    """
    reason = " ".join(str(error).split())[:200]
    lost = f"another process of the cluster has ended or cannot be reached; the run can be continued ({reason})"
    print(f"edqn: {lost if own is None else own}", file=sys.stderr, flush=True)
    os._exit(1 if own is None else 2)


def run_synchronised(work: Callable[[], T]) -> T:
    """Returns `work()`, or raises on every process if it fails on one; every process must call this.

    Raises:
        ConfigError: on every process, if `work` raises it on any; the message is that of the first such process.
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


def check_equal(text: str) -> None:
    """Raises on every process unless all have the same text, such as their options; every process must call this.

    Raises:
        ConfigError: if one differs.
    """
    if not jax.distributed.is_initialized():
        return
    digest = np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint8)
    if len({row.tobytes() for row in multihost_utils.process_allgather(digest)}) > 1:
        raise ConfigError(
            "the processes have different options or world files; give all of them the same ones, --tuned-for "
            "cpu or gpu included; all need a C compiler (with GPUs, CUDA's), or EDQN_JAX_NATIVE=0"
        )


def broadcast_from_first(content: bytes | None) -> bytes:
    """Broadcasts the bytes of process 0; every process must call this, all others with None."""
    if not jax.distributed.is_initialized():
        assert content is not None
        return content
    length = int(multihost_utils.broadcast_one_to_all(np.asarray(len(content or b""))))
    sent = np.frombuffer(content, np.uint8) if content is not None else np.zeros(length, np.uint8)
    return np.asarray(multihost_utils.broadcast_one_to_all(sent)).tobytes()


def any_process(flag: bool) -> bool:
    """Returns whether `flag` is true on any process; every process must call this."""
    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def replicate(tree: Any, mesh: Mesh) -> Any:
    """Copies arrays that are equal on every process to every device of a mesh, which may span processes."""
    # Through the host: JAX cannot move an array that is committed to one device to another process.
    return jax.device_put(jax.tree.map(np.asarray, tree), NamedSharding(mesh, PartitionSpec()))


def fetch_global(tree: Tree) -> Tree:
    """Returns each array of a mesh of all processes, gathered on the host; every process must call this."""
    return multihost_utils.process_allgather(tree, tiled=True)
