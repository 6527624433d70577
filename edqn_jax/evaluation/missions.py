"""Missions of training, validation and evaluation, from the name of a world."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import FAMILIES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.places import Point, check_seed, moved_ends, place_in_file
from edqn_jax.kept_programs import kept_jit
from edqn_jax.keys import CROSSING_OF_WORLD, FILE_MISSIONS, run_streams
from edqn_jax.planning.astar import shortest_path
from edqn_jax.planning.free_space import is_reachable, kept_reachable
from edqn_jax.planning.lattice import CELL_M, lattice_shape
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.mjcf import check_scene, load_world, mjcf_of, resolve_world
from edqn_jax.sim.scene.mjcf_parts.files import self_contained_bytes
from edqn_jax.sim.scene.scene import Scene, take_scene, with_equal_capacities
from edqn_jax.sim.task import group
from edqn_jax.sim.task.crossing import crossing_missions, own_crossings
from edqn_jax.sim.task.env import EnvParams, scene_of
from edqn_jax.sim.task.missions import Missions, own_missions, random_missions, spread_missions
from edqn_jax.sim.task.reward import Reward, check_reward
from edqn_jax.sim.worlds import families
from edqn_jax.sim.worlds.free_points import Cells, cells_of, free_point

_scene_of = kept_jit()(scene_of)  # one program, not one for each shape of array


@dataclasses.dataclass(frozen=True)
class MissionSet:
    """Missions in one or more worlds."""

    name: str
    """Name that the world was asked for by."""
    env_params: EnvParams
    file: Path | None = None
    """MJCF file of the only world; None for random worlds."""
    note: str | None = None
    """What was decided for the user, as a sentence."""

    def scene(self, mission: int = 0) -> Scene:
        """Returns the world of one mission."""
        return _scene_of(self.env_params, jnp.asarray(mission))

    def with_reward(self, reward: Reward | None) -> MissionSet:
        """Returns the same missions with this reward; None is the configured one.

        Raises:
            ConfigError: if the reward takes anything but a transition.
        """
        check_reward(reward)
        return dataclasses.replace(self, env_params=dataclasses.replace(self.env_params, reward=reward))

    def mjcf(self) -> list[str]:
        """Returns every world of the pool as MJCF: the file it was read from, or written from the arrays."""
        if self.file is not None:
            return [self_contained_bytes(self.file).decode()]
        pool = jax.tree.map(np.asarray, self.env_params.pool)
        return [mjcf_of(take_scene(pool, i), title=f"{self.name} {i}") for i in range(pool.start.shape[0])]


@dataclasses.dataclass(frozen=True)
class RunMissions:
    """Missions of a training run. Validation and final missions have the same shape, so one program flies both."""

    training: MissionSet
    validation: MissionSet
    final: MissionSet
    """Mission 0 decides the run's verdict; it is not flown before the end."""
    near_start: np.ndarray
    """[M] bool: which validation missions begin at or near their world's own start."""
    tests: int
    """How many of the final missions, counted from the last, judge the policy in unseen random worlds."""

    @property
    def scene(self) -> Scene:
        """The world of the final mission 0."""
        return self.final.scene()


def run_missions(config: Config, reward: Reward | None = None) -> RunMissions:
    """Returns the missions of a training run, which depend on the configuration's world and seed alone.

    Args:
        config: of the run.
        reward: reward function in place of the configured one.

    Raises:
        ConfigError: if a drone of this radius does not fit at the world's start or goal.
    """
    keys = run_streams(config.train.seed)
    if config.world.name in FAMILIES:
        missions = _random_run_missions(config, keys.training_missions)
    else:
        missions = _file_run_missions(config, keys.training_missions, keys.validation_missions)
    return dataclasses.replace(
        missions, **{name: getattr(missions, name).with_reward(reward) for name in ("training", "validation", "final")}
    )


