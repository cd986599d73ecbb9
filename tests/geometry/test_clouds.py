"""Point clouds: what is accepted, the area of each point, and normals that all face outward."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Voronoi

import harnack as hk
from harnack.geometry import clouds
from harnack.geometry.clouds import CloudError, estimate_areas, estimate_normals, validate_cloud
from harnack.geometry.example_meshes import icosphere

POINTS = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]
UP = [[0.0, 0, 1]] * 3


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def on_sphere(n: int) -> np.ndarray:
    x = rng().normal(size=(n, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def spiral(n: int) -> np.ndarray:
    """n points evenly spread over the unit sphere."""
    k = np.arange(n) + 0.5
    z, t = 1.0 - 2.0 * k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.column_stack([r * np.cos(t), r * np.sin(t), z])


def on_torus(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points evenly spread over the torus of radii 1 and 0.4, and its normals."""
    s, t, u = rng().random((3, 3 * n)) * np.array([[2 * np.pi], [2 * np.pi], [1.0]])
    s, t = (angle[u < (1.0 + 0.4 * np.cos(t)) / 1.4][:n] for angle in (s, t))
    normals = np.column_stack([np.cos(t) * np.cos(s), np.cos(t) * np.sin(s), np.sin(t)])
    return np.column_stack([np.cos(s), np.sin(s), np.zeros(n)]) + 0.4 * normals, normals


# --- what is accepted --------------------------------------------------------------------------


def test_a_cloud_becomes_arrays_of_its_own():
    mine = np.array(POINTS)
    x, n, a = validate_cloud(mine, np.array([[0, 0, 5], [0, 3e200, 0], [1e-200, 0, 0]]), [1, 2, 3])
    mine[:] = 7.0
    assert x.tolist() == POINTS
    assert n.tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert a.tolist() == [1, 2, 3]
    for array in (x, n, a):
        assert array.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    assert validate_cloud(POINTS, UP, 0.5)[2].tolist() == [0.5] * 3
    validate_cloud([POINTS[0]] * 3, UP, 1.0)  # points at one position are allowed


@pytest.mark.parametrize(
    ("points", "normals", "areas", "message"),
    [
        ([], UP, 1.0, "there are no points"),
        (np.zeros((0, 3)), np.zeros((0, 3)), 1.0, "there are no points"),
        ("abc", UP, 1.0, "the points must be real numbers"),
        (None, UP, 1.0, "the points must be real numbers"),
        ([[0, 0, 0], [1, 0]], UP, 1.0, "the points are ragged"),
        ([[0, 0], [1, 0]], UP, 1.0, r"the points must have shape \(n, 3\), not \(2, 2\)"),
        (np.zeros((3, 9)), UP, 1.0, "transpose it"),
        ([[0, np.nan, 0], *POINTS[:2]], UP, 1.0, r"point 0 is \(0, nan, 0\): .* finite"),
        ([*POINTS[:1], [np.inf] * 3, [np.nan] * 3], UP, 1.0, r"point 1 .*and 1 more"),
        (np.array(POINTS) * 1e101, UP, 1.0, r"up to 1e\+101 are too large"),
        (np.broadcast_to(0.0, (100_000_001, 3)), UP, 1.0, "at most 100,000,000"),
        (POINTS, None, 1.0, r"has no normals.*harnack.geometry.estimate_normals\(points\)"),
        (POINTS, UP[:2], 1.0, "3 points but 2 normals"),
        (POINTS, [0, 0, 1], 1.0, r"the normals must have shape \(n, 3\), not \(3,\)"),
        (POINTS, [*UP[:2], [0, 0, np.nan]], 1.0, "normal 2 is .* finite"),
        (POINTS, [*UP[:2], [0, 0, -0.0]], 1.0, "normal 2 is zero: .*estimate_normals"),
        (POINTS, UP, [1, 2], r"must have shape \(3,\), not \(2,\)"),
        (POINTS, UP, [[1], [2], [3]], r"must have shape \(3,\), not \(3, 1\)"),
        (POINTS, UP, None, "the areas must be real numbers"),
        (POINTS, UP, [1, 0, -1], r"area of point 1 is 0 \(and 1 more\): .* positive"),
        (POINTS, UP, [1, 1, np.nan], "area of point 2 is nan"),
        (POINTS, UP, [1, np.inf, 1], "area of point 1 is inf"),
    ],
)
def test_each_bad_cloud_has_its_own_error(points, normals, areas, message):
    with pytest.raises(CloudError, match=message) as caught:
        validate_cloud(points, normals, areas)
    assert isinstance(caught.value, ValueError)


