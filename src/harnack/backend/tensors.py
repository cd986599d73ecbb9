"""Converts between Dr.Jit's tensors and vectors, and wraps functions for PyTorch and JAX. A tensor
is an array with a shape, such as (n, 3). A vector is three Dr.Jit arrays with an entry, called a
lane, for each of n points. A wrapped function takes and returns arrays of the other framework, and
its derivatives are passed on; a cotangent is the gradient of some later result with respect to one
of its results.

Arrays of other frameworks reach Dr.Jit as tensors (n, 3) or (n,): `drjit.wrap` passes tensors to a
function and expects tensors from it. This package computes with vectors instead, with a lane for
each row. All conversions pass derivatives on, in both directions.

`wrap_for_jax` makes functions for JAX, for which Dr.Jit has no `wrap`. `wrap_for_torch` replaces
`drjit.wrap` for PyTorch, which returns zeros for missing derivatives: here they raise an error, and
the backward pass may be repeated. Neither framework is imported before it is used.

Numbers that change from step to step of an optimization compile no new kernels: literals with
derivatives become kernel parameters, and if the vertices of a curve are Dr.Jit arrays, neither its
proofs nor its convex hull are chosen by its shape.
"""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr
import numpy as np

from harnack.backend.arrays import backend_of
from harnack.backend.validation import TRANSPOSE_ADVICE, check_vectors

if TYPE_CHECKING:
    from harnack.backend.arrays import Real, Vec3

Method = TypeVar("Method", bound=Callable[..., Any])


def is_tensor(value: Any) -> bool:
    """Return whether a value is a Dr.Jit tensor."""
    return dr.is_tensor_v(cast("Any", type(value)))


def tensor_to_vectors(
    tensor: Any, name: str = "vectors", error: type[Exception] = ValueError
) -> Vec3:
    """Return the rows of a tensor (n, 3) as a 3-vector of n lanes.

    name: what the tensor is, for messages.
    error: the class of errors about its shape.

    Raises:
        TypeError: not of 32- or 64-bit floats.
        `error`: another shape.
    """
    check_vectors(tensor, name, error, transposed=TRANSPOSE_ADVICE)
    numbers = tensor_to_array(tensor, name)
    backend = backend_of(numbers)
    count = 3 * tensor.shape[0]
    # The numbers 0, 3, 6, ... of the rows are x coordinates, and so on. No rows, no indices.
    indices = (dr.arange(backend.UInt32, k, count, 3) for k in range(3 if count else 0))
    components = [dr.gather(backend.Float, numbers, index) for index in indices]
    return backend.Array3f(*components) if components else dr.zeros(backend.Array3f, 0)


def tensor_to_array(tensor: Any, name: str = "values") -> Real:
    """Return all numbers of a tensor, row by row, as a Dr.Jit array. name: what the tensor is, for
    messages.

    Raises:
        TypeError: the numbers are not 32- or 64-bit floats.
    """
    array = tensor.array
    try:
        return backend_of(array).Float(array)
    except TypeError as error:
        raise TypeError(f"{name}: {error}") from None


def array_to_tensor(array: Any, shape: tuple[int, ...]) -> Any:
    """Return a Dr.Jit array as a tensor of the given shape; a 3-vector as a tensor of shape
    (*shape, 3).

    A value that all lanes share is repeated. Unsigned integers become signed ones, since PyTorch
    has no unsigned integers.
    """
    kind = cast("Any", type(array))
    count = math.prod(shape)
    # A value that all lanes share: entry 0 for all of them.
    if dr.width(array) == 1 and count > 1:
        index_type = dr.uint32_array_t(dr.array_t(kind))
        array = dr.gather(kind, array, dr.zeros(index_type, count))
    # The numbers of a vector in one array, point after point.
    if dr.depth_v(kind) > 1:
        array, shape = dr.ravel(array), (*shape, dr.size_v(kind))
    elif dr.is_unsigned_v(kind) and not dr.is_mask_v(kind):
        array = dr.int32_array_t(kind)(array)
    return dr.tensor_t(type(array))(array, shape)


