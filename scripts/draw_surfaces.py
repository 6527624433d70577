"""Draws every pattern of surfaces on one world, each beside what the drone's camera sees of it.

    python scripts/draw_surfaces.py docs/images/surfaces.png

The pictures for people have ten times as many pixels along each axis.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import Config, SurfaceConfig
from edqn_jax.config.simulation import LOOKS
from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_write
from edqn_jax.report.style import open_figure
from edqn_jax.sim.camera import camera
from edqn_jax.sim.scene.scene import Scene, take_scene
from edqn_jax.sim.worlds.families import worlds_of

FINE = 10
"""Pixels of the picture for people in one of the drone's."""

FAMILY, INDEX = "rooms", 3


def view_of(scene: Scene) -> tuple[Array, Array]:
    """Returns where the camera stands, at the world's start, and its rotation: along two walls."""
    way = np.asarray(scene.goal - scene.start)
    yaw = np.arctan2(way[1], way[0]) + 0.4
    cos, sin = np.cos(yaw), np.sin(yaw)
    return scene.start, jnp.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], jnp.float32)


def draw_patterns(file: Path, index: int = INDEX) -> None:
    """Writes a PNG with two pictures for each pattern, for people and as the drone sees it."""
    with open_figure(7.0, 6.2, file) as figure:
        panels = figure.subplots(5, 4).ravel()
        for axes in panels:
            axes.set_axis_off()
        for place, pattern in enumerate(LOOKS):
            config = Config(surface=SurfaceConfig(pattern=pattern))
            scene = take_scene(worlds_of(config, FAMILY, "test", 1, first=index), 0)
            position, rotation = view_of(scene)
            fine = jax.jit(partial(camera.fine_rgb, config.camera, FINE))(scene, position, rotation)
            seen = jax.jit(partial(camera.render_luma, config.camera))(scene, position, rotation)
            for axes, picture in zip(panels[2 * place :], (fine, seen), strict=False):
                axes.imshow(np.asarray(camera.on_screen(picture)), cmap="gray", vmin=0, vmax=1)
            panels[2 * place].set_title(pattern, fontsize=8)


def main(arguments: list[str] | None = None) -> int:
    """Draws the figure that the command line asks for; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="PNG to write")
    options = parser.parse_args(arguments)
    try:
        check_can_write(options.file)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    draw_patterns(options.file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
