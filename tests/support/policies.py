"""Policies made by hand, and the small camera they look through."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import AgentConfig, CameraConfig, Config, DroneConfig, EncoderConfig
from edqn_jax.learn.actor import PolicyParams, observation_size
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.sim.actions import ACTIONS

CONFIG = dataclasses.replace(
    Config(),
    drone=DroneConfig(physics="rigid_body"),  # compiles in less time
    camera=CameraConfig(width=8, height=6),
    encoder=EncoderConfig(patch_layers=(8, 4), joint_layers=(16,), decoder_hidden=(16,)),
    agent=AgentConfig(hidden=(16,), history=2),
)


fresh = jax.jit(fresh_policy, static_argnums=(0, 1))
"""Untrained parameters by one program; operation by operation takes seconds to compile."""


@functools.cache
def always(move: tuple[int, int, int]) -> PolicyParams:
    """A policy that takes the same move (ahead, left, up) whatever it sees."""
    params = fresh(CONFIG, 0)
    q = jax.tree.map(jnp.zeros_like, params.q)
    (action,) = np.flatnonzero((ACTIONS == move).all(axis=1))
    # The head's first output is the state's value, the others are the advantages of the moves.
    q["Dense_1"]["bias"] = q["Dense_1"]["bias"].at[1 + action].set(1.0)
    return dataclasses.replace(params, q=q)


def that_sees(codes: bool, own: bool) -> PolicyParams:
    """An untrained policy whose first layer is cut off from the codes, or from the drone's own state."""
    params = fresh(CONFIG, 1)
    size = CONFIG.encoder.code_size
    column = np.arange(CONFIG.agent.history * observation_size(CONFIG)) % observation_size(CONFIG)
    seen = np.where(column < size, codes, own)
    params.q["Dense_0"]["kernel"] = params.q["Dense_0"]["kernel"] * seen[:, None]
    return params