# --- areas -------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["sphere", "spiral", "torus", "two spheres"])
def test_areas_add_up_to_that_of_the_surface(shape):
    n = 4000
    points = normals = {"sphere": on_sphere, "spiral": spiral}.get(shape, spiral)(n)
    expected = 4.0 * np.pi
    if shape == "torus":
        points, normals = on_torus(n)
        expected = 4.0 * np.pi**2 * 0.4
    elif shape == "two spheres":
        points = np.concatenate([points, 0.5 * points + [1.6, 0.0, 0.0]])
        normals = np.concatenate([normals, normals])
        expected *= 1.25
    areas = estimate_areas(points, normals)
    assert areas.sum() == pytest.approx(expected, rel=0.01)
    assert (areas > 0.0).all()


def test_areas_scale_with_the_square_of_the_size():
    x = on_sphere(300)
    areas = estimate_areas(x, x)
    for scale in (1e-40, 1e40):
        np.testing.assert_allclose(
            estimate_areas(scale * x + 3 * scale, 5.0 * x), areas * scale**2, rtol=1e-9
        )


def test_cells_in_a_plane_are_those_of_qhull():
    plane = rng().random((400, 2))
    rotation = np.linalg.qr(rng().normal(size=(3, 3)))[0]
    points = np.column_stack([plane, np.zeros(400)]) @ rotation.T
    areas = estimate_areas(points, np.broadcast_to(rotation[:, 2], (400, 3)), neighbors=60)
    diagram = Voronoi(plane)
    compared = 0
    for k in range(400):
        region = diagram.regions[diagram.point_region[k]]
        corners = diagram.vertices[region]
        if -1 in region or (np.abs(corners - 0.5) > 0.5).any():
            continue
        x, y = (corners - plane[k]).T
        by_angle = np.argsort(np.arctan2(y, x))
        x, y = x[by_angle], y[by_angle]
        expected = 0.5 * np.abs(x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
        assert areas[k] == pytest.approx(expected, rel=1e-9)
        compared += 1
    assert compared > 250


@pytest.mark.parametrize("normal", [[0, 0, 1], [0, 0, -1], [1e-9, 0, -1]])
def test_a_grid_has_equal_cells_at_its_rim_as_well(normal):
    # Parallel and equal bisectors everywhere, and cells without end along the rim.
    x, y = np.mgrid[:12, :9] * 0.25
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(108)])
    areas = estimate_areas(points, np.broadcast_to(normal, (108, 3)))
    np.testing.assert_allclose(areas, 0.0625, rtol=1e-9)


def test_the_rim_of_a_random_disc_does_not_count_much_too_much():
    r, t = rng().random((2, 3000))
    r, t = np.sqrt(r), 2.0 * np.pi * t
    points = np.column_stack([r * np.cos(t), r * np.sin(t), 0 * r])
    total = estimate_areas(points, np.broadcast_to([0, 0, 1], points.shape)).sum()
    assert np.pi < total < 1.04 * np.pi


def test_the_other_side_of_a_thin_wall_takes_nothing_away():
    x = rng().random((800, 2))
    wall = np.column_stack([np.tile(x, (2, 1)), np.repeat([0.0, 0.005], 800)])
    normals = np.repeat([[0, 0, -1.0], [0, 0, 1.0]], 800, axis=0)
    one_side = estimate_areas(wall[:800], normals[:800], neighbors=40)
    both = estimate_areas(wall, normals, neighbors=80)
    inner = (np.abs(x - 0.5) < 0.4).all(axis=1)
    np.testing.assert_allclose(both[:800][inner], one_side[inner], rtol=0.02)


