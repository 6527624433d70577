"""Makes `scenes/examples/building.obj`: a furnished house of two storeys, 24 x 14 x 8 m, some 60,000 triangles.

    python scripts/make_building.py

Walls and furniture are closed solids that overlap. The hall in the middle is as high as the house; the rooms beside it
have openings of 5 m.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from trimesh import Trimesh
from trimesh.creation import box, cylinder, icosphere, torus

from edqn_jax.sim.scene.scans.scan import obj_text

FILE = Path(__file__).parents[1] / "scenes/examples/building.obj"
LENGTH, WIDTH, STOREY, THICK = 24.0, 14.0, 4.0, 0.2
HALL = (9.0, 15.0)
"""Metres along x between which the upper floor is open."""
DOOR = 5.0


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Trimesh:
    """Returns a box between two corners, metres."""
    return box(bounds=[low, high])


def post(x: float, y: float, floor: float, height: float, radius: float, sections: int = 24) -> Trimesh:
    """Returns an upright cylinder that stands on a floor."""
    solid = cylinder(radius=radius, height=height, sections=sections)
    return solid.apply_translation([x, y, floor + height / 2])


def shell() -> list[Trimesh]:
    """Returns floors, roof and walls."""
    parts = [block((0, 0, 0), (LENGTH, WIDTH, THICK)), block((0, 0, 2 * STOREY - THICK), (LENGTH, WIDTH, 2 * STOREY))]
    for x in ((0.0, HALL[0]), (HALL[1], LENGTH)):
        parts.append(block((x[0], 0, STOREY - THICK / 2), (x[1], WIDTH, STOREY + THICK / 2)))
    parts += [block((x, 0, 0), (x + THICK, WIDTH, 2 * STOREY)) for x in (0.0, LENGTH - THICK)]
    parts += [block((0, y, 0), (LENGTH, y + THICK, 2 * STOREY)) for y in (0.0, WIDTH - THICK)]
    for x in (HALL[0] - THICK / 2, HALL[1] - THICK / 2):
        for floor in (0.0, STOREY):
            parts += partition(x, floor)
    return parts


def partition(x: float, floor: float) -> list[Trimesh]:
    """Returns a wall across the house with an opening in its middle, as high as the storey less half a metre."""
    top, side = floor + STOREY, (WIDTH - DOOR) / 2
    lintel = block((x, 0, top - 0.5), (x + THICK, WIDTH, top))
    return [lintel, *(block((x, y, floor), (x + THICK, y + side, top)) for y in (0.0, WIDTH - side))]


def table(x: float, y: float, floor: float) -> list[Trimesh]:
    """Returns a table with two chairs."""
    top = block((x - 0.7, y - 0.4, floor + 0.71), (x + 0.7, y + 0.4, floor + 0.75))
    legs = [post(x + dx, y + dy, floor, 0.72, 0.03) for dx in (-0.6, 0.6) for dy in (-0.3, 0.3)]
    return [top, *legs, *chair(x, y - 0.8, floor, -1.0), *chair(x, y + 0.8, floor, 1.0)]


def chair(x: float, y: float, floor: float, side: float) -> list[Trimesh]:
    """Returns a chair whose back is on one side along y."""
    seat = block((x - 0.22, y - 0.22, floor + 0.43), (x + 0.22, y + 0.22, floor + 0.47))
    back = block((x - 0.22, y + side * 0.2 - 0.02, floor + 0.45), (x + 0.22, y + side * 0.2 + 0.02, floor + 0.95))
    legs = [post(x + dx, y + dy, floor, 0.44, 0.02, 16) for dx in (-0.18, 0.18) for dy in (-0.18, 0.18)]
    return [seat, back, *legs]


def shelf(x: float, y: float, floor: float) -> list[Trimesh]:
    """Returns a shelf along x."""
    boards = [
        block((x - 0.8, y - 0.15, floor + z), (x + 0.8, y + 0.15, floor + z + 0.03)) for z in np.arange(0, 2.2, 0.36)
    ]
    return [*boards, *(block((x + dx, y - 0.15, floor), (x + dx + 0.03, y + 0.15, floor + 2.2)) for dx in (-0.8, 0.77))]


def plant(x: float, y: float, floor: float, rng: np.random.Generator) -> list[Trimesh]:
    """Returns a plant in a pot."""
    crown = icosphere(subdivisions=3, radius=0.35)
    crown.vertices = crown.vertices * (1 + 0.12 * rng.standard_normal((len(crown.vertices), 1)).clip(-1, 1))
    return [
        post(x, y, floor, 0.4, 0.2, 32),
        post(x, y, floor, 0.8, 0.03, 12),
        crown.apply_translation([x, y, floor + 1.05]),
    ]


def lamp(x: float, y: float, ceiling: float) -> list[Trimesh]:
    """Returns a ring that hangs from a ceiling."""
    ring = torus(0.35, 0.03, major_sections=32, minor_sections=12)
    rods = [post(x + dx, y, ceiling - 0.5, 0.5, 0.01, 8) for dx in (-0.35, 0.35)]
    return [ring.apply_translation([x, y, ceiling - 0.5]), *rods]


def furniture() -> list[Trimesh]:
    """Returns all that stands and hangs in the house."""
    rng = np.random.default_rng(44)
    parts: list[Trimesh] = []
    for floor in (THICK, STOREY + THICK / 2):
        ceiling = (STOREY - THICK / 2) if floor < STOREY else 2 * STOREY - THICK
        for x in (4.5, 19.5):
            for y in (1.6, 3.4, WIDTH - 3.4, WIDTH - 1.6):
                parts += table(x + rng.uniform(-1.5, 1.5), y, floor)
            for dx in (-2.5, 2.5):
                parts += shelf(x + dx, 0.4, floor) + shelf(x + dx, WIDTH - 0.4, floor)
                for y in (WIDTH / 4, 3 * WIDTH / 4):
                    parts += lamp(x + dx / 2, y, ceiling)
            for y in (0.7, 2.4, WIDTH - 2.4, WIDTH - 0.7):
                parts += plant(x + (3.6 if x < 12 else -3.6), y, floor, rng)
            end = x - 4.2 if x < LENGTH / 2 else x + 3.4
            parts.append(block((end, WIDTH / 2 - 1, floor), (end + 0.8, WIDTH / 2 + 1, floor + 0.45)))
    for y in (1.5, WIDTH - 1.5):
        parts += [post(x, y, 0.0, 2 * STOREY, 0.25, 64) for x in (10.5, 13.5)]
    for x, y in ((10.0, 4.0), (14.0, 4.0), (10.0, 10.0), (14.0, 10.0)):
        parts += plant(x, y, THICK, rng)
    return parts


def building() -> Trimesh:
    """Returns the house."""
    return trimesh.util.concatenate([*shell(), *furniture()])  # pyright: ignore[reportReturnType]


def main() -> None:
    """Writes the mesh."""
    made = building()
    vertices, number = np.unique(np.round(made.vertices, 3), axis=0, return_inverse=True)
    text = obj_text(vertices, number.reshape(-1)[made.faces])
    FILE.write_text(text, encoding="utf-8")
    print(f"{FILE}: {len(made.faces):,} triangles, {FILE.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
