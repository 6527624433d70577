"""RotorPy's quadrotor behind a MAVLink endpoint with PX4's manners: `python -m edqn_jax.fly.simulated.vehicle`.

It has a clock of its own, and an estimator whose position has noise and drifts. Alone it runs on the machine's clock;
with `--clock` it is a member of a simulation. It starts in the air, armed, in hold mode, as after a pilot's take-off.
"""

from __future__ import annotations

import argparse
import contextlib
import struct
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from edqn_jax.errors import ConfigError, error_sentence
from edqn_jax.extras import MissingPackageError
from edqn_jax.fly import frames
from edqn_jax.fly.clocks import Clock, WallClock
from edqn_jax.fly.faults import Fault
from edqn_jax.fly.link import connect
from edqn_jax.fly.simulated.injected import DRIFT_M_S, JUMP_M, LEFT, MASTER_S, OF_VEHICLE, second_master
from edqn_jax.fly.simulated.lockstep import SimulatedClock
from edqn_jax.fly.simulated.manners import LAND, OFFBOARD, POSITION, UNSUPPORTED, Limits, Manners
from edqn_jax.interop.outer.poses import Body
from edqn_jax.interop.outer.rotorpy_body import STEP_S, RotorPyBody

TRUTH = struct.Struct("<d3d4d3d4B")
"""Time, position, quaternion, velocity, and main mode, sub mode, armed, airborne: what the clock's keeper is told."""

ARM, SET_MODE = 400, 176

CLOCK_AHEAD_S, CLOCK_FAST = 1234.5, 2e-5
"""Of the vehicle's clock against the simulation's."""

LATE_S = 0.05
"""Behind the machine's clock at most."""

POSITION_NOISE_M, VELOCITY_NOISE_M_S, TILT_NOISE_RAD = 0.02, 0.05, 0.005
DRIFT_M = 0.02
"""Of the estimated position after a second; grows with the square root of time."""


