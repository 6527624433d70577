"""`edqn fly`: flies an exported policy over MAVLink, plays a flight again, or simulates flights over the wire."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import Point, check_is_saved, check_run, parse_arguments
from edqn_jax.cli.help import FLY
from edqn_jax.cli.process.signals import Stops
from edqn_jax.cli.process.status import show_phase
from edqn_jax.errors import CheckError, ConfigError, StoppedError, suggest_nearest
from edqn_jax.files import check_can_write, write_atomically

if TYPE_CHECKING:
    from edqn_jax.fly.faults import Settings
    from edqn_jax.fly.pilot import Report
    from edqn_jax.interop.deployment.runner import Runner
    from edqn_jax.interop.recordings.lens import Lens

Ending = Literal["hover", "hold", "land"]

OF_THE_WORLD = "mavlink events fov calibration contrast goal volume fence origin goal_radius max_s dry clock".split()
"""Options that a simulated flight has from its world."""

DARKENING = 0.4
"""Natural logarithm of how much darker the whole picture is from which on it has gone dark."""

OF_THE_LOG = ("fov", "contrast")
"""Options that a flight's log holds, where they are not given once more."""


@dataclass(frozen=True)
class FlyArgs:
    """Fly an exported policy over MAVLink from a camera's events; play a logged flight again; simulate flights."""

    policy: Annotated[Positional[Path], arg(metavar="POLICY")]
    """POLICY.onnx, as `edqn export` writes it; with --simulate the folder of a run, or a policy of the package, such as
    `pretrained-looks`."""
    simulate: Annotated[str | None, arg(metavar="WORLD", help_behavior_hint="")] = None
    """Fly here, in a world by name or an MJCF file: three processes, RotorPy's quadrotor, an ESIM's events."""
    missions: Annotated[int, arg(metavar="N")] = 1
    """With --simulate: how many; in a world of a file the same one again, with other errors of the vehicle."""
    jobs: Annotated[int, arg(metavar="J")] = 1
    """With --simulate: how many missions are flown at once, each on a core of its own."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """With --simulate: of the test worlds."""
    speed: Annotated[float, arg(metavar="X")] = 1.0
    """With --simulate: most simulated seconds a second. Where the machine is slower, the clock waits for it."""
    fault: Annotated[str | None, arg(metavar="FAULT", help_behavior_hint="")] = None
    """With --simulate: what goes wrong in each flight, such as "lost link", "low battery" or "process killed"."""
    fault_s: Annotated[tuple[float, float], arg(metavar="S S")] = (3.0, 8.0)
    """With --fault: between which simulated seconds, drawn for each mission."""
    picture: Literal["own", "mujoco"] = "own"
    """With --simulate: who draws what the camera sees."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """With --simulate: file for how each mission ended."""
    replay: Annotated[Path | None, arg(metavar="FLIGHT", help_behavior_hint="")] = None
    """Play the log of a flight again, and compare what state machine and policy do with what they did."""
    mcap: Annotated[Path | None, arg(metavar="FILE.mcap", help_behavior_hint="")] = None
    """With --replay: also write that flight as MCAP, for Foxglove and others."""
    mavlink: Annotated[str, arg(metavar="ADDRESS")] = "udpin:0.0.0.0:14540"
    """The vehicle, as pymavlink writes it: udpin:HOST:PORT, tcp:HOST:PORT, or DEVICE,BAUD."""
    events: Annotated[str | None, arg(metavar="SOURCE", help_behavior_hint="")] = None
    """The camera: dv:HOST:PORT (dv-processing's network writer), tcp:HOST:PORT (the stream of
    `edqn_jax.fly.streams`), or a recording, played at its own speed."""
    camera: Annotated[tuple[int, int] | None, arg(metavar="W H", help_behavior_hint="")] = None
    """Pixels of the camera across and down (default: with --simulate 346 260, else what it says)."""
    fov: Annotated[float | None, arg(metavar="DEG", help_behavior_hint="")] = None
    """Horizontal field of view of the camera, degrees (default: the policy's; with --replay the log's)."""
    calibration: Annotated[str | None, arg(metavar="FILE[:CAMERA]", help_behavior_hint="")] = None
    """The camera's lens, in place of --fov: YAML of Kalibr or in DSEC's layout (of a camera other than cam0, with its
    name); with --replay the log's."""
    contrast: Annotated[float | None, arg(metavar="C", help_behavior_hint="")] = None
    """Change of log brightness that makes an event in the camera (default: the policy's; with --replay the log's)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal in the policy's world: metres east, north, up."""
    volume: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="X Y Z X Y Z", help_behavior_hint=""),
    ] = None
    """Lowest and highest corner of the flight volume, which the policy is told, as large as in training."""
    fence: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="X Y Z X Y Z", help_behavior_hint=""),
    ] = None
    """Lowest and highest corner of what must not be left (default: the volume)."""
    origin: Annotated[Point, arg(metavar="X Y Z")] = (0.0, 0.0, 0.0)
    """Where the vehicle's local frame begins, in the policy's world."""
    goal_radius: Annotated[float, arg(metavar="M")] = 1.0
    """How near is there, metres."""
    pace: Annotated[float, arg(metavar="X")] = 1.0
    """Share of the policy's speed, from 0.2 to 1, with all its times as much longer, for a vehicle that is slower to
    follow: it needs the square of this share of the acceleration."""
    after_hover: Literal["hold", "land"] = "hold"
    """What follows a hover of 3 s after a fault, and a flight that takes too long."""
    at_goal: Ending = "hold"
    """What follows the goal."""
    on: Annotated[tuple[str, ...], arg(metavar="FAULT=ACTION", help_behavior_hint="")] = ()
    """What is done about a fault, hover, hold or land, as in "low battery=hold"; docs/deployment.md has their names,
    and what is done otherwise."""
    max_s: Annotated[float, arg(metavar="S")] = 300.0
    """Longest flight, seconds."""
    least_rate: Annotated[float, arg(metavar="HZ")] = 0.1
    """Events per second and pixel that a drone in motion sees through an open lens; set it above the camera's noise.
    A lens that sees fewer for 0.4 s after the whole picture went dark, or from the start on, is covered."""
    unseen_s: Annotated[float, arg(metavar="S")] = 8.0
    """So long a lens that did not go dark may see fewer, as before blank walls; longer with a slower --pace."""
    dry: bool = False
    """Bench test with props off: decides and logs, sends zero velocity, asks for no mode."""
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Where everything is logged (default: nowhere)."""
    clock: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="")] = None
    """Clock of a simulation; --simulate gives it."""


def parse_fly(argv: Sequence[str]) -> FlyArgs:
    """Returns the checked arguments of `edqn fly`.

    Raises:
        ConfigError: if one is missing, out of its limits, or does not go with another.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = parse_arguments(FlyArgs, argv, FLY)
    if args.simulate is not None and args.replay is not None:
        raise ConfigError("--simulate flies and --replay plays a flight again; give one of them")
    if min(args.missions, args.jobs) < 1 or args.seed < 0 or args.speed <= 0:
        raise ConfigError("--missions and --jobs must be at least 1, --seed at least 0 and --speed more than 0")
    check_fault(args)
    if args.camera is not None and min(args.camera) < 1:
        raise ConfigError(f"--camera must be two whole numbers of at least 1, not {args.camera[0]} {args.camera[1]}")
    if args.mcap is not None and args.replay is None:
        raise ConfigError("--mcap writes a flight that --replay plays; give --replay FLIGHT, too")
    if args.mcap is not None and args.mcap.suffix != ".mcap":
        raise ConfigError(f"'{args.mcap}' must end in .mcap")
    if args.fov is not None and args.calibration is not None:
        raise ConfigError("--fov and --calibration cannot both be given: a calibration says the field of view")
    if not 0.2 <= args.pace <= 1.0:
        raise ConfigError(f"--pace must be from 0.2 to 1, not {args.pace:g}")
    if not (args.least_rate >= 0 and args.unseen_s > 0):
        raise ConfigError("--least-rate must be at least 0 and --unseen-s more than 0")
    actions_of(args.on)
    if args.json is not None:
        check_can_write(args.json)
    if args.simulate is not None:
        if args.policy.suffix == ".onnx":
            raise ConfigError(
                f"--simulate needs the folder of a run, or a policy of the package, such as pretrained-looks, not "
                f"'{args.policy}', which does not say what it was trained for"
            )
        check_is_saved(args.policy, f"{FLY} --simulate")
        check_run(args.policy)
        for each in fields(FlyArgs):
            if each.name in OF_THE_WORLD and getattr(args, each.name) != each.default:
                raise ConfigError(f"--simulate gives --{each.name.replace('_', '-')} itself; leave it out")
        return args
    if args.policy.suffix != ".onnx":
        raise ConfigError(f"'{args.policy}' must be an exported policy; 'edqn export {args.policy}' writes one")
    if args.replay is None:
        for name in ("events", "goal", "volume"):
            if getattr(args, name) is None:
                raise ConfigError(f"--{name} is missing; '{FLY} --help' says what it is")
    return args


