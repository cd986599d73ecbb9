"""Hermite radial basis functions: a smooth surface through given points p_i, with given normals
there. The surface is f = 0 for a sum f of one term for each point: f(x) = sum over i of a_i r_i^3 +
b_i . grad r_i^3, with r_i = |x - p_i|, numbers a_i and vectors b_i. The record of a point is its
row of numbers: p_i (entries 0 to 2), what rounding has cut off of p_i (3 to 5), a_i (6) and 3 b_i
(7 to 9). Along a path p + s d, a straight line from a point p, each term is a function of the
length s. A path is cut into pieces at knots, which are values of s. Jets are intervals that contain
the values and the derivatives of a function."""

from __future__ import annotations

import dataclasses
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
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.batched_fields import cached_upload
from harnack.fields.blobs.blob_sums import (
    PIECES,
    KnotRecorder,
    State,
    SumOnRay,
    SumValue,
    backend_number,
    for_each_record,
    sum_jets,
)
from harnack.fields.evaluator import POINTS, EvaluateOnly, Plan
from harnack.fields.formula import Formula
from harnack.fields.formula_evaluator import FormulaEvaluator, is_jet
from harnack.geometry import Box

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.formula_evaluator import FormulaFunction
    from harnack.geometry import Volume


# The maximal number of points: the linear system has four unknowns for each point.
_MAX_POINTS = 5000
# The domain is the box around the points, with this fraction of its size added on each side.
_MARGIN = 0.25


