"""What the Q-network sees of each sensor, and that the whole training step learns from any of them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from edqn_jax.config import CameraConfig, Config, EncoderConfig
from edqn_jax.config.loading import to_yaml
from edqn_jax.evaluation.latency import decision_latency_ms
from edqn_jax.learn.actor import AgentActor, PolicyParams, observation_size
from edqn_jax.learn.perception import embedding, pooled_encoder, vae
from edqn_jax.learn.perception.code import Form
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import init_state
from edqn_jax.learn.step import run_steps
from edqn_jax.runs.checkpoints.params import save_params
from edqn_jax.runs.policies import load_run
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.observation import MOTION_SIZE, Observation
from tests.support.configs import TINY
from tests.support.marks import in_whole
from tests.support.miniature import miniature_world
from tests.support.moving_boxes import frames

QUICK = dataclasses.replace(TINY, drone=dataclasses.replace(TINY.drone, physics="rigid_body"))
"""Sensors do not depend on the physics, and these compile in less time; `test_trainer` trains with the default ones."""

SENSORS = ("events", "frames", "frame-pair", "depth", "depth-motion", "event-image", "ranges", "blind")
CODED = SENSORS[:5]
STEPS = 12
KEYS = jax.random.split(jax.random.key(0))
"""Of two seeds."""


def with_sensor(name: str, config: Config = TINY) -> Config:
    return dataclasses.replace(config, env=dataclasses.replace(config.env, sensor=name))


@pytest.fixture(scope="module")
def world() -> EnvParams:
    return miniature_world(TINY)


# ------------------------------------------------------------------------------------------ the whole


@pytest.fixture(scope="module")
def traced(world: EnvParams) -> Callable[[str], tuple]:
    """For a sensor, its configuration and what starts and trains two seeds, both traced.

    An array as large as the camera's image is told by its size.
    """

    @functools.cache
    def of(name: str) -> tuple:
        config = dataclasses.replace(with_sensor(name, QUICK), camera=CameraConfig(width=11, height=7))
        start = jax.jit(jax.vmap(lambda key: init_state(config, world, key))).trace(KEYS)
        steps = jax.jit(jax.vmap(lambda state: run_steps(config, world, state, jnp.arange(STEPS))))
        return config, start, steps.trace(start.out_info)

    return of


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize("name", [*SENSORS[-2:], *in_whole(*SENSORS[1:-2])])
def test_the_training_step_learns_from_every_sensor_mapped_over_seeds(traced, name: str) -> None:
    config, start, steps = traced(name)
    plan, before = Schedule.from_config(config), start.lower().compile()(KEYS)
    after, (_, losses) = steps.lower().compile()(before)
    for leaf in jax.tree.leaves((after.learner, after.actors.memory, after.actors.replay)):
        assert np.isfinite(np.asarray(leaf)).all()
    for part in ("q", "target", "average"):
        assert moved(getattr(before.learner.agent, part), getattr(after.learner.agent, part)), part
    learns = np.arange(STEPS) >= plan.learn_from
    np.testing.assert_array_equal(np.isfinite(losses.metrics["q_loss"]), [learns] * len(KEYS))
    assert learns.any() and not learns.all()
    sees = np.arange(STEPS) < plan.warmup
    np.testing.assert_array_equal(np.isfinite(losses.metrics["reconstruction_loss"]), [sees] * len(KEYS))
    if name in CODED:
        assert plan.warmup == 4 and moved(before.learner.vae, after.learner.vae)
        learnt = jax.vmap(partial(embedding.inference_params, config))(after.learner.vae)  # what was learnt acts
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-6), learnt, after.learner.encoder)
    else:
        assert plan.warmup == 0 and after.learner.vae == after.learner.encoder == {}


def moved(one, two) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
    return any(not np.array_equal(a, b) for a, b in pairs)


@pytest.mark.whole
@pytest.mark.parametrize("name", ["events", *in_whole(*SENSORS[1:])])
@pytest.mark.slow
def test_only_a_sensor_with_an_image_has_one_in_its_program_and_a_vae(traced, name: str) -> None:
    _, start, steps = traced(name)
    state, program = start.out_info, str(steps.jaxpr)
    assert ("pictures[" in program) is (name in (*CODED, "event-image"))
    assert ("7,11]" in program) is (name in (*CODED, "event-image"))  # an array as large as an image
    assert bool(jax.tree.leaves((state.learner.vae, state.learner.vae_optimiser))) is (name in CODED)
    assert (state.actors.env.memory is None) is (name not in ("events", "event-image"))


def test_decisions_that_others_warm_up_in_are_learnt_in() -> None:
    plans = {name: Schedule.from_config(with_sensor(name)) for name in SENSORS}
    assert len({plan.total for plan in plans.values()}) == 1
    assert [plans[name].warmup for name in SENSORS] == [4, 4, 4, 4, 4, 0, 0, 0]
    assert [plans[name].learn_from for name in SENSORS] == [9, 9, 9, 9, 9, 5, 5, 5]


def test_the_workload_says_what_is_drawn_and_learnt_from() -> None:
    scene = mjcf.load_scene(mjcf.resolve_world("paper"))
    always = dataclasses.replace(TINY, encoder=dataclasses.replace(TINY.encoder, keep_learning=True, batch_size=32))
    found = {name: describe_workload(with_sensor(name, always), scene) for name in SENSORS}
    assert [found[name]["sensor"] for name in SENSORS] == list(SENSORS)
    assert [found[name]["frames_per_decision"] for name in SENSORS] == [2, 1, 2, 1, 2, 2, 0, 0]
    assert [found[name]["vae_samples_per_decision"] for name in SENSORS] == [2, 2, 2, 2, 2, 0, 0, 0]


# ------------------------------------------------------------------------------------- what is seen


def test_the_q_network_sees_a_code_or_the_ranges_or_only_the_own_state() -> None:
    sizes = [observation_size(with_sensor(name, Config())) for name in SENSORS]
    assert sizes == [42, 42, 42, 42, 42, 778, 36, 10]
    own, sensed, motion = jnp.arange(10.0), jnp.linspace(0.0, 1.0, 26), jnp.ones(MOTION_SIZE)
    nothing = PolicyParams(encoder={}, q={})
    actor = AgentActor(with_sensor("ranges"))
    (ranges,) = actor.encode(nothing, jnp.zeros((1, 36)), Observation(sensed, own, motion))
    np.testing.assert_array_equal(ranges, jnp.concatenate([sensed, own]))
    (blind,) = AgentActor(with_sensor("blind")).encode(nothing, jnp.zeros((1, 10)), Observation(None, own, motion))
    np.testing.assert_array_equal(blind, own)


@pytest.mark.whole
@pytest.mark.parametrize("name", [*SENSORS[:2], *in_whole(*SENSORS[2:])])
@pytest.mark.slow
def test_a_decision_of_any_sensor_can_be_timed(name: str) -> None:
    config = with_sensor(name)
    taken = decision_latency_ms(config, fresh_policy(config), calls=3)
    assert 0.0 < taken["median"] <= taken["p99"]


# --------------------------------------------------------------------------------- codes of pictures


def shapes(params) -> dict[str, tuple[int, ...]]:
    return {
        "/".join(str(key.key) for key in path): leaf.shape for path, leaf in jax.tree_util.tree_leaves_with_path(params)
    }


@pytest.mark.parametrize("kind", ["network", *in_whole("table")])
def test_the_code_of_a_picture_has_the_sizes_of_the_code_of_events(kind) -> None:
    config = dataclasses.replace(Config(), encoder=EncoderConfig("pooled", "sensed", pixel_features=kind))
    events, frames, pair, depth, motion = (
        shapes(jax.eval_shape(partial(embedding.init_params, with_sensor(name, config)), jax.random.key(0)))
        for name in CODED
    )
    assert pair["decoder/kernel"] == events["decoder/kernel"] and pair.keys() == frames.keys()
    assert motion == pair
    assert frames == depth and events.keys() == frames.keys()
    apart = {name: (events[name], frames[name]) for name in events if events[name] != frames[name]}
    last = {"network": ("layers_2/kernel", (64, 48), (64, 144)), "table": ("table", (2, 768, 48), (1, 768, 144))}[kind]
    # ON and OFF become one channel; the three temporal channels' features are one pixel's, pooled into 144 either way.
    assert apart.pop("decoder/kernel") == ((128, 2, 12, 16), (128, 1, 12, 16))
    assert apart.pop("decoder/bias") == ((2, 12, 16), (1, 12, 16))
    assert apart.pop(f"encoder/pixels/{last[0]}") == last[1:]
    assert apart == ({"encoder/pixels/layers_2/bias": ((48,), (144,))} if kind == "network" else {})
    assert events["encoder/hidden/kernel"] == (144, 128) and events["encoder/code/mean/kernel"] == (128, 32)


@pytest.mark.parametrize("kind", ["network", "table"])
@pytest.mark.slow
def test_a_picture_is_pooled_pixel_by_pixel(kind) -> None:
    config = EncoderConfig("pooled", "sensed", pixel_features=kind, features=4, hidden=16, code_size=5)
    camera = CameraConfig(width=6, height=4)
    params = jax.jit(lambda key: vae.init_vae(config, camera, key, form=Form.PICTURE, layers=3))(jax.random.key(0))
    pictures = np.random.default_rng(0).normal(size=(2, 3, 4, 6)).astype(np.float32)
    mean, log_variance = jax.jit(partial(vae.encode, config))(params, jnp.asarray(pictures), jnp.zeros(MOTION_SIZE))
    place = pooled_encoder.PixelTable if kind == "table" else pooled_encoder.PixelNetwork
    p = params["encoder"]
    everywhere = place(12, 4, 6, 3).apply({"params": p["pixels"]}, method="everywhere")
    features = np.asarray(everywhere).reshape(3, 4, 6, 12)
    for picture, code, spread in zip(pictures, mean, log_variance, strict=True):
        pooled = sum(picture[at] * features[at] for at in np.ndindex(3, 4, 6))
        z = np.maximum(pooled / np.sqrt(72) @ p["hidden"]["kernel"] + p["hidden"]["bias"], 0.0)
        np.testing.assert_allclose(
            code, z @ p["code"]["mean"]["kernel"] + p["code"]["mean"]["bias"], rtol=1e-4, atol=1e-4
        )
        np.testing.assert_allclose(spread, -4.0, atol=1e-6)  # untrained


@pytest.mark.whole
@pytest.mark.slow
def test_the_code_of_pictures_is_learnt() -> None:
    config, camera = EncoderConfig("pooled", "sensed"), CameraConfig()
    draw = jax.jit(jax.vmap(lambda key: jnp.log(frames(camera, key)[1] + 1e-3) + 1.0))
    pictures = draw(jax.random.split(jax.random.key(1), 1024))[:, None]
    params = vae.init_vae(config, camera, jax.random.key(0), form=Form.PICTURE)
    optimiser, still = optax.adam(config.learning_rate), jnp.zeros(MOTION_SIZE)

    def update(carry, key):
        params, state = carry
        pick_key, noise_key = jax.random.split(key)
        some = pictures[jax.random.randint(pick_key, (64,), 0, 1024)]
        wanted = vae.in_waves(config, vae.decoder_target(config, some))
        noise = jax.random.normal(noise_key, (64, config.code_size))
        gradient = jax.grad(lambda p: vae.vae_loss(config, p, some, still, wanted, noise)[0])(params)
        change, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, change), state), None

    keys = jax.random.split(jax.random.key(2), 300)
    (params, _), _ = jax.jit(lambda c: jax.lax.scan(update, c, keys))((params, optimiser.init(params)))
    unseen = draw(jax.random.split(jax.random.key(3), 256))[:, None]
    wanted = vae.decoder_target(config, unseen)
    made = jax.jit(partial(vae.decode, config, camera))(params, vae.embed(config, params, unseen, still))
    left = float(jnp.sum((wanted - made) ** 2) / jnp.sum((wanted - wanted.mean(0)) ** 2))
    # 1 is the mean picture, 0.56 was reached: five boxes at random places fit a code of 32 no better in 300 updates.
    assert left < 0.65, left


# ----------------------------------------------------------------------------------- what was saved


@pytest.mark.parametrize("name", SENSORS[1:])
@pytest.mark.slow
def test_the_policy_of_any_sensor_comes_back(tmp_path: Path, name: str) -> None:
    config = with_sensor(name)
    (tmp_path / "config.yaml").write_text(to_yaml(config))
    save_params(tmp_path / "checkpoints", fresh_policy(config, seed=3))
    found, params = load_run(tmp_path)
    assert found == config and not moved(params, fresh_policy(config, seed=3))
    assert jax.tree.structure(params) == jax.tree.structure(fresh_policy(config))
