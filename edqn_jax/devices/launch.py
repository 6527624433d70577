"""How a process was started: alone, or as one of several that train one policy. Does not import JAX."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from edqn_jax.errors import ConfigError

Distributed = Literal["auto", "never", "must"]


def how_to_join(
    distributed: Distributed,
    coordinator_address: str | None,
    num_processes: int | None,
    process_id: int | None,
    environment: Mapping[str, str],
) -> dict[str, Any] | None:
    """Returns the arguments for `processes.join_cluster`, or None for a process that trains alone.

    Args:
        distributed: `auto` joins if the next three are given or `srun` has started several tasks, `must` joins
            any cluster that JAX detects, `never` trains alone.
        coordinator_address: host and port of process 0.
        num_processes: number of processes on all hosts.
        process_id: number of this process, from 0.
        environment: environment variables of this process.

    Raises:
        ConfigError: if they contradict each other.
    """
    by_hand = {
        "--coordinator-address": coordinator_address,
        "--num-processes": num_processes,
        "--process-id": process_id,
    }
    given = [name for name, value in by_hand.items() if value is not None]
    if distributed == "never":
        if given:
            raise ConfigError(f"--distributed never joins no other process; leave out {given[0]}")
        return None
    if coordinator_address is not None and num_processes is not None and process_id is not None:
        if not coordinator_address.rpartition(":")[2].isdecimal():
            raise ConfigError(f"--coordinator-address must be HOST:PORT, not '{coordinator_address}'")
        if num_processes < 1:
            raise ConfigError(f"--num-processes must be at least 1, not {num_processes}")
        if not 0 <= process_id < num_processes:
            raise ConfigError(
                f"--process-id must be from 0 to {num_processes - 1}, one less than --num-processes, not {process_id}"
            )
        return {
            "coordinator_address": coordinator_address,
            "num_processes": num_processes,
            "process_id": process_id,
            # Without this JAX still detects a cluster, to choose this process's devices.
            "cluster_detection_method": "deactivate",
        }
    if given:
        missing = next(name for name in by_hand if name not in given)
        raise ConfigError(f"{', '.join(by_hand)} must be given together; {missing} is missing")
    # Tasks of this job step. SLURM_NTASKS, which JAX reads, counts the whole allocation in an interactive shell:
    # a program started there without `srun` would wait for tasks that are never started.
    if distributed == "must" or int(environment.get("SLURM_STEP_NUM_TASKS", 1)) > 1:
        return {}
    return None
