"""The package's own programs do small work in C, and know it where they are traced and lowered."""

from __future__ import annotations

import dataclasses
import gc
import shutil
import threading
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from edqn_jax.evaluation import rollouts
from edqn_jax.kept_programs import Place
from edqn_jax.learn.actor import AgentActor
from edqn_jax.learn.perception import patches
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.learn.step import train_step
from edqn_jax.learn.trainer import Trainer
from edqn_jax.native import adam, threefry
from edqn_jax.native.own_programs import without_collection
from tests.support.configs import TINY
from tests.support.miniature import miniature_world

CONFIG = dataclasses.replace(TINY, camera=dataclasses.replace(TINY.camera, width=8, height=8))
"""Images that can be cut into whole patches."""

HAS_COMPILER = shutil.which("cc") is not None


def done_in_c(program: jax.stages.Lowered) -> list[bool]:
    """Returns whether a program draws its random bits in C, cuts its patches, and takes steps of its optimisers."""
    return [f"@{target}" in program.as_text() for target in (threefry.TARGET, patches.TARGET, adam.TARGET)]


def test_training_draws_cuts_and_steps_in_c() -> None:
    trainer = Trainer(CONFIG, miniature_world(CONFIG), jax.devices()[:2])
    trainer.trace()
    assert trainer._traced is not None and done_in_c(trainer._traced) == [HAS_COMPILER] * 3


def test_flights_of_the_agent_draw_and_cut_in_c() -> None:
    mesh, world = Mesh(np.asarray(jax.devices()[:2]), ("mission",)), miniature_world(CONFIG)
    params, program = fresh_policy(CONFIG), rollouts._Program(CONFIG, AgentActor(CONFIG), rollouts.Extras())
    begin, fly_on, _ = rollouts._lower(Place(None), program, mesh, world, params, jax.random.key(0))
    found = [done_in_c(each) for each in (begin, fly_on)]
    assert [any(each) for each in zip(*found, strict=True)] == [HAS_COMPILER, HAS_COMPILER, False]


def test_the_first_state_is_made_on_one_device_and_draws_in_c(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []

    def compiled(place: Place, trace: Callable[[], list[jax.stages.Lowered]], devices: list[Any]) -> object:
        found.append((trace()[0], devices))
        return [lambda *_: None]

    monkeypatch.setattr(Place, "load_or_compile", compiled)
    Trainer(CONFIG, miniature_world(CONFIG), jax.devices()[:2]).trace_first()()
    [(program, devices)] = found
    assert devices == jax.devices()[:1] and done_in_c(program)[0] is HAS_COMPILER


def test_no_garbage_is_collected_until_the_last_of_those_that_trace_has_ended() -> None:
    assert gc.isenabled()
    inside, others_done = threading.Event(), threading.Event()

    def another() -> None:
        with without_collection():
            inside.set()
            others_done.wait(60)

    thread = threading.Thread(target=another)
    with without_collection():
        thread.start()
        assert inside.wait(60) and not gc.isenabled()
    still_off = not gc.isenabled()  # another thread traces on
    others_done.set()
    thread.join(60)
    assert still_off and gc.isenabled()


def test_collection_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        with without_collection(), without_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_large_programs_are_traced_without_collection(monkeypatch: pytest.MonkeyPatch) -> None:
    collects = []

    def step(*args: Any) -> Any:
        collects.append(gc.isenabled())
        return train_step(*args)

    monkeypatch.setattr("edqn_jax.learn.step.train_step", step)
    Trainer(CONFIG, miniature_world(CONFIG), jax.devices()[:1]).trace()
    assert collects == [False] and gc.isenabled()
