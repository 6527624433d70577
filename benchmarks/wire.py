"""How long from the newest event to the setpoint on the wire, and how steadily do setpoints come, in real time?

The pilot's loop flies the simulated vehicle over MAVLink on the machine's clock, alone on one core, and decides on
events of a camera that sees a simulated flight again and again. Vehicle and camera are processes on the other cores;
with --busy each of these has a program beside them that never rests. Needs the extras `fly` and `export`.

    python benchmarks/wire.py --minutes 10 --busy --json wire.json

Latency: from when the camera knew of its newest event, on the same clock, to when the socket had the setpoint.
"""

from __future__ import annotations

from measurement.command import Parser, in_a_sentence

import argparse
import contextlib
import dataclasses
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.trajectories import flight_trajectory
from edqn_jax.fly.clocks import ClockOffset, WallClock
from edqn_jax.fly.faults import Fault, Limits, Settings
from edqn_jax.fly.link import Link
from edqn_jax.fly.pilot import GAP_S, Pilot, Report, Task
from edqn_jax.fly.records import FlightLog
from edqn_jax.fly.simulated.camera import EventCamera, EventServer
from edqn_jax.fly.simulated.ports import hold_udp_port
from edqn_jax.fly.streams import EVENT, SocketStream
from edqn_jax.interop.deployment.onnx_export import export_policy
from edqn_jax.interop.deployment.runner import Runner
from edqn_jax.interop.outer.event_cameras import CONTRAST
from edqn_jax.interop.outer.pictures import own_pictures
from edqn_jax.interop.outer.poses import Track, camera_rotation
from edqn_jax.interop.recordings.flight_events import flight_recording
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.policies import load_policy
from edqn_jax.sim.environment import make
from measurement import json_report
from measurement.cores import keep_to, own_cores

WORLD = "medium"
"""Where the camera flies: the first test world."""

FRAME_S = 0.005
"""Between two packets of the camera."""

FAR_M = 1e5
"""The flight's goal and fence are so far away that neither is reached."""

BUSY = "while True: pass"


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments.

    Raises:
        ConfigError: if one is out of its limits, or the machine has one core alone.
    """
    parser = Parser("wire", __doc__)
    parser.add_argument(
        "run", nargs="?", type=Path, default=Path("pretrained-looks"), help="folder of a run, or a name"
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="how long is flown (default 1)")
    parser.add_argument("--busy", action="store_true", help="keep the other cores busy")
    parser.add_argument("--camera", nargs=2, type=int, default=[346, 260], metavar=("W", "H"), help="its pixels")
    parser.add_argument("--pace", type=float, default=1.0, help="as of edqn fly")
    parser.add_argument("--seen", type=float, default=10.0, help="seconds of flight that the camera repeats")
    parser.add_argument("--first", action="store_true", help="pilot and camera come before all else (SCHED_FIFO)")
    parser.add_argument("--no-log", action="store_true", help="log nothing (a log has some GB in ten minutes)")
    args = parser.parse(argv)
    if min(args.minutes, args.seen, args.pace) <= 0.0 or args.pace > 1.0 or min(args.camera) < 1:
        raise ConfigError("--minutes, --seen and --pace must be above 0, --pace at most 1, --camera's sides at least 1")
    if len(own_cores()) < 2:
        raise ConfigError("vehicle and camera need a core beside the pilot's, and this process may use one alone")
    return args


def come_first() -> None:
    """Lets this process run whenever it wants to.

    Raises:
        ConfigError: if it may not, or the system cannot.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except (OSError, AttributeError) as error:
        raise ConfigError(f"--first cannot be had ({error}); it needs Linux, and root or CAP_SYS_NICE") from None


def seen_packets(policy: Policy, size: tuple[int, int], seconds: float) -> list[NDArray]:
    """Returns a packet [N] of `EVENT` for each `FRAME_S` of the policy's flight, as a camera of a size sees it."""
    config = policy.config
    missions = load_missions(config, WORLD, 1, 0, None, None)
    flights = fly_on_all_devices(config, missions.env_params, policy.params, 0, record=True)
    flown = flight_recording(config, missions.env_params, flight_trajectory(config, flights)).flight
    assert flown is not None
    track = Track(1e-6 * flown["t"], *(flown[name].astype(np.float64) for name in ("position", "quaternion")))
    lens = dataclasses.replace(config.camera, width=size[0], height=size[1])
    see = own_pictures(dataclasses.replace(config, camera=lens), make(WORLD, config, worlds=1, split="test"), 0)
    camera = EventCamera(see, lambda attitude: camera_rotation(attitude, config.camera.mount))
    frames = round(min(seconds, float(track.time[-1])) / FRAME_S)
    return [camera.frame(FRAME_S * k, *track.at(FRAME_S * k))[1] for k in range(frames)]


def stream(file: Path, size: tuple[int, int], chosen: Sequence[int], first: bool, address: Any) -> None:
    """Is the camera's process: sends its address, then packets of a file again and again on the machine's clock."""
    keep_to(chosen)
    if first:
        come_first()
    with np.load(file) as held:
        packets = np.split(held["events"], held["ends"][:-1])
    server, clock = EventServer(size), WallClock()
    address.send(server.address)
    began, frame = clock.now(), 0
    while multiprocessing.parent_process().is_alive():  # pyright: ignore[reportOptionalMemberAccess]
        frame = max(frame + 1, int((clock.now() - began) / FRAME_S))  # one that is late leaves frames out
        clock.sleep_until(began + frame * FRAME_S)
        until = round(1e6 * clock.now())
        events = packets[frame % len(packets)].copy()
        events["t"] = until - 1
        server.send(until, events)


