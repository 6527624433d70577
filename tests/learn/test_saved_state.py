"""A train state on the host and back, on any number of devices."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.learn import saved_state
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.trainer import Trainer
from edqn_jax.sim.task.env import EnvParams
from tests.support.configs import TINY
from tests.support.miniature import miniature_world


@pytest.fixture(scope="module")
def world() -> EnvParams:
    return miniature_world(TINY)


@pytest.mark.whole
@pytest.mark.slow
def test_the_state_of_several_agents_comes_back_on_another_number_of_devices(world: EnvParams) -> None:
    one, two = (Trainer(TINY, [world] * 2, jax.devices()[:count]) for count in (1, 2))
    state = two.init([3, 4])
    found = saved_state.to_host(two, state, done=0)
    shapes = {name: (array.shape, str(array.dtype)) for name, array in found.items()}
    saved_state.check_shapes(shapes, saved_state.state_shapes(one, done=0))
    there = saved_state.from_host(one, found)
    assert jax.tree.structure(there) == jax.tree.structure(state)
    back = saved_state.to_host(one, there, done=0)
    assert set(back) == set(found)
    for name, array in found.items():
        np.testing.assert_array_equal(back[name], array, err_msg=name)
    laid = jax.tree.map(lambda leaf: leaf.sharding, saved_state.from_host(two, found))
    assert laid == jax.tree.map(lambda leaf: leaf.sharding, state)


def test_what_no_later_step_reads_is_left_out_and_nothing_else(world: EnvParams) -> None:
    trainer = Trainer(TINY, world, jax.devices()[:1])
    (_, end) = trainer.schedule.vae_training[-1]
    before, after = (set(saved_state.state_shapes(trainer, done)) for done in (end - 1, end))
    assert before > after and all(name.startswith(".actors.samples") for name in before - after)
    learns_on = dataclasses.replace(TINY, encoder=dataclasses.replace(TINY.encoder, keep_learning=True))
    assert Schedule.from_config(learns_on).reads_samples(learns_on, end)


def test_the_array_that_does_not_fit_is_named() -> None:
    wanted = {".q": ((3, 4), "float32"), ".step": ((), "int32")}
    saved_state.check_shapes(wanted, wanted)
    for found, says in (
        ({".q": ((3, 4), "float32")}, r"it has no '\.step'"),
        ({**wanted, ".more": ((), "bool")}, r"it has '\.more', which this version does not know"),
        ({**wanted, ".q": ((3, 5), "float32")}, r"its '\.q' is float32 \[3, 5\] where float32 \[3, 4\] is needed"),
    ):
        with pytest.raises(ConfigError, match=says):
            saved_state.check_shapes(found, wanted)
