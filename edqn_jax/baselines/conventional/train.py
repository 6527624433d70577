"""stable-baselines3's DQN on all drones, and how fast it is.

What the agent is: DQN with 128 x 128 ReLU units, n-step returns, a Huber loss, Adam and a Polyak-averaged target, at
the sizes and rates of the configuration. Where ours goes beyond what stable-baselines3 has (double and dueling
DQN), this one does not follow.
"""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

from edqn_jax.baselines.conventional import world
from edqn_jax.baselines.conventional.fleet import Course
from edqn_jax.baselines.conventional.stopwatch import Stopwatch
from edqn_jax.baselines.conventional.vae import Learner
from edqn_jax.baselines.conventional.vec_env import CodedDrones
from edqn_jax.baselines.conventional.workers import SpreadFleet
from edqn_jax.baselines.planner import require
from edqn_jax.config import DENSITIES, Config, ConfigError
from edqn_jax.sim.env import ACTIONS
from edqn_jax.sim.mjcf import check_scene, load_world, resolve_world
from edqn_jax.sim.scene import stack_scenes
from edqn_jax.sim.worlds import spread_missions

torch = require("torch")
stable_baselines3 = require("stable_baselines3")

PARTS = (
    "physics",
    "outcome",
    "rays",
    "shading",
    "events",
    "waiting",
    "encoder",
    "vae_update",
    "acting",
    "dqn_update",
)
"""What is timed apart; the rest of the time is stable-baselines3's own."""


def training_course(config: Config) -> Course:
    """The training missions of `python train.py` on a world from a file.

    Raises:
        ConfigError: if the world is a random one, or cannot be flown in.
    """
    name = config.world.name
    if name in DENSITIES:
        raise ConfigError(f"the conventional stack flies in one world; give 'paper' or an MJCF file, not '{name}'")
    loaded = load_world(resolve_world(name))
    check_scene(loaded.scene, config.drone.body_radius_m, names=loaded.names, title=f"'{name}'")
    key = jax.random.fold_in(jax.random.key(config.train.seed), 1)
    own, jitter = config.world.own_start_fraction, config.world.start_jitter_m
    missions = spread_missions(stack_scenes([loaded.scene]), config.world.missions, own, jitter, key)
    start, goal = (np.asarray(points, np.float64) for points in (missions.start, missions.goal))
    return Course(mjcf=world.text_of(loaded.scene), start=start, goal=goal)


class TimedDQN(stable_baselines3.DQN):
    """stable-baselines3's DQN; what it does itself is timed apart from what it calls."""

    stopwatch: Stopwatch

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """The DQN's updates."""
        with self.stopwatch.time("dqn_update"):
            super().train(gradient_steps, batch_size)

    def _sample_action(self, *args: Any, **kwargs: Any) -> Any:
        with self.stopwatch.time("acting"):
            return super()._sample_action(*args, **kwargs)


class Training:
    """Drones, VAE and DQN as `config` has them; a context, at whose end its other processes end."""

    def __init__(self, config: Config, course: Course, processes: int = 1, threads: int = 1) -> None:
        """`config.train.num_envs` drones in so many processes, PyTorch with so many threads.

        Raises:
            ConfigError: where the configuration asks for what this stack does not have.
            ValueError: if the drones do not divide into the processes.
        """
        agent, drones = config.agent, config.train.num_envs
        self.config, self.processes, self.threads = config, processes, threads
        fleet = SpreadFleet(config, course, drones, processes, config.train.seed)
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
            # It moves its target once a step of all drones, ours once an update: the same way in all.
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

    def warm_up(self) -> None:
        """Held random manoeuvres in which the VAE learns; then its code is the agent's."""
        torch.set_num_threads(self.threads)
        config, env = self.config.encoder, self.env
        env.updates = config.warmup_updates_per_step
        env.reset()
        action = self.random.integers(len(ACTIONS), size=env.num_envs)
        for _ in range(-(-config.warmup_decisions // env.num_envs)):
            new = self.random.random(env.num_envs) < 1.0 / config.hold_decisions
            action = np.where(new, self.random.integers(len(ACTIONS), size=env.num_envs), action)
            env.step(action)
        self.learner.publish()
        env.updates = 1 if config.keep_learning else 0

    def learn(self, decisions: int) -> float:
        """So many more decisions, rounded up to whole steps of all drones; decisions per second."""
        torch.set_num_threads(self.threads)
        before = self.dqn.num_timesteps
        began = time.perf_counter()
        self.dqn.learn(decisions, log_interval=None, reset_num_timesteps=before == 0)  # type: ignore[arg-type]
        return (self.dqn.num_timesteps - before) / (time.perf_counter() - began)

    def __enter__(self) -> Training:
        return self

    def __exit__(self, *_: object) -> None:
        self.env.close()


class Steady:
    """A training past its beginning, to be timed turn by turn: the counterpart of `benchmarks/whole.py`. A context."""

    def __init__(self, config: Config, course: Course, processes: int, threads: int) -> None:
        """Warms up, compiles, and fills the replay until updates begin. `config` has the VAE learn throughout."""
        self.training = Training(config, course, processes, threads)
        self.training.warm_up()
        self.training.learn(config.agent.learning_starts + config.train.num_envs)
        self.training.stopwatch.seconds.clear()
        self.decisions, self.seconds = 0, 0.0

    def __enter__(self) -> Steady:
        return self

    def __exit__(self, *reason: object) -> None:
        self.training.__exit__(*reason)

    def turn(self, decisions: int) -> float:
        """Decisions per second of so many more.

        Raises:
            RuntimeError: if the agent or the VAE did not learn from as many samples as the configuration says.
        """
        training, config = self.training, self.training.config
        before = training.dqn.num_timesteps, training.dqn._n_updates, training.learner.samples
        rate = training.learn(decisions)
        done, updates, seen = (
            now - then
            for now, then in zip(
                (training.dqn.num_timesteps, training.dqn._n_updates, training.learner.samples), before, strict=True
            )
        )
        if updates * config.train.num_envs != done * config.agent.updates_per_step or seen != done:
            raise RuntimeError("a timed turn did not learn throughout")
        self.decisions += done
        self.seconds += done / rate
        return rate

    def shares(self) -> dict[str, float]:
        """Share of all turns' time by part, of this process; what is left is `stable_baselines3`."""
        spent = self.training.stopwatch.seconds
        shares = {part: spent.get(part, 0.0) / self.seconds for part in PARTS}
        return {**shares, "stable_baselines3": 1.0 - sum(shares.values())}
