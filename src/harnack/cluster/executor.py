"""A task in parts, done here or by a cluster; finished parts are kept in a folder if one is named.

Parts are named by what they are made of, so that a folder can be used again after a crash, with
other workers, or for a film with more frames: what is there is not done again, and what belongs to
something else is not touched.
"""

from __future__ import annotations

import asyncio
import os
import time
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.cluster.serialization import Packed, load_module, name_of
from harnack.cluster.workers import (
    SCHEDULER_LOST,
    alone,
    connected,
    fingerprint,
    warn_of_rounding,
    worker_threads,
)
from harnack.files.file_geometry import check_writable, write_atomically

Arrays = dict[str, npt.NDArray[Any]]
"""What a part gives, by name, and all of it: it is sent and kept as plain numbers."""
Step = Callable[..., Arrays]

# Parts in the hands of the cluster for each of its threads. More hide the time that messages take;
# results wait in the memory of workers.
_AHEAD = 3
# Parts that a task is cut into for each thread, so that all end at about the same time.
_OF_A_THREAD = 6
# Seconds between two looks at what is done, and without a worker until a warning says so.
_PAUSE, _ALONE = 0.005, 20.0


@dataclass(frozen=True)
class Folder:
    """Finished parts, a file of arrays for each."""

    path: Path

    @classmethod
    def at(cls, path: str | os.PathLike[str]) -> Folder:
        """A folder, made if it is not there.

        Raises:
            OSError: it cannot be made, or no file can be created in it.
        """
        folder = Path(path)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise FileExistsError(f"checkpoint {folder} is a file: name a folder") from None
        check_writable(folder / "part.npz")
        return cls(folder)

    def get(self, name: str) -> Arrays | None:
        """The arrays of a part, None if it is not there.

        Raises:
            ValueError: the file is damaged.
        """
        path = self._file(name)
        if not path.exists():
            return None
        try:
            with np.load(path, allow_pickle=False) as found:
                return {name: found[name] for name in found.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{path} is damaged ({error}): delete it, and it is made anew"
            ) from None

    def has(self, name: str) -> bool:
        """Whether a part is there."""
        return self._file(name).exists()

    def put(self, name: str, arrays: Arrays) -> None:
        """Write the arrays of a part."""
        with write_atomically(self._file(name)) as partial:
            np.savez(partial, allow_pickle=False, **arrays)

    def _file(self, name: str) -> Path:
        return self.path / f"{name}.npz"


