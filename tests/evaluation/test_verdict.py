"""The verdict on flights made by hand."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from edqn_jax.evaluation.judge import MujocoWorld, clearance, load_judge, replay_contact
from edqn_jax.evaluation.verdicts import CONTACT_TOLERANCE_M, Agreement
from edqn_jax.sim.task.outcomes import Outcome

RADIUS = 0.36
MILLIMETRE = 1e-3
WORLD = """
<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="50 50 1"/>
    <geom name="box" type="box" size="1 2 3" pos="10 0 3"/>
    <geom name="tilted" type="box" size="1 1 1" pos="20 0 5" euler="0 45 0"/>
    <geom name="ball" type="sphere" size="1.5" pos="30 0 5"/>
    <body pos="40 0 5"><geom name="capsule" type="capsule" size="0.5 2"/></body>
    <geom name="cylinder" type="cylinder" size="0.8 2" pos="50 0 5"/>
    <geom type="box" size="0.02 5 5" pos="60 0 5"/>
    <geom name="note" type="box" size="1 1 1" pos="70 0 5" contype="0" conaffinity="0" group="3"/>
    <geom name="seen" type="box" size="1 1 1" pos="80 0 5" contype="0" conaffinity="0" group="1"/>
  </worldbody>
</mujoco>
"""
# Where the solid's top is above its centre line x = 10, 20, ... on a flight along y.
TOPS = {"box": (10.0, 6.0), "tilted": (20.0, 5 + 2**0.5), "ball": (30.0, 6.5), "capsule": (40.0, 7.5)}
TOPS |= {"cylinder": (50.0, 7.0), "seen": (80.0, 6.0)}


@pytest.fixture(scope="module")
def judge() -> MujocoWorld:
    return load_judge(mujoco.MjSpec.from_string(WORLD), RADIUS)


def along_y(x: float, z: float, step: float = 0.08) -> np.ndarray:
    y = np.arange(-4.013, 4.0, step)
    return np.stack([np.full_like(y, x), y, np.full_like(y, z)], axis=1)


@pytest.mark.parametrize("name", TOPS)
def test_a_graze_one_millimetre_deep_is_a_contact_and_one_millimetre_off_is_not(judge, name):
    x, top = TOPS[name]
    contact = replay_contact(judge, along_y(x, top + RADIUS - MILLIMETRE))
    assert contact is not None
    assert contact.geom == name
    assert 0 < contact.depth <= MILLIMETRE + 1e-6
    assert replay_contact(judge, along_y(x, top + RADIUS + MILLIMETRE)) is None


def test_the_ground_is_touched_from_above(judge):
    down = np.array([[0, 0, 1.0], [0, 0, RADIUS + MILLIMETRE], [1, 0, RADIUS + MILLIMETRE]])
    assert replay_contact(judge, down) is None
    down[1:, 2] -= 2 * MILLIMETRE
    contact = replay_contact(judge, down)
    assert contact is not None
    assert (contact.segment, contact.geom) == (0, "ground")
    assert contact.depth == pytest.approx(MILLIMETRE, abs=1e-6)


def test_a_thin_wall_between_two_steps_is_met_where_the_sphere_first_touches_it(judge):
    flight = np.array([[55.0, 1, 5], [57.0, 1, 5], [63.0, 1, 5], [64.0, 1, 5]])
    contact = replay_contact(judge, flight)
    assert contact is not None
    first = 60.0 - 0.02 - RADIUS  # geometry, by hand
    assert contact.segment == 1
    assert contact.fraction == pytest.approx((first - 57) / 6, abs=1e-6)
    assert contact.position == pytest.approx((first, 1, 5), abs=1e-6)
    assert contact.geom == "geom 5"  # MuJoCo numbers the world body's own geoms first
    # Half way through, the sphere overlaps by its radius and half the wall.
    assert contact.depth == pytest.approx(RADIUS + 0.02, abs=3e-3)


def test_a_flight_that_begins_inside_a_solid_touches_at_once(judge):
    contact = replay_contact(judge, [[10, 0, 3], [10, 0, 4]])
    assert contact is not None
    assert (contact.segment, contact.fraction, contact.geom) == (0, 0.0, "box")


def test_hovering_beside_a_wall_is_no_contact(judge):
    assert replay_contact(judge, np.tile([[12.0, 0, 3]], (50, 1))) is None


def test_geoms_that_are_notes_to_the_reader_are_flown_through(judge):
    assert replay_contact(judge, [[70, -5, 5], [70, 5, 5]]) is None


def test_the_names_of_a_hit_do_not_depend_on_how_finely_the_flight_is_sampled(judge):
    coarse = replay_contact(judge, [[0, 0, 5], [90, 0, 5]])
    fine = replay_contact(judge, np.linspace([0, 0, 5], [90, 0, 5], 1501))
    assert coarse is not None and fine is not None
    assert coarse.geom == fine.geom == "box"
    assert coarse.position == pytest.approx(fine.position, abs=1e-6)


def flying_sphere() -> mujoco.MjModel:
    """The same world with a free sphere: MuJoCo's collision pipeline pairs no two static bodies."""
    spec = mujoco.MjSpec.from_string(WORLD)
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0])
    model = spec.compile()
    model.geom_contype[model.geom("seen").id] = 1
    return model


