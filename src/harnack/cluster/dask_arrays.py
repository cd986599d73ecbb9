"""Functions of points and rays applied to Dask arrays, computed block by block when the result is
needed."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from typing import Any, TypeVar, cast

import numpy as np

from harnack.cluster.serialization import SerializedObject, content_hash, import_optional
from harnack.cluster.workers import exclusive_compute

Function = TypeVar("Function", bound=Callable[..., Any])


def is_dask_array(value: Any) -> bool:
    """Whether a value is a Dask array; this does not import Dask."""
    return type(value).__module__.startswith("dask.array") and hasattr(value, "dask")


def accepts_dask_arrays(*names: str) -> Callable[[Function], Function]:
    """Return a decorator of a function or method of points or rays: if one of the named arguments
    is a Dask array, the results are Dask arrays, whose blocks are the function's results for the
    blocks of the arguments. Other arguments, such as a field, are sent to each worker once.

    It must be the outermost decorator, since workers look the function up by its name.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        variadic = next(
            (name for name, one in signature.parameters.items() if one.kind is one.VAR_KEYWORD), ""
        )

        @functools.wraps(function)
        def general(*given: Any, **settings: Any) -> Any:
            if not any(map(is_dask_array, (*given, *settings.values()))):
                return function(*given, **settings)
            arguments = signature.bind(*given, **settings).arguments
            # Methods take the place of `self` by position, and the rest by name.
            rest = arguments.pop(next(iter(signature.parameters)))
            named = {**arguments.pop(variadic, {}), **arguments}
            return _map_blocks(functools.partial(general, rest), names, named)

        return cast("Function", general)

    return decorate


def _map_blocks(call: Callable[..., Any], names: tuple[str, ...], arguments: dict[str, Any]) -> Any:
    """The Dask arrays that result from `call` for arguments that contain Dask arrays."""
    what = "Dask arrays"
    delayed = import_optional("dask", what).delayed
    array = import_optional("dask.array", what)
    lazy = {name: one for name, one in arguments.items() if is_dask_array(one)}
    for name in lazy.keys() - set(names):
        raise TypeError(f"{name} cannot be a Dask array: call its method compute() first")
    lazy = _align_blocks(
        array, lazy, {name: arguments[name] for name in names if name in arguments}
    )
    fixed = {name: one for name, one in arguments.items() if name not in lazy}
    for name, one in lazy.items():
        if one.dtype.kind not in "iuf":
            raise TypeError(f"{name} must hold real numbers, not {one.dtype}")
    call = functools.partial(call, **fixed)
    # What there is to be expected, told by no points; wrong settings are told here as well.
    result = call(**{name: np.zeros((0, *one.shape[1:]), one.dtype) for name, one in lazy.items()})
    empty = _arrays_of(result)
    packed = SerializedObject.serialize(call, what)
    token = content_hash(
        (packed.content_hash, [(name, one.name) for name, one in lazy.items()]), what
    )
    sent = delayed(packed, name=f"harnack-{packed.content_hash}", traverse=False)
    run = delayed(_run, pure=False)
    columns = [one.to_delayed().reshape(-1).tolist() for one in lazy.values()]
    lengths: tuple[int, ...] = next(iter(lazy.values())).chunks[0]
    found: dict[str, list[Any]] = {name: [] for name in empty}
    for k, blocks in enumerate(zip(*columns, strict=True)):
        given = dict(zip(lazy, blocks, strict=True))
        block = run(sent, given, sum(lengths[:k]), dask_key_name=f"harnack-{token}-{k}")
        for name, one in empty.items():
            shape = (lengths[k], *one.shape[1:])
            found[name].append(array.from_delayed(block[name], shape, one.dtype))
    results = {name: array.concatenate(parts) for name, parts in found.items()}
    return type(result)(**results) if is_dataclass(result) else results[""]


def _align_blocks(array: Any, lazy: dict[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Dask arrays, and other arrays with an entry for each of their rows, cut into the same blocks
    of rows.

    Raises:
        ValueError: their lengths differ or are not known.
    """
    first, main = next(iter(lazy.items()))
    if main.ndim == 0:
        raise ValueError(f"{first} must have shape (n, 3) or (n,), not ()")
    if any(np.isnan(one) for one in main.chunks[0]):
        raise ValueError(
            f"{first}: the lengths of its blocks are not known; call its method "
            "compute_chunk_sizes() first"
        )
    count = main.shape[0]
    rows = dict(lazy)
    for name, one in others.items():
        shape = np.shape(one)
        if name not in lazy and shape not in ((), (3,)) and shape[0] == count:
            rows[name] = array.from_array(np.asarray(one), chunks=-1)
    for name, one in rows.items():
        if one.ndim not in (1, 2) or (one.ndim == 2 and one.shape[1] != 3):
            raise ValueError(f"{name} must have shape (n, 3) or (n,), not {one.shape}")
        if one.shape[0] != count:
            raise ValueError(f"{name} has {one.shape[0]} entries, and {first} has {count}")
    chunks = main.chunks[0]
    return {name: one.rechunk((chunks, -1)[: one.ndim]) for name, one in rows.items()}


def _arrays_of(result: Any) -> dict[str, np.ndarray[Any, Any]]:
    return dict(vars(result)) if is_dataclass(result) else {"": np.asarray(result)}


def _run(packed: SerializedObject, blocks: dict[str, Any], start: int) -> dict[str, Any]:
    """The results for one block of rows, which begins at row `start`."""
    with exclusive_compute():
        try:
            return _arrays_of(packed.deserialize()(**blocks))
        except (TypeError, ValueError) as error:
            raise type(error)(f"in the block that begins at row {start}: {error}") from error
