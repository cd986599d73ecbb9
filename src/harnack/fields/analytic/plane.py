"""Functions of the plane: analytic functions g(z) of a complex variable z = x + i y that are chosen
by name, their level curves, and height fields. Such a function may have several values at a point,
its branches. If the part of g that is drawn, the real or the imaginary one, may be shifted by
multiples of a period, branches that differ by whole periods count as one. A singular point is one
where a branch is not analytic.

- `make_branches`: the `Branches` of a function given by name, by a mapping or by the user's code.
- `LevelCurves`: surfaces over the level curves of harmonic functions of the plane, which is Harnack
  tracing in two dimensions.
- `HeightField`: the graph of a formula over the plane.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic import Jet
from harnack.backend import backend_of, choose_backend, to_numpy, to_vector3
from harnack.backend.elementary import max_norm
from harnack.backend.validation import as_finite
from harnack.enclosures import HarmonicBall, TaylorRemainder
from harnack.enclosures.samples import Sample
from harnack.fields.analytic.branches import (
    ArcSine,
    Branches,
    BranchPoint,
    Disk,
    Logarithm,
    PowerProduct,
    UserBranches,
    complex_of,
    complex_type,
    derivatives,
)
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits
from harnack.fields.formula import Formula, probe_jets, warn_if_slow_to_compile
from harnack.fields.formula_evaluator import as_jet
from harnack.geometry.clip_volumes import Box, VolumeIntersection
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3
    from harnack.fields.analytic.branches import Branch, BranchEvaluator, Complex
    from harnack.geometry import Volume

__all__ = ["make_branches", "power_product"]

_NAMES = ("log", "sqrt", "cbrt", "power", "asin")
# The largest denominator of an exponent, which is the number of sheets: more sheets cannot be
# distinguished.
_MAX_BRANCHES = 24
# The largest exponent.
_MAX_EXPONENT = 6
# A point at which a user's function is evaluated as a test.
_PROBE = 0.31, 0.17


def make_branches(
    function: Any,
    *,
    exponent: Any = None,
    argument: Mapping[complex, int] | None = None,
    singular_points: Iterable[Any] | None = None,
    second_bound: Callable[[Any, Any], Any] | None = None,
    period: float | None = None,
) -> Branches:
    """Make the `Branches` of an analytic function g(z) that may have several values at a point.

    function: "log", "sqrt", "cbrt", "power" or "asin"; or a mapping {a_i: alpha_i}, for the product
        of (z - a_i)^alpha_i; or a callable that returns the branches at a point.
    exponent: only, and always, with "power": the rational exponent.
    argument: only with "log", "sqrt", "cbrt" and "power": a mapping {a_i: n_i} with integers n_i
        other than 0. The function is then applied to the product of (z - a_i)^n_i instead of to z.
    singular_points, second_bound, period: only with a callable; the first two are then needed.
        singular_points: the points where a branch is not analytic, as complex numbers or
        `BranchPoint`s. second_bound: a function of z and r that returns a bound of |g"| on the disk
        of radius r about z, for all branches. period: the period of the drawn part; None if it has
        none.

    Raises:
        TypeError, ValueError: a parameter is given that does not belong to this function, or is
            missing; or the function is invalid.
    """
    user_settings = {"singular": singular_points, "second": second_bound, "period": period}
    if callable(function):
        _refuse_settings("a function of your own", exponent=exponent, argument=argument)
        return _user_branches(function, singular_points, second_bound, period)
    _refuse_settings("a function that is named; only one of your own has them", **user_settings)
    if isinstance(function, Mapping):
        _refuse_settings("a mapping of exponents", exponent=exponent, argument=argument)
        return power_product(cast("Mapping[complex, Any]", function))
    if not isinstance(function, str):
        raise TypeError(
            f"function must be one of {', '.join(_NAMES)}, a mapping such as {{0: 0.5, 1: -0.5}}, "
            f"or a function that returns branches, not {function!r}"
        )
    if function not in _NAMES:
        raise ValueError(
            f"unknown function {function!r}; choose one of {', '.join(_NAMES)}"
            f"{did_you_mean(function, _NAMES)}"
        )
    if function == "power":
        if exponent is None:
            raise ValueError('"power" needs its exponent, such as exponent=2 / 3')
    else:
        _refuse_settings(f'"{function}"; use "power"', exponent=exponent)
    if function == "asin":
        _refuse_settings('"asin"', argument=argument)
        return ArcSine()
    multiplicities = {
        complex(a): _integer(n) for a, n in ({0: 1} if argument is None else argument).items()
    }
    if function == "log":
        if not multiplicities:
            raise ValueError("argument: give at least one zero or pole, such as {1: 1, -1: -1}")
        return Logarithm(tuple(multiplicities), tuple(multiplicities.values()))
    # A root or power of a product is the product of the powers of its factors.
    power = {"sqrt": Fraction(1, 2), "cbrt": Fraction(1, 3)}.get(function)
    power = _fraction(exponent) if power is None else power
    return power_product({a: n * power for a, n in multiplicities.items()})


def power_product(exponents: Mapping[complex, Any]) -> PowerProduct:
    """The product of (z - a)^alpha over the items a: alpha of the mapping. Items with exponent 0
    are left out.

    Raises:
        TypeError, ValueError: a point is not finite, an exponent is not a rational number with a
            small denominator, no exponent differs from 0, or there are more than 24 branches.
    """
    chosen: dict[complex, Fraction] = {}
    for a, alpha in exponents.items():
        point, power = complex(a), _fraction(alpha)
        if not (math.isfinite(point.real) and math.isfinite(point.imag)):
            raise ValueError(f"each zero or branch point must be finite, not {a!r}")
        if power != 0:
            chosen[point] = power
    if not chosen:
        raise ValueError("a product of powers needs at least one exponent other than 0")
    sheets = math.lcm(*(power.denominator for power in chosen.values()))
    if sheets > _MAX_BRANCHES:
        raise ValueError(
            f"these exponents make {sheets} sheets, and no more than {_MAX_BRANCHES} are drawn: "
            "take "
            "fractions with a smaller common denominator"
        )
    return PowerProduct(tuple(chosen), tuple(float(power) for power in chosen.values()), sheets)


def _fraction(value: Any) -> Fraction:
    """`value` as a fraction with a denominator of at most 24 (the largest number of branches) and
    an absolute value of at most 6.

    A float is rounded to such a fraction if that is within 1e-12.

    Raises:
        TypeError, ValueError: it is no such fraction.
    """
    try:
        exact = Fraction(value)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"an exponent must be a rational number, not {value!r}") from None
    fraction = exact.limit_denominator(_MAX_BRANCHES)
    if abs(fraction - exact) > Fraction(1, 10**12):
        raise ValueError(
            f"the exponent {value!r} is no fraction with a denominator up to {_MAX_BRANCHES}: its "
            "function has too many sheets to be drawn, infinitely many if it is irrational; write "
            "Fraction(2, 3) for two thirds"
        )
    if not abs(fraction) <= _MAX_EXPONENT:
        raise ValueError(f"exponents must be at most {_MAX_EXPONENT} in size, not {value!r}")
    return fraction


def _integer(value: Any) -> int:
    """`value` as an int, if it is an integer other than 0.

    Raises:
        TypeError, ValueError: for any other value.
    """
    number = _fraction(value)
    if number.denominator != 1 or number == 0:
        raise ValueError(
            f"argument: multiplicities must be whole numbers other than 0, not {value!r}"
        )
    return int(number)


def copied_arguments(**arguments: Any) -> dict[str, Any]:
    """Arguments of `make_branches` by name, with lists, mappings and arrays copied, so that a field
    can keep them."""

    def copied(value: Any) -> Any:
        """A copy of a list, a mapping or an array; the value itself otherwise."""
        if isinstance(value, Mapping):
            return dict(cast("Mapping[Any, Any]", value))
        if isinstance(value, np.ndarray):
            return cast("Any", value).copy()
        return tuple(cast("Any", value)) if isinstance(value, list | Iterator) else value

    return {name: copied(value) for name, value in arguments.items()}


def _user_branches(
    function: Any, singular_points: Any, second_bound: Any, period: Any
) -> UserBranches:
    """The `Branches` of a user's function, after all functions that the user gave have been called
    once as a test.

    function: a function of z that returns all branches at z, each as (g, g') or (g, g', g").
    singular_points: the points where a branch is not analytic, as complex numbers or
        `BranchPoint`s.
    second_bound: a function of z and r that returns a bound of |g"| on the disk of radius r about
        z.
    period: the period of the drawn part; None if it has none.

    Raises:
        TypeError, ValueError: a parameter is missing or invalid, or a function returns something
            else than it should.
    """
    if singular_points is None or second_bound is None:
        raise ValueError(
            "a function of your own needs singular_points=, where it is not analytic, such as [0], "
            "and second_bound=, a bound of |g''| on disks, such as lambda z, r: 2.0"
        )
    if not callable(second_bound):
        raise TypeError(f"second_bound must be a function of z and a radius, not {second_bound!r}")
    try:
        points = tuple(
            entry if isinstance(entry, BranchPoint) else BranchPoint(entry)
            for entry in singular_points
        )
    except TypeError:
        raise TypeError(
            f"singular_points must be complex numbers or BranchPoints, not {singular_points!r}"
        ) from None
    if period is not None and not (
        isinstance(period, numbers.Real) and 0 < float(period) < math.inf
    ):
        raise ValueError(f"period must be a positive number, not {period!r}")
    backend = choose_backend("double")
    z = complex_type(backend)(*(backend.Float(entry) for entry in _PROBE))
    message = "the function must return its branches, each as (g, g') or (g, g', g''), not"
    try:
        branches = [tuple(entry) for entry in function(z)]
    except TypeError as error:
        raise TypeError(f"{message} what it does ({error})") from None
    if not branches or any(len(entry) not in (2, 3) for entry in branches):
        raise ValueError(f"{message} {branches!r}")
    for entry in (number for branch in branches for number in branch):
        if not isinstance(entry, type(z) | backend.Float | int | float | complex):
            raise TypeError(
                f"{message} with {entry!r}: use operators, drjit.sqrt, drjit.log and so on"
            )
    if period is not None and len(branches) > 1:
        raise ValueError(
            "a function with a period must have one branch up to it: of several, no side of the "
            "surface is told from the other in general; draw each by itself"
        )
    bound = _try_bound(second_bound, z, backend.Float(_PROBE[1]))
    if not isinstance(bound, backend.Float | int | float):
        raise TypeError(
            f"second_bound must return a real number, the bound of |g''|, not {bound!r}"
        )
    shift = None if period is None else float(period)
    branches_of_user = UserBranches(function, points, second_bound, len(branches), shift)
    # Raises the errors that the recorded evaluation would raise.
    branches_of_user.on_backend(backend).evaluate(z)
    return branches_of_user


def _try_bound(second_bound: Callable[[Any, Any], Any], z: Any, radius: Any) -> Any:
    """The value of the user's second_bound(z, radius).

    Raises:
        TypeError: it cannot be called with a point and a radius.
    """
    try:
        return second_bound(z, radius)
    except TypeError as error:
        raise TypeError(
            f"second_bound must take z and a radius, as Dr.Jit numbers: {error}"
        ) from error


def _refuse_settings(context: str, **settings: Any) -> None:
    """Raise ValueError if a setting was given, that is, if one is not None.

    context: the kind of function that does not have these settings, for the message.
    """
    names = [name for name, value in settings.items() if value is not None]
    if names:
        raise ValueError(f"{' and '.join(names)} cannot be given for {context}")


# Radii of the disks on which the function is bounded, as fractions of the distance to the nearest
# singular point; and the largest such distance that is used.
_DISK_FRACTIONS = (0.4, 0.8)
_MAX_CLEARANCE = 1e6


class LevelCurves(Field):
    """The function f(x, y, z) = Re g(x + i y), or Im g(x + i y), with an analytic function g of a
    complex variable. f does not depend on z: its level sets stand upright on level curves of the
    plane. The singular points are the points of the plane where g is not analytic.

    function, exponent, argument, singular_points, second_bound, period: the analytic function g,
        given as for `RiemannSurface`. It must have a single branch, up to a period: for example
        {a_i: n_i} with integers n_i for a rational function, or "log" with argument={a_i: n_i} for
        the potential of charges n_i at a_i.
    part: "real" or "imag".
    level: the default level.
    domain: the volume in which f is drawn; by default the box |x|, |y| <= 2, |z| <= 1/4.

    Promises (proved bounds of f near a point). f is harmonic in the plane, so Harnack's inequality
    of dimension 2 holds in disks that contain no singular point. There |g"| is bounded
    (`BranchEvaluator.second_derivative_bound`), so f changes by at most |g'| r + max|g"| r^2/2 on a
    disk of radius r. Each disk gives two promises: this range, as a `HarmonicBall` of dimension 2,
    and the bound of second derivatives.

    Raises:
        TypeError, ValueError: an invalid function, or a function with several branches.
    """

    traits = Traits(is_global=True)

    def __init__(
        self,
        function: str | Mapping[complex, Any] | Callable[[Any], Any],
        part: str = "real",
        *,
        exponent: Any = None,
        argument: Mapping[complex, int] | None = None,
        singular_points: Iterable[Any] | None = None,
        second_bound: Callable[[Any, Any], Any] | None = None,
        period: float | None = None,
        level: float = 0.0,
        domain: Volume | None = None,
    ) -> None:
        """Check the arguments, which the class describes, and make the branches of the function."""
        if part not in ("imag", "real"):
            raise ValueError(f'part must be "real" or "imag", not {part!r}')
        self.part = part
        self._branch_arguments = copied_arguments(
            function=function,
            exponent=exponent,
            argument=argument,
            singular_points=singular_points,
            second_bound=second_bound,
            period=period,
        )
        self.branches: Branches = make_branches(**self._branch_arguments)
        if self.branches.count > 1:
            raise ValueError(
                f"level curves need a function with one branch, and this one has "
                f"{self.branches.count}: draw its Riemann surface, whose plane cuts they are"
            )
        self.domain = Box((-2.0, -2.0, -0.25), (2.0, 2.0, 0.25)) if domain is None else domain
        self.default_level = as_finite(level, "level")
        shift = self.branches.period(part == "imag")
        self.period = shift  # pyright: ignore[reportAttributeAccessIssue]

    def constructor_arguments(self) -> dict[str, Any]:
        """The arguments of the constructor by name, those of the function as they were given."""
        return {**super().constructor_arguments(), **self._branch_arguments}

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of f for any plan. Its numbers lie on the backend as data, not as literals:
        Dr.Jit then need not compile its code again for other numbers."""
        del plan
        return _LevelCurvesEvaluator(self.branches.on_backend(backend), self.part)


@dataclass(frozen=True, eq=False)
class _LevelCurvesEvaluator(Evaluator):
    """The evaluator of the function f of `LevelCurves`, which has the proofs, on a backend.

    branches: the analytic function g.
    part: the part of g that f is, "real" or "imag".
    """

    branches: BranchEvaluator
    part: str

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: value, gradient and bounds of f on two disks about p that contain no
        singular point. Each disk gives a range of f in a ball in which f is harmonic, and a bound
        of second derivatives; `LevelCurves` has their proof."""
        rounding, z, branch = self._at(p)
        slope_x, slope_y = derivatives(branch.first, self.part)
        vector = cast("Any", type(p))
        gradient = vector(slope_x, slope_y, 0 * slope_x)
        gradient_norm, error_units = dr.norm(gradient), self.branches.value_rounding(z, (branch,))
        clearance = self.branches.clearance(z)
        promises: list[TaylorRemainder | HarmonicBall] = []
        value = branch.value.imag if self.part == "imag" else branch.value.real
        for fraction in _DISK_FRACTIONS:
            radius = fraction * dr.minimum(clearance, _MAX_CLEARANCE)
            # (1e-4 and 1e-5 cover the rounding of the bounds.)
            second_bound = self.branches.second_derivative_bound(Disk(z, radius, rounding)) * (
                1 + 1e-4
            )
            # By Taylor's formula.
            change = (gradient_norm * radius + 0.5 * second_bound * radius * radius) * (1 + 1e-5)
            promises += [
                TaylorRemainder(second_bound, radius),
                HarmonicBall(radius, value - change, value + change, 2),  # 2: of the plane
            ]
        return Sample(value, gradient, tuple(promises), backend_of(p).machine_epsilon * error_units)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p. f is harmonic in the plane, so its trace is 0.

        Raises:
            NotImplementedError: the user's function does not return its second derivative.
        """
        _, _, branch = self._at(p)
        if branch.second is None:
            raise NotImplementedError(
                "this function comes without its second derivative: return (g, g', g'')"
            )
        xx, xy = derivatives(branch.second, self.part)
        zero, vector = 0 * p.x, cast("Any", type(p))
        return vector(xx, xy, zero), vector(xy, -xx, zero), vector(zero, zero, zero)

    def _at(self, p: Vec3) -> tuple[Real, Complex, Branch]:
        """Evaluate g at the projections of the points p to the complex plane.

        Returns a bound of the rounding error of the projection (a distance), the projection as a
        complex number, moved off singular points, and the only branch of g, with its derivatives,
        there.
        """
        rounding = 4 * backend_of(p).machine_epsilon * max_norm(p)
        z = self.branches.move_off_singularities(complex_of(p.x, p.y), rounding)
        # There is one branch only (other values of g differ from it by whole periods).
        return rounding, z, self.branches.evaluate(z)[0]


# The number of cells along each side of the grid on which a height field is bounded.
_CELLS = 32


def _unit_box() -> Volume:
    """The default domain of a height field: the box of all points with coordinates from -1 to 1."""
    return Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


@dataclass(frozen=True, eq=False)
class HeightField(Formula):
    """The surface z = u(x, y) over the plane, which is the level 0 of f = z - u(x, y). f is
    negative below the surface.

    function: u, written with plain operators and functions such as `harnack.math.sin` (see
        `expression`). It is called while Dr.Jit records code; numbers in it become literals of that
        code.
    domain: the volume in which the surface is drawn; by default the box of all points with
        coordinates from -1 to 1.

        hk.fields.HeightField(lambda x, y: 0.3 * hk.math.sin(3 * x) * hk.math.cos(3 * y))

    The second derivative of f along a ray depends on u only; steps are proved from its ranges. Rays
    are clipped to the range of u over the domain, which is proved on a grid of cells.

    Raises:
        TypeError: function cannot be called with two coordinates, or uses operations without
            ranges.
        ValueError: the domain is unbounded.
    """

    function: Callable[[Any, Any], Any]
    domain: Volume | None = field(default_factory=_unit_box)

    def __post_init__(self) -> None:
        """Check the function, by a call as a test, and that the domain is bounded."""
        if not callable(self.function):
            raise TypeError(f"function must be callable with x, y, not {self.function!r}")
        if self.domain is None or not np.isfinite(self.domain.bounds()).all():
            raise ValueError(
                "a height field needs a bounded domain, such as harnack.Ball() or "
                "harnack.Box((-1, -1, -1), (1, 1, 1))"
            )
        point = probe_jets()
        as_jet(self.formula(*point), point[0], "HeightField")
        warn_if_slow_to_compile(self)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return z - self.function(x, y)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """The part of the domain between the lowest and the highest height that the level sets can
        have over it; the whole domain if the heights are not bounded or exceed it.

        levels: the levels of f.
        """
        assert self.domain is not None
        lower, upper = self.domain.bounds()
        # At the level c of f = z - u the height is u + c.
        lowest, highest = self._heights(lower, upper)
        slack = 1e-6 * float(np.abs([lower, upper]).max())
        lowest, highest = lowest + min(levels) - slack, highest + max(levels) + slack
        if not (np.isfinite([lowest, highest]).all() and (lowest > lower[2] or highest < upper[2])):
            return self.domain
        bottom, top = max(lowest, lower[2] - slack), min(highest, upper[2] + slack)
        # No level set meets the domain, so that any volume contains them.
        if bottom >= top:
            return self.domain
        left, front = (float(coordinate) for coordinate in lower[:2])
        right, back = (float(coordinate) for coordinate in upper[:2])
        slab = Box((left - slack, front - slack, bottom), (right + slack, back + slack, top))
        return VolumeIntersection((self.domain, slab))

    def _heights(self, lower: FloatArray, upper: FloatArray) -> tuple[float, float]:
        """Proved bounds (lowest, highest) of the height u(x, y) over a box.

        lower, upper: (3,) the corners of the box; their z does not matter.

        The box is divided into 32 x 32 cells, and u is bounded, by interval arithmetic, on a square
        around each.
        """
        backend = choose_backend("double")
        size = (upper - lower)[:2] / _CELLS
        cell_positions = np.indices((_CELLS, _CELLS)).reshape(2, -1).T + 0.5
        centers = np.column_stack(
            [cell_positions * size + lower[:2], np.zeros(len(cell_positions))]
        )
        # The longer side, as the boxes of the jets are cubes.
        half_side = backend.Float(0.5 * float(size.max()) * (1 + 1e-9))
        # The ranges of x, y and z over a cube around each cell; only those of x and y are used.
        jets = Jet.over_ball(to_vector3(backend, centers, "points"), half_side)
        # `as_jet` makes a jet of a height that is a plain number.
        heights = as_jet(self.function(*jets[:2]), jets[0], "HeightField").value
        # The added 0 makes an array of a constant.
        lowest = to_numpy(0 * half_side + dr.min(heights.lower)).min()
        return float(lowest), float(to_numpy(0 * half_side + dr.max(heights.upper)).max())
