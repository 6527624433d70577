"""Provenance of a run or a measured figure: workload, versions, digest of the state, reward."""

from __future__ import annotations

import hashlib
import inspect
import platform
from importlib import metadata
from typing import Any

import jax
import jax.numpy as jnp

from edqn_jax.config import Config
from edqn_jax.learn.embedding import has_code
from edqn_jax.learn.trainer import TrainState
from edqn_jax.parallel import processes
from edqn_jax.sim.reward import Reward
from edqn_jax.sim.scene import Scene, obstacle_count
from edqn_jax.sim.sensor import frames_per_decision


def workload(config: Config, scene: Scene) -> dict[str, Any]:
    """Returns the workload that a figure was measured for, as in the JSON of runs and benchmarks."""
    agent, envs = config.agent, config.train.num_envs
    return {
        "physics_steps_per_decision": config.drone.physics_steps,
        "physics_dt": config.drone.physics_dt_s,
        "width": config.camera.width,
        "height": config.camera.height,
        "sensor": config.env.sensor,
        "frames_per_decision": frames_per_decision(config),
        "obstacles": obstacle_count(scene),
        "replayed_samples_per_decision": agent.batch_size * agent.updates_per_step / envs,
        "vae_samples_per_decision": 1.0 if config.encoder.keep_learning and has_code(config) else 0.0,
        "num_envs": envs,
        "physics": config.drone.physics,
    }


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that figures depend on."""
    packages = ("jax", "mujoco", "mujoco-mjx", "flax", "optax", "numpy")
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in packages}}


def state_digest(state: TrainState) -> str:
    """Returns the SHA-256 of the train state's leaves in pytree order; every process must call this."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(state):
        raw = jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        array = processes.fetch(raw)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def reward_record(config: Config, reward: Reward | None) -> dict[str, str | None]:
    """Returns a reward's name, and for a reward function the SHA-256 of its source.

    The digest is None for the configured rewards, and where Python cannot find the source.
    """
    if reward is None:
        return {"name": config.env.reward, "source_sha256": None}
    name = getattr(reward, "__qualname__", type(reward).__qualname__)
    try:
        source = inspect.getsource(reward if inspect.isroutine(reward) else type(reward))
    except (OSError, TypeError):
        return {"name": name, "source_sha256": None}
    return {"name": name, "source_sha256": hashlib.sha256(source.encode()).hexdigest()}
