"""Functions of several numbers: maxima, minima, norms and blends (Hart 1996, appendix B). The
numbers are jets (ranges of a function and of its derivatives), numbers of the other arithmetics,
Dr.Jit and NumPy arrays or Python numbers, also of different kinds in one call. All ranges are
intervals that are proved to contain the values. Blends combine two signed distances, or functions
like these, into that of a union or intersection with a rounded edge. Indices denote derivatives:
x_i' or x_i,j."""

from __future__ import annotations

import functools
import itertools
import math
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic.functions import absolute, length_bound, power, sqrt_range
from harnack.arithmetic.functions import exp as exp_function
from harnack.arithmetic.functions import log as log_function
from harnack.arithmetic.interval import Interval
from harnack.arithmetic.jet import Jet, wronskian_range
from harnack.arithmetic.operators import FormulaNumber
from harnack.backend.elementary import fmax, fmin

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Real


def maximum(*values: Any) -> Any:
    """The largest of two or more numbers of any kind."""
    return _reduce_extremum("maximum", values)


def minimum(*values: Any) -> Any:
    """The smallest of two or more numbers of any kind."""
    return _reduce_extremum("minimum", values)


def _reduce_extremum(name: str, values: tuple[Any, ...]) -> Any:
    """The maximum or minimum of two or more numbers of any kind.

    name: "maximum" or "minimum".

    Raises:
        TypeError: there are fewer than two numbers.
    """
    if len(values) < 2:
        raise TypeError(f"{name} compares two numbers or more, and {len(values)} was given")
    whole = as_one_operation(name, values)
    if whole is not None:
        return whole
    if any(isinstance(value, FormulaNumber) for value in values):
        # Jets and their like first: their methods accept numbers of the other kinds.
        ordered = sorted(values, key=lambda value: not isinstance(value, FormulaNumber))
        return functools.reduce(lambda a, b: getattr(a, name)(b), ordered)
    array_function, plain_function = _EXTREMUM_FUNCTIONS[name]

    def plain(a: Any, b: Any) -> Any:
        """The maximum or minimum of two arrays or Python numbers."""
        is_array = any(dr.is_array_v(cast("Any", type(value))) for value in (a, b))
        return array_function(a, b) if is_array else plain_function(a, b)

    return functools.reduce(plain, values)


def as_one_operation(name: str, values: tuple[Any, ...], *literals: float) -> Any:
    """A function of several numbers as a single operation of their arithmetic
    (`FormulaNumber.of_several`); None if they have none."""
    number = next((value for value in values if isinstance(value, FormulaNumber)), None)
    return None if number is None else number.of_several(name, values, *literals)


_EXTREMUM_FUNCTIONS: dict[str, tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]] = {
    "maximum": (fmax, np.maximum),
    "minimum": (fmin, np.minimum),
}


def norm(*values: Any, p: float = 2.0) -> Any:
    """The p-norm (|x|^p + |y|^p + ...)^(1/p) of numbers of any kind.

    p: at least 1; 2 for the Euclidean length, `math.inf` for the largest absolute value.

    Proof of the ranges. Let N be the norm of functions x_i, and u_i = |x_i|/N <= 1. Then N' = sum_i
    sign(x_i) u_i^(p-1) x_i'. By Hoelder's and Minkowski's inequalities |N'| is at most the p-norm
    of the x_i'. And

        N'' = (p-1)/N (sum_i u_i^(p-2) x_i'^2 - N'^2) + sum_i sign(x_i) u_i^(p-1) x_i''.

    The first part is not negative, because N is a convex function of the x_i. At N = 0 the norm has
    a kink upwards, so the first part has no upper bound there. For p = 2 the first part is
    sum_(i<j) w_ij^2 / N^3 with w_ij = x_i x_j' - x_j x_i' (Lagrange's identity). Along straight
    lines w_ij' = x_i x_j'' - x_j x_i'' is 0, so the range of w_ij is narrowed from the start of the
    piece.

    Raises:
        TypeError: there are no numbers.
        ValueError: p is below 1, for which this is no norm and has no bounded derivative.
    """
    if not values:
        raise TypeError("norm needs a number or more")
    if dr.is_array_v(cast("Any", type(p))):
        return _norm_of_any_power(values, p)
    if not p >= 1.0:
        raise ValueError(f"the p of a norm must be at least 1, not {p!r}")
    if len(values) == 1 or math.isinf(p):
        sizes = [absolute(term) for term in values]
        return sizes[0] if len(sizes) == 1 else maximum(*sizes)
    if p == 1.0:
        return functools.reduce(lambda a, b: a + b, [absolute(term) for term in values])
    whole = as_one_operation("norm", values, p)
    if whole is not None:
        return whole
    jets = [term for term in values if isinstance(term, Jet)]
    # Another arithmetic than jets: the root of the sum of powers.
    if not jets and any(isinstance(term, FormulaNumber) for term in values):
        sizes = [term if p == 2.0 else absolute(term) for term in values]
        powers = [
            term.apply(power(p)) if isinstance(term, FormulaNumber) else term**p for term in sizes
        ]
        # A number whose operators accept numbers of the other kinds comes first.
        powers.sort(key=lambda term: not isinstance(term, FormulaNumber))
        total = functools.reduce(lambda a, b: a + b, powers)
        return total.norm_of_powers(p)
    if not jets:
        return _plain_norm(values, p)
    operands = [term if isinstance(term, Jet) else jets[0].coerce(term) for term in values]
    return _jet_norm(operands, p)


