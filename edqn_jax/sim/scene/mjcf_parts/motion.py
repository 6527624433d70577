"""How mocap bodies of an MJCF world move, as text of the file says.

    <custom><text name="motion:door" data="oscillate 0 2 0 4 0"/></custom>

A moving obstacle is a mocap body, and a text `motion:` with the body's name holds a word and its numbers:

* `bounce VX VY VZ`: a steady velocity, m/s, turned back where the body would leave the site `volume`. Six more numbers
  are the lowest and the highest position of the body instead, metres.
* `oscillate AX AY AZ PERIOD PHASE`: back and forth by an amplitude, metres, once in PERIOD seconds; PHASE in periods.
* `circle RADIUS PERIOD PHASE`: level, anticlockwise from above, PHASE in turns from the x axis; clockwise where PERIOD
  is negative.
* `ellipse AX AY AZ BX BY BZ RATE PHASE`: A cos + B sin of an angle that grows by RATE rad/s from PHASE rad.
* `throw SHARE EARLY SPEED BEARING ELEVATION GRAVITY PACE`: a ball (a body of one sphere) that is launched EARLY seconds
  before it meets a drone that goes on as it flies at the launch. It is due when it would meet one that flies straight
  from start to goal at PACE m/s after that SHARE of the way. SPEED m/s; it comes from BEARING degrees to the left of
  the way to the goal and ELEVATION degrees above the horizon; GRAVITY m/s^2.

Where a body is drawn is where it is at time 0. A `;` joins a `bounce` and one of the others but `throw`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import mujoco
import numpy as np

from edqn_jax.sim.scene.mjcf_parts.files import SceneError
from edqn_jax.sim.scene.motion import LEAST_FLOWN_M, Throw, at_rest
from edqn_jax.sim.scene.scene import PARKED, Shape, Spheres
from edqn_jax.sim.scene.shapes.kind import kind_of, reach_of

PREFIX = "motion:"
"""Of the name of a text that says how a body moves."""

FASTEST = 100.0
"""Speed that no obstacle exceeds, m/s: contact is searched at eight points of a physics step."""

_COUNTS = {"bounce": (3, 9), "oscillate": (5,), "circle": (3,), "ellipse": (8,), "throw": (7,)}

MotionSpec = tuple[str, tuple[float, ...]]
"""A kind of motion, such as "bounce", and its numbers."""


def motions_of(model: mujoco.MjModel, title: str) -> dict[int, list[MotionSpec]]:
    """Returns the motions of a world's mocap bodies, by the number of the body.

    Args:
        model: of the world.
        title: of the world in messages.

    Raises:
        SceneError: if a text names no mocap body, or says what cannot be.
    """
    found = {}
    for i in range(model.ntext):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TEXT, i) or ""
        if not name.startswith(PREFIX):
            continue
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name.removeprefix(PREFIX))
        if body < 0 or model.body_mocapid[body] < 0:
            raise SceneError(f"{title}: the text '{name}' must name a body with mocap=\"true\"")
        begin = model.text_adr[i]
        data = bytes(model.text_data[begin : begin + model.text_size[i]]).rstrip(b"\0").decode()
        found[body] = _parse_motions(data, f"{title}: the text '{name}'")
    return found


def _parse_motions(data: str, title: str) -> list[MotionSpec]:
    specs = [_parse_motion(part.split(), title) for part in data.split(";")]
    words = [word for word, _ in specs]
    swings = [word for word in words if word not in ("bounce", "throw")]
    if words.count("bounce") > 1 or len(swings) > 1 or ("throw" in words and len(words) > 1):
        raise SceneError(f"{title} must be one motion, or a bounce and another one, not '{data}'")
    return specs


def _parse_motion(words: Sequence[str], title: str) -> MotionSpec:
    if not words or words[0] not in _COUNTS:
        raise SceneError(f"{title} must begin with {', '.join(_COUNTS)}, not '{' '.join(words)[:80]}'")
    word, counts = words[0], _COUNTS[words[0]]
    try:
        numbers = [float(number) for number in words[1:]]
    except ValueError:
        numbers = [math.nan]
    if len(numbers) not in counts or not np.all(np.isfinite(numbers)):
        many = " or ".join(map(str, counts))
        raise SceneError(f"{title} must have {many} numbers after '{word}', not '{' '.join(words[1:])[:80]}'")
    if word in ("oscillate", "circle") and numbers[-2] == 0:
        raise SceneError(f"{title} must have a period that is not 0")
    if word == "throw" and (numbers[0] < 0 or min(numbers[1], numbers[2], numbers[6]) <= 0):
        raise SceneError(f"{title} must have a share of 0 or more, and EARLY, SPEED and PACE above 0")
    if word == "throw" and numbers[1] * numbers[2] < LEAST_FLOWN_M * (1 - 1e-6):
        raise SceneError(f"{title} must begin {LEAST_FLOWN_M:g} m away or further: EARLY times SPEED")
    return word, tuple(numbers)


def as_ellipse(spec: MotionSpec) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Returns half axes [3] in metres, rate in rad/s and phase in rad of `oscillate`, `circle` or `ellipse`."""
    word, numbers = spec
    if word == "ellipse":
        return np.array(numbers[:3]), np.array(numbers[3:6]), numbers[6], numbers[7]
    rate, phase = 2 * math.pi / numbers[-2], 2 * math.pi * numbers[-1]
    if word == "oscillate":
        return np.zeros(3), np.array(numbers[:3]), rate, phase
    return np.array([numbers[0], 0, 0]), np.array([0, numbers[0], 0]), rate, phase


