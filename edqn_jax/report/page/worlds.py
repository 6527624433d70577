"""A world as the page's 3D view draws it: shapes with sizes, colours, and which side of the volume they close."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from edqn_jax.report.solids import closed_side, present, solids_of
from edqn_jax.sim.scene.motion import NEVER, OUTSIDE_M, thrown_to
from edqn_jax.sim.scene.scene import PARKED, Scene, aim_of


def world_data(scene: Scene) -> dict[str, Any]:
    """Returns one world as plain JSON data: `lower` and `upper` of its volume, and `shapes`, lengths in metres.

    A shape has its `kind` (box, cylinder, capsule, sphere), centre `at`, `colour`, and of its kind `half` and `turn`
    (body-to-world, row by row), `radius`, `axis` and `half`. `closes` is the axis and the sign of the side of the
    volume that a ceiling or an outer wall closes: the view leaves it out when it looks from there. `moves` says where a
    shape is at another time.
    """
    lower, upper = np.asarray(scene.volume, np.float64)
    shapes = []
    for shape, solid, moves in zip(_shapes(scene), solids_of(scene), _motions(scene), strict=True):
        closes = None if moves else closed_side(solid, lower, upper)
        shape |= {"colour": _hex(solid.colour)} | moves
        shapes.append(shape | ({} if closes is None else {"closes": list(closes)}))
    return {"lower": rounded(lower), "upper": rounded(upper), "shapes": shapes}


def ball_data(scene: Scene) -> list[dict[str, Any]]:
    """Returns the balls that are thrown within a flight, as shapes of `world_data`, which holds none of them."""
    return list(_balls(scene))


def _motions(scene: Scene) -> Iterator[dict[str, Any]]:
    """Yields `moves` of every shape that is not parked, in the order of `solids_of`; nothing of those that stand."""
    for kind in ("boxes", "tilted_boxes", "cylinders", "tilted_cylinders", "capsules", "spheres"):
        shapes = getattr(scene, kind)
        if shapes.motion is None:
            yield from ({} for _ in present(shapes, "position"))
            continue
        names = [field.name for field in dataclasses.fields(shapes.motion)]
        columns = [np.asarray(getattr(shapes.motion, name), np.float64) for name in names]
        for place, *values in zip(np.asarray(shapes.position), *columns, strict=True):
            if np.abs(place).max() < PARKED / 10:
                moves = {name: rounded(value, 6) for name, value in zip(names, values, strict=True)}
                yield {"moves": moves} if np.any(moves["velocity"]) or np.any(moves["swing"]) else {}


def _balls(scene: Scene) -> Iterator[dict[str, Any]]:
    """Yields the balls that are thrown within the flight."""
    throw = scene.spheres.throw
    if throw is None:
        return
    aim = aim_of(scene, throw)
    hits, aims = np.asarray(aim.launch + throw.early), np.asarray(aim.point)
    # A second before the hit, without gravity, it is so far away from there.
    straight = dataclasses.replace(throw, gravity=jnp.zeros_like(throw.gravity))
    before = np.stack([thrown_to(straight, aim, hit - 1.0)[i] for i, hit in enumerate(hits)])
    for i in np.flatnonzero((np.asarray(throw.early) > 0) & (np.asarray(aim.launch) < NEVER)):
        speed, colour = float(throw.speed[i]), np.asarray(scene.spheres.albedo[i])
        moves = {"hit": float(hits[i]), "early": float(throw.early[i]), "speed": speed, "outside": OUTSIDE_M}
        moves |= {
            "gravity": float(throw.gravity[i]),
            "aim": rounded(aims[i]),
            "from": rounded((before[i] - aims[i]) / speed, 6),
        }
        yield {
            "kind": "sphere",
            "at": rounded(aims[i]),
            "radius": rounded(scene.spheres.radius[i]),
            "colour": _hex(colour),
            "moves": moves,
        }


def _shapes(scene: Scene) -> Iterator[dict[str, Any]]:
    """Yields every shape that is not parked, in the order of `solids_of`."""
    for at, half, yaw in present(scene.boxes, "position", "half", "yaw"):
        c, s = np.cos(yaw), np.sin(yaw)
        yield {
            "kind": "box",
            "at": rounded(at),
            "half": rounded(half),
            "turn": rounded([c, -s, 0, s, c, 0, 0, 0, 1], 5),
        }
    for at, half, turn in present(scene.tilted_boxes, "position", "half", "rotation"):
        yield {"kind": "box", "at": rounded(at), "half": rounded(half), "turn": rounded(turn.ravel(), 5)}
    for at, radius, half in present(scene.cylinders, "position", "radius", "half_height"):
        yield _along("cylinder", at, np.array([0.0, 0.0, 1.0]), half, radius)
    for name, kind in (("tilted_cylinders", "cylinder"), ("capsules", "capsule")):
        for at, axis, half, radius in present(getattr(scene, name), "position", "axis", "half_length", "radius"):
            yield _along(kind, at, axis, half, radius)
    for at, radius in present(scene.spheres, "position", "radius"):
        yield {"kind": "sphere", "at": rounded(at), "radius": rounded(radius)}


def _along(kind: str, at: np.ndarray, axis: np.ndarray, half: np.ndarray, radius: np.ndarray) -> dict[str, Any]:
    sizes = {"half": rounded(half), "radius": rounded(radius)}
    return {"kind": kind, "at": rounded(at), "axis": rounded(axis, 5), **sizes}


def rounded(values: Any, digits: int = 3) -> Any:
    """Returns numbers as plain data, rounded; by default to millimetres."""
    return (np.round(np.asarray(values, np.float64), digits) + 0.0).tolist()


def _hex(colour: np.ndarray) -> str:
    return "#" + "".join(f"{round(255 * float(channel)):02x}" for channel in np.clip(colour, 0, 1))
