"""Rows of `worth.py`: policies are trained, and fly the same test missions in every condition of an axis."""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import success
from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer, to_yaml
from edqn_jax.config.rules import validate
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import actor_of
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.surface import PATTERNS
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.outcomes import Outcome
from measurement import json_report
from worth_parts.axes import AXES, Layer, Place, flown_of


def measure_row(config: Config, place: Place, args: argparse.Namespace, folder: Path) -> success.Row:
    """Trains the seeds of a row, saves their policies in `folder`, flies every condition, and returns the row."""
    began, known = time.perf_counter(), (folder / success.TRAINED).is_file()
    policies, training = success.trained(config, args.seeds, folder)
    began -= training["seconds"] if known else 0.0
    flown = outcomes_of(config, policies, flown_of(AXES[args.axis], place.sensor), args.missions, args.test_seed)
    return {
        "benchmark": "worth",
        "axis": args.axis,
        "world": place.world,
        "trained": place.trained,
        "sensor": place.sensor,
        "missions": args.missions,
        "test_seed": args.test_seed,
        "decisions": training["decisions"],
        "seeds": [policy.config.train.seed for policy in policies],
        "outcomes": {int(outcome): outcome.name.lower() for outcome in Outcome},
        "flown": flown,
        "train_seconds": training["train_seconds"],
        "row_seconds": time.perf_counter() - began,
        "commit": success.commit(),
        "options": to_yaml(config),
        "training": training,
        **json_report.machine(jax.devices()),
    }


def outcomes_of(
    config: Config, policies: Sequence[Policy], layers: Mapping[str, Layer], missions: int, seed: int
) -> dict[str, list[str]]:
    """Returns by condition the outcomes of each policy's missions, a digit of `Outcome` for each.

    Conditions that one program can fly are flown together: it is compiled once.

    Args:
        config: of the row.
        policies: of its seeds.
        layers: by condition, what is otherwise than in training.
        missions: in each condition; the same for all of them, and for all rows of a world.
        seed: of the test worlds: `missions` of them from the `seed` x `missions`-th on.

    Raises:
        ConfigError: if a condition is invalid, or the policies cannot fly in it.
    """
    groups: dict[Any, list[tuple[str, EnvParams]]] = {}
    for name, layer in layers.items():
        there = apply_layer(config, layer, name)
        validate(there, trains=False)
        course = with_any_pattern(load_missions(there, config.world.name, missions, seed).env_params)
        # What the worlds are made by is in their arrays, and is no part of the program that flies them.
        alike = dataclasses.replace(there, world=config.world, surface=config.surface)
        groups.setdefault((alike, jax.tree.structure(course)), []).append((name, course))
    found = {}
    for (flown, _), members in groups.items():
        names, course = [name for name, _ in members], join_courses([course for _, course in members])
        of_policies = [
            fly_on_all_devices(flown, course, policy.params, actor=actor_of(policy, flown)).outcome
            for policy in policies
        ]
        by_seed = np.stack(of_policies).reshape(len(policies), len(names), missions)
        for number, name in enumerate(names):
            found[name] = ["".join(map(str, map(int, one))) for one in by_seed[:, number]]
    return {name: found[name] for name in layers}


def with_any_pattern(course: EnvParams) -> EnvParams:
    """Returns missions whose surfaces may have any pattern, so that one program flies all looks; plaid has none."""
    pool = course.pool
    looks = {
        kind: dataclasses.replace(shapes, surface=dataclasses.replace(shapes.surface, patterns=PATTERNS))
        for kind, shapes in pool.shapes().items()
        if getattr(shapes, "surface", None) is not None
    }
    return dataclasses.replace(course, pool=pool.with_shapes(looks)) if looks else course


def join_courses(courses: Sequence[EnvParams]) -> EnvParams:
    """Returns the missions of several pools of worlds, whose arrays are alike, one after the other."""

    def joined(*leaves: Any) -> Any:
        return jnp.asarray(np.concatenate([np.asarray(leaf) for leaf in leaves]))

    pool: Scene = jax.tree.map(joined, *[course.pool for course in courses])
    missions = jax.tree.map(joined, *[course.missions for course in courses])
    first = np.cumsum([0, *(course.pool.start.shape[0] for course in courses[:-1])])
    scene = np.concatenate(
        [np.asarray(course.missions.scene) + begins for course, begins in zip(courses, first, strict=True)]
    )
    missions = dataclasses.replace(missions, scene=jnp.asarray(scene, jnp.int32))
    return dataclasses.replace(courses[0], pool=pool, missions=missions)
