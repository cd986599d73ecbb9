"""Shapes: what each promises, against formulas in NumPy that share nothing with it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.arithmetic.norms import blend_intersection, blend_union
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.backend.elementary import safe_norm
from harnack.enclosures import LevelGaps, choose_enclosures
from harnack.enclosures.samples import Ray, value_error_bound
from harnack.enclosures.selection import longest_free_length
from harnack.fields.formula import Formula
from harnack.fields.solids.fractal import CORNERS, lattice_vector
from harnack.geometry import example_meshes
from harnack.meshing.closed_mesh import from_manifold, to_manifold
from harnack.meshing.triangle_mesh import TriangleMesh
from harnack.testing import check_field
from tests.oracles.mesh_distance import signed_distance

Oracle = Callable[[Any], Any]
CURVE = np.array([[0, 0, 0], [1, 0.2, 0], [0.3, 1, 0.4], [-0.5, 0.5, 0.8], [-1, 0, 1],
                  [-0.2, -0.9, 0.3], [0.4, -0.6, -0.4]])  # fmt: skip


def norm(x: Any, p: float = 2.0) -> Any:
    return np.linalg.norm(x, p, axis=-1)


def pair(a: Any, b: Any, p: float = 2.0) -> Any:
    return norm(np.stack([a, b], -1), p)


def box(x: Any, half: Any) -> Any:
    q = np.abs(x) - half
    return norm(np.maximum(q, 0)) + np.minimum(q.max(-1), 0)


def segments(x: Any, points: Any) -> Any:
    best = np.full(x.shape[:-1], np.inf)
    for a, b in itertools.pairwise(points):
        t = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        best = np.minimum(best, norm(x - a - t[..., None] * (b - a)))
    return best


def region(x: Any, loops: Any) -> Any:
    """The signed distance in the plane, inside by the even-odd rule: rays towards +y."""
    best, inside = np.full(x.shape[:-1], np.inf), np.zeros(x.shape[:-1], bool)
    for loop in loops:
        closed = np.array([*loop, loop[0]])
        best = np.minimum(best, segments(x, closed))
        for a, b in itertools.pairwise(closed):
            spans = (a[0] > x[..., 0]) != (b[0] > x[..., 0])
            if spans.any():
                at = a[1] + (x[..., 0] - a[0]) / (b[0] - a[0]) * (b[1] - a[1])
                inside ^= spans & (at > x[..., 1])
    return np.where(inside, -best, best)


def hull_of_balls(x: Any, centers: Any, radii: Any) -> Any:
    """The signed distance: the greatest of n . x less the support function over unit vectors n. It
    is attained at the direction from one of the centers, or at one of those n that support both."""
    (a, b), (r, s) = np.array(centers, float), radii
    axis, length = b - a, np.linalg.norm(b - a)
    normals = [(x - center) / np.maximum(norm(x - center), 1e-300)[..., None] for center in (a, b)]
    if abs(r - s) < length:
        along = axis / length
        across = (x - a) - ((x - a) @ along)[..., None] * along
        size = norm(across)[..., None]
        any_across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
        across = np.where(
            size > 0, across / np.maximum(size, 1e-300), any_across / norm(any_across)
        )
        slope = (r - s) / length
        normals.append(slope * along + math.sqrt(1 - slope**2) * across)
    return np.max(
        [np.minimum(((x - a) * n).sum(-1) - r, ((x - b) * n).sum(-1) - s) for n in normals], axis=0
    )


def extruded(x: Any, loops: Any, height: float, twist: float = 0.0, taper: float = 1.0) -> Any:
    z = x[..., 2]
    share = np.clip(z / height, 0, 1)
    q = (x[..., 0] + 1j * x[..., 1]) / (1 + share * (taper - 1))
    q = q * np.exp(-1j * math.radians(twist) * z / height)
    d, w = region(np.stack([q.real, q.imag], -1), loops), np.abs(z - height / 2) - height / 2
    return pair(np.maximum(d, 0), np.maximum(w, 0)) + np.minimum(np.maximum(d, w), 0)


def screw(x: Any, thread: Any) -> Any:
    pitch, points = thread.pitch, np.array(thread.profile)
    lead = thread.starts * pitch * (-1 if thread.left_handed else 1)
    r = norm(x[..., :2])
    u = (x[..., 2] - lead * np.arctan2(x[..., 1], x[..., 0]) / (2 * np.pi)) % pitch
    curve = np.concatenate([points + np.array([k * pitch, 0]) for k in range(-3, 5)])
    d = segments(np.stack([u, r], -1), curve)
    return np.maximum(np.where(r < np.interp(u, *curve.T), -d, d), -points[:, 1].min() / 2)


def julia(x: Any, c: Any, count: int, w: float) -> Any:
    q = np.concatenate([x, np.full((*x.shape[:-1], 1), w)], -1).astype(np.longdouble)
    log, share = np.zeros(x.shape[:-1]), np.ones(x.shape[:-1])
    for _ in range(count):
        far = norm(q) > 1e30
        log = np.where(far, log, 0)
        square = np.concatenate(
            [
                q[..., :1] ** 2 - (q[..., 1:] ** 2).sum(-1, keepdims=True),
                2 * q[..., :1] * q[..., 1:],
            ],
            -1,
        )
        q = np.where(far[..., None], q, square + np.array(c))
        share = np.where(far, share, share / 2)
    b = 0.5 + math.sqrt(0.25 + math.hypot(*c))
    size = np.sqrt((q * q).sum(-1))
    last = 2.0**-count
    with np.errstate(divide="ignore"):
        return np.maximum(share * np.log(size) - last * math.log(b), -last).astype(float)


def noise(x: Any, field: Any) -> Any:
    backend = choose_backend("double")
    flat = x.reshape(-1, 3)
    total = np.zeros(len(flat))
    for octave in range(field.octaves):
        q = flat * field.frequency * 2.0**octave
        base = np.floor(q)
        for corner in CORNERS:
            at = (base + corner).astype(np.int64).astype(np.uint32)
            seed = backend.UInt32((field.seed + octave) % 2**32)
            g = lattice_vector(*(backend.UInt32(v) for v in at.T), seed, backend.Float(0))
            g = np.stack([np.array(v) for v in g], -1)
            away = q - base - corner
            t = 1 - np.abs(away)
            s = t**3 * (t * (6 * t - 15) + 10) if field.fade == "quintic" else t**2 * (3 - 2 * t)
            total += (
                field.amplitude * 2.0 ** (-field.beta * octave) * s.prod(-1) * (g * away).sum(-1)
            )
    return total.reshape(x.shape[:-1])


def powered(x: Any, powers: Any, radii: Any) -> Any:
    y = x / np.array(radii)
    return min(radii) * (pair(norm(y[..., :2], powers[0]), y[..., 2], powers[1]) - 1)


def supertorus(x: Any, powers: Any, major: float, minor: float) -> Any:
    return pair(norm(x[..., :2], powers[0]) - major, x[..., 2], powers[1]) - minor


NOISE = hk.solids.Noise(2.0, 0.7, seed=5)
FRACTAL = hk.solids.FractalNoise(3, 1.0, 2.0, 0.15, fade="cubic")
TUBE = hk.Tube.bezier(CURVE, 0.2, tolerance=2e-3)
C = (-0.2, 0.8, 0.0, 0.0)
SCREW = hk.solids.Thread([(0, 0.8), (0.1, 0.8), (0.25, 0.5)], 0.4, starts=2, left_handed=True)
TURN = np.linspace(0, 2 * np.pi, 90, endpoint=False)
STAR = (0.8 + 0.25 * np.cos(5 * TURN))[:, None] * np.column_stack([np.cos(TURN), np.sin(TURN)])
# A hole, which runs the same way around, and an island in it.
LOOPS = [STAR, [[-0.4, -0.3], [0.45, -0.3], [0.3, 0.4]], [[0.0, -0.2], [0.25, -0.2], [0.2, 0.1]]]
CUP = [[0.0, -0.6], [0.5, -0.6], [0.9, 0.6], [0.8, 0.65], [0.4, -0.4], [0.0, -0.4]]

SPIKES = example_meshes.icosphere(0)
SPIKES = SPIKES[0] * np.where(np.arange(12) % 3, 1.0, 0.4)[:, None], SPIKES[1]
# Two tetrahedra through each other, as one mesh; and the surface of their union.
CORNERS_OF_FOUR = np.array([[0, 0, 0.9], [0.9, 0.1, -0.5], [-0.5, 0.8, -0.4], [-0.4, -0.8, -0.5]])
FOUR = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
CROSSING = (
    np.concatenate([CORNERS_OF_FOUR, [0.1, 0.2, 0.0] - CORNERS_OF_FOUR[[0, 1, 3, 2]]]),
    (np.concatenate([FOUR, FOUR + 4])),
)
UNITED = from_manifold(
    to_manifold(TriangleMesh(CROSSING[0], FOUR)) + to_manifold(TriangleMesh(CROSSING[0], FOUR + 4))
)

SHAPES: dict[str, tuple[Any, Oracle]] = {
    "plane": (
        hk.solids.Plane((1.0, 2.0, -2.0), 0.3),
        lambda x: x @ np.array([1.0, 2.0, -2.0]) / 3 - 0.3,
    ),
    "sphere": (hk.Sphere(0.8, (0.1, 0.2, 0.0)), lambda x: norm(x - [0.1, 0.2, 0.0]) - 0.8),
    "ellipsoid": (
        hk.Ellipsoid((1.0, 0.5, 0.7)),
        lambda x: 0.5 * (norm(x / np.array([1.0, 0.5, 0.7])) - 1),
    ),
    "cylinder": (hk.Cylinder(0.5), lambda x: norm(x[..., :2]) - 0.5),
    "cut cylinder": (
        hk.Cylinder(0.5, 1.6),
        lambda x: box(np.stack([norm(x[..., :2]), x[..., 2]], -1), [0.5, 0.8]),
    ),
    "double cone": (
        hk.solids.DoubleCone(math.degrees(0.6)),
        lambda x: norm(x[..., :2]) * math.cos(0.6) - np.abs(x[..., 2]) * math.sin(0.6),
    ),
    "capsule": (
        hk.Capsule((0.2, 0.0, 0.0), (1.0, 0.5, -0.3), 0.3),
        lambda x: segments(x, np.array([[0.2, 0.0, 0.0], [1.0, 0.5, -0.3]])) - 0.3,
    ),
    "round cone": (
        hk.solids.RoundCone((0.2, 0.0, 0.0), (0.8, 0.5, -0.3), (0.2, 0.5)),
        lambda x: hull_of_balls(x, [[0.2, 0.0, 0.0], [0.8, 0.5, -0.3]], (0.2, 0.5)),
    ),
    "ball in a ball": (
        hk.solids.RoundCone((0.2, 0.0, 0.0), (0.1, 0.1, -0.3), (0.7, 0.3)),
        lambda x: norm(x - [0.2, 0.0, 0.0]) - 0.7,
    ),
    "torus": (hk.Torus(0.9, 0.3), lambda x: pair(norm(x[..., :2]) - 0.9, x[..., 2]) - 0.3),
    "box": (hk.Cuboid((2.0, 1.0, 1.4)), lambda x: box(x, [1.0, 0.5, 0.7])),
    "rounded box": (
        hk.Cuboid((2.0, 1.0, 1.4), 0.2),
        lambda x: box(x, [0.8, 0.3, 0.5]) - 0.2,
    ),
    **{
        f"superellipsoid {p} {q}": (
            hk.solids.Superellipsoid((p, q), (1.0, 0.7, 0.9)),
            lambda x, p=p, q=q: powered(x, (p, q), (1.0, 0.7, 0.9)),
        )
        for p, q in ((4.0, 4.0), (1.0, 1.0), (1.5, 3.0), (2.0, 1.3))
    },
    **{
        f"supertorus {p} {q}": (
            hk.solids.Supertorus((p, q), 0.9, 0.3),
            lambda x, p=p, q=q: supertorus(x, (p, q), 0.9, 0.3),
        )
        for p, q in ((4.0, 4.0), (1.2, 1.5))
    },
    "tube": (TUBE, lambda x: segments(x, TUBE.points) - 0.2),
    "outline": (hk.Extrusion(LOOPS, 0.6), lambda x: extruded(x, LOOPS, 0.6)),
    "few edges": (
        hk.Extrusion(LOOPS[1:], 0.6),
        lambda x: extruded(x, LOOPS[1:], 0.6),
    ),
    "turned outline": (
        hk.Extrusion(LOOPS, 0.8, twist=70.0, taper=0.6),
        lambda x: extruded(x, LOOPS, 0.8, 70.0, 0.6),
    ),
    "cup": (
        hk.SolidOfRevolution(CUP),
        # Mirrored at the axis, where the edges on it are none.
        lambda x: region(
            np.stack([norm(x[..., :2]), x[..., 2]], -1),
            [np.concatenate([CUP, np.array(CUP)[-2:0:-1] * [-1, 1]])],
        ),
    ),
    "mesh": (hk.solid(SPIKES), lambda x: signed_distance(x, *SPIKES)),
    "crossing mesh": (
        hk.solid(CROSSING),
        lambda x: signed_distance(x, UNITED.vertices, UNITED.faces),
    ),
    "thread": (SCREW, lambda x: screw(x, SCREW)),
    "noise": (NOISE, lambda x: noise(x, NOISE)),
    "displaced": (
        hk.solids.DisplacedSolid(hk.Sphere(), FRACTAL),
        lambda x: norm(x) - 1 + noise(x, FRACTAL),
    ),
    "julia": (hk.solids.Julia(C, 8, 0.1), lambda x: julia(x, C, 8, 0.1)),
}  # fmt: skip

EVERY = pytest.mark.parametrize("name", SHAPES)
# One precision, and one shape of each kind, tell most of what goes wrong; the rest is slow.
QUICK_PRECISIONS = pytest.mark.parametrize(
    "precision", ["single", pytest.param("double", marks=pytest.mark.slow)]
)
# Others of their kinds have contracts, which take half a minute each: their formulas are long.
ALIKE = (
    *(f"superellipsoid {powers}" for powers in ("4.0 4.0", "1.5 3.0", "2.0 1.3")),
    "supertorus 4.0 4.0",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", [one for one in SHAPES if one not in ALIKE])
def test_contract(name: str) -> None:
    check_field(SHAPES[name][0], rng=1, count=25, directions=2)


@pytest.mark.few(11)
@EVERY
@QUICK_PRECISIONS
def test_values(name: str, precision: Any) -> None:
    shape, oracle = SHAPES[name]
    x = np.random.default_rng(2).uniform(-1.5, 1.5, (400, 3)).astype(np.float32).astype(float)
    off = np.abs(shape.value(x, precision=precision) - oracle(x))
    assert off.max() < (1e-3 if name == "julia" else 3e-6) * (1 if precision == "single" else 1e-6)


def unit_vectors(rng: Any, n: int) -> Any:
    d = rng.normal(size=(n, 3))
    return d / norm(d)[:, None]


@pytest.mark.few(2)
@EVERY
@QUICK_PRECISIONS
def test_no_level_within_a_step(name: str, precision: Any) -> None:
    """Along random paths, with levels near and far; the same steps times 1.001 meet one."""
    shape, oracle = SHAPES[name]
    backend, rng, n = choose_backend(precision), np.random.default_rng(3), 800
    x = rng.uniform(-1.3, 1.3, (n, 3))
    x[: n // 5] = np.round(x[: n // 5])  # on axes and planes of symmetry
    d = unit_vectors(rng, n)
    d[: n // 10] = np.eye(3)[rng.integers(0, 3, n // 10)]
    x, d = (v.astype(backend.dtype).astype(float) for v in (x, d))
    ahead = 10.0 ** rng.uniform(-4, 0.5, n)
    gaps = ahead * 10.0 ** rng.uniform(-2, 0.5, (2, n))
    p, along = to_vector3(backend, x), to_vector3(backend, d)
    path = Ray(p, along, choose_enclosures(None))
    look = shape.evaluator(backend).sample_ray(
        path, backend.Float(0), backend.Float(ahead), backend.Float(0)
    )
    blur = value_error_bound(look.sample, safe_norm(look.sample.gradient), 1.5)
    seen = LevelGaps(*(backend.Float(one) for one in gaps)).reduced_by(blur)
    step = to_numpy(longest_free_length(look.forward, seen)).astype(float) * np.ones(n)
    start = oracle(x)
    assert (step > 0).mean() > 0.5

    def passes(factor: float) -> Any:
        t = factor * step[:, None] * np.linspace(0, 1, 33)
        moved = oracle(x[:, None] + t[..., None] * d[:, None]) - start[:, None]
        slack = 1e-12 if precision == "double" else 0.0
        return (moved > gaps[1][:, None] + slack).any(1) | (moved < -gaps[0][:, None] - slack).any(
            1
        )

    assert not passes(1.0).any()
    never_that_long = ("julia", "turned outline", "thread")
    if precision == "double" and name not in never_that_long:
        assert passes(1.001).any()


CONSTANTS = [
    *[
        name
        for name in SHAPES
        if name not in ("tube", "turned outline", "thread", "noise", "displaced", "julia")
    ],
]


def steepest(oracle: Oracle, rng: Any, spread: float = 1.5) -> float:
    """The largest difference quotient that a search finds."""
    h = 1e-6
    x, d = rng.uniform(-spread, spread, (5_000, 3)), unit_vectors(rng, 5_000)

    def slope(x: Any, d: Any) -> Any:
        return (oracle(x + h * d) - oracle(x - h * d)) / (2 * h)

    best = slope(x, d)
    size = 0.3
    for _ in range(90):
        keep = np.argsort(best)[-200:]
        x, d, best = x[keep], d[keep], best[keep]
        y = x + size * rng.normal(size=x.shape)
        e = d + size * rng.normal(size=x.shape)
        e /= norm(e)[:, None]
        new = slope(y, e)
        better = new > best
        x[better], d[better], best[better] = y[better], e[better], new[better]
        size *= 0.93
    return float(best.max())


@pytest.mark.parametrize("name", CONSTANTS)
def test_lipschitz_constants_are_attained(name: str) -> None:
    shape, oracle = SHAPES[name]
    most = steepest(oracle, np.random.default_rng(4))
    if name.startswith("superellipsoid"):  # attained where the radii are equal
        assert most <= shape.lipschitz * (1 + 1e-6)
        return
    assert 0.99 * shape.lipschitz <= most <= shape.lipschitz * (1 + 1e-6)


@pytest.mark.parametrize(
    "powers", [(1.0, 1.0), (1.0, 2.0), (2.0, 1.0), (1.3, 1.7), (4.0, 4.0), (3.0, 1.2), (1.5, 5.0)]
)
def test_constants_of_norms_are_attained(powers: tuple[float, float]) -> None:
    shape = hk.solids.Superellipsoid(powers)
    most = steepest(lambda x: powered(x, powers, (1.0, 1.0, 1.0)), np.random.default_rng(5))
    assert 0.99 * shape.lipschitz <= most <= shape.lipschitz * (1 + 1e-6)


@EVERY
@pytest.mark.parametrize(
    "level",
    [pytest.param(-0.1, marks=pytest.mark.slow), 0.0, pytest.param(0.2, marks=pytest.mark.slow)],
)
def test_hulls_hold_the_solid(name: str, level: float) -> None:
    shape, oracle = SHAPES[name]
    hull = shape.sublevel_extent(level)
    if name in ("plane", "cylinder", "double cone", "thread", "noise"):
        assert hull is None
        return
    rng = np.random.default_rng(6)
    if name == "julia":
        level *= 0.1
        hull = shape.sublevel_extent(level)
    x = rng.uniform(-2.5, 2.5, (8_000, 3))
    inside = oracle(x) <= level
    assert hull.contains_points(x[inside]).all()


@pytest.mark.few(3)
@EVERY
@QUICK_PRECISIONS
def test_first_hits(name: str, precision: Any) -> None:
    """No ray passes a place where f is negative before its hit; hits are on the surface."""
    shape, oracle = SHAPES[name]
    rng, n = np.random.default_rng(7), 150
    o = 3 * unit_vectors(rng, n)
    d = rng.uniform(-0.9, 0.9, (n, 3)) - o
    d /= norm(d)[:, None]
    o, d = (v.astype(np.float32).astype(float) for v in (o, d))
    d /= norm(d)[:, None]
    hits = hk.trace(shape, o, d, t_max=6.0, precision=precision)
    status = np.array(hits.status)
    assert (status != int(hk.RayStatus.OUT_OF_STEPS)).all()
    is_hit = status == int(hk.RayStatus.HIT)
    end = np.where(is_hit, np.array(hits.t), 6.0)
    t = end[:, None] * np.linspace(0, 1, 501)[:-1]
    start = np.sign(oracle(o))
    f = start[:, None] * oracle(o[:, None] + t[..., None] * d[:, None])
    slack = 1e-5 if precision == "single" else 1e-12  # of f before the hit
    assert (f > -slack).all()
    assert np.abs(oracle(o + end[:, None] * d)[is_hit]).max() < 1e-3  # ten times the tolerance
    assert is_hit.mean() > 0.05


@pytest.mark.slow
@EVERY
def test_sphere_tracing_finds_the_same(name: str) -> None:
    shape, _ = SHAPES[name]
    rng = np.random.default_rng(8)
    o = 3 * unit_vectors(rng, 300)
    d = rng.uniform(-0.9, 0.9, (300, 3)) - o
    d /= norm(d)[:, None]
    one, two = (
        hk.trace(shape, o, d, t_max=6.0, precision="double", tolerance=1e-4, enclosures=b)
        for b in (None, "lipschitz")
    )
    a, b = np.array(one.t), np.array(two.t)
    both = np.isfinite(a) & np.isfinite(b)
    assert (np.isfinite(a) != np.isfinite(b)).mean() < 0.01
    assert np.median(np.abs(a[both] - b[both])) < 2e-4  # the tolerance of a hit is 1e-4


@pytest.mark.parametrize("power", [1.0, 2.0, 4.0, 8.0])
def test_blends(power: float) -> None:
    """The constant 2^(1/p) is attained, and 1 holds of gradients at right angles, p >= 2."""
    rng, r = np.random.default_rng(9), 0.5

    def blended(a: Any, b: Any) -> Any:
        return np.asarray(blend_union(a, b, r, power))

    same = steepest(lambda x: blended(x[..., 0], x[..., 0]), rng, 0.45)
    assert same == pytest.approx(2 ** (1 / power), rel=1e-3)
    across = steepest(lambda x: blended(x[..., 0], x[..., 1]), rng, 1.0)
    if power >= 2:
        assert across == pytest.approx(1.0, abs=1e-3)
    x = rng.uniform(-1, 2, (2, 1000))
    assert (blended(*x) <= np.minimum(*x) + 1e-12).all()
    far = x.min(0) > r
    assert np.allclose(blended(*x)[far], x.min(0)[far])
    assert np.allclose(blend_intersection(-x[0], -x[1], r, power), -blended(*x))


class Blended(Formula):
    """A blended union of a sphere and a box."""

    lipschitz = 2**0.5

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        a = hk.math.norm(x - 0.6, y, z) - 0.5
        b = hk.math.maximum(abs(x + 0.4), abs(y), abs(z)) - 0.4
        return blend_union(a, b, 0.4)


@pytest.mark.slow
def test_blends_keep_their_promises() -> None:
    check_field(Blended(), rng=3, count=100)
    o = np.array([[0.1, 0.0, 3.0]])
    d = np.array([[0.0, 0.0, -1.0]])
    sharp = hk.trace(hk.Sphere(0.5, (0.6, 0.0, 0.0)), o, d)
    blended = hk.trace(Blended(), o, d)
    assert blended.t[0] < sharp.t[0]


def test_flattening_is_as_stated() -> None:
    t = np.linspace(0, 1, 400)[:, None]
    for start in (0, 3):
        a, b, c, e = CURVE[start : start + 4]
        curve = (1 - t) ** 3 * a + 3 * t * (1 - t) ** 2 * b + 3 * t**2 * (1 - t) * c + t**3 * e
        assert segments(curve, TUBE.points).max() <= TUBE.flattening_error + 1e-12
    assert TUBE.flattening_error <= 2e-3
    finer = hk.Tube.bezier(CURVE, 0.2, tolerance=1e-5)
    assert finer.describe()["segments"] > 5 * TUBE.describe()["segments"]


def test_metric_threads_have_their_sizes() -> None:
    """M8: 8 mm across crests, 6.647 mm across roots (ISO 724), 7.188 mm across the pitch line."""
    pitch = 1.25
    screw, cut = (
        hk.solids.metric_thread("M8", 20.0),
        hk.solids.metric_thread("M8", 20.0, internal=True),
    )
    z = 10.0 + pitch * np.linspace(0, 1, 2001)
    for solid in (screw, cut):
        angle = 0.7
        r = np.linspace(2.9, 4.3, 1401)
        x = np.stack(np.broadcast_arrays(r[:, None] * math.cos(angle), r[:, None] * math.sin(angle),
                                         z[None]), -1)  # fmt: skip
        inside = solid.value(x.reshape(-1, 3), precision="double").reshape(x.shape[:2]) <= 0
        edge = r[inside.sum(axis=0) - 1]  # a profile r(z)
        assert 2 * edge.max() == pytest.approx(8.0, abs=4e-3)
        assert 2 * edge.min() == pytest.approx(6.647, abs=4e-3)
        assert np.mean(edge > 7.188 / 2) == pytest.approx(0.5, abs=5e-3)
        assert np.mean(edge > 3.998) == pytest.approx(1 / 8, abs=5e-3)
        assert np.mean(edge < 6.65 / 2) == pytest.approx(1 / 4, abs=5e-3)
    # A screw and its nut are twice the clearance apart, across crests, roots and flanks.
    loose, wide = hk.solids.metric_thread("M8", 20.0, clearance=0.05), hk.solids.metric_thread(
        "M8", 20.0, internal=True, clearance=0.05
    )  # fmt: skip
    points = x.reshape(-1, 3)
    off = [
        a.value(points, precision="double") - b.value(points, precision="double")
        for a, b in ((loose.parts[0], screw.parts[0]), (screw.parts[0], wide.parts[0].parts[0]))
    ]
    near = np.abs(screw.value(points, precision="double")) < 0.05
    for one in off:
        assert np.median(one[near]) == pytest.approx(0.05, abs=1e-9)
        assert one[near].min() > 0.0249  # beside a corner, where another edge is nearest
    # On the pitch line of M12, 10.863 across: both flanks are 0.2 apart, and not 0.1 and 0.3.
    bolt, hole = hk.solids.metric_thread("M12", 20.0, clearance=0.1), hk.solids.metric_thread(
        "M12", 20.0, internal=True, clearance=0.1
    )  # fmt: skip
    flanks = [[10.863 / 2, 0.0, 7.0 + turn * 1.75] for turn in (-3 / 16, 5 / 16)]
    gaps = (bolt.parts[0].value(flanks), -hole.parts[0].parts[0].value(flanks))
    assert np.abs(np.array(gaps) - 0.1).max() < 2e-4
    # Counter-clockwise as it rises: a quarter of a turn up, the same a quarter of a pitch higher.
    rise = screw.parts[0].value([[0.0, 3.9, 5.0 + pitch / 4]], precision="double")
    assert rise == pytest.approx(screw.parts[0].value([[3.9, 0.0, 5.0]], precision="double"))


def test_coils_stay_within_their_flattening() -> None:
    coil = hk.Tube.helix(2.0, 0.5, 3.0, 0.2, left_handed=True)
    t = np.linspace(0, 6 * np.pi, 5000)
    curve = np.column_stack([2 * np.cos(t), -2 * np.sin(t), 0.5 * t / (2 * np.pi)])
    off = np.abs(coil.value(curve, precision="double") + 0.2).max()
    assert 0.9 * coil.flattening_error < off <= coil.flattening_error <= 2e-4


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: hk.Sphere(0.0), "radius of a sphere must be positive"),
        (lambda: hk.Sphere(1.0, (0, math.nan, 0)), "must be finite"),
        (lambda: hk.solids.Plane((0, 0, 0)), "must not be zero"),
        (lambda: hk.solids.Plane((0, 1)), "three numbers, not 2"),
        (lambda: hk.Ellipsoid((1, -1, 1)), "must be positive"),
        (lambda: hk.Cylinder(1.0, 0.0), "the height"),
        (lambda: hk.solids.DoubleCone(120.0), "between 0 and 90 degrees"),
        (lambda: hk.Capsule((0, 0, 0), (0, 0, 0)), "use Sphere"),
        (lambda: hk.Torus(1.0, math.inf), "minor radius"),
        (lambda: hk.Cuboid((2, 2, 2), 2.0), "least half side"),
        (lambda: hk.solids.Superellipsoid((0.5, 2.0)), "at least 1"),
        (lambda: hk.solids.Supertorus((2.0,)), "two numbers"),
        (lambda: hk.Tube(np.zeros((3, 3)), 0.1), "two points or more"),
        (lambda: hk.Tube(np.zeros((3, 2)), 0.1), "must have shape"),
        (lambda: hk.Tube.bezier(np.zeros((5, 3)), 0.1), "3 n \\+ 1"),
        (lambda: hk.Extrusion(CUP, 0.0), "height of an extruded outline"),
        (lambda: hk.Extrusion(CUP, 1.0, twist=math.inf), "twist of an extruded outline"),
        (lambda: hk.Extrusion(CUP, 1.0, taper=-1.0), "taper of an extruded outline"),
        (lambda: hk.Extrusion([(0, 0), (1, 1)], 1.0), "three points or more"),
        (lambda: hk.SolidOfRevolution([(-0.1, 0), (1, 0), (1, 1)]), "lies in r >= 0"),
        (lambda: hk.Tube.helix(1.0, 1.0, 0.0, 0.1), "its turns must be positive"),
        (lambda: hk.Tube.helix(1.0, 1.0, 1.0, 0.1, tolerance=1e-30), "larger tolerance"),
        (lambda: hk.solids.Thread([(0, 1), (1, 1)], 1.0), "rises by less than the pitch"),
        (lambda: hk.solids.Thread([(-0.6, 1)], 1.0), "begins within half a pitch of 0"),
        (lambda: hk.solids.Thread([(0, -1)], 1.0), "must be positive"),
        (lambda: hk.solids.Thread([(0, math.nan)], 1.0), "finite"),
        (lambda: hk.solids.Thread([0, 1], 1.0), "has shape"),
        (lambda: hk.solids.Thread([(0, 1)], 1.0, starts=0), "starts of a thread"),
        (lambda: hk.solids.metric_thread("8", 10.0), "named as"),
        (lambda: hk.solids.metric_thread(8, 10.0), "named as"),
        (lambda: hk.solids.metric_thread("M13", 10.0), "no coarse thread M13"),
        (lambda: hk.solids.metric_thread("M8x7", 10.0), "leaves no core"),
        (lambda: hk.solids.metric_thread("M8", 1.0), "must be longer"),
        (lambda: hk.solids.metric_thread("M8", 10.0, clearance=0.2), "clearance of M8"),
        (lambda: hk.solids.metric_thread("M8", 10.0, clearance=-0.1), "clearance of M8"),
        (lambda: hk.solids.Noise(0.0), "frequency of noise"),
        (lambda: hk.solids.Noise(fade="linear"), "quintic"),
        (lambda: hk.solids.FractalNoise(0), "octaves"),
        (lambda: hk.solids.Julia((1, 2, 3)), "four numbers"),
        (lambda: hk.solids.Julia(iterations=0), "from 1 to 60"),
        (lambda: hk.solids.Julia((20.0, 0, 0, 0)), "no longer than 10"),
    ],
)
def test_wrong_numbers(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_numbers_are_data_of_a_kernel() -> None:
    """Another radius compiles nothing."""
    o, d = np.tile([0.0, 0.0, 3.0], (16, 1)), np.tile([0.0, 0.0, -1.0], (16, 1))
    for radius in (0.9, 0.8):
        hk.trace(hk.Sphere(radius), o, d)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        hk.trace(hk.Sphere(0.7), o, d)
        made = dr.kernel_history([dr.KernelType.JIT])
    assert all(one["cache_hit"] for one in made)
