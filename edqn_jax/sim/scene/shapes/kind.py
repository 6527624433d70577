"""What the package asks of a kind of shape, and the arithmetic that kinds share.

A kind is a `ShapeKind` in the registry `SHAPES`: one file here, or one of a user's. Distance, camera, MJCF, judge and
pictures go through the registered kinds, so that none of them names one. Only what is fast for some names these: the
columns and the C of a level camera (`sim/camera`) and the random worlds.

N is the number of shapes of a kind in one world, [R, C] are rays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.config.registry import SHAPES
from edqn_jax.user_code import check_functions

PARKED = 1e6
"""Coordinate of absent shapes, metres along each axis."""

FAR = np.full(3, PARKED)
GREY = np.full(3, 0.5)
UP = np.array([0.0, 0.0, 1.0])

TINY = 1e-9

THICKNESS = "thickness:"
"""Before the name of a geom, the numeric of the thickness of its mesh, metres."""

LEVEL = 1e-6
"""An axis this near to vertical (sine of the angle) is vertical: 0.1 mm over 100 m."""

Vector = tuple[Array, Array, Array]
"""A vector, an array for each coordinate."""


@struct.dataclass
class Hits:
    """Where rays first meet N shapes, the leading axis; fields broadcast to [N, R, C].

    The point is origin + depth x direction. What colour is there is not asked here (`sim/camera/raycast.py`).
    """

    depth: Array  # of the first intersection, in lengths of the ray's direction
    hit: Array  # bool, whether there is one, at a positive depth
    sides: Sequence[tuple[Any, Vector]]
    """Which side is met, and its unit normal, outwards, world axes: the last whose condition holds; the first has
    none. So whatever depends on the normal of a flat side alone is computed once a shape, not once a ray."""

    @classmethod
    def of(cls, depth: Array, hit: Array, normal: Vector) -> Hits:
        """Returns hits [N, R, C], depths in metres, of shapes with a single side, of that normal."""
        return cls(depth=depth, hit=hit, sides=((None, normal),))

    @property
    def normal(self) -> Vector:
        """Returns the unit normal where each ray meets each shape, three [N, R, C]."""
        x, y, z = (self.by_side(lambda *normal, i=i: normal[i]) for i in range(3))
        return x, y, z

    def by_side(self, of_normal: Callable[..., Array]) -> Array:
        """Returns a function (nx, ny, nz) → array of the normal of the side that is met, [N, R, C]."""
        (_, first), *others = self.sides
        found = of_normal(*first)
        for here, normal in others:
            found = jnp.where(here, of_normal(*normal), found)
        return found


@dataclass(frozen=True)
class Geom:
    """A geom of an MJCF file, in the world's frame."""

    kind: str
    """MuJoCo's name of it, such as `box`."""
    position: np.ndarray
    """[3] metres."""
    rotation: np.ndarray
    """[3, 3] geom-to-world."""
    size: np.ndarray
    """[3] metres, as MuJoCo has it."""
    albedo: np.ndarray
    """[3]"""
    mesh: tuple[np.ndarray, np.ndarray] | None = None
    """Vertices [V, 3], metres, in the geom's axes, and triangles [F, 3] of a mesh, an ellipsoid or a height field;
    None: it is none of them."""
    thickness: float = 0.0
    """Metres of a mesh that is a surface and not closed; 0 of a closed one."""

    def is_upright(self, axis: int = 2) -> bool:
        """Returns whether one of its axes is vertical."""
        return math.hypot(self.rotation[0, axis], self.rotation[1, axis]) < LEVEL