# Logarithms are taken of numbers that are at least this.
_SMALLEST = {dr.VarType.Float32: 1e-30, dr.VarType.Float64: 1e-200}


def _norm_of_any_power(values: tuple[Any, ...], p: Any) -> Any:
    """The p-norm, whose power p is a number of Dr.Jit with derivatives, by exp(p log |x|). The
    values are Dr.Jit or dual numbers."""
    smallest = _SMALLEST[dr.type_v(p)]

    def to_power(x: Any, exponent: Any) -> Any:
        """The power of a number x >= 0."""
        scaled = log_of(maximum(x, smallest)) * exponent
        return scaled.apply(exp_function) if isinstance(scaled, FormulaNumber) else dr.exp(scaled)

    def log_of(x: Any) -> Any:
        """The logarithm of a number x > 0."""
        return x.apply(log_function) if isinstance(x, FormulaNumber) else dr.log(x)

    powers = [to_power(absolute(x), p) for x in values]
    powers.sort(key=lambda x: not isinstance(x, FormulaNumber))
    return to_power(functools.reduce(lambda a, b: a + b, powers), 1 / p)


def _plain_norm(values: tuple[Any, ...], p: float) -> Any:
    """The p-norm of arrays and Python numbers, in a form whose derivative is finite if all numbers
    are 0."""
    if not any(dr.is_array_v(cast("Any", type(value))) for value in values):
        # NumPy: divided by the largest, so that no power overflows.
        sizes = np.array(np.broadcast_arrays(*(np.abs(value) for value in values)))
        largest = sizes.max(axis=0)
        scale = np.where(largest > 0, largest, 1.0)
        return scale * np.sum((sizes / scale) ** p, axis=0) ** (1 / p) * (largest > 0)
    # Dr.Jit: the root is taken of 1 where the sum is 0, since its derivative at 0 is infinite.
    if p == 2.0:
        power_sum = functools.reduce(lambda a, b: a + b, [value * value for value in values])
        positive = power_sum > 0
        return dr.select(positive, dr.sqrt(dr.select(positive, power_sum, 1)), 0)
    # Divided by the largest, so that no power overflows.
    largest = functools.reduce(lambda a, b: fmax(a, b), [dr.abs(value) for value in values])
    positive = largest > 0
    scale = dr.select(positive, dr.detach(largest), 1)
    ratios = [dr.abs(value) / scale for value in values]
    power_sum = functools.reduce(lambda a, b: a + b, [_plain_power(value, p) for value in ratios])
    return dr.select(positive, scale * dr.power(dr.select(positive, power_sum, 1), 1 / p), 0)


def _plain_power(x: Any, p: float) -> Any:
    """x^p for Dr.Jit arrays x >= 0, with the derivative 0 at x = 0."""
    return dr.select(x > 0, dr.power(dr.select(x > 0, x, 1), p), 0)