class HRBF(Formula):
    """Hermite radial basis functions: f(x) = sum over i of a_i r_i^3 + b_i . grad r_i^3, with r_i =
    |x - p_i|, for given points p_i. The numbers a_i and the vectors b_i are chosen so that f = 0
    and grad f = n_i at all points p_i. So the surface f = 0 passes through the points and has the
    given normals n_i there.

    points: (n, 3), the p_i.
    normals: (n, 3), the n_i, of any length but 0; they are made unit vectors. They point outward,
        so that f is negative inside.
    domain: the volume in which f is drawn; None for the box around the points, enlarged by a
        quarter of its longest side on each side. Far from all points such functions may have other
        zeros.

    Source: Aydinlilar and Zanni 2023, eq. 9; Wendland 2005.

    Raises:
        ValueError: arguments that are not points with normals, or a repeated point.
    """

    traits = dataclasses.replace(Formula.traits, is_cheap=False)
    period: ClassVar[float | None] = None
    default_level: float = 0.0

    def __init__(self, points: Any, normals: Any, *, domain: Volume | None = None) -> None:
        """Check points and normals (see the class), and solve for the coefficients a_i and
        b_i of the function."""
        self.points, self.normals = _checked(points, normals)
        self.value_coefficients, self.gradient_coefficients = _solve_coefficients(
            self.points, self.normals
        )
        lower, upper = self.points.min(axis=0), self.points.max(axis=0)
        margin = _MARGIN * float((upper - lower).max())
        self.domain = Box(lower - margin, upper + margin) if domain is None else domain
        self.lipschitz = self._largest_gradient()

    def _largest_gradient(self) -> float | None:
        """A bound of |grad f| in the domain; None if the domain is unbounded.

        It is a sum over the points p_i. The gradient of the term of a point is at most 3 |a| r^2 +
        6 |b| r, where r is the distance from p_i; the bound takes r as the distance to the farthest
        corner of the domain's box.
        """
        if self.domain is None or not np.isfinite(corners := np.array(self.domain.bounds())).all():
            return None
        max_offsets = np.abs(corners[:, None] - self.points).max(axis=0)
        r = np.linalg.norm(max_offsets, axis=1)
        vector_norms = np.linalg.norm(self.gradient_coefficients, axis=1)
        # (1e-6 covers the rounding of the sum.)
        return float((3 * np.abs(self.value_coefficients) * r * r + 6 * vector_norms * r).sum()) * (
            1 + 1e-6
        )

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> FormulaEvaluator:
        del plan
        function = self._upload(backend)
        return _HRBFEvaluator(self, function, function.lipschitz, function)

    def formula_on(self, backend: Backend) -> FormulaFunction:
        return self._upload(backend)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at jets of the coordinates (intervals that contain values and derivatives), or at
        Dr.Jit numbers."""
        number = backend_number(x, y, z) if is_jet(x, type(self).__name__) else x
        return self._upload(backend_of(number))(x, y, z)

    @cached_upload
    def _upload(self, backend: Backend) -> _DeviceFunction:
        """The function on a backend, with a table of one record (row of 16 numbers) for each point.
        Code that Dr.Jit compiles for it serves other points as well, because all numbers are data
        and none are literals.

        A record holds, by columns: 0 to 2 the point, rounded to the precision of the backend; 3 to
        5 the rest of the point, which rounding has cut off; 6 the number a; 7 to 9 the vector 3 b;
        10 to 15 zeros, which fill the row.
        """
        rounded_points = self.points.astype(backend.dtype).astype(np.float64)
        rows = np.column_stack(
            [
                rounded_points,
                self.points - rounded_points,
                self.value_coefficients,
                3 * self.gradient_coefficients,
                np.zeros((len(rounded_points), 6)),
            ]
        )
        records = RecordTable.upload(backend, rows)
        lipschitz = None if self.lipschitz is None else dr.opaque(backend.Float, self.lipschitz)
        return _DeviceFunction(backend, type(self).__name__, records, lipschitz)

    def describe(self) -> dict[str, Any]:
        """The number of points, as a dictionary for users."""
        return {"points": len(self.points)}


@dataclass(frozen=True, eq=False)
class _DeviceFunction:
    """The function f of `HRBF` on a backend. Called with three coordinates, it is the formula of f.

    name: the name of the field's class, for messages.
    records: a table with one record (row of 16 numbers) for each point.
    lipschitz: a bound of |grad f| in the domain; None if the domain is unbounded.
    """

    backend: Backend
    name: str
    records: RecordTable
    lipschitz: Real | None

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """f at jets of the coordinates (intervals that contain values and derivatives), or at
        Dr.Jit numbers."""
        if not is_jet(x, self.name):
            points = EvaluateOnly(lambda p: self.sample(self.value_at(p)))
            return points.differentiable_value(self.backend.Array3f(x, y, z))

        def term(row: list[Real]) -> Jet:
            """The jet of the term a r^3 + b . grad r^3 of one point, which is a r^3 + 3 r (b . v)
            with v = x - p_i, whose components are u, v and w in the code. row: the point's record:
            p_i in two parts (entries 0 to 5), a (6), and 3 b (7 to 9)."""
            u, v, w = ((entry - row[k]) - row[3 + k] for k, entry in enumerate((x, y, z)))
            r = (u**2 + v**2 + w**2).apply(sqrt)
            # a r^3 + r (3 b . v)
            return r**3 * row[6] + r * (u * row[7] + v * row[8] + w * row[9])

        return sum_jets(term, x, self.backend.Float(0), for_each_record(self.records))

    def value_at(self, p: Vec3) -> SumValue:
        """f at points p."""
        # Any direction will do: with a single knot no derivative along the line is computed.
        d = type(p)(1, 0, 0)
        return self.along(p, d, (0.0,)).start

    def sample(self, sums: SumValue) -> Sample:
        """The sample at points: value, gradient, and, as the proved bound of f near the points, a
        Lipschitz constant that holds in the domain.

        sums: value and gradient of f at the points, with bounds of their errors.
        """
        promises = () if self.lipschitz is None else (Lipschitz(0 * sums.value + self.lipschitz),)
        return Sample(sums.value, sums.gradient, promises, sums.error, sums.gradient_error)

    def along(self, p: Vec3, d: Vec3, knots: Sequence[Real]) -> SumOnRay:
        """f along the paths p + s d, with ranges of its first two derivatives by s on the pieces
        between knots.

        p, d: (3, n) starts of the paths, and their unit directions.
        knots: increasing values of s, the first of them 0. If there is only that one, derivatives
            along the line are left out.

        Proof. Consider the term of one point p_i. Let b be three times its vector b_i, h the
        distance of the line from p_i, w the vector from p_i to the nearest point of the line, c = b
        . w and B = b . d. Let x be the position on the line, measured from that nearest point, r^2
        = h^2 + x^2 and u = x/r. Then the term and its first two derivatives in x are

            a r^3 + r (c + B x),
            3 a r x + c u + B (h^2 + 2x^2)/r,
            3 a (h^2 + 2x^2)/r + c h^2/r^3 + B (3u - u^3).

        The functions r x, u and 3u - u^3 increase. (h^2 + 2x^2)/r decreases until x = 0 and
        increases from there; h^2/r^3 does the opposite. So each function has its extreme values on
        a piece at the ends of the piece, or at 0.

        Rounding. The error of positions is at most e = 8 roundings of the largest distance m from
        p_i on the path, as in `harnack.fields.blobs.blob_sums`. It changes the three expressions by
        at most 3 |a| m^2 e + 2 |b| m e, 6 |a| m e + 4 |b| e and 10 |a| e + 8 |b| min(1, e/r), where
        r is the smallest distance from p_i on the path. A sum of n terms adds n roundings of the
        sum of |a| m^3 + |b| m^2, of 3 |a| m^2 + 3 |b| m and of 6 |a| m + 3 |b|.
        """
        backend, records = self.backend, self.records
        real = backend.Float
        count = len(knots) - 1
        roundoff = 0.5 * backend.machine_epsilon
        tiny = float(dr.smallest(real))

        def add_point(row: list[Real], state: State) -> State:
            """Return the sums so far (`state`), with the term of one more point added. row: the
            point's record. In the code a and b are the a and b of the proof.

            The state consists of the value; the three components of the gradient; the sums of |a|
            r^3 + |b| r^2 and of |a| r^2 + |b| r, for the errors of both; and the number of terms.
            If derivatives along the line are bounded, there follow for each piece the ends of the
            range of the first derivative and those of the second, and at the end the sums for the
            errors of these two ranges.
            """
            (
                value,
                gradient_x,
                gradient_y,
                gradient_z,
                value_size,
                gradient_size,
                term_count,
                *sums,
            ) = state
            a = row[6]
            v, b, r, inverse_r = _offset_of_point(p, row)
            # The term is a r^3 + r (b . v), and its gradient is (3 a r + (b . v)/r) v + r b.
            along_b = dr.dot(b, v)
            radial = dr.fma(3 * a, r, along_b * inverse_r)
            value = value + r * dr.fma(a * r, r, along_b)
            gradient = [
                component + dr.fma(radial, v[k], r * b[k])
                for k, component in enumerate((gradient_x, gradient_y, gradient_z))
            ]
            abs_a, norm_b = dr.abs(a), dr.norm(b)
            value_size = dr.fma(dr.fma(abs_a, r, norm_b), r * r, value_size)
            gradient_size = dr.fma(dr.fma(abs_a, r, norm_b), r, gradient_size)
            term_count = term_count + 1
            if not count:
                return value, *gradient, value_size, gradient_size, term_count

            # The line's quantities of the proof: x at the start of the path, w, h, c and B
            # (`rate_b`).
            position = dr.dot(v, d)
            w = v - position * d
            h_squared = dr.dot(w, w)
            h = dr.sqrt(h_squared)
            c, rate_b = dr.dot(b, w), dr.dot(b, d)
            start_shapes = _term_functions(h_squared, position, tiny)
            # The values at x = 0 of the functions that are not monotone.
            values_at_zero = (h, h_squared / fmax(h_squared * h, tiny))
            for k in range(count):
                end_at = position + knots[k + 1]
                end_shapes = _term_functions(h_squared, end_at, tiny)
                crosses = (position + knots[k] <= 0) & (end_at >= 0)
                bowl_min = dr.select(
                    crosses, values_at_zero[0], fmin(start_shapes.bowl, end_shapes.bowl)
                )
                bell_max = dr.select(
                    crosses, values_at_zero[1], fmax(start_shapes.bell, end_shapes.bell)
                )
                bowl = bowl_min, fmax(start_shapes.bowl, end_shapes.bowl)
                bell = fmin(start_shapes.bell, end_shapes.bell), bell_max
                # Add the range of each function times its factor: to the first derivative (index 0)
                # or to the second one (index 2).
                for index, scale, (lower, upper) in (
                    (0, 3 * a, (start_shapes.lift, end_shapes.lift)),
                    (0, c, (start_shapes.sine, end_shapes.sine)),
                    (0, rate_b, bowl),
                    (2, 3 * a, bowl),
                    (2, c, bell),
                    (2, rate_b, (start_shapes.turn, end_shapes.turn)),
                ):
                    # A negative factor exchanges the ends of a range.
                    is_positive = scale > 0
                    lower, upper = (
                        dr.select(is_positive, lower, upper),
                        dr.select(is_positive, upper, lower),
                    )
                    sums[4 * k + index] = dr.fma(lower, scale, sums[4 * k + index])
                    sums[4 * k + index + 1] = dr.fma(upper, scale, sums[4 * k + index + 1])
                start_shapes = end_shapes

            # The largest distance from the point on the path, and the smallest.
            max_distance = r + knots[-1]
            nearest = dr.select(
                position >= 0,
                r,
                dr.select(
                    position + knots[-1] <= 0,
                    dr.sqrt(h_squared + dr.square(position + knots[-1])),
                    h,
                ),
            )
            # m/r, limited as min(1, e/r) is in the bound of the error.
            fraction = fmin(max_distance / fmax(nearest, tiny), 1 / (8 * roundoff))
            sums[-2] = sums[-2] + max_distance * dr.fma(abs_a, max_distance, norm_b)
            sums[-1] = sums[-1] + dr.fma(abs_a, max_distance, norm_b * fraction)
            return value, *gradient, value_size, gradient_size, term_count, *sums

        # Seven numbers for the value; four for each piece, and two for the errors of their ranges.
        state_size = 7 + (4 * count + 2 if count else 0)
        state = records.for_each(add_point, tuple(real(0) for _ in range(state_size)), "points")
        value, gradient_x, gradient_y, gradient_z, value_size, gradient_size, term_count, *sums = (
            state
        )
        # The numbers of roundings in the proof: of the value 3 * 8 + n; of the derivatives 6 * 8 +
        # 3 n and 10 * 8 + 6 n, for which 64 + 3 n and 100 + 6 n are taken.
        start = SumValue(
            value,
            backend.Array3f(gradient_x, gradient_y, gradient_z),
            roundoff * (24 + term_count) * value_size,
            roundoff * (64 + 3 * term_count) * gradient_size,
        )
        pieces: list[PathPiece] = []
        # From here on a and b are the two ends of a piece.
        for k, (a, b) in enumerate(itertools.pairwise(knots)):
            lower, upper, min_second, max_second = sums[4 * k : 4 * k + 4]
            slope_error = roundoff * (64 + 3 * term_count) * sums[-2]
            second_error = roundoff * (100 + 6 * term_count) * sums[-1]
            slopes = SlopeRange(lower - slope_error, upper + slope_error)
            pieces.append(
                PathPiece(
                    b - a,
                    slopes,
                    min_second - second_error,
                    max_second + second_error,
                )
            )
        return SumOnRay(start, tuple(pieces))


@dataclass(frozen=True, eq=False)
class _HRBFEvaluator(FormulaEvaluator):
    """The evaluator of `HRBF`.

    function: the function on the backend, which is also the formula.
    """

    function: _DeviceFunction

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: the value and the gradient of f, and a Lipschitz constant that holds in
        the domain."""
        return self.function.sample(self.function.value_at(p))

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the position t of a ray, with enclosures: proofs of lengths in front of the
        point on which f takes none of the levels (the values that rays look for). It needs one loop
        over the points p_i. There is no enclosure behind the point.

        path: the ray.
        t: a length along it.
        ahead: the length in front of the point up to which proofs are wanted.
        back: the same behind the point; not used.
        """
        del back
        p, d = path.point(t), path.direction
        # The proofs are asked first at which knots they want ranges of derivatives; those are then
        # computed in the one loop over the points.
        recorder = KnotRecorder()
        length = ahead
        # (The slope is not needed for this.)
        path.proofs.from_restriction(recorder, SlopeRange(0.0, 0.0), length)
        # No proof asks for ranges of derivatives: those from the Lipschitz constant are used.
        if recorder.knots is None:
            return path.enclose(self.evaluate(p))
        sums = self.function.along(p, d, recorder.knots)
        slope = dr.dot(sums.start.gradient, d)
        slopes = SlopeRange.around(slope, sums.start.gradient_error)
        enclosures = path.proofs.from_restriction(sums, slopes, length)
        # The next sample asks for enclosures up to as many lengths of this step as there are
        # pieces.
        return RaySample(self.function.sample(sums.start), enclosures, (), slope, PIECES)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p, by a sum over the points p_i."""
        backend, records = self.function.backend, self.function.records
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))

        def add_point(row: list[Real], state: State) -> State:
            """Return the sums so far of the second derivatives xx, xy, xz, yy, yz, zz (`state`),
            with the term of one more point added. row: the point's record."""
            # The vector from the point; three times the vector b_i; the length of v, and 1/length.
            v, b, r, inverse_r = _offset_of_point(p, row)
            b_dot_e = dr.dot(b, v) * inverse_r
            e = v * inverse_r

            def entry(i: int, j: int) -> Real:
                """The second derivative of the point's term by coordinates i and j.

                Let v be the vector from the point, r its length and e = v/r; let a be the number of
                the point's record, and b the vector of its entries 7 to 9. With the indices i and j
                for components of vectors, the derivative is 3 a (r delta_ij + v_i e_j) + (b . e)
                (delta_ij - e_i e_j) + b_i e_j + b_j e_i.
                """
                delta = 1.0 if i == j else 0.0
                vector_part = b_dot_e * (delta - e[i] * e[j]) + b[i] * e[j] + b[j] * e[i]
                return 3 * row[6] * (r * delta + v[i] * e[j]) + vector_part

            return tuple(total + entry(*pair) for total, pair in zip(state, pairs, strict=True))

        zero = tuple(backend.Float(0) for _ in pairs)
        xx, xy, xz, yy, yz, zz = records.for_each(add_point, zero, "points")
        vector = backend.Array3f
        return vector(xx, xy, xz), vector(xy, yy, yz), vector(xz, yz, zz)


