"""The example of PPO: its advantages, what it leaves out, and that it runs."""

from __future__ import annotations

from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.stats import norm

import ppo
from edqn_jax.interop import functional

SETTINGS = ppo.Settings()
MOVES, VELOCITY = functional.Discrete(27), functional.Box(-1.0, 1.0, (3,))


def rows(terminated: list[bool], ended: list[bool], valid: list[bool]) -> ppo.Row:
    """Four steps of one drone, with values 1, 2, 3, 4 and a reward of 10 a step."""
    column = lambda x: jnp.asarray(x)[:, None]  # noqa: E731
    return ppo.Row(
        observed=jax.random.normal(jax.random.key(0), (4, 1, 17)),
        action=column([0, 1, 2, 3]),
        log_prob=column([-3.0] * 4),
        value=column([1.0, 2.0, 3.0, 4.0]),
        reward=column([10.0] * 4),
        terminated=column(terminated),
        ended=column(ended),
        valid=column(valid),
    )


@pytest.mark.parametrize(
    ("terminated", "expected"),
    [
        # With discount 1/2 and decay 1/2: the errors are r + V'/2 - V, with no V' where the episode was terminated.
        (True, [10 + 1 - 1 + (10 - 2) / 4, 10 - 2]),
        (False, [10 + 1 - 1 + (10 + 1.5 - 2) / 4, 10 + 1.5 - 2]),
    ],
)
def test_a_truncated_episode_is_bootstrapped_from_its_final_observation(
    terminated: bool, expected: list[float]
) -> None:
    no = [False] * 4
    ended = [False, True, False, False]
    episode = rows([False, terminated, False, False] if terminated else no, ended, [True, True, False, True])
    found = ppo.advantages(episode, jnp.array([6.0]), 0.5, 0.5)[:, 0]
    np.testing.assert_allclose(found[:2], expected, rtol=1e-6)  # what comes after the end changes nothing before it
    np.testing.assert_allclose(found[3], 10 + 3 - 4, rtol=1e-6)


def test_a_step_spent_on_a_reset_is_not_learnt_from() -> None:
    episode = rows([False, True, False, False], [False, True, False, False], [True, True, False, True])
    flat = jax.tree.map(lambda x: x[:, 0], episode)
    params = ppo.ActorCritic(MOVES).init(jax.random.key(1), flat.observed)

    def gradient(changed: Array, row: int) -> Array:
        advantage = jnp.array([1.0, -2.0, 0.5, 1.5]).at[row].set(changed)
        return jax.flatten_util.ravel_pytree(jax.grad(ppo.loss, argnums=2)(SETTINGS, MOVES, params, flat, advantage))[0]

    np.testing.assert_array_equal(gradient(jnp.array(0.5), 2), gradient(jnp.array(-70.0), 2))
    assert np.any(gradient(jnp.array(1.5), 3) != gradient(jnp.array(-70.0), 3))


def test_a_gaussian_policy_has_the_density_and_the_entropy_of_a_normal_distribution() -> None:
    mean, deviation = np.array([0.3, -0.2, 0.0]), np.array([0.5, 1.0, 2.0])
    said = jnp.asarray(np.concatenate([mean, np.log(deviation)]), jnp.float32)[None]
    action = np.array([0.1, 1.0, -3.0])
    density, entropy = ppo.likelihood(VELOCITY, said, jnp.asarray(action, jnp.float32)[None])
    np.testing.assert_allclose(density, norm.logpdf(action, mean, deviation).sum(), rtol=1e-5)
    np.testing.assert_allclose(entropy, norm.entropy(mean, deviation).sum(), rtol=1e-5)
    many = ppo.drawn(VELOCITY, jnp.repeat(said, 20_000, axis=0), jax.random.key(0))
    np.testing.assert_allclose(many.mean(axis=0), mean, atol=0.05)
    np.testing.assert_allclose(many.std(axis=0), deviation, rtol=0.03)
    np.testing.assert_allclose(ppo.best(VELOCITY, said[0]), mean, rtol=1e-6)


@pytest.mark.parametrize("actions", ["moves", "velocity"])
def test_it_trains_and_says_how_well(actions: Any, capsys: pytest.CaptureFixture[str]) -> None:
    small = ppo.Settings(
        actions=actions, decisions=60_000, worlds=8, test_worlds=16, num_envs=64, minibatches=4, learning_rate=1e-3
    )
    ppo.main(small)
    *_, untrained, trained = capsys.readouterr().out.splitlines()
    before, after = (float(line.split("mean return ")[1].split(",")[0]) for line in (untrained, trained))
    assert untrained.startswith("untrained") and after > before + 50
