"""stable-baselines3's DQN on all drones: training, flights and speed.

The agent is a DQN with ReLU layers, n-step returns, a Huber loss, Adam and a Polyak-averaged target, with the sizes and
rates of the configuration. It does not have what stable-baselines3 lacks: double and dueling DQN, averaged parameters.

trained = train(config, Course.of(world), processes=2)
flights = fly(trained, Course.of(validation))
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conventional_stack.fleet import Course
from conventional_stack.flights import fly_missions
from conventional_stack.stopwatch import Stopwatch
from conventional_stack.vae import EventVAE, Learner
from conventional_stack.vec_env import CodedDrones, make_observations
from conventional_stack.workers import SpreadFleet
from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.learn.schedule import Schedule
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.task.flights import Flights

torch = require_extra("torch")
stable_baselines3 = require_extra("stable_baselines3")

PARTS = (
    "physics",
    "outcome",
    "rays",
    "shading",
    "columns",
    "events",
    "waiting",
    "encoder",
    "vae_update",
    "acting",
    "dqn_update",
)
"""Parts that are timed; the rest of the time is spent in stable-baselines3."""


@dataclass(frozen=True)
class Trained:
    """The result of a training, which does not change when the training continues."""

    config: Config
    vae: EventVAE
    q: Any
    """The Q-network, a PyTorch module."""
    decisions: int
    """All decisions, with those of the warm-up."""
    seconds: float
    """Time of these decisions, without the start of processes."""

    def act(self, events: NDArray[np.int8], own: NDArray[np.float32], motion: NDArray[np.float32]) -> NDArray[np.int64]:
        """Returns the best actions [M] for event counts [M, H, W], own states [M, 10] and own motions [M, 7]."""
        code = self.vae.code(self.vae.patches(events), motion)
        observation = torch.from_numpy(make_observations(self.config, code, own))
        with torch.inference_mode():
            return self.q(observation).argmax(dim=1).numpy()


def train(
    config: Config,
    course: Course,
    processes: int = 1,
    threads: int = 1,
    watch: Callable[[Trained], None] | None = None,
) -> Trained:
    """Trains for `config.train.total_steps` decisions, warm-up included, with `config.train.seed`.

    Args:
        course: world and missions.
        processes: number of simulating processes.
        threads: of PyTorch in the process that learns.
        watch: called with the result after every `config.train.validation_every` decisions and at the end; its time
            does not count.

    Raises:
        ConfigError: if this stack does not support the configuration.
        ValueError: if the number of drones is not a multiple of the number of processes.
    """
    with Training(config, course, processes, threads) as training:
        training.warm_up()
        trained = training.trained()
        while (left := training.total - training.decisions) > 0:
            training.learn(min(config.train.validation_every or left, left))
            trained = training.trained()
            if watch is not None:
                watch(trained)
        return trained


def fly(trained: Trained, course: Course) -> Flights:
    """Flies each mission of the course once with the best actions, see `flights.fly_missions`."""
    return fly_missions(trained.config, course, trained.act)


def check(config: Config) -> None:
    """Raises ConfigError if stable-baselines3's DQN or the VAE does not support the configuration."""
    agent = config.agent
    unknown = agent.layer_norm or agent.last_move or agent.exploration_episodes > 0
    if agent.history != 1 or agent.huber_delta != 1.0 or unknown:
        raise ConfigError(
            "the conventional stack's DQN supports only agent.history 1, agent.layer_norm False, agent.last_move "
            "False, agent.huber_delta 1 and agent.exploration_episodes 0"
        )
    if config.encoder.architecture != "patches":
        raise ConfigError("the conventional stack's VAE supports only encoder.architecture 'patches'")


class TimedDQN(stable_baselines3.DQN):
    """stable-baselines3's DQN with its updates and actions timed."""

    stopwatch: Stopwatch
    planned: int
    """Decisions over which the schedules extend, over all calls of `learn`."""

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, self.planned)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Runs and times the DQN's updates."""
        with self.stopwatch.time("dqn_update"):
            super().train(gradient_steps, batch_size)

    def _sample_action(self, *args: Any, **kwargs: Any) -> Any:
        with self.stopwatch.time("acting"):
            return super()._sample_action(*args, **kwargs)


