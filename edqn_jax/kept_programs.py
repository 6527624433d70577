"""Programs that a command compiled, loaded by a later one without being traced.

JAX's own cache is asked with a traced program, and tracing is most of what a second run would wait for. Here a program
is found by what it is traced from: the configuration, shapes and layout of its arguments, the package's sources, and
versions and settings of what traces and compiles it. With code of users in the process nothing is kept, since that is
not among them.

The files hold pickles, so nobody else can write in their folder (`cache.private_folder`), as in that of JAX's cache.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import os
import pickle
import platform
import threading
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import serialize_executable

from edqn_jax import user_code
from edqn_jax.config import Config, registry
from edqn_jax.devices.cache import enabled_folder
from edqn_jax.devices.kept_files import name_of, read_kept, write_kept
from edqn_jax.native import build, shipped
from edqn_jax.native.own_programs import own_program
from edqn_jax.native.threefry import draw_own_in_c
from edqn_jax.registries import Registry

Given = ParamSpec("Given")
Returned = TypeVar("Returned")

PACKAGE = Path(__file__).parent

SOURCES = (".c", ".cu", ".h", ".py")

DEPENDENCIES = ("flax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "optax")


_had: dict[Path, list[jax.stages.Compiled]] = {}  # what `Place.load_or_compile` has returned


@dataclasses.dataclass(frozen=True)
class Place:
    """Where programs are found that belong together. They lie beside it, by what XLA compiles them from.

    So what one configuration or version of the package has compiled is found by another that leads to the same program.
    """

    file: Path | None
    """None if they are not kept."""

    def holds_programs(self) -> bool:
        """Returns whether `load_or_compile` need not trace, unless what is found here cannot be loaded."""
        return self.file is not None and (self.file in _had or self.file.is_file())

    def load(self) -> list[jax.stages.Compiled] | None:
        """Returns the programs; None if there are none, or they cannot be loaded, and are to be compiled."""
        content = None if self.file is None else read_kept(self.file)
        if content is None or self.file is None:
            return None
        try:
            libraries, programs = pickle.loads(content)
        except Exception:  # whatever is wrong with what another version has written, they are compiled
            return None
        if not all(build.ensure_registered(*_arguments(library)) for library in libraries):
            return None
        loaded = [_load(self.file.parent / name, *others) for name, *others in programs]
        found = [each for each in loaded if each is not None]
        return found if len(found) == len(loaded) else None

    @property
    def name(self) -> str | None:
        """Name for the functions of its programs, see `named`; None if they are not kept."""
        return None if self.file is None else f"kept_{self.file.name.partition('-')[0]}"

    def load_or_compile(
        self,
        trace: Callable[[], Sequence[jax.stages.Lowered]],
        devices: Sequence[Any],
        options: dict[str, str | bool] | None = None,
    ) -> list[jax.stages.Compiled]:
        """Returns the programs as `load`, or as `compile` does those that `trace` returns; the same ones later on."""
        if self.file is None:
            return self.compile(trace(), devices, options)
        if self.file not in _had:
            _had[self.file] = self.load() or self.compile(trace(), devices, options)
        return _had[self.file]

    def compile(
        self,
        traced: Sequence[jax.stages.Lowered],
        devices: Sequence[Any],
        options: dict[str, str | bool] | None = None,
    ) -> list[jax.stages.Compiled]:
        """Compiles programs for these devices, unless the same were compiled before, and keeps them if possible.

        Args:
            traced: each of them.
            devices: on which they run.
            options: of the compiler.
        """
        if self.file is None:
            return [each.compile(options) for each in traced]
        numbers, compiled, found = [device.id for device in devices], [], []
        for each in traced:
            infos, form = jax.tree.flatten(each.args_info)
            trees = form, each.out_tree
            # Arguments that are not used are not in the text, and yet must be those that the program was made for.
            called = str((trees, [(info.shape, info.dtype, info.donated) for info in infos]))
            texts = each.as_text(), called, repr((sorted((options or {}).items()), numbers)), *_surroundings()
            name = f"{name_of(*(text.encode() for text in texts))}.executable"
            program = _load(self.file.parent / name, *trees, numbers)
            if program is None:
                program = self._compile_and_keep(self.file.parent / name, each, options)
            compiled.append(program)
            found.append((name, *trees, numbers))
        if not all((self.file.parent / name).is_file() for name, *_ in found):
            return compiled
        with contextlib.suppress(Exception):  # of trees that hold what cannot be pickled
            write_kept(self.file, pickle.dumps((build.used_libraries(), found)))
        return compiled

    def _compile_and_keep(
        self, file: Path, traced: jax.stages.Lowered, options: dict[str, str | bool] | None
    ) -> jax.stages.Compiled:
        hits = _hits_of_thread()
        compiled = traced.compile(options)
        was_kept_by_jax = _hits_of_thread() > hits  # see `named`
        if not was_kept_by_jax:
            with contextlib.suppress(Exception):  # such as of a program that calls Python
                write_kept(file, serialize_executable.serialize(compiled)[0])
        # Left to JAX, a program would be traced in every run once its file here is not found: after an update, say.
        if was_kept_by_jax or file.is_file():
            with contextlib.suppress(OSError):  # where nothing can be deleted any more
                for copy in file.parent.glob(f"jit_{self.name}-*"):
                    copy.unlink(missing_ok=True)
        return compiled


def named(function: Callable[Given, Returned], name: str | None) -> Callable[Given, Returned]:
    """Returns a function with the name of its place, if its programs are kept.

    JAX's cache tells programs apart by it; and one that XLA has loaded from there it writes without its functions,
    so that it could be run and not kept. So nothing stays in JAX's cache under these names.
    """
    if name is None:
        return function

    def kept(*args: Given.args, **kwargs: Given.kwargs) -> Returned:
        return function(*args, **kwargs)

    kept.__name__ = name
    return kept


def _load(file: Path, in_tree: Any, out_tree: Any, numbers: Sequence[int]) -> jax.stages.Compiled | None:
    content, devices = read_kept(file), jax.devices()
    if content is None:
        return None
    try:
        on = [devices[number] for number in numbers]
        return serialize_executable.deserialize_and_load(content, in_tree, out_tree, execution_devices=on)
    except Exception:  # as in `Place.load`
        return None


_of_thread = threading.local()


def _hits_of_thread() -> int:
    """Returns how many programs this thread has had from JAX's cache since it was first asked."""
    _listen()
    return getattr(_of_thread, "hits", 0)


