"""Replay as a plain list of all transitions; n-step transitions are found by walking along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edqn_jax.sim.task.outcomes import Outcome


@dataclass
class Row:
    """One decision of one environment."""

    observation: NDArray
    reward: float
    outcome: int
    is_reset: bool
    action: int


@dataclass
class Transition:
    history: NDArray
    action: int
    returns: float
    discount: float
    next_history: NDArray
    weight: float


def seen(rows: list[Row], now: int, length: int) -> NDArray:
    """The newest `length` observations of the episode that row `now` belongs to, zeros before it began."""
    begin = now
    while begin > 0 and not rows[begin].is_reset:
        begin -= 1
    episode = [row.observation for row in rows[begin : now + 1]]
    blank = [np.zeros_like(episode[0])] * length
    return np.stack((blank + episode)[-length:])


def transition(rows: list[Row], start: int, n: int, discount: float, history: int) -> Transition:
    """Act at `start`, collect rewards until something ends the episode or n steps are over."""
    total, now = 0.0, start
    terminal = False
    if rows[start].outcome == Outcome.RUNNING:
        for k in range(n):
            now += 1
            total += discount**k * rows[now].reward
            if rows[now].outcome != Outcome.RUNNING:
                terminal = rows[now].outcome != Outcome.TIME_OUT
                break
    return Transition(
        history=seen(rows, start, history),
        action=rows[start].action,
        returns=total,
        discount=0.0 if terminal else discount ** (now - start),
        next_history=seen(rows, now, history),
        weight=float(rows[start].outcome == Outcome.RUNNING and rows[now].outcome != Outcome.DIVERGED),
    )
