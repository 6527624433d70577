"""What do failed flights have in common? Looks back from each collision of a run.

For each: what was hit, on which side of the drone, when it was first seen, and how many events it made in the windows
of the last four decisions, for a sensor that begins anew in each (as that of the `paper` event law does).

    python benchmarks/failures.py RUN --world medium --missions 3000 --flights 50
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import sys
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.evaluation.flight_scene import scene_of_flight
from edqn_jax.evaluation.missions import MissionSet
from edqn_jax.sim.camera import camera
from edqn_jax.sim.physics.drone import Flight, yaw_of
from edqn_jax.sim.scene.distance import shape_distances, signed_distance
from edqn_jax.sim.scene.scene import Scene, absent_like, scene_at
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome
from measurement import json_report
from measurement.recorded import fly_recorded

NAMES = {
    "boxes": "block",
    "tilted_boxes": "block",
    "cylinders": "pillar",
    "tilted_cylinders": "pillar",
    "capsules": "capsule",
    "spheres": "ball",
    "planes": "ground",
}
"""What people call a shape of each kind."""

SAME_M = 1e-3
"""Depths closer than this are of one surface: float32 has 1e-5 m at 100 m."""

LOOK_BACK = 40
"""Decisions before the collision that are looked at."""

LAST = 4
"""Decisions before the collision whose windows' events are counted: the last second, of which windows cover a part."""


def find_hit_shape(scene: Scene, point: np.ndarray, yaw: float) -> tuple[str, int, str]:
    """Returns kind and index of the shape nearest to `point` [3], and on which side of a drone heading `yaw` it is."""
    distances = {kind: np.asarray(each) for kind, each in shape_distances(scene, jnp.asarray(point)).items()}
    kind = min(distances, key=lambda name: distances[name].min())
    towards = -np.asarray(jax.grad(lambda at: signed_distance(scene, at))(jnp.asarray(point)))
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead, left, up = cos * towards[0] + sin * towards[1], cos * towards[1] - sin * towards[0], towards[2]
    sides = {"ahead": ahead, "behind": -ahead, "left": left, "right": -left, "above": up, "below": -up}
    return kind, int(np.argmin(distances[kind])), max(sides, key=lambda name: sides[name])


def alone(scene: Scene, kind: str, index: int) -> Scene:
    """Returns the scene with one shape; all others are parked."""
    shapes: dict[str, Any] = {}
    for name, own in scene.shapes().items():
        kept = np.arange(own.position.shape[0]) == (index if name == kind else -1)
        away = absent_like(own)
        shapes[name] = jax.tree.map(
            lambda own, none, kept=kept: jnp.where(kept.reshape(-1, *[1] * (own.ndim - 1)), own, none),
            own,
            away,
        )
    return scene.with_shapes(shapes)


@partial(jax.jit, static_argnums=0)
def count_visible(config: Config, scene: Scene, only: Scene, poses: Flight) -> tuple[jax.Array, jax.Array]:
    """Returns how many pixels show the shape at each of K decisions, and how many events these pixels have: [K] each.

    Args:
        scene, only: the world, and the same with one shape alone.
        poses: [K, T] at the sensor's frame times, the decision last.
    """

    def one(poses: Flight) -> tuple[jax.Array, jax.Array]:
        position, rotation = poses.position[-1], sensor.mount_rotation(config, poses.quaternion[-1])
        assert poses.time is not None
        now = poses.time[-1]
        whole, own = (
            camera.render_depth(config.camera, scene_at(each, now), position, rotation) for each in (scene, only)
        )
        shows = jnp.isfinite(own) & (own < whole + SAME_M)
        key = jax.random.key(0)
        field, _ = sensor.sense(config, scene, poses, sensor.at_rest(config, key), key)
        events = jnp.sum(jnp.where(shows, field.count, 0)) if isinstance(field, EventField) else jnp.zeros((), int)
        return jnp.sum(shows), events

    return jax.vmap(one)(poses)


def poses_of(config: Config, position: np.ndarray, quaternion: np.ndarray, decisions: int) -> Flight:
    """Returns the poses [LOOK_BACK, T] that the sensor saw before each of the last decisions of a flight, in order.

    Where the flight is shorter, the first ones are repeated.

    Args:
        position: [steps, 3] after each physics step. quaternion: [steps, 4].
        decisions: that the flight took.
    """
    n = config.drone.physics_steps
    # What the last decision was taken on was seen at the end of the one before.
    ends = np.maximum(np.arange(decisions - LOOK_BACK, decisions), 1) * n
    rows = np.maximum(ends[:, None] - n + np.asarray(sensor.frame_steps(config))[None] - 1, 0)
    at, turned = jnp.asarray(position[rows]), jnp.asarray(quaternion[rows])
    time = jnp.asarray(config.drone.physics_dt_s * (rows + 1), jnp.float32)
    return Flight(position=at, quaternion=turned, velocity=jnp.zeros_like(at), time=time)


