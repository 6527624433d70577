"""A small workload that is trained as any other."""

from __future__ import annotations

MINIATURE = (
    *("--num-envs", "16", "--agent.batch-size", "16", "--agent.replay-size", "512", "--agent.learning-starts", "64"),
    *("--camera.width", "8", "--camera.height", "6", "--train.validation-missions", "2", "--world.missions", "16"),
)
"""Flags of train.py."""
