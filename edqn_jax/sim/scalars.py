"""Evaluates functions of small arrays number by number, so that XLA fuses them into a few loops.

A function as MJX has them cuts, joins, turns and multiplies arrays of a few numbers. XLA:CPU gives most of these steps
a loop of their own, and mapped over environments each costs a microsecond, however little it does. Here the function is
traced once and evaluated again with every number of its arrays an array of its own. To cut and to join then costs
nothing, what is left is arithmetic of whole rows of environments, which is fused, and what constants make known
beforehand (products with zeros and ones, above all) is not computed.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal

Numbers = np.ndarray
"""Constants in their own dtype; or objects, each a constant or a traced array []."""

_CALLS = frozenset({"jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"})


def number_by_number(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns `function` evaluated number by number: the same results to rounding.

    NaN and infinity times a constant 0 are 0.

    Args:
        function: of arrays of fixed shapes, to a pytree of arrays, without loops, branches and random numbers.
            Where it reads or writes at an index, that is known when tracing, and within bounds where it reads.

    Raises:
        NotImplementedError: when called, if the function does something else.
    """

    def evaluated(*arguments: Any) -> Any:
        jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        results = _evaluated(jaxpr, [_apart(leaf) for leaf in jax.tree.leaves(arguments)])
        leaves, tree = jax.tree.flatten(shape)
        return jax.tree.unflatten(tree, [_joined(*each) for each in zip(results, leaves, strict=True)])

    return evaluated


def _apart(array: Any) -> Numbers:
    if not isinstance(array, Tracer):
        return np.asarray(array)
    parts = np.empty(array.shape, object)
    for index in np.ndindex(array.shape):
        parts[index] = array[index]
    return parts


def _joined(numbers: Numbers, like: jax.ShapeDtypeStruct) -> Array:
    if not _traced(numbers):
        return jnp.asarray(numbers, like.dtype)
    return jnp.stack([jnp.asarray(number, like.dtype) for number in numbers.flat]).reshape(like.shape)


def _traced(numbers: Numbers) -> bool:
    return numbers.dtype == object


def _constant(number: Any) -> bool:
    return not isinstance(number, Tracer)


def _evaluated(closed: ClosedJaxpr, arguments: Sequence[Numbers]) -> list[Numbers]:
    jaxpr = closed.jaxpr
    known: dict[Any, Numbers] = dict(zip(jaxpr.constvars, map(_apart, closed.consts), strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))

    def value(atom: Any) -> Numbers:
        return np.asarray(atom.val) if isinstance(atom, Literal) else known[atom]

    for equation in jaxpr.eqns:
        results = _results(equation, [value(atom) for atom in equation.invars])
        known.update(zip(equation.outvars, map(_settled, results, equation.outvars), strict=True))
    return [value(atom) for atom in jaxpr.outvars]


def _settled(numbers: Numbers, variable: Any) -> Numbers:
    """Returns constants in their dtype, if all are constants."""
    if _traced(numbers) and not all(map(_constant, numbers.flat)):
        return numbers
    return numbers.astype(variable.aval.dtype)


def _results(equation: Any, operands: list[Numbers]) -> list[Numbers]:
    name, params = equation.primitive.name, equation.params
    if name in _CALLS:
        inner = params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"]
        return _evaluated(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), operands)
    if name in _CUT_AND_JOINED:
        return [_CUT_AND_JOINED[name](params, *operands)]
    if not any(map(_traced, operands)):
        return _of_constants(equation, operands)
    if name in _REDUCTIONS:
        return [_reduced(_REDUCTIONS[name], operands[0], params["axes"])]
    if name == "dot_general":
        return [_product(params["dimension_numbers"], *operands)]
    if name in _ELEMENTWISE:
        return [_elementwise(equation, operands)]
    raise NotImplementedError(f"'{name}' cannot be evaluated number by number")


# ------------------------------------------------------------------------------------------ cutting and joining


def _alike(parts: Sequence[Numbers]) -> list[Numbers]:
    return [part.astype(object) for part in parts] if any(map(_traced, parts)) else list(parts)


