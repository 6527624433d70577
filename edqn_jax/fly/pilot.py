"""Flies a policy: the loop between camera, policy and vehicle. To be read, and copied where another one is needed."""

from __future__ import annotations

import dataclasses
import gc
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from edqn_jax.fly.clocks import Clock
from edqn_jax.fly.faults import Command, Inputs, Settings
from edqn_jax.fly.link import Link
from edqn_jax.fly.machine import Output, Phase, State, step
from edqn_jax.fly.records import FlightLog
from edqn_jax.fly.streams import EventSource
from edqn_jax.fly.tally import Tally, events_at_pace
from edqn_jax.interop.deployment.runner import Runner
from edqn_jax.interop.recordings.lens import Lens

TICK_S = 0.02
"""Setpoints are sent at 50 Hz."""

PATIENCE_S = 0.012
"""A decision waits for the camera's next packet, so that it is made on events that are new, if that is to be expected
within this."""

LATE_S = 0.003
"""For so long after it was expected it is waited for."""

GAP_S = 0.1
"""Longer gaps between setpoints are counted; PX4 leaves offboard mode after 0.5 s."""


@dataclasses.dataclass
class Latency:
    """Milliseconds from the newest event to the setpoint on the wire, of each decision, and its parts."""

    age: list[float] = dataclasses.field(default_factory=list)
    """From when the camera knew of its newest event to when it was read."""
    read: list[float] = dataclasses.field(default_factory=list)
    """Taking events and telemetry from their sockets."""
    decide: list[float] = dataclasses.field(default_factory=list)
    """Counting the events of the window, and the network."""
    send: list[float] = dataclasses.field(default_factory=list)
    rest: list[float] = dataclasses.field(default_factory=list)
    """The state machine and the log."""

    def percentiles(self) -> dict[str, tuple[float, float]]:
        """Returns median and 99th percentile of each part, and of their sum without `age` as `computing`."""
        parts = {field.name: np.array(getattr(self, field.name)) for field in dataclasses.fields(self)}
        parts["computing"] = parts["read"] + parts["decide"] + parts["send"] + parts["rest"]
        parts["all"] = parts["computing"] + parts["age"]
        return {
            name: (float(np.median(each)), float(np.percentile(each, 99))) for name, each in parts.items() if each.size
        }


@dataclasses.dataclass(frozen=True)
class Report:
    """How a flight went."""

    outcome: str
    seconds: float
    """From the first decision to the end."""
    decisions: int
    latency: Latency
    longest_gap_s: float
    """Between two setpoints of the flight."""
    gaps: int
    """How many of those between setpoints were longer than `GAP_S`."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What is flown."""

    settings: Settings
    """Of the state machine; their `period_s` is the policy's over `pace`."""
    volume: ArrayLike
    """[2, 3] that the policy is told: lowest and highest corner, metres."""
    pace: float = 1.0
    """Share of the policy's speed that is flown, with all its times as much longer: it cannot tell, and the vehicle
    needs only the square of it of the acceleration."""
    dry: bool = False
    """A bench test: decides and sends zero velocity, and asks for no mode."""
    fov_deg: float | None = None
    """Of the camera, as the runner was told; for the log, as `contrast`."""
    contrast: float | None = None
    lens: Lens | None = None


