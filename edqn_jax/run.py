"""The training command: a dumb host loop around compiled chunks, and what a run leaves behind.

Run a chunk; fetch a handful of numbers; log, validate, save, draw progress; again. At the end the greedy
policy flies the mission, and the pictures are drawn.

Of several processes each runs this loop, on the same numbers; all fly, and one writes.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from edqn_jax import flights
from edqn_jax.config import DENSITIES, Config
from edqn_jax.errors import DivergedError, StoppedError
from edqn_jax.evaluate import flight_summary, spl, summarise, trajectory
from edqn_jax.flights import Flights
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.trainer import Episodes, Losses, Plan, Trainer, policy_of
from edqn_jax.parallel import processes
from edqn_jax.parallel.devices import choose_devices
from edqn_jax.planners.astar import Path as ShortestPath
from edqn_jax.planners.astar import shortest_path
from edqn_jax.report.gallery import draw_gallery
from edqn_jax.report.progress import Progress
from edqn_jax.runs.checkpoints import save_policy
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.provenance import state_digest, versions, workload
from edqn_jax.sim import drone, worlds
from edqn_jax.sim.env import Outcome, World
from edqn_jax.sim.mjcf import check_scene, load_world, resolve_world
from edqn_jax.sim.scene import Scene, stack_scenes, take_scene
from edqn_jax.sim.worlds import Missions

FLIES = 0.9
"""Share of the validation missions that begin at or near a world's own start, with which a policy flies the mission."""


@dataclasses.dataclass(frozen=True)
class Courses:
    """Where a run trains, validates and is judged; the last two of one shape, so that one program flies both."""

    training: World
    validation: World
    final: World
    """Mission 0 is the one that is judged; nothing flies it before the end."""
    jitter_m: float = 0.0
    """How far, along each axis, validation missions near a world's own start may begin from it."""

    @property
    def from_start(self) -> np.ndarray:
        """Which validation missions begin at or near their world's own start, and not anywhere: [M] bool."""
        own = np.asarray(self.validation.pool.start)[np.asarray(self.validation.missions.scene)]
        apart = np.abs(np.asarray(self.validation.missions.start) - own).max(axis=1)
        return apart <= self.jitter_m + 1e-3  # positions are rounded to float32

    @property
    def scene(self) -> Scene:
        """The world of the mission that is judged."""
        return take_scene(self.final.pool, self.final.missions.scene[0])

    def shortest(self, config: Config) -> ShortestPath:
        """A*'s path of that mission.

        Raises:
            ConfigError: if there is none.
        """
        scene = self.scene
        return shortest_path(scene, scene.start, scene.goal, config.drone.body_radius_m)


def lay_courses(config: Config) -> Courses:
    """Worlds and missions of a run; all of it follows from the configuration's world and seed.

    Raises:
        ConfigError: if the world cannot be flown in.
    """
    airframe = drone.load_airframe(config.drone)
    count, radius = config.train.validation_missions, config.drone.body_radius_m
    root = jax.random.key(config.train.seed)
    training_key, validation_key = (jax.random.fold_in(root, purpose) for purpose in (1, 2))
    if config.world.name in DENSITIES:
        pools = {
            "training": worlds.random_pool(config.world.name, worlds.world_keys("training", config.world.pool_size)),
            "validation": worlds.random_pool(config.world.name, worlds.world_keys("validation", count)),
            "test": worlds.random_pool(config.world.name, worlds.world_keys("test", count)),
        }
        training = worlds.random_missions(pools["training"], config.world.missions, training_key)
        validation, final = (worlds.own_missions(pools[split]) for split in ("validation", "test"))
        return Courses(
            training=World(airframe, pools["training"], training),
            validation=World(airframe, pools["validation"], validation),
            final=World(airframe, pools["test"], final),
        )
    loaded = load_world(resolve_world(config.world.name))
    check_scene(loaded.scene, radius, names=loaded.names, title=f"'{config.world.name}'")
    pool = stack_scenes([loaded.scene])
    spread, jitter = config.world.own_start_fraction, config.world.start_jitter_m
    training = worlds.spread_missions(pool, config.world.missions, spread, jitter, training_key)
    # Half of the validation begins near the start, but never at it.
    near = max(jitter, 0.5)
    validation = worlds.spread_missions(pool, count, 0.5, near, validation_key)
    own = worlds.own_missions(pool)
    final = jax.tree.map(lambda one, many: jnp.concatenate([one, many[1:]]), own, validation)
    return Courses(
        training=World(airframe, pool, training),
        validation=World(airframe, pool, validation),
        final=World(airframe, pool, _typed(final)),
        jitter_m=near,
    )


