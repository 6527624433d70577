"""The task as tutorials write it is the same task, and stable-baselines3 trains on it."""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import tutorial
from edqn_jax.config import CameraConfig, Config
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.camera import camera
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.airframe import c_model, load_airframe, mixer_of
from edqn_jax.sim.physics.controller import rotor_thrusts as thrusts_in_jax
from edqn_jax.sim.physics.flight import fly_decision
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.sensors import event_laws, event_memory
from edqn_jax.sim.task.action_sets import heading_to_goal, velocity_command
from edqn_jax.sim.task.observation import own_state
from tutorial_stack.control import thrusts
from tutorial_stack.env import Look, TutorialDrone, event_image

CONFIG = Config()

WORLD = """
<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1"/>
    <geom name="wall" type="box" pos="12 20 5" size="1 4 5"/>
    <site name="volume" type="box" pos="20 20 10" size="20 20 10"/>
    <site name="start" pos="5 5 5"/>
    <site name="goal" pos="13 5 5"/>
  </worldbody>
</mujoco>
"""


def painted(model: mujoco.MjModel, config: CameraConfig) -> Look:
    """Stands for the renderer, which needs OpenGL: a picture whose brightness follows the drone."""
    ramp = np.linspace(0.0, 3.0, config.height * config.width * 3).reshape(config.height, config.width, 3)
    return lambda data: (127 + 100 * np.sin(ramp + data.qpos[0])).astype(np.uint8)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("tutorial") / "world.xml"
    file.write_text(WORLD, encoding="utf-8")
    return file


@pytest.fixture
def flown(world: Path) -> TutorialDrone:
    return TutorialDrone(world, CONFIG, painted)


def move(*vector: int) -> int:
    return int(np.flatnonzero((ACTIONS == vector).all(axis=1))[0])


def test_the_rotors_get_what_those_of_edqn_jax_get() -> None:
    airframe, model = load_airframe(CONFIG.drone), c_model(CONFIG.drone)
    one = (float(model.body_mass[1]), model.body_inertia[1], mixer_of(model), 13.0, 9.81)
    expected = jax.jit(partial(thrusts_in_jax, CONFIG.drone, airframe))
    rng = np.random.default_rng(0)
    for _ in range(200):
        quaternion = rng.normal(size=4) + [3, 0, 0, 0]
        quaternion /= np.linalg.norm(quaternion)
        pose, motion = np.concatenate([rng.normal(size=3), quaternion]), rng.normal(size=6) * 2
        command, yaw = rng.normal(size=3) * 4, rng.uniform(-3, 3)
        state = drone.DroneState(*(jnp.asarray(x) for x in (pose[:3], pose[3:], motion[:3], motion[3:], yaw)))
        found = thrusts(CONFIG.drone, *one, pose, motion, command, yaw)
        np.testing.assert_allclose(found, expected(state, jnp.asarray(command)), atol=2e-4)


def test_the_events_are_those_of_the_papers_law() -> None:
    before, after = np.random.default_rng(1).integers(0, 256, (2, 24, 32, 3), dtype=np.uint8)
    law = dataclasses.replace(CONFIG.events, threshold=0.15, tolerance=0.1)
    luma = jnp.asarray(np.stack([before, after]) @ np.array(camera.LUMA_WEIGHTS) / 255.0)
    memory = event_memory.reset_memory(law, 24, 32, jax.random.key(0))
    field, _ = event_laws.generate_events(law, memory, luma, law.frame_times_s, jax.random.key(1))
    expected = np.asarray(field.polarity * np.log1p(field.count))
    assert (np.abs(event_image(law, before, after) - expected) > 1e-6).mean() < 0.005  # counts at a whole number


def test_it_is_an_environment_of_gymnasium(flown: TutorialDrone) -> None:
    require_extra("gymnasium.utils.env_checker").check_env(flown, skip_render_check=True)