class Pilot:
    """One flight."""

    def __init__(
        self,
        runner: Runner,
        link: Link,
        source: EventSource,
        clock: Clock,
        task: Task,
        *,
        log: FlightLog | None = None,
        stop: Callable[[], bool] = lambda: False,
        tell: Callable[[str], None] = print,
    ) -> None:
        """Prepares a flight.

        Args:
            runner: the policy.
            link: to the vehicle.
            source: of events.
            clock: the host's.
            task: what is flown.
            log: where everything is written.
            stop: says whether the process was asked to stop.
            tell: takes each sentence for people.
        """
        self.runner, self.link, self.source, self.clock = runner, link, source, clock
        self.settings, self._volume = task.settings, np.asarray(task.volume)
        self._pace, self._dry = task.pace, task.dry
        self._camera = {"fov": task.fov_deg, "contrast": task.contrast, "lens": task.lens}
        self._log, self._stop, self._tell = log, stop, tell
        self.state = State()
        self.latency = Latency()
        self._command: Command | None = None
        self._tally, self._counted_us = Tally(runner, task.pace), -1
        self._due, self._written_us = 0.0, -1
        self._flying_at: float | None = None
        self._sent_at: float | None = None
        self._gap_s, self._gaps, self._fresh = 0.0, 0, True

    def fly(self) -> Report:
        """Flies until it has ended."""
        if self._log is not None:
            about = self.runner.about
            self._log.write("settings", settings=self.settings, pace=self._pace, **self._camera, about=about)
        gc.collect()
        gc.freeze()  # what lives now is not looked through again in flight, which takes 10 ms and more
        began, ticks = self.clock.now(), 0
        try:
            while self.state.phase is not Phase.ENDED:
                self.tick()
                ticks = max(ticks + 1, int((self.clock.now() - began) / TICK_S))
                self.clock.sleep_until(began + ticks * TICK_S)
        except BaseException:
            if self.state.phase in (Phase.FLYING, Phase.HOVERING) and not self._dry:
                self.link.request("hold")
            self._report("cut off")
            raise
        finally:
            gc.unfreeze()
        return self._report(self.state.outcome)

    def _report(self, outcome: str) -> Report:
        """Returns how the flight went, and logs it."""
        seconds = 0.0 if self._flying_at is None else self.clock.now() - self._flying_at
        if self._log is not None:
            self._log.write("end", outcome=outcome, seconds=seconds, latency=self.latency.percentiles())
        return Report(outcome, seconds, len(self.latency.decide), self.latency, self._gap_s, self._gaps)

    def tick(self) -> None:
        """Reads, decides where it is time to, and sends."""
        awoke, now = time.perf_counter(), self.clock.now()
        self._read(now)
        if self.clock.passes and self.state.phase is Phase.FLYING and now >= self._due - 1e-6:
            awoke, now = self._await_packet()
        read_at = now
        read_s = time.perf_counter() - awoke
        inputs = self._inputs()
        before = self.state.phase
        self.state, output = step(self.state, inputs, now, self.settings)
        if self.state.phase is Phase.READY and before is not Phase.READY:
            self.link.forget_masters()  # a mode that a pilot chose before is none of the flight
        if self.state.phase is Phase.FLYING and before is not Phase.FLYING:
            self._begin(now)
        self._write_tick(now, inputs, output)
        decides = output.decides and now >= self._due - 1e-6
        decide_s = waited_s = 0.0
        if decides:
            self._due = max(self._due + self.settings.period_s, now)
            began = time.perf_counter()
            self._command = self._decide(now)
            decide_s = time.perf_counter() - began
            began = time.perf_counter()
            self.clock.work()
            waited_s = time.perf_counter() - began
            now, inputs = self.clock.now(), dataclasses.replace(inputs, command=self._command)
            self.state, output = step(self.state, inputs, now, self.settings)
            self._write_tick(now, inputs, output)
        began = time.perf_counter()
        self._send(output, now)
        if decides:
            send_s, spent_s = time.perf_counter() - began, time.perf_counter() - awoke - waited_s
            self._keep_latency(read_at, read_s, decide_s, send_s, spent_s - read_s - decide_s - send_s)
        if self.state.phase is not before:
            self._tell(f"{now:.2f} s: {self.state.phase}" + (f" ({why})" if (why := self._why()) else ""))

    def _await_packet(self) -> tuple[float, float]:
        """Reads until the camera's next packet is there, if it is to come soon; returns when, on both clocks."""
        events = self.source.events
        awoke, now = time.perf_counter(), self.clock.now()
        known, expected = events.until_us, events.next_at()
        end = now if expected is None or expected > now + PATIENCE_S else expected + LATE_S
        while events.until_us == known and now < end:
            self.source.wait(end - now)
            awoke, now = time.perf_counter(), self.clock.now()
            self._read(now)
        return awoke, now

    def _read(self, now: float) -> None:
        """Takes what has come from camera and vehicle, and counts the packets that are new."""
        self.source.read(now, getattr(self.clock, "streamed_us", -1))
        self.link.read(now)
        events = self.source.events
        if events.until_us < self._counted_us:  # the camera's clock began anew
            self._counted_us = -1
        self._tally.take(events.since(self._counted_us))
        self._counted_us = events.until_us

    def _inputs(self) -> Inputs:
        events = self.source.events
        return dataclasses.replace(
            self.link.inputs(),
            **(self._pretended() if self._dry else {}),
            packet_at=events.packet_at,
            rate_hz=events.rate_hz(self.clock.now()),
            darkening=events.darkening(self.clock.now()),
            camera=events.size,
            stop=self._stop(),
            command=self._command,
        )

    def _pretended(self) -> dict[str, Any]:
        """Returns what a bench test takes for granted."""
        modes = {Phase.WAITING: "hold", Phase.HOLDING: "hold", Phase.LANDING: "land"}
        mode = modes.get(self.state.phase, "offboard")
        return {"armed": True, "airborne": self.state.phase is not Phase.LANDING, "mode": mode}

    def _begin(self, now: float) -> None:
        """Begins a stretch of flight: the policy has seen nothing yet."""
        self.runner.reset()
        self.link.forget_masters()
        self._due, self._fresh, self._command = now, True, None
        self._flying_at = now if self._flying_at is None else self._flying_at

    def _decide(self, now: float) -> Command | None:
        own, events = self.link.own(now), self.source.events
        if own is None or events.offset.value is None:
            return self._command
        until = events.until_us
        seen_at, times = 1e-6 * until + events.offset.value, self.runner.about["frame_times_us"]
        seen = self._tally.number(until)
        if seen is None:
            window = events.window(until - round(self.runner.window_us / self._pace), until)
            seen = events_at_pace(window, until, self._pace)
        asked: dict[str, Any] = {
            "until_us": until,
            "position": own.odometry.position,
            "quaternion": own.quaternion,
            "velocity": own.odometry.velocity / self._pace,
            "yaw_rate": own.yaw_rate / self._pace,
            "goal": self.settings.goal,
            "volume": self._volume,
            "attitudes": [self.link.attitude_at(seen_at + 1e-6 * t / self._pace) for t in times],
        }
        try:
            wanted = self.runner.decide(seen, **asked)
        except ValueError as error:
            self._tell(f"{now:.2f} s: the policy cannot decide: {error}")
            return self._command
        if self._log is not None:
            self._log.write("decision", at=now, fresh=self._fresh, asked=asked, move=wanted.move, values=wanted.values)
        self._fresh = False
        return Command(now, self._pace * np.asarray(wanted.velocity, np.float64), wanted.yaw)

    def _send(self, output: Output, now: float) -> None:
        velocity = (0.0, 0.0, 0.0) if self._dry and output.velocity is not None else output.velocity
        self.link.send(velocity, output.yaw, now)
        if output.request is not None and not self._dry:
            self.link.request(output.request)
        if velocity is None:
            self._sent_at = None
            return
        sent_at = self.clock.now()
        if self._sent_at is not None:
            self._gap_s = max(self._gap_s, sent_at - self._sent_at)
            self._gaps += sent_at - self._sent_at > GAP_S
        self._sent_at = sent_at

    def _keep_latency(self, read_at: float, read_s: float, decide_s: float, send_s: float, rest_s: float) -> None:
        latency = self.latency
        seen_at = 1e-6 * self.source.events.until_us + (self.source.events.offset.value or 0.0)
        latency.age.append(1e3 * max(0.0, read_at - seen_at))
        parts = (latency.read, read_s), (latency.decide, decide_s), (latency.send, send_s), (latency.rest, rest_s)
        for part, spent in parts:
            part.append(1e3 * spent)

    def _write_tick(self, now: float, inputs: Inputs, output: Output) -> None:
        for said in self.link.said:
            self._tell(f"{now:.2f} s: {said}")
        if self._log is not None:
            self._log.write("tick", now=now, inputs=inputs, phase=self.state.phase, output=output)
            for said in self.link.said:
                self._log.write("said", now=now, text=said)
            events = self.source.events
            if events.size is not None:
                if events.until_us < self._written_us:  # the camera's clock began anew
                    self._written_us = -1
                packets = events.since(self._written_us)
                self._log.write_events(events.size, packets)
                self._written_us = packets[-1][0] if packets else self._written_us
        self.link.said.clear()

    def _why(self) -> str:
        return self.state.outcome or (str(self.state.fault) if self.state.fault else "")
