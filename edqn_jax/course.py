"""Where an evaluation flies: the name of a world becomes missions."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import DENSITIES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.planners.astar import shortest_path
from edqn_jax.sim import drone, worlds
from edqn_jax.sim.env import World
from edqn_jax.sim.mjcf import check_scene, load_world, resolve_world, write_scene
from edqn_jax.sim.scene import stack_scenes, take_scene

Point = tuple[float, float, float]

_MISSION_SEED = 7_919
"""Root of the keys of missions in worlds from files; training folds other roots."""


@dataclasses.dataclass(frozen=True)
class Course:
    """Where an evaluation flies."""

    name: str
    world: World
    file: Path | None
    """MJCF of the only world; None for random ones."""

    def mjcf(self) -> list[str]:
        """Every world of the pool as MJCF: the very file it was read from, or written from the arrays."""
        if self.file is not None:
            return [self.file.read_text(encoding="utf-8")]
        pool = jax.tree.map(np.asarray, self.world.pool)
        with tempfile.TemporaryDirectory() as folder:
            written = Path(folder) / "world.xml"
            texts = []
            for index in range(pool.start.shape[0]):
                write_scene(take_scene(pool, index), written, title=f"{self.name} {index}")
                texts.append(written.read_text(encoding="utf-8"))
        return texts


def load_course(
    config: Config,
    name: str,
    missions: int = 1,
    seed: int = 0,
    start: Point | None = None,
    goal: Point | None = None,
) -> Course:
    """The missions of an evaluation.

    In a world from a file, one mission is from its own start to its own goal, more are from random free
    starts all over the volume to its goal. In random worlds each mission has a test world of its own, which
    training never sees. `start` and `goal`, metres, take the place of the world's.

    Args:
        config: of the policy that will fly.
        name: `sparse`, `medium`, `dense`, the name of a scene or an MJCF file.
        missions: how many.
        seed: which; the missions of two seeds differ.
        start: of every mission.
        goal: of every mission.

    Raises:
        ConfigError: if there is no such world, no drone can stand where a mission starts or ends, or there is
            no way for the only mission.
    """
    if missions < 1:
        raise ConfigError(f"--missions must be at least 1, not {missions}")
    if seed < 0 or (seed + 1) * missions >= 2**31:
        last = 2**31 // missions - 2
        raise ConfigError(f"--seed must be from 0 to {last} for {missions} missions, not {seed}")
    radius = config.drone.body_radius_m
    moved = {k: jnp.asarray(v, jnp.float32) for k, v in (("start", start), ("goal", goal)) if v is not None}
    airframe = drone.load_airframe(config.drone)
    if name in DENSITIES:
        pool = worlds.random_pool(name, worlds.world_keys("test", missions, first=seed * missions))
        if moved:
            many = {key: jnp.broadcast_to(value, (missions, 3)) for key, value in moved.items()}
            pool = dataclasses.replace(pool, **many)
            for index in range(missions):
                title = f"test world {seed * missions + index} ({name})"
                check_scene(take_scene(pool, index), radius, title=title)
        return Course(name, World(airframe, pool, worlds.own_missions(pool)), None)

    file = resolve_world(name)
    loaded = load_world(file)
    scene = dataclasses.replace(loaded.scene, **moved)
    spread = missions > 1
    if spread and start is not None:
        raise ConfigError(f"--start with --missions {missions}: in '{name}' all would be one and the same flight")
    if not spread:
        check_scene(scene, radius, names=loaded.names, title=f"'{name}'")
        shortest_path(scene, scene.start, scene.goal, radius)  # or a sentence: there is no way
        pool = stack_scenes([scene])
        return Course(name, World(airframe, pool, worlds.own_missions(pool)), file)
    probe_key, missions_key = jax.random.split(jax.random.fold_in(jax.random.key(_MISSION_SEED), seed))
    # The world's own start does not matter, any free point will do; the goal does.
    standing = dataclasses.replace(scene, start=worlds.free_point(scene, probe_key))
    check_scene(standing, radius, names=loaded.names, title=f"'{name}'")
    pool = stack_scenes([scene])
    flown = worlds.spread_missions(pool, missions, 0.0, 0.0, missions_key)
    return Course(name, World(airframe, pool, flown), file)
