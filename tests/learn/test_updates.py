"""How often the VAE is updated in a step, and what is told of the updates that were made."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.learn.dqn.learner import DqnState, update_q
from edqn_jax.learn.learner import Rings, UpdateStats
from edqn_jax.learn.state import init_state
from edqn_jax.learn.updates import Networks, update_vae
from tests.support.miniature import miniature_world

IN_WARMUP, LATER = 2, 20


def miniature(updates: int, keeps: bool) -> Config:
    encoder = {"warmup_decisions": 64, "batch_size": 16, "replay_size": 512}
    return make_config(
        "paper",
        camera={"width": 8, "height": 6},
        drone={"physics": "rigid_body"},
        encoder=encoder | {"warmup_updates_per_step": updates, "keep_learning": keeps},
        agent={"batch_size": 16, "replay_size": 512, "learning_starts": 64},
        train={"num_envs": 16, "chunk_steps": 8, "total_steps": 16 * 64},
        world={"missions": 16},
    )


def updated(updates: int, keeps: bool, step: int) -> tuple[Networks, UpdateStats, Networks]:
    """Returns the networks before a step's updates, what is told of these, and the networks after them."""
    config = miniature(updates, keeps)
    world = miniature_world(config)
    state = jax.jit(lambda key: init_state(config, world, key))(jax.random.key(0))
    stats, after = jax.jit(
        lambda networks, rings, keys: update_vae(config, None, networks, rings, keys, jnp.int32(step))
    )(state.learner, state.actors.samples, state.actors.key)
    return state.learner, stats, after


def updates_made(networks: Networks) -> int:
    """Returns how often Adam has been asked."""
    return int(networks.vae_optimiser.inner_state[0].count)


def equal(one: object, other: object) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


@pytest.mark.whole
@pytest.mark.parametrize("keeps", [True, False])
def test_the_warmup_makes_its_updates_and_later_steps_one_or_none(keeps: bool) -> None:
    before, stats, after = updated(3, keeps, IN_WARMUP)
    assert updates_made(after) == 3 and not equal(before.vae, after.vae)
    assert np.isfinite(stats.metrics["reconstruction_loss"]) and not stats.ill_losses and not stats.ill_gradients
    before, stats, after = updated(3, keeps, LATER)
    assert updates_made(after) == int(keeps)
    assert equal(before.vae, after.vae) == (not keeps)
    assert bool(np.isnan(stats.metrics["kl"])) == (not keeps)


@pytest.mark.whole
def test_a_later_update_does_not_depend_on_how_many_the_warmup_makes() -> None:
    assert equal(updated(3, True, LATER)[2].vae, updated(1, True, LATER)[2].vae)


@pytest.mark.whole
def test_each_update_takes_its_own_keys_as_debug_checks() -> None:
    with jax.debug_key_reuse(True):
        assert updates_made(updated(3, True, IN_WARMUP)[2]) == 3


def test_only_updates_that_were_made_are_told_of() -> None:
    loss = jnp.array([1.0, np.nan, 3.0, 100.0])
    finite = jnp.array([True, False, True, False])
    stats = UpdateStats.from_updates(loss, {"loss": loss}, finite, made=jnp.int32(3))
    assert (float(stats.metrics["loss"]), int(stats.ill_losses), int(stats.ill_gradients)) == (2.0, 1, 1)
    stats = UpdateStats.from_updates(loss, {"loss": loss}, finite)
    assert (float(stats.metrics["loss"]), int(stats.ill_losses), int(stats.ill_gradients)) == (
        np.float32(104 / 3),
        1,
        2,
    )
    stats = UpdateStats.from_updates(loss, {"loss": loss}, finite, made=jnp.int32(0))
    assert np.isnan(stats.metrics["loss"]) and not stats.ill_losses and not stats.ill_gradients


def test_target_and_average_follow_the_q_network_at_rates_of_their_own() -> None:
    config = miniature(1, True)
    config = dataclasses.replace(
        config, agent=dataclasses.replace(config.agent, target_rate=0.5, average_rate=0.125, updates_per_step=1)
    )
    world = miniature_world(config)
    state = jax.jit(lambda key: init_state(config, world, key))(jax.random.key(0))
    before = state.learner.agent

    def update(agent: DqnState, replay: Any, keys: jax.Array) -> tuple[UpdateStats, DqnState]:
        return update_q(config, None, agent, Rings(replay, jnp.int32(20), keys), 0.0)

    replay = state.actors.replay.replace(reward=jnp.ones_like(state.actors.replay.reward))
    _, after = jax.jit(update)(before, replay, state.actors.key)
    assert not equal(before.q, after.q)
    for name, rate in (("target", 0.5), ("average", 0.125)):
        wanted = jax.tree.map(lambda new, old, rate=rate: rate * new + (1 - rate) * old, after.q, getattr(before, name))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), getattr(after, name), wanted)
