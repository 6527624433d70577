"""The error of predicted distances: its histograms, its figures, and what a whole evaluation says of a decoder."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.decoder import (
    NEAR_M,
    check_predicts_distance,
    error_histograms,
    median_error,
    predicted_distance,
    summarise_errors,
)
from edqn_jax.learn.actor import AgentActor
from edqn_jax.learn.perception.waves import OUTPUT_SCALE
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import FunctionActor
from tests.support.policies import CONFIG, always


def test_the_figures_are_the_quantiles_over_near_pixels():
    rng = np.random.default_rng(0)
    true = rng.uniform(0.2, 20.0, (40, 24, 32)).astype(np.float32)
    predicted = (true * rng.lognormal(0.0, 0.5, true.shape)).astype(np.float32)
    histograms = np.asarray(jax.vmap(error_histograms)(jnp.asarray(predicted), jnp.asarray(true)))
    figures = summarise_errors(histograms, 40)
    near = true < NEAR_M
    metres = np.abs(predicted - true)[near]
    assert (figures["frames"], figures["pixels"]) == (40, near.sum())
    for name, errors in (("relative", metres / true[near]), ("metres", metres)):
        assert figures[f"{name}_median"] == pytest.approx(np.quantile(errors, 0.5), rel=0.01)
        assert figures[f"{name}_p90"] == pytest.approx(np.quantile(errors, 0.9), rel=0.01)
    assert median_error(predicted, true) == pytest.approx(figures["relative_median"], rel=0.01)


def test_what_is_predicted_at_infinity_is_beyond_every_error():
    true = jnp.full((2, 5), 3.0)
    predicted = true.at[0, :2].set(jnp.inf)
    figures = summarise_errors(np.asarray(error_histograms(predicted, true))[None], 1)
    assert figures["relative_median"] == pytest.approx(0.0, abs=1e-3)
    assert figures["relative_p90"] is None and figures["metres_p90"] is None


def test_what_is_far_does_not_count():
    far = jnp.full((2, 5), jnp.inf)
    assert not np.asarray(error_histograms(jnp.ones((2, 5)), far)).any()
    figures = summarise_errors(np.zeros((1, 2, 1000), int), 3)
    assert figures["pixels"] == 0 and figures["relative_median"] is None
    assert median_error(np.ones(3), np.full(3, np.inf)) is None


def test_a_policy_without_a_decoder_is_refused_in_a_sentence():
    blind = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, sensor="blind"))
    with pytest.raises(ConfigError, match="sensor 'blind' has no decoder"):
        check_predicts_distance(blind, AgentActor(blind))
    sensed = dataclasses.replace(CONFIG, encoder=dataclasses.replace(CONFIG.encoder, target="sensed"))
    with pytest.raises(ConfigError, match="encoder.target sensed, not nearness or both"):
        check_predicts_distance(sensed, AgentActor(sensed))
    with pytest.raises(ConfigError, match="a function has no decoder"):
        check_predicts_distance(CONFIG, FunctionActor(lambda observation, memory, key: (0, memory)))


@pytest.mark.whole
def test_an_evaluation_compares_what_the_policy_acted_on_with_the_truth():
    params = jax.tree.map(jnp.copy, always((1, 0, 0)))
    # An untrained decoder draws about 0, which is infinitely far; this one draws half of the scale and its code.
    bias = params.encoder["decoder"]["bias"]
    params.encoder["decoder"]["bias"] = bias.at[..., 0, 0].set(1.5 * np.sqrt(48) / OUTPUT_SCALE)
    policy = Policy(CONFIG, params)
    flown = edqn_jax.evaluate(policy, "medium", missions=1, decoder=True)
    environment = edqn_jax.make("medium", CONFIG, worlds=1, split="test")
    state, seen = environment.reset(0, 0)
    memory, errors = None, []
    while not state.ended:
        true = np.asarray(environment.depth(state))
        move, memory = policy.act(seen, memory)
        predicted = predicted_distance(CONFIG, policy.params.encoder, AgentActor(CONFIG).code(memory))
        near = true < NEAR_M
        errors.append(np.abs(np.asarray(predicted)[near] - true[near]) / true[near])
        state, step = environment.step(state, move)
        seen = step.observation
    figures = flown.figures["decoder"]
    assert (figures["frames"], figures["pixels"]) == (len(errors), sum(map(len, errors)))
    assert figures["relative_median"] == pytest.approx(np.median(np.concatenate(errors)), rel=0.02)
