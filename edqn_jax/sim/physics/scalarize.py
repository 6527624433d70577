"""Evaluates functions of small arrays number by number, so that XLA fuses them into a few loops.

MJX's functions slice, concatenate, transpose and multiply small arrays. XLA:CPU gives most of these steps a loop of
their own, and mapped over environments each costs a microsecond, however little it does. Here a function is traced once
and its jaxpr evaluated again with every number of its arrays a traced array []. Slicing and concatenating then cost
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


def scalarize(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns `function` evaluated number by number: the same finite results to rounding.

    Signs of zeros may differ, NaN and infinity times a constant 0 are 0, and derivatives are those of the operations,
    without custom rules.

    Args:
        function: of arrays of fixed shapes, to a pytree of arrays. Of JAX's operations it has those that are named in
            this file; no loops, branches and random numbers. Indices are constants when tracing, reads in bounds.

    Raises:
        NotImplementedError: when called, if the function has another operation.
    """

    def evaluated(*arguments: Any) -> Any:
        jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        results = _evaluated(jaxpr, [_to_numbers(leaf) for leaf in jax.tree.leaves(arguments)])
        leaves, tree = jax.tree.flatten(shape)
        return jax.tree.unflatten(tree, [_to_array(*each) for each in zip(results, leaves, strict=True)])

    return evaluated


def _to_numbers(array: Any) -> Numbers:
    if not isinstance(array, Tracer):
        return np.asarray(array)
    parts = np.empty(array.shape, object)
    for index in np.ndindex(array.shape):
        parts[index] = array[index]
    return parts


def _to_array(numbers: Numbers, like: jax.ShapeDtypeStruct) -> Array:
    if not _traced(numbers):
        return jnp.asarray(numbers, like.dtype)
    return jnp.stack([jnp.asarray(number, like.dtype) for number in numbers.flat]).reshape(like.shape)


def _traced(numbers: Numbers) -> bool:
    return numbers.dtype == object


def _constant(number: Any) -> bool:
    return not isinstance(number, Tracer)


def _evaluated(closed: ClosedJaxpr, arguments: Sequence[Numbers]) -> list[Numbers]:
    """Returns the results of a jaxpr for its arguments, equation by equation."""
    jaxpr = closed.jaxpr
    known: dict[Any, Numbers] = dict(zip(jaxpr.constvars, map(_to_numbers, closed.consts), strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))

    def value(atom: Any) -> Numbers:
        return np.asarray(atom.val) if isinstance(atom, Literal) else known[atom]

    for equation in jaxpr.eqns:
        results = _results(equation, [value(atom) for atom in equation.invars])
        known.update(zip(equation.outvars, map(_as_constants, results, equation.outvars), strict=True))
    return [value(atom) for atom in jaxpr.outvars]


def _as_constants(numbers: Numbers, variable: Any) -> Numbers:
    """Returns the numbers in their variable's dtype if all are constants, unchanged otherwise."""
    if _traced(numbers) and not all(map(_constant, numbers.flat)):
        return numbers
    return numbers.astype(variable.aval.dtype)


def _results(equation: Any, operands: list[Numbers]) -> list[Numbers]:
    """Returns the results of one equation of a jaxpr for its operands."""
    name, params = equation.primitive.name, equation.params
    if name in ("jit", "closed_call"):
        return _evaluated(params["jaxpr"], operands)
    if name == "custom_jvp_call":
        return _evaluated(params["call_jaxpr"], operands)
    if name in _LAYOUT:
        return [_LAYOUT[name](params, *operands)]
    if not any(map(_traced, operands)):
        return _fold_constants(equation, operands)
    if name in _REDUCTIONS:
        return [_reduce(_REDUCTIONS[name], operands[0], params["axes"])]
    if name == "dot_general":
        if params["preferred_element_type"] not in (None, equation.invars[0].aval.dtype):
            raise NotImplementedError("a product cannot be summed in another dtype number by number; convert before it")
        return [_product(params["dimension_numbers"], *operands)]
    if name in _ELEMENTWISE:
        return [_elementwise(equation, operands)]
    raise NotImplementedError(f"'{name}' cannot be evaluated number by number; call a function that has it as it is")