def check_fault(args: FlyArgs) -> None:
    """Raises ConfigError if there is no such fault to simulate, or it would strike at no time."""
    from edqn_jax.fly.simulated.injected import FAULTS

    if not 0.0 <= args.fault_s[0] <= args.fault_s[1] < math.inf:
        raise ConfigError("--fault-s must be two times of at least 0, the earlier one first")
    if args.fault is None:
        return
    if args.simulate is None:
        raise ConfigError("--fault goes with --simulate: nothing else goes wrong on purpose")
    if args.fault not in FAULTS:
        raise ConfigError(f"--fault '{args.fault}' cannot be simulated{suggest_nearest(args.fault, FAULTS)}")


def actions_of(words: Sequence[str]) -> dict:
    """Returns the action of each fault that words such as `low battery=hold` name.

    Raises:
        ConfigError: if there is no such fault or action.
    """
    from edqn_jax.fly.faults import Action, Fault

    found = {}
    for word in words:
        fault, _, action = word.partition("=")
        if fault not in list(Fault):
            raise ConfigError(f"there is no fault '{fault}'{suggest_nearest(fault, list(Fault))}")
        if action not in list(Action):
            raise ConfigError(f"a fault is answered by hover, hold or land, not by '{action}'")
        found[Fault(fault)] = Action(action)
    return found


