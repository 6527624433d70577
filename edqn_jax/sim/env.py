"""The task: reset, step, reward and outcome of one drone on one mission.

An ended environment spends its next step on being reset: the step's action is ignored, and what it returns
is the first observation of a new mission. So the row after an episode's last action holds its final
observation, every observation is rendered and encoded once, and nothing else is needed to cut episodes.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config, EnvConfig
from edqn_jax.random import integers
from edqn_jax.sim import drone, sensor
from edqn_jax.sim.drone import Airframe, DroneState, Flight
from edqn_jax.sim.events import EventMemory
from edqn_jax.sim.moves import ACTIONS
from edqn_jax.sim.scene import Scene, path_contact, scene_at, take_scene
from edqn_jax.sim.sensor import Sensed, frame_steps
from edqn_jax.sim.worlds import Missions

OWN_SIZE = 10
"""Values of the drone's own state in an observation."""


class Outcome(enum.IntEnum):
    """How an episode stands. Everything but RUNNING ends it; only TIME_OUT is a truncation."""

    RUNNING = 0
    GOAL = 1
    COLLISION = 2
    LEFT_VOLUME = 3
    TIME_OUT = 4
    DIVERGED = 5


@struct.dataclass
class World:
    """Where environments fly: P worlds and the missions that resets draw from."""

    airframe: Airframe
    pool: Scene  # every array with a leading [P]
    missions: Missions


@struct.dataclass
class Observation:
    """What the agent may know: what its sensor shows, by default the events before the decision, and its own state."""

    sensed: Sensed
    own: Array  # [OWN_SIZE], see `own_state`


@struct.dataclass
class EnvState:
    """One environment."""

    drone: DroneState
    mission: Array  # [] int32 index into the missions
    decision: Array  # [] int32 decisions taken in this episode
    ended: Array  # [] bool, the next step is a reset
    memory: EventMemory | None  # the sensor's
    episode_return: Array  # [] sum of rewards so far
    key: Array  # [] typed key


@struct.dataclass
class Step:
    """What one decision led to. n physics steps."""

    observation: Observation
    reward: Array  # [] float32, unscaled
    outcome: Array  # [] int32, an `Outcome`
    is_reset: Array  # [] bool, the step was spent on a reset: reward 0, action ignored
    episode_return: Array  # [] of the episode so far, this step included
    episode_length: Array  # [] int32, likewise
    flight: Flight  # [n, ...] after each physics step; for a reset, the new start throughout
    end_step: Array  # [] int32, physics step (1..n) at which the outcome fell; n while running
    contact: Array  # [] share of that step flown before a collision touched, 1 otherwise


def velocity_command(config: EnvConfig, action: Array, yaw: Array) -> Array:
    """World velocity [3] m/s that `action` (0..26) commands at heading `yaw`."""
    move = jnp.asarray(ACTIONS, jnp.float32)[action] * config.speed_m_s
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos * move[0] - sin * move[1], sin * move[0] + cos * move[1], move[2]])


def own_state(config: EnvConfig, scene: Scene, goal: Array, state: DroneState) -> Array:
    """The drone's own ten values [10], each of order 1.

    Horizontal distance and height to the goal (asinh(d / 2 m) / 2 and asinh(h / 2 m): metres count near the
    goal, powers of ten far away), cosine and sine of the heading, own position scaled to [-1, 1] in the
    flight volume (3), own velocity in the heading frame (3, in commanded speeds).
    """
    yaw = drone.yaw_of(state.quaternion)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    ahead = goal - state.position
    distance = jnp.sqrt(ahead[0] ** 2 + ahead[1] ** 2)
    lower, upper = scene.volume[0], scene.volume[1]
    position = 2 * (state.position - lower) / (upper - lower) - 1
    vx, vy, vz = state.velocity / config.speed_m_s
    return jnp.concatenate(
        [
            jnp.stack([jnp.arcsinh(distance / 2.0) / 2.0, jnp.arcsinh(ahead[2] / 2.0), cos, sin]),
            position,
            jnp.stack([cos * vx + sin * vy, cos * vy - sin * vx, vz]),
        ]
    )


def bearing(config: EnvConfig, state: DroneState, goal: Array) -> Array:
    """Heading setpoint [] radians of the next decision: towards the goal [3], or held when it is (nearly) overhead."""
    ahead = goal - state.position
    near = ahead[0] ** 2 + ahead[1] ** 2 < config.heading_hold_m**2
    return jnp.where(near, state.yaw_setpoint, jnp.arctan2(ahead[1], ahead[0]))