def test_a_flight_is_that_of_edqn_jax(flown: TutorialDrone, world: Path) -> None:
    observed, _ = flown.reset(seed=0)
    body = drone.hover_state(jnp.asarray(flown.start, jnp.float32), jnp.float32(0.0))
    scene, airframe = load_scene(world), load_airframe(CONFIG.drone)
    own = own_state(CONFIG.env, scene, jnp.asarray(flown.goal), body)
    np.testing.assert_allclose(observed[-10:], own, atol=1e-6)
    assert not observed[:-10].any()  # at rest nothing changes
    fly_on = jax.jit(partial(fly_decision, CONFIG.drone, airframe))
    for action in (move(1, 1, 0), move(1, 0, 1), move(0, -1, -1)):
        command = velocity_command(CONFIG.env, jnp.int32(action), drone.yaw_of(body.quaternion))
        body, _ = fly_on(body, command, heading_to_goal(CONFIG.env, body, jnp.asarray(flown.goal, jnp.float32)))
        observed, reward, *_ = flown.step(action)
        np.testing.assert_allclose(flown.data.qpos[:3], body.position, atol=5e-3)  # float64 there
        own = own_state(CONFIG.env, scene, jnp.asarray(flown.goal), body)
        np.testing.assert_allclose(observed[-10:], own, atol=5e-3)
        assert observed[:-10].any() and math.isfinite(reward)


def test_a_flight_ends_at_the_goal_at_a_wall_at_the_fence_and_at_its_last_decision(flown: TutorialDrone) -> None:
    def ending(start: tuple[float, float, float], goal: tuple[float, float, float], action: int) -> tuple[str, bool]:
        flown.start, flown.goal = np.array(start), np.array(goal)
        flown.reset()
        while True:
            _, reward, ended, out_of_time, said = flown.step(action)
            if ended or out_of_time:
                worth = {"goal": 100.0, "collision": -100.0, "left_volume": -100.0, "": 0.0}[said["outcome"]]
                assert abs(reward - worth) < 10
                return said["outcome"], out_of_time

    ahead, up, stay = move(1, 0, 0), move(0, 0, 1), move(0, 0, 0)
    assert ending((5, 5, 5), (13, 5, 5), ahead) == ("goal", False)
    assert ending((5, 20, 5), (30, 20, 5), ahead) == ("collision", False)
    assert ending((5, 5, 18), (30, 5, 5), up) == ("left_volume", False)
    flown.config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, max_decisions=3))
    assert ending((5, 5, 5), (30, 5, 5), stay) == ("", True)


def test_stable_baselines3_trains_on_it(world: Path) -> None:
    one_process = require_extra("stable_baselines3.common.vec_env").DummyVecEnv
    config = dataclasses.replace(CONFIG, world=dataclasses.replace(CONFIG.world, name=str(world)))
    with tutorial.Tutorial(config, 2, one_process, look=painted) as trained:
        before = [p.detach().clone() for p in trained.dqn.q_net.parameters()]
        assert trained.turn(12) > 0
        assert trained.dqn.num_timesteps == 12 and trained.dqn.replay_buffer.size() == 6
        after = list(trained.dqn.q_net.parameters())
        assert any((new != old).any() for new, old in zip(after, before, strict=True))


@pytest.mark.parametrize(
    ("group", "change"),
    [
        ("env", {"reward": "sparse"}),
        ("env", {"sensor": "blind"}),
        ("env", {"position": False}),
        ("world", {"name": "open"}),
    ],
)
def test_what_it_does_not_have_is_said(group: str, change: dict[str, object]) -> None:
    config = dataclasses.replace(CONFIG, **{group: dataclasses.replace(getattr(CONFIG, group), **change)})
    with pytest.raises(ConfigError, match=r"must be 'paper'|has events and a reward|supports only"):
        tutorial.check(config)


def test_the_report_says_both_rates_and_their_ratio() -> None:
    rows = [{"decisions_per_second": 50.0}, {"decisions_per_second": 12_000.0}]
    report = {"device": "a CPU", "repeats": 3, "drones": 8, "workload": {"num_envs": 256}, "rows": rows, "ratio": 240.0}
    lines = tutorial.table(report).splitlines()
    assert lines[-3].endswith("| 50 |") and lines[-2].endswith("| 12,000 |") and lines[-1] == "| ratio | 240 |"