def _typed(missions: Missions) -> Missions:
    return dataclasses.replace(missions, scene=missions.scene.astype(jnp.int32))


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Parameters that a run may end with, and what validation says of them; by default none yet."""

    params: PolicyParams
    spl: float = -1.0  # below what any validation gives
    success: float = 0.0  # share of validation missions
    decisions: int = 0  # trained before that validation, of all environments


def is_due(config: Config, plan: Plan, checked: int, done: int) -> bool:
    """Whether a validation is due after `done` training steps, the last one having been after `checked` decisions."""
    every = config.train.validation_every
    # On crossing a multiple, never on equality: right for any number of environments.
    return every > 0 and done * config.train.num_envs // every > checked // every and done > plan.learn_from


def check_finite(plan: Plan, done: int, losses: Losses) -> None:
    """Nothing, if all losses of the chunk that ended with training step `done` are finite.

    Raises:
        DivergedError: if one is not.
    """
    learns = np.arange(done - len(losses.q_loss), done) >= plan.learn_from
    bad = learns & ~np.isfinite(losses.q_loss)
    if bad.any():
        raise DivergedError(f"training diverged: the Q loss was {losses.q_loss[bad][0]} at training step {done}")


def validated_by(
    config: Config, courses: Courses, flown: Flights, params: PolicyParams, decisions: int
) -> tuple[Candidate, float]:
    """What the flights of a validation say of the parameters that flew them.

    Returns:
        the candidate, and the share of missions flown of those that begin at or near their world's own start.
    """
    arrived = np.asarray(flown.outcome) == Outcome.GOAL
    straight = _straight(courses.validation.missions, config.env.goal_radius_m)
    weighted = spl(arrived, np.asarray(flown.path_length_m), straight)
    latest = Candidate(params, weighted, float(np.mean(arrived)), decisions)
    return latest, float(np.mean(arrived[courses.from_start]))


def _straight(missions: Missions, goal_radius_m: float) -> np.ndarray:
    """[M] metres from each start straight to the goal's sphere: no flight is shorter, and nothing need be searched."""
    apart = np.linalg.norm(np.asarray(missions.goal) - np.asarray(missions.start), axis=1)
    return np.maximum(apart - goal_radius_m, 1e-3)


def choose(keep: Literal["best", "last"], kept: Candidate, latest: Candidate) -> Candidate:
    """Which of the two a run would end with: `best` by SPL, the latest among equals; `last` always the latest."""
    return latest if keep == "last" or latest.spl >= kept.spl else kept


class _Log:
    """What the host keeps of a run while it goes on."""

    def __init__(self, config: Config, run: RunDirectory | None) -> None:
        self.config, self.run = config, run
        self.episodes = 0
        self.validations: list[tuple[int, float, float]] = []  # decisions, seconds, success from the start

    def chunk(self, first: int, episodes: Episodes, losses: Losses, seconds: float) -> dict[str, Any]:
        """Writes what ended in a chunk and returns its metrics."""
        envs = self.config.train.num_envs
        outcome, length, gain = (
            np.asarray(x).reshape(len(x), -1) for x in (episodes.outcome, episodes.length, episodes.episode_return)
        )
        rows, columns = np.nonzero(outcome)
        kinds = outcome[rows, columns]
        if self.run is not None:
            self.run.append_episodes(
                (int((first + r + 1) * envs), float(gain[r, c]), int(length[r, c]), str(Outcome(int(k)).name.lower()))
                for r, c, k in zip(rows, columns, kinds, strict=True)
            )
        self.episodes += len(rows)
        plan = Plan.of(self.config)
        steps = len(outcome)
        warming = first + steps <= plan.warmup
        return {
            "phase": "seeing" if warming else "flying",
            "decisions": (first + steps) * envs,
            "decisions_per_second": steps * envs / seconds,
            "episodes": self.episodes,
            "success_rate": float(np.mean(kinds == Outcome.GOAL)) if len(kinds) else None,
            "mean_return": float(np.mean(gain[rows, columns])) if len(kinds) else None,
            "epsilon": float(losses.epsilon[-1]),
            "q_loss": _mean(losses.q_loss),
            "mean_q": _mean(losses.mean_q),
            "reconstruction_loss": _mean(losses.reconstruction),
            "kl": _mean(losses.kl),
        }


