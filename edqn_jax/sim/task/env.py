"""The task: reset, step, reward and outcome of one drone on one mission.

An ended environment spends its next step on being reset: the step's action is ignored, and what it returns
is the first observation of a new mission. So the row after an episode's last action holds its final
observation, every observation is rendered and encoded once, and nothing else is needed to cut episodes.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.checks import check_finite, check_index, is_finite
from edqn_jax.config import SENSORS, Config
from edqn_jax.errors import ConfigError
from edqn_jax.keys import uniform_integers
from edqn_jax.sim.physics import disturbances, drone
from edqn_jax.sim.physics.airframe import Airframe
from edqn_jax.sim.physics.disturbances import Disturbance
from edqn_jax.sim.physics.drone import DroneState, Flight
from edqn_jax.sim.scene.launches import initial_aim, update_aim
from edqn_jax.sim.scene.motion import Aim
from edqn_jax.sim.scene.scene import PARKED, Scene, has_motion, scene_at, take_scene, with_drones
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.sensors.sensor import SensorMemory
from edqn_jax.sim.task import group
from edqn_jax.sim.task.action_sets import action_set, clip_action
from edqn_jax.sim.task.decision import Decision, Payment, Situation, reset_decision, select_tree, take_decision, time_of
from edqn_jax.sim.task.group import Turn
from edqn_jax.sim.task.missions import Missions
from edqn_jax.sim.task.observation import Observation, View, observe, poses_at_start, sensor_poses, with_times
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.renewal import renew
from edqn_jax.sim.task.reward import Reward
from edqn_jax.sim.worlds import geodesic


@struct.dataclass
class EnvParams:
    """Parameters of environments: airframe, pool of P scenes, missions and reward."""

    airframe: Airframe
    pool: Scene  # every array with a leading [P]
    missions: Missions
    reward: Reward | None = struct.field(pytree_node=False, default=None)  # in place of the configured one
    distances: geodesic.Field | None = None  # to the pool's own goals, in training for the reward `geodesic`


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
class NonFinite:
    """Which quantities of a diverged decision are not finite: [] bool each."""

    physics_state: Array
    observation: Array
    reward: Array


@struct.dataclass
class Step:
    """Result of one step. n physics steps."""

    observation: Observation
    reward: Array  # [] float32, unscaled
    outcome: Array  # [] int32, an `Outcome`
    is_reset: Array  # [] bool, the step was spent on a reset, or on waiting for one: reward 0, action ignored
    episode_return: Array  # [] of the episode so far, this step included
    episode_length: Array  # [] int32, likewise
    flight: Flight  # [n, ...] after each physics step; for a reset, the new start throughout
    end_step: Array  # [] int32, physics step (1..n) at which the outcome fell; n while running
    contact: Array  # [] share of that step flown before a collision touched, 1 otherwise
    broken: NonFinite
    waits: Array | None = None  # [] bool, the episode has ended and that of others in the group has not
    hit_drone: Array | None = None  # [] bool, the collision was with a drone; both None for a drone alone


@struct.dataclass
class _Start:
    """The beginning of an episode."""

    drone: DroneState  # at rest at the mission's start, facing its goal
    sensor: Array  # key of the sensor at rest
    disturbance: Disturbance | None  # what the episode will fly against


def _start(config: Config, env_params: EnvParams, mission: Array, key: Array) -> _Start:
    start, goal = env_params.missions.start[mission], env_params.missions.goal[mission]
    yaw = jnp.arctan2(goal[1] - start[1], goal[0] - start[0])
    disturbance = None
    if disturbances.any_on(config):
        key, drawing = jax.random.split(key)
        disturbance = disturbances.sample_disturbance(
            config, env_params.airframe.mass * env_params.airframe.gravity / 4, drawing
        )
    if disturbance is not None and config.env.action_delay:
        disturbance = dataclasses.replace(disturbance, move=jnp.asarray(action_set(config).still))
    return _Start(drone.hover_state(start, yaw), key, disturbance)


def nearness(config: Config, env_params: EnvParams, state: EnvState) -> Array:
    """Returns how near things are from an environment now: [H, W] as `sensor.label_image`, without a unit.

    A label for training: no observation holds it. With several drones as `step`.
    """
    scene = scene_now(config, env_params, state)
    if group.is_multi_drone(config):
        there, is_there = group.other_drones(config, (state.drone.position, ~state.ended))
        there = jnp.where(is_there[:, None], there, PARKED)
        scene = with_drones(scene, there, jnp.where(is_there, config.drone.body_radius_m, 0.0))
    return sensor.label_image(config, scene, state.drone.position, state.drone.quaternion)


def reset(
    config: Config, env_params: EnvParams, key: Array, mission: Array | None = None
) -> tuple[EnvState, Observation]:
    """Returns a fresh environment on a mission drawn from the pool, or on the given one, [] int32."""
    key, noise = jax.random.split(key)
    state = dataclasses.replace(before_reset(config, env_params, key, mission), ended=jnp.zeros((), bool))
    scene, actions = scene_of(env_params, state.mission), action_set(config)
    view = View(
        scene=scene,
        goal=env_params.missions.goal[state.mission],
        drone=state.drone,
        move=actions.direction(state.drone, jnp.asarray(actions.still)),
        poses=poses_at_start(config, scene, state.drone),
        disturbance=state.disturbance,
    )
    observation, memory = observe(config, view, state.memory, noise)
    aim = update_aim(config, scene, state.aim, state.decision, state.drone.position, jnp.zeros(3))
    return dataclasses.replace(state, memory=memory, aim=aim), observation


def before_reset(config: Config, env_params: EnvParams, key: Array, mission: Array | None = None) -> EnvState:
    """Returns an environment whose next step is a reset; it needs no picture. The mission [] is as in `reset`."""
    key, mission_key, rest = jax.random.split(key, 3)
    mission = _sample_mission(config, env_params, mission_key) if mission is None else mission
    start = _start(config, env_params, mission, rest)
    return EnvState(
        drone=start.drone,
        mission=mission.astype(jnp.int32),
        decision=jnp.zeros((), jnp.int32),
        ended=jnp.ones((), bool),
        memory=sensor.at_rest(config, start.sensor),
        episode_return=jnp.zeros(()),
        key=key,
        disturbance=start.disturbance,
        aim=initial_aim(env_params.pool),
    )


def _sample_mission(config: Config, env_params: EnvParams, key: Array) -> Array:
    count = env_params.missions.scene.shape[0]
    if group.is_multi_drone(config):
        return group.mission_of_block(config, uniform_integers(key, (), count // config.env.drones))
    return uniform_integers(key, (), count)


class _Keys(NamedTuple):
    """Keys split from an environment's key at each step; each is consumed."""

    next: Array
    mission: Array
    start: Array
    noise: Array
    gusts: Array | None  # None where nothing changes how a drone flies

    @classmethod
    def split(cls, config: Config, key: Array) -> _Keys:
        key, mission, start, noise = jax.random.split(key, 4)
        gusts = None
        if disturbances.changes_flight(config):
            key, gusts = jax.random.split(key)
        return cls(key, mission, start, noise, gusts)


