"""PPO on the functional environment, in one file: rollouts, advantages and updates are one compiled program.

    python examples/ppo.py                                        # about two minutes on two CPU cores
    python examples/ppo.py --observation code --world medium      # with the events, through the pretrained encoder
    python examples/ppo.py --actions velocity                     # any velocity in place of 27 moves

Prints mean return and success of the greedy policy before and after training, in worlds that training does not use.
"""

from __future__ import annotations

import edqn_jax

# Before the imports below, which take seconds.
show_phase = edqn_jax.show_phases("ppo") if __name__ == "__main__" else lambda *_: None

import dataclasses
import time
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
import tyro
from jax import Array

from edqn_jax.interop import functional

Space = functional.Discrete | functional.Box


@dataclasses.dataclass(frozen=True)
class Settings:
    """Trains PPO on one world or a family of worlds."""

    world: str = "sparse"
    """Where to fly: random worlds (`sparse`, `medium`, ...), `paper` or an MJCF file."""
    worlds: int = 1024
    """Random worlds to train in; 1 for a world from a file."""
    observation: Literal["kinematics", "code"] = "kinematics"
    """Own state and motion alone, or also the codes of the pretrained policy's encoder."""
    actions: Literal["moves", "velocity"] = "moves"
    """27 moves, or velocities [3] of a Gaussian policy."""
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
    """Returns the logits [n] of the moves, or mean and log standard deviation [2 A] of an action, and the value."""

    space: Space

    @nn.compact
    def __call__(self, observed: Array) -> tuple[Array, Array]:
        def tower(outputs: int, scale: float) -> Array:
            x = observed
            for width in (128, 128):
                x = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
            return nn.Dense(outputs, kernel_init=nn.initializers.orthogonal(scale))(x)

        value = tower(1, 1.0)[..., 0]
        if isinstance(self.space, functional.Discrete):
            return tower(self.space.n, 0.01), value
        mean = tower(self.space.shape[0], 0.01)
        spread = self.param("log_deviation", nn.initializers.constant(-0.5), self.space.shape)
        return jnp.concatenate([mean, jnp.broadcast_to(spread, mean.shape)], axis=-1), value


def decided(space: Space, params: Any, observed: Array) -> tuple[Array, Array]:
    """Returns what the policy says [..., n or 2 A] and values [...] of observations [..., D]."""
    made: Any = ActorCritic(space).apply(params, observed)
    return made


def drawn(space: Space, said: Array, key: Array) -> Array:
    """Returns random actions [N] or [N, A] of what the policy says."""
    if isinstance(space, functional.Discrete):
        return jax.random.categorical(key, said)
    mean, log_deviation = jnp.split(said, 2, axis=-1)
    return mean + jnp.exp(log_deviation) * jax.random.normal(key, mean.shape)


def best(space: Space, said: Array) -> Array:
    """Returns the likeliest action [] or [A] of what the policy says."""
    return jnp.argmax(said) if isinstance(space, functional.Discrete) else jnp.split(said, 2)[0]


def likelihood(space: Space, said: Array, action: Array) -> tuple[Array, Array]:
    """Returns the log-probability [N] of actions [N, ...], and the policy's entropy [N]."""
    if isinstance(space, functional.Discrete):
        log_probs = jax.nn.log_softmax(said)
        log_prob = jnp.take_along_axis(log_probs, action[:, None], axis=1)[:, 0]
        return log_prob, -jnp.sum(jnp.exp(log_probs) * log_probs, axis=1)
    mean, log_deviation = jnp.split(said, 2, axis=-1)
    constant = 0.5 * jnp.log(2 * jnp.pi)
    log_prob = -0.5 * ((action - mean) / jnp.exp(log_deviation)) ** 2 - log_deviation - constant
    return jnp.sum(log_prob, axis=-1), jnp.sum(log_deviation + constant + 0.5, axis=-1)


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


def loss(settings: Settings, space: Space, params: Any, rows: Row, advantage: Array) -> Array:
    """Returns PPO's clipped loss, the mean over valid rows [B]."""
    said, value = decided(space, params, rows.observed)
    log_prob, entropy = likelihood(space, said, rows.action)
    weight = rows.valid / jnp.maximum(rows.valid.sum(), 1)
    mean = jnp.sum(weight * advantage)
    normed = (advantage - mean) / (jnp.sqrt(jnp.sum(weight * (advantage - mean) ** 2)) + 1e-8)
    ratio = jnp.exp(log_prob - rows.log_prob)
    gain = jnp.minimum(ratio * normed, jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip) * normed)
    error = (value - (rows.value + advantage)) ** 2
    return jnp.sum(weight * (-gain + 0.5 * error - settings.entropy * entropy))


