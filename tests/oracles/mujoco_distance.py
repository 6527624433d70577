"""Signed distances by MuJoCo: from a probe sphere, moved from point to point, to each geom."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

PROBE_RADIUS = 1e-3
_FAR = 1e3  # MuJoCo reports no distance beyond this


def distances(path: Path, points: np.ndarray) -> dict[str, np.ndarray]:
    """For every named geom of the file, its signed distance [K] from `points` [K, 3], metres."""
    spec = mujoco.MjSpec.from_file(str(path))
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[PROBE_RADIUS, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    me = model.geom("probe").id
    others = [geom for geom in range(model.ngeom) if geom != me]
    found = {model.geom(geom).name: np.empty(len(points)) for geom in others}
    for k, point in enumerate(points):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        for geom in others:
            gap = mujoco.mj_geomDistance(model, data, me, geom, _FAR, None)
            found[model.geom(geom).name][k] = gap + PROBE_RADIUS
    return found
