"""A sensor of one's own: what its shape says, what is made of what it shows, and what is refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.config import SENSORS, Config
from edqn_jax.config.loading import make_config
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError
from edqn_jax.interop import functional
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.samples import Samples, mirror_samples
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.sensors.event_field import EventField, event_image
from edqn_jax.sim.sensors.event_laws import random_field
from edqn_jax.sim.sensors.sensor import EVENT_FIELD, Image, Sensor
from edqn_jax.sim.task.env import check_sensor
from edqn_jax.sim.task.observation import MIRRORED_MOTION
from tests.support.miniature import miniature_world
from tests.support.registries import keep_as_they_are

H, W = 6, 8


def of_shape(shape: Any, **more: Any) -> Sensor:
    return Sensor(show=lambda *_: (None, None), shape=lambda config: shape, **more)


def with_sensor(config: Config, name: str) -> Config:
    return dataclasses.replace(config, env=dataclasses.replace(config.env, sensor=name))


@pytest.fixture
def config(monkeypatch: pytest.MonkeyPatch) -> Config:
    """Of a small camera and a sensor of one's own, `mine`."""
    keep_as_they_are(monkeypatch)
    SENSORS.register("mine", of_shape((3,)), "three numbers")
    return make_config("paper", camera={"width": W, "height": H}, env={"sensor": "mine"})


def test_a_registered_sensor_is_a_choice_and_another_is_answered_with_the_nearest(config: Config) -> None:
    assert sensor.sensor_of(config).count_values(config) == 3 and embedding.embedding_size(config) == 3
    assert "`mine`: three numbers" in SENSORS.describe() and SENSORS.own == ("mine",)
    wrong = with_sensor(config, "mien")
    with pytest.raises(
        ConfigError,
        match="^env.sensor: there is no sensor 'mien'; did you mean 'mine', or one that --imp",
    ):
        validate(wrong)
    unknown = with_sensor(config, "xyz")
    with pytest.raises(ConfigError, match="; known are events, frames, .*, mine, or one that --import registers$"):
        validate(unknown)


def test_pictures_are_read_by_the_encoder_and_values_by_the_q_network(config: Config) -> None:
    tree = of_shape({"b": (2, H, W), "a": (3,), "c": [(1, H, W), (4,)]})
    shown = tree.example(config)
    pictures, values = tree.encoder_input(config, shown), tree.values(config, shown)
    np.testing.assert_array_equal(pictures, jnp.concatenate([shown["b"], shown["c"][0]]))
    np.testing.assert_array_equal(values, jnp.concatenate([shown["a"], shown["c"][1]]))
    assert (tree.count_pictures(config), tree.count_values(config)) == (3, 7)
    many = {"b": jnp.ones((5, 2, H, W)), "a": jnp.ones((5, 3)), "c": [jnp.ones((5, 1, H, W)), jnp.ones((5, 4))]}
    assert jnp.shape(tree.encoder_input(config, many)) == (5, 3, H, W)  # type: ignore[arg-type]
    assert jnp.shape(tree.values(config, many)) == (5, 7)  # type: ignore[arg-type]
    assert tree.numbers(config, shown).shape == (3 * H * W + 7,)
    assert tree.numbers(config, many).shape == (5, 3 * H * W + 7)


def test_events_may_have_values_beside_them(config: Config) -> None:
    tree = of_shape({"field": EVENT_FIELD, "near": (2,)}, image=Image("events", "events", signed=True))
    shown = tree.example(config)
    assert isinstance(tree.encoder_input(config, shown), EventField) and tree.shows_events(config)
    np.testing.assert_array_equal(tree.values(config, shown), shown["near"])
    np.testing.assert_array_equal(tree.picture(config, shown), event_image(shown["field"]))


def test_the_picture_of_figures_is_the_one_that_the_entry_names(config: Config) -> None:
    two = of_shape((2, H, W), image=Image("second", "units", picture=1))
    shown = two.example(config)
    np.testing.assert_array_equal(two.picture(config, shown), shown[1])
    np.testing.assert_array_equal(two.picture_of_target(config, 2.0 * shown), 2.0 * shown[1])


def test_samples_are_mirrored_as_the_sensor_says() -> None:
    pictures = jnp.asarray(np.random.default_rng(0).normal(size=(4, 2, H, W)), jnp.float32)
    wanted = vae.Target(jnp.ones((4, 1, 3, 4)), jnp.zeros(4))
    samples = Samples(pictures, jnp.ones((4, 7)), wanted)
    signs = jnp.array([1.0, -1.0])[:, None, None]
    found = mirror_samples(samples, MIRRORED_MOTION, lambda image: signs * jnp.flip(image, axis=-1)).sensed
    assert isinstance(found, jax.Array)
    np.testing.assert_array_equal(found[:, 0], pictures[:, 0, :, ::-1])
    np.testing.assert_array_equal(found[:, 1], -pictures[:, 1, :, ::-1])
    np.testing.assert_array_equal(mirror_samples(samples, MIRRORED_MOTION).sensed, pictures[..., ::-1])


