"""A vehicle over MAVLink: what it tells, as the state machine and the policy need it, and setpoints for it.

Velocity and yaw go out as SET_POSITION_TARGET_LOCAL_NED. Modes are PX4's offboard, hold and land, or ArduPilot's
guided, brake and land (the latter was tried against no ArduPilot). Nothing here can arm a vehicle.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.fly import frames
from edqn_jax.fly.clocks import ClockOffset
from edqn_jax.fly.faults import Inputs, Odometry

SYSTEM, COMPONENT = 1, 191
"""Our identity: a computer on board of the vehicle."""

VELOCITY_AND_YAW = 0b1001_1100_0111
"""Type mask that ignores position, acceleration and yaw rate."""

PX4, ARDUPILOT = 12, 3
"""MAV_AUTOPILOT."""

MODES: dict[int, dict[str, tuple[int, int]]] = {
    PX4: {"offboard": (6, 0), "hold": (4, 3), "land": (4, 6)},
    ARDUPILOT: {"offboard": (4, 0), "hold": (17, 0), "land": (9, 0)},
}
"""Numbers of a mode, main and sub, by autopilot."""

ROTORS = {2, 13, 14, 15, 29}
"""MAV_TYPE of multirotors: quad, hexa, octo, tri, deca."""

STREAMS_HZ = {"LOCAL_POSITION_NED": 50, "ATTITUDE": 50, "EXTENDED_SYS_STATE": 5, "BATTERY_STATUS": 1}
"""Messages that the vehicle is asked for."""

MASTERS = {"SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT", "SET_ATTITUDE_TARGET", "SET_MODE"}
"""Messages of someone who steers; and DO_SET_MODE of COMMAND_LONG."""

DO_SET_MODE, SET_MESSAGE_INTERVAL = 176, 511
IN_AIR = {2, 3, 4}
LOW_BATTERY = {2, 3, 4, 5, 6}
HISTORY_S = 1.0
SETTLES_S = 0.3

MANY = 2000
"""Messages that are taken at once."""


@dataclasses.dataclass(frozen=True)
class Own:
    """What a drone knows of itself, in the policy's world."""

    odometry: Odometry
    quaternion: NDArray[np.float64]
    """[4] w, x, y, z from the body to the world."""
    yaw_rate: float
    """Of the heading, rad/s to the left."""


def mavlink() -> Any:
    """Returns pymavlink's `mavutil`, with MAVLink 2.

    Raises:
        MissingPackageError: if pymavlink is not installed.
    """
    os.environ.setdefault("MAVLINK20", "1")
    return require_extra("pymavlink.mavutil", extra="fly")


def connect(address: str, system: int = SYSTEM, component: int = COMPONENT) -> Any:
    """Returns pymavlink's connection to an address.

    Args:
        address: as pymavlink writes it: `udpin:0.0.0.0:14540`, `udpout:HOST:PORT`, `tcp:HOST:PORT` or
            `/dev/ttyTHS1,921600`.
        system: ours.
        component: ours.

    Raises:
        ConfigError: if it cannot be opened.
        MissingPackageError: if pymavlink is not installed.
    """
    device, _, baud = address.partition(",")
    try:
        if ":" in device:
            int(device.rpartition(":")[2])  # pymavlink leaves a socket open where this is no number
        return mavlink().mavlink_connection(
            device, baud=int(baud or 57600), source_system=system, source_component=component, retries=1
        )
    except (OSError, ValueError, IndexError) as error:
        raise ConfigError(
            f"'{address}' cannot be opened ({error}); write it as udpin:0.0.0.0:14540, tcp:HOST:PORT or "
            "/dev/ttyTHS1,921600"
        ) from error