class OwnClock(ClockOffset):
    """The camera's clock is the machine's."""

    value = 0.0

    def __init__(self) -> None:
        self.jumps = 0

    def add_arrival(self, other: float, received: float) -> None:
        """Learns nothing."""


@contextlib.contextmanager
def others(
    packets: Sequence[NDArray], size: tuple[int, int], chosen: Sequence[int], *, busy: bool, first: bool
) -> Iterator[Any]:
    """Yields address of the vehicle and of the camera, processes that run on the chosen cores within the block."""
    fresh = multiprocessing.get_context("spawn")
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        ends = np.cumsum([len(each) for each in packets])
        np.savez(folder / "seen.npz", events=np.concatenate([np.empty(0, EVENT), *packets]), ends=ends)
        here, there = fresh.Pipe()
        camera = fresh.Process(target=stream, args=(folder / "seen.npz", size, chosen, first, there), daemon=True)
        camera.start()
        stack.callback(camera.terminate)
        port, let_go = hold_udp_port()
        stack.callback(let_go)
        vehicle = ["-m", "edqn_jax.fly.simulated.vehicle", "--mavlink", f"udpout:127.0.0.1:{port}"]
        programs = [vehicle, *([["-c", BUSY]] * len(chosen) if busy else [])]
        own = own_cores()
        keep_to(chosen)  # so that the programs are kept there, too
        for words in programs:
            program = subprocess.Popen([sys.executable, *words])
            stack.callback(program.wait)
            stack.callback(program.kill)
        keep_to(own)
        if not here.poll(60.0):
            raise ConfigError("the camera's process did not start")
        let_go()
        yield f"udpin:127.0.0.1:{port}", here.recv()


def fly(runner: Runner, vehicle: str, camera: str, args: argparse.Namespace) -> tuple[Report, Counter[str]]:
    """Flies so many minutes and returns how, and how often each fault came."""
    size, said = (args.camera[0], args.camera[1]), []
    with contextlib.ExitStack() as stack:
        source = SocketStream(camera)
        stack.callback(source.close)
        source.events.offset = OwnClock()
        link = Link(vehicle)
        stack.callback(link.close)
        log = None
        if not args.no_log:
            log = FlightLog(Path(stack.enter_context(tempfile.TemporaryDirectory())) / "flight")
            stack.callback(log.close)
        settings = Settings(
            goal=np.array([FAR_M / 2, 0.0, 5.0]),
            fence=np.array([[-FAR_M] * 3, [FAR_M] * 3]),
            camera=size,
            period_s=runner.period_s / args.pace,
            resumes=10**9,
            flight_s=60.0 * args.minutes,
            # A simulated vehicle that waits for a core lags behind its own clock, which is no fault of the pilot's.
            limits=Limits(battery=0.0, link_s=60.0, stale_s=10.0, jump_m=np.inf, drift_m=np.inf),
        )
        volume = [[0.0, 0.0, 0.0], [110.0, 110.0, 25.0]]
        pilot = Pilot(runner, link, source, WallClock(), Task(settings, volume, args.pace), log=log, tell=said.append)
        report = pilot.fly()
    return report, Counter(fault for line in said for fault in Fault if f"({fault})" in line and "hovering" in line)


def measure(policy: Policy, args: argparse.Namespace) -> dict[str, Any]:
    """Returns the report that `--json` writes."""
    size = (args.camera[0], args.camera[1])
    packets = seen_packets(policy, size, args.seen)
    with tempfile.TemporaryDirectory() as folder:
        runner = Runner(export_policy(policy, Path(folder) / "policy.onnx").file, camera=size, contrast=CONTRAST)
    pilot, *rest = own_cores()
    with others(packets, size, rest, busy=args.busy, first=args.first) as (vehicle, camera):
        keep_to([pilot])
        if args.first:
            come_first()
        report, faults = fly(runner, vehicle, camera, args)
        if args.first:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        keep_to([pilot, *rest])
    if report.outcome != "time out":
        raise ConfigError(f"the flight ended after {report.seconds:.1f} s with {report.outcome}")
    rate = sum(len(each) for each in packets) / (FRAME_S * len(packets))
    return {
        **json_report.machine(jax.devices()),
        "camera": list(size),
        "events_per_second": rate,
        "events_per_decision": rate * 1e-6 * runner.window_us / args.pace,
        "busy": args.busy,
        "logged": not args.no_log,
        "pace": args.pace,
        "first": args.first,
        "seconds": report.seconds,
        "decisions": report.decisions,
        "longest_gap_ms": 1e3 * report.longest_gap_s,
        "gaps_over_100_ms": report.gaps,
        "faults": dict(faults),
        "rows": [
            {"name": name, "median_ms": median, "p99_ms": p99}
            for name, (median, p99) in report.latency.percentiles().items()
        ],
    }


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    args = parse(argv)
    report = measure(load_policy(args.run), args)
    width, height = report["camera"]
    print(
        f"{report['decisions']:,} decisions on {report['events_per_decision']:,.0f} events each of {width} x {height} "
        f"pixels, on one core, the others {'busy' if args.busy else 'with vehicle and camera alone'}; newest event to "
        "setpoint, ms, median / 99 %:"
    )
    for row in report["rows"]:
        print(f"  {row['name']:10} {row['median_ms']:7.2f} {row['p99_ms']:7.2f}")
    faults = ", ".join(f"{name} {count}" for name, count in report["faults"].items()) or "none"
    print(
        f"{report['gaps_over_100_ms']} gaps over {1e3 * GAP_S:.0f} ms between setpoints in {report['seconds']:.0f} s, "
        f"the longest of {report['longest_gap_ms']:.0f} ms; faults: {faults}"
    )
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
