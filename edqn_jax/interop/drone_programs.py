"""The compiled programs of `interop/gymnasium.py`: resets and decisions of one drone and of many."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.interop.functional import FunctionalEnv, Params, State
from edqn_jax.learn.perception.code import Params as EncoderParams
from edqn_jax.sim.task.env import EnvState


@struct.dataclass
class Drone:
    """One drone between two decisions."""

    state: EnvState  # without its key
    key: Array  # [2] uint32, the data of that key


@struct.dataclass
class Decided:
    """Result of one decision in Gymnasium's terms; with a leading [N] for many drones."""

    observed: Any
    reward: Array
    outcome: Array
    terminated: Array
    truncated: Array


@dataclasses.dataclass(frozen=True)
class Program:
    """Static arguments of a compiled program."""

    env: FunctionalEnv
    world: Any  # structure of an `EnvParams`
    limit: int | None = None  # decisions after which an episode is cut, beside the task's own time-out


Leaves = list[Array]
"""Arrays of an `EnvParams`. JAX calls a compiled function in a quarter less time where no argument is a typed key or an
object whose fields it has to ask for in Python; so worlds go in as lists, and keys as their data."""


def _held(state: State) -> Drone:
    flight = state.flight
    return Drone(dataclasses.replace(flight, key=None), jax.random.key_data(flight.key))


def _reset(
    program: Program, leaves: Leaves, encoder: EncoderParams, seed: Array, mission: Array | None
) -> tuple[Drone, Any]:
    observed, state = program.env.reset(jax.random.key(seed), _params(program, leaves, encoder), mission)
    return _held(state), observed


def _step(
    program: Program, leaves: Leaves, encoder: EncoderParams, drone: Drone, action: Array
) -> tuple[Drone, Decided]:
    key = jax.random.wrap_key_data(drone.key)
    params, state = _params(program, leaves, encoder), State(dataclasses.replace(drone.state, key=key))
    observed, state, reward, terminated, truncated, info = program.env.step(key, state, action, params)
    if program.limit is not None:
        cut = ~info["is_reset"] & (info["episode_length"] >= program.limit)
        truncated, ended = truncated | cut, state.flight.ended | cut
        state = State(dataclasses.replace(state.flight, ended=ended))
    return _held(state), Decided(observed, reward, info["outcome"], terminated, truncated)


def _params(program: Program, leaves: Leaves, encoder: EncoderParams) -> Params:
    return Params(jax.tree.unflatten(program.world, leaves), encoder)


reset_one = jax.jit(_reset, static_argnums=0)
step_one = jax.jit(_step, static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def reset_many(program: Program, leaves: Leaves, encoder: EncoderParams, seeds: Array, missions: Array | None):
    return jax.vmap(lambda seed, mission: _reset(program, leaves, encoder, seed, mission))(seeds, missions)


@functools.partial(jax.jit, static_argnums=0, donate_argnums=3)
def step_many(program: Program, leaves: Leaves, encoder: EncoderParams, drones: Drone, actions: Array):
    return jax.vmap(lambda drone, action: _step(program, leaves, encoder, drone, action))(drones, actions)


@functools.partial(jax.jit, static_argnums=0, donate_argnums=3)
def reset_some(program: Program, leaves: Leaves, encoder: EncoderParams, drones: Drone, numbers: Array):
    """Resets the ended drones of these numbers [K] and returns their observations; other numbers stand for none."""
    ended = jax.tree.map(lambda x: x.at[numbers].get(mode="clip"), drones)
    still = jnp.asarray(program.env.task.still)
    fresh, decided = jax.vmap(lambda drone: _step(program, leaves, encoder, drone, still))(ended)
    return jax.tree.map(lambda x, y: x.at[numbers].set(y, mode="drop"), drones, fresh), decided.observed
