"""Eq. 1-5, the three event laws, and the stream."""

from __future__ import annotations

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from edqn_jax.config import Config, EventsConfig
from edqn_jax.config.loading import make_config
from edqn_jax.sim.sensors import event_field, event_laws, event_memory, event_noise, events, poisson
from tests.oracles import event_fields, events_plain
from tests.support.event_frames import (
    AIRSIM,
    ESIM,
    HEIGHT,
    KEY,
    PAPER,
    TIMES,
    WIDTH,
    host,
    levels,
    long_flight,
    memory_of,
    random_frames,
    run,
)
from tests.support.marks import in_whole

BINDING = dataclasses.replace(ESIM, refractory_ns=6e6)
LAWS = {"paper": PAPER, "airsim": AIRSIM, "esim": ESIM, "binding esim": BINDING}

few = settings(max_examples=12, deadline=None, derandomize=True)
seeds = st.integers(0, 2**31 - 1)


def assert_same_events(stream: np.ndarray, plain: list[events_plain.Event]) -> None:
    ours = np.sort(stream, order=["t", "y", "x"])
    theirs = np.array([(round(t * 1e6), x, y, p) for t, x, y, p in plain], event_field.STREAM_DTYPE)
    # Per pixel in order of time: float32 may move a stamp by a microsecond, so times cannot be matched first.
    ours, theirs = (s[np.lexsort((s["t"], s["x"], s["y"]))] for s in (ours, theirs))
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(ours[name], theirs[name])
    # 1 us: half from rounding, the rest float32 times and the half-open window of `esim`.
    assert np.all(np.abs(ours["t"] - theirs["t"]) <= 1)


def far_from_a_step(distance: np.ndarray, slack: float = 1e-4) -> bool:
    """Float32 and float64 may count differently only where a level is met almost exactly."""
    return bool(np.all(np.abs(distance - np.round(distance)) > slack))


