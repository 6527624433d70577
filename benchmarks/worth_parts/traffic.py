"""The axis `bytes`: the events of flights against frames, in bytes a second. Nothing is trained.

A shipped policy flies test worlds. From moments of each flight the camera's pictures are rendered again, at several
resolutions and so close in time that an edge moves about a pixel at most from one to the next, and an ESIM sensor makes
events of them. The frame rate at which frames cost the same bytes is the break-even: a camera of frames that is slower
costs less than the events, a faster one more.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import success
from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer, to_yaml
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.evaluation.intervals import percentile_interval
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.runs.policies import load_policy
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import Scene, has_motion, scene_at
from edqn_jax.sim.sensors import event_laws, event_memory
from edqn_jax.sim.sensors.sensor import render_view
from measurement import json_report
from measurement.flags import parse_options, with_test_worlds_only

WORLDS = ("sparse", "medium", "dense", "rooms", "forest", "canyon", "moving")

SIZES = {32: 24, 64: 48, 128: 96, 346: 260}
"""Camera pixels across, and down."""

CONTRASTS = (0.05, 0.1, 0.2, 0.4)
"""Log-brightness change per event; that of real sensors is about 0.2 (docs/sensors_in_light.md)."""

FRAME_RATES = (30, 60, 120, 200)
"""Frames a second that events are compared with, at 8 bits a pixel."""

EVENT_BYTES = (4, 8)
"""Bytes of an event: of EVT 2.0, and of AEDAT or a plain stream of x, y, polarity and time."""

WINDOW_STEPS = 10
"""Physics steps of a moment: 0.2 s."""

MOMENTS = 4
"""Of each flight."""

FIRST_WIDTH = 32
"""Pixels across of which a turn of 2 rad/s moves no edge by more than a pixel in a physics step."""


def wanted_rows(args: argparse.Namespace) -> list[success.Wanted]:
    """Returns the rows of the axis: a world at a resolution.

    Raises:
        ConfigError: if an option is invalid, or there is no such policy.
    """
    use_cpu_devices()
    policy = load_policy(args.policy)
    fly = functools.cache(partial(record_flights, policy, args))
    wanted = []
    for world in args.worlds:
        for width in args.widths:
            config = config_of(world, width, args.flags)
            identity = f"worth bytes {args.policy} {args.test_seed}"
            file = success.row_file(args.out, config, args.missions, identity)
            measure = partial(measure_row, config, args, partial(fly, world, config.surface.pattern))
            wanted.append(success.Wanted(file, measure, says=_say))
    return wanted


def config_of(world: str, width: int, flags: Sequence[str]) -> Config:
    """Returns the configuration of the event sensor that is counted.

    Raises:
        ConfigError: if an option is invalid.
    """
    size = ("--camera.width", str(width), "--camera.height", str(SIZES[width]))
    look = () if any(flag.startswith("--surface.pattern") for flag in flags) else ("--surface.pattern", "drawn")
    config = parse_options(["--world", world, "--events.law", "esim", *size, *look, *flags])
    return with_test_worlds_only(config)


def record_flights(policy: Any, args: argparse.Namespace, world: str, pattern: str) -> tuple[MissionSet, Any]:
    """Returns test missions in a look, and the recorded flights of the policy through them."""
    config = apply_layer(policy.config, {"surface": {"pattern": pattern}}, "--axis bytes")
    config = dataclasses.replace(config, world=dataclasses.replace(config.world, name=world))
    course = load_missions(config, world, args.missions, args.test_seed)
    return course, fly_on_all_devices(config, course.env_params, policy.params, record=True)


def measure_row(config: Config, args: argparse.Namespace, fly: Any) -> success.Row:
    """Counts the events of moments of flights at one resolution and several contrasts, and returns the row."""
    began = time.perf_counter()
    course, flights = fly()
    moments = moments_of(config, flights, args.test_seed)
    rates = event_rates(config, course, flights, moments)
    return {
        "benchmark": "worth",
        "axis": "bytes",
        "world": config.world.name,
        "look": config.surface.pattern,
        "policy": str(args.policy),
        "width": config.camera.width,
        "height": config.camera.height,
        "missions": args.missions,
        "test_seed": args.test_seed,
        "events_per_second": {contrast: rates[:, number].tolist() for number, contrast in enumerate(CONTRASTS)},
        "row_seconds": time.perf_counter() - began,
        "commit": success.commit(),
        "options": to_yaml(config),
        **json_report.machine(jax.devices()),
    }


def moments_of(config: Config, flights: Any, seed: int) -> list[tuple[int, int]]:
    """Returns (mission, first physics step) of `MOMENTS` random moments of each flight that is long enough."""
    random, moments = np.random.default_rng(seed), []
    for mission, steps in enumerate(np.asarray(flights.physics_steps)):
        last = int(steps) - 2 - WINDOW_STEPS  # the last step may be cut off at a contact
        if last >= 0:
            moments += [(mission, int(first)) for first in random.integers(0, last + 1, MOMENTS)]
    return moments


def event_rates(config: Config, course: MissionSet, flights: Any, moments: Sequence[tuple[int, int]]) -> np.ndarray:
    """Returns the mean events a second [F, C] of each flight that has moments, with each of the contrasts.

    Args:
        config: of camera and sensor; thresholds are those of `CONTRASTS`.
        course: missions.
        flights: through them, recorded.
        moments: of `moments_of`.
    """
    between = -(-config.camera.width // FIRST_WIDTH)
    dt_s = config.drone.physics_dt_s
    times = tuple((np.arange(-WINDOW_STEPS * between, 1) * dt_s / between).tolist())
    record, moving = flights.get_record(), has_motion(course.scene())
    by_flight: dict[int, list[np.ndarray]] = {}
    for number, (mission, first) in enumerate(moments):
        poses = poses_between(record, mission, first, between, dt_s if moving else None)
        counts = np.asarray(_count(config, times, course.scene(mission), poses, jax.random.key(number)))
        by_flight.setdefault(mission, []).append(counts / (WINDOW_STEPS * dt_s))
    return np.array([np.mean(rates, axis=0) for rates in by_flight.values()])


def poses_between(record: Any, mission: int, first: int, between: int, dt_s: float | None) -> Flight:
    """Returns the poses [WINDOW_STEPS between + 1] from physics step `first` on, linear between the steps.

    Args:
        record: of flights.
        mission: number of the flight.
        first: physics step after which the moment begins, from 0.
        between: poses for each physics step.
        dt_s: of a physics step, for times in a world that moves; None in one that stands.
    """
    steps = np.arange(WINDOW_STEPS + 1)
    fine = np.arange(WINDOW_STEPS * between + 1) / between

    def along(values: np.ndarray) -> np.ndarray:
        rows = np.asarray(values)[mission, first : first + WINDOW_STEPS + 1]
        return np.stack([np.interp(fine, steps, column) for column in rows.T], axis=1).astype(np.float32)

    quaternion = along(record.quaternion)
    return Flight(
        position=jnp.asarray(along(record.position)),
        quaternion=jnp.asarray(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)),
        velocity=jnp.asarray(along(record.velocity)),
        time=None if dt_s is None else jnp.asarray((first + 1 + fine) * dt_s, jnp.float32),
    )


@partial(jax.jit, static_argnums=(0, 1))
def _count(config: Config, times: tuple[float, ...], scene: Scene, poses: Flight, key: Array) -> Array:
    """Returns the events [C] of one moment with each of the contrasts; the frames are the same."""
    camera, begins, noise = config.camera, *jax.random.split(key)
    see = lambda place, attitude, time: render_view(config, scene_at(scene, time), place, attitude)  # noqa: E731
    frames = jax.vmap(see)(poses.position, poses.quaternion, poses.time)
    counts = []
    for number, contrast in enumerate(CONTRASTS):
        options = dataclasses.replace(config.events, contrast_on=contrast, contrast_off=contrast)
        memory = event_memory.reset_memory(options, camera.height, camera.width, jax.random.fold_in(begins, number))
        field, _ = event_laws.generate_events(options, memory, frames, times, jax.random.fold_in(noise, number))
        counts.append(jnp.sum(field.count))
    return jnp.stack(counts)


def break_even(row: success.Row, contrast: str | float, event_bytes: int) -> tuple[float, float, float]:
    """Returns the frame rate at which 8-bit frames cost the bytes of the events, and its interval over flights."""
    rates = np.array(row["events_per_second"][contrast]) * event_bytes / (row["width"] * row["height"])
    drawn = np.random.default_rng(0).integers(0, len(rates), (10_000, len(rates)))
    return float(rates.mean()), *percentile_interval(rates[drawn].mean(axis=1))


def _say(row: success.Row) -> str:
    """Returns a row as a line of JSON with its break-even frame rates."""
    found = {
        str(contrast): round(break_even(row, contrast, EVENT_BYTES[0])[0], 1) for contrast in row["events_per_second"]
    }
    return json.dumps({key: row[key] for key in ("axis", "world", "width")} | {"break_even_hz": found})
