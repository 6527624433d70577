"""The policy that flies: an encoder, a Q-network and the memory that stacks observations."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.errors import ConfigError
from edqn_jax.learn.learner import learner_of
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.qnetwork import Params
from edqn_jax.sim.sensors.events import EventField
from edqn_jax.sim.sensors.sensor import DEPTH_SCALE, Sensed, distance_of, sensor_of
from edqn_jax.sim.task.observation import OWN_SIZE, Observation

MOVE_SIZE = 3
"""Values of the last move, which end the own motion (`sim.task.observation.own_motion`)."""

Memory = Array
"""[H, D] the newest observations as the network sees them, newest last; zeros before an episode began."""


@struct.dataclass
class PolicyParams:
    """All that a policy knows."""

    encoder: Params  # {} where nothing is encoded
    q: Params


def observation_size(config: Config) -> int:
    """Returns D, the length of what is seen, the last move where the Q-network sees it, and the own state."""
    return embedding.size(config) + (MOVE_SIZE if config.agent.last_move else 0) + OWN_SIZE


def fresh_policy(config: Config, seed: int = 0) -> PolicyParams:
    """Returns a policy that has learnt nothing."""
    encoder_key, agent_key = jax.random.split(jax.random.key(seed))
    learner = learner_of(config)
    return PolicyParams(
        encoder=embedding.acting(config, embedding.init(config, encoder_key)),
        q=learner.policy(learner.init(config, agent_key)),
    )


def empty_memory(config: Config) -> Memory:
    """Returns the memory at the beginning of an episode."""
    return jnp.zeros((config.agent.history, observation_size(config)))


def remember(memory: Memory, flat: Array) -> Memory:
    """Returns the memory [..., H, D] with a new observation [..., D] at its end."""
    return jnp.concatenate([memory[..., 1:, :], flat[..., None, :]], axis=-2)


def flatten(config: Config, params: Params, memory: Memory, observation: Observation) -> Array:
    """Returns [..., D]: what is seen, by default as a code, and own state of observations [...] after a memory.

    With `agent.last_move` the move, which stays as it is where own states are turned, stands between both.
    """
    seen = embedding.embed(config, params, observation, memory[..., -1, : embedding.size(config)])
    parts = [] if seen is None else [seen]
    if config.agent.last_move:
        parts.append(observation.motion[..., -MOVE_SIZE:])
    return jnp.concatenate([*parts, observation.own], axis=-1) if parts else observation.own


def see(config: Config, params: Params, memory: Memory, observation: Observation) -> Memory:
    """Returns the memory [..., H, D] with the encoded observation [...] at its end."""
    return remember(memory, flatten(config, params, memory, observation))


def act(
    config: Config, params: PolicyParams, memory: Memory, observation: Observation, key: Array
) -> tuple[Array, Memory]:
    """Returns the greedy move [] int32 for one observation, and the memory with that observation in it."""
    memory = see(config, params.encoder, memory, observation)
    return learner_of(config).decide(config, params.q, memory), memory


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
            memory = empty_memory(self.config)
        return _act(self.config, self.params, memory, observation)

    @as_tested
    def code(self, observation: Observation, memory: Memory | None = None) -> Array:
        """Returns the code [C] that the encoder makes of one observation; the arguments are those of `act`.

        Raises:
            ConfigError: as `act`, or if the policy has no encoder.
        """
        if not embedding.has_code(self.config):
            raise ConfigError(f"the policy's sensor '{self.config.env.sensor}' has no encoder, so there is no code")
        _, memory = self.act(observation, memory)
        return memory[-1, : embedding.size(self.config)] / self.config.agent.code_scale

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


def _kind(sensed: Sensed) -> tuple[tuple[int, ...] | None, float | None]:
    """Returns the shape of what a sensor shows, and of events the length of the window in seconds."""
    if isinstance(sensed, EventField):
        # With noise, ON and OFF events of a frame pair stand in rows of their own.
        rows, *size = sensed.count.shape
        return (rows // 2 if sensed.with_noise else rows, *size), round(sensed.window_s, 6)
    return (None if sensed is None else sensed.shape), None


def _described(kind: tuple[tuple[int, ...] | None, float | None]) -> str:
    shape, window_s = kind
    if shape is None:
        return "nothing"
    size = " x ".join(str(side) for side in shape)
    return f"{size} numbers" if window_s is None else f"events of {size} frame pairs and pixels in {window_s:g} s"


@functools.partial(jax.jit, static_argnums=0)
def _depth(config: Config, params: Params, code: Array) -> Array:
    drawn = vae.decode(config.encoder, config.camera, params, code)[..., -1, :, :]
    return distance_of(drawn / DEPTH_SCALE)


@functools.partial(jax.jit, static_argnums=0)
def _act(config: Config, params: PolicyParams, memory: Memory, observation: Observation) -> tuple[Array, Memory]:
    return act(config, params, memory, observation, jax.random.key(0))  # greedy, so the key does not matter
