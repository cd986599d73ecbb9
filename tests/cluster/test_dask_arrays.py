"""Dask arrays of points and rays, and Zarr files."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cluster.dask_arrays import is_dask_array
from harnack.gallery import SCENES
from harnack.geometry import example_curves

dask = pytest.importorskip("dask")
da = pytest.importorskip("dask.array")
RNG = np.random.default_rng(1)
POINTS, DIRECTIONS = RNG.normal(size=(2, 300, 3))
POLYGON = hk.SolidAngle(example_curves.wavy_polygon(24))
FIELDS = [POLYGON, SCENES["soup"].surfaces()[0].field, hk.Sphere(1.0), hk.Gyroid(2.0)]


@pytest.fixture(scope="module")
def points() -> Any:
    return da.from_array(POINTS, chunks=(110, 2))


@pytest.fixture(scope="module")
def directions() -> Any:
    return da.from_array(DIRECTIONS, chunks=(300, 3))


@pytest.mark.slow
@pytest.mark.parametrize("field", FIELDS, ids=lambda field: type(field).__name__)
def test_blocks_give_what_whole_arrays_give(field: hk.Field, points: Any, directions: Any) -> None:
    for name, more in (("value", {}), ("gradient", {"precision": "double"}), ("hessian", {})):
        lazy, expected = (getattr(field, name)(one, **more) for one in (points, POINTS))
        assert is_dask_array(lazy)
        assert lazy.shape == expected.shape
        assert lazy.dtype == expected.dtype
        np.testing.assert_array_equal(lazy.compute(), expected)
    hits, expected = hk.trace(field, points, directions), hk.trace(field, POINTS, DIRECTIONS)
    for name, found in dask.compute(vars(hits))[0].items():
        np.testing.assert_array_equal(found, getattr(expected, name))
    assert int(hits.is_hit.sum().compute()) == expected.is_hit.sum()


def test_distances_by_blocks(points: Any) -> None:
    first = hk.signed_distance(POLYGON, points, method="first_order").compute()
    np.testing.assert_array_equal(first, hk.signed_distance(POLYGON, POINTS, method="first_order"))
    bounds = hk.distance.distance_bounds(hk.Sphere(1.0), points)
    lower, upper = dask.compute(bounds.lower, bounds.upper)
    true = np.abs(np.linalg.norm(POINTS, axis=1) - 1)
    assert (lower <= true + 1e-12).all()
    assert (true <= upper + 1e-12).all()


def test_crossings_and_rays_that_share_a_direction(points: Any) -> None:
    down = [[0.0, 0.0, -1.0]]
    lazy = hk.crossings(POLYGON, points, down, max_crossings=2, t_max=np.full(300, 4.0))
    expected = hk.crossings(POLYGON, POINTS, down, max_crossings=2, t_max=np.full(300, 4.0))
    np.testing.assert_array_equal(lazy.t.compute(), expected.t)


def test_a_cluster_gives_the_same_and_opens_a_field_once(points: Any, client: Any) -> None:
    from harnack.cluster.serialization import _deserialize_cached

    client.run(_deserialize_cached.cache_clear)
    found = client.compute(FIELDS[1].value(points)).result()
    np.testing.assert_array_equal(found, FIELDS[1].value(POINTS))
    assert all(one.misses <= 1 for one in client.run(_deserialize_cached.cache_info).values())


def test_names_are_the_same_in_every_run(points: Any) -> None:
    assert (
        POLYGON.value(points).name
        == hk.SolidAngle(example_curves.wavy_polygon(24)).value(points).name
    )
    names = {
        POLYGON.value(points).name,
        POLYGON.value(points + 1).name,
        POLYGON.value(points, precision="double").name,
        POLYGON.gradient(points).name,
        hk.SolidAngle(example_curves.wavy_polygon(25)).value(points).name,
    }
    assert len(names) == 5


def refused(points: Any, directions: Any) -> list[tuple[Callable[[], Any], str]]:
    bad = da.from_array(np.where(np.arange(300)[:, None] == 250, np.nan, POINTS), chunks=110)
    return [
        (lambda: POLYGON.value(da.zeros((10, 4))), r"points must have shape .*\(10, 4\)"),
        (lambda: POLYGON.value(da.zeros((10, 3), dtype=complex)), "real numbers"),
        (lambda: POLYGON.value(points, precision="x"), "precision"),
        (lambda: POLYGON.value(bad).compute(), "begins at row 220: points has NaN"),
        (lambda: POLYGON.value(points[points[:, 0] > 0]), "compute_chunk_sizes"),
        (lambda: hk.trace(POLYGON, points, directions[:7]), "directions has 7 entries"),
        (lambda: hk.trace(POLYGON, points, directions, level=da.ones(2)), "level cannot be a Dask"),
        (lambda: POLYGON.value(da.zeros(())), r"points must have shape .*, not \(\)"),
    ]


@pytest.mark.parametrize("which", range(8))
def test_wrong_arrays_are_refused_by_name(which: int, points: Any, directions: Any) -> None:
    call, message = refused(points, directions)[which]
    with pytest.raises((TypeError, ValueError), match=message):
        call()


def test_nothing_is_loaded_that_is_not_asked_for() -> None:
    assert not is_dask_array(POINTS)
    assert not is_dask_array(type("Array", (), {"__module__": "dask.array.core"})())


zarr_only = pytest.mark.skipif(sys.version_info < (3, 11), reason="Zarr 3 needs a newer Python")


@zarr_only
@pytest.mark.parametrize("with_client", [False, True])
def test_zarr_files_can_be_gone_on_with(
    with_client: bool, points: Any, client: Any, tmp_path: Path
) -> None:
    path, told = tmp_path / "w.zarr", list[hk.Progress]()
    given: dict[str, Any] = {"client": client if with_client else None, "progress": told.append}
    gradient = POLYGON.gradient(points)
    found = hk.io.to_zarr(gradient, path, **given)
    np.testing.assert_array_equal(found[:], POLYGON.gradient(POINTS))
    assert told[-1].done == pytest.approx(1)
    chunks = {one: one.stat().st_mtime_ns for one in path.rglob("*") if one.parent.name == "1"}
    (lost,) = chunks
    lost.unlink()
    kept = path / "c" / "0" / "0"
    when = kept.stat().st_mtime_ns
    told.clear()
    found = hk.io.to_zarr(gradient, path, **given)
    np.testing.assert_array_equal(found[:], POLYGON.gradient(POINTS))
    assert [one.done for one in told] == pytest.approx([2 / 3, 1])
    assert kept.stat().st_mtime_ns == when


@zarr_only
def test_zeros_are_written_too(points: Any, tmp_path: Path) -> None:
    """Zarr leaves out chunks of zeros unless told not to; they would be computed again."""
    hk.io.to_zarr(da.zeros(40, chunks=10), tmp_path / "z.zarr", progress=False)
    assert len(list((tmp_path / "z.zarr" / "c").iterdir())) == 4


@zarr_only
def test_blocks_without_rows_need_no_chunk(tmp_path: Path) -> None:
    for k, lengths in enumerate([(0,), (20, 0)]):
        points = da.from_array(POINTS[: sum(lengths)], chunks=(lengths, 3))
        found = hk.io.to_zarr(POLYGON.value(points), tmp_path / f"{k}.zarr", progress=False)
        np.testing.assert_array_equal(found[:], POLYGON.value(POINTS[: sum(lengths)]))


@zarr_only
def test_files_that_cannot_be_are_refused(points: Any, tmp_path: Path) -> None:
    path = tmp_path / "w.zarr"
    hk.io.to_zarr(POLYGON.value(points), path, progress=False)
    with pytest.raises(ValueError, match="holds another array"):
        hk.io.to_zarr(POLYGON.value(points, precision="double"), path, progress=False)
    with pytest.raises(ValueError, match="holds another array"):
        hk.io.to_zarr(POLYGON.value(points + 1), path, progress=False)
    (tmp_path / "no.zarr").mkdir()
    with pytest.raises(ValueError, match="is no Zarr array"):
        hk.io.to_zarr(POLYGON.value(points), tmp_path / "no.zarr", progress=False)
    with pytest.raises(TypeError, match="writes a Dask array"):
        hk.io.to_zarr(POINTS, path)
    uneven = POLYGON.value(points.rechunk(((10, 200, 90), 3)))
    with pytest.raises(ValueError, match="unequal lengths"):
        hk.io.to_zarr(uneven, tmp_path / "u.zarr")
    with pytest.raises((OSError, ValueError), match="no_folder"):
        hk.io.to_zarr(POLYGON.value(points), tmp_path / "no_folder" / "a.zarr", progress=False)
