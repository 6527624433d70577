"""Checkpoints of three small arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edqn_jax.runs.checkpoints import states
from edqn_jax.runs.checkpoints.states import Checkpoint

ARRAYS = {
    ".actors.env": np.arange(12, dtype=np.float32).reshape(3, 4),
    ".learner['a.b/c']": np.array(True),
    ".step": np.int32(7) * np.ones((), np.int32),
}


def saved(folder: Path, step: int, keep: int = 2) -> Path:
    arrays = {**ARRAYS, ".step": np.asarray(step, np.int32)}
    return states.save_checkpoint(
        folder, step, Checkpoint(arrays, {"done": step}, "train: {}\n", {"reward": "r"}), keep
    )


def file_name(step: int) -> str:
    return f"step-{step:09}.safetensors"


def newest(folder: Path) -> tuple[Checkpoint | None, list[str]]:
    said: list[str] = []
    return states.newest_checkpoint(folder, lambda checkpoint: None, said.append), said
