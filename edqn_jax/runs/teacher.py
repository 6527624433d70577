"""The learner `imitation`, whose teacher is the policy of a run: loaded once, and checked against the student."""

from __future__ import annotations

import functools
from pathlib import Path

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.learn.imitation.learner import imitation_of
from edqn_jax.learn.learner import Teacher
from edqn_jax.policies import no_run, policy_folder
from edqn_jax.runs.continuation import option_differences
from edqn_jax.runs.policies import load_policy, policy_digest
from edqn_jax.sim.sensors.sensor import has_clock
from edqn_jax.sim.task.observation import leans

ALIKE = (
    *("env.actions", "env.speed_m_s", "env.position", "env.heading", "env.action_delay"),
    *("drone.airframe", "drone.physics_steps", "drone.physics_dt_s"),
)
"""Options beside those of the camera that a teacher must share with its student: own state and commands."""


def load_teacher(config: Config) -> Teacher:
    """Returns the policy that `imitation.teacher` names.

    Raises:
        ConfigError: if there is none, it has another sensor than `depth`, or it sees or commands otherwise than the
            student.
    """
    name = config.imitation.teacher
    folder = Path(name)
    if not (policy_folder(folder) / "config.yaml").is_file():
        raise no_run(folder)
    teacher = _loaded(folder.absolute() if folder.is_dir() else folder, policy_digest(folder))
    sensor = teacher.config.env.sensor
    if sensor != "depth":
        raise ConfigError(f"imitation.teacher must be a policy of the sensor depth; '{name}' is one of '{sensor}'")
    differ = [
        option
        for option in option_differences(teacher.config, config)
        if option in ALIKE or option.startswith("camera.")
    ]
    if differ:
        said = "; ".join(f"{each} is {_of(teacher.config, each)} and here {_of(config, each)}" for each in differ)
        raise ConfigError(f"imitation.teacher must see and command as its student does; of '{name}' {said}")
    if leans(config) and has_clock(config):
        raise ConfigError("exposure.rate_hz and exposure.latency_s must be 0 with imitation and camera.mount body")
    return teacher


@functools.cache
def _loaded(folder: Path, digest: str) -> Teacher:
    """Returns the policy of a folder; one with another digest is loaded anew."""
    policy = load_policy(folder)
    return Teacher(policy.config, policy.params)


def _of(config: Config, name: str) -> object:
    group, option = name.split(".")
    return getattr(getattr(config, group), option)


IMITATION = imitation_of(load_teacher)
