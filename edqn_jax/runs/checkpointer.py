"""Checkpoints of a run while it trains, and how it is continued from one."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer, parse_layer
from edqn_jax.devices import processes
from edqn_jax.errors import ConfigError
from edqn_jax.learn import saved_state
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.step import policy_of
from edqn_jax.runs import world_copy
from edqn_jax.runs.checkpoints import states
from edqn_jax.runs.checkpoints.params import save_params
from edqn_jax.runs.checkpoints.states import Checkpoint
from edqn_jax.runs.continuation import MAY_CHANGE, option_differences
from edqn_jax.runs.directory import RunDirectory, config_text
from edqn_jax.runs.provenance import reward_record
from edqn_jax.sim.task.reward import Reward
from edqn_jax.training.loop import AgentProgress, RunProgress
from edqn_jax.training.selection import Candidate
from edqn_jax.training.setup import TrainingSetup

MAX_OVERHEAD = 0.03
"""Share of the time that saving may take: where it takes longer, checkpoints are further apart."""

_KEPT = "kept"
"""Beginning of the names of parameters that an agent keeps."""


class Checkpointer:
    """Saves checkpoints of a run every few seconds and at its end; restores them."""

    def __init__(
        self,
        preparation: TrainingSetup,
        run: RunDirectory | None,
        folders: Sequence[RunDirectory | None],
        reward: Reward | None,
        message: Callable[[str], None],
    ) -> None:
        """Keeps a run.

        Args:
            preparation: of the run.
            run: its folder, with the checkpoints; None on a process that writes nothing.
            folders: of each agent, the same one where there is one agent.
            reward: as in `train`.
            message: told of checkpoints that cannot be saved or used.
        """
        self.preparation, self.run, self.folders, self.message = preparation, run, folders, message
        self.config = preparation.config
        self.reward = reward_record(self.config, reward)
        self.resumed_at: list[int] = []
        """Decisions at which the run was continued."""
        self.seconds = 0.0
        """That saving has taken since the run was begun or continued."""
        self._saved_at, self._took = time.monotonic(), 0.0

    @property
    def facts(self) -> dict[str, Any]:
        """What `summary.json` says of interruptions and checkpoints."""
        return {"resumed_at_decisions": self.resumed_at, "checkpoint_seconds": self.seconds}

    def save_if_due(self, standing: RunProgress, last: bool) -> None:
        """Saves checkpoint and policies if it is time or `last`; every process must call this after each chunk.

        Where no checkpoints are asked for, the policies are saved at the end all the same.

        Raises:
            ConfigError: if the last one cannot be saved; of others there is a message, and the run goes on.
        """
        every = self.config.train.checkpoint_every_s
        if every == 0:
            if last:
                processes.run_synchronised(lambda: self.save_policies(standing))
            return
        if not (last or standing.healthy):
            return  # the checkpoints from before are worth more
        since = time.monotonic() - self._saved_at
        if not (last or processes.any_process(since >= max(every, self._took / MAX_OVERHEAD))):
            return
        began = time.monotonic()
        try:
            self._save(standing)
        except ConfigError as error:
            if last:
                raise
            self.message(f"no checkpoint after {self._decisions(standing):,} decisions: {error}; training goes on")
        self._saved_at = time.monotonic()
        self._took = self._saved_at - began
        self.seconds += self._took

    def restore_newest(self) -> RunProgress | None:
        """Returns where the run stood at its newest checkpoint, its files cut back to then; None if there is none.

        Every process must call this.

        Raises:
            ConfigError: if no checkpoint can be used, or it is of other options, another reward or another version.
        """
        found: list[Checkpoint | None] = [None]

        def read() -> None:
            try:
                if self.run is not None:
                    found[0] = self._read(self.run)
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                if isinstance(error, ConfigError):
                    raise
                raise ConfigError(f"a checkpoint does not hold what it must: {error!r}"[:300]) from None

        processes.run_synchronised(read)
        checkpoint = found[0]
        text = None
        if self.run is not None:
            text = json.dumps(None if checkpoint is None else checkpoint.host).encode()
        host = json.loads(processes.broadcast_from_first(text))
        if host is None:
            return None
        arrays = self._broadcast_arrays(checkpoint, host["done"])
        processes.run_synchronised(
            lambda: None if self.run is None else states.truncate_logs(self._files(), host["files"])
        )
        return self._standing(host, arrays)

    def save_policies(self, standing: RunProgress) -> None:
        """Saves the policy that each agent would end with now.

        Raises:
            ConfigError: if it cannot be written.
        """
        policies = standing.policies(self.preparation.trainer, self.preparation.configs)
        for folder, policy in zip(self.folders, policies, strict=True):
            if folder is not None:
                save_params(folder.checkpoints, policy, folder.config_file)

    def _save(self, standing: RunProgress) -> None:
        arrays = saved_state.to_host(self.preparation.trainer, standing.state, standing.done)

        def write() -> None:
            if self.run is None:
                return
            kept = _named_kept([agent.kept.params for agent in standing.agents])
            checkpoint = Checkpoint(
                arrays={name: array for name, array in {**arrays, **kept}.items() if array.size},
                host=self._host(standing),
                config=config_text(self.config),
                facts={**states.checkpoint_versions(), "reward": json.dumps(self.reward, sort_keys=True)},
            )
            states.save_checkpoint(self.run.checkpoints, standing.done, checkpoint, self.config.train.checkpoints)
            self.save_policies(standing)

        processes.run_synchronised(write)

    def _host(self, standing: RunProgress) -> dict[str, Any]:
        assert self.run is not None
        try:
            files = states.log_digests(self._files())
        except OSError as error:
            raise ConfigError(f"a file of the run in '{self.run.path}' cannot be read: {error.strerror}") from None
        agents = [
            {
                "episodes": agent.episodes,
                "validations": agent.validations,
                **{name: getattr(agent.kept, name) for name in _scores()},
            }
            for agent in standing.agents
        ]
        return {
            "done": standing.done,
            "checked": standing.checked,
            "train_seconds": standing.train_seconds,
            "elapsed_s": standing.elapsed_s,
            "resumed_at": self.resumed_at,
            "agents": agents,
            "files": files,
        }

    def _files(self) -> dict[str, Any]:
        """Returns the run's growing files by their names in its folder."""
        assert self.run is not None
        files = [file for folder in self.folders if folder for file in (folder.metrics_file, folder.episodes_file)]
        return {str(file.relative_to(self.run.path)): file for file in files}

    def _read(self, run: RunDirectory) -> Checkpoint | None:
        """Returns the newest checkpoint that is undamaged, if this run can go on from it.

        Raises:
            ConfigError: if it is of another version or reward, or its arrays are not those that the run needs.
        """
        states.remove_partials(run.checkpoints)

        def usable(checkpoint: Checkpoint) -> None:
            states.check_log_prefix(self._files(), checkpoint.host["files"])

        checkpoint = states.newest_checkpoint(run.checkpoints, usable, self.message)
        if checkpoint is None:
            return None
        world_copy.check_unchanged(run.path, self.config)
        where = f"the checkpoint in '{checkpoint.file}'"
        wrote, here = checkpoint.facts.get("edqn_jax"), states.checkpoint_versions()
        if wrote != here["edqn_jax"]:
            raise ConfigError(
                f"{where} was saved by edqn_jax {wrote}, which edqn_jax {here['edqn_jax']} cannot continue; use that "
                "version, or --resume never"
            )
        if checkpoint.facts.get("jax") != here["jax"]:
            self.message(f"jax is {here['jax']} and was {checkpoint.facts.get('jax')}: rounding may differ")
        own = apply_layer(Config(), parse_layer(checkpoint.config, where), where)
        differ = [name for name in option_differences(own, self.config) if name not in MAY_CHANGE]
        if differ:
            raise ConfigError(f"{where} is of a run with other options: {', '.join(differ)}")
        rewarded = json.loads(checkpoint.facts.get("reward", "null"))
        if rewarded != self.reward:
            raise ConfigError(
                f"{where} was trained with the reward {_reward_label(rewarded)}, not with {_reward_label(self.reward)};"
                " a run goes on with its own reward"
            )
        found = {name: (array.shape, str(array.dtype)) for name, array in checkpoint.arrays.items()}
        try:
            saved_state.check_shapes(found, self._checkpoint_arrays(checkpoint.host["done"]))
        except ConfigError as error:
            raise ConfigError(f"{where} does not fit the run: {error}") from None
        return checkpoint

    def _checkpoint_arrays(self, done: int) -> dict[str, saved_state.Shape]:
        """Returns the arrays of a checkpoint after `done` steps; empty ones are not saved."""
        of_state = saved_state.state_shapes(self.preparation.trainer, done)
        kept = {name: (array.shape, str(array.dtype)) for name, array in _named_kept(self._fresh()).items()}
        return {name: shape for name, shape in {**of_state, **kept}.items() if 0 not in shape[0]}

    def _fresh(self) -> list[PolicyParams]:
        """Returns parameters of the right shapes for each agent, on the host."""
        trainer = self.preparation.trainer
        whole = policy_of(self.preparation.config, trainer.shapes())
        zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), whole)
        return trainer.each(zeros)

    def _broadcast_arrays(self, checkpoint: Checkpoint | None, done: int) -> dict[str, np.ndarray]:
        """Returns the arrays of process 0's checkpoint, on every process; empty ones are made anew."""
        of_state = saved_state.state_shapes(self.preparation.trainer, done)
        arrays = {name: np.zeros(shape, kind) for name, (shape, kind) in of_state.items() if 0 in shape}
        for name, (shape, kind) in self._checkpoint_arrays(done).items():
            held = None if checkpoint is None else checkpoint.arrays[name].tobytes()
            arrays[name] = np.frombuffer(processes.broadcast_from_first(held), kind).reshape(shape)
        return arrays

    def _standing(self, host: dict[str, Any], arrays: dict[str, np.ndarray]) -> RunProgress:
        kept = [
            jax.tree_util.tree_map_with_path(
                lambda path, leaf, n=n: arrays.get(agent_array_name(n, path), leaf), params
            )
            for n, params in enumerate(self._fresh())
        ]
        agents = [
            AgentProgress(
                kept=Candidate(
                    params, **{name: agent[name] for name in _scores() if name in agent or name not in _NOT_IN_OLDER}
                ),
                episodes=agent["episodes"],
                validations=[(found[0], found[1], found[2]) for found in agent["validations"]],
            )
            for params, agent in zip(kept, host["agents"], strict=True)
        ]
        self.resumed_at = [*host["resumed_at"], host["done"] * self.config.train.num_envs]
        return RunProgress(
            state=saved_state.from_host(self.preparation.trainer, arrays),
            done=host["done"],
            checked=host["checked"],
            train_seconds=host["train_seconds"],
            elapsed_s=host["elapsed_s"],
            agents=agents,
        )

    def _decisions(self, standing: RunProgress) -> int:
        return standing.done * self.config.train.num_envs


_NOT_IN_OLDER = {"timed_out"}
"""Scores that checkpoints of older runs do not have."""


def _scores() -> list[str]:
    """Returns the names of the scores that are saved with kept parameters."""
    return [field.name for field in dataclasses.fields(Candidate) if field.name != "params"]


def _named_kept(agents: Sequence[PolicyParams]) -> dict[str, np.ndarray]:
    return {
        agent_array_name(number, path): np.asarray(leaf)
        for number, params in enumerate(agents)
        for path, leaf in jax.tree_util.tree_leaves_with_path(params)
    }


def agent_array_name(agent: int, path: Any) -> str:
    """Returns the name in a checkpoint of an array of the parameters that an agent keeps."""
    return f"{_KEPT}[{agent}]{jax.tree_util.keystr(path)}"


def _reward_label(record: dict[str, str | None] | None) -> str:
    """Returns a reward's name as text, with the beginning of its digest."""
    if record is None:
        return "that it does not name"
    digest = record.get("source_sha256")
    return f"'{record.get('name')}'" + (f" ({digest[:8]})" if digest else "")
