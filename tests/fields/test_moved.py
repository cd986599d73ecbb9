"""Winding numbers whose vertices move: what is kept, and that what is promised stays true."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.solid_angles import winding_mesh
from harnack.geometry import MeshError
from harnack.geometry.example_meshes import bumpy_sphere, remove_faces

VERTICES, FACES = bumpy_sphere(3)
FACES = remove_faces(FACES, 0.1, 0)
# A duplicate and a flipped face: they count, and cancel, wherever they are.
FACES = np.concatenate([FACES, FACES[:2], FACES[4:5, ::-1]])


def breathed(x: np.ndarray) -> np.ndarray:
    """A little motion, and somewhere else."""
    return 1.7 * x + 0.05 * np.sin(3 * np.roll(x, 1, axis=1)) + [3.0, 0.0, -1.0]


def torn(x: np.ndarray) -> np.ndarray:
    """So much motion that triangles of a leaf are far from each other."""
    return np.random.default_rng(0).permutation(x)


def twisted(x: np.ndarray) -> np.ndarray:
    """Wrung around an axis and stretched along it; neighbors stay so."""
    angle = 2.5 * x[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1], 4 * x[:, 2]])


def around(x: np.ndarray, n: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    middle, size = x.mean(axis=0), np.ptp(x, axis=0)
    return middle + rng.uniform(-0.8, 0.8, (n, 3)) * size


def winding(x: Any, **options: Any) -> hk.WindingNumber:
    return hk.WindingNumber(x, FACES, **options)


@pytest.mark.few(1)
@pytest.mark.parametrize("motion", [breathed, twisted, torn])
def test_values_are_within_the_bound(motion: Any) -> None:
    """Of the exact ones, by a tree that was made for other places, and used there."""
    field = winding(VERTICES, method="tree")
    field.value(VERTICES[:2] * 0.9)
    x = motion(VERTICES)
    moved, points = field.with_vertices(x), around(x, 3000)
    assert moved.mesh.tree is field.mesh.tree
    exact = winding(x, method="exact").value(points, precision="double")
    off = np.abs(moved.value(points, precision="double") - exact)
    oracle = 1e-13  # is rounded as well
    assert (off <= moved.error_bound(points, precision="double") + oracle).all()
    assert off.max() > 1e-12  # the tree is used
    single = np.abs(moved.value(points, precision="single") - exact)
    assert np.quantile(single, 0.99) < 1e-2


@pytest.mark.few(3)
@pytest.mark.parametrize("motion", [breathed, twisted, torn])
@pytest.mark.parametrize("method", ["exact", "tree"])
def test_moved_is_as_new(method: Any, motion: Any) -> None:
    """A new field with a tree of that shape is the same field, to the last bit."""
    field = winding(VERTICES, method=method)
    field.value(VERTICES[:2] * 0.9)
    x = motion(VERTICES)
    points = around(x, 500)
    new, moved = winding(x, method=method), field.with_vertices(x)
    if method == "tree":
        vars(new.mesh).update(tree=field.mesh.tree)
    for name in ("value", "gradient", "hessian", "error_bound"):
        found, expected = (getattr(one, name)(points) for one in (moved, new))
        np.testing.assert_array_equal(found, expected)
    assert moved.mesh.area == new.mesh.area
    assert moved.mesh.boundary_length == new.mesh.boundary_length


@pytest.mark.parametrize("method", ["exact", "tree"])
def test_nothing_moved_nothing_changed(method: Any) -> None:
    field = winding(VERTICES, method=method)
    points = around(VERTICES, 500)
    before = field.value(points)
    there = field.with_vertices(breathed(VERTICES))
    back = there.with_vertices(VERTICES)
    np.testing.assert_array_equal(back.value(points), before)
    np.testing.assert_array_equal(field.value(points), before)
    assert (there.value(points) != before).any()
    np.testing.assert_array_equal(back.facet_faces, field.facet_faces)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", ["exact", "tree"])
@pytest.mark.parametrize("motion", [breathed, twisted])
def test_hits_are_those_of_a_new_field(motion: Any, method: Any) -> None:
    backend = choose_backend()
    field = winding(VERTICES, method=method)
    field.evaluator(backend)  # which uploads the mesh as it was
    x = motion(VERTICES)
    middle, size = x.mean(axis=0), np.ptp(x, axis=0).max()
    rng = np.random.default_rng(2)
    o = rng.normal(size=(1500, 3))
    o = middle + 2 * size * o / np.linalg.norm(o, axis=1, keepdims=True)
    d = middle + 0.4 * rng.uniform(-1, 1, (1500, 3)) * np.ptp(x, axis=0) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    rays = to_vector3(backend, o), to_vector3(backend, d)
    moved, new = (
        hk.trace(hk.Surface(one), *rays, t_max=10 * size)
        for one in (field.with_vertices(x), winding(x, method=method))
    )
    dr.eval(moved.t, new.t)
    hit = to_numpy(moved.status) == int(hk.RayStatus.HIT)
    same = hit == (to_numpy(new.status) == int(hk.RayStatus.HIT))
    assert same.mean() >= 0.999  # rays may graze
    assert hit.mean() > 0.4
    both = np.flatnonzero(hit & same)
    near = np.abs(to_numpy(moved.t)[both] - to_numpy(new.t)[both]) < 1e-3 * size
    assert near.mean() >= 0.999


def test_nothing_is_sorted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither faces into trees, nor vertices and edges."""
    field = winding(VERTICES, method="tree")
    points = around(VERTICES, 100)
    field.value(points)

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("this is for new meshes")

    monkeypatch.setattr(winding_mesh, "build_balanced_tree", refuse)
    monkeypatch.setattr(winding_mesh.Welded, "of", refuse)
    moved = field.with_vertices(breathed(VERTICES))
    assert np.isfinite(moved.value(breathed(points))).all()
    with pytest.raises(AssertionError, match="this is for new meshes"):
        winding(VERTICES)


def test_soups_that_move_together() -> None:
    """Every corner is a vertex of its own; those that coincide must stay together."""
    corners = VERTICES[FACES].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    field = hk.WindingNumber(corners, faces)
    points = around(breathed(VERTICES), 500)
    np.testing.assert_allclose(
        field.with_vertices(breathed(corners)).value(points, precision="double"),
        winding(breathed(VERTICES)).value(points, precision="double"),
        atol=1e-9,
    )
    apart = corners.copy()
    apart[-1] += 0.01
    with pytest.raises(MeshError, match=r"were at the same place.*make a new winding number"):
        field.with_vertices(apart)


def test_vertices_without_faces_may_part() -> None:
    x = np.concatenate([VERTICES, VERTICES[:1]])
    field = winding(x)
    x[-1] += 1.0
    np.testing.assert_array_equal(
        field.with_vertices(x).value([[0.1, 0.2, 0.3]]), field.value([[0.1, 0.2, 0.3]])
    )


def flattened(x: np.ndarray) -> np.ndarray:
    out = x.copy()
    out[FACES[7, 0]] = out[FACES[7, 1]]
    return out


def with_nan(x: np.ndarray) -> np.ndarray:
    out = x.copy()
    out[3, 1] = np.nan
    return out


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (VERTICES[:-1], "there are 641 vertices"),
        (np.concatenate([VERTICES, VERTICES[:1]]), "vertices: 643 of them, where 642"),
        (VERTICES[:, :2], "vertices"),
        (with_nan(VERTICES), "coordinates must be finite"),
        (flattened(VERTICES), "face"),
        (None, "vertices"),
    ],
)
def test_bad_vertices_are_refused(vertices: Any, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        winding(VERTICES).with_vertices(vertices)