def look_back(config: Config, missions: MissionSet, flights: Flights, mission: int) -> dict[str, Any]:
    """Returns a row about one collision."""
    assert flights.record is not None
    steps, decisions = int(flights.physics_steps[mission]), int(flights.decisions[mission])
    position = np.asarray(flights.record.position[mission])[:steps]
    quaternion = np.asarray(flights.record.quaternion[mission])[:steps]
    before = position[-2] if steps > 1 else position[-1]
    point = before + float(flights.contact[mission]) * (position[-1] - before)
    scene = scene_of_flight(config, missions, flights, mission)
    then = config.drone.physics_dt_s * (steps - 1 + float(flights.contact[mission]))
    heading = float(yaw_of(jnp.asarray(quaternion[-1])))
    kind, index, side = find_hit_shape(scene_at(scene, jnp.float32(then)), point, heading)
    pixels, events = (
        np.asarray(values)
        for values in count_visible(
            config, scene, alone(scene, kind, index), poses_of(config, position, quaternion, decisions)
        )
    )
    seconds = config.drone.physics_steps * config.drone.physics_dt_s
    looked = min(decisions - 1, LOOK_BACK)
    pixels, events = pixels[LOOK_BACK - looked :], events[LOOK_BACK - looked :]
    in_view = np.flatnonzero(pixels > 0)
    return {
        "mission": mission,
        "hit": NAMES[kind],
        "side": side,
        "first_seen_s": float((looked - in_view[0]) * seconds) if len(in_view) else None,
        "in_view_at_last": bool(looked and pixels[-1] > 0),
        "share_in_view_lately": float(np.mean(pixels[-LAST:] > 0)) if looked else 0.0,
        "pixels_at_last": int(pixels[-1]) if looked else 0,
        "events_lately": int(events[-LAST:].sum()),
        "speed_m_s": float(np.linalg.norm(np.asarray(flights.record.velocity[mission])[steps - 1])),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns what the rows have in common, as Markdown tables."""

    def counted(name: str) -> str:
        return ", ".join(f"{what} {count}" for what, count in Counter(row[name] for row in rows).most_common())

    def quartiles(name: str) -> str:
        known = [row[name] for row in rows if row[name] is not None]
        if not known:
            return "–"
        low, middle, high = np.percentile(known, [25, 50, 75])
        return f"{middle:.3g} ({low:.3g} to {high:.3g})"

    unseen = sum(not row["in_view_at_last"] for row in rows)
    never = sum(row["first_seen_s"] is None for row in rows)
    silent = sum(row["events_lately"] == 0 for row in rows)
    lines = [
        f"| of {len(rows)} collisions | |",
        "| --- | --- |",
        f"| what was hit | {counted('hit')} |",
        f"| on which side | {counted('side')} |",
        f"| out of view when the last move was chosen | {unseen} |",
        f"| never in view in the last {LOOK_BACK} decisions | {never} |",
        f"| first seen, s before the collision, at most {LOOK_BACK} decisions: median (quartiles) "
        f"| {quartiles('first_seen_s')} |",
        f"| pixels that showed it when the last move was chosen | {quartiles('pixels_at_last')} |",
        f"| its events in the windows of the last {LAST} decisions | {quartiles('events_lately')} |",
        f"| without any event in these windows | {silent} |",
        f"| speed, m/s | {quartiles('speed_m_s')} |",
    ]
    return "\n".join(lines)


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0; 2 for invalid input."""
    parser = Parser("failures", __doc__, json="write a row for each collision to this file")
    parser.add_flights("folder of a run, or pretrained", missions=1000)
    parser.add_argument("--flights", type=at_least_one, default=50, help="most collisions to look at (default 50)")
    args = parser.parse(argv)
    config, missions, flown = fly_recorded(args)
    flights = jax.tree.map(np.asarray, flown)
    (collided,) = np.nonzero(flights.outcome == Outcome.COLLISION)
    rows = [look_back(config, missions, flights, int(mission)) for mission in collided[: args.flights]]
    counts = Counter(Outcome(int(kind)).name.lower() for kind in flights.outcome)
    print(", ".join(f"{count} {name}" for name, count in counts.most_common()))
    print(table(rows) if rows else "no flight collided")
    report = {"benchmark": "failures", "world": missions.name, "seed": args.seed, "outcomes": counts, "rows": rows}
    json_report.write(args.json, report | json_report.machine(jax.devices()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