@pytest.mark.parametrize(
    ("shape", "says"),
    [
        ((2, H + 1, W), r"'mine' must show values \(V,\), pictures \(C, 6, 8\).*, not \(2, 7, 8\)"),
        ((H, W), r"or EVENT_FIELD, not \(6, 8\)"),
        ({"a": EVENT_FIELD, "b": (1, H, W)}, "must show pictures or one EVENT_FIELD, not both"),
        ("picture", "or EVENT_FIELD, not picture"),
    ],
)
def test_a_shape_that_nothing_can_read_is_refused(config: Config, shape: Any, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        of_shape(shape).shapes(config)


def test_what_is_shown_must_have_the_shape_that_is_told(config: Config) -> None:
    of_shape({"a": (3,)}).check(config, {"a": jnp.zeros(3)})
    of_shape(None).check(config, None)
    of_shape(EVENT_FIELD).check(config, random_field(config.events, H, W, np.random.default_rng(0)))
    with pytest.raises(ConfigError, match=r"'mine' shows \(4,\), but its shape is \(3,\); both must be the same"):
        of_shape((3,)).check(config, jnp.zeros(4))
    with pytest.raises(ConfigError, match="shows None, but its shape is"):
        of_shape((3,)).check(config, None)
    with pytest.raises(ConfigError, match=r"'mine' shows \(3,\), but its shape is events"):
        of_shape(EVENT_FIELD).check(config, jnp.zeros(3))


def test_what_is_shown_must_be_finite_and_floating_point(config: Config) -> None:
    for wrong, said in ((jnp.zeros(3, int), "int32"), (jnp.zeros(3, bool), "bool")):
        with pytest.raises(ConfigError, match=f"the sensor 'mine' must show float32 numbers, not {said}"):
            of_shape({"a": (3,)}).check(config, {"a": wrong})
    world = miniature_world(config)
    for name, number in (("ones", 1.0), ("spoilt", float("nan"))):
        SENSORS.register(name, Sensor(lambda *_, shown=number: (jnp.full(3, shown), None), lambda config: (3,)))
    check_sensor(with_sensor(config, "ones"), world)
    with pytest.raises(ConfigError, match="the sensor 'spoilt' must show finite numbers, and shows NaN or Inf as a fl"):
        check_sensor(with_sensor(config, "spoilt"), world)


def test_the_functional_face_joins_a_tree_and_refuses_nothing(config: Config) -> None:
    space = functional.FunctionalEnv(config, "image").observation_space()
    assert isinstance(space, dict) and space["image"].shape == (3,)
    SENSORS.register("nothing", of_shape(None))
    nothing = with_sensor(config, "nothing")
    with pytest.raises(ConfigError, match="the sensor 'nothing' shows nothing"):
        functional.make("paper", nothing)


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (
            {"show": lambda *_: None},
            "^`show` of the sensor 'wrong' must return what .* and its memory, not None",
        ),
        ({"show": lambda *_: (None, None)}, r"^the sensor 'wrong' shows None, but its shape is \(3,\)"),
        (
            {"show": lambda c, s, p, memory, k: (jnp.zeros(3), memory + 0.5), "at_rest": lambda c, key: jnp.int32(0)},
            r"^`show` of the sensor 'wrong' must .* a memory .*, and it is float32\[\], not int32\[\]; `at_rest`",
        ),
        (
            {"show": lambda *_: (jnp.zeros(3), {"a": jnp.zeros(2)})},
            r"must return a memory like .*, and \['a'\] is float32\[2\], not missing; `at_rest` returns the first one",
        ),
        (
            {"frame_times_s": lambda c: (0.5,)},
            r"^`frame_times_s` of .* from -0.26 to 0 s, .*\(0.5,\)",
        ),
        ({"frame_times_s": lambda c: ()}, r"^`frame_times_s` of the sensor 'wrong' must be times .*, not \(\)"),
    ],
)
def test_what_a_sensor_returns_wrongly_is_said(config: Config, made: dict[str, Any], says: str) -> None:
    given = {"show": lambda *_: (jnp.zeros(3), None), "shape": lambda c: (3,)} | made
    SENSORS.register("wrong", Sensor(**given))
    with pytest.raises(ConfigError, match=says):
        edqn_jax.make("paper", with_sensor(config, "wrong")).reset()


def test_what_a_sensor_raises_itself_is_not_changed(config: Config) -> None:
    def fails(*_: Any) -> Any:
        raise KeyError("my own")

    SENSORS.register("fails", Sensor(fails, lambda c: (3,)))
    with pytest.raises(KeyError, match="my own"):
        edqn_jax.make("paper", with_sensor(config, "fails")).reset()
