"""The contract of a sensor: its output, and how other modules label, draw and embed it.

A new sensor is a `Sensor`, registered under a name for `env.sensor`; nothing else has to know it:

    from edqn_jax.config.registry import SENSORS

    SENSORS.register("mine", Sensor(show=..., shape=lambda config: (3,)))

The package's own are in `built_in.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.checks import first_difference
from edqn_jax.config import CameraConfig, Config
from edqn_jax.config.registry import SENSORS
from edqn_jax.errors import ConfigError
from edqn_jax.sim.actions import DIRECTIONS
from edqn_jax.sim.camera import camera
from edqn_jax.sim.camera.depth import nearest_depth
from edqn_jax.sim.camera.raycast import Rays
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import Scene, scene_at
from edqn_jax.sim.scene.shapes.kind import TINY
from edqn_jax.sim.sensors import event_field, event_laws, events, exposure, frame_clock
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.event_memory import EventMemory
from edqn_jax.sim.sensors.exposure import FrameMemory
from edqn_jax.user_code import check_functions, describe_object

Sensed = Any
"""What a sensor shows, an `EventField`, an array, a tree of these, or None; see `Sensor.shape`."""

SensorMemory = EventMemory | FrameMemory | Any
"""What a sensor carries from one decision to the next, a tree of arrays; None for nothing."""

EVENT_FIELD: Final = "events"
"""What `Sensor.shape` has in the place of an event field."""

MID_GREY = -1.0
"""Log brightness that `frames` shows as 0: about the middle of the range in a scene."""

HALF_NEAR_M = 4.0
"""Distance at which nearness is one half, metres: what a drone flies along an axis in a second."""

DEPTH_SCALE = 3.0
"""Value of `depth` at contact: its pictures then vary as much as frames do, and the VAE weighs both alike."""


@dataclasses.dataclass(frozen=True)
class Image:
    """How a sensor's image is taken from what it shows, and how it is labelled and coloured in figures."""

    label: str
    unit: str
    signed: bool = False
    """Whether it holds signed event counts: the colours are symmetric about 0. Otherwise they span the values."""
    picture: int = 0
    """Number of the picture that is drawn, of those that the sensor shows; of events it is their number."""


