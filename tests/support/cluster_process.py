"""`edqn train` as one of several processes that train together, or alone, and a note of what became of it.

    python -m tests.support.cluster_process NOTE.json DEVICES [--no-learning] [arguments of edqn train]

The process has DEVICES CPU devices. Its note holds the shards that it held and what `train_run` returned. To spare
compiling, its camera sees waves that follow the pose, and it draws no pictures. `--no-learning` puts a state and
chunks that do nothing in the place of the compiled ones and compiles no rollouts, for tests of what processes tell
one another.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from jax import Array

from edqn_jax.cli import main
from edqn_jax.config import CameraConfig
from edqn_jax.devices import devices, hardware, processes
from edqn_jax.evaluation import rollouts
from edqn_jax.learn.dqn.learner import DqnState
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.learn.state import Episodes, Losses, TrainState
from edqn_jax.learn.trainer import Trainer
from edqn_jax.learn.updates import Networks
from edqn_jax.report import gallery
from edqn_jax.runs import record
from edqn_jax.runs.directory import to_plain_json
from edqn_jax.sim.camera import camera
from edqn_jax.sim.scene.scene import Scene
from tests.support.miniature import no_losses


def waves(config: CameraConfig, scene: Scene, position: Array, rotation: Array) -> Array:
    """Stands for `camera.render_luma`."""
    del scene
    across, down = jnp.arange(config.width), jnp.arange(config.height)[:, None]
    return 0.5 + 0.4 * jnp.sin(across * position[0] + down * position[1] + rotation[0, 0])


def only_a_policy(self: Trainer, seed: int | Sequence[int], start: Policy | None = None) -> TrainState:
    """Stands for the state before the first step: of all of it, parameters."""
    assert isinstance(seed, int)
    params = fresh_policy(self.config, seed)
    agent = DqnState(q=params.q, target=params.q, average=params.q, q_optimiser=None)
    learner = Networks(vae={}, vae_optimiser=None, encoder=params.encoder, agent=agent)
    state = TrainState(actors=None, learner=learner, step=jnp.int32(0))  # type: ignore[arg-type]
    return processes.replicate(state, self.mesh)


def no_learning(self: Trainer, state: TrainState, first: int) -> tuple[TrainState, tuple[Episodes, Losses]]:
    """Stands for the compiled chunk, and takes long enough to be interrupted."""
    del first
    time.sleep(0.2)
    train = self.config.train
    none = jnp.zeros((train.chunk_steps, train.shards, train.num_envs // train.shards))
    losses = no_losses(train.chunk_steps)
    return state, processes.replicate((Episodes(none, none, none), losses), self.mesh)


if __name__ == "__main__":
    note, count, *argv = sys.argv[1:]
    noted: dict[str, Any] = {}
    init, train_run = Trainer.init, record.train_run

    def noting_init(self: Trainer, seed: int | Sequence[int], start: Policy | None = None) -> TrainState:
        state = init(self, seed, start)
        parts = state.actors.reward.addressable_shards
        noted["shards"] = [list(range(8))[part.index[0]] for part in parts]
        noted["environments"] = sum(part.data.size for part in parts)
        return state

    def noting_run(*arguments: Any, **options: Any) -> dict[str, Any]:
        noted["summary"] = train_run(*arguments, **options)
        return noted["summary"]

    hardware.count_cores = devices.count_cores = lambda: int(count)
    camera.render_luma = waves
    gallery.prepare_gallery = lambda *_: lambda *_: None
    Trainer.init, record.train_run = noting_init, noting_run
    if argv[:1] == ["--no-learning"]:
        del argv[0]
        Trainer.init, Trainer.compile, Trainer.chunk = only_a_policy, lambda self: None, no_learning
        Trainer.trace = lambda self: None
        rollouts.trace_missions = lambda *_, **__: lambda: None
    code = main(["train", *argv])
    Path(note).write_text(json.dumps(to_plain_json(noted)), encoding="utf-8")
    sys.exit(code)
