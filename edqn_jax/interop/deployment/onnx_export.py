"""A policy as an ONNX file that a computer without JAX flies, by `runner.py` beside it. Needs the extra `export`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import ENCODERS, Config
from edqn_jax.errors import CheckError, ConfigError
from edqn_jax.evaluation.world_check import trained_sizes
from edqn_jax.extras import require_extra
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.interop.deployment import runner
from edqn_jax.learn.actor import AgentActor, Memory, PolicyParams, observation_size
from edqn_jax.learn.policy import Policy
from edqn_jax.learn.qnetwork import q_values
from edqn_jax.policies.functions import check_has_params
from edqn_jax.sim.actions import ACTIONS, move_name
from edqn_jax.sim.sensors import contrast, event_laws, event_memory, event_noise, events
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.task.observation import (
    MAX_YAW_RATE,
    Observation,
    knows_contrast,
    knows_light,
    leans,
    motion_size,
    own_size,
)
from edqn_jax.version import package_version

RUNNER = "edqn_runner.py"
"""Name of the copy of the runner that is written beside a policy."""

INPUTS, OUTPUTS = ("counts", "own", "motion", "memory"), ("values", "memory_after")

OPSET, IR_VERSION = 18, 8
"""The oldest that this network can be written in, so that onnxruntime reads it from `runner.OLDEST_ONNXRUNTIME` on."""

EDGE, NUDGES = 3e-7, 8
"""By how much own motion, the leans within it, is nudged to find counts at an edge, and how often.

It is some times what single precision rounds a lean by, radians.
"""

TOLERANCE = 1e-5
"""Largest difference between a value of the Q-network in double precision and in ONNX, of the largest value where that
exceeds 1; or twice that of JAX in single precision, if it is more."""

CHECKS = 1000
"""Random inputs that are compared before a policy is written."""


@dataclasses.dataclass(frozen=True)
class Exported:
    """An exported policy, compared with JAX."""

    file: Path
    runner: Path
    checks: int
    """Random inputs that were compared."""
    largest_difference: float
    """Of any value of the Q-network, as a share of the input's largest value where that exceeds 1."""
    ties: int
    """Inputs whose best moves are equally good within the tolerance, so that either may be chosen."""
    on_edges: int
    """Inputs of a policy that levels its events whose counts stand at the edge of being rounded to another number: left
    out."""


