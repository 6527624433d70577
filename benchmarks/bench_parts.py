"""pytest-benchmark over the parts of a training step: a call is what a part does in `STEPS` steps of the workload.

    pytest -n0 benchmarks/bench_parts.py
    pytest -n0 benchmarks/bench_parts.py -k "physics or rendering" --benchmark-autosave --benchmark-compare

Ordinary test runs leave it alone but for one part, which they run untimed. Timings are of all devices at once, on a
fresh state: `throughput.py` times the same parts on a trained one, per decision and beside their floors.
"""

from __future__ import annotations

import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from pytest_benchmark.fixture import BenchmarkFixture

from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.trainer import AXIS, Plan, Trainer
from edqn_jax.parallel.devices import choose_devices, use_cpu_devices
from measurement.flags import configured
from measurement.parts import PARTS, Moment
from measurement.timing import Timed
from measurement.whole import steady

STEPS = 20
"""Enough that starting a compiled program does not pass for a small part's own time."""

use_cpu_devices()


@pytest.fixture(scope="session")
def now() -> Moment:
    """The state before the first step, told that it is past the beginning, so that everything learns.

    EDQN_FLAGS, train.py's, say of which workload; without it the reference.
    """
    config = configured(os.environ.get("EDQN_FLAGS", "").split())
    config = steady(config, config.train.chunk_steps)
    world = run_missions(config).training.world
    state = Trainer(config, world, jax.devices()[:1]).init(config.train.seed)
    return Moment(config, world, dataclasses.replace(state, step=jnp.int32(Plan.of(config).learn_from)))


@pytest.mark.parametrize("name", PARTS)
def test_part(name: str, now: Moment, benchmark: BenchmarkFixture) -> None:
    train = now.config.train
    mesh = Mesh(np.asarray(choose_devices(train.devices, train.shards)), (AXIS,))
    part = Timed(PARTS[name](now), mesh, train.num_envs)
    benchmark.extra_info["decisions"] = STEPS * train.num_envs
    assert benchmark(part.seconds, STEPS) > 0