def _jet_norm(xs: list[Jet], p: float) -> Jet:
    """The p-norm N of the jets x_i (ranges of functions and of their derivatives), for 1 < p <
    infinity. `norm` has the proof of its ranges.

    In the code `inverse_norm` is the range of 1/N, `ratios` are the ranges of x_i/N, and `pulls`
    are those of sign(x_i) |x_i/N|^(p-1), the derivatives of N by the x_i.
    """
    # Any number of the backend, for the type of the others.
    number = next((f.value.lower for f in xs if not f.value.is_literal), None)
    number = xs[0].backend_number() if number is None else number
    values = [as_backend_interval(f.value, number) for f in xs]
    length = _norm_range(values, p)
    inverse_norm = _reciprocal_norm(length)
    ratios = [_clip_magnitude(f * inverse_norm, 1.0) for f in values]
    pulls = ratios if p == 2.0 else [_signed_power(f, p - 1) for f in ratios]
    indices = range(len(xs))
    # N' is the sum of pulls times x_i', and at most the norm of the x_i'.
    first = tuple(
        _clip_magnitude(
            _total([pulls[k] * xs[k].first_derivatives[i] for k in indices]),
            _slope_bound([f.first_derivatives[i] for f in xs], number, p),
        )
        for i in range(len(xs[0].first_derivatives))
    )
    second: list[Interval] = []
    for k, (i, j) in enumerate(xs[0].hessian_indices()):
        # The first part of N''.
        if p == 2.0:
            convex = _wronskian_term(xs, values, inverse_norm, i, j)
        else:
            convex = -(first[i] * first[j])
            for f, u in zip(xs, ratios, strict=True):
                # The first of the three ranges is that of the power itself.
                weight = power(p - 2).ranges(Interval(u.min_abs, u.max_abs))[0]
                convex = convex + weight * _product(f.first_derivatives[i], f.first_derivatives[j])
            convex = convex * inverse_norm * Interval.enclosing(p - 1, type(number))
        # Not negative, because N is convex.
        if i == j:
            convex = Interval(fmax(convex.lower, 0), convex.upper)
        second.append(
            convex + _total([u * x.second_derivatives[k] for u, x in zip(pulls, xs, strict=True)])
        )
    jet = Jet(length, first, tuple(second), piece_length=xs[0].piece_length)
    starts = [f.jet_at_start for f in xs]
    if any(f is None for f in starts):
        return jet
    return jet.narrowed_from_start(_jet_norm(cast("list[Jet]", starts), p), xs[0].piece_length)


def _wronskian_term(
    functions: list[Jet], values: list[Interval], inverse_norm: Interval, i: int, j: int
) -> Interval:
    """The range of the sum over pairs k < m of w_km,i w_km,j / N^3, where N is the Euclidean norm
    of functions x_k. It is the part of N's second derivative by the variables i and j that the
    first derivatives of the functions contribute (`norm` has the proof).

    w_km,i is the function x_k x_m,i - x_m x_k,i, where ",i" denotes the derivative by the variable
    i.

    functions: the functions x_k.
    values: the ranges of their values.
    inverse_norm: the range of 1/N.
    i, j: the two variables of the second derivative.
    """
    parts: list[Interval] = []
    for k, m in itertools.combinations(range(len(functions)), 2):
        pair = functions[k], functions[m], values[k], values[m]
        a = wronskian_range(*pair, i) * inverse_norm
        parts.append(a.square() if i == j else a * (wronskian_range(*pair, j) * inverse_norm))
    return _total(parts) * inverse_norm


def _norm_range(values: list[Interval], p: float) -> Interval:
    """The range of the p-norm of independent numbers, one in each of the intervals `values`."""
    smallest = [value.min_abs for value in values]
    low = length_bound(smallest, -1) if p == 2.0 else _norm_of_magnitudes(smallest, p).lower
    largest_of_smallest = functools.reduce(
        fmax, smallest
    )  # rounding and underflow cannot make it shorter
    return Interval(fmax(low, largest_of_smallest), _largest_norm(values, p))


def _largest_norm(values: list[Interval], p: float) -> Real:
    """The upper end of `_norm_range`."""
    largest = [value.max_abs for value in values]
    return length_bound(largest, 1) if p == 2.0 else _norm_of_magnitudes(largest, p).upper


def _slope_bound(slopes: list[Interval], number: Real, p: float) -> Real:
    """An upper bound of the p-norm of derivatives. If all but one are the constant 0, as those of
    coordinates by one of them, it is the size of that one. number: for the type of others."""
    others = [slope for slope in slopes if not slope.is_zero]
    if len(others) == 1 and others[0].is_literal:
        return others[0].max_abs
    return _largest_norm([as_backend_interval(slope, number) for slope in slopes], p)


