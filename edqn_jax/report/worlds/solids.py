"""A scene as convex solids of flat faces, and an orthographic view that draws them in the right order."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Polygon

from edqn_jax.config import SHAPES
from edqn_jax.sim.scene.scene import PARKED, Scene, scene_at
from edqn_jax.sim.scene.shapes.kind import ShapeKind

SUN = np.array([-0.45, -0.6, 0.66])
"""Direction towards the light of the pictures; a unit vector, near enough."""
GROUND = "#f4f3ef"
SHADOW = "#dedcd5"
OUTLINE = "#a8a8a4"
ABOVE_M = 1.0
"""Metres above start and goal at which what is above them is cut off, and below them what a map shows no more."""
NEARLY_ALL = 0.75
"""Share of the volume's width that a ceiling or an outer wall covers."""
PASSABLE_M = 1.0
"""Metres between a solid and the floor or the ceiling from which on a map shows it as open."""
PALE = 0.3
"""Share of its own colour that an open solid has on a map; the rest is the ground's."""


@dataclass(frozen=True)
class Solid:
    """A convex body: faces are [k, 3] corner rings in metres, any orientation; colour is RGB in [0, 1]."""

    faces: list[np.ndarray]
    colour: np.ndarray

    @cached_property
    def corners(self) -> np.ndarray:
        """Returns the corners [N, 3] metres of all faces."""
        return np.concatenate(self.faces)

    @cached_property
    def outward(self) -> np.ndarray:
        """Unit normals that point out of the body, [faces, 3]."""
        centre = self.corners.mean(0)
        normals = np.stack([_ring_normal(face) for face in self.faces])
        middles = np.stack([face.mean(0) for face in self.faces])
        sides = np.sign(np.sum(normals * (middles - centre), axis=1, keepdims=True))
        return normals * sides


