"""Dask arrays of points and rays: what is asked of them is computed block by block, when it is
needed, and can be written to a Zarr file in which finished chunks stay.
"""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from harnack.cluster.packing import Packed, load_module, name_of
from harnack.cluster.workers import alone, as_client
from harnack.progress import Advance, progress_bar

Function = TypeVar("Function", bound=Callable[..., Any])
# The attribute of a Zarr array that says what it holds.
_MARK = "harnack"


def is_lazy(value: Any) -> bool:
    """Whether a value is a Dask array; Dask is not imported to tell."""
    return type(value).__module__.startswith("dask.array") and hasattr(value, "dask")


def takes_blocks(*names: str) -> Callable[[Function], Function]:
    """A decorator of a function or method of points or rays: where one of the named arguments is a
    Dask array, the results are Dask arrays, whose blocks are the function's results for the blocks
    of the arguments. What else it is given, such as a field, is sent to each worker once.

    It is the outermost decorator, since workers find the function by its name.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def general(*given: Any, **settings: Any) -> Any:
            if not any(map(is_lazy, (*given, *settings.values()))):
                return function(*given, **settings)
            arguments = signature.bind(*given, **settings).arguments
            # Methods take the place of `self` by position, and the rest by name.
            rest = arguments.pop(next(iter(signature.parameters)))
            named = {**arguments.pop("settings", {}), **arguments}
            return _in_blocks(functools.partial(general, rest), names, named)

        return cast("Function", general)

    return decorate


def _in_blocks(call: Callable[..., Any], names: tuple[str, ...], arguments: dict[str, Any]) -> Any:
    """What `call` gives for arguments, some of which are Dask arrays."""
    what = "Dask arrays"
    delayed = load_module("dask", what).delayed
    array = load_module("dask.array", what)
    lazy = {name: one for name, one in arguments.items() if is_lazy(one)}
    for name in lazy.keys() - set(names):
        raise TypeError(f"{name} cannot be a Dask array: call its method compute() first")
    lazy = _alike(array, lazy, {name: arguments[name] for name in names if name in arguments})
    fixed = {name: one for name, one in arguments.items() if name not in lazy}
    for name, one in lazy.items():
        if one.dtype.kind not in "iuf":
            raise TypeError(f"{name} must hold real numbers, not {one.dtype}")
    call = functools.partial(call, **fixed)
    # What there is to be expected, told by no points; wrong settings are told here as well.
    result = call(**{name: np.zeros((0, *one.shape[1:]), one.dtype) for name, one in lazy.items()})
    empty = _arrays_of(result)
    packed = Packed.of(call, what)
    token = name_of((packed.name, [(name, one.name) for name, one in lazy.items()]), what)
    sent = delayed(packed, name=f"harnack-{packed.name}", traverse=False)
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


def _alike(array: Any, lazy: dict[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Dask arrays, and what else has an entry for each of their rows, in the same blocks of rows.

    Raises:
        ValueError: their lengths differ or are not known.
    """
    first, main = next(iter(lazy.items()))
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


def _run(packed: Packed, blocks: dict[str, Any], start: int) -> dict[str, Any]:
    """The results for one block of rows, which begins at row `start`."""
    with alone():
        try:
            return _arrays_of(packed.open()(**blocks))
        except (TypeError, ValueError) as error:
            raise type(error)(f"in the block that begins at row {start}: {error}") from error


def to_zarr(
    array: Any,
    path: str | os.PathLike[str],
    *,
    client: Any = None,
    progress: bool | Advance = True,
) -> Any:
    """Write a Dask array to a Zarr file, chunk by chunk, and return the Zarr array.

    A chunk of the file is a block of the array. Chunks that are there already, of the same array,
    are not computed again, so that what was stopped goes on.

    array: a Dask array; that it is the same is known by its name, which says what it is made of.
    path: of a folder, by custom with the ending .zarr, that workers see under the same name.
    client: a `dask.distributed.Client` or the address of a scheduler; by default as Dask chooses.
    progress: whether to show it, or a function that is told each part, of 1, that is done.

    Raises:
        ModuleNotFoundError: Dask or Zarr is not installed.
        TypeError: not a Dask array.
        ValueError: there is another array at the path, or its blocks have unequal lengths.
        OSError: it cannot be written there, or workers did not write there.
    """
    zarr = load_module("zarr", "to_zarr")
    dask = load_module("dask", "to_zarr")
    if not is_lazy(array):
        raise TypeError(f"to_zarr writes a Dask array, not a {type(array).__name__}")
    for lengths in array.chunks:
        if any(one != lengths[0] for one in lengths[:-1]) or lengths[-1] > lengths[0]:
            raise ValueError(
                f"the blocks have unequal lengths, {lengths[:9]}: call rechunk() first"
            )
    target = Path(path).resolve()
    file = _zarr_file(zarr, array, target)
    missing = [
        index for index in np.ndindex(*array.numblocks) if not _chunk(file, target, index).exists()
    ]
    blocks = array.to_delayed()
    write = dask.delayed(_write, pure=False)
    tasks = [write(str(target), _places(array, index), blocks[index]) for index in missing]
    part = 1 / max(1, array.npartitions)
    with progress_bar("writing", progress) as advance, as_client(client) as one:
        advance(1 - part * len(missing))
        for _ in _computed(one, tasks):
            advance(part)
    for index in missing:
        if not _chunk(file, target, index).exists():
            raise OSError(
                f"workers did not write to {target}: they see other files than this machine; name "
                "a folder that all share"
            )
    return file


def _computed(client: Any, tasks: list[Any]) -> Iterator[None]:
    """Computes tasks, all at once by a client, else one by one, and yields after each."""
    if client is None:
        for task in tasks:
            task.compute()
            yield
        return
    futures = client.compute(tasks)
    try:
        for future in load_module("distributed", "client").as_completed(futures):
            future.result()
            yield
    finally:
        client.cancel([one for one in futures if one.status == "pending"])


def _zarr_file(zarr: Any, array: Any, target: Path) -> Any:
    """The Zarr array of a Dask array, made if it is not there."""
    chunks = tuple(max(1, lengths[0]) for lengths in array.chunks)
    if not target.exists():
        return zarr.create_array(
            str(target), shape=array.shape, chunks=chunks, dtype=array.dtype,
            attributes={_MARK: array.name}, config={"write_empty_chunks": True},
        )  # fmt: skip
    try:
        file = zarr.open_array(str(target), mode="r+")
    except Exception as error:  # of many kinds
        raise ValueError(f"{target} is no Zarr array ({error}): name another folder") from None
    same = file.shape == array.shape and file.chunks == chunks and file.dtype == array.dtype
    if not same or file.attrs.get(_MARK) != array.name:
        raise ValueError(
            f"{target} holds another array, or the same one made of other numbers: delete it, or "
            "name another folder"
        )
    return file


def _chunk(file: Any, target: Path, index: tuple[int, ...]) -> Path:
    """The file of a chunk, which is written under another name first, and then renamed."""
    return target / file.metadata.encode_chunk_key(index)


def _places(array: Any, index: tuple[int, ...]) -> tuple[slice, ...]:
    starts = [sum(lengths[:k]) for lengths, k in zip(array.chunks, index, strict=True)]
    ends = [sum(lengths[: k + 1]) for lengths, k in zip(array.chunks, index, strict=True)]
    return tuple(slice(a, b) for a, b in zip(starts, ends, strict=True))


def _write(path: str, places: tuple[slice, ...], block: Any) -> None:
    zarr = load_module("zarr", "to_zarr")
    file = zarr.open_array(path, mode="r+", config={"write_empty_chunks": True})
    file[places] = block
