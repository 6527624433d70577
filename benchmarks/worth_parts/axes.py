"""What each axis of `worth.py` varies: what policies are trained with, what they see, and where they fly."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import success
from edqn_jax.config import Config, ExposureConfig

Layer = Mapping[str, Mapping[str, Any]]

CONTROLS = BLIND, DEPTH = "blind", "depth"
"""Controls that every axis has beside its sensors: what a policy comes to that sees nothing, or the truth."""

FRAMES = ("frames", "frame-pair", "frame-difference")
"""Sensors of a camera of frames."""

LOOKS = ("plaid", "drawn", "bricks", "posters", "wood", "blank")
"""Looks that are flown. Policies are trained in the first two; `blank` is among those of `drawn`, the others never."""

REAL_EVENTS = ("--events.profile", "dvs", "--events.threshold", "0.03", "--events.tolerance", "0.03")
REAL_FRAMES = ("--exposure.real",)
REAL = {BLIND: (), DEPTH: (), "events": REAL_EVENTS, "frames": REAL_FRAMES, "frame-pair": REAL_FRAMES}
"""Sensors with the faults of real ones, for axes with light."""

MEAN_OF = 117
"""Pixels of a sensor of 346 x 260 under one of 32 x 24."""
MEAN_EVENTS = ("--events.profile", "dvs", "--events.sensor-pixels", str(MEAN_OF))
MEAN_FRAMES = (
    *("--exposure.real", "--exposure.bits", "12", "--exposure.full-well-e", str(MEAN_OF * ExposureConfig.full_well_e)),
    *("--exposure.sensitivity-e-lux-s", str(MEAN_OF * ExposureConfig.sensitivity_e_lux_s)),
    *("--exposure.read-noise-e", str(MEAN_OF**0.5 * ExposureConfig.read_noise_e)),
)
MEAN = {"events": MEAN_EVENTS, "frames": MEAN_FRAMES, "frame-pair": MEAN_FRAMES}
"""Real sensors of one size, whose noise averages out alike: the events' thresholds are a real camera's 0.2."""
QUICK_PIXEL_LUX = 1.0
"""Light in which a pixel that needs little of it has the bandwidth that others have at `events.reference_lux`."""

LUX = (0.1, 1.0, 10.0, 100.0, 10_000.0)

SUNNY_LUX, SHADE = 10_000.0, 0.01
"""Light of a clear day, as much as there is here; brightness in the shade as a share of that in the sun."""
SHADOWS = {"no shadows": False, "shadows": True}
"""By condition: `camera.shadows`."""
IN_LIGHT = {
    "no shading": {"camera": {"shadows": False, "ambient": 1.0}},
    "dim sun": {"camera": {"shadows": False}, "light": {"least_lux": SHADE * SUNNY_LUX, "most_lux": SHADE * SUNNY_LUX}},
}
"""Each takes one of the two things away that go together in rooms with shadows: shading by the sun, or its light."""

AGES = (BLIND, DEPTH, "depth-late-1", "depth-late-2", "events", *FRAMES[:2])
CLOCK = "@"
"""Before the frames a second of a camera that has a clock, in a sensor's name; others take theirs at the decision."""
RATES_HZ = (30, 60, 120, 200)
LATENCY_S = 0.015
"""From the end of an exposure until a clocked frame is there: readout and transfer take 10 to 20 ms."""

QUICK = (
    *("--drone.physics-steps", "2", "--env.max-decisions", "400", "--events.frame-times-s", "-0.04", "0"),
    *("--agent.discount", "0.99", "--agent.n-step", "8", "--agent.history", "3", "--env.step-reward", "-0.03"),
    *("--encoder.hold-decisions", "20", "--env.collision-reward", "-100", "--env.left-volume-reward", "-100"),
)
"""Decisions at 25 Hz: what the defaults say of 0.26 s, said of 0.04 s; three observations for every sensor."""

SECONDS = ((0.3, 0.4), (0.4, 0.5), (0.5, 0.7), (0.7, 1.0))
SPEEDS_M_S = (6.0, 9.0, 12.0)
RADII_M = (0.15, 0.3)


@dataclasses.dataclass(frozen=True)
class Axis:
    """An axis of the map."""

    question: str
    worlds: Sequence[str]
    trained: Mapping[str, Sequence[str]]
    """By condition: options of training in it."""
    sensors: Mapping[str, Sequence[str]]
    """By `env.sensor`, with the rate of a camera with a clock behind it: options that the sensor has."""
    flown: Mapping[str, Layer]
    """By condition: what is otherwise than in training. A comma parts it into column and row of the figure."""
    flags: Sequence[str] = ()
    """Options of all rows."""
    same_trained: Sequence[str] = ()
    """Controls that see nothing of what differs between conditions of training, and are trained in one."""
    same_flown: bool = False
    """Whether the controls see nothing of what differs between the conditions that are flown."""
    borrowed: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """By sensor that the axis does not train: another axis, of the same task, whose rows of it are this one's."""

    @property
    def shown(self) -> list[str]:
        """Returns the sensors of a table: the controls, its own, and those of other axes."""
        return list(dict.fromkeys([*CONTROLS, *self.sensors, *self.borrowed]))


@dataclasses.dataclass(frozen=True)
class Place:
    """A row of an axis: a world, a condition of training and a sensor."""

    world: str
    trained: str
    sensor: str


DARK = Axis(
    "Light and speed",
    ("medium",),
    {f"{speed:g} m/s": ("--env.speed-m-s", str(speed)) for speed in (4.0, 8.0)},
    REAL,
    {f"{lux:g} lux": {"light": {"least_lux": lux, "most_lux": lux}} for lux in LUX},
    ("--light.least-lux", str(LUX[0]), "--light.most-lux", str(LUX[-1])),
    same_flown=True,
)