@dataclass(frozen=True)
class _TermFunctions:
    """The values at a position x on a line of five functions of x, whose ranges bound the
    derivatives of one point's term along the line (`_DeviceFunction.along`). Here x is measured
    from the point of the line nearest to the point p_i of the term, h is the distance of the line
    from p_i, r^2 = h^2 + x^2 and u = x/r. `bowl` and `bell` are named by the shapes of their
    graphs."""

    lift: Real  # r x
    sine: Real  # u
    bowl: Real  # (h^2 + 2x^2)/r
    bell: Real  # h^2/r^3
    turn: Real  # 3u - u^3


def _term_functions(h_squared: Real, x: Real, tiny: float) -> _TermFunctions:
    """The five functions `_TermFunctions` at the position x of a line that passes the point p_i of
    a term at the distance h. x is measured from the point of the line nearest to p_i.

    h_squared: h^2.
    tiny: the smallest positive normal number; a distance below it counts as this number in
        divisions.
    """
    x_squared = x * x
    r_squared = h_squared + x_squared
    r = dr.sqrt(r_squared)
    inverse_r = 1 / fmax(r, tiny)
    u = x * inverse_r
    # In this order: r x, u, (h^2 + 2x^2)/r, h^2/r^3, 3u - u^3.
    return _TermFunctions(
        r * x,
        u,
        (r_squared + x_squared) * inverse_r,
        h_squared * inverse_r * inverse_r * inverse_r,
        u * (3 - u * u),
    )


