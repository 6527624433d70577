"""What the axes see and fly beside what the package has: two sensors, and worlds of balls, of wires, of courtyards."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

import edqn_jax
from edqn_jax.config import Config
from edqn_jax.config.registry import FAMILIES, SENSORS
from edqn_jax.keys import uniform_parts
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import Scene, UprightBoxes
from edqn_jax.sim.sensors.built_in import CHANGE_SCALE
from edqn_jax.sim.sensors.sensor import Image, last_view, nearness_image
from edqn_jax.sim.worlds import building, discs, rooms
from edqn_jax.sim.worlds.free_points import TRIES

MOST_LATE = 3
"""Observations by which `depth-late-N` is late at most."""

COURT_M = (40.0, 40.0, 16.0)
"""Flight volume of the worlds `court`, metres: missions are 20 m long or more."""

WIRES_M = (40.0, 40.0, 9.0)
"""Flight volume of the worlds `wires`, metres, as that of forests: the trunks reach its ceiling."""
TRUNKS, TRUNK_RADIUS, TRUNK_GAP = 48, (0.04, 0.12), 2.0
"""Trunks if all find a place, their radii and the free metres between any two, at least."""
WIRES, WIRE_LENGTH, WIRE_RADIUS, WIRE_HEIGHT = 40, (6.0, 14.0), (0.015, 0.04), (0.8, 8.2)
"""Wires: how many, how long, half as wide as, and how high, metres. They are level, and square in section."""

ROOFED, ROOF_M = 0.5, 0.3
"""Share of the rooms of `courtyards` that have a roof, and how thick that is, metres."""


def difference() -> edqn_jax.Sensor:
    """Returns the sensor `frame-difference`: of a frame pair, how much darker each frame before the newest was.

    The newest frame itself is not shown. What grew brighter and what grew darker are pictures of their own, as
    `log1p` of thresholds: the VAE sees counts of events so, and all that differs from these is their rounding.
    """
    pair = SENSORS.get("frame-pair")

    def show(config: Config, scene: Scene, poses: Flight, memory: Any, key: Array) -> tuple[Array, Any]:
        pictures, memory = pair.show(config, scene, poses, memory, key)
        thresholds = pictures[1:] * (CHANGE_SCALE / config.events.threshold)
        both = jnp.concatenate([jnp.maximum(thresholds, 0.0), jnp.maximum(-thresholds, 0.0)])
        return jnp.log1p(both), memory

    def shape(config: Config) -> tuple[int, ...]:
        count, *size = pair.shape(config)
        return 2 * (count - 1), *size

    return edqn_jax.Sensor(
        show,
        shape=shape,
        frame_times_s=pair.frame_times_s,
        draws_frames=True,
        exposes=True,
        at_rest=pair.at_rest,
        image=Image("what grew brighter", "log1p of contrast thresholds"),
    )


def late_depth(count: int) -> edqn_jax.Sensor:
    """Returns the sensor `depth-late-N`: the picture of `depth` of `count` observations before.

    Until there is one, the drone has been at rest, and it is the first.
    """

    def show(config: Config, scene: Scene, poses: Flight, memory: Any, key: Array) -> tuple[Array, Any]:
        pictures, seen = memory
        now = nearness_image(config, *last_view(scene, poses))[None]
        pictures = jnp.where(seen, pictures, now)
        return pictures[:1], (jnp.concatenate([pictures[1:], now]), jnp.ones((), bool))

    def at_rest(config: Config, key: Array) -> tuple[Array, Array]:
        return jnp.zeros((count, config.camera.height, config.camera.width)), jnp.zeros((), bool)

    return edqn_jax.Sensor(
        show,
        shape=lambda config: (1, config.camera.height, config.camera.width),
        draws_frames=True,
        at_rest=at_rest,
        image=Image("nearness", "nearness (3 is contact)"),
    )


def sample_court(key: Array) -> Scene:
    """Returns a world with level ground and nothing on it, a start and a goal; the key is consumed."""
    return building.build_scene(COURT_M, jax.random.uniform(key, (2, TRIES, 3)), building.make_ground())


def sample_wires(key: Array) -> Scene:
    """Returns a world of thin trunks and of wires across it, a start and a goal; the key is consumed."""
    counts = (TRUNKS, TRUNKS * 2 * discs.PLACES, WIRES * 6, (TRUNKS + WIRES) * building.COLOUR_DRAWS, 2 * TRIES * 3)
    thick, places, drawn, colours, ends = uniform_parts(key, counts)
    radius = building.scale_uniforms(TRUNK_RADIUS, thick)
    candidates = discs.candidates_inside(radius, places.reshape(TRUNKS, discs.PLACES, 2), WIRES_M[:2], 0.0)
    x, y, placed = discs.place_discs(radius, candidates, TRUNK_GAP)
    albedo = building.make_albedos(colours.reshape(TRUNKS + WIRES, -1))

    wire = drawn.reshape(WIRES, 6)
    half = jnp.stack([building.scale_uniforms(WIRE_LENGTH, wire[:, 0]) / 2, *2 * [jnp.zeros(WIRES)]], axis=1)
    half = half.at[:, 1:].set(building.scale_uniforms(WIRE_RADIUS, wire[:, 1])[:, None])
    middle = jnp.column_stack([wire[:, 2:4] * jnp.array(WIRES_M[:2]), building.scale_uniforms(WIRE_HEIGHT, wire[:, 4])])
    return building.build_scene(
        WIRES_M,
        ends.reshape(2, TRIES, 3),
        building.make_ground(),
        building.make_boxes(jnp.ones(WIRES, bool), middle, half, jnp.pi * wire[:, 5], albedo[TRUNKS:]),
        building.make_cylinders(
            placed, jnp.stack([x, y, jnp.full(TRUNKS, WIRES_M[2] / 2)], axis=1), radius, WIRES_M[2] / 2, albedo[:TRUNKS]
        ),
    )


def sample_courtyards(key: Array) -> Scene:
    """Returns the rooms of this key, of which some have no roof, so that sun reaches them; the key is consumed.

    Where shadows are cast, rooms with a roof are dark but for what shines in through doors and windows.
    """
    scene = rooms.sample_rooms(key)
    height, (along_x, along_y) = rooms.lay_out(key)
    count = rooms.ROOMS**2
    low, high = (
        jnp.column_stack([*(side.ravel() for side in jnp.meshgrid(*sides)), jnp.full(count, level)])
        for sides, level in (((along_x[:-1], along_y[:-1]), height), ((along_x[1:], along_y[1:]), height + ROOF_M))
    )
    roofed = jax.random.uniform(jax.random.fold_in(key, 0), (count,)) < ROOFED
    albedo = jnp.broadcast_to(scene.planes.albedo[1], (count, 3))
    roofs = building.make_boxes(roofed, (low + high) / 2, (high - low) / 2, jnp.zeros(count), albedo)
    boxes: UprightBoxes = jax.tree.map(lambda *parts: jnp.concatenate(parts), scene.boxes, roofs)
    ground = jax.tree.map(lambda leaf: leaf[:1], scene.planes)
    return dataclasses.replace(scene, boxes=boxes, planes=ground)


def register() -> None:
    """Registers these sensors and worlds, once."""
    if "court" in FAMILIES:
        return
    FAMILIES.register("wires", edqn_jax.Family(sample_wires, WIRES_M, detours=True), "thin trunks, and wires across")
    size = (rooms.SIDE, rooms.SIDE, rooms.HEIGHT[1])
    FAMILIES.register(
        "courtyards", edqn_jax.Family(sample_courtyards, size, detours=True), "rooms, some without a roof"
    )
    FAMILIES.register("court", edqn_jax.Family(sample_court, COURT_M, edge_m=None), "nothing but balls that are thrown")
    SENSORS.register("frame-difference", difference(), "how the brightness has changed between two frames")
    for count in range(1, MOST_LATE + 1):
        SENSORS.register(f"depth-late-{count}", late_depth(count), f"true depth of {count} observations before")
