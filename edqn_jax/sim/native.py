"""The level camera in C, for CPUs: compiles `pictures.c` once for this machine and registers it with XLA.

Where there is a C compiler, pictures and depth images are drawn by the compiled library; everywhere else, and on
GPUs, by the same functions in JAX (`columns.py`, `depth.py`). Both agree to rounding (`tests/sim/test_native.py`).
The library is kept beside compiled programs, in a folder for this kind of processor.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import CameraConfig
from edqn_jax.parallel.programs import private_folder
from edqn_jax.sim import coverage, raycast
from edqn_jax.sim.picture_primitive import most_rows
from edqn_jax.sim.scene import Scene
from edqn_jax.sim.texture import WAVES

SOURCE = Path(__file__).with_name("pictures.c")

SWITCH = "EDQN_JAX_NATIVE"
"""Environment variable; 0 draws with JAX alone."""

FLAGS = (
    *("-std=gnu11", "-O3", "-march=native", "-fPIC", "-shared"),
    # What vector instructions need. Comparisons of NaN are never relied on.
    *("-fno-math-errno", "-fno-trapping-math", "-ffinite-math-only", "-fno-signed-zeros"),
)

KINDS = ("boxes", "cylinders", "spheres", "planes")
"""Kinds of shape that the library draws. A scene with room for any other is drawn by JAX."""

NOWHERE = 1e29
"""Depths beyond this, in metres, are those of rays that meet nothing."""


def can_draw(config: CameraConfig, scene: Scene) -> bool:
    """Returns whether the library is at hand and draws such pictures; known when tracing."""
    others = (scene.tilted_boxes, scene.capsules, scene.tilted_cylinders)
    plain = config.mount == "level" and not any(kind.position.shape[-2] for kind in others)
    return plain and is_at_hand()


def pictures(config: CameraConfig, scene: Scene, origin: Array, rotation: Array, weights: Array) -> Array:
    """Returns brightness [M, H, W] as `columns.picture` does; arrays have a leading [L], see `picture_primitive`."""
    return _call("edqn_pictures", config, scene, origin, rotation, weights)


def depths(config: CameraConfig, scene: Scene, origin: Array, rotation: Array) -> Array:
    """Returns the depth [M, H, W] metres along the middle ray of each pixel, inf where there is nothing.

    As `depth.nearest_depth` does; arrays have a leading [L], see `picture_primitive`.
    """
    found = _call("edqn_depths", config, scene, origin, rotation)
    return jnp.where(found > NOWHERE, jnp.inf, found)


def _call(target: str, config: CameraConfig, scene: Scene, *frames: Array) -> Array:
    u, v = raycast.image_plane(config, 1, 1)
    waves = np.array(
        [[*np.divide(w.direction, config.texture_period_m * w.octave), w.weight] for w in WAVES], np.float32
    )
    first = [raycast.pitch_of(config), config.texture_contrast, config.ambient]
    constants = np.array([*first, *raycast.sun_direction(config), *config.sky_rgb], np.float32)
    shapes = [getattr(getattr(scene, kind), f.name) for kind in KINDS for f in dataclasses.fields(getattr(scene, kind))]
    origin, rotation, *weights = frames
    count = most_rows([*shapes, *frames])
    shape = jax.ShapeDtypeStruct((count, config.height, config.width), jnp.float32)
    return jax.ffi.ffi_call(target, shape)(constants, u, v, waves, origin, rotation, *shapes, *weights)


@functools.cache
def is_at_hand() -> bool:
    """Returns whether the library is compiled, loaded and registered, which the first call does."""
    if os.environ.get(SWITCH, "1") == "0":
        return False
    compiler = shutil.which(os.environ.get("CC", "cc"))
    if compiler is None:
        return False
    try:
        library = ctypes.CDLL(str(_compiled(compiler)))
    except (OSError, subprocess.SubprocessError):
        return False
    for target in ("edqn_pictures", "edqn_depths"):
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, target)), platform="cpu")
    return True


def _compiled(compiler: str) -> Path:
    """Returns the library's file, compiled unless one of the same source, flags and XLA is kept."""
    command = [compiler, *FLAGS, *_definitions(), f"-I{jax.ffi.include_dir()}", str(SOURCE), "-lm"]
    named = hashlib.sha256(SOURCE.read_bytes() + repr((command, jax.__version__)).encode()).hexdigest()[:16]
    folder = private_folder() or Path(tempfile.mkdtemp())
    library = folder / f"pictures-{named}.so"
    if not library.is_file():
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            made = Path(scratch) / library.name
            subprocess.run([*command, "-o", str(made)], check=True, capture_output=True, timeout=60)
            made.replace(library)
    return library


def _definitions() -> Sequence[str]:
    """Returns the constants that the source shares with the modules it speaks of."""
    numbers = {
        "TINY": raycast.TINY,
        "HORIZON_M": raycast.HORIZON_M,
        "NEAR_M": coverage.NEAR_M,
        "FAR_U": coverage.FAR_U,
        "LEVEL_FACE": coverage.LEVEL_FACE,
    }
    return [
        *(f"-D{name}={value:e}f" for name, value in numbers.items()),
        f"-DDEPTH_OF_LAYERS={coverage.DEPTH_OF_LAYERS}",
    ]