class Training:
    """Drones, VAE and DQN of a configuration. A context manager, which ends the other processes."""

    def __init__(
        self, config: Config, course: Course, processes: int = 1, threads: int = 1, camera: str = "rays"
    ) -> None:
        """Starts `config.train.num_envs` drones in `processes` processes and PyTorch with `threads` threads.

        `camera` is one of `fleet.CAMERAS`.

        Raises:
            ConfigError: if this stack does not support the configuration.
            ValueError: if the number of drones is not a multiple of the number of processes.
        """
        agent, drones = config.agent, config.train.num_envs
        check(config)
        self.config, self.threads, self.plan = config, threads, Schedule.from_config(config)
        self.warm, self.seconds = 0, 0.0
        fleet = SpreadFleet(config, course, drones, processes, config.train.seed, camera)
        self.learner = Learner(config.encoder, config.camera, config.train.seed)
        self.env = CodedDrones(config, fleet, self.learner)
        self.stopwatch = fleet.stopwatch
        self.random = np.random.default_rng(config.train.seed)
        self.dqn = TimedDQN(
            "MlpPolicy",
            self.env,
            learning_rate=lambda left: (
                agent.final_learning_rate + left * (agent.learning_rate - agent.final_learning_rate)
            ),
            buffer_size=agent.replay_size,
            learning_starts=agent.learning_starts,
            batch_size=agent.batch_size,
            gamma=agent.discount,
            n_steps=agent.n_step,
            train_freq=1,  # a step of all drones
            gradient_steps=agent.updates_per_step,
            # It updates its target once per step of all drones, ours once per update; the product is the same.
            tau=1 - (1 - agent.target_rate) ** agent.updates_per_step,
            target_update_interval=drones,
            exploration_fraction=agent.exploration_fraction,
            exploration_initial_eps=agent.exploration_start,
            exploration_final_eps=agent.exploration_end,
            max_grad_norm=agent.max_gradient_norm,
            policy_kwargs={"net_arch": list(agent.hidden), "optimizer_kwargs": {"fused": True}},
            seed=config.train.seed,
            device="cpu",
        )
        self.dqn.stopwatch = self.stopwatch
        self.dqn.planned = self.total - self.plan.warmup * drones

    @property
    def total(self) -> int:
        """Returns the number of decisions of the whole training."""
        return self.plan.total * self.env.num_envs

    @property
    def decisions(self) -> int:
        """Returns the number of decisions so far."""
        return self.warm + self.dqn.num_timesteps

    def trained(self) -> Trained:
        """Returns the result so far."""
        q = copy.deepcopy(self.dqn.q_net).requires_grad_(False)
        return Trained(self.config, self.learner.acting, q, self.decisions, self.seconds)

    def warm_up(self) -> None:
        """Trains the VAE on held random actions, then copies it for the agent."""
        torch.set_num_threads(self.threads)
        began = time.perf_counter()
        config, env = self.config.encoder, self.env
        env.updates = config.warmup_updates_per_step
        env.reset()
        action = self.random.integers(len(ACTIONS), size=env.num_envs)
        for _ in range(self.plan.warmup):
            new = self.random.random(env.num_envs) < 1.0 / config.hold_decisions
            action = np.where(new, self.random.integers(len(ACTIONS), size=env.num_envs), action)
            env.step(action)
        self.learner.publish()
        env.updates = 1 if config.keep_learning else 0
        self.warm += self.plan.warmup * env.num_envs
        self.seconds += time.perf_counter() - began

    def learn(self, decisions: int) -> float:
        """Trains for more decisions, rounded up to whole steps of all drones; returns decisions per second."""
        torch.set_num_threads(self.threads)
        before = self.dqn.num_timesteps
        began = time.perf_counter()
        self.dqn.learn(decisions, log_interval=None, reset_num_timesteps=before == 0)  # type: ignore[arg-type]
        seconds = time.perf_counter() - began
        self.seconds += seconds
        return (self.dqn.num_timesteps - before) / seconds

    def __enter__(self) -> Training:
        return self

    def __exit__(self, *_: object) -> None:
        self.env.close()


class Steady:
    """A training after its warm-up, for timing: the counterpart of `measurement.whole.WholeStep`. A context manager."""

    def __init__(self, config: Config, course: Course, processes: int, threads: int, camera: str = "rays") -> None:
        """Warms up, compiles, and fills the replay until updates begin; `config` must let the VAE learn throughout."""
        self.training = Training(config, course, processes, threads, camera)
        self.training.warm_up()
        self.training.learn(config.agent.learning_starts + config.train.num_envs)
        self.training.stopwatch.seconds.clear()
        self.decisions, self.seconds = 0, 0.0

    def __enter__(self) -> Steady:
        return self

    def __exit__(self, *reason: object) -> None:
        self.training.__exit__(*reason)

    def turn(self, decisions: int) -> float:
        """Trains for more decisions and returns decisions per second.

        Raises:
            RuntimeError: if the agent or the VAE did not learn from all samples that the configuration requires.
        """
        training, config = self.training, self.training.config
        before = training.dqn.num_timesteps, training.dqn._n_updates, training.learner.samples
        rate = training.learn(decisions)
        done, updates, samples = (
            now - then
            for now, then in zip(
                (training.dqn.num_timesteps, training.dqn._n_updates, training.learner.samples), before, strict=True
            )
        )
        if updates * config.train.num_envs != done * config.agent.updates_per_step or samples != done:
            raise RuntimeError("a timed turn did not learn throughout")
        self.decisions += done
        self.seconds += done / rate
        return rate

    def shares(self) -> dict[str, float]:
        """Returns the share of time of each part in this process; the rest is `stable_baselines3`."""
        spent = self.training.stopwatch.seconds
        shares = {part: spent.get(part, 0.0) / self.seconds for part in PARTS}
        return {**shares, "stable_baselines3": 1.0 - sum(shares.values())}
