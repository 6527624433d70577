"""A world compiled by C MuJoCo, and its geoms as plain arrays for compiled loops."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from edqn_jax.sim.camera.camera import LUMA_WEIGHTS
from edqn_jax.sim.scene.mjcf import write_scene
from edqn_jax.sim.scene.scene import Scene


class Geoms(NamedTuple):
    """G static geoms and the flight volume."""

    kind: NDArray[np.int64]
    """[G] `mjtGeom`."""
    position: NDArray[np.float64]
    """[G, 3] metres."""
    axes: NDArray[np.float64]
    """[G, 3, 3] rows are the geom's axes in the world frame."""
    size: NDArray[np.float64]
    """[G, 3] metres, with MuJoCo's meaning for the kind."""
    luma: NDArray[np.float64]
    """[G] of the albedo."""
    lower: NDArray[np.float64]
    """[3] corner of the flight volume, metres."""
    upper: NDArray[np.float64]


class World(NamedTuple):
    """A compiled world."""

    model: mujoco.MjModel
    data: mujoco.MjData
    geoms: Geoms


def text_of(scene: Scene) -> str:
    """Returns the MJCF of a scene, from which another process can compile it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.xml"
        write_scene(scene, path)
        return path.read_text(encoding="utf-8")


def compiled(text: str) -> World:
    """Compiles an MJCF from `text_of`."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    middle, half = data.site("volume").xpos, model.site("volume").size
    rotation = data.geom_xmat.reshape(-1, 3, 3)
    geoms = Geoms(
        kind=model.geom_type.astype(np.int64),
        position=data.geom_xpos.copy(),
        axes=np.ascontiguousarray(rotation.transpose(0, 2, 1)),
        size=model.geom_size.copy(),
        luma=model.geom_rgba[:, :3].astype(np.float64) @ np.array(LUMA_WEIGHTS),
        lower=middle - half,
        upper=middle + half,
    )
    return World(model, data, geoms)