def fly_command(args: FlyArgs, stops: Stops) -> None:
    """Runs `edqn fly` with these arguments.

    Raises:
        CheckError: if a flight ended otherwise than at its goal, or a replay differs.
        ConfigError: if policy, camera or vehicle are not as they should be; nothing was sent then.
        MissingPackageError: if a package of the extra `fly` or `transfer` is not installed.
        StoppedError: if a signal ended the flight.
    """
    if args.simulate is not None:
        simulate(args)
    elif args.replay is not None:
        replay(args, args.replay)
    else:
        fly(args, stops)


def fly(args: FlyArgs, stops: Stops) -> None:
    """Flies one mission."""
    import numpy as np

    from edqn_jax.fly.clocks import WallClock
    from edqn_jax.fly.link import Link
    from edqn_jax.fly.pilot import Pilot, Task
    from edqn_jax.fly.records import FlightLog
    from edqn_jax.fly.simulated.lockstep import SimulatedClock
    from edqn_jax.fly.streams import open_events
    from edqn_jax.interop.recordings.lens import read_lens
    from edqn_jax.policies.sizes import describe_larger

    assert args.events is not None and args.volume is not None
    with contextlib.ExitStack() as stack:
        source = open_events(args.events, args.camera)
        stack.callback(source.close)
        size = source.events.size
        assert size is not None
        lens = None if args.calibration is None else read_lens(args.calibration)
        runner = load_runner(args, size, lens)
        settings = settings_of(args, size, runner.period_s / args.pace)
        known = runner.about.get("trained_in", [])  # older files hold no sizes
        for warning in describe_larger(np.subtract(args.volume[3:], args.volume[:3]), known):
            print(warning)
        link = Link(args.mavlink, args.origin)
        stack.callback(link.close)
        log = None
        if args.out is not None:
            log = FlightLog(args.out)
            stack.callback(log.close)
        clock = WallClock()
        if args.clock is not None:
            clock = SimulatedClock(args.clock, "autopilot")
            stack.callback(clock.close)
        stack.enter_context(stops.obey_signals(lambda _: None))
        task = Task(settings, np.reshape(args.volume, (2, 3)), args.pace, args.dry, args.fov, args.contrast, lens)
        show_phase("flying")
        pilot = Pilot(runner, link, source, clock, task, log=log, stop=stops.is_requested)
        try:
            report = pilot.fly()
        except ConnectionError:
            if args.clock is None:
                raise
            return  # the clock's keeper says why it ended
    end(report, stops)


