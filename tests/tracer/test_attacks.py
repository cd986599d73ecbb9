"""Cases that attacks on the guarantees found, kept as they were."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.geometry.example_meshes import icosphere
from tests.oracles.direct_sums import dipole_sum

PRECISIONS = ("single", "double")


def single(x: np.ndarray) -> np.ndarray:
    return x.astype(np.float32).astype(np.float64)


def grazing(
    vertices: np.ndarray, faces: np.ndarray, kind: str, n: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays past vertices or edges of a mesh that mostly do not enter it."""
    rng = np.random.default_rng(0)
    chosen = vertices[faces[rng.integers(len(faces), size=n)]]
    share = rng.uniform(size=(n, 1)) if kind == "edges" else 0
    target = chosen[:, 0] + share * (chosen[:, 1] - chosen[:, 0])
    if kind == "axis":
        d = np.eye(3)[rng.integers(3, size=n)] * rng.choice([-1.0, 1.0], (n, 1))
    else:
        d = np.cross(target, rng.normal(size=(n, 3)))
        d /= np.linalg.norm(d, axis=1)[:, None]
        d += 0.15 * rng.normal(size=(n, 3)) * rng.uniform(size=(n, 1))
    d /= np.linalg.norm(d, axis=1)[:, None]
    return target - 1.2 * d, d, target


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("method", ["exact", "tree"])
@pytest.mark.parametrize("kind", ["axis", "random", "edges"])
def test_vertices_of_inner_sheets_are_no_surface(kind: str, method: Any, precision: Any) -> None:
    """A ball in a ball, both outwards: w is 2 and 1, and the level 1/2 is on neither's inside. Rays
    that graze vertices of the inner ball crossed its triangles one by one, some of them out before
    in: 3 % were hits."""
    vertices, faces = icosphere(2)
    vertices = single(vertices)
    both = np.concatenate([3 * vertices, vertices]), np.concatenate([faces, faces + len(vertices)])
    o, d, target = grazing(vertices, faces, kind, 3000)
    some = (np.linalg.norm(o, axis=1) > 1.01) & (np.linalg.norm(o, axis=1) < 2.5)
    o, target = o[some], target[some]
    o = single(o) if precision == "single" else o
    field = hk.WindingNumber(*both, method=method)
    hits = hk.trace(field, o, target - o, t_max=1.6, precision=precision)
    assert (hits.status == hk.RayStatus.MISS).all(), d[some][hits.is_hit][:1]


