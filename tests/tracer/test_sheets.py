"""Fields that jump across triangles: the first hits, against dense sampling of the exact value."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.backend import (
    Backend,
    Mask,
    Real,
    Vec3,
    backend_of,
    choose_backend,
    to_numpy,
)  # fmt: skip
from harnack.backend.elementary import clamp, fmax, fmin
from harnack.enclosures import (
    Enclosure,
    HarmonicBall,
    Levels,
    SlopeRange,
    TaylorRemainder,
    choose_enclosures,
)
from harnack.enclosures.harmonic_ball import HarnackSlopeEnclosure, SphericalCapEnclosure
from harnack.enclosures.parabola import TaylorEnclosure
from harnack.enclosures.samples import Ray as RayPath
from harnack.fields import Field, Sample
from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.rendering.surface_hits import intersect_surface
from harnack.testing.enclosure_contracts import PromiseCase
from harnack.tracer import traced_surface
from harnack.tracer.level_contact import test_jump as jump_test
from tests.oracles.exact import exact_step, on_host
from tests.oracles.jump_oracle import first_side_changes, judge
from tests.oracles.mutated_enclosure import mutated_enclosure

FOUR_PI = 4 * math.pi

# --- a winding number without any structure -------------------------------------------------


def unmatched_edges(faces: np.ndarray) -> list[tuple[int, int, int]]:
    """(a, b, weight) of the directed edges that faces do not cancel."""
    count: Counter[tuple[int, int]] = Counter()
    for face in faces.tolist():
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            count[min(a, b), max(a, b)] += 1 if a < b else -1
    return [(a, b, n) if n > 0 else (b, a, -n) for (a, b), n in count.items() if n]


@dataclasses.dataclass(frozen=True)
class Passage:
    """Rays o + t d and a mesh, seen along the rays.

    areas: {(i, j): x_i y_j - x_j y_i} for edges i < j, with coordinates across the ray: its sign
        says on which side the ray passes the edge.
    crossings: (t, side) for each triangle: side is 1 where the ray crosses along its normal, -1
        where against it, 0 where it passes by.
    """

    areas: dict[tuple[int, int], Real]
    crossings: list[tuple[Real, Real]]

    @classmethod
    def of(cls, o: Vec3, d: Vec3, vertices: np.ndarray, faces: np.ndarray) -> Passage:
        """Watertight (Woop, Benthin and Wald 2013): the side on which a ray passes an edge is the
        same for both triangles at it."""
        u, v = frame(d)
        relative = [type(d)(*x.tolist()) - o for x in vertices]
        x, y, z = ([dr.dot(r, axis) for r in relative] for axis in (u, v, d))
        areas: dict[tuple[int, int], Real] = {}
        crossings = []
        for face in faces.tolist():
            parts, signs = [], []
            for k in range(3):
                i, j = face[(k + 1) % 3], face[(k + 2) % 3]
                low, high = min(i, j), max(i, j)
                if (low, high) not in areas:
                    areas[low, high] = x[low] * y[high] - x[high] * y[low]
                area = areas[low, high]
                parts.append(area if i < j else -area)
                signs.append(area >= 0 if i < j else ~(area >= 0))
            whole = parts[0] + parts[1] + parts[2]
            depth = sum(part * z[i] for part, i in zip(parts, face, strict=True))
            along, against = signs[0] & signs[1] & signs[2], ~(signs[0] | signs[1] | signs[2])
            t = dr.select(whole != 0, depth / whole, dr.inf)
            side = dr.select(along, 1.0, dr.select(against, -1.0, 0 * o.x))
            crossings.append((t, dr.select(whole != 0, side, 0)))
        return cls(areas, crossings)


@dataclasses.dataclass(frozen=True)
class Stretch:
    """Between two crossings of rays."""

    d: Vec3
    passage: Passage
    behind: JumpCrossing
    offset: Real

    def is_behind(self, i: int) -> Mask:
        """Whether the crossing of triangle i, if there is one, has been passed."""
        t = self.passage.crossings[i][0]
        return (t < self.behind.t) | ((t == self.behind.t) & (self.behind.facet >= i))


class BruteForceWinding(hk.Field):
    """The winding number as a sum over all triangles; each crossing tested against all of them.

    On a stretch every triangle that the ray crosses is taken as seen from before or behind the
    crossing, whatever rounding says of the point. The lift is bounded by Biot-Savart over the
    edges that do not cancel. jump: a factor that spoils what is said of jumps, 1 for the truth.
    """

    default_level = 0.5
    counts_crossings = False

    traits = hk.fields.Traits(has_jumps=True)

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.SampleEvaluator:
        return hk.fields.SampleEvaluator(self, backend, jumps=BruteForceJumps(self))

    def __init__(self, vertices: Any, faces: Any, *, jump: float = 1.0) -> None:
        self.vertices = np.asarray(vertices, np.float32).astype(np.float64)
        self.faces = np.asarray(faces)
        self.edges = unmatched_edges(self.faces)
        self.size = float(np.abs(self.vertices).max())
        self.jump = jump
        self.domain = hk.Box((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0))
        self.stretch: Stretch | None = None

    def evaluate(self, p: Vec3) -> hk.fields.Sample:
        backend = backend_of(p)
        corners = [backend.Array3f(*v.tolist()) - p for v in self.vertices]
        gradient, distance, variation = self._edge_sums(backend, corners)
        value, error = self._value(backend, corners)
        error = backend.machine_epsilon * (8 + error)
        if not self.edges:
            return hk.fields.Sample(value, gradient, (hk.proofs.Lipschitz(1e-9),), error)
        r = 0.5 * distance
        s = r * variation * (1 + 1e-4)
        return hk.fields.Sample(
            value, gradient, (hk.proofs.HarmonicBall(r, value - s, value + s),), error
        )

    def _value(self, backend: Backend, corners: list[Vec3]) -> tuple[Real, Real]:
        total, error = backend.Float(0), backend.Float(0)
        for i, face in enumerate(self.faces.tolist()):
            a, b, c = (corners[k] for k in face)
            la, lb, lc = dr.norm(a), dr.norm(b), dr.norm(c)
            im = dr.dot(a, dr.cross(b, c))
            re = dr.fma(la * lb, lc, dr.dot(a, b) * lc + dr.dot(b, c) * la + dr.dot(c, a) * lb)
            total += 2 * dr.atan2(self._seen(i, im), re)
            # Beside an edge the angle turns by pi within the rounding of the edge's place.
            error += sum(self.size / distance_to_edge(u, v) for u, v in ((a, b), (b, c), (c, a)))
        return total / FOUR_PI, error

    def _seen(self, i: int, im: Real) -> Real:
        """The triangle's volume with the sign that the stretch says."""
        if self.stretch is None:
            return im
        _, side = self.stretch.passage.crossings[i]
        # In front of the triangle (on the side of its normal) im is negative.
        seen = dr.mulsign(
            fmax(dr.abs(im), 1e-30), dr.select(self.stretch.is_behind(i), -side, side)
        )
        return dr.select(side != 0, seen, im)

    def _normal(self, like: Vec3, i: int) -> Vec3:
        a, b, c = self.vertices[self.faces[i]]
        normal = np.cross(b - a, c - a)
        return type(like)(*(normal / np.linalg.norm(normal)).tolist())

    def _edge_sums(self, backend: Backend, corners: list[Vec3]) -> tuple[Vec3, Real, Real]:
        """Gradient, distance to the singular edges, and a bound of |gradient| within half of it."""
        gradient, near = backend.Array3f(0), backend.Float(dr.inf)
        distances = []
        for i, j, n in self.edges:
            a, b = corners[i], corners[j]
            cross, la, lb = dr.cross(a, b - a), dr.norm(a), dr.norm(b)
            ab = dr.dot(a, b)
            inverse = dr.select(ab > 0, 1 / (la * lb + ab), (la * lb - ab) / dr.squared_norm(cross))
            gradient += n * (1 / la + 1 / lb) * inverse * cross
            distances.append(distance_to_edge(a, b))
            near = fmin(near, distances[-1])
        variation = backend.Float(0)
        for distance, (i, j, n) in zip(distances, self.edges, strict=True):
            length = float(np.linalg.norm(self.vertices[i] - self.vertices[j]))
            left = distance - 0.5 * near
            variation += n * fmin(length / (left * left), 2 / left)
        return gradient / FOUR_PI, near, variation / FOUR_PI


