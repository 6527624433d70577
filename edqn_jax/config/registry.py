"""Registries: what can be named in an option, the package's own entries and other people's.

Built-in entries are held as `module:name` and imported when they are first asked for, so that the names are known
before JAX is imported. What somebody registers is checked at once, by the function that a registry is made with.
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from edqn_jax.errors import ConfigError, suggest_nearest
from edqn_jax.user_code import check_takes, describe_object

OWN = "one that --import registers"
"""What else a name may be."""

Take = Callable[[str, Any], Any]
"""(the entry in words, what was given) → the entry as it is held; raises ConfigError if it is none."""


def instance_of(wanted: str, *classes: str) -> Take:
    """Returns a check that takes instances of these classes, `module:name`, which are `wanted` in words."""

    def take(what: str, entry: Any) -> Any:
        if not isinstance(entry, tuple(map(_import_name, classes))):
            raise ConfigError(f"{what} must be {wanted}, not {describe_object(entry)}")
        return entry

    return take


def module_made_of(arguments: str) -> Take:
    """Returns a check that takes classes of flax modules, and functions, which are called with these arguments."""
    wanted = "the class of a flax module, or a function that makes one, of"

    def take(what: str, entry: Any) -> Any:
        if isinstance(entry, type) and not issubclass(entry, _import_name("flax.linen:Module")):
            raise ConfigError(f"{what} must be {wanted} ({arguments}), not {describe_object(entry)}")
        check_takes(entry, arguments, what, wanted)
        return entry

    return take


def existing_file(what: str, entry: Any) -> Path:
    """Returns the absolute path of a file, of its path as text or `Path`.

    Raises:
        ConfigError: if it is none, or there is no such file.
    """
    if not isinstance(entry, str | Path):
        raise ConfigError(f"{what} must be the path of an MJCF file, not {describe_object(entry)}")
    file = Path(entry).expanduser().resolve()
    if not file.is_file():
        raise ConfigError(f"{what} must be the path of an MJCF file, and there is no file '{entry}'")
    return file


def _import_name(name: str) -> Any:
    """Imports what `module:name` stands for."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


class Registry:
    """Entries of one kind by name."""

    def __init__(
        self,
        kind: str,
        option: str,
        entries: Mapping[str, str],
        about: Mapping[str, str] | None = None,
        *,
        take: Take,
        reserved: Collection[str] = (),
    ) -> None:
        """Holds built-in entries.

        Args:
            kind: what an entry is, for messages.
            option: that names one, such as `agent.learner`.
            entries: `module:name` by name.
            about: what help texts say of entries, by name.
            take: checks what is registered.
            reserved: names that the option has for something else.
        """
        self.kind = kind
        self.option = option
        self._take = take
        self._reserved = reserved
        self._built_in = tuple(entries)
        self._entries: dict[str, Any] = dict(entries)
        self._about = dict(about or {})

    @property
    def names(self) -> tuple[str, ...]:
        """Returns the names, built-in ones first."""
        return tuple(self._entries)

    @property
    def own(self) -> tuple[str, ...]:
        """Returns the names that are not built in."""
        return self.names[len(self._built_in) :]

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def describe(self) -> str:
        """Returns the names with what is said of them; neighbours of which the same is said stand together."""
        groups = itertools.groupby(self.names, lambda name: self._about.get(name, ""))
        listed = [(", ".join(f"`{name}`" for name in names), about) for about, names in groups]
        return "; ".join(f"{names}: {about}" if about else names for names, about in listed)

    def register(self, name: str, entry: Any, about: str = "") -> None:
        """Adds an entry of one's own, with what help texts say of it.

        Raises:
            ConfigError: if the name is taken, reserved, or no identifier with hyphens, or the entry is not what the
                registry is of.
        """
        if not isinstance(name, str) or name.startswith("-") or not name.replace("-", "_").isidentifier():
            raise ConfigError(
                f"the name of a {self.kind} must be letters, digits, - and _, and begin with a letter, not {name!r}"
            )
        if name in self._entries:
            raise ConfigError(f"the {self.kind} '{name}' is there already; give yours another name")
        if name in self._reserved:
            raise ConfigError(f"'{name}' is something else in {self.option}; give your {self.kind} another name")
        if not isinstance(about, str):
            raise ConfigError(f"`about` of the {self.kind} '{name}' must be text, not {describe_object(about)}")
        self._entries[name] = self._take(f"the {self.kind} '{name}'", entry)
        self._about[name] = about

    def check(self, name: str) -> None:
        """Raises unless there is an entry of that name.

        Raises:
            ConfigError: with the nearest name, or all of them.
        """
        if name not in self._entries:
            raise ConfigError(
                f"{self.option}: there is no {self.kind} '{name}'{suggest_nearest(name, self, f', or {OWN}')}"
            )

    def get(self, name: str) -> Any:
        """Returns the entry of that name.

        Raises:
            ConfigError: as `check`.
        """
        self.check(name)
        entry = self._entries[name]
        if isinstance(entry, str):
            entry = self._entries[name] = _import_name(entry)
        return entry


