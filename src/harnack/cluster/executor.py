"""Runs jobs as tasks, in this process or on a Dask cluster, and may keep results in a checkpoint
folder. A "job" is an object; a "task" is one call of a method of the job, which returns arrays by
name. A "future" is Dask's handle for a task that may still run.

Each task is named by a hash of its contents, including files and users' code but not cached values
(`serialization`, `users_code`). The name alone identifies a stored result. So a checkpoint folder
can be used again after a crash, with other workers, or for a film with more frames: finished tasks
are not repeated, and results of other jobs are left alone.

All jobs take the same path. A picture is always computed band by band, in this process or on Dask's
workers, so that the result is the same bit for bit. Steps that need the whole picture (hidden sky,
outlines) run in the process that assembles it. A job is sent as a Dask task, not as data in a
worker's memory, because such data would be lost with the worker.
"""

from __future__ import annotations

import os
import time
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.cluster.serialization import SerializedObject, content_hash, import_cluster_package
from harnack.cluster.workers import (
    SCHEDULER_LOST,
    connect_client,
    exclusive_compute,
    rounding_fingerprint,
    warn_rounding_differs,
    worker_threads,
)
from harnack.files.file_geometry import check_writable, write_atomically

TaskResult = dict[str, npt.NDArray[Any]]
"""The result of a task: arrays by name, and nothing else. They are sent and stored as they are."""
TaskFunction = Callable[..., TaskResult]

# The number of tasks that the cluster holds at a time, for each of its threads. With more tasks no
# thread waits for messages, but more results wait in the memory of workers.
_PENDING_PER_THREAD = 3
# The number of tasks per thread that a job is split into, so that all threads end at about the same
# time.
_TASKS_PER_THREAD = 6
# Seconds between two queries for finished tasks; and seconds without any worker before a warning.
_POLL_SECONDS, _NO_WORKER_SECONDS = 0.005, 20.0


@dataclass(frozen=True)
class CheckpointFolder:
    """A folder that stores the results of finished tasks, one .npz file for each."""

    path: Path

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> CheckpointFolder:
        """Open a checkpoint folder; it is created if it does not exist.

        Raises:
            TypeError: `path` is not the path of a folder.
            OSError: the folder cannot be created, or no file can be created in it.
        """
        try:
            folder = Path(path)
        except TypeError:
            raise TypeError(f"checkpoint must be the path of a folder, not {path!r:.60}") from None
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise FileExistsError(f"checkpoint {folder} is a file: name a folder") from None
        check_writable(folder / "part.npz")
        return cls(folder)

    def load(self, name: str) -> TaskResult | None:
        """Read and return the stored result of the task with this name; None if the folder has
        none.

        Raises:
            ValueError: the file is damaged.
        """
        import zipfile  # imported here: few pictures need it

        path = self._file(name)
        if not path.exists():
            return None
        try:
            with np.load(path, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{path} is damaged ({error}): delete it, and it is made anew"
            ) from None

    def has(self, name: str) -> bool:
        """Return whether the folder has a result of the task with this name."""
        return self._file(name).exists()

    def save(self, name: str, arrays: TaskResult) -> None:
        """Store `arrays`, the result of the task with this name."""
        with write_atomically(self._file(name)) as partial:
            np.savez(partial, allow_pickle=False, **arrays)

    def _file(self, name: str) -> Path:
        """Return the path of the file for the result of the task with this name."""
        return self.path / f"{name}.npz"