def accepts_tensors(method: Method) -> Method:
    """Decorator for a method of points: the method also takes a tensor of points, (..., 3), and
    then returns a tensor."""

    @functools.wraps(method)
    def wrapper(self: Any, points: Any, **settings: Any) -> Any:
        """Call the method, with a tensor converted to vectors and the result converted back."""
        if not is_tensor(points):
            return method(self, points, **settings)
        # A tensor without axes is refused by `tensor_to_vectors` below.
        *shape, _ = points.shape or (0,)
        # A single point is a table of one row.
        rows = cast("Any", type(points))(points.array, (1, 3)) if points.shape == (3,) else points
        return array_to_tensor(
            method(self, tensor_to_vectors(rows, "points"), **settings), tuple(shape)
        )

    return cast("Method", wrapper)


# PyTorch.


def wrap_for_torch(function: Callable[..., Any]) -> Callable[..., Any]:
    """Turn a function of Dr.Jit tensors into a function of PyTorch tensors, with derivatives.

    It does what `drjit.wrap(source="torch", target="drjit")` does, but loses nothing silently. Some
    results depend on the arguments only through quantities without a derivative, such as whether
    rays hit (`hits.is_hit`): requesting their derivative raises an error. A second backward pass
    (`retain_graph=True`) is right, and calls `function` again.

    function: a pure function. It is called with a Dr.Jit tensor for each PyTorch tensor among its
        arguments, of the same shape and precision, and returns a Dr.Jit array or tensor, or several
        in a tuple, list or dictionary; 3-vectors become tensors (n, 3). All other arguments are
        passed unchanged; tensors within lists and other containers are not converted.

    Raises:
        ImportError: PyTorch is not installed.
    """
    torch: Any = importlib.import_module("torch")
    first_derivative = _refusing_second_derivatives(torch)

    def run_function(arguments: list[Any], tensors: tuple[Any, ...]) -> tuple[list[Any], Any]:
        """Call `function`. Returns its tensor arguments as Dr.Jit tensors with derivatives, and its
        result.

        arguments: the arguments in order, with None in place of tensors.
        tensors: PyTorch tensors for these places.
        """
        inputs = [_differentiable_tensor(tensor.detach()) for tensor in tensors]
        remaining = iter(inputs)
        all_arguments = (next(remaining) if value is None else value for value in arguments)
        return inputs, function(*all_arguments)

    class Wrapped(torch.autograd.Function):
        """The function in the form that PyTorch's automatic differentiation calls. `ctx` is
        PyTorch's object that keeps values from the forward pass for the backward pass."""

        @staticmethod
        def forward(ctx: Any, arguments: list[Any], own_result: list[Any], *tensors: Any) -> Any:
            """Return the results as PyTorch tensors.

            arguments: the arguments of `function`, with None in place of tensors.
            own_result: an empty list, to which the result of `function` itself is appended. The
                caller needs its type (tuple, list, ...).
            tensors: PyTorch's tensors among the arguments.
            """
            inputs, outputs = run_function(arguments, tensors)
            own_result.append(outputs)
            # PyTorch keeps the tensors for a second backward pass, and Dr.Jit's graph serves the
            # first.
            ctx.save_for_backward(*tensors)
            ctx.arguments, ctx.graph = arguments, (inputs, _results(outputs))
            # `graph` holds the tensors of the arguments, and the list of results.
            results = tuple(dr.detach(_as_tensor(value)).torch() for value in ctx.graph[1])
            # PyTorch asks for no gradients of integers.
            integral = (result for result in results if not result.is_floating_point())
            ctx.mark_non_differentiable(*integral)
            return results

        @staticmethod
        def backward(ctx: Any, *cotangents: Any) -> Any:
            """Return the gradients with respect to the arguments of `forward` (None for the first
            two). cotangents: the gradients with respect to its results.

            Dr.Jit's graph of the forward pass can be traversed only once. If it is used up,
            `function` is called again.
            """
            graph, ctx.graph = ctx.graph, None
            if graph is None:  # a repeated backward pass
                inputs, outputs = run_function(ctx.arguments, ctx.saved_tensors)
                graph = inputs, _results(outputs)
            inputs, outputs = graph
            plain_cotangents = [None if value is None else value.detach() for value in cotangents]
            parts = _gradients(inputs, outputs, plain_cotangents)
            gradients = [part.torch() for part in parts]
            if torch.is_grad_enabled():  # create_graph=True
                sources = [
                    *ctx.saved_tensors,
                    *(value for value in cotangents if value is not None),
                ]
                gradients = [first_derivative(part, *sources) for part in gradients]
            remaining = iter(gradients)
            own = (next(remaining) if dr.is_float_v(value) else None for value in inputs)
            return None, None, *own

    @functools.wraps(function)
    def wrapped(*args: Any) -> Any:
        """Call the function with PyTorch tensors."""
        tensors = [value for value in args if isinstance(value, torch.Tensor)]
        # Tensors are passed one by one, as PyTorch differentiates by direct arguments only.
        arguments = [None if isinstance(value, torch.Tensor) else value for value in args]
        own_result: list[Any] = []
        return _in_container(own_result, iter(Wrapped.apply(arguments, own_result, *tensors)))

    return wrapped


