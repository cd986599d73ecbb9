"""Quaternion Julia sets as solids. The orbit of a quaternion q_0 is the sequence q_0, q_1 = q_0^2 +
c, q_2 = q_1^2 + c, ... with a constant c; its members are called iterates. The filled Julia set
consists of the points whose orbits stay bounded. It is drawn in a slice of the space of
quaternions, in which the fourth coordinate is constant. The function f of the solid is positive
outside; a Lipschitz constant of f on a ball about a point outside proves that the ball holds no
point of the set."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.elementary import clamp, fmax, fmin
from harnack.backend.validation import as_finite, as_integer_in_range
from harnack.enclosures import Lipschitz
from harnack.enclosures.samples import Sample
from harnack.fields.attached_numbers import with_attached_arguments
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.number_table import detached
from harnack.fields.solids.solid import Solid, ball_around

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.number_table import NumberReader
    from harnack.geometry import Volume

Quaternion = tuple[float, float, float, float]

# Radii of the balls on which a Lipschitz constant is computed, as fractions of the longest step
# that could be proved.
_RADIUS_FRACTIONS = (0.8, 0.6, 0.45, 0.3, 0.15)
# An iterate whose absolute value is above this number has escaped. Later iterates are not computed;
# their logarithms follow from this one.
_ESCAPED_NORM = {"single": 1e4, "double": 1e8}


@dataclass(frozen=True)
class Julia(Solid):
    """A filled quaternion Julia set: the points whose orbit q_0, q_1 = q_0^2 + c, q_2 = q_1^2 + c
    ... stays small for N iterations. f = 2^-N max(log(|q_N|/B), -1), where B is the escape radius:
    an orbit that has left the ball of radius B never returns. So f <= 0 on the set.

    c: the constant, four numbers; the real part comes first.
    iterations: N. More iterations show finer details, and the solid shrinks to the Julia set.
    fourth_coordinate: the position of the slice that is shown. The point (x, y, z) of space is the
        quaternion q_0 = x + y i + z j + fourth_coordinate k.

    B = (1 + sqrt(1 + 4 |c|))/2. If |q| > B, then |q^2 + c| >= |q|^2 - |c| > |q|: an orbit that
    leaves the ball of radius B never returns. So no orbit of the filled Julia set leaves it, and f
    <= 0 on the set, for any N.

    Proof of the Lipschitz constants. Consider all orbits that begin in a ball of radius r about a
    point, and let q_n be that of the point itself. The n-th iterates of these orbits are within e_n
    of q_n, where e_0 = r and e_(n+1) = 2 |q_n| e_n + e_n^2, since the squares of q and q + d differ
    by d q + q d + d^2. The derivative of an iterate by the starting point in any direction is at
    most d_n, where d_0 = 1 and d_(n+1) = 2 (|q_n| + e_n) d_n. So g_n = d_n/(|q_n| - e_n) is a bound
    of the derivative of the logarithm of the iterate's absolute value. A second bound is g_(n+1) <=
    2 g_n/(1 - |c|/m_n^2), as the derivative of q^2 in a direction in which q has the derivative q'
    is q q' + q' q, of a length of at most 2 |q| |q'|. Here m_n is a lower bound of the absolute
    values of the n-th iterates: the larger of |q_n| - e_n and m_(n-1)^2 - |c|. The smaller bound of
    the two is used. Then 2^-N g_N is a Lipschitz constant of f in the ball. So is 2^-N d_N
    exp(1)/B, since f is constant where the N-th iterate is smaller than B/exp(1). The sample of a
    point promises such constants for a few radii r. A ball with |q_n| - e_n > B for an n <= N
    contains no point of the solid. (The usual estimate |z| log|z| / (2 |z'|) is not a bound of the
    distance.)

    Rounding. q_n is computed with rounding. So e_(n+1) is increased by a bound of the rounding of
    one iteration, 8 machine epsilons times |q_n|^2 + |c|. For r = 0, e_n is then a bound of the
    rounding error of q_n.

    Early end. The iteration ends at an n < N if |q_n| is above a large number. Then f is taken as
    2^-n log|q_n| - 2^-N log B, with an error of at most 2^-n 2 |c|/|q_n|^2: each later iterate q_j
    adds 2^-(j+1) log|1 + c/q_j^2|, and these terms decrease. If m_n >= 2 B, later m_j at least
    double, and the product of all factors 1/(1 - |c|/m_j^2) from n on is at most exp(4 |c|/m_n^2).
    So 2^-n g_n times this number is a Lipschitz constant.
    """

    traits = dataclasses.replace(Solid.traits, differentiable_arguments=("c", "fourth_coordinate"))

    c: Quaternion = (-0.2, 0.8, 0.0, 0.0)
    iterations: int = 10
    fourth_coordinate: float = 0.0

    def __post_init__(self) -> None:
        """Check the arguments.

        Raises:
            ValueError: c is not four finite numbers of a length of at most 10, or another argument
                is out of range.
        """
        try:
            numbers = tuple(detached(self.c))
        except TypeError:
            numbers = ()
        if len(numbers) != 4:
            raise ValueError(f"c of a Julia set must be four numbers, not {self.c!r}")
        c = tuple(as_finite(part, "each part of c of a Julia set") for part in numbers)
        if not math.hypot(*c) <= 10.0:
            raise ValueError(f"c of a Julia set must be no longer than 10, not {self.c!r}")
        object.__setattr__(self, "c", c)
        count = as_integer_in_range(self.iterations, "the iterations of a Julia set", 1, 60)
        object.__setattr__(self, "iterations", count)
        object.__setattr__(
            self, "fourth_coordinate", as_finite(self.fourth_coordinate, "the slice of a Julia set")
        )

    def with_read_numbers(self, numbers: NumberReader) -> _AttachedJulia:
        """The same function of the numbers with their derivatives."""
        own = with_attached_arguments(self, ("c", "fourth_coordinate"), numbers)
        return _AttachedJulia(own.c, own.fourth_coordinate, self.iterations)

    @property
    def escape_radius(self) -> float:
        """The escape radius B: an orbit that has left the ball of this radius never returns."""
        return 0.5 + math.sqrt(0.25 + math.hypot(*self.c))

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A ball about the origin that contains all points where f <= level. None if `above`, as
        the points where f >= level are unbounded; and for a level so large that the ball's radius
        may overflow.

        Proof. Let |q_0| = B (1 + t), t > 0. As B^2 - |c| = B, induction gives |q_n| >= B (1 +
        (2B)^n t). Where f <= level, |q_N| <= B exp(2^N max(level, 0)), so (2B)^N t <= exp(2^N
        max(level, 0)) - 1. In the slice |q_0|^2 is the squared distance from the origin plus
        fourth_coordinate^2.
        """
        b, scaled = self.escape_radius, 2.0**self.iterations * level
        # In double precision exp overflows at about 709.
        if above or scaled > 600.0:
            return None
        # The largest possible t; then the largest |q_0|.
        excess = math.expm1(max(scaled, 0.0)) / (2.0 * b) ** self.iterations
        reach = b * (1.0 + excess)
        square = reach * reach - self.fourth_coordinate * self.fourth_coordinate
        return ball_around((0.0, 0.0, 0.0), math.sqrt(max(square, 0.0)))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of the set, with c, the fourth coordinate, |c| and B as kernel parameters
        of the backend (numbers that a compiled kernel reads when it runs)."""
        del plan
        numbers = self.c, self.fourth_coordinate, math.hypot(*self.c), self.escape_radius
        c, fourth_coordinate, size, radius = _kernel_parameters(backend, numbers)
        return _JuliaEvaluator(c, fourth_coordinate, size, radius, self.iterations)


@dataclass(frozen=True, eq=False)
class _AttachedJulia:
    """A Julia set whose numbers may have derivatives: c, fourth_coordinate and iterations as of
    `Julia`. Its function is known for Dr.Jit numbers alone, so that its gradient has no derivatives
    by c."""

    c: tuple[Any, ...]
    fourth_coordinate: Any
    iterations: int

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at (x, y, z)."""
        if not all(dr.is_array_v(type(v)) for v in (x, y, z)):
            raise TypeError("a Julia set has no formula")
        real = cast("Any", type(x))
        is_single = dr.type_v(real) == dr.VarType.Float32
        escape = _ESCAPED_NORM["single" if is_single else "double"]
        c, q = self.c, [x, y, z, 0 * x + self.fourth_coordinate]
        factor = 0 * dr.detach(x) + 1
        for _ in range(self.iterations):
            is_active = dr.detach(_squared_norm(q)) <= escape * escape
            across = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
            following = [q[0] * q[0] - across + c[0], *(2 * q[0] * q[i] + c[i] for i in (1, 2, 3))]
            q = [dr.select(is_active, a, b) for a, b in zip(following, q, strict=True)]
            factor = dr.select(is_active, 0.5 * factor, factor)
        # 0 * x turns Python numbers into arrays.
        bound = 0.5 + dr.sqrt(0.25 + dr.sqrt(_squared_norm([0 * x + part for part in c])))
        last, length = 2.0**-self.iterations, dr.sqrt(_squared_norm(q))
        is_floor = dr.detach(length) <= dr.detach(bound) * math.exp(-1.0)
        return dr.select(
            is_floor, -last, factor * dr.log(dr.select(is_floor, 1, length)) - last * dr.log(bound)
        )


@dataclass(frozen=True, eq=False)
class _JuliaEvaluator(Evaluator):
    """The evaluator of a `Julia` set.

    c: the four parts of the constant.
    fourth_coordinate: the position of the slice.
    size: |c|.
    escape_radius: B.
    iterations: N.
    """

    c: tuple[Real, Real, Real, Real]
    fourth_coordinate: Real
    size: Real
    escape_radius: Real
    iterations: int

    def evaluate(self, p: Vec3) -> Sample:
        """The sample of f at p. A first orbit gives f and its gradient, and so the longest step
        that could be proved. A second computation gives Lipschitz constants on balls about p, whose
        radii are fractions of that step. Where none is proved, the radius is 0."""
        zero = 0 * p.x
        # With the radius 0 alone; `steepest` is then a bound of |grad f| at p itself.
        value, gradient, error, (steepest,) = self._orbit(p, (zero,))
        # No step is longer than this, as the Lipschitz constant on a ball is at least that at its
        # center.
        longest = dr.abs(value) / steepest
        # Where |f|/|grad f| tells nothing, any length may be tried.
        longest = clamp(dr.select(dr.isfinite(longest), longest, 1), 1e-6, self.escape_radius)
        radii = tuple(longest * fraction for fraction in _RADIUS_FRACTIONS)
        constants = self._orbit(p, radii)[3]  # the bounds of |grad f|
        promises: list[Lipschitz] = []
        for radius, constant in zip(radii, constants, strict=True):
            is_proved = (constant >= 0) & (constant < dr.inf)
            promises.append(
                Lipschitz(dr.select(is_proved, constant, 0), dr.select(is_proved, radius, 0))
            )
        return Sample(value, gradient, tuple(promises), error)

    def _orbit(self, p: Vec3, radii: tuple[Real, ...]) -> tuple[Any, ...]:
        """Compute the orbit of p. Returns four results: f at p; its gradient; a bound of the error
        of f; and for each radius a bound of |grad f| on the ball of that radius about p.

        radii: of the balls. The first must be 0: it gives the rounding error of f.

        The docstring of `Julia` has the formulas, for all orbits that begin in the ball about p. In
        the code `size` is |c|, and b is B. For each radius, `change` holds e_n, a bound of how far
        the n-th iterates of these orbits are from q_n; `slopes` holds d_n, a bound of the
        derivatives of these iterates by the starting point; `min_q` holds m_n, a lower bound of
        their absolute values; and `rates` holds g_n, a bound of the derivatives of the logarithms
        of these. `jacobian` is that of q_n with respect to x, y and z. `rounded` is the bound of
        the rounding of one iteration.
        """
        c, size, b = self.c, self.size, self.escape_radius
        real = cast("Any", type(p.x))
        is_single = dr.type_v(real) == dr.VarType.Float32
        escape = _ESCAPED_NORM["single" if is_single else "double"]
        epsilon = 2 * float(dr.epsilon(real))  # the machine epsilon
        zero, ones = 0 * p.x, 0 * p.x + 1
        q = [p.x, p.y, p.z, zero + self.fourth_coordinate]
        jacobian = [ones, zero, zero, zero, ones, zero, zero, zero, ones, zero, zero, zero]
        change = [zero + r for r in radii]
        slopes = [ones for _ in radii]
        start = dr.sqrt(_squared_norm(q))
        min_q = [fmax(start * (1 - 4 * epsilon) - r, 0) for r in change]
        rates = [1 / m for m in min_q]

        def iterate(n: Any, *state: Any) -> tuple[Any, ...]:
            """The state of the loop after one more iteration.

            The state consists of the number n of iterations; the four components of q_n; the 12
            entries of its Jacobian with respect to x, y and z, row by row; and four bounds for each
            radius, `change`, `slopes`, `min_q` and `rates`, which `_orbit` explains.
            """
            q, jacobian = list(state[:4]), state[4:16]
            change, slopes, min_q, rates = _split_in_four(state[16:])
            next_jacobian: list[Any] = [None] * 12
            for k in range(3):
                # Column k of the Jacobian: a is the real part of the derivative of q_n, v the other
                # three. The derivative of q^2 follows from the formula of `next_q`.
                a, *v = (jacobian[3 * i + k] for i in range(4))
                next_jacobian[k] = 2 * (q[0] * a - (q[1] * v[0] + q[2] * v[1] + q[3] * v[2]))
                for i in range(3):
                    next_jacobian[3 * (i + 1) + k] = 2 * (q[0] * v[i] + q[i + 1] * a)
            square = _squared_norm(q)
            norm = dr.sqrt(square) * (1 + 4 * epsilon)
            # The error of each component of q^2 + c is a few roundings of |q|^2 + |c|.
            rounded = 8 * epsilon * (square + size)
            across = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
            next_q = [q[0] * q[0] - across + c[0], *(2 * q[0] * q[i] + c[i] for i in (1, 2, 3))]
            next_change = [(2 * norm * e + e * e) * (1 + 8 * epsilon) + rounded for e in change]
            next_slopes = [
                2 * (norm + e) * d * (1 + 8 * epsilon) for e, d in zip(change, slopes, strict=True)
            ]
            next_norm = dr.sqrt(_squared_norm(next_q)) * (1 - 4 * epsilon)
            # The bounds m_n and g_n: the better of the two bounds of each.
            next_min_q: list[Real] = []
            next_rates: list[Real] = []
            for e, d, m, rate in zip(next_change, next_slopes, min_q, rates, strict=True):
                next_m = m * m * (1 - 4 * epsilon) - size
                factor = 1 - size / (m * m) * (1 + 4 * epsilon)
                by_rate = dr.select(factor > 0, 2 * rate / factor * (1 + 4 * epsilon), dr.inf)
                next_min_q.append(fmax(fmax(next_norm - e, 0), next_m))
                next_rates.append(fmin(by_rate, d / fmax(next_norm - e, 0) * (1 + epsilon)))
            return (
                n + 1,
                *next_q,
                *next_jacobian,
                *next_change,
                *next_slopes,
                *next_min_q,
                *next_rates,
            )

        def is_active(n: Any, *state: Any) -> Any:
            """A mask of the lanes on which iterations are left and the orbit has not escaped. n,
            state: as in `iterate`."""
            return (n < self.iterations) & (_squared_norm(state[:4]) <= escape * escape)

        index = dr.uint32_array_t(real)
        begin = (dr.zeros(index, dr.width(p)), *q, *jacobian, *change, *slopes, *min_q, *rates)
        n, *state = dr.while_loop(begin, is_active, iterate, label="quaternion Julia set")
        q, jacobian = state[:4], state[4:16]
        change, slopes, min_q, rates = _split_in_four(state[16:])
        square = _squared_norm(q)
        norm = dr.sqrt(square)
        # 2^-n, where n is the number of iterations that were done on the lane, rounded up.
        factor = dr.exp2(-real(n)) * (1 + 4 * epsilon)
        is_complete = n >= self.iterations
        last = 2.0**-self.iterations
        offset = last * dr.log(b)
        # Where log(|q_N|/B) < -1, f is constant, -2^-N. (An orbit that ended early is far outside
        # of that.)
        is_floor = norm <= b * math.exp(-1.0)
        value = dr.select(is_floor, -last, factor * dr.log(norm) - offset)
        # The gradient of log|q| is q/|q|^2, times the Jacobian.
        scale = dr.select(is_floor, 0, factor / square)
        gradient = type(p)(
            *(scale * sum(q[i] * jacobian[3 * i + k] for i in range(4)) for k in range(3))
        )
        cut = b * (math.exp(-1.0) * (1 - 1e-6))  # f is constant where |q_N| is smaller
        constants: list[Real] = []
        for e, d, m, rate in zip(change, slopes, min_q, rates, strict=True):
            # If all N iterations were done, g_N or d_N exp(1)/B; if the orbit escaped, the bound of
            # the early end.
            at_end = fmin(rate, d / fmax(norm * (1 - 4 * epsilon) - e, cut))
            escaped = dr.select(m >= 2 * b, rate * dr.exp(4 * size / (m * m)), dr.inf)
            constants.append(factor * dr.select(is_complete, at_end, escaped) * (1 + 8 * epsilon))
        # The error of logarithms is a few roundings of their size, or of 1.
        rounding = 16 * epsilon * (factor * (dr.abs(dr.log(norm)) + 1) + dr.abs(offset))
        # The error of leaving out later iterates. Then the effect of the error of q_n: `change[0]`
        # is e_n for the radius 0, and the derivative of log|q| is 1/|q|.
        rounding += dr.select(is_complete, 0, factor * 2 * size / square)
        error = factor * change[0] / fmax(norm - change[0], cut)
        return value, gradient, error + rounding, constants


def _split_in_four(state: Any) -> tuple[Any, Any, Any, Any]:
    """A sequence, cut into four parts of the same length."""
    k = len(state) // 4
    return state[:k], state[k : 2 * k], state[2 * k : 3 * k], state[3 * k :]


def _kernel_parameters(backend: Backend, value: Any) -> Any:
    """A number, or nested tuples of numbers, as kernel parameters of a backend (numbers that a
    compiled kernel reads when it runs)."""
    if isinstance(value, tuple):
        return tuple(_kernel_parameters(backend, part) for part in cast("tuple[Any, ...]", value))
    return dr.opaque(backend.Float, float(value))


def _squared_norm(q: Any) -> Any:
    """The squared absolute value of a quaternion, given by its four components."""
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