@dataclass(frozen=True)
class View:
    """An orthographic view of the world. Angles in degrees; elevation 90 is a map with x to the right."""

    azimuth: float
    elevation: float

    @property
    def towards(self) -> np.ndarray:
        """Unit vector from the world to the eye, [3]."""
        a, e = np.radians([self.azimuth, self.elevation])
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Returns points [..., 3] of the world, metres, on the picture: [..., 2] metres, x to the right and y up."""
        a, e = np.radians([self.azimuth, self.elevation])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
        return np.asarray(points) @ np.stack([right, up], axis=1)


MAP = View(azimuth=-90.0, elevation=90.0)
"""From straight above, x to the right and y up."""


def solids_of(scene: Scene) -> list[Solid]:
    """Returns every shape of one world that is not parked; planes are left out, the ground is drawn by itself."""
    return [solid for kind, shape in standing_rows(scene) for solid in solids_of_shape(kind, shape)]


def solids_of_shape(kind: ShapeKind, shape: Any) -> list[Solid]:
    """Returns the convex solids that a shape that is drawn consists of."""
    assert kind.faces is not None  # `standing_rows` yields what is drawn
    parts = [kind.faces(shape)] if kind.parts is None else kind.parts(shape)
    return [Solid(list(faces), shape.albedo) for faces in parts]


def cut_of(parts: Sequence[Solid], scene: Scene) -> tuple[float, float] | None:
    """Returns between which heights, metres, a shape of several parts is shown if some of it is above a flight's ends.

    None of what lies above neither start nor goal.
    """
    ends = [end for end in np.asarray([scene.start, scene.goal], np.float64) if np.all(np.isfinite(end))]
    for solid in parts if len(parts) > 1 else ():
        low, high = solid.corners.min(0), solid.corners.max(0)
        if any(np.all(low[:2] <= end[:2]) and np.all(end[:2] <= high[:2]) and low[2] > end[2] for end in ends):
            return float(min(end[2] for end in ends)) - ABOVE_M, float(max(end[2] for end in ends)) + ABOVE_M
    return None


def _below(solid: Solid, cut: float) -> Solid | None:
    """Returns the part of an upright solid below a height; None if there is none."""
    if solid.corners[:, 2].min() >= cut:
        return None
    low = [np.minimum(face, [np.inf, np.inf, cut]) for face in solid.faces]
    return Solid([face for face in low if np.linalg.norm(_newell(face)) > 1e-9], solid.colour)


def static_scene(scene: Scene) -> Scene:
    """Returns one world without the shapes that move, and without drones."""
    scene = dataclasses.replace(scene, drones=None)
    return _only(scene, scene_at(scene, None), moving=False)


def moving_solids(scene: Scene, time: float) -> list[Solid]:
    """Returns the shapes of one world that move, where they are at `time` seconds; a ball only while it flies.

    Drones are not among them: they are too small to be drawn to scale.
    """
    scene = dataclasses.replace(scene, drones=None)
    return solids_of(_only(scene, scene_at(scene, jnp.float32(time)), moving=True))


def _only(scene: Scene, now: Scene, moving: bool) -> Scene:
    """Returns the world `now` with those shapes alone that move in `scene`, or that stand; the others are parked."""
    kept = {}
    for kind, here in now.shapes().items():
        shapes = scene.shapes()[kind]
        goes = np.zeros(here.position.shape[0], bool)
        if getattr(shapes, "motion", None) is not None:
            velocity, swing = np.asarray(shapes.motion.velocity), np.asarray(shapes.motion.swing)
            goes |= np.any(velocity, axis=1) | (np.any(swing, axis=(1, 2)) & (np.asarray(shapes.motion.rate) != 0))
        if getattr(shapes, "throw", None) is not None:
            goes |= np.asarray(shapes.throw.early) > 0
        place = np.where((goes == moving)[:, None], np.asarray(here.position), PARKED)
        kept[kind] = dataclasses.replace(here, position=place)
    return now.with_shapes(kept)


@dataclass(frozen=True)
class CutawayView:
    """A world's solids for one view, sorted into what is drawn and what would hide all the rest."""

    shown: list[Solid]
    near_walls: list[Solid]
    """Walls along the rim of the volume, on the side of the eye: drawn as outlines."""
    has_ceiling: bool
    """Whether a ceiling was left out."""
    moving: list[Solid]
    """What moves, where it is at time 0: drawn as outlines."""
    cut: tuple[float, float] | None = None
    """Heights, metres, between which a shape is shown."""
    passable: list[Solid] = dataclasses.field(default_factory=list)
    """On a map: the wall above a door, and what else can be flown under or, below a ceiling, over; drawn pale."""

    @property
    def note(self) -> str:
        """Note on what was cut away, for the figure; empty if nothing was."""
        parts = [name for name, cut in (("ceiling", self.has_ceiling), ("near walls", self.near_walls)) if cut]
        notes = [f"{' and '.join(parts)} cut away"] if parts else []
        notes += ["open is pale"] if self.passable else []
        if self.cut is not None:
            low, high = self.cut
            notes.append(f"cut off above {high:.1f} m" + (f", and below {low:.1f} m" if np.isfinite(low) else ""))
        return "; ".join(notes + (["outlined: what moves, as at the start"] if self.moving else []))


def make_cutaway(scene: Scene, view: View) -> CutawayView:
    """Returns a world as it is drawn: without its ceiling, without outer walls before the eye, and what moves apart.

    On a map of a world with a ceiling, what leaves a gap of `PASSABLE_M` above or below it is apart, too: else the wall
    above a door would close it. In one without, whose volume ends at the height of its walls, what reaches that height
    and leaves a gap below it is.

    A ceiling is a box or another shape in the upper half of the volume that covers nearly all of it, or a plane
    that looks down there; an outer wall runs along nearly a whole side of the volume.
    """
    lower, upper = np.asarray(scene.volume, np.float64)
    middle = (lower[2] + upper[2]) / 2
    planes = zip(np.asarray(scene.planes.position), np.asarray(scene.planes.normal), strict=True)
    has_ceiling = any(normal[2] < -0.9 and middle < position[2] < PARKED / 10 for position, normal in planes)
    shown, near_walls, solids, cut = [], [], [], None
    for kind, shape in standing_rows(static_scene(scene)):
        parts = solids_of_shape(kind, shape)
        heights = cut_of(parts, scene)
        if heights is not None:
            # From above, all that is level has one colour: a map shows a slice.
            cut = (heights[0] if view.elevation >= 89 else -np.inf, heights[1])
            parts = [low for each in parts if (low := _below(each, cut[1])) and low.corners[:, 2].max() >= cut[0]]
        solids += parts
    for solid in solids:
        side = boundary_side(solid, lower, upper)
        if side == (2, 1):
            has_ceiling = True
        elif side is not None and side[1] * view.towards[side[0]] > 1e-6:
            near_walls.append(solid)
        else:
            shown.append(solid)
    passable = []
    if view.elevation >= 89:
        passable = [solid for solid in shown if _is_passable(solid, lower[2], upper[2], has_ceiling)]
    shown = [solid for solid in shown if not any(solid is each for each in passable)]
    return CutawayView(shown, near_walls, has_ceiling, moving_solids(scene, 0.0), cut, passable)


