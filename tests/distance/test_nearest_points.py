"""Nearest points: against exact distances and dense samples, and with hostile input."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

import harnack as hk
from harnack.backend import choose_backend
from harnack.distance import cell_search
from harnack.distance.cell_classification import taylor_remainder
from harnack.enclosures.samples import Sample
from harnack.geometry import example_curves, example_meshes
from tests.distance.test_distance import CURVED, Bare, surface_points, true_distance, unit
from tests.distance.test_mesh_distances import beside_faces, distance_to_closed_mesh
from tests.oracles.direct_sums import dipole_sum
from tests.oracles.mesh_distance import distances_to_triangles

PRECISIONS = ("double", "single")


def check_bounds(field: hk.Field, x: np.ndarray, **given: Any) -> hk.distance.DistanceBounds:
    """That the parts of the answer agree with one another."""
    found = hk.distance.distance_bounds(field, x, **given)
    away = np.linalg.norm(x - found.closest_points, axis=1)
    assert np.allclose(found.upper, away, rtol=1e-6, atol=1e-12 * (1 + np.abs(x).max()))
    assert (found.lower <= found.upper).all()
    return found


# --- closed meshes -----------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_distances_to_a_closed_mesh_are_exact(precision: Any) -> None:
    vertices, faces = example_meshes.bumpy_sphere(3)
    rng = np.random.default_rng(0)
    x = np.concatenate([
        rng.uniform(-1.5, 1.5, (300, 3)), 1e3 * rng.normal(size=(50, 3)), np.zeros((1, 3)),
        beside_faces(vertices, faces, 300, np.repeat([1e-9, 1e-6, 1e-3], 100)),
        vertices[:50], vertices[faces[:50]].mean(axis=1), vertices[faces[:50, :2]].mean(axis=1),
    ])  # fmt: skip
    field, exact = hk.WindingNumber(vertices, faces), distance_to_closed_mesh(vertices, faces, x)
    found = check_bounds(field, x, precision=precision) if precision == "double" else None
    distance = np.abs(hk.signed_distance(field, x, precision=precision))
    size = 1e-6 if precision == "single" else 1e-13
    assert (np.abs(distance - exact) <= size * (1 + np.abs(x).max(axis=1))).all()
    if found is not None:
        assert (found.lower <= exact).all()
        assert (found.upper - found.lower <= 1e-12 * (1 + np.abs(x).max(axis=1))).all()


def test_slivers_duplicates_and_ties() -> None:
    """A prism as thin as a hair, given twice; points in the middle, as far from both sides."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0.0]])
    vertices = np.concatenate([corners, corners + np.array([0, 0, 2.0])])
    faces = [(0, 2, 1), (3, 4, 5)]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        faces += [(a, b, b + 3), (a, b + 3, a + 3)]
    faces = np.array(faces)
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.uniform(-1, 3, (200, 3)), [[0.5, 5e-8, 1.0], [0.5, 0, 1.0]]])
    exact = distances_to_triangles(x, vertices[faces]).min(axis=1)
    for times in (1, 2):
        found = check_bounds(hk.WindingNumber(vertices, np.tile(faces, (times, 1))), x)
        assert np.abs(found.upper - exact).max() < 1e-12


def test_a_level_that_a_mesh_has_not() -> None:
    field = hk.WindingNumber(*example_meshes.icosphere(1))
    with pytest.warns(RuntimeWarning, match="no closest point was found for 2 of 2"):
        assert np.isnan(hk.signed_distance(field, [[0, 0, 0], [2, 0, 0]], level=1.5)).all()


def test_faces_that_pass_through_one_another_are_cut() -> None:
    """Two balls: what of each lies within the other is not the surface."""
    ball, faces = example_meshes.icosphere(2)
    vertices = np.concatenate([ball, ball + np.array([0.9, 0.05, 0.02])])
    both = np.concatenate([faces, faces + len(ball)])
    x = np.random.default_rng(2).uniform(-1.5, 2.5, (400, 3))
    found = check_bounds(hk.WindingNumber(vertices, both), x)
    on = []
    for part, other in ((faces, faces + len(ball)), (faces + len(ball), faces)):
        y = beside_faces(vertices, part, 100_000, 0.0, seed=3)
        inside = hk.WindingNumber(vertices, other).value(y, precision="double") > 0.5
        on.append(y[~inside])
    nearest, _ = cKDTree(np.concatenate(on)).query(x)
    assert (found.upper <= nearest + 1e-12).all()
    # No foot lies inside either ball, but for rounding.
    for part in (faces, faces + len(ball)):
        off = hk.signed_distance(hk.WindingNumber(vertices, part), found.closest_points)
        assert off.min() > -1e-9


