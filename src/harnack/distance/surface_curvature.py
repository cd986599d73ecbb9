"""Curvature of level sets of a function f from its first and second derivatives, and lines of
curvature: curves on a level set along which it bends most, or least. The principal curvatures at a
point are the largest and the smallest curvature of the surface in any direction there, and the
principal directions are those in which they occur.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy
from harnack.backend.arrays import as_finite_vectors, upload_vectors
from harnack.backend.elementary import fmax, fmin
from harnack.backend.loops import loop_while_active
from harnack.backend.validation import as_positive, no_derivatives
from harnack.distance.tangent_plane import SymmetricEigen2, TangentPlane, in_batches
from harnack.fields.batched_fields import BatchedField
from harnack.name_suggestions import did_you_mean, is_one_of
from harnack.tracer.trace_options import shows_keywords, surface_and_options

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.evaluator import Evaluator
    from harnack.fields.field import Field
    from harnack.geometry import Volume
    from harnack.tracer import Surface, TraceKeywords, TraceOptions

__all__ = ["CurvatureSamples", "Family", "curvature", "curvature_lines"]

_HONORED_BY_LINES = ("level", "clip", "section", "precision")
# A mean curvature is accurate enough if its error is at most this fraction of it, or this fraction
# of 1/(size of the surface), whichever is larger.
_ACCURACY = 1e-3
# Acceptance factors of the multipole expansions, tried in turn until the error is small enough: a
# cluster is expanded only if it is this many times farther away than usual; with infinity every
# term is summed directly.
_ACCEPTANCE_FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0, math.inf)
# Rounding error of the formulas here, in machine epsilons of the gradient and the Hessian.
_ROUNDING = 16.0


@dataclass(frozen=True)
class CurvatureSamples:
    """Curvatures of the level sets of a function f through n points. NaN where the gradient is
    zero, so that there is no surface, and where the error of the gradient is not less than its
    length.

    mean: (n,) half the divergence of the normal, 1/length. Its sign is the normal's: a sphere of
        radius r has 1/r if f grows outward, -1/r if f grows inward.
    gaussian: (n,) product of the principal curvatures, 1/length^2; the same for f and -f.
    normal: (n, 3) grad f/|grad f|.
    mean_error, gaussian_error: (n,) proved bounds of how far `mean` and `gaussian` may be off;
        infinite where they are NaN, and where the field does not state the errors of its
        derivatives (`Evaluator.derivative_errors`). The rounding of the coordinates in which a
        moved or bent field without a formula is evaluated is not included.
    """

    mean: FloatArray
    gaussian: FloatArray
    normal: FloatArray
    mean_error: FloatArray
    gaussian_error: FloatArray


@shows_keywords("precision")
@no_derivatives
def curvature(
    surface: Field | Surface,
    points: Any,
    *,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> CurvatureSamples:
    """Compute the mean and Gaussian curvature of the level sets of a field's function f through
    points (n, 3).

    surface: a field, or a `Surface`. The curvature at a point is that of the level set through the
        point, whatever its level is; levels, clip and section of a `Surface` have no effect. One
        with a side or `largest` raises a TypeError.
    options: a `TraceOptions` in which only `precision` is set: any other option that is set raises
        a TypeError. None is double precision.
    keywords: `precision`, in place of `options`.

    The derivative of n = grad f/|grad f| along a tangent u of the level set has the tangential
    part (A u)/|grad f|, A the Hessian; its component along n is zero, for |n| = 1. So with an
    orthonormal frame (u, v) of the tangent plane the shape operator is S = (u, v)^T A (u, v) /
    |grad f|, and

        mean = tr S/2 = (tr A - n.An)/(2 |grad f|) = (div n)/2,
        gaussian = det S = n.adj(A)n/|grad f|^2.

    A field that is summed over a tree, or a solid made of one, states the errors of its gradient
    and Hessian. If they make the mean curvature uncertain by more than a thousandth of itself, and
    by more than a thousandth of 1/(size of the surface), then clusters are expanded as a whole only
    from farther away; at the last, all terms are summed one by one. `mean_error` and
    `gaussian_error` bound the error that remains.

    Raises:
        NotImplementedError: the field has no second derivatives.
        TypeError: an option that curvatures do not have.
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers.
    """
    target, choices = surface_and_options("curvature", surface, options, keywords, ("precision",))
    field, backend = target.field, choose_backend(choices.precision or "double")
    # Most fields are evaluated inside a kernel. A `BatchedField` is evaluated by tree sums, for
    # many points at once.
    if not isinstance(field, BatchedField):
        evaluator = field.evaluator(backend)

        def from_field(p: Vec3, acceptance: Real) -> tuple[Real | Vec3, ...]:
            """Return the curvatures at p, from the gradient and Hessian that the field computes
            inside of a kernel (`_Derivatives.curvatures`).

            acceptance: the acceptance factor of a treecode, a number; the larger it is, the smaller
                the error.
            """
            refined = (
                evaluator
                if evaluator.variable_accuracy is None
                else evaluator.variable_accuracy.at(acceptance)
            )
            sample = refined.evaluate(p)
            errors = refined.derivative_errors(p, sample)
            rows = refined.hessian(p)
            return _Derivatives(backend, sample.gradient, rows, *errors).curvatures()

        return _refine_accuracy(
            backend, field, from_field, points, evaluator.variable_accuracy is not None
        )

    def from_tree(p: Vec3, acceptance: Real) -> tuple[Real | Vec3, ...]:
        """Return the curvatures at p, from the tree sums of a field that is evaluated in batches
        (`_Derivatives.curvatures`).

        acceptance: the acceptance factor of the treecode; the larger it is, the smaller the error.
        """
        # With derivatives up to the second.
        values = field.values_at(p, 2, acceptance)
        if values.gradient is None or values.hessian is None:
            raise RuntimeError(f"{type(field).__name__}: values_at(x, 2) gave no derivatives")
        rows = values.hessian.rows(backend.Array3f)
        derivatives = _Derivatives(
            backend, values.gradient, rows, values.gradient_error, values.hessian_error
        )
        return derivatives.curvatures()

    return _refine_accuracy(backend, field, from_tree, points, True)  # the treecode can refine


def _refine_accuracy(
    backend: Backend,
    field: Field,
    evaluate: Callable[[Vec3, Real], tuple[Real | Vec3, ...]],
    points: Any,
    can_refine: bool,
) -> CurvatureSamples:
    """Return the curvatures at points (n, 3). Where their error is too large, they are evaluated
    again with a more accurate treecode. Its accuracy depends on an acceptance factor
    (`_ACCEPTANCE_FACTORS`): the larger it is, the farther away a cluster of terms has to be to be
    expanded as a whole.

    evaluate: a function of points and an acceptance factor that returns the values of
        `_Derivatives.curvatures`.
    can_refine: whether the field's accuracy depends on that factor.

    A mean curvature is accurate enough if its error is at most a thousandth of it, or of 1/(size of
    the surface). Where the field has no truncation error, nothing is evaluated again.
    """

    def with_acceptance(acceptance: float) -> Callable[[Vec3], tuple[Real | Vec3, ...]]:
        """Return the function `evaluate` of the points alone, with this acceptance factor."""

        def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
            return evaluate(p, dr.opaque(backend.Float, acceptance))

        return compute

    *columns, is_truncated = in_batches(backend, with_acceptance(_ACCEPTANCE_FACTORS[0]), points)
    if not can_refine:
        return CurvatureSamples(*columns)
    x = np.asarray(points, np.float64)
    # The allowed error where the mean curvature itself is nearly 0.
    flat_error = _ACCURACY / _size(field, x)
    for acceptance in _ACCEPTANCE_FACTORS[1:]:
        # `columns` are the results of `_Derivatives.curvatures` but for the last one.
        mean, error = columns[0], columns[3]
        with np.errstate(invalid="ignore"):
            is_accurate = error <= np.maximum(_ACCURACY * np.abs(mean), flat_error)
        rows = np.flatnonzero(~is_accurate & (is_truncated > 0))
        if not rows.size:
            break
        # Only the rows whose error is too large are evaluated again.
        *refined, is_truncated[rows] = in_batches(backend, with_acceptance(acceptance), x[rows])
        for column, values in zip(columns, refined, strict=True):
            column[rows] = values
    return CurvatureSamples(*columns)


def _size(field: Field, points: FloatArray) -> float:
    """Return the size of a field's surface, a length: the diagonal of the box that is proved to
    contain it. If there is no finite box, it is the largest absolute coordinate of the points (n,
    3)."""
    volume = field.extent((field.default_level,))
    if volume is not None:
        lower, upper = volume.bounds()
        if np.isfinite([lower, upper]).all():
            return float(np.linalg.norm(upper - lower))
    return max(float(np.abs(points).max(initial=0.0)), 1e-30)


@dataclass(frozen=True)
class _Derivatives:
    """The first and second derivatives of a function f at points, as computed, with bounds of their
    errors.

    gradient: grad f.
    rows: the three rows of the Hessian.
    gradient_error: bound of the length of the gradient's error.
    hessian_error: bound of the spectral norm of the Hessian's error.
    """

    backend: Backend
    gradient: Vec3
    rows: tuple[Vec3, Vec3, Vec3]
    gradient_error: Real
    hessian_error: Real

    def curvatures(self) -> tuple[Real | Vec3, ...]:
        """Compute the curvatures of the level set. Returns the mean and the Gaussian curvature; the
        unit normal; bounds of the errors of both curvatures; and a number: 0 if the field states
        that its derivatives have no error at the point, otherwise 1.

        Bounds. Let g, A be the computed gradient and Hessian, G = |g|, n = g/G, (u, v) an
        orthonormal basis of the plane at right angles to n, and M = (u, v)^T A (u, v) with T = tr M
        and D = det M, so that the mean curvature is H = T/(2G) and the Gaussian K = D/G^2. A prime
        marks the same quantities of the true derivatives g', A'; |g' - g| <= c < G, and
        |A' - A| <= h in the spectral norm. Then G' >= G - c, and n' is at an angle t <= pi/2 to n
        with sin t <= c/G =: s. Let S = sqrt(2) |A - (tr A/3) 1|_F in the Frobenius norm; S is at
        least the range of A's eigenvalues, as (a-b)^2 <= 2 (a^2 + b^2).

        - T = tr A - n.An. nn^T - n'n'^T has the eigenvalues sin t, -sin t and 0, the first two with
          unit eigenvectors p, q: |n.An - n'.An'| = sin t |p.Ap - q.Aq| <= s S. The projection
          1 - n'n'^T has two eigenvalues 1: |tr((1 - n'n'^T)(A - A'))| <= 2 h. So |T - T'| <= s S +
          2 h, and as |1/G' - 1/G| <= c/(G (G - c)), |H - H'| <= ((s S + 2 h)/2 + |H| c)/(G - c).
        - Let the rotation R by the angle t take n to n'. M' is the matrix of R^T A' R in the basis
          (u, v), as its determinant does not depend on the basis. With m the middle of the range of
          A's eigenvalues,
          |A - R^T A R| = |(R - 1)(A - m) - (A - m)(R - 1)| <= 2 |R - 1| S/2, |R - 1| = 2 sin(t/2) =
          sin t sqrt(2/(1 + cos t)) <= s sqrt(2/(1 + sqrt(1 - s^2))) =: r. So E = M' - M is at most
          e := r S + h, and det(M + E) = det M + tr(adj(M) E) + det E differs from det M by at most
          e (|a| + |b|) + e^2, a and b the eigenvalues of M, |a| + |b| = max(|T|, |a - b|).
          With 1/G'^2 - 1/G^2 <= c (2G - c)/(G^2 (G - c)^2):
          |K - K'| <= (e (|a| + |b|) + e^2 + |K| c (2G - c))/(G - c)^2.

        The rounding of this arithmetic is the same as a change of g and A by a few epsilons of
        themselves, which are added to c and h.
        """
        real = self.backend.Float
        x, y, z = self.rows
        plane = TangentPlane.of(self.gradient)
        # The second derivatives of f along the tangents u and v of the plane.
        uu, vv, uv = plane.restrict_hessian(self.rows)
        inverse_norm = 1 / plane.gradient_norm
        mean = 0.5 * (uu + vv) * inverse_norm
        gaussian = (uu * inverse_norm) * (vv * inverse_norm) - (uv * inverse_norm) * (
            uv * inverse_norm
        )

        rounding = _ROUNDING * self.backend.machine_epsilon
        # The deviator is the Hessian less its mean diagonal; `deviator` is its Frobenius norm, and
        # `eigen_range` is S of the proof.
        mean_diagonal = (x.x + y.y + z.z) / 3
        off_diagonal = dr.square(x.y) + dr.square(x.z) + dr.square(y.z)
        diagonal = (
            dr.square(x.x - mean_diagonal)
            + dr.square(y.y - mean_diagonal)
            + dr.square(z.z - mean_diagonal)
        )
        deviator = dr.sqrt(diagonal + 2 * off_diagonal)
        hessian_norm = deviator + math.sqrt(3) * dr.abs(mean_diagonal)
        eigen_range = math.sqrt(2) * deviator + rounding * hessian_norm
        # c, h, s and e are those of the proof, with rounding.
        c = dr.fma(rounding, plane.gradient_norm, real(self.gradient_error))
        h = dr.fma(rounding, hessian_norm, real(self.hessian_error))
        min_norm = plane.gradient_norm - c
        is_known = (min_norm > 0) & dr.isfinite(mean) & dr.isfinite(gaussian)
        s = fmin(c * inverse_norm, real(1))
        mean_error = (0.5 * s * eigen_range + h + dr.abs(mean) * c) / min_norm
        e = dr.fma(s * dr.sqrt(2 / (1 + dr.sqrt(1 - s * s))), eigen_range, h)
        eigenvalue_sum = fmax(dr.abs(uu + vv), dr.sqrt(dr.square(uu - vv) + 4 * uv * uv))
        numerator = e * (eigenvalue_sum + e) + dr.abs(gaussian) * c * (2 * plane.gradient_norm - c)
        gaussian_error = numerator / (min_norm * min_norm)
        is_exact = (real(self.gradient_error) <= 0) & (real(self.hessian_error) <= 0)
        return (
            dr.select(is_known, mean, dr.nan),
            dr.select(is_known, gaussian, dr.nan),
            dr.select(is_known, plane.n, dr.nan),
            _or_infinite(is_known, mean_error),
            _or_infinite(is_known, gaussian_error),
            dr.select(is_exact, real(0), 1),
        )


def _or_infinite(is_known: Any, error: Real) -> Real:
    """Return an error bound rounded up, so that it stays a bound. It is infinite in lanes in which
    the bound is not known (the mask `is_known` is False) or not finite."""
    return dr.select(is_known & dr.isfinite(error), error * (1 + 1e-5), dr.inf)


# Lines of curvature.

Family = Literal["maximum", "minimum"]

# Newton steps that bring a seed to the surface.
_SEED_NEWTON_STEPS = 8
# A line ends where the two principal curvatures differ by less than this fraction of the larger
# absolute value: the principal directions are not known there, and at an umbilic all directions are
# principal.
_UMBILIC = 1e-3
# A line also ends where it turns in one step by more than the angle with this cosine, and where the
# step is longer than this fraction of the smallest radius of curvature: its continuation would
# depend on the step and not on the surface.
_MIN_STEP_COSINE, _MAX_STEP_PER_RADIUS = math.cos(math.radians(40)), 0.5
_MOST_STEPS = 100_000


@shows_keywords(*_HONORED_BY_LINES)
@no_derivatives
def curvature_lines(
    surface: Field | Surface,
    seeds: Any,
    *,
    step: float,
    length: float,
    family: Family = "maximum",
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> list[FloatArray]:
    """Trace the lines of curvature of a level set through seeds (n, 3). Returns n polylines (k, 3),
    each with a number k of its own. Lines of curvature are curves on the level set along which it
    bends most, or least.

    A line that comes back to its seed ends there, and its first point is its last.

    surface: a field, or a `Surface` of one level; lines end where its clip and section do, and a
        seed outside of these gives an empty line, (0, 3).
    seeds: points near the surface, from which Newton's method leads to it.
    step: the arc length of a step.
    length: the arc length to which a line is followed, on either side of its seed.
    family: "maximum" for lines along the direction of the larger principal curvature, "minimum" for
        lines along that of the smaller one. Curvatures have the signs that `curvature` gives them.
    options, keywords: as in `curvature`; beside a bare field also `level`, `clip` and `section`.

    The principal directions are the eigenvectors of the Hessian restricted to the tangent plane
    (`curvature` says why). An eigenvector has no sign: so each stage of a step (of the Runge-Kutta
    method of order four) takes the sign that agrees with the direction before it. The end of each
    step is O(step^5) away from the surface; one step of Newton's method along grad f brings it
    back.

    A line ends where the directions are not defined, as at umbilics, where both curvatures are the
    same; where the surface turns too fast for the step, as beside the curve of a solid angle; and
    after `length`. A seed that Newton's method does not bring to the surface gives an empty line.

    Raises:
        NotImplementedError: the field has no second derivatives.
        TypeError, ValueError: seeds that are not an (n, 3) array of finite numbers; a step or
            length that is not positive; an unknown family.
    """
    target, choices = surface_and_options(
        "curvature_lines", surface, options, keywords, _HONORED_BY_LINES
    )
    backend = choose_backend(choices.precision or "double")
    field, levels = target.field, list(target.level_values)
    if len(levels) > 1:
        raise ValueError(f"lines of curvature are of one level, not of {len(levels)}")
    if not is_one_of(family, get_args(Family)):
        names = ", ".join(f'"{name}"' for name in get_args(Family))
        hint = did_you_mean(family, get_args(Family))
        raise ValueError(f"unknown family {family!r}; choose one of {names}{hint}")
    step, length = as_positive(step, "step"), as_positive(length, "length")
    # Steps on either side of the seed.
    count = math.ceil(length / step)
    if count > _MOST_STEPS:
        raise ValueError(f"length/step asks for {count:,} steps: at most {_MOST_STEPS:,}")
    start = as_finite_vectors(seeds, "seeds")
    if not len(start):
        return []
    # Data, so that another level, step or family compiles no other kernel.
    largest = 1.0 if family == "maximum" else 0.0
    level, opaque_step, largest_factor = (
        dr.opaque(backend.Float, name) for name in (levels[0], step, largest)
    )
    tracer = _CurvatureLineTracer(
        backend, field.evaluator(backend), field.period, level, opaque_step, largest_factor
    )
    with dr.suspend_grad():
        halves = tracer.follow(start, count)
    return [
        _join_halves(ahead, behind, step, target.clip_volume)
        for ahead, behind in zip(*halves, strict=True)
    ]


@dataclass(frozen=True)
class _LineState:
    """The state of lines of curvature while they are followed on a surface, one line in each lane.
    A line of curvature is a curve along which the surface bends most, or least.

    x: the current point of the line, on the surface.
    direction: the unit principal direction at x, along which the line goes on.
    step_count: the number of steps so far.
    active: whether the line continues.
    """

    x: Vec3
    direction: Vec3
    step_count: Any
    active: Mask


@dataclass(frozen=True)
class _CurvatureLineTracer:
    """Follows lines of curvature on a level set of the field's function f: curves along which the
    surface bends most, or least. Their tangents are the principal directions, the directions of the
    larger or of the smaller principal curvature.

    evaluator: samples f.
    period: the period of f; None if f is real-valued.
    level: the value of f on the surface.
    step: the arc length of a step.
    largest: 1 for the lines along the direction of the larger principal curvature, 0 for those
        along the smaller one.
    """

    backend: Backend
    evaluator: Evaluator
    period: float | None
    level: Real
    step: Real
    largest: Real

    def follow(self, seeds: FloatArray, count: int) -> tuple[list[FloatArray], list[FloatArray]]:
        """Trace each line from its seed in both directions, by at most `count` steps each.

        seeds: (n, 3) points near the surface.

        Returns two lists of n polylines (k, 3), one for each direction; all begin at the seeds,
        moved onto the surface. A polyline is empty if its seed does not reach the surface, or has
        no principal direction.

        Lanes 0 to n - 1 follow one direction, and lanes n to 2n - 1 the other. The point of each
        lane after step i is stored at the place 2 n i + lane.
        """
        integer, vector, n = self.backend.UInt32, self.backend.Array3f, len(seeds)
        x = upload_vectors(self.backend, np.concatenate([seeds, seeds]))
        x = self._on_surface(x, _SEED_NEWTON_STEPS)
        direction, is_known = self._direction(x, None)  # there is no direction before
        lane = dr.arange(integer, 2 * n)
        # An eigenvector and its negative: the two directions from each seed.
        direction = dr.select(lane < n, direction, -direction)
        # The points of all lines after all steps.
        points = vector(*(dr.full(self.backend.Float, dr.nan, 2 * n * (count + 1)) for _ in "xyz"))
        dr.scatter(points, x, lane, is_known)
        dr.eval(points, x, direction, is_known)
        max_steps = dr.opaque(integer, count)

        def body(state: _LineState) -> _LineState:
            """Advance all lines by a step, store their points, and return the new state."""
            x, direction, is_valid = self._advance(state)
            step_count = state.step_count + 1
            dr.scatter(points, x, step_count * (2 * n) + lane, state.active & is_valid)
            return _LineState(
                x, direction, step_count, state.active & is_valid & (step_count < max_steps)
            )

        no_steps = dr.zeros(integer, 2 * n)
        # (`& True` makes an array of its own for the loop.)
        loop_while_active(
            _LineState(x, direction, no_steps, is_known & True), body, "curvature lines"
        )
        point_array = to_numpy(points).reshape(count + 1, 2 * n, 3).astype(np.float64)
        # Places that were not written are NaN.
        lines = [line[np.isfinite(line).all(axis=1)] for line in point_array.swapaxes(0, 1)]
        return lines[:n], lines[n:]

    def _advance(self, state: _LineState) -> tuple[Vec3, Vec3, Mask]:
        """Follow all lines of curvature by one step of the Runge-Kutta method of order four, and
        move their points back to the surface. Returns the next points; the unit principal
        directions there; and the mask of lines that continue.

        A line ends where it turns by more than 40 degrees in a step, or has no principal direction.
        """
        x, h = state.x, self.step
        first = state.direction
        second, _ = self._direction(x + 0.5 * h * first, first)
        third, _ = self._direction(x + 0.5 * h * second, second)
        fourth, _ = self._direction(x + h * third, third)
        end = x + h / 6 * (first + 2 * (second + third) + fourth)
        end = self._on_surface(end, 1)  # one step of Newton's method
        last, is_known = self._direction(end, fourth)
        return end, last, is_known & (dr.dot(first, last) > _MIN_STEP_COSINE)

    def _direction(self, x: Vec3, previous: Vec3 | None) -> tuple[Vec3, Mask]:
        """Return the unit principal direction at x; and the mask of lanes in which the line can be
        continued there: the direction is well defined, and the step is short enough for the
        curvature.

        previous: the line's direction before. Of the two opposite directions the result is the one
            that makes an angle of at most 90 degrees with it. None: either of the two.
        """
        plane = TangentPlane.of(self.evaluator.evaluate(x).gradient)
        eigen = SymmetricEigen2.of(*plane.restrict_hessian(self.evaluator.hessian(x)))
        # The eigenvector of the larger eigenvalue if `largest` is 1, of the smaller one if 0.
        u, v = eigen.combination(self.largest, 1 - self.largest)
        direction = u * plane.u + v * plane.v
        if previous is not None:
            direction = dr.select(dr.dot(direction, previous) < 0, -direction, direction)
        # Times |grad f|: the Hessian was not divided by it.
        max_curvature = fmax(dr.abs(eigen.largest), dr.abs(eigen.smallest))
        is_known = (eigen.largest - eigen.smallest > _UMBILIC * max_curvature) & dr.isfinite(
            dr.norm(direction)
        )
        return direction, is_known & (
            max_curvature * self.step < _MAX_STEP_PER_RADIUS * plane.gradient_norm
        )

    def _on_surface(self, x: Vec3, steps: int) -> Vec3:
        """Return the point to which `steps` steps of Newton's method along the gradient lead from
        x, toward the level set."""

        def step(x: Vec3) -> Vec3:
            """Make one Newton step from x."""
            sample = self.evaluator.evaluate(x)
            gap = sample.value - self.level
            # Of a periodic function, the level that is nearest in value counts.
            if self.period is not None:
                gap = gap - self.period * dr.round(gap / self.period)
            return x - gap / dr.squared_norm(sample.gradient) * sample.gradient

        return _iterate(step, x, steps, self.backend)


def _iterate(step: Callable[[Vec3], Vec3], x: Vec3, times: int, backend: Backend) -> Vec3:
    """Apply the function `step` to x `times` times, and return the result. It is a loop of the
    kernel, so that the compiled kernel contains the code of `step` only once."""
    if times == 1:
        return step(x)

    def body(k: Any, x: Vec3) -> tuple[Any, Vec3]:
        return k + 1, step(x)

    def is_active(k: Any, x: Vec3) -> Mask:
        del x
        return k < times

    start = (backend.UInt32(0), backend.Array3f(x))
    return dr.while_loop(start, is_active, body, label="to the surface")[1]


def _join_halves(
    ahead: FloatArray, behind: FloatArray, step: float, clip: Volume | None
) -> FloatArray:
    """Join the two halves of a line of curvature, which both begin at its seed, to one polyline (k,
    3).

    ahead, behind: (i, 3), (j, 3) the halves.
    step: the arc length of a step.
    clip: the volume at whose boundary the halves are cut; None for no cut.

    If `ahead` returns to the seed, the line is closed. Then the result is `ahead` up to the seed,
    which is also its last point. The line returns where a step passes the seed at a distance below
    a quarter of `step`, in about the direction of the first step.
    """
    if clip is not None:
        ahead, behind = (_until_exit(half, clip) for half in (ahead, behind))
    if len(ahead) > 3:
        # At this fraction of each step it is nearest to the seed.
        moves, to_seed = np.diff(ahead, axis=0), ahead[0] - ahead[:-1]
        # (1e-300 avoids a division by 0 for a step of length 0.)
        fraction = (moves * to_seed).sum(axis=1) / np.maximum((moves * moves).sum(axis=1), 1e-300)
        is_near_seed = np.linalg.norm(to_seed - fraction[:, None] * moves, axis=1) < 0.25 * step
        is_same_way = moves @ moves[0] > 0
        closing = np.flatnonzero(
            is_near_seed
            & (fraction > 0)
            & (fraction <= 1)
            & is_same_way
            & _after_second_step(len(moves))
        )
        if closing.size:
            return np.concatenate([ahead[: closing[0] + 1], ahead[:1]])
    # `behind` is reversed, without the seed, which `ahead` contains already.
    return np.concatenate([behind[:0:-1], ahead])


def _after_second_step(count: int) -> BoolArray:
    """Return a mask (count,) of the steps of a line that is False for the first two and True for
    all others. The first two are near the seed even if the line does not return to it."""
    return np.arange(count) > 1


def _until_exit(line: FloatArray, clip: Volume) -> FloatArray:
    """Return the points (k, 3) of a line before the first that is outside the clip volume."""
    outside = np.flatnonzero(~clip.contains_points(line)) if len(line) else np.zeros(0, int)
    return line[: outside[0]] if outside.size else line
