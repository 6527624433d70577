"""One decision of one drone in stages: command, fly, judge, reward; and the reset in a decision's place.

Observing comes after it, in `observation.py`. `env.step` puts all together. An action that comes a decision late wraps
the command, gusts wrap the flight, the other drones of a group wrap the verdict.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.checks import check_finite
from edqn_jax.config import Config
from edqn_jax.sim.physics.airframe import Airframe
from edqn_jax.sim.physics.controller import Command
from edqn_jax.sim.physics.disturbances import Disturbance
from edqn_jax.sim.physics.drone import DroneState, Flight
from edqn_jax.sim.physics.flight import fly_command, fly_disturbed
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Scene, has_motion, scene_at
from edqn_jax.sim.task import group
from edqn_jax.sim.task.action_sets import action_set
from edqn_jax.sim.task.observation import repeat_pose
from edqn_jax.sim.task.outcomes import Outcome, Verdict, judge_decision
from edqn_jax.sim.task.reward import Reward, Transition, configured_reward, reward_of
from edqn_jax.sim.worlds import geodesic


@struct.dataclass
class Situation:
    """State of one drone before a decision."""

    scene: Scene  # with its motion
    goal: Array  # [3] metres
    drone: DroneState
    decision: Array  # [] int32 taken before in this episode
    ended: Array  # [] bool, the episode has ended
    disturbance: Disturbance | None = None  # None where nothing disturbs


@struct.dataclass
class Payment:
    """Inputs of the reward beside the configuration."""

    function: Reward | None = struct.field(pytree_node=False)  # in place of the configured reward
    distances: geodesic.Field | None  # None where all distances are straight
    number: Array  # [] int32, the world in the pool


@struct.dataclass
class Decision:
    """Result of one decision, or of the reset that replaces it. n physics steps."""

    drone: DroneState
    flight: Flight  # [n, ...]
    verdict: Verdict
    reward: Array
    broken: Array  # [] bool, the body was not finite
    unrewarded: Array  # [] bool, the reward was not, although the body was
    disturbance: Disturbance | None = None


def select_tree(condition: Array, yes, no):
    """Returns `yes` where the condition [] holds, else `no`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def time_of(config: Config, decisions: Array) -> Array:
    """Returns the seconds [] of an episode after so many decisions []."""
    return (decisions * config.drone.physics_steps) * config.drone.physics_dt_s


def take_decision(
    config: Config, airframe: Airframe, payment: Payment, before: Situation, action: Array, gusts: Array | None
) -> Decision:
    """Returns the decision as flown, judged and rewarded.

    A diverged body stays where it was, so that no NaN reaches an observation; a decision without a finite reward has
    diverged, too.

    Args:
        config: of task and drone.
        airframe: that the controller believes in.
        payment: see there.
        before: see there.
        action: [] or [A], as chosen.
        gusts: key, consumed; None where nothing changes how a drone flies.
    """
    applied_action, late = _delay_action(config, before.disturbance, action)
    command = action_set(config).command(config, airframe, before.drone, before.goal, applied_action)
    after, disturbance, flight = _fly(config, airframe, before.drone, late, command, gusts)
    verdict = _judge(config, before, flight)
    reward = _reward(config, payment, before, after, action, verdict.outcome)
    numbers = jnp.concatenate([after.position, after.quaternion, after.velocity, after.angular_velocity])
    broken = ~jnp.all(jnp.isfinite(numbers))
    check_finite(numbers, "the state of a drone")
    check_finite(jnp.where(broken, 0.0, reward), "the reward of a decision")
    unrewarded = ~broken & ~jnp.isfinite(reward)
    ill, hit = broken | unrewarded, verdict.hit_drone
    return Decision(
        drone=select_tree(broken, before.drone, after),
        flight=select_tree(broken, repeat_pose(before.drone, flight.position.shape[0]), flight),
        verdict=dataclasses.replace(
            verdict,
            outcome=jnp.where(ill, int(Outcome.DIVERGED), verdict.outcome).astype(jnp.int32),
            hit_drone=None if hit is None else hit & ~ill,
        ),
        reward=jnp.where(ill, 0.0, reward),
        broken=broken,
        unrewarded=unrewarded,
        disturbance=select_tree(broken, before.disturbance, disturbance),
    )