def flip_left_right(image: Array) -> Array:
    """Returns images [..., H, W] with left and right exchanged."""
    return jnp.flip(image, axis=-1)


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Functions and labels of one sensor. T frame times."""

    show: Callable[[Config, Scene, Flight, Any, Array], tuple[Sensed, Any]]
    """As `sense`."""
    shape: Callable[[Config], Any] = lambda config: None
    """Shape of what is shown of order 1: (V,) values, which the Q-network sees as they are; (C, H, W) pictures at the
    camera's resolution, or `EVENT_FIELD`, which the VAE embeds; or a tree, such as a dict, of values and one of these.
    None: nothing is shown, and the Q-network sees only the drone's own state."""
    frame_times_s: Callable[[Config], tuple[float, ...]] = lambda config: (0.0,)
    """Times of the T poses that `show` needs, seconds relative to the end of a decision; each is a physics step."""
    draws_frames: bool = False
    """Whether `show` draws a picture at each of these times."""
    makes_events: bool = False
    """Whether its memory has the episode's `contrast` and `lux`, which the networks can be told, as `EventMemory`."""
    exposes: bool = False
    """Whether its pictures are taken as `exposure` has it, from the poses up to a frame's time. With `exposure.real`
    its memory has the episode's `lux`, which the networks can be told, as `FrameMemory`."""
    at_rest: Callable[[Config, Array], Any] = lambda config, key: None
    """Memory before the first decision, from a key; None where nothing is carried from one decision to the next."""
    image: Image | None = None
    """How what is shown is drawn; None where it is not."""
    mirror: Callable[[Array], Array] = flip_left_right
    """Returns pictures [..., C, H, W], or images of events, as they would be with left and right exchanged."""

    def __post_init__(self) -> None:
        """Checks what each function takes.

        Raises:
            ConfigError: names the function and its arguments.
        """
        check_functions(
            self,
            {
                "show": "config, scene, poses, memory, key",
                "shape": "config",
                "frame_times_s": "config",
                "at_rest": "config, key",
                "mirror": "pictures",
            },
        )

    def encoder_input(self, config: Config, sensed: Sensed) -> EventField | Array | None:
        """Returns what the VAE reads: a field [..., F, H, W], pictures [..., C, H, W] joined, or None."""
        seen = self._parts(config, sensed, lambda shape: not _is_of_values(shape))
        return seen[0] if len(seen) == 1 else jnp.concatenate(seen, axis=-3) if seen else None

    def values(self, config: Config, sensed: Sensed) -> Array | None:
        """Returns the values [..., V] for the Q-network, concatenated, or None."""
        seen = self._parts(config, sensed, _is_of_values)
        return seen[0] if len(seen) == 1 else jnp.concatenate(seen, axis=-1) if seen else None

    def count_values(self, config: Config) -> int:
        """Returns V, the number of values that the Q-network sees as they are."""
        return sum(shape[0] for shape in self.shapes(config) if _is_of_values(shape))

    def shows_events(self, config: Config) -> bool:
        """Returns whether it shows an event field."""
        return EVENT_FIELD in self.shapes(config)

    def count_pictures(self, config: Config) -> int:
        """Returns C, the number of pictures; 0 where it shows none."""
        return sum(shape[0] for shape in self.shapes(config) if _is_of_pictures(shape))

    def picture(self, config: Config, sensed: Sensed) -> Array:
        """Returns the picture [..., H, W] for figures: signed event counts, or that of `image.picture`."""
        seen = self.encoder_input(config, sensed)
        assert seen is not None and self.image is not None
        if isinstance(seen, EventField):
            return event_field.event_image(seen)
        return seen[..., self.image.picture, :, :]

    def picture_of_target(self, config: Config, channels: Array) -> Array:
        """Returns the picture [..., H, W] of what a decoder draws of this sensor, [..., C, H, W] of
        `vae.decoder_target`.

        Of events it is their number, ON plus OFF.
        """
        assert self.image is not None
        if self.shows_events(config):
            return jnp.sum(jnp.expm1(channels), axis=-3)
        return channels[..., self.image.picture, :, :]

    def numbers(self, config: Config, sensed: Sensed) -> Array:
        """Returns what is shown as one array of order 1, for learners of other libraries.

        Of events it is the logarithm of each pixel's signed count, [..., H, W]; an array is itself; the parts of a tree
        are joined to one vector [..., N].
        """
        shapes = self.shapes(config)
        parts = self._parts(config, sensed, lambda shape: True)
        arrays = [signed_log(event_field.image_in_units(x)) if isinstance(x, EventField) else x for x in parts]
        if len(arrays) == 1:
            return arrays[0]
        axes = [2 if shape == EVENT_FIELD else len(shape) for shape in shapes]
        flat = [x.reshape(*x.shape[: x.ndim - n], -1) for x, n in zip(arrays, axes, strict=True)]
        return jnp.concatenate(flat, axis=-1)

    def shapes(self, config: Config) -> list[Any]:
        """Returns the shapes of what is shown, of a tree in its order.

        Raises:
            ConfigError: if one is none that `shape` may have.
        """
        found = jax.tree.leaves(self.shape(config), is_leaf=_is_shape)
        name, size = config.env.sensor, (config.camera.height, config.camera.width)
        for shape in found:
            if not (shape == EVENT_FIELD or _is_of_values(shape) or (_is_of_pictures(shape) and shape[1:] == size)):
                raise ConfigError(
                    f"the sensor '{name}' must show values (V,), pictures (C, {size[0]}, {size[1]}) of the camera's "
                    f"pixels, or EVENT_FIELD, not {shape}"
                )
        if EVENT_FIELD in found and (found.count(EVENT_FIELD) > 1 or any(map(_is_of_pictures, found))):
            raise ConfigError(f"the sensor '{name}' must show pictures or one EVENT_FIELD, not both or several")
        return found

    def check(self, config: Config, sensed: Sensed) -> None:
        """Raises unless `sensed` has the shape that `shape` says, in floating-point numbers.

        Raises:
            ConfigError: names both shapes, or the type of the numbers.
        """
        wanted, name = self.shape(config), config.env.sensor
        shown = jax.tree.map(lambda x: EVENT_FIELD if _is_field(x) else jnp.shape(x), sensed, is_leaf=_is_field)
        if wanted != shown:
            raise ConfigError(f"the sensor '{name}' shows {shown}, but its shape is {wanted}; both must be the same")
        for numbers in jax.tree.leaves(sensed, is_leaf=_is_field):
            if not (_is_field(numbers) or jnp.issubdtype(numbers.dtype, jnp.floating)):
                raise ConfigError(f"the sensor '{name}' must show float32 numbers, not {numbers.dtype}")

    def example(self, config: Config) -> Sensed:
        """Returns random data of the form that the sensor shows, the same at every call."""
        rng, size = np.random.default_rng(0), (config.camera.height, config.camera.width)

        def random(shape: Any) -> EventField | Array:
            if shape == EVENT_FIELD:
                return event_laws.random_field(config.events, *size, rng)
            return jnp.asarray(rng.random(shape, np.float32))

        self.shapes(config)
        return jax.tree.map(random, self.shape(config), is_leaf=_is_shape)

    def _parts(self, config: Config, sensed: Sensed, chosen: Callable[[Any], bool]) -> list[Any]:
        """Returns the parts of a sensor's output whose shapes meet a condition."""
        tree = jax.tree.structure(self.shape(config), is_leaf=_is_shape)
        pairs = zip(self.shapes(config), tree.flatten_up_to(sensed), strict=True)
        return [part for shape, part in pairs if chosen(shape)]


