"""Flags of a tiny run, and what stands for training one."""

from __future__ import annotations

import dataclasses

from edqn_jax.config import Config
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.training.history import History
from edqn_jax.training.loop import TrainingResult
from edqn_jax.training.selection import Candidate

SMALL = (
    *("--num-envs", "16", "--train.chunk-steps", "4", "--total-steps", "256", "--agent.batch-size", "16"),
    *("--agent.replay-size", "512", "--agent.learning-starts", "64", "--camera.width", "8", "--camera.height", "6"),
    *("--world.pool-size", "4", "--world.missions", "16", "--drone.physics", "rigid_body"),
    *("--env.max-decisions", "12"),
)


def untrained(seeds: int, config: Config) -> list[TrainingResult]:
    """Stands for training, which has tests of its own."""
    results = []
    for seed in range(seeds):
        own = dataclasses.replace(config, train=dataclasses.replace(config.train, seed=seed))
        policy = Policy(own, fresh_policy(own, seed))
        results.append(TrainingResult(policy, History(), Candidate(policy.params), None, 256, False, 1.5, 2.5))  # type: ignore[arg-type]
    return results
