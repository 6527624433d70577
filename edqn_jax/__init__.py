"""Train drones to fly through unknown obstacles from simulated events, in one compiled JAX program.

The names below are public; they are loaded when first used, so that importing this package imports neither JAX nor
MuJoCo. It configures one thing: XLA's flags, so that sums on CPUs are right (docs/decisions/0028). Everything else may
change between versions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edqn_jax.xla_flags import disable_ynn_fusions

if TYPE_CHECKING:
    from edqn_jax.cli.process.status import show_phases
    from edqn_jax.config import (
        ACTION_SETS,
        AIRFRAMES,
        ENCODERS,
        FAMILIES,
        LEARNERS,
        NETWORKS,
        SENSORS,
        SHAPES,
        Config,
    )
    from edqn_jax.config.loading import make_config
    from edqn_jax.devices.devices import use_cpu_devices
    from edqn_jax.errors import ConfigError, DivergedError, StoppedError
    from edqn_jax.evaluation.evaluate import Evaluation, evaluate
    from edqn_jax.interop.flight_files import record
    from edqn_jax.learn.policy import Policy
    from edqn_jax.planning.astar import plan
    from edqn_jax.planning.path import PlannedPath
    from edqn_jax.policies.functions import FunctionPolicy
    from edqn_jax.report.page.document import write_report
    from edqn_jax.report.worlds.flights import draw_map
    from edqn_jax.runs.policies import load_policy, save_policy
    from edqn_jax.sim.actions import move_name, move_number
    from edqn_jax.sim.environment import Environment, make
    from edqn_jax.sim.scene.shapes.kind import ShapeKind
    from edqn_jax.sim.sensors.sensor import Sensor
    from edqn_jax.sim.task.outcomes import Outcome
    from edqn_jax.sim.task.reward import Transition
    from edqn_jax.sim.worlds.families import Family
    from edqn_jax.training.loop import Chunk, TrainingResult, train, train_seeds

_MODULES = {
    "ACTION_SETS": "config",
    "AIRFRAMES": "config",
    "ENCODERS": "config",
    "FAMILIES": "config",
    "LEARNERS": "config",
    "NETWORKS": "config",
    "SENSORS": "config",
    "SHAPES": "config",
    "Chunk": "training.loop",
    "Config": "config",
    "ConfigError": "errors",
    "DivergedError": "errors",
    "Environment": "sim.environment",
    "Evaluation": "evaluation.evaluate",
    "Family": "sim.worlds.families",
    "FunctionPolicy": "policies.functions",
    "Outcome": "sim.task.outcomes",
    "PlannedPath": "planning.path",
    "Policy": "learn.policy",
    "Sensor": "sim.sensors.sensor",
    "ShapeKind": "sim.scene.shapes.kind",
    "StoppedError": "errors",
    "TrainingResult": "training.loop",
    "Transition": "sim.task.reward",
    "draw_map": "report.worlds.flights",
    "evaluate": "evaluation.evaluate",
    "load_policy": "runs.policies",
    "make": "sim.environment",
    "make_config": "config.loading",
    "move_name": "sim.actions",
    "move_number": "sim.actions",
    "plan": "planning.astar",
    "record": "interop.flight_files",
    "save_policy": "runs.policies",
    "show_phases": "cli.process.status",
    "train": "training.loop",
    "train_seeds": "training.loop",
    "use_cpu_devices": "devices.devices",
    "write_report": "report.page.document",
}
"""The module of each public name."""

__all__ = [
    "ACTION_SETS",
    "AIRFRAMES",
    "ENCODERS",
    "FAMILIES",
    "LEARNERS",
    "NETWORKS",
    "SENSORS",
    "SHAPES",
    "Chunk",
    "Config",
    "ConfigError",
    "DivergedError",
    "Environment",
    "Evaluation",
    "Family",
    "FunctionPolicy",
    "Outcome",
    "PlannedPath",
    "Policy",
    "Sensor",
    "ShapeKind",
    "StoppedError",
    "TrainingResult",
    "Transition",
    "__version__",
    "draw_map",
    "evaluate",
    "load_policy",
    "make",
    "make_config",
    "move_name",
    "move_number",
    "plan",
    "record",
    "save_policy",
    "show_phases",
    "train",
    "train_seeds",
    "use_cpu_devices",
    "write_report",
]

__version__: str


def __getattr__(name: str) -> Any:
    """Loads a public name when it is first used (PEP 562)."""
    from importlib import import_module

    if name == "__version__":
        value: Any = import_module(f"{__name__}.version").package_version()
    elif name in _MODULES:
        value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    else:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)


disable_ynn_fusions()
