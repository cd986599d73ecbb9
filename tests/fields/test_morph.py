"""Morphs: the sliced kernel, its bounds, the quadrature, first hits, both ends."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import beta, betainc, eval_chebyu

import harnack as hk
from harnack.backend import choose_backend, to_float, to_numpy
from harnack.enclosures import HarmonicBall, TaylorRemainder
from harnack.fields.evaluator import Plan
from harnack.fields.solid_angles.morph_slice import GRADIENT_BOUND, SlicedKernel, quadrature_points
from harnack.geometry.example_meshes import bumpy_sphere, icosphere, remove_faces, torus_mesh
from harnack.geometry.meshes import MeshError
from harnack.testing.violation_search import random_directions, sample_field
from tests.backend.test_kernels import compiled
from tests.oracles.direct_sums import sliced_sum
from tests.oracles.oracle import OracleValues, first_crossings

TORUS = torus_mesh(0.7, 0.25, 24, 12)
BUMPY = (0.8 * bumpy_sphere(3)[0], bumpy_sphere(3)[1])
GAP = 0.3


def morph(w: float, **options: Any) -> hk.fields.Morph:
    return hk.fields.Morph(TORUS, BUMPY, gap=GAP, w=w, **options)


def ball(x: np.ndarray, radius: float, w: float) -> np.ndarray:
    """U of a ball about the origin, in closed form."""
    r = np.linalg.norm(x, axis=1)
    near, far = radius - r, radius + r
    bent = math.pi * w / (2 * r) * np.log((near**2 + w * w) / (far**2 + w * w))
    return bent + math.pi * (np.arctan(near / w) + np.arctan(far / w))


def exact(field: hk.fields.Morph, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """f and its gradient at x (n, 3), by the plain sum over the points of the quadrature."""
    slice_: Any = field._slice
    sums = [
        sliced_sum(one.points, one.moments, w)(x)
        for one, w in zip(slice_._pieces, slice_.heights, strict=True)
    ]
    value, gradient = (
        np.sum(parts, axis=0) / (2 * math.pi**2) for parts in zip(*sums, strict=True)
    )
    return value, gradient


# ---------------------------------------------------------------- the kernel and its bounds


@pytest.mark.parametrize("precision", ["double", "single"])
def test_kernel_loses_no_digits_at_any_angle(precision: str) -> None:
    """psi_k D^2k against incomplete beta functions, from straight above to straight beside."""
    backend = choose_backend(precision)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    phi = np.concatenate([rng.uniform(0, 0.5 * np.pi, 2000), 10 ** rng.uniform(-2, -1, 300)])
    phi = np.concatenate([phi, 0.5 * np.pi - 10 ** rng.uniform(-6, -1, 300)])
    r, w = (f(phi).astype(backend.dtype).astype(np.float64) for f in (np.sin, np.cos))
    d = np.hypot(r, w)
    s, c = r / d, w / d
    kernel = SlicedKernel(backend, 1.0)
    kernel.height = to_float(backend, w)  # another in each lane
    for last in (2, 4, 5):
        radial = kernel.at(to_float(backend, d), to_float(backend, 1 / d), last)
        for k, theta in enumerate(radial.thetas):
            n = k + 1
            part = np.where(c < 0.7, 1 - betainc(0.5, n - 0.5, c * c), betainc(n - 0.5, 0.5, s * s))
            moment = 0.5 * part * beta(n - 0.5, 0.5) / s ** (2 * n - 1)
            wanted = 2 / math.pi * 2**k * math.factorial(k) * moment / d
            off = np.abs(to_numpy(radial.scale * theta) / wanted - 1).max()
            assert off < (1e-12 if precision == "double" else 1e-6)


@pytest.mark.parametrize("m", range(1, 7))
def test_slices_bend_no_more_than_dipoles_at_the_distance(m: int) -> None:
    """|d^m K| <= m!/D^(m+1) over all places and directions, attained at height 0; and the lobes
    that the proof in `sliced_kernel` needs are small."""
    nodes, weights = np.polynomial.legendre.leggauss(80)
    half = 0.25 * np.pi * (nodes + 1)
    a = np.linspace(-1, 1, 201)[:, None]
    largest = 0.0
    for start in np.linspace(0, 0.5 * np.pi - 1e-3, 120):
        share = 1 - start / (0.5 * np.pi)
        angle = start + share * half
        terms = eval_chebyu(m, a * np.cos(angle)) * np.cos(angle) ** m
        integral = terms @ weights * (0.25 * np.pi * share) / np.cos(start) ** (m + 1)
        largest = max(largest, float(np.abs(integral).max()))
    assert largest == pytest.approx(0.5 * np.pi, rel=1e-9)
    for k in range(1, (m + 1) // 2 + 1):
        near, far = k * np.pi / (m + 1), min((k + 1) * np.pi / (m + 1), 0.5 * np.pi)
        if far - near < 1e-9:
            continue

        def lobe(t: float, near: float = near) -> float:
            return abs(eval_chebyu(m, math.sin(t) * math.cos(near))) * math.sin(t) ** m

        first = math.asin(math.cos(far) / math.cos(near))
        assert quad(lobe, first, 0.5 * np.pi)[0] < 0.4


def test_gradient_of_a_dipole_in_four_dimensions() -> None:
    """4/pi K: the larger of two functions of the angle, at most 2 GRADIENT, to four digits."""
    phi = np.linspace(1e-2, 0.5 * np.pi, 100_001)
    s, c = np.sin(phi), np.cos(phi)
    across = (phi - s * c) / (2 * s**3)
    along = 2 * across - c
    largest = 4 / math.pi * max(np.sqrt(along**2 + s * s).max(), across.max())
    assert 0.9999 <= largest / (2 * GRADIENT_BOUND) <= 1


# ---------------------------------------------------------------- quadrature


def test_pieces_keep_area_and_first_moment() -> None:
    rng = np.random.default_rng(1)
    corners = rng.normal(size=(40, 1, 3)) + rng.uniform(-1, 1, (40, 3, 3)) * rng.choice(
        [0.02, 1.0], (40, 1, 1)
    )
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    pieces = quadrature_points(corners, 0.3)
    np.testing.assert_allclose(pieces.moments.sum(axis=0), normal.sum(axis=0), atol=1e-12)
    assert len(pieces.points) > 100
    flat = corners * [1, 1, 0]
    flat[:, [1, 2]] = np.where(
        (np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])[:, 2] > 0)[:, None, None],
        flat[:, [1, 2]],
        flat[:, [2, 1]],
    )
    pieces = quadrature_points(flat, 0.3)
    area = 0.5 * np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])[:, 2]
    first = (area[:, None] * flat.mean(axis=1)).sum(axis=0)
    np.testing.assert_allclose((pieces.moments[:, 2:] * pieces.points).sum(axis=0), first)


@pytest.mark.slow
def test_balls_in_closed_form() -> None:
    vertices, faces = icosphere(4)
    corners = vertices[faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    vertices = vertices * (4 * math.pi / 3 / volume) ** (1 / 3)
    a, b = np.array([-0.3, 0, 0]), np.array([0.4, 0.2, 0])
    x = np.random.default_rng(2).normal(0, 0.7, (500, 3))
    for w in (0.06, 0.2, 0.34):
        field = hk.fields.Morph(
            (0.8 * vertices + a, faces), (0.6 * vertices + b, faces), gap=0.4, w=w
        )
        wanted = (ball(x - a, 0.8, w) + ball(x - b, 0.6, 0.4 - w)) / (2 * math.pi**2)
        off = np.abs(field.value(x, precision="double") - wanted)
        assert off.max() < 2e-3
        # What the quadrature leaves out, as a displacement, and what the tree does.
        slope = np.linalg.norm(field.gradient(x, precision="double"), axis=1)
        room = field.quadrature_displacement(x, precision="double") * slope
        assert (off <= room + field.error_bound(x, precision="double") + 1e-3).all()


@pytest.mark.slow
def test_quadrature_bound_holds_against_a_fine_one() -> None:
    x = np.random.default_rng(3).uniform(-1, 1, (200, 3))
    for w in (0.08, 0.22):
        rough, fine = morph(w), morph(w, spacing=0.1)
        assert sum(fine.describe()[f"points of {k}"] for k in "ab") > 20_000
        off = np.abs(exact(rough, x)[0] - exact(fine, x)[0])
        slope = np.linalg.norm(rough.gradient(x, precision="double"), axis=1)
        bound = rough.quadrature_displacement(x, precision="double") * slope
        assert (off <= bound).all()
        assert (off / bound).max() > 1e-3


# ---------------------------------------------------------------- the field


@pytest.mark.few(1)
@pytest.mark.parametrize("w", [0.08, 0.15])
def test_tree_is_the_sum_within_its_error(w: float) -> None:
    field = morph(w, accuracy=2.0)
    x = np.random.default_rng(4).uniform(-1, 1, (60, 3)).astype(np.float32).astype(float)
    value, gradient = exact(field, x)
    for precision in ("single", "double"):
        look = sample_field(field, x, precision=precision) if precision == "double" else None
        off = np.abs(field.value(x, precision=precision) - value)  # type: ignore[arg-type]
        assert (off <= field.error_bound(x, precision=precision)).all()  # type: ignore[arg-type]
        assert off.max() > 1e-6  # there is something to bound
        slant = np.linalg.norm(field.gradient(x, precision=precision) - gradient, axis=1)  # type: ignore[arg-type]
        assert (slant <= field.gradient_error_bound(x, precision=precision)).all()  # type: ignore[arg-type]
        if look is not None:
            for known in look.promises:
                d = random_directions(np.random.default_rng(5), len(x))
                t = 0.99 * known.radius  # type: ignore[union-attr]
                there = exact(field, x + t[:, None] * d)[0]  # type: ignore[index]
                if isinstance(known, TaylorRemainder):
                    line = value + t * (gradient * d).sum(axis=1)
                    assert (np.abs(there - line) <= 0.5 * known.constant * t * t).all()
                else:
                    assert isinstance(known, HarmonicBall)
                    assert known.dimension == 4
                    room = look.error  # type: ignore[union-attr]
                    assert (there <= known.upper + room).all()
                    assert (there >= known.lower - room).all()


def test_hessian_is_that_of_the_gradient() -> None:
    field, h = morph(0.1, accuracy=20.0), 1e-5
    x = np.random.default_rng(6).uniform(-0.8, 0.8, (30, 3))
    hessian = field.hessian(x, precision="double")
    steps = [(exact(field, x + h * e)[1] - exact(field, x - h * e)[1]) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(hessian, np.stack(steps, axis=1), atol=2e-4)


def rays(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    o = 2.5 * random_directions(rng, n)
    d = rng.uniform(-0.9, 0.9, (n, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = o.astype(np.float32).astype(float), d.astype(np.float32).astype(float)
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


def compare(field: hk.fields.Morph, n: int, precision: str, seed: int) -> int:
    """Trace n random rays, look for earlier crossings densely; the number of hits."""
    o, d = rays(n, seed)
    tolerance = 1e-3
    hits = hk.trace(field, o, d, t_max=6.0, tolerance=tolerance, precision=precision)
    nearest = min(field.w, field.gap - field.w)

    def function(x: np.ndarray) -> OracleValues:
        value, gradient = exact(field, x)
        return OracleValues(value, gradient, np.full(len(x), nearest))

    truth = first_crossings(
        function, o, d, 0.0, 6.0, levels=[0.5], depth=tolerance, finest=0.5 * tolerance
    )
    assert not (hits.t > truth.beyond + 5 * tolerance).any()
    value, gradient = exact(field, hits.position[hits.is_hit])
    assert (np.abs(value - 0.5) <= 5 * tolerance * np.linalg.norm(gradient, axis=1)).all()
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    return int(hits.is_hit.sum())


@pytest.mark.slow
@pytest.mark.parametrize("precision", [pytest.param("single", marks=pytest.mark.slow), "double"])
def test_first_hits(precision: str) -> None:
    assert compare(morph(0.15), 25, precision, 0) > 2


@pytest.mark.slow
@pytest.mark.parametrize("w", [0.06, 0.15, 0.25])
def test_many_first_hits(w: float) -> None:
    """250 rays in both precisions: on samples a fifth of the height apart, none before the hit is
    inside the solid; at the hit f is the level within the tolerance."""
    field, tolerance = morph(w), 1e-3
    o, d = rays(250, 1)
    middle, half = -(o * d).sum(axis=1), 1.1
    reach = np.sqrt(np.maximum(half**2 - ((o + middle[:, None] * d) ** 2).sum(axis=1), 0))
    t = (middle - reach)[:, None] + reach[:, None] * np.arange(0, 2, w / 5 / half)
    inside = exact(field, (o[:, None] + t[..., None] * d[:, None]).reshape(-1, 3))[0] > 0.5
    inside = inside.reshape(t.shape)
    first = np.where(inside.any(axis=1), t[np.arange(len(t)), inside.argmax(axis=1)], np.inf)
    assert np.isfinite(first).sum() > 30
    for precision in ("single", "double"):
        hits = hk.trace(field, o, d, t_max=6.0, tolerance=tolerance, precision=precision)  # type: ignore[arg-type]
        assert not (hits.t > first + 5 * tolerance).any()
        assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
        value, gradient = exact(field, hits.position[hits.is_hit])
        steep = np.linalg.norm(gradient, axis=1)
        assert (np.abs(value - 0.5) <= 2 * tolerance * steep).all()


@pytest.mark.parametrize(("w", "mesh"), [(0.0, TORUS), (GAP, BUMPY)])
def test_ends_are_the_meshes(w: float, mesh: Any) -> None:
    o, d = rays(300, 7)
    field = morph(w)
    assert field.traits.has_jumps
    found, wanted = hk.trace(field, o, d), hk.trace(hk.WindingNumber(*mesh), o, d)
    np.testing.assert_array_equal(found.is_hit, wanted.is_hit)
    np.testing.assert_array_equal(found.t, wanted.t)
    np.testing.assert_array_equal(found.primitive_index, wanted.primitive_index)
    assert (field.quadrature_displacement(o) == 0).all()
    assert field.describe()["shows"] == ("mesh a" if w == 0 else "mesh b")


def test_an_end_is_traced_as_its_mesh_is() -> None:
    """With cells where there are many rays, and without jumps for distances: both were lost."""
    vertices, faces = icosphere(3)
    end = hk.fields.Morph((vertices, faces[:900]), (0.5 * vertices, faces), gap=1.0, w=0.0)
    mesh = hk.WindingNumber(vertices, faces[:900])
    plan = Plan((0.5,), 10**7)
    of_end, of_mesh = (each.evaluator(choose_backend("single"), plan) for each in (end, mesh))
    assert type(of_end) is type(of_mesh)
    assert of_end.modulo_one is not None
    assert of_mesh.modulo_one is not None
    assert of_end.jumps is not None
    assert of_mesh.jumps is not None
    assert type(of_end.jumps.smooth_field()) is type(of_mesh.jumps.smooth_field())


@pytest.mark.slow
def test_slices_near_an_end_are_near_the_mesh_in_proportion() -> None:
    o, d = rays(200, 8)
    farther, near, at = (hk.trace(morph(w), o, d, tolerance=1e-3) for w in (0.02, 0.01, 0.0))
    all_ = farther.is_hit & near.is_hit & at.is_hit
    assert all_.sum() > 10
    assert (near.is_hit != at.is_hit).mean() < 0.03
    first, second = (np.median(one.t[all_] - at.t[all_]) for one in (farther, near))
    assert 0 < second < 0.7 * first < 0.05


@pytest.mark.slow
def test_meshes_with_holes() -> None:
    vertices, faces = BUMPY
    field = hk.fields.Morph(TORUS, (vertices, remove_faces(faces, 0.1, seed=0)), gap=GAP, w=0.2)
    assert hk.trace(field, *rays(100, 9), tolerance=1e-3).is_hit.any()


@pytest.mark.slow
def test_another_slice_compiles_no_kernel() -> None:
    o, d = rays(40, 10)

    def trace(k: int) -> int:
        field = hk.fields.Morph(TORUS, BUMPY, gap=GAP + 0.001 * k, w=0.06 + 0.007 * k)
        return compiled(lambda: hk.trace(field, o, d, tolerance=1e-2), size=40)

    trace(0), trace(1)
    assert [trace(k) for k in range(2, 26)] == [0] * 24


def test_extent_holds_the_hits() -> None:
    field = morph(0.15)
    low, high = field.extent((0.5,)).bounds()  # type: ignore[union-attr]
    hits = hk.trace(field, *rays(200, 11), tolerance=1e-3)
    at = hits.position[hits.is_hit]
    assert len(at) > 10
    assert ((at >= low) & (at <= high)).all()
    with pytest.raises(ValueError, match="level 0"):
        field.validate_levels((0.0,))


@pytest.mark.parametrize("w", [-0.1, 0.31, math.nan, math.inf])
def test_heights_outside_the_gap(w: float) -> None:
    with pytest.raises(ValueError, match="w must lie between 0 and the gap"):
        morph(w)


def test_bad_input() -> None:
    for gap in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="gap must be positive"):
            hk.fields.Morph(TORUS, BUMPY, gap=gap, w=0.0)
    for spacing in (0.0, 2.5, math.nan):
        with pytest.raises(ValueError, match="spacing must be"):
            morph(0.1, spacing=spacing)
    with pytest.raises(ValueError, match="accuracy must lie"):
        morph(0.1, accuracy=1.0)
    with pytest.raises(ValueError, match="so near to an end"):
        morph(1e-5)
    with pytest.raises(MeshError, match=r"mesh_a: give a pair \(vertices, faces\)"):
        hk.fields.Morph(None, BUMPY, gap=GAP, w=0.1)  # type: ignore[arg-type]
    vertices, faces = BUMPY
    with pytest.raises(MeshError, match=r"mesh_b: .*out of range"):
        hk.fields.Morph(TORUS, (vertices, faces + 999), gap=GAP, w=0.1)
    with pytest.raises(MeshError, match=r"mesh_b: .*finite"):
        hk.fields.Morph(TORUS, (vertices * np.nan, faces), gap=GAP, w=0.1)


@pytest.mark.slow
def test_hits_carry_derivatives() -> None:
    backend = choose_backend("double")
    o = backend.Array3f(0.65, 0.1, 2.0)
    dr.enable_grad(o)
    hits = hk.trace(morph(0.08), o, backend.Array3f(0, 0, -1), tolerance=1e-6)
    dr.backward(hits.t)
    n = to_numpy(hits.normal)[0]
    np.testing.assert_allclose(to_numpy(dr.grad(o))[0], n / n[2], rtol=1e-3)