def _norm_of_magnitudes(sizes: list[Any], p: float) -> Interval:
    """The p-norm of numbers >= 0, as an interval that contains the exact norm in spite of rounding.

    sizes: the numbers.
    """
    if p == 2.0:
        return sqrt_range(_total([Interval.point(size).square() for size in sizes]))
    largest = functools.reduce(lambda a, b: dr.select((a > b) | dr.isnan(a), a, b), sizes)
    tiny = float(dr.smallest(cast("Any", type(largest))))
    # Divided by the largest, so that no power overflows.
    inverse_largest = Interval.point(fmax(tiny, largest)).reciprocal()
    # Each gives three ranges; [0] is that of the function, without those of its derivatives.
    root_ranges, power_ranges = power(1 / p).ranges, power(p).ranges
    powers = [power_ranges(Interval.point(size) * inverse_largest)[0] for size in sizes]
    norm = root_ranges(_total(powers))[0] * Interval.point(largest)
    return Interval(
        dr.select(largest > tiny, norm.lower, 0), fmax(norm.upper, 0) + len(sizes) * tiny
    )


def _signed_power(x: Interval, q: float) -> Interval:
    """The range of sign(y) |y|^q for y in the interval x, q > 0. The function increases with y, so
    the range follows from the ends."""

    def at(v: Any) -> Interval:
        """An interval that contains sign(v) |v|^q in spite of rounding."""
        # The range of the power itself, without those of its derivatives.
        size = power(q).ranges(Interval.point(dr.abs(v)))[0]
        return Interval(
            dr.select(v >= 0, size.lower, -size.upper), dr.select(v >= 0, size.upper, -size.lower)
        )

    low = at(x.lower)
    return low if x.lower is x.upper else Interval(low.lower, at(x.upper).upper)


def _reciprocal_norm(length: Interval) -> Interval:
    """The range of 1/N for a norm N >= 0. Its upper end is infinite if N may be 0.

    length: the range of N.
    """
    inverse = length.reciprocal()
    from_upper = Interval.point(length.upper).reciprocal()
    return Interval(fmax(from_upper.lower, 0), inverse.upper)


def _clip_magnitude(x: Interval, bound: Real) -> Interval:
    """The interval x, clipped to the numbers whose absolute value is at most `bound`."""
    return Interval(fmax(x.lower, -bound), fmin(x.upper, bound))


def _product(a: Interval, b: Interval) -> Interval:
    """The range of the product of two numbers, one in each of the intervals a and b. If a and b are
    the same object, they stand for a single number, and the result is the range of its square."""
    return a.square() if a is b else a * b


def _total(parts: list[Interval]) -> Interval:
    """The range of the sum of numbers, one in each of the intervals."""
    return functools.reduce(lambda a, b: a + b, parts)


def as_backend_interval(x: Interval, like: Any) -> Interval:
    """The interval x with Dr.Jit numbers as its ends: if they are Python numbers, they are
    converted to the type of `like`."""
    if not x.is_literal:
        return x
    kind = cast("Any", type(like))
    low = kind(x.lower)
    return Interval(low, low if x.lower == x.upper else kind(x.upper))


def blend_union(a: Any, b: Any, radius: Any, power: float = 2.0) -> Any:
    """The function of a union with a rounded edge, from the functions a and b of two sets {a <= 0}
    and {b <= 0}. It is <= 0 in both sets, and also in a fillet along the inner edge at which their
    surfaces meet; the cross-section of the fillet is an arc of a superellipse.

    a, b: numbers of any kind, such as signed distances.
    radius: the blend changes the union where both a and b are less than this.
    power: at least 1. With 2 the edge is a circular arc if the surfaces meet at right angles;
        larger powers make it sharper.

    Let r be the radius, p the power, g_a = max(0, 1 - a/r), and g_b the same for b. Where a or b is
    less than r, the function is r (1 - |(g_a, g_b)|_p), with the p-norm (g_a^p + g_b^p)^(1/p). (In
    Hart 1996, equation 43, the p-th root is printed around the whole expression instead.) Where
    both are at least r, it is their minimum. It is continuous: where the smaller one is r, both
    formulas give r.

    Proof of its Lipschitz constant, for a and b with constants of at most 1. The gradient is
    u_a^(p-1) grad a + u_b^(p-1) grad b with u = g/|g|_p. By Hoelder's inequality u_a^(p-1) +
    u_b^(p-1) is at most 2^(1/p), with equality at a = b. So 2^(1/p) is a Lipschitz constant, which
    is attained where the gradients are equal. If they are orthogonal and p >= 2, it is 1. With two
    radii, as in Hart's paper, the function is not continuous at g = 0, and there is no constant at
    all.
    """
    whole = as_one_operation("blended union", (a, b, radius), power)
    if whole is not None:
        return whole
    jets = [operand for operand in (a, b) if isinstance(operand, Jet)]
    # Hessians are midpoints of ranges, which the rule for paths would leave open on one side.
    is_hessian = any(len(jet.second_derivatives) > 1 for jet in jets)
    if jets and power == 2.0 and not is_hessian:
        a, b, r = (jets[0].coerce(number) for number in (a, b, radius))
        return _jet_blend(a, b, r)
    g_a, g_b = (maximum(1.0 - operand / radius, 0.0) for operand in (a, b))
    near = (1.0 - norm(g_a, g_b, p=power)) * radius
    smaller = minimum(a, b)
    # Where the smaller one is at least r, `near` is r; elsewhere the second term is 0.
    blend = near + maximum(smaller - radius, 0.0)
    if not isinstance(smaller, Jet) or not isinstance(blend, Jet):
        return blend
    # Where only one of the two forms applies, the kinks of the other do not matter.
    excess = smaller - radius
    blend = near.select(excess.value.upper < 0, blend)
    return smaller.select(excess.value.lower > 0, blend)


