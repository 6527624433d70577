"""Outcome, reward, own state and own motion of a decision, as `edqn_jax/sim/task/env.py` defines them, in numba."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np

from conventional_stack.flight import clip, wrap_angle
from edqn_jax.config import Config
from edqn_jax.extras import require_extra
from edqn_jax.sim.task.observation import MAX_YAW_RATE
from edqn_jax.sim.task.outcomes import Outcome

numba = require_extra("numba")

RUNNING, GOAL, COLLISION, LEFT_VOLUME, TIME_OUT, DIVERGED = (int(outcome) for outcome in Outcome)

_PLANE, _SPHERE, _CAPSULE, _CYLINDER = (
    int(kind)
    for kind in (
        mujoco.mjtGeom.mjGEOM_PLANE,
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
    )
)

_SAMPLES = 8
"""Points at which a segment is checked, as in `distance.segment_contact`."""

_REWARDS = ("sparse", "progress", "potential")


class Rules(NamedTuple):
    """The options that `judge` needs, with the names of `EnvConfig`."""

    radius: float
    goal_radius: float
    max_decisions: int
    reward: int  # index into `_REWARDS`
    progress_weight: float
    path_weight: float
    goal_reward: float
    collision_reward: float
    left_volume_reward: float
    step_reward: float
    discount: float
    speed: float


def rules_of(config: Config) -> Rules:
    """Returns the rules of a configuration."""
    return Rules(
        radius=config.drone.body_radius_m,
        goal_radius=config.env.goal_radius_m,
        max_decisions=config.env.max_decisions,
        reward=_REWARDS.index(config.env.reward),
        progress_weight=config.env.progress_weight,
        path_weight=config.env.path_weight,
        goal_reward=config.env.goal_reward,
        collision_reward=config.env.collision_reward,
        left_volume_reward=config.env.left_volume_reward,
        step_reward=config.env.step_reward,
        discount=config.env.potential_discount,
        speed=config.env.speed_m_s,
    )


@numba.njit(cache=True, error_model="numpy")
def signed_distance(geoms, px, py, pz):
    """Returns metres from a point to the nearest geom, negative inside one; inf in an empty world."""
    nearest = math.inf
    for g in range(len(geoms.kind)):
        kind, axes, size = geoms.kind[g], geoms.axes[g], geoms.size[g]
        dx, dy, dz = px - geoms.position[g, 0], py - geoms.position[g, 1], pz - geoms.position[g, 2]
        z = axes[2, 0] * dx + axes[2, 1] * dy + axes[2, 2] * dz
        if kind == _PLANE:
            distance = z
        elif kind == _SPHERE:
            distance = math.sqrt(dx * dx + dy * dy + dz * dz) - size[0]
        else:
            x = axes[0, 0] * dx + axes[0, 1] * dy + axes[0, 2] * dz
            y = axes[1, 0] * dx + axes[1, 1] * dy + axes[1, 2] * dz
            if kind == _CAPSULE:
                beyond = max(abs(z) - size[1], 0.0)
                distance = math.sqrt(x * x + y * y + beyond * beyond) - size[0]
            else:
                if kind == _CYLINDER:
                    a, b, c = math.sqrt(x * x + y * y) - size[0], abs(z) - size[1], -math.inf
                else:
                    a, b, c = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
                deepest = max(a, b, c)
                a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
                distance = math.sqrt(a * a + b * b + c * c) if deepest > 0 else deepest
        nearest = min(nearest, distance)
    return nearest


@numba.njit(cache=True, error_model="numpy")
def _contact(geoms, radius, start, end):
    """Returns the fraction of the line from `start` [3] to `end` [3] at which a sphere first touches; inf if never."""
    before = 0.0
    for k in range(_SAMPLES):
        f = k / (_SAMPLES - 1)
        x, y, z = (
            start[0] + f * (end[0] - start[0]),
            start[1] + f * (end[1] - start[1]),
            start[2] + f * (end[2] - start[2]),
        )
        gap = signed_distance(geoms, x, y, z) - radius
        if gap <= 0:
            # Between the last free sample and this one, interpolated linearly.
            return 0.0 if k == 0 else f - gap / (gap - before) / (_SAMPLES - 1)
        before = gap
    return math.inf


@numba.njit(cache=True, error_model="numpy")
def _first_verdict(geoms, rules, goal, path):
    """Returns the outcome of the first physics step that ends the episode, else RUNNING.

    Within a step the order is: not finite, contact, outside the volume, goal. Also returns that step, 1..n, and the
    fraction of it before a contact, as `edqn_jax.sim.task.outcomes.judge_decision`.
    """
    gap = signed_distance(geoms, path[0, 0], path[0, 1], path[0, 2]) - rules.radius
    for step in range(1, len(path)):
        x, y, z = path[step, 0], path[step, 1], path[step, 2]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            return DIVERGED, step, 1.0
        before, gap = gap, signed_distance(geoms, x, y, z) - rules.radius
        dx, dy, dz = x - path[step - 1, 0], y - path[step - 1, 1], z - path[step - 1, 2]
        # Two clearances whose sum exceeds the distance prove the segment free.
        free = before + gap > math.sqrt(dx * dx + dy * dy + dz * dz)
        if not free:
            fraction = _contact(geoms, rules.radius, path[step - 1], path[step])
            if fraction <= 1:
                return COLLISION, step, fraction
        for axis in range(3):
            if path[step, axis] < geoms.lower[axis] or path[step, axis] > geoms.upper[axis]:
                return LEFT_VOLUME, step, 1.0
        if (x - goal[0]) ** 2 + (y - goal[1]) ** 2 + (z - goal[2]) ** 2 < rules.goal_radius**2:
            return GOAL, step, 1.0
    return RUNNING, len(path) - 1, 1.0


@numba.njit(cache=True, error_model="numpy")
def reward_of(rules, outcome, before, after, displacement):
    """Returns the reward of one decision from the distances to the goal before and after it and the displacement."""
    if outcome == DIVERGED:
        return 0.0
    total = rules.step_reward
    if outcome == GOAL:
        total += rules.goal_reward
    elif outcome == COLLISION:
        total += rules.collision_reward
    elif outcome == LEFT_VOLUME:
        total += rules.left_volume_reward
    if rules.reward == 1:
        total += rules.progress_weight * (before - after) - rules.path_weight * displacement
    elif rules.reward == 2:
        ended = outcome != RUNNING and outcome != TIME_OUT
        total += rules.progress_weight * (before - (0.0 if ended else rules.discount * after))
    return total


@numba.njit(cache=True, error_model="numpy")
def judge(geoms, rules, goal, path, state, decision, outcome, reward, end_step, contact):
    """Computes outcome and reward of one decision of N drones.

    Args:
        goal: [N, 3] metres.
        path: [N, n + 1, 7] poses; if a drone diverged, all of its poses are set to the first.
        state: [N, 13]; if a drone diverged, set to its first pose at rest.
        decision: [N] number of decisions, increased by 1.
        outcome, reward: [N], output.
        end_step, contact: [N], output, as in `edqn_jax.sim.task.env.Step`.
    """
    for i in range(len(decision)):
        decision[i] += 1
        verdict, end_step[i], contact[i] = _first_verdict(geoms, rules, goal[i], path[i])
        if not np.all(np.isfinite(state[i])):
            verdict = DIVERGED
            state[i, :7], state[i, 7:] = path[i, 0], 0.0
            path[i] = path[i, 0]
        if verdict == RUNNING and decision[i] >= rules.max_decisions:
            verdict = TIME_OUT
        outcome[i] = verdict
        start, end = path[i, 0, :3], path[i, -1, :3]
        before, after, displacement = 0.0, 0.0, 0.0
        for axis in range(3):
            before += (goal[i, axis] - start[axis]) ** 2
            after += (goal[i, axis] - end[axis]) ** 2
            displacement += (end[axis] - start[axis]) ** 2
        reward[i] = reward_of(rules, verdict, math.sqrt(before), math.sqrt(after), math.sqrt(displacement))


@numba.njit(cache=True, error_model="numpy")
def own_state(geoms, rules, goal, state, own):
    """Computes the drones' own states as `edqn_jax.sim.task.observation.own_state`, into `own` [N, 10]."""
    for i in range(len(state)):
        yaw = wrap_angle(2 * math.atan2(state[i, 6], state[i, 3]))
        cos, sin = math.cos(yaw), math.sin(yaw)
        dx, dy, dz = goal[i, 0] - state[i, 0], goal[i, 1] - state[i, 1], goal[i, 2] - state[i, 2]
        own[i, 0] = math.asinh(math.sqrt(dx * dx + dy * dy) / 2.0) / 2.0
        own[i, 1] = math.asinh(dz / 2.0)
        own[i, 2], own[i, 3] = cos, sin
        for axis in range(3):
            lower, upper = geoms.lower[axis], geoms.upper[axis]
            own[i, 4 + axis] = 2 * (state[i, axis] - lower) / (upper - lower) - 1
        vx, vy, vz = state[i, 7] / rules.speed, state[i, 8] / rules.speed, state[i, 9] / rules.speed
        own[i, 7], own[i, 8], own[i, 9] = cos * vx + sin * vy, cos * vy - sin * vx, vz


@numba.njit(cache=True, error_model="numpy")
def own_motion(moves, action, own, state, motion):
    """Computes the drones' own motions as `edqn_jax.sim.task.observation.own_motion`, into `motion` [N, 7].

    Args:
        moves: [27, 3] the vectors of the moves.
        action: [N] the moves that were flown.
        own: [N, 10] own states, which hold the velocity.
        state: [N, 13].
    """
    for i in range(len(state)):
        w, x, y, z = state[i, 3], state[i, 4], state[i, 5], state[i, 6]
        p, q, r = state[i, 10], state[i, 11], state[i, 12]
        turn = w * (w * r + x * q - y * p) + z * (x * p + y * q + z * r)
        motion[i, :3] = own[i, 7:]
        motion[i, 3] = clip(turn / max(w * w + z * z, 1e-9), -MAX_YAW_RATE, MAX_YAW_RATE)
        motion[i, 4:] = moves[action[i]]
