"""All pictures of a run, drawn from its directory and its final flight."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from edqn_jax.config import Config
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.report.curves import plot_learning, plot_returns
from edqn_jax.report.images import NEARNESS, RECONSTRUCTED_EVENTS, look_of, plot_reconstruction, plot_sight
from edqn_jax.report.sights import FlightRenderer, decision_rows, downsample_picture, times_of, trajectory_poses
from edqn_jax.report.worlds.flights import plot_path, plot_world
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.record import Draw
from edqn_jax.sim.camera.camera import on_screen
from edqn_jax.sim.scene.scene import Scene

MOMENTS = 5
"""Moments of the flight that are shown."""


def prepare_gallery(config: Config, scene: Scene, pool: Executor) -> Draw:
    """Starts to compile what draws flights in worlds whose arrays have the shapes of `scene`.

    Args:
        pool: as in `FlightRenderer`.

    Returns:
        the function that draws all pictures of a run.
    """
    sights = FlightRenderer(config, scene, pool)

    def plot(run: RunDirectory, scene: Scene, params: PolicyParams, shortest: np.ndarray, outcome: str) -> None:
        plot_gallery(run, sights.in_world(scene), params, shortest, outcome)

    return plot


def plot_gallery(
    run: RunDirectory, sights: FlightRenderer, params: PolicyParams, shortest: np.ndarray, outcome: str
) -> None:
    """Draws world, path, returns, learning, what the drone sees and its reconstruction into the run's `figures/`.

    What it sees is named after its sensor; `ranges` and `blind` show no image, and nothing is reconstructed.

    Args:
        sights: of the world in which the recorded flight was flown.
        params: of the policy that flew.
        shortest: [P, 3] points of the shortest path, metres.
        outcome: how the flight ended, as `summary.json` says it.
    """
    trajectory = run.read_trajectory()
    goal_radius_m = sights.config.env.goal_radius_m
    plot_world(sights.scene, run.figures / "world.png")
    plot_path(sights.scene, trajectory, shortest, run.figures / "path.png", outcome, goal_radius_m)
    plot_returns(run.read_episodes(), run.figures / "returns.png")
    plot_learning(run.read_metrics(), run.figures / "learning.png")
    if sights.has_image:
        _plot_what_it_sees(run, sights, params, trajectory)


def _plot_what_it_sees(
    run: RunDirectory, sights: FlightRenderer, params: PolicyParams, trajectory: dict[str, np.ndarray]
) -> None:
    """Draws RGB above what the sensor shows at moments of the flight, and what the VAE makes of that."""
    config = sights.config
    look = look_of(config.env.sensor)
    shown = sights.shown(params, trajectory)
    moments = _busiest(np.abs(shown.image).sum((1, 2)) if look.signed else shown.image.std((1, 2)), MOMENTS)
    rows = decision_rows(config, trajectory)[moments, -1]
    seen = zip(*trajectory_poses(trajectory, rows), times_of(trajectory, rows), strict=True)
    fine = np.stack([sights.rgb(*pose) for pose in seen])
    plot_sight(
        on_screen(fine),
        on_screen(downsample_picture(fine)),
        shown.image[moments],
        run.figures / f"{config.env.sensor}.png",
        list(trajectory["t"][rows]),
        look,
    )
    file = run.figures / "reconstruction.png"
    draws_nearness = embedding.needs_nearness(config)
    assert shown.target is not None and shown.reconstruction is not None
    title = NEARNESS if draws_nearness else RECONSTRUCTED_EVENTS if look.signed else look
    # A target made of what is shown says nothing more than that.
    seen = (shown.image[moments], look) if draws_nearness else None
    distances = None
    if shown.predicted is not None and shown.distance is not None:
        distances = shown.predicted[moments], shown.distance[moments]
    plot_reconstruction(shown.target[moments], shown.reconstruction[moments], file, title, seen, distances)


def _busiest(events: np.ndarray, parts: int) -> np.ndarray:
    """Returns of each of `parts` equal parts of a flight the decision with the most to see; fewer in a short flight.

    `events` [decisions] is how much each has, such as its number of events.
    """
    numbers = np.array_split(np.arange(len(events)), parts)
    # Not from a part's rim, or neighbours in two parts would show one and the same thing.
    inner = [part[len(part) // 8 : len(part) - len(part) // 8] for part in numbers if len(part)]
    return np.array([part[np.argmax(events[part])] for part in inner])