def _refusing_second_derivatives(torch: Any) -> Callable[..., Any]:
    """Return the identity for a gradient that is asked for with create_graph=True, as a function of
    PyTorch, the module `torch`. It depends on the arguments, and its own derivative is refused:
    PyTorch would take it for 0."""

    class FirstDerivative(torch.autograd.Function):
        """That function."""

        @staticmethod
        def forward(ctx: Any, gradient: Any, *sources: Any) -> Any:
            """Return the gradient. sources: all that it depends on."""
            del ctx, sources
            return gradient.clone()

        @staticmethod
        def backward(ctx: Any, *cotangents: Any) -> Any:
            """Raise NotImplementedError."""
            raise NotImplementedError(_NO_SECOND_DERIVATIVE)

    return cast("Any", FirstDerivative).apply


def _results(outputs: Any) -> list[Any]:
    """Return the results of a function as a list, from a single result or a tuple, list or
    dictionary."""
    if isinstance(outputs, dict):
        return list(cast("dict[Any, Any]", outputs).values())
    return list(cast("list[Any]", outputs)) if isinstance(outputs, (tuple, list)) else [outputs]


def _in_container(own_result: list[Any], results: Any) -> Any:
    """Return arrays of another framework in a container of the same type (and with the same keys)
    as the result of the wrapped function: a dictionary, a tuple or a list. If that result is a
    single array, the single array of the other framework is returned.

    own_result: a list whose only entry is the result of the wrapped function, Dr.Jit's arrays. It
        is a list, as it is filled while the function is called. The entry is removed.
    results: an iterator over the arrays of the other framework, in the order of the container.
    """
    outputs = own_result.pop()
    if isinstance(outputs, dict):
        return dict(zip(cast("dict[Any, Any]", outputs), results, strict=True))
    return type(outputs)(results) if type(outputs) in (tuple, list) else next(results)


def _gradients(inputs: list[Any], outputs: list[Any], cotangents: list[Any]) -> list[Any]:
    """Return the gradients, as tensors, with respect to each input that holds floats.

    inputs: tensors with derivatives enabled.
    outputs: the results of the function for these inputs.
    cotangents: the gradients with respect to the outputs; None for an output without a gradient.

    Raises:
        NotImplementedError: a nonzero gradient is given for an output that has no derivative with
            respect to any input.
    """
    for output, cotangent in zip(outputs, cotangents, strict=True):
        if cotangent is None or not dr.is_float_v(output) or not dr.width(output):
            continue
        cotangent_tensor, tensor = _import_tensor(cotangent), _as_tensor(output)
        if dr.grad_enabled(tensor):
            dr.accum_grad(tensor, cotangent_tensor)  # an output may occur twice, or be an input
            dr.enqueue(dr.ADMode.Backward, tensor)
        # The output has no derivative: a gradient of 0 does no harm.
        elif dr.any(cotangent_tensor.array != 0, axis=None):
            raise NotImplementedError(_NO_DERIVATIVE)
    # All outputs are propagated back to the inputs at once.
    dr.traverse(dr.ADMode.Backward)
    return [dr.grad(source) for source in inputs if dr.is_float_v(source)]