def judge(config: Config, scene: Scene, goal: Array, before: Array, flight: Flight, decision: Array):
    """Outcome of one decision: the earliest physics step wins, and at the same step a collision wins.

    Args:
        before: [3] position before the first physics step.
        decision: decisions taken, this one included.

    Returns:
        outcome, end_step in 1..n, contact: as in `Step`.
    """
    n = flight.position.shape[0]
    path = jnp.concatenate([before[None], flight.position])
    touch, contact = path_contact(scene, path, config.drone.body_radius_m)
    at = flight.position
    apart = at - goal[None]
    arrived = jnp.sum(apart * apart, axis=1) < config.env.goal_radius_m**2
    outside = jnp.any((at < scene.volume[0][None]) | (at > scene.volume[1][None]), axis=1)
    broken = ~jnp.all(jnp.isfinite(at), axis=1)
    # Per physics step, the verdicts in order of precedence.
    verdict = jnp.select(
        [broken, touch, outside, arrived],
        [
            jnp.full(n, int(Outcome.DIVERGED)),
            jnp.full(n, int(Outcome.COLLISION)),
            jnp.full(n, int(Outcome.LEFT_VOLUME)),
            jnp.full(n, int(Outcome.GOAL)),
        ],
        jnp.full(n, int(Outcome.RUNNING)),
    )
    first = jnp.argmax(verdict != Outcome.RUNNING)
    outcome = verdict[first]
    running = outcome == Outcome.RUNNING
    timed_out = running & (decision >= config.env.max_decisions)
    outcome = jnp.where(timed_out, int(Outcome.TIME_OUT), outcome).astype(jnp.int32)
    end_step = jnp.where(running, n, first + 1).astype(jnp.int32)
    return outcome, end_step, jnp.where(outcome == Outcome.COLLISION, contact[first], 1.0)


def reward(
    config: EnvConfig,
    discount: float,
    outcome: Array,
    before: Array,
    after: Array,
    flown: Array | float = 0.0,
) -> Array:
    """Reward of one decision.

    `sparse` is Eq. 8. `progress` adds the metres gained towards the goal, times a weight, and
    takes something for each metre flown. `potential` adds
    gamma * Phi(s') - Phi(s) with Phi = -weight * distance, and Phi = 0 at terminal states: the form that leaves the
    optimal policy unchanged (Ng et al. 1999).

    Args:
        before, after: distances to the goal, metres.
        flown: metres flown.
    """
    at_end = jnp.select(
        [outcome == Outcome.GOAL, outcome == Outcome.COLLISION, outcome == Outcome.LEFT_VOLUME],
        [config.goal_reward, config.collision_reward, config.left_volume_reward],
        0.0,
    )
    total = at_end + config.step_reward
    if config.reward == "progress":
        total = total + config.progress_weight * (before - after) - config.path_weight * flown
    elif config.reward == "potential":
        terminal = is_terminal(outcome)
        total = total + config.progress_weight * (before - jnp.where(terminal, 0.0, discount * after))
    return jnp.where(outcome == Outcome.DIVERGED, 0.0, total)


def is_terminal(outcome: Array) -> Array:
    """Whether the outcome cuts the bootstrap: every end but a time-out."""
    return (outcome != Outcome.RUNNING) & (outcome != Outcome.TIME_OUT)


def _start(config: Config, world: World, mission: Array, key: Array) -> tuple[DroneState, EventMemory | None]:
    """At rest at the mission's start, facing its goal, the sensor at rest."""
    start, goal = world.missions.start[mission], world.missions.goal[mission]
    yaw = jnp.arctan2(goal[1] - start[1], goal[0] - start[0])
    return drone.hover(start, yaw), sensor.at_rest(config, key)


def observe(
    config: Config,
    scene: Scene,
    goal: Array,
    state: DroneState,
    poses: Flight,
    memory: EventMemory | None,
    key: Array,
) -> tuple[Observation, EventMemory | None]:
    """What the sensor shows now, and the own state.

    Args:
        poses, memory, key: as in `sensor.sense`.
    """
    sensed, memory = sensor.sense(config, scene, poses, memory, key)
    return Observation(sensed=sensed, own=own_state(config.env, scene, goal, state)), memory


def reset(config: Config, world: World, key: Array, mission: Array | None = None) -> tuple[EnvState, Observation]:
    """A fresh environment on a mission drawn from the pool, or on the given one."""
    key, noise = jax.random.split(key)
    state = dataclasses.replace(ended(config, world, key, mission), ended=jnp.zeros((), bool))
    scene = scene_at(take_scene(world.pool, world.missions.scene[state.mission]), jnp.zeros(()))
    still = _hold(state.drone, len(frame_steps(config)))
    goal = world.missions.goal[state.mission]
    observation, memory = observe(config, scene, goal, state.drone, still, state.memory, noise)
    return dataclasses.replace(state, memory=memory), observation