def signed_log(image: Array) -> Array:
    """Returns log(1 + count) of signed counts [...], with their sign."""
    counts = image.astype(jnp.float32)
    return jnp.sign(counts) * jnp.log1p(jnp.abs(counts))


def _is_field(tree: Any) -> bool:
    return isinstance(tree, EventField)


def _is_shape(tree: Any) -> bool:
    """Returns whether this is the shape of one array, or `EVENT_FIELD`."""
    return tree == EVENT_FIELD or (isinstance(tree, tuple) and all(isinstance(size, int) for size in tree))


def _is_of_values(shape: Any) -> bool:
    return _is_shape(shape) and shape != EVENT_FIELD and len(shape) == 1


def _is_of_pictures(shape: Any) -> bool:
    return _is_shape(shape) and shape != EVENT_FIELD and len(shape) == 3


def sensor_of(config: Config) -> Sensor:
    """Returns the sensor that `config` names.

    Raises:
        ConfigError: if there is none of that name.
    """
    return SENSORS.get(config.env.sensor)


def frame_steps(config: Config) -> tuple[int, ...]:
    """Returns the physics steps of a decision, 0..n, after which the sensor needs a pose.

    Raises:
        ConfigError: if there is none, or one is before the decision or after it.
    """
    n, times = config.drone.physics_steps, sensor_of(config).frame_times_s(config)
    steps = tuple(n + round(t / config.drone.physics_dt_s) for t in times)
    if not steps or not 0 <= min(steps) <= max(steps) <= n:
        raise ConfigError(
            f"`frame_times_s` of the sensor '{config.env.sensor}' must be times from "
            f"{-n * config.drone.physics_dt_s:g} to 0 s, relative to the end of a decision, not {times}"
        )
    return steps


def has_clock(config: Config) -> bool:
    """Returns whether the sensor's frames are those of a camera with a clock of its own."""
    return sensor_of(config).exposes and frame_clock.is_on(config.exposure)


def count_attitudes(config: Config) -> int:
    """Returns T, the number of attitudes of `attitudes_seen`."""
    return sensor_of(config).count_pictures(config) if has_clock(config) else len(frame_steps(config))


def attitudes_seen(poses: Flight, memory: SensorMemory) -> Array:
    """Returns the attitudes [T, 4] at which the sensor looked: at its poses, or by a clock at its frames' ends.

    Args:
        poses: that it was given.
        memory: after `sense`.
    """
    if isinstance(memory, FrameMemory) and memory.clock is not None and memory.clock.attitudes is not None:
        return memory.clock.attitudes
    return poses.quaternion


def frames_per_decision(config: Config) -> int:
    """Returns the number of pictures that are drawn for one decision."""
    if not sensor_of(config).draws_frames:
        return 0
    options = config.exposure
    if not sensor_of(config).exposes or exposure.is_perfect(options):
        return len(frame_steps(config))
    return sensor_of(config).count_pictures(config) * (options.sub_frames if options.real else 1)


def render_view(config: Config, scene: Scene, position: Array, quaternion: Array) -> Array:
    """Returns the camera's luma frame [H, W] on a body at `position` [3], metres, with attitude `quaternion` [4]."""
    return camera.render_luma(config.camera, scene, position, mount_rotation(config, quaternion))


def mount_rotation(config: Config, quaternion: Array) -> Array:
    """Returns the camera's [3, 3] body-to-world rotation: the heading alone when level, else the full attitude."""
    if config.camera.mount == "level":
        w, z = quaternion[0], quaternion[3]
        scale = jax.lax.rsqrt(jnp.maximum(w * w + z * z, 1e-9))
        quaternion = jnp.stack([w * scale, jnp.zeros_like(w), jnp.zeros_like(w), z * scale])
    w, x, y, z = quaternion
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def at_rest(config: Config, key: Array) -> SensorMemory:
    """Returns the sensor's memory before the first decision; None where it has none."""
    return sensor_of(config).at_rest(config, key)


