"""Registries refuse at once what is no entry of theirs, and names that cannot be given."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import AgentConfig, CameraConfig, EncoderConfig
from edqn_jax.config.registry import (
    AIRFRAMES,
    ENCODERS,
    FAMILIES,
    LEARNERS,
    NETWORKS,
    SENSORS,
    Registry,
    instance_of,
)
from edqn_jax.errors import ConfigError
from edqn_jax.learn.dqn.learner import DQN
from edqn_jax.learn.perception import vae
from edqn_jax.learn.qnetwork import init_q
from edqn_jax.sim.actions import Box, Discrete
from edqn_jax.sim.physics.airframe import SKYDIO_X2
from edqn_jax.sim.sensors.sensor import Sensor
from edqn_jax.sim.task.action_sets import ActionSet
from edqn_jax.sim.worlds.families import SPARSE, Family, Mixture
from tests.support.registries import EVERY, keep_as_they_are


@pytest.fixture(autouse=True)
def _kept(monkeypatch: pytest.MonkeyPatch) -> None:
    keep_as_they_are(monkeypatch)


def test_names_are_taken_once_and_asked_for_by_the_nearest() -> None:
    registry = Registry(
        "thing",
        "a.thing",
        {"one": "edqn_jax.errors:ConfigError"},
        take=instance_of("a number", "builtins:int"),
        reserved=("none",),
    )
    assert registry.get("one") is ConfigError
    registry.register("two-of-them", 2)
    assert registry.names == ("one", "two-of-them") and registry.get("two-of-them") == 2
    with pytest.raises(ConfigError, match="the thing 'one' is there already"):
        registry.register("one", 1)
    with pytest.raises(ConfigError, match="'none' is something else in a.thing; give your thing another name"):
        registry.register("none", 1)
    with pytest.raises(ConfigError, match="the thing 'three' must be a number, not '3'"):
        registry.register("three", "3")
    with pytest.raises(ConfigError, match="`about` of the thing 'three' must be text, not 3"):
        registry.register("three", 3, 3)  # type: ignore[arg-type]
    assert "three" not in registry
    with pytest.raises(
        ConfigError, match="there is no thing 'xyz'; known are one, two-of-them, or one that --import registers$"
    ):
        registry.check("xyz")


@pytest.mark.parametrize("name", ["a b", "a/b", "../a", "-a", "", "a.b", "3d", 3, None])
def test_a_name_that_no_option_could_have_is_refused(name: Any) -> None:
    with pytest.raises(ConfigError, match="must be letters, digits, - and _, and begin with a letter, not"):
        SENSORS.register(name, SENSORS.get("blind"))


def test_a_family_cannot_be_called_as_the_papers_world() -> None:
    with pytest.raises(ConfigError, match="'paper' is something else in world.name"):
        FAMILIES.register("paper", SPARSE)


WANTED = {
    "sensor": "an edqn_jax.Sensor",
    "family of random worlds": "an edqn_jax.Family, or a Mixture of some",
    "learner": "an edqn_jax.learn.learner.Learner",
    "network": r"the class of a flax module, or a function that makes one, of \(config, moves\)",
    "encoder": r"the class of a flax module, or a function that makes one, of \(config, height, width\)",
    "set of actions": "an edqn_jax.sim.task.action_sets.ActionSet",
    "kind of shape": "an edqn_jax.ShapeKind",
    "airframe": "the path of an MJCF file",
}


@pytest.mark.parametrize("registry", EVERY, ids=lambda registry: registry.kind)
@pytest.mark.parametrize(
    ("entry", "told"), [(None, "None"), (3, "3"), (Sensor, "the class Sensor"), (np.zeros(2), "an object of the type")]
)
def test_every_registry_says_what_an_entry_must_be(registry: Registry, entry: Any, told: str) -> None:
    with pytest.raises(ConfigError, match=f"^the {registry.kind} 'mine' must be {WANTED[registry.kind]}, not {told}"):
        registry.register("mine", entry)
    assert "mine" not in registry


@pytest.mark.parametrize("registry", EVERY, ids=lambda registry: registry.kind)
def test_every_built_in_entry_could_be_registered(registry: Registry) -> None:
    for name in list(registry):
        registry.register(f"my-{name}", registry.get(name))
        assert registry.get(f"my-{name}") is registry.get(name) or registry is AIRFRAMES


def test_an_airframe_is_a_path_or_its_text_and_must_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SKYDIO_X2.parent)
    AIRFRAMES.register("text", SKYDIO_X2.name)
    AIRFRAMES.register("path", Path(SKYDIO_X2.name))
    monkeypatch.chdir("/")
    assert AIRFRAMES.get("text") == AIRFRAMES.get("path") == SKYDIO_X2.resolve()
    with pytest.raises(ConfigError, match="and there is no file 'nowhere.xml'"):
        AIRFRAMES.register("nowhere", "nowhere.xml")


def _any(*_: Any) -> None: ...


@pytest.mark.parametrize(
    ("contract", "given", "says"),
    [
        (Sensor, (lambda config, scene: None,), r"^`show` of Sensor .* memory, key\), not one of \(config, scene\)$"),
        (Sensor, (None,), r"^`show` of Sensor must be a function \(.*\), not None$"),
        (Sensor, (_any, (3,)), r"^`shape` of Sensor must be a function \(config\), not an object of the type tuple$"),
        (Family, (lambda: None, (1.0, 1.0, 1.0)), r"^`draw` of Family must be .* \(key\), not one of \(\)$"),
        (Family, (_any, (1.0, 1.0)), "^`size` of Family must be three lengths above 0"),
        (Family, (_any, (1.0, 1.0, 1.0), 0.0), "^`edge_m` of Family must be metres above 0, or None"),
        (Mixture, ({"sparse": 0},), "^`shares` of Mixture must be whole numbers above 0"),
        (Mixture, (["sparse"],), "^`shares` of Mixture must be"),
        (ActionSet, (3, 0, _any, _any), "^`space` of ActionSet must be Discrete or Box, not 3"),
        (ActionSet, (Discrete(2), np.int32(2), _any, _any), "^`still` of ActionSet must be a whole number from 0 to 1"),
        (ActionSet, (Box(-1.0, 1.0, (1,)), np.zeros(1), lambda a: a, _any), r"^`command` of .*, not one of \(a\)$"),
    ],
)
def test_what_is_wrong_in_an_entry_is_said_where_it_is_made(contract: Any, given: tuple[Any, ...], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        contract(*given)


def test_functions_of_a_learner_are_checked_and_any_that_fits_is_taken() -> None:
    with pytest.raises(ConfigError, match=r"`decide` of Learner must be a function .*, not one of \(params, memory\)"):
        dataclasses.replace(DQN, decide=lambda params, memory: memory)
    wrapped = functools.partial(lambda more, config, params, memory, last=0: memory, 1)
    assert dataclasses.replace(DQN, decide=wrapped).decide is wrapped
    LEARNERS.register("mine", dataclasses.replace(DQN, decide=lambda *_: jnp.zeros(())))


class Pooled(nn.Module):
    def __call__(self, a: Any, b: Any) -> Any:
        return a + b


def test_what_makes_a_network_is_checked_before_and_after() -> None:
    with pytest.raises(ConfigError, match=r"the network 'x' must be .*\(config, moves\), not one of \(config\)"):
        NETWORKS.register("x", lambda config: None)
    with pytest.raises(ConfigError, match=r"the encoder 'x' must be .*, not the class int"):
        ENCODERS.register("x", int)
    NETWORKS.register("x", lambda config, moves: None)
    with pytest.raises(ConfigError, match="the network 'x' must be a flax module, and what makes it returned None"):
        init_q(AgentConfig(network="x"), 3, 27, jax.random.key(0))
    NETWORKS.register("y", lambda config, moves: Pooled())
    with pytest.raises(ConfigError, match=r"`__call__` of the network 'y' must be .*\(x\), not one of \(a, b\)"):
        init_q(AgentConfig(network="y"), 3, 27, jax.random.key(0))
    ENCODERS.register("x", lambda config, height, width: (height, width))
    with pytest.raises(ConfigError, match="the encoder 'x' must be a flax module, and what makes it returned an obj"):
        vae.init_vae(EncoderConfig(architecture="x"), CameraConfig(), jax.random.key(0))
