"""The loop between camera, policy and vehicle on one page, to be copied where another camera or rule is needed.

    python examples/fly_loop.py policy.onnx tcp:127.0.0.1:7777 udpin:0.0.0.0:14540 40 0 3

flies to a goal 40 m east and 3 m up. What `edqn fly` has beside it: a log, a dry run, latencies, a slower pace, events
counted as they come. Nothing is armed; whatever goes wrong ends in hover, hold or land (docs/deployment.md).
"""

from __future__ import annotations

import dataclasses
import signal
import sys
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from edqn_jax.fly.clocks import Clock, WallClock
from edqn_jax.fly.faults import Command, Limits, Settings
from edqn_jax.fly.link import Link
from edqn_jax.fly.machine import Phase, State, step
from edqn_jax.fly.streams import EventSource, open_events
from edqn_jax.interop.deployment.runner import Runner

TICK_S = 0.02
CAMERA, FOV_DEG, CONTRAST = (346, 260), 70.0, 0.2
VOLUME = ((-5.0, -20.0, 0.0), (60.0, 20.0, 10.0))
"""Lowest and highest corner of where it may fly, metres east, north and up of where it began; its fence, too."""


def fly(
    runner: Runner,
    link: Link,
    source: EventSource,
    clock: Clock,
    settings: Settings,
    volume: ArrayLike,
    stop: Callable[[], bool] = lambda: False,
) -> str:
    """Flies one mission and returns how it ended: `goal`, `refused: ...`, or a fault."""
    state, command, due, tick = State(), None, 0.0, clock.now()
    try:
        while state.phase is not Phase.ENDED:
            now = clock.now()
            source.read(now)
            link.read(now)
            events = source.events
            inputs = dataclasses.replace(
                link.inputs(),
                packet_at=events.packet_at,
                rate_hz=events.rate_hz(now),
                darkening=events.darkening(now),
                camera=events.size,
                stop=stop(),
                command=command,
            )
            before = state.phase
            state, output = step(state, inputs, now, settings)
            if state.phase in (Phase.READY, Phase.FLYING) and before is not state.phase:
                link.forget_masters()  # who steered before is none of the flight
            if state.phase is Phase.FLYING and before is not Phase.FLYING:
                runner.reset()  # the policy has seen nothing yet
                due, command = now, None
            if output.decides and now >= due:
                due = max(due + settings.period_s, now)
                command = decide(runner, link, source, now, settings, volume) or command
                state, output = step(state, dataclasses.replace(inputs, command=command), clock.now(), settings)
            link.send(output.velocity, output.yaw, now)  # 50 times a second, the last command or zero
            if output.request is not None:
                link.request(output.request)
            for said in link.said:
                print(said)
            link.said.clear()
            tick = max(tick + TICK_S, clock.now())
            clock.sleep_until(tick)
    except BaseException:
        if state.phase in (Phase.FLYING, Phase.HOVERING):
            link.request("hold")
        raise
    return state.outcome


def decide(
    runner: Runner, link: Link, source: EventSource, now: float, settings: Settings, volume: ArrayLike
) -> Command | None:
    """Returns what the policy wants of the newest events and the newest odometry; None before there are both."""
    own, events = link.own(now), source.events
    if own is None or events.offset.value is None:
        return None
    until = events.until_us
    seen_at = 1e-6 * until + events.offset.value  # on the host's clock
    wanted = runner.decide(
        events.window(until - runner.window_us, until),
        until_us=until,
        position=own.odometry.position,
        quaternion=own.quaternion,
        velocity=own.odometry.velocity,
        yaw_rate=own.yaw_rate,
        goal=settings.goal,
        volume=volume,
        attitudes=[link.attitude_at(seen_at + 1e-6 * time) for time in runner.about["frame_times_us"]],
    )
    return Command(now, np.asarray(wanted.velocity, np.float64), wanted.yaw)


if __name__ == "__main__":
    policy, camera, vehicle, *goal = sys.argv[1:]
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: asked.append(number))
    pilot = Runner(policy, camera=CAMERA, camera_fov_deg=FOV_DEG, contrast=CONTRAST)
    limits = Limits(darkening=0.4 / CONTRAST)  # OFF events a pixel of a picture that goes dark
    task = Settings(np.array(goal, float), np.array(VOLUME), CAMERA, pilot.period_s, limits=limits)
    print(fly(pilot, Link(vehicle), open_events(camera, CAMERA), WallClock(), task, VOLUME, lambda: bool(asked)))