def _is_passable(solid: Solid, floor: float, ceiling: float, has_ceiling: bool) -> bool:
    """Whether a drone fits under or over a solid; without a ceiling, under one over which there is no way."""
    heights = solid.corners[:, 2]
    under, over = heights.min() - floor >= PASSABLE_M, ceiling - heights.max() >= PASSABLE_M
    return bool(under or over) if has_ceiling else bool(under and not over)


def boundary_side(solid: Solid, lower: np.ndarray, upper: np.ndarray) -> tuple[int, int] | None:
    """Returns which side of the volume from `lower` [3] to `upper` [3] a solid closes: its axis, and -1 or 1.

    A ceiling closes (2, 1), an outer wall a side of axis 0 or 1; None of other solids.
    """
    low, high = solid.corners.min(0), solid.corners.max(0)
    middle = (lower[2] + upper[2]) / 2
    covered = (np.minimum(high, upper) - np.maximum(low, lower)) / (upper - lower) > NEARLY_ALL
    if covered[:2].all() and low[2] >= middle:
        return 2, 1
    if high[2] <= middle:
        return None
    rims = ((axis, side) for axis in (0, 1) for side in (-1, 1) if covered[1 - axis])
    return next((rim for rim in rims if _at_rim(*rim, low, high, lower, upper)), None)