def test_log_brightness_of_black_is_finite_and_of_white_is_near_zero():
    config = EventsConfig()
    np.testing.assert_allclose(
        events.log_brightness(config, jnp.array([0.0, 1.0])), [np.log(1e-3), np.log(1.001)], rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("law", LAWS)
def test_a_still_camera_is_silent(law):
    frames = jnp.asarray(np.repeat(random_frames(1, 1), len(TIMES), 0))
    field, _ = run(LAWS[law], memory_of(LAWS[law], 3), frames)
    assert not np.any(field.count) and not np.any(field.polarity)


@few
@given(seed=seeds)
def test_paper_law_equals_the_plain_loop(seed):
    frames = random_frames(seed)
    level = levels(PAPER, frames)
    change = np.abs(np.diff(level, axis=0))
    assume(far_from_a_step(change[change > 0] / PAPER.tolerance))
    field, _ = run(PAPER, memory_of(PAPER, 0), jnp.asarray(frames))
    plain = events_plain.paper(level, np.array(TIMES), PAPER.threshold, PAPER.tolerance, PAPER.refractory_ns)
    assert_same_events(event_field.to_stream(host(field)), plain)
    assert plain


@few
@given(seed=seeds, law=st.sampled_from(["esim", "binding esim"]))
def test_esim_law_equals_the_plain_loop(seed, law):
    config = LAWS[law]
    frames, memory = random_frames(seed), memory_of(config, seed)
    assert memory.residual is not None
    field, _ = run(config, memory, jnp.asarray(frames))
    plain = events_plain.esim(
        levels(config, frames),
        np.array(TIMES),
        np.asarray(memory.residual),
        config.contrast_on,
        config.contrast_off,
        config.refractory_ns,
    )
    assert_same_events(event_field.to_stream(host(field)), plain)
    assert plain


def test_airsim_counts_equal_airsim_for_every_pair_of_grey_values():
    config = EventsConfig(law="airsim")
    grey = np.arange(256, dtype=np.float32) / 255.0
    frames = np.stack(np.meshgrid(grey, grey, indexing="ij"))
    memory = event_memory.reset_memory(config, 256, 256, jax.random.key(0))
    field, _ = run(config, memory, jnp.asarray(frames), (0.0, 0.04))
    plain = np.array([[events_plain.airsim_count(a, b, 0.5) for b in range(256)] for a in range(256)])
    np.testing.assert_array_equal(field.count[0], plain[..., 0])
    np.testing.assert_array_equal(field.polarity[0], plain[..., 1])


@pytest.mark.parametrize(("change", "count"), [(0.51, 0), (0.99, 0), (1.01, 1), (1.51, 2), (2.6, 4)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_airsim_emits_one_event_less_than_the_crossings(change, count, sign):
    assert int(events.airsim_count(jnp.float32(0.7), jnp.float32(0.7 + sign * change), 0.5, 1000)) == count


@pytest.mark.parametrize(("change", "count"), [(0.05, 0), (0.12, 0), (0.16, 1), (0.25, 2), (0.99, 3)])
def test_paper_counts_whole_tolerances_over_the_threshold_up_to_the_cap(change, count):
    start = 0.2
    end = (start + PAPER.log_epsilon) * np.exp(change) - PAPER.log_epsilon
    frames = jnp.full((2, HEIGHT, WIDTH), start).at[1].set(end)
    field, _ = run(PAPER, memory_of(PAPER, 0), frames, (0.0, 0.02))
    assert np.all(np.asarray(field.count) == count)


def test_a_change_must_exceed_the_threshold():
    threshold = jnp.float32(0.1)
    change = jnp.nextafter(threshold, jnp.array([0.0, 0.1, 1.0], jnp.float32))
    np.testing.assert_array_equal(events.event_polarity(change, threshold), [0, 0, 1])
    np.testing.assert_array_equal(events.event_polarity(-change, threshold), [0, 0, -1])


@pytest.mark.whole
@pytest.mark.parametrize("pixels", [9, *in_whole(1)])
@pytest.mark.parametrize("faults_share", [1.0, *in_whole(0.0)])
def test_the_dvs_flies_with_any_refractory_period(pixels, faults_share):
    """None, v2e's 0.5 ms and 10 ms."""
    given = {"profile": "dvs", "sensor_pixels": pixels, "faults_share": faults_share, "shot_rate_hz": 500.0}
    frames, totals = np.tile(random_frames(1), (1, 8, 8)), []
    for period in (0.0, 5e5, 1e7):
        config = make_config("medium", events={**given, "refractory_ns": period})
        assert (config.events.refractory_ns, config.events.bandwidth_hz) == (period, 30.0)
        memory = memory_of(config.events, 0, *frames.shape[1:])
        memory = dataclasses.replace(memory, faults=jnp.float32(0.9) if faults_share else None)
        field = host(run(config.events, memory, frames)[0])
        assert field.count.min() >= 0 and np.isfinite(field.t_first).all() and np.isfinite(field.t_step).all()
        totals.append(int(field.count.sum()))
    assert totals[0] >= totals[1] > 1.5 * totals[2] > 0


@pytest.mark.parametrize(("refractory_ns", "limit"), [(1000.0, 40_000), (6e6, 6), (1e8, 0), (0.0, 2**31 - 1)])
def test_the_cap_is_the_window_over_the_refractory_period(refractory_ns, limit):
    assert events.max_events(EventsConfig(refractory_ns=refractory_ns), 0.0 - -0.04) == limit


@pytest.mark.parametrize("law", ["paper", "airsim", "binding esim"])
def test_a_binding_refractory_period_keeps_a_pixels_events_apart(law):
    config = LAWS[law]
    unbound = dataclasses.replace(config, refractory_ns=0.0)
    rng = np.random.default_rng(0)
    frames = jnp.asarray(np.exp(rng.uniform(-5.0, 0.0, (3, HEIGHT, WIDTH))).astype(np.float32))
    memory = memory_of(config, 5)
    field = host(run(config, memory, frames)[0])
    free = host(run(unbound, memory, frames)[0])
    assert field.count.sum() < free.count.sum()
    stream = event_field.to_stream(field)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            t = stream["t"][(stream["x"] == x) & (stream["y"] == y)]
            assert np.all(np.diff(t) >= config.refractory_ns * 1e-3 - 1)  # 1 us of rounding


@pytest.mark.parametrize("law", ["paper", "airsim"])
def test_a_binding_refractory_period_caps_the_count(law):
    frames = jnp.stack([jnp.full((HEIGHT, WIDTH), 0.01), jnp.ones((HEIGHT, WIDTH))])
    field, _ = run(LAWS[law], memory_of(LAWS[law], 0), frames, (0.0, 0.02))
    assert np.all(np.asarray(field.count) == 3)


def test_esim_reconstructs_every_pixel_within_one_threshold():
    frames = long_flight(1)
    times = tuple(0.02 * k for k in range(len(frames)))
    memory = memory_of(ESIM, 11)
    field, _ = run(ESIM, memory, jnp.asarray(frames), times)
    count, polarity = np.asarray(field.count), np.asarray(field.polarity)
    level = levels(ESIM, frames).astype(np.float64)
    jump = count * np.where(polarity > 0, ESIM.contrast_on, -ESIM.contrast_off)
    reference = level[0] - np.asarray(memory.residual)
    error = np.abs(level[1:] - (reference + np.cumsum(jump, 0)))
    # 1e-5: float32 residuals over 400 frames.
    assert error.max() <= max(ESIM.contrast_on, ESIM.contrast_off) + 1e-5
    assert count.sum() > 5000


@pytest.mark.parametrize("law", ["esim", "binding esim"])
def test_streaming_frame_by_frame_equals_one_long_window(law):
    config, frames = LAWS[law], long_flight(2, 41)
    times = tuple(0.02 * k for k in range(41))
    memory = memory_of(config, 4)
    whole = event_field.to_stream(host(run(config, memory, jnp.asarray(frames), times, True)[0]))
    parts = []
    for k in range(40):
        field, memory = run(config, memory, jnp.asarray(frames[k : k + 2]), (0.0, 0.02), True)
        parts.append(event_field.to_stream(host(field), window_start_us=20_000 * k))
    streamed = np.concatenate(parts)
    order = ("t", "x", "y")
    whole, streamed = (s[np.lexsort([s[n] for n in order])] for s in (whole, streamed))
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(whole[name], streamed[name])
    assert np.all(np.abs(whole["t"] - streamed["t"]) <= 1)  # float32 at 0.8 s, then rounding
    assert len(whole) > 200


def test_an_unseen_pause_releases_no_burst():
    """Re-anchoring: what changed between two windows makes no events, the residual stays."""
    dark, bright = jnp.full((2, HEIGHT, WIDTH), 0.05), jnp.full((2, HEIGHT, WIDTH), 0.9)
    _, memory = run(ESIM, memory_of(ESIM, 1), dark, (0.0, 0.02))
    field, after = run(ESIM, memory, bright, (0.0, 0.02))
    assert not np.any(field.count)
    np.testing.assert_array_equal(memory.residual, after.residual)


def test_esim_windows_are_half_open():
    """A level that is met just as the next frame is taken is stamped before that frame."""
    rise = np.exp(ESIM.contrast_on * (3.0 + 1e-5))
    frames = jnp.full((3, HEIGHT, WIDTH), 0.2).at[1:].set((0.2 + ESIM.log_epsilon) * rise - ESIM.log_epsilon)
    memory = memory_of(ESIM, 0).replace(residual=jnp.zeros((HEIGHT, WIDTH)))
    field = host(run(ESIM, memory, frames)[0])
    stream = event_field.to_stream(field)
    assert np.all(field.count == [[[3]], [[0]]])
    assert stream["t"].max() == 19_999
    np.testing.assert_array_equal(event_fields.collect(stream, TIMES, HEIGHT, WIDTH).count, field.count)


@few
@given(seed=seeds, law=st.sampled_from(list(LAWS)))
def test_expansion_is_sorted_inside_the_window_and_lossless_both_ways(seed, law):
    config = LAWS[law]
    field = host(run(config, memory_of(config, seed), jnp.asarray(random_frames(seed)))[0])
    start_us = seed * 1000
    stream = event_field.to_stream(field, start_us)
    assert np.all(np.diff(stream["t"]) >= 0)
    if len(stream):
        assert start_us <= stream["t"][0] and stream["t"][-1] < start_us + 40_000
    back = event_fields.collect(stream, TIMES, HEIGHT, WIDTH, start_us)
    np.testing.assert_array_equal(back.count, field.count)
    np.testing.assert_array_equal(back.polarity, field.polarity)
    for k in range(int(field.count.max())):
        true, found = (f.t_first + k * f.t_step.astype(np.float64) for f in (field, back))
        # Each stamp is the microsecond nearest to the truth, and the line is within half of one of the stamp.
        assert np.all(np.abs(true - found)[field.count > k] <= 1.0e-6 + 1e-9)
    again = event_field.to_stream(back, start_us)
    np.testing.assert_array_equal(np.sort(stream), np.sort(again))


@few
@given(data=st.data())
def test_a_stream_of_evenly_spaced_events_survives_collection(data):
    start = data.draw(st.floats(0.0, 5000.0))
    step = data.draw(st.floats(1.0, 300.0))
    count = data.draw(st.integers(1, 40))
    stream = np.zeros(count, event_field.STREAM_DTYPE)
    stamps = start + step * np.arange(count)
    # Halves are rounded to even, up and down, which only the very same line does.
    assume(np.all(np.abs(stamps % 1.0 - 0.5) > 1e-3))
    stream["t"] = np.rint(stamps).astype(np.int64)
    stream["x"], stream["y"], stream["p"] = 2, 1, -1
    field = event_fields.collect(stream, (0.0, 0.02), HEIGHT, WIDTH)
    assert field.count.sum() == field.count[0, 1, 2] == count
    np.testing.assert_array_equal(event_field.to_stream(field), stream)


def test_collect_refuses_a_stream_that_no_field_can_hold():
    stream = np.zeros(3, event_field.STREAM_DTYPE)
    stream["p"], stream["t"] = 1, [0, 10, 100]
    with pytest.raises(ValueError, match="unevenly"):
        event_fields.collect(stream, (0.0, 0.02), HEIGHT, WIDTH)
    stream["t"], stream["p"] = [0, 10, 20], [1, -1, 1]
    with pytest.raises(ValueError, match="both polarities"):
        event_fields.collect(stream, (0.0, 0.02), HEIGHT, WIDTH)


def test_an_empty_window_has_an_empty_stream():
    still = jnp.full((3, HEIGHT, WIDTH), 0.5)
    stream = event_field.to_stream(host(run(PAPER, memory_of(PAPER, 0), still)[0]))
    assert len(stream) == 0
    assert not np.any(event_fields.collect(stream, TIMES, HEIGHT, WIDTH).count)


def test_a_stored_signed_count_holds_the_whole_field_of_two_frames():
    config = EventsConfig()
    field, _ = run(config, memory_of(config, 0), jnp.asarray(random_frames(9, 2)), config.frame_times_s)
    again = event_fields.field_of_counts(config, event_fields.signed_count(field))
    for name in ("count", "polarity"):
        np.testing.assert_array_equal(getattr(field, name), getattr(again, name))
    np.testing.assert_allclose(field.t_step, again.t_step, rtol=1e-6)
    assert field.window_s == again.window_s


@pytest.mark.parametrize(
    ("config", "frames", "divides"),
    [
        (PAPER, 2, True),
        (dataclasses.replace(AIRSIM, airsim_tolerance=0.1), 2, True),
        (PAPER, 3, False),
        (ESIM, 2, False),
        (dataclasses.replace(PAPER, leak_rate_hz=200.0), 2, False),
    ],
    ids=["paper", "airsim", "three frames", "esim", "noise"],
)
def test_a_field_says_that_events_divide_the_window_where_they_do(config, frames, divides):
    field, _ = run(config, memory_of(config, 0), jnp.asarray(random_frames(5, frames)), TIMES[-frames:])
    window = field.window_s
    even = np.all(field.t_first == 0.0) and np.allclose(field.t_step, window / np.maximum(field.count, 1), rtol=1e-6)
    assert np.any(field.count > 1)
    assert field.divides_window == even == divides


def test_the_event_picture_paints_on_red_and_off_blue():
    for background, blank in (("white", 255), ("black", 0)):
        picture = event_field.event_picture(np.array([[3, -1, 0]]), background)
        red, blue, none = picture[0].astype(int)
        assert picture.dtype == np.uint8 and red[0] > red[2] + 50 and blue[2] > blue[0] + 50
        assert np.all(none == blank)
    with pytest.raises(ValueError, match="background"):
        event_field.event_picture(np.zeros((1, 1)), "green")


def test_frames_and_times_must_match():
    with pytest.raises(ValueError, match="two frames"):
        event_laws.generate_events(PAPER, memory_of(PAPER, 0), jnp.ones((1, 2, 2)), (0.0,), jax.random.key(0))
    with pytest.raises(ValueError, match="rising"):
        event_laws.generate_events(PAPER, memory_of(PAPER, 0), jnp.ones((2, 2, 2)), (0.0, 0.0), jax.random.key(0))


NOISY = EventsConfig(leak_rate_hz=20.0, shot_rate_hz=40.0, hot_pixel_fraction=0.1, hot_pixel_rate_hz=400.0)


@pytest.mark.slow
def test_noise_rates_are_the_configured_ones():
    size = 200
    memory = event_memory.reset_memory(NOISY, size, size, jax.random.key(1))
    still = jnp.full((3, size, size), 0.5)
    field = host(run(NOISY, memory, still)[0])
    assert field.count.shape == (4, size, size)
    assert np.all(field.polarity[:2] >= 0) and np.all(field.polarity[2:] <= 0)
    hot = np.asarray(memory.hot)
    assert abs(hot.mean() - 0.1) < 0.01  # 40 000 draws: standard error 0.0015
    count = field.count.sum(0)
    # Poisson: 36 000 pixels x 60 Hz x 0.04 s = 86 400 events, standard error 0.35 %.
    assert abs(count[~hot].mean() / (60.0 * 0.04) - 1.0) < 0.02
    assert abs(count[hot].mean() / (460.0 * 0.04) - 1.0) < 0.02
    off = (field.count * (field.polarity < 0)).sum(0)[~hot].mean() / (20.0 * 0.04)
    assert abs(off - 1.0) < 0.03
    t = event_field.to_stream(field)["t"]
    assert t[0] >= 0 and t[-1] < 40_000
    # Uniform in time: the mean of n uniform stamps has standard error 0.04 / sqrt(12 n) = 3e-5 s.
    assert abs(t.mean() * 1e-6 - 0.02) < 2e-4


BUSY = {"leak_rate_hz": 40.0, "shot_rate_hz": 60.0, "hot_pixel_fraction": 0.3, "hot_pixel_rate_hz": 100.0}
"""Some events of noise in nearly every pixel, and in most rows that have signal."""
FIRING = {**LAWS, "airsim": dataclasses.replace(AIRSIM, airsim_tolerance=0.1)}
"""Laws under which random frames make events."""


@partial(jax.jit, static_argnames="config")
def parts(config, memory, frames):
    """Signal and noise apart, and what the camera shows; one key."""
    quiet = dataclasses.replace(config, **dict.fromkeys(BUSY, 0.0))
    key, times = jax.random.key(KEY), np.array(TIMES)
    signal, _ = event_laws.generate_events(quiet, memory, frames, TIMES, key)
    noise = event_noise.noise_events(config, memory.hot, signal.count, times - times[0], key)
    shown, _ = event_laws.generate_events(config, memory, frames, TIMES, key)
    return signal, noise, shown


@pytest.mark.parametrize("most", [4, *in_whole(16, 100)])
@pytest.mark.parametrize("mean", [0.0, 0.05, 0.4, 3.0, 120.0])
def test_counts_of_noise_are_poisson_cut_off_at_the_most(mean, most):
    many = 200_000
    counts = np.asarray(
        jax.jit(poisson.sample_capped, static_argnums=2)(jax.random.key(KEY), jnp.full(many, mean), most)
    )
    terms = [math.exp(k * math.log(mean) - mean - math.lgamma(k + 1)) if mean else float(k == 0) for k in range(most)]
    expected = np.array([*terms, max(1 - sum(terms), 0.0)])
    found = np.bincount(np.minimum(counts, most), minlength=most + 1) / many
    # Five standard errors of a share of `many`, and what float32 leaves of a distribution function.
    assert np.all(np.abs(found - expected) < 5 * np.sqrt(expected / many) + 1e-6)


def test_no_mean_makes_bursts_of_noise(monkeypatch):
    monkeypatch.setattr(jax.random, "uniform", lambda key, shape: jnp.full(shape, 1 - 2.0**-23))
    means = jnp.asarray(np.geomspace(1e-6, 4, 5000), jnp.float32)
    counts = np.asarray(poisson.sample_capped(jax.random.key(0), means, 16))
    # Less than one window in 2^27 has more events than these.
    mean = np.asarray(means, float)
    assert np.all(counts <= 4 + 2 * mean + 6 * np.sqrt(mean))


def test_each_frame_pair_has_the_noise_of_its_own_length():
    config = dataclasses.replace(Config().events, shot_rate_hz=200.0, refractory_ns=5e6)
    times = np.array([0.0, 0.005, 0.04])
    field = event_noise.noise_events(config, None, jnp.zeros((2, 100, 100), jnp.int32), times, jax.random.key(KEY))
    count = np.asarray(field.count).reshape(2, 2, 100, 100).sum(0).mean((1, 2))
    # 200 Hz in 5 ms, at most one event a pixel: 1 - exp(-1), and in 35 ms, at most seven, with a mean of 7.
    sevens = sum(min(k, 7) * math.exp(-7 + k * math.log(7) - math.lgamma(k + 1)) for k in range(60))
    np.testing.assert_allclose(count, [1 - math.exp(-1), sevens], rtol=0.02)


@pytest.mark.whole
@few
@given(seed=seeds, law=st.sampled_from(list(FIRING)))
def test_signal_and_noise_are_merged_as_by_the_plain_loop(seed, law):
    config = dataclasses.replace(FIRING[law], **BUSY)
    signal, noise, shown = map(host, parts(config, memory_of(config, seed), jnp.asarray(random_frames(seed))))
    one, other = (
        [(t * 1e-6, x, y, p) for t, x, y, p in event_field.to_stream(each).tolist()] for each in (signal, noise)
    )
    plain = events_plain.merged(one, other, np.array(TIMES), config.refractory_ns)
    assert min(len(one), len(other)) > 5
    stream = event_field.to_stream(shown)
    for name, field in (("count", shown.count), ("stream", stream)):
        assert (field.sum() if name == "count" else len(field)) == len(plain)
    ours = np.sort(stream, order=["y", "x", "p", "t"])
    theirs = np.array(sorted((y, x, p, t * 1e6) for t, x, y, p in plain))
    for column, name in enumerate(("y", "x", "p")):
        np.testing.assert_array_equal(ours[name], theirs[:, column])
    # Signal and noise are rounded to a microsecond before they are merged, and what is merged once more.
    assert np.all(np.abs(ours["t"] - theirs[:, 3]) <= 3)


@pytest.mark.parametrize("law", FIRING)
def test_no_row_tells_noise_from_signal(law):
    """Which of two fields is the noise cannot be told from both in one, and rows hold polarities, not origins."""
    config = dataclasses.replace(FIRING[law], **BUSY)
    signal, noise, shown = parts(config, memory_of(config, 3), jnp.asarray(random_frames(3)))
    times = np.array(TIMES) - TIMES[0]
    split = event_noise.split_polarity(signal)
    assert np.all(np.asarray(shown.polarity[:2]) >= 0) and np.all(np.asarray(shown.polarity[2:]) <= 0)
    for half in (slice(0, 2), slice(2, 4)):
        assert np.any(split.count[half]) and np.any(noise.count[half])
    exchanged = event_noise.merge_fields(config, noise, split, times)
    has = np.asarray(shown.count) > 0
    for name in ("count", "polarity", "t_first", "t_step"):
        one, other = (np.asarray(getattr(field, name)) for field in (shown, exchanged))
        np.testing.assert_allclose(one[has], other[has], rtol=1e-5, atol=1e-9)  # two programs
    np.testing.assert_array_equal(
        event_field.event_image(shown), event_field.event_image(signal) + event_field.event_image(noise)
    )


@pytest.mark.parametrize("law", ["paper", "airsim", "binding esim"])
def test_noise_obeys_the_refractory_period_of_its_pixel(law):
    """A pixel and polarity fires no two events within it, however much noise there is; signal is not replaced."""
    config = dataclasses.replace(FIRING[law], leak_rate_hz=1000.0, shot_rate_hz=2000.0)
    rng = np.random.default_rng(1)
    frames = jnp.asarray(np.exp(rng.uniform(-3.0, 0.0, (3, HEIGHT, WIDTH))).astype(np.float32))
    signal, _, shown = map(host, parts(config, memory_of(config, 5), frames))
    limit = events.max_events(config, 0.02)
    together = shown.count[:2] + shown.count[2:]
    assert np.all((together == limit) | (signal.count >= limit)) and np.all(shown.count.sum(0) >= signal.count.sum(0))
    steps = shown.t_step[shown.count > 1]
    assert steps.min() >= config.refractory_ns * 1e-9 * (1 - 1e-6)
    lasts = (shown.t_first + (shown.count - 1) * shown.t_step)[shown.count > 0]
    assert lasts.max() < 0.04


def test_threshold_mismatch_spreads_where_pixels_begin_to_fire():
    config = EventsConfig(threshold=0.1, tolerance=0.1, threshold_mismatch=0.2)
    memory = event_memory.reset_memory(config, 100, 100, jax.random.key(2))
    frames = jnp.full((2, 100, 100), 0.2).at[1].set((0.2 + 1e-3) * np.exp(0.1 * 1.2) - 1e-3)
    field, _ = run(config, memory, frames, (0.0, 0.02))
    # A change of 1.2 thresholds reaches pixels whose threshold is under one deviation too high: 84.1 %.
    assert abs(np.mean(np.asarray(field.count) > 0) - 0.841) < 0.02


def test_a_perfect_sensor_draws_no_random_numbers():
    trace = jax.make_jaxpr(
        lambda k, f: event_laws.generate_events(PAPER, event_memory.EventMemory(None, None, None, None), f, TIMES, k)
    )
    assert "random" not in str(trace(jax.random.key(0), jnp.ones((3, 2, 2))))