def reset_decision(decision: Decision, start: DroneState, disturbance: Disturbance | None = None) -> Decision:
    """Returns a reset with the arrays of a decision: at `start` throughout, with no reward."""
    verdict = decision.verdict
    return dataclasses.replace(
        decision,
        drone=start,
        flight=repeat_pose(start, decision.flight.position.shape[0]),
        verdict=dataclasses.replace(
            verdict,
            outcome=jnp.full((), int(Outcome.RUNNING), jnp.int32),
            hit_drone=None if verdict.hit_drone is None else jnp.zeros((), bool),
        ),
        reward=jnp.zeros(()),
        broken=jnp.zeros((), bool),
        unrewarded=jnp.zeros((), bool),
        disturbance=disturbance,
    )


def _delay_action(config: Config, disturbance: Disturbance | None, action: Array) -> tuple[Array, Disturbance | None]:
    """Returns the action that is flown now, and the disturbance with the one that is flown next."""
    if not config.env.action_delay:
        return action, disturbance
    assert disturbance is not None and disturbance.move is not None
    before = disturbance.move if disturbance.late is None else jnp.where(disturbance.late, disturbance.move, action)
    return before, dataclasses.replace(disturbance, move=action)


def _fly(
    config: Config,
    airframe: Airframe,
    body: DroneState,
    disturbance: Disturbance | None,
    command: Command,
    gusts: Array | None,
) -> tuple[DroneState, Disturbance | None, Flight]:
    """Flies a command under the disturbance, if that changes the dynamics."""
    if gusts is not None:
        assert disturbance is not None
        return fly_disturbed(config, airframe, body, disturbance, command, gusts)
    after, flight = fly_command(config.drone, airframe, body, command)
    return after, disturbance, flight


def _judge(config: Config, before: Situation, flight: Flight) -> Verdict:
    """Returns the outcome in the world and among the other drones."""
    position = before.drone.position
    verdict = Verdict(*judge_decision(config, before.scene, before.goal, position, flight, before.decision + 1))
    if not group.is_multi_drone(config):
        return verdict
    path = jnp.concatenate([position[None], flight.position])
    return group.judge_contacts(config, path, ~before.ended, verdict)


def _reward(
    config: Config, payment: Payment, before: Situation, after: DroneState, action: Array, outcome: Array
) -> Array:
    """Returns the configured reward or that of the user's function; without distance fields, distances are straight."""
    here, there, goal = before.drone.position, after.position, before.goal
    moved = jnp.sqrt(jnp.sum((there - here) ** 2))
    if config.env.reward == "geodesic" and payment.distances is not None:
        left = geodesic.distance_to_goal(payment.distances, payment.number, goal, here)
        gained = left - geodesic.distance_to_goal(payment.distances, payment.number, goal, there)
        # Gains are at most the length flown: a drone that crashes into a thin wall ends behind it.
        most = geodesic.MAX_LATTICE_RATIO * moved
        still_left = left - jnp.clip(gained, -most, most)
    else:
        left, still_left = (jnp.sqrt(jnp.sum((goal - point) ** 2)) for point in (here, there))
    clearance = None
    if config.env.closeness_weight or payment.function is not None:
        scene = before.scene
        afterwards = scene_at(scene, time_of(config, before.decision + 1) if has_motion(scene) else None)
        clearance = signed_distance(afterwards, there) - config.drone.body_radius_m
    configured = configured_reward(config.env, outcome, left, still_left, moved, clearance)
    if payment.function is None:
        return configured
    assert clearance is not None
    transition = Transition(
        before=here,
        after=there,
        goal=goal,
        clearance=clearance,
        move=action,
        outcome=outcome,
        configured=configured,
    )
    return reward_of(payment.function, transition)
