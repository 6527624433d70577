"""The MAVLink side of `edqn fly`, against pymavlink on the other end of a loopback socket."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pymavlink")

from edqn_jax.errors import ConfigError  # noqa: E402
from edqn_jax.fly.link import VELOCITY_AND_YAW, Link, connect  # noqa: E402
from tests.support.interop.ports import free_port  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore")  # pymavlink leaves sockets to the collector

ORIGIN = np.array([10.0, 20.0, 5.0])


class End:
    """The vehicle's end of a link."""

    def __init__(self, port: int, system: int = 1, component: int = 1) -> None:
        self.wire = connect(f"udpout:127.0.0.1:{port}", system, component)

    def heartbeat(
        self, mode: tuple[int, int] = (4, 3), *, kind: int = 2, autopilot: int = 12, armed: bool = True
    ) -> None:
        self.wire.mav.heartbeat_send(kind, autopilot, 1 | 128 * armed, mode[0] << 16 | mode[1] << 24, 4)

    def received(self) -> list[Any]:
        found = []
        while (message := self.wire.recv_msg()) is not None:
            found.append(message)
        return found


Ends = Callable[..., End]


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def link(port: int) -> Iterator[Link]:
    made = Link(f"udpin:127.0.0.1:{port}", ORIGIN)
    yield made
    made.close()


@pytest.fixture(name="ends")
def make_ends(port: int) -> Iterator[Ends]:
    made: list[End] = []

    def make(system: int = 1, component: int = 1) -> End:
        made.append(End(port, system, component))
        return made[-1]

    yield make
    for end in made:
        end.wire.close()


def test_what_a_vehicle_tells_is_read_in_our_frames(link: Link, ends: Ends) -> None:
    end = ends()
    end.heartbeat((6, 0))
    end.wire.mav.attitude_send(1000, 0.0, 0.0, np.radians(30), 0.0, 0.0, 0.5)
    end.wire.mav.local_position_ned_send(1000, 1.0, 2.0, -3.0, 0.5, 0.25, -1.0)
    end.wire.mav.extended_sys_state_send(0, 2)
    end.wire.mav.sys_status_send(0, 0, 0, 300, 15000, 1000, 55, 0, 0, 0, 0, 0, 0)
    link.read(7.0)
    heard = link.inputs()
    assert (heard.heartbeat_at, heard.mode, heard.armed, heard.airborne) == (7.0, "offboard", True, True)
    assert heard.battery == pytest.approx(0.55) and not heard.other_master and not heard.wrong
    assert heard.odometry is not None and heard.odometry.at == 7.0
    np.testing.assert_allclose(heard.odometry.position, ORIGIN + [2.0, 1.0, 3.0])
    np.testing.assert_allclose(heard.odometry.velocity, [0.25, 0.5, 1.0])
    own = link.own(7.1)
    assert own is not None
    np.testing.assert_allclose(own.odometry.position, ORIGIN + [2.025, 1.05, 3.1])
    assert 2 * np.arctan2(own.quaternion[3], own.quaternion[0]) == pytest.approx(np.radians(60))
    assert own.yaw_rate == pytest.approx(-0.5)
    assert link.attitude_at(6.0).tolist() == own.quaternion.tolist()


def test_odometry_in_the_bodys_frame_is_turned_and_its_resets_count(link: Link, ends: Ends) -> None:
    end = ends()
    end.heartbeat()
    half = np.sqrt(0.5)
    nowhere = (0.0,) * 21
    for resets, place in enumerate(((0.0, 0.0, -5.0), (1.0, 0.0, -5.0), (np.nan, 0.0, -5.0))):
        # Facing east, 2 m/s ahead.
        end.wire.mav.odometry_send(
            1_000_000 + resets, 1, 12, *place, (half, 0.0, 0.0, half), 2.0, 0.0, 0.0, 0, 0, 0, nowhere, nowhere, resets
        )
        link.read(3.0 + resets)
    found = link.inputs().odometry
    assert found is not None and found.at == 4.0 and found.resets == 1  # what is not a number is not taken
    np.testing.assert_allclose(found.velocity, [2.0, 0.0, 0.0], atol=1e-6)


def test_setpoints_go_out_in_the_vehicles_frame(link: Link, ends: Ends) -> None:
    end = ends()
    end.heartbeat()
    link.read(1.0)
    link.send((3.0, 1.0, 0.5), np.pi / 2, 1.0)
    link.send(None, None, 1.02)
    link.request("offboard")
    link.request("land")
    found = end.received()
    (sent,) = (each for each in found if each.get_type() == "SET_POSITION_TARGET_LOCAL_NED")
    assert sent.type_mask == VELOCITY_AND_YAW and sent.coordinate_frame == 1
    assert (sent.vx, sent.vy, sent.vz) == (1.0, 3.0, -0.5) and sent.yaw == pytest.approx(0.0, abs=1e-6)
    assert (sent.target_system, sent.target_component) == (1, 1)
    modes = [each for each in found if each.get_type() == "COMMAND_LONG" and each.command == 176]
    assert [(each.param1, each.param2, each.param3) for each in modes] == [(1, 6, 0), (1, 4, 6)]
    assert not any(each.get_type() == "COMMAND_LONG" and each.command == 400 for each in found), "nothing is armed"
    assert sum(each.get_type() == "HEARTBEAT" for each in found) == 1


def test_ardupilots_modes_are_known(link: Link, ends: Ends) -> None:
    end = ends()
    end.wire.mav.heartbeat_send(2, 3, 129, 17, 4)
    link.read(1.0)
    assert link.inputs().mode == "hold" and link.inputs().airborne
    link.request("offboard")
    assert [each.param2 for each in end.received() if each.get_type() == "COMMAND_LONG"] == [4]


