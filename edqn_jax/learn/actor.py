"""The one acting path: from an observation and a memory to an action, for whatever flies or looks as a policy does.

An `Actor` is three pure functions of one drone, closed over what does not change in flight. The training step,
missions, exported policies, reports, recordings and the benchmarks' pilot all call them; callers map them with
`jax.vmap`, or give arrays with leading dimensions to the agent's.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn.learner import learner_of
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.qnetwork import Params
from edqn_jax.sim.sensors.sensor import sensor_of
from edqn_jax.sim.task.observation import Observation, motion_size, own_size

MOVE_SIZE = 3
"""Values of the last move, which end the own motion (`sim.task.observation.own_motion`)."""

Memory = Array
"""[H, D] the newest observations as the network sees them, newest last; zeros before an episode began."""


class Actor(abc.ABC):
    """The contract of what acts: pure functions, traced by JAX; equal actors share compiled programs.

    Parameters, memories and what `encode` returns are pytrees that only the actor reads.
    """

    @abc.abstractmethod
    def init(self) -> Any:
        """Returns the memory of one drone at the beginning of an episode."""

    @abc.abstractmethod
    def encode(self, params: Any, memory: Any, observation: Observation) -> Any:
        """Returns the memory with a new observation in it, the input of `decide`."""

    @abc.abstractmethod
    def decide(self, params: Any, seen: Any, key: Array) -> tuple[Array, Any]:
        """Returns the action [] or [...] for what `encode` returned, and the memory for the next observation."""

    def act(self, params: Any, memory: Any, observation: Observation, key: Array) -> tuple[Array, Any]:
        """Returns the action [] or [...] for a new observation, and the next memory; the key is consumed."""
        return self.decide(params, self.encode(params, memory, observation), key)


@struct.dataclass
class PolicyParams:
    """Parameters of a policy: encoder and Q-network."""

    encoder: Params  # {} where nothing is encoded
    q: Params


def blank_observation(config: Config) -> Observation:
    """Returns an observation of one drone in which nothing is seen, with the shapes and types of any other."""
    own, motion = jnp.zeros(own_size(config)), jnp.zeros(motion_size(config))
    return Observation(sensor_of(config).example(config), own=own, motion=motion)


def observation_size(config: Config) -> int:
    """Returns D, the length of what is seen, the last move where the Q-network sees it, and the own state."""
    return embedding.embedding_size(config) + (MOVE_SIZE if config.agent.last_move else 0) + own_size(config)


def grow_moves(config: Config, known: Config, q: Params) -> Params:
    """Returns a Q-network's parameters for observations with the last move, whose weights begin at 0.

    Args:
        config: of the new observations.
        known: with which the parameters were trained; they are returned as they are where both see the move, or
            neither does.
        q: of the network `mlp`; those of others are returned as they are.
    """
    if config.agent.last_move <= known.agent.last_move or known.agent.network != "mlp":
        return q
    kernel = q["Dense_0"]["kernel"]
    rows = kernel.reshape(known.agent.history, observation_size(known), -1)
    blank = jnp.zeros((len(rows), MOVE_SIZE, rows.shape[-1]))
    seen = embedding.embedding_size(known)
    grown = jnp.concatenate([rows[:, :seen], blank, rows[:, seen:]], axis=1)
    return {**q, "Dense_0": {**q["Dense_0"], "kernel": grown.reshape(-1, rows.shape[-1])}}


@dataclasses.dataclass(frozen=True)
class AgentActor(Actor):
    """The package's own agent, greedy: an encoder, a memory that stacks observations, and a learner's network."""

    config: Config

    def init(self) -> Memory:
        """Returns the memory [H, D] at the beginning of an episode."""
        return jnp.zeros((self.config.agent.history, observation_size(self.config)))

    def encode(self, params: PolicyParams, memory: Memory, observation: Observation) -> Memory:
        """Returns the memory [..., H, D] with the encoded observation [...] at its end; `params.q` is not read."""
        new = self._flat(params, observation)
        return jnp.concatenate([memory[..., 1:, :], new[..., None, :]], axis=-2)

    def decide(self, params: PolicyParams, seen: Memory, key: Array | None = None) -> tuple[Array, Memory]:
        """Returns the greedy moves [...] int32 for memories [..., H, D], and these; the key is not used."""
        return learner_of(self.config).decide(self.config, params.q, seen), seen

    def embed(self, params: PolicyParams, observation: Observation) -> Array | None:
        """Returns the embedding [..., C] of the sensor's output; None if there is no output.

        Args:
            params: of which the encoder is read.
            observation: [...].
        """
        return embedding.embed(self.config, params.encoder, observation)

    def code(self, memory: Memory) -> Array:
        """Returns the newest codes [..., C] in memories [..., H, D], as the decoder takes them."""
        return memory[..., -1, : embedding.code_size(self.config)] / self.config.agent.code_scale

    def _flat(self, params: PolicyParams, observation: Observation) -> Array:
        """Returns [..., D]: what is seen, by default as a code, and own state of observations [...].

        With `agent.last_move` the move, which stays as it is where own states are turned, stands between both.
        """
        seen = self.embed(params, observation)
        parts = [] if seen is None else [seen]
        if self.config.agent.last_move:
            parts.append(observation.motion[..., -MOVE_SIZE:])
        return jnp.concatenate([*parts, observation.own], axis=-1) if parts else observation.own