LEARNERS = Registry(
    "learner",
    "agent.learner",
    {"dqn": "edqn_jax.learn.dqn.learner:DQN", "pqn": "edqn_jax.learn.pqn.learner:PQN"},
    {"dqn": "from a replay", "pqn": "from fresh rollouts (options `pqn.*`)"},
    take=instance_of("an edqn_jax.learn.learner.Learner", "edqn_jax.learn.learner:Learner"),
)
"""How the network that chooses moves learns: `edqn_jax.learn.learner.Learner`."""

NETWORKS = Registry(
    "network",
    "agent.network",
    {"mlp": "edqn_jax.learn.qnetwork:QNetwork"},
    {"mlp": "ReLU layers of `agent.hidden`"},
    take=module_made_of("config, moves"),
)
"""Q-networks: a flax module, made of `AgentConfig` and the number of moves, that maps stacked observations
[..., history x observation] to a value of each move [..., moves]."""

_ENCODERS = "edqn_jax.learn.perception"

ENCODERS = Registry(
    "encoder",
    "encoder.architecture",
    {
        "patches": f"{_ENCODERS}.patch_encoder:PatchEncoder",
        "pooled": f"{_ENCODERS}.pooled_encoder:PooledEncoder",
    },
    {
        "patches": "events are counted per pixel, pixels are read in patches together with the own motion, patches are "
        "joined",
        "pooled": "the paper's sum over all events, without the own motion",
    },
    take=module_made_of("config, height, width"),
)
"""Encoders of the VAE: a flax module, made of `EncoderConfig` and of the image's height and width, that maps events or
pictures and the own motion to mean and log-variance of the code, each [..., code_size]."""

_SENSORS = "edqn_jax.sim.sensors.built_in"

SENSORS = Registry(
    "sensor",
    "env.sensor",
    {
        "events": f"{_SENSORS}:EVENTS",
        "frames": f"{_SENSORS}:FRAMES",
        "frame-pair": f"{_SENSORS}:FRAME_PAIR",
        "event-image": f"{_SENSORS}:EVENT_IMAGE",
        "blind": f"{_SENSORS}:BLIND",
        "depth": f"{_SENSORS}:DEPTH",
        "depth-motion": f"{_SENSORS}:DEPTH_MOTION",
        "ranges": f"{_SENSORS}:RANGES",
    },
    {
        "events": "the event camera",
        "frames": "the newest brightness frame",
        "frame-pair": "the frames that the events would be made of",
        "event-image": "an image of the events without a VAE",
        "blind": "nothing",
        "depth": "true depth",
        "depth-motion": "that and how it changes by the obstacles' own motion",
        "ranges": "the true free distance along each move",
    },
    take=instance_of("an edqn_jax.Sensor", "edqn_jax.sim.sensors.sensor:Sensor"),
)
"""What a drone sees of the world: `edqn_jax.sim.sensors.sensor.Sensor`. `events` is the method's; the others are
compared with it at the same budget."""

