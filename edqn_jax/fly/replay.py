"""A logged flight once more: the state machine and the policy on what was heard then, compared with what they did."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.fly.machine import State, step
from edqn_jax.fly.records import EVENTS, inputs_of, read_records, settings_of
from edqn_jax.fly.streams import EVENT, read_stream
from edqn_jax.fly.tally import events_at_pace
from edqn_jax.interop.deployment.runner import Runner


@dataclasses.dataclass(frozen=True)
class Replayed:
    """What a flight did once more."""

    ticks: int
    other_outputs: int
    """Ticks at which the state machine does something else than it did."""
    decisions: int
    other_moves: int
    """Decisions at which the policy chooses another move."""
    outcome: str


def replay(folder: Path, runner: Runner | None = None) -> Replayed:
    """Returns how a flight goes once more.

    Args:
        folder: of its log.
        runner: the policy; None leaves the decisions out.

    Raises:
        ConfigError: if there is no flight in the folder.
    """
    records = read_records(folder)
    begun = next((each for each in records if each["kind"] == "settings"), None)
    if begun is None:
        raise ConfigError(f"the flight in '{folder}' was cut off before it began")
    settings, state = settings_of(begun["settings"]), State()
    ticks = [each for each in records if each["kind"] == "tick"]
    other = 0
    for tick in ticks:
        state, output = step(state, inputs_of(tick["inputs"]), tick["now"], settings)
        velocity = None if output.velocity is None else list(output.velocity)
        other += state.phase != tick["phase"] or velocity != tick["output"]["velocity"]
    decisions = [each for each in records if each["kind"] == "decision"] if runner is not None else []
    moves = 0 if runner is None else _other_moves(folder, decisions, runner, begun["pace"])
    return Replayed(len(ticks), other, len(decisions), moves, state.outcome)


def _other_moves(folder: Path, decisions: list[dict], runner: Runner, pace: float) -> int:
    written = read_stream(folder / EVENTS)
    anew = np.flatnonzero(np.diff([until for until, _ in written]) < 0) + 1
    # The packets of each stretch in which the camera's clock did not begin anew, and their ends.
    stretches = [written[first:last] for first, last in itertools.pairwise([0, *anew, len(written)])]
    clocks = [(packets, np.array([until for until, _ in packets], np.int64)) for packets in stretches]
    (packets, ends), newest, other = clocks.pop(0), -1, 0
    for decision in decisions:
        if decision["fresh"]:
            runner.reset()
        asked = decision["asked"]
        until = asked["until_us"]
        while clocks and (until < newest or until > ends[-1]):
            (packets, ends), newest = clocks.pop(0), -1
        newest = until
        since = until - round(runner.window_us / pace)
        first, last = np.searchsorted(ends, [since, until + 1])
        held = np.concatenate([np.empty(0, EVENT), *(events for _, events in packets[first:last])])
        window = held[(held["t"] >= since) & (held["t"] < until)]
        other += runner.decide(events_at_pace(window, until, pace), **asked).move != decision["move"]
    return other
