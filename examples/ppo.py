"""PPO on the functional environment, in one file: rollouts, advantages and updates are one compiled program.

    python examples/ppo.py                                        # about two minutes on two CPU cores
    python examples/ppo.py --observation code --world medium      # with the events, through the pretrained encoder

Prints mean return and success of the greedy policy before and after training, in worlds that training does not use.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
import tyro
from jax import Array

import edqn_jax
from edqn_jax.interop import functional


@dataclasses.dataclass(frozen=True)
class Settings:
    """Trains PPO on one world or a family of worlds."""

    world: str = "sparse"
    """Where to fly: random worlds (`sparse`, `medium`, ...), `paper` or an MJCF file."""
    worlds: int = 1024
    """Random worlds to train in; 1 for a world from a file."""
    observation: Literal["kinematics", "code"] = "kinematics"
    """Own state and motion alone, or also the codes of the pretrained policy's encoder."""
    decisions: int = 4_000_000
    """Decisions in all."""
    seed: int = 0
    num_envs: int = 256
    num_steps: int = 64
    """Decisions of each environment in a rollout."""
    epochs: int = 4
    minibatches: int = 8
    learning_rate: float = 5e-4
    discount: float = 0.97
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.01
    reward_scale: float = 0.02
    test_worlds: int = 256
    """Random worlds of the tests, none of which training uses, with a mission in each."""


class Row(NamedTuple):
    """One step of every environment."""

    observed: Array
    action: Array
    log_prob: Array
    value: Array
    reward: Array
    terminated: Array
    ended: Array  # terminated or truncated
    valid: Array  # false where the step was spent on a reset: no transition


class ActorCritic(nn.Module):
    """Returns the logits of the moves and the value."""

    @nn.compact
    def __call__(self, observed: Array) -> tuple[Array, Array]:
        def tower(outputs: int, scale: float) -> Array:
            x = observed
            for width in (128, 128):
                x = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
            return nn.Dense(outputs, kernel_init=nn.initializers.orthogonal(scale))(x)

        return tower(27, 0.01), tower(1, 1.0)[..., 0]


def decided(params: Any, observed: Array) -> tuple[Array, Array]:
    """Returns logits [..., 27] and values [...] of observations [..., D]."""
    made: Any = ActorCritic().apply(params, observed)
    return made


def advantages(rows: Row, last_value: Array, discount: float, decay: float) -> Array:
    """Returns generalised advantages [T, N].

    The observation after a decision is the next row's, also at the end of an episode; there the value counts unless
    the episode was terminated, and nothing of the next episode does.
    """

    def back(carry: tuple[Array, Array], row: Row) -> tuple[tuple[Array, Array], Array]:
        later, next_value = carry
        error = row.reward + discount * next_value * ~row.terminated - row.value
        advantage = error + discount * decay * later * ~row.ended
        return (advantage, row.value), advantage

    start = jnp.zeros_like(last_value), last_value
    return jax.lax.scan(back, start, rows, reverse=True)[1]


def loss(settings: Settings, params: Any, rows: Row, advantage: Array) -> Array:
    """Returns PPO's clipped loss, the mean over valid rows [B]."""
    logits, value = decided(params, rows.observed)
    log_probs = jax.nn.log_softmax(logits)
    log_prob = jnp.take_along_axis(log_probs, rows.action[:, None], axis=1)[:, 0]
    weight = rows.valid / jnp.maximum(rows.valid.sum(), 1)
    mean = jnp.sum(weight * advantage)
    normed = (advantage - mean) / (jnp.sqrt(jnp.sum(weight * (advantage - mean) ** 2)) + 1e-8)
    ratio = jnp.exp(log_prob - rows.log_prob)
    gain = jnp.minimum(ratio * normed, jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip) * normed)
    error = (value - (rows.value + advantage)) ** 2
    entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=1)
    return jnp.sum(weight * (-gain + 0.5 * error - settings.entropy * entropy))


