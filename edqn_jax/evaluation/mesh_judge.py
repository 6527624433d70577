"""Distances to the solids that C MuJoCo does not judge: meshes that are not convex or not closed, and height fields.

C MuJoCo collides with the convex hull of a mesh. Here the nearest point of each triangle that may be the nearest is
trimesh's, so that no code is shared with the grids that training uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import scipy
from numpy.typing import NDArray

from edqn_jax.sim.scene.mjcf_parts.geoms import thickness_of
from edqn_jax.sim.scene.mjcf_parts.solids import field_mesh

_LONGEST_M = 0.5  # edge of the triangles that are looked up by their middles
_CONVEX = 1e-3  # share of its hull that a mesh of which C MuJoCo is the judge may leave empty


@dataclass(frozen=True)
class TriangleSolid:
    """Triangles of a geom, by their middles."""

    triangles: NDArray[np.float64]
    """[F, 3, 3] metres, in the geom's axes, which MuJoCo moves with its body."""
    tree: scipy.spatial.KDTree
    reach: float
    """Most metres from the middle of a triangle to its corners."""
    half: float = 0.0
    """Metres that a surface with a thickness reaches to either side."""

    def distance(self, point: NDArray[np.float64]) -> float:
        """Returns metres from a point [3] in the geom's axes to the surface, on whichever side of it."""
        from trimesh.triangles import closest_point

        middle, _ = self.tree.query(point)
        near = self.triangles[self.tree.query_ball_point(point, middle + self.reach + 1e-9)]
        nearest = closest_point(near, np.broadcast_to(point, (len(near), 3)))
        return float(np.sqrt(np.min(np.sum((nearest - point) ** 2, axis=1)))) - self.half


def triangle_solids(model: mujoco.MjModel, geoms: NDArray[np.int64]) -> dict[int, TriangleSolid]:
    """Returns those of the geoms [N], by their numbers, that C MuJoCo does not judge."""
    found = {}
    for geom in geoms:
        kind, number = model.geom_type[geom], model.geom_dataid[geom]
        if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
            vertices, faces = field_mesh(model, number)
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            vertex, face = model.mesh_vertadr[number], model.mesh_faceadr[number]
            vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[number]].astype(np.float64)
            faces = model.mesh_face[face : face + model.mesh_facenum[number]]
            if not thickness_of(model, geom) and _is_convex(vertices, faces):
                continue
        else:
            continue
        found[int(geom)] = _solid(vertices, faces, thickness_of(model, geom))
    return found


def _is_convex(vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> bool:
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return abs(mesh.volume / mesh.convex_hull.volume - 1) <= _CONVEX


def _solid(vertices: NDArray[np.float64], faces: NDArray[np.integer], thickness: float) -> TriangleSolid:
    from trimesh.remesh import subdivide_to_size

    divided = subdivide_to_size(vertices, faces, max_edge=_LONGEST_M, max_iter=30)
    triangles = divided[0][divided[1]]
    middles = triangles.mean(1)
    reach = float(np.linalg.norm(triangles - middles[:, None], axis=2).max())
    return TriangleSolid(triangles, scipy.spatial.KDTree(middles), reach, thickness / 2)