OPEN = ("sparse", "medium", "dense")
CLOSED = ("rooms", "forest", "canyon")
"""Families of worlds in which the straight line to the goal is often, or seldom, free."""

MIXTURES: dict[str, dict[str, int]] = {
    "open": dict.fromkeys(OPEN, 1),
    "mixed": {**dict.fromkeys(OPEN, 1), **dict.fromkeys(CLOSED, 3)},
}
"""Random worlds that are of one of several families, with their shares; a quarter of the mixed ones are open."""

FAMILIES = Registry(
    "family of random worlds",
    "world.name",
    {name: f"edqn_jax.sim.worlds.families:{name.upper()}" for name in (*OPEN, *CLOSED, *MIXTURES, "moving")},
    {
        **dict.fromkeys(OPEN, "open ones"),
        **dict.fromkeys(CLOSED, "closed ones"),
        "open": "open ones of all three kinds",
        "mixed": "all six, a quarter of them open",
        "moving": "medium ones in which obstacles move",
    },
    take=instance_of(
        "an edqn_jax.Family, or a Mixture of some",
        "edqn_jax.sim.worlds.families:Family",
        "edqn_jax.sim.worlds.families:Mixture",
    ),
    reserved=("paper",),
)
"""Random worlds: `edqn_jax.sim.worlds.families.Family`, or a `Mixture` of some."""


AIRFRAMES = Registry(
    "airframe",
    "drone.airframe",
    {"skydio_x2": "edqn_jax.sim.physics.airframe:SKYDIO_X2"},
    {"skydio_x2": "the Skydio X2"},
    take=existing_file,
)
"""Quadrotors: the path of an MJCF file of one free body and four motors, as `sim/physics/skydio_x2.xml`."""

_SHAPES = "edqn_jax.sim.scene.shapes"

SHAPES = Registry(
    "kind of shape",
    "shape",
    {
        "boxes": f"{_SHAPES}.upright_box:UPRIGHT_BOX",
        "cylinders": f"{_SHAPES}.upright_cylinder:UPRIGHT_CYLINDER",
        "spheres": f"{_SHAPES}.sphere:SPHERE",
        "tilted_boxes": f"{_SHAPES}.tilted_box:TILTED_BOX",
        "capsules": f"{_SHAPES}.capsule:CAPSULE",
        "tilted_cylinders": f"{_SHAPES}.tilted_cylinder:TILTED_CYLINDER",
        "planes": f"{_SHAPES}.plane:PLANE",
    },
    take=instance_of("an edqn_jax.ShapeKind", f"{_SHAPES}.kind:ShapeKind"),
)
"""Each kind of shape is an `edqn_jax.sim.scene.shapes.kind.ShapeKind`. A geom is read by the first that takes it."""

ACTION_SETS = Registry(
    "set of actions",
    "env.actions",
    {
        "moves": "edqn_jax.sim.task.action_sets:MOVES",
        "velocity": "edqn_jax.sim.task.action_sets:VELOCITY",
        "body-rates": "edqn_jax.sim.task.action_sets:BODY_RATES",
    },
    {
        "moves": "{-1, 0, 1}^3 times `speed_m_s`, in the heading frame",
        "velocity": "[-1, 1]^3 times it",
        "body-rates": "thrust and rates about the body's axes",
    },
    take=instance_of("an edqn_jax.sim.task.action_sets.ActionSet", "edqn_jax.sim.task.action_sets:ActionSet"),
)
"""What actions are and what they command: `edqn_jax.sim.task.action_sets.ActionSet`."""


def has_detours(world: str) -> bool:
    """Returns whether a world is a random one in which the straight line to the goal is seldom free."""
    # Of built-in families without their modules, which import JAX.
    return world in (*CLOSED, "mixed") or (world in FAMILIES.own and FAMILIES.get(world).detours)
