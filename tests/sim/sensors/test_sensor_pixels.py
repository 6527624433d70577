"""Many pixels of a real sensor under one of ours, against these pixels one by one."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import EventsConfig
from edqn_jax.sim.sensors import event_field, poisson
from tests.oracles import sensor_pixels_plain as plain
from tests.support.event_frames import TIMES, host, memory_of, run

N = 117
MANY = EventsConfig(tolerance=0.2, contrast_on=0.2, contrast_off=0.2, sensor_pixels=N)
PAIR = (-0.04, 0.0)


def frames_of(config: EventsConfig, levels: np.ndarray, size: int) -> np.ndarray:
    """Frames [T, size, size] of log brightness `levels` [T], the same for all pixels."""
    luma = np.exp(np.asarray(levels)) - config.log_epsilon
    return np.broadcast_to(luma[:, None, None], (len(levels), size, size)).astype(np.float32)


@pytest.mark.parametrize("mismatch", [0.0, 0.25])
@pytest.mark.parametrize("change", [0.03, -0.27, 1.0])
def test_counts_are_those_of_pixels_one_by_one(mismatch, change):
    config, size = dataclasses.replace(MANY, threshold_mismatch=mismatch), 30
    frames = frames_of(config, np.array([-1.5, -1.5 + change]), size)
    field = host(run(config, memory_of(config, 1, size, size), frames, PAIR)[0])
    rng = np.random.default_rng(0)
    wanted = [plain.memoryless(change, plain.thresholds_of(0.2, mismatch, N, rng), rng) for _ in range(600)]
    assert (field.polarity[field.count > 0] == np.sign(change)).all()
    # 600 and 900 draws: the mean to some standard errors, and the clip of thresholds at a tenth; the spread to 25 %.
    error = 5 * np.std(wanted) / 600**0.5
    assert field.count.mean() == pytest.approx(np.mean(wanted), abs=error + 0.02 * mismatch * np.mean(wanted) + 0.1)
    assert field.count.std() == pytest.approx(np.std(wanted), rel=0.25)
    np.testing.assert_allclose(event_field.in_units(field), field.count / N, rtol=1e-6)


def test_pixels_with_memory_have_backlash_and_no_steps():
    config, size = dataclasses.replace(MANY, law="esim"), 12
    levels = np.array([-3.0, -2.0, -1.9, -2.0, -2.05, -2.5, -2.45, -2.25, -2.1])
    times = tuple(0.02 * np.arange(len(levels)))
    field = host(run(config, memory_of(config, 1, size, size), frames_of(config, levels, size), times)[0])
    rng, thresholds = np.random.default_rng(0), np.full(N, 0.2)
    wanted = np.mean([plain.with_memory(levels, thresholds, rng) for _ in range(60)], axis=0)
    found = (field.count * field.polarity).mean(axis=(1, 2))
    # From the first rise on, whose references are drawn otherwise: events of 117 pixels.
    np.testing.assert_allclose(found[1:], wanted[1:], atol=2.0)
    assert found[2] == 0 and found[1] == pytest.approx(N / 2, abs=1)


def test_noise_is_the_mean_of_the_noise_of_all_pixels():
    config = dataclasses.replace(
        MANY, leak_rate_hz=0.5, shot_rate_hz=5.0, hot_pixel_fraction=0.01, hot_pixel_rate_hz=50.0
    )
    size = 60
    still = frames_of(config, np.full(2, -1.5), size)
    memory = memory_of(config, 1, size, size)
    assert np.asarray(memory.hot).mean() == pytest.approx(N * 0.01, rel=0.06)
    field = host(run(config, memory, still, PAIR)[0])
    on, off = field.count
    assert off.mean() == pytest.approx(N * 2.5 * 0.04, rel=0.03)
    assert off.std() == pytest.approx((N * 2.5 * 0.04) ** 0.5, rel=0.06)
    assert on.mean() == pytest.approx(N * (0.5 + 2.5 + 0.5) * 0.04, rel=0.03)


@pytest.mark.parametrize("mean", [0.05, 1.0, 3.9, 4.1, 40.0])
def test_poisson_counts_have_the_mean_and_the_spread_of_theirs(mean):
    drawn = np.asarray(poisson.sample_counts(jax.random.key(0), jnp.full(40_000, mean)))
    assert drawn.min() >= 0
    assert drawn.mean() == pytest.approx(mean, abs=5 * (mean / 40_000) ** 0.5 + 0.002 * mean)
    assert drawn.var() == pytest.approx(mean, rel=0.05 if mean > 0.1 else 0.12)


def test_mismatch_averages_out_and_a_refractory_period_caps_the_mean():
    config = dataclasses.replace(MANY, threshold_mismatch=0.25, refractory_ns=6e6)
    gain = np.asarray(memory_of(config, 1, 60, 60).gain)
    assert gain.std() == pytest.approx(0.25 / N**0.5, rel=0.05)
    bright = frames_of(config, np.array([-6.0, -0.1, -0.1]), 3)
    field = host(run(config, memory_of(config, 1, 3, 3), bright, TIMES)[0])
    assert (field.count[0] == 3 * N).all() and (field.count[1] == 0).all()  # 3 of each pixel in 20 ms
