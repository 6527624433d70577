"""What each curve of `scaling.py` varies, and the sizes that it takes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from curves.boxes import world_of_boxes
from edqn_jax.config import Config
from edqn_jax.config.loading import Layer, apply_layer
from edqn_jax.config.rules import validate
from edqn_jax.sim.scene.mjcf import write_scene

BOXES = (8, 16, 30, 60, 120)
"""Numbers of obstacles; random worlds have 12, 30 and 60."""


@dataclasses.dataclass(frozen=True)
class Point:
    """One size of the quantity that a curve varies."""

    x: float
    label: str
    config: Config


@dataclasses.dataclass(frozen=True)
class Curve:
    """The sizes at which the cost of a decision is measured."""

    name: str
    linear: float
    """Slope of linear growth: 1, or 0 if the number of decisions grows with the size."""
    points: tuple[Point, ...]


def pixels(base: Config, quick: bool, folder: Path) -> Curve:
    """Varies the width and height of frames from half to three times the base."""
    del folder
    points = []
    for times in (1, 2) if quick else (0.5, 1, 2, 3):
        width, height = round(times * base.camera.width), round(times * base.camera.height)
        points.append(
            Point(
                width * height, f"{width} × {height}", replace_options(base, camera={"width": width, "height": height})
            )
        )
    return Curve("pixels", 1.0, tuple(points))


def obstacles(base: Config, quick: bool, folder: Path) -> Curve:
    """Varies the number of boxes; a smaller world has the first boxes of a larger one."""
    points = []
    for count in BOXES[::4] if quick else BOXES:
        file = folder / f"{count}-boxes.xml"
        write_scene(world_of_boxes(count), file, title=f"{count} boxes")
        points.append(Point(count, str(count), replace_options(base, world={"name": str(file)})))
    return Curve("obstacles", 1.0, tuple(points))


def environments(base: Config, quick: bool, folder: Path) -> Curve:
    """Varies the number of environments from a quarter to sixteen times the base, and the updates in proportion."""
    del folder
    many = base.train.num_envs
    counts = [many, 4 * many] if quick else [many // 4, many, 4 * many, 16 * many]
    return Curve("environments", 0.0, tuple(Point(n, str(n), with_environments(base, n)) for n in counts))


def physics_steps(base: Config, quick: bool, folder: Path) -> Curve:
    """Varies the number of physics steps per decision, with the same time between decisions."""
    del folder
    points = []
    for times in (1, 4) if quick else (1, 2, 4):
        steps, dt = times * base.drone.physics_steps, base.drone.physics_dt_s / times
        points.append(
            Point(steps, str(steps), replace_options(base, drone={"physics_steps": steps, "physics_dt_s": dt}))
        )
    return Curve("physics steps", 1.0, tuple(points))


def devices(base: Config, quick: bool, folder: Path) -> Curve:
    """Varies the number of devices up to that of the base, with equal environments and samples per device."""
    del quick, folder
    most = base.train.devices
    points = []
    for count in (count for count in (1, 2, 4, 8) if most % count == 0):
        envs, batch, replay = (
            size * count // most for size in (base.train.num_envs, base.agent.batch_size, base.agent.replay_size)
        )
        agent = {"batch_size": batch, "replay_size": replay}
        points.append(
            Point(count, str(count), replace_options(base, train={"num_envs": envs, "devices": count}, agent=agent))
        )
    return Curve("devices", 0.0, tuple(points))


CURVES: dict[str, Callable[[Config, bool, Path], Curve]] = {
    "pixels": pixels,
    "obstacles": obstacles,
    "environments": environments,
    "physics_steps": physics_steps,
    "devices": devices,
}


def with_environments(base: Config, count: int) -> Config:
    """Returns `base` with another number of environments and the same replayed samples per decision."""
    agent = base.agent
    updates = max(1, round(agent.updates_per_step * count / base.train.num_envs))
    return replace_options(base, train={"num_envs": count}, agent={"updates_per_step": updates})


def replace_options(config: Config, **layer: Any) -> Config:
    """Returns `config` with the given options of its groups replaced.

    Raises:
        ConfigError: if the result is invalid.
    """
    groups: Layer = layer
    changed = apply_layer(config, groups, "this size")
    validate(changed)
    return changed