# -------------------------------------------------------------------------------- slices, concatenation and indices


def _same_kind(parts: Sequence[Numbers]) -> list[Numbers]:
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
    """Returns the flat indices [...], in an array of `shape`, of all elements that are read or written.

    All places of a window that is not in bounds are -1.

    Args:
        shape: of what is read from or written to.
        indices: [..., K] first index of each window, along the axes `mapped`.
        sizes: of a window, along each axis.
        window: axes of the result that are those of a window.
        dropped: axes of a window that the result lacks.
        mapped: K axes.
    """
    if _traced(indices):
        raise NotImplementedError("an index must be a constant when tracing")
    numbered = np.arange(int(np.prod(shape))).reshape(shape)
    found = []
    for first in indices.reshape(-1, indices.shape[-1]):
        corner = np.zeros(len(shape), int)
        corner[list(mapped)] = first
        inside = bool(((corner >= 0) & (corner + sizes <= shape)).all())
        cut = [slice(low, low + size) for low, size in zip(corner if inside else 0 * corner, sizes, strict=True)]
        places = np.squeeze(numbered[tuple(cut)], tuple(dropped))
        found.append(places if inside else np.full_like(places, -1))
    places = np.reshape(found, [*indices.shape[:-1], *found[0].shape])
    others = [axis for axis in range(places.ndim) if axis not in window]
    return np.moveaxis(places, range(places.ndim), [*others, *window])


def _dimension_numbers(params: dict[str, Any]) -> Any:
    numbers = params["dimension_numbers"]
    if numbers.operand_batching_dims:
        raise NotImplementedError(
            "an index must not be mapped by vmap inside of the function; map the function instead"
        )
    return numbers


def _gathered(params: dict[str, Any], x: Numbers, indices: Numbers) -> Numbers:
    numbers = _dimension_numbers(params)
    axes = numbers.offset_dims, numbers.collapsed_slice_dims, numbers.start_index_map
    places = _places(x.shape, indices, params["slice_sizes"], *axes)
    if (places < 0).any():
        raise NotImplementedError("an index to read at must be in bounds")
    return x.reshape(-1)[places]


def _scatter(params: dict[str, Any], x: Numbers, indices: Numbers, new: Numbers, *, add: bool) -> Numbers:
    """Returns `x` with numbers written at indices, or added; windows out of bounds are left out."""
    numbers = _dimension_numbers(params)
    if not add and params["update_jaxpr"] is not None:
        raise NotImplementedError("a function cannot be applied at indices number by number; set what it returns")
    windows = [axis for axis in range(x.ndim) if axis not in numbers.inserted_window_dims]
    sizes = [1] * x.ndim
    for axis, of_new in zip(windows, numbers.update_window_dims, strict=True):
        sizes[axis] = new.shape[of_new]
    axes = numbers.update_window_dims, numbers.inserted_window_dims, numbers.scatter_dims_to_operand_dims
    places = _places(x.shape, indices, sizes, *axes)
    if (places < 0).any() and params["mode"] == jax.lax.GatherScatterMode.CLIP:
        raise NotImplementedError("an index to write at must be in bounds where it is clipped")
    result = x.astype(object).reshape(-1)
    for place, number in zip(places.flat, new.astype(object).flat, strict=True):
        if place >= 0:
            result[place] = _plus(result[place], number) if add else number
    return result.reshape(x.shape)


_LAYOUT: dict[str, Callable[..., Numbers]] = {
    "slice": _sliced,
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "transpose": lambda params, x: x.transpose(params["permutation"]),
    "rev": lambda params, x: np.flip(x, params["dimensions"]),
    "broadcast_in_dim": _broadcast,
    "tile": lambda params, x: np.tile(x, params["reps"]),
    "concatenate": lambda params, *parts: np.concatenate(_same_kind(parts), params["dimension"]),
    "stack": lambda params, *parts: np.stack(_same_kind(parts), params["axis"]),
    "gather": _gathered,
    "scatter": functools.partial(_scatter, add=False),
    "scatter-add": functools.partial(_scatter, add=True),
}

# ---------------------------------------------------------------------------------------------------- arithmetic

