"""Named configurations, and what worlds and hardware change in them.

`default` is the best that we know, and `paper` Table 1 as docs/method.md reads it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from edqn_jax.config.learning import AgentConfig, EncoderConfig, TrainConfig
from edqn_jax.config.options import Config
from edqn_jax.config.registry import FAMILIES, MIXTURES, has_detours
from edqn_jax.config.simulation import EnvConfig, EventsConfig, WorldConfig
from edqn_jax.errors import ConfigError

PRESETS = ("default", "paper")

Layer = Mapping[str, Mapping[str, Any]]

Hardware = Literal["cpu", "gpu"]
"""What defaults are chosen for."""

WORLD = "medium"
"""World of the `default` preset where nothing names one."""

PAPERS_WORLD = "paper"
"""The paper's map, in which the options of `Config` were found."""

RANDOM_WORLDS: Layer = {
    "world": {"flown": "paper", "pool_size": 4096, "missions": 32_768},
    "train": {"total_steps": 1_500_000, "validation_every": 1_500_000, "validation_missions": 1024},
    "encoder": {
        "warmup_decisions": 65_536,
        "replay_size": 65_536,
        "retrain_at": (0.15,),
        "retrain_decisions": 65_536,
    },
    "agent": {"updates_per_step": 4, "turn": True},
    "events": {"threshold": 0.03, "tolerance": 0.03, "frame_times_s": (-0.08, 0.0)},
    "surface": {"pattern": "drawn"},
}
"""What random worlds change in the `default` preset: surfaces that look otherwise in each, since of one look a policy
learns its size in place of distance (docs/surfaces.md); more decisions in more worlds, fewer updates for each, a longer
window of events with lower thresholds, and an encoder that learns from more, and again from flights of the policy,
since there only events tell where obstacles are. No direction is preferred, so what is replayed is turned. The last
flight is through the paper's map, which training never uses (docs/results/random_worlds.md)."""

CLOSED_WORLDS: Layer = {
    "env": {"reward": "geodesic", "progress_weight": 6.0, "path_weight": 2.0, "potential_discount": 0.98},
    "agent": {"discount": 0.98, "n_step": 5},
}
"""What rooms, forests and canyons change further: metres count along the way around obstacles, and more than the metres
flown, since a drone that is paid for the straight line alone hovers where it ends (docs/results/paper.md)."""

DRAWN_WORLDS: Layer = {
    "env": {
        "reward": "geodesic",
        "progress_weight": 6.0,
        "path_weight": 2.0,
        "collision_reward": -60.0,
        "left_volume_reward": -60.0,
    },
    "train": {"total_steps": 3_000_000, "validation_every": 196_608},
}
"""What a user's own MJCF file changes: the reward counts metres along the way, since behind walls the straight line
leads into a corner, and collisions cost less, since where ways are narrow training otherwise ends in hovering
(docs/decisions/0019-metres-along-the-way.md)."""

GPU: Layer = {
    "world": {"pool_size": 16_384, "missions": 131_072},
    "train": {
        "num_envs": 16_384,
        "chunk_steps": 16,
        "total_steps": 60_000_000,
        "validation_every": 2_097_152,
        "validation_missions": 512,
    },
    "env": {"collision_reward": -300.0, "left_volume_reward": -300.0},
    "encoder": {
        "code_size": 64,
        "patch_layers": (64, 16),
        "joint_layers": (256, 128),
        "warmup_decisions": 2_097_152,
        "warmup_updates_per_step": 24,
        "batch_size": 4096,
        "replay_size": 524_288,
        "retrain_at": (0.2, 0.5),
        "retrain_decisions": 2_097_152,
    },
    "agent": {
        "hidden": (256, 256),
        "batch_size": 4096,
        "updates_per_step": 8,
        "replay_size": 1_048_576,
        "exploration_end": 0.005,
    },
}
"""What a GPU changes further for random worlds: as many environments as fill it, larger networks and updates, a larger
pool of worlds, since a small one is learnt by heart, and collisions that cost more, which takes more decisions to learn
(docs/ablation.md)."""


GPU_CLOSED: Layer = {"agent": {"hidden": (512, 512)}}
"""What a GPU changes further for rooms, forests and canyons."""

GPU_MIXED: Layer = {"agent": {"hidden": (1024, 1024, 1024), "layer_norm": True, "replay_size": 2_097_152}}
"""What a GPU changes further for one policy of all six families: a larger, normalised Q-network and a larger replay
(docs/decisions/0022-one-policy-for-six-families.md)."""

GPU_FROM_FILE: Layer = {
    "train": {"num_envs": 2048, "chunk_steps": 32, "total_steps": 6_000_000, "validation_every": 2_000_000},
    "encoder": {
        "warmup_decisions": 131_072,
        "warmup_updates_per_step": 12,
        "batch_size": 1024,
        "replay_size": 131_072,
    },
    "agent": {
        "hidden": (256, 256),
        "batch_size": 1024,
        "replay_size": 1_048_576,
        "learning_starts": 65_536,
        "random_decisions": 16_384,
    },
}
"""What a GPU changes for a world from a file: more environments and larger batches
(docs/decisions/0014-gpu-defaults-and-seeds.md)."""


def world_layers(world: str, tuned_for: Hardware) -> list[Layer]:
    """Returns what a world and the hardware change in the `default` preset; later ones replace earlier ones."""
    if world == PAPERS_WORLD:
        return gpu_layers(world, tuned_for)
    if world not in FAMILIES:
        return [DRAWN_WORLDS, *gpu_layers(world, tuned_for)]
    return [RANDOM_WORLDS, *([CLOSED_WORLDS] if has_detours(world) else []), *gpu_layers(world, tuned_for)]


def gpu_layers(world: str, tuned_for: Hardware | Literal["auto"]) -> list[Layer]:
    """Returns what a GPU changes for a world."""
    if tuned_for != "gpu":
        return []
    if world not in FAMILIES:
        return [GPU_FROM_FILE]
    if not has_detours(world):
        return [GPU]
    return [GPU, GPU_MIXED if world in MIXTURES else GPU_CLOSED]


def get_preset(name: str) -> Config:
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