def _jet_blend(a: Jet, b: Jet, radius: Jet) -> Jet:
    """The blended union of two jets (ranges of functions a and b and of their derivatives) with a
    circular edge of the given radius r, a constant.

    Proof. With p = r - a and q = r - b let phi be |(p, q)| of their positive parts if one of them
    is positive, and else max(p, q). The blend is F = r - phi. Over all unit vectors n with n_1, n_2
    >= 0, phi is the largest n . (p, q): where p or q is positive by Cauchy's inequality, and else
    at n = (1, 0) or (0, 1). So F is the least of the functions r - n . (p, q), whose derivatives
    are n_1 a' + n_2 b' and n_1 a'' + n_2 b''. At each point F has the slope of an n at which the
    largest is attained, and F'' is at most n_1 a'' + n_2 b'' there, kinks included.

    For p > 0 or q > 0, n is (p, q)/N for the positive parts of p and q and their norm N, and by
    Lagrange's identity

        F'' = n_1 a'' + n_2 b'' - (n_1 b' - n_2 a')^2 / N

    (where one of the parts is 0, as there F is a or b, and the last term is at most 0). F'' has no
    lower bound where N may be 0. n_1 grows with p and falls with q, so that its range follows from
    the ends of theirs. F grows with a and b, and so does the range of F.
    """
    number = next((f.value.lower for f in (a, b) if not f.value.is_literal), a.backend_number())
    x, y, r = (as_backend_interval(f.value, number) for f in (a, b, radius))
    p, q = r + -x, r + -y
    # The least and the largest of the positive parts.
    (p_low, p_high), (q_low, q_high) = (
        (fmax(entry.lower, 0), _positive_or_nan(entry.upper)) for entry in (p, q)
    )
    n_1, n_2 = _share(p_low, p_high, q_low, q_high), _share(q_low, q_high, p_low, p_high)
    smallest = _norm_of_magnitudes([p_low, q_low], 2.0)
    # Where only one of the parts is positive, F is a or b, and there is no last term.
    is_single = ((p_high <= 0) & (q_low > 0)) | ((q_high <= 0) & (p_low > 0))
    largest = Interval.point(fmax(smallest.lower, 0)).reciprocal().upper
    inverse = Interval(0 * number, dr.select(is_single, 0, largest))
    first = tuple(
        n_1 * u + n_2 * v for u, v in zip(a.first_derivatives, b.first_derivatives, strict=True)
    )
    bend = [
        n_1 * v + -(n_2 * u) for u, v in zip(a.first_derivatives, b.first_derivatives, strict=True)
    ]
    second = tuple(
        n_1 * a.second_derivatives[k]
        + n_2 * b.second_derivatives[k]
        + -((bend[i].square() if i == j else bend[i] * bend[j]) * inverse)
        for k, (i, j) in enumerate(a.hessian_indices())
    )
    value = Interval(
        _blend_of_numbers(x.lower, y.lower, r).lower, _blend_of_numbers(x.upper, y.upper, r).upper
    )
    jet = Jet(value, first, second, piece_length=a.piece_length)
    starts = [f.jet_at_start for f in (a, b, radius)]
    if not any(f is None for f in starts):
        jet = jet.narrowed_from_start(_jet_blend(*cast("list[Jet]", starts)), a.piece_length)
    # Where both are at least r, F is the smaller of them.
    is_far = (x.lower >= r.upper) & (y.lower >= r.upper)
    return a.minimum(b).select(is_far, jet)