def first_collision(model: mujoco.MjModel, points: np.ndarray, spacing: float) -> float | None:
    """Plain reference: returns the metres flown until MuJoCo finds a contact, asked every `spacing` metres."""
    data = mujoco.MjData(model)
    flown = 0.0
    for begin, end in zip(points[:-1], points[1:], strict=True):
        length = float(np.linalg.norm(end - begin))
        for fraction in np.linspace(0, 1, 2 + int(length / spacing)):
            data.qpos[:3] = begin + fraction * (end - begin)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                return flown + fraction * length
        flown += length
    return None


@pytest.mark.slow
def test_random_flights_are_judged_as_the_collision_pipeline_judges_them_at_every_two_millimetres(judge):
    model = flying_sphere()
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(40):
        begin = rng.uniform([5, -4, 0.5], [85, 4, 9])
        points = begin + np.cumsum(rng.normal(0.0, 0.4, (12, 3)), axis=0)
        contact, flown = replay_contact(judge, points), first_collision(model, points, 2 * MILLIMETRE)
        assert (contact is None) == (flown is None)
        if contact is not None and flown is not None:
            hits += 1
            lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
            exact = lengths[: contact.segment].sum() + contact.fraction * lengths[contact.segment]
            assert exact <= flown + 1e-6
            assert flown - exact <= 2 * MILLIMETRE
    assert 5 <= hits <= 35  # both verdicts occur


def test_clearance_is_the_distance_to_the_nearest_solid(judge):
    gap, name = clearance(judge, [12.0, 0, 3])
    assert name == "box"
    assert gap == pytest.approx(1.0 - RADIUS, abs=1e-9)
    empty = load_judge(mujoco.MjSpec.from_string("<mujoco/>"), RADIUS)
    assert clearance(empty, [0, 0, 0]) == (np.inf, "")
    assert replay_contact(empty, [[0, 0, 0], [1, 0, 0]]) is None


@pytest.mark.parametrize("flight", [[[0, 0, 5]], [[0, 0], [1, 1]], [[0, 0, 5], [np.nan, 0, 5]]])
def test_what_is_no_flight_is_refused(judge, flight):
    with pytest.raises(ValueError, match="positions must be finite metres"):
        replay_contact(judge, flight)


def test_a_radius_of_nothing_is_refused():
    with pytest.raises(ValueError, match="radius must be positive"):
        load_judge(mujoco.MjSpec.from_string(WORLD), 0.0)


@pytest.mark.parametrize(
    ("stated", "found", "apart_m", "agrees"),
    [
        (None, None, None, True),
        (3.5, None, None, False),
        (None, 3.5, None, False),
        (3.5, 3.5, 0.0, True),
        (3.5, 3.6, CONTACT_TOLERANCE_M, True),
        (3.5, 3.7, 1.1 * CONTACT_TOLERANCE_M, False),
    ],
)
def test_verdicts_agree_on_the_same_contact_or_on_none(stated, found, apart_m, agrees):
    outcome = Outcome.GOAL if stated is None else Outcome.COLLISION
    assert Agreement(0, outcome, stated, found, apart_m, touched="").agrees is agrees