class Vehicle:
    """The quadrotor and its endpoints; `step` every `STEP_S` seconds."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._start = np.array(args.start, np.float64)
        self._ground = args.ground
        limits = Limits()
        self.manners = Manners(limits, armed=not args.unarmed, airborne=not args.unarmed)
        turn = np.radians(limits.MPC_YAWRAUTO_MAX)
        self._body = RotorPyBody(self._start, args.yaw, turn, wind=args.wind, **limits.of_body())
        self._random = np.random.default_rng(args.seed)
        self._drift, self._battery = np.zeros(3), args.battery
        self._wires = [connect(address, 1, 1) for address in args.mavlink]
        self._steps = 0
        self._fault, self._fault_steps = args.fault, round(args.fault_s / STEP_S)
        aside = np.random.default_rng([args.seed, 1]).uniform(0.0, 2.0 * np.pi)
        self._aside = np.array([np.cos(aside), np.sin(aside), 0.0])

    @property
    def clock_s(self) -> float:
        """The vehicle's own clock."""
        return CLOCK_AHEAD_S + self._steps * STEP_S * (1.0 + CLOCK_FAST)

    def step(self) -> None:
        """Takes what has come, flies `STEP_S` seconds, tells what is due."""
        for wire in self._wires:
            while (message := wire.recv_msg()) is not None:
                if not self._is(Fault.LOST_LINK):
                    self._take(message, wire)
        body = self._body.state()
        yaw = frames.angles_of(body.quaternion)[2]
        velocity, heading = self.manners.wanted(self.clock_s, yaw, body.position[2] - self._ground)
        if self.manners.airborne:
            self._body.step(velocity, heading)
        self._steps += 1
        self._drift += self._random.normal(0.0, DRIFT_M * np.sqrt(STEP_S), 3)
        self._battery -= STEP_S / 1200.0
        self._go_wrong()
        if not self._is(Fault.LOST_LINK):
            self._tell()

    def truth(self) -> bytes:
        """Returns where it is, as `TRUTH`."""
        body, is_armed = self._body.state(), self.manners.armed
        numbers = (*body.position, *body.quaternion, *body.velocity)
        return TRUTH.pack(self._steps * STEP_S, *numbers, *self.manners.mode, is_armed, self.manners.airborne)

    def close(self) -> None:
        """Closes its endpoints."""
        for wire in self._wires:
            wire.close()

    def _is(self, fault: Fault) -> bool:
        """Returns whether this fault has begun."""
        return self._fault == fault and self._steps >= self._fault_steps

    def _go_wrong(self) -> None:
        """Does what a fault that has begun does to the vehicle itself."""
        since = self._steps - self._fault_steps
        if self._is(Fault.BATTERY):
            self._battery = min(self._battery, LEFT)
        elif self._is(Fault.DRIFT):
            self._drift += DRIFT_M_S * STEP_S * self._aside
        elif self._is(Fault.JUMP) and since == 0:
            self._drift += JUMP_M * self._aside
        elif self._is(Fault.TAKEN_OVER) and since == 0:
            self.manners.mode = POSITION
        elif self._is(Fault.SECOND_MASTER) and since % round(MASTER_S / STEP_S) == 0:
            self.manners.take_setpoint(np.zeros(3), frames.angles_of(self._body.state().quaternion)[2], self.clock_s)
            for wire in self._wires:
                wire.write(second_master())

    def _take(self, message: Any, wire: Any) -> None:
        kind = message.get_type()
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            velocity = frames.from_ned((message.vx, message.vy, message.vz))
            self.manners.take_setpoint(velocity, frames.yaw_to_ned(message.yaw), self.clock_s)
        elif kind == "COMMAND_LONG":
            wire.mav.command_ack_send(message.command, self._obey(message))
        elif kind == "TIMESYNC" and message.tc1 == 0:
            wire.mav.timesync_send(round(1e9 * self.clock_s), message.ts1)
        if kind != "BAD_DATA":  # as PX4's MAV_FORWARD: others on the link are told
            for other in self._wires:
                if other is not wire:
                    other.write(message.get_msgbuf())

    def _obey(self, message: Any) -> int:
        if message.command == ARM:
            return self.manners.take_arming(message.param1 > 0.5)
        if message.command == SET_MODE:
            return self.manners.take_mode((int(message.param2), int(message.param3)), self.clock_s)
        return 0 if message.command == 511 else UNSUPPORTED

    def _tell(self) -> None:
        if self._steps % 4 == 0 and not self._is(Fault.STALE):
            self._tell_state(self._body.state())
        if self._steps % 40 == 0:
            landed = 2 if self.manners.airborne else 1
            for wire in self._wires:
                wire.mav.extended_sys_state_send(0, landed)
        if self._steps % 200 == 1:
            self._tell_heartbeat()

    def _tell_heartbeat(self) -> None:
        main, sub = self.manners.mode
        base = 1 | 128 * self.manners.armed | (8 if (main, sub) in (OFFBOARD, LAND) else 0)
        left = round(100 * max(self._battery, 0.0))
        for wire in self._wires:
            wire.mav.heartbeat_send(2, 12, base, main << 16 | sub << 24, 4 if self.manners.armed else 3)
            wire.mav.sys_status_send(0, 0, 0, 300, 15000, 1000, left, 0, 0, 0, 0, 0, 0)

    def _tell_state(self, body: Body) -> None:
        boot_ms = round(1e3 * self.clock_s) % 2**32
        place = body.position - self._start + self._drift + self._random.normal(0.0, POSITION_NOISE_M, 3)
        velocity = body.velocity + self._random.normal(0.0, VELOCITY_NOISE_M_S, 3)
        angles = frames.angles_of(frames.quaternion_from_ned(body.quaternion))
        roll, pitch, yaw = (float(each) for each in angles + self._random.normal(0.0, TILT_NOISE_RAD, 3))
        turn = -body.yaw_rate * np.cos(pitch) / np.cos(roll)  # about the body's z, as if it did not pitch
        for wire in self._wires:
            wire.mav.local_position_ned_send(boot_ms, *frames.to_ned(place), *frames.to_ned(velocity))
            wire.mav.attitude_send(boot_ms, roll, pitch, yaw, 0.0, 0.0, turn)


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments."""
    parser = argparse.ArgumentParser("python -m edqn_jax.fly.simulated.vehicle", description=__doc__)
    parser.add_argument("--mavlink", nargs="+", default=["udpout:127.0.0.1:14540"], help="endpoints, as pymavlink's")
    parser.add_argument("--start", nargs=3, type=float, default=[0.0, 0.0, 5.0], help="metres in the world, z up")
    parser.add_argument("--yaw", type=float, default=0.0, help="first heading, radians from x to the left")
    parser.add_argument("--ground", type=float, default=0.3, help="height at which it stands, metres")
    parser.add_argument("--wind", nargs=3, type=float, default=[0.0, 0.0, 0.0], help="m/s")
    parser.add_argument("--battery", type=float, default=1.0, help="share at the beginning")
    parser.add_argument("--seed", type=int, default=0, help="of the estimator's errors")
    parser.add_argument("--unarmed", action="store_true", help="on the ground, motors off")
    parser.add_argument("--seconds", type=float, default=np.inf, help="ends after so long")
    parser.add_argument("--fault", choices=list(map(str, OF_VEHICLE)), help="that strikes in flight")
    parser.add_argument("--fault-s", type=float, default=0.0, help="when it strikes, its own seconds")
    parser.add_argument("--clock", help="HOST:PORT of a simulation's clock")
    return parser.parse_args(argv)


def run(args: argparse.Namespace) -> None:
    """Flies until its time or the simulation ends."""
    with contextlib.ExitStack() as stack:
        simulated = SimulatedClock(args.clock, "vehicle") if args.clock else None
        if simulated is not None:
            stack.callback(simulated.close)
        clock: Clock = simulated or WallClock()
        vehicle = Vehicle(args)
        stack.callback(vehicle.close)
        began, steps = clock.now(), 0
        while steps * STEP_S < args.seconds:
            vehicle.step()
            steps += 1
            if simulated is not None:
                simulated.told = vehicle.truth()
            # On a machine that is too busy for it, its time goes slowly, not in bursts.
            began = max(began, clock.now() - LATE_S - steps * STEP_S)
            clock.sleep_until(began + steps * STEP_S)


def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0, or 2 for invalid input."""
    try:
        run(parse(argv))
    except (ConfigError, MissingPackageError) as error:
        print(f"vehicle: {error_sentence(error)}", file=sys.stderr)
        return 2
    except (ConnectionError, KeyboardInterrupt):
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