@pytest.mark.parametrize("precision", PRECISIONS)
def test_hits_of_triangles_seen_edge_on_lie_on_them(precision: Any) -> None:
    """In the plane of a face, to rounding: hits were up to 0.03 from the triangle they named."""
    vertices, faces = icosphere(1)
    vertices = single(vertices)
    rng = np.random.default_rng(1)
    n = 4000
    triangles = vertices[faces[rng.integers(len(faces), size=n)]]
    weights = rng.dirichlet([1, 1, 1], size=n)
    edges = triangles[:, 1:] - triangles[:, :1]
    d = np.einsum("nk,nki->ni", rng.normal(size=(n, 2)), edges)
    d /= np.linalg.norm(d, axis=1)[:, None]
    o = single(np.einsum("nk,nki->ni", weights, triangles) - 3 * d)
    o = np.concatenate([o, [[0.96367258, 1.42124164, -2.16641927]]])
    d = np.concatenate([single(d), [[-0.15844034, -0.27559111, 0.94812775]]])
    field = hk.WindingNumber(vertices, faces)
    hits = hk.trace(field, o, d, tolerance=1e-5, precision=precision)
    rows = np.flatnonzero(hits.is_hit & (hits.primitive_index >= 0))
    assert len(rows) > 1000
    a, b, c = np.moveaxis(vertices[faces[field.facet_faces[hits.primitive_index[rows]]]], 1, 0)
    x, normal = hits.position[rows], np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    assert np.abs(((x - a) * normal).sum(axis=1)).max() < 1e-5
    for p, q in ((a, b), (b, c), (c, a)):
        inward = np.cross(normal, q - p)
        inward /= np.linalg.norm(inward, axis=1)[:, None]
        assert ((x - p) * inward).sum(axis=1).min() > -1e-5


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_what_is_lost_in_rounding_is_no_hit(precision: Any) -> None:
    """Far from a screened cloud the level 0 is nowhere, and w is nothing but held exponentials:
    hits stated an uncertainty of 0 or NaN."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(100, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    field = hk.fields.ScreenedWindingNumber(normals, normals, length=0.05, method="sum")
    o = rng.normal(size=(100, 3))
    o *= 8 / np.linalg.norm(o, axis=1)[:, None]
    d = np.cross(o, rng.normal(size=(100, 3)))
    hits = hk.trace(field, o, d, level=0, t_max=10, precision=precision)
    assert not hits.is_hit.any()
    assert np.isfinite(hits.uncertainty).all()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_rays_that_start_at_vertices_of_curves_hit_them(precision: Any) -> None:
    """They ran out of steps at once, where the sum of an edge's field is infinite."""
    angle = 2 * np.pi * np.arange(8) / 8
    ring = single(np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))
    loops = [ring, single(0.6 * ring[::-1]), single(0.3 * ring)]
    o = np.concatenate(loops)
    hits = hk.trace(hk.SolidAngle(loops), o, np.roll(o, 3, axis=0) - o, precision=precision)
    assert hits.is_hit.all()
    assert hits.t.max() < 1e-4


@pytest.mark.slow
def test_closest_points_of_clouds_are_on_the_surface_whatever_the_accuracy() -> None:
    """They were on that of the approximate sum: up to a fifth of the size off."""
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(400, 3))
    normals = single(normals / np.linalg.norm(normals, axis=1)[:, None])
    field = hk.DipolePotential(normals, normals, np.full(400, np.pi / 100), accuracy=1.5)
    x = 0.8 * rng.normal(size=(12, 3))
    feet = hk.distance.closest_points(field, x)
    value, gradient = dipole_sum(normals, field.areas[:, None] * field.normals)(feet)
    apart = np.linalg.norm(feet[:, None] - normals, axis=2).min(axis=1) > 1e-6
    off = np.abs(value - 2 * np.pi) / np.linalg.norm(gradient, axis=1)
    assert off[apart].max() < 1e-9


@pytest.mark.parametrize("precision", PRECISIONS)
def test_curvatures_beside_curves_state_their_error(precision: Any) -> None:
    """Mean curvatures were off by up to 1e5 times what was stated."""
    loop = single(hk.geometry.example_curves.wavy_polygon(12))
    rng = np.random.default_rng(0)
    middle = 0.5 * (loop + np.roll(loop, -1, axis=0))
    x = single(middle + 1e-5 * rng.normal(size=middle.shape))
    found = hk.curvature(hk.SolidAngle(loop), x, precision=precision)
    # In double precision errors are far smaller, and serve as the truth of single precision.
    exact = hk.curvature(hk.SolidAngle(loop), x, precision="double")
    off = np.abs(found.mean - exact.mean)
    assert ((off <= found.mean_error + exact.mean_error) | np.isnan(found.mean)).all()
    assert (
        found.mean_error[np.isfinite(found.mean)] > (1 if precision == "single" else 1e-9)
    ).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_directions_may_have_any_length(precision: Any) -> None:
    """Those whose squares overflow were proved misses, and short ones pointed elsewhere."""
    o, d = np.array([[0.1, 0.2, 3.0]]), np.array([[0.0, 0.01, -1.0]])
    fields: tuple[hk.Field, ...] = (
        hk.WindingNumber(*icosphere(1)),
        hk.SolidAngle(hk.geometry.example_curves.wavy_polygon(12)),
    )
    powers = (-35, -19, -17, 17, 19, 30, 37) if precision == "single" else (-300, -161, 153, 300)
    for field in fields:
        hit = hk.trace(field, o, d, precision=precision)
        for power in powers:
            same = hk.trace(field, o, d * 10.0**power, precision=precision)
            assert same.is_hit.all()
            np.testing.assert_allclose(same.t, hit.t, rtol=1e-6)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", ["exact", "tree"])
