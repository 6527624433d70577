"""The training schedule: numbers of training steps that follow from a configuration.

The warm-up comes first, then the learner learns; each retraining of the VAE gives the agent a new encoder, and the
rings begin anew.
"""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import Config, TrainConfig
from edqn_jax.config.registry import LEARNERS
from edqn_jax.learn.perception import embedding


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Numbers of training steps; static."""

    total: int
    scheduled: int
    """Steps that exploration, step size and retraining are planned for; fewer than `total` in an extended run."""
    warmup: int
    starts: int
    """Steps of a ring before the first update of the learner."""
    vae_training: tuple[tuple[int, int], ...]
    """Of the warm-up and of each retraining of the VAE, the first step and the step after the last."""

    @classmethod
    def from_config(cls, config: Config) -> Schedule:
        """Returns the plan of a configuration.

        Total decisions round up to whole chunks, the warm-up to whole steps; it takes a quarter at most.
        Where there is no VAE there is no warm-up: its decisions go to the DQN.
        """
        envs = config.train.num_envs
        total = _whole_chunks(config.train, config.train.total_steps)
        scheduled = _whole_chunks(config.train, config.train.schedule_steps or config.train.total_steps)
        most = scheduled // 4 if embedding.has_code(config) else 0
        warmup = min(math.ceil(config.encoder.warmup_decisions / envs), most)
        starts = LEARNERS.get(config.agent.learner).starts(config)
        vae_training = _vae_training(config, scheduled, warmup, starts) if warmup else ()
        return cls(total=total, scheduled=scheduled, warmup=warmup, starts=starts, vae_training=vae_training)

    @property
    def learn_from(self) -> int:
        """Step of the learner's first update."""
        return self.warmup + self.starts

    def trains_vae(self, step: Array | np.ndarray) -> Array:
        """Returns whether the VAE learns in steps `[...]`, bool."""
        trained = jnp.zeros(jnp.shape(step), bool)
        for first, end in self.vae_training:
            trained |= (first <= step) & (step < end)
        return trained

    def vae_rate(self, config: Config, step: Array) -> Array | float:
        """Returns the step size of the VAE in step `[]`: in each of its trainings it changes to the final one."""
        first, last = config.encoder.learning_rate, config.encoder.final_learning_rate
        if not last:
            return first
        done = jnp.zeros(())
        for start, end in self.vae_training:
            done = jnp.where((start <= step) & (step < end), (step - start) / (end - start), done)
        return first + done * (last - first)

    def samples_kept(self, config: Config, step: Array) -> Array:
        """Returns how many steps before steps `[...]` gave the VAE something to learn from, int32."""
        if config.encoder.keep_learning:
            return step
        kept = jnp.zeros(jnp.shape(step), jnp.int32)
        for first, end in self.vae_training:
            kept += jnp.clip(step - first, 0, end - first)
        return kept

    def replaces_encoder(self, step: Array) -> Array:
        """Returns whether the agent's encoder changes at the end of steps `[...]`, bool."""
        replaced = jnp.zeros(jnp.shape(step), bool)
        for _, end in self.vae_training:
            replaced |= step + 1 == end
        return replaced

    def reads_samples(self, config: Config, done: int) -> bool:
        """Returns whether the VAE learns again after `done` steps, so that what it has kept is still needed."""
        return config.encoder.keep_learning or any(done < end for _, end in self.vae_training)

    def replay_time(self, step: Array | np.ndarray) -> Array:
        """Returns the number of steps `[...]` since the replay began; 0 in the warm-up."""
        began = jnp.full(jnp.shape(step), self.warmup, jnp.int32)
        for _, end in self.vae_training:
            began = jnp.where(step >= end, end, began)
        return jnp.maximum(step - began, 0)


def _whole_chunks(train: TrainConfig, decisions: int) -> int:
    """Returns the training steps of whole chunks that take at least so many decisions."""
    return math.ceil(decisions / train.num_envs / train.chunk_steps) * train.chunk_steps


def _vae_training(config: Config, total: int, warmup: int, starts: int) -> tuple[tuple[int, int], ...]:
    """Returns the warm-up and each retraining that leaves the DQN at least a quarter of the run after it.

    A retraining takes an eighth of the run at most, begins when the DQN has learnt for as long as that, and never
    before another has ended.
    """
    length = min(math.ceil(config.encoder.retrain_decisions / config.train.num_envs), total // 8)
    times = [(0, warmup)]
    for share in config.encoder.retrain_at:
        first = max(round(share * total), times[-1][1] + starts + length)
        if length and total - (first + length) - starts >= total // 4:
            times.append((first, first + length))
    return tuple(times)
