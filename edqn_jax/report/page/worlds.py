"""A world as the page's 3D view draws it: shapes with sizes, colours, and which side of the volume they close."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from edqn_jax.report.solids import Solid, closed_side, present, solids_of
from edqn_jax.sim.scene import Scene


def world_data(scene: Scene) -> dict[str, Any]:
    """Returns one world as plain JSON data: `lower` and `upper` of its volume, and `shapes`, lengths in metres.

    A shape has its `kind` (box, cylinder, capsule, sphere), centre `at`, `colour`, and of its kind `half` and `turn`
    (body-to-world, row by row), `radius`, `axis` and `half`. `closes` is the axis and the sign of the side of the
    volume that a ceiling or an outer wall closes: the view leaves it out when it looks from there.
    """
    lower, upper = np.asarray(scene.volume, np.float64)
    shapes = []
    for shape, solid in zip(_shapes(scene), solids_of(scene), strict=True):
        closes = closed_side(solid, lower, upper)
        shapes.append(shape | {"colour": _hex(solid)} | ({} if closes is None else {"closes": list(closes)}))
    return {"lower": rounded(lower), "upper": rounded(upper), "shapes": shapes}


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


def _hex(solid: Solid) -> str:
    return "#" + "".join(f"{round(255 * float(channel)):02x}" for channel in np.clip(solid.colour, 0, 1))