def test_rays_on_the_line_of_a_boundary_edge_see_the_right_value(method: Any) -> None:
    """Exactly on it the edge's factor was as short as what stood for its imaginary part: f along
    the ray was off by a constant, up to 0.25, and first hits were missed."""
    vertices, faces = icosphere(1)
    vertices, faces = single(vertices), faces[np.arange(len(faces)) % 3 > 0]
    o = [[0.7013015747070312, 0, -1.051462173461914]]
    d = [[0.14934921264648438, 0, 0.525731086730957]]
    field = hk.WindingNumber(vertices, faces, method=method)
    hit = hk.trace(field, o, d, level=0.02, tolerance=1e-5, precision="double")
    np.testing.assert_allclose(hit.t, 0.029064, atol=1.1e-5)
    np.testing.assert_allclose(hit.value, field.value(hit.position, precision="double"), atol=1e-6)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", ["exact", "tree"])
def test_rays_along_boundary_edges_miss_no_hit(method: Any) -> None:
    """Of a mesh with whole numbers for coordinates, so that rays are on the very lines: 27,000
    tolerances off before. Hits are within tolerance of a level, and no level is before them."""
    rng, n = np.random.default_rng(5), 150
    vertices, faces = icosphere(1)
    vertices, faces = np.round(8 * vertices), faces[np.arange(len(faces)) % 3 > 0]
    corners = vertices[faces[rng.integers(len(faces), size=n)]]
    start, end = corners[:, 0], corners[:, 1]
    d = end - start
    o = start - d * rng.choice([0.125, 0.25, 0.5, 1, 2], (n, 1))
    field = hk.WindingNumber(vertices, faces, method=method)
    hits = hk.trace(field, o, d, level=0.02, tolerance=1e-5, precision="double")
    assert (hits.status != int(hk.RayStatus.OUT_OF_STEPS)).all()
    exact = hk.WindingNumber(vertices, faces, method="exact")
    smooth = hits.is_hit & (hits.primitive_index < 0)
    w, gradient = exact.value_and_gradient(hits.position[smooth], precision="double")
    steep = np.linalg.norm(gradient, axis=1)
    # On a singular edge itself all values meet.
    off = np.where(np.isfinite(steep), np.abs(np.remainder(w - 0.02 + 0.5, 1) - 0.5) / steep, 0)
    assert smooth.sum() > 100
    assert off.max() < 1.05e-5
    d /= np.linalg.norm(d, axis=1)[:, None]
    share = np.linspace(0, 1, 402)[1:-1]
    x = o[:, None] + (np.minimum(hits.t, 60)[:, None] * share)[:, :, None] * d[:, None]
    x = x.reshape(-1, 3)
    around = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    w = np.stack([exact.value(x + 1e-7 * step, precision="double") for step in around])
    above, regular = w[0] > 0.02, np.ptp(w, axis=0) < 1e-3  # not on a triangle
    first = np.repeat(above.reshape(n, -1)[:, 0], 400)
    assert (above == first)[regular].all()
    assert regular.mean() > 0.6


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("method", ["exact", "tree"])
def test_sheets_in_one_plane_that_cancel_are_no_surface(method: Any, precision: Any) -> None:
    """A triangle on a larger one that faces the other way: a fifth of the rays hit, in whatever
    order rounding put the two crossings."""
    rng, n = np.random.default_rng(0), 1000
    large, small = [[-2, -2, 0], [2, -2, 0], [0, 2, 0]], [[-1, -1, 0], [0, 1, 0], [1, -1, 0]]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    o = rng.normal(size=(n, 3)) * [1, 1, 0] + [0, 0, 3]
    target = np.column_stack([rng.uniform(-0.4, 0.4, n), rng.uniform(-0.8, 0, n), np.zeros(n)])
    for axes in (np.eye(3), turn):
        vertices = single(np.array([*large, *small]) @ axes)
        field = hk.WindingNumber(vertices, [[0, 1, 2], [3, 4, 5]], method=method)
        hits = hk.trace(field, o @ axes, (target - o) @ axes, level=0.3, precision=precision)
        assert not (hits.primitive_index >= 0).any()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_walls_thicker_than_rounding_are_hit(precision: Any) -> None:
    """Two sheets that cancel, a hundred roundings apart, are a wall."""
    rng, n = np.random.default_rng(0), 500
    thick = 1e-5 if precision == "single" else 1e-13
    near = np.array([[-2, -2, thick], [2, -2, thick], [0, 2, thick]])
    vertices = np.concatenate([near, near * [1, 1, 0]])
    field = hk.WindingNumber(vertices, [[0, 1, 2], [3, 5, 4]])
    o = rng.normal(size=(n, 3)) * [1, 1, 0] + [0, 0, 3]
    target = np.column_stack([rng.uniform(-0.4, 0.4, n), rng.uniform(-0.8, 0, n), np.zeros(n)])
    hits = hk.trace(field, o, target - o, precision=precision)
    assert (hits.primitive_index == 0).all()


