"""What each sensor shows, held against other people's rays and a camera by brute force."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import SENSORS, CameraConfig, Config, DroneConfig, EnvConfig
from edqn_jax.evaluation.latency import decision_latency_ms
from edqn_jax.learn import policy
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import init_state
from edqn_jax.learn.step import run_steps
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.actions import ACTIONS, DIRECTIONS
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.drone import Flight, hover_state
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.scene.scene import stack_scenes, take_scene
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.sensor import Sensor
from edqn_jax.sim.task import env
from edqn_jax.sim.task.action_sets import velocity_command
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE, Observation
from tests.oracles import camera_plain
from tests.oracles.mujoco_depth import RayCaster
from tests.support.configs import TINY
from tests.support.drawn_scenes import every_kind, free_points, rotation_of, scene_of
from tests.support.marks import in_whole
from tests.support.miniature import WORLD

CAMERA = CameraConfig(width=16, height=12)
STAY = 13


def config_of(name: str, **options) -> Config:
    # What is seen does not depend on the physics; these are quicker to trace and to compile.
    return Config(camera=CAMERA, drone=DroneConfig(physics="rigid_body"), env=EnvConfig(sensor=name, **options))  # type: ignore


@partial(jax.jit, static_argnums=0)
def shown(config, scene, positions, yaws):
    """[M, ...] of what the sensor shows at rest."""

    def one(position, yaw):
        body = hover_state(position, yaw)
        still = Flight(*(jnp.stack([x] * 2) for x in (body.position, body.quaternion, body.velocity)))
        return sensor.sense(config, scene, still, sensor.at_rest(config, jax.random.key(0)), jax.random.key(1))[0]

    return jax.vmap(one)(positions, yaws)


def poses(scene, rng, count):
    positions = free_points(scene, rng, count)
    return positions, rng.uniform(-np.pi, np.pi, len(positions)).astype(np.float32)


def turned(yaw: float) -> np.ndarray:
    return rotation_of(0.0, 0.0, float(yaw))


@pytest.fixture(scope="module")
def scenes():
    """Worlds, and the same with equally many places for shapes of each kind, so that one program shows them all."""
    rng = np.random.default_rng(11)
    drawn = [mjcf.load_scene(mjcf.resolve_world("paper")), *(every_kind(rng) for _ in range(2))]
    pool = stack_scenes(drawn)
    return [(scene, take_scene(pool, index)) for index, scene in enumerate(drawn)]


@pytest.mark.whole
@pytest.mark.slow
def test_a_frame_is_the_logarithm_of_the_camera_by_brute_force(scenes) -> None:
    config = config_of("frames")
    for scene, padded in scenes:
        where = poses(scene, np.random.default_rng(1), 2)
        ours = np.asarray(shown(config, padded, *where), np.float64)[:, 0]
        plain = np.stack([camera_plain.luma(CAMERA, scene, p, turned(a)) for p, a in zip(*where, strict=True)])
        assert ours.shape == (2, 12, 16)
        # The level camera's own bar against 8 x 8 samples a pixel (tests/sim/camera/test_camera.py).
        assert np.sqrt(np.mean((np.exp(ours - 1.0) - config.events.log_epsilon - plain) ** 2)) < 0.014
        assert np.ptp(plain) > 0.2  # there was something to see


@pytest.mark.slow
def test_depth_is_the_nearness_of_what_mujocos_rays_meet(scenes) -> None:
    config = config_of("depth")
    for scene, padded in scenes:
        where = poses(scene, np.random.default_rng(2), 4)
        ours = np.asarray(shown(config, padded, *where), np.float64)[:, 0]
        caster = RayCaster(scene)
        rays = [camera_plain.directions(CAMERA, turned(yaw), 1) for yaw in where[1]]
        metres = np.stack([caster.distance(p, d) for p, d in zip(where[0], rays, strict=True)])
        wanted = 3.0 / (1.0 + metres / 4.0)  # MuJoCo's inf, the sky, is 0
        # Metres agree to 1e-4 of themselves; rays along an edge may meet another surface.
        wrong = np.abs(ours - wanted) > 3e-3
        assert wrong.mean() < 0.005
        assert ours.min() >= 0.0 and ours.max() <= 3.0 and np.ptp(wanted) > 0.3


def free_way(config, scene, caster, position, yaw) -> np.ndarray:
    """[26] metres along what each move commands, to a geom or to a face of the volume, by MuJoCo and by hand."""
    found = []
    commands = jax.vmap(lambda move: velocity_command(config.env, move, yaw))(jnp.arange(len(ACTIONS)))
    for move, command in enumerate(np.asarray(commands, np.float64)):
        if move == STAY:
            assert not command.any()
            continue
        way = command / np.linalg.norm(command)
        met = float(caster.distance(position, way))
        for axis in range(3):
            for face in np.asarray(scene.volume, np.float64)[:, axis]:
                reach = (face - position[axis]) / way[axis] if way[axis] else np.inf
                met = min(met, reach) if reach > 0 else met
        found.append(met)
    return np.array(found)


@pytest.mark.slow
def test_ranges_are_the_free_way_along_each_move_in_its_order(scenes) -> None:
    config = config_of("ranges")
    fenced = []
    for scene, padded in scenes:
        positions, yaws = poses(scene, np.random.default_rng(3), 6)
        yaws[:2] = 0.0, np.pi / 2  # along the axes
        ours = np.asarray(shown(config, padded, positions, yaws), np.float64)
        caster = RayCaster(scene)
        metres = np.stack([free_way(config, scene, caster, p, a) for p, a in zip(positions, yaws, strict=True)])
        assert ours.shape == metres.shape == (6, 26)
        wrong = np.abs(ours - 1.0 / (1.0 + metres / 4.0)) > 1e-3
        assert wrong.mean() < 0.005
        lower, upper = np.asarray(scene.volume)
        ends = positions + np.array([turned(a) @ DIRECTIONS.T for a in yaws]).transpose(2, 0, 1) * metres.T[..., None]
        fenced.append(np.any((ends < lower + 0.01) | (ends > upper - 0.01), axis=-1))
    share = np.mean([each.mean() for each in fenced])
    assert 0.2 < share < 0.9  # some end at the volume, some at shapes


def test_nothing_but_the_volume_bounds_the_way_in_an_empty_world() -> None:
    scene = scene_of()  # 60 x 60 x 25 m
    config = config_of("ranges")
    near = np.asarray(shown(config, scene, jnp.array([[10.0, 20.0, 5.0]]), jnp.zeros(1)))[0]
    metres = dict(zip([tuple(a) for a in ACTIONS if a.any()], 4.0 * (1.0 / near - 1.0), strict=True))
    by_hand = {
        (1, 0, 0): 50.0,
        (-1, 0, 0): 10.0,
        (0, 1, 0): 40.0,
        (0, 0, -1): 5.0,
        (1, 1, 0): 40.0 * np.sqrt(2),
        (-1, -1, -1): 5.0 * np.sqrt(3),
    }
    for move, length in by_hand.items():
        assert metres[move] == pytest.approx(length, rel=1e-4), move


def test_nearness_is_bounded_and_falls_with_distance() -> None:
    near = np.asarray(sensor.nearness(jnp.array([0.0, 0.36, 4.0, 12.0, jnp.inf])))
    np.testing.assert_allclose(near, [1.0, 4 / 4.36, 0.5, 0.25, 0.0], atol=1e-6)


@pytest.fixture(scope="module")
def world():
    pool = stack_scenes([mjcf.load_scene(WORLD)])
    return env.EnvParams(load_airframe(Config().drone), pool, own_missions(pool))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["depth", *in_whole("frames", "ranges")])
def test_a_step_shows_what_is_seen_from_where_it_ends(world, name: str) -> None:
    config = config_of(name)
    state, _ = jax.jit(lambda key: env.reset(config, world, key))(jax.random.key(0))
    state, step = jax.jit(lambda s: env.step(config, world, s, 26))(state)
    assert not step.is_reset and state.memory is None
    end = Flight(*(x[-1:] for x in (step.flight.position, step.flight.quaternion, step.flight.velocity)))
    scene = jax.tree.map(lambda x: x[0], world.pool)
    again = jax.jit(lambda p: sensor.sense(config, scene, p, None, jax.random.key(0))[0])(end)
    np.testing.assert_allclose(step.observation.sensed, again, atol=1e-4)  # two programs
    assert np.ptp(np.asarray(step.flight.position), axis=0).max() > 0.3  # elsewhere, another view
    if name == "depth":  # which is the label of every other sensor
        label = jax.jit(lambda s: env.nearness(config_of("frames"), world, s))(state)
        np.testing.assert_allclose(label, step.observation.sensed[0], atol=1e-4)  # type: ignore


@pytest.mark.slow
def test_a_frame_pair_is_the_frames_that_events_are_made_of(world) -> None:
    """The newest frame, and how the brightness changed, are all that is in two; event images count that change."""
    scene, times = jax.tree.map(lambda x: x[0], world.pool), (-0.08, -0.04, 0.0)
    places = jnp.array([[5.0, 5.0, 3.0], [5.1, 5.05, 3.0], [5.3, 5.1, 3.1]])
    upright = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0]), (3, 4))
    found, key = {}, jax.random.key(0)
    for name in ("frame-pair", "frames", "event-image", "events"):
        config = config_of(name)
        config = dataclasses.replace(config, events=dataclasses.replace(config.events, frame_times_s=times))
        memory = sensor.at_rest(config, key)
        see = jax.jit(lambda at, to, c=config, m=memory: sensor.sense(c, scene, Flight(at, to, at), m, key)[0])
        found[name] = (
            [see(places[: k + 1], upright[: k + 1]) for k in range(3)] if name == "frames" else (see(places, upright))
        )
    first, middle, last = (np.asarray(frame)[0] for frame in found["frames"])
    newest, since_first, since_middle = np.asarray(found["frame-pair"])
    np.testing.assert_allclose(newest, last, atol=1e-4)  # other programs
    np.testing.assert_allclose(since_first, (last - first) / 0.1, atol=2e-3)
    np.testing.assert_allclose(since_middle, (last - middle) / 0.1, atol=2e-3)
    assert np.abs(since_first).max() > 1.0
    net = np.sum(np.asarray(found["events"].count) * np.asarray(found["events"].polarity), axis=0)
    assert net.min() < 0 < net.max()
    np.testing.assert_allclose(found["event-image"], (np.sign(net) * np.log1p(np.abs(net))).ravel(), atol=1e-5)


DRAWN = {
    "events": 2,
    "frames": 1,
    "frame-pair": 2,
    "depth": 1,
    "depth-motion": 2,
    "event-image": 2,
    "ranges": 0,
    "blind": 0,
}
"""Pictures of a decision by sensor."""

SHAPES = {
    "frames": (1, 12, 16),
    "frame-pair": (2, 12, 16),
    "depth": (1, 12, 16),
    "depth-motion": (2, 12, 16),
    "event-image": (192,),
    "ranges": (26,),
}


@pytest.mark.parametrize(("name", "frames"), DRAWN.items())
def test_what_a_decision_draws(world, name: str, frames: int) -> None:
    config = config_of(name)
    assert sensor.frames_per_decision(config) == frames
    state = jax.eval_shape(lambda key: env.before_reset(config, world, key), jax.random.key(0))
    program = jax.make_jaxpr(lambda s: env.step(config, world, s, 0))(state)
    drawn = [e.outvars[0].aval.shape for e in program.jaxpr.eqns if e.primitive.name == "pictures"]  # type: ignore
    # Two frames of a window are drawn together; where nothing moves, no second depth is needed to know that.
    together = 1 if name == "depth-motion" else frames
    assert drawn == ([(together, 12, 16)] if frames else [])
    sensed = jax.eval_shape(lambda s: env.step(config, world, s, 0), state)[1].observation.sensed
    if name == "events":
        assert isinstance(sensed, EventField)
    else:
        assert getattr(sensed, "shape", None) == SHAPES.get(name)


def test_a_camera_on_the_body_sees_the_ground_rise_and_ranges_do_not_care(world) -> None:
    lean = rotation_of(0.0, 0.4, 0.0)  # nose down
    w = np.sqrt(1 + np.trace(lean)) / 2
    quaternion = jnp.array([w, 0.0, (lean[0, 2] - lean[2, 0]) / (4 * w), 0.0], jnp.float32)[None]
    level = jnp.array([[1.0, 0.0, 0.0, 0.0]])
    scene = jax.tree.map(lambda x: x[0], world.pool)
    place = jnp.array([[5.0, 5.0, 3.0]])
    found = {}
    for name in ("depth", "ranges"):
        config = dataclasses.replace(config_of(name), camera=dataclasses.replace(CAMERA, mount="body"))
        see = jax.jit(lambda here, config=config: sensor.sense(config, scene, here, None, jax.random.key(0))[0])
        for attitude in (level, quaternion):
            found[name, attitude is level] = np.asarray(see(Flight(place, attitude, jnp.zeros((1, 3)))))
    assert found["depth", False][:6].mean() > found["depth", True][:6].mean() + 0.02
    np.testing.assert_allclose(found["ranges", False], found["ranges", True], atol=1e-6)


# ------------------------------------------------------------------------------------- a new sensor


def _show_row_means(config, scene, poses, memory, key):
    """Mean brightness of each row of the newest frame, and the number of decisions."""
    frame = sensor.render_view(config, scene, poses.position[-1], poses.quaternion[-1])
    return jnp.mean(sensor.brightness(config, frame), axis=-1), memory + 1


def _show_negative(config, scene, poses, memory, key):
    frame = sensor.render_view(config, scene, poses.position[-1], poses.quaternion[-1])
    return -sensor.brightness(config, frame)[None], memory


def _show_tree(config, scene, poses, memory, key):
    """Two pictures and three values."""
    picture = _show_negative(config, scene, poses, memory, key)[0]
    return {"pictures": jnp.concatenate([picture, 2.0 * picture]), "rows": picture[0, :3, 0]}, memory


NEW = {
    "row_means": Sensor(
        show=_show_row_means,
        shape=lambda config: (config.camera.height,),
        draws_frames=True,
        at_rest=lambda config, key: jnp.zeros(()),
    ),
    "negative": Sensor(
        show=_show_negative, shape=lambda config: (1, config.camera.height, config.camera.width), draws_frames=True
    ),
    "tree": Sensor(
        show=_show_tree,
        shape=lambda config: {"pictures": (2, config.camera.height, config.camera.width), "rows": (3,)},
        draws_frames=True,
    ),
}


@pytest.fixture(params=["row_means", *in_whole("negative", "tree")])
def with_new_sensor(request, monkeypatch) -> Config:
    """A miniature that trains with a sensor that only the table knows."""
    monkeypatch.setitem(SENSORS._entries, request.param, NEW[request.param])
    return dataclasses.replace(
        TINY,
        env=dataclasses.replace(TINY.env, sensor=request.param),
        drone=dataclasses.replace(TINY.drone, physics="rigid_body"),  # compiles faster
    )


@pytest.mark.slow
def test_a_new_sensor_needs_only_its_entry_to_act(with_new_sensor, world) -> None:
    config = with_new_sensor
    state = jax.eval_shape(lambda key: env.before_reset(config, world, key), jax.random.key(0))
    state, step = jax.eval_shape(lambda s: env.step(config, world, s, 0), state)
    shown = sensor.sensor_of(config).example(config)
    assert jax.tree.map(jnp.shape, step.observation.sensed) == jax.tree.map(jnp.shape, shown)
    assert describe_workload(config, jax.tree.map(lambda x: x[0], world.pool))["frames_per_decision"] == 1
    params = policy.fresh_policy(config)
    observation = Observation(shown, jnp.zeros(OWN_SIZE), jnp.zeros(MOTION_SIZE))
    code = embedding.embed(config, params.encoder, observation)
    assert code is not None and code.shape == (embedding.embedding_size(config),)
    if config.env.sensor == "row_means":
        np.testing.assert_array_equal(code, shown)
        assert state.memory.shape == () and not params.encoder
    if config.env.sensor == "tree":
        assert embedding.code_size(config) == embedding.embedding_size(config) - 3 == config.encoder.code_size
        np.testing.assert_array_equal(code[-3:], shown["rows"])
        assert policy.Policy(config, params).code(observation).shape == (config.encoder.code_size,)
    assert decision_latency_ms(config, params, calls=1)["median"] > 0.0


@pytest.mark.whole
@pytest.mark.slow
def test_a_new_sensor_needs_only_its_entry_to_train(with_new_sensor, world) -> None:
    config = with_new_sensor
    steps = Schedule.from_config(config).learn_from + 2
    before = jax.jit(lambda key: init_state(config, world, key))(jax.random.key(0))
    after, (_, losses) = jax.jit(lambda s: run_steps(config, world, s, jnp.arange(steps)))(before)
    assert np.isfinite(np.asarray(losses.metrics["q_loss"])[-1])
    assert np.isfinite(np.asarray(losses.metrics["reconstruction_loss"])).sum() == Schedule.from_config(config).warmup
    if config.env.sensor == "row_means":
        np.testing.assert_array_equal(after.actors.env.memory >= 1, True)  # what it carries is carried
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(after.learner))
