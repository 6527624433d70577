"""Loading MuJoCo where it is to draw: it looks for OpenGL, of the kind that MUJOCO_GL names, as it is imported."""

from __future__ import annotations

import importlib
import os

from edqn_jax.errors import ConfigError


def load_mujoco() -> None:
    """Imports MuJoCo, with EGL unless MUJOCO_GL names something else.

    Raises:
        ConfigError: if there is no such OpenGL.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        importlib.import_module("mujoco")
    except Exception as error:  # what a missing library raises differs by its kind
        raise no_opengl(error) from None


def no_opengl(error: Exception) -> ConfigError:
    """Returns what is to be said where MuJoCo cannot draw."""
    return ConfigError(
        f"MuJoCo cannot draw with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r} ({' '.join(str(error).split())}); "
        "install EGL (Debian: libegl1) or OSMesa (libosmesa6) and name it in MUJOCO_GL: egl or osmesa"
    )