@pytest.mark.slow
def test_hits_on_dipoles_say_how_far_off_they_are() -> None:
    """Points that rounding takes for a dipole were hits three tolerances from it, without a word:
    all levels meet there, but nowhere else."""
    rng, n = np.random.default_rng(3), 20
    points = rng.normal(size=(n, 3))
    points = single(points / np.linalg.norm(points, axis=1)[:, None])
    areas = single(np.pi / 5 * 10 ** rng.uniform(-8, 2, n))
    chosen, o = rng.integers(n, size=400), single(rng.normal(size=(400, 3)))
    field = hk.fields.ScreenedWindingNumber(points, points, areas, length=5.0, method="sum")
    hits = hk.trace(field, o, points[chosen] - o, level=-0.1, tolerance=1e-5, precision="single")
    value, gradient = field.value_and_gradient(hits.position[hits.is_hit], precision="double")
    off = np.abs(value + 0.1) / np.linalg.norm(gradient, axis=1)
    apart = np.linalg.norm(hits.position[hits.is_hit][:, None] - points, axis=2).min(axis=1)
    stated = 1.05e-5 + hits.uncertainty[hits.is_hit] + 2e-6
    assert (np.minimum(off, apart) <= stated).all()
    assert (hits.uncertainty[hits.is_hit] > 1e-5).sum() > 50


@pytest.mark.few(2)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("method", ["exact", "tree"])
def test_far_away_derivatives_keep_their_bounds(method: Any, precision: Any) -> None:
    """Gradients by tree exceeded them from 80 sizes on, and Hessians in single precision where
    powers of the distance underflow. Far away the field of a triangle is that of a dipole."""
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    field = hk.WindingNumber(triangle, [[0, 1, 2]], method=method)
    rng, normal = np.random.default_rng(0), np.array([0, 0, 0.5])
    for distance in (3e5, 1e7, 1e9):
        x = single(distance * rng.normal(size=(50, 3)))
        r = x - triangle.mean(axis=0)
        rho = np.linalg.norm(r, axis=1)[:, None]
        u, share = r / rho, 1 / (4 * np.pi * rho**3)
        along = (u * normal).sum(axis=1)[:, None]
        gradient = share * (3 * along * u - normal)
        # Of the next order, which for a triangle about its center is the octupole.
        left_out = 10 * share / rho**2
        off = np.linalg.norm(
            np.abs(field.gradient(x, precision=precision)) - np.abs(gradient), axis=1
        )
        bound = field.gradient_error_bound(x, precision=precision)
        assert (off <= bound + left_out[:, 0]).all()
        both = u[:, :, None] * normal + u[:, None, :] * normal[:, None]
        outer = u[:, :, None] * u[:, None, :]
        bend = both + along[:, :, None] * (np.eye(3) - 5 * outer)
        bend *= 3 * (share / rho)[:, :, None]
        off = np.abs(np.abs(field.hessian(x, precision=precision)) - np.abs(bend)).max(axis=(1, 2))
        bound = field.hessian_error_bound(x, precision=precision)
        assert (off <= bound + left_out[:, 0] / rho[:, 0]).all()