_NO_SECOND_DERIVATIVE = (
    "wrap_for_torch gives no second derivatives: detach the gradient that create_graph=True asked "
    "for where it is a constant"
)
_NO_DERIVATIVE = (
    "a result of the wrapped function depends on its arguments by nothing that has a derivative: "
    "zero would be wrong where it depends on whether rays hit (hits.is_hit, hits.status), on what "
    "was hit, or on NumPy arrays. Take t, position, clearance or field.value, or detach that result"
)

# JAX.

_TRACED_MESSAGE = (
    "wrap_for_jax(function) cannot run inside jax.jit, jax.vmap or the like, where shapes of "
    "results must be known beforehand: call it outside, or inside jax.jit give result=, a function "
    "of the same arguments whose result has these shapes and types, such as "
    "result=lambda vertices, points: points[:, 0]"
)


def wrap_for_jax(
    function: Callable[..., Any], *, result_like: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """Turn a function of Dr.Jit tensors into a function of JAX arrays, with derivatives for
    `jax.grad`. Dr.Jit's own `drjit.wrap` does not support JAX.

    function: a pure function. It is called with a Dr.Jit tensor for each array or number among its
        arguments, of the shape and precision that it has in JAX, and returns Dr.Jit arrays or
        tensors, possibly in tuples, lists and dictionaries; 3-vectors become arrays (n, 3).
    result_like: only for use inside `jax.jit`: a JAX function of the same arguments whose result
        has the shapes and types of `function`'s result. Its values are not used.

    Some results depend on the arguments only through quantities without a derivative, such as
    whether rays hit (`hits.is_hit`): requesting their derivative raises an error. Derivatives are
    those of reverse mode (`jax.grad`, `jax.vjp`, `jax.jacrev`). A derivative calls `function` a
    second time: JAX may keep the values of a forward pass, but it cannot keep Dr.Jit's graph.

    Raises:
        ImportError: JAX is not installed.
    """
    jax: Any = importlib.import_module("jax")
    run = functools.partial(_run_for_jax, jax, function)
    pull_back = functools.partial(_pull_back, jax, function)

    def call(*args: Any) -> Any:
        """Return the result of the function, also inside of `jax.jit`."""
        if not _is_traced(jax, args):
            return run(*args)
        if result_like is None:
            raise TypeError(_TRACED_MESSAGE)
        return _pure_callback(jax, run, jax.eval_shape(result_like, *args), *args)

    def forward(*args: Any) -> tuple[Any, Any]:
        """Return the result, and the arguments, which JAX passes to `backward`."""
        return call(*args), args

    def backward(args: Any, cotangents: Any) -> Any:
        """Return the gradients with respect to all arguments. cotangents: the gradients with
        respect to the result."""
        # The gradients with respect to the arguments that hold floats are computed by `pull_back`.
        leaves: list[Any] = jax.tree.leaves(args)
        if _is_traced(jax, (args, cotangents)):
            # Inside jax.jit only shapes are known: the gradients are computed by a callback when
            # the compiled program runs.
            shapes = [
                jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)
                for leaf in leaves
                if _is_float(jax, leaf)
            ]
            derivatives = iter(_pure_callback(jax, pull_back, shapes, args, cotangents))
        else:
            derivatives = iter(pull_back(args, cotangents))
        # JAX has a type of its own for derivatives with respect to integers.
        gradients = [
            next(derivatives)
            if _is_float(jax, leaf)
            else np.zeros(np.shape(leaf), jax.dtypes.float0)
            for leaf in leaves
        ]
        return jax.tree.unflatten(jax.tree.structure(args), gradients)

    # Where derivatives are needed, JAX calls `forward` and `backward` in place of `call`.
    differentiable: Any = jax.custom_vjp(call)
    differentiable.defvjp(forward, backward)

    @functools.wraps(function)
    def wrapped(*args: Any) -> Any:
        """Call `function` with JAX arrays or numbers."""
        return differentiable(*jax.tree.map(jax.numpy.asarray, args))

    return wrapped