@dataclass(frozen=True)
class Executor:
    """Runs the tasks of a job. `open_executor` makes one for a cluster or a checkpoint folder;
    `Executor(job)` calls the job's methods in this process.

    job: the object whose methods are called. With a client or a checkpoint, it must be one that
        `SerializedObject.serialize` accepts, and its methods return arrays by name. It is sent to
        each worker once, and deserialized there once.
    client: a Dask client whose workers run the tasks; None to run them in this process.
    checkpoint: the folder that stores results; None for no folder.
    chunks: the number of tasks that a job is split into; None for a number that suits the workers.
    decode: turns the arrays that a task of the method with the given name returned into the result;
        None to leave them as they are.
    """

    job: Any
    client: Any = None
    checkpoint: CheckpointFolder | None = None
    chunks: int | None = None
    decode: Callable[[str, TaskResult], Any] | None = None

    @property
    def is_local(self) -> bool:
        """Whether tasks are plain calls in this process, whose results are stored nowhere."""
        return self.client is None and self.checkpoint is None

    def split_range(self, count: int, max_size: int) -> list[tuple[int, int]]:
        """Split range(count) into intervals (start, stop) of at most `max_size` numbers each; each
        interval is to be a task. If `chunks` is set, the intervals are made shorter until there are
        about so many of them. If it is not set but there is a client, they are made shorter until
        there are about six for each thread of its workers."""
        size = max(1, min(max_size, count))
        # Quotients are rounded up.
        if self.chunks is not None:
            size = max(1, min(size, -(-count // self.chunks)))
        elif self.client is not None:
            size = max(1, min(size, -(-count // (_TASKS_PER_THREAD * self._threads()))))
        return [(start, min(start + size, count)) for start in range(0, count, size)]

    def run_tasks(self, step: str, parts: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Call the method `step` of the job with the arguments of each part, and yield the results
        in the order of the parts. In this process each is computed when it is asked for.

        step: the name of the method.
        parts: for each task, a tuple of the method's arguments.

        Raises the errors of the method.
        """
        method = getattr(self.job, step)
        plain_calls = (method(*part) for part in parts)
        for result in plain_calls if self.is_local else self._run_named(step, parts):
            yield result if self.decode is None else self.decode(step, result)

    def _run_named(self, step: str, parts: Sequence[tuple[Any, ...]]) -> Iterator[TaskResult]:
        """Do what `run_tasks` does by tasks that have names, by which their results are stored."""
        packed = SerializedObject.serialize(
            self.job, "checkpoint" if self.client is None else "client"
        )
        names = [f"{packed.content_hash}-{step}-{content_hash(part, 'a part')}" for part in parts]
        runner = (
            _LocalTasks(packed, step)
            if self.client is None
            else _DaskTasks(self.client, packed, step)
        )
        try:
            yield from _ordered_results(names, parts, self.checkpoint, runner, self._max_pending)
        finally:
            # After an error, results that are finished already are stored.
            for name, arrays in runner.cancel():
                if self.checkpoint is not None:
                    self.checkpoint.save(name, arrays)

    def _max_pending(self) -> int:
        """Return the largest number of tasks that may be started ahead, that is before their
        results are yielded: three for each thread of the workers, or one in this process."""
        return 1 if self.client is None else _PENDING_PER_THREAD * self._threads()

    def _threads(self) -> int:
        """Return the number of threads of all workers of the client, at least 1."""
        return max(1, sum(worker_threads(self.client).values()))


@contextmanager
def open_executor(
    job: Any, client: Any = None, checkpoint: Any = None, chunks: int | None = None
) -> Generator[Executor]:
    """Context manager that yields an `Executor` of a job for the workers of a Dask cluster or for
    this process.

    job: the object whose methods are called, as for `Executor`.
    client: a Dask client, the address of a scheduler, or None for this process.
    checkpoint: the path of a folder that stores results, or None.
    chunks: the number of tasks that a job is split into; None for a number that suits the workers.

    Raises:
        ModuleNotFoundError: Dask or cloudpickle is not installed.
        TypeError: client is neither a client nor an address, or checkpoint is no path.
        OSError: no scheduler answers at the address, or the folder cannot be written.
        RuntimeError: a worker cannot run the tasks.
    """
    folder = None
    if checkpoint is not None:
        import_cluster_package("cloudpickle", "checkpoint")
        folder = CheckpointFolder.open(checkpoint)
    with connect_client(client) as dask_client:
        yield Executor(job, dask_client, folder, chunks)


class _LocalTasks:
    """Runs the tasks of a job in this process, one after the other. It has the same methods as
    `_DaskTasks`.

    do: the job's method that a task calls.
    waiting: (name, arguments) of the tasks that were submitted and not run yet.
    """

    def __init__(self, packed: SerializedObject, step: str) -> None:
        """Prepare the tasks of the serialized job `packed`. step: the name of the job's method that
        a task calls."""
        self.do: TaskFunction = getattr(packed.deserialize(), step)
        self.waiting: list[tuple[str, tuple[Any, ...]]] = []

    def submit(self, name: str, part: tuple[Any, ...]) -> None:
        """Add a task to the waiting ones. name: the name of the task. part: the arguments of the
        method."""
        self.waiting.append((name, part))

    def next_completed(self) -> tuple[str, TaskResult]:
        """Run the next waiting task, and return its name and its result."""
        name, part = self.waiting.pop(0)
        return name, self.do(*part)

    def cancel(self) -> list[tuple[str, TaskResult]]:
        """Return the (name, result) of the tasks that are finished but whose results were not
        fetched: always none here, since a task is run only when its result is fetched."""
        return []


class _DaskTasks:
    """Runs the tasks of a job on the workers of a Dask cluster. If a worker is lost, Dask runs its
    tasks on another one.

    completed: Dask's iterator of finished futures.
    names: the name of the task of each future that was not fetched yet.
    checked_workers: addresses of the workers whose rounding was compared with that of this process.
    packed: the future of the serialized job.
    """

    def __init__(self, client: Any, packed: SerializedObject, step: str) -> None:
        """Send the serialized job `packed` to the cluster of `client`. step: the name of the job's
        method that a task calls."""
        distributed = import_cluster_package("distributed", "client")
        self.client, self.step = client, step
        # Classes of errors of Dask, by which lost workers and a lost scheduler are recognized.
        self.worker_lost = distributed.KilledWorker
        self.scheduler_lost = import_cluster_package(
            "distributed.client", "client"
        ).FuturesCancelledError
        self.completed = distributed.as_completed(loop=client.loop)
        self.names: dict[Any, str] = {}
        self.checked_workers = set(worker_threads(client))
        # As a task and not as data in a worker's memory, which would be lost with that worker.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sending large graph")
            self.packed = client.submit(_unchanged, packed, key=f"harnack-{packed.content_hash}")

    def submit(self, name: str, part: tuple[Any, ...]) -> None:
        """Send a task to the cluster. name: the name of the task. part: the arguments of the
        method."""
        future = self.client.submit(_run_task, self.packed, self.step, part, key=name)
        self.names[future] = name
        self.completed.add(future)

    def next_completed(self) -> tuple[str, TaskResult]:
        """Wait for a finished task, and return its name and its result. An error of the task is
        raised here. Warns if the worker that ran it rounds differently from this process.

        Raises:
            RuntimeError: several workers were lost while they ran the task, or the scheduler is
                gone.
        """
        from asyncio import CancelledError  # imported here: it takes time that few programs need

        self._wait()
        future = next(self.completed)
        try:
            arrays, worker, rounding = future.result()
        except self.worker_lost as error:
            raise RuntimeError(
                f"several workers were lost while they did one part ({error}): it may need more "
                "memory than they have. Divide the task into more parts (chunks), or give them more"
            ) from None
        except (CancelledError, self.scheduler_lost):
            raise RuntimeError(SCHEDULER_LOST) from None
        name = self.names.pop(future)
        future.release()
        if worker not in self.checked_workers:
            self.checked_workers.add(worker)
            if rounding != rounding_fingerprint():
                warn_rounding_differs([worker])
        return name, arrays

    def _wait(self) -> None:
        """Wait until a task is finished, and warn once if the cluster has no worker for 20
        seconds."""
        idle_since, has_warned = None, False
        next_check = time.monotonic() + 1
        while not self.completed.has_ready():
            time.sleep(_POLL_SECONDS)
            now = time.monotonic()
            if now < next_check:
                continue
            next_check = now + 1
            if worker_threads(self.client):
                idle_since = None
                continue
            idle_since = idle_since or now
            if now - idle_since > _NO_WORKER_SECONDS and not has_warned:
                has_warned = True
                warnings.warn("the cluster has no worker: this waits for one", stacklevel=2)

    def cancel(self) -> list[tuple[str, TaskResult]]:
        """Cancel unfinished tasks, and return (name, result) of the tasks that are finished but
        whose results were not fetched."""
        from asyncio import CancelledError  # imported here: it takes time that few programs need

        finished = [future for future in self.names if future.status == "finished"]
        results: list[tuple[str, TaskResult]] = []
        # Without a scheduler there are no results to fetch; the error that is raised says so.
        # (`_run_task` returns the arrays first.)
        with suppress(OSError, TimeoutError, CancelledError, self.scheduler_lost):
            self.client.cancel([future for future in self.names if future.status != "finished"])
            for future in finished:
                results.append((self.names[future], future.result(timeout=_NO_WORKER_SECONDS)[0]))
        self.names.clear()
        self.packed.release()
        return results


def _ordered_results(
    names: list[str],
    arguments: Sequence[tuple[Any, ...]],
    folder: CheckpointFolder | None,
    runner: _LocalTasks | _DaskTasks,
    max_pending: Callable[[], int],
) -> Iterator[TaskResult]:
    """Yield the results of tasks in their order, while several tasks run at the same time. A task
    that occurs several times is run once.

    names: the name of each task; equal names are the same task.
    arguments: the arguments of each task.
    folder: the folder in which results are looked up and stored; None for no folder.
    runner: runs the tasks.
    max_pending: returns the largest number of tasks that may be started ahead, that is before their
        results are yielded.
    """
    results: dict[str, TaskResult] = {}
    pending: set[str] = set()
    uses_left, next_index = Counter(names), 0

    def submit(index: int) -> None:
        """Start the task with this index."""
        runner.submit(names[index], arguments[index])
        pending.add(names[index])

    for index, name in enumerate(names):
        stored_result = None if folder is None or name in results else folder.load(name)
        if stored_result is not None:
            yield stored_result
            continue
        if name not in results and name not in pending:
            submit(index)
        next_index = max(next_index, index + 1)
        # Until the next result in order is there: start as many tasks as allowed, and wait for one.
        while name not in results:
            # The number of workers may change.
            limit = max_pending()
            while next_index < len(names) and len(pending) + len(results) < limit:
                next_name = names[next_index]
                if (
                    next_name not in pending
                    and next_name not in results
                    and not (folder and folder.has(next_name))
                ):
                    submit(next_index)
                next_index += 1
            finished_name, arrays = runner.next_completed()
            pending.remove(finished_name)
            results[finished_name] = arrays
            if folder is not None:
                folder.save(finished_name, arrays)
        uses_left[name] -= 1
        # A result is dropped when no later task has the same name.
        yield results[name] if uses_left[name] else results.pop(name)


def _unchanged(packed: SerializedObject) -> SerializedObject:
    """Return the argument, a serialized job. This is the Dask task on whose result all tasks of the
    job depend."""
    return packed


def _run_task(
    packed: SerializedObject, step: str, arguments: tuple[Any, ...]
) -> tuple[TaskResult, str, str]:
    """Run one task on this worker: call the method `step` of the serialized job `packed` with
    `arguments`. Returns its result, the worker's address, and the worker's `rounding_fingerprint`.
    """
    with exclusive_compute() as address:
        method: TaskFunction = getattr(packed.deserialize(), step)
        return method(*arguments), address, rounding_fingerprint()