def export_policy(policy: Policy, file: str | Path, *, checks: int = CHECKS, digest: str | None = None) -> Exported:
    """Writes a policy as ONNX with all that the runner must know, and a copy of the runner beside it.

    Before anything is written, ONNX and JAX are given the same random inputs.

    Args:
        policy: a policy that sees events.
        file: to write; its name ends in .onnx.
        checks: how many random inputs.
        digest: SHA-256 of the policy, for the file's metadata.

    Raises:
        CheckError: if ONNX and JAX do not agree; nothing is written.
        ConfigError: if the policy is a function, does not see events, sees more of them than their counts or knows the
            light, or the file cannot be written.
    """
    check_has_params(policy, "an ONNX file")
    file = Path(file)
    if file.suffix.lower() != ".onnx":
        raise ConfigError(f"'{file}' must end in .onnx")
    beside = file.with_name(RUNNER)
    for each in (file, beside):
        check_can_write(each)
    jax2onnx = require_extra("jax2onnx", extra="export")
    require_extra("onnxruntime", extra="export")
    about = about_policy(policy.config)
    decide = decision_function(policy.config, policy.params)
    with _without_warnings():
        model = jax2onnx.to_onnx(
            decide,
            inputs=_shapes(policy.config),
            model_name="edqn_jax_policy",
            opset=OPSET,
            input_names=INPUTS,
            output_names=OUTPUTS,
        )
    model.ir_version = IR_VERSION
    model.producer_name, model.producer_version = "edqn_jax", package_version()
    difference, ties, on_edges = _compare(policy, model.SerializeToString(), checks)
    about["checked"] = {"inputs": checks, "largest_difference": difference, "ties": ties, "on_edges": on_edges}
    about["policy_sha256"] = digest
    entry = model.metadata_props.add()
    entry.key, entry.value = runner.METADATA, json.dumps(about)
    write_atomically(file, model.SerializeToString())
    write_atomically(beside, Path(runner.__file__).read_bytes())
    return Exported(file, beside, checks, difference, ties, on_edges)


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Within the block jax2onnx is silent about plugins that do not load with this JAX; one that is needed fails."""
    logger = logging.getLogger("jax2onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def about_policy(config: Config) -> dict[str, Any]:
    """Returns what the runner must know of a policy, as plain data.

    Raises:
        ConfigError: if the policy does not see events, sees more of them than their counts, or knows the light.
    """
    sensor, law = config.env.sensor, config.events
    if sensor not in ("events", "event-image"):
        raise ConfigError(f"only policies that see events can be exported; the sensor of this one is '{sensor}'")
    if knows_light(config):
        raise ConfigError("a policy that knows the light (light.told) cannot be exported: the runner is told no light")
    encoder = config.encoder
    if sensor == "events" and encoder.architecture in ENCODERS.own:
        raise ConfigError(
            f"this policy's encoder '{encoder.architecture}' is not the package's own, and may read more of events "
            "than the counts that the runner has; encoders 'patches' and 'pooled' can be exported"
        )
    if sensor == "events" and encoder.architecture == "pooled" and not _only_counts(config):
        raise ConfigError(
            "this policy's encoder is 'pooled' and sees when each event was, which the runner does not; encoders of "
            "patches can be exported, and pooled sums of two frames with the law 'paper' or 'airsim' without noise"
        )
    on, off = {
        "paper": (law.tolerance, law.tolerance),
        "airsim": (law.airsim_tolerance, law.airsim_tolerance),
        "esim": (law.contrast_on, law.contrast_off),
    }[law.law]
    least = int(law.threshold / law.tolerance + 1e-6) if law.law == "paper" else 1
    return {
        "format": runner.FORMAT,
        "edqn_jax": package_version(),
        "sensor": sensor,
        "width": config.camera.width,
        "height": config.camera.height,
        "horizontal_fov_deg": config.camera.horizontal_fov_deg,
        "mount": config.camera.mount,
        "frame_times_us": [round(t * 1e6) for t in law.frame_times_s],
        "law": law.law,
        "contrast_on": on,
        "contrast_off": off,
        "least_count": max(1, least) if law.sensor_pixels == 1 else 1,
        "known_contrast": _known_contrast(config),
        "knows_lean": leans(config),
        "sensor_pixels": law.sensor_pixels,
        "counts_net": not event_noise.has_noise(config.events),
        "history": config.agent.history,
        "observation_size": observation_size(config),
        "decision_s": config.drone.physics_steps * config.drone.physics_dt_s,
        "speed_m_s": config.env.speed_m_s,
        "goal_radius_m": config.env.goal_radius_m,
        "heading": config.env.heading,
        "heading_hold_m": config.env.heading_hold_m,
        "max_yaw_rate_rad_s": config.drone.max_yaw_rate_rad_s,
        "knows_position": config.env.position,
        "most_yaw_rate": MAX_YAW_RATE,
        "actions": ACTIONS.tolist(),
        "trained_in": [[float(side) for side in size] for size in trained_sizes(config).values()],
        "action_names": [move_name(move) for move in range(len(ACTIONS))],
    }


def _known_contrast(config: Config) -> dict[str, float] | None:
    """Returns the contrast that a policy which knows it assumes, and its scale; None where it knows none."""
    if not knows_contrast(config):
        return None
    return {
        "default": (config.events.least_contrast * config.events.most_contrast) ** 0.5,
        "middle": contrast.MIDDLE,
        "half_range": contrast.HALF_RANGE,
    }


def decision_function(config: Config, params: PolicyParams) -> Callable[..., tuple[Array, Array]]:
    """Returns the function that is exported: counts, own state, own motion and memory to values and memory.

    All with a leading [1]: counts [1, F, 2, H, W] int32 of ON and OFF events, own [1, own_size], motion
    [1, motion_size], memory [1, history, D]; values [1, 27].
    """
    params = jax.tree.map(np.asarray, params)  # constants of the file

    def decide(counts: Array, own: Array, motion: Array, memory: Memory) -> tuple[Array, Array]:
        observation = Observation(sensed=_sense(config, counts, motion), own=own, motion=motion)
        after = AgentActor(config).encode(params, memory, observation)
        return q_values(config.agent, params.q, len(ACTIONS), after), after

    return decide


def field_of(config: Config, counts: Array, motion: Array) -> EventField:
    """Returns the event field [..., F, H, W] of counts [..., F, 2, H, W] of ON and OFF events.

    The own motion [..., motion_size] tells the contrast, where the policy knows it.

    Of a policy that was trained with noise it is [..., 2 F, H, W]: ON and OFF apart. Times are those of Eq. 5.
    Polarities are int32.
    """
    on, off = counts[..., 0, :, :], counts[..., 1, :, :]
    if event_noise.has_noise(config.events):
        count = jnp.concatenate([on, off], axis=-3)
        sign = jnp.concatenate([jnp.ones_like(on), -jnp.ones_like(off)], axis=-3)
    else:
        count, sign = on + off, jnp.sign(on - off)
    edges = np.asarray(config.events.frame_times_s) - config.events.frame_times_s[0]
    starts, lengths = edges[:-1, None, None], np.diff(edges)[:, None, None]
    repeats = count.shape[-3] // len(lengths)
    first, step = events.event_times(
        count,
        jnp.asarray(np.tile(starts, (repeats, 1, 1)), jnp.float32),
        jnp.asarray(np.tile(lengths, (repeats, 1, 1)), jnp.float32),
    )
    return EventField(
        count=count,
        polarity=sign,  # int32: onnxruntime compares int8 from 1.21 on only
        t_first=first,
        t_step=step,
        window_s=float(edges[-1]),
        divides_window=_only_counts(config),
        with_noise=event_noise.has_noise(config.events),
        unit=_unit(config, motion),
    )


def _unit(config: Config, motion: Array) -> Array | None:
    """Returns what an event counts [...] with own motions [..., motion_size]; None where it is 1."""
    known = contrast.contrast_of(motion[..., -1]) if knows_contrast(config) else None
    unit = event_memory.unit_of(config.events, known)
    return None if unit is None else jnp.broadcast_to(unit, motion.shape[:-1])


def _sense(config: Config, counts: Array, motion: Array) -> EventField | Array:
    """Returns what the sensor shows where a camera counts these events."""
    if config.env.sensor == "events":
        return field_of(config, counts, motion)
    image = jnp.sum(counts[..., 0, :, :] - counts[..., 1, :, :], axis=-3).astype(jnp.float32)
    unit = _unit(config, motion)
    image = image if unit is None else image * unit[..., None, None]
    shown = jnp.sign(image) * jnp.log1p(jnp.abs(image))  # as sim.sensor has it
    return shown.reshape(*shown.shape[:-2], -1)


def _only_counts(config: Config) -> bool:
    """Returns whether the counts of a window say all that there is to its events."""
    return event_laws.divides_window(config.events, len(config.events.frame_times_s))


def _shapes(config: Config) -> list[jax.ShapeDtypeStruct]:
    pairs = len(config.events.frame_times_s) - 1
    counts = (1, pairs, 2, config.camera.height, config.camera.width)
    numbers = [(1, own_size(config)), (1, motion_size(config)), (1, config.agent.history, observation_size(config))]
    return [jax.ShapeDtypeStruct(counts, np.int32), *(jax.ShapeDtypeStruct(shape, np.float32) for shape in numbers)]


def _random_inputs(config: Config, rng: np.random.Generator) -> list[np.ndarray]:
    """Returns inputs of every density of events, from none on."""
    counts, own, motion, memory = (given.shape for given in _shapes(config))
    number = rng.poisson(3.0 * rng.random(), counts) * (rng.random(counts) < rng.random())
    if not event_noise.has_noise(config.events):  # of a pixel's events between two frames all have one polarity
        number[:, :, 0][rng.random(number[:, :, 0].shape) < 0.5] = 0
        number[:, :, 1][number[:, :, 0] > 0] = 0
    numbers = (rng.uniform(-1.0, 1.0, own), rng.uniform(-1.0, 1.0, motion), rng.normal(0.0, 0.5, memory))
    return [number.astype(np.int32), *(each.astype(np.float32) for each in numbers)]


def _by_jax(policy: Policy, precision: type) -> Callable[[list[list[np.ndarray]]], tuple[np.ndarray, np.ndarray]]:
    """Returns what computes values [N, 27] and memories of N inputs by JAX in `np.float32` or `np.float64`."""

    def cast(x: Array | np.ndarray) -> np.ndarray:
        return np.asarray(x, precision if np.issubdtype(x.dtype, np.floating) else None)

    with jax.enable_x64(precision is np.float64):
        decide = jax.jit(decision_function(policy.config, jax.tree.map(cast, policy.params)))

    def values(inputs: list[list[np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
        with jax.enable_x64(precision is np.float64):
            found, memory = decide(*(cast(np.concatenate(each)) for each in zip(*inputs, strict=True)))
            return np.asarray(found), np.asarray(memory)

    return values


def _shares_apart(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Returns the largest difference [N] of each row [N, K], as a share of its largest number where that exceeds 1."""
    apart = np.abs(found - wanted).reshape(len(wanted), -1)
    return apart.max(axis=1) / np.maximum(np.abs(wanted).reshape(len(wanted), -1).max(axis=1), 1.0)