def _broadcast(params: dict[str, Any], x: Numbers) -> Numbers:
    shape = [1] * len(params["shape"])
    for axis, at in enumerate(params["broadcast_dimensions"]):
        shape[at] = x.shape[axis]
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _sliced(params: dict[str, Any], x: Numbers) -> Numbers:
    strides = params["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _places(
    shape: Sequence[int], indices: Numbers, sizes: Sequence[int], window: Sequence[int], dropped: Any, mapped: Any
) -> Numbers:
    """Returns the place, in an array of `shape` that is made flat, of all that is read or written; -1 out of bounds.

    Args:
        shape: of what is read from or written to.
        indices: [..., K] first index of each window, along the axes `mapped`.
        sizes: of a window, along each axis.
        window: axes of the result that are those of a window.
        dropped: axes of a window that the result lacks.
        mapped: K axes.
    """
    if _traced(indices):
        raise NotImplementedError("an index must be known when tracing")
    numbered = np.full(np.add(shape, sizes), -1)
    numbered[tuple(map(slice, shape))] = np.arange(int(np.prod(shape))).reshape(shape)
    found = []
    for first in indices.reshape(-1, indices.shape[-1]):
        corner = np.zeros(len(shape), int)
        corner[list(mapped)] = first
        corner = np.where((corner < 0) | (corner > shape), shape, corner)
        cut = tuple(slice(low, low + size) for low, size in zip(corner, sizes, strict=True))
        found.append(np.squeeze(numbered[cut], tuple(dropped)))
    places = np.reshape(found, [*indices.shape[:-1], *found[0].shape])
    others = [axis for axis in range(places.ndim) if axis not in window]
    return np.moveaxis(places, range(places.ndim), [*others, *window])


def _gathered(params: dict[str, Any], x: Numbers, indices: Numbers) -> Numbers:
    how, sizes = params["dimension_numbers"], params["slice_sizes"]
    if how.operand_batching_dims:
        raise NotImplementedError("a gather with axes in common cannot be evaluated number by number")
    places = _places(x.shape, indices, sizes, how.offset_dims, how.collapsed_slice_dims, how.start_index_map)
    if (places < 0).any():
        raise NotImplementedError("what is out of bounds cannot be read number by number")
    return x.reshape(-1)[places]


def _scattered(params: dict[str, Any], x: Numbers, indices: Numbers, new: Numbers, *, add: bool) -> Numbers:
    how = params["dimension_numbers"]
    if how.operand_batching_dims:
        raise NotImplementedError("a scatter with axes in common cannot be evaluated number by number")
    kept = [axis for axis in range(x.ndim) if axis not in how.inserted_window_dims]
    sizes = [1] * x.ndim
    for axis, of in zip(kept, how.update_window_dims, strict=True):
        sizes[axis] = new.shape[of]
    axes = how.update_window_dims, how.inserted_window_dims, how.scatter_dims_to_operand_dims
    result = x.astype(object).reshape(-1)
    for place, number in zip(_places(x.shape, indices, sizes, *axes).flat, new.astype(object).flat, strict=True):
        if place >= 0:
            result[place] = _plus(result[place], number) if add else number
    return result.reshape(x.shape)


_CUT_AND_JOINED: dict[str, Callable[..., Numbers]] = {
    "slice": _sliced,
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "transpose": lambda params, x: x.transpose(params["permutation"]),
    "rev": lambda params, x: np.flip(x, params["dimensions"]),
    "broadcast_in_dim": _broadcast,
    "tile": lambda params, x: np.tile(x, params["reps"]),
    "concatenate": lambda params, *parts: np.concatenate(_alike(parts), params["dimension"]),
    "stack": lambda params, *parts: np.stack(_alike(parts), params["axis"]),
    "gather": _gathered,
    "scatter": functools.partial(_scattered, add=False),
    "scatter-add": functools.partial(_scattered, add=True),
}

# ---------------------------------------------------------------------------------------------------- arithmetic