# --- smooth surfaces ---------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["wavy", "knot", "gyroid"])
@pytest.mark.parametrize(
    ("n", "rays"), [(1500, 30_000), pytest.param(20_000, 300_000, marks=pytest.mark.slow)]
)
def test_no_dense_sample_is_nearer(name: str, n: int, rays: int) -> None:
    """Neither than the distance nor, with more reason, than the proved lower bound."""
    field = CURVED[name]
    volume = field.domain or field.extent((field.default_level,))
    assert volume is not None
    lower, upper = volume.bounds()
    x = np.random.default_rng(4).uniform(lower, upper, (n, 3))
    if field.domain is not None:
        x = x[field.domain.contains_points(x)]
    found = check_bounds(field, x)
    nearest, _ = cKDTree(surface_points(field, rays)).query(x)
    assert (found.upper <= nearest + 1e-9).all()
    assert (found.lower <= nearest + 1e-12).all()
    # What is proved says something: within a cell's size of the truth.
    assert np.quantile(found.upper - found.lower, 0.9) < 0.03 * np.linalg.norm(upper - lower)


@pytest.mark.slow
def test_a_few_points_are_proved_to_the_tolerance() -> None:
    """Up to 1e-6 of the size, but for points whose nearest is where the surface ends."""
    field = CURVED["wavy"]
    x = np.random.default_rng(5).uniform(-0.8, 0.8, (20, 3))
    found = check_bounds(field, x)
    assert np.quantile(found.upper - found.lower, 0.9) < 1e-5
    assert (found.upper - found.lower).max() < 1e-3


def test_beside_the_surface_all_is_proved() -> None:
    for name in ("wavy", "gyroid"):
        field = CURVED[name]
        y = surface_points(field, 400)[:100]
        above = unit(field.gradient(y, precision="double"))
        inner = y + 1e-9 * above
        found = check_bounds(field, inner)
        assert np.abs(found.upper - 1e-9).max() < 1e-13, name
        assert (found.lower >= 0.99e-9).mean() > 0.9, name


@pytest.mark.slow
def test_far_away_and_on_the_axis() -> None:
    """From 1000 sizes away, and from where many points are as near as one another."""
    disk = hk.SolidAngle(example_curves.regular_polygon(12))
    corners = example_curves.regular_polygon(12)
    x = np.array([[0, 0, 1e3], [1e3, 0, 0], [0, 0, 0.5], [0, 0, 0], *corners[:2]])
    found = check_bounds(disk, x)
    reach = np.linalg.norm(corners - [1e3, 0, 0], axis=1).min()
    assert found.upper == pytest.approx([1e3, reach, 0.5, 0, 0, 0], abs=1e-10)


def test_a_surface_without_extent() -> None:
    """Cells are looked for around the points, and farther out until the nearest is within."""
    x = np.array([[0.0, 0.0, 0.0], [700.0, 0.0, 0.0], [0.0, 1.25, 0.0]])
    found = check_bounds(Bare(), x)
    assert found.upper == pytest.approx([1.0, 699.0, 0.25], rel=1e-9)

    class Waves(hk.Field):
        """sin x: planes at all multiples of pi, which have no end."""

        def evaluate(self, p: Any) -> hk.fields.Sample:
            import drjit as dr

            return hk.fields.Sample(
                dr.sin(p.x), type(p)(dr.cos(p.x), 0, 0), (hk.proofs.TaylorRemainder(1.0),)
            )

    x = np.random.default_rng(6).uniform(-20, 20, (200, 3))
    exact = np.abs(x[:, 0] - np.pi * np.round(x[:, 0] / np.pi))
    found = check_bounds(Waves(), x)
    assert np.abs(found.upper - exact).max() < 1e-12
    assert (found.lower <= exact + 1e-12).all()


