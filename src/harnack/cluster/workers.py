"""Connects to a Dask cluster, and checks that its workers can run tasks before anything is sent to
them. A "worker" is a process of the cluster that runs tasks; its "scheduler" distributes them; a
"client" is the connection of this process to the scheduler.
"""

from __future__ import annotations

import functools
import hashlib
import sys
import warnings
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from typing import Any

import drjit as dr
import numpy as np

from harnack.backend import choose_backend, to_numpy
from harnack.cluster.serialization import import_cluster_package, package_versions

# How long to wait for a scheduler to answer.
_CONNECT_TIMEOUT = "10s"
SCHEDULER_LOST = "the scheduler was lost, or somebody cancelled what this task waits for"
_INSTALL = "install the same there as here, such as by pip install 'harnack[cluster]=={version}'"


@contextmanager
def connect_client(client: Any) -> Generator[Any]:
    """Context manager that yields a Dask client whose workers have all been checked, or None if
    `client` is None.

    client: a Dask client, the address of a scheduler, or None. A client that was opened from an
        address is closed at the end.

    Workers that join the cluster later are checked when they get a task: by `exclusive_compute` and
    `SerializedObject.deserialize`.

    Raises:
        ModuleNotFoundError: Dask is not installed.
        TypeError: `client` is neither a client nor an address.
        OSError: there is no scheduler at the address.
        RuntimeError: a worker has no harnack, another version of it, or no LLVM that Dr.Jit can
            use. The message names the worker.
    """
    if client is None:
        yield None
        return
    distributed = import_cluster_package("distributed", "client")
    own_client = None
    # A client that is opened here is closed here.
    if isinstance(client, str):
        try:
            client = own_client = distributed.Client(
                client, timeout=_CONNECT_TIMEOUT, set_as_default=False
            )
        except (OSError, ValueError, TimeoutError) as error:
            raise OSError(
                f"no scheduler answers at {client!r} ({error}); start one by `dask scheduler`, "
                "which prints its address, such as tcp://127.0.0.1:8786"
            ) from None
    if not isinstance(client, distributed.Client) or client.asynchronous:
        raise TypeError(
            "client must be a dask.distributed.Client that is not asynchronous, or the address of "
            f"a scheduler such as tcp://127.0.0.1:8786, not {client!r}"
        )
    try:
        _check_workers(client)
        yield client
    finally:
        if own_client is not None:
            own_client.close()


@contextmanager
def exclusive_compute() -> Generator[str]:
    """Context manager within which no other task of this process computes, as Dr.Jit already uses
    all threads of a worker. It yields the address of this Dask worker, or "" if this process is no
    worker.

    Raises:
        RuntimeError: Dr.Jit has no backend that it can use here.
    """
    distributed = sys.modules.get("distributed")
    worker = None
    if distributed is not None:
        with suppress(ValueError):  # this is no worker
            worker = distributed.get_worker()
    try:
        choose_backend()
    except RuntimeError as error:
        raise RuntimeError(f"worker {worker and worker.address} cannot work: {error}") from None
    if worker is not None:
        adopt_worker_threads(worker.nanny is not None, worker.state.nthreads)
    # A lock of this name is the same one for all tasks of this process.
    with import_cluster_package("dask.utils", "client").SerializableLock("harnack"):
        yield "" if worker is None else worker.address


def worker_threads(client: Any) -> dict[str, int]:
    """Return the number of threads of each worker of a client, by the worker's address.

    Raises:
        RuntimeError: the scheduler is gone.
    """
    try:
        threads: dict[str, int] = client.nthreads()
    except OSError:
        raise RuntimeError(SCHEDULER_LOST) from None
    return threads


def _check_workers(client: Any) -> None:
    """Check that all workers of a client have the same versions of packages as this process, and
    warn if they round differently.

    Raises:
        RuntimeError: a worker has other versions, or cannot compute.
    """
    import importlib.metadata  # imported here, as it takes time that few programs need

    # A function of the standard library, which every worker has. In place of the result of a worker
    # that fails stands its error.
    versions = client.run(importlib.metadata.version, "harnack", on_error="return")
    local_version = importlib.metadata.version("harnack")
    for address, version in versions.items():
        if version != local_version:
            remote = f"harnack {version}" if isinstance(version, str) else "no harnack"
            raise RuntimeError(
                f"worker {address} has {remote}, and here it is {local_version}: "
                f"{_INSTALL.format(version=local_version)}"
            )
    # A state is a pair: the versions of packages, and the fingerprint of rounding. In place of the
    # state of a worker that fails stands its error.
    states = client.run(_worker_state, on_error="return")
    for address, state in states.items():
        if isinstance(state, BaseException):
            raise RuntimeError(f"worker {address} cannot work: {state}") from state
        if state[0] != package_versions():
            raise RuntimeError(
                f"worker {address} has {state[0]}, and here it is {package_versions()}: "
                f"{_INSTALL.format(version=local_version)}"
            )
    differing = [address for address, state in states.items() if state[1] != rounding_fingerprint()]
    if differing:
        warn_rounding_differs(differing)


def warn_rounding_differs(workers: Iterable[str]) -> None:
    """Warn that the processors of some workers round differently from that of this process.
    workers: the addresses of these workers."""
    warnings.warn(
        f"the processors of {', '.join(sorted(workers))} round differently from this one: "
        "results are right, but not the same bit for bit as without them",
        stacklevel=4,
    )


def _worker_state(dask_worker: Any = None) -> tuple[str, str]:
    """Return the `package_versions` and the `rounding_fingerprint` of a worker. It is run on the
    worker.

    dask_worker: Dask passes the worker under this name.

    Raises:
        LLVMNotFoundError: Dr.Jit has no backend there.
    """
    choose_backend()
    adopt_worker_threads(dask_worker.nanny is not None, dask_worker.state.nthreads)
    return package_versions(), rounding_fingerprint()


@functools.cache
def adopt_worker_threads(has_nanny: bool, threads: int) -> None:
    """Set Dr.Jit's number of threads to the number `threads` that Dask gave this worker, if the
    process belongs to this worker alone.

    A second call with the same arguments does nothing: users may have set another number since.

    has_nanny: whether Dask runs a supervising process (a nanny) for this worker; then the process
        belongs to it alone.
    """
    if has_nanny:
        dr.set_thread_count(threads)


def rounding_fingerprint() -> str:
    """Return a text that is equal on machines whose kernels give the same bits: the backend's name,
    and a hash of numbers that kernels compute on this machine."""
    name = choose_backend().name
    return f"{name} {_rounding(name)}"


@functools.cache
def _rounding(_name: str) -> str:
    """Return a hash of numbers that kernels of the chosen backend compute: functions that
    processors may round differently. _name: the backend's name, by which the hash is cached."""
    # 4096 numbers from 0.01 to 40, arguments of the functions.
    x = dr.linspace(choose_backend().Float, 0.01, 40, 4096)
    s, c = dr.sincos(x)
    results = (dr.rcp(x), dr.rsqrt(x), s, c, dr.exp(-x), dr.log(x), dr.fma(s, c, x), dr.sqrt(x),
               dr.atan2(s, x), x / c)  # fmt: skip
    numbers = np.concatenate([to_numpy(result) for result in results])
    return hashlib.blake2b(numbers.tobytes(), digest_size=8).hexdigest()
