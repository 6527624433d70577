"""Tallies of flights: outcome, decisions, path, time and closest approach, added up decision by decision."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.sim.physics.drone import DroneState, Flight
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Scene, scene_at


@struct.dataclass
class Closest:
    """Where a flight came closest to a shape, other drones aside, its start and end included. M missions."""

    distance: Array  # [M] metres between the body's sphere and the shape
    time: Array  # [M] seconds since the start
    position: Array  # [M, 3] metres
    quaternion: Array  # [M, 4]


@struct.dataclass
class Record:
    """Whole flights, a row per physics step, taken after it. T = decision limit x physics steps a decision.

    Rows after a flight's end are NaN. The last row of a collision stands beyond the contact: what the physics
    computed without knowing of it.
    """

    position: Array  # [M, T, 3] metres
    quaternion: Array  # [M, T, 4]
    velocity: Array  # [M, T, 3] m/s
    clearance: Array  # [M, T] metres from the body's sphere to the nearest shape, at a contact cut off there
    action: Array  # [M, D, ...] one a decision; after the end -1, or NaN where actions are in a box
    reward: Array  # [M, D] of each decision


@struct.dataclass
class Flights:
    """Tallies of M missions. A flight ends with the physics step of its outcome, a collision at the contact."""

    outcome: Array  # [M] int32, an `Outcome`
    decisions: Array  # [M] int32
    physics_steps: Array  # [M] int32, the one of the outcome included
    contact: Array  # [M] share of the last physics step flown before a collision touched, 1 otherwise
    episode_return: Array  # [M] undiscounted
    path_length_m: Array  # [M]
    flight_seconds: Array  # [M]
    closest: Closest
    record: Record | None
    hit_drone: Array | None = None  # [M] bool, the collision was with another drone; None where one flies alone
    decoder_errors: Array | None = None  # [M, 2, bins] of `evaluation.decoder`, if they were asked for

    def get_record(self) -> Record:
        """Returns the record.

        Raises:
            ValueError: if the flights were not recorded.
        """
        if self.record is None:
            raise ValueError("the flights were not recorded; fly them with record=True")
        return self.record


def at_start(config: Config, scene: Scene, body: DroneState) -> Flights:
    """Returns the tallies of a flight that begins at `body`."""
    zero, none = jnp.zeros(()), jnp.zeros((), jnp.int32)
    return Flights(
        outcome=none,
        decisions=none,
        physics_steps=none,
        contact=jnp.ones(()),
        episode_return=zero,
        path_length_m=zero,
        flight_seconds=zero,
        closest=Closest(
            distance=signed_distance(scene, body.position) - config.drone.body_radius_m,
            time=zero,
            position=body.position,
            quaternion=body.quaternion,
        ),
        record=None,
    )


def update_tallies(
    config: Config,
    scene: Scene,
    flights: Flights,
    before: Array,
    flight: Flight,
    outcome: Array,
    end_step: Array,
    contact: Array,
) -> tuple[Flights, Array]:
    """Returns the tallies of one flight after one more decision; the return is added elsewhere.

    Args:
        config: body and physics.
        scene: its shapes are where they are at each moment of the decision.
        flights: of one flight that is not over.
        before: [3] metres, position before the first physics step.
        flight: n physics steps.
        outcome: as `outcomes.judge_decision` has it, like the next two.
        end_step: in 1..n.
        contact: share of that step.

    Returns:
        the tallies, and the clearance [n] after each physics step, metres.
    """
    steps = jnp.arange(config.drone.physics_steps)
    is_flown = steps < end_step
    share = jnp.where(steps == end_step - 1, contact, 1.0)
    begin = jnp.concatenate([before[None], flight.position[:-1]])
    segment = share[:, None] * (flight.position - begin)
    end = begin + segment
    times = flights.flight_seconds + (steps + share) * config.drone.physics_dt_s

    distance = jax.vmap(lambda point, time: signed_distance(scene_at(scene, time), point))(end, times)
    clearance = distance - config.drone.body_radius_m
    least = jnp.argmin(jnp.where(is_flown, clearance, jnp.inf))
    closest = Closest(
        distance=clearance[least],
        time=times[least],
        position=end[least],
        quaternion=flight.quaternion[least],
    )
    closer = closest.distance < flights.closest.distance
    after = Flights(
        outcome=outcome,
        decisions=flights.decisions + 1,
        physics_steps=flights.physics_steps + end_step,
        contact=contact,
        episode_return=flights.episode_return,
        path_length_m=flights.path_length_m + jnp.sum(jnp.where(is_flown, jnp.sqrt(jnp.sum(segment**2, axis=-1)), 0.0)),
        flight_seconds=times[end_step - 1],
        closest=jax.tree.map(lambda new, old: jnp.where(closer, new, old), closest, flights.closest),
        record=None,
    )
    return after, clearance
