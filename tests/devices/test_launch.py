"""How a process finds out whether it is one of several."""

from __future__ import annotations

from typing import Any

import pytest

from edqn_jax.devices.launch import Distributed, how_to_join
from edqn_jax.errors import ConfigError

SRUN = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4", "SLURM_STEP_NUM_TASKS": "4", "SLURM_PROCID": "1"}

BY_HAND = {"coordinator_address": "node1:1234", "num_processes": 2, "process_id": 1}

NOTHING: dict[str, Any] = dict.fromkeys(BY_HAND)


@pytest.mark.parametrize(
    ("distributed", "environment", "joins"),
    [
        ("auto", {}, False),
        ("auto", SRUN, True),
        ("never", SRUN, False),
        ("must", {}, True),
        # `srun` with one task, and Python without `srun` in the shell of an allocation of four tasks.
        ("auto", {**SRUN, "SLURM_NTASKS": "1", "SLURM_STEP_NUM_TASKS": "1"}, False),
        ("auto", {**SRUN, "SLURM_STEP_NUM_TASKS": "1"}, False),
        ("auto", {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4"}, False),
    ],
)
def test_a_process_joins_where_srun_started_several_or_it_must(
    distributed: Distributed, environment: dict[str, str], joins: bool
) -> None:
    assert how_to_join(distributed, **NOTHING, environment=environment) == ({} if joins else None)


@pytest.mark.parametrize("address", ["node1:1234", "10.0.0.1:1234", "[::1]:1234"])
def test_flags_say_it_all_by_hand(address: str) -> None:
    given = {**BY_HAND, "coordinator_address": address}
    arguments = how_to_join("auto", **given, environment=SRUN)
    assert arguments == {**given, "cluster_detection_method": "deactivate"}


@pytest.mark.parametrize(
    ("distributed", "given", "says"),
    [
        ("never", {"process_id": 0}, "--distributed never joins no other process; leave out --process-id"),
        (
            "auto",
            {"coordinator_address": "node1:1234", "process_id": 0},
            "must be given together; --num-processes is missing",
        ),
        ("must", {"num_processes": 2, "process_id": 0}, "must be given together; --coordinator-address is missing"),
        ("auto", {**BY_HAND, "coordinator_address": "node1"}, "must be HOST:PORT, not 'node1'"),
        ("auto", {**BY_HAND, "coordinator_address": "node1:http"}, "must be HOST:PORT, not 'node1:http'"),
        ("auto", {**BY_HAND, "num_processes": 0}, "--num-processes must be at least 1, not 0"),
        ("auto", {**BY_HAND, "process_id": 2}, "--process-id must be from 0 to 1, .* not 2"),
        ("auto", {**BY_HAND, "process_id": -1}, "--process-id must be from 0 to 1, .* not -1"),
    ],
)
def test_flags_that_contradict_each_other_are_named(distributed: Distributed, given: dict, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        how_to_join(distributed, **{**NOTHING, **given}, environment={})
