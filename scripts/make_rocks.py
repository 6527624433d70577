"""Makes `scenes/examples/rocks.xml`: boulders above a ground, each a convex mesh, that MuJoCo judges.

Their meshes are the hulls of points on ellipsoids; `benchmarks/verdicts.py` flies there.

    python scripts/make_rocks.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

FILE = Path(__file__).parents[1] / "scenes/examples/rocks.xml"
SIZE = (24.0, 16.0, 6.0)
KINDS, CORNERS = 4, 24

HEAD = """<mujoco model="rocks">
  <!-- Boulders, each a convex mesh; scripts/make_rocks.py makes it. -->
"""


def rock(rng: np.random.Generator) -> str:
    """Returns the vertices of a convex boulder, metres."""
    way = rng.normal(size=(CORNERS, 3))
    points = way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0.8, 1.8, 3)
    return " ".join(f"{x:.3f}" for x in points[ConvexHull(points).vertices].ravel())


def rocks() -> str:
    """Returns the world as MJCF."""
    rng = np.random.default_rng(44)
    x, y, z = SIZE
    lines = ["  <asset>"]
    lines += [f'    <mesh name="rock{i}" vertex="{rock(rng)}"/>' for i in range(KINDS)]
    lines += ["  </asset>", "  <worldbody>"]
    lines += [
        f'    <site name="start" pos="2 {y / 2:g} 3" group="3"/>',
        f'    <site name="goal" pos="{x - 2:g} {y / 2:g} 3" group="3"/>',
        f'    <site name="volume" type="box" pos="{x / 2:g} {y / 2:g} {z / 2:g}" size="{x / 2:g} {y / 2:g} {z / 2:g}" '
        'group="3"/>',
        '    <geom name="ground" type="plane" size="0 0 1" rgba="0.4 0.42 0.36 1"/>',
    ]
    # One in each cell of 3 x 3, away from its sides.
    for i, (column, row) in enumerate(np.ndindex(3, 3)):
        place = 5.5 + 6.5 * column + rng.uniform(-1, 1), 2.8 + 5.2 * row + rng.uniform(-1, 1), rng.uniform(1.5, 4.5)
        turn = Rotation.random(None, rng).as_quat()[[3, 0, 1, 2]]
        grey = rng.uniform(0.3, 0.8)
        lines.append(
            f'    <geom name="rock {i}" type="mesh" mesh="rock{i % KINDS}" pos="{_text(place)}" '
            f'quat="{_text(turn)}" rgba="{grey:.2f} {0.95 * grey:.2f} {0.9 * grey:.2f} 1"/>'
        )
    return HEAD + "\n".join([*lines, "  </worldbody>", "</mujoco>"]) + "\n"


def main() -> None:
    """Writes the world."""
    FILE.write_text(rocks(), encoding="utf-8")


def _text(numbers: np.ndarray | tuple[float, ...]) -> str:
    return " ".join(f"{x:.3f}" for x in numbers)


if __name__ == "__main__":
    main()
