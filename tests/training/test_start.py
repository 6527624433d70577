"""Training that begins with the networks of a policy."""

from __future__ import annotations

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.cli.train import parse_train
from edqn_jax.config import Config
from edqn_jax.config.registry import LEARNERS
from edqn_jax.learn.actor import AgentActor, PolicyParams, blank_observation
from edqn_jax.learn.learner import learner_of
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.learn.qnetwork import network_values
from edqn_jax.learn.trainer import Trainer
from edqn_jax.learn.updates import Networks, begin_networks, init_networks
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE
from edqn_jax.training.setup import set_up_training

SMALL = edqn_jax.make_config("medium", camera={"width": 16, "height": 8}, agent={"hidden": (8,)})
BODY = dataclasses.replace(SMALL, camera=dataclasses.replace(SMALL.camera, mount="body"))


@functools.cache
def small_policy() -> Policy:
    return Policy(SMALL, fresh_policy(SMALL, 5))


def assert_equal_trees(found: Any, wanted: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, found, wanted)


def begin(config: Config, policy: Policy | None = None) -> Networks:
    policy = policy or small_policy()
    fresh = init_networks(config, jax.random.key(0))
    return begin_networks(config, fresh, policy.config, policy.params)


@pytest.mark.whole
@pytest.mark.parametrize("learner", ["dqn", "pqn"])
def test_the_networks_are_the_policys_and_their_optimisers_fresh(learner: str) -> None:
    config = dataclasses.replace(SMALL, agent=dataclasses.replace(SMALL.agent, learner=learner))
    found, fresh = begin(config), init_networks(config, jax.random.key(0))
    for params in (found.vae, found.encoder):
        assert_equal_trees(params, small_policy().params.encoder)
    for params in (learner_of(config).network(found.agent), learner_of(config).policy(found.agent)):
        assert_equal_trees(params, small_policy().params.q)
    assert_equal_trees((found.vae_optimiser, found.agent.q_optimiser), (fresh.vae_optimiser, fresh.agent.q_optimiser))


def test_what_a_camera_on_the_body_adds_to_the_own_motion_changes_no_code_at_first() -> None:
    rng = np.random.default_rng(0)
    drawn = {"least_contrast": 0.02, "most_contrast": 0.3}
    level, body = (dataclasses.replace(c, events=dataclasses.replace(c.events, **drawn)) for c in (SMALL, BODY))
    policy = Policy(level, fresh_policy(level, 1))
    grown = embedding.grow_motion(body, level, policy.params.encoder)["encoder"]
    for name in ("motion", "joint_0"):
        old, new = policy.params.encoder["encoder"][name]["kernel"], np.asarray(grown[name]["kernel"])
        assert len(new) == len(old) + 4
        values, lean = rng.normal(size=len(old)), rng.normal(size=4)
        # The contrast is the last value, and roll and pitch of two frames are before it.
        more = np.concatenate([values[:-1], lean, values[-1:]])
        np.testing.assert_allclose(more @ new, values @ old, rtol=1e-5, atol=1e-5)


def test_a_last_move_that_the_policy_did_not_see_changes_no_value_at_first() -> None:
    told = dataclasses.replace(SMALL, agent=dataclasses.replace(SMALL.agent, last_move=True))
    agent = begin(told).agent
    rng, known, more = np.random.default_rng(0), AgentActor(SMALL), AgentActor(told)
    observations = [
        dataclasses.replace(
            blank_observation(SMALL),
            own=jnp.asarray(rng.normal(size=OWN_SIZE), jnp.float32),
            motion=jnp.asarray(rng.normal(size=MOTION_SIZE), jnp.float32),
        )
        for _ in range(SMALL.agent.history)
    ]
    values = []
    for actor, q in ((known, small_policy().params.q), (more, learner_of(told).policy(agent))):
        params, memory = PolicyParams(small_policy().params.encoder, q), actor.init()
        for observation in observations:
            memory = actor.encode(params, memory, observation)
        values.append(network_values(actor.config.agent, q, memory))
    np.testing.assert_allclose(values[1], values[0], rtol=1e-5, atol=1e-5)
    assert_equal_trees(begin(told, Policy(told, PolicyParams(small_policy().params.encoder, agent.q))).agent.q, agent.q)


def test_networks_of_other_shapes_and_learners_that_cannot_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = dataclasses.replace(SMALL, agent=dataclasses.replace(SMALL.agent, hidden=(9,)))
    for config, policy in ((wide, small_policy()), (SMALL, Policy(BODY, fresh_policy(BODY)))):
        with pytest.raises(edqn_jax.ConfigError, match="have other shapes than those of the policy"):
            begin(config, policy)
    phases = []
    display = SimpleNamespace(phase=phases.append)
    with (
        pytest.raises(edqn_jax.ConfigError, match="have other shapes"),
        set_up_training(wide, display=display, start=small_policy()),  # type: ignore[arg-type]
    ):
        pass
    assert not phases  # nothing was prepared or compiled
    monkeypatch.setitem(LEARNERS._entries, "dqn", dataclasses.replace(learner_of(SMALL), begin_from=None))
    with pytest.raises(edqn_jax.ConfigError, match="learner 'dqn' cannot begin with a policy"):
        begin(SMALL)
    with (
        pytest.raises(edqn_jax.ConfigError, match="begin with a policy that has parameters, not with 'pretrained'"),
        set_up_training(SMALL, start="pretrained"),  # type: ignore[arg-type]
    ):
        pass


def test_the_command_takes_the_policys_options_and_flags_change_them() -> None:
    known = edqn_jax.load_policy("pretrained-looks").config
    words = ["--start-from", "pretrained-looks", "--world", "rooms", "--tuned-for", "cpu"]
    _, config = parse_train([*words, "--camera.mount", "body", "--encoder.warmup-decisions", "512"])
    assert config.agent.hidden == known.agent.hidden and config.events == known.events
    assert config.encoder.patch_layers == known.encoder.patch_layers and config.encoder.warmup_decisions == 512
    assert config.camera == dataclasses.replace(known.camera, mount="body") and config.surface == known.surface
    assert config.train == parse_train(["--world", "rooms", "--tuned-for", "cpu"])[1].train
    with pytest.raises(edqn_jax.ConfigError, match="did you mean 'pretrained'"):
        parse_train(["--start-from", "pretraind"])
    assert config.agent.exploration_start == 0.1


@pytest.mark.parametrize("begins", [True, False])
def test_what_makes_a_first_state_is_traced_where_one_will_be_needed(
    begins: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Traced(Exception):
        """The first state, ahead of the chunk."""

    class NotTraced(Exception):
        """What comes next was reached without it."""

    def stop(error: type[Exception]) -> None:
        raise error

    monkeypatch.setattr(Trainer, "trace_first", lambda *_: stop(Traced))
    monkeypatch.setattr(Trainer, "shapes", lambda *_: stop(NotTraced))
    with pytest.raises(Traced if begins else NotTraced), set_up_training(SMALL, begins=begins):
        pass
