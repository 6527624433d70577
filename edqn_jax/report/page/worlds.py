"""A world as the page's 3D view draws it: shapes with sizes, colours, and which side of the volume they close."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from edqn_jax.report.worlds.solids import Solid, boundary_side, cut_of, solids_of_shape, standing_rows
from edqn_jax.sim.scene.motion import NEVER, OUTSIDE_M, ball_positions
from edqn_jax.sim.scene.scene import Scene, aim_of
from edqn_jax.sim.scene.shapes.kind import ShapeKind


def world_data(scene: Scene) -> dict[str, Any]:
    """Returns one world as plain JSON data: `lower` and `upper` of its volume, and `shapes`, lengths in metres.

    A shape has its `kind` (box, cylinder, capsule, sphere, faces, mesh), centre `at`, `colour`, and of its kind `half`
    and `turn` (body-to-world, row by row), `radius`, `axis` and `half`, `faces`, rings of corners about the centre, or
    `turn`, `vertices` and `triangles`; a mesh that `hides` flights is cut off above the drone, seen from above.
    `closes` is the axis and the sign of the side of the volume that a ceiling or an outer wall closes: the view leaves
    it out when it looks from there. `moves` says where a shape is at another time.
    """
    lower, upper = np.asarray(scene.volume, np.float64)
    shapes = []
    for kind, shape in standing_rows(scene):
        moves = _motion(shape)
        parts = solids_of_shape(kind, shape)
        hides = {"hides": True} if cut_of(parts, scene) is not None else {}
        if kind.page is not None and kind.faces is not None:
            parts = [Solid(list(kind.faces(shape)), shape.albedo)]
        for solid in parts:
            closes = None if moves else boundary_side(solid, lower, upper)
            drawn = _drawing(kind, shape, solid) | {"colour": _hex(solid.colour)} | moves | hides
            shapes.append(drawn | ({} if closes is None else {"closes": list(closes)}))
    return {"lower": round_values(lower), "upper": round_values(upper), "shapes": shapes}


def ball_data(scene: Scene) -> list[dict[str, Any]]:
    """Returns the balls that are thrown within a flight, as shapes of `world_data`, which holds none of them."""
    return list(_balls(scene))


def _motion(shape: Any) -> dict[str, Any]:
    """Returns `moves` of a shape; nothing of one that stands."""
    motion = getattr(shape, "motion", None)
    if motion is None:
        return {}
    moves = {field.name: round_values(getattr(motion, field.name), 6) for field in dataclasses.fields(motion)}
    return {"moves": moves} if np.any(moves["velocity"]) or np.any(moves["swing"]) else {}


def _balls(scene: Scene) -> Iterator[dict[str, Any]]:
    """Yields the balls that are thrown within the flight."""
    throw = scene.spheres.throw
    if throw is None:
        return
    aim = aim_of(scene, throw)
    hits, aims = np.asarray(aim.launch + throw.early), np.asarray(aim.point)
    # A second before the hit, without gravity, it is so far away from there.
    straight = dataclasses.replace(throw, gravity=jnp.zeros_like(throw.gravity))
    before = np.stack([ball_positions(straight, aim, hit - 1.0)[i] for i, hit in enumerate(hits)])
    for i in np.flatnonzero((np.asarray(throw.early) > 0) & (np.asarray(aim.launch) < NEVER)):
        speed, colour = float(throw.speed[i]), np.asarray(scene.spheres.albedo[i])
        moves = {"hit": float(hits[i]), "early": float(throw.early[i]), "speed": speed, "outside": OUTSIDE_M}
        moves |= {
            "gravity": float(throw.gravity[i]),
            "aim": round_values(aims[i]),
            "from": round_values((before[i] - aims[i]) / speed, 6),
        }
        yield {
            "kind": "sphere",
            "at": round_values(aims[i]),
            "radius": round_values(scene.spheres.radius[i]),
            "colour": _hex(colour),
            "moves": moves,
        }


def _drawing(kind: ShapeKind, shape: Any, solid: Solid) -> dict[str, Any]:
    """Returns what the view draws of a shape that stands in the world: the whole, or one of the solids it consists of.

    The view takes each face's outer side from the place that the solid stands at, which is within.
    """
    at = solid.corners.mean(0) if kind.page is None and kind.parts is not None else shape.position
    if kind.page is None:
        sizes = {"kind": "faces", "faces": [face - at for face in solid.faces]}
    else:
        sizes = kind.page(shape)
    digits = {"turn": 5, "axis": 5}
    numbers = {
        name: [round_values(ring) for ring in value]
        if name == "faces"
        else np.asarray(value).tolist()
        if name == "triangles"
        else round_values(value, digits.get(name, 3))
        for name, value in sizes.items()
        if name != "kind"
    }
    return {"kind": sizes["kind"], "at": round_values(at), **numbers}


def round_values(values: Any, digits: int = 3) -> Any:
    """Returns numbers as plain data, rounded; by default to millimetres."""
    return (np.round(np.asarray(values, np.float64), digits) + 0.0).tolist()


def _hex(colour: np.ndarray) -> str:
    return "#" + "".join(f"{round(255 * float(channel)):02x}" for channel in np.clip(colour, 0, 1))
