"""Contacts of a flight by C MuJoCo, which moves the body sphere through the original MJCF.

Shares no code with the signed distance that training uses. A probe sphere of the body's radius is added to the
world. Along the straight segments between physics steps it advances by the clearance that `mj_geomDistance`
reports; no solid is nearer than that, so the search misses neither a thin wall between two steps nor a graze. Of meshes
that are not convex, and height fields, it is trimesh that says how far away they are (`mesh_judge.py`).

Mocap bodies of which the file says how they move stand, at every point of the search, where they are at its time. The
sphere then advances by the clearance less what the fastest of them may move meanwhile. Where they are is computed here
from the words of the file, too, by other formulas than the simulator's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from edqn_jax.evaluation.mesh_judge import TriangleSolid, triangle_solids
from edqn_jax.sim.scene.mjcf_parts.geoms import geom_of
from edqn_jax.sim.scene.mjcf_parts.motion import MotionSpec, as_ellipse, motions_of
from edqn_jax.sim.scene.shapes.kind import reach_of, read_shape

PROBE_NAME = "edqn_body_sphere"
"""Name of the sphere that is added to the world."""

HIDDEN_GROUP = 3
"""Geoms of this group and above without collision bits are annotations, not solids."""

_SHORTEST_ADVANCE_M = 1e-4  # a graze shorter than this is at most 4 nanometres deep for a 0.36 m sphere
_DEPTH_SPACING_M = 5e-3
_FARTHEST_M = 1e3
_AWAY_M = 1e6
_OUT_M = 1.0  # beyond the flight volume, and its radius, a ball is no more
_AT_ONCE_S = 1e-3  # times that differ by less are the same
_LEAST_LAUNCH_M = 3.0  # nearer than this, and than it flies, no ball is launched; it is thrown at where the drone is


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
class FlightTrack:
    """A recorded flight, at which balls are thrown."""

    start: ArrayLike
    """[3] metres."""
    goal: ArrayLike
    """[3] metres."""
    places: ArrayLike | None = None
    """[K, 3] metres, where the drone was at its start and after each decision; None flies straight at a steady pace."""
    decision_s: float = 0.0
    """Length of a decision, seconds, where there are places."""


@dataclass(frozen=True)
class Moving:
    """A mocap body that moves."""

    mocap: int
    """Its number among the mocap bodies."""
    position: NDArray[np.float64]
    """[3] at time 0, metres."""
    specs: Sequence[MotionSpec]
    volume: NDArray[np.float64]
    """[2, 3] between which it bounces where the file names no limits, and beyond which a ball is no more, metres."""
    low: NDArray[np.float64]
    """[3] metres from its position to the lowest point of its shapes, 0 or less."""
    high: NDArray[np.float64]
    """[3] metres to the highest point."""

    def at(self, time: float, target: FlightTrack) -> NDArray[np.float64]:
        """Returns the position [3], metres; `_AWAY_M` away for a ball before launch and after its flight."""
        place = self.position.copy()
        for word, numbers in self.specs:
            if word == "throw":
                return self._ball_position(numbers, time, target)
            if word == "bounce":
                low, high = self.volume[0] - self.low, self.volume[1] - self.high
                if len(numbers) == 9:
                    low, high = np.array(numbers[3:6]), np.array(numbers[6:9])
                for axis in range(3):
                    if numbers[axis]:
                        one = self.position[axis], numbers[axis] * time, low[axis], high[axis]
                        place[axis] += _reflect(*one) - self.position[axis]
            else:
                a, b, rate, phase = as_ellipse((word, numbers))
                place += a * (math.cos(phase + rate * time) - math.cos(phase))
                place += b * (math.sin(phase + rate * time) - math.sin(phase))
        return place

    def speed(self) -> float:
        """Returns a bound of its speed, m/s."""
        total = 0.0
        for word, numbers in self.specs:
            if word == "bounce":
                total += float(np.linalg.norm(numbers[:3]))
            elif word != "throw":
                a, b, rate, _ = as_ellipse((word, numbers))
                total += abs(rate) * float(np.linalg.norm(np.stack([a, b]), ord=2))
        return total

    def _ball_position(self, numbers: Sequence[float], time: float, target: FlightTrack) -> NDArray[np.float64]:
        share, early, speed, bearing, elevation, gravity, pace = numbers
        away = np.full(3, _AWAY_M)
        start, goal = (np.asarray(end, np.float64) for end in (target.start, target.goal))
        length = float(np.linalg.norm(goal - start))
        launch = max(share * length / pace - early, 0.0)
        if target.places is None:
            here, aim = start, start + (goal - start) * min(1.0, pace * (launch + early) / length)
        else:
            places, number = np.asarray(target.places, np.float64), int((launch + _AT_ONCE_S) // target.decision_s)
            if number >= len(places):
                return away
            here, last = places[number], places[max(number - 1, 0)]
            launch = number * target.decision_s
            aim = np.clip(here + (here - last) / target.decision_s * early, self.volume[0], self.volume[1])
        if time <= launch + _AT_ONCE_S:
            return away
        heading = math.atan2(goal[1] - here[1], goal[0] - here[0]) + math.radians(bearing)
        up = math.radians(elevation)
        from_there = np.array([math.cos(heading) * math.cos(up), math.sin(heading) * math.cos(up), math.sin(up)])
        least = min(speed * early, _LEAST_LAUNCH_M)
        if target.places is not None and np.linalg.norm(aim + speed * early * from_there - here) < least:
            aim = here
        flown = time - launch
        # From the point of launch, with what is thrown upwards for gravity to take back by the hit.
        place = aim + speed * (early - flown) * from_there
        place[2] += gravity * early / 2 * flown - gravity * flown**2 / 2
        out = (self.high[0] - self.low[0]) / 2 + _OUT_M
        inside = np.all((place >= self.volume[0] - out) & (place <= self.volume[1] + out))
        return place - (self.low + self.high) / 2 if inside else away

    def throw_speed(self, seconds: float) -> float:
        """Returns a bound of the ball's speed within so many seconds of a flight, m/s; 0 for other bodies."""
        word, numbers = self.specs[0]
        return numbers[2] + abs(numbers[5]) * (numbers[1] / 2 + seconds) if word == "throw" else 0.0


