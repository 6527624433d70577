"""A model of stable-baselines3 flies as a policy: here a stand-in; the library's own is in `test_stable_baselines3`."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import edqn_jax
from edqn_jax.errors import ConfigError
from edqn_jax.interop.sb3_policy import sb3_policy
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import FunctionActor
from tests.support.miniature import WORLD
from tests.support.policies import CONFIG, fresh

BLIND = dataclasses.replace(
    CONFIG,
    env=dataclasses.replace(CONFIG.env, sensor="blind", max_decisions=12),
    world=dataclasses.replace(CONFIG.world, name=str(WORLD), flown=""),
)


class Model:
    """Chooses moves by what it sees, and keeps the shapes of that."""

    action_space = SimpleNamespace(shape=(), dtype=np.dtype(np.int64))

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        spaces = {name: SimpleNamespace(shape=shape) for name, shape in shapes.items()}
        self.observation_space = spaces["vector"] if "vector" in spaces else SimpleNamespace(spaces=spaces)
        self.asked: list[tuple[int, ...]] = []

    def predict(self, observed: Any, deterministic: bool) -> tuple[np.ndarray, None]:
        """Returns moves [...] for observations [...], as the library does: int64, and a state that is none."""
        assert deterministic
        vector = observed if isinstance(observed, np.ndarray) else observed["own"]
        self.asked.append(vector.shape)
        return self.move_of(vector), None

    @staticmethod
    def move_of(vector: np.ndarray) -> np.ndarray:
        """Returns moves [...] of vectors [..., N], which change along a flight."""
        return (np.floor(50 * np.abs(vector[..., :10]).sum(-1)) % 27).astype(np.int64)


def test_a_model_flies_what_it_would_choose() -> None:
    model = Model(vector=(17,))
    policy = sb3_policy(model, BLIND, observation="kinematics")
    record = edqn_jax.evaluate(policy, missions=1, record=True).flights.record
    assert record is not None and all(shape[-1] == 17 for shape in model.asked)
    environment = edqn_jax.make(WORLD, BLIND)
    state, seen = environment.reset(0, 0)
    (moves,) = np.asarray(record.action)
    for move in moves[moves >= 0]:
        assert move == model.move_of(np.asarray(seen.own))
        state, step = environment.step(state, int(move))
        seen = step.observation
    assert len(np.unique(moves)) > 2


class Pilot(Model):
    """Flies up at full speed, as a model of continuous actions does."""

    action_space = SimpleNamespace(shape=(3,), dtype=np.dtype(np.float32))

    @staticmethod
    def move_of(vector: np.ndarray) -> np.ndarray:
        """Returns velocities [..., 3] of vectors [..., N]."""
        return np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), (*vector.shape[:-1], 3))


FAST = dataclasses.replace(BLIND, env=dataclasses.replace(BLIND.env, actions="velocity"))


def test_a_model_of_continuous_actions_flies_and_its_numbers_are_recorded() -> None:
    policy = sb3_policy(Pilot(vector=(17,)), FAST, observation="kinematics")
    evaluation = edqn_jax.evaluate(policy, missions=1, record=True)
    record = evaluation.flights.record
    assert record is not None and evaluation.path()[-1, 2] > evaluation.path()[0, 2]
    actions = np.asarray(record.action)[0]
    assert np.all(actions[np.isfinite(actions[:, 0])] == [0.0, 0.0, 1.0])


def test_what_the_kinds_of_observations_show_reaches_the_model() -> None:
    policy = Policy(CONFIG, fresh(CONFIG, 0))
    size = CONFIG.encoder.code_size
    seen = edqn_jax.make(WORLD, CONFIG).reset(0, 0)[1]
    for kind, model, options in (
        ("image", Model(image=(6, 8), own=(10,), motion=(7,)), {"config": CONFIG}),
        ("code", Model(vector=(size + 17,)), {"policy": policy}),
    ):
        flies = sb3_policy(model, observation=kind, **options)  # type: ignore[arg-type]
        actor = FunctionActor(flies.function, flies.memory)
        move, _ = jax.jit(actor.act)(None, actor.init(), seen, jax.random.key(0))
        assert move.dtype == np.int32 and 0 <= int(move) < 27 and len(model.asked) == 1


@pytest.mark.parametrize(
    ("model", "options", "says"),
    [
        (Model(vector=(17,)), {"config": CONFIG}, r"observations \(17,\), and 'image' with the sensor 'events'"),
        (Model(vector=(9,)), {"observation": "kinematics"}, r"\(9,\), and 'kinematics' .* 'blind' is \(17,\)"),
        (Model(vector=(17,)), {"observation": "codes"}, "observation must be one of image, code, kinematics"),
        (Model(vector=(17,)), {"observation": "code"}, "observation 'code' needs a policy"),
        (Model(vector=(17,)), {"config": FAST, "observation": "kinematics"}, r"int32\[\], .*'velocity' is 3 finite"),
        (Pilot(vector=(17,)), {"config": BLIND, "observation": "kinematics"}, r"float32\[3\], .*'moves' is a whole"),
    ],
)
def test_a_model_of_other_observations_is_refused(model: Any, options: Any, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        sb3_policy(model, **options)