def sense(config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array) -> tuple[Sensed, SensorMemory]:
    """Returns the sensor's output at the end of a decision, and its next memory.

    Args:
        scene: one world; each pose sees it as it stands at the pose's time.
        poses: [T, ...] after the physics steps of `frame_steps`, in order.
        memory: from `at_rest` or the decision before.
        key: consumed only by noise.

    Raises:
        ConfigError: if the sensor does not show what its `shape` says, or returns another memory than it is given.
    """
    sensor, name = sensor_of(config), config.env.sensor
    shown = sensor.show(config, scene, poses, memory, key)
    if not (isinstance(shown, tuple) and len(shown) == 2):
        raise ConfigError(
            f"`show` of the sensor '{name}' must return what is shown and its memory, not {describe_object(shown)}"
        )
    sensed, after = shown
    sensor.check(config, sensed)
    difference = first_difference(memory, after)
    if difference:
        raise ConfigError(
            f"`show` of the sensor '{name}' must return a memory like the one that it is given, and {difference}; "
            "`at_rest` returns the first one"
        )
    return sensed, after


def last_view(scene: Scene, poses: Flight) -> tuple[Scene, Array, Array]:
    """Returns the world as it stands at the last of the poses, its position [3] metres and its quaternion [4]."""
    time = None if poses.time is None else poses.time[-1]
    return scene_at(scene, time), poses.position[-1], poses.quaternion[-1]


def brightness(config: Config, luma: Array) -> Array:
    """Returns what `frames` shows of a luma frame [..., H, W]: log brightness (Eq. 1), whose changes make events.

    In the logarithm a contrast is the same in light and in shade; brightness itself varies so little that the VAE
    leaves part of its code unused (docs/baselines.md).
    """
    return events.log_brightness(config.events, luma) - MID_GREY


def nearness_image(config: Config, scene: Scene, position: Array, quaternion: Array) -> Array:
    """Returns what `depth` shows [H, W] from a body at `position` [3], metres, with attitude `quaternion` [4]."""
    metres = camera.render_depth(config.camera, scene, position, mount_rotation(config, quaternion))
    return DEPTH_SCALE * nearness(metres)


def label_image(config: Config, scene: Scene, position: Array, quaternion: Array) -> Array:
    """Returns what the decoder must draw of how near things are, as `nearness_image`; level with `encoder.levelled`."""
    if config.encoder.levelled:
        level = dataclasses.replace(config.camera, mount="level")
        # Of the whole attitude a level camera keeps the heading of body x, to which roll and pitch are relative.
        return DEPTH_SCALE * nearness(camera.render_depth(level, scene, position, mount_rotation(config, quaternion)))
    return nearness_image(config, scene, position, quaternion)


def nearness(distance: Array) -> Array:
    """Returns `1 / (1 + distance / HALF_NEAR_M)` of metres [...]: 1 at contact, 0 at infinity, steepest near 0."""
    return 1.0 / (1.0 + distance / HALF_NEAR_M)


def distance_of(nearness: Array) -> Array:
    """Returns the distance [...], metres, of a `nearness`: its inverse; 0 above 1, infinity at 0 and below."""
    return HALF_NEAR_M * (1.0 / jnp.clip(nearness, 0.0, 1.0) - 1.0)


def move_ranges(config: CameraConfig, scene: Scene, position: Array, yaw: Array) -> Array:
    """Returns metres [26] from `position` [3] to the nearest shape or face of the flight volume along each move.

    Exact rays from the body's centre along `moves.DIRECTIONS` at heading `yaw` [] radians. The centre must be inside
    the volume and outside all shapes.
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    ahead, left, up = jnp.asarray(DIRECTIONS.T)
    direction = jnp.stack([cos * ahead - sin * left, sin * ahead + cos * left, up])
    # One row of rays; the fields that describe a pixel's area do not affect where rays meet shapes.
    rays = Rays(
        dx=direction[None, 0],
        dy=direction[None, 1],
        dz=direction[None, 2],
        right=jnp.zeros(3),
        up=jnp.zeros(3),
        pitch=0.0,
        across=1,
        down=1,
    )
    to_shape = nearest_depth(scene, position, rays)[0]
    lower, upper = (jnp.abs(corner - position)[:, None] for corner in scene.volume)
    along = jnp.where(direction > 0, upper, lower) / jnp.maximum(jnp.abs(direction), TINY)
    to_face = jnp.min(jnp.where(jnp.abs(direction) > TINY, along, jnp.inf), axis=0)
    return jnp.minimum(to_shape, to_face)