@dataclass(frozen=True)
class Crew:
    """Who does the parts of tasks (`crew`).

    client: a Dask client, None for this process. folder: where finished parts are kept, None for
    nowhere. tiles: how many parts a task is cut into, None for as many as suit the workers.
    """

    client: Any = None
    folder: Folder | None = None
    tiles: int | None = None

    def cut(self, count: int, most: int) -> list[tuple[int, int]]:
        """(start, stop) of runs of things that are counted from 0, at most `most` a run."""
        size = max(1, min(most, count))
        if self.tiles is not None:
            size = max(1, min(size, -(-count // self.tiles)))
        elif self.client is not None:
            size = max(1, min(size, -(-count // (_OF_A_THREAD * self._threads()))))
        return [(start, min(start + size, count)) for start in range(0, count, size)]

    def each(self, job: Any, step: str, parts: Sequence[tuple[Any, ...]]) -> Iterator[Arrays]:
        """What the method `step` of a job gives for the arguments of each part, in their order.

        job: what `Packed.of` takes. It is sent to each worker once, and opened there once.
        """
        if self.client is None and self.folder is None:
            do: Step = getattr(job, step)
            for part in parts:
                yield do(*part)
            return
        packed = Packed.of(job, "checkpoint" if self.client is None else "client")
        names = [f"{packed.name}-{step}-{name_of(part, 'a part')}" for part in parts]
        doing = _Here(packed, step) if self.client is None else _There(self.client, packed, step)
        try:
            yield from _in_order(names, parts, self.folder, doing, self._ahead)
        finally:
            for name, arrays in doing.end():
                if self.folder is not None:
                    self.folder.put(name, arrays)

    def _ahead(self) -> int:
        return 1 if self.client is None else _AHEAD * self._threads()

    def _threads(self) -> int:
        return max(1, sum(worker_threads(self.client).values()))


@contextmanager
def crew(client: Any = None, checkpoint: Any = None, tiles: int | None = None) -> Generator[Crew]:
    """A crew, from the arguments of those who have something done.

    Raises:
        ModuleNotFoundError, TypeError, OSError, RuntimeError: as `connected` and `Folder.at`.
    """
    folder = None
    if checkpoint is not None:
        load_module("cloudpickle", "checkpoint")
        folder = Folder.at(checkpoint)
    with connected(client) as one:
        yield Crew(one, folder, tiles)


class _Here:
    """Parts that this process does, one after the other."""

    def __init__(self, packed: Packed, step: str) -> None:
        self.do: Step = getattr(packed.open(), step)
        self.waiting: list[tuple[str, tuple[Any, ...]]] = []

    def begin(self, name: str, part: tuple[Any, ...]) -> None:
        """Have a part done."""
        self.waiting.append((name, part))

    def next_done(self) -> tuple[str, Arrays]:
        """The name and the arrays of a part that is done."""
        name, part = self.waiting.pop(0)
        return name, self.do(*part)

    def end(self) -> list[tuple[str, Arrays]]:
        """Forget what is not done; what is done and nobody asked for."""
        return []


class _There:
    """Parts that workers do. A lost worker's parts go to others: Dask sees to that."""

    def __init__(self, client: Any, packed: Packed, step: str) -> None:
        distributed = load_module("distributed", "client")
        self.client, self.step = client, step
        self.worker_lost = distributed.KilledWorker
        self.scheduler_lost = load_module("distributed.client", "client").FuturesCancelledError
        self.done = distributed.as_completed(loop=client.loop)
        self.names: dict[Any, str] = {}
        self.looked_at = set(worker_threads(client))
        # As a task and not as data in a worker's memory, which would be lost with that worker.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sending large graph")
            self.packed = client.submit(_same, packed, key=f"harnack-{packed.name}")

    def begin(self, name: str, part: tuple[Any, ...]) -> None:
        """Have a part done."""
        future = self.client.submit(_done, self.packed, self.step, part, key=name)
        self.names[future] = name
        self.done.add(future)

    def next_done(self) -> tuple[str, Arrays]:
        """The name and the arrays of a part that is done.

        Raises what the part raised; RuntimeError: it took several workers with it, or the scheduler
        is gone.
        """
        self._wait()
        future = next(self.done)
        try:
            arrays, worker, rounding = future.result()
        except self.worker_lost as error:
            raise RuntimeError(
                f"several workers were lost while they did one part ({error}): it may need more "
                "memory than they have. Cut the task into more parts (tiles=), or give them more"
            ) from None
        except (asyncio.CancelledError, self.scheduler_lost):
            raise RuntimeError(SCHEDULER_LOST) from None
        name = self.names.pop(future)
        future.release()
        if worker not in self.looked_at:
            self.looked_at.add(worker)
            if rounding != fingerprint():
                warn_of_rounding([worker])
        return name, arrays

    def _wait(self) -> None:
        """Until a part is done. A warning says if nobody is there to do one."""
        alone_since, warned = None, False
        look_again = time.monotonic() + 1
        while not self.done.has_ready():
            time.sleep(_PAUSE)
            now = time.monotonic()
            if now < look_again:
                continue
            look_again = now + 1
            if worker_threads(self.client):
                alone_since = None
                continue
            alone_since = alone_since or now
            if now - alone_since > _ALONE and not warned:
                warned = True
                warnings.warn("the cluster has no worker: this waits for one", stacklevel=2)

    def end(self) -> list[tuple[str, Arrays]]:
        """Forget what is not done; what is done and nobody asked for."""
        ready = [one for one in self.names if one.status == "finished"]
        found: list[tuple[str, Arrays]] = []
        # Without a scheduler there is nobody to ask; what is raised already says so.
        with suppress(OSError, TimeoutError, asyncio.CancelledError, self.scheduler_lost):
            self.client.cancel([one for one in self.names if one.status != "finished"])
            for one in ready:
                found.append((self.names[one], one.result(timeout=_ALONE)[0]))
        self.names.clear()
        self.packed.release()
        return found


def _in_order(
    names: list[str],
    parts: Sequence[tuple[Any, ...]],
    folder: Folder | None,
    doing: _Here | _There,
    ahead: Callable[[], int],
) -> Iterator[Arrays]:
    """The arrays of parts in their order, several of which are done at the same time.

    A part that occurs several times is done once.
    """
    found: dict[str, Arrays] = {}
    waiting: set[str] = set()
    uses, begun = Counter(names), 0

    def begin(index: int) -> None:
        doing.begin(names[index], parts[index])
        waiting.add(names[index])

    for index, name in enumerate(names):
        kept = None if folder is None or name in found else folder.get(name)
        if kept is not None:
            yield kept
            continue
        if name not in found and name not in waiting:
            begin(index)
        begun = max(begun, index + 1)
        while name not in found:
            most = ahead()
            while begun < len(names) and len(waiting) + len(found) < most:
                other = names[begun]
                if (
                    other not in waiting
                    and other not in found
                    and not (folder and folder.has(other))
                ):
                    begin(begun)
                begun += 1
            done, arrays = doing.next_done()
            waiting.remove(done)
            found[done] = arrays
            if folder is not None:
                folder.put(done, arrays)
        uses[name] -= 1
        yield found[name] if uses[name] else found.pop(name)


def _same(packed: Packed) -> Packed:
    return packed


def _done(packed: Packed, step: str, part: tuple[Any, ...]) -> tuple[Arrays, str, str]:
    """A part, done by this worker; the worker's address, and its `fingerprint`."""
    with alone() as address:
        do: Step = getattr(packed.open(), step)
        return do(*part), address, fingerprint()
