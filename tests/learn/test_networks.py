"""A Q-network of one's own: by its name in the policy, saved and loaded, and refused where it does not fit."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import edqn_jax
from edqn_jax.config import NETWORKS, Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.learn import qnetwork
from edqn_jax.learn.actor import observation_size
from edqn_jax.learn.dqn.learner import DQN
from edqn_jax.learn.policy import Policy, fresh_policy
from tests.support.registries import keep_as_they_are


class Linear(nn.Module):
    """One layer."""

    config: Any
    moves: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return nn.Dense(self.moves)(x)


class Normalised(Linear):
    """One that has batch statistics."""

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return nn.Dense(self.moves)(nn.BatchNorm(use_running_average=True)(x))


@pytest.fixture
def config(monkeypatch: pytest.MonkeyPatch) -> Config:
    keep_as_they_are(monkeypatch)
    NETWORKS.register("linear", Linear)
    return make_config("paper", env={"sensor": "blind"}, agent={"network": "linear"})


def test_the_learner_trains_and_the_policy_flies_the_network_that_is_named(config: Config) -> None:
    inputs = config.agent.history * observation_size(config)
    state = DQN.init(config, jax.random.key(0))
    assert jax.tree.map(jnp.shape, state.q) == {"Dense_0": {"kernel": (inputs, 27), "bias": (27,)}}
    memory = jax.random.normal(jax.random.key(1), (5, config.agent.history, observation_size(config)))
    layer = state.q["Dense_0"]
    values = memory.reshape(5, -1) @ layer["kernel"] + layer["bias"]
    np.testing.assert_array_equal(DQN.decide(config, state.q, memory), jnp.argmax(values, axis=-1))


def test_a_saved_policy_is_loaded_where_its_network_is_registered_alone(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = Policy(config, fresh_policy(config))
    edqn_jax.save_policy(policy, tmp_path / "saved")
    loaded = edqn_jax.load_policy(tmp_path / "saved")
    assert loaded.config.agent.network == "linear"
    jax.tree.map(np.testing.assert_array_equal, loaded.params.q, policy.params.q)
    monkeypatch.delitem(NETWORKS._entries, "linear")
    with pytest.raises(ConfigError, match="there is no network 'linear'; known are mlp, or one that --import reg"):
        edqn_jax.load_policy(tmp_path / "saved")


@pytest.mark.parametrize(
    ("network", "says"),
    [
        (
            lambda config, moves: Linear(config, moves + 1),
            r"must return \[27\] values for \[20\] inputs, not \[28\]",
        ),
        (Normalised, "'other' must have parameters alone, not batch_stats"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(config: Config, network: Any, says: str) -> None:
    NETWORKS.register("other", network)
    agent = dataclasses.replace(config.agent, network="other")
    with pytest.raises(ConfigError, match=says):
        qnetwork.init_q(agent, observation_size(config), 27, jax.random.key(0))