def test_curvatures_where_rounding_meets_a_shifted_curve_are_unknown() -> None:
    """In single precision, 2,000 sizes from the origin, points that count as on the curve had the
    curvature of a made-up gradient, with an error of nothing."""
    rng = np.random.default_rng(0)
    loop = single(rng.normal(size=(6, 3)) + 2000 * np.array([0.6, -0.7, 0.4]))
    share = rng.random((25, 1))
    k = rng.integers(6, size=25)
    x = single(loop[k] * (1 - share) + loop[(k + 1) % 6] * share + 1e-4 * rng.normal(size=(25, 3)))
    found = hk.curvature(hk.SolidAngle(loop), x, precision="single")
    exact = hk.curvature(hk.SolidAngle(loop), x, precision="double")
    known = np.isfinite(found.mean)
    assert (~known).sum() > 5
    off = np.abs(found.mean - exact.mean)[known]
    assert (off <= (found.mean_error + exact.mean_error)[known]).all()


@pytest.mark.slow
def test_distances_from_absurdly_far_away() -> None:
    """The newton distance to a cloud was 0 from 1e20 sizes on; from 1e160 an IndexError."""
    vertices, faces = icosphere(2)
    x = np.array([[0.3, -0.5, 0.8]])
    open_mesh = hk.WindingNumber(vertices, faces[vertices[faces].mean(axis=1)[:, 2] < 0.6])
    for field in (open_mesh, hk.DipolePotential(vertices, vertices)):
        for method in ("lower_bound", "closest_point"):
            far = hk.signed_distance(field, 1e20 * x, method=method)  # type: ignore[arg-type]
            assert 1e19 < far[0] < 1e20
            with pytest.raises(ValueError, match=r"coordinates up to .* are too large"):
                hk.signed_distance(field, 1e160 * x, method=method)  # type: ignore[arg-type]


@pytest.mark.parametrize("scale", [1e-38, 1e-20, 1e20, 1e37])
@pytest.mark.parametrize(
    "make",
    [
        lambda s: hk.SolidAngle(np.array([[1, 0, 0], [0, 1, 0], [-1, -1, 0.3]]) * s),
        lambda s: hk.Surface(hk.Gyroid(s), clip=hk.Box((-s, -s, -s), (s, s, s))),
        lambda s: hk.Torus(0.6 * s, 0.2 * s),
    ],
    ids=["curve", "clip", "solid"],
)
def test_what_squares_of_lengths_lose_is_refused(make: Any, scale: float) -> None:
    """All rays missed in single precision, where squares of coordinates overflow or are 0."""
    ray = [[0.0, 0.0, 0.0]], [[0.0, 0.6, 0.8]]
    kind = "size of .* too small" if scale < 1 else "coordinates up to .* too large"
    with pytest.raises(ValueError, match=f"{kind} for single precision"):
        hk.trace(make(scale), *ray, precision="single")
    with pytest.raises(ValueError, match=r"origins have coordinates up to 4e[+]20: too large"):
        hk.trace(make(1.0), [[4e20, 0.0, 0.0]], ray[1], precision="single")
