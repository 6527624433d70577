"""Several drones in one world: what the drones of a group are to each other.

N drones (`env.drones`) that stand next to each other in an array of environments are one group: they share world,
clock and end, and nothing else. Functions stay those of one drone; `map_drones` maps them so that a drone can gather
the others of its group over the named axis. A decision has two parts: first each drone flies, knowing of none, then
each is judged and sees, in a world in which the others are spheres that move as they have just flown.

A drone whose episode has ended is absent, and waits until all of its group have ended; then all are reset together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.motion import DroneTracks
from edqn_jax.sim.scene.scene import PARKED, Scene
from edqn_jax.sim.task.outcomes import Outcome, Verdict

AXIS = "drones"
"""Name of the axis of a group's drones."""


def is_multi_drone(config: Config) -> bool:
    """Returns whether drones fly in groups; known when tracing."""
    return config.env.drones > 1


def check_alone(config: Config, caller: str) -> None:
    """Refuses several drones where one flies alone.

    Raises:
        ConfigError: if drones fly in groups.
    """
    if is_multi_drone(config):
        raise ConfigError(
            f"{caller} flies one drone: env.drones must be 1, not {config.env.drones}; "
            "`edqn train` and `edqn evaluate` fly several"
        )


def map_drones(config: Config, function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function of one drone mapped over environments [E, ...], groups of N one after the other.

    Args:
        config: says N, which divides E.
        function: of arrays of one drone; within it `gather_group` and what needs it can be called.
    """
    if not is_multi_drone(config):
        return jax.vmap(function)
    in_groups = jax.vmap(jax.vmap(function, axis_name=AXIS))

    def mapped(*arguments: Any) -> Any:
        split = jax.tree.map(lambda x: x.reshape(-1, config.env.drones, *x.shape[1:]), arguments)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), in_groups(*split))

    return mapped


def gather_group(tree: Any) -> Any:
    """Returns the arrays of all drones of the group, with a leading [N], to one of them; see `map_drones`."""
    return lax.all_gather(tree, AXIS)


def own_number() -> Array:
    """Returns the drone's own number in its group, [] int32 from 0."""
    return lax.axis_index(AXIS)


def other_drones(config: Config, tree: Any) -> Any:
    """Returns the arrays [N - 1, ...] of all others, of one drone's own."""
    which = (own_number() + 1 + jnp.arange(config.env.drones - 1)) % config.env.drones
    return jax.tree.map(lambda x: x[which], gather_group(tree))


def mission_of_block(config: Config, block: Array) -> Array:
    """Returns the drone's own mission [] int32 of the block [] int32 that the group's first drone has drawn."""
    return gather_group(block)[0] * config.env.drones + own_number()


@struct.dataclass
class Turn:
    """Whether a drone's step is a decision, a reset or a wait."""

    is_reset: Array  # [] bool
    waits: Array | None = None  # [] bool, for others of the group whose episodes go on; None for a drone alone

    def goes_on(self, outcome: Array) -> Array:
        """Returns whether others see a drone with this outcome [] after its decision, [] bool."""
        on = outcome == Outcome.RUNNING
        return on if self.waits is None else on & ~self.waits

    def decisions_after(self, decision: Array) -> Array:
        """Returns the decisions [] of the episode after the step."""
        count = jnp.where(self.is_reset, 0, decision + 1)
        return count if self.waits is None else jnp.where(self.waits, decision, count)

    def is_over(self, outcome: Array) -> Array:
        """Returns whether the episode has ended after a step with this outcome, [] bool."""
        over = outcome != Outcome.RUNNING
        return over if self.waits is None else over | self.waits


def turn_of(config: Config, ended: Array) -> Turn:
    """Returns the kind of a drone's next step from whether its episode `ended`, [] bool."""
    if not is_multi_drone(config):
        return Turn(ended)
    over = jnp.all(gather_group(ended))
    return Turn(over, ended & ~over)


def active_partner_index(config: Config, waits: Array) -> Array:
    """Returns for each environment [E] its own index, for one that waits that of the first of its group that flies.

    Args:
        waits: [E] bool; of a group there is always one that does not.
    """
    number = jnp.arange(waits.shape[0])
    in_groups = waits.reshape(-1, config.env.drones)
    first = number[:: config.env.drones] + jnp.argmin(in_groups, axis=1)
    return jnp.where(waits, jnp.repeat(first, config.env.drones), number)


def add_other_drones(config: Config, scene: Scene, first: Array, flight: Flight, is_there: Array) -> Scene:
    """Returns the scene with the other drones added; unchanged for a single drone.

    Args:
        scene: one world.
        first: [3] metres, where the drone itself was before the decision.
        flight: how it has flown since, with times.
        is_there: [] bool, whether the drone is visible to the others.
    """
    if not is_multi_drone(config):
        return scene
    assert flight.time is not None
    path, is_there = other_drones(config, (jnp.concatenate([first[None], flight.position]), is_there))
    dt = config.drone.physics_dt_s
    tracks = DroneTracks(
        path=jnp.where(is_there[:, None, None], path, PARKED),
        radius=jnp.where(is_there, config.drone.body_radius_m, 0.0),
        began=flight.time[0] - dt,
        step_s=jnp.float32(dt),
    )
    return dataclasses.replace(scene, drones=tracks)


def judge_contacts(config: Config, path: Array, flies: Array, verdict: Verdict) -> Verdict:
    """Returns one drone's verdict among the others: a contact of two drones ends both, unless one has ended before.

    At the same moment a contact of drones wins.

    Args:
        config: of the group.
        path: [n + 1, 3] metres, before the first physics step and after each.
        flies: [] bool, whether it has not ended in an earlier decision.
        verdict: of the drone alone in its world.
    """
    outcome, end_step, contact = verdict.outcome, verdict.end_step, verdict.contact
    ends = (outcome != Outcome.RUNNING) & (outcome != Outcome.TIME_OUT)
    until = jnp.where(ends, end_step - 1 + contact, jnp.inf)
    paths, fly, untils = gather_group((path, flies, until))
    hit = contact_times(paths, fly, untils, 2 * config.drone.body_radius_m)[own_number()]
    hits = jnp.isfinite(hit)
    step = jnp.clip(jnp.ceil(jnp.where(hits, hit, 1.0)), 1, path.shape[0] - 1).astype(jnp.int32)
    return Verdict(
        outcome=jnp.where(hits, int(Outcome.COLLISION), outcome).astype(jnp.int32),
        end_step=jnp.where(hits, step, end_step),
        contact=jnp.where(hits, hit - (step - 1), contact),
        hit_drone=hits,
    )


def contact_times(path: Array, flies: Array, until: Array, reach: float) -> Array:
    """Returns when each drone of a group hits another, [N] in physics steps from 0, inf where it does not.

    Contacts are taken in the order of time; a drone that has ended hits no other.

    Args:
        path: [N, n + 1, 3] metres.
        flies: [N] bool.
        until: [N] when each ends for another reason, in physics steps; inf where it does not.
        reach: metres between the centres of two that touch.
    """
    count = path.shape[0]
    meet = jax.vmap(jax.vmap(lambda a, b: pair_contact_time(a, b, reach), (None, 0)), (0, None))(path, path)
    possible = meet <= jnp.minimum(until[:, None], until[None, :])
    possible &= flies[:, None] & flies[None, :] & ~jnp.eye(count, dtype=bool)
    meet = jnp.where(possible, meet, jnp.inf)
    hit = jnp.full(count, jnp.inf)
    for _ in range(count // 2):
        free = jnp.isinf(hit)
        left = jnp.where(free[:, None] & free[None, :], meet, jnp.inf)
        first = jnp.argmin(left)
        pair = (jnp.arange(count) == first // count) | (jnp.arange(count) == first % count)
        hit = jnp.where(pair & free, left.ravel()[first], hit)
    return hit


def pair_contact_time(one: Array, other: Array, reach: float) -> Array:
    """Returns when two spheres that move straight within each physics step first touch: [] physics steps, inf if never.

    Seen from the other, one moves along a segment `d0 + f d`, f in [0, 1]; they touch where its length is `reach`. The
    result is the same to the bit with the two exchanged.

    Args:
        one, other: [n + 1, 3] metres, where they are at the same times.
        reach: metres between their centres at a contact.
    """
    apart = one - other
    begin, move = apart[:-1], (one[1:] - one[:-1]) - (other[1:] - other[:-1])
    along = jnp.sum(begin * move, axis=1)
    gap = jnp.sum(begin * begin, axis=1) - reach * reach
    root = along * along - jnp.sum(move * move, axis=1) * gap
    closing = (along < 0) & (root >= 0)
    # The lesser root as c / (-b + sqrt), which has no difference of two nearly equal numbers.
    share = gap / jnp.where(closing, -along + jnp.sqrt(jnp.maximum(root, 0.0)), 1.0)
    share = jnp.where(gap <= 0, 0.0, jnp.where(closing & (share <= 1.0), share, jnp.inf))
    return jnp.min(jnp.arange(share.shape[0]) + jnp.where(jnp.isnan(share), jnp.inf, share))