def step(
    config: Config, env_params: EnvParams, state: EnvState, action: Array, mission: Array | None = None
) -> tuple[EnvState, Step]:
    """Takes one decision of one drone, or its reset if its episode has ended.

    With several drones it must be mapped by `group.map_drones`; a drone whose episode has ended waits until all of its
    group have ended, and is absent meanwhile.

    Args:
        action: as `env.actions` has it: a move [] int, 0..26, or numbers [A] in [-1, 1].
        mission: [] int, which one a reset takes; None draws one. Those of a group are a block of N in a row.
    """
    actions = action_set(config)
    action, keys = clip_action(actions.space, action), _Keys.split(config, state.key)
    turn = group.turn_of(config, state.ended)
    fresh = _sample_mission(config, env_params, keys.mission) if mission is None else mission
    mission = jnp.where(turn.is_reset, fresh, state.mission).astype(jnp.int32)
    check_index(mission, env_params.missions.scene.shape[0], "the missions")
    goal = env_params.missions.goal[mission]
    scene = scene_of(env_params, mission, select_tree(turn.is_reset, initial_aim(env_params.pool), state.aim))
    start = _start(config, env_params, mission, keys.start)

    # For an ended environment the decision is computed and dropped.
    payment = Payment(env_params.reward, env_params.distances, env_params.missions.scene[state.mission])
    before = Situation(scene, goal, state.drone, state.decision, state.ended, state.disturbance)
    done = take_decision(config, env_params.airframe, payment, before, action, keys.gusts)
    done = _taken(config, turn, before, start, done)
    first = select_tree(turn.is_reset, start.drone, state.drone)
    view = View(
        scene=group.add_other_drones(config, scene, first.position, done.flight, turn.goes_on(done.verdict.outcome)),
        goal=goal,
        drone=done.drone,
        move=select_tree(
            turn.is_reset,
            actions.direction(done.drone, jnp.asarray(actions.still)),
            actions.direction(done.drone, action),
        ),
        poses=sensor_poses(config, first, done.flight),
        disturbance=done.disturbance,
    )
    memory = renew(config, turn.is_reset, start.sensor, state.memory)
    observation, memory, observation_nonfinite = _sense(config, turn, view, memory, keys.noise)
    outcome = jnp.where(observation_nonfinite, int(Outcome.DIVERGED), done.verdict.outcome)
    decision = turn.decisions_after(state.decision)
    moved = jnp.where(turn.is_reset, 0.0, done.drone.position - first.position)
    after = EnvState(
        drone=done.drone,
        mission=mission,
        decision=decision,
        ended=turn.is_over(outcome),
        memory=memory,
        episode_return=jnp.where(turn.is_reset, 0.0, state.episode_return + done.reward),
        key=keys.next,
        disturbance=done.disturbance,
        aim=update_aim(config, view.scene, scene.aim, decision, done.drone.position, moved),
    )
    return after, _step_of(turn, after, done, outcome, observation, observation_nonfinite)


