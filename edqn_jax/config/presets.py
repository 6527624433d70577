"""Named configurations: `default`, the best that we know, and `paper`, Table 1 as docs/method.md reads it."""

from __future__ import annotations

import dataclasses

from edqn_jax.config.options import (
    AgentConfig,
    Config,
    EncoderConfig,
    EnvConfig,
    EventsConfig,
    TrainConfig,
    WorldConfig,
)
from edqn_jax.errors import ConfigError

PRESETS = ("default", "paper")


def preset(name: str) -> Config:
    """Returns the named preset.

    Raises:
        ConfigError: if there is none of that name.
    """
    if name == "default":
        return Config()
    if name == "paper":
        return dataclasses.replace(
            Config(),
            events=EventsConfig(threshold=0.1, tolerance=0.1, contrast_on=0.1, contrast_off=0.1),
            encoder=EncoderConfig(
                architecture="pooled",
                target="sensed",
                warmup_updates_per_step=12,
                batch_size=16,
                replay_size=16,
                mirror=False,
            ),
            env=EnvConfig(
                reward="sparse",
                progress_weight=1.0,
                path_weight=0.0,
                potential_discount=0.99,
                left_volume_reward=0.0,
                step_reward=0.0,
            ),
            agent=AgentConfig(
                hidden=(16, 16),
                history=1,
                dueling=False,
                double=False,
                n_step=1,
                discount=0.99,
                target_rate=0.005,
                learning_rate=4e-4,
                final_learning_rate=4e-4,
                max_gradient_norm=float("inf"),
                average_rate=1.0,
                huber_delta=0.0,
                reward_scale=1.0,
                batch_size=128,
                updates_per_step=16,
                learning_starts=1024,
                exploration_end=0.01,
                exploration_episodes=10,
            ),
            # Its updates are so small that two devices would mostly wait for each other.
            train=TrainConfig(
                num_envs=16, total_steps=500_000, max_episodes=40_000, chunk_steps=512, devices=1, keep="last"
            ),
            world=WorldConfig(own_start_fraction=1.0, start_jitter_m=0.0),
        )
    raise ConfigError(f"there is no preset '{name}'; the presets are {', '.join(PRESETS)}")
