"""The scanned training step: traced once, the same on any layout, its phases in order."""

from __future__ import annotations

import dataclasses
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import (
    AirConfig,
    BodyConfig,
    Config,
    MotorsConfig,
    NoiseConfig,
)
from edqn_jax.learn import replay, saved_state
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import TrainState, init_state
from edqn_jax.learn.step import _encode_observations, policy_of, run_steps, train_step
from edqn_jax.learn.trainer import Trainer
from edqn_jax.sim.physics.disturbances import Disturbance
from edqn_jax.sim.task import env
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE, Observation
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.configs import TINY, retrained
from tests.support.miniature import miniature_world

pytestmark = pytest.mark.whole

RETRAINED = retrained((0.01,))


@pytest.fixture(scope="module")
def world() -> EnvParams:
    return miniature_world(TINY)


def run(config: Config, world: EnvParams, devices: int) -> tuple[list[TrainState], list, int, Trainer]:
    """States on the host after each chunk, what the chunks returned, how often the step was traced; the trainer."""
    traces = 0
    step = train_step

    def counted(*args):
        nonlocal traces
        traces += 1
        return step(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("edqn_jax.learn.step.train_step", counted)
        made = Trainer(config, world, jax.devices()[:devices])
        state = made.init(config.train.seed)
        states, returned = [_host(state)], []
        for first in range(0, made.schedule.total, config.train.chunk_steps):
            state, out = made.chunk(state, first)
            states.append(_host(state))
            returned.append(jax.tree.map(np.asarray, out))
    return states, returned, traces, made


def _host(state: TrainState) -> TrainState:
    """A copy that donation does not take away, keys as their data."""

    def leaf(x: jax.Array) -> np.ndarray:
        return np.array(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)

    return jax.tree.map(leaf, state)


@pytest.fixture(scope="module")
def on_one(world: EnvParams):
    return run(TINY, world, 1)


@pytest.fixture(scope="module")
def on_two(world: EnvParams):
    return run(TINY, world, 2)


@pytest.mark.slow
def test_the_training_chunk_is_traced_exactly_once_in_a_run(on_two) -> None:
    states, _, traces, _ = on_two
    assert len(states) == 5
    assert traces == 1


@pytest.mark.slow
def test_no_callback_to_the_host_hides_in_the_step(world: EnvParams) -> None:
    state = jax.eval_shape(lambda k: init_state(TINY, world, k), jax.random.key(0))
    jaxpr = jax.make_jaxpr(lambda s, n: run_steps(TINY, world, s, n))(state, jnp.arange(2))
    assert "callback" not in str(jaxpr)


@pytest.mark.slow
def test_rollouts_before_learning_are_the_same_on_one_device_and_two(on_one, on_two) -> None:
    # The first chunk is the warm-up: random manoeuvres, so nothing that was learnt has acted yet. XLA vectorises
    # another batch size differently, which moves the last bits of a position at 100 m.
    for one, two in zip(
        jax.tree.leaves(on_one[0][1].actors.env), jax.tree.leaves(on_two[0][1].actors.env), strict=True
    ):
        np.testing.assert_allclose(one, two, atol=1e-4)


@pytest.mark.slow
def test_parameters_agree_on_one_device_and_two_after_the_first_updates(on_one, on_two) -> None:
    # Sums over shards are added in another order: a few units in the last place per update.
    for one, two in zip(jax.tree.leaves(on_one[0][1].learner), jax.tree.leaves(on_two[0][1].learner), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-5)


@pytest.mark.slow
def test_training_against_every_disturbance_stores_what_was_chosen_and_goes_on_from_what_was_saved(
    world: EnvParams,
) -> None:
    config = dataclasses.replace(
        TINY,
        env=dataclasses.replace(
            TINY.env, sensor="blind", action_delay=1, delay_share=0.5, setpoint_m_s2=4.0, max_decisions=6
        ),
        air=AirConfig(wind_m_s=5.0, gusts_m_s=3.0),
        body=BodyConfig(mass_share=0.2, inertia_share=0.2),
        motors=MotorsConfig(gain_share=0.2, lag_s=0.05),
        noise=NoiseConfig(0.3, 0.2, 0.3, 0.2),
    )
    made = Trainer(config, world, jax.devices()[:1])
    state, _ = made.chunk(made.init(0), 0)
    saved = saved_state.to_host(made, state, 4)
    assert {name.rpartition(".")[2] for name in saved if ".disturbance." in name} == set(vars(Disturbance()))
    chosen = saved[".actors.env.disturbance.move"]  # in the newest row, which is to be flown next
    running, newest = ~saved[".actors.is_reset"], saved[".actors.replay.action"][:, 3]
    assert running.any()
    np.testing.assert_array_equal(chosen[running], newest[running])
    again = saved_state.from_host(made, saved)
    (one, (_, losses)), (other, _) = (made.chunk(each, 4) for each in (state, again))
    assert np.isfinite(losses.metrics["q_loss"][-1]) and not any(
        np.any(count) for count in vars(losses.health).values()
    )
    jax.tree.map(np.testing.assert_array_equal, _host(one), _host(other))


def flown_on(made: Trainer, chunks: int, poison: Any = None) -> tuple[TrainState, Any]:
    """The state after so many chunks and the last one's losses; `poison` changes the state before the last."""
    state, losses = made.init(TINY.train.seed), None
    for number in range(chunks):
        if poison is not None and number == chunks - 1:
            state = poison(state)
        state, (_, losses) = made.chunk(state, number * TINY.train.chunk_steps)
    assert losses is not None
    return _host(state), jax.tree.map(np.asarray, losses)


def finite(tree: Any) -> bool:
    return all(np.isfinite(np.asarray(leaf, np.float64)).all() for leaf in jax.tree.leaves(tree))


def changed(state: TrainState, path: str, change: Any) -> TrainState:
    """The state with the array at a path such as `actors.replay.reward` changed; of several, the first."""
    first, _, rest = path.partition(".")
    held = getattr(state, first)
    if rest:
        return dataclasses.replace(state, **{first: changed(held, rest, change)})
    leaves, tree = jax.tree.flatten(held)
    return dataclasses.replace(state, **{first: tree.unflatten([change(leaves[0]), *leaves[1:]])})


@pytest.mark.slow
def test_a_poisoned_parameter_stops_all_updates_and_spoils_no_saved_policy(on_one) -> None:
    made, steps, updates = on_one[3], TINY.train.chunk_steps, TINY.agent.updates_per_step
    clean, _ = flown_on(made, 3)
    state, losses = flown_on(
        made, 4, lambda state: changed(state, "learner.agent.q", lambda x: x.at[(0,) * x.ndim].set(np.nan))
    )
    health = losses.health
    np.testing.assert_array_equal(health.parameters, np.ones(steps))
    np.testing.assert_array_equal(health.gradient, np.full(steps, updates))
    assert np.isnan(losses.metrics["q_loss"]).all() and not health.physics_state.any()
    # What is flown and saved is the average, which stays; so does the optimiser.
    assert _same(state.learner.agent.average, clean.learner.agent.average) and _same(
        state.learner.agent.target, clean.learner.agent.target
    )
    assert finite(state.learner.agent.q_optimiser) and finite(state.actors.replay)


@pytest.mark.slow
def test_a_poisoned_encoder_is_told_of_and_acts_in_no_flight(on_one) -> None:
    state, losses = flown_on(
        on_one[3], 4, lambda state: changed(state, "learner.vae", lambda x: x.at[(0,) * x.ndim].set(np.nan))
    )
    np.testing.assert_array_equal(losses.health.parameters, np.ones(TINY.train.chunk_steps))
    assert finite(state.learner.encoder) and finite(state.learner.agent)


@pytest.mark.slow
def test_a_poisoned_transition_costs_the_updates_that_meet_it_and_nothing_else(on_one) -> None:
    made, plan = on_one[3], Schedule.from_config(TINY)
    written = 2 * TINY.train.chunk_steps - plan.warmup  # rows before the last chunk

    def poison(state: TrainState) -> TrainState:
        return changed(state, "actors.replay.reward", lambda x: x.at[0, written - 1, 0].set(np.nan))

    state, losses = flown_on(made, 3, poison)
    skipped = losses.health.gradient.sum()
    assert 0 < skipped < TINY.train.chunk_steps * TINY.agent.updates_per_step
    np.testing.assert_array_equal(losses.health.loss, losses.health.gradient)
    assert not losses.health.parameters.any() and finite(state.learner)


@pytest.mark.slow
def test_drones_whose_physics_blows_up_are_reset_and_counted_and_the_others_fly_on(on_one) -> None:
    made, running = on_one[3], []
    clean, before = flown_on(made, 3)

    def poison(state: TrainState) -> TrainState:
        running.append(int(np.sum(~np.asarray(state.actors.env.ended)[:4])))
        return changed(state, "actors.env.drone.angular_velocity", lambda x: x.at[:4].set(1e30))

    state, losses = flown_on(made, 3, poison)
    assert losses.health.physics_state.tolist() == [*running, 0, 0, 0] and running[0] > 4
    assert before.health.physics_state.sum() == 0
    assert finite(state.actors) and finite(state.learner) and not losses.health.gradient.any()
    one, other = (np.asarray(x.actors.env.drone.position)[4:] for x in (state, clean))
    np.testing.assert_allclose(one, other, atol=1e-3)  # the Q-network is hardly another one by now


@pytest.mark.slow
def test_the_acting_encoder_changes_once_at_the_end_of_the_warm_up(on_one) -> None:
    states = on_one[0]
    assert Schedule.from_config(TINY).warmup == 4
    start, warm, later, last = states[0].learner, states[1].learner, states[2].learner, states[-1].learner
    assert not _same(start.encoder, warm.encoder)
    assert _same(warm.encoder, warm.vae)
    assert _same(warm.encoder, later.encoder) and _same(warm.encoder, last.encoder)


@pytest.mark.slow
def test_the_q_network_rests_until_there_is_enough_to_learn_from(on_one) -> None:
    states, returned, *_ = on_one
    plan = Schedule.from_config(TINY)
    losses = np.concatenate([losses.metrics["q_loss"] for _, losses in returned])
    assert np.isnan(losses[: plan.learn_from]).all()
    assert np.isfinite(losses[plan.learn_from :]).all()
    assert _same(states[0].learner.agent.q, states[1].learner.agent.q)
    assert not _same(states[0].learner.agent.q, states[-1].learner.agent.q)
    # The average lags behind what learns, and the target too.
    assert not _same(states[-1].learner.agent.q, states[-1].learner.agent.target)


@pytest.mark.slow
def test_the_replay_holds_what_the_environments_went_through(on_one) -> None:
    states, returned, *_ = on_one
    plan, actors = Schedule.from_config(TINY), states[-1].actors
    stored = plan.total - plan.warmup
    # [S, L, E] -> rows 1.. hold the outcome of the step before them.
    replayed = actors.replay.outcome[:, 1:stored].swapaxes(0, 1)
    flown = np.concatenate([episodes.outcome for episodes, _ in returned])[plan.warmup :]
    np.testing.assert_array_equal(replayed, flown[: stored - 1])
    after_an_end = np.roll(actors.replay.outcome, 1, axis=1)[:, 1:stored] != Outcome.RUNNING
    np.testing.assert_array_equal(actors.replay.is_reset[:, 1:stored], after_an_end)


@pytest.mark.slow
def test_nothing_is_learnt_from_what_stood_there_before_the_first_reset(world: EnvParams) -> None:
    start = jax.jit(partial(init_state, TINY, world))(jax.random.key(0))
    actors = jax.tree.map(lambda x: x[0], start.actors)
    envs = actors.reward.shape[0]

    def row(is_reset: bool, outcome: jax.Array) -> replay.Rows:
        return replay.Rows(
            observation=actors.memory[:, -1],
            reward=actors.reward,
            outcome=outcome,
            is_reset=jnp.full(envs, is_reset),
            action=jnp.zeros(envs, jnp.int32),
        )

    agent = dataclasses.replace(TINY.agent, history=1)
    last = agent.n_step + 1  # room for two starts: the row before the first reset, and that reset
    write, sample = jax.jit(replay.store_decision), jax.jit(partial(replay.sample_transitions, agent), static_argnums=2)
    ring = write(actors.replay, row(True, actors.outcome), jnp.int32(0))
    for time in range(1, last + 1):
        ring = write(ring, row(time == 1, jnp.full(envs, int(Outcome.RUNNING))), jnp.int32(time))
    batch = sample(ring, jnp.int32(last), 64, jax.random.key(1))
    assert set(np.asarray(batch.weight)) == {0.0, 1.0}
    oldest = sample(ring, jnp.int32(last - 1), 64, jax.random.key(1))
    assert not np.any(oldest.weight)


def test_a_new_episode_begins_with_an_empty_memory() -> None:
    config = dataclasses.replace(TINY, env=dataclasses.replace(TINY.env, sensor="blind"))
    own = jnp.arange(1.0, 1.0 + 2 * OWN_SIZE).reshape(2, OWN_SIZE)
    seen: Any = SimpleNamespace(
        is_reset=jnp.array([True, False]), observation=Observation(None, own, own[:, :MOTION_SIZE])
    )
    actors: Any = SimpleNamespace(memory=jnp.full((1, 2, config.agent.history, OWN_SIZE), 7.0))
    learner: Any = SimpleNamespace(encoder={}, agent=SimpleNamespace(average={}))
    fresh, running = _encode_observations(
        config, learner, actors, seen, jnp.int32(Schedule.from_config(config).warmup + 5)
    )
    np.testing.assert_array_equal(fresh, [np.zeros(OWN_SIZE), own[0]])
    np.testing.assert_array_equal(running, [np.full(OWN_SIZE, 7.0), own[1]])


@pytest.fixture(scope="module")
def retraining(world: EnvParams) -> tuple[list[TrainState], list]:
    """States before each of 15 steps and after the last, and what each returned; steps 11 and 12 retrain the VAE."""
    step = jax.jit(lambda state, number: train_step(RETRAINED, world, None, state, number))
    states, returned = [jax.jit(lambda key: init_state(RETRAINED, world, key))(jax.random.key(0))], []
    for number in range(15):
        state, out = step(states[-1], jnp.int32(number))
        states.append(state)
        returned.append(out)
    return states, returned


@pytest.mark.slow
def test_the_encoder_that_acts_changes_when_the_vae_has_been_trained_and_never_else(retraining) -> None:
    states, returned = retraining
    changed, learnt = [], []
    for number, (before, state, (_, losses)) in enumerate(zip(states, states[1:], returned, strict=False)):
        changed += [number] * (not _same(before.learner.encoder, state.learner.encoder))
        learnt += [number] * bool(np.isfinite(losses.metrics["reconstruction_loss"]))
        if number in (3, 12):  # nothing that was encoded with the old one is left in a memory
            memory = np.asarray(state.actors.memory)
            assert not memory[:, :, :-1].any() and memory[:, :, -1].any()
    assert changed == [3, 12] and learnt == [0, 1, 2, 3, 11, 12]


@pytest.mark.slow
def test_labels_reach_the_vae_and_nothing_that_acts_before_it_does(retraining, world: EnvParams, monkeypatch) -> None:
    """With other labels in a retraining the VAE learns something else; all that is seen and done stays as it was."""
    states, returned = retraining
    (_, warmup), (first, end) = Schedule.from_config(RETRAINED).vae_training
    assert warmup < first < end - 1
    true = env.nearness
    monkeypatch.setattr(env, "nearness", lambda *given: 3.0 - true(*given))
    step = jax.jit(lambda state: train_step(RETRAINED, world, None, state, jnp.int32(first)))
    truly, falsely = (states[first + 1], returned[first]), step(states[first])
    assert not _same(truly[0].learner.vae, falsely[0].learner.vae)
    assert _same(_told(truly), _told(falsely))


@pytest.mark.slow
def test_agents_that_train_together_train_as_each_alone(on_two, world: EnvParams) -> None:
    alone: Trainer = on_two[-1]
    other = dataclasses.replace(world, missions=jax.tree.map(lambda x: x[::-1], world.missions))
    together = Trainer(TINY, [other, world], jax.devices()[:2])
    state, two = alone.init(1), together.init([0, 1])
    learnt = False
    for first in range(0, alone.schedule.total, TINY.train.chunk_steps):
        state, (episodes, losses) = alone.chunk(state, first)
        two, returned = together.chunk(two, first)
        second_episodes, second_losses = together.each(jax.tree.map(np.asarray, returned))[1]
        # Flights are exact; batched products round otherwise, which after many updates would change a move.
        np.testing.assert_array_equal(second_episodes.outcome, episodes.outcome)
        for name in ("reconstruction_loss", "q_loss"):
            np.testing.assert_allclose(second_losses.metrics[name], losses.metrics[name], rtol=1e-4)
        learnt |= bool(np.isfinite(losses.metrics["q_loss"]).any())
    assert learnt
    first, second = together.each(jax.tree.map(np.asarray, policy_of(together.config, two)))
    assert not _same(first, second)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5), second, policy_of(together.config, state))


def _told(trained: tuple) -> tuple:
    """What the agent of a chunk knew, saw and did, and how its episodes ended; all but the VAE that learns."""
    state, (episodes, _) = trained
    return state.learner.encoder, state.learner.agent.q, state.actors.memory, state.actors.replay, episodes


def _same(one, two) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.slow
def test_what_makes_the_first_state_is_compiled_ahead_and_used_once(
    world: EnvParams, on_two, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Trainer(TINY, world, jax.devices()[:2])
    made.trace_first()()
    monkeypatch.setattr(made, "trace_first", None)
    for one, two in zip(jax.tree.leaves(_host(made.init(TINY.train.seed))), jax.tree.leaves(on_two[0][0]), strict=True):
        np.testing.assert_array_equal(one, two)
    with pytest.raises(TypeError):  # it may hold parameters, and is not held on to
        made.init(TINY.train.seed)