class BruteForceJumps(hk.fields.Jumps):
    """The crossings of rays with the triangles of a field, each triangle tested by itself."""

    def __init__(self, field: BruteForceWinding) -> None:
        self.field = field

    def next_crossing(
        self, o: Vec3, d: Vec3, after: JumpCrossing, t_max: Real, active: Mask
    ) -> JumpCrossing:
        best = JumpCrossing(type(o.x)(dr.inf), dr.uint32_array_t(o.x)(NO_FACET), 0 * o.x, 0 * d)
        passage = Passage.of(o, d, self.field.vertices, self.field.faces)
        for i, (t, side) in enumerate(passage.crossings):
            later = (t > after.t) | ((t == after.t) & (after.facet < i))
            better = active & (side != 0) & later & (t <= t_max) & (t < best.t)
            normal = -self.field._normal(d, i)
            found = (t, i, -self.field.jump * side, normal)
            mine = (best.t, best.facet, best.jump, best.normal)
            best = JumpCrossing(
                *(dr.select(better, x, y) for x, y in zip(found, mine, strict=True))
            )
        return best

    def continuation(
        self, o: Vec3, d: Vec3, behind: JumpCrossing, ahead: JumpCrossing, offset: Real
    ) -> hk.fields.Evaluator:
        other = type(self.field)(self.field.vertices, self.field.faces)
        passage = Passage.of(o, d, self.field.vertices, self.field.faces)
        other.stretch = Stretch(d, passage, behind, offset)
        return hk.fields.EvaluateOnly(other.evaluate)

    def initial_offset(self, o: Vec3, d: Vec3, t_min: Real, active: Mask) -> Real:
        del active
        if not self.field.counts_crossings:
            return 0.0
        passage = Passage.of(o, d, self.field.vertices, self.field.faces)
        return sum(dr.select(t > t_min, side, 0) for t, side in passage.crossings)


def frame(d: Vec3) -> tuple[Vec3, Vec3]:
    """Two unit vectors across d and each other (Duff et al. 2017)."""
    sign = dr.mulsign(type(d.x)(1), d.z)
    a = -1 / (sign + d.z)
    b = d.x * d.y * a
    u = type(d)(1 + sign * d.x * d.x * a, sign * b, -sign * d.x)
    return u, type(d)(b, sign + d.y * d.y * a, -d.y)


def distance_to_edge(a: Vec3, b: Vec3) -> Real:
    """From the origin to the segment between two points."""
    e = b - a
    s = clamp(-dr.dot(a, e) / dr.squared_norm(e), type(a.x)(0), type(a.x)(1))
    return dr.norm(dr.fma(type(a)(s), e, a))


class CountedWinding(BruteForceWinding):
    """The same, with the crossings ahead counted once, at the start of the ray.

    w is the number of triangles that the rest of the ray leaves less those that it enters, plus
    the solid angles of strips from the singular edges to infinity behind the ray: apex at
    infinity against the ray, one principal arctangent for each edge. Where the ray runs in line
    with a corner both parts of it cancel, so it only decides by which integer the sum over all
    triangles, taken as they appear, is off.
    """

    counts_crossings = True

    def _seen(self, i: int, im: Real) -> Real:
        del i
        return im

    def _value(self, backend: Backend, corners: list[Vec3]) -> tuple[Real, Real]:
        value, error = super()._value(backend, corners)
        if self.stretch is None:
            return value, error
        apex, total = -self.stretch.d, backend.Float(0)
        for i, j, n in self.edges:
            a, b = corners[i], corners[j]
            la, lb = dr.norm(a), dr.norm(b)
            # apex . (a x b), the very number that told on which side the ray passes the edge.
            area = self.stretch.passage.areas[min(i, j), max(i, j)]
            im = -area if i < j else area
            re = la * lb + dr.dot(a, b) + dr.dot(b, apex) * la + dr.dot(a, apex) * lb
            total += 2 * n * dr.atan2(im, re)
        return value + dr.round(self.stretch.offset + total / FOUR_PI - value), error


