"""Contacts of a flight by C MuJoCo, which moves the body sphere through the original MJCF.

Shares no code with the signed distance that training uses. A probe sphere of the body's radius is added to the
world. Along the straight segments between physics steps it advances by the clearance that `mj_geomDistance`
reports; no solid is nearer than that, so the search misses neither a thin wall between two steps nor a graze.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

PROBE_NAME = "edqn_body_sphere"
"""Name of the sphere that is added to the world."""

HIDDEN_GROUP = 3
"""Geoms of this group and above without collision bits are annotations, not solids."""

_SHORTEST_ADVANCE_M = 1e-4  # a graze shorter than this is at most 4 nanometres deep for a 0.36 m sphere
_DEPTH_SPACING_M = 5e-3
_FARTHEST_M = 1e3


@dataclass(frozen=True)
class Contact:
    """The first contact of a flight."""

    segment: int
    """The contact lies between positions[segment] and positions[segment + 1]."""
    fraction: float
    """How far along that segment, in [0, 1]."""
    position: tuple[float, float, float]
    """Centre of the body sphere then, metres."""
    geom: str
    """Name of the geom touched, or `geom N` (MuJoCo's number) where it has none."""
    depth: float
    """Deepest overlap with any geom from then to the segment's end, metres."""


@dataclass(frozen=True)
class Judge:
    """A compiled world with the probe sphere. Build it with `load_judge`, once per world."""

    model: mujoco.MjModel
    data: mujoco.MjData
    probe: int
    """Geom number of the probe."""
    solids: NDArray[np.int64]
    """[N] geom numbers of the solids."""
    reach: NDArray[np.float64]
    """[N] radius of each solid's bounding sphere, metres; inf for planes."""


def load_judge(world: str | Path | mujoco.MjSpec, radius: float) -> Judge:
    """Returns the world of an MJCF file (or a spec) with a probe sphere of `radius` metres.

    Raises:
        ValueError: if the file is not MJCF, or the radius is not positive.
    """
    if not radius > 0:
        raise ValueError(f"the body radius must be positive, not {radius}")
    spec = mujoco.MjSpec.from_file(str(world)) if isinstance(world, (str, Path)) else world.copy()
    body = spec.worldbody.add_body(name=PROBE_NAME, mocap=True)
    body.add_geom(name=PROBE_NAME, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0.0, 0.0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    probe = model.geom(PROBE_NAME).id
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    solid = collides | (model.geom_group < HIDDEN_GROUP)
    solid[probe] = False
    solids = np.flatnonzero(solid)
    plane = model.geom_type[solids] == mujoco.mjtGeom.mjGEOM_PLANE
    reach = np.where(plane, np.inf, model.geom_rbound[solids])
    return Judge(model=model, data=data, probe=probe, solids=solids, reach=reach)


def clearance(judge: Judge, position: ArrayLike) -> tuple[float, str]:
    """Returns the distance from the body sphere at `position` [3] to the nearest solid, and that solid's name.

    Metres, negative where they overlap; inf and "" in an empty world.
    """
    data, radius = judge.data, judge.model.geom_size[judge.probe, 0]
    data.geom_xpos[judge.probe] = position
    centres = data.geom_xpos[judge.solids]
    at_least = np.linalg.norm(centres - data.geom_xpos[judge.probe], axis=1) - judge.reach - radius
    nearest, name = np.inf, -1
    for index in np.argsort(at_least):
        if at_least[index] >= nearest:
            break
        geom = int(judge.solids[index])
        distance = mujoco.mj_geomDistance(judge.model, data, geom, judge.probe, _FARTHEST_M, None)
        if distance < nearest:
            nearest, name = distance, geom
    if name < 0:
        return np.inf, ""
    return float(nearest), judge.model.geom(name).name or f"geom {name}"


def replay_contact(judge: Judge, positions: ArrayLike) -> Contact | None:
    """Returns the first contact of the body sphere along the segments between `positions` [n, 3], n >= 2, or None.

    Row 0 is the start of the flight, row k the position after physics step k, metres.

    Raises:
        ValueError: if `positions` is not an array of at least two finite points.
    """
    points = np.asarray(positions, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.isfinite(points).all():
        raise ValueError(f"positions must be finite metres of shape [n, 3] with n >= 2, not of shape {points.shape}")
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])

    def place(distance: float) -> tuple[int, float]:
        segment = min(int(np.searchsorted(travelled, distance, side="right")) - 1, len(steps) - 1)
        if steps[segment] == 0.0:
            return segment, 0.0
        return segment, min(1.0, (distance - travelled[segment]) / steps[segment])

    def at(distance: float) -> NDArray[np.float64]:
        segment, fraction = place(distance)
        return points[segment] + fraction * (points[segment + 1] - points[segment])

    free, here, end = 0.0, 0.0, float(travelled[-1])
    while True:
        gap, _ = clearance(judge, at(here))
        if gap <= 0.0:
            break
        if here >= end:
            return None
        free, here = here, min(end, here + max(gap, _SHORTEST_ADVANCE_M))
    while here - free > 1e-9:  # bisection; `free` never touches, `here` always does
        middle = 0.5 * (free + here)
        if clearance(judge, at(middle))[0] > 0.0:
            free = middle
        else:
            here = middle

    segment, fraction = place(here)
    rest = travelled[segment + 1] - here
    samples = np.linspace(here, travelled[segment + 1], 2 + int(rest / _DEPTH_SPACING_M))
    x, y, z = at(here)
    return Contact(
        segment=segment,
        fraction=float(fraction),
        position=(float(x), float(y), float(z)),
        geom=clearance(judge, at(here))[1],
        depth=max(0.0, -min(clearance(judge, at(sample))[0] for sample in samples)),
    )
