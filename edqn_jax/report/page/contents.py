"""The data of the page, plain JSON: worlds, runs, flights, curves, and pictures as far as they fit."""

from __future__ import annotations

import base64
import datetime
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from edqn_jax.evaluation.flight_scene import scene_of_flight
from edqn_jax.evaluation.trajectories import flight_trajectory
from edqn_jax.report.curves import running_mean
from edqn_jax.report.page.evaluated import EvaluatedRun
from edqn_jax.report.page.pictures import flight_pictures
from edqn_jax.report.page.worlds import ball_data, round_values, world_data
from edqn_jax.report.sights import FlightRenderer
from edqn_jax.report.style import OUTCOME_COLOURS, OUTCOME_LABELS
from edqn_jax.runs.directory import to_plain_json
from edqn_jax.version import package_version

RUN_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#7a7a7a")
"""Of the runs, of Okabe and Ito's palette; more runs begin again."""
EVERY_S = 0.1
"""Time between the rows of a flight on the page, seconds, which draws straight lines between them."""
POINTS = 400
"""Points of a curve at most; more cannot be seen."""
COLUMNS = ("t", "x", "y", "z", "qw", "qx", "qy", "qz", "speed", "clearance")
"""Of a flight on the page: s, m, a unit quaternion, m/s, m."""


def page_data(runs: Sequence[EvaluatedRun]) -> dict[str, Any]:
    """Returns the data of the page without pictures; equal worlds of several flights are one."""
    worlds: dict[str, int] = {}
    meshes: list[dict[str, Any]] = []
    data = []
    for number, run in enumerate(runs):
        colour = RUN_COLOURS[number % len(RUN_COLOURS)]
        flights = []
        for mission in range(len(run.flights.outcome)):
            scene = _scene(run, mission)
            world = world_data(scene)
            key = hashlib.sha256(json.dumps(world).encode()).hexdigest()
            if key not in worlds:
                worlds[key] = len(meshes)
                meshes.append(world)
            balls = ball_data(scene)
            flights.append({"world": worlds[key], **flight_data(run, mission), **({"balls": balls} if balls else {})})
        data.append({"name": run.name, "colour": colour, "curves": learning_curves(run), "flights": flights})
    return {
        "version": package_version(),
        "made": datetime.datetime.now().isoformat(sep=" ", timespec="minutes"),
        "columns": list(COLUMNS),
        "outcomes": {kind: {"label": OUTCOME_LABELS[kind], "colour": OUTCOME_COLOURS[kind]} for kind in OUTCOME_LABELS},
        "worlds": meshes,
        "runs": data,
    }


def flight_data(run: EvaluatedRun, mission: int) -> dict[str, Any]:
    """Returns one flight: its ending, start and goal, and `rows`, base64 of float32 [T, COLUMNS], little-endian."""
    config, flights = run.config, run.flights
    columns = flight_trajectory(config, flights, mission)
    columns["speed"] = np.linalg.norm([columns[name] for name in ("vx", "vy", "vz")], axis=0)
    every = max(1, round(EVERY_S / config.drone.physics_dt_s))
    last = len(columns["t"]) - 1
    rows = np.unique(np.append(np.arange(0, last + 1, every), last))
    table = np.stack([columns[name][rows] for name in COLUMNS], axis=1).astype("<f4")
    pool_missions = run.missions.env_params.missions
    return {
        "mission": mission,
        "outcome": run.outcomes[mission],
        "decisions": int(flights.decisions[mission]),
        "seconds": round_values(flights.flight_seconds[mission]),
        "path_m": round_values(flights.path_length_m[mission], 2),
        "clearance_m": round_values(flights.closest.distance[mission], 2),
        "start": round_values(pool_missions.start[mission]),
        "goal": round_values(pool_missions.goal[mission]),
        "goal_radius": config.env.goal_radius_m,
        "fov_deg": config.camera.horizontal_fov_deg,
        "aspect": config.camera.width / config.camera.height,
        "level": config.camera.mount == "level",
        "decision_s": config.drone.physics_steps * config.drone.physics_dt_s,
        "rows": base64.b64encode(table.tobytes()).decode("ascii"),
    }


def learning_curves(run: EvaluatedRun) -> dict[str, Any]:
    """Returns means of return and success over episodes, and the success of validations, each over decisions."""
    found: dict[str, Any] = {}
    if len(run.episodes.get("step", ())):
        step, outcome = run.episodes["step"], run.episodes["outcome"]
        whole = outcome != "diverged"
        window = max(1, min(200, len(step) // 10))
        found["window"] = window
        found["return"] = _curve(step[whole], run.episodes["return"][whole], window)
        found["success"] = _curve(step, (outcome == "goal").astype(np.float64), window)
    validations = [
        (row["decisions"], row["validation_success"])
        for row in run.metrics
        if row.get("validation_success") is not None
    ]
    if validations:
        found["validation"] = {"x": [x for x, _ in validations], "y": round_values([y for _, y in validations], 4)}
    return to_plain_json(found)


def _curve(step: np.ndarray, values: np.ndarray, window: int) -> dict[str, list[float]]:
    """Returns the running mean of `values` [E], thinned, each at the last of its episodes."""
    window = max(1, min(window, len(values)))
    if not len(values):
        return {"x": [], "y": []}
    mean, at = running_mean(values, window), step[window - 1 :]
    chosen = np.unique(np.linspace(0, len(mean) - 1, min(POINTS, len(mean))).round().astype(int))
    return {"x": at[chosen].tolist(), "y": round_values(mean[chosen], 4)}


def add_pictures(
    data: dict[str, Any], runs: Sequence[EvaluatedRun], most_bytes: int, message: Callable[[str], None] = lambda _: None
) -> None:
    """Adds the pictures of flights to the page's data, in turns of the runs, until `most_bytes` of them are there.

    The first flight of each run comes first, then those that did not reach the goal. A flight without pictures says
    why under `no_pictures`.
    """
    left = most_bytes
    with ThreadPoolExecutor(2, thread_name_prefix="compiling") as pool:
        sights = [FlightRenderer(run.config, _scene(run, 0), pool, decodes=run.params is not None) for run in runs]
        queues = [_by_interest(run.outcomes) for run in runs]
        if any(each.has_image for each in sights):
            message("drawing what the drone saw")
        for turn in range(max(map(len, queues), default=0)):
            for run, shown, queue, of_run in zip(runs, sights, queues, data["runs"], strict=True):
                if turn >= len(queue):
                    continue
                flight = of_run["flights"][queue[turn]]
                if not shown.has_image:
                    flight["no_pictures"] = f"no pictures: the sensor '{run.config.env.sensor}' shows no image"
                    continue
                if left <= 0:
                    flight["no_pictures"] = "no pictures of this flight: the file would be too large"
                    continue
                there = shown.in_world(_scene(run, queue[turn]))
                flight["pictures"] = flight_pictures(
                    there, run.params, flight_trajectory(run.config, run.flights, queue[turn])
                )
                left -= sum(len(panel["png"]) for panel in flight["pictures"]["panels"])


def _by_interest(outcomes: Sequence[str]) -> list[int]:
    """Returns the numbers of flights in the order in which pictures are drawn."""
    return sorted(range(len(outcomes)), key=lambda number: (number > 0, outcomes[number] == "goal", number))


def _scene(run: EvaluatedRun, mission: int) -> Any:
    return scene_of_flight(run.config, run.missions, run.flights, mission)


def script_text(data: Mapping[str, Any]) -> str:
    """Returns data as JSON that can stand inside a `<script>` element: it holds no `<`, `>` or `&`."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