def _reflect(position: float, way: float, low: float, high: float) -> float:
    """Returns where a point ends that runs `way` metres from `position` and turns back at `low` and `high`."""
    while way:
        wall = high if way > 0 else low
        if abs(way) <= abs(wall - position):
            return position + way
        way, position = -(way - (wall - position)), wall
    return position


@dataclass(frozen=True)
class MujocoWorld:
    """A compiled world with the probe sphere. Build it with `load_judge`, once per world."""

    model: mujoco.MjModel
    data: mujoco.MjData
    probe: int
    """Geom number of the probe."""
    solids: NDArray[np.int64]
    """[N] geom numbers of the solids."""
    reach: NDArray[np.float64]
    """[N] radius of each solid's bounding sphere, metres; inf for planes."""
    moving: tuple[Moving, ...] = ()
    target: FlightTrack = FlightTrack((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """From site `start` to site `goal` of the world, at a steady pace."""
    meshes: Mapping[int, TriangleSolid] = field(default_factory=dict)
    """The solids, by geom number, that C MuJoCo does not judge."""

    def judge_of(self, geom: str) -> str:
        """Returns who says how far away the geom of this name is."""
        return "trimesh" if geom in {self.name_of(number) for number in self.meshes} else "C MuJoCo"

    def name_of(self, geom: int) -> str:
        """Returns the name of geom number `geom`, or `geom N` where it has none."""
        return self.model.geom(geom).name or f"geom {geom}"


def load_judge(world: str | Path | mujoco.MjSpec, radius: float, volume: ArrayLike | None = None) -> MujocoWorld:
    """Returns the world of an MJCF file (or a spec) with a probe sphere of `radius` metres.

    Args:
        world: the world.
        radius: of the body, metres.
        volume: [2, 3] flight volume in which bodies bounce, metres; None is the world's site `volume`.

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
    moving = tuple(_moving(model, data, solids, volume))
    start, goal = (np.array(data.site(n).xpos) if n in _sites(model) else np.zeros(3) for n in ("start", "goal"))
    meshes = triangle_solids(model, solids)
    return MujocoWorld(model, data, probe, solids, reach, moving, FlightTrack(start, goal), meshes)


def _sites(model: mujoco.MjModel) -> list[str]:
    return [model.site(i).name for i in range(model.nsite)]


def _moving(
    model: mujoco.MjModel, data: mujoco.MjData, solids: NDArray[np.int64], volume: ArrayLike | None
) -> list[Moving]:
    """Returns the bodies that move."""
    motions = motions_of(model, "the world")
    if not motions:
        return []
    if volume is None:
        if "volume" not in _sites(model):
            raise ValueError("a world that moves needs a site 'volume', or the volume that is given")
        site = model.site("volume").id
        volume = data.site_xpos[site] + np.array([[-1.0], [1.0]]) * model.site_size[site]
    found = []
    for body, specs in motions.items():
        geoms = [int(geom) for geom in solids if model.body_rootid[model.geom_bodyid[geom]] == body]
        place = np.array(data.xpos[body])
        extents = np.stack([_extent(model, data, geom) for geom in geoms]) - place
        low, high = extents[:, 0].min(0), extents[:, 1].max(0)
        found.append(Moving(int(model.body_mocapid[body]), place, specs, np.asarray(volume, np.float64), low, high))
    return found


def _extent(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> NDArray[np.float64]:
    """Returns the corners [2, 3] of the axis-aligned box around a geom, whose kind of shape says how far it reaches."""
    shape = read_shape(geom_of(model, data, geom))
    return np.asarray(shape.position + np.array([[-1.0], [1.0]]) * reach_of(shape))


def clearance(
    judge: MujocoWorld, position: ArrayLike, time: float = 0.0, target: FlightTrack | None = None
) -> tuple[float, str]:
    """Returns the distance from the body sphere at `position` [3] to the nearest solid, and that solid's name.

    Metres, negative where they overlap; inf and "" in an empty world. What moves is where it is at `time` seconds;
    balls are thrown at the target, by default the world's own.
    """
    data, radius = judge.data, judge.model.geom_size[judge.probe, 0]
    for body in judge.moving:
        data.mocap_pos[body.mocap] = body.at(time, judge.target if target is None else target)
    if judge.moving:
        mujoco.mj_kinematics(judge.model, data)
    data.geom_xpos[judge.probe] = position
    centres = data.geom_xpos[judge.solids]
    at_least = np.linalg.norm(centres - data.geom_xpos[judge.probe], axis=1) - judge.reach - radius
    nearest, name = np.inf, -1
    for index in np.argsort(at_least):
        if at_least[index] >= nearest:
            break
        geom = int(judge.solids[index])
        if geom in judge.meshes:
            place = (np.asarray(position) - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
            distance = judge.meshes[geom].distance(place) - radius
        else:
            distance = mujoco.mj_geomDistance(judge.model, data, geom, judge.probe, _FARTHEST_M, None)
        if distance < nearest:
            nearest, name = distance, geom
    if name < 0:
        return np.inf, ""
    return float(nearest), judge.name_of(name)


def max_obstacle_speed(judge: MujocoWorld, seconds: float) -> float:
    """Returns a bound of the speed of all obstacles within so many seconds of a flight, m/s."""
    return max((max(body.speed(), body.throw_speed(seconds)) for body in judge.moving), default=0.0)


def replay_contact(
    judge: MujocoWorld, positions: ArrayLike, step_s: float | None = None, target: FlightTrack | None = None
) -> Contact | None:
    """Returns the first contact of the body sphere along the segments between `positions` [n, 3], n >= 2, or None.

    Args:
        judge: of the world.
        positions: row 0 is the start of the flight, row k the position after physics step k, metres.
        step_s: seconds of a physics step; needed where something moves.
        target: as in `clearance`.

    Raises:
        ValueError: if `positions` is not an array of at least two finite points, or `step_s` is missing.
    """
    if judge.moving and step_s is None:
        raise ValueError("the world moves: the contact depends on the seconds of a physics step, step_s")
    step_s = step_s or 0.0
    points = np.asarray(positions, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.isfinite(points).all():
        raise ValueError(f"positions must be finite metres of shape [n, 3] with n >= 2, not of shape {points.shape}")
    way = Way(points, max_obstacle_speed(judge, step_s * len(points)) * step_s)

    def gap_at(distance: float) -> tuple[float, str]:
        segment, fraction = way.place(distance)
        return clearance(judge, way.at(distance), step_s * (segment + fraction), target)

    # A ball may appear between two steps.
    here = _first_touch(way, gap_at, jumps=any(body.specs[0][0] == "throw" for body in judge.moving))
    if here is None:
        return None
    segment, fraction = way.place(here)
    rest = way.travelled[segment + 1] - here
    samples = np.linspace(here, way.travelled[segment + 1], 2 + int(rest / _DEPTH_SPACING_M))
    x, y, z = way.at(here)
    return Contact(
        segment=segment,
        fraction=float(fraction),
        position=(float(x), float(y), float(z)),
        geom=gap_at(here)[1],
        depth=max(0.0, -min(gap_at(sample)[0] for sample in samples)),
    )


class Way:
    """A body's path, parameterised by distance: its own plus the most that obstacles move meanwhile."""

    def __init__(self, points: NDArray[np.float64], meets_m: float) -> None:
        """Takes positions [n, 3] of the body and the most that obstacles move in a step, both in metres."""
        self.points, self.steps = points, np.linalg.norm(np.diff(points, axis=0), axis=1) + meets_m
        self.travelled = np.concatenate([[0.0], np.cumsum(self.steps)])

    def place(self, distance: float) -> tuple[int, float]:
        """Returns the segment at this distance, metres, and the fraction of the segment."""
        segment = min(int(np.searchsorted(self.travelled, distance, side="right")) - 1, len(self.steps) - 1)
        if self.steps[segment] == 0.0:
            return segment, 0.0
        return segment, min(1.0, (distance - self.travelled[segment]) / self.steps[segment])

    def at(self, distance: float) -> NDArray[np.float64]:
        """Returns the position [3] of the body there."""
        segment, fraction = self.place(distance)
        return self.points[segment] + fraction * (self.points[segment + 1] - self.points[segment])


def _first_touch(way: Way, gap_at: Callable[[float], tuple[float, str]], jumps: bool) -> float | None:
    """Returns the metres gone at the first contact; None without one.

    Advances by the gap, which nothing can close sooner, and halves what the last advance left open.

    Args:
        way: of the body.
        gap_at: metres to the nearest solid, and its name, for metres gone.
        jumps: look after every physics step, since something may appear.
    """
    free, here, end = 0.0, 0.0, float(way.travelled[-1])
    while True:
        gap, _ = gap_at(here)
        if gap <= 0.0:
            break
        if here >= end:
            return None
        ahead = way.travelled[min(way.place(here)[0] + 1, len(way.steps))] if jumps else end
        ahead = max(ahead, here + _SHORTEST_ADVANCE_M)
        free, here = here, min(end, ahead, here + max(gap, _SHORTEST_ADVANCE_M))
    while here - free > 1e-9:  # bisection; `free` never touches, `here` always does
        middle = 0.5 * (free + here)
        if gap_at(middle)[0] > 0.0:
            free = middle
        else:
            here = middle
    return here
