"""VAE, processes and DQN of the conventional stack, and the command that times them."""

from __future__ import annotations

import dataclasses
import importlib
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import conventional
from conventional_stack.fleet import Record
from conventional_stack.settings import AGENT, supported_config
from conventional_stack.train import Steady, Trained, Training, fly, train
from conventional_stack.vae import EventVAE, Learner
from conventional_stack.vec_env import CodedDrones
from conventional_stack.workers import SpreadFleet
from edqn_jax.config import CameraConfig, Config, EncoderConfig
from edqn_jax.errors import ConfigError
from edqn_jax.extras import MissingPackageError, require_extra
from edqn_jax.learn.perception import vae
from edqn_jax.learn.perception.waves import cosine_basis
from edqn_jax.runs.directory import to_plain_json
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE
from edqn_jax.sim.task.outcomes import Outcome
from measurement.flags import parse_config
from rivals import stack
from tests.support.benchmarks.conventional_course import course_of
from tests.support.benchmarks.uninstalled import hide
from tests.support.miniature import MINIATURE

torch = require_extra("torch")
torch.set_num_threads(1)  # beside other tests a second one costs more than it does

CONFIG = supported_config(Config())
START, GOAL = np.array([[20.0, 40.0, 12.0]]), np.array([[90.0, 90.0, 10.0]])


