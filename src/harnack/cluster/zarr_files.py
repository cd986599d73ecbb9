"""Writes Dask arrays to Zarr files. A Zarr file is a folder with one file for each "chunk" of the
array; a chunk is one block of the Dask array. Chunks that are already in the file are not computed
again.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from harnack.backend.validation import no_derivatives
from harnack.cluster.dask_arrays import is_dask_array
from harnack.cluster.serialization import import_cluster_package
from harnack.cluster.workers import connect_client
from harnack.name_suggestions import with_article
from harnack.progress import ProgressFunction, show_progress

# The attribute of a Zarr array that holds the name of the Dask array.
_NAME_ATTRIBUTE = "harnack"


@no_derivatives
def to_zarr(
    array: Any,
    path: str | os.PathLike[str],
    *,
    client: Any = None,
    progress: bool | ProgressFunction = True,
) -> Any:
    """Write a Dask array to a Zarr file, chunk by chunk, and return the Zarr array.

    A chunk of the file is a block of the array. Chunks of the same array that are already in the
    file are not computed again, so that an interrupted call can be continued.

    array: a Dask array. Dask derives its name from its contents, and the file is recognized by this
        name.
    path: the folder to write, usually with the ending .zarr; workers must see it under the same
        path.
    client: a `dask.distributed.Client` or the address of a scheduler; by default the array is
        computed as Dask chooses.
    progress: whether to show the progress, or a function that is called with a `Progress`.

    Raises:
        ModuleNotFoundError: Dask or Zarr is not installed.
        TypeError: not a Dask array.
        ValueError: there is another array at the path, or the blocks have unequal lengths.
        OSError: the file cannot be written, or workers wrote to another file system.
    """
    zarr = import_cluster_package("zarr", "to_zarr")
    dask = import_cluster_package("dask", "to_zarr")
    if not is_dask_array(array):
        raise TypeError(f"to_zarr writes a Dask array, not {with_article(type(array).__name__)}")
    for lengths in array.chunks:
        if any(length != lengths[0] for length in lengths[:-1]) or lengths[-1] > lengths[0]:
            raise ValueError(
                f"the blocks have unequal lengths, {lengths[:9]}: call rechunk() first"
            )
    target = Path(path).resolve()
    file = _open_or_create(zarr, array, target)
    # The indices of the chunks that are not empty and whose file does not exist.
    missing_chunks = [
        index
        for index in np.ndindex(*array.numblocks)
        if all(extent.stop > extent.start for extent in _chunk_slices(array, index))
        and not _chunk_path(file, target, index).exists()
    ]
    blocks = array.to_delayed()
    write = dask.delayed(_write_block, pure=False)  # it has an effect, so each call counts
    tasks = [
        write(str(target), _chunk_slices(array, index), blocks[index]) for index in missing_chunks
    ]
    fraction = 1 / max(1, array.npartitions)
    with (
        show_progress("writing", progress) as reporter,
        connect_client(client) as dask_client,
    ):
        reporter.advance(1 - fraction * len(missing_chunks))
        for _ in _compute_tasks(dask_client, tasks):
            reporter.advance(fraction)
    for index in missing_chunks:
        if not _chunk_path(file, target, index).exists():
            raise OSError(
                f"workers did not write to {target}: they see other files than this machine; name "
                "a folder that all share"
            )
    return file


def _compute_tasks(client: Any, tasks: list[Any]) -> Iterator[None]:
    """Compute delayed Dask tasks, and yield after each finished one: all at once on the cluster of
    `client`, or one after the other in this process if `client` is None."""
    if client is None:
        for task in tasks:
            task.compute()
            yield
        return
    futures = client.compute(tasks)
    try:
        for future in import_cluster_package("distributed", "client").as_completed(
            futures, loop=client.loop
        ):
            future.result()
            yield
    finally:
        # After an error, tasks that have not begun are canceled.
        client.cancel([pending for pending in futures if pending.status == "pending"])


def _open_or_create(zarr: Any, array: Any, target: Path) -> Any:
    """Open the Zarr file `target` of a Dask array, or create it if it does not exist.

    zarr: the module of this name.

    Raises:
        FileNotFoundError: the parent folder does not exist.
        ValueError: the path holds something else.
    """
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {target}: create the folder {target.parent} first")
    chunks = tuple(max(1, lengths[0]) for lengths in array.chunks)
    if not target.exists():
        return zarr.create_array(
            str(target), shape=array.shape, chunks=chunks, dtype=array.dtype,
            attributes={_NAME_ATTRIBUTE: array.name},
        )  # fmt: skip
    try:
        file = zarr.open_array(str(target), mode="r+")
    except Exception as error:  # of many kinds
        raise ValueError(f"{target} is no Zarr array ({error}): name another folder") from None
    is_same = file.shape == array.shape and file.chunks == chunks and file.dtype == array.dtype
    if not is_same or file.attrs.get(_NAME_ATTRIBUTE) != array.name:
        raise ValueError(
            f"{target} holds another array, or the same one made of other numbers: delete it, or "
            "name another folder"
        )
    return file


def _chunk_path(file: Any, target: Path, index: tuple[int, ...]) -> Path:
    """Return the path of the file of the chunk with this index in the Zarr array `file`, whose
    folder is `target`. The path exists only if the chunk is complete: Zarr writes it under another
    name first, and then renames it."""
    return target / file.metadata.encode_chunk_key(index)


def _chunk_slices(array: Any, index: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the slices, one for each axis, that select the chunk with this index from the
    array."""
    starts = [sum(lengths[:k]) for lengths, k in zip(array.chunks, index, strict=True)]
    ends = [sum(lengths[: k + 1]) for lengths, k in zip(array.chunks, index, strict=True)]
    return tuple(slice(a, b) for a, b in zip(starts, ends, strict=True))


def _write_block(path: str, slices: tuple[slice, ...], block: Any) -> None:
    """Write a block of numbers into the Zarr array at `path`. It is run on a worker. slices: the
    place of the block in the array."""
    zarr = import_cluster_package("zarr", "to_zarr")
    # By default Zarr leaves out chunks of zeros, which would then be computed again.
    with zarr.config.set({"array.write_empty_chunks": True}):
        zarr.open_array(path, mode="r+")[slices] = block
