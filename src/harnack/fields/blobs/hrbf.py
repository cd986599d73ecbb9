"""Hermite radial basis functions: a smooth surface through points with given normals."""

from __future__ import annotations

import copy
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, cast

import drjit as dr
import numpy as np

from harnack.arithmetic import Jet, sqrt
from harnack.backend import FloatArray, backend_of
from harnack.backend.elementary import fmax, fmin
from harnack.backend.record_table import RecordTable
from harnack.backend.validation import (
    as_real_array,
    check_coordinate_size,
    check_finite,
    check_vectors,
)
from harnack.enclosures import Lipschitz, SlopeRange
from harnack.enclosures.enclosure import PathPiece
from harnack.fields.batched_fields import cached_prepare
from harnack.fields.blobs.blob_sums import (
    PIECES,
    KnotRecorder,
    State,
    SumOnRay,
    SumValue,
    for_each_record,
    sum_jets,
)
from harnack.fields.formula import Formula, is_jet
from harnack.fields.samples import Ray, RaySample, Sample
from harnack.geometry import Box
from harnack.geometry.volume import check_volume

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume


# The most points: the linear system has four unknowns for each of them.
_MOST_POINTS = 5000
# The domain is the box around the points, with this fraction of its size added on each side.
_MARGIN = 0.25