def blobs(count: int, seed: int) -> np.ndarray:
    """Event windows with one blob of ON events and one of OFF."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:24, :32]
    fields = np.zeros((count, 24, 32), np.int8)
    for field in fields:
        for sign in (1, -1):
            cy, cx = rng.uniform((3, 3), (21, 29))
            field[(y - cy) ** 2 + (x - cx) ** 2 < 9] = 3 * sign
    return fields


def motions(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, MOTION_SIZE)).astype(np.float32)


def labels(fields: np.ndarray) -> np.ndarray:
    """Near where there are ON events, far elsewhere."""
    return np.where(fields > 0, 2.0, 0.5).astype(np.float32)


def field_of(counts: np.ndarray) -> EventField:
    """The same event counts [B, H, W] as ours."""
    signed = jnp.asarray(counts, jnp.int32)[:, None]
    when = jnp.zeros(signed.shape)
    return EventField(jnp.abs(signed), jnp.sign(signed).astype(jnp.int8), when, when, window_s=1.0)


def twins(camera: CameraConfig, config: EncoderConfig):
    """Our parameters, none of which is zero, and the VAE in PyTorch that has them."""
    leaves, tree = jax.tree.flatten(vae.init_vae(config, camera, jax.random.key(0)))
    rng = np.random.default_rng(1)
    params = jax.tree.unflatten(tree, [leaf + 0.05 * rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves])
    return params, EventVAE(config, camera, params)


def sensed(camera: CameraConfig, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    shape = (count, camera.height, camera.width)
    counts = (rng.integers(-9, 10, shape) * (rng.random(shape) < 0.3)).astype(np.int8)
    counts[0, 0, :2] = 127, -127
    return counts, motions(count, 3), rng.uniform(0.0, 3.0, shape).astype(np.float32)


SMALL = dataclasses.replace(
    CONFIG.encoder, patch_layers=(8,), joint_layers=(12,), decoder_hidden=(10,), target_blur=0, decoder_bandwidth=1.0
)
NETWORKS = [
    (CONFIG.camera, CONFIG.encoder),
    (CONFIG.camera, dataclasses.replace(CONFIG.encoder, target="sensed")),
    (CONFIG.camera, dataclasses.replace(CONFIG.encoder, target="both", target_blur=5)),
    (CameraConfig(width=10, height=6), SMALL),  # patches beyond the image
]
TOLERANCE = 1e-5
"""Sums of at most some hundred float32 products of order 1, in another order."""


@pytest.mark.parametrize(("camera", "config"), NETWORKS)
def test_codes_and_drawings_of_our_parameters_are_ours(camera, config):
    params, theirs = twins(camera, config)
    counts, motion, _ = sensed(camera, 8)
    ours = vae.encode(config, params, field_of(counts), jnp.asarray(motion))
    with torch.inference_mode():
        got = theirs.encoder(theirs.patches(counts), torch.from_numpy(motion))
        drawn = theirs.decoder(got[0]).numpy()
    for mine, expected in zip(got, ours, strict=True):
        assert np.ptp(expected) > 0.5
        np.testing.assert_allclose(mine.numpy(), expected, atol=TOLERANCE, rtol=TOLERANCE)
    np.testing.assert_array_equal(theirs.code(theirs.patches(counts), motion), got[0].numpy())
    rows, columns = drawn.shape[-2:]
    image = cosine_basis(camera.height, rows).T @ drawn @ cosine_basis(camera.width, columns)
    expected = vae.decode(config, camera, params, ours[0])
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(image, expected, atol=TOLERANCE, rtol=TOLERANCE)


@pytest.mark.parametrize(("camera", "config"), NETWORKS)
def test_what_is_drawn_and_its_loss_are_ours(camera, config):
    params, theirs = twins(camera, config)
    counts, motion, near = sensed(camera, 8)
    wanted = vae.in_waves(config, vae.decoder_target(config, field_of(counts), jnp.asarray(near)))
    got = theirs.target(counts, near)
    assert np.ptp(wanted.amplitudes) > 1.0
    np.testing.assert_allclose(got.numpy(), wanted.amplitudes, atol=TOLERANCE, rtol=TOLERANCE)
    torch.manual_seed(1)
    loss = theirs.loss(theirs.patches(counts), motion, got)
    loss.backward()
    torch.manual_seed(1)
    noise = jnp.asarray(torch.randn(8, config.code_size).numpy())
    drawable = dataclasses.replace(wanted, beyond=jnp.zeros(8))

    def our_loss(params):
        return vae.vae_loss(config, params, field_of(counts), jnp.asarray(motion), drawable, noise)[0]

    expected, gradient = jax.value_and_grad(our_loss)(params)
    np.testing.assert_allclose(loss.item(), expected, rtol=TOLERANCE)
    # The whole chain of layers: the gradient of the first one.
    first = np.concatenate([gradient["encoder"][name]["kernel"] for name in ("channel_0", "channel_1")])
    size = np.abs(first).max()
    np.testing.assert_allclose(theirs.encoder.patch.weight.grad.numpy().T / size, first / size, atol=TOLERANCE)


def test_the_vae_starts_as_ours():
    learner = Learner(CONFIG.encoder, CONFIG.camera, seed=3)
    params = vae.init_vae(CONFIG.encoder, CONFIG.camera, jax.random.key(3))
    counts, motion = blobs(5, 0), motions(5, 0)
    expected = vae.embed(CONFIG.encoder, params, field_of(counts), jnp.asarray(motion))
    got = learner.acting.code(learner.acting.patches(counts), motion)
    np.testing.assert_allclose(got, expected, atol=TOLERANCE, rtol=TOLERANCE)


def test_the_vae_learns_what_is_near_and_the_agents_code_waits_to_be_published():
    learner = Learner(CONFIG.encoder, CONFIG.camera, seed=0)
    known = learner.acting
    fields, motion = blobs(64, 1), motions(64, 1)
    patches, wanted = known.patches(fields), known.target(fields, labels(fields))
    mean = known.target(fields, labels(fields)).mean(dim=0)
    blank = (wanted - mean).square().sum((1, 2, 3)).mean().item()
    code = known.code(patches, motion)
    for step in range(300):
        seen = blobs(64, 100 + step)
        learner.update(known.patches(seen), motions(64, 100 + step), known.target(seen, labels(seen)))
    np.testing.assert_array_equal(learner.acting.code(patches, motion), code)
    learner.publish()
    assert not np.allclose(learner.acting.code(patches, motion), code)
    assert learner.samples == 300 * 64
    with torch.no_grad():
        drawn = learner.learning.decoder(torch.from_numpy(learner.acting.code(patches, motion)))
    assert (drawn - wanted).square().sum((1, 2, 3)).mean().item() < 0.6 * blank


@pytest.mark.parametrize("processes", [1, 2])
def test_drones_fly_alike_in_one_process_and_in_two(processes):
    course = course_of(START, GOAL)
    fleet = SpreadFleet(CONFIG, course, 4, processes, seed=0)
    alone = SpreadFleet(CONFIG, course, 1, 1, seed=0)
    try:
        fleet.reset()
        for step in range(6):
            actions = [(5 * step + 7 * drone) % 27 for drone in range(4)]
            fleet.record.action[:] = actions
            fleet.step()
        for drone in range(4):
            alone.reset()
            for step in range(6):
                alone.record.action[0] = (5 * step + 7 * drone) % 27
                alone.step()
            for name in ("events", "motion", "nearness", "own", "reward", "outcome"):
                np.testing.assert_array_equal(getattr(fleet.record, name)[drone], getattr(alone.record, name)[0])
        for name in ("events", "motion", "nearness"):
            assert getattr(fleet.record, name).any()
    finally:
        fleet.close()


def test_drones_that_cannot_be_shared_out_are_named():
    with pytest.raises(ValueError, match="5 drones cannot be divided among 2 processes"):
        SpreadFleet(CONFIG, course_of(START, GOAL), 5, 2, seed=0)


def test_a_process_that_ended_is_noticed():
    fleet = SpreadFleet(CONFIG, course_of(START, GOAL), 2, 2, seed=0)
    fleet.reset()
    process, _ = fleet.workers[0]
    process.terminate()
    process.join()
    with pytest.raises((RuntimeError, BrokenPipeError)):
        fleet.step()
    fleet.close()


class Still:
    """A fleet whose record a test writes by hand."""

    def __init__(self, drones: int) -> None:
        from conventional_stack.stopwatch import Stopwatch

        self.record = Record.empty(CONFIG, drones)
        self.stopwatch = Stopwatch()

    def step(self) -> None:
        pass

    reset = close = step


def test_ended_drones_keep_their_last_observation_and_only_time_outs_are_truncated():
    still = Still(4)
    learner = Learner(CONFIG.encoder, CONFIG.camera, seed=0)
    drones = CodedDrones(CONFIG, still, learner)  # type: ignore[arg-type]
    drones.reset()
    record = still.record
    record.events[:], record.motion[:] = blobs(4, 0), motions(4, 0)
    record.nearness[:] = labels(record.events)
    record.own[:], record.final_own[:] = 1.0, 2.0
    record.outcome[:] = [Outcome.RUNNING, Outcome.GOAL, Outcome.TIME_OUT, Outcome.COLLISION]
    record.reward[:] = [1.0, 100.0, 0.0, -100.0]
    seen, rewards, ends, infos = drones.step(np.zeros(4, np.int64))
    np.testing.assert_allclose(rewards, CONFIG.agent.reward_scale * record.reward)
    assert ends.tolist() == [False, True, True, True]
    assert [info.get("TimeLimit.truncated") for info in infos] == [None, False, True, False]
    acting, scale = learner.acting, CONFIG.agent.code_scale
    codes = scale * acting.code(acting.patches(record.events), record.motion)
    still_one = np.zeros((1, MOTION_SIZE), np.float32)
    quiet = scale * acting.code(acting.patches(np.zeros((1, 24, 32), np.int8)), still_one)[0]
    # The frozen encoder's own code, whatever the VAE learned in this step.
    np.testing.assert_allclose(seen[0, :-OWN_SIZE], codes[0], atol=1e-6)
    for drone in (1, 2, 3):
        np.testing.assert_allclose(seen[drone, :-OWN_SIZE], quiet, atol=1e-6)
        np.testing.assert_allclose(infos[drone]["terminal_observation"][:-OWN_SIZE], codes[drone], atol=1e-6)
        assert (infos[drone]["terminal_observation"][-OWN_SIZE:] == 2.0).all()
    assert (seen[:, -OWN_SIZE:] == 1.0).all()
    assert learner.samples == 4
    # What it learned is all of what was seen and of what was near.
    twin = Learner(CONFIG.encoder, CONFIG.camera, seed=0)
    twin.update(acting.patches(record.events), record.motion, acting.target(record.events, record.nearness))
    for got, expected in zip(learner.learning.parameters(), twin.learning.parameters(), strict=True):
        assert torch.equal(got, expected)


def test_drones_answer_for_all_at_once_and_have_no_methods_of_their_own():
    drones = CodedDrones(CONFIG, Still(4), Learner(CONFIG.encoder, CONFIG.camera, seed=0))  # type: ignore[arg-type]
    drones.set_attr("updates", 3)
    assert drones.get_attr("updates", indices=[0, 2]) == [3, 3] and drones.get_attr("updates") == [3] * 4
    with pytest.raises(AttributeError, match="^a drone has no method 'land'$"):
        drones.env_method("land")


def miniature() -> Config:
    return conventional.parse(["--", *MINIATURE])[1]


SHORT = supported_config(
    parse_config([*MINIATURE, "--train.chunk-steps", "16", "--total-steps", "1024", "--train.validation-every", "300"])
)
"""A whole training: 256 decisions of warm-up, 768 of the DQN."""


def replaced(config: Config, **options) -> Config:
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **options))


def weights(trained: Trained) -> np.ndarray:
    return np.concatenate([w.numpy().ravel() for w in (*trained.q.parameters(), *trained.vae.parameters())])


def test_a_training_takes_its_decisions_in_pieces_as_in_one_and_its_seed_says_how():
    course = course_of(START, GOAL)
    watched: list[Trained] = []
    whole = train(replaced(SHORT, validation_every=0), course)
    pieces = train(SHORT, course, watch=watched.append)
    assert [seen.decisions for seen in watched] == [560, 864, 1024]  # 300 more, in whole steps of 16 drones
    assert [seen.seconds for seen in watched] == sorted(seen.seconds for seen in watched)
    assert whole.decisions == pieces.decisions == 1024
    np.testing.assert_array_equal(weights(pieces), weights(whole))
    # What was shown earlier stays as it was.
    assert not np.array_equal(weights(watched[0]), weights(pieces))
    other = train(replaced(SHORT, seed=1), course)
    assert not np.allclose(weights(other), weights(whole))


def test_a_vae_that_reconstructs_events_is_trained_without_a_label():
    config = dataclasses.replace(SHORT, encoder=dataclasses.replace(SHORT.encoder, target="sensed"))
    with Training(config, course_of(START, GOAL)) as training:
        training.warm_up()
        assert training.env.fleet.record.nearness.size == 0
        assert training.learner.samples == config.encoder.warmup_updates_per_step * 256


def test_the_schedules_run_over_the_whole_training():
    with Training(SHORT, course_of(START, GOAL)) as training:
        training.warm_up()
        assert training.decisions == 256  # a quarter, less than the configuration's warm-up
        assert training.learner.samples == SHORT.encoder.warmup_updates_per_step * 256
        epsilon, rate = [], []
        for _ in range(2):
            training.learn(384)
            epsilon.append(training.dqn.exploration_rate)
            rate.append(training.dqn.policy.optimizer.param_groups[0]["lr"])
        agent = SHORT.agent
        assert epsilon == pytest.approx([agent.exploration_end] * 2)
        middle = (agent.learning_rate + agent.final_learning_rate) / 2
        assert rate == pytest.approx([middle, agent.final_learning_rate])


def test_what_was_learnt_flies_by_the_best_value_of_what_it_sees():
    course = course_of(START, GOAL)
    trained = train(SHORT, course)
    rng = np.random.default_rng(0)
    events = rng.integers(-3, 4, (200, 6, 8)).astype(np.int8)
    own = rng.normal(size=(200, OWN_SIZE)).astype(np.float32)
    motion = motions(200, 0)
    code = trained.vae.code(trained.vae.patches(events), motion) * SHORT.agent.code_scale
    values = trained.q(torch.from_numpy(np.concatenate([code, own], axis=1)))
    np.testing.assert_array_equal(trained.act(events, own, motion), values.numpy().argmax(1))
    assert not np.array_equal(trained.act(events, own, np.zeros_like(motion)), values.numpy().argmax(1))
    flights = fly(trained, course)
    np.testing.assert_array_equal(flights.outcome != Outcome.RUNNING, [True])
    again = fly(trained, course)
    np.testing.assert_array_equal(flights.path_length_m, again.path_length_m)


@pytest.mark.parametrize(
    "change", [{"history": 2}, {"layer_norm": True}, {"huber_delta": 0.0}, {"exploration_episodes": 10}]
)
def test_a_dqn_that_stable_baselines3_does_not_have_is_declined(change):
    config = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, **change))
    with pytest.raises(ConfigError, match="the conventional stack's DQN supports only agent.history 1"):
        train(config, course_of(START, GOAL))


def test_a_vae_that_this_stack_does_not_have_is_declined():
    config = dataclasses.replace(CONFIG, encoder=dataclasses.replace(CONFIG.encoder, architecture="pooled"))
    with pytest.raises(ConfigError, match="the conventional stack's VAE supports only encoder.architecture 'patches'"):
        train(config, course_of(START, GOAL))


def test_the_camera_is_that_of_every_process():
    course = course_of(START, GOAL)
    seen = {}
    for camera in ("rays", "columns"):
        fleet = SpreadFleet(CONFIG, course, 2, 2, seed=0, camera=camera)
        try:
            fleet.reset()
            for _ in range(3):
                fleet.record.action[:] = 22
                fleet.step()
            seen[camera] = fleet.record.events.copy()
        finally:
            fleet.close()
    # The drones fly alike; one ray a pixel makes events at silhouettes where an area makes none, or none where it does.
    differ = [np.mean(a != b) for a, b in zip(seen["rays"], seen["columns"], strict=True)]
    assert all(0 < share < 0.2 for share in differ), differ
    np.testing.assert_array_equal(*seen["columns"])


def test_a_timed_turn_replays_four_samples_a_decision_and_shows_the_vae_each_field_once():
    config = miniature()
    with Steady(config, course_of(START, GOAL), 1, 1) as run:
        training = run.training
        before = training.dqn._n_updates, training.learner.samples
        assert run.turn(160) > 0
        assert (training.dqn._n_updates - before[0]) * config.agent.batch_size == 4 * 160
        assert training.learner.samples - before[1] == 160 == run.decisions
        shares = run.shares()
        assert sum(shares.values()) == pytest.approx(1.0) and min(shares.values()) >= 0
        for part in ("physics", "rays", "shading", "events", "encoder", "vae_update", "acting", "dqn_update"):
            assert shares[part] > 0


def test_a_turn_that_does_not_learn_throughout_is_no_figure():
    config = miniature()
    with Steady(config, course_of(START, GOAL), 1, 1) as run:
        run.training.env.updates = 0
        with pytest.raises(RuntimeError, match="did not learn throughout"):
            run.turn(32)


def test_the_warm_up_publishes_the_code_and_rests():
    config = miniature()
    config = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, keep_learning=False))
    with Training(config, course_of(START, GOAL)) as training:
        fields, motion = blobs(3, 0)[:, 6:12, 8:16].copy(), motions(3, 0)

        def code():
            return training.learner.acting.code(training.learner.acting.patches(fields), motion)

        before = code()
        training.warm_up()
        assert training.learner.samples == config.encoder.warmup_updates_per_step * config.encoder.warmup_decisions
        after = code()
        assert not np.array_equal(after, before)
        training.learn(64)
        np.testing.assert_array_equal(code(), after)
        assert training.learner.samples == config.encoder.warmup_updates_per_step * config.encoder.warmup_decisions


def test_the_command_says_what_it_measured(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(conventional, "SETTINGS", ((1, 1), (2, 1)))
    monkeypatch.setattr(conventional, "use_cpu_devices", lambda: None)  # this process has its devices already
    file = tmp_path / "rows.json"
    assert conventional.main(["--decisions", "32", "--repeats", "2", "--json", str(file), "--", *MINIATURE]) == 0
    report = json.loads(file.read_text())
    assert [row["processes"] for row in report["rows"]] == [1, 2]
    assert report["decisions_per_second"] == max(row["decisions_per_second"] for row in report["rows"])
    assert report["workload"]["replayed_samples_per_decision"] == 4 and report["workload"]["physics"] == "c_mujoco"
    assert "torch" in report["versions"] and to_plain_json(report) == report
    assert "| rays |" in capsys.readouterr().out
    assert all(row["camera"] == "rays" and row["shares"]["columns"] == 0 for row in report["rows"])


def test_both_cameras_and_ours_take_turns(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(conventional, "SETTINGS", ((1, 1),))
    monkeypatch.setattr(conventional, "use_cpu_devices", lambda: None)
    file = tmp_path / "rows.json"
    words = ["--camera", "rays", "columns", "--edqn", "--decisions", "32", "--repeats", "3", "--json", str(file)]
    assert conventional.main([*words, "--", *MINIATURE]) == 0
    rays, columns, ours = json.loads(file.read_text())["rows"]
    assert rays["shares"]["columns"] == columns["shares"]["rays"] == columns["shares"]["shading"] == 0
    assert rays["shares"]["rays"] > 0 and columns["shares"]["columns"] > 0
    for row in (rays, columns):
        ratios = [a / b for a, b in zip(ours["turns"], row["turns"], strict=True)]
        assert row["edqn_over_it"] == pytest.approx(sorted(ratios)[1])
    assert "decisions/s over it (products " in capsys.readouterr().out


def test_ours_is_not_held_to_what_stable_baselines3_has():
    _, stack_config, ours = conventional.parse(["--edqn"])
    assert ours is not None and conventional.parse([])[2] is None
    for name, value in AGENT.items():
        assert getattr(ours.agent, name) == getattr(Config().agent, name)
        assert getattr(stack_config.agent, name) == value


@pytest.mark.slow
def test_beside_its_flights_a_seed_tells_what_its_other_processes_held(monkeypatch):
    monkeypatch.setattr(stack.Stack, "_fastest", lambda self: (2, 1))
    turn = stack.Stack(SHORT).turn(0)
    assert turn["decisions"] == 1024 and len(turn["flights"]["outcome"]) == 1
    # Another process that has imported JAX, MuJoCo and numba.
    assert turn["workers_peak_bytes"] > 50e6


@pytest.mark.parametrize("package", ["gymnasium", "numba", "stable_baselines3", "torch"])
def test_without_a_package_it_says_how_to_install_it(package, monkeypatch):
    hide(monkeypatch, package)
    with pytest.raises(MissingPackageError, match=rf"^{package} is not installed; run pip install 'edqn-jax\[bench\]'"):
        importlib.import_module("conventional_stack.train")


def test_without_a_package_the_command_ends_with_that_sentence(monkeypatch, capsys):
    monkeypatch.setattr(conventional, "use_cpu_devices", lambda: None)
    hide(monkeypatch, "stable_baselines3")
    assert conventional.main(["--", *MINIATURE]) == 2
    assert capsys.readouterr().err.startswith("stable_baselines3 is not installed")