class ExactWinding:
    """The winding number in double precision with NumPy, as a plain sum."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.corners = vertices.astype(np.float32).astype(np.float64)
        self.triangles = self.corners[faces]
        self.edges = self.corners[[edge[:2] for edge in unmatched_edges(faces)]].reshape(-1, 2, 3)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        x, total = points.T, np.zeros(len(points))
        for triangle in self.triangles:
            a, b, c = (corner[:, None] - x for corner in triangle)
            la, lb, lc = (np.sqrt(dot(v, v)) for v in (a, b, c))
            normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
            im = normal @ a
            re = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
            total += 2 * np.arctan2(im, re)
        return total / FOUR_PI


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# --- meshes ---------------------------------------------------------------------------------

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
CUBE_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
TETRAHEDRON_FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def turned(vertices: np.ndarray, angle: float = 0.4) -> np.ndarray:
    """So that no face is along an axis."""
    c, s = math.cos(angle), math.sin(angle)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return vertices @ (about_x @ about_z).T


def together(*meshes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    first = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    faces = [faces + start for (_, faces), start in zip(meshes, first[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def flipped(faces: np.ndarray, *which: int) -> np.ndarray:
    faces = faces.copy()
    rows = list(which) or slice(None)
    faces[rows] = faces[rows][:, ::-1]
    return faces


def strip(n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A bent band of n squares, open on all sides."""
    angle = np.linspace(-1.3, 1.6, n + 1)
    arc = np.column_stack([np.cos(angle), np.sin(angle)])
    vertices = np.concatenate([np.column_stack([arc, np.full(n + 1, z)]) for z in (-0.6, 0.5)])
    low = np.arange(n)
    one = np.column_stack([low, low + 1, low + n + 2])
    two = np.column_stack([low, low + n + 2, low + n + 1])
    return vertices, np.concatenate([one, two])