class HRBF(Formula):
    """f = sum of a_i r_i^3 + b_i . grad r_i^3, r_i = |x - p_i|, with f = 0 and grad f = n_i at all
    points p_i: the surface passes through the points, along the normals (Aydinlilar and Zanni 2023,
    eq. 9; Wendland 2005).

    points: (n, 3).
    normals: (n, 3) of any length but 0, outward: f is negative inside.
    domain: the volume it is drawn in; None for the box around the points and a quarter more on each
        side. Far from all points such functions may have other zeros.

    Raises ValueError for what are no points with normals, or points that are given twice.
    """

    is_cheap = False
    period: ClassVar[float | None] = None
    default_level: float = 0.0

    def __init__(self, points: Any, normals: Any, *, domain: Volume | None = None) -> None:
        check_volume(domain, "domain")
        self.points, self.normals = _checked(points, normals)
        self.value_coefficients, self.gradient_coefficients = _solve_coefficients(
            self.points, self.normals
        )
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        more = _MARGIN * float((high - low).max())
        self.domain = Box(low - more, high + more) if domain is None else domain
        self.lipschitz = self._largest_gradient()
        self._on: tuple[Backend, RecordTable] | None = None

    @cached_prepare
    def prepare(self, backend: Backend) -> HRBF:
        """The points as records of the backend; other points compile no other kernel."""
        prepared = copy.copy(self)
        prepared._on = self._uploaded(backend)
        if self.lipschitz is not None:
            prepared.lipschitz = dr.opaque(backend.Float, self.lipschitz)
        return prepared

    def _largest_gradient(self) -> float | None:
        """A bound of |grad f| in the domain: |grad (a r^3 + b.grad r^3)| <= 3 |a| r^2 + 6 |b| r."""
        if self.domain is None or not np.isfinite(corners := np.array(self.domain.bounds())).all():
            return None
        far = np.abs(corners[:, None] - self.points).max(axis=0)
        r = np.linalg.norm(far, axis=1)
        strong = np.linalg.norm(self.gradient_coefficients, axis=1)
        return float((3 * np.abs(self.value_coefficients) * r * r + 6 * strong * r).sum()) * (
            1 + 1e-6
        )

    def _uploaded(self, backend: Backend) -> tuple[Backend, RecordTable]:
        near = self.points.astype(backend.dtype).astype(np.float64)
        rows = np.column_stack(
            [
                near,
                self.points - near,
                self.value_coefficients,
                3 * self.gradient_coefficients,
                np.zeros((len(near), 6)),
            ]
        )
        return backend, RecordTable.upload(backend, rows)

    def _prepared_for(self, backend: Backend) -> tuple[Backend, RecordTable]:
        return self._uploaded(backend) if self._on is None else self._on

    def evaluate(self, p: Vec3) -> Sample:
        d = type(p)(1, 0, 0)
        return self._sample(self._along(p, d, (0.0,)).start)

    def _sample(self, found: SumValue) -> Sample:
        known = () if self.lipschitz is None else (Lipschitz(0 * found.value + self.lipschitz),)
        return Sample(found.value, found.gradient, known, found.error, found.gradient_error)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """Value and ranges by one loop over the points; looking back nothing is proved."""
        del back
        p, d = path.point(t), path.direction
        asked = KnotRecorder()
        length = ahead
        path.proofs.from_restriction(asked, SlopeRange(0.0, 0.0), length)
        if asked.knots is None:
            return path.enclose(self.evaluate(p))
        found = self._along(p, d, asked.knots)
        slope = dr.dot(found.start.gradient, d)
        slopes = SlopeRange.around(slope, found.start.gradient_error)
        enclosures = path.proofs.from_restriction(found, slopes, length)
        return RaySample(self._sample(found.start), enclosures, (), slope, PIECES)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f of jets of the coordinates, or of Dr.Jit numbers."""
        if not is_jet(x, type(self).__name__):
            return self.differentiable_value(backend_of(x).Array3f(x, y, z))
        numbers = (end for jet in (x, y, z) for one in (jet.value, *jet.first_derivatives)
                   for end in (one.lower, one.upper) if dr.is_array_v(type(end)))  # fmt: skip
        backend, records = self._prepared_for(backend_of(next(numbers)))

        def term(row: list[Real]) -> Jet:
            u, v, w = ((one - row[k]) - row[3 + k] for k, one in enumerate((x, y, z)))
            r = (u**2 + v**2 + w**2).apply(sqrt)
            return r**3 * row[6] + r * (u * row[7] + v * row[8] + w * row[9])

        return sum_jets(term, x, backend.Float(0), for_each_record(records))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        backend, records = self._prepared_for(backend_of(p))
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))

        def body(row: list[Real], state: State) -> State:
            v, b, r, inverse = _term(p, row)
            along = dr.dot(b, v) * inverse
            e = v * inverse

            def entry(i: int, j: int) -> Real:
                same = 1.0 if i == j else 0.0
                third = along * (same - e[i] * e[j]) + b[i] * e[j] + b[j] * e[i]
                return 3 * row[6] * (r * same + v[i] * e[j]) + third

            return tuple(one + entry(*pair) for one, pair in zip(state, pairs, strict=True))

        zero = tuple(backend.Float(0) for _ in pairs)
        xx, xy, xz, yy, yz, zz = records.for_each(body, zero, "points")
        vector = backend.Array3f
        return vector(xx, xy, xz), vector(xy, yy, yz), vector(xz, yz, zz)

    def _along(self, p: Vec3, d: Vec3, knots: Sequence[Real]) -> SumOnRay:
        """The sum along p + s d.

        With b_i three times the vector of the point, h the distance of the line from it, c = b.w
        for w from the point to the nearest point of the line, x the position from there, r^2 = h^2
        + x^2, u = x/r and B = b.d, a term and its derivatives are

            a r^3 + r (c + B x),
            3 a r x + c u + B (h^2 + 2x^2)/r,
            3 a (h^2 + 2x^2)/r + c h^2/r^3 + B (3u - u^3).

        r x, u and 3u - u^3 increase; (h^2 + 2x^2)/r and -h^2/r^3 decrease until x = 0 and increase
        from there. So each has its extreme values at the ends of a piece, or at 0.

        Rounding. Positions are right within e = 8 roundings of the largest distance m on the path,
        as in `harnack.fields.blobs.blob_sums`. That changes the three expressions by at most 3 |a|
        m^2 e + 2 |b| m e, 6 |a| m e + 4 |b| e and 10 |a| e + 8 |b| min(1, e/r), r the least
        distance on the path. Sums of n terms add n roundings of the sum of |a| m^3 + |b| m^2, 3 |a|
        m^2 + 3 |b| m and 6 |a| m + 3 |b|.
        """
        backend, records = self._prepared_for(backend_of(p))
        real = backend.Float
        count = len(knots) - 1
        unit = 0.5 * backend.machine_epsilon
        tiny = float(dr.smallest(real))

        def body(row: list[Real], state: State) -> State:
            value, gx, gy, gz, value_size, gradient_size, terms, *sums = state
            a = row[6]
            v, b, r, inverse = _term(p, row)
            along_b = dr.dot(b, v)
            pull = dr.fma(3 * a, r, along_b * inverse)
            value = value + r * dr.fma(a * r, r, along_b)
            gradient = [one + dr.fma(pull, v[k], r * b[k]) for k, one in enumerate((gx, gy, gz))]
            steep, strong = dr.abs(a), dr.norm(b)
            value_size = dr.fma(dr.fma(steep, r, strong), r * r, value_size)
            gradient_size = dr.fma(dr.fma(steep, r, strong), r, gradient_size)
            terms = terms + 1
            if not count:
                return value, *gradient, value_size, gradient_size, terms

            at = dr.dot(v, d)
            w = v - at * d
            h2 = dr.dot(w, w)
            h = dr.sqrt(h2)
            c, rate = dr.dot(b, w), dr.dot(b, d)
            begin = _shapes(h2, at, tiny)
            # The values at x = 0 of the functions that are not monotone.
            valley = (h, h2 / fmax(h2 * h, tiny))
            for k in range(count):
                place = at + knots[k + 1]
                end = _shapes(h2, place, tiny)
                crosses = (at + knots[k] <= 0) & (place >= 0)
                dip = dr.select(crosses, valley[0], fmin(begin.bowl, end.bowl))
                peak = dr.select(crosses, valley[1], fmax(begin.bell, end.bell))
                bowl = dip, fmax(begin.bowl, end.bowl)
                bell = fmin(begin.bell, end.bell), peak
                for at_sum, scale, (low, high) in (
                    (0, 3 * a, (begin.lift, end.lift)),
                    (0, c, (begin.sine, end.sine)),
                    (0, rate, bowl),
                    (2, 3 * a, bowl),
                    (2, c, bell),
                    (2, rate, (begin.turn, end.turn)),
                ):
                    up = scale > 0
                    low, high = dr.select(up, low, high), dr.select(up, high, low)
                    sums[4 * k + at_sum] = dr.fma(low, scale, sums[4 * k + at_sum])
                    sums[4 * k + at_sum + 1] = dr.fma(high, scale, sums[4 * k + at_sum + 1])
                begin = end

            largest = r + knots[-1]
            nearest = dr.select(
                at >= 0,
                r,
                dr.select(at + knots[-1] <= 0, dr.sqrt(h2 + dr.square(at + knots[-1])), h),
            )
            share = fmin(largest / fmax(nearest, tiny), 1 / (8 * unit))
            sums[-2] = sums[-2] + largest * dr.fma(steep, largest, strong)
            sums[-1] = sums[-1] + dr.fma(steep, largest, strong * share)
            return value, *gradient, value_size, gradient_size, terms, *sums

        size = 7 + (4 * count + 2 if count else 0)
        state = records.for_each(body, tuple(real(0) for _ in range(size)), "points")
        value, gx, gy, gz, value_size, gradient_size, terms, *sums = state
        start = SumValue(
            value,
            backend.Array3f(gx, gy, gz),
            unit * (24 + terms) * value_size,
            unit * (64 + 3 * terms) * gradient_size,
        )
        parts: list[PathPiece] = []
        for k, (a, b) in enumerate(itertools.pairwise(knots)):
            low, high, least, most = sums[4 * k : 4 * k + 4]
            slope_error = unit * (64 + 3 * terms) * sums[-2]
            bend_error = unit * (100 + 6 * terms) * sums[-1]
            slopes = SlopeRange(low - slope_error, high + slope_error)
            parts.append(PathPiece(b - a, slopes, least - bend_error, most + bend_error))
        return SumOnRay(start, tuple(parts))

    def describe(self) -> dict[str, Any]:
        return {"points": len(self.points)}


@dataclass(frozen=True)
class _TermFunctions:
    """The functions for one point along a line: see `HRBF._along`."""

    lift: Real  # r x
    sine: Real  # u
    bowl: Real  # (h^2 + 2x^2)/r
    bell: Real  # h^2/r^3
    turn: Real  # 3u - u^3


def _shapes(h2: Real, x: Real, tiny: float) -> _TermFunctions:
    square = x * x
    r2 = h2 + square
    r = dr.sqrt(r2)
    inverse = 1 / fmax(r, tiny)
    u = x * inverse
    return _TermFunctions(
        r * x, u, (r2 + square) * inverse, h2 * inverse * inverse * inverse, u * (3 - u * u)
    )


def _term(p: Vec3, row: list[Real]) -> tuple[Vec3, Vec3, Real, Real]:
    """The vector from a point to p, its b, its length, and the inverse of that."""
    v = type(p)(*((p[k] - row[k]) - row[3 + k] for k in range(3)))
    b = type(p)(row[7], row[8], row[9])
    r = dr.norm(v)
    return v, b, r, 1 / fmax(r, float(dr.smallest(type(r))))


def _solve_coefficients(points: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Factors a (n,) and vectors b (n, 3) of the function: see `HRBF`.

    Raises:
        ValueError: the system cannot be solved.
    """
    middle, n = points.mean(axis=0), len(points)
    size = float(np.abs(points - middle).max()) or 1.0
    x = (points - middle) / size
    v = x[:, None] - x[None]  # from column to row
    r = np.linalg.norm(v, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        outer = np.where(
            (r > 0)[..., None, None], v[..., :, None] * v[..., None, :] / r[..., None, None], 0
        )
    system = np.empty((n, 4, n, 4))
    system[:, 0, :, 0] = r**3
    system[:, 0, :, 1:] = 3 * r[..., None] * v
    system[:, 1:, :, 0] = np.moveaxis(3 * r[..., None] * v, 2, 1)
    hessian = 3 * (r[..., None, None] * np.eye(3) + outer)
    system[:, 1:, :, 1:] = np.moveaxis(hessian, 2, 1)
    wanted = np.zeros((n, 4))
    wanted[:, 1:] = normals
    matrix = system.reshape(4 * n, 4 * n)
    import scipy.linalg  # here: time that few need

    try:
        found = cast("Any", scipy.linalg).solve(matrix, wanted.ravel(), assume_a="gen")
    except np.linalg.LinAlgError:
        found = np.full(4 * n, np.nan)
    missed = np.abs(matrix @ found - wanted.ravel()).max()
    if not missed <= 1e-6:
        raise ValueError(
            f"no function through these {n} points was found (it misses them by {missed:.1g} of "
            "their size): they lie too close together for their distances, or on one line; leave "
            "some out or add others"
        )
    found = found.reshape(n, 4)
    return found[:, 0] / size**2, found[:, 1:] / size


def _checked(points: Any, normals: Any) -> tuple[FloatArray, FloatArray]:
    """Arrays of points and unit normals.

    Raises:
        ValueError: wrong shapes or numbers, points that are given twice.
    """
    x = as_real_array(points, "points").astype(np.float64)
    check_vectors(x, "points")
    if not 2 <= len(x) <= _MOST_POINTS:
        raise ValueError(f"points: {len(x):,} given, but 2 to {_MOST_POINTS:,} can be used")
    check_finite(x, "point {}", ValueError)
    check_coordinate_size(x, ValueError)
    n = as_real_array(normals, "normals").astype(np.float64)
    check_vectors(n, "normals")
    if len(n) != len(x):
        raise ValueError(f"{len(x)} points and {len(n)} normals: there must be one for each point")
    check_finite(n, "normal {}", ValueError, "normals must be finite")
    length = np.linalg.norm(n, axis=1)
    if not (length > 0).all():
        raise ValueError(f"normal {int(np.argmin(length))} is zero: it has no direction")
    _, first, counts = np.unique(x, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        twice = int(first[np.argmax(counts > 1)])
        raise ValueError(f"point {twice} is given more than once: leave out the others")
    return x, n / length[:, None]