_NUMPY: dict[str, Callable[..., Numbers]] = {
    **{"add": np.add, "sub": np.subtract, "mul": np.multiply, "max": np.maximum, "min": np.minimum, "neg": np.negative},
    **{"lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal},
    **{"ne": np.not_equal, "and": np.bitwise_and, "or": np.bitwise_or, "rem": np.fmod, "sign": np.sign, "abs": np.abs},
    "is_finite": np.isfinite,
}
"""NumPy functions for constant operands, mostly indices; XLA would compile a program for each shape."""


def _iota(params: dict[str, Any]) -> Numbers:
    along = [1] * len(params["shape"])
    along[params["dimension"]] = -1
    counted = np.arange(params["shape"][params["dimension"]]).astype(params["dtype"])
    return np.broadcast_to(counted.reshape(along), params["shape"])


def _cumsum(params: dict[str, Any], x: Numbers) -> Numbers:
    turn = np.flip if params["reverse"] else lambda each, axis: each
    return turn(np.cumsum(turn(x, params["axis"]), params["axis"], dtype=x.dtype), params["axis"])


_OF_WHOLE_NUMBERS: dict[str, Callable[..., Numbers]] = {
    "iota": _iota,
    "convert_element_type": lambda params, x: x.astype(params["new_dtype"]),
    "cumsum": _cumsum,
    "reduce_sum": lambda params, x: x.sum(tuple(params["axes"]), dtype=x.dtype),
}
"""Likewise, of whole numbers and truths alone, for which both agree: sums are exact, and rounding to the nearest float
has one result. Of others XLA's is taken."""

_ELEMENTWISE = frozenset(
    "abs add add_any and atan2 clamp convert_element_type cos div eq exp floor ge gt integer_pow is_finite le log lt "
    "max min mul ne neg not or pow reduce_precision rem rsqrt select_n sign sin sqrt square sub tan tanh".split()
)


def _fold_constants(equation: Any, operands: Sequence[Any]) -> list[Numbers]:
    """Returns the results of an equation whose operands are all constants, as constants."""
    name = equation.primitive.name
    if name in _NUMPY:
        return [_NUMPY[name](*operands)]
    if name in _OF_WHOLE_NUMBERS and all(each.dtype.kind in "biu" for each in operands):
        return [_OF_WHOLE_NUMBERS[name](equation.params, *operands)]
    if name == "select_n":
        return [np.choose(np.asarray(operands[0], int), operands[1:])]
    with jax.ensure_compile_time_eval():
        found = equation.primitive.bind(*map(jnp.asarray, operands), **equation.params)
    return [np.asarray(each) for each in (found if equation.primitive.multiple_results else [found])]


def _is(number: Any, value: int) -> bool:
    return _constant(number) and bool(number == value)


def _simpler(name: str, a: Any, b: Any) -> Any:
    """Returns a sum, difference, product or quotient if a constant operand makes it trivial; None otherwise."""
    if name in ("add", "add_any", "sub") and _is(b, 0):
        return a
    if name in ("add", "add_any") and _is(a, 0):
        return b
    if name == "sub" and _is(a, 0):
        return -b
    if (name == "mul" and _is(a, 0)) or (name in ("mul", "div") and _is(b, 1)):
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


def _reduce(combine: Callable[[Any, Any], Any], x: Numbers, axes: Sequence[int]) -> Numbers:
    """Returns `x` with the numbers along `axes` combined, first to last."""
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    rows = x.transpose([*kept, *axes]).reshape([*(x.shape[axis] for axis in kept), -1])
    result = np.empty(rows.shape[:-1], object)
    for index in np.ndindex(result.shape):
        result[index] = functools.reduce(combine, rows[index])
    return result


def _product(dimensions: Any, a: Numbers, b: Numbers) -> Numbers:
    """Returns the result of `dot_general`; its axes are the common ones, then those of `a`, then those of `b`."""
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
    """Returns the result of an elementwise equation, simplified where an operand is constant."""
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
            result[index] = _fold_constants(equation, list(map(np.asarray, numbers, dtypes)))[0][()]
        else:
            given = [jnp.asarray(number, dtype) for number, dtype in zip(numbers, dtypes, strict=True)]
            result[index] = equation.primitive.bind(*given, **equation.params)
    return result
