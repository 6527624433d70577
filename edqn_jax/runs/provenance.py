"""Provenance of a run or a measured figure: workload, versions, digest of the state, reward."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import platform
import re
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.devices import processes
from edqn_jax.learn.perception.embedding import has_code
from edqn_jax.learn.state import TrainState
from edqn_jax.native import build
from edqn_jax.native.products import precision_of
from edqn_jax.sim.scene.scene import Scene, obstacle_count
from edqn_jax.sim.sensors.sensor import frames_per_decision
from edqn_jax.sim.task.reward import Reward


def describe_workload(config: Config, scene: Scene) -> dict[str, Any]:
    """Returns the workload that a figure was measured for, as in the JSON of runs and benchmarks."""
    agent, envs = config.agent, config.train.num_envs
    return {
        "physics_steps_per_decision": config.drone.physics_steps,
        "physics_dt": config.drone.physics_dt_s,
        "width": config.camera.width,
        "height": config.camera.height,
        "sensor": config.env.sensor,
        "frames_per_decision": frames_per_decision(config),
        "obstacles": obstacle_count(scene),
        "replayed_samples_per_decision": agent.batch_size * agent.updates_per_step / envs,
        "vae_samples_per_decision": (
            config.encoder.batch_size / envs if config.encoder.keep_learning and has_code(config) else 0.0
        ),
        "num_envs": envs,
        "products": precision_of(config.train.products),
        "physics": config.drone.physics,
    }


def package_versions() -> dict[str, str]:
    """Returns the versions of Python, of packages, and of the compilers of C, that figures depend on."""
    names = ("jax", "mujoco", "mujoco-mjx", "flax", "optax", "numpy")
    packages = {name: metadata.version(name) for name in names}
    cuda = build.cuda_compiler()
    compilers = {"C compiler": build.C} | ({} if cuda is None else {"CUDA compiler": cuda})
    in_c = {name: build.compiler_version(each) or "none" for name, each in compilers.items()}
    return {"python": platform.python_version(), **packages, **in_c}


def state_digest(state: TrainState) -> str:
    """Returns the SHA-256 of the train state's leaves in pytree order; every process must call this."""
    leaves = (
        jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        for leaf in jax.tree.leaves(state)
    )
    return digest_of(np.asarray(processes.fetch_global(leaf)) for leaf in leaves)


def digest_of(arrays: Iterable[np.ndarray]) -> str:
    """Returns the SHA-256 of arrays with their shapes and types, in this order."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def reward_record(config: Config, reward: Reward | None) -> dict[str, str | None]:
    """Returns a reward's name, and for a reward function also what `source_record` does.

    The digest is None for the configured rewards.
    """
    if reward is None:
        return {"name": config.env.reward, "source_sha256": None}
    return source_record(reward)


def source_record(function: Any) -> dict[str, str | None]:
    """Returns a function's name, and the SHA-256 of its source and of the values bound to it.

    Bound are the arguments of a `functools.partial`, defaults, variables of an enclosing function, and the attributes
    of an object that is called or whose method is. The digest is None where Python cannot find the source.
    """
    name, digest = type(function).__qualname__, None
    # Attributes and `repr` of foreign objects may raise anything; a run must not end without its summary for that.
    with contextlib.suppress(Exception):
        name = _name(function)
        digest = hashlib.sha256("".join(_parts(function)).encode()).hexdigest()
    return {"name": name, "source_sha256": digest}


def _name(reward: Any) -> str:
    """Returns the name of a reward function; of a lambda, also where it stands."""
    inner = reward.func if isinstance(reward, functools.partial) else _unwrap(reward)
    if inner is not reward:
        return _name(inner)
    name = getattr(reward, "__qualname__", None)
    if not isinstance(name, str):
        return type(reward).__qualname__
    code = getattr(reward, "__code__", None)
    if code is not None and name.endswith("<lambda>"):
        return f"{name} ({Path(code.co_filename).name}:{code.co_firstlineno})"
    return name


def _parts(reward: Any) -> Iterator[str]:
    """Yields the source of a reward function, and what is bound to it.

    Raises:
        OSError, TypeError: if Python cannot find the source.
    """
    reward = _unwrap(reward)
    if isinstance(reward, functools.partial):
        yield from _parts(reward.func)
        yield _text((reward.args, sorted(reward.keywords.items())))
    elif inspect.isfunction(reward):
        yield inspect.getsource(reward)
        bound = [cell.cell_contents for cell in reward.__closure__ or ()]
        bound += [*(reward.__defaults__ or ()), *sorted((reward.__kwdefaults__ or {}).items())]
        if bound:
            yield _text(bound)
    elif inspect.ismethod(reward):
        yield reward.__name__
        yield from _parts_of_object(reward.__self__)
    else:
        yield from _parts_of_object(reward)


def _parts_of_object(thing: Any) -> Iterator[str]:
    """Yields the source of an object's class, or of a class, and the object's attributes."""
    if isinstance(thing, type):
        yield inspect.getsource(thing)
        return
    yield inspect.getsource(type(thing))
    attributes = getattr(thing, "__dict__", {})
    if attributes:
        yield _text(sorted(attributes.items()))


def _unwrap(reward: Any) -> Any:
    """Returns the function that `jax.jit` or another decorator wraps."""
    try:
        return inspect.unwrap(reward)
    except ValueError:  # wrapped by itself
        return reward


def _text(bound: Any) -> str:
    """Returns values as text that is the same in every process; arrays in full."""
    leaves, tree = jax.tree.flatten(bound)
    arrays = [x for x in leaves if isinstance(x, np.ndarray | jax.Array)]
    texts = [f"{x.dtype}{x.shape}{np.asarray(x).tobytes().hex()}" for x in arrays]
    others = [repr(x) for x in leaves if not isinstance(x, np.ndarray | jax.Array)]
    return re.sub(r" at 0x[0-9a-fA-F]+", "", f"{tree}{others}") + "".join(texts)