def set_in_motion(
    shapes: Sequence[Shape],
    specs: Sequence[MotionSpec],
    at: np.ndarray,
    volume: np.ndarray | None,
    title: str,
) -> list[Shape]:
    """Returns the shapes of one body with this motion.

    Args:
        shapes: of the body, where they are at time 0.
        specs: motion of the body.
        at: [3] position of the body at time 0, metres.
        volume: [2, 3] corners of the flight volume, metres; None where the file names none.
        title: of the world and the body in messages.

    Raises:
        SceneError: if the shapes cannot move so.
    """
    for kind in (kind_of(shape)[1] for shape in shapes):
        if kind.reach is None:
            raise SceneError(f"{title} has a {kind.geom}, which has no end and cannot move; use a box")
    if specs[0][0] == "throw":
        if len(shapes) != 1 or not isinstance(shapes[0], Spheres):
            raise SceneError(f"{title} is thrown and must be one sphere, nothing else")
        return [_thrown(shapes[0], specs[0][1], title)]
    how: Any = jax.tree.map(np.asarray, at_rest())
    low = high = np.zeros(3)
    for word, numbers in specs:
        if word == "bounce":
            how = dataclasses.replace(how, velocity=np.array(numbers[:3]))
            low, high = _walls(numbers, shapes, at, volume, title)
        else:
            a, b, rate, phase = as_ellipse((word, numbers))
            cos, sin = math.cos(phase), math.sin(phase)
            how = dataclasses.replace(how, swing=np.stack([cos * a + sin * b, cos * b - sin * a]), rate=rate)
    top = float(np.linalg.norm(how.velocity) + abs(how.rate) * np.linalg.norm(how.swing))
    if not top <= FASTEST:
        raise SceneError(f"{title} moves at {top:.0f} m/s; an obstacle may move at {FASTEST:g}")
    runs = how.velocity != 0

    def moving(shape: Any) -> Shape:
        walls = (np.where(runs, shape.position + way, 0) for way in (low, high))
        return dataclasses.replace(
            shape, motion=dataclasses.replace(how, **dict(zip(("low", "high"), walls, strict=True)))
        )

    return [moving(shape) for shape in shapes]


def _walls(
    numbers: tuple[float, ...],
    shapes: Sequence[Shape],
    at: np.ndarray,
    volume: np.ndarray | None,
    title: str,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns how far a body that bounces may move down and up each axis from where it is at time 0, [3] metres."""
    if len(numbers) == 9:
        low, high = np.array(numbers[3:6]) - at, np.array(numbers[6:9]) - at
        where = "between its lowest and its highest position"
    elif volume is None:
        raise SceneError(f"{title} bounces within the flight volume, which the file does not name; add a site 'volume'")
    else:
        middle, reach = np.stack([shape.position for shape in shapes]), np.stack([reach_of(shape) for shape in shapes])
        low = volume[0] - np.min(middle - reach, axis=0)
        high = volume[1] - np.max(middle + reach, axis=0)
        where = "within the flight volume"
    runs = np.array(numbers[:3]) != 0
    within = 1e-4  # metres; files round
    if np.any(runs & ((low > within) | (high < -within) | (high - low < within))):
        raise SceneError(f"{title} bounces and must be {where} at the beginning, with space to move")
    return np.minimum(low, 0.0), np.maximum(high, 0.0)


def _thrown(ball: Spheres, numbers: tuple[float, ...], title: str) -> Spheres:
    share, early, speed, bearing, elevation, gravity, pace = numbers
    if speed + abs(gravity) * early / 2 > FASTEST:
        raise SceneError(f"{title} is thrown faster than {FASTEST:g} m/s, which no obstacle may be")
    turned = math.radians(bearing), math.radians(elevation)
    throw = Throw(share, early, speed, *turned, gravity, pace)  # type: ignore[arg-type]
    return dataclasses.replace(ball, position=np.full(3, PARKED), throw=throw)


def text_of(shape: Shape) -> str | None:
    """Returns the motion of a single shape as text for MJCF, on a body at its position; None if it stands still."""
    throw, motion = getattr(shape, "throw", None), getattr(shape, "motion", None)
    if throw is not None:
        turned = math.degrees(throw.bearing), math.degrees(throw.elevation)
        return _text("throw", throw.share, throw.early, throw.speed, *turned, throw.gravity, throw.pace)
    if motion is None:
        return None
    texts = []
    if np.any(motion.velocity):
        texts.append(_text("bounce", *motion.velocity, *motion.low, *motion.high))
    if np.any(motion.swing) and motion.rate:
        texts.append(_text("ellipse", *np.ravel(motion.swing), motion.rate, 0.0))
    return "; ".join(texts)


def _text(word: str, *numbers: Any) -> str:
    return " ".join([word, *(f"{float(number):.9g}" for number in numbers)])
