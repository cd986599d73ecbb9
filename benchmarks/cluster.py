"""One worker of a cluster and two, here: queries that do not fit into memory, and tiles."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import harnack as hk
from harnack.geometry import example_curves, example_meshes

POINTS, CHUNK, MEMORY = 100_000_000, 1_000_000, "1GB"
# Number of chunks with which one worker alone is measured.
_FEW = 20
_PICTURE: dict[str, Any] = {"size": (640, 480), "spp": 16, "show": "path", "progress": False}


def cluster() -> str:
    """Throughputs, as text."""
    lines = [
        f"Each worker is a process with one thread. *Queries*: {POINTS:,} winding numbers of a "
        f"mesh of {len(_mesh().mesh.faces):,} faces with holes, whose points come from a Zarr file "
        f"of {POINTS * 12 / 1e9:.1f} GB, while a worker may use {MEMORY}, and whose values go to "
        f"another; one worker alone does {_FEW * CHUNK:,} of them. "
        "*Tiles*: a path-traced picture of a polygon of 64 edges, "
        f"{_PICTURE['size'][0]} x {_PICTURE['size'][1]}, {_PICTURE['spp']} samples. Kernels are "
        "compiled before.\n",
        "| | one worker | two workers | |",
        "|---|---:|---:|---:|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        _write_points(Path(folder, "points.zarr"))
        one, _ = _queries(Path(folder), 1, _FEW)
        two, memory = _queries(Path(folder), 2, POINTS // CHUNK)
    rates = " | ".join(f"{rate / 1e6:.2f} million" for rate in (one, two))
    lines.append(f"| queries a second | {rates} | {two / one:.2f} x |")
    one, two = (_tiles(workers) for workers in (1, 2))
    lines.append(f"| seconds for the picture | {one:.1f} | {two:.1f} | {one / two:.2f} x |")
    lines.append(f"\nThe most memory that a worker used for queries was {memory / 1e9:.2f} GB.")
    return "## Clusters\n\n" + "\n".join(lines) + "\n"


def _mesh() -> hk.WindingNumber:
    vertices, faces = example_meshes.torus_mesh(1.0, 0.4, 190, 190)
    return hk.WindingNumber(vertices, example_meshes.remove_faces(faces, 0.02, seed=0))


@contextmanager
def _client(workers: int) -> Iterator[Any]:
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, memory_limit=MEMORY, processes=True,
            dashboard_address=None,
        ) as local,
        Client(local, set_as_default=False) as client,
    ):  # fmt: skip
        yield client


def _write_points(path: Path) -> None:
    import zarr

    file = zarr.create_array(str(path), shape=(POINTS, 3), chunks=(CHUNK, 3), dtype="float32")
    rng = np.random.default_rng(0)
    for start in range(0, POINTS, CHUNK):
        file[start : start + CHUNK] = rng.uniform(-1.5, 1.5, (CHUNK, 3)).astype(np.float32)


def _queries(folder: Path, workers: int, chunks: int) -> tuple[float, float]:
    """Queries a second, and the largest number of bytes that a worker used."""
    import dask.array as da

    points = da.from_zarr(str(folder / "points.zarr"))
    field = _mesh()
    with _client(workers) as client:
        for k in range(2 * workers):  # each compiles
            block = points[k * CHUNK : k * CHUNK + CHUNK // 10]
            client.compute(field.value(block)).result()
        start = time.perf_counter()
        values = field.value(points[: chunks * CHUNK])
        hk.io.to_zarr(values, folder / f"{workers}.zarr", client=client, progress=workers == 2)
        seconds = time.perf_counter() - start
        peak = max(client.run(_peak).values())
    return chunks * CHUNK / seconds, peak


def _peak() -> int:
    """The largest number of bytes that this process has used."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _tiles(workers: int) -> float:
    """Seconds for the second of two pictures."""
    field = hk.SolidAngle(example_curves.wavy_polygon(64))
    seconds = 0.0
    with _client(workers) as client:
        for seed in range(2):
            start = time.perf_counter()
            hk.render(field, client=client, seed=seed, **_PICTURE)
            seconds = time.perf_counter() - start
    return seconds
