"""The task: reset, step, reward and outcome of one drone on one mission.

An ended environment spends its next step on being reset: the step's action is ignored, and what it returns
is the first observation of a new mission. So the row after an episode's last action holds its final
observation, every observation is rendered and encoded once, and nothing else is needed to cut episodes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.checks import check_finite, check_index
from edqn_jax.config import Config, EnvConfig
from edqn_jax.keys import integers
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.physics import disturbances, drone
from edqn_jax.sim.physics.disturbances import Disturbance
from edqn_jax.sim.physics.drone import Airframe, DroneState, Flight
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.launches import nobody_aimed_at, thrown
from edqn_jax.sim.scene.motion import Aim
from edqn_jax.sim.scene.scene import PARKED, Scene, moves, scene_at, take_scene, with_drones
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.sensors.sensor import Sensed, SensorMemory, frame_steps
from edqn_jax.sim.task import group
from edqn_jax.sim.task.missions import Missions
from edqn_jax.sim.task.outcomes import Outcome, judge
from edqn_jax.sim.task.reward import Reward, Transition, configured_reward
from edqn_jax.sim.worlds import geodesic

OWN_SIZE = 10
"""Values of the drone's own state in an observation."""

MOTION_SIZE = 7
"""Values of the drone's own motion in an observation."""

MOST_YAW_RATE = 10.0
"""Bound of the yaw rate in an observation, rad/s."""

MIRRORED_MOTION = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0)
"""Factors [MOTION_SIZE] on the own motion when left and right are exchanged."""


@struct.dataclass
class World:
    """Where environments fly: P worlds and the missions that resets draw from."""

    airframe: Airframe
    pool: Scene  # every array with a leading [P]
    missions: Missions
    reward: Reward | None = struct.field(pytree_node=False, default=None)  # in place of the configured one
    distances: geodesic.Field | None = None  # to the pool's own goals, in training for the reward `geodesic`


@struct.dataclass
class Observation:
    """What the agent may know: what its sensor shows, by default the events before the decision, and its own state."""

    sensed: Sensed
    own: Array  # [OWN_SIZE], see `own_state`
    motion: Array  # [MOTION_SIZE], see `own_motion`; only the encoder sees it


@struct.dataclass
class EnvState:
    """One environment."""

    drone: DroneState
    mission: Array  # [] int32 index into the missions
    decision: Array  # [] int32 decisions taken in this episode
    ended: Array  # [] bool, the next step is a reset
    memory: SensorMemory  # the sensor's
    episode_return: Array  # [] sum of rewards so far
    key: Array  # [] typed key
    disturbance: Disturbance | None = None  # what the episode flies against; None where nothing disturbs
    aim: Aim | None = None  # of the balls thrown until now; None where no world has any


@struct.dataclass
class Broken:
    """What was not finite in a decision, which has therefore diverged: [] bool each."""

    physics_state: Array
    observation: Array
    reward: Array


@struct.dataclass
class Step:
    """What one decision led to. n physics steps."""

    observation: Observation
    reward: Array  # [] float32, unscaled
    outcome: Array  # [] int32, an `Outcome`
    is_reset: Array  # [] bool, the step was spent on a reset, or on waiting for one: reward 0, action ignored
    episode_return: Array  # [] of the episode so far, this step included
    episode_length: Array  # [] int32, likewise
    flight: Flight  # [n, ...] after each physics step; for a reset, the new start throughout
    end_step: Array  # [] int32, physics step (1..n) at which the outcome fell; n while running
    contact: Array  # [] share of that step flown before a collision touched, 1 otherwise
    broken: Broken
    waits: Array | None = None  # [] bool, the episode has ended and that of others in the group has not
    hit_drone: Array | None = None  # [] bool, the collision was with a drone; both None for a drone alone


def velocity_command(config: EnvConfig, action: Array, yaw: Array) -> Array:
    """World velocity [3] m/s that `action` (0..26) commands at heading `yaw`."""
    move = jnp.asarray(ACTIONS, jnp.float32)[action] * config.speed_m_s
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos * move[0] - sin * move[1], sin * move[0] + cos * move[1], move[2]])


