"""Whole simulated flights of a JAX policy, with all that a runner is given at each decision."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

import edqn_jax
from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.physics import drone
from edqn_jax.sim.sensors import contrast, event_field
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.sensor import frame_steps
from edqn_jax.sim.task.action_sets import heading_setpoint, velocity_command
from edqn_jax.sim.task.observation import knows_contrast
from tests.oracles import event_fields


@dataclasses.dataclass(frozen=True)
class Decided:
    """One decision of the JAX policy, and what a runner is given for it."""

    packet: np.ndarray
    until_us: int
    given: dict[str, Any]
    move: int
    command: np.ndarray
    own: np.ndarray
    motion: np.ndarray
    setpoint: float
    contrast: float | None
    """Of the camera, where the policy is told it."""


def flown(policy: Policy, world: str = "medium", mission: int = 0, worlds: int = 1, most: int = 1000) -> list[Decided]:
    """Returns the decisions of a flight, from its start to its end."""
    environment = edqn_jax.make(world, policy.config, worlds=worlds)
    scene, config = environment.scene(mission), policy.config
    goal, volume = np.asarray(scene.goal), np.asarray(scene.volume)
    window_us = round(1e6 * (config.events.frame_times_s[-1] - config.events.frame_times_s[0]))
    state, seen = environment.reset(3, mission)
    memory, last, decisions, until_us = None, np.zeros(3), [], 5_000_000
    path = np.tile(np.asarray(state.drone.quaternion), (config.drone.physics_steps + 1, 1))
    while not state.ended and len(decisions) < most:
        move, memory = policy.act(seen, memory)
        body = state.drone
        yaw = drone.yaw_of(body.quaternion)
        command = velocity_command(config.env, move, yaw)
        given = {
            "position": np.asarray(body.position),
            "quaternion": np.asarray(body.quaternion),
            "velocity": np.asarray(body.velocity),
            "yaw_rate": float(drone.yaw_rate_of(body)),
            "goal": goal,
            "volume": volume,
            "attitudes": path[list(frame_steps(config))],
        }
        told = float(contrast.contrast_of(seen.motion[-1])) if knows_contrast(config) else None
        packet = event_field.to_stream(_field(config, seen.sensed, told))
        packet["t"] += until_us - window_us
        setpoint = float(heading_setpoint(config.env, body, jax.numpy.asarray(goal), command))
        own, motion = np.asarray(seen.own), np.asarray(seen.motion)
        assert np.array_equal(motion[4:7], last)
        decisions.append(Decided(packet, until_us, given, int(move), np.asarray(command), own, motion, setpoint, told))
        last = ACTIONS[int(move)]
        path = np.asarray(body.quaternion)[None]
        state, step = environment.step(state, move)
        path = np.concatenate([path, np.asarray(step.flight.quaternion)])
        seen, until_us = step.observation, until_us + 260_000
    return decisions


def _field(config: Config, sensed: Any, told: float | None) -> EventField:
    """The events that were seen; of `event-image`, some that would show the same image."""
    if isinstance(sensed, EventField):
        return sensed
    unit = 1.0 if told is None else told / contrast.REFERENCE
    image = np.rint(np.sign(sensed) * np.expm1(np.abs(sensed)) / unit)
    return event_fields.field_of_counts(config.events, jax.numpy.asarray(image.reshape(config.camera.height, -1)))


def untrained(**groups: Any) -> Policy:
    """A policy that has learnt nothing."""
    camera = {"width": 16, "height": 12} | groups.pop("camera", {})
    config = make_config("medium", drone={"physics": "rigid_body"}, camera=camera, **groups)
    return Policy(config, fresh_policy(config))