def _taken(config: Config, turn: Turn, before: Situation, start: _Start, done: Decision) -> Decision:
    """Returns the decision, or the reset or wait that replaces it; with times of its poses if anything moves."""
    done = select_tree(turn.is_reset, reset_decision(done, start.drone, start.disturbance), done)
    if turn.waits is not None:
        done = select_tree(turn.waits, reset_decision(done, before.drone, before.disturbance), done)
    if not has_motion(before.scene) and not group.is_multi_drone(config):
        return done
    # The time before a start is negative: what moves has moved before.
    n = config.drone.physics_steps
    steps = jnp.where(turn.is_reset, -n, before.decision * n) + jnp.arange(1, n + 1)
    return dataclasses.replace(done, flight=with_times(config, done.flight, steps))


def _sense(
    config: Config, turn: Turn, view: View, memory: SensorMemory, key: Array
) -> tuple[Observation, SensorMemory, Array]:
    """Observes; returns also whether what the sensor shows was not finite, and is zeros now, [] bool."""
    observation, memory = observe(config, view, memory, key)
    for number in jax.tree.leaves(observation.sensed):
        check_finite(number, "what a sensor shows")
    # Own state and motion are of a finite body; counts of events are whole numbers, and nothing is checked.
    observation_nonfinite = ~is_finite(observation.sensed)
    if turn.waits is not None:
        observation_nonfinite &= ~turn.waits
    if _has_floats(observation.sensed):
        observation = select_tree(observation_nonfinite, jax.tree.map(jnp.zeros_like, observation), observation)
    return observation, memory, observation_nonfinite


def check_sensor(config: Config, env_params: EnvParams) -> None:
    """Raises ConfigError if a registered sensor's first observation is not finite; built-in sensors are not checked.

    Raises:
        ConfigError: names the sensor.
    """
    name = config.env.sensor
    if name not in SENSORS.own:
        return
    first = group.map_drones(config, lambda key: reset(config, env_params, key)[1].sensed)
    if not is_finite(jax.jit(first)(jax.random.split(jax.random.key(0), config.env.drones))):
        raise ConfigError(f"the sensor '{name}' must show finite numbers, and shows NaN or Inf as a flight begins")


def _step_of(
    turn: Turn, after: EnvState, done: Decision, outcome: Array, observation: Observation, observation_nonfinite: Array
) -> Step:
    return Step(
        observation=observation,
        reward=done.reward,
        outcome=outcome,
        is_reset=turn.is_reset if turn.waits is None else turn.is_reset | turn.waits,
        episode_return=after.episode_return,
        episode_length=after.decision,
        flight=done.flight,
        end_step=done.verdict.end_step,
        contact=done.verdict.contact,
        broken=NonFinite(physics_state=done.broken, observation=observation_nonfinite, reward=done.unrewarded),
        waits=turn.waits,
        hit_drone=done.verdict.hit_drone,
    )


def _has_floats(tree: object) -> bool:
    return any(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(tree))


def scene_of(env_params: EnvParams, mission: Array, aim: Aim | None = None) -> Scene:
    """Returns the world of a mission [] int32, with its motion; balls are thrown at the mission's own drone.

    Args:
        aim: of the flight; None is that of a drone of steady pace.
    """
    scene = take_scene(env_params.pool, env_params.missions.scene[mission])
    if not has_motion(scene):
        return scene
    return dataclasses.replace(
        scene, start=env_params.missions.start[mission], goal=env_params.missions.goal[mission], aim=aim
    )


def scene_now(config: Config, env_params: EnvParams, state: EnvState) -> Scene:
    """Returns the scene of an environment at its present time, after its last decision."""
    scene = scene_of(env_params, state.mission, state.aim)
    return scene_at(scene, time_of(config, state.decision) if has_motion(scene) else None)