def own_state(config: EnvConfig, scene: Scene, goal: Array, state: DroneState) -> Array:
    """Returns the drone's own ten values [OWN_SIZE], each of order 1.

    Horizontal distance and height to the goal (asinh(d / 2 m) / 2 and asinh(h / 2 m): metres count near the
    goal, powers of ten far away), cosine and sine of the heading, own position scaled to [-1, 1] in the
    flight volume (3), own velocity in the heading frame (3, in commanded speeds).

    Without `config.position` the first value is of the metres ahead to the goal, the position's horizontal values are 0
    and its height gives way to the metres to the left, in the heading frame and scaled as the distance.
    """
    yaw = drone.yaw_of(state.quaternion)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    way = goal - state.position
    if config.position:
        lower, upper = scene.volume[0], scene.volume[1]
        distance = jnp.sqrt(way[0] ** 2 + way[1] ** 2)
        place = 2 * (state.position - lower) / (upper - lower) - 1
    else:
        distance, left = cos * way[0] + sin * way[1], cos * way[1] - sin * way[0]
        place = jnp.stack([jnp.zeros(()), jnp.zeros(()), jnp.arcsinh(left / 2.0) / 2.0])
    towards = jnp.stack([jnp.arcsinh(distance / 2.0) / 2.0, jnp.arcsinh(way[2] / 2.0), cos, sin])
    return jnp.concatenate([towards, place, heading_velocity(config, yaw, state.velocity)])


def turned(own: Array, quarters: Array) -> Array:
    """Returns own states [..., OWN_SIZE] as they would be with world and drone turned about the volume's middle.

    Args:
        own: in a volume that is as long as it is wide.
        quarters: [...] int32, quarter turns to the left.
    """
    cos, sin = jnp.array([1.0, 0.0, -1.0, 0.0])[quarters], jnp.array([0.0, 1.0, 0.0, -1.0])[quarters]
    towards_x, towards_y = own[..., 2:6:2], own[..., 3:6:2]  # of the heading, and of the position in the volume
    x = cos[..., None] * towards_x - sin[..., None] * towards_y
    y = sin[..., None] * towards_x + cos[..., None] * towards_y
    pairs = jnp.stack([x, y], axis=-1).reshape(*x.shape[:-1], 4)
    return jnp.concatenate([own[..., :2], pairs, own[..., 6:]], axis=-1)


def own_motion(config: EnvConfig, state: DroneState, move: Array) -> Array:
    """Returns what the drone knows of its own motion [MOTION_SIZE], each value of order 1.

    Velocity in the heading frame (3, in commanded speeds), yaw rate (rad/s, at most `MOST_YAW_RATE`), last move (3).

    Args:
        move: [3] chosen at the last decision, of -1, 0 and 1 in the heading frame; zeros at a start. With
            `env.action_delay` it is yet to be flown.
    """
    velocity = heading_velocity(config, drone.yaw_of(state.quaternion), state.velocity)
    # Of a drone on its back the heading turns at any rate.
    rate = jnp.clip(drone.yaw_rate_of(state), -MOST_YAW_RATE, MOST_YAW_RATE)
    return jnp.concatenate([velocity, rate[None], move])


def heading_velocity(config: EnvConfig, yaw: Array, velocity: Array) -> Array:
    """Returns velocities [..., 3] m/s in the frame of headings [...] radians, in commanded speeds."""
    vx, vy, vz = jnp.moveaxis(velocity / config.speed_m_s, -1, 0)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos * vx + sin * vy, cos * vy - sin * vx, vz], axis=-1)


def bearing(config: EnvConfig, state: DroneState, goal: Array) -> Array:
    """Heading setpoint [] radians of the next decision: towards the goal [3], or held when it is (nearly) overhead."""
    ahead = goal - state.position
    near = ahead[0] ** 2 + ahead[1] ** 2 < config.heading_hold_m**2
    return jnp.where(near, state.yaw_setpoint, jnp.arctan2(ahead[1], ahead[0]))