def first_success(validations: Sequence[tuple[int, float, float]]) -> tuple[int | None, float | None]:
    """Decisions and seconds at the first validation in which the mission was flown.

    Args:
        validations: decisions, seconds and success rate, of missions from the start, of each, in order.

    Returns:
        (None, None) if none reached `FLIES`.
    """
    return next(((decisions, seconds) for decisions, seconds, rate in validations if rate >= FLIES), (None, None))


def _mean(values: Any) -> float | None:
    """Mean of what learnt in a chunk; None if nothing did."""
    finite = np.asarray(values)
    finite = finite[~np.isnan(finite)]
    return float(np.mean(finite)) if len(finite) else None


def train_run(
    config: Config, run: RunDirectory | None, progress: Progress, stop_requested: Callable[[], bool]
) -> dict[str, Any]:
    """Train, validate, fly, draw; everything lands in the run directory.

    Args:
        config: the same on every process.
        run: None on a process that writes nothing, which is every one but the first of those that train together.
        progress: where it is shown.
        stop_requested: asked after each chunk; one process's yes stops all of them.

    Returns:
        what `summary.json` holds.

    Raises:
        ConfigError: before anything is written, if the run cannot be made; later, if one of its files cannot be.
        DivergedError: if a loss stops being finite.
        StoppedError: after saving the policy, if `stop_requested()` turned true.
    """
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="compiling")
    try:
        return _train(config, run, progress, stop_requested, pool)
    finally:
        # Nobody waits for what is being compiled: where the loop ended with an error, its sentence comes at once.
        pool.shutdown(wait=False, cancel_futures=True)


def _ahead(pool: Executor, work: Callable[[], None]) -> Future[float]:
    """Does `work` beside what follows; its result are the seconds that it took.

    Of several processes none works ahead: all must meet in one order.
    """

    def timed() -> float:
        began = time.perf_counter()
        work()
        return time.perf_counter() - began

    future = pool.submit(timed)
    if jax.process_count() > 1:
        future.result()
    return future


