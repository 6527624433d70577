"""RotorPy's quadrotor behind MAVLink, flown by `Link`; in steps of its own clock."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pymavlink")
pytest.importorskip("rotorpy")

from edqn_jax.fly.faults import Fault, Settings  # noqa: E402
from edqn_jax.fly.link import Link  # noqa: E402
from edqn_jax.fly.pilot import Pilot, Task  # noqa: E402
from edqn_jax.fly.simulated import vehicle as simulated  # noqa: E402
from edqn_jax.fly.simulated.injected import OF_VEHICLE  # noqa: E402
from edqn_jax.fly.simulated.lockstep import SimulatedClock  # noqa: E402
from edqn_jax.fly.simulated.manners import HOLD, LAND, POSITION  # noqa: E402
from edqn_jax.fly.streams import EVENT, Events  # noqa: E402
from edqn_jax.interop.deployment.runner import Command  # noqa: E402
from edqn_jax.interop.outer.rotorpy_body import STEP_S  # noqa: E402
from tests.support.interop.ports import free_port  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore")  # pymavlink, rotorpy and what they import

START = np.array([3.0, 4.0, 5.0])


class Together:
    """A vehicle and a link to it, in steps of the vehicle's clock."""

    def __init__(self, *words: str) -> None:
        self.port = free_port()
        self.link = Link(f"udpin:127.0.0.1:{self.port}", START)
        place = [str(each) for each in START]
        more = ["--mavlink", f"udpout:127.0.0.1:{self.port}", "--start", *place, *words]
        self.vehicle = simulated.Vehicle(simulated.parse(more))
        self.now = 500.0

    def run(self, seconds: float, velocity: Any = None, yaw: float | None = None) -> None:
        """Lets time pass, with setpoints at 50 Hz if there are any."""
        for k in range(round(seconds / STEP_S)):
            self.vehicle.step()
            self.now += STEP_S
            if k % 4 == 0:
                self.link.read(self.now)
                self.link.send(velocity, yaw, self.now)

    def truth(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns position and velocity."""
        numbers = np.array(simulated.TRUTH.unpack(self.vehicle.truth())[:11])
        return numbers[1:4], numbers[8:11]

    def close(self) -> None:
        self.link.close()
        self.vehicle.close()


@pytest.fixture(name="make")
def make_together() -> Iterator[Callable[..., Together]]:
    made: list[Together] = []

    def make(*words: str) -> Together:
        made.append(Together(*words))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_a_vehicle_tells_where_it_is_with_small_errors_on_its_own_clock(make: Callable[..., Together]) -> None:
    both = make()
    both.run(2.0)
    heard, own = both.link.inputs(), both.link.own(both.now)
    assert (heard.mode, heard.armed, heard.airborne) == ("hold", True, True) and heard.battery is not None
    assert own is not None and heard.odometry is not None
    error = np.abs(heard.odometry.position - both.truth()[0])
    assert 1e-4 < error.max() < 0.3
    assert both.link.offset.value == pytest.approx(500.0 - simulated.CLOCK_AHEAD_S, abs=0.01)
    assert both.now - heard.odometry.at < 0.05


def test_offboard_is_flown_as_told_and_left_when_setpoints_stop(make: Callable[..., Together]) -> None:
    both = make()
    both.run(1.5)
    both.link.request("offboard")
    both.run(0.1)
    assert both.link.inputs().mode == "hold" and "refused offboard" in both.link.said[0]
    both.run(0.5, (0.0, 0.0, 0.0))
    both.link.request("offboard")
    both.run(3.0, (2.0, 1.0, 0.5), np.pi / 2)
    assert both.link.inputs().mode == "offboard"
    place, velocity = both.truth()
    np.testing.assert_allclose(velocity, [2.0, 1.0, 0.5], atol=0.4)  # drag takes its share
    own = both.link.own(both.now)
    assert own is not None
    assert 2 * np.arctan2(own.quaternion[3], own.quaternion[0]) == pytest.approx(np.pi / 2, abs=0.1)
    both.run(0.4)
    assert both.vehicle.manners.mode == (6, 0)
    both.run(2.0)
    assert both.vehicle.manners.mode == (4, 3) and both.link.inputs().mode == "hold"
    assert np.linalg.norm(both.truth()[1]) < 0.2


def test_it_lands_when_it_is_asked_to(make: Callable[..., Together]) -> None:
    both = make("--ground", "4.6")
    both.run(1.5)
    both.link.request("land")
    both.run(2.0)
    heard = both.link.inputs()
    assert heard.mode == "land" and not heard.airborne and not heard.armed


def test_an_unarmed_vehicle_stays_where_it_is_and_arms_for_whom_it_is_told_to(make: Callable[..., Together]) -> None:
    both = make("--unarmed")
    both.run(1.5)
    assert not both.link.inputs().armed and not both.link.inputs().airborne
    np.testing.assert_allclose(both.truth()[0], START)
    both.link._command(simulated.ARM, 1)
    both.run(1.2)
    assert both.link.inputs().armed


def test_a_ground_station_on_another_endpoint_is_forwarded(make: Callable[..., Together]) -> None:
    port = free_port()
    from edqn_jax.fly.link import connect

    both = make()
    both.vehicle._wires.append(connect(f"udpout:127.0.0.1:{port}", 1, 1))
    station = connect(f"udpin:127.0.0.1:{port}", 255, 190)
    both.run(1.2)
    while station.recv_msg() is not None:
        pass
    station.mav.command_long_send(1, 1, 176, 0, 1, 3, 0, 0, 0, 0, 0)
    both.run(1.2)
    station.close()
    assert both.link.inputs().other_master and both.link.inputs().mode == "other"


class Steps:
    """A clock that lets the vehicle fly while the pilot sleeps."""

    passes = False

    def __init__(self, both: Together) -> None:
        self.both = both

    def now(self) -> float:
        return self.both.now

    def sleep_until(self, moment: float) -> None:
        while self.both.now < moment - STEP_S / 2:
            self.both.vehicle.step()
            self.both.now += STEP_S

    def work(self) -> None: ...


class Sees:
    """A camera that always sees enough."""

    def __init__(self) -> None:
        self.events = Events((346, 260))

    def read(self, now: float, least_us: int = -1) -> None:
        events = np.zeros(5000, EVENT)
        events["t"], events["p"] = round(1e6 * now) - 1, 1
        self.events.add(events, round(1e6 * now), now)

    def wait(self, most_s: float) -> None: ...

    def close(self) -> None: ...


class Ahead:
    """A policy that flies along x."""

    period_s, window_us, about = 0.26, 160_000, {"frame_times_us": [-160_000, 0]}

    def reset(self) -> None: ...

    def count(self, packet: np.ndarray) -> None:
        """Counts nothing: it is given the events themselves."""

    def decide(self, packet: np.ndarray, until_us: int, **own: Any) -> Command:
        return Command(22, np.array([3.0, 0.0, 0.0], np.float32), 0.0, np.zeros(27, np.float32))


def fly_ahead(both: Together) -> str:
    fence = np.array([[-10.0, -10.0, 0.0], [200.0, 20.0, 20.0]])
    settings = Settings(goal=np.array([100.0, 4.0, 5.0]), fence=fence, camera=(346, 260), period_s=0.26)
    policy: Any = Ahead()
    task = Task(settings, fence)
    return Pilot(policy, both.link, Sees(), Steps(both), task, tell=lambda _: None).fly().outcome


@pytest.mark.parametrize(
    ("fault", "outcome", "mode"),
    [
        (Fault.BATTERY, "low battery", LAND),
        (Fault.TAKEN_OVER, "taken over", POSITION),
        (Fault.STALE, "stale odometry", HOLD),
        (Fault.JUMP, "odometry jump", HOLD),
        (Fault.DRIFT, "odometry drift", HOLD),
        (Fault.LOST_LINK, "lost link; the vehicle did not confirm hold", HOLD),
        (Fault.SECOND_MASTER, "second master", HOLD),
    ],
)
def test_faults_over_the_wire_end_as_configured(
    make: Callable[..., Together], fault: Fault, outcome: str, mode: tuple[int, int]
) -> None:
    both = make("--ground", "4.8", "--fault", str(fault), "--fault-s", "3.5")
    assert fly_ahead(both) == outcome
    assert both.vehicle.manners.mode == mode
    place, velocity = both.truth()
    assert place[0] > START[0] + 2.0, "it flew"
    if mode == HOLD and fault is not Fault.SECOND_MASTER:  # which is left to the vehicle at once
        assert np.linalg.norm(velocity) < 0.5


def test_all_faults_of_a_vehicle_are_tried() -> None:
    tried = next(mark for mark in test_faults_over_the_wire_end_as_configured.pytestmark if mark.name == "parametrize")
    assert {row[0] for row in tried.args[1]} == set(OF_VEHICLE)


def test_it_leaves_the_clock_as_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[SimulatedClock] = []
    close = SimulatedClock.close
    monkeypatch.setattr(SimulatedClock, "close", lambda clock: (left.append(clock), close(clock)))
    with socket.create_server(("127.0.0.1", 0)) as server:
        clock = f"127.0.0.1:{server.getsockname()[1]}"
        assert simulated.main(["--clock", clock, "--mavlink", "nowhere"]) == 2
        assert simulated.main(["--clock", clock, "--mavlink", "udpout:127.0.0.1:9", "--seconds", "0"]) == 0
    assert len(left) == 2


def test_bad_input_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert simulated.main(["--mavlink", "nowhere", "--seconds", "0.01"]) == 2
    assert capsys.readouterr().err.startswith("vehicle: 'nowhere' cannot be opened")
    assert simulated.main(["--clock", "127.0.0.1:1"]) == 2
    assert "no simulated clock" in capsys.readouterr().err
