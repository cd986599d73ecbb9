"""Pictures and films in parts: the same bit for bit, whoever draws them and whatever is lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cluster.executor import CheckpointFolder, Executor, open_executor
from harnack.geometry import example_curves

POLYGON = hk.SolidAngle(example_curves.wavy_polygon(24))
SMALL: dict[str, Any] = {"size": (40, 30), "progress": False}
WAYS: list[dict[str, Any]] = [
    {"show": "path", "spp": 4},
    {"show": "shaded"},
    {"show": "shaded", "antialias": "cones", "isolines": hk.Isolines("z", 0.1)},
    {"show": "value", "color_by": "z"},
    {"show": "evaluations"},
]


def pixels(picture: Any) -> tuple[Any, Any]:
    return np.asarray(picture), picture.srgb


def assert_same(one: Any, other: Any) -> None:
    for a, b in zip(pixels(one), pixels(other), strict=True):
        np.testing.assert_array_equal(a, b)


def kept_parts(folder: Path) -> int:
    """The number of finished files in a folder; one that is being renamed may be listed twice."""
    return sum(".partial" not in name for name in os.listdir(folder))


class Squares:
    """A job of numbers; some parts raise, where a folder is given once it has three others."""

    def __init__(self, calls: list[int] | None = None, folder: Path | None = None) -> None:
        self.calls = calls
        self.folder = folder

    def square(self, k: int) -> dict[str, Any]:
        if self.calls is not None:
            self.calls.append(k)
        if k < 0:
            until = time.monotonic() + 60
            while self.folder and kept_parts(self.folder) < 3 and time.monotonic() < until:
                time.sleep(0.05)
            raise ValueError(f"{k} is negative")
        return {"square": np.array(k * k)}


@pytest.mark.few(1)
@pytest.mark.parametrize("way", WAYS, ids=str)
def test_workers_draw_the_same_picture(way: dict[str, Any], client: Any) -> None:
    alone = hk.render(POLYGON, **SMALL, **way)
    assert_same(hk.render(POLYGON, client=client, **SMALL, **way), alone)
    assert_same(hk.render(POLYGON, client=client, chunks=7, **SMALL, **way), alone)


@pytest.mark.slow
def test_workers_take_the_variant_of_mitsuba(client: Any, tmp_path: Path) -> None:
    """They drew in the variant that they take by themselves."""
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[2])!r})
import harnack as hk, mitsuba as mi, numpy as np
from harnack.geometry import example_curves
mi.set_variant("llvm_ad_mono")
way = {{"size": (24, 18), "progress": False, "show": "path", "spp": 4}}
field = hk.SolidAngle(example_curves.wavy_polygon(24))
alone = hk.render(field, **way)
there = hk.render(field, client={client.scheduler.address!r}, **way)
print(np.array_equal(alone, there), (alone[..., 0] == alone[..., 1]).all())
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["True", "True"]
    one = hk.render(POLYGON, show="path", spp=4, client=client, **SMALL)
    assert_same(one, hk.render(POLYGON, show="path", spp=4, **SMALL))


@pytest.mark.few(1)
@pytest.mark.parametrize("way", WAYS[:2], ids=str)
def test_a_checkpoint_spares_what_is_done(
    way: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = hk.render(POLYGON, **SMALL, **way)
    kept: dict[str, Any] = {"checkpoint": tmp_path, "chunks": 5, **SMALL, **way}
    put: list[str] = []
    own = CheckpointFolder.save

    def counted(self: CheckpointFolder, name: str, arrays: Any) -> None:
        if len(put) == 3:
            raise KeyboardInterrupt
        put.append(name)
        own(self, name, arrays)

    monkeypatch.setattr(CheckpointFolder, "save", counted)
    with pytest.raises(KeyboardInterrupt):
        hk.render(POLYGON, **kept)
    assert len(list(tmp_path.iterdir())) == 3
    monkeypatch.setattr(CheckpointFolder, "save", own)
    there = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert_same(hk.render(POLYGON, **kept), alone)
    assert all((tmp_path / name).stat().st_mtime_ns == when for name, when in there.items())
    parts = len(list(tmp_path.iterdir()))
    other = hk.render(POLYGON, level=4.0, **kept)
    assert not np.array_equal(other, alone)
    assert len(list(tmp_path.iterdir())) >= parts + 5


def test_films_are_the_same_and_grow(tmp_path: Path, client: Any) -> None:
    small: dict[str, Any] = {"size": (24, 18), "progress": False}
    paths = [tmp_path / f"{k}.gif" for k in range(4)]
    hk.animate(POLYGON, paths[0], frames=4, orbit=360, **small)
    hk.animate(POLYGON, paths[1], frames=4, orbit=360, client=client, **small)
    kept: dict[str, Any] = {"checkpoint": tmp_path / "parts", **small}
    hk.animate(POLYGON, paths[2], frames=4, orbit=360, client=client, **kept)
    assert len(list((tmp_path / "parts").iterdir())) == 4
    hk.animate(POLYGON, paths[3], frames=8, orbit=360, **kept)  # at every second place of these
    assert len(list((tmp_path / "parts").iterdir())) == 8
    data = [path.read_bytes() for path in paths]
    assert data[0] == data[1] == data[2] != data[3]


@pytest.mark.slow
def test_a_worker_that_is_killed_takes_nothing_with_it(tmp_path: Path) -> None:
    """Its parts go to the other; a run that is stopped then goes on from what is kept."""
    distributed = pytest.importorskip("distributed")
    way: dict[str, Any] = {"size": (64, 48), "show": "path", "spp": 64, "chunks": 24}
    alone = hk.render(POLYGON, progress=False, **{**way, "chunks": None})
    kept: dict[str, Any] = {**way, "checkpoint": tmp_path}
    local = {"threads_per_worker": 1, "processes": True, "dashboard_address": None}
    done: list[hk.Progress] = []

    def kill(progress: hk.Progress) -> None:
        done.append(progress)
        if len(done) == 4:
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
        if len(done) == 10:
            raise KeyboardInterrupt

    with (
        distributed.LocalCluster(n_workers=2, **local) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
        pytest.raises(KeyboardInterrupt),
    ):
        hk.render(POLYGON, client=client, progress=kill, **kept)
    before = set(tmp_path.iterdir())
    assert len(before) >= 10
    with distributed.LocalCluster(n_workers=2, **local) as cluster:
        again = hk.render(POLYGON, client=cluster.scheduler_address, progress=False, **kept)
    assert before <= set(tmp_path.iterdir())
    assert len(list(tmp_path.iterdir())) == 24
    assert_same(again, alone)


def test_a_job_is_opened_once_by_each_worker(client: Any) -> None:
    from harnack.cluster.serialization import _deserialize_cached

    client.run(_deserialize_cached.cache_clear)
    found = list(Executor(Squares(), client).run_tasks("square", [(k,) for k in range(40)]))
    assert [int(one["square"]) for one in found] == [k * k for k in range(40)]
    assert all(one.misses <= 1 for one in client.run(_deserialize_cached.cache_info).values())


def test_equal_parts_are_done_once(tmp_path: Path) -> None:
    folder = CheckpointFolder.open(tmp_path)
    for _ in range(2):
        found = list(
            Executor(Squares(), checkpoint=folder).run_tasks("square", [(k,) for k in (3, 2, 3, 3)])
        )
        assert [int(one["square"]) for one in found] == [9, 4, 9, 9]
    assert len(list(tmp_path.iterdir())) == 2


def test_errors_of_parts_come_back_and_the_rest_is_kept(client: Any, tmp_path: Path) -> None:
    parts = [(k,) for k in (1, 2, 3, -4, 5)]
    executor = Executor(Squares(folder=tmp_path), client, CheckpointFolder.open(tmp_path))
    with pytest.raises(ValueError, match="-4 is negative"):
        list(executor.run_tasks("square", parts))
    assert kept_parts(tmp_path) >= 3


def test_damaged_parts_are_refused_by_name(tmp_path: Path) -> None:
    folder = CheckpointFolder.open(tmp_path)
    list(Executor(Squares(), checkpoint=folder).run_tasks("square", [(3,)]))
    (path,) = tmp_path.iterdir()
    for damaged in (b"", path.read_bytes()[:40], b"no numbers"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=f"{path.name} is damaged.*delete it"):
            list(Executor(Squares(), checkpoint=folder).run_tasks("square", [(3,)]))


@pytest.mark.parametrize("chunks", [1, 3, 100])
@pytest.mark.parametrize("count", [0, 1, 17])
def test_runs_hold_everything_once(count: int, chunks: int) -> None:
    runs = Executor(Squares(), chunks=chunks).split_range(count, 6)
    assert [k for start, stop in runs for k in range(start, stop)] == list(range(count))
    assert all(0 < stop - start <= 6 for start, stop in runs)


def everything_refused(tmp_path: Path) -> Iterator[tuple[dict[str, Any], str]]:
    (tmp_path / "file").write_text("")
    yield {"client": 3}, "client must be a dask"
    yield {"client": "tcp://127.0.0.1:1"}, "no scheduler answers"
    yield {"checkpoint": tmp_path / "file"}, "is a file: name a folder"
    yield {"chunks": 3}, "with a client or a checkpoint"
    for wrong in (0, True, 2.5, "3", float("nan")):
        yield {"chunks": wrong, "checkpoint": tmp_path}, "chunks must be an integer from 1"


def test_wrong_settings_are_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("harnack.cluster.workers._CONNECT_TIMEOUT", "0.2s")
    for settings, message in everything_refused(tmp_path):
        with pytest.raises((TypeError, ValueError, OSError), match=message):
            hk.render(POLYGON, **SMALL, **settings)


def test_scenes_that_others_cannot_load_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="give the scene as a dictionary"):
        hk.render(hk.rendering.register().load_dict(hk_scene()), checkpoint=tmp_path, **PLAIN)


PLAIN: dict[str, Any] = {"progress": False, "show": "normal"}


def hk_scene() -> dict[str, Any]:
    return {"type": "scene", "sensor": {"type": "perspective"}, "ball": {"type": "sphere"}}


@pytest.mark.parametrize("missing", ["client", "checkpoint"])
def test_what_is_missing_is_told(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("distributed", "cloudpickle", "dask"):
        monkeypatch.setitem(__import__("sys").modules, name, None)
    given = {"client": "tcp://127.0.0.1:8786", "checkpoint": tmp_path}[missing]
    with pytest.raises(ModuleNotFoundError, match=rf"{missing} needs .*harnack\[cluster\]"):
        hk.render(POLYGON, **SMALL, **{missing: given})
    hk.render(POLYGON, show="normal", **SMALL)


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ([{"tcp://a:1": ModuleNotFoundError("x")}], "worker tcp://a:1 has no harnack"),
        ([{"tcp://a:1": "0.0.0"}], "worker tcp://a:1 has harnack 0.0.0, and here it is"),
        ([None, {"tcp://b:2": RuntimeError("no LLVM: apt install libllvm19")}],
         "worker tcp://b:2 cannot work: no LLVM"),
        ([None, {"tcp://b:2": ("drjit 1.0", "x")}], "worker tcp://b:2 has drjit 1.0, and here"),
    ],
)  # fmt: skip
def test_workers_that_cannot_work_are_refused_by_name(
    answers: Sequence[Any], message: str, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, asked = client.run, iter(answers)

    def run(*given: Any, **settings: Any) -> Any:
        answer = next(asked)
        return own(*given, **settings) if answer is None else answer

    monkeypatch.setattr(client, "run", run)
    with pytest.raises(RuntimeError, match=message), open_executor(Squares(), client):
        pass


def test_other_processors_are_told_of(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harnack.cluster.workers.rounding_fingerprint", lambda: "another")
    with pytest.warns(UserWarning, match="round differently"), open_executor(Squares(), client):
        pass


def test_workers_that_came_late_are_told_of(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harnack.cluster.executor.worker_threads", lambda _: {})
    monkeypatch.setattr("harnack.cluster.executor.rounding_fingerprint", lambda: "another")
    with pytest.warns(UserWarning, match=r"processors of tcp://.* round differently"):
        list(Executor(Squares(), client).run_tasks("square", [(2,)]))


def test_a_lost_scheduler_is_told(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost() -> None:
        raise OSError("Connection reset by peer")

    monkeypatch.setattr(client, "nthreads", lost)
    with pytest.raises(RuntimeError, match="the scheduler was lost"):
        list(Executor(Squares(), client).run_tasks("square", [(2,)]))