def _train(
    config: Config,
    run: RunDirectory | None,
    progress: Progress,
    stop_requested: Callable[[], bool],
    pool: Executor,
) -> dict[str, Any]:
    """`train_run`, which compiles in the pool."""
    began = time.perf_counter()
    devices = choose_devices(config.train.devices, config.train.shards)
    courses = processes.together(lambda: lay_courses(config))  # a world's file may be missing on one host
    trainer = Trainer(config, courses.training, devices)
    progress.message(f"{config.world.name} world, {_described(devices)}; compiling")
    compiled = _ahead(pool, trainer.compile)
    shortest = processes.together(lambda: courses.shortest(config))
    processes.together(lambda: None if run is None else run.create(config))
    state = trainer.init(config.train.seed)
    compile_seconds = compiled.result()

    plan, envs, chunk = trainer.plan, config.train.num_envs, config.train.chunk_steps
    log = _Log(config, run)
    kept = Candidate(jax.tree.map(np.asarray, policy_of(state)))
    mesh = Mesh(np.asarray(devices), ("mission",))
    given = _placed(config, courses.validation, kept.params, mesh)
    flyable = _ahead(pool, lambda: flights.prepare(config, *given, record=True, mesh=mesh))
    progress.start(plan.total * envs)
    train_seconds, checked = 0.0, 0
    done = 0
    while done < plan.total:
        started = time.perf_counter()
        state, (episodes, losses) = trainer.chunk(state, done)
        losses = jax.tree.map(np.asarray, losses)
        seconds = time.perf_counter() - started
        train_seconds += seconds
        metrics = log.chunk(done, processes.fetch(episodes), losses, seconds)
        done += chunk
        check_finite(plan, done, losses)
        finished = done >= plan.total or 0 < config.train.max_episodes <= log.episodes
        if finished or is_due(config, plan, checked, done):
            checked = done * envs
            params = jax.tree.map(np.asarray, policy_of(state))
            flyable.result()
            latest, mission = validated_by(
                config, courses, _fly(config, courses.validation, params, mesh), params, checked
            )
            log.validations.append((checked, time.perf_counter() - began, mission))
            metrics |= {
                "validation_success": latest.success,
                "validation_mission": mission,
                "validation_spl": latest.spl,
            }
            kept = choose(config.train.keep, kept, latest)
        if run is not None:
            run.append_metrics(metrics)
        progress.update(metrics)
        if processes.on_any(stop_requested()) and not finished:
            chosen = config.train.keep == "best" and kept.decisions > 0
            stopped = f"stopped after {done * envs:,} decisions"
            if run is None:
                raise StoppedError(f"{stopped}; the first process saves the policy")
            save_policy(run.checkpoints, kept.params if chosen else policy_of(state))
            raise StoppedError(f"{stopped}; the policy is in '{run.checkpoints}'")
        if finished:
            break
    progress.stop()
    if run is not None:
        save_policy(run.checkpoints, kept.params)

    flown = _fly(config, courses.final, kept.params, mesh)
    digest = state_digest(state)  # the last that all processes do together
    scene = jax.tree.map(np.asarray, courses.scene)
    flight = flight_summary(flown)
    if run is not None:
        run.write_trajectory(trajectory(config, flown))
        draw_gallery(config, run, scene, kept.params, np.asarray(shortest.points), flight["outcome"])
    since = first_success(log.validations)
    summary = {
        **flight,
        "shortest_path_m": shortest.length_m,
        "world": config.world.name,
        "seed": config.train.seed,
        "train_decisions": done * envs,
        "train_seconds": train_seconds,
        "compile_seconds": compile_seconds,
        "total_seconds": time.perf_counter() - began,
        "decisions_per_second": done * envs / train_seconds,
        "episodes": log.episodes,
        "first_success_decisions": since[0],
        "first_success_seconds": since[1],
        "validation_success": kept.success,
        "validation_spl": kept.spl,
        "parameters_from_decisions": kept.decisions,
        "workload": workload(config, scene),
        "devices": [str(device) for device in devices],
        "versions": versions(),
        "state_digest": digest,
    }
    if config.world.name in DENSITIES:
        summary["test"] = summarise(flown)
    if run is not None:
        run.write_summary(summary)
        progress.message(_verdict(summary, run))
    return summary


def _described(devices: Sequence[jax.Device]) -> str:  # pyright: ignore[reportInvalidTypeForm]
    processes = len({device.process_index for device in devices})
    return f"{len(devices)} {devices[0].platform} devices" + (f" of {processes} processes" if processes > 1 else "")


def _fly(config: Config, world: World, params: PolicyParams, mesh: Mesh) -> Flights:
    """The world's missions, flown and recorded; sensor noise is the same each time."""
    return processes.fetch(flights.fly_missions(config, *_placed(config, world, params, mesh), record=True, mesh=mesh))


def _placed(config: Config, world: World, params: PolicyParams, mesh: Mesh) -> tuple[World, PolicyParams, jax.Array]:
    """What `fly_missions` is given."""
    return *processes.replicate((world, params), mesh), jax.random.key(config.train.seed)


def _verdict(summary: dict[str, Any], run: RunDirectory) -> str:
    ending = {
        "goal": "reached the goal",
        "collision": "hit something",
        "left_volume": "left the flight volume",
        "time_out": "ran out of time",
        "diverged": "left the range of numbers",
    }[summary["outcome"]]
    text = (
        f"The greedy flight {ending} after {summary['steps']} decisions ({summary['flight_seconds']:.1f} s), "
        f"{summary['path_length_m']:.1f} m flown where the shortest path is {summary['shortest_path_m']:.1f} m, "
        f"never nearer than {summary['min_clearance_m']:.2f} m to anything."
    )
    if "test" in summary:
        test = summary["test"]
        low, high = test["interval"]
        text += (
            f"\nUnseen test worlds: {test['successes']} of {test['missions']} "
            f"({test['success_rate']:.0%}, 95 % interval {low:.0%} to {high:.0%})."
        )
    return f"{text}\nTrained in {summary['train_seconds']:.0f} s; everything is in {run.path}"