@dataclass(frozen=True)
class ShapeKind:
    """A kind of shape: the dataclass that holds its shapes, and what is asked of them.

    The dataclass has `position` [N, 3] metres, `albedo` [N, 3], `motion`, None where nothing moves, and what else the
    functions here read. Of a single shape its fields lack the leading axis and are numbers of NumPy.
    """

    parked: Any
    """One absent shape, an instance of the dataclass, at `FAR`; its distances must be finite."""
    geom: str
    """MuJoCo's name of the geom that it is read from and written as."""
    distance: Callable[[Any, Array, Array, Array], Array]
    """(shapes, x, y, z of a point) → [N] metres to each surface, negative inside; less than that collides sooner."""
    meet: Callable[[Any, Array, Vector], Hits]
    """(shapes, origin [3] metres, direction of rays, three that broadcast to [1, R, C]) → where they meet shapes."""
    read: Callable[[Geom], Any]
    """A geom of that name → a single shape, or None if another kind is to read it."""
    write: Callable[[Any], dict[str, Any]]
    """A single shape → attributes of its geom beside type, pos and rgba: numbers."""
    asset: Callable[[Any], dict[str, Any]] | None = None
    """A single shape → attributes of the mesh that its geom names: numbers; None: it names none."""
    custom: Callable[[Any], dict[str, Any]] | None = None
    """A single shape → numerics of `<custom>` for its geom: numbers by the word that stands before the geom's name."""
    share: Callable[[Sequence[Any]], Sequence[Any]] | None = None
    """Shapes of several worlds, single or not → the same with equal static fields; None: there are none."""
    slack: float = 0.0
    """Metres that distances near a surface may be too small: a collision there is no error."""
    reach: Callable[[Any], Any] | None = None
    """Shapes, single or not → half extents [..., 3] of the axis-aligned boxes around them, metres; None: endless."""
    faces: Callable[[Any], Sequence[np.ndarray]] | None = None
    """A single shape → rings of corners [k, 3], metres, of a convex solid for pictures; None if it is not drawn."""
    parts: Callable[[Any], Sequence[Sequence[np.ndarray]]] | None = None
    """A single shape → several convex solids for pictures, each as `faces`; None: it is the one of `faces`."""
    page: Callable[[Any], dict[str, Any]] | None = None
    """A single shape → `kind` and sizes of a solid that `report/page/page.js` knows; None draws its faces."""

    def __post_init__(self) -> None:
        """Checks what each function takes.

        Raises:
            ConfigError: names the function and its arguments.
        """
        check_functions(
            self,
            {
                "distance": "shapes, x, y, z",
                "meet": "shapes, origin, direction",
                "read": "geom",
                "write": "shape",
                "asset": "shape",
                "custom": "shape",
                "share": "several",
                "reach": "shapes",
                "faces": "shape",
                "parts": "shape",
                "page": "shape",
            },
        )


def kinds() -> dict[str, ShapeKind]:
    """Returns the registered kinds by name, built-in ones first."""
    return {name: SHAPES.get(name) for name in SHAPES}


def kind_of(shape: Any) -> tuple[str, ShapeKind]:
    """Returns name and kind of a shape, single or not.

    Raises:
        TypeError: if it is of no registered kind.
    """
    for name, kind in kinds().items():
        if type(kind.parked) is type(shape):
            return name, kind
    raise TypeError(f"{type(shape).__name__} is the dataclass of no kind of shape in SHAPES")


def read_shape(geom: Geom) -> Any:
    """Returns a geom as a single shape of the first kind that takes it; None if there is none.

    What has a mesh is read as one where no kind is for its name.
    """
    found = (kind.read(geom) for name in (geom.kind, "mesh") for kind in kinds().values() if kind.geom == name)
    return next((shape for shape in found if shape is not None), None)


def reach_of(shapes: Any) -> Any:
    """Returns half extents [..., 3] metres of the axis-aligned boxes around shapes of one kind; inf of endless ones."""
    reach = kind_of(shapes)[1].reach
    return np.full(np.shape(shapes.position), np.inf) if reach is None else reach(shapes)


def array_module(values: Any) -> Any:
    """Returns `jax.numpy` for arrays of JAX, `numpy` for everything else."""
    return jnp if isinstance(values, jax.Array) else np


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Returns the quaternion [4], w first, of a rotation [3, 3]."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.asarray(rotation, np.float64).ravel())
    return quaternion


def safe_inverse(x: Array) -> Array:
    """Returns 1 / x of [...], finite at 0."""
    return 1.0 / jnp.where(jnp.abs(x) < TINY, TINY, x)


def per_shape(x: Array) -> Array:
    """Reshapes [N] to [N, 1, 1], to broadcast against [N, R, C]."""
    return x[:, None, None]


def nearer_of(a: Hits, b: Hits) -> Hits:
    """Returns the hits [N, R, C] of the union of two solids of the same shapes: those that each ray meets first.

    Depths are in metres; `b` has one side.
    """
    take_b = b.hit & (~a.hit | (b.depth < a.depth))
    ((_, normal),) = b.sides
    depth = jnp.where(take_b, b.depth, a.depth)
    return Hits(depth=depth, hit=a.hit | b.hit, sides=(*a.sides, (take_b, normal)))


def norm(*components: Array) -> Array:
    """Returns the length [...] of a vector, metres, with a finite gradient at 0."""
    return jnp.sqrt(jnp.maximum(sum(c * c for c in components), 1e-20))  # 1e-10 m is nothing


def solid_distance(*gaps: Array) -> Array:
    """Returns the signed distance [N] metres, given the distances beyond each pair of faces (negative: within)."""
    outside = norm(*(jnp.maximum(gap, 0.0) for gap in gaps))
    deepest = gaps[0]
    for gap in gaps[1:]:
        deepest = jnp.maximum(deepest, gap)
    return jnp.where(deepest > 0, outside, deepest)


def offset(position: Array, x: Array, y: Array, z: Array) -> Vector:
    """Returns a point less the positions [N, 3], [N] metres each."""
    return x - position[:, 0], y - position[:, 1], z - position[:, 2]