def _run_for_jax(jax: Any, function: Callable[..., Any], *args: Any) -> Any:
    """Call `function` with JAX arrays, and return its result as JAX arrays. Derivatives are enabled
    even if nobody asks for them, because hits are refined to rounding error only if they are; so
    the result is the same with `jax.grad` and without."""
    outputs = function(*jax.tree.map(_differentiable_tensor, args))
    return jax.tree.map(_as_jax, outputs)


def _pull_back(jax: Any, function: Callable[..., Any], args: Any, cotangents: Any) -> list[Any]:
    """Return the gradients, as JAX arrays, with respect to each argument that holds floats.

    jax: the module.
    args: the arguments of `function`.
    cotangents: the gradients with respect to the result of `function`.
    """
    inputs = jax.tree.map(_differentiable_tensor, args)
    outputs = jax.tree.leaves(function(*inputs))
    gradients = _gradients(jax.tree.leaves(inputs), outputs, jax.tree.leaves(cotangents))
    return [gradient.jax() for gradient in gradients]


def _is_traced(jax: Any, values: Any) -> bool:
    """Return whether one of the values is a placeholder without numbers, as JAX passes while it
    transforms or compiles a function."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def _pure_callback(jax: Any, compute: Callable[..., Any], shapes: Any, *args: Any) -> Any:
    """Return the result of `compute`, which JAX calls while a compiled program runs. shapes: the
    shapes and types of the result."""

    def compute_on_host(*values: Any) -> Any:
        """Return the result of `compute` for NumPy arrays, as NumPy arrays."""
        # NumPy arrays, as a callback must not wait for work that JAX itself has to do.
        return jax.tree.map(np.asarray, compute(*jax.tree.map(np.asarray, values)))

    return jax.pure_callback(compute_on_host, shapes, *args, vmap_method="sequential")


def _is_float(jax: Any, array: Any) -> bool:
    """Return whether an array or number holds floats for JAX."""
    return jax.numpy.issubdtype(jax.numpy.result_type(array), jax.numpy.floating)


def _import_tensor(array: Any) -> Any:
    """Return a JAX, PyTorch or NumPy array as a Dr.Jit tensor of the same shape and precision, on
    the same device."""
    return dr.detail.import_tensor(array, True)


def _differentiable_tensor(array: Any) -> Any:
    """Return an array of another framework as a Dr.Jit tensor, with derivatives enabled if it holds
    floats."""
    tensor = _import_tensor(array)
    if dr.is_float_v(tensor):
        dr.enable_grad(tensor)
    return tensor


def _as_tensor(value: Any) -> Any:
    """Return a Dr.Jit array or tensor, the result of a function, as a Dr.Jit tensor.

    Raises:
        TypeError: another value.
    """
    if not dr.is_array_v(cast("Any", type(value))):
        raise TypeError(
            "a wrapped function returns Dr.Jit arrays or tensors, in tuples, lists and "
            f"dictionaries, not {type(value).__name__}: vars(hits) is a dictionary of hits, and "
            "hits are such arrays if the rays are arguments of the function"
        )
    return value if is_tensor(value) else array_to_tensor(value, (dr.width(value),))


def _as_jax(value: Any) -> Any:
    """Return a Dr.Jit array or tensor as a JAX array, without derivatives."""
    return dr.detach(_as_tensor(value)).jax()