@functools.cache
def _listen() -> None:
    def count(event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            _of_thread.hits = getattr(_of_thread, "hits", 0) + 1

    jax.monitoring.register_event_listener(count)


class KeptFunction(Generic[Returned]):
    """A function as `jax.jit` makes it; where a command keeps programs, it is loaded without being traced."""

    def __init__(self, function: Callable[..., Returned], static_argnums: tuple[int, ...]) -> None:
        functools.update_wrapper(self, function)
        self._static, self._signature = static_argnums, inspect.signature(function)
        self._function, self._traced = function, jax.jit(function, static_argnums=static_argnums)
        self._compiled: dict[Any, jax.stages.Compiled] = {}
        self._compiling: dict[Any, threading.Lock] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Returned:
        bound = self._signature.bind(*args, **kwargs)
        bound.apply_defaults()
        args = bound.args  # one program, however the arguments are given
        given = [arg for number, arg in enumerate(args) if number not in self._static]
        leaves, form = jax.tree.flatten(given)
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return self._traced(*args)
        draw_own_in_c()
        if enabled_folder() is None:
            with own_program():
                return self._traced(*args)
        static = tuple(arg for number, arg in enumerate(args) if number in self._static)
        told_apart = static, form, tuple(map(_kind_of, leaves))
        compiled = self._compiled.get(told_apart) or self._compile(told_apart, static, given, args)
        return compiled(*given)

    def _compile(self, told_apart: Any, static: Any, given: Any, args: Any) -> jax.stages.Compiled:
        # A program is compiled once, and several are at once.
        with self._compiling.setdefault(told_apart, threading.Lock()):
            if told_apart not in self._compiled:
                place = place_of(self._function.__name__.strip("_"), (self.__module__, self._static, static), given)
                function = jax.jit(named(self._function, place.name), static_argnums=self._static)
                devices = {device for leaf in jax.tree.leaves(given) for device in getattr(leaf, "devices", set)()}
                on = sorted(devices, key=lambda device: device.id) or jax.local_devices()[:1]
                with own_program():
                    [self._compiled[told_apart]] = place.load_or_compile(lambda: [function.lower(*args)], on)
            return self._compiled[told_apart]


def kept_jit(*static_argnums: int) -> Callable[[Callable[..., Returned]], KeptFunction[Returned]]:
    """Returns a decorator like `jax.jit`, for what every command computes a few times.

    Args:
        static_argnums: places of arguments that are static, told apart by their `repr`.
    """
    return lambda function: KeptFunction(function, static_argnums)


def place_of(name: str, made_of: object, arguments: Any) -> Place:
    """Returns where programs are kept.

    Args:
        name: of the programs.
        made_of: what they are traced from beside their arguments; its `repr` tells it apart.
        arguments: of the first, arrays or their shapes in a tree.
    """
    folder = folder_without_user_code()
    if folder is None or jax.default_backend() != "cpu" or jax.process_count() > 1:
        return Place(None)  # what GPUs load has not been tried
    leaves, form = jax.tree.flatten(arguments)
    parts = [name, repr(made_of), str(form), *map(_shape_of, leaves)]
    if any(" at 0x" in part for part in parts):  # an object that nothing but its address tells apart
        return Place(None)
    parts += [digest_of_package(), str(PACKAGE), *_surroundings()]
    return Place(folder / f"{name}-{name_of(*(part.encode() for part in parts))}.program")


def without_seed(config: Config) -> Config:
    """Returns a configuration whose programs are those of all seeds, which are arguments of what is traced."""
    return dataclasses.replace(config, train=dataclasses.replace(config.train, seed=0))


def folder_without_user_code() -> Path | None:
    """Returns the folder in which a command keeps what the package alone computes; None if nothing is kept."""
    own = (entries.own for entries in vars(registry).values() if isinstance(entries, Registry))
    return None if user_code.IMPORTED or any(own) else enabled_folder()


def _kind_of(leaf: Any) -> Any:
    """Returns what tells an argument apart within a process, sooner than `_shape_of`."""
    if isinstance(leaf, jax.Array):
        return leaf.aval, leaf.sharding
    return (leaf.shape, leaf.dtype) if isinstance(leaf, np.ndarray | np.generic) else type(leaf)


def _shape_of(leaf: Any) -> str:
    kind = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
    return f"{kind.dtype}{kind.shape} {kind.weak_type} {getattr(leaf, 'sharding', None)}"


def _arguments(library: build.Library) -> tuple[Any, ...]:
    return tuple(getattr(library, field.name) for field in dataclasses.fields(library))


def _surroundings() -> tuple[str]:
    """Returns what decides how programs are compiled, and how they are traced beside the package's sources."""
    settings = {name: value for name, value in os.environ.items() if name.startswith(("JAX_", "XLA_"))}
    compilers = [build.compiler_version(), os.environ.get(shipped.SWITCH)]
    devices = [(device.platform, device.device_kind, device.id) for device in jax.devices()]
    return (repr((sorted(settings.items()), compilers, devices, versions())),)


@functools.cache
def versions() -> list[str]:
    """Returns the versions of Python and of the libraries that compute."""
    return [platform.python_version(), *map(metadata.version, DEPENDENCIES)]


@functools.cache
def digest_of_package() -> str:
    """Returns what tells apart the sources of the package."""
    files = sorted(file for file in PACKAGE.rglob("*") if file.suffix in SOURCES)
    return hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)).hexdigest()