def heading_setpoint(config: EnvConfig, state: DroneState, goal: Array, command: Array) -> Array:
    """Heading setpoint [] radians of the next decision: `bearing`, or along the commanded velocity.

    Args:
        command: [3] m/s in the world; without a horizontal part the setpoint stays.
    """
    if config.heading == "goal":
        return bearing(config, state, goal)
    level = command[0] ** 2 + command[1] ** 2
    return jnp.where(level > 0, jnp.arctan2(command[1], command[0]), state.yaw_setpoint)


def _start(
    config: Config, world: World, mission: Array, key: Array
) -> tuple[DroneState, SensorMemory, Disturbance | None]:
    """At rest at the mission's start, facing its goal, the sensor at rest, and what the episode will fly against."""
    start, goal = world.missions.start[mission], world.missions.goal[mission]
    yaw = jnp.arctan2(goal[1] - start[1], goal[0] - start[0])
    drawn = None
    if disturbances.any_on(config):
        key, drawing = jax.random.split(key)
        drawn = disturbances.draw(config, world.airframe.mass * world.airframe.gravity / 4, drawing)
    return drone.hover(start, yaw), sensor.at_rest(config, key), drawn


def observe(
    config: Config,
    scene: Scene,
    goal: Array,
    state: DroneState,
    move: Array,
    poses: Flight,
    memory: SensorMemory,
    key: Array,
    disturbance: Disturbance | None = None,
) -> tuple[Observation, SensorMemory]:
    """Returns what the sensor shows on the way to `goal` [3], metres, own state [OWN_SIZE] and motion [MOTION_SIZE].

    Args:
        move: as in `own_motion`.
        poses, memory, key: as in `sensor.sense`.
        disturbance: whose errors own state and motion have; None where there are none.
    """
    if disturbance is not None and disturbances.has_noise(config.noise):
        key, errs = jax.random.split(key)
        position, velocity = disturbances.believed(config.noise, disturbance, state.position, state.velocity, errs)
        state = dataclasses.replace(state, position=position, velocity=velocity)
    sensed, memory = sensor.sense(config, scene, poses, memory, key)
    own, motion = own_state(config.env, scene, goal, state), own_motion(config.env, state, move)
    return Observation(sensed=sensed, own=own, motion=motion), memory


def nearness(config: Config, world: World, state: EnvState) -> Array:
    """Returns what the sensor `depth` would show of an environment now: [H, W], without a unit.

    A label for training: no observation holds it. With several drones as `step`.
    """
    scene = scene_now(config, world, state)
    if group.several(config):
        there, is_there = group.others(config, (state.drone.position, ~state.ended))
        there = jnp.where(is_there[:, None], there, PARKED)
        scene = with_drones(scene, there, jnp.where(is_there, config.drone.body_radius_m, 0.0))
    return sensor.nearness_image(config, scene, state.drone.position, state.drone.quaternion)


def reset(config: Config, world: World, key: Array, mission: Array | None = None) -> tuple[EnvState, Observation]:
    """Returns a fresh environment on a mission drawn from the pool, or on the given one, [] int32."""
    key, noise = jax.random.split(key)
    state = dataclasses.replace(ended(config, world, key, mission), ended=jnp.zeros((), bool))
    scene = scene_of(world, state.mission)
    still = poses_at_start(config, scene, state.drone)
    goal = world.missions.goal[state.mission]
    observation, memory = observe(
        *(config, scene, goal, state.drone, jnp.zeros(3), still, state.memory, noise, state.disturbance)
    )
    aim = thrown(config, scene, state.aim, state.decision, state.drone.position, jnp.zeros(3))
    return dataclasses.replace(state, memory=memory, aim=aim), observation


def ended(config: Config, world: World, key: Array, mission: Array | None = None) -> EnvState:
    """Returns an environment whose next step is a reset; it needs no picture. The mission [] is as in `reset`."""
    key, draw, rest = jax.random.split(key, 3)
    mission = _drawn_mission(config, world, draw) if mission is None else mission
    body, memory, disturbance = _start(config, world, mission, rest)
    return EnvState(
        drone=body,
        mission=mission.astype(jnp.int32),
        decision=jnp.zeros((), jnp.int32),
        ended=jnp.ones((), bool),
        memory=memory,
        episode_return=jnp.zeros(()),
        key=key,
        disturbance=disturbance,
        aim=nobody_aimed_at(world.pool),
    )


