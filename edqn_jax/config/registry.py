"""All registries: what options name."""

from __future__ import annotations

from edqn_jax.registries import OWN, Registry, existing_file, instance_of, module_made_of

__all__ = [
    "ACTION_SETS",
    "AIRFRAMES",
    "CLOSED",
    "ENCODERS",
    "FAMILIES",
    "LEARNERS",
    "MIXTURES",
    "NETWORKS",
    "OPEN",
    "OWN",
    "SENSORS",
    "SHAPES",
    "Registry",
    "has_detours",
]

LEARNERS = Registry(
    "learner",
    "agent.learner",
    {
        "dqn": "edqn_jax.learn.dqn.learner:DQN",
        "pqn": "edqn_jax.learn.pqn.learner:PQN",
        "imitation": "edqn_jax.runs.teacher:IMITATION",
    },
    {
        "dqn": "from a replay",
        "pqn": "from fresh rollouts (options `pqn.*`)",
        "imitation": "from the moves of a policy that sees depth (options `imitation.*`)",
    },
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
    "narrow": {**dict.fromkeys(OPEN, 1), "rooms": 6, "forest": 4, "canyon": 2},
}
"""Random worlds that are of one of several families, with their shares; a quarter of the mixed ones are open, two
thirds of the narrow ones rooms and forests, which are learnt last."""

FAMILIES = Registry(
    "family of random worlds",
    "world.name",
    {name: f"edqn_jax.sim.worlds.families:{name.upper()}" for name in (*OPEN, *CLOSED, *MIXTURES, "moving")},
    {
        **dict.fromkeys(OPEN, "open ones"),
        **dict.fromkeys(CLOSED, "closed ones"),
        "open": "open ones of all three kinds",
        "mixed": "all six, a quarter of them open",
        "narrow": "all six, two thirds of them rooms and forests",
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
        "fields": f"{_SHAPES}.field:FIELD",
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
    families = MIXTURES.get(world, (world,))
    return not set(CLOSED).isdisjoint(families) or (world in FAMILIES.own and FAMILIES.get(world).detours)
