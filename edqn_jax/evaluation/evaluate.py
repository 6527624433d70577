"""Evaluates a policy greedily on missions of any world."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from edqn_jax.config import EXACT, Config
from edqn_jax.config.loading import Layer, with_conditions
from edqn_jax.devices.forks import check_not_forked
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.decoder import check_predicts_distance, summarise_errors
from edqn_jax.evaluation.metrics import shortest_paths, summarise_flights
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.places import Point
from edqn_jax.evaluation.rollouts import ShowPhase, fly_on_all_devices, show_nothing
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import Function, FunctionPolicy, actor_of, as_policy, config_of
from edqn_jax.policies.unseen import describe_unseen
from edqn_jax.sim.sensors.sensor import sensor_of
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.watchers import shown_phases


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Flights of M missions, and their figures."""

    missions: MissionSet
    flights: Flights
    """Arrays on the host: outcome [M], decisions [M], path_length_m [M] and so on; `record` has every pose, positions
    [M, T, 3] metres, NaN after a flight's end, if it was asked for."""
    figures: dict[str, Any]
    """Success rate with its 95 % Wilson interval, SPL, collisions and so on, see `metrics.summarise_flights`."""

    @property
    def success_rate(self) -> float:
        """Share of the missions that reached the goal."""
        return self.figures["success_rate"]

    @property
    def outcomes(self) -> list[str]:
        """How each flight ended: `goal`, `collision`, `left_volume`, `time_out` or `diverged`."""
        return [Outcome(int(kind)).name.lower() for kind in self.flights.outcome]

    def path(self, mission: int = 0) -> np.ndarray:
        """Returns the positions [T, 3] metres of one recorded flight, one after each physics step.

        Raises:
            ConfigError: if the flights were not recorded.
        """
        if self.flights.record is None:
            raise ConfigError("these flights were not recorded; evaluate with record=True")
        return np.asarray(self.flights.record.position[mission])[: int(self.flights.physics_steps[mission])]


@as_tested
def evaluate(
    policy: Policy | FunctionPolicy | Function,
    world: str | Path | None = None,
    *,
    missions: int = 1,
    seed: int = 0,
    start: Point | None = None,
    goal: Point | None = None,
    record: bool = False,
    shuffle_codes: bool = False,
    decoder: bool = False,
    conditions: Layer | None = None,
    phase: ShowPhase | None = None,
    announce: Callable[[MissionSet], None] = lambda _: None,
) -> Evaluation:
    """Flies a policy greedily, every mission once, and measures.

    Args:
        policy: from `train` or `load_policy`; or any function of an observation, a memory and a key that returns an
            action and the memory, see `FunctionPolicy`.
        world: `paper`, the name of random worlds (`config.FAMILIES`) or an MJCF file; None is where it was
            trained, of random worlds the test worlds.
        missions: how many. One in a world from a file goes from its start to its goal, more begin at random free
            points; in random worlds each has a test world of its own, which training never uses; of several drones
            (`env.drones`) each group has one.
        seed: which missions.
        start, goal: of every mission, metres, in place of the world's.
        record: keep every pose.
        shuffle_codes: give each drone the observation of another one's sensor at each decision.
        decoder: also measure the error of the distances that the policy's decoder predicts: `figures["decoder"]`, see
            `decoder.summarise_errors`. True distances are then rendered at every decision.
        conditions: wind and other disturbances, and drones, in place of the policy's own, by group, such as
            `{"air": {"gusts_m_s": 5.0}}`; see `config.CONDITIONS`.
        phase: called with the name of each phase as it begins, such as `compiling`, and while it flies with how many
            missions have ended, of how many. Without it a terminal shows them with a clock.
        announce: called with the missions before they are flown; their `note` says what the policy never met.

    Raises:
        ConfigError: if there is no such world or condition, the missions cannot be flown, the policy cannot fly, or
            there is nothing to shuffle, or no decoder that predicts distance.
    """
    check_not_forked()
    policy = as_policy(policy, world)
    config = with_conditions(config_of(policy), conditions or {}, "evaluate")
    if shuffle_codes:
        _check_can_shuffle(config, missions)
    actor = actor_of(policy, config)
    if decoder:
        check_predicts_distance(config, actor)
    with shown_phases(phase) as told:
        show = told or show_nothing
        show("preparing worlds")
        loaded = load_missions(config, str(world or config.world.name), missions, seed, start, goal)
        mission_set = note_unseen(policy, config, loaded)
        announce(mission_set)
        flights = fly_on_all_devices(
            config,
            mission_set.env_params,
            policy.params,
            seed,
            actor=actor,
            record=record,
            shuffle_codes=shuffle_codes,
            decoder_errors=decoder,
            phase=told,
        )
        show("shortest paths")
        shortest = shortest_paths(config, mission_set.env_params, np.asarray(flights.outcome) == Outcome.GOAL)
    return Evaluation(mission_set, flights, _figures(config, flights, shortest))


def evaluate_look(
    policy: Policy, world: str | None, look: str, *, missions: int = 1, seed: int = 0, exact: bool = False
) -> Evaluation:
    """Flies a policy as `evaluate` does where all surfaces have one look, and measures its decoder if it has one.

    Args:
        policy: as of `evaluate`.
        world: as of `evaluate`.
        look: `surface.pattern`.
        missions: how many.
        seed: which missions.
        exact: whether without the disturbances of the policy's training, see `config.EXACT`.
    """
    conditions = {"surface": {"pattern": look}, **(EXACT if exact else {})}
    decoder = embedding.needs_nearness(policy.config)
    return evaluate(policy, world, missions=missions, seed=seed, decoder=decoder, conditions=conditions)


def _figures(config: Config, flights: Flights, shortest: np.ndarray) -> dict[str, Any]:
    """Returns the figures of flights, with the decoder's error where it was measured."""
    figures = summarise_flights(flights, shortest, config.env.drones)
    if flights.decoder_errors is not None:
        figures["decoder"] = summarise_errors(np.asarray(flights.decoder_errors), int(np.sum(flights.decisions)))
    return figures


def note_unseen(policy: Policy | FunctionPolicy, config: Config, missions: MissionSet) -> MissionSet:
    """Returns missions whose note also says what the policy was not trained with; nothing is known of a function."""
    if isinstance(policy, FunctionPolicy):
        return missions
    unseen = describe_unseen(policy.config, config, None if missions.file is None else missions.scene())
    return dataclasses.replace(missions, note="\n".join(filter(None, (missions.note, *unseen))) or None)


def _check_can_shuffle(config: Config, missions: int) -> None:
    least = 2 * len(jax.devices())
    if missions < least:
        raise ConfigError(f"--shuffle-codes needs --missions of at least {least}, not {missions}")
    if not sensor_of(config).shapes(config):
        raise ConfigError(f"--shuffle-codes has nothing to shuffle: the sensor '{config.env.sensor}' shows nothing")
