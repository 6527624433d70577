"""Frames of a few pixels, event laws, and both in one compiled program."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import EventsConfig
from edqn_jax.sim.sensors import event_field, event_laws, event_memory, events

HEIGHT, WIDTH = 4, 5


TIMES = (-0.04, -0.02, 0.0)
"""Two frame pairs of 20 ms in a window of 40 ms."""


KEY = 7


PAPER = EventsConfig(threshold=0.15, tolerance=0.1, refractory_ns=6e6)  # room for 3 events in 20 ms


AIRSIM = EventsConfig(law="airsim", refractory_ns=6e6)


ESIM = EventsConfig(law="esim", contrast_on=0.12, contrast_off=0.09, refractory_ns=0.0)


@partial(jax.jit, static_argnames=("config", "times", "continuous", "gap_s"))
def run(config, memory, frames, times=TIMES, continuous=False, gap_s=None):
    return event_laws.generate_events(
        config, memory, frames, times, jax.random.key(KEY), continuous=continuous, gap_s=gap_s
    )


@partial(jax.jit, static_argnames=("config", "height", "width"))
def memory_of(config, seed, height=HEIGHT, width=WIDTH):
    return event_memory.reset_memory(config, height, width, jax.random.key(seed))


def random_frames(seed: int, count: int = len(TIMES)) -> np.ndarray:
    """`[count, H, W]` luma whose logarithm walks at random, with some pixels that stand still."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, 0.5, (count, HEIGHT, WIDTH)) * (rng.random((HEIGHT, WIDTH)) < 0.8)
    return np.exp(np.clip(np.cumsum(steps, 0) - 1.5, -5.0, 0.0)).astype(np.float32)


def levels(config: EventsConfig, frames: np.ndarray) -> np.ndarray:
    return np.asarray(events.log_brightness(config, jnp.asarray(frames)))


def host(field: event_field.EventField) -> event_field.EventField:
    return jax.tree.map(np.asarray, field)


def long_flight(seed: int, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(seed)
    level = np.cumsum(rng.normal(0.0, 0.15, (count, HEIGHT, WIDTH)), 0)
    return np.exp(-2.0 + 1.5 * np.sin(level)).astype(np.float32)
