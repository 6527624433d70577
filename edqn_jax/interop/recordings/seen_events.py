"""A recording as a policy sees it: its windows, at its resolution, encoded and decoded."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.interop.deployment import runner
from edqn_jax.interop.deployment.onnx_export import about_policy, field_of
from edqn_jax.interop.recordings.recording import Recording
from edqn_jax.learn.actor import AgentActor, PolicyParams
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import check_has_params
from edqn_jax.sim.sensors import event_field
from edqn_jax.sim.task.observation import Observation, own_size


@dataclasses.dataclass(frozen=True)
class Seen:
    """Observations of a policy at D times of a recording."""

    until_us: NDArray[np.int64]
    """[D] end of each window, on the recording's clock."""
    image: NDArray[np.int32]
    """[D, H, W] ON minus OFF events, as the policy counts them."""
    decoded: NDArray[np.float32]
    """[D, H, W] what the decoder draws of the code: nearness, or events per pixel."""
    has_nearness: bool
    """Whether it is nearness."""


def window_ends(recording: Recording, window_us: int, period_us: int) -> NDArray[np.int64]:
    """Returns the ends [D] of the windows that are wholly in a recording, one each period, and at least one.

    The first ends a period after the beginning of the flight, where it is known, else a window after the first event.
    """
    t = recording.events["t"]
    if recording.flight is not None:
        # What `between` leaves of a flight keeps its decisions.
        begin, last = int(recording.flight["t"][0]), int(recording.flight["t"][-1])
        ends = np.arange(begin + period_us, last + 1, period_us)
        inside = ends[(ends - window_us >= t[0]) & (ends <= t[-1] + period_us)]
        return inside if inside.size else ends[:1]
    first, last = int(t[0]) + window_us, int(t[-1]) + 1
    return np.arange(first, max(last, first) + 1, period_us)


def image_at(recording: Recording, end_us: int, window_us: int) -> NDArray[np.int32]:
    """Returns ON minus OFF events of a window [H, W], at the camera's own resolution.

    Raises:
        ConfigError: if the size of the image is not known.
    """
    width, height = recording.size()
    first, last = np.searchsorted(recording.events["t"], [end_us - window_us, end_us])
    window = recording.events[first:last]
    cell = window["y"].astype(np.int64) * width + window["x"]
    on, off = (np.bincount(cell[window["p"] == sign], minlength=width * height) for sign in (1, -1))
    return (on - off).reshape(height, width).astype(np.int32)


def observe_recording(
    policy: Policy,
    recording: Recording,
    *,
    contrast: float | None = None,
    fov_deg: float | None = None,
    directions: NDArray[np.float64] | None = None,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw_rate: float = 0.0,
) -> Seen:
    """Returns the policy's observations of a recording, one per decision.

    Args:
        policy: with an encoder of events.
        recording: of a camera that looks ahead.
        contrast: of the camera; None is what the recording says, or the policy's own.
        fov_deg: horizontal; None takes the camera's whole image for the policy's.
        directions: [H, W, 2] of a calibrated lens, in place of `fov_deg`, as of `Runner`.
        velocity: [3] m/s ahead, to the left and up, where the recording has no flight.
        yaw_rate: rad/s to the left, likewise.

    Raises:
        ConfigError: if the policy does not encode events, or the camera cannot stand for the policy's.
    """
    check_has_params(policy, "observe_recording")
    config = policy.config
    if config.env.sensor != "events":
        raise ConfigError(f"only policies with the sensor 'events' encode events, not '{config.env.sensor}'")
    about = about_policy(config)
    try:
        grid = runner.Grid.of(about, recording.size(), fov_deg, directions)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from None
    try:
        contrast = runner.camera_contrast(about, recording.contrast if contrast is None else contrast)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    window_us = about["frame_times_us"][-1] - about["frame_times_us"][0]
    ends = window_ends(recording, window_us, round(about["decision_s"] * 1e6))
    stream = recording.events
    first = np.searchsorted(stream["t"], ends - window_us)
    last = np.searchsorted(stream["t"], ends)
    counts = np.stack(
        [
            runner.count_events(about, stream[a:b], int(end) - window_us, grid=grid, contrast=contrast)
            for a, b, end in zip(first, last, ends, strict=True)
        ]
    )
    motions = (_motion(about, recording, int(end), velocity, yaw_rate) for end in ends)
    motion = np.stack([runner.with_contrast(about, each, contrast) for each in motions])
    image, decoded = _encode_and_decode(config, policy.params, jnp.asarray(counts), jnp.asarray(motion))
    return Seen(ends, np.asarray(image), np.asarray(decoded), embedding.needs_nearness(config))


def _motion(
    about: dict[str, Any], recording: Recording, end_us: int, velocity: tuple[float, float, float], yaw_rate: float
) -> NDArray[np.float32]:
    """Returns the own motion at a moment: of the flight, or what was given, level, with the move nearest to it."""
    flight = recording.flight
    if flight is None:
        given = np.asarray(velocity, np.float32)
        move = np.clip(np.rint(given / about["speed_m_s"]), -1, 1)
        level = np.tile(np.array([1, 0, 0, 0], np.float32), (len(about["frame_times_us"]), 1))
        return runner.with_lean(about, level, runner.own_motion(about, np.float32(0), given, yaw_rate, move))
    now = max(int(np.searchsorted(flight["t"], end_us, side="right")) - 1, 1)
    yaw, before = (runner.heading_of(flight["quaternion"][row].astype(np.float32)) for row in (now, now - 1))
    turned = (yaw - before + np.pi) % (2 * np.pi) - np.pi
    rate = turned / (float(flight["t"][now] - flight["t"][now - 1]) * 1e-6)
    motion = runner.own_motion(about, yaw, flight["velocity"][now].astype(np.float32), rate, flight["move"][now])
    frames = np.searchsorted(flight["t"], end_us + np.asarray(about["frame_times_us"]), side="right") - 1
    return runner.with_lean(about, flight["quaternion"][np.maximum(frames, 0)].astype(np.float32), motion)


def _encode_and_decode(config: Config, params: PolicyParams, counts: Array, motion: Array) -> tuple[Array, Array]:
    """Returns signed event images and what is drawn of the codes, each [D, H, W]."""
    actor = AgentActor(config)

    def one(given: tuple[Array, Array]) -> tuple[Array, Array]:
        field = field_of(config, *given)
        # The goal is not part of a code.
        seen = Observation(sensed=field, own=jnp.zeros(own_size(config)), motion=given[1])
        code = actor.code(actor.encode(params, actor.init(), seen))
        channels = vae.decode(config.encoder, config.camera, params.encoder, code)
        nearness = embedding.needs_nearness(config)
        decoded = channels[-1] if nearness else jnp.sum(jnp.expm1(channels), axis=-3)
        return event_field.event_image(field), decoded

    return jax.jit(lambda c, m: jax.lax.map(one, (c, m)))(counts, motion)
