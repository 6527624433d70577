"""The same training on 1 and 8 simulated devices, and notes of what came of it.

    python -m tests.support.layout_process FOLDER

On each number of devices: decisions without learning, epsilon-greedily with the fresh network and encoder, then one
update of the DQN, and from the same moment one of the VAE. `FOLDER/N.npz` holds what N devices came to, by names:
`flown/STEP...` the state after each decision, `seen/STEP...` what it led to, `dqn...` and `vae...` the learner.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import AgentConfig, CameraConfig, Config, EncoderConfig, EnvConfig, TrainConfig
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.trainer import Trainer
from edqn_jax.sim.task.env import EnvParams
from tests.support.miniature import miniature_world

DEVICES = (1, 8)

DECISIONS = 12
"""Decisions without learning."""

CONFIG = Config(
    camera=CameraConfig(width=8, height=6),
    env=EnvConfig(max_decisions=5),  # so that every environment is reset at least once
    encoder=EncoderConfig(
        code_size=8,
        patch_layers=(8, 4),
        joint_layers=(16,),
        decoder_hidden=(16,),
        warmup_decisions=64,
        warmup_updates_per_step=1,
        batch_size=64,
        replay_size=64,
    ),
    agent=AgentConfig(
        hidden=(16, 16),
        batch_size=64,
        updates_per_step=1,
        replay_size=64 * 16,
        learning_starts=64 * DECISIONS,
        random_decisions=0,
        exploration_start=0.3,
        exploration_end=0.3,
    ),
    train=TrainConfig(num_envs=64, chunk_steps=1, total_steps=64 * 64, products="float32"),
)
"""A chunk is one step, so the number that it is given says what is done in it (`Schedule`): the first step is the
warm-up, in which the VAE learns, the next ones only fly, and from `learn_from` on the DQN learns.
"""


def leaves_of(name: str, tree: Any) -> dict[str, np.ndarray]:
    """The leaves by their paths, copied, so that donation does not take them away; keys as their data."""

    def data(x: jax.Array) -> np.ndarray:
        return np.array(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)

    found = jax.tree_util.tree_leaves_with_path(tree)
    return {name + jax.tree_util.keystr(path): data(leaf) for path, leaf in found}


def fly_and_learn(config: Config, world: EnvParams, devices: int) -> dict[str, np.ndarray]:
    """What so many devices come to."""
    plan, made = Schedule.from_config(config), Trainer(config, world, jax.devices()[:devices])
    assert (plan.warmup, plan.learn_from) == (1, 1 + DECISIONS)
    state = made.init(config.train.seed)
    came_to = leaves_of("flown/0", state.actors)
    for number in range(1, plan.learn_from):
        state, (seen, _) = made.chunk(state, number)
        came_to |= leaves_of(f"flown/{number}", state.actors) | leaves_of(f"seen/{number}", seen)
    again = jax.jit(lambda tree: jax.tree.map(jnp.copy, tree))(state)  # one program, not one for each leaf
    for name, number, moment in (("dqn", plan.learn_from, state), ("vae", 0, again)):
        came_to |= leaves_of(f"{name}/before", moment.learner)
        learnt, _ = made.chunk(moment, number)
        came_to |= leaves_of(f"{name}/after", learnt.learner)
    return came_to


if __name__ == "__main__":
    use_cpu_devices(max(DEVICES))
    folder, world = Path(sys.argv[1]), miniature_world(CONFIG, own_start_fraction=0.0)  # starts all over it
    for count in DEVICES:
        np.savez(folder / f"{count}.npz", **fly_and_learn(CONFIG, world, count))  # pyright: ignore[reportArgumentType]