def _offset_of_point(p: Vec3, row: list[Real]) -> tuple[Vec3, Vec3, Real, Real]:
    """Return four results for one of the given points, p_i: the vector v from p_i to p; the vector
    3 b_i; the length of v; and one over that length.

    row: the record of p_i.
    """
    v = type(p)(*((p[k] - row[k]) - row[3 + k] for k in range(3)))
    b = type(p)(row[7], row[8], row[9])
    r = dr.norm(v)
    return v, b, r, 1 / fmax(r, float(dr.smallest(type(r))))


def _solve_coefficients(points: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The numbers a_i (n,) and the vectors b_i (n, 3) of the function f = sum over i of a_i r_i^3 +
    b_i . grad r_i^3 with r_i = |x - p_i|, for which f = 0 and grad f = the normal at each point
    p_i.

    They solve a linear system with four equations and four unknowns for each point. It is solved in
    coordinates scaled to the size of the point set.

    Raises:
        ValueError: the system cannot be solved.
    """
    center, n = points.mean(axis=0), len(points)
    size = float(np.abs(points - center).max()) or 1.0
    scaled = (points - center) / size
    offsets = scaled[:, None] - scaled[None]  # from column to row
    r = np.linalg.norm(offsets, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        unit_outer_products = np.where(
            (r > 0)[..., None, None],
            offsets[..., :, None] * offsets[..., None, :] / r[..., None, None],
            0,
        )
    system = np.empty((n, 4, n, 4))
    # Equation 0 of a point is the value of f, equations 1 to 3 are the gradient. Unknown 0 of a
    # point is a, unknowns 1 to 3 are b.
    system[:, 0, :, 0] = r**3
    system[:, 0, :, 1:] = 3 * r[..., None] * offsets
    system[:, 1:, :, 0] = np.moveaxis(3 * r[..., None] * offsets, 2, 1)
    hessian = 3 * (r[..., None, None] * np.eye(3) + unit_outer_products)
    system[:, 1:, :, 1:] = np.moveaxis(hessian, 2, 1)
    right_side = np.zeros((n, 4))
    right_side[:, 1:] = normals
    matrix = system.reshape(4 * n, 4 * n)
    import scipy.linalg  # imported here, as it takes time that few programs need

    try:
        solution = cast("Any", scipy.linalg).solve(matrix, right_side.ravel(), assume_a="gen")
    except np.linalg.LinAlgError:
        # No solution: the residual below is NaN, which is refused.
        solution = np.full(4 * n, np.nan)
    residual = np.abs(matrix @ solution - right_side.ravel()).max()
    if not residual <= 1e-6:
        raise ValueError(
            f"no function through these {n} points was found (it misses them by {residual:.1g} of "
            "their size): they lie too close together for their distances, or on one line; leave "
            "some out or add others"
        )
    solution = solution.reshape(n, 4)
    # Back to unscaled coordinates, in which r^3 is size^3 times and grad r^3 size^2 times as large;
    # f is multiplied by size, so that its gradients are still the normals.
    return solution[:, 0] / size**2, solution[:, 1:] / size


def _checked(points: Any, normals: Any) -> tuple[FloatArray, FloatArray]:
    """The points (n, 3) and the normals (n, 3) after checks, x and n in the code; the normals are
    made unit vectors.

    Raises:
        ValueError: wrong shapes or numbers, or a repeated point.
    """
    x = as_real_array(points, "points").astype(np.float64)
    check_vectors(x, "points")
    if not 2 <= len(x) <= _MAX_POINTS:
        raise ValueError(f"points: {len(x):,} given, but 2 to {_MAX_POINTS:,} can be used")
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
    _, first_index, counts = np.unique(x, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        index = int(first_index[np.argmax(counts > 1)])
        raise ValueError(f"point {index} is given more than once: leave out the others")
    return x, n / length[:, None]