def _at_rim(axis: int, side: float, low: np.ndarray, high: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether a solid from `low` to `high` lies wholly at the volume's rim on the `side` of an axis."""
    within = 0.1 * (upper - lower)[axis]
    return bool(low[axis] >= upper[axis] - within if side > 0 else high[axis] <= lower[axis] + within)


def plot_outlines(axes: Axes, view: View, solids: Sequence[Solid]) -> None:
    """Draws the edges of the faces that look at the eye, so that the view goes through."""
    rings = [
        view.project(face)
        for solid in solids
        for face, normal in zip(solid.faces, solid.outward, strict=True)
        if normal @ view.towards > 0
    ]
    edges = PolyCollection(rings, facecolors="none", edgecolors=OUTLINE, linewidths=0.6, zorder=3)
    axes.add_collection(edges)


def plot_solids(axes: Axes, view: View, solids: Sequence[Solid]) -> None:
    """Draws the solids, the far ones first, each as its faces that look at the eye."""
    rings, colours = faces_seen(view, solids)
    # Edges in the face's own colour close the hairline between neighbouring faces.
    bodies = PolyCollection(rings, facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=2)
    axes.add_collection(bodies)


def plot_passable(axes: Axes, view: View, solids: Sequence[Solid]) -> None:
    """Draws solids that leave a way above or below them, pale."""
    ground = np.array([int(GROUND[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    rings, colours = faces_seen(view, solids)
    pale = [PALE * colour + (1 - PALE) * ground for colour in colours]
    axes.add_collection(PolyCollection(rings, facecolors=pale, edgecolors=pale, linewidths=0.3, zorder=1.8))


def faces_seen(view: View, solids: Sequence[Solid]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Returns the faces of solids that look at the eye, [k, 2] each, and their colours, in the order of painting."""
    rings, colours = [], []
    for solid in far_to_near(solids, view):
        for face, normal in zip(solid.faces, solid.outward, strict=True):
            if normal @ view.towards > 0:
                rings.append(view.project(face))
                colours.append(_shaded(solid.colour, normal))
    return rings, colours


def plot_shadows(axes: Axes, view: View, solids: Sequence[Solid], floor: np.ndarray) -> None:
    """Draws the solids' shadows on the ground, as far as the floor's [4, 3] corners reach."""
    fallen = [view.project(_shadow(face)) for solid in solids for face in solid.faces]
    shadows = PolyCollection(fallen, facecolors=SHADOW, edgecolors="none", zorder=1)
    axes.add_collection(shadows, autolim=False)
    shadows.set_clip_path(Polygon(view.project(floor), transform=axes.transData))


def is_occluded(points: np.ndarray, solids: Sequence[Solid], view: View) -> np.ndarray:
    """Returns which of the points [P, 3], metres, a solid hides from the eye, [P] bool: clips rays by convex bodies."""
    covered = np.zeros(len(points), bool)
    for solid in solids:
        normals = solid.outward
        offsets = np.array([normal @ face[0] for normal, face in zip(normals, solid.faces, strict=True)])
        gap = offsets - points @ normals.T
        speed = normals @ view.towards
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = gap / speed
        enter = np.where(speed < -1e-9, crossing, -np.inf).max(1)
        leave = np.where(speed > 1e-9, crossing, np.inf).min(1)
        beside = ((np.abs(speed) <= 1e-9) & (gap < 0)).any(1)
        covered |= ~beside & (leave > np.maximum(enter, 1e-6))
    return covered


def standing_rows(scene: Scene) -> Iterator[tuple[ShapeKind, Any]]:
    """Yields kind and shape, of float64, of each that is drawn and stands in the world."""
    for name, shapes in scene.shapes().items():
        kind = SHAPES.get(name)
        rows = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), shapes)
        for i, place in enumerate(rows.position if kind.faces is not None else ()):
            if np.abs(place).max() < PARKED / 10:
                yield kind, jax.tree.map(lambda leaf, i=i: leaf[i], rows)


def _ring_normal(face: np.ndarray) -> np.ndarray:
    # Newell's sum over the edges does not mind a corner that lies on a line between two others.
    normal = _newell(face)
    return normal / np.linalg.norm(normal)


def _newell(face: np.ndarray) -> np.ndarray:
    return np.sum(np.cross(face, np.roll(face, -1, axis=0)), axis=0)


def _shadow(face: np.ndarray) -> np.ndarray:
    fallen = face - face[:, 2:] / SUN[2] * SUN
    return fallen * np.array([1.0, 1.0, 0.0])


def far_to_near(solids: Sequence[Solid], view: View) -> list[Solid]:
    """Returns the solids in an order in which each may be painted over those before it.

    Of two convex bodies that a plane separates, the one on the eye's side is painted later. The planes tried are those
    of the flat-sided solids' faces and of the axes; where none decides, the nearer middle is painted later.
    """
    if not solids:
        return []
    flat = [solid.outward for solid in solids if len(solid.faces) == 6]
    directions = np.unique(np.concatenate([np.eye(3), -np.eye(3), *flat]).round(6) + 0.0, axis=0)
    directions = directions[directions @ view.towards > 1e-6]
    reach = [solid.corners @ directions.T for solid in solids]
    near, far = (np.stack([pick(along, axis=0) for along in reach]) for pick in (np.max, np.min))
    beyond = (far[:, None] >= near[None] - 1e-6).any(-1)  # [i, j]: i lies on the eye's side of a plane, j behind it
    hides = beyond & ~beyond.T
    nearness = np.array([_nearness(solid, view) for solid in solids])
    left, order = np.ones(len(solids), bool), []
    while left.any():
        free = left & ~(hides & left[None]).any(1)  # nothing that they hide is still to be painted
        candidates = np.flatnonzero(free if free.any() else left)
        chosen = candidates[np.argmin(nearness[candidates])]
        left[chosen] = False
        order.append(solids[chosen])
    return order


def _nearness(solid: Solid, view: View) -> float:
    # The middle's distance; seen from above, the height of the top decides.
    middle = (solid.corners.min(0) + solid.corners.max(0)) / 2
    if view.elevation >= 89:
        return float(solid.corners[:, 2].max())
    return float(middle @ np.array([*view.towards[:2], 0.0]) + 1e-3 * middle[2])


def _shaded(colour: np.ndarray, normal: np.ndarray) -> np.ndarray:
    light = 0.55 + 0.45 * max(float(normal @ SUN), 0.0)
    return np.clip(colour * light * 1.15, 0.0, 1.0)
