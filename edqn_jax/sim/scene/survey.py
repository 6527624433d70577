"""What became of each geom of an MJCF file, and what of the file is not used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from edqn_jax.sim.scene.mjcf import LoadedWorld, compile_model
from edqn_jax.sim.scene.mjcf_parts.files import SceneError
from edqn_jax.sim.scene.mjcf_parts.geoms import geom_name, is_solid, kind_name, shape_of
from edqn_jax.sim.scene.mjcf_parts.motion import motions_of
from edqn_jax.sim.scene.shapes.kind import kind_of

LEFT_OUT = "in group 3 or above, and nothing collides with it"
"""Why a geom is left out."""


@dataclass(frozen=True)
class GeomFate:
    """What became of a geom."""

    name: str
    geom: str
    """MuJoCo's name of its kind."""
    became: str | None
    """Kind of shape in `SHAPES`; None if it is left out or refused."""
    why: str = ""
    """Why it is left out, or refused and what would be right."""
    is_refused: bool = False


@dataclass(frozen=True)
class Survey:
    """What became of a file."""

    geoms: tuple[GeomFate, ...]
    ignored: tuple[str, ...]
    """What else is not used, such as textures, and what is there instead."""

    @property
    def refused(self) -> list[GeomFate]:
        """Returns the geoms because of which the world cannot be flown."""
        return [fate for fate in self.geoms if fate.is_refused]


def survey_world(path: Path, loaded: LoadedWorld | None) -> Survey:
    """Returns what became of the geoms of an MJCF file, each refused one with its own reason.

    Args:
        path: of the file.
        loaded: the world that it holds; None if `load_world` refuses it.

    Raises:
        SceneError: if MuJoCo cannot read the file, or what it says of motion is wrong.
    """
    model = compile_model(path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    motions = motions_of(model, str(path))
    kinds = {} if loaded is None else {name: kind for kind, names in loaded.names.items() for name in names}
    geoms = []
    for geom in range(model.ngeom):
        name, kind = geom_name(model, geom), kind_name(model, geom)
        if not is_solid(model, geom):
            geoms.append(GeomFate(name, kind, None, LEFT_OUT))
        elif loaded is not None:
            geoms.append(GeomFate(name, kind, kinds[name]))
        else:
            moves = int(model.body_rootid[model.geom_bodyid[geom]]) in motions
            geoms.append(_fate_of(model, data, geom, str(path), moves))
    return Survey(tuple(geoms), tuple(_ignored(model)))


def _fate_of(model: mujoco.MjModel, data: mujoco.MjData, geom: int, title: str, moves: bool) -> GeomFate:
    """Returns what became of a solid geom of a file that is refused."""
    name, kind = geom_name(model, geom), kind_name(model, geom)
    try:
        return GeomFate(name, kind, kind_of(shape_of(model, data, geom, title, moves))[0])
    except SceneError as error:
        reason = str(error).removeprefix(f"{title}: geom '{name}'").removeprefix(":").strip()
        return GeomFate(name, kind, None, reason, is_refused=True)


def _ignored(model: mujoco.MjModel) -> list[str]:
    """Returns what of a model neither the drone nor its camera meets, as sentences without a verb."""
    textures = int(np.sum(model.tex_type != mujoco.mjtTexture.mjTEXTURE_SKYBOX))
    alpha = np.where(model.geom_matid < 0, model.geom_rgba[:, 3], 1.0)
    used = model.geom_matid >= 0
    alpha[used] = model.mat_rgba[model.geom_matid[used], 3]
    clear = sum(alpha[geom] < 1 for geom in range(model.ngeom) if is_solid(model, geom))
    counts = (
        (textures, "texture", "surfaces have a colour and the camera's pattern"),
        (clear, "geom's transparency", "all shapes are opaque"),
        (model.nlight, "light", "there is one sun"),
    )
    return [f"{count} × {name}: {instead}" for count, name, instead in counts if count]