def _drawn_mission(config: Config, world: World, key: Array) -> Array:
    count = world.missions.scene.shape[0]
    if group.several(config):
        return group.mission_of_block(config, integers(key, (), count // config.env.drones))
    return integers(key, (), count)


def poses_at_start(config: Config, scene: Scene, body: DroneState) -> Flight:
    """Returns the poses [T] at which the sensor looks before an episode, in which the body is at rest."""
    before = np.array(frame_steps(config)) - config.drone.physics_steps
    return timed(config, _hold(body, len(before)), jnp.asarray(before) if moves(scene) else None)


def _hold(body: DroneState, n: int) -> Flight:
    """N times the same pose."""
    repeat: Callable[[Array], Array] = lambda x: jnp.broadcast_to(x, (n, *x.shape))  # noqa: E731
    return Flight(position=repeat(body.position), quaternion=repeat(body.quaternion), velocity=repeat(body.velocity))


@struct.dataclass
class _Decision:
    """What a decision, or the reset in its place, comes to. n physics steps."""

    drone: DroneState
    flight: Flight  # [n, ...]
    outcome: Array
    end_step: Array
    contact: Array
    reward: Array
    broken: Array  # [] bool, the body was not finite
    unrewarded: Array  # [] bool, the reward was not, although the body was
    disturbance: Disturbance | None = None
    hit_drone: Array | None = None


def step(
    config: Config, world: World, state: EnvState, action: Array, mission: Array | None = None
) -> tuple[EnvState, Step]:
    """Takes one decision of one drone, or its reset if its episode has ended.

    With several drones it must be mapped by `group.each`; a drone whose episode has ended waits until all of its
    group have ended, and is absent meanwhile.

    Args:
        action: [] int, 0..26.
        mission: [] int, which one a reset takes; None draws one. Those of a group are a block of N in a row.
    """
    key, draw, rest, noise = jax.random.split(state.key, 4)
    gusts = None
    if disturbances.changes_flight(config):
        key, gusts = jax.random.split(key)
    is_reset, waits = state.ended, None
    if group.several(config):
        is_reset, waits = group.resets_and_waits(state.ended)
    fresh = _drawn_mission(config, world, draw) if mission is None else mission
    mission = jnp.where(is_reset, fresh, state.mission).astype(jnp.int32)
    check_index(action, len(ACTIONS), "the moves")
    check_index(mission, world.missions.scene.shape[0], "the missions")
    goal = world.missions.goal[mission]
    nobody = nobody_aimed_at(world.pool)
    scene = scene_of(world, mission, _choose(is_reset, nobody, state.aim))

    # For an ended environment the decision is computed and dropped.
    start, rested, drawn = _start(config, world, mission, rest)
    flown = _fly(config, world, scene, goal, state, action, gusts)
    done = _choose(is_reset, _reset_in_place_of(flown, start, drawn), flown)
    if waits is not None:
        done = _choose(waits, _reset_in_place_of(flown, state.drone, state.disturbance), done)
    n = config.drone.physics_steps
    # The time before a start is negative: what moves has moved before.
    moving = moves(scene) or group.several(config)
    steps = jnp.where(is_reset, -n, state.decision * n) + jnp.arange(1, n + 1) if moving else None
    done = dataclasses.replace(done, flight=timed(config, done.flight, steps))

    first = _choose(is_reset, start, state.drone)
    if waits is not None:
        goes_on = (done.outcome == Outcome.RUNNING) & ~waits
        scene = group.present(config, scene, first.position, done.flight, goes_on)
    poses = poses_seen(config, first, done.flight)
    memory = _choose(is_reset, rested, state.memory)
    move = jnp.where(is_reset, 0.0, jnp.asarray(ACTIONS, jnp.float32)[action])
    observation, memory = observe(*(config, scene, goal, done.drone, move, poses, memory, noise, done.disturbance))
    for number in jax.tree.leaves(observation.sensed):
        check_finite(number, "what a sensor shows")
    # Own state and motion are of a finite body; counts of events are whole numbers, and nothing is checked.
    unseen = ~is_finite(observation.sensed)
    if waits is not None:
        unseen &= ~waits
    if _has_floats(observation.sensed):
        observation = _choose(unseen, jax.tree.map(jnp.zeros_like, observation), observation)
    done = dataclasses.replace(done, outcome=jnp.where(unseen, int(Outcome.DIVERGED), done.outcome))
    decision = jnp.where(is_reset, 0, state.decision + 1)
    over = done.outcome != Outcome.RUNNING
    if waits is not None:
        decision, over = jnp.where(waits, state.decision, decision), over | waits
    moved = jnp.where(is_reset, 0.0, done.drone.position - first.position)
    after = EnvState(
        drone=done.drone,
        mission=mission,
        decision=decision,
        ended=over,
        memory=memory,
        episode_return=jnp.where(is_reset, 0.0, state.episode_return + done.reward),
        key=key,
        disturbance=done.disturbance,
        aim=thrown(config, scene, scene.aim, decision, done.drone.position, moved),
    )
    return after, Step(
        observation=observation,
        reward=done.reward,
        outcome=done.outcome,
        is_reset=is_reset if waits is None else is_reset | waits,
        episode_return=after.episode_return,
        episode_length=after.decision,
        flight=done.flight,
        end_step=done.end_step,
        contact=done.contact,
        broken=Broken(physics_state=done.broken, observation=unseen, reward=done.unrewarded),
        waits=waits,
        hit_drone=done.hit_drone,
    )


def _has_floats(tree: object) -> bool:
    return any(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(tree))


def is_finite(tree: object) -> Array:
    """Returns whether every number of a tree's arrays is finite, [] bool; whole numbers are."""
    sums = [jnp.sum(leaf) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.isfinite(sum(sums, jnp.zeros(())))


def scene_of(world: World, mission: Array, aim: Aim | None = None) -> Scene:
    """Returns the world of a mission [] int32, with its motion; balls are thrown at the mission's own drone.

    Args:
        aim: of the flight; None is that of a drone of steady pace.
    """
    scene = take_scene(world.pool, world.missions.scene[mission])
    if not moves(scene):
        return scene
    return dataclasses.replace(scene, start=world.missions.start[mission], goal=world.missions.goal[mission], aim=aim)


def scene_now(config: Config, world: World, state: EnvState) -> Scene:
    """Returns the world of an environment as it stands now, after its last decision."""
    scene = scene_of(world, state.mission, state.aim)
    return scene_at(scene, _time(config, state.decision) if moves(scene) else None)


def _time(config: Config, decisions: Array) -> Array:
    """Returns the seconds [] of an episode after so many decisions []."""
    return (decisions * config.drone.physics_steps) * config.drone.physics_dt_s


def timed(config: Config, flight: Flight, steps: Array | None) -> Flight:
    """Returns a flight with the times of its poses, taken after physics steps `steps` [n] of the episode.

    Where nothing moves but the drone nobody asks for times, and there are none.
    """
    if steps is None:
        return flight
    return dataclasses.replace(flight, time=steps * config.drone.physics_dt_s)


def _fly(
    config: Config, world: World, scene: Scene, goal: Array, state: EnvState, action: Array, gusts: Array | None
) -> _Decision:
    """The decision as flown and judged.

    A diverged body stays where it was, so that no NaN reaches an observation; a decision without a finite reward has
    diverged, too. The key `gusts` is consumed; None where nothing changes how a drone flies.
    """
    before, disturbance = state.drone, state.disturbance
    move = action
    if config.env.action_delay:
        assert disturbance is not None and disturbance.move is not None
        move, disturbance = disturbance.move, dataclasses.replace(disturbance, move=jnp.asarray(action, jnp.int32))
    command = velocity_command(config.env, move, drone.yaw_of(before.quaternion))
    heading = heading_setpoint(config.env, before, goal, command)
    if gusts is None:
        after, flight = drone.fly(config.drone, world.airframe, before, command, heading)
    else:
        assert disturbance is not None
        after, disturbance, flight = drone.fly_disturbed(
            config, world.airframe, before, disturbance, command, heading, gusts
        )
    outcome, end_step, contact = judge(config, scene, goal, before.position, flight, state.decision + 1)
    hit_drone = None
    if group.several(config):
        path = jnp.concatenate([before.position[None], flight.position])
        outcome, end_step, contact, hit_drone = group.collide(config, path, ~state.ended, outcome, end_step, contact)
    reward = _reward(config, world, scene, goal, state, after, action, outcome)
    numbers = jnp.concatenate([after.position, after.quaternion, after.velocity, after.angular_velocity])
    broken = ~jnp.all(jnp.isfinite(numbers))
    check_finite(numbers, "the state of a drone")
    check_finite(jnp.where(broken, 0.0, reward), "the reward of a decision")
    unrewarded = ~broken & ~jnp.isfinite(reward)
    return _Decision(
        drone=_choose(broken, before, after),
        flight=_choose(broken, _hold(before, flight.position.shape[0]), flight),
        outcome=jnp.where(broken | unrewarded, int(Outcome.DIVERGED), outcome).astype(jnp.int32),
        end_step=end_step,
        contact=contact,
        reward=jnp.where(broken | unrewarded, 0.0, reward),
        broken=broken,
        unrewarded=unrewarded,
        disturbance=_choose(broken, state.disturbance, disturbance),
        hit_drone=None if hit_drone is None else hit_drone & ~(broken | unrewarded),
    )


def _reward(
    config: Config,
    world: World,
    scene: Scene,
    goal: Array,
    state: EnvState,
    after: DroneState,
    action: Array,
    outcome: Array,
) -> Array:
    """The configured reward, or that of the world's own function; where there are no distances all are straight."""
    before = state.drone
    moved = jnp.sqrt(jnp.sum((after.position - before.position) ** 2))
    if config.env.reward == "geodesic" and world.distances is not None:
        number = world.missions.scene[state.mission]
        left = geodesic.remaining(world.distances, number, goal, before.position)
        gained = left - geodesic.remaining(world.distances, number, goal, after.position)
        # Nobody gains more than the way flown: a drone that crashes into a thin wall ends behind it.
        most = geodesic.LONGER * moved
        still_left = left - jnp.clip(gained, -most, most)
    else:
        left, still_left = (jnp.sqrt(jnp.sum((goal - point) ** 2)) for point in (before.position, after.position))
    configured = configured_reward(config.env, config.agent.discount, outcome, left, still_left, moved)
    if world.reward is None:
        return configured
    afterwards = scene_at(scene, _time(config, state.decision + 1) if moves(scene) else None)
    transition = Transition(
        before=before.position,
        after=after.position,
        goal=goal,
        clearance=signed_distance(afterwards, after.position) - config.drone.body_radius_m,
        move=jnp.asarray(action, jnp.int32),
        outcome=outcome,
        configured=configured,
    )
    return jnp.asarray(world.reward(transition), jnp.float32)


def _reset_in_place_of(flown: _Decision, start: DroneState, drawn: Disturbance | None = None) -> _Decision:
    """A reset with the arrays of a decision: at `start` throughout, with no reward."""
    return dataclasses.replace(
        flown,
        drone=start,
        flight=_hold(start, flown.flight.position.shape[0]),
        outcome=jnp.full((), int(Outcome.RUNNING), jnp.int32),
        reward=jnp.zeros(()),
        broken=jnp.zeros((), bool),
        unrewarded=jnp.zeros((), bool),
        disturbance=drawn,
        hit_drone=None if flown.hit_drone is None else jnp.zeros((), bool),
    )


def poses_seen(config: Config, first: DroneState, flight: Flight) -> Flight:
    """Returns the poses [T] at which the sensor looks, of those before the first and after each physics step."""
    began = None if flight.time is None else flight.time[0] - config.drone.physics_dt_s
    path = jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b]),
        Flight(position=first.position, quaternion=first.quaternion, velocity=first.velocity, time=began),
        flight,
    )
    return jax.tree.map(lambda x: jnp.stack([x[i] for i in frame_steps(config)]), path)


def _choose(condition: Array, yes, no):
    """`yes` where the scalar condition holds, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