_QUICK: dict[str, Callable[..., Numbers]] = {
    **{"add": np.add, "sub": np.subtract, "mul": np.multiply, "max": np.maximum, "min": np.minimum, "neg": np.negative},
    **{"lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal},
    **{"ne": np.not_equal, "and": np.bitwise_and, "or": np.bitwise_or, "rem": np.fmod},
}
"""Of constants, in NumPy: most are arithmetic of indices, and XLA compiles a program for each shape."""

_ELEMENTWISE = frozenset(
    "abs acos add add_any and asin atan atan2 ceil clamp convert_element_type cos div eq exp expm1 floor ge gt "
    "integer_pow is_finite le log log1p logistic lt max min mul ne neg not or pow reduce_precision rem round rsqrt "
    "select_n sign sin sqrt square sub tan tanh xor".split()
)


def _of_constants(equation: Any, operands: Sequence[Any]) -> list[Numbers]:
    name = equation.primitive.name
    if name in _QUICK:
        return [_QUICK[name](*operands)]
    if name == "select_n":
        return [np.choose(np.asarray(operands[0], int), operands[1:])]
    if name == "convert_element_type":
        return [operands[0].astype(equation.params["new_dtype"])]
    with jax.ensure_compile_time_eval():
        found = equation.primitive.bind(*map(jnp.asarray, operands), **equation.params)
    return [np.asarray(each) for each in (found if equation.primitive.multiple_results else [found])]


def _is(number: Any, value: int) -> bool:
    return _constant(number) and bool(number == value)


def _simpler(name: str, a: Any, b: Any) -> Any:
    """Returns a sum, difference, product or quotient if a constant spares computing it; None otherwise."""
    if name in ("add", "add_any", "sub") and _is(b, 0):
        return a
    if name in ("add", "add_any") and _is(a, 0):
        return b
    if name == "sub" and _is(a, 0):
        return -b
    if name in ("mul", "div") and (_is(a, 0) or _is(b, 1)):
        return a
    if name == "mul" and (_is(b, 0) or _is(a, 1)):
        return b
    if name == "mul" and (_is(a, -1) or _is(b, -1)):
        return -(b if _is(a, -1) else a)
    return None


def _plus(a: Any, b: Any) -> Any:
    simpler = _simpler("add", a, b)
    return a + b if simpler is None else simpler


def _times(a: Any, b: Any) -> Any:
    simpler = _simpler("mul", a, b)
    return a * b if simpler is None else simpler


_REDUCTIONS: dict[str, Callable[[Any, Any], Any]] = {
    "reduce_sum": _plus,
    "reduce_prod": _times,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_and": operator.and_,
    "reduce_or": operator.or_,
}


def _reduced(combine: Callable[[Any, Any], Any], x: Numbers, axes: Sequence[int]) -> Numbers:
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    rows = x.transpose([*kept, *axes]).reshape([*(x.shape[axis] for axis in kept), -1])
    result = np.empty(rows.shape[:-1], object)
    for index in np.ndindex(result.shape):
        result[index] = functools.reduce(combine, rows[index])
    return result


def _product(dimensions: Any, a: Numbers, b: Numbers) -> Numbers:
    (over_a, over_b), (shared_a, shared_b) = dimensions

    def rows(x: Numbers, over: Sequence[int], shared: Sequence[int]) -> tuple[Numbers, list[int]]:
        free = [axis for axis in range(x.ndim) if axis not in (*over, *shared)]
        sizes = [int(np.prod([x.shape[axis] for axis in axes])) for axes in (shared, free, over)]
        return x.transpose([*shared, *free, *over]).reshape(sizes), [x.shape[axis] for axis in free]

    (left, free_a), (right, free_b) = rows(a, over_a, shared_a), rows(b, over_b, shared_b)
    result = np.empty((len(left), left.shape[1], right.shape[1]), object)
    for n, i, j in itertools.product(*map(range, result.shape)):
        result[n, i, j] = functools.reduce(_plus, map(_times, left[n, i], right[n, j]), 0.0)
    return result.reshape([*(a.shape[axis] for axis in shared_a), *free_a, *free_b])


def _elementwise(equation: Any, operands: list[Numbers]) -> Numbers:
    name, dtypes = equation.primitive.name, [atom.aval.dtype for atom in equation.invars]
    shape = np.broadcast_shapes(*(x.shape for x in operands))
    result = np.empty(shape, object)
    for index, *numbers in zip(np.ndindex(shape), *(np.broadcast_to(x, shape).flat for x in operands), strict=True):
        if name == "select_n" and _constant(numbers[0]):
            result[index] = numbers[1 + int(numbers[0])]
            continue
        simpler = _simpler(name, *numbers) if len(numbers) == 2 else None
        if simpler is not None:
            result[index] = simpler
        elif all(map(_constant, numbers)):
            result[index] = _of_constants(equation, list(map(np.asarray, numbers, dtypes)))[0][()]
        else:
            given = [jnp.asarray(number, dtype) for number, dtype in zip(numbers, dtypes, strict=True)]
            result[index] = equation.primitive.bind(*given, **equation.params)
    return result
