"""Times the parts of a training step with pytest-benchmark; a call runs a part for `STEPS` steps of the workload.

    pytest -n0 benchmarks/bench_parts.py
    pytest -n0 benchmarks/bench_parts.py -k "physics or rendering" --benchmark-autosave --benchmark-compare

The tests run one part without timing. Times are of all devices together and of an untrained state; `throughput.py`
times the same parts of a trained state, per decision and with their minimum times.
"""

from __future__ import annotations

from measurement.command import in_a_sentence

import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from pytest_benchmark.fixture import BenchmarkFixture

from edqn_jax.devices.devices import choose_devices, use_cpu_devices
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.trainer import AXIS, Trainer
from measurement.flags import parse_config
from measurement.parts import PARTS, Moment
from measurement.timing import Timed
from measurement.whole import steady

STEPS = 20
"""Enough that the start of a compiled program is a small share of the time of a small part."""

use_cpu_devices()


@pytest.fixture(scope="session")
def now() -> Moment:
    """Returns the state before the first step, with the step number after the warm-up, so that everything learns.

    The environment variable EDQN_FLAGS sets options of train.py; without it the reference workload is timed.
    """
    config = parse_config(os.environ.get("EDQN_FLAGS", "").split())
    config = steady(config, config.train.chunk_steps)
    world = run_missions(config).training.env_params
    state = Trainer(config, world, jax.devices()[:1]).init(config.train.seed)
    return Moment(config, world, dataclasses.replace(state, step=jnp.int32(Schedule.from_config(config).learn_from)))


@pytest.mark.parametrize("name", PARTS)
def test_part(name: str, now: Moment, benchmark: BenchmarkFixture) -> None:
    train = now.config.train
    mesh = Mesh(np.asarray(choose_devices(train.devices, train.shards)), (AXIS,))
    part = Timed(PARTS[name](now), mesh, train.num_envs)
    benchmark.extra_info["decisions"] = STEPS * train.num_envs
    assert benchmark(part.seconds, STEPS) > 0


@in_a_sentence
def main() -> int:
    """Prints how pytest runs this file."""
    print(__doc__)
    return 0


if __name__ == "__main__":
    main()