def _positive_or_nan(x: Any) -> Any:
    """The larger of x and 0; NaN if x is."""
    return dr.select(x < 0, 0, x)


def _share(p_low: Any, p_high: Any, q_low: Any, q_high: Any) -> Interval:
    """The range of p/|(p, q)| for p in [p_low, p_high] and q in [q_low, q_high], numbers >= 0. If
    both may be 0, it may be any number from 0 to 1."""
    low = Interval.point(p_low) * _norm_of_magnitudes([p_low, q_high], 2.0).reciprocal()
    high = Interval.point(p_high) * _norm_of_magnitudes([p_high, q_low], 2.0).reciprocal()
    may_vanish = ~((p_low > 0) | (q_low > 0))
    none = ~((p_high > 0) | may_vanish)  # p is 0, and q is not
    upper = dr.select(none, 0, fmin(dr.select(may_vanish | dr.isnan(high.upper), 1, high.upper), 1))
    lower = dr.select(may_vanish | dr.isnan(low.lower), 0, fmax(low.lower, 0))
    return Interval(lower, upper)


def _blend_of_numbers(a: Any, b: Any, radius: Interval) -> Interval:
    """The blended union of two numbers, as an interval that contains it in spite of rounding."""
    p, q = radius + Interval.point(-a), radius + Interval.point(-b)
    low, high = (
        _norm_of_magnitudes([fmax(getattr(entry, end), 0) for entry in (p, q)], 2.0)
        for end in ("lower", "upper")
    )
    # Where both numbers are at least the radius, it is the smaller of the two.
    smaller = fmin(a, b)
    near = radius + -Interval(low.lower, high.upper)
    lower = dr.select(smaller >= radius.upper, smaller, fmin(near.lower, smaller))
    upper = dr.select(smaller >= radius.lower, fmax(smaller, near.upper), near.upper)
    # An end that is NaN stands for an infinite one.
    is_unknown = dr.isnan(a + b)
    return Interval(dr.select(is_unknown, -dr.inf, lower), dr.select(is_unknown, dr.inf, upper))


def blend_intersection(a: Any, b: Any, radius: Any, power: float = 2.0) -> Any:
    """The function of the intersection of the sets {a <= 0} and {b <= 0} with a rounded outer edge:
    minus the function of the blended union of the complements.

    a, b: numbers of any kind, such as signed distances.
    radius: the blend changes the intersection where both -a and -b are less than this.
    power: at least 1; larger powers make the edge sharper (`blend_union`).
    """
    whole = as_one_operation("blended intersection", (a, b, radius), power)
    return -blend_union(-a, -b, radius, power) if whole is None else whole


def orthogonal_intersection(*sides: Any) -> Any:
    """The signed distance from the set of points where all of the functions `sides` are <= 0.

    sides: signed distances whose gradients are at right angles to each other, such as those of
        planes at right angles.

    Proof. Outside of the set, the nearest point is found separately along each of the gradients. So
    the distance is the norm of the positive ones of these functions (Pythagoras); if a single one
    is positive, it is that one, the largest. Inside, the largest of the functions is minus the
    distance to the nearest boundary.
    """
    whole = as_one_operation("orthogonal intersection", sides)
    if whole is not None:
        return whole
    largest = maximum(*sides)
    outside = norm(*(maximum(side, 0.0) for side in sides))
    distance = outside + minimum(largest, 0.0)
    if not isinstance(distance, Jet):
        return distance
    # Outside of the set the minimum is 0.
    distance = outside.select(largest.value.lower > 0, distance)
    # Where no two sides can be positive, as on a face, the distance is the largest of them: the
    # kinks of the norm at 0 and of the minimum do not matter.
    highs = [side.value.upper if isinstance(side, Jet) else side for side in sides]
    second_largest = functools.reduce(
        fmax, [fmin(a, b) for a, b in itertools.combinations(highs, 2)]
    )
    is_finite = dr.isfinite(functools.reduce(lambda a, b: a + b, highs))
    return largest.select((second_largest < 0) & is_finite, distance)
