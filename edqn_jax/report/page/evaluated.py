"""A run or a policy as the page shows it: what its folder says, and its evaluation flights, flown anew."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edqn_jax.config import FAMILIES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import MissionSet, final_missions
from edqn_jax.evaluation.rollouts import ShowPhase, fly_on_all_devices
from edqn_jax.learn.actor import Actor, AgentActor, PolicyParams
from edqn_jax.learn.policy import Policy
from edqn_jax.policies import policy_folder
from edqn_jax.policies.functions import FunctionPolicy, actor_of, config_of
from edqn_jax.runs.directory import SEED_FOLDER, RunDirectory, config_text
from edqn_jax.runs.policies import load_run, worlds_replaced
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome


@dataclasses.dataclass(frozen=True)
class EvaluatedRun:
    """A run and its evaluation flights."""

    name: str
    """The end of its path, by which the page calls it."""
    config: Config
    config_text: str
    """`config.yaml` as it stands in the folder."""
    params: PolicyParams | None
    """None of a function."""
    missions: MissionSet
    flights: Flights
    """On the host, recorded."""
    summary: dict[str, Any]
    """`summary.json`; {} of an unfinished run and of a policy by itself."""
    metrics: list[dict[str, Any]]
    episodes: dict[str, np.ndarray]
    notes: list[str]
    """What was decided for the reader, as sentences."""

    @property
    def outcomes(self) -> list[str]:
        """How each flight ended, in words."""
        return [Outcome(int(kind)).name.lower() for kind in self.flights.outcome]


def folders_of(run: Path) -> list[Path]:
    """Returns the folder of a run, or those of its seeds where several were trained together."""
    run = policy_folder(run)
    seeds = [folder for folder in run.glob(f"{SEED_FOLDER}*/") if folder.name.removeprefix(SEED_FOLDER).isdigit()]
    return sorted(seeds, key=lambda folder: int(folder.name.removeprefix(SEED_FOLDER))) or [run]


def fly_run(
    folder: Path,
    name: str,
    most: int,
    message: Callable[[str], None] = lambda _: None,
    phase: ShowPhase | None = None,
) -> EvaluatedRun:
    """Reads a run and flies its evaluation missions anew, as at its end.

    Args:
        folder: of the run, or of a policy.
        name: what the page calls it.
        most: missions at most.
        message: told of what takes time.
        phase: called as a phase of it begins, and as flights end.

    Raises:
        ConfigError: if there is no run, its policy cannot be loaded, or a file of it is not as a run writes it.
    """
    config, params = load_run(folder)
    run = RunDirectory(folder)
    try:
        text = run.config_file.read_text(encoding="utf-8")
        summary = json.loads(run.summary_file.read_text(encoding="utf-8")) if run.summary_file.is_file() else {}
        metrics = run.read_metrics() if run.metrics_file.is_file() else []
        episodes = run.read_episodes() if run.episodes_file.is_file() else {}
        if not isinstance(summary, dict) or not all(isinstance(row, dict) for row in metrics):
            raise ValueError("something other than an object in a file of JSON")
    except (AttributeError, LookupError, OSError, RecursionError, TypeError, ValueError) as error:
        raise ConfigError(f"a file of the run in '{folder}' is not as a run writes it: {error}"[:300]) from None
    missions, flights = _evaluate(config, params, AgentActor(config), most, f"'{folder}'", message, phase)
    count, notes = len(flights.outcome), worlds_replaced(folder)
    notes += _chosen_by(config, count)
    if count < config.train.validation_missions:
        notes.append(f"{count} of the run's {config.train.validation_missions} evaluation flights are on this page.")
    ended = Outcome(int(flights.outcome[0])).name.lower()
    if summary.get("outcome", ended) != ended:
        notes.append(
            f"The last flight was recorded as {summary['outcome']} and ends as {ended} when it is flown here, where "
            "rounding is another."
        )
    return EvaluatedRun(name, config, text, params, missions, flights, summary, metrics, episodes, notes)


def _chosen_by(config: Config, flights: int) -> list[str]:
    """Returns a note where flights are those by which a policy was chosen: of one trained in a world from a file."""
    if config.world.name in FAMILIES or flights < 2 or config.train.keep != "best":
        return []
    return [
        "All flights but the first are of the training's validation, by which the policy was chosen among others; edqn "
        "evaluate flies others."
    ]


def fly_policy(
    policy: Policy | FunctionPolicy,
    name: str,
    most: int,
    message: Callable[[str], None] = lambda _: None,
    phase: ShowPhase | None = None,
) -> EvaluatedRun:
    """Flies a policy that no folder holds on the missions that a run of its configuration ends with.

    Args:
        policy: as `as_policy` returns it.
        name: what the page calls it.
        most: missions at most.
        message, phase: as in `fly_run`.

    Raises:
        ConfigError: if it cannot fly there.
    """
    config = config_of(policy)
    missions, flights = _evaluate(config, policy.params, actor_of(policy, config), most, f"'{name}'", message, phase)
    notes = _chosen_by(config, len(flights.outcome)) if isinstance(policy, Policy) else []
    return EvaluatedRun(name, config, config_text(config), policy.params, missions, flights, {}, [], {}, notes)


def _evaluate(
    config: Config,
    params: PolicyParams | None,
    actor: Actor,
    most: int,
    name: str,
    message: Callable[[str], None],
    phase: ShowPhase | None,
) -> tuple[MissionSet, Flights]:
    missions = final_missions(config, most)
    count = missions.env_params.missions.scene.shape[0]
    message(f"flying {count} mission{'' if count == 1 else 's'} of {name}")
    flights = fly_on_all_devices(
        config, missions.env_params, params, config.train.seed, actor=actor, record=True, phase=phase
    )
    return missions, flights


def names_of(folders: Sequence[Path]) -> list[str]:
    """Returns a name for each folder: as few of the last parts of its path as tell it from the others."""
    parts = [folder.absolute().parts for folder in folders]
    names: list[str] = []
    for length in range(1, max(map(len, parts), default=0) + 1):
        names = ["/".join(each[-length - each[-1].startswith(SEED_FOLDER) :]) for each in parts]
        if len(set(names)) == len(set(parts)):
            break
    return names
