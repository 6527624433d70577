"""The whole training step in steady state: its configuration, and a compiled chunk of it for timing."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from edqn_jax.config import Config
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.trainer import Trainer
from edqn_jax.sim.task import env

WHOLE = "whole_training_step"
"""Name of the row of the whole step."""


def steady(config: Config, chunk_steps: int) -> Config:
    """Returns `config` with a VAE sample a decision throughout and two chunks of warm-up; all later ones are alike."""
    decisions = chunk_steps * config.train.num_envs
    return dataclasses.replace(
        config,
        encoder=dataclasses.replace(
            config.encoder,
            keep_learning=True,
            warmup_decisions=decisions,
            batch_size=config.train.num_envs,
            retrain_at=(),
        ),
        agent=dataclasses.replace(config.agent, learning_starts=min(decisions, config.agent.learning_starts)),
        train=dataclasses.replace(config.train, chunk_steps=chunk_steps, total_steps=1000 * decisions),
    )


class WholeStep:
    """The compiled chunk of the training command, after the warm-up."""

    def __init__(self, config: Config, world: env.EnvParams, devices: Sequence[Any]) -> None:
        self.trainer = Trainer(config, world, devices)
        self.decisions = config.train.chunk_steps * config.train.num_envs
        state = self.trainer.init(config.train.seed)
        began = time.perf_counter()
        self.trainer.compile()
        self.compile_seconds = time.perf_counter() - began
        self.done = 0
        self.state = state
        while self.done < self.trainer.schedule.learn_from:
            self.turn()

    @property
    def temporary_bytes(self) -> int:
        """Returns the bytes that the compiled chunk needs on each device besides its inputs and outputs."""
        chunk: Any = self.trainer._chunk
        return chunk.memory_analysis().temp_size_in_bytes

    def turn(self) -> float:
        """Runs one more chunk and returns its decisions per second.

        Raises:
            RuntimeError: if Q-network or VAE did not learn in the whole chunk.
        """
        began = time.perf_counter()
        self.state, (_, losses) = self.trainer.chunk(self.state, self.done)
        q_loss = np.asarray(losses.metrics["q_loss"])
        seconds = time.perf_counter() - began
        learns = self.done >= self.trainer.schedule.learn_from
        self.done += len(q_loss)
        learnt = [q_loss]
        if embedding.has_code(self.trainer.config):
            learnt.append(np.asarray(losses.metrics["reconstruction_loss"]))
        if learns and not np.isfinite(np.concatenate(learnt)).all():
            raise RuntimeError("a timed chunk did not learn throughout")
        return self.decisions / seconds