def test_points_at_one_position_share_their_cell():
    x = on_sphere(200)
    areas = estimate_areas(x, x)
    both = estimate_areas(np.concatenate([x, x[:50], x[:10]]), np.concatenate([x, x[:50], x[:10]]))
    share = np.repeat([3.0, 2.0, 1.0], [10, 40, 150])
    np.testing.assert_allclose(both[:200], areas / share, rtol=1e-12)
    np.testing.assert_allclose(both[200:250], areas[:50] / share[:50], rtol=1e-12)


def test_few_points_have_areas_too():
    for count in (2, 3, 4, 12):
        x = on_sphere(count)
        areas = estimate_areas(x, x)
        assert (areas > 0.0).all()
        assert areas.sum() < 20.0


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        ([POINTS[0]] * 3, {}, "all points are at one position"),
        (POINTS, {"neighbors": 2}, "at least 3 neighbors"),
        ([[0, 0, 0], [1e-120, 0, 0], [0, 1e-120, 0]], {}, "within 1e-100"),
    ],
)
def test_areas_that_cannot_be_estimated(points, options, message):
    with pytest.raises(CloudError, match=message):
        estimate_areas(points, UP, **options)
    with pytest.raises(CloudError, match="3 points but 2 normals"):
        estimate_areas(POINTS, UP[:2])


def test_cells_do_not_depend_on_how_the_work_is_divided(monkeypatch):
    x = on_sphere(500)
    areas, normals = estimate_areas(x, x), estimate_normals(x)
    monkeypatch.setattr(clouds, "_CHUNK", 7)
    np.testing.assert_allclose(estimate_areas(x, x), areas, rtol=1e-12)
    np.testing.assert_allclose(estimate_normals(x), normals, atol=1e-9)


# --- normals -----------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [500, 4000])
def test_normals_of_a_sphere_and_a_torus_face_outward(n):
    x = on_sphere(n)
    assert (estimate_normals(x) * x).sum(axis=1).min() > 1.0 - 10.0 / n
    points, expected = on_torus(n)
    normals = estimate_normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    assert (normals * expected).sum(axis=1).min() > 1.0 - 60.0 / n


def test_each_piece_faces_outward_by_itself():
    ball = on_sphere(600)
    shifts = np.repeat([[0.0, 0, 0], [3, 0, 0], [0, -9, 2]], 600, axis=0)
    scale = np.repeat([1.0, 0.1, 5.0], 600)[:, None]
    order = rng().permutation(1800)
    points = (np.tile(ball, (3, 1)) * scale + shifts)[order]
    normals = estimate_normals(points)
    assert (normals * np.tile(ball, (3, 1))[order]).sum(axis=1).min() > 0.9


def box_surface(n: int) -> tuple[np.ndarray, np.ndarray]:
    x = rng().uniform(-1, 1, size=(n, 3))
    side = np.arange(n) % 6
    x[np.arange(n), side % 3] = np.where(side < 3, -1.0, 1.0)
    normals = np.zeros((n, 3))
    normals[np.arange(n), side % 3] = np.where(side < 3, -1.0, 1.0)
    return x * [1.0, 0.6, 0.25], normals


def test_orientation_is_carried_around_sharp_edges():
    points, expected = box_surface(6000)
    cosine = (estimate_normals(points) * expected).sum(axis=1)
    assert (cosine > 0.0).mean() > 0.999


def test_uneven_samples_face_outward():
    x = spiral(4000)
    x = x[(x[:, 0] > 0.5) | (np.arange(4000) % 8 == 0)]  # dense on one side
    assert ((estimate_normals(x) * x).sum(axis=1) > 0.0).all()


