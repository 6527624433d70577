"""What a learner of one's own returns is checked in shapes and types before anything is compiled."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import pytest

import edqn_jax
from edqn_jax.config import LEARNERS, Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.learn.dqn.learner import DQN
from edqn_jax.learn.learner import Learner, UpdateStats
from edqn_jax.learn.pqn.learner import PQN
from edqn_jax.training.learner_check import check_learner
from tests.support.registries import keep_as_they_are

MINE = Learner(
    init=lambda config, key: {"w": jnp.zeros(3), "count": jnp.int32(0)},
    act=lambda config, state, memory, keys, progress: (jnp.full(memory.shape[:2], 13), {"height": jnp.float32(1.0)}),
    decide=lambda config, params, memory: jnp.full(memory.shape[:-2], 13),
    ring_length=lambda config: 2,
    starts=lambda config: 1,
    updates=lambda config, newest: jnp.zeros_like(newest),
    update=lambda config, axis, state, rings, after: (UpdateStats.without_updates("mine"), state),
    network=lambda state: state["w"],
    policy=lambda state: state["w"],
)


@pytest.fixture
def config(monkeypatch: pytest.MonkeyPatch) -> Config:
    keep_as_they_are(monkeypatch)
    LEARNERS.register("mine", MINE)
    return make_config(
        "paper", env={"sensor": "blind"}, agent={"learner": "mine"}, train={"num_envs": 16, "total_steps": 3200}
    )


@pytest.mark.parametrize("learner", [MINE, DQN, PQN])
def test_what_fits_is_taken(config: Config, learner: Learner) -> None:
    LEARNERS.register("fits", learner)
    check_learner(dataclasses.replace(config, agent=dataclasses.replace(config.agent, learner="fits")))


def _moves(state: Any, memory: Any) -> Any:
    return jnp.zeros(memory.shape[:2], jnp.int32)


@pytest.mark.parametrize(
    ("function", "does", "says"),
    [
        ("ring_length", lambda c: None, "must return a whole number of at least 1, not None"),
        ("ring_length", lambda c: 0, "must return a whole number of at least 1, not 0"),
        ("starts", lambda c: 0.5, "must return a whole number of at least 0, not 0.5"),
        ("updates", lambda c, n: n[0], r"must return int32\[3\] .*, not int32\[\]"),
        ("updates", lambda c, n: None, r"must return int32\[3\] .*, not None"),
        ("init", lambda c, k: {"w": "no"}, "must return arrays, not 'no'"),
        ("decide", lambda c, p, m: m, r"must return int32\[\d+, \d+\] .*, not float32"),
        ("decide", lambda c, p, m: jnp.zeros(m.shape[:2]), r"must return int32\[.*, not float32\["),
        ("act", lambda c, s, m, k, e: _moves(s, m), "must return two things, not an object"),
        ("act", lambda c, s, m, k, e: (_moves(s, m)[0], {}), r"must return int32\[\d+, \d+\] .*, not int32\[\d+\]"),
        ("act", lambda c, s, m, k, e: (_moves(s, m), None), "must return metrics as a dict of .* by name, not None"),
        ("act", lambda c, s, m, k, e: (_moves(s, m), {"a": jnp.zeros(2)}), r"by name, not 'a' of shape \(2,\)"),
        ("act", lambda c, s, m, k, e: (_moves(s, m), {"phase": 1.0}), "of other names than .*, not 'phase'"),
        ("act", lambda c, s, m, k, e: (_moves(s, m), {"mine": 1.0}), "other metrics than `act`, which has 'mine', too"),
        ("update", lambda c, a, s, r, o: s, "must return two things, not an object of the type dict"),
        ("update", lambda c, a, s, r, o: ({}, s), "must return UpdateStats and the state, not an object"),
        (
            "update",
            lambda c, a, s, r, o: (UpdateStats.without_updates(), s | {"count": 0.0}),
            r"a state like the one that it is given, not one in which \['count'\] is float32\[\], not int32\[\]",
        ),
    ],
)  # fmt: skip
def test_what_a_learner_returns_wrongly_is_said(config: Config, function: str, does: Any, says: str) -> None:
    LEARNERS.register("wrong", dataclasses.replace(MINE, **{function: does}))
    wrong = dataclasses.replace(config, agent=dataclasses.replace(config.agent, learner="wrong"))
    named = "update" if "'mine', too" in says else function
    with pytest.raises(
        ConfigError, match=f"^`{named}` of the learner 'wrong' must return .*{says.removeprefix('must return ')}"
    ):
        check_learner(wrong)


def test_training_checks_first_and_lets_a_learners_own_errors_through(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: Any) -> Any:
        raise KeyError("my own")

    for name, function, error in (("wrong", lambda c, p, m: None, ConfigError), ("raises", fails, KeyError)):
        LEARNERS.register(name, dataclasses.replace(MINE, decide=function))
        wrong = dataclasses.replace(config, agent=dataclasses.replace(config.agent, learner=name))
        with pytest.raises(error):
            edqn_jax.train(wrong)
