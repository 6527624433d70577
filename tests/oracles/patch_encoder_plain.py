"""The patch encoder event by event and pixel by pixel, with one full layer over patch, place and own motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Event = tuple[int, int, int, int]
"""Frame pair, column, row, polarity (-1 or 1)."""


def counts(events: Sequence[Event], pairs: int, height: int, width: int) -> np.ndarray:
    """Returns the number of events of each frame pair, polarity (ON first) and pixel: [pairs, 2, H, W]."""
    total = np.zeros((pairs, 2, height, width))
    for pair, x, y, polarity in events:
        total[pair, 0 if polarity > 0 else 1, y, x] += 1
    return total


def code(
    params: Any, events: Sequence[Event], motion: np.ndarray, pairs: int, size: tuple[int, int], side: int, overlap: int
):
    """Returns mean and log-variance of one window's events; `params` are those of the encoder, `size` is (H, W)."""
    height, width = size
    level = np.log(1.0 + counts(events, pairs, height, width)).reshape(2 * pairs, height, width)
    rows, columns = -(-height // side), -(-width // side)
    layers = [params[name] for name in sorted(params) if name.startswith("patch_")]
    first = [params[f"channel_{number}"]["kernel"] for number in range(2 * pairs)]
    kernel = np.concatenate([*first, params["place"]["kernel"], params["motion"]["kernel"]])
    features = []
    for row in range(rows):
        for column in range(columns):
            patch = np.zeros((2 * pairs, side + 2 * overlap, side + 2 * overlap))
            for y in range(-overlap, side + overlap):
                for x in range(-overlap, side + overlap):
                    if 0 <= row * side + y < height and 0 <= column * side + x < width:
                        patch[:, overlap + y, overlap + x] = level[:, row * side + y, column * side + x]
            across = 2.0 * (column + 0.5) * side / width - 1.0
            down = 2.0 * (row + 0.5) * side / height - 1.0
            z = _relu(np.concatenate([patch.ravel(), [across, down], motion]), kernel, params["channel_0"]["bias"])
            for layer in layers:
                z = _relu(z, layer["kernel"], layer["bias"])
            features.append(z)
    z = np.concatenate([*features, motion])
    for name in sorted(name for name in params if name.startswith("joint_")):
        z = _relu(z, params[name]["kernel"], params[name]["bias"])
    head = params["code"]
    mean, log_variance = (z @ head[name]["kernel"] + head[name]["bias"] for name in ("mean", "log_variance"))
    return np.clip(mean, -1e3, 1e3), np.clip(log_variance, -6.0, 6.0)


def _relu(z: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
    return np.maximum(z @ kernel + bias, 0.0)
