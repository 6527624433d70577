"""`edqn record`: flies a saved policy once and writes the flight as a GIF or MP4, or the events of its camera."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rich.console import Console

from edqn_jax.cli.arguments import VIDEO, RecordArgs
from edqn_jax.config import Config
from edqn_jax.evaluation.companions import scene_of_flight
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.trajectories import trajectory
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.report.style import OUTCOME_LABELS
from edqn_jax.runs.policies import load_run, worlds_replaced
from edqn_jax.sim.task import group
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome


def record_command(args: RecordArgs) -> None:
    """Runs `edqn record` with these arguments.

    Raises:
        ConfigError: if the run, the world or the file to write is not as it should be.
        MissingPackageError: if the file to write needs an extra that is not installed.
    """
    check_can_write(args.file)
    config, params = load_run(args.run)
    # Of several drones the whole group is flown, and the first one's flight is shown.
    own = config.world.name if group.several(config) else config.world.flown or config.world.name
    world = args.world or own
    missions = load_missions(config, world, config.env.drones, args.seed, args.start, args.goal)
    write = _write_video if args.file.suffix.lower() in VIDEO else _write_events
    outcome, seconds = write(args, config, params, missions)
    notes = [] if args.world is not None else worlds_replaced(args.run)
    for note in (*notes, *([missions.note] if missions.note is not None else [])):
        Console().print(note, soft_wrap=True, markup=False, highlight=False)
    Console().print(
        f"{OUTCOME_LABELS[outcome]} after {seconds:.1f} s; '{args.file}' has {args.file.stat().st_size / 1e6:.1f} MB",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )


def _write_video(args: RecordArgs, config: Config, params: PolicyParams, missions: MissionSet) -> tuple[str, float]:
    """Writes the flight as a GIF or MP4; returns how it ended, and after how many seconds."""
    from edqn_jax.report.animation import animate
    from edqn_jax.report.sights import Sights

    scene = scene_of_flight(config, missions)
    with ThreadPoolExecutor(2, thread_name_prefix="compiling") as pool:
        sights = Sights(config, scene, pool)
        flights = fly_on_all_devices(config, missions.world, params, args.seed, record=True)
        sights = sights.in_world(scene_of_flight(config, missions, flights))
        outcome, seconds = _ending(flights)
        name = missions.name if missions.file is None else Path(missions.name).stem
        flown = trajectory(config, flights)
        video = animate(sights, params, flown, outcome, title=f"world '{name}'", form=args.file.suffix.lower())
    write_atomically(args.file, video)
    return outcome, seconds


def _write_events(args: RecordArgs, config: Config, params: PolicyParams, missions: MissionSet) -> tuple[str, float]:
    """Writes the events of a camera that watches the flight; returns as `_write_video`."""
    from edqn_jax.interop.recordings.event_files import check_can_write_events, write_events
    from edqn_jax.interop.recordings.flight_events import flight_recording

    group.check_alone(config, "`edqn record` of events")
    check_can_write_events(args.file)
    flights = fly_on_all_devices(config, missions.world, params, args.seed, record=True)
    write_events(args.file, flight_recording(config, missions.world, trajectory(config, flights), args.size))
    return _ending(flights)


def _ending(flights: Flights) -> tuple[str, float]:
    return Outcome(int(flights.outcome[0])).name.lower(), float(flights.flight_seconds[0])