def ended(config: Config, world: World, key: Array, mission: Array | None = None) -> EnvState:
    """An environment whose next step is a reset; it needs no picture. The mission is as in `reset`."""
    key, draw, rest = jax.random.split(key, 3)
    mission = _drawn_mission(world, draw) if mission is None else mission
    body, memory = _start(config, world, mission, rest)
    return EnvState(
        drone=body,
        mission=mission.astype(jnp.int32),
        decision=jnp.zeros((), jnp.int32),
        ended=jnp.ones((), bool),
        memory=memory,
        episode_return=jnp.zeros(()),
        key=key,
    )


def _drawn_mission(world: World, key: Array) -> Array:
    return integers(key, (), world.missions.scene.shape[0])


def _hold(body: DroneState, n: int) -> Flight:
    """N times the same pose."""
    repeat: Callable[[Array], Array] = lambda x: jnp.broadcast_to(x, (n, *x.shape))  # noqa: E731
    return Flight(position=repeat(body.position), quaternion=repeat(body.quaternion), velocity=repeat(body.velocity))


def step(
    config: Config, world: World, state: EnvState, action: Array, mission: Array | None = None
) -> tuple[EnvState, Step]:
    """One decision of one drone, or its reset if its episode has ended.

    Args:
        action: [] int, 0..26.
        mission: [] int, which one a reset takes; None draws one.
    """
    key, draw, rest, noise = jax.random.split(state.key, 4)
    is_reset = state.ended
    fresh = _drawn_mission(world, draw) if mission is None else mission
    mission = jnp.where(is_reset, fresh, state.mission)
    goal = world.missions.goal[mission]
    time = state.decision * (config.drone.physics_steps * config.drone.physics_dt_s)
    scene = scene_at(take_scene(world.pool, world.missions.scene[mission]), time)

    # The decision as flown; for an ended environment it is computed and dropped.
    before = state.drone
    command = velocity_command(config.env, action, drone.yaw_of(before.quaternion))
    flown, flight = drone.fly(config.drone, world.airframe, before, command, bearing(config.env, before, goal))
    decision = state.decision + 1
    outcome, end_step, contact = judge(config, scene, goal, before.position, flight, decision)
    distances = [jnp.sqrt(jnp.sum((goal - p) ** 2)) for p in (before.position, flown.position)]
    moved = jnp.sqrt(jnp.sum((flown.position - before.position) ** 2))
    gained = reward(config.env, config.agent.discount, outcome, distances[0], distances[1], moved)

    start, memory = _start(config, world, mission, rest)
    # A diverged body must not leave NaN in the last observation; it stays where it was.
    broken = ~jnp.all(jnp.isfinite(jnp.concatenate([flown.position, flown.quaternion, flown.velocity])))
    held = _hold(before, flight.position.shape[0])
    body = _choose(is_reset, start, _choose(broken, before, flown))
    memory = _choose(is_reset, memory, state.memory)
    flight = _choose(is_reset, _hold(start, flight.position.shape[0]), _choose(broken, held, flight))
    outcome = jnp.where(is_reset, int(Outcome.RUNNING), jnp.where(broken, int(Outcome.DIVERGED), outcome))

    first = _choose(is_reset, start, before)
    path = jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b]),
        Flight(position=first.position, quaternion=first.quaternion, velocity=first.velocity),
        flight,
    )
    poses = jax.tree.map(lambda x: jnp.stack([x[i] for i in frame_steps(config)]), path)
    observation, memory = observe(config, scene, goal, body, poses, memory, noise)

    gained = jnp.where(is_reset, 0.0, jnp.where(broken, 0.0, gained))
    episode_return = jnp.where(is_reset, 0.0, state.episode_return + gained)
    decision = jnp.where(is_reset, 0, decision)
    after = EnvState(
        drone=body,
        mission=mission.astype(jnp.int32),
        decision=decision,
        ended=outcome != Outcome.RUNNING,
        memory=memory,
        episode_return=episode_return,
        key=key,
    )
    return after, Step(
        observation=observation,
        reward=gained,
        outcome=outcome.astype(jnp.int32),
        is_reset=is_reset,
        episode_return=episode_return,
        episode_length=decision,
        flight=flight,
        end_step=end_step,
        contact=contact,
    )


def _choose(condition: Array, yes, no):
    """`yes` where the scalar condition holds, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