def test_the_vehicles_clock_is_asked_for_and_odometry_has_its_time(link: Link, ends: Ends) -> None:
    end = ends()
    end.heartbeat()
    link.read(100.0)
    for k in range(3):
        now = 100.0 + 0.2 * k
        link.send(None, None, now)
        (question,) = (each for each in end.received() if each.get_type() == "TIMESYNC")
        end.wire.mav.timesync_send(round(1e9 * (now - 90.0)), question.ts1)  # 90 s behind us
        link.read(now)
    end.wire.mav.timesync_send(1_000_000_000, 77)  # an answer to someone else
    link.read(100.4)
    assert link.offset.value == pytest.approx(90.0)
    end.wire.mav.local_position_ned_send(10_350, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    link.read(100.4)
    odometry = link.inputs().odometry
    assert odometry is not None and odometry.at == pytest.approx(100.35)


def test_an_answer_to_a_request_changes_the_mode_at_once(link: Link, ends: Ends) -> None:
    end = ends()
    end.heartbeat()
    link.read(1.0)
    link.request("offboard")
    end.wire.mav.command_ack_send(176, 1)
    link.read(1.1)
    assert link.inputs().mode == "hold" and link.said == ["the vehicle refused offboard (MAV_RESULT 1)"]
    end.wire.mav.command_ack_send(176, 0)
    end.heartbeat()  # on its way before
    link.read(1.2)
    assert link.inputs().mode == "offboard"
    end.heartbeat()
    link.read(2.2)
    assert link.inputs().mode == "hold"


@pytest.mark.parametrize(
    ("steers", "how"),
    [
        (True, lambda mav: mav.command_long_send(1, 1, 176, 0, 1, 4, 3, 0, 0, 0, 0)),
        (True, lambda mav: mav.set_position_target_local_ned_send(0, 1, 1, 1, 0, *(0.0,) * 11)),
        (False, lambda mav: mav.heartbeat_send(6, 8, 0, 0, 4)),
        (False, lambda mav: mav.command_long_send(1, 1, 511, 0, 1, 4, 3, 0, 0, 0, 0)),
    ],
)
def test_whoever_else_steers_is_noticed(link: Link, ends: Ends, steers: bool, how: Callable[[Any], None]) -> None:
    ends().heartbeat()
    link.read(1.0)
    how(ends(255, 190).wire.mav)
    link.read(1.1)
    assert link.inputs().other_master is steers
    link.forget_masters()
    assert not link.inputs().other_master


@pytest.mark.parametrize(
    ("kind", "autopilot", "says"), [(1, 12, "no multirotor"), (2, 8, "neither PX4 nor ArduPilot"), (6, 8, "")]
)
def test_another_vehicle_is_refused_and_a_ground_station_is_none(
    link: Link, ends: Ends, kind: int, autopilot: int, says: str
) -> None:
    ends().heartbeat(kind=kind, autopilot=autopilot)
    link.read(1.0)
    assert says in link.inputs().wrong and bool(says) is bool(link.inputs().wrong)
    assert (link.inputs().heartbeat_at is None) is (kind == 6)


def test_what_is_not_mavlink_is_told(link: Link, port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(b"$GPGGA,123519,4807.038,N,01131.000,E\r\n" * 3, ("127.0.0.1", port))
    link.read(1.0)
    assert link.inputs().wrong == "what comes there is not MAVLink"


def test_a_link_that_is_reset_falls_silent_and_is_told_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = Link(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        far, _ = server.accept()
    far.sendall(link._wire.mav.heartbeat_encode(2, 12, 129, 4 << 16 | 3 << 24, 4).pack(link._wire.mav))
    until = time.monotonic() + 20.0
    while link.inputs().heartbeat_at is None and time.monotonic() < until:
        link.read(1.0)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    far.close()  # with a reset
    while not link.said and time.monotonic() < until:
        link.read(2.0)
    for _ in range(3):
        link.send((1.0, 0.0, 0.0), None, 3.0)
        link.request("hold")
        link.read(3.0)
    link.close()
    assert link.inputs().heartbeat_at == 1.0
    assert len(link.said) == 1 and link.said[0].startswith("the link is broken: ")


def test_a_device_that_cannot_be_written_to_is_told_once(link: Link, ends: Ends) -> None:
    ends().heartbeat()
    link.read(1.0)

    def fail(buffer: bytes) -> None:
        raise OSError("no such device")

    link._wire.write = fail
    for _ in range(3):
        link.send((1.0, 0.0, 0.0), None, 2.0)
        link.request("hold")
    assert link.said == ["the link is broken: no such device"]


@pytest.mark.parametrize("address", ["udpin:127.0.0.1:notaport", "tcp:127.0.0.1:1", "/dev/nowhere,57600"])
def test_an_address_that_cannot_be_opened_is_one_sentence(address: str) -> None:
    with pytest.raises(ConfigError, match="cannot be opened"):
        Link(address)


def test_the_autopilot_needs_no_jax() -> None:
    program = (
        "import sys; import edqn_jax.fly.link, edqn_jax.fly.machine, edqn_jax.fly.pilot, edqn_jax.fly.replay; "
        "print('jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_setpoints_are_sent_often_enough(link: Link, ends: Ends) -> None:
    end = ends()
    end.heartbeat()
    link.read(time.monotonic())
    for k in range(50):
        link.send((0.0, 0.0, 0.0), None, 0.02 * k)
    assert sum(each.get_type() == "SET_POSITION_TARGET_LOCAL_NED" for each in end.received()) == 50