def make_train(settings: Settings, env: functional.FunctionalEnv, task: functional.Params) -> tuple[Any, Any]:
    """Returns the functions `init(key)` → carry and `update(carry)` → carry, figures."""
    step = jax.vmap(env.step, in_axes=(0, 0, 0, None))
    batch = settings.num_envs * settings.num_steps
    updates = -(-settings.decisions // batch)
    schedule = optax.linear_schedule(settings.learning_rate, 0.0, updates * settings.epochs * settings.minibatches)
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule, eps=1e-5))

    def init(key: Array) -> tuple:
        network_key, reset_key, key = jax.random.split(key, 3)
        observed, states = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(reset_key, settings.num_envs), task)
        params = ActorCritic().init(network_key, observed)
        return params, optimiser.init(params), observed, states, key

    def update(carry: tuple) -> tuple[tuple, dict[str, Array]]:
        params, optimised, observed, states, key = carry
        key, order_key = jax.random.split(key)

        def act(carry: tuple, _: None) -> tuple[tuple, tuple[Row, dict]]:
            observed, states, key = carry
            key, move_key, step_key = jax.random.split(key, 3)
            logits, value = decided(params, observed)
            action = jax.random.categorical(move_key, logits)
            log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], axis=1)[:, 0]
            keys = jax.random.split(step_key, settings.num_envs)
            after, states, reward, terminated, truncated, info = step(keys, states, action, task)
            reward, ended = settings.reward_scale * reward, terminated | truncated
            row = Row(observed, action, log_prob, value, reward, terminated, ended, ~info["is_reset"])
            return (after, states, key), (row, {"ended": ended, **info})

        carry, (rows, info) = jax.lax.scan(act, (observed, states, key), None, settings.num_steps)
        observed, states, key = carry
        last_value = decided(params, observed)[1]
        advantage = advantages(rows, last_value, settings.discount, settings.gae_lambda)
        flat = jax.tree.map(lambda x: x.reshape(batch, *x.shape[2:]), (rows, advantage))

        def descend(carry: tuple, chosen: Array) -> tuple[tuple, None]:
            params, optimised = carry
            part = jax.tree.map(lambda x: x[chosen], flat)
            changes, optimised = optimiser.update(jax.grad(loss, argnums=1)(settings, params, *part), optimised)
            return (optax.apply_updates(params, changes), optimised), None

        orders = jax.vmap(lambda key: jax.random.permutation(key, batch))(jax.random.split(order_key, settings.epochs))
        parts = orders.reshape(settings.epochs * settings.minibatches, -1)
        (params, optimised), _ = jax.lax.scan(descend, (params, optimised), parts)
        ends = jnp.maximum(info["ended"].sum(), 1)
        figures = {
            "return": jnp.sum(info["ended"] * info["episode_return"]) / ends,
            "success": info["is_success"].sum() / ends,
        }
        return (params, optimised, observed, states, key), figures

    return init, jax.jit(update, donate_argnums=0)


def fly(env: functional.FunctionalEnv, task: functional.Params, params: Any, mission: Array) -> tuple[Array, Array]:
    """Returns return [] and success [] of one greedy flight of a mission [], with the seed of its number."""

    def decide(carry: tuple, nothing: None) -> tuple[tuple, tuple[Array, Array]]:
        observed, state, alive = carry
        logits, _ = decided(params, observed)
        key = state.flight.key
        observed, state, reward, terminated, truncated, info = env.step(key, state, jnp.argmax(logits), task)
        return (observed, state, alive & ~(terminated | truncated)), (alive * reward, alive & info["is_success"])

    observed, state = env.reset(jax.random.key(mission), task, mission)
    _, (rewards, success) = jax.lax.scan(decide, (observed, state, True), None, env.config.env.max_decisions)
    return rewards.sum(), success.any()


def main(settings: Settings) -> None:
    """Trains and prints."""
    options: dict[str, Any] = {"observation": settings.observation}
    if settings.observation == "code":
        options["policy"] = edqn_jax.load_policy("pretrained")
    else:
        options["config"] = edqn_jax.make_config(settings.world, drone={"physics": "rigid_body"})
    env, task = functional.make(settings.world, worlds=settings.worlds, **options)
    if settings.worlds > 1:
        _, unseen = functional.make(settings.world, worlds=settings.test_worlds, world_seed=1000, **options)
    else:
        unseen = task
    missions = jnp.arange(unseen.world.missions.scene.shape[0])

    @jax.jit
    def test(params: Any) -> tuple[Array, Array]:
        returns, success = jax.vmap(lambda mission: fly(env, unseen, params, mission))(missions)
        return returns.mean(), success.mean()

    init, update = make_train(settings, env, task)
    carry = init(jax.random.key(settings.seed))
    before, began = test(carry[0]), time.perf_counter()
    batch = settings.num_envs * settings.num_steps
    updates = -(-settings.decisions // batch)
    for number in range(1, updates + 1):
        carry, figures = update(carry)
        if number % max(1, updates // 10) == 0:
            seen = f"return {float(figures['return']):7.1f}, success {float(figures['success']):.0%}"
            print(f"{number * batch:>10,} decisions, {time.perf_counter() - began:4.0f} s: {seen}", flush=True)
    for name, (mean, success) in (("untrained", before), ("trained", test(carry[0]))):
        print(f"{name}: mean return {float(mean):.1f}, success {float(success):.1%} of {len(missions)} missions")


if __name__ == "__main__":
    main(tyro.cli(Settings))
