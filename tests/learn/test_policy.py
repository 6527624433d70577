"""The policy is given the same observations in flight as in training."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.config import AgentConfig, CameraConfig, Config, EncoderConfig, EnvConfig, EventsConfig
from edqn_jax.errors import ConfigError
from edqn_jax.learn import qnetwork, replay
from edqn_jax.learn.actor import AgentActor, PolicyParams, observation_size
from edqn_jax.learn.perception import vae
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE, Observation
from tests.oracles import event_fields

CONFIG = Config(
    camera=CameraConfig(width=8, height=6),
    encoder=EncoderConfig(code_size=5, patch_layers=(4, 3), joint_layers=(8,), decoder_hidden=(8,)),
    agent=AgentConfig(history=3, hidden=(16,)),
)
SIZE = observation_size(CONFIG)
ACTOR = AgentActor(CONFIG)


@pytest.fixture(scope="module")
def params():
    @jax.jit
    def fresh(key):
        code_key, q_key = jax.random.split(key)
        return PolicyParams(
            encoder=vae.init_vae(CONFIG.encoder, CONFIG.camera, code_key),
            q=qnetwork.init_q(CONFIG.agent, SIZE, len(ACTIONS), q_key),
        )

    return fresh(jax.random.key(0))


def observations(count, seed=0):
    rng = np.random.default_rng(seed)
    counts = rng.integers(-3, 4, (count, 6, 8)).astype(np.int8)
    own = rng.normal(size=(count, OWN_SIZE)).astype(np.float32)
    motion = rng.normal(size=(count, MOTION_SIZE)).astype(np.float32)
    return [
        Observation(
            sensed=event_fields.field_of_counts(CONFIG.events, jnp.asarray(c)),
            own=jnp.asarray(o),
            motion=jnp.asarray(m),
        )
        for c, o, m in zip(counts, own, motion, strict=True)
    ]


@pytest.fixture(scope="module")
def act():
    return jax.jit(ACTOR.act)


@jax.jit
def flatten(params, memory, observation):
    """What is remembered of one observation, [D]."""
    return ACTOR.encode(params, memory, observation)[-1]


@pytest.mark.slow
def test_memory_stacks_an_episode_as_the_replay_does(params, act):
    seen = observations(5)
    memory = ACTOR.init()
    flat = np.stack([flatten(params, memory, each) for each in seen])
    history = CONFIG.agent.history
    # The replay's rows: an older episode's observations before this one's first, which is a reset.
    rows = np.concatenate([np.full((history, SIZE), 9.0, np.float32), flat])
    resets = np.zeros(len(rows), bool)
    resets[history] = True
    for now, each in enumerate(seen):
        _, memory = act(params, memory, each, jax.random.key(now))
        window = slice(now + 1, now + 1 + history)
        trained_on = replay.stack_observations(jnp.asarray(rows[window]), jnp.asarray(resets[window]))
        # Two compilations, hence not to the last digit.
        np.testing.assert_allclose(memory, trained_on, atol=1e-5)


@pytest.mark.slow
def test_an_observation_is_the_scaled_code_and_the_own_state(params):
    one = observations(1)[0]
    flat = flatten(params, ACTOR.init(), one)
    assert flat.shape == (SIZE,) == (5 + OWN_SIZE,)
    code = vae.embed(CONFIG.encoder, params.encoder, one.sensed, one.motion)  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(flat[:5], CONFIG.agent.code_scale * code, rtol=1e-6)
    np.testing.assert_array_equal(flat[5:], one.own)


@pytest.mark.slow
def test_a_network_that_sees_the_last_move_has_it_between_the_code_and_the_own_state(params):
    config = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, last_move=True))
    one = observations(1)[0]
    memory = AgentActor(config).init()
    flat = AgentActor(config).encode(params, memory, one)[-1]
    plain = flatten(params, ACTOR.init(), one)
    assert flat.shape == memory.shape[1:] == (observation_size(config),)
    np.testing.assert_array_equal(flat[5:8], one.motion[4:])
    np.testing.assert_allclose(np.delete(flat, [5, 6, 7]), plain, rtol=1e-6)


def test_the_greedy_move_is_the_best_of_the_network(params, act):
    memory = ACTOR.init()
    for number, each in enumerate(observations(4, seed=1)):
        move, memory = act(params, memory, each, jax.random.key(number))
        q = qnetwork.q_values(CONFIG.agent, params.q, len(ACTIONS), memory)
        assert int(move) == int(jnp.argmax(q)) and move.dtype == jnp.int32


def test_memories_of_many_drones_are_remembered_side_by_side():
    actor = AgentActor(dataclasses.replace(CONFIG, env=EnvConfig(sensor="blind")))
    memory = jnp.arange(2 * 3 * float(OWN_SIZE)).reshape(2, 3, OWN_SIZE)
    new = Observation(None, own=-jnp.ones((2, OWN_SIZE)), motion=jnp.zeros((2, MOTION_SIZE)))
    params = PolicyParams(encoder={}, q={})
    both = actor.encode(params, memory, new)
    for drone in range(2):
        alone = actor.encode(params, memory[drone], jax.tree.map(lambda x, d=drone: x[d], new))
        np.testing.assert_array_equal(both[drone], alone)
    np.testing.assert_array_equal(both[:, :2], memory[:, 1:])
    np.testing.assert_array_equal(both[:, 2], new.own)


def test_a_code_is_read_from_the_newest_observation():
    memory = jnp.stack([jnp.zeros((3, SIZE)), jnp.arange(3.0 * SIZE).reshape(3, SIZE)])
    np.testing.assert_allclose(ACTOR.code(memory)[1], (2 * SIZE + np.arange(5)) / CONFIG.agent.code_scale)


def test_the_table_of_the_paper_has_a_state_of_42():
    assert observation_size(Config()) == 42
    assert observation_size(dataclasses.replace(Config(), agent=AgentConfig(last_move=True))) == 45


@pytest.mark.usefixtures("strict_jax")
@pytest.mark.slow
def test_the_policy_is_strict(params):
    one = observations(1)[0]
    move, memory = jax.jit(ACTOR.act)(params, ACTOR.init(), one, jax.random.key(3))
    assert memory.shape == (3, SIZE) and move.shape == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seen", "says"),
    [
        (jnp.zeros((6, 8)), r"events of 1 x 6 x 8 .* in 0.04 s; this observation is 6 x 8 numbers"),
        (None, "this observation is nothing"),
        (
            event_fields.field_of_counts(CONFIG.events, jnp.zeros((12, 8), jnp.int8)),
            "this observation is events of 1 x 12 x 8",
        ),
        (
            event_fields.field_of_counts(EventsConfig(frame_times_s=(-0.08, 0.0)), jnp.zeros((6, 8), jnp.int8)),
            "this observation is events of 1 x 6 x 8 frame pairs and pixels in 0.08 s",
        ),
    ],
)
def test_an_observation_of_another_sensor_is_refused_with_a_sentence_that_names_both(seen, says, params):
    flies = Policy(CONFIG, params)
    fitting = observations(1)[0]
    flies.act(fitting)
    with pytest.raises(ConfigError, match=f"trained with the sensor 'events'.*{says}"):
        flies.act(dataclasses.replace(fitting, sensed=seen))


@pytest.mark.whole
@pytest.mark.slow
def test_noise_changes_the_form_of_events_and_not_whether_they_fit():
    noisy = dataclasses.replace(CONFIG, events=EventsConfig(leak_rate_hz=0.2))
    environment = edqn_jax.make("sparse", noisy)
    _, observation = environment.reset(jax.random.key(0))
    Policy(noisy, fresh_policy(noisy)).act(observation)
    Policy(CONFIG, fresh_policy(CONFIG)).act(observation)
