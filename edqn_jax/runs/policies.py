"""Loading a saved run: its configuration and its policy."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer, load_layer
from edqn_jax.config.rules import validate
from edqn_jax.devices.forks import check_not_forked
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_make, write_atomically
from edqn_jax.learn.policy import Policy, PolicyParams, fresh_policy
from edqn_jax.policies import function_named, no_run, policy_folder
from edqn_jax.policies.functions import FunctionPolicy, as_policy, check_has_params, config_of, load_function
from edqn_jax.runs import world_copy
from edqn_jax.runs.checkpoints.params import load_params, policy_file, save_params
from edqn_jax.runs.checkpoints.sealed import file_digest
from edqn_jax.runs.directory import SEED_FOLDER, config_text, version_of
from edqn_jax.version import package_version


@as_tested
def load_policy(run: str | Path) -> Policy:
    """Returns the policy of a run directory, of a folder that `save_policy` wrote, or `pretrained`.

    Raises:
        ConfigError: if there is none, or its parts are incomplete or do not fit each other.
    """
    return Policy(*load_run(Path(run)))


def find_policy(name: str | Path, world: str | Path | None = None) -> Policy | FunctionPolicy:
    """Returns the policy that a command names: one that `load_policy` loads, or a function.

    Args:
        name: as `load_policy`, or `module:name` or `path/to/file.py:name` of a function.
        world: where it will fly, whose default configuration a function has that brings none.

    Raises:
        ConfigError: as `load_policy`, or if the function does not load.
    """
    if function_named(name) is None:
        return load_policy(name)
    return as_policy(load_function(str(name)), world)


def find_config(name: str | Path, world: str | Path | None = None) -> Config:
    """Returns the configuration of the policy that a command names, whose parameters are not looked at.

    Args:
        name: as `find_policy`.
        world: likewise.

    Raises:
        ConfigError: if there is none, or its configuration is not one.
    """
    if function_named(name) is not None:
        return config_of(find_policy(name, world))
    folder, file = _folder_of(Path(name))
    policy_file(folder / "checkpoints")
    return world_copy.with_copied_worlds(folder, _config_in(file))[0]


@as_tested
def save_policy(policy: Policy, folder: str | Path) -> None:
    """Writes a policy into `folder`, for `load_policy` and `edqn evaluate`; the folder must be new or empty.

    Raises:
        ConfigError: if the folder holds files already, or cannot be written, or the policy is a function.
    """
    check_has_params(policy, "save_policy")
    folder = Path(folder)
    check_can_make(folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise ConfigError(f"'{folder}' holds files already; give a new or empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "config.yaml", config_text(policy.config))
    save_params(folder / "checkpoints", policy.params, folder / "config.yaml")


def load_run(folder: Path) -> tuple[Config, PolicyParams]:
    """Returns the configuration and the policy of a run, or of any folder with `config.yaml` and `checkpoints/`.

    Where the file of its world is missing or another one now, the configuration names the run's own copy.

    Args:
        folder: of the run, or the name of a policy that comes with the package.

    Raises:
        ConfigError: if there is none, or its parts are incomplete, do not match, or do not fit this version, or
            the process was forked after JAX had been used.
    """
    check_not_forked()
    folder, file = _folder_of(folder)
    try:
        return _loaded(folder, file)
    except ConfigError as error:
        writer, here = version_of(file), package_version()
        if writer in (None, here):
            raise
        raise ConfigError(
            f"the policy in '{folder}' was saved by edqn_jax {writer} and does not fit edqn_jax {here}: {error}"
        ) from None


def _folder_of(name: Path) -> tuple[Path, Path]:
    """Returns the folder of a policy, and the file of its configuration.

    Raises:
        ConfigError: if there is none, or the folder holds the runs of several seeds.
    """
    folder = policy_folder(name)
    file = folder / "config.yaml"
    if not file.is_file():
        raise no_run(folder)
    seeds = sorted(folder.glob(f"{SEED_FOLDER}*/"))
    if seeds:
        raise ConfigError(f"'{folder}' holds the runs of {len(seeds)} seeds; name one of them, such as '{seeds[0]}'")
    return folder, file


def _config_in(file: Path) -> Config:
    layer = load_layer(file)
    if not layer:
        raise ConfigError(f"'{file}' is empty: it does not say what the policy beside it is")
    config = apply_layer(Config(), layer, str(file))
    validate(config, trains=False)
    return config


def _loaded(folder: Path, file: Path) -> tuple[Config, PolicyParams]:
    config = _config_in(file)
    params = load_params(folder / "checkpoints", file)
    fresh = jax.eval_shape(lambda: fresh_policy(config))
    if _shapes(params) != _shapes(fresh):
        raise ConfigError(
            f"the policy in '{folder}' does not have the shapes that its config.yaml asks for in edqn_jax "
            f"{package_version()}; fly it with the version that trained it, or train it anew"
        )
    return world_copy.with_copied_worlds(folder, config)[0], params


def worlds_replaced(run: Path) -> list[str]:
    """Returns a sentence for each world that is replaced by the run's own copy; none for a function.

    Raises:
        ConfigError: if the run's configuration or its copies are damaged.
    """
    if function_named(run) is not None:
        return []
    folder = policy_folder(run)
    config = apply_layer(Config(), load_layer(folder / "config.yaml"), str(folder / "config.yaml"))
    return world_copy.with_copied_worlds(folder, config)[1]


def policy_digest(run: Path) -> str:
    """Returns the SHA-256 of a policy's file.

    Raises:
        ConfigError: if there is no policy.
    """
    return file_digest(policy_file(policy_folder(run) / "checkpoints"))


def _shapes(params: PolicyParams) -> PolicyParams:
    return jax.tree.map(np.shape, params)
