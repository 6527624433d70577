"""`edqn record`: flies a saved policy once and writes the flight as an animated GIF or an MP4."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from edqn_jax.cli.arguments import RecordArgs
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.trajectories import trajectory
from edqn_jax.report.animation import animate
from edqn_jax.report.sights import Sights
from edqn_jax.report.style import OUTCOME_LABELS
from edqn_jax.runs.files import check_can_write, write_atomically
from edqn_jax.runs.policies import load_run, worlds_replaced
from edqn_jax.sim.outcomes import Outcome


def record_command(args: RecordArgs) -> None:
    """Runs `edqn record` with these arguments.

    Raises:
        ConfigError: if the run, the world or the file to write is not as it should be.
    """
    check_can_write(args.file)
    config, params = load_run(args.run)
    world = args.world or config.world.flown or config.world.name
    missions = load_missions(config, world, 1, args.seed, args.start, args.goal)
    scene = jax.tree.map(np.asarray, missions.scene())
    with ThreadPoolExecutor(2, thread_name_prefix="compiling") as pool:
        sights = Sights(config, scene, pool)
        flights = fly_on_all_devices(config, missions.world, params, args.seed, record=True)
        outcome = Outcome(int(flights.outcome[0])).name.lower()
        name = missions.name if missions.file is None else Path(missions.name).stem
        flown = trajectory(config, flights)
        video = animate(sights, params, flown, outcome, title=f"world '{name}'", form=args.file.suffix.lower())
    write_atomically(args.file, video)
    notes = [] if args.world is not None else worlds_replaced(args.run)
    for note in (*notes, *([missions.note] if missions.note is not None else [])):
        Console().print(note, soft_wrap=True, markup=False, highlight=False)
    ended = f"{OUTCOME_LABELS[outcome]} after {float(flights.flight_seconds[0]):.1f} s"
    Console().print(
        f"{ended}; '{args.file}' has {len(video) / 1e6:.1f} MB", soft_wrap=True, markup=False, highlight=False
    )
