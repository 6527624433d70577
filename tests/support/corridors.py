"""MJCF worlds of one wall with a door."""

from __future__ import annotations

from pathlib import Path

SIZE = (24.0, 12.0, 6.0)


def corridor(folder: Path, door: float, geoms: str = "", *, asset: str = "", length: float = SIZE[0]) -> Path:
    """A file with a wall across the middle of a volume, and in it a door of this width, as high as the volume.

    Start and goal stand on either side, 2.5 m above the ground; the way between them is straight.
    """
    half, side = length / 2, (SIZE[1] - door) / 4
    sites = f'<site name="start" pos="3 6 2.5"/><site name="goal" pos="{length - 3} 6 2.5"/>'
    sites += f'<site name="volume" type="box" pos="{half} 6 3" size="{half} 6 3" group="3"/>'
    walls = "".join(
        f'<geom name="{name}" type="box" pos="{half} {y} 3" size=".1 {side} 3"/>'
        for name, y in (("south", side), ("north", SIZE[1] - side))
    )
    ground = '<geom name="ground" type="plane" size="0 0 1"/>'
    file = folder / "corridor.xml"
    file.write_text(f"<mujoco><asset>{asset}</asset><worldbody>{sites}{ground}{walls}{geoms}</worldbody></mujoco>")
    return file
