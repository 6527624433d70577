"""One flight of a policy as a file: a GIF or MP4 for people, or the events of a camera that watches it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from edqn_jax.config import Config
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.evaluate import note_unseen
from edqn_jax.evaluation.flight_scene import scene_of_flight
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.places import Point
from edqn_jax.evaluation.rollouts import ShowPhase, fly_on_all_devices, show_nothing
from edqn_jax.evaluation.trajectories import flight_trajectory
from edqn_jax.files import EVENT_FILES, VIDEO, check_can_write, check_shown, write_atomically
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import Function, FunctionPolicy, actor_of, as_policy, config_of
from edqn_jax.sim.task import group
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.watchers import shown_phases


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A flight that was written."""

    outcome: str
    """How it ended: `goal`, `collision`, `left_volume`, `time_out` or `diverged`."""
    seconds: float
    """How long it flew."""
    missions: MissionSet
    """What was flown: one mission, or that of a whole group, whose first drone is shown."""


@as_tested
def record(
    policy: Policy | FunctionPolicy | Function,
    file: str | Path,
    world: str | Path | None = None,
    *,
    start: Point | None = None,
    goal: Point | None = None,
    seed: int = 0,
    size: tuple[int, int] | None = None,
    pace: tuple[float | None, float | None] = (None, None),
    phase: ShowPhase | None = None,
    announce: Callable[[MissionSet], None] = lambda _: None,
) -> Recorded:
    """Flies a policy once and writes the flight, in place of a file of that name.

    Args:
        policy: from `train` or `load_policy`, or any function, see `FunctionPolicy`.
        file: `.gif` or `.mp4` (extra `video`): the view, what the drone sees, and its path; `.h5`, `.npz` or `.txt`
            (extra `events`): the events of a camera with a frame at every physics step.
        world: `paper`, an MJCF file, or a family of random worlds; None is where a run of it ends.
        start, goal: metres, in place of the world's.
        seed: number of the test world of a family; elsewhere it only changes the sensor's noise.
        size: pixels across and down, of a video or of the camera whose events are written; None are 800 x 540 or the
            policy's.
        pace: of a video: how many times as fast as flown it is (None: a frame a decision, or fewer), and its frames a
            second (None: 10).
        phase: called as each phase begins, and after each frame that is drawn. Without it a terminal shows them with a
            clock.
        announce: called with the mission before it is flown; its `note` says what the policy never met.

    Raises:
        ConfigError: if the policy cannot fly there, or the file cannot be written or has another ending.
        MissingPackageError: if the file needs an extra that is not installed.
    """
    file = Path(file)
    suffix = file.suffix.lower()
    if suffix not in VIDEO + EVENT_FILES:
        raise ConfigError(f"'{file}' must end in .gif or .mp4 for a video, or in .h5, .npz or .txt for events")
    check_shown(file, size, *pace)
    check_can_write(file)
    policy = as_policy(policy, world)
    config = config_of(policy)
    # Of several drones the whole group is flown, and the first one's flight is shown.
    own = config.world.name if group.is_multi_drone(config) else config.world.flown or config.world.name
    with shown_phases(phase) as told:
        show = told or show_nothing
        show("preparing the world")
        loaded = load_missions(config, str(world or own), config.env.drones, seed, start, goal)
        missions = note_unseen(policy, config, loaded)
        announce(missions)
        if suffix in VIDEO:
            given = {"size": size, "speed": pace[0], "fps": pace[1]}
            film = {name: value for name, value in given.items() if value is not None}
            flights = _write_video(file, policy, config, missions, seed, show, **film)
        else:
            flights = _write_events(file, policy, config, missions, seed, size, show)
    return Recorded(_ending(flights), float(flights.flight_seconds[0]), missions)


def _write_video(
    file: Path,
    policy: Policy | FunctionPolicy,
    config: Config,
    missions: MissionSet,
    seed: int,
    phase: ShowPhase,
    **film: Any,
) -> Flights:
    from edqn_jax.report.animation import Film, animate_flight
    from edqn_jax.report.sights import FlightRenderer

    scene = scene_of_flight(config, missions)
    with ThreadPoolExecutor(2, thread_name_prefix="compiling") as pool:
        sights = FlightRenderer(config, scene, pool, decodes=isinstance(policy, Policy))
        flights = _fly_missions(policy, config, missions, seed, phase)
        phase("drawing")
        sights = sights.in_world(scene_of_flight(config, missions, flights))
        name = missions.name if missions.file is None else Path(missions.name).stem
        flight, ended = flight_trajectory(config, flights), _ending(flights)
        title, form = f"world '{name}'", file.suffix.lower()
        video = animate_flight(sights, policy.params, flight, ended, title, form, Film(**film), phase)
    write_atomically(file, video)
    return flights


def _write_events(
    file: Path,
    policy: Policy | FunctionPolicy,
    config: Config,
    missions: MissionSet,
    seed: int,
    size: tuple[int, int] | None,
    phase: ShowPhase,
) -> Flights:
    from edqn_jax.interop.recordings.event_files import check_can_write_events, write_events
    from edqn_jax.interop.recordings.flight_events import flight_recording

    group.check_alone(config, "`edqn record` of events")
    check_can_write_events(file)
    flights = _fly_missions(policy, config, missions, seed, phase)
    phase("drawing what the camera sees")
    write_events(file, flight_recording(config, missions.env_params, flight_trajectory(config, flights), size))
    return flights


def _fly_missions(
    policy: Policy | FunctionPolicy, config: Config, missions: MissionSet, seed: int, phase: ShowPhase
) -> Flights:
    actor = actor_of(policy, config)
    return fly_on_all_devices(config, missions.env_params, policy.params, seed, actor=actor, record=True, phase=phase)


def _ending(flights: Flights) -> str:
    return Outcome(int(flights.outcome[0])).name.lower()