def missions_of_runs(configs: Sequence[Config], reward: Reward | None = None) -> list[RunMissions]:
    """Returns `run_missions` of runs that differ in their seeds alone; they share the worlds.

    Raises:
        ConfigError: as `run_missions`.
    """
    first = run_missions(configs[0], reward)
    if configs[0].world.name not in FAMILIES:
        return [first, *(run_missions(config, reward) for config in configs[1:])]
    others = []
    for config in configs[1:]:
        key, world = run_streams(config.train.seed).training_missions, first.training.env_params
        missions = _training_missions(world.pool, config, key)
        training = dataclasses.replace(first.training, env_params=dataclasses.replace(world, missions=missions))
        others.append(dataclasses.replace(first, training=training))
    return [first, *others]


def _random_run_missions(config: Config, training_key: jax.Array) -> RunMissions:
    """Returns missions of random worlds; every validation and final mission, or block of them, has a world of its own.

    Where `world.flown` names a world, the first final mission, or block of them, is in that world.
    """
    name, final_name, count = config.world.name, config.world.flown, config.train.validation_missions
    drones = config.env.drones
    airframe = load_airframe(config.drone)
    training_pool = families.worlds_of(config, name, "training", config.world.pool_size)
    training = _training_missions(training_pool, config, training_key)
    validation, test = (families.worlds_of(config, name, split, count // drones) for split in ("validation", "test"))
    if final_name:
        validation, test, own = with_equal_capacities([validation, test, _pool_of(final_name, config)])
        test = _prepend(own, test)
    return RunMissions(
        training=MissionSet(name, EnvParams(airframe, training_pool, training)),
        validation=MissionSet(name, _env_params_of(validation, config, "validation")),
        final=MissionSet(name, _env_params_of(test, config, "test")),
        near_start=np.ones(count, bool),
        tests=count - drones if final_name else count,
    )


def final_missions(config: Config, most: int) -> MissionSet:
    """Returns the first of the final missions of `run_missions`, without making the training worlds.

    Args:
        config: of the run.
        most: how many missions at most; fewer where the run has fewer, and in whole groups, at least one.

    Raises:
        ConfigError: as `run_missions`.
    """
    name, final_name, count = config.world.name, config.world.flown, min(most, config.train.validation_missions)
    if name not in FAMILIES:
        final = run_missions(config).final
        missions = jax.tree.map(lambda leaf: leaf[:count], final.env_params.missions)
        return dataclasses.replace(final, env_params=dataclasses.replace(final.env_params, missions=missions))
    count = max(count // config.env.drones, 1) * config.env.drones
    pool = families.worlds_of(config, name, "test", count // config.env.drones)
    if final_name:
        pool, own = with_equal_capacities([pool, _pool_of(final_name, config)])
        pool = _prepend(own, pool)
    return MissionSet(name, _env_params_of(pool, config, "test"))


def _env_params_of(pool: Scene, config: Config, split: families.Split, first: int = 0) -> EnvParams:
    """Returns one mission in each world of the pool, its own, or one block of missions that cross.

    The own mission of a world is then that of its block's first drone.

    Args:
        pool: worlds `first`, `first + 1`, ... of the split.
        config: says how many drones fly together.
        split: of the worlds.
        first: number of the first world.
    """
    airframe, drones = load_airframe(config.drone), config.env.drones
    if not group.is_multi_drone(config):
        return EnvParams(airframe, pool, own_missions(pool))
    if pool.spheres.throw is not None:
        raise ConfigError(f"with env.drones {drones} the world must throw no balls, which are for one drone alone")
    keys = families.world_keys(split, pool.start.shape[0], first)
    missions = own_crossings(pool, drones, jax.vmap(lambda key: jax.random.fold_in(key, CROSSING_OF_WORLD))(keys))
    pool = dataclasses.replace(pool, start=missions.start[::drones], goal=missions.goal[::drones])
    return EnvParams(airframe, pool, missions)


def _prepend(own: Scene, pool: Scene) -> Scene:
    """Returns a pool with the world `own`, a pool of one, before all others, and without its last."""
    return jax.tree.map(lambda one, many: jax.device_put(np.concatenate([one, many])[:-1]), own, pool)


def _training_missions(pool: Scene, config: Config, key: jax.Array) -> Missions:
    """Returns missions between random points, to the worlds' own goals where the reward needs distances to them.

    Of several drones they are blocks that cross.
    """
    if group.is_multi_drone(config):
        return crossing_missions(pool, config.env.drones, config.world.missions // config.env.drones, key)
    return random_missions(pool, config.world.missions, key, own_goals=config.env.reward == "geodesic")


def _pool_of(name: str, config: Config) -> Scene:
    """Returns the pool of the one world of a file.

    Raises:
        ConfigError: if the file is no world, or the drone does not fit where its mission starts or ends.
    """
    loaded = load_world(resolve_world(name))
    radii = config.drone.body_radius_m, config.env.goal_radius_m
    check_scene(loaded.scene, radii[0], names=loaded.names, title=f"'{name}'", goal_radius=radii[1])
    return families.world_of_file(config, loaded.scene)


def _file_run_missions(config: Config, training_key: jax.Array, validation_key: jax.Array) -> RunMissions:
    """Returns missions of a world from a file: all end at its goal, the final one begins at its start."""
    name, count = config.world.name, config.train.validation_missions
    airframe, file = load_airframe(config.drone), resolve_world(name)
    pool = _pool_of(name, config)
    spread, jitter = config.world.own_start_fraction, config.world.start_jitter_m
    cells, note = _with_a_way(pool, config, name, own_start=True)
    training = spread_missions(pool, config.world.missions, spread, jitter, training_key, cells)
    # Half of the validation begins near the start, more where training does, but never at it: flown greedily, missions
    # from one point would be one and the same.
    near = max(jitter, 0.5)
    validation = spread_missions(pool, count, max(0.5, spread), near, validation_key, cells)
    own = own_missions(pool)
    final = jax.tree.map(lambda one, many: jnp.concatenate([one, many[1:]]), own, validation)
    final = dataclasses.replace(final, scene=final.scene.astype(jnp.int32))
    return RunMissions(
        training=MissionSet(name, EnvParams(airframe, pool, training), file, note),
        validation=MissionSet(name, EnvParams(airframe, pool, validation), file),
        final=MissionSet(name, EnvParams(airframe, pool, final), file),
        near_start=_starts_near(validation, np.asarray(pool.start[0]), near),
        tests=0,
    )


def _with_a_way(pool: Scene, config: Config, name: str, own_start: bool = False) -> tuple[Cells | None, str | None]:
    """Returns the cells of the pool's only world that have a way to its goal, and how many have none.

    Args:
        pool: one world.
        config: of the run.
        name: of the world.
        own_start: whether a mission begins at the world's own start.

    Returns:
        (None, None) where there is a way from everywhere.

    Raises:
        ConfigError: if the world is too large to search it, or there is no way from its own start.
    """
    scene, radius = take_scene(pool, 0), config.drone.body_radius_m
    if own_start:
        lattice_shape(scene, np.asarray(scene.start, np.float64), CELL_M)  # A* searches the way from there
    found = kept_reachable(scene, radius)
    if found.lost == 0.0:
        return None, None
    if own_start and not is_reachable(found, scene.start):
        shortest_path(scene, scene.start, scene.goal, radius)  # raises, before anything is compiled
    cells = cells_of(scene, found.is_way, found.corner, found.edge_m)
    lost = f"{found.lost:.0%}" if found.lost >= 0.01 else "Less than 1%"
    return cells, f"{lost} of the free space of '{name}' has no way to the goal: no mission begins there"


def _starts_near(missions: Missions, start: np.ndarray, jitter_m: float) -> np.ndarray:
    """Returns [M] whether each mission begins within `jitter_m` of `start` [3] along each axis."""
    apart = np.abs(np.asarray(missions.start) - start).max(axis=1)
    return apart <= jitter_m + 1e-3  # positions are rounded to float32


def load_missions(
    config: Config,
    name: str,
    missions: int = 1,
    seed: int = 0,
    start: Point | None = None,
    goal: Point | None = None,
) -> MissionSet:
    """Returns the missions of an evaluation.

    In a world from a file a single mission goes from its start to its goal; several go from random free
    starts all over the volume to its goal. In random worlds each mission has a test world of its own, which
    training never uses. `start` and `goal` replace those of the world.

    Args:
        config: configuration of the policy.
        name: of `config.FAMILIES`, of a scene, or an MJCF file.
        missions: number of missions.
        seed: seed of the missions.
        start: start of every mission, metres.
        goal: goal of every mission, metres.

    Raises:
        ConfigError: if there is no such world, the drone does not fit where a mission starts or ends, or there is
            no path for the only mission.
    """
    if missions < 1:
        raise ConfigError(f"missions must be at least 1, not {missions}")
    check_seed(seed, missions)
    moved = moved_ends(start, goal)
    if group.is_multi_drone(config):
        check_group(config, name, missions, moved)
    if name in FAMILIES:
        return _random_missions(config, name, missions, seed, moved)
    if missions > 1 and start is not None:
        raise ConfigError(
            f"--start with --missions {missions}: in '{name}' all flights would be equal; give only one of the two"
        )
    return _file_missions(config, name, missions, seed, moved)


def _random_missions(config: Config, name: str, missions: int, seed: int, moved: dict[str, jax.Array]) -> MissionSet:
    """Returns one mission in each of `missions` test worlds, of N drones one block in each of `missions` / N."""
    count = missions // config.env.drones
    pool = families.worlds_of(config, name, "test", count, first=seed * count)
    if moved:
        many = {key: jnp.broadcast_to(value, (missions, 3)) for key, value in moved.items()}
        pool = dataclasses.replace(pool, **many)
        for index in range(missions):
            title = f"test world {seed * missions + index} ({name})"
            check_scene(take_scene(pool, index), config.drone.body_radius_m, title=title)
    return MissionSet(name, _env_params_of(pool, config, "test", seed * count))


def check_group(config: Config, name: str, missions: int, moved: dict[str, jax.Array]) -> None:
    """Refuses what several drones cannot fly.

    Raises:
        ConfigError: says what they can.
    """
    drones = config.env.drones
    if name not in FAMILIES:
        raise ConfigError(f"env.drones {drones} needs a random world ({', '.join(FAMILIES)}), not '{name}'")
    if missions % drones:
        raise ConfigError(f"missions must be a multiple of env.drones ({drones}), not {missions}")
    if moved:
        raise ConfigError(f"--{' and --'.join(moved)} cannot be given with env.drones {drones}: their missions cross")


def mission_key(seed: int) -> jax.Array:
    """Returns the key [] of the evaluation missions `seed` in worlds from files; the same in every version."""
    return jax.random.fold_in(jax.random.key(FILE_MISSIONS), seed)


def _file_missions(config: Config, name: str, missions: int, seed: int, moved: dict[str, jax.Array]) -> MissionSet:
    """Returns one mission from start to goal of a world from a file, or many from random free starts."""
    radius, airframe, file = config.drone.body_radius_m, load_airframe(config.drone), resolve_world(name)
    loaded = load_world(file)
    placed = place_in_file(config, name, loaded, moved)
    scene, note = placed.scene, placed.note
    if missions == 1:
        check_scene(scene, radius, names=loaded.names, title=f"'{name}'", goal_radius=config.env.goal_radius_m)
        shortest_path(scene, scene.start, scene.goal, radius)  # raises where there is no path
        pool = families.world_of_file(config, scene)
        return MissionSet(name, EnvParams(airframe, pool, own_missions(pool)), file, note)
    probe_key, missions_key = jax.random.split(mission_key(seed))
    # The world's own start does not matter, any free point will do; the goal does.
    standing = dataclasses.replace(scene, start=free_point(scene, probe_key))
    check_scene(standing, radius, names=loaded.names, title=f"'{name}'")
    pool = families.world_of_file(config, scene)
    cells, said = _with_a_way(pool, config, name)
    many = spread_missions(pool, missions, 0.0, 0.0, missions_key, cells)
    return MissionSet(name, EnvParams(airframe, pool, many), file, " ".join(filter(None, (note, said))) or None)