class Link:
    """One vehicle; `read` often, `send` at 20 Hz or more."""

    def __init__(self, address: str, origin: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Opens the link.

        Args:
            address: as in `connect`.
            origin: [3] metres: where the vehicle's local frame begins, in the policy's world.

        Raises:
            ConfigError: if it cannot be opened.
            MissingPackageError: if pymavlink is not installed.
        """
        self._wire = connect(address)
        self._origin = np.asarray(origin, np.float64)
        self._vehicle: tuple[int, int] | None = None
        self._autopilot = PX4
        self._wrong, self._landed_told, self._mode_asked, self._mode_at = "", False, "", -np.inf
        self._asked_ns: collections.deque[int] = collections.deque(maxlen=20)
        self._heard = Inputs()
        self._attitudes: collections.deque[tuple[float, NDArray[np.float64]]] = collections.deque()
        self._yaw_rate = 0.0
        self._sent_at: dict[str, float] = {}
        self._errors: set[str] = set()
        self.offset = ClockOffset()
        """Of the autopilot's clock."""
        self.said: list[str] = []
        """What the vehicle told people, and what it refused; whoever reads it empties it."""

    def read(self, now: float) -> None:
        """Takes what has come, of a flood not all at once; a link that breaks falls silent."""
        for message in itertools.takewhile(lambda each: each is not None, (self._next() for _ in range(MANY))):
            kind = message.get_type()
            if kind == "BAD_DATA":
                self._wrong = self._wrong or ("" if self._vehicle else "what comes there is not MAVLink")
                continue
            sender = message.get_srcSystem(), message.get_srcComponent()
            if kind == "HEARTBEAT" and self._vehicle is None:
                self._meet(message, sender)
            if sender == self._vehicle:
                take = getattr(self, f"_take_{kind.lower()}", None)
                if take is not None:
                    take(message, now)
            elif self._vehicle is not None and sender != (SYSTEM, COMPONENT):
                steers = kind in MASTERS or (kind == "COMMAND_LONG" and message.command == DO_SET_MODE)
                self._heard = dataclasses.replace(self._heard, other_master=self._heard.other_master or steers)

    def inputs(self) -> Inputs:
        """Returns what was last heard of the vehicle; the fields of the camera are empty."""
        return dataclasses.replace(self._heard, wrong=self._wrong)

    def own(self, now: float) -> Own | None:
        """Returns what the drone knows of itself, led on by its velocity to `now`; None before it has told."""
        odometry = self._heard.odometry
        if odometry is None or not self._attitudes:
            return None
        ahead = min(max(now - odometry.at, 0.0), 0.2)
        led = dataclasses.replace(odometry, position=odometry.position + ahead * odometry.velocity)
        return Own(led, self._attitudes[-1][1], self._yaw_rate)

    def attitude_at(self, time: float) -> NDArray[np.float64]:
        """Returns the attitude [4] at a time of the host's clock within the last second; the nearest that is known.

        Raises:
            LookupError: if none has come.
        """
        if not self._attitudes:
            raise LookupError("no attitude has come")
        after = next((k for k, (at, _) in enumerate(self._attitudes) if at >= time), len(self._attitudes))
        if after in (0, len(self._attitudes)):
            return self._attitudes[0 if after == 0 else -1][1]
        (first, before), (last, following) = self._attitudes[after - 1], self._attitudes[after]
        return frames.between(before, following, (time - first) / max(last - first, 1e-9))

    def send(self, velocity: ArrayLike | None, yaw: float | None, now: float) -> None:
        """Sends what is due: a setpoint, if there is one, heartbeats, questions for its clock and its messages.

        Args:
            velocity: [3] m/s in the world; None sends none.
            yaw: radians from the world's x to the left; None keeps the heading.
            now: host's seconds.
        """
        with self._told_if_it_breaks():
            self._send(velocity, yaw, now)

    def _send(self, velocity: ArrayLike | None, yaw: float | None, now: float) -> None:
        out = self._wire.mav
        if self._is_due("heartbeat", 1.0, now):
            out.heartbeat_send(18, 8, 0, 0, 4)  # an onboard controller, no autopilot
        if self._vehicle is None:
            return
        if self._is_due("timesync", 0.1, now):
            self._asked_ns.append(round(1e9 * now))
            out.timesync_send(0, self._asked_ns[-1])
        if self._is_due("streams", 5.0, now):
            self._ask_streams()
        if velocity is not None:
            north, east, down = frames.to_ned(velocity)
            heading = frames.yaw_to_ned(self._heading() if yaw is None else yaw)
            out.set_position_target_local_ned_send(
                round(1e3 * now) % 2**32,
                *self._vehicle,
                1,
                VELOCITY_AND_YAW,
                *(0.0, 0.0, 0.0),
                *(north, east, down),
                *(0.0, 0.0, 0.0),
                heading,
                0.0,
            )

    def request(self, mode: str) -> None:
        """Asks for a mode: `offboard`, `hold` or `land`."""
        if self._vehicle is None:
            return
        main, sub = MODES[self._autopilot][mode]
        self._mode_asked = mode
        with self._told_if_it_breaks():
            self._command(DO_SET_MODE, 1, main, sub)

    def forget_masters(self) -> None:
        """Forgets who steered before: to be called as a flight begins."""
        self._heard = dataclasses.replace(self._heard, other_master=False)

    def close(self) -> None:
        """Closes the link."""
        self._wire.close()

    @contextlib.contextmanager
    def _told_if_it_breaks(self) -> Iterator[None]:
        """Tells people of each error of socket or device once; the state machine knows a lost link by its silence."""
        try:
            yield
        except OSError as error:
            if str(error) not in self._errors:
                self._errors.add(str(error))
                self.said.append(f"the link is broken: {error}")

    def _next(self) -> Any:
        """Returns a message; None if none has come, or none can."""
        with self._told_if_it_breaks():
            return self._wire.recv_msg()
        return None

    def _is_due(self, what: str, every_s: float, now: float) -> bool:
        if now - self._sent_at.get(what, -np.inf) < every_s - 1e-6:
            return False
        self._sent_at[what] = now
        return True

    def _ask_streams(self) -> None:
        for name, rate in STREAMS_HZ.items():
            number = getattr(mavlink().mavlink, f"MAVLINK_MSG_ID_{name}")
            self._command(SET_MESSAGE_INTERVAL, number, 1_000_000 // rate)

    def _command(self, number: int, *params: float) -> None:
        assert self._vehicle is not None
        seven = (*params, *(0.0,) * (7 - len(params)))
        self._wire.mav.command_long_send(*self._vehicle, number, 0, *seven)

    def _heading(self) -> float:
        return frames.angles_of(self._attitudes[-1][1])[2] if self._attitudes else 0.0

    def _meet(self, message: Any, sender: tuple[int, int]) -> None:
        if message.type in (6, 18, 26, 30):  # ground stations, other computers, gimbals, cameras
            return
        self._wrong = ""
        if message.autopilot not in MODES:
            self._wrong = f"the autopilot of vehicle {sender[0]} is neither PX4 nor ArduPilot"
        elif message.type not in ROTORS:
            self._wrong = f"vehicle {sender[0]} is no multirotor (MAV_TYPE {message.type})"
        else:
            self._autopilot = message.autopilot
        self._vehicle = sender

    def _take_heartbeat(self, message: Any, now: float) -> None:
        custom = message.custom_mode
        numbers = ((custom >> 16) & 0xFF, (custom >> 24) & 0xFF) if self._autopilot == PX4 else (custom, 0)
        known = {those: name for name, those in MODES[self._autopilot].items()}
        armed = bool(message.base_mode & 128)
        airborne = self._heard.airborne if self._landed_told else armed and message.system_status == 4
        # A heartbeat on its way while the vehicle answered a request tells of the mode before.
        mode = self._heard.mode if now - self._mode_at < SETTLES_S else known.get(numbers, "other")
        self._heard = dataclasses.replace(self._heard, heartbeat_at=now, mode=mode, armed=armed, airborne=airborne)

    def _take_extended_sys_state(self, message: Any, now: float) -> None:
        if message.landed_state:
            self._landed_told = True
            self._heard = dataclasses.replace(self._heard, airborne=message.landed_state in IN_AIR)

    def _take_command_ack(self, message: Any, now: float) -> None:
        if message.command != DO_SET_MODE or not self._mode_asked:
            return
        if message.result == 0:
            self._heard, self._mode_at = dataclasses.replace(self._heard, mode=self._mode_asked), now
        else:
            self.said.append(f"the vehicle refused {self._mode_asked} (MAV_RESULT {message.result})")

    def _take_statustext(self, message: Any, now: float) -> None:
        self.said.append(str(message.text))

    def _take_timesync(self, message: Any, now: float) -> None:
        if message.tc1 and message.ts1 in self._asked_ns:  # an answer, and to us
            self.offset.add_exchange(1e-9 * message.ts1, 1e-9 * message.tc1, now)

    def _take_sys_status(self, message: Any, now: float) -> None:
        if message.battery_remaining >= 0:
            self._heard = dataclasses.replace(self._heard, battery=message.battery_remaining / 100)

    def _take_battery_status(self, message: Any, now: float) -> None:
        if getattr(message, "charge_state", 0) in LOW_BATTERY:
            self._heard = dataclasses.replace(self._heard, battery=0.0)
        elif message.battery_remaining >= 0:
            self._heard = dataclasses.replace(self._heard, battery=message.battery_remaining / 100)

    def _host_time(self, boot_s: float, now: float) -> float:
        """Returns when something was measured, on the host's clock."""
        return now if self.offset.value is None else min(now, boot_s + self.offset.value)

    def _take_attitude(self, message: Any, now: float) -> None:
        angles = (message.roll, message.pitch, message.yaw)
        quaternion = frames.quaternion_from_ned(frames.quaternion_of_angles(*angles))
        rate = frames.heading_rate(message.roll, message.pitch, message.pitchspeed, message.yawspeed)
        self._keep_attitude(self._host_time(1e-3 * message.time_boot_ms, now), quaternion, -rate)

    def _keep_attitude(self, at: float, quaternion: NDArray[np.float64], yaw_rate: float) -> None:
        if not np.all(np.isfinite(quaternion)) or (self._attitudes and at <= self._attitudes[-1][0]):
            return
        self._attitudes.append((at, quaternion))
        self._yaw_rate = yaw_rate
        while self._attitudes[0][0] < at - HISTORY_S:
            self._attitudes.popleft()

    def _take_local_position_ned(self, message: Any, now: float) -> None:
        at = self._host_time(1e-3 * message.time_boot_ms, now)
        self._keep_odometry(at, (message.x, message.y, message.z), (message.vx, message.vy, message.vz), 0)

    def _take_odometry(self, message: Any, now: float) -> None:
        at = self._host_time(1e-6 * message.time_usec, now)
        velocity = np.array([message.vx, message.vy, message.vz])
        if message.child_frame_id in (8, 12):  # the body's frame
            velocity = frames.rotate(message.q, velocity)
        self._keep_odometry(at, (message.x, message.y, message.z), velocity, message.reset_counter)

    def _keep_odometry(self, at: float, place: ArrayLike, velocity: ArrayLike, resets: int) -> None:
        position, speed = self._origin + frames.from_ned(place), frames.from_ned(velocity)
        old = self._heard.odometry
        # What is not a number, or older than what is known, ages into staleness.
        if np.all(np.isfinite([position, speed])) and (old is None or at > old.at):
            new = Odometry(at, position, speed, max(resets, 0 if old is None else old.resets))
            self._heard = dataclasses.replace(self._heard, odometry=new)
