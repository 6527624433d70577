"""A camera's lens as its calibration file describes it, of Kalibr or in DSEC's layout, and where each pixel looks.

Models are those that OpenCV documents: a pinhole with radial and tangential distortion (`radtan`), or the equidistant
fisheye (`equidistant`). A pixel's centre has whole coordinates.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError

COEFFICIENTS = {"none": (0,), "radtan": (4, 5), "equidistant": (4,)}
"""How many each model has: k1 k2 p1 p2 and perhaps k3, or k1 to k4."""

MOST_RAD = 1.5
"""Pixels that look further to the side than this are left out: a pinhole has no place for them."""

STEPS, NEAR = 50, 1e-9
"""Of Newton's method, which mostly needs four; and how near it must come."""


@dataclasses.dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion of a camera."""

    size: tuple[int, int]
    """Width and height, pixels."""
    matrix: tuple[float, float, float, float]
    """fx, fy, cx, cy, pixels."""
    model: str
    """Of `COEFFICIENTS`."""
    coefficients: tuple[float, ...]

    def directions(self) -> NDArray[np.float64]:
        """Returns where each pixel looks [H, W, 2]: how far to the right and down for one ahead; nan where nowhere."""
        width, height = self.size
        fx, fy, cx, cy = self.matrix
        columns, rows = np.meshgrid((np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy)
        seen = np.stack([columns, rows], axis=-1).astype(np.float64)
        if self.model == "none":
            return seen
        return (_without_radtan if self.model == "radtan" else _without_equidistant)(seen, self.coefficients)

    def check_size(self, size: tuple[int, int], name: str) -> None:
        """Raises ConfigError if the camera has another size; `name` is the calibration's.

        Raises:
            ConfigError: says both sizes.
        """
        if size != self.size:
            raise ConfigError(
                f"the calibration '{name}' is of {self.size[0]} x {self.size[1]} pixels, and the camera has {size[0]} "
                f"x {size[1]}"
            )


def _without_radtan(seen: NDArray[np.float64], coefficients: tuple[float, ...]) -> NDArray[np.float64]:
    k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
    x, y = seen[..., 0].copy(), seen[..., 1].copy()
    with np.errstate(all="ignore"):  # what does not converge is left out
        for _ in range(STEPS):
            square = x * x + y * y
            radial = 1 + square * (k1 + square * (k2 + square * k3))
            slope = 2 * (k1 + square * (2 * k2 + 3 * k3 * square))  # of the radial part, by x over x
            off_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x) - seen[..., 0]
            off_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y - seen[..., 1]
            xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
            xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
            yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
            folds = xx * yy - xy * xy
            x, y = x - (yy * off_x - xy * off_y) / folds, y - (xx * off_y - xy * off_x) / folds
        good = (np.hypot(off_x, off_y) < NEAR) & (folds > 0) & (np.hypot(x, y) < np.tan(MOST_RAD))
    return np.where(good[..., None], np.stack([x, y], axis=-1), np.nan)


def _without_equidistant(seen: NDArray[np.float64], coefficients: tuple[float, ...]) -> NDArray[np.float64]:
    bent = np.hypot(seen[..., 0], seen[..., 1])
    angle, terms = bent.copy(), np.array(coefficients)
    powers = 2 * np.arange(1, 5)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            raised = angle[..., None] ** powers
            off = angle * (1 + raised @ terms) - bent
            slope = 1 + raised @ (terms * (powers + 1))
            angle = angle - off / slope
        good = (np.abs(off) < NEAR) & (slope > 0) & (np.abs(angle) < MOST_RAD)
        scale = np.where(bent > 0, np.tan(angle) / np.where(bent > 0, bent, 1.0), 1.0)
    return np.where(good[..., None], seen * scale[..., None], np.nan)


def read_lens(name: str) -> Lens:
    """Returns the lens of `FILE`, or `FILE:CAMERA` for another camera than `cam0`.

    Args:
        name: of a YAML file as Kalibr writes it (`camchain.yaml`), or of DSEC's (`cam_to_cam.yaml`).

    Raises:
        ConfigError: if there is no such file or camera, or it is not described as expected.
    """
    file, _, camera = (name, "", "") if Path(name).is_file() else name.rpartition(":")
    camera = camera or "cam0"
    if not Path(file).is_file():
        raise ConfigError(f"there is no calibration '{name}'")
    try:
        held = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"'{file}' is no YAML: {' '.join(str(error).split())}") from None
    cameras = held.get("intrinsics", held) if isinstance(held, dict) else {}
    known = {key: value for key, value in cameras.items() if isinstance(value, dict) and "distortion_model" in value}
    if camera not in known:
        named = f"it has {', '.join(known)}" if known else "it describes none as Kalibr or DSEC do"
        raise ConfigError(f"the calibration '{file}' has no camera '{camera}': {named}")
    return _lens_of(f"{file}:{camera}", known[camera])


def _lens_of(name: str, described: Mapping[str, Any]) -> Lens:
    model = described["distortion_model"]
    if described.get("camera_model", "pinhole") != "pinhole" or model not in COEFFICIENTS:
        raise ConfigError(
            f"the calibration '{name}' has the models {described.get('camera_model', 'pinhole')} and {model}; pinhole "
            f"with {', '.join(COEFFICIENTS)} are known"
        )
    matrix = described.get("intrinsics", described.get("camera_matrix"))
    coefficients = described.get("distortion_coeffs") or [0.0]
    try:
        width, height = (int(each) for each in described["resolution"])
        fx, fy, cx, cy = (float(each) for each in matrix)  # pyright: ignore[reportOptionalIterable]
        bends = tuple(float(each) for each in coefficients)
        is_whole = np.all(np.isfinite((fx, fy, cx, cy, *bends))) and min(width, height, fx, fy) > 0
        if not is_whole or (model != "none" and len(bends) not in COEFFICIENTS[model]):
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise ConfigError(
            f"the calibration '{name}' must have a resolution of 2 numbers, fx, fy, cx, cy, and as many coefficients "
            f"as {model} has"
        ) from None
    return Lens((width, height), (fx, fy, cx, cy), model, bends)