def test_points_at_one_position_get_one_normal():
    x = on_sphere(200)
    normals = estimate_normals(np.concatenate([x, x]))
    np.testing.assert_array_equal(normals[:200], normals[200:])
    np.testing.assert_array_equal(normals[:200], estimate_normals(x))


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_a_flat_piece_faces_a_positive_axis(axis, flip):
    x = np.zeros((50, 3))
    x[:, [axis - 2, axis - 1]] = rng().random((50, 2)) * [flip, 1.0]
    np.testing.assert_allclose(estimate_normals(x), np.tile(np.eye(3)[axis], (50, 1)), atol=1e-12)


def test_normals_do_not_depend_on_the_scale():
    points, _ = on_torus(800)
    normals = estimate_normals(points)
    for scale in (1e-60, 1e60):
        np.testing.assert_allclose(estimate_normals(scale * points), normals, atol=1e-6)


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (POINTS, {}, "3 different points do not show a surface"),
        ([POINTS[0]] * 9, {}, "1 different points do not"),
        (np.outer(np.arange(40), [1.0, 2.0, 3.0]), {}, "neighbors of 40 points lie on a line"),
        (np.eye(4, 3), {"neighbors": 1}, "at least 3 neighbors"),
        ([], {}, "there are no points"),
    ],
)
def test_normals_that_cannot_be_estimated(points, options, message):
    with pytest.raises(CloudError, match=message):
        estimate_normals(points, **options)


def test_signs_are_carried_along_any_tree():
    """Against carrying them step by step, on a path, which is the deepest tree."""
    x, _ = icosphere(2)
    parent = np.maximum(np.arange(len(x)) - 1, 0)
    normals = x * np.where(rng().random(len(x)) < 0.5, -1.0, 1.0)[:, None]
    sign = clouds._propagate_signs(clouds._TangentPlanes(x, normals, parent[:, None]), parent)
    for k in range(1, len(x)):
        edge = x[k] - x[k - 1]
        edge /= np.linalg.norm(edge)
        mirrored = normals[k - 1] - 2.0 * (normals[k - 1] @ edge) * edge
        assert np.sign(mirrored @ normals[k]) == sign[k] * sign[k - 1]


# --- moved ----------------------------------------------------------------------------------


def moved_cloud(n=3000, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.full(n, 4 * np.pi / n)


@pytest.mark.few(1)
@pytest.mark.parametrize("motion", ["none", "small", "turned", "shuffled"])
def test_a_moved_cloud_is_the_cloud_that_is_there(motion, monkeypatch):
    """Also where the tree no longer fits: its bounds are of where the points are now."""
    u, areas = moved_cloud()
    field = hk.DipolePotential(u, u, areas)
    field.value(u[:5] * 1.5)
    x = {
        "none": u,
        "small": u * (1 + 0.05 * np.sin(3 * u[:, :1])),
        "turned": u[:, [1, 2, 0]],
        "shuffled": u[np.random.default_rng(1).permutation(len(u))],
    }[motion]
    monkeypatch.setattr("harnack.fmm.treecode.build_balanced_tree", None)  # no sort again
    moved = field.with_points(x, x, areas)
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (800, 3))
    z = x - points[:, None]
    r = np.linalg.norm(z, axis=2)
    exact = (areas * (x * z).sum(axis=2) / r**3).sum(axis=1)
    slope = np.linalg.norm(moved.gradient(points), axis=1)  # times the rounding of the point
    bound = moved.error_bound(points) + 2e-7 * slope + 1e-6 * np.abs(exact)
    assert (np.abs(moved.value(points) - exact) <= bound).all()
    hits = hk.trace(moved, points[:50] * 3, -points[:50], t_max=20.0)
    inside = np.linalg.norm(points[:50] * 3, axis=1) > 1.3
    assert hits.is_hit[inside].all()


def test_a_moved_cloud_keeps_its_number_of_points():
    u, areas = moved_cloud(100)
    with pytest.raises(CloudError, match="99 of them, where 100 were before"):
        hk.DipolePotential(u, u, areas).with_points(u[1:], u[1:], areas[1:])
