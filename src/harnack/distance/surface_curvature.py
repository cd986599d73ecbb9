"""Curvature of level sets from first and second derivatives, and lines of curvature."""

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
    from harnack.fields.field import Field
    from harnack.geometry import Volume
    from harnack.tracer import Surface, TraceKeywords, TraceOptions

__all__ = ["CurvatureSamples", "Family", "curvature", "curvature_lines"]

_HONORED_BY_LINES = ("level", "clip", "section", "precision")
# The error of a mean curvature that is good enough: this share of it, or of one over the size of
# the surface where that is more.
_ACCURACY = 1e-3
# Acceptance factors of the multipole expansions, tried in turn until the error is small enough: a
# cluster is expanded only if it is this many times farther away than usual; with infinity every
# term is summed directly.
_ACCEPTANCE_FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0, math.inf)
# The rounding errors of the arithmetic in this module, in epsilons of gradient and Hessian.
_ROUNDING = 16.0


@dataclass(frozen=True)
class CurvatureSamples:
    """Curvatures of the level sets through n points. NaN where the gradient is zero, so that there
    is no surface, and where the error of the gradient is not less than its length.

    mean: (n,) half the divergence of the normal, 1/length. Its sign is the normal's: a sphere of
        radius r has 1/r if f grows outward, -1/r if f grows inward.
    gaussian: (n,) product of the principal curvatures, 1/length^2; the same for f and -f.
    normal: (n, 3) grad f/|grad f|.
    mean_error, gaussian_error: (n,) proved bounds of how far `mean` and `gaussian` may be off;
        infinite where they are NaN, and where the field does not state the errors of its
        derivatives (`Field.derivative_errors`). The rounding of the coordinates in which a moved or
        bent field without a formula is evaluated is not included.
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
    """Mean and Gaussian curvature of the level sets of a field through points (n, 3).

    surface: a field, or a `Surface` whose levels, clip and section say where it is drawn: the
        curvature at a point is that of the level set through it, whatever its level.
    options: a `TraceOptions`, of which curvatures have `precision` alone; None is double precision.
    keywords: `precision`, in place of `options`.

    The derivative of n = grad f/|grad f| along a tangent u of the level set has the tangential
    part (A u)/|grad f|, A the Hessian; its component along n is zero, for |n| = 1. So with an
    orthonormal frame (u, v) of the tangent plane the shape operator is S = (u, v)^T A (u, v) /
    |grad f|, and

        mean = tr S/2 = (tr A - n.An)/(2 |grad f|) = (div n)/2,
        gaussian = det S = n.adj(A)n/|grad f|^2.

    Of a sum over a tree, and of a solid made of one, both derivatives have an error that the field
    states. Where it leaves the mean curvature uncertain by more than a thousandth of itself, or of
    one over the size of the surface, clusters are taken as a whole only from farther away, up to
    the sum of all terms one by one. What remains is in `mean_error` and `gaussian_error`.

    Raises:
        NotImplementedError: the field has no second derivatives.
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers.
    """
    target, choices = surface_and_options("curvature", surface, options, keywords, ("precision",))
    field, backend = target.field, choose_backend(choices.precision or "double")
    if not isinstance(field, BatchedField):
        prepared = field.prepare(backend)

        def directly(p: Vec3, closer: Real) -> tuple[Real | Vec3, ...]:
            closely = prepared.at_accuracy(closer) if prepared.has_variable_accuracy else prepared
            sample = closely.evaluate(p)
            errors = closely.derivative_errors(p, sample)
            rows = closely.hessian(p)
            return _Derivatives(backend, sample.gradient, rows, *errors).curvatures()

        return _refine_accuracy(backend, field, directly, points, prepared.has_variable_accuracy)

    def by_tree(p: Vec3, closer: Real) -> tuple[Real | Vec3, ...]:
        values = field.values_at(p, 2, closer)
        if values.gradient is None or values.hessian is None:
            raise RuntimeError(f"{type(field).__name__}: values_at(x, 2) gave no derivatives")
        rows = values.hessian.rows(backend.Array3f)
        derivatives = _Derivatives(
            backend, values.gradient, rows, values.gradient_error, values.hessian_error
        )
        return derivatives.curvatures()

    return _refine_accuracy(backend, field, by_tree, points, True)


def _refine_accuracy(
    backend: Backend,
    field: Field,
    computed: Callable[[Vec3, Real], tuple[Real | Vec3, ...]],
    points: Any,
    has_detail: bool,
) -> CurvatureSamples:
    """The curvatures; `computed` with higher accuracy where the error is too large, if the field
    `has_detail`."""

    def at(closer: float) -> Callable[[Vec3], tuple[Real | Vec3, ...]]:
        def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
            return computed(p, dr.opaque(backend.Float, closer))

        return compute

    *results, is_truncated = in_batches(backend, at(_ACCEPTANCE_FACTORS[0]), points)
    if not has_detail:
        return CurvatureSamples(*results)
    x = np.asarray(points, np.float64)
    flat = _ACCURACY / _size(field, x)
    for closer in _ACCEPTANCE_FACTORS[1:]:
        mean, error = results[0], results[3]
        with np.errstate(invalid="ignore"):
            is_accurate = error <= np.maximum(_ACCURACY * np.abs(mean), flat)
        rows = np.flatnonzero(~is_accurate & (is_truncated > 0))
        if not rows.size:
            break
        *refined, is_truncated[rows] = in_batches(backend, at(closer), x[rows])
        for values, replacement in zip(results, refined, strict=True):
            values[rows] = replacement
    return CurvatureSamples(*results)


def _size(field: Field, points: FloatArray) -> float:
    """The size of the surface: of the box that holds it, else the extent of the points."""
    volume = field.extent((field.default_level,))
    if volume is not None:
        lower, upper = volume.bounds()
        if np.isfinite([lower, upper]).all():
            return float(np.linalg.norm(upper - lower))
    return max(float(np.abs(points).max(initial=0.0)), 1e-30)


@dataclass(frozen=True)
class _Derivatives:
    """Gradient and rows of the Hessian, and bounds of their errors: of the length of one and the
    spectral norm of the other."""

    backend: Backend
    gradient: Vec3
    rows: tuple[Vec3, Vec3, Vec3]
    gradient_error: Real
    hessian_error: Real

    def curvatures(self) -> tuple[Real | Vec3, ...]:
        """Mean, Gaussian curvature and normal, the two errors, and 0 where the field states that
        its derivatives are exact, else 1.

        Bounds. Let g, A be the derivatives at hand, G = |g|, T = tr M and D = det M of the matrix
        M = (u, v)^T A (u, v), so that mean H = T/(2G) and Gaussian K = D/G^2. Let g', A' be the
        true ones, |g' - g| <= c < G and |A' - A| <= h in the spectral norm; T', D', .. theirs. Then
        G' >= G - c, and n' is at an angle t <= pi/2 to n with sin t <= c/G =: s. Let S be at least
        the range of A's eigenvalues: sqrt(2) |A - (tr A/3) 1|_F, as (a-b)^2 <= 2 (a^2 + b^2).

        - T = tr A - n.An. nn^T - n'n'^T has the eigenvalues sin t, -sin t and 0, the first two with
          unit eigenvectors p, q: |n.An - n'.An'| = sin t |p.Ap - q.Aq| <= s S. The projection
          1 - n'n'^T has two eigenvalues 1: |tr((1 - n'n'^T)(A - A'))| <= 2 h. So |T - T'| <= s S +
          2 h, and as |1/G' - 1/G| <= c/(G (G - c)), |H - H'| <= ((s S + 2 h)/2 + |H| c)/(G - c).
        - Let the rotation R by the angle t take n to n'. M' is that of R^T A' R in the same frame
          (its determinant does not depend on the frame). With m the middle of A's range,
          |A - R^T A R| = |(R - 1)(A - m) - (A - m)(R - 1)| <= 2 |R - 1| S/2, |R - 1| = 2 sin(t/2) =
          sin t sqrt(2/(1 + cos t)) <= s sqrt(2/(1 + sqrt(1 - s^2))) =: r. So E = M' - M is at most
          e := r S + h, and det(M + E) = det M + tr(adj(M) E) + det E differs from det M by at most
          e (|a| + |b|) + e^2, a and b the eigenvalues of M, |a| + |b| = max(|T|, |a - b|).
          With 1/G'^2 - 1/G^2 <= c (2G - c)/(G^2 (G - c)^2):
          |K - K'| <= (e (|a| + |b|) + e^2 + |K| c (2G - c))/(G - c)^2.

        The arithmetic here is that of derivatives changed by a few epsilons of themselves, which
        are added to c and h.
        """
        real = self.backend.Float
        x, y, z = self.rows
        plane = TangentPlane.of(self.gradient)
        uu, vv, uv = plane.restrict_hessian(self.rows)
        share = 1 / plane.gradient_norm
        mean = 0.5 * (uu + vv) * share
        gaussian = (uu * share) * (vv * share) - (uv * share) * (uv * share)

        rounding = _ROUNDING * self.backend.machine_epsilon
        third = (x.x + y.y + z.z) / 3
        off = dr.square(x.y) + dr.square(x.z) + dr.square(y.z)
        diagonal = dr.square(x.x - third) + dr.square(y.y - third) + dr.square(z.z - third)
        deviator = dr.sqrt(diagonal + 2 * off)
        size = deviator + math.sqrt(3) * dr.abs(third)
        wide = math.sqrt(2) * deviator + rounding * size
        c = dr.fma(rounding, plane.gradient_norm, real(self.gradient_error))
        h = dr.fma(rounding, size, real(self.hessian_error))
        left = plane.gradient_norm - c
        known = (left > 0) & dr.isfinite(mean) & dr.isfinite(gaussian)
        s = fmin(c * share, real(1))
        mean_error = (0.5 * s * wide + h + dr.abs(mean) * c) / left
        e = dr.fma(s * dr.sqrt(2 / (1 + dr.sqrt(1 - s * s))), wide, h)
        both = fmax(dr.abs(uu + vv), dr.sqrt(dr.square(uu - vv) + 4 * uv * uv))
        moved = e * (both + e) + dr.abs(gaussian) * c * (2 * plane.gradient_norm - c)
        gaussian_error = moved / (left * left)
        is_exact = (real(self.gradient_error) <= 0) & (real(self.hessian_error) <= 0)
        return (
            dr.select(known, mean, dr.nan),
            dr.select(known, gaussian, dr.nan),
            dr.select(known, plane.n, dr.nan),
            _or_infinite(known, mean_error),
            _or_infinite(known, gaussian_error),
            dr.select(is_exact, real(0), 1),
        )


def _or_infinite(known: Any, error: Real) -> Real:
    """Errors, rounded up; infinite where nothing is known."""
    return dr.select(known & dr.isfinite(error), error * (1 + 1e-5), dr.inf)


# Lines of curvature.

Family = Literal["maximum", "minimum"]

# Newton steps that bring a seed to the surface.
_SEED_NEWTON_STEPS = 8
# A line ends where the two principal curvatures differ by less than this part of their size: what
# direction is principal is not known there, and about an umbilic all are.
_UMBILIC = 1e-3
# It ends where it turns in one step by more than this angle (its cosine), and where a step is
# longer than this part of the least radius of curvature: what follows would be no line of the
# surface but the step's.
_MIN_STEP_COSINE, _MAX_STEP_PER_RADIUS = math.cos(math.radians(40)), 0.5
_MAX_STEPS = 100_000


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
    """The lines of curvature of a level set through seeds (n, 3): n polylines (k, 3), with k >= 1.

    They are curves on the level set along which it bends most, or least.

    A line that comes back to its seed ends there, and its first point is its last.

    surface: a field, or a `Surface` of one level; lines end where its clip and section do, and a
        seed outside of these gives an empty line, (0, 3).
    seeds: points near the surface, from which Newton's method leads to it.
    step: length of the steps, as a length of arc. length: how far to follow a line to either side.
    family: whether to follow the direction of the larger principal curvature or of the smaller; the
        sign of curvatures is that of `curvature`.
    options, keywords: as in `curvature`; beside a bare field also `level`, `clip` and `section`.

    With n = grad f/|grad f| and the Hessian A, the principal directions are the eigenvectors of A
    restricted to the tangent plane (`curvature` says why). They are lines without an arrow: each
    stage of a step (Runge and Kutta's of order four) takes the sign that agrees with the direction
    before it. One step of Newton's method along grad f brings the end of each step back to the
    surface, from which it is O(step^5) away.

    A line ends where the directions are not defined, as at umbilics, where both curvatures are the
    same; where the surface turns too fast for the step, as beside the curve of a solid angle; and
    after `length`. A seed whose first point is no point of a surface gives an empty line.

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
        known = ", ".join(f'"{name}"' for name in get_args(Family))
        hint = did_you_mean(family, get_args(Family))
        raise ValueError(f"unknown family {family!r}; choose one of {known}{hint}")
    step, length = as_positive(step, "step"), as_positive(length, "length")
    count = math.ceil(length / step)
    if count > _MAX_STEPS:
        raise ValueError(f"length/step asks for {count:,} steps: at most {_MAX_STEPS:,}")
    start = as_finite_vectors(seeds, "seeds")
    if not len(start):
        return []
    # Data, so that another level, step or family compiles no other kernel.
    wants_largest = 1.0 if family == "maximum" else 0.0
    at, h, largest = (
        dr.opaque(backend.Float, number) for number in (levels[0], step, wants_largest)
    )
    guide = _CurvatureLineTracer(backend, field.prepare(backend), at, h, largest)
    with dr.suspend_grad():
        both = guide.follow(start, count)
    return [
        _join_halves(ahead, back, step, target.clip_volume)
        for ahead, back in zip(*both, strict=True)
    ]


@dataclass(frozen=True)
class _LineState:
    """The points that lines have reached, their directions there, and which lines go on."""

    x: Vec3
    direction: Vec3
    index: Any
    active: Mask


@dataclass(frozen=True)
class _CurvatureLineTracer:
    """Follows the lines of one family: largest is 1 for the larger curvature, 0 for the smaller."""

    backend: Backend
    field: Field
    level: Real
    step: Real
    largest: Real

    def follow(self, seeds: FloatArray, count: int) -> tuple[list[FloatArray], list[FloatArray]]:
        """The points of each line to both sides of its seed, each from the seed on."""
        integer, vector, n = self.backend.UInt32, self.backend.Array3f, len(seeds)
        x = upload_vectors(self.backend, np.concatenate([seeds, seeds]))
        x = self._on_surface(x, _SEED_NEWTON_STEPS)
        direction, is_known = self._direction(x, None)
        lane = dr.arange(integer, 2 * n)
        direction = dr.select(lane < n, direction, -direction)
        points = vector(*(dr.full(self.backend.Float, dr.nan, 2 * n * (count + 1)) for _ in "xyz"))
        dr.scatter(points, x, lane, is_known)
        dr.eval(points, x, direction, is_known)
        last = dr.opaque(integer, count)

        def body(state: _LineState) -> _LineState:
            x, direction, goes_on = self._advance(state)
            index = state.index + 1
            dr.scatter(points, x, index * (2 * n) + lane, state.active & goes_on)
            return _LineState(x, direction, index, state.active & goes_on & (index < last))

        index = dr.zeros(integer, 2 * n)
        loop_while_active(_LineState(x, direction, index, is_known & True), body, "curvature lines")
        array = to_numpy(points).reshape(count + 1, 2 * n, 3).astype(np.float64)
        lines = [line[np.isfinite(line).all(axis=1)] for line in array.swapaxes(0, 1)]
        return lines[:n], lines[n:]

    def _advance(self, state: _LineState) -> tuple[Vec3, Vec3, Mask]:
        """The next point, the direction there, and whether it is a point of the line."""
        x, h = state.x, self.step
        first = state.direction
        second, _ = self._direction(x + 0.5 * h * first, first)
        third, _ = self._direction(x + 0.5 * h * second, second)
        fourth, _ = self._direction(x + h * third, third)
        end = x + h / 6 * (first + 2 * (second + third) + fourth)
        end = self._on_surface(end, 1)
        last, is_known = self._direction(end, fourth)
        return end, last, is_known & (dr.dot(first, last) > _MIN_STEP_COSINE)

    def _direction(self, x: Vec3, previous: Vec3 | None) -> tuple[Vec3, Mask]:
        """The principal direction that agrees with the previous one, and whether it is defined."""
        plane = TangentPlane.of(self.field.evaluate(x).gradient)
        eigen = SymmetricEigen2.of(*plane.restrict_hessian(self.field.hessian(x)))
        u, v = eigen.combination(self.largest, 1 - self.largest)
        direction = u * plane.u + v * plane.v
        if previous is not None:
            direction = dr.select(dr.dot(direction, previous) < 0, -direction, direction)
        max_curvature = fmax(dr.abs(eigen.largest), dr.abs(eigen.smallest))
        is_known = (eigen.largest - eigen.smallest > _UMBILIC * max_curvature) & dr.isfinite(
            dr.norm(direction)
        )
        return direction, is_known & (
            max_curvature * self.step < _MAX_STEP_PER_RADIUS * plane.gradient_norm
        )

    def _on_surface(self, x: Vec3, steps: int) -> Vec3:
        """The point to which Newton's method along the gradient leads in `steps` steps."""

        def step(x: Vec3) -> Vec3:
            sample = self.field.evaluate(x)
            gap = sample.value - self.level
            if self.field.period is not None:
                gap = gap - self.field.period * dr.round(gap / self.field.period)
            return x - gap / dr.squared_norm(sample.gradient) * sample.gradient

        return _iterate(step, x, steps, self.backend)


def _iterate(step: Callable[[Vec3], Vec3], x: Vec3, times: int, backend: Backend) -> Vec3:
    """The step repeated `times` times, recorded once."""
    if times == 1:
        return step(x)

    def body(k: Any, x: Vec3) -> tuple[Any, Vec3]:
        return k + 1, step(x)

    def more(k: Any, x: Vec3) -> Mask:
        del x
        return k < times

    start = (backend.UInt32(0), backend.Array3f(x))
    return dr.while_loop(start, more, body, label="to the surface")[1]


def _join_halves(
    ahead: FloatArray, back: FloatArray, step: float, clip: Volume | None
) -> FloatArray:
    """One line of its two halves, each cut where it first leaves the volume; of one that comes
    back to its seed, one turn, which ends in the seed."""
    if clip is not None:
        ahead, back = (_inside(half, clip) for half in (ahead, back))
    if len(ahead) > 3:
        # Passed within half a step, by a step that leads from one side of the seed to the other.
        moves, to_seed = np.diff(ahead, axis=0), ahead[0] - ahead[:-1]
        share = (moves * to_seed).sum(axis=1) / np.maximum((moves * moves).sum(axis=1), 1e-300)
        passing = np.linalg.norm(to_seed - share[:, None] * moves, axis=1) < 0.25 * step
        agrees = moves @ moves[0] > 0
        closed = np.flatnonzero(
            passing & (share > 0) & (share <= 1) & agrees & _after_second_step(len(moves))
        )
        if closed.size:
            return np.concatenate([ahead[: closed[0] + 1], ahead[:1]])
    return np.concatenate([back[:0:-1], ahead])


def _after_second_step(count: int) -> BoolArray:
    """Not one of the first two steps, which pass near the seed."""
    return np.arange(count) > 1


def _inside(line: FloatArray, clip: Volume) -> FloatArray:
    outside = np.flatnonzero(~clip.contains_points(line)) if len(line) else np.zeros(0, int)
    return line[: outside[0]] if outside.size else line
