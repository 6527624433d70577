"""Geoms of an MJCF world as shapes."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mesh_field import MOST_VALUES
from edqn_jax.sim.scene.mjcf_parts.files import SceneError
from edqn_jax.sim.scene.mjcf_parts.motion import PREFIX
from edqn_jax.sim.scene.mjcf_parts.solids import ellipsoid_mesh, field_mesh
from edqn_jax.sim.scene.scene import Shape
from edqn_jax.sim.scene.shapes.kind import THICKNESS, Geom, kinds, read_shape


def geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Returns the name of a geom, or its number and kind where it has none."""
    return model.geom(geom).name or f"geom number {geom} ({kind_name(model, geom)})"


def is_solid(model: mujoco.MjModel, geom: int) -> bool:
    """Returns whether a geom is part of the world: visible in MuJoCo's viewer, or collided with."""
    return bool(model.geom_group[geom] < 3 or model.geom_contype[geom] or model.geom_conaffinity[geom])


def kind_name(model: mujoco.MjModel, geom: int) -> str:
    """Returns MuJoCo's name of a geom's kind, such as `box`."""
    return mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()


def shape_of(model: mujoco.MjModel, data: mujoco.MjData, geom: int, title: str, moves: bool) -> Shape:
    """Returns a geom as a single shape, in the world's frame.

    Args:
        model: of the world.
        data: with the places of its bodies.
        geom: number of the geom.
        title: of the world in messages.
        moves: whether its mocap body may.

    Raises:
        SceneError: if the geom moves otherwise, is not finite, or is of no kind that is known.
    """
    name = geom_name(model, geom)
    body = model.geom_bodyid[geom]
    root = model.body_rootid[body]
    if model.body_weldid[body] != model.body_weldid[root] or model.body_dofnum[root]:
        raise SceneError(
            f"{title}: geom '{name}' is on a body that can move; remove the joints of body '{model.body(body).name}', "
            "nothing is simulated but the drone"
        )
    if model.body_mocapid[root] >= 0 and not moves:
        text = f"{PREFIX}{model.body(root).name}"
        raise SceneError(
            f"{title}: geom '{name}' is on a body that can move; remove the mocap of body '{model.body(root).name}', "
            f'or say how it moves: <custom><text name="{text}" data="oscillate 0 2 0 4 0"/></custom>'
        )
    found = geom_of(model, data, geom)
    if not all(np.all(np.isfinite(values)) for values in (found.position, found.rotation, found.size)):
        raise SceneError(f"{title}: geom '{name}' has a place or a size that is not finite; give it numbers")
    try:
        shape = read_shape(found)
    except ConfigError as error:
        raise SceneError(f"{title}: geom '{name}': {error}") from None
    if shape is None:
        *some, last = dict.fromkeys(kind.geom for kind in kinds().values())
        raise SceneError(
            f"{title}: geom '{name}' is of the unsupported kind {found.kind}; make it a {', '.join(some)} or {last}, "
            "or hide it in group 3 with contype and conaffinity 0"
        )
    return shape


def check_grids(shapes: Sequence[Shape], title: str) -> None:
    """Checks that the grids of all shapes of a world together are small enough.

    Raises:
        SceneError: names the most that they may be.
    """
    grids = {grid for shape in shapes for grid in getattr(shape, "grids", ())}
    count = sum(grid.values.size for grid in grids)
    if count > MOST_VALUES:
        raise SceneError(
            f"{title}: the grids of its meshes hold more than {MOST_VALUES:,} values; give it fewer meshes"
        )


def _mesh_of(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns vertices [V, 3], metres, and triangles [F, 3] of a mesh, an ellipsoid or a height field."""
    kind, data = model.geom_type[geom], model.geom_dataid[geom]
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return ellipsoid_mesh(tuple(model.geom_size[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        return field_mesh(model, data)
    if kind != mujoco.mjtGeom.mjGEOM_MESH:
        return None
    vertex, face = model.mesh_vertadr[data], model.mesh_faceadr[data]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[data]].astype(np.float64)
    vertices = (vertices @ _turn_of_mesh(model, data).T + model.mesh_pos[data]).astype(np.float32)
    return vertices, model.mesh_face[face : face + model.mesh_facenum[data]]


def _turn_of_mesh(model: mujoco.MjModel, number: int) -> np.ndarray:
    """Returns the rotation [3, 3] from MuJoCo's axes of a mesh to those of its file."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[number])
    return rotation.reshape(3, 3)


def geom_of(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Geom:
    """Returns geom number `geom` of a model, in the world's frame."""
    material = model.geom_matid[geom]
    position, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        # MuJoCo has turned the mesh to its axes of inertia; walls along the axes of its file are along those of a grid.
        number = model.geom_dataid[geom]
        rotation = rotation @ _turn_of_mesh(model, number).T
        position = position - rotation @ model.mesh_pos[number]
    return Geom(
        kind=kind_name(model, geom),
        position=position,
        rotation=rotation,
        size=model.geom_size[geom],
        albedo=(model.geom_rgba[geom] if material < 0 else model.mat_rgba[material])[:3],
        mesh=_mesh_of(model, geom),
        thickness=thickness_of(model, geom),
    )


def thickness_of(model: mujoco.MjModel, geom: int) -> float:
    """Returns the thickness of a geom's mesh, metres, as the numeric `thickness:NAME` says; 0 without one."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, f"{THICKNESS}{model.geom(geom).name}")
    return 0.0 if number < 0 else float(model.numeric_data[model.numeric_adr[number]])
