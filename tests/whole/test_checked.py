"""`--debug`: training with everything checked finds what is planted, and nothing in what is sound."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from edqn_jax.cli.train import parse_train
from edqn_jax.config import Config
from edqn_jax.errors import CheckError
from edqn_jax.learn.dqn import learner as dqn
from edqn_jax.learn.state import TrainState
from edqn_jax.learn.trainer import Trainer
from tests.support.miniature import MINIATURE, miniature_world

FLAGS = (
    *MINIATURE,
    *("--env.sensor", "blind", "--agent.hidden", "8", "--train.shards", "2", "--train.chunk-steps", "16"),
)

CHECKED = (*FLAGS, "--debug")


def config_of(flags: tuple[str, ...]) -> Config:
    return parse_train(flags)[1]


def trainer_of(flags: tuple[str, ...]) -> Trainer:
    config = config_of(flags)
    return Trainer(config, miniature_world(config), jax.devices()[:1])


@pytest.fixture(scope="module")
def checked() -> Trainer:
    trainer = trainer_of(CHECKED)
    trainer.compile()
    return trainer


@pytest.fixture(scope="module")
def learning(checked: Trainer) -> TrainState:
    """Returns the state after two chunks, in which the Q-network has learnt; `blind` has no encoder."""
    state = checked.init(0)
    for first in (0, 16):
        state, (_, losses) = checked.chunk(state, first)
    assert jnp.isfinite(losses.metrics["q_loss"]).all()
    return state


def fault(checked: Trainer, state: TrainState) -> str:
    with pytest.raises(CheckError) as raised:
        checked.chunk(state, 32)
    said = str(raised.value)
    assert said.startswith("--debug: ") and "\n" not in said
    return said


def changed(state: TrainState, **leaves: Any) -> TrainState:
    return dataclasses.replace(state, actors=dataclasses.replace(state.actors, **leaves))


def test_nothing_is_found_in_a_training_with_an_encoder() -> None:
    trainer = trainer_of((*CHECKED, "--env.sensor", "events"))
    trainer.compile()
    _, (_, losses) = trainer.chunk(trainer.init(0), 0)
    assert jnp.isfinite(losses.metrics["reconstruction_loss"]).any()


def test_a_sound_run_learns_as_without_checks(learning: TrainState) -> None:
    trainer = trainer_of(FLAGS)
    state = trainer.init(0)
    for first in (0, 16):
        state, _ = trainer.chunk(state, first)
    # One drone after the other is rounded otherwise than all at once.
    assert jnp.array_equal(state.actors.env.mission, learning.actors.env.mission)
    assert jnp.allclose(state.actors.env.drone.position, learning.actors.env.drone.position, atol=1e-3)


def test_a_sound_run_against_every_disturbance_has_no_fault() -> None:
    disturbed = ("--air.wind-m-s", "5", "--air.gusts-m-s", "5", "--body.mass-share", "0.2", "--motors.lag-s", "0.1")
    noisy = ("--noise.position-m", "0.5", "--noise.velocity-bias-m-s", "0.3", "--env.action-delay", "1")
    trainer = trainer_of((*CHECKED, *disturbed, *noisy))
    state, (_, losses) = trainer.chunk(trainer.init(0), 0)
    assert jnp.isfinite(losses.metrics["q_loss"][-1]) and state.actors.env.disturbance is not None


@pytest.mark.parametrize("sensor", ["events", "frame-pair"])
def test_a_sound_run_with_a_faulty_sensor_in_any_light_has_no_fault(sensor: str) -> None:
    light = ("--light.least-lux", "0.1", "--light.most-lux", "10000", "--events.hot-pixel-fraction", "0.1")
    faults = ("--events.profile", "dvs", "--exposure.real", "--env.sensor", sensor, "--events.law", "esim")
    clock = ("--exposure.rate-hz", "30", "--exposure.latency-s", "0.2", "--exposure.bits", "12")
    trainer = trainer_of((*CHECKED, *light, *faults, *clock))
    state, (_, losses) = trainer.chunk(trainer.init(0), 0)
    assert jnp.isfinite(losses.metrics["reconstruction_loss"][-1])
    memory = state.actors.env.memory
    assert memory is not None and memory.lux is not None
    lux = memory.lux
    assert jnp.all((lux >= 0.1) & (lux <= 10_000)) and jnp.std(jnp.log(lux)) > 1


def test_a_number_that_is_none_is_named_with_its_steps(checked: Trainer, learning: TrainState) -> None:
    drone = learning.actors.env.drone
    drone = dataclasses.replace(drone, position=drone.position.at[0, 0, 0].set(jnp.nan))
    said = fault(checked, changed(learning, env=dataclasses.replace(learning.actors.env, drone=drone)))
    assert "in training steps 32 to 47: the state of a drone is not finite" in said


def test_a_reward_that_is_none_is_named() -> None:
    """A number that no operation makes, as a constant of a reward function."""
    config = config_of(CHECKED)
    world = dataclasses.replace(miniature_world(config), reward=lambda transition: jnp.float32(jnp.nan))
    trainer = Trainer(config, world, jax.devices()[:1])
    with pytest.raises(CheckError, match="the reward of a decision is not finite"):
        trainer.chunk(trainer.init(0), 0)


def test_a_move_that_does_not_exist_is_named(checked: Trainer, learning: TrainState) -> None:
    ring = learning.actors.replay
    ring = dataclasses.replace(ring, action=jnp.full_like(ring.action, 27))
    assert "index 27 of the moves is out of bounds" in fault(checked, changed(learning, replay=ring))


def test_an_index_inside_the_environment_is_checked(checked: Trainer, learning: TrainState) -> None:
    world = checked.env_params
    missions = dataclasses.replace(world.missions, scene=world.missions.scene + 1)
    beyond = trainer_of(CHECKED)
    beyond.env_params, beyond._chunk = dataclasses.replace(world, missions=missions), checked._chunk
    assert "out-of-bounds indexing" in fault(beyond, learning)


def test_an_array_with_other_axes_is_named(checked: Trainer, learning: TrainState) -> None:
    memory = learning.actors.memory
    assert "wrong shape" in fault(checked, changed(learning, memory=memory.swapaxes(0, 1)))


def test_a_key_that_is_used_twice_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dqn, "split_each", lambda keys, count: jnp.stack([keys] * count))
    with pytest.raises(CheckError, match="a random key is used twice"):
        trainer_of(CHECKED).compile()