def end(report: Report, stops: Stops) -> None:
    """Prints how a flight ended, and raises unless it was at its goal."""
    if parts := report.latency.percentiles():
        print(f"{latency_sentence(parts)}; longest gap {1e3 * report.longest_gap_s:.0f} ms")
    sentence = f"{report.outcome} after {report.seconds:.1f} s and {report.decisions} decisions"
    if report.outcome == "goal":
        print(f"reached the {sentence}")
        return
    if stops.is_requested():
        raise StoppedError(f"the flight was stopped: {sentence}")
    if report.outcome.startswith("refused: "):
        raise ConfigError(f"no flight: {report.outcome.removeprefix('refused: ')}")
    raise CheckError(f"the flight ended with {sentence}")


def latency_sentence(parts: Mapping[str, Sequence[float]]) -> str:
    """Returns medians and 99th percentiles of parts of the latency, as people read them."""
    said = ", ".join(f"{name} {median:.1f} / {p99:.1f}" for name, (median, p99) in parts.items())
    return f"newest event to setpoint, ms, median / 99 %: {said}"


def load_runner(args: FlyArgs, size: tuple[int, int], lens: Lens | None) -> Runner:
    """Returns the policy for a camera of a size.

    Raises:
        ConfigError: if the file is no policy, or the camera is not that of --camera or of the lens, or cannot stand for
            the policy's.
        MissingPackageError: if onnxruntime is not installed.
    """
    from edqn_jax.extras import require_extra
    from edqn_jax.interop.deployment.runner import Runner

    require_extra("onnxruntime", "fly")
    if args.camera is not None and args.camera != size:
        told = f"{args.camera[0]} x {args.camera[1]}"
        raise ConfigError(f"the camera has {size[0]} x {size[1]} pixels, and --camera says {told}")
    directions = None
    if lens is not None:
        lens.check_size(size, args.calibration or "of the log")
        directions = lens.directions()
    try:
        runner = Runner(
            args.policy, camera=size, camera_fov_deg=args.fov, contrast=args.contrast, directions=directions
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return runner


def settings_of(args: FlyArgs, size: tuple[int, int], period_s: float) -> Settings:
    """Returns what a flight is to do.

    Raises:
        ConfigError: if it could not be ended so, or a box's first corner is not the lower one.
    """
    import numpy as np

    from edqn_jax.fly.faults import Action, Limits, Settings

    assert args.volume is not None and args.goal is not None
    boxes = {"volume": np.reshape(args.volume, (2, 3))}
    boxes["fence"] = boxes["volume"] if args.fence is None else np.reshape(args.fence, (2, 3))
    for name, box in boxes.items():
        if not np.all(box[0] < box[1]):
            raise ConfigError(f"--{name} must be its lowest and its highest corner, each coordinate of the first lower")
    try:
        return Settings(
            goal=np.array(args.goal),
            fence=boxes["fence"],
            camera=size,
            period_s=period_s,
            goal_radius_m=args.goal_radius,
            actions=actions_of(args.on),
            after_hover=Action(args.after_hover),
            at_goal=Action(args.at_goal),
            flight_s=args.max_s,
            limits=Limits(
                covered_hz=args.least_rate,
                unseen_s=args.unseen_s / args.pace,
                darkening=darkening_of(args.contrast, Limits.darkening),
            ),
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error


def darkening_of(contrast: float | None, untold: float) -> float:
    """Returns by how many OFF events a pixel a camera of this contrast sees its picture go dark; `untold` without one.

    As much less light makes more events of a smaller contrast.
    """
    return untold if contrast is None else DARKENING / contrast


def replay(args: FlyArgs, folder: Path) -> None:
    """Plays a flight again."""
    from edqn_jax.fly.mcap_file import write_mcap
    from edqn_jax.fly.records import lens_of, read_records
    from edqn_jax.fly.replay import replay as play
    from edqn_jax.interop.recordings.lens import read_lens

    show_phase("playing the flight again")
    begun = next((each for each in read_records(folder) if each["kind"] == "settings"), None)
    runner = None
    if begun is not None:
        width, height = begun["settings"]["camera"]
        told = {name: begun.get(name) if getattr(args, name) is None else getattr(args, name) for name in OF_THE_LOG}
        lens = lens_of(begun.get("lens")) if args.calibration is None else read_lens(args.calibration)
        if args.fov is not None:
            lens = None
        elif lens is not None:
            told["fov"] = None
        runner = load_runner(replace(args, camera=None, **told), (width, height), lens)
    again = play(folder, runner)
    print(
        f"{again.ticks:,} ticks, {again.other_outputs} of them with another output; {again.decisions:,} decisions, "
        f"{again.other_moves} of them another move; outcome: {again.outcome}"
    )
    if args.mcap is not None:
        print(f"'{args.mcap}' has {write_mcap(folder, args.mcap):,} messages")
    if again.other_outputs or again.other_moves:
        raise CheckError(f"the flight in '{folder}' goes another way once more")


def simulate(args: FlyArgs) -> None:
    """Flies missions here, over the wire."""
    import tempfile

    if args.picture == "mujoco":
        from edqn_jax.interop.outer.opengl import load_mujoco

        load_mujoco()

    from edqn_jax.config import FAMILIES
    from edqn_jax.runs.policies import load_policy
    from edqn_jax.sim.environment import make

    assert args.simulate is not None
    show_phase("reading policy and world")
    policy = load_policy(args.policy)
    # Before packages are missed that a flight needs: a world that there is none of is the first thing to say.
    count = args.missions if args.jobs == 1 and args.simulate in FAMILIES else 1
    environment = make(args.simulate, policy.config, worlds=count, seed=args.seed, split="test")

    from edqn_jax.evaluation.metrics import wilson_interval
    from edqn_jax.evaluation.world_check import warn_of_training
    from edqn_jax.fly.simulated.missions import Setup, fly_missions
    from edqn_jax.fly.simulated.several import fly_at_once
    from edqn_jax.interop.deployment.onnx_export import export_policy

    show_phase("exporting the policy")
    asked = args.simulate, policy.config, args.missions, args.seed
    there = replace(policy.config, world=replace(policy.config.world, name=args.simulate))
    for warning in warn_of_training(there, policy.config):
        print(warning)
    ended = []
    with tempfile.TemporaryDirectory() as folder:
        file = export_policy(policy, Path(folder) / "policy.onnx").file
        size = (346, 260) if args.camera is None else args.camera
        answers = ["--after-hover", args.after_hover, "--at-goal", args.at_goal]
        limits = ["--least-rate", repr(args.least_rate), "--unseen-s", repr(args.unseen_s)]
        more = (*answers, *limits, *(("--on", *args.on) if args.on else ()))
        how = {"speed": args.speed, "picture": args.picture, "pace": args.pace}
        how |= {"fault": args.fault, "fault_s": args.fault_s}
        setup = Setup(file, size, **how, out=args.out, autopilot=more)
        flown = (
            fly_missions(environment, args.missions, setup)
            if args.jobs == 1
            else fly_at_once(*asked, setup, jobs=args.jobs)
        )
        show_phase("flying", 0, args.missions)
        for mission in flown:
            ended = sorted([*ended, mission], key=lambda each: each.number)
            show_phase("flying", len(ended), args.missions)
            struck = "" if mission.fault_s is None else f"{args.fault} at {mission.fault_s:.1f} s; "
            print(
                f"mission {mission.number}: {struck}{mission.outcome} after {mission.seconds:.1f} s, "
                f"{mission.clearance_m:.2f} m clear at least; {mission.events_hz:,.0f} events/s; "
                f"{mission.speed:.2f} simulated seconds a second; "
                f"{latency_sentence(mission.latency)}",
                flush=True,
            )
            if args.json is not None:  # after each: who is cut off has those that ended
                write_atomically(args.json, json.dumps([asdict(each) for each in ended], indent=2) + "\n")
    reached = sum(each.outcome == "goal" for each in ended)
    low, high = wilson_interval(reached, len(ended))
    print(f"{reached} of {len(ended)} reached the goal ({100 * low:.0f} to {100 * high:.0f} %, Wilson)")