def make_train(settings: Settings, env: functional.FunctionalEnv, task: functional.Params) -> tuple[Any, Any]:
    """Returns the functions `init(key)` → carry and `update(carry)` → carry, figures."""
    step, space = jax.vmap(env.step, in_axes=(0, 0, 0, None)), env.action_space(task)
    batch = settings.num_envs * settings.num_steps
    updates = -(-settings.decisions // batch)
    schedule = optax.linear_schedule(settings.learning_rate, 0.0, updates * settings.epochs * settings.minibatches)
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule, eps=1e-5))

    def init(key: Array) -> tuple:
        network_key, reset_key, key = jax.random.split(key, 3)
        observed, states = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(reset_key, settings.num_envs), task)
        params = ActorCritic(space).init(network_key, observed)
        return params, optimiser.init(params), observed, states, key

    def update(carry: tuple) -> tuple[tuple, dict[str, Array]]:
        params, optimised, observed, states, key = carry
        key, order_key = jax.random.split(key)

        def act(carry: tuple, _: None) -> tuple[tuple, tuple[Row, dict]]:
            observed, states, key = carry
            key, move_key, step_key = jax.random.split(key, 3)
            said, value = decided(space, params, observed)
            action = drawn(space, said, move_key)
            log_prob = likelihood(space, said, action)[0]
            keys = jax.random.split(step_key, settings.num_envs)
            after, states, reward, terminated, truncated, info = step(keys, states, action, task)
            reward, ended = settings.reward_scale * reward, terminated | truncated
            row = Row(observed, action, log_prob, value, reward, terminated, ended, ~info["is_reset"])
            return (after, states, key), (row, {"ended": ended, **info})

        carry, (rows, info) = jax.lax.scan(act, (observed, states, key), None, settings.num_steps)
        observed, states, key = carry
        last_value = decided(space, params, observed)[1]
        advantage = advantages(rows, last_value, settings.discount, settings.gae_lambda)
        flat = jax.tree.map(lambda x: x.reshape(batch, *x.shape[2:]), (rows, advantage))

        def descend(carry: tuple, chosen: Array) -> tuple[tuple, None]:
            params, optimised = carry
            part = jax.tree.map(lambda x: x[chosen], flat)
            changes, optimised = optimiser.update(jax.grad(loss, argnums=2)(settings, space, params, *part), optimised)
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
    space = env.action_space(task)

    def decide(carry: tuple, nothing: None) -> tuple[tuple, tuple[Array, Array]]:
        observed, state, alive = carry
        action = best(space, decided(space, params, observed)[0])
        observed, state, reward, terminated, truncated, info = env.step(state.flight.key, state, action, task)
        return (observed, state, alive & ~(terminated | truncated)), (alive * reward, alive & info["is_success"])

    observed, state = env.reset(jax.random.key(mission), task, mission)
    _, (rewards, success) = jax.lax.scan(decide, (observed, state, True), None, env.config.env.max_decisions)
    return rewards.sum(), success.any()


def main(settings: Settings) -> None:
    """Trains and prints."""
    show_phase("preparing the worlds")
    options: dict[str, Any] = {"observation": settings.observation}
    if settings.observation == "code":
        policy = edqn_jax.load_policy("pretrained")
        flown = dataclasses.replace(policy.config.env, actions=settings.actions)
        options["policy"] = dataclasses.replace(policy, config=dataclasses.replace(policy.config, env=flown))
    else:
        physics, flown = {"physics": "rigid_body"}, {"actions": settings.actions}
        options["config"] = edqn_jax.make_config(settings.world, drone=physics, env=flown)
    env, task = functional.make(settings.world, worlds=settings.worlds, **options)
    if settings.worlds > 1:
        _, unseen = functional.make(settings.world, worlds=settings.test_worlds, world_seed=1000, **options)
    else:
        unseen = task
    missions = jnp.arange(unseen.world.missions.scene.shape[0])

    def test(params: Any) -> tuple[Array, Array]:
        returns, success = jax.vmap(lambda mission: fly(env, unseen, params, mission))(missions)
        return returns.mean(), success.mean()

    init, update = make_train(settings, env, task)
    show_phase("starting the environments")
    carry = init(jax.random.key(settings.seed))
    show_phase("compiling the test flights")
    fly_tests = jax.jit(test).lower(carry[0]).compile()
    show_phase("flying the tests")
    before, began = jax.block_until_ready(fly_tests(carry[0])), time.perf_counter()
    show_phase("compiling the training")
    update = update.lower(carry).compile()
    batch = settings.num_envs * settings.num_steps
    updates = -(-settings.decisions // batch)
    for number in range(1, updates + 1):
        show_phase("training", number - 1, updates)
        carry, figures = jax.block_until_ready(update(carry))
        if number % max(1, updates // 10) == 0:
            seen = f"return {float(figures['return']):7.1f}, success {float(figures['success']):.0%}"
            print(f"{number * batch:>10,} decisions, {time.perf_counter() - began:4.0f} s: {seen}", flush=True)
    show_phase("flying the tests")
    for name, (mean, success) in (("untrained", before), ("trained", fly_tests(carry[0]))):
        print(f"{name}: mean return {float(mean):.1f}, success {float(success):.1%} of {len(missions)} missions")


if __name__ == "__main__":
    main(tyro.cli(Settings))