def test_an_empty_level_set() -> None:
    """exp(x) + 1 has no level 0, within its domain."""

    class Positive(hk.Field):
        domain = hk.Ball(radius=1.0)

        def evaluate(self, p: Any) -> hk.fields.Sample:
            return hk.fields.Sample(2 + p.x, type(p)(1, 0, 0), (hk.proofs.TaylorRemainder(0.0),))

    with pytest.warns(RuntimeWarning, match="no closest point was found for 1 of 1"):
        found = hk.distance.distance_bounds(Positive(), [[0.1, 0.2, 0.3]])
    assert np.isnan(found.upper).all()


@pytest.mark.slow
def test_the_rim_of_a_domain() -> None:
    """A plane cut by a ball: beyond the disk its rim is the nearest."""
    field = hk.HarmonicPolynomial({(0, 0, 1): 1.0}, domain=hk.Ball(radius=2.0))
    x = np.random.default_rng(7).uniform(-4, 4, (500, 3))
    rim = np.hypot(np.maximum(np.hypot(x[:, 0], x[:, 1]) - math.sqrt(4 - 0.25), 0), x[:, 2] - 0.5)
    found = check_bounds(field, x, level=0.5)
    assert (found.lower <= rim + 1e-12).all()
    assert np.abs(found.upper - rim).max() < 1e-9


@pytest.mark.slow
def test_parts_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    field, x = CURVED["wavy"], np.random.default_rng(8).uniform(-1, 1, (60, 3))
    whole = hk.signed_distance(field, x)
    monkeypatch.setattr(cell_search, "_BATCH_SIZE", 17)
    messages: list[str] = []
    parts = hk.signed_distance(field, x, progress=messages.append)
    assert np.allclose(parts, whole, rtol=1e-12)
    assert any("cells" in one for one in messages)
    hk.distance.distance_bounds(field, x[:5], progress=messages.append)
    assert "cells for" in messages[-1]


# --- what is proved ----------------------------------------------------------------------------


@pytest.mark.parametrize("dimension", [2, 3, 4])
def test_the_remainder_is_attained_by_poissons_kernel(dimension: int) -> None:
    """f = P(q, s) - 1 >= -1, with mass 1 at s = 1: along its axis nothing is to spare."""
    real = choose_backend("double").Float
    q = np.linspace(0.01, 0.9, 30)
    rest = (1 + q) / (1 - q) ** (dimension - 1) - 1 - dimension * q
    ball = hk.proofs.HarmonicBall(1.0, -1.0, math.inf, dimension)
    zero = choose_backend("double").Array3f(0)
    found = np.array(taylor_remainder(Sample(real(0), zero, (ball,)), real(q)))
    assert (found >= rest * (1 - 1e-9)).all()
    assert found == pytest.approx(rest, rel=1e-9)
    assert np.isinf(np.array(taylor_remainder(Sample(real(0), zero, (ball,)), real(1.5)))).all()


