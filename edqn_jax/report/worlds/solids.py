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
from edqn_jax.report.worlds.meshes import FLOOR_M, Mesh, floor_of, mesh_of_shape, plot_meshes
from edqn_jax.report.worlds.views import SUN, View, pale, shaded
from edqn_jax.sim.scene.scene import PARKED, Scene, scene_at
from edqn_jax.sim.scene.shapes.kind import ShapeKind

SHADOW = "#dedcd5"
OUTLINE = "#a8a8a4"
ABOVE_M = 1.0
"""Metres above start and goal at which what is above them is cut off, and below them what a map shows no more."""
NEAR_WALL_M = 0.3
"""Metres of a mesh around a flight that are cut away on the side of the eye."""
NEARLY_ALL = 0.75
"""Share of the volume's width that a ceiling or an outer wall covers."""
PASSABLE_M = 1.0
"""Metres between a solid and the floor or the ceiling from which on a map shows it as open."""


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
    """Convex solids that are drawn as they are."""
    near_walls: list[Solid]
    """Walls along the rim of the volume, on the side of the eye: drawn as outlines."""
    has_ceiling: bool
    """Whether a ceiling was left out."""
    moving: list[Solid]
    """What moves, where it is at time 0: drawn as outlines."""
    cut: tuple[float, float] | None = None
    """Heights, metres, above which a shape is cut off, and below which it is pale."""
    passable: list[Solid] = dataclasses.field(default_factory=list)
    """On a map: the wall above a door, and what else can be flown under or, below a ceiling, over; drawn pale."""
    meshes: list[Mesh] = dataclasses.field(default_factory=list)
    """Meshes that are drawn as they are."""
    within: list[Solid] = dataclasses.field(default_factory=list)
    """Convex solids that fill those meshes, as far as they are shown."""
    has_pale_floor: bool = False
    """On a map: whether a floor that is part of a mesh is pale, so that what stands on it is seen."""

    @property
    def hiding(self) -> list[Solid]:
        """Solids that hide what is behind them."""
        return [*self.shown, *self.within]

    @property
    def note(self) -> str:
        """Note on what was cut away, for the figure; empty if nothing was."""
        walls = self.near_walls or any(len(mesh.cuts) > 1 for mesh in self.meshes)
        parts = [name for name, cut in (("ceiling", self.has_ceiling), ("near walls", walls)) if cut]
        notes = [f"{' and '.join(parts)} cut away"] if parts else []
        notes += ["open is pale"] if self.passable else []
        notes += ["a mesh's own floor is pale"] if self.has_pale_floor else []
        if self.cut is not None:
            low, high = self.cut
            notes.append(f"cut at {high:.1f} m" + (f", pale below {low:.1f} m" if np.isfinite(low) else ""))
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
    meshes, within, has_pale_floor = [], [], False
    for kind, shape in standing_rows(static_scene(scene)):
        parts, mesh = solids_of_shape(kind, shape), mesh_of_shape(kind, shape)
        heights = cut_of(parts, scene)
        if heights is not None:
            cut = (heights[0] if view.elevation >= 89 else -np.inf, heights[1])
            parts = [low for each in parts if (low := _below(each, cut[1])) and low.corners[:, 2].max() >= cut[0]]
        if mesh is None:
            solids += parts
            continue
        cuts = () if heights is None else _cuts(mesh.corners.reshape(-1, 3), view, heights[1])
        within += [part for part in parts if all((part.corners @ normal).min() < along for normal, along in cuts)]
        open_below = -np.inf if heights is None or view.elevation < 89 else heights[0]
        if view.elevation >= 89 and all(_is_passable(part, lower[2], upper[2], has_ceiling) for part in parts):
            open_below = np.inf
        floor = floor_of(mesh, lower[2] - ABOVE_M, lower[2] + ABOVE_M) if view.elevation >= 89 else None
        if floor is not None and floor + FLOOR_M > open_below:
            open_below, has_pale_floor = floor + FLOOR_M, True
        meshes.append(dataclasses.replace(mesh, cuts=cuts, open_below=open_below))
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
    moving = moving_solids(scene, 0.0)
    return CutawayView(shown, near_walls, has_ceiling, moving, cut, passable, meshes, within, has_pale_floor)


def _cuts(corners: np.ndarray, view: View, height: float) -> tuple[tuple[np.ndarray, float], ...]:
    """Returns planes at which a mesh of corners [N, 3] around a flight is cut: above it, and in its near walls."""
    planes = [(np.array([0.0, 0.0, 1.0]), height)]
    low, high = corners.min(0), corners.max(0)
    for axis in (0, 1) if view.elevation < 89 else ():
        normal = np.sign(view.towards[axis]) * np.eye(3)[axis]
        planes.append((normal, float(max(low @ normal, high @ normal)) - NEAR_WALL_M))
    return tuple(planes)


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


def plot_solids(axes: Axes, view: View, solids: Sequence[Solid], meshes: Sequence[Mesh] = ()) -> None:
    """Draws the solids, the far ones first, each as its faces that look at the eye; or, with meshes, all as these."""
    if meshes:
        plot_meshes(axes, view, [*meshes, *(_as_mesh(solid) for solid in solids)])
        return
    rings, colours = faces_seen(view, solids)
    # Edges in the face's own colour close the hairline between neighbouring faces.
    bodies = PolyCollection(rings, facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=2)
    axes.add_collection(bodies)


def _as_mesh(solid: Solid) -> Mesh:
    """Returns a solid as triangles."""
    corners = []
    for face, normal in zip(solid.faces, solid.outward, strict=True):
        ring = face if _newell(face) @ normal > 0 else face[::-1]
        corners += [ring[[0, k, k + 1]] for k in range(1, len(ring) - 1)]
    return Mesh(np.stack(corners), np.asarray(solid.colour))


def plot_passable(axes: Axes, view: View, solids: Sequence[Solid]) -> None:
    """Draws solids that leave a way above or below them, pale."""
    rings, colours = faces_seen(view, solids)
    faint = [pale(colour) for colour in colours]
    axes.add_collection(PolyCollection(rings, facecolors=faint, edgecolors=faint, linewidths=0.3, zorder=1.8))


def faces_seen(view: View, solids: Sequence[Solid]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Returns the faces of solids that look at the eye, [k, 2] each, and their colours, in the order of painting."""
    rings, colours = [], []
    for solid in far_to_near(solids, view):
        for face, normal in zip(solid.faces, solid.outward, strict=True):
            if normal @ view.towards > 0:
                rings.append(view.project(face))
                colours.append(shaded(solid.colour, normal))
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