def _on_edges(policy: Policy, inputs: list[list[np.ndarray]], in_jax: Any) -> np.ndarray:
    """Returns whether the counts of each input [N] that are levelled stand at the edge of being rounded otherwise.

    Single precision may round them to the other side, in JAX as in ONNX, and a count is then another by 1. They are
    found by changing own motion by `EDGE`, by which values that do not hang on such a count hardly change.
    """
    found = np.zeros(len(inputs), bool)
    if not policy.config.encoder.levelled:
        return found
    rng, (wanted, _) = np.random.default_rng(1), in_jax(inputs)
    for _ in range(NUDGES):
        nudged = [
            [counts, own, motion.astype(np.float64) + EDGE * rng.choice([-1.0, 1.0], motion.shape), memory]
            for counts, own, motion, memory in inputs
        ]
        found |= _shares_apart(in_jax(nudged)[0], wanted) > TOLERANCE
    return found


def _compare(policy: Policy, model: bytes, checks: int) -> tuple[float, int, int]:
    """Compares ONNX with JAX on random inputs.

    Returns:
        the largest difference of any value, as a share of its input's largest; how many best moves are ties; how many
        inputs were left out, see `_on_edges`.

    Raises:
        CheckError: if a value or a move differs, or if most inputs would be left out.
    """
    onnxruntime = require_extra("onnxruntime", extra="export")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(model, options, ["CPUExecutionProvider"])
    rng, largest, ties = np.random.default_rng(0), 0.0, 0
    inputs = [_random_inputs(policy.config, rng) for _ in range(checks)]
    # Double precision, so that only ONNX rounds; what single precision makes of the same network, ONNX may make, too.
    in_double = _by_jax(policy, np.float64)
    in_jax, in_single = in_double(inputs), _by_jax(policy, np.float32)(inputs)
    on_edges = _on_edges(policy, inputs, in_double)
    if 2 * on_edges.sum() > checks:
        raise CheckError(
            f"{on_edges.sum()} of {checks} random inputs change where own motion does by {EDGE:g}, so "
            "that ONNX and JAX cannot be compared; nothing was written"
        )
    tolerance = max(
        TOLERANCE, *(2 * _shares_apart(*each)[~on_edges].max() for each in zip(in_single, in_jax, strict=True))
    )
    for number in np.flatnonzero(~on_edges):
        wanted, remembered = (each[number : number + 1] for each in in_jax)
        values, memory = session.run(list(OUTPUTS), dict(zip(INPUTS, inputs[number], strict=True)))
        difference = float(_shares_apart(values, wanted)[0])
        apart = max(difference, float(_shares_apart(memory, remembered)[0]))
        if not apart <= tolerance:
            raise CheckError(
                f"ONNX and JAX differ by {apart:.2e} of the largest value at random input {number}, more than "
                f"{tolerance:.2e}; nothing was written"
            )
        second, first = np.sort(wanted[0])[-2:]
        tie = first - second <= 2 * tolerance * max(1.0, float(np.abs(wanted).max()))
        ties += bool(tie)
        if not tie and values.argmax() != wanted.argmax():
            raise CheckError(f"ONNX and JAX choose different moves at random input {number}; nothing was written")
        largest = max(largest, difference)
    return largest, ties, int(on_edges.sum())
