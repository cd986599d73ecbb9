"""Lets functions of points and rays accept Dask arrays. A Dask array is divided into "blocks" of
rows; the function is applied block by block when the result is computed, on a worker of a Dask
cluster or in this process.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from typing import Any, TypeVar, cast

import numpy as np

from harnack.cluster.serialization import SerializedObject, content_hash, import_cluster_package
from harnack.cluster.workers import exclusive_compute

Function = TypeVar("Function", bound=Callable[..., Any])


def is_dask_array(value: Any) -> bool:
    """Return whether a value is a Dask array. This does not import Dask."""
    return type(value).__module__.startswith("dask.array") and hasattr(value, "dask")


def accepts_dask_arrays(*names: str) -> Callable[[Function], Function]:
    """Make a decorator for functions and methods of points or rays that lets them accept Dask
    arrays. If one of the arguments `names` is a Dask array, the results are Dask arrays too, and
    each of their blocks is the function's result for the same block of the arguments. All other
    arguments, such as a field, are sent to each worker once.

    It must be the outermost decorator, since workers look the function up by its name.
    """

    def decorate(function: Function) -> Function:
        """Return `function` with support for Dask arrays. Its arguments `names` may be Dask
        arrays."""
        signature = inspect.signature(function)
        # The name of the parameter **keywords, if there is one.
        variadic_name = next(
            (
                name
                for name, parameter in signature.parameters.items()
                if parameter.kind is parameter.VAR_KEYWORD
            ),
            "",
        )

        @functools.wraps(function)
        def wrapper(*positional: Any, **settings: Any) -> Any:
            """Call `function` itself, or call it block by block if an argument is a Dask array."""
            if not any(map(is_dask_array, (*positional, *settings.values()))):
                return function(*positional, **settings)
            arguments = signature.bind(*positional, **settings).arguments
            # The first argument (a surface, or `self` of a method), which is no Dask array, is
            # passed by position, all others by name. `variadic_name` is the name of the function's
            # parameter **keywords, whose entries are arguments by name too.
            first_argument = arguments.pop(next(iter(signature.parameters)))
            named = {**arguments.pop(variadic_name, {}), **arguments}
            # `names` are the arguments that may be Dask arrays. `wrapper` is called for each block,
            # and not `function`, as workers find the wrapper under the function's name.
            return _map_blocks(functools.partial(wrapper, first_argument), names, named)

        return cast("Function", wrapper)

    return decorate


def _map_blocks(call: Callable[..., Any], names: tuple[str, ...], arguments: dict[str, Any]) -> Any:
    """Apply a function to Dask arrays block by block, without computing anything yet.

    call: the function, which takes all arguments by name.
    names: the arguments that may be Dask arrays.
    arguments: the arguments by name; at least one is a Dask array.

    Returns a Dask array or, if the function returns a dataclass, that dataclass with Dask arrays as
    attributes.

    Raises:
        TypeError: another argument is a Dask array, or a Dask array does not hold real numbers.
    """
    purpose = "Dask arrays"
    delayed = import_cluster_package("dask", purpose).delayed
    dask_array = import_cluster_package("dask.array", purpose)
    dask_arguments = {name: array for name, array in arguments.items() if is_dask_array(array)}
    for name in dask_arguments.keys() - set(names):
        raise TypeError(f"{name} cannot be a Dask array: call its method compute() first")
    dask_arguments = _align_blocks(
        dask_array, dask_arguments, {name: arguments[name] for name in names if name in arguments}
    )
    constants = {name: array for name, array in arguments.items() if name not in dask_arguments}
    for name, array in dask_arguments.items():
        if array.dtype.kind not in "iuf":
            raise TypeError(f"{name} must hold real numbers, not {array.dtype}")
    call = functools.partial(call, **constants)
    # A call with no points gives the type of the result; wrong settings raise here as well.
    empty_result = call(
        **{
            name: np.zeros((0, *array.shape[1:]), array.dtype)
            for name, array in dask_arguments.items()
        }
    )
    empty_arrays = _arrays_of(empty_result)
    serialized = SerializedObject.serialize(call, purpose)
    # The results' names in Dask: equal for equal calls of equal arrays.
    result_hash = content_hash(
        (serialized.content_hash, [(name, array.name) for name, array in dask_arguments.items()]),
        purpose,
    )
    # traverse=False: Dask need not look for Dask arrays in it.
    sent_call = delayed(serialized, name=f"harnack-{serialized.content_hash}", traverse=False)
    # pure=False: Dask need not compute names from arguments, as names are given below.
    run_block = delayed(_run_block, pure=False)
    block_lists = [array.to_delayed().reshape(-1).tolist() for array in dask_arguments.values()]
    lengths: tuple[int, ...] = next(iter(dask_arguments.values())).chunks[0]
    outputs: dict[str, list[Any]] = {name: [] for name in empty_arrays}
    # One delayed call for each block; it returns the result's arrays by name.
    for block_index, blocks in enumerate(zip(*block_lists, strict=True)):
        block_of_argument = dict(zip(dask_arguments, blocks, strict=True))
        # The third argument is the index of the first row of the block.
        output = run_block(
            sent_call,
            block_of_argument,
            sum(lengths[:block_index]),
            dask_key_name=f"harnack-{result_hash}-{block_index}",
        )
        for name, array in empty_arrays.items():
            shape = (lengths[block_index], *array.shape[1:])
            outputs[name].append(dask_array.from_delayed(output[name], shape, array.dtype))
    # The array of a function that returns no dataclass has the name "".
    result_arrays = {name: dask_array.concatenate(pieces) for name, pieces in outputs.items()}
    return type(empty_result)(**result_arrays) if is_dataclass(empty_result) else result_arrays[""]


def _align_blocks(
    dask_array: Any, dask_arguments: dict[str, Any], others: Mapping[str, Any]
) -> dict[str, Any]:
    """Divide Dask arrays into the same blocks of rows. Returns them by name.

    dask_array: the module dask.array.
    dask_arguments: the Dask arrays by name; the blocks are those of the first array.
    others: further arguments by name; an array among them with as many rows becomes a Dask array
        too.

    Raises:
        ValueError: the arrays have different or unknown lengths, or a shape other than (n, 3) or
            (n,).
    """
    first_name, reference = next(iter(dask_arguments.items()))
    if reference.ndim == 0:
        raise ValueError(f"{first_name} must have shape (n, 3) or (n,), not ()")
    # Unknown lengths are NaN in Dask.
    if any(np.isnan(array) for array in reference.chunks[0]):
        raise ValueError(
            f"{first_name}: the lengths of its blocks are not known; call its method "
            "compute_chunk_sizes() first"
        )
    count = reference.shape[0]
    aligned = dict(dask_arguments)
    for name, array in others.items():
        shape = np.shape(array)
        # A number or a single point or direction belongs to all rows.
        if name not in dask_arguments and shape not in ((), (3,)) and shape[0] == count:
            aligned[name] = dask_array.from_array(np.asarray(array), chunks=-1)  # one block
    for name, array in aligned.items():
        if array.ndim not in (1, 2) or (array.ndim == 2 and array.shape[1] != 3):
            raise ValueError(f"{name} must have shape (n, 3) or (n,), not {array.shape}")
        if array.shape[0] != count:
            raise ValueError(f"{name} has {array.shape[0]} entries, and {first_name} has {count}")
    # -1: columns are not divided.
    chunks = reference.chunks[0]
    return {name: array.rechunk((chunks, -1)[: array.ndim]) for name, array in aligned.items()}


def _arrays_of(result: Any) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of a function's result by name: the attributes of a dataclass, or the array
    itself under the name ""."""
    return dict(vars(result)) if is_dataclass(result) else {"": np.asarray(result)}


def _run_block(packed: SerializedObject, blocks: dict[str, Any], start: int) -> dict[str, Any]:
    """Apply the function to one block of rows, on a worker. Returns the result's arrays by name.

    packed: the serialized function.
    blocks: the block of each Dask array by the argument's name.
    start: the first row of the block, for messages.
    """
    with exclusive_compute():
        try:
            return _arrays_of(packed.deserialize()(**blocks))
        except (TypeError, ValueError) as error:
            raise type(error)(f"in the block that begins at row {start}: {error}") from error
