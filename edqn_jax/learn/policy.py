"""The policy that flies, for people: a configuration and parameters, given one observation after another."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import Config
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.errors import ConfigError
from edqn_jax.learn.actor import AgentActor, Memory, PolicyParams
from edqn_jax.learn.learner import learner_of
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.qnetwork import Params
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.sensor import DEPTH_SCALE, Sensed, distance_of, sensor_of
from edqn_jax.sim.task.observation import Observation


def fresh_policy(config: Config, seed: int = 0) -> PolicyParams:
    """Returns a policy that has learnt nothing."""
    encoder_key, agent_key = jax.random.split(jax.random.key(seed))
    learner = learner_of(config)
    return PolicyParams(
        encoder=embedding.inference_params(config, embedding.init_params(config, encoder_key)),
        q=learner.policy(learner.init(config, agent_key)),
    )


@dataclasses.dataclass(frozen=True)
class Policy:
    """A policy that can fly: its configuration and its parameters."""

    config: Config
    params: PolicyParams

    @as_tested
    def act(self, observation: Observation, memory: Memory | None = None) -> tuple[Array, Memory]:
        """Returns the greedy move [] int32 (0..26) for one observation, and the memory for the next call.

        Args:
            observation: of one drone, as `Environment.reset` and `step` return it.
            memory: from the call before; None at the start of an episode.

        Raises:
            ConfigError: if the observation has another form, size or window than the policy was trained with.
        """
        _check_fits(self.config, observation)
        if memory is None:
            memory = AgentActor(self.config).init()
        return _act(self.config, self.params, memory, observation)

    @as_tested
    def code(self, observation: Observation) -> Array:
        """Returns the code [C] that the encoder makes of one observation, as `act` is given it.

        Raises:
            ConfigError: as `act`, or if the policy has no encoder.
        """
        if not embedding.has_code(self.config):
            raise ConfigError(f"the policy's sensor '{self.config.env.sensor}' has no encoder, so there is no code")
        _, memory = self.act(observation)
        return AgentActor(self.config).code(memory)

    @as_tested
    def depth(self, code: Array) -> Array:
        """Returns the distances [H, W] metres that the decoder draws from a code [C], inf where it draws nothing.

        Raises:
            ConfigError: if the policy's encoder was not trained to draw how near things are.
        """
        if not embedding.needs_nearness(self.config):
            raise ConfigError(
                "the policy's decoder does not draw distances; encoder.target must be 'nearness' or 'both'"
            )
        return _depth(self.config, self.params.encoder, code)


def _check_fits(config: Config, observation: Observation) -> None:
    """Raises unless an observation is what the sensor of `config` shows.

    Raises:
        ConfigError: names both.
    """
    trained, given = _kind(_example(config)), _kind(observation.sensed)
    if trained != given:
        raise ConfigError(
            f"this policy was trained with the sensor '{config.env.sensor}', which shows {_described(trained)}; this "
            f"observation is {_described(given)}; make the environment with the policy's `config`"
        )


@functools.cache
def _example(config: Config) -> Sensed:
    return sensor_of(config).example(config)


def _kind(sensed: Sensed) -> tuple[Any, float | None]:
    """Returns the shape, or shapes, of what a sensor shows, and of events the length of the window in seconds."""
    if isinstance(sensed, EventField):
        # With noise, ON and OFF events of a frame pair stand in rows of their own.
        rows, *size = sensed.count.shape
        return (rows // 2 if sensed.with_noise else rows, *size), round(sensed.window_s, 6)
    return (None if sensed is None else jax.tree.map(jnp.shape, sensed)), None


def _described(kind: tuple[Any, float | None]) -> str:
    shape, window_s = kind
    if shape is None:
        return "nothing"
    if not isinstance(shape, tuple):
        return f"numbers of the shapes {shape}"
    size = " x ".join(str(side) for side in shape)
    return f"{size} numbers" if window_s is None else f"events of {size} frame pairs and pixels in {window_s:g} s"


@functools.partial(jax.jit, static_argnums=0)
def _depth(config: Config, params: Params, code: Array) -> Array:
    decoded = vae.decode(config.encoder, config.camera, params, code)[..., -1, :, :]
    return distance_of(decoded / DEPTH_SCALE)


@functools.partial(jax.jit, static_argnums=0)
def _act(config: Config, params: PolicyParams, memory: Memory, observation: Observation) -> tuple[Array, Memory]:
    return AgentActor(config).act(params, memory, observation, jax.random.key(0))  # greedy: the key has no effect
