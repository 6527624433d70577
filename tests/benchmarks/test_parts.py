"""The parts of the training step: how their operations are counted, and what they do."""

from __future__ import annotations

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from jax.sharding import Mesh

from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import init_state
from edqn_jax.learn.trainer import AXIS
from measurement.flags import parse_config
from measurement.parts import PARTS, Moment, parts_of
from measurement.timing import Part, Timed, depending_on, operations, size_of
from measurement.whole import steady
from tests.support.miniature import MINIATURE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def now() -> Moment:
    """A fresh state that is told it is past the beginning."""
    config = steady(parse_config((*MINIATURE, "--drone.physics", "mjx")), 8)
    world = run_missions(config).training.env_params
    state = jax.jit(lambda world, key: init_state(config, world, key))(world, jax.random.key(0))
    return Moment(config, world, dataclasses.replace(state, step=jnp.int32(Schedule.from_config(config).learn_from)))


def with_steps(now: Moment, steps: int) -> Part:
    """The physics of decisions of so many steps."""
    drone = dataclasses.replace(now.config.drone, physics_steps=steps)
    return PARTS["physics"](dataclasses.replace(now, config=dataclasses.replace(now.config, drone=drone)))


def test_every_part_is_named_as_its_row(now: Moment) -> None:
    assert [part.name for part in parts_of(now.config, now.world, now.state)] == list(PARTS)


def test_a_scan_is_counted_once_so_physics_counts_one_step_and_multiplies(now: Moment) -> None:
    part = with_steps(now, 26)
    assert part.scans == 26
    single = operations(part)
    once, often = (operations(dataclasses.replace(with_steps(now, steps), counted=None)) for steps in (1, 26))
    assert single is not None and once is not None and often is not None
    # The single step is nearly all of a decision of one; 25 steps more add less than one step to the count.
    assert 0.9 * once < single < once
    assert often - once < single


def test_environments_that_have_ended_fly_on_where_resets_are_left_out(now: Moment) -> None:
    state = dataclasses.replace(now.environments, ended=jnp.ones(16, bool), decision=jnp.full(16, 7))
    body = jax.jit(PARTS["environment_without_resets"](now).body)
    after, _ = body(now.world, (state, now.moves))
    assert after.decision.tolist() == 16 * [7]  # always from where training has come to
    after, _ = body(now.world, (state, jnp.full_like(now.moves, -1)))  # a move that there is not shows what was flown
    assert after.decision.tolist() == 16 * [8]


def test_what_does_not_change_is_computed_in_every_turn_all_the_same() -> None:
    def body(constant: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        same, result = carry
        return same, depending_on(result, jnp.sin(constant), jnp.tan(same))

    mesh = Mesh(np.asarray(jax.devices()[:1]), (AXIS,))
    part = Part("constant", body, jnp.ones(64), (jnp.ones(64), jnp.zeros(64)))
    program = str(Timed(part, mesh, 64).loop.as_text())
    found = dict(re.findall(r"^(?:ENTRY )?%?([\w.-]+) \(.*?\{\n(.*?)^\}", program, re.M | re.S))
    (entry,) = (name for name in found if name.startswith("main"))
    once, new = {entry}, {entry}
    while new:  # all that is called from there, but for the loop
        new = {name for at in new for name in re.findall(r"(?:calls|to_apply)=%?([\w.-]+)", found[at])} - once
        once |= new
    for operation in (" sine(", " tan("):
        places = {name for name, text in found.items() if operation in text}
        assert places and not places & once


def test_sampling_is_a_part_of_what_the_replay_does(now: Moment) -> None:
    sampling, replay = PARTS["sampling"](now), PARTS["replay"](now)
    agent = now.config.agent
    # 32 values of the code, 10 of the own state and the reward in four bytes each; outcome, reset and move in one.
    row = (32 + 10 + 1) * 4 + 3
    sampled = agent.updates_per_step * agent.batch_size * (agent.history + agent.n_step) * row
    assert sampling.moved == sampled
    assert replay.moved == sampled + 16 * row
    counted = operations(sampling), operations(replay)
    assert counted[0] is not None and counted[1] is not None and 0 < counted[0] <= counted[1]


def test_bytes_are_those_of_the_arrays() -> None:
    tree = {"a": jnp.zeros((3, 5)), "b": jnp.zeros(7, jnp.int8), "keys": jax.random.split(jax.random.key(0), 4)}
    assert size_of(tree) == 3 * 5 * 4 + 7 + 4 * 2 * 4
    assert size_of(jax.eval_shape(lambda: tree)) == size_of(tree)