AXES: dict[str, Axis] = {
    "looks": Axis(
        "Looks never trained on",
        ("medium", "rooms"),
        {look: ("--surface.pattern", look) for look in LOOKS[:2]},
        dict.fromkeys((BLIND, DEPTH, "events", *FRAMES), ()),
        {look: {"surface": {"pattern": look}} for look in LOOKS},
        same_trained=CONTROLS,
        same_flown=True,
    ),
    "age": Axis(
        "Age of what is seen, and time to impact",
        ("court",),
        {"0.3 to 1 s": ()},
        dict.fromkeys(AGES, ())
        | {
            f"frame-pair{CLOCK}{rate}": ("--exposure.rate-hz", str(rate), "--exposure.latency-s", str(LATENCY_S))
            for rate in RATES_HZ
        },
        {
            f"{least:g} to {most:g} s, {speed:g} m/s": {
                "world": {"ball_seconds": (least, most), "ball_speed_m_s": speed, "ball_slowest": 1.0}
            }
            for speed in SPEEDS_M_S
            for least, most in SECONDS
        },
        (
            *QUICK,
            *("--world.balls", "4", "--world.ball-seconds", str(SECONDS[0][0]), str(SECONDS[-1][1])),
            *("--world.ball-speed-m-s", str(SPEEDS_M_S[-1]), "--world.ball-slowest", "0.5"),
            *("--world.ball-radii-m", *map(str, RADII_M)),
        ),
    ),
    "dark": DARK,
    "size": dataclasses.replace(
        DARK,
        question="Light and speed, cameras of one size",
        sensors=MEAN,
        borrowed=dict.fromkeys(CONTROLS, "dark"),
    ),
    "bandwidth": dataclasses.replace(
        DARK,
        question="Cameras of one size, events that need a tenth of the light",
        sensors={"events": (*MEAN_EVENTS, "--events.reference-lux", str(QUICK_PIXEL_LUX))},
        borrowed=dict.fromkeys(CONTROLS, "dark") | dict.fromkeys(("frames", "frame-pair"), "size"),
    ),
    "shade": Axis(
        "Sun and shade a hundred times darker",
        ("medium", "rooms", "courtyards"),
        {name: ("--camera.shadows",) if cast else () for name, cast in SHADOWS.items()},
        REAL,
        {name: {"camera": {"shadows": cast}} for name, cast in SHADOWS.items()} | IN_LIGHT,
        (
            *("--surface.pattern", "plaid", "--camera.ambient", str(SHADE)),
            *("--light.least-lux", str(SUNNY_LUX), "--light.most-lux", str(SUNNY_LUX)),
        ),
        same_trained=CONTROLS,
        same_flown=True,
    ),
    "turning": Axis(
        "A camera on the body, at speed among trunks",
        ("forest",),
        {f"{speed:g} m/s": ("--env.speed-m-s", str(speed)) for speed in (8.0, 12.0)},
        REAL,
        {f"{lux:g} lux": {"light": {"least_lux": lux, "most_lux": lux}} for lux in (50.0, 500.0)},
        (
            *("--camera.mount", "body", "--camera.width", "64", "--camera.height", "48"),
            *("--encoder.replay-size", "131072", "--light.least-lux", "50", "--light.most-lux", "500"),
        ),
        same_flown=True,
    ),
    "fine": Axis(
        "Thin trunks and wires, a camera on the body",
        ("wires",),
        {
            f"{width} x {height}": ("--camera.width", str(width), "--camera.height", str(height))
            for width, height in ((64, 48), (128, 96))
        },
        REAL,
        {f"{lux:g} lux": {"light": {"least_lux": lux, "most_lux": lux}} for lux in (50.0, 500.0)},
        (
            *("--camera.mount", "body", "--camera.samples-down", "3", "--env.speed-m-s", "8"),
            *("--encoder.replay-size", "65536", "--light.least-lux", "50", "--light.most-lux", "500"),
        ),
        same_trained=(BLIND,),
        same_flown=True,
    ),
}
"""By name."""


def places_of(axis: Axis, worlds: Sequence[str], trained: Sequence[str], sensors: Sequence[str]) -> list[Place]:
    """Returns those rows of an axis that are of these worlds, conditions of training and sensors; in its own order.

    A control that sees nothing of the conditions of training has the first of them alone.
    """
    first = next(iter(axis.trained))
    return [
        Place(world, condition, sensor)
        for world in axis.worlds
        for sensor in axis.sensors
        for condition in axis.trained
        if world in worlds and sensor in sensors and (condition in trained or is_first_alone(axis, sensor))
        if condition == first or not is_first_alone(axis, sensor)
    ]


def camera_of(sensor: str) -> str:
    """Returns the `env.sensor` of a sensor of an axis, whose name may have a clock behind it."""
    return sensor.partition(CLOCK)[0]


def is_first_alone(axis: Axis, sensor: str) -> bool:
    """Returns whether a sensor is trained in the first condition alone, and stands for all of them."""
    return sensor in axis.same_trained


def flown_of(axis: Axis, sensor: str) -> dict[str, Layer]:
    """Returns the conditions in which a policy of this sensor flies; the first stands for all that it cannot tell."""
    flown = dict(axis.flown)
    if axis.same_flown and sensor in CONTROLS:
        first = next(iter(flown))
        return {first: flown[first]}
    return flown


def config_of(axis: Axis, place: Place, flags: Sequence[str]) -> Config:
    """Returns the configuration of a row's first seed; `flags` are options of train.py beside those of the axis.

    Raises:
        ConfigError: if the options are invalid.
    """
    own = (*axis.flags, *axis.trained[place.trained], *axis.sensors[place.sensor])
    return success.config_of(place.world, camera_of(place.sensor), [*own, *flags])
