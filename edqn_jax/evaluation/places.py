"""One world with the start and goal that were asked for, before they are checked and flown."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import FAMILIES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mjcf import LoadedWorld, load_world, resolve_world, widen_volume
from edqn_jax.sim.scene.scene import Scene, take_scene
from edqn_jax.sim.worlds import families

Point = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class PlacedWorld:
    """One world as a mission meets it."""

    scene: Scene
    title: str
    """Name of the world in messages."""
    names: Mapping[str, tuple[str, ...]] | None = None
    """As in `LoadedWorld`; None of a random world."""
    file: Path | None = None
    """MJCF file of the world; None of a random one."""
    note: str | None = None
    """What was decided for the user, as a sentence."""


def check_seed(seed: int, missions: int = 1) -> None:
    """Raises ConfigError if there are no missions of this seed."""
    if seed < 0 or (seed + 1) * missions >= 2**31:
        last = 2**31 // missions - 2
        several = f" for {missions} missions" if missions > 1 else ""
        raise ConfigError(f"--seed must be from 0 to {last}{several}, not {seed}")


def moved_ends(start: Point | None, goal: Point | None) -> dict[str, jax.Array]:
    """Returns those of start and goal, metres, that replace the world's own, each [3].

    Raises:
        ConfigError: if one is not finite.
    """
    given = {role: point for role, point in (("start", start), ("goal", goal)) if point is not None}
    for role, point in given.items():
        if not np.all(np.isfinite(point)):
            raise ConfigError(f"--{role} must be three finite numbers, metres, not {' '.join(f'{x:g}' for x in point)}")
    return {role: jnp.asarray(point, jnp.float32) for role, point in given.items()}


def place_in_file(config: Config, name: str, loaded: LoadedWorld, moved: Mapping[str, jax.Array]) -> PlacedWorld:
    """Returns the world of a file; its volume is wider where the file names none and an end that moved lies outside.

    Raises:
        ConfigError: if an end is too far away.
    """
    scene, note = dataclasses.replace(loaded.scene, **moved), None
    if moved and not loaded.has_volume:
        scene = widen_volume(scene, moved, f"'{name}'")
        if not np.array_equal(scene.volume, loaded.scene.volume):
            note = f"'{name}' names no flight volume: it is flown in {_box(scene)}, around its shapes, start and goal"
    if scene.boxes.surface is not None and config.surface.pattern == "plaid":
        note = " ".join(filter(None, (note, f"'{name}' has patterns of its own, and no plaid")))
    return PlacedWorld(scene, f"'{name}'", loaded.names, loaded.path, note)


def place_world(config: Config, name: str, seed: int, start: Point | None, goal: Point | None) -> PlacedWorld:
    """Returns the world of the only mission of a seed.

    Args:
        config: configuration of the policy.
        name: of `config.FAMILIES`, of a scene, or an MJCF file.
        seed: number of the test world of a family.
        start: of the mission, metres; None is the world's own.
        goal: likewise.

    Raises:
        ConfigError: if there is no such world, or an argument is invalid.
    """
    check_seed(seed)
    moved = moved_ends(start, goal)
    if name not in FAMILIES:
        return place_in_file(config, name, load_world(resolve_world(name)), moved)
    pool = families.worlds_of(config, name, "test", 1, first=seed)
    return PlacedWorld(dataclasses.replace(take_scene(pool, 0), **moved), f"test world {seed} ({name})")


def _box(scene: Scene) -> str:
    lower, upper = np.asarray(scene.volume)
    return "x, y, z = " + ", ".join(f"{low:g} to {high:g}" for low, high in zip(lower, upper, strict=True)) + " m"