@pytest.mark.slow
def test_lower_bounds_of_clouds_hold() -> None:
    k = np.arange(300) + 0.5
    z, turn = 1 - 2 * k / 300, np.pi * (1 + np.sqrt(5)) * k
    p = np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    field = hk.DipolePotential(p, p, np.full(300, 4 * np.pi / 300))
    x = np.random.default_rng(9).uniform(-1.5, 1.5, (400, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = check_bounds(field, x)
    on = surface_points(field, 20_000)
    nearest, _ = cKDTree(np.concatenate([on, p])).query(x)
    assert (found.upper <= nearest + 1e-9).all()
    assert (found.lower <= nearest + 1e-9).all()


# --- many points, few cells --------------------------------------------------------------------

BOXED = hk.Gyroid(domain=hk.Box((-3, -2, -4), (3.5, 4, 2)))


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells as coarse as for many points, and none split for the few of a test."""
    monkeypatch.setattr(cell_search, "_MAX_CELLS", 5000)
    monkeypatch.setattr(cell_search, "_CELLS_PER_POINT", 1e9)


def rim_on_sphere(field: hk.Field, radius: float, circles: int) -> np.ndarray:
    """Points where the level set meets a sphere about the origin: sign changes along random great
    circles, halved until they are known to rounding."""
    rng = np.random.default_rng(0)
    u = unit(rng.normal(size=(circles, 3)))
    v = unit(np.cross(u, rng.normal(size=(circles, 3))))

    def above(angle: np.ndarray, k: np.ndarray) -> np.ndarray:
        x = np.cos(angle)[:, None] * u[k] + np.sin(angle)[:, None] * v[k]
        return field.value(radius * x, precision="double") - field.default_level

    steps = 400
    angle = np.tile(np.linspace(0, 2 * np.pi, steps + 1), circles)
    k = np.repeat(np.arange(circles), steps + 1)
    sign = (above(angle, k) > 0).reshape(circles, -1)
    row, step = np.nonzero(sign[:, 1:] != sign[:, :-1])
    low, high = step * 2 * np.pi / steps, (step + 1) * 2 * np.pi / steps
    first = sign[row, step]
    for _ in range(50):
        middle = 0.5 * (low + high)
        same = (above(middle, row) > 0) == first
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return radius * (np.cos(low)[:, None] * u[row] + np.sin(low)[:, None] * v[row])


@pytest.mark.few(1)
@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize(
    ("field", "point", "distance"),
    [
        # The nearest point lies on the rim, in one face of the box, beside a corner of the rim: the
        # search ended at the corner, or beside it.
        (BOXED, [1.34206, -1.07967, -3.77922], 1.0633774860),
        (BOXED, [1.7480614, -1.8235083, -5.4509435], 1.4636948597),
        # On the rim in a sphere, from outside: steps along it were given up where it is bent.
        (hk.Gyroid(), [11.55697859, -9.07436974, 7.11655145], 10.0586507679),
        (hk.Gyroid(), [-3.74050973, 6.16428533, 0.28591015], 1.3265089321),
        # Beside a vertex of the curve, at which one edge of the surface turns to the point.
        (CURVED["knot"], [0.15862, 1.289, 0.80903], 0.6353912227),
        (CURVED["knot"], [-1.01919, 0.76773, -0.4654], 0.5755429308),
    ],
)
def test_the_nearest_is_where_it_was_not_found(
    field: hk.Field, point: list[float], distance: float
) -> None:
    found = check_bounds(field, np.array([point]))
    assert found.upper[0] <= distance * (1 + 1e-6)
    assert found.lower[0] <= distance


@pytest.mark.slow
@pytest.mark.usefixtures("coarse")
def test_rims_from_outside_a_ball() -> None:
    """From outside one point in a thousand had another part of the rim nearer."""
    field = hk.Gyroid()
    x = np.random.default_rng(11).uniform(-12, 12, (3000, 3))
    x = x[np.linalg.norm(x, axis=1) > 2 * np.pi]
    found = check_bounds(field, x)
    nearest, _ = cKDTree(rim_on_sphere(field, 2 * np.pi * (1 - 1e-13), 3000)).query(x)
    assert (found.upper <= nearest + 1e-9).all()
    assert (found.lower <= nearest).all()
    assert np.median(nearest - found.upper) < 0.01


@pytest.mark.slow
@pytest.mark.usefixtures("coarse")
def test_sheets_that_cross_within_a_cell() -> None:
    """The zeros of Y_5,3 cross in lines, along which a cell knows a point of one sheet only: points
    on another sheet, or closer to it than the cell is wide, are seen by descents of their own."""
    field = CURVED["Y 5,3"]
    on = surface_points(field, 20_000)
    z = on[np.hypot(on[:, 0], on[:, 1]) < 0.05 * np.abs(on[:, 2])]
    assert len(z) > 20
    rng = np.random.default_rng(12)
    x = z + 1e-4 * unit(rng.normal(size=z.shape))
    found = check_bounds(field, x)
    assert (found.upper <= 1e-4 * (1 + 1e-9)).all()


@pytest.mark.few(1)
@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("name", ["wavy", "knot"])
def test_points_of_the_boundary_and_from_very_far(name: str) -> None:
    field = CURVED[name]
    corners = (
        example_curves.wavy_polygon(24) if name == "wavy" else example_curves.torus_knot(2, 3, 60)
    )
    edges = 0.5 * (corners + np.roll(corners, 1, axis=0))
    far = 1e4 * unit(np.random.default_rng(13).normal(size=(40, 3)))
    found = check_bounds(field, np.concatenate([corners, edges, far]))
    assert (found.upper[: 2 * len(corners)] < 1e-12).all()
    on = np.concatenate([surface_points(field, 20_000), corners])
    nearest, _ = cKDTree(on).query(far)
    assert (found.upper[2 * len(corners) :] <= nearest + 1e-9).all()
    for n in (0, 1):
        assert hk.distance.distance_bounds(field, far[:n]).closest_points.shape == (n, 3)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["inside", "outside"])
@pytest.mark.parametrize("name", ["wavy", "knot", "gyroid", "Y 5,3"])
def test_no_dense_sample_is_nearer_in_many_points(name: str, where: str) -> None:
    """5,000 points, 100,000 samples of the surface and, where a ball cuts it, many of its rim."""
    field = CURVED[name]
    volume = field.domain or field.extent((field.default_level,))
    assert volume is not None
    lower, upper = volume.bounds()
    size = float(np.linalg.norm(upper - lower))
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    wide = 1.0 if where == "inside" else 2.0
    x = middle + np.random.default_rng(14).uniform(-wide, wide, (5_000, 3)) * half
    if field.domain is not None:
        inside = field.domain.contains_points(x)
        x = x[inside if where == "inside" else ~inside]
        radius = 0.5 * float((upper - lower)[0])
        rim = rim_on_sphere(field, radius * (1 - 1e-13), 20_000)
        nearest, _ = cKDTree(np.concatenate([surface_points(field, 100_000), rim])).query(x)
    else:
        nearest = true_distance(field, x, 100_000)
    found = check_bounds(field, x)
    assert (found.lower <= nearest + 1e-12 * size).all()
    assert (found.upper > nearest + 1e-6 * size).sum() <= 2
    assert (found.upper <= nearest + 1e-4 * size).all()


@pytest.mark.slow
@pytest.mark.parametrize("cells", [None, True])
def test_feet_on_clouds_are_on_the_exact_surface(cells: Any) -> None:
    """They come from sums with clusters, which leave out 1e-4 of the size here, and are moved by
    what these leave out; x is straight above them."""
    rng = np.random.default_rng(3)
    n = rng.normal(size=(2000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    points = n * (1 + 0.1 * n[:, :1] ** 2)
    field = hk.DipolePotential(points, n, cells=cells)
    x = 1.7 * rng.normal(size=(400, 3))
    found = hk.distance.distance_bounds(field, x)
    at_points = cKDTree(points).query(found.closest_points)[0] == 0
    assert at_points.mean() < 0.5
    total = dipole_sum(points, n * field.areas[:, None])
    x, feet, upper = x[~at_points], found.closest_points[~at_points], found.upper[~at_points]
    value, gradient = total(feet)
    steep = np.linalg.norm(gradient, axis=1)
    off = np.abs(value - 2 * np.pi) / steep
    assert off.max() < 1e-12
    away = (x - feet) / upper[:, None]
    slant = np.linalg.norm(np.cross(away, gradient / steep[:, None]), axis=1)
    assert np.quantile(slant, 0.95) < 1e-8


@pytest.mark.parametrize("precision", PRECISIONS)
def test_beside_a_point_of_a_cloud(precision: Any) -> None:
    """All levels come to it: distances were up to five thousand times as long."""
    rng = np.random.default_rng(0)
    points, d = (unit(rng.normal(size=(n, 3))) for n in (50, 400))
    field = hk.DipolePotential(points, points)
    which = np.arange(400) % 50
    for u in (1e-3, 1e-5):
        x = points[which] + u * d
        found = hk.distance.distance_bounds(field, x, precision=precision)
        away = np.linalg.norm(x.astype(np.float32) - points[which], axis=1)
        assert (found.upper <= np.maximum(u, away) * (1 + 1e-6) + 1e-12).all()
        assert (found.lower <= found.upper).all()
    # A smoothed sum has no such points.
    assert hk.DipolePotential(points, points, smoothing=0.2).boundary is None
