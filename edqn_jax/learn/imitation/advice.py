"""What a teacher that sees depth would do where drones of the training step are: its memory and its moves.

The depth is the label that the training step renders for the VAE, and own state and motion are the student's.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn.actor import AgentActor, PolicyParams
from edqn_jax.sim.task.observation import MOTION_SIZE, Observation, lean_of, leans, own_size


@struct.dataclass
class Advice:
    """A teacher's memory, the newest observation included, and its greedy move there."""

    memory: Array  # [..., H, D]
    move: Array  # [...] int32


def no_advice(teacher: Config, envs: int) -> Advice:
    """Returns that of E environments before anything is seen."""
    memory = AgentActor(teacher).init()
    return Advice(memory=jnp.broadcast_to(memory, (envs, *memory.shape)), move=jnp.zeros(envs, jnp.int32))


def teacher_observation(config: Config, teacher: Config, observation: Observation, near: Array) -> Observation:
    """Returns the observations [...] of the sensor `depth` that belong to those of a student.

    Args:
        config: of the student.
        teacher: configuration of the teacher.
        observation: [...] of the student.
        near: [..., H, W] as `nearness_image`.
    """
    # What a sensor tells of its light and contrast is the last of both, and `depth` tells nothing.
    own, motion = observation.own[..., : own_size(teacher)], observation.motion[..., :MOTION_SIZE]
    if leans(config):
        lean = lean_of(config, observation.motion)[..., -1, :]
        motion = jnp.concatenate([motion, lean], axis=-1)
    return Observation(sensed=near[..., None, :, :], own=own, motion=motion)


def advise(
    config: Config,
    teacher: Config,
    params: PolicyParams,
    before: Advice,
    observation: Observation,
    is_reset: Array,
    near: Array,
) -> Advice:
    """Returns the teacher's advice [N, ...] for N new observations.

    Args:
        config: of the student.
        teacher: configuration of the teacher.
        params: of the teacher.
        before: advice [N, ...] for the observations before.
        observation: [N] of the student.
        is_reset: [N] bool, an episode begins.
        near: [N, H, W] as `nearness_image`.
    """
    actor = AgentActor(teacher)
    memory = jnp.where(is_reset[:, None, None], 0.0, before.memory)
    memory = actor.encode(params, memory, teacher_observation(config, teacher, observation, near))
    move, memory = actor.decide(params, memory)
    return Advice(memory=memory, move=move)