MESHES: dict[str, tuple[np.ndarray, np.ndarray]] = {
    "tetrahedron": (turned(TETRAHEDRON), TETRAHEDRON_FACES),
    "open cube": (turned(CUBE), CUBE_FACES[2:]),
    "cube along the axes": (0.75 * CUBE, CUBE_FACES[1:]),
    "nested boxes": together((turned(CUBE), CUBE_FACES), (0.5 * CUBE, CUBE_FACES)),
    "box with a cavity": together((turned(CUBE), CUBE_FACES), (0.5 * CUBE, flipped(CUBE_FACES))),
    "flipped face": (turned(CUBE), flipped(CUBE_FACES, 3, 8)),
    "self-intersecting": together(
        (turned(CUBE), CUBE_FACES),
        (turned(TETRAHEDRON, 0.9) + np.array([0.7, 0.3, 0.5]), TETRAHEDRON_FACES),
    ),
    "doubled faces": (turned(CUBE), np.concatenate([CUBE_FACES, CUBE_FACES[[2, 5]]])),
    "strip": strip(),
}
TOLERANCE, REACH = 2e-5, 2e-4


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def rays(
    vertices: np.ndarray, n: int = 2000, seed: int = 0, closest: float = 1e-6
) -> tuple[np.ndarray, np.ndarray]:
    """Rays of all kinds: from outside and inside into the mesh, past its vertices and edges as
    closely as `closest`, and along the axes. Origins are single-precision numbers."""
    rng = np.random.default_rng(seed)
    lower, upper = vertices.min(axis=0) - 0.2, vertices.max(axis=0) + 0.2
    o = 2.9 * unit(rng.normal(size=(n, 3)))
    o[: n // 4] = rng.uniform(lower, upper, (n // 4, 3))
    target = rng.uniform(lower, upper, (n, 3))
    m = n // 2
    i, j = rng.integers(len(vertices), size=(2, m))
    share = np.where(rng.random((m, 1)) < 0.3, 0.0, rng.random((m, 1)))
    aside = 10 ** rng.uniform(math.log10(closest), -2, (m, 1)) * unit(rng.normal(size=(m, 3)))
    target[n - m :] = (1 - share) * vertices[i] + share * vertices[j] + aside
    o = o.astype(np.float32).astype(np.float64)
    d = unit(target - o)
    some = np.flatnonzero(rng.random(n) < 0.1)
    d[some] = np.eye(3)[rng.integers(3, size=len(some))] * rng.choice([-1, 1], (len(some), 1))
    return o, d


def leaves_domain(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """t at which rays leave the box of half-width 3 with which the fields end."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nanmin((3 * np.sign(d) - o) / np.where(d == 0, np.nan, d), axis=1)


def hit_t(hits: hk.Hits) -> np.ndarray:
    return np.where(hits.is_hit, hits.t, np.inf).astype(np.float64)


KINDS = [BruteForceWinding, CountedWinding]

# --- first hits -----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [name if name == "strip" else pytest.param(name, marks=pytest.mark.slow) for name in MESHES],
)
def test_first_hits_agree_with_samples_of_the_exact_value(name: str) -> None:
    vertices, faces = MESHES[name]
    exact = ExactWinding(vertices, faces)
    # Closer than this, single precision cannot tell on which side CountedWinding's rays pass.
    o, d = rays(vertices, closest=1e-5)
    start, end = np.zeros(len(o)), leaves_domain(o, d)
    truth = first_side_changes(exact, o, d, start, end, level=0.5, samples=400)
    for kind in KINDS:
        for precision in ("single", "double"):
            hits = hk.trace(kind(vertices, faces), o, d, precision=precision, tolerance=TOLERANCE)
            verdict = judge(
                hit_t(hits), exact, o, d, start, end,
                level=0.5, reach=REACH, edges=exact.edges, truth=truth, samples=400,
            )  # fmt: skip
            where = f"{kind.__name__} {precision}: {verdict}"
            assert verdict.wrong == 0, where
            assert verdict.changes > 600, where
            assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any(), where
            check_sheets_hit(hits, exact, faces, d)
            smooth = (hits.is_hit & (hits.primitive_index < 0)).sum()
            if len(exact.edges) == 0:
                assert smooth == 0, where
            elif name != "doubled faces":  # whose smooth level 1/2 is the edges alone
                assert smooth > 50, where
            assert (hits.primitive_index >= 0).sum() > 300, where


def check_sheets_hit(hits: hk.Hits, exact: ExactWinding, faces: np.ndarray, d: np.ndarray) -> None:
    """The index is that of a triangle that the hit lies on, the normal its own, to the side of
    the larger value, and the value is that before it."""
    rows = np.flatnonzero(hits.primitive_index >= 0)
    assert hits.is_hit[rows].all()
    assert (hits.primitive_index < len(faces)).all()
    triangle = exact.triangles[hits.primitive_index[rows]]
    normal = unit(np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]))
    # The winding number is larger behind the faces.
    np.testing.assert_allclose(hits.normal[rows], -normal, atol=1e-6)
    off_plane = ((hits.position[rows] - triangle[:, 0]) * normal).sum(axis=1)
    np.testing.assert_allclose(off_plane, 0, atol=2e-6)
    along = (hits.normal[rows] * d[rows]).sum(axis=1)
    clear = np.abs(along) > 1e-5
    rising = along > 0
    assert (hits.value[rows] <= 0.5 + 1e-3)[clear & rising].all()
    assert (hits.value[rows] >= 0.5 - 1e-3)[clear & ~rising].all()


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("name", "level"),
    [("nested boxes", 1.5), ("strip", -0.3), ("flipped face", 0.75), ("doubled faces", 1.2)],
)
def test_other_levels(name: str, level: float) -> None:
    vertices, faces = MESHES[name]
    exact = ExactWinding(vertices, faces)
    o, d = rays(vertices, 600, seed=1, closest=1e-4)
    field = BruteForceWinding(vertices, faces)
    settings: Any = {"tolerance": TOLERANCE, "precision": "double"}
    hits = hk.trace(field, o, d, level=level, **settings)
    verdict = judge(
        hit_t(hits), exact, o, d, 0.0, leaves_domain(o, d),
        level=level, reach=REACH, edges=exact.edges, samples=400,
    )  # fmt: skip
    assert verdict.wrong == 0
    assert verdict.changes > 100
    plain = hk.trace(field, o, d, **settings)
    both = hk.trace(field, o, d, level=[level, 0.5], **settings)
    np.testing.assert_allclose(hit_t(both), np.minimum(hit_t(hits), hit_t(plain)), atol=2 * REACH)


@pytest.mark.few(1)
@pytest.mark.parametrize("factor", [0.9, 1.1])
@pytest.mark.parametrize("kind", KINDS)
def test_wrong_jumps_are_seen(kind: type[BruteForceWinding], factor: float) -> None:
    """The oracle can fail: a field that tells wrong jumps gets wrong hits."""
    vertices, faces = MESHES["flipped face"]
    exact = ExactWinding(vertices, faces)
    o, d = rays(vertices, 600)
    hits = hk.trace(
        kind(vertices, faces, jump=factor), o, d, tolerance=TOLERANCE, precision="single"
    )
    verdict = judge(
        hit_t(hits), exact, o, d, 0.0, leaves_domain(o, d),
        level=0.5, reach=REACH, edges=exact.edges, samples=400,
    )  # fmt: skip
    assert len(verdict.missed if factor < 1 else verdict.early) > 3


@pytest.mark.slow
def test_the_oracle_sees_hits_that_are_late_early_or_not_there() -> None:
    vertices, faces = MESHES["open cube"]
    exact = ExactWinding(vertices, faces)
    o, d = rays(vertices, 300)
    end = leaves_domain(o, d)
    hits = hk.trace(
        BruteForceWinding(vertices, faces), o, d, tolerance=TOLERANCE, precision="single"
    )
    limits: Any = {"level": 0.5, "reach": REACH, "edges": exact.edges, "samples": 400}
    t, is_clear = hit_t(hits), hits.is_hit & (hits.t > 0.1)
    for spoiled, wrong in (
        (t + 10 * REACH, "missed"),
        (np.full_like(t, np.inf), "missed"),
        (0.9 * t, "early"),
    ):
        verdict = judge(np.where(is_clear, spoiled, t), exact, o, d, 0.0, end, **limits)
        assert len(getattr(verdict, wrong)) > 0.8 * is_clear.sum()
    with pytest.raises(ValueError, match="must be finite"):
        first_side_changes(exact, o, d, 0.0, math.inf, level=0.5)


@pytest.mark.parametrize(("short", "early"), [(0.5, 0), (2.0, 1)])
def test_a_level_that_a_jump_cuts_off_is_within_reach_or_not(short: float, early: int) -> None:
    """f = x falls by ten at x = 1, `short` reaches before the level: nowhere is there a surface."""

    def value(x: np.ndarray) -> np.ndarray:
        return x[:, 0] - 10 * (x[:, 0] > 1)

    o, d, t = np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.array([1 - 1e-9])
    verdict = judge(t, value, o, d, 0.0, 3.0, level=1 + short * REACH, reach=REACH)
    assert len(verdict.early) == early


# --- steps that are exact -------------------------------------------------------------------


class Staircase(hk.Field):
    """slope * x, and a jump at each of some planes x = const: all steps are known exactly."""

    traits = hk.fields.Traits(has_jumps=True)

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.SampleEvaluator:
        return hk.fields.SampleEvaluator(self, backend, jumps=StaircaseJumps(self))

    def __init__(self, slope: float, planes: dict[float, float], lift: Real | None = None) -> None:
        self.slope, self.planes, self.lift = slope, planes, lift

    def evaluate(self, p: Vec3) -> hk.fields.Sample:
        lift = self.lift
        if lift is None:
            lift = sum(dr.select(p.x > x, jump, 0.0) for x, jump in self.planes.items())
        gradient = type(p)(self.slope, 0, 0)
        return hk.fields.Sample(
            self.slope * p.x + lift, gradient, (hk.proofs.Lipschitz(abs(self.slope)),)
        )


class StaircaseJumps(hk.fields.Jumps):
    """The planes at which a staircase jumps."""

    def __init__(self, field: Staircase) -> None:
        self.field = field

    def next_crossing(
        self, o: Vec3, d: Vec3, after: JumpCrossing, t_max: Real, active: Mask
    ) -> JumpCrossing:
        t, sheet, jump = type(o.x)(dr.inf), dr.uint32_array_t(o.x)(NO_FACET), type(o.x)(0)
        for i, (x, height) in enumerate(self.field.planes.items()):
            there = (x - o.x) / d.x
            later = (there > after.t) | ((there == after.t) & (after.facet < i))
            better = active & later & (there <= t_max) & (there < t)
            t, sheet = dr.select(better, there, t), dr.select(better, i, sheet)
            jump = dr.select(better, dr.mulsign(type(t)(height), d.x), jump)
        return JumpCrossing(t, sheet, jump, type(d)(dr.mulsign(1 + 0 * t, jump * d.x), 0, 0))

    def initial_offset(self, o: Vec3, d: Vec3, t_min: Real, active: Mask) -> Real:
        del active
        total = type(o.x)(0)
        for x, height in self.field.planes.items():
            is_ahead = (x - o.x) / d.x > t_min
            total += dr.select(is_ahead == (d.x > 0), 0, height)
        return total

    def continuation(
        self, o: Vec3, d: Vec3, behind: JumpCrossing, ahead: JumpCrossing, offset: Real
    ) -> hk.fields.Evaluator:
        del o, d, behind, ahead
        return hk.fields.EvaluateOnly(
            Staircase(self.field.slope, self.field.planes, offset).evaluate
        )


@pytest.mark.few(1)
@pytest.mark.parametrize("over_relaxation", [1.0, 1.4])
@pytest.mark.parametrize("precision", ["single", "double"])
def test_staircases(precision: Any, over_relaxation: float) -> None:
    """Level 0 is met smoothly, or at a plane, or not at all, in places that are plain to see."""
    up, down = [[1.0, 0, 0]], [[-1.0, 0, 0]]
    # slope, planes, direction, start x, t_max; t of the hit, sheet
    cases: list[tuple[float, dict[float, float], Any, float, float, float, int]] = [
        (1.0, {1.0: 5.0}, up, -2.0, 9.0, 2.0, -1),
        (1.0, {-1.0: 5.0}, up, -2.0, 9.0, 1.0, 0),
        (1.0, {-1.0: 0.5}, up, -2.0, 9.0, 1.5, -1),
        (1.0, {-1.0: -2.0}, up, -2.0, 9.0, 4.0, -1),
        # The level lies behind a plane, just before the end of the ray.
        (1.0, {-1.0: -2.0}, up, -2.0, 4.01, 4.0, -1),
        (1.0, {-1.0: -2.0}, up, -2.0, 3.99, math.inf, -1),
        # Just before and just behind a plane.
        (1.0, {0.001: -2.0}, up, -2.0, 9.0, 2.0, -1),
        (1.0, {-0.001: 2.0}, up, -2.0, 9.0, 1.999, 0),
        (1.0, {-0.001: -2.0}, up, -2.0, 9.0, 4.0, -1),
        # From above, and through several.
        (1.0, {1.0: 0.5}, down, 3.0, 9.0, 3.0, -1),
        (1.0, {1.0: -1.5}, down, 3.0, 9.0, 1.5, -1),
        (1.0, {-1.0: -1.0, 2.0: 1.0}, down, 3.0, 9.0, 2.0, -1),
        (1.0, {-1.0: -2.5, 2.0: 3.0}, down, 3.0, 9.0, 1.0, 1),
        (1.0, {-1.5: 0.7, -1.25: -3.0, -1.0: 0.7, -0.5: 9.0}, up, -2.0, 9.0, 1.5, 3),
        (1.0, {-1.0: 0.6}, up, -2.0, 0.5, math.inf, -1),
        (0.0, {-3.0: 1.0, -1.0: 0.5, 3.0: -5.0}, up, -2.0, 9.0, 5.0, 2),
    ]
    for slope, planes, way, x, t_max, t, sheet in cases:
        hits = hk.trace(
            Staircase(slope, planes), [[x, 0.0, 0.0]], way,
            t_max=t_max, precision=precision, over_relaxation=over_relaxation, tolerance=1e-5,
        )  # fmt: skip
        assert hits.t[0] == pytest.approx(t, abs=1e-4), (slope, planes, x)
        assert hits.primitive_index[0] == sheet, (slope, planes, x)


class Approximate(hk.Field):
    """x, with a gradient that is too short, as that of an approximation may be."""

    def __init__(self, gradient: float, gradient_error: Any) -> None:
        self.gradient, self.gradient_error = gradient, gradient_error

    def evaluate(self, p: Vec3) -> hk.fields.Sample:
        gradient = type(p)(self.gradient, 0, 0)
        ball = hk.proofs.HarmonicBall(5.0 + 0 * p.x, p.x - 10, p.x + 10)
        return hk.fields.Sample(p.x, gradient, (ball,), 0.0, self.gradient_error)


@pytest.mark.few(2)
@pytest.mark.parametrize("over_relaxation", [1.0, 1.4])
@pytest.mark.parametrize("enclosures", [None, "slope", "caps"])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_gradients_known_up_to_an_error(
    enclosures: Any, over_relaxation: float, direction: float
) -> None:
    """Trusted, a gradient of half the length leads past the level; with its error it does not."""

    def passes(gradient: float, error: Any) -> bool:
        hits = hk.trace(
            Approximate(gradient, error), [[0.0, 0, 0]], [[direction, 0, 0]],
            level=direction, t_max=4.0, enclosures=enclosures, over_relaxation=over_relaxation,
            tolerance=1e-5,
        )  # fmt: skip
        assert hits.t[0] in (pytest.approx(1, abs=1e-4), math.inf)
        return bool(np.isinf(hits.t[0]))

    assert passes(0.5, 0.0)
    assert not passes(0.5, 0.5)
    assert not passes(0.5, choose_backend("single").Float(0.5))
    assert not passes(1.0, 0.0)
    assert not passes(1.0, 0.3)


# --- steps with slopes known up to an error ------------------------------------------------------


def uncertain(rows: int, seed: int) -> list[tuple[type[Enclosure], PromiseCase, Any, Any]]:
    """(proof, case, slope, error) of all kinds; slopes so large that they matter."""
    rng, real = np.random.default_rng(seed), choose_backend("double").Float

    def around_one() -> np.ndarray:
        return 10 ** rng.uniform(-1, 1, rows)

    radius, below, above, down, up = (around_one() for _ in range(5))
    down, up = down * np.minimum(below, above), up * np.minimum(below, above)
    slope = 2 * rng.uniform(-1, 1, rows) * np.minimum(below, above) / radius
    error = around_one() * 0.2 * np.abs(slope)
    on_ball = HarmonicBall(*map(real, (radius, -below, above)))
    ball = PromiseCase(on_ball, real(np.minimum(down, below)), real(np.minimum(up, above)))
    curved = PromiseCase(TaylorRemainder(real(around_one()), real(radius)), real(down), real(up))
    return [
        (kind, case, real(slope), real(error))
        for kind, case in (
            (HarnackSlopeEnclosure, ball),
            (SphericalCapEnclosure, ball),
            (TaylorEnclosure, curved),
        )
    ]


def check_uncertain_steps(factor: float = 1.0, covers: float = 1.0) -> None:
    """Steps are as long as the extremal functions of the worst slope allow, and no longer.

    factor, covers: what the proofs are made wrong by.
    """
    for kind, case, slope, error in uncertain(2000, 0):
        host, middle, off = on_host(case, 2000), to_numpy(slope), to_numpy(error)
        exact = np.minimum(*(exact_step(kind, host, middle + s * off) for s in (1, -1)))
        alone = exact_step(kind, host, middle)
        wrong = mutated_enclosure(kind, factor, covers=covers)
        found = to_numpy(case.step(wrong, slope, error))
        ratio = found / exact
        assert ratio.max() <= 1 + 1e-12, kind
        assert ratio.min() > 0.99, kind
        assert np.median(ratio) > 1 - 1e-4, kind
        assert (alone > 1.01 * exact).mean() > 0.3  # the error does shorten them
        free = [
            to_numpy(case.covers(wrong, slope, type(slope)(share * exact), error))
            for share in (0.999, 1.0001)
        ]
        inside = exact < 0.999 * host.promise.radius
        assert free[0].all(), kind
        assert not free[1][inside].any(), kind


@pytest.mark.slow
def test_steps_are_those_of_the_worst_slope() -> None:
    check_uncertain_steps()


@pytest.mark.parametrize("factor", [1.001, 1.00001])
def test_steps_too_long_for_the_worst_slope_are_seen(factor: float) -> None:
    with pytest.raises(AssertionError):
        check_uncertain_steps(factor)
    with pytest.raises(AssertionError):
        check_uncertain_steps(covers=1.001)


def test_steps_that_ignore_the_error_of_the_slope_are_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        SlopeRange, "around", classmethod(lambda cls, slope, error: cls(slope, slope))
    )
    with pytest.raises(AssertionError):
        check_uncertain_steps()


def test_looks_see_the_error_of_the_slope_in_both_directions() -> None:
    """The slopes of a look are an interval, and that looking back is the same one negated."""
    backend = choose_backend("double")
    real = backend.Float

    class Uncertain(Field):
        def evaluate(self, p: Any) -> Sample:
            return Sample(
                p.x, backend.Array3f(1, 0, 0), (TaylorRemainder(1.0),), gradient_error=0.25
            )

    o, d = backend.Array3f(0, 0, 0), backend.Array3f(1, 0, 0)
    path = RayPath(o, d, choose_enclosures(None))
    look = Uncertain().evaluator(backend).sample_ray(path, real(0), real(1), real(1))
    (ahead,), (back,) = look.forward, look.backward
    assert isinstance(ahead, TaylorEnclosure)
    assert isinstance(back, TaylorEnclosure)
    ends = [ahead.slopes.lower, ahead.slopes.upper, back.slopes.lower, back.slopes.upper]
    assert [float(end[0]) for end in ends] == [0.75, 1.25, -1.25, -0.75]


# --- parts of rays --------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_rays_that_begin_and_end_anywhere(kind: type[BruteForceWinding]) -> None:
    """By t_min and t_max, and by clip volumes: crossings outside do not count as met, and those
    before the start count for the value there."""
    vertices, faces = MESHES["box with a cavity"]
    field, exact = kind(vertices, faces), ExactWinding(vertices, faces)
    o, d = rays(vertices, 800, seed=2, closest=1e-4)
    rng = np.random.default_rng(0)
    near = rng.uniform(0, 3, len(o)).astype(np.float32).astype(np.float64)
    far = near + rng.uniform(0, 2, len(o))
    half = hk.HalfSpace((0.0, 0.6, 0.8), 0.31)
    ball = hk.Ball((0.2, 0.1, 0.0), 0.8)
    inside = [
        ({"t_min": near, "t_max": far}, near, np.minimum(far, leaves_domain(o, d))),
        ({"clip": half}, *interval(half, o, d)),
        ({"clip": ball}, *interval(ball, o, d)),
    ]
    for settings, start, end in inside:
        rows = np.flatnonzero(start < end)
        assert len(rows) > 200
        hits = hk.trace(field, o, d, tolerance=TOLERANCE, precision="single", **settings)
        t = hit_t(hits)
        assert not hits.is_hit[start > end + 1e-5].any()
        assert ((t >= start - 1e-5) | ~hits.is_hit).all()
        verdict = judge(
            t[rows], exact, o[rows], d[rows], start[rows], end[rows],
            level=0.5, reach=REACH, samples=400,
        )  # fmt: skip
        # The end of the part may fall on either side of a sheet by rounding.
        wrong = [k for k in (*verdict.missed, *verdict.early) if end[rows][k] - t[rows][k] > REACH]
        assert wrong == []
        assert verdict.hits > 50


def interval(volume: Any, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    double = choose_backend("double")
    far = double.Float(leaves_domain(o, d))
    start, end = volume.upload(double).clip(
        double.Array3f(o.T), double.Array3f(d.T), double.Float(0), far
    )
    return to_numpy(start + 0 * far), to_numpy(end)


def test_a_sheet_at_the_start_is_met_there() -> None:
    """As a smooth level set is."""
    vertices, faces = MESHES["cube along the axes"]
    field = BruteForceWinding(vertices, faces)
    o, d = np.array([[0.1, 0.2, 0.75]]), np.array([[0.0, 0.0, -1.0]])
    hits = hk.trace(field, o, d, precision="single")
    assert hits.t.tolist() == [0.0]
    hits = hk.trace(field, o + np.array([[0, 0, 1.0]]), d, t_min=1.0, precision="single")
    assert hits.t.tolist() == [1.0]
    assert (
        hits.primitive_index.tolist()
        == hk.trace(field, o, d, precision="single").primitive_index.tolist()
    )
    beyond = hk.trace(field, o, d, t_min=1e-3, precision="single")
    assert beyond.t[0] > 1e-3


@pytest.mark.slow
def test_few_steps_end_with_the_proved_length() -> None:
    vertices, faces = MESHES["flipped face"]
    field = BruteForceWinding(vertices, faces)
    o, d = rays(vertices, 300)
    full = hk.trace(field, o, d, precision="single")
    for steps in (1, 2, 3, 6):
        short = hk.trace(field, o, d, max_steps=steps, precision="single")
        out = short.status == hk.RayStatus.OUT_OF_STEPS
        assert out.any()
        assert (short.evaluations <= steps).all()
        assert (short.t[out] <= full.t[out] + 1e-5).all()
        assert (short.primitive_index[out] == -1).all()
        np.testing.assert_array_equal(short.t[~out], full.t[~out])
    boxes = BruteForceWinding(*MESHES["nested boxes"])
    ray = np.array([[0.05, 0.1, 2.9]]), np.array([[0.0, 0.0, -1.0]])
    for steps in (1, 2, 3):  # the second passes the outer box, the third hits the inner one
        hits = hk.trace(boxes, *ray, level=1.5, max_steps=steps, precision="single")
        assert hits.evaluations.tolist() == [steps]
        assert hits.is_hit.tolist() == [steps == 3]


def test_closed_meshes_cost_one_evaluation_a_crossing() -> None:
    """And one at the start; the last crossing is the hit, or the rest of the ray is free."""
    vertices, faces = MESHES["nested boxes"]
    field = BruteForceWinding(vertices, faces)
    o = np.array([[0.05, 0.1, 2.9], [2.9, 2.8, 2.7], [0.05, 0.1, 0.0]])
    d = np.array([[0.0, 0, -1], [0, 0, -1], [0, 0, -1]])
    hits = hk.trace(field, o, d, precision="single")
    assert hits.status.tolist() == [1, 0, 1]
    assert hits.evaluations.tolist() == [2, 1, 3]
    assert hk.trace(field, o, d, level=1.5, precision="single").evaluations.tolist() == [3, 1, 2]


# --- other ways in --------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", ["single", "double"])
def test_drjit_rays_get_the_same(precision: Any) -> None:
    vertices, faces = MESHES["open cube"]
    backend, field = choose_backend(precision), CountedWinding(vertices, faces)
    o, d = rays(vertices, 300)
    plain = hk.trace(field, o, d, precision=precision)
    hits = hk.trace(field, backend.Array3f(o.T), backend.Array3f(d.T))
    assert type(hits.primitive_index) is backend.Int32
    for name in ("t", "normal", "evaluations", "status", "primitive_index"):
        np.testing.assert_array_equal(to_numpy(getattr(hits, name)), getattr(plain, name))


def test_occlusion_is_a_hit() -> None:
    vertices, faces = MESHES["open cube"]
    backend = choose_backend("single")
    prepared = traced_surface(BruteForceWinding(vertices, faces)).tracer(backend)
    o, d = (backend.Array3f(v.T) for v in rays(vertices, 400))
    far = backend.Float(np.random.default_rng(0).uniform(0.1, 4, 400))
    active = dr.arange(backend.UInt32, 400) % 3 != 0
    status = to_numpy(prepared.first_hit(o, d, 0, far, active).status)
    blocked = to_numpy(prepared.occluded(o, d, 0, far, active))
    np.testing.assert_array_equal(blocked, status != hk.RayStatus.MISS)
    assert not blocked[~to_numpy(active)].any()
    assert 50 < blocked.sum() < 300


def test_fields_without_sheets_have_no_facets() -> None:
    o, d = rays(CUBE, 50)
    hits = hk.trace(hk.Gyroid(domain=hk.Ball(radius=3.0)), o, d)
    assert hits.is_hit.any()
    assert (hits.primitive_index == -1).all()
    assert hits.primitive_index.dtype == np.int64
    assert hk.trace(hk.Gyroid(), o[:0], d[:0]).primitive_index.shape == (0,)


def test_jumps_without_distances_are_refused() -> None:
    jumps = Staircase(1.0, {0.5: 1.0}).evaluator(choose_backend("single")).jumps
    assert jumps is not None
    assert not jumps.gives_distances
    with pytest.raises(NotImplementedError, match="define its method distance"):
        jumps.distance(choose_backend("single").Array3f(1, 0, 0))


# --- a level on the value of a side ---------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "jump", "hit"),
    [
        (0.3, 1.0, True), (0.3, -1.0, False), (0.7, -1.0, True), (0.7, 1.0, False),
        (1.5, 1.0, False), (-0.6, 1.0, False), (-0.5, 1.0, True), (0.5, 1.0, True),
        (0.5, -1.0, True), (0.5 + 1e-7, 1.0, True), (0.5 - 1e-7, -1.0, True),
        (0.5 + 1e-4, 1.0, False), (0.5 - 1e-4, -1.0, False), (-0.5 - 1e-7, 1.0, True),
        (0.2, 0.0, False), (-1.7, 4.0, True),
    ],
)  # fmt: skip
def test_a_level_within_rounding_of_a_side_counts_as_between(
    before: float, jump: float, hit: bool
) -> None:
    backend = choose_backend("single")
    real, vector = backend.Float, backend.Array3f
    for sheet, there in ((3, True), (3, False), (NO_FACET, True)):
        ahead = JumpCrossing(real(1), backend.UInt32(sheet), real(jump), vector(0, 0, 1))
        met = jump_test(ahead, backend.Bool(there), real(before), real(1e-6), Levels((0.5,)))
        reached = there and sheet != NO_FACET
        assert met.at_crossing == [reached]
        assert met.is_hit == [hit and reached]


# --- derivatives ----------------------------------------------------------------------------


@pytest.mark.slow
def test_derivatives_by_rays_are_those_of_the_plane() -> None:
    vertices, faces = MESHES["open cube"]
    field = BruteForceWinding(vertices, faces)
    backend = choose_backend("double")
    o, d = rays(vertices, 200, seed=3, closest=1e-3)
    plain = hk.trace(field, o, d, precision="double", tolerance=1e-12)
    steep = np.abs((plain.normal * d).sum(axis=1)) > 0.1
    keep = plain.is_hit & steep & (plain.t > 1e-3)
    o, d, on_sheet = o[keep], d[keep], plain.primitive_index[keep] >= 0
    assert 20 < on_sheet.sum() < keep.sum() - 10
    way, turn = np.array([0.3, -0.2, 0.5]), np.array([-0.1, 0.25, 0.15])

    def solve(s: float) -> np.ndarray:
        hits = hk.trace(field, o + s * way, d + s * turn, precision="double", tolerance=1e-12)
        assert hits.is_hit.all()
        return hits.t

    h = 1e-6
    expected = (solve(h) - solve(-h)) / (2 * h)
    s = backend.Float(0)
    dr.enable_grad(s)
    hits = hk.trace(
        field,
        backend.Array3f(o.T) + s * backend.Array3f(*way.tolist()),
        backend.Array3f(d.T) + s * backend.Array3f(*turn.tolist()),
        tolerance=1e-9,
    )
    dr.set_grad(s, 1)
    found = to_numpy(dr.forward_to(hits.t))
    np.testing.assert_allclose(found[on_sheet], expected[on_sheet], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found[~on_sheet], expected[~on_sheet], rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_the_level_moves_smooth_hits_only() -> None:
    vertices, faces = MESHES["open cube"]
    backend = choose_backend("double")
    o, d = rays(vertices, 200, seed=3, closest=1e-3)
    level = backend.Float(0.5)
    dr.enable_grad(level)
    hits = hk.trace(
        BruteForceWinding(vertices, faces),
        backend.Array3f(o.T), backend.Array3f(d.T), level=level,
    )  # fmt: skip
    dr.set_grad(level, 1)
    moved, sheet = to_numpy(dr.forward_to(hits.t)), to_numpy(hits.primitive_index)
    assert (moved[sheet >= 0] == 0).all()
    assert (moved[(sheet < 0) & np.isfinite(to_numpy(hits.t))] != 0).sum() > 10


def test_derivatives_by_parameters_are_refused() -> None:
    class Moving(BruteForceWinding):
        traits = hk.fields.Traits(has_jumps=True, has_parameter_derivatives=True)

        def parameters(self) -> dict[str, Any]:
            return {"where": where}

    backend = choose_backend("double")
    where = backend.Array3f(0, 0, 0)
    field = Moving(*MESHES["open cube"])
    ray = backend.Array3f(0, 0, 2), backend.Array3f(0, 0, -1)
    assert hk.trace(field, *ray).status == [1]
    dr.enable_grad(where)
    with pytest.raises(NotImplementedError, match="detach those of this Moving"):
        hk.trace(field, *ray)


# --- what is refused ------------------------------------------------------------------------


def test_what_makes_no_sense_is_refused() -> None:
    vertices, faces = MESHES["open cube"]
    field = BruteForceWinding(vertices, faces)
    solid = hk.Surface(field, level=0.5, side="above")
    with pytest.raises(ValueError, match="a field that jumps has no closed solid"):
        hk.render(solid, size=(8, 6), progress=False)
    with pytest.raises(
        TypeError, match=r'trace has no side; .* give surface\.replace\(side="surface"\)'
    ):
        hk.trace(solid, [[3.0, 0, 0]], [[-1.0, 0, 0]])
    field.period = 1.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="must be real-valued"):
        hk.Surface(field)


# --- pictures -------------------------------------------------------------------------------

OPEN_CUBE = BruteForceWinding(*MESHES["open cube"])


@pytest.mark.slow
def test_rays_that_leave_a_sheet_do_not_meet_it_again() -> None:
    """To both sides, however flat. From outside the cube nothing else can be met."""
    vertices, faces = MESHES["tetrahedron"]
    backend = choose_backend("single")
    for scale in (1.0, 1e-3):
        field = BruteForceWinding(scale * vertices, faces)
        prepared = traced_surface(field, tolerance=1e-6 * scale).tracer(backend)
        o, d = rays(vertices, 1000, seed=4)
        ray = backend.Array3f((scale * o).T), backend.Array3f(d.T)
        met = intersect_surface(prepared, *ray, math.inf, backend.Bool(True))
        normal = to_numpy(met.normal)
        side = np.sign((normal * d).sum(axis=1))
        np.testing.assert_allclose(
            np.linalg.norm(normal, axis=1)[to_numpy(met.is_hit)], 1, atol=1e-5
        )
        outside = to_numpy(met.is_hit) & (side > 0)  # the normal points into the tetrahedron
        assert outside.sum() > 200
        way = unit(np.random.default_rng(0).normal(size=d.shape))
        away = (way * normal).sum(axis=1, keepdims=True)
        way = unit(way - (away + 1e-4 * np.abs(away)) * normal)  # nearly along the face, outwards
        start = to_numpy(met.position) - to_numpy(met.ray_offset)[:, None] * normal
        blocked = prepared.occluded(
            backend.Array3f(start.T), backend.Array3f(way.T), 0, math.inf,
            backend.Bool(outside),
        )  # fmt: skip
        assert not to_numpy(blocked).any()


@pytest.mark.slow
def test_polished_hits_stay_on_the_surface_and_sheets_where_they_are() -> None:
    vertices, faces = MESHES["open cube"]
    backend, exact = choose_backend("double"), ExactWinding(vertices, faces)
    prepared = traced_surface(BruteForceWinding(vertices, faces), tolerance=1e-4).tracer(backend)
    o, d = rays(vertices, 500, closest=1e-2)
    ray = backend.Array3f(o.T), backend.Array3f(d.T)
    met = intersect_surface(prepared, *ray, math.inf, backend.Bool(True))
    trace = prepared.first_hit(*ray, 0, math.inf)
    found, on_sheet = to_numpy(met.is_hit), to_numpy(trace.at_jump)
    position = to_numpy(met.position)
    np.testing.assert_array_equal(to_numpy(met.t)[on_sheet], to_numpy(trace.t)[on_sheet])
    smooth = found & ~on_sheet
    assert smooth.sum() > 30
    off = np.abs(exact(position[smooth]) - 0.5)
    assert np.quantile(off, 0.9) < 1e-6
    counts = to_numpy(met.evaluations) - to_numpy(trace.evaluations)
    np.testing.assert_array_equal(counts, smooth.astype(int))


@pytest.mark.slow
def test_walls_thinner_than_rounding_are_not_passed() -> None:
    """A unit cube at the coordinates of a map was a proved miss in single precision, in which its
    sides cancel; so was one of two units, 4e6 away."""
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    place = np.array([4e5, 5.8e6, 100.0])
    near = hk.WindingNumber(cube.vertices, cube.faces)
    on_map = hk.WindingNumber(cube.vertices + place, cube.faces)
    rays = np.array([[0.1, 0.2, 4.0], [2.0, 0.0, 4.0]]), np.array([[0, 0, -1.0]] * 2)
    single = hk.trace(on_map, place + rays[0], rays[1], precision="single")
    assert single.status.tolist() == [hk.RayStatus.OUT_OF_STEPS, hk.RayStatus.MISS]
    double = hk.trace(on_map, place + rays[0], rays[1], precision="double")
    assert double.t == pytest.approx([3.5, np.inf])
    far = hk.trace(near, [[0.1, 0.2, 4e6], [0.1, 0.2, 4e5]], rays[1], precision="single")
    assert far.status.tolist() == [hk.RayStatus.OUT_OF_STEPS, hk.RayStatus.HIT]
    assert far.t[1] == pytest.approx(4e5 - 0.5, abs=0.1)


def test_views_of_an_open_cube() -> None:
    normal = hk.render(OPEN_CUBE, show="normal", size=(40, 30))
    depth = hk.render(OPEN_CUBE, show="depth", size=(40, 30))
    status = hk.render(OPEN_CUBE, show="status", size=(40, 30))
    hit = status == hk.RayStatus.HIT
    assert (status != hk.RayStatus.OUT_OF_STEPS).all()
    assert 200 < hit.sum() < 1100
    np.testing.assert_allclose(np.linalg.norm(normal[hit], axis=1), 1, atol=1e-4)
    assert np.isfinite(depth[hit]).all()
    assert np.isinf(depth[~hit]).all()


@pytest.mark.slow
def test_a_small_picture_of_an_open_cube(tmp_path: Path) -> None:
    path = tmp_path / "cube.png"
    image = hk.render(OPEN_CUBE, path, size=(32, 24), spp=4, progress=False)
    assert path.stat().st_size > 200
    assert np.isfinite(image).all()
    assert image.mean() > 0.05
    magenta = (image[..., 0] > 0.8) & (image[..., 1] < 0.05) & (image[..., 2] > 0.8)
    assert not magenta.any()
