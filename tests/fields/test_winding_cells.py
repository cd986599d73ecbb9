"""Winding numbers by cells of the boundary: samples modulo one, and the whole numbers of rays."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import Levels, Lipschitz, choose_enclosures
from harnack.enclosures.samples import Ray
from harnack.fields import Plan, Sample
from harnack.fields.solid_angles.cell_options import NO_CELLS
from harnack.fields.solid_angles.winding_number import WindingModuloOne
from harnack.geometry.example_meshes import bumpy_sphere, icosphere, remove_faces
from harnack.tracer.branch_tracker import BranchTracker
from tests.fields.test_winding import (
    KINDS,
    Mesh,
    check_first_hits,
    damaged,
    direct_sum,
    places,
    rays,
    unit,
)
from tests.oracles.jump_oracle import first_side_changes

PRECISIONS = ["single", "double"]


def with_cells(mesh: Mesh, cells: Any = True, **settings: Any) -> hk.WindingNumber:
    return hk.WindingNumber(*mesh, cells=cells, **settings)


def modulo_one(numbers: np.ndarray) -> np.ndarray:
    return (numbers + 0.5) % 1 - 0.5


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", ["holes", "soup"])
def test_samples_in_cells_are_within_their_errors(kind: str, precision: Any) -> None:
    mesh = damaged(kind, 1)
    field, backend = with_cells(mesh, method="exact"), choose_backend(precision)
    x = places(mesh, 4000, 1e-4)
    sample = WindingModuloOne(field).evaluator(backend).evaluate(to_vector3(backend, x))
    off = modulo_one(to_numpy(sample.value) - direct_sum(mesh[0][mesh[1]], x))
    gradient = hk.WindingNumber(*mesh, method="exact").gradient(x, precision="double")
    steep = np.linalg.norm(gradient, axis=1)
    place = 4 * backend.machine_epsilon * np.abs(x).max(axis=1) * steep
    error = to_numpy(sample.value_error).astype(np.float64)
    assert (np.abs(off) <= error + place + 1e-12).all()
    assert np.median(error) < 2e-3
    turned = np.linalg.norm(to_numpy(sample.gradient) - gradient, axis=1)
    bent = to_numpy(sample.promises[0].constant) * 4 * backend.machine_epsilon
    assert (turned <= to_numpy(sample.gradient_error) + bent + 1e-4 * steep).all()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", ["holes", "all of it"])
def test_first_hits(kind: str, precision: Any) -> None:
    check_first_hits(damaged(kind, 3), "exact", 400, 3, precision, cells=True)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("method", "precision", "seed"), [("exact", "single", 2), ("tree", "double", 5)]
)
def test_many_first_hits(kind: str, method: Any, precision: Any, seed: int) -> None:
    check_first_hits(damaged(kind, seed), method, 1000, seed, precision, cells=True)


def compare(mesh: Mesh, o: np.ndarray, d: np.ndarray, **settings: Any) -> hk.Hits:
    """Rays end as without cells, but for grazes within the tolerance."""
    settings = {"tolerance": 1e-4, "precision": "single", **settings}
    hits = hk.trace(with_cells(mesh), o, d, **settings)
    plain = hk.trace(with_cells(mesh, False), o, d, **settings)
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    assert (plain.is_hit != hits.is_hit).mean() <= 2e-3
    both = plain.is_hit & hits.is_hit
    apart = np.abs(plain.t[both] - hits.t[both])
    assert (apart > 2e-3 * (1 + np.abs(o).max() / 100)).mean() <= 5e-3
    assert (plain.primitive_index[both] != hits.primitive_index[both]).mean() <= 5e-3
    return hits


@pytest.mark.few(1)
@pytest.mark.parametrize("level", [1.5, -0.5, 0.3, 1.0, (0.5, 1.4)])
def test_other_levels_of_overlapping_parts(level: Any) -> None:
    """Where w goes from -1 to 3: a copy inside, one turned around, one twice."""
    vertices, faces = bumpy_sphere(2)
    faces = remove_faces(faces, 0.1, 0)
    shifts = ((1.0, 0.0, 1), (0.6, 0.2, 1), (0.7, 0.9, -1), (0.5, -0.6, 1), (0.5, -0.6, 1))
    copies = [size * vertices + np.array([shift, 0, 0]) for size, shift, _ in shifts]
    turns = [faces[:, ::way] for *_, way in shifts]
    table = [turn + k * len(vertices) for k, turn in enumerate(turns)]
    mesh = np.concatenate(copies), np.concatenate(table)
    hits = compare(mesh, *rays(mesh, 1500, 4), level=level)
    assert hits.is_hit.mean() > 0.05


def test_rays_from_inside_and_far_away_and_of_a_clip() -> None:
    mesh = damaged("holes", 1)
    rng = np.random.default_rng(1)
    o, d = rng.uniform(-0.6, 0.6, (1500, 3)), unit(rng.normal(size=(1500, 3)))
    compare(mesh, o, d)
    compare(mesh, o, d, t_min=0.3, t_max=0.9)
    far = o - 1e3 * d
    compare(mesh, far, d, precision="double")
    clip = hk.Ball((0.3, 0.1, 0.0), 0.7)
    fields = with_cells(mesh), with_cells(mesh, False)
    one, other = (hk.trace(hk.Surface(field, clip=clip), far, d) for field in fields)
    assert (one.is_hit != other.is_hit).mean() <= 2e-3
    assert one.is_hit.sum() > 100


def test_many_rays_end_as_without_cells() -> None:
    """So many that a grid of empty cells is made, by cells and without."""
    mesh = damaged("holes", 1)
    hits = compare(mesh, *rays(mesh, 6000, 9))
    assert hits.evaluations.mean() < 4


@pytest.mark.slow
def test_a_rung_within_the_tolerance_is_no_hit() -> None:
    """Beside the cracks of a soup w is so steep that the tolerance holds more than its way to the
    next level, modulo one: rays hit where w was -1/2."""
    rng = np.random.default_rng(0)
    vertices, faces = bumpy_sphere(2)
    corners = vertices[faces[:150]]
    corners = corners + 2e-3 * rng.normal(size=corners.shape)
    mesh = corners.reshape(-1, 3), np.arange(450).reshape(-1, 3)
    middle = corners.reshape(-1, 3).mean(axis=0)
    o = middle + 1.5 * unit(rng.normal(size=(4000, 3)))
    d = unit(middle + 0.4 * rng.normal(size=(4000, 3)) - o)
    hits = hk.trace(with_cells(mesh), o, d, precision="double", tolerance=1e-4)
    smooth = hits.is_hit & (hits.primitive_index < 0)
    x = hits.position[smooth]
    gradient = hk.WindingNumber(*mesh, method="exact").gradient(x, precision="double")
    off = np.abs(direct_sum(corners, x) - 0.5)
    assert smooth.sum() > 50
    assert (off <= 1.01e-4 * np.linalg.norm(gradient, axis=1) + 1e-9).all()
    truth = first_side_changes(
        lambda p: direct_sum(corners, p), o[:400], d[:400], 0.0, 4.0, level=0.5, samples=256
    )
    late = hits.t[:400] > truth + 1e-3
    assert not late.any()


@pytest.mark.slow
def test_crossings_are_those_without_cells() -> None:
    mesh = damaged("holes", 1)
    o, d = rays(mesh, 300, 2)
    fields = [with_cells(mesh, cells) for cells in (True, False)]
    crossings = [hk.crossings(field, o, d, max_crossings=6).t for field in fields]
    first = [hk.trace(field, o, d, require_crossing=True).t for field in fields]
    for t, plain_t in (crossings, first):
        assert (t != plain_t).mean() < 0.02 or np.array_equal(t, plain_t, equal_nan=True)


def test_moved_meshes_have_cells_of_their_own() -> None:
    vertices, faces = damaged("holes", 1)
    o, d = rays((vertices, faces), 500, 3)
    field = with_cells((vertices, faces))
    hk.trace(field, o, d)
    moved = field.with_vertices(1.3 * vertices + 0.2)
    hits = hk.trace(moved, o, d)
    fresh = hk.trace(with_cells((1.3 * vertices + 0.2, faces)), o, d)
    np.testing.assert_array_equal(hits.t, fresh.t)


def test_when_there_are_cells() -> None:
    mesh = damaged("holes", 1)
    field = hk.WindingNumber(*mesh)
    edges = field.describe()["singular edges"]
    assert edges > 64
    assert field.describe()["cells"] == "from 5,000 rays on"
    backend = choose_backend("single")
    few, many, more = (field.evaluator(backend, Plan(ray_count=n)) for n in (100, 10**6, 2 * 10**6))
    assert few.data is field.evaluator(backend).data
    assert few.modulo_one is None
    assert few.describe()["cells"] == "from 5,000 rays on"
    assert many.data is more.data
    assert many.describe()["cells"].endswith("MB")
    assert many.modulo_one is not None
    short = with_cells(mesh, 0.01).evaluator(backend)
    assert short.describe()["cells"] == "none, as they need more memory"
    assert short.modulo_one is None
    assert hk.WindingNumber(*icosphere(1)).cell_choice(10**9) == NO_CELLS
    assert with_cells(mesh, False).cell_choice(10**9) == NO_CELLS
    with pytest.raises(ValueError, match="megabytes"):
        with_cells(mesh, -1.0)


@pytest.mark.parametrize(
    ("value", "before", "step", "expected"),
    [
        (0.45, 0.4, 0.1, 0.45),
        (-0.55, 0.4, 0.1, 0.45),
        # Proved to change little: past a rung by as much as the error.
        (-0.499, 0.45, 0.1, 0.501),
        # Nothing is proved of the change: between the rungs of the value before.
        (-0.499, 0.45, 9.0, -0.499),
        (2.2, 0.4, 9.0, 0.2),
        (2.2, 1.4, 9.0, 1.2),
        (0.2, -1.4, 9.0, -0.8),
    ],
)
def test_whole_numbers(value: float, before: float, step: float, expected: float) -> None:
    backend = choose_backend("double")
    real, vector = backend.Float, backend.Array3f
    known = (Lipschitz(real(1.0), real(0.2)),)
    sample = Sample(
        real(value), vector(0.5, 0, 0), known, real(1e-6), branch_unknown=backend.Bool(True)
    )
    path = Ray(vector(0), vector(1, 0, 0), choose_enclosures(None))
    numbers = BranchTracker(Levels((0.5,)))
    look, is_sure = numbers.resolve(path.enclose(sample), real(before), real(step), real(1e-6))
    assert bool(is_sure[0]) == (step < 1)
    assert look.sample.value[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("value", "error", "knows", "up", "passes", "is_doubtful"),
    [
        (0.45, 0.0, False, 0.05, False, False),
        (-0.2, 0.0, False, 0.7, False, False),
        (-0.45, 0.0, False, 0.95, False, True),
        (-0.45, 0.0, True, 0.95, True, False),
        (-0.3, 0.11, False, 0.8, False, True),
        (0.1, 0.2, False, 0.4, False, True),
        (0.1, 0.2, True, 0.4, True, False),
        (0.45, 0.03, False, 0.05, False, True),
        (1.45, 0.0, True, math.inf, True, False),
        (0.55, 0.0, True, 0.95, False, False),
    ],
)
def test_gaps_to_rungs(
    value: float, error: float, knows: bool, up: float, passes: bool, is_doubtful: bool
) -> None:
    backend = choose_backend("double")
    real = backend.Float
    sample = Sample(real(value), backend.Array3f(1, 0, 0), ())
    asked = backend.Bool(not knows), backend.Bool(False), real(error)
    gaps, *said = BranchTracker(Levels((0.5,))).gaps(sample, *asked)
    assert gaps.above[0] == pytest.approx(up)
    assert [bool(one[0]) for one in said] == [passes, is_doubtful]
    assert not dr.any(said[0] & said[1])


_TRIANGLE = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
_SMALL = np.array([[-0.3, -0.3, 0.3], [0.3, -0.3, 0.3], [0, 0.3, 0.3]])


def _ends(
    corners: list[Any], level: float, origins: Any, directions: Any, **settings: Any
) -> list[hk.Hits]:
    """Ends of rays with cells, and without."""
    mesh = np.concatenate(corners), np.arange(3 * len(corners)).reshape(-1, 3)
    fields = (with_cells(mesh, one, method="tree") for one in (True, False))
    return [hk.trace(one, origins, directions, level=level, **settings) for one in fields]


def test_a_ray_that_enters_beyond_a_rung_next_to_zero_knows_the_number() -> None:
    # Where it enters, w is about -0.2, between the rungs -1.1 and -0.1 of the level 0.9.
    cells, plain = _ends([_TRIANGLE, _SMALL], 0.9, [(-0.387, -0.093, 5.0)], [(0.0, 0, -1)])
    assert plain.status[0] == hk.RayStatus.MISS
    assert cells.status[0] == plain.status[0]


def test_the_first_sample_of_a_ray_is_not_the_value_nearest_to_zero() -> None:
    # Where it enters, w is about -0.6, between the rungs -0.7 and 0.3.
    ray = [(-0.087, -0.093, 5.0)], [(0.0, 0, -1)]
    cells, plain = _ends([_TRIANGLE] * 3 + [_SMALL], 0.3, *ray, tolerance=1e-3)
    assert plain.primitive_index[0] == 0
    assert cells.primitive_index[0] == plain.primitive_index[0]
    assert abs(cells.t[0] - plain.t[0]) < 1e-3
    assert abs(cells.value[0] - plain.value[0]) < 1e-3


def test_behind_a_rung_passed_off_the_cells_the_next_sample_knows_the_number() -> None:
    x, y = (-10000.8193359375, -9999.1806640625), (-10001.2041015625, -9998.7958984375)
    z = -9999.703125
    big = np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])
    u, v = (-10000.6787109375, -10000.0234375), (-10000.4814453125, -9999.5185546875)
    z = -10001.5859375
    small = np.array([[u[0], v[0], z], [u[1], v[0], z], [u[1], v[1], z], [u[0], v[1], z]])
    corners = [big[[0, 1, 2]], big[[0, 2, 3]]] * 3 + [small[[2, 1, 0]], small[[3, 2, 0]]]
    origin = (-10000.1025390625, -10001.2021484375, -10004.2509765625)
    ray = [origin], [(-0.029849009588360786, 0.31229814887046814, 0.9495151042938232)]
    cells, plain = _ends(corners, 0.9, *ray, tolerance=1e-3, t_min=1.2875842, t_max=4.0504760)
    assert plain.status[0] == hk.RayStatus.MISS
    assert cells.status[0] == plain.status[0]


def test_a_ray_far_from_the_origin_does_not_run_out_of_steps() -> None:
    corners = np.array(
        [
            [-10000.734375, 9998.6572265625, -10000.0908203125],
            [-9999.6953125, 10000.630859375, -9999.73828125],
            [-10000.73046875, 9999.498046875, -9999.8203125],
        ]
    )
    ray = [(-10002.29296875, 9995.697265625, -10000.619140625)], [(0.460142, 0.874011, 0.156120)]
    cells, plain = _ends([corners], 0.9, *ray, tolerance=1e-3)
    assert plain.status[0] == hk.RayStatus.HIT
    assert cells.status[0] == plain.status[0]


def lattice_triangles(n: int) -> Mesh:
    """Right triangles in planes of coordinates, whose corners are multiples of 1/4 in part."""
    rng = np.random.default_rng(5)
    corners = np.eye(3) * rng.uniform(0.1, 1, (n, 1, 1)) + rng.integers(-4, 5, (n, 1, 3)) / 4
    return corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)


def far_sphere() -> Mesh:
    vertices, faces = bumpy_sphere(2)
    return vertices + np.array([1000.0, -500.0, 200.0]), remove_faces(faces, 0.1, 0)


def flipped_faces() -> Mesh:
    vertices, faces = bumpy_sphere(2)
    return vertices, np.where(np.arange(len(faces))[:, None] % 5 == 0, faces[:, ::-1], faces)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    "mesh", [far_sphere(), flipped_faces(), lattice_triangles(80)], ids=["far", "flips", "lattice"]
)
def test_where_a_value_is_known_from_the_middle_of_a_cell_it_is_right(
    mesh: Mesh, precision: Any
) -> None:
    """At random points; beside faces, edges and corners; and on lines of a coordinate through the
    middles of cells, as corners of the lattice are."""
    field, backend = with_cells(mesh), choose_backend(precision)
    field.extent((0.5,))
    evaluator = field.evaluator(backend)
    modulo_one, cells = evaluator.modulo_one, evaluator.data.cells
    assert modulo_one is not None
    assert cells is not None
    rng, size, n = np.random.default_rng(6), float(np.ptp(mesh[0], axis=0).max()), 4000
    corners = mesh[0][mesh[1]]
    weights = rng.dirichlet((1, 1, 1), n) * ((rng.random((n, 3)) < 0.7) | [True, False, False])
    weights /= weights.sum(axis=1, keepdims=True)
    on = np.einsum("nk,nkd->nd", weights, corners[rng.integers(len(corners), size=n)])
    off = size * 10.0 ** rng.uniform(-7, -1, (n, 1)) * rng.normal(size=(n, 3))
    centers = cells.cells.centers() * field.mesh.size + field.mesh.center
    beside = rng.normal(size=(n, 3)) * (rng.random((n, 3)) < 0.4)
    points = np.concatenate([
        corners.mean(axis=(0, 1)) + size * rng.uniform(-0.5, 0.5, (n, 3)),
        on,
        on + off * (rng.random((n, 3)) < 0.6),
        centers[rng.integers(len(centers), size=n)] + 0.02 * size * beside,
    ])  # fmt: skip
    points = points.astype(backend.dtype).astype(np.float64)
    x = to_vector3(backend, points)
    known_value = modulo_one.value_if_cheap(x, backend.Float(0), backend.Bool(True))
    value = to_numpy(known_value).astype(np.float64)
    known = np.isfinite(value)
    assert known[:n].mean() > 0.9
    if np.abs(points).max() < 10:  # else rounding moves points off faces
        assert known[n : 2 * n].mean() < 0.02
    exact = hk.WindingNumber(*mesh, method="exact").value(points, precision="double")
    assert np.abs(value - exact)[known].max() < 0.01


def test_a_poor_value_in_the_middle_of_a_cell_is_not_used() -> None:
    rng = np.random.default_rng(7)
    corners = rng.normal(size=(300, 1, 3)) + 0.5 * rng.normal(size=(300, 3, 3))
    mesh = corners.reshape(-1, 3), np.arange(900).reshape(-1, 3)
    field = with_cells(mesh, method="tree", accuracy=1.5, order=0)
    field.extent((0.5,))
    cells = field.evaluator(choose_backend("single")).data.cells
    assert cells is not None
    assert cells.size == cells.cells.size + 4 * cells.count
    poor = field.error_bound(cells.cells.centers() * field.mesh.size + field.mesh.center) > 0.13
    assert poor.mean() > 0.1
    assert np.isnan(to_numpy(cells.center_values)[poor]).all()


def cube_without_a_triangle() -> Mesh:
    vertices = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    faces = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]]
    faces += [[2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5]]
    return vertices, np.array(faces)


def thinned_sphere(x: float) -> Mesh:
    vertices, faces = icosphere(3)
    kept = np.random.default_rng(0).random(len(faces)) > 0.1
    return vertices + np.array([x, 0, 0]), faces[kept]


@pytest.mark.parametrize("distance", [30.0, 200.0, 1e4])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_rays_that_begin_within_rounding_of_a_triangle_know_its_side(
    distance: float, precision: Any
) -> None:
    """The value at the first point was that of the other side: up to two in five rays missed."""
    mesh, rng, n = cube_without_a_triangle(), np.random.default_rng(0), 1000
    way = rng.normal(size=(n, 3))
    way[:, 2] = -np.abs(way[:, 2]) - 0.5
    way /= np.linalg.norm(way, axis=1)[:, None]
    o = np.array([0.2, -0.3, 1.0]) - distance * way
    near = distance * (1 + 1.5 * choose_backend(precision).machine_epsilon * rng.integers(-1, 2, n))
    settings = {"t_min": near, "precision": precision}
    hits, plain = (
        hk.trace(hk.WindingNumber(*mesh, cells=cells), o, way, **settings)
        for cells in (True, False)
    )
    np.testing.assert_array_equal(hits.status, plain.status)


@pytest.mark.parametrize(
    ("x", "o", "d", "settings"),
    [
        (0.0, [0.17092786729335785, -0.9515982866287231, 1000.0], [0, 0, -1],
         {"clip": hk.Box([-2, -2, -2], [2, 2, 0.25])}),
        (3000.0, [3002.319580078125, -0.8631852269172668, 0.35353776812553406],
         [-0.9277864098548889, 0.34527409076690674, -0.14141510426998138],
         {"t_min": 1.5041636797864626}),
        (1000.0, [1000.4432373046875, 0.2900524139404297, 1.7000000476837158],
         [0.2510278820991516, 0.16427110135555267, -1.0],
         {"clip": hk.Box([998, -2, -2], [1002, 2, 0.25])}),
    ],
)  # fmt: skip
def test_rays_of_a_clip_and_far_meshes_know_their_side(
    x: float, o: Any, d: Any, settings: Any
) -> None:
    for cells in (True, False):
        hits = hk.trace(hk.WindingNumber(*thinned_sphere(x), cells=cells), [o], [d], **settings)
        assert hits.is_hit.all()
