"""Names and mappings that stand for functions with branches."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
import numbers
from typing import Any, cast

from harnack.backend import choose_backend
from harnack.fields.plane.branches import (
    ArcSine,
    Branches,
    BranchPoint,
    Logarithm,
    OwnBranches,
    PowerProduct,
    complex_type,
)
from harnack.names import did_you_mean

__all__ = ["branches_of", "power_product"]

_NAMES = ("log", "sqrt", "cbrt", "power", "asin")
# Exponents are fractions with denominators up to this: so many sheets can still be told apart.
_MOST_SHEETS = 24
_LARGEST = 6
# A point at which a function of one's own is tried.
_PROBE = 0.31, 0.17


def branches_of(
    function: Any,
    *,
    exponent: Any = None,
    of: Mapping[complex, int] | None = None,
    singular: Iterable[Any] | None = None,
    second: Callable[[Any, Any], Any] | None = None,
    period: float | None = None,
) -> Branches:
    """The branches of what a user names: see `RiemannSurface`.

    Raises:
        TypeError, ValueError: settings that do not belong together, or that are no such function.
    """
    own = {"singular": singular, "second": second, "period": period}
    if callable(function):
        _refuse("a function of your own", exponent=exponent, of=of)
        return _own(function, singular, second, period)
    _refuse("a function that is named; only one of your own has them", **own)
    if isinstance(function, Mapping):
        _refuse("a mapping of exponents", exponent=exponent, of=of)
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
        _refuse(f'"{function}"; use "power"', exponent=exponent)
    if function == "asin":
        _refuse('"asin"', of=of)
        return ArcSine()
    inner = {complex(a): _whole(n) for a, n in ({0: 1} if of is None else of).items()}
    if function == "log":
        if not inner:
            raise ValueError("of: give at least one zero or pole, such as {1: 1, -1: -1}")
        return Logarithm(tuple(inner), tuple(inner.values()))
    power = {"sqrt": Fraction(1, 2), "cbrt": Fraction(1, 3)}.get(function)
    power = _fraction(exponent) if power is None else power
    return power_product({a: n * power for a, n in inner.items()})


def power_product(exponents: Mapping[complex, Any]) -> PowerProduct:
    """The product of (z - a)^alpha for a mapping {a: alpha}.

    Raises:
        TypeError, ValueError: no such mapping.
    """
    chosen: dict[complex, Fraction] = {}
    for a, alpha in exponents.items():
        place, power = complex(a), _fraction(alpha)
        if not (math.isfinite(place.real) and math.isfinite(place.imag)):
            raise ValueError(f"each zero or branch point must be finite, not {a!r}")
        if power != 0:
            chosen[place] = power
    if not chosen:
        raise ValueError("a product of powers needs at least one exponent other than 0")
    count = math.lcm(*(power.denominator for power in chosen.values()))
    if count > _MOST_SHEETS:
        raise ValueError(
            f"these exponents make {count} sheets, and no more than {_MOST_SHEETS} are drawn: take "
            "fractions with a smaller common denominator"
        )
    return PowerProduct(tuple(chosen), tuple(float(power) for power in chosen.values()), count)


def _fraction(value: Any) -> Fraction:
    """A number as the fraction with a small denominator that it is."""
    try:
        exact = Fraction(value)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"an exponent must be a rational number, not {value!r}") from None
    near = exact.limit_denominator(_MOST_SHEETS)
    if abs(near - exact) > Fraction(1, 10**12):
        raise ValueError(
            f"the exponent {value!r} is no fraction with a denominator up to {_MOST_SHEETS}: its "
            "function has too many sheets to be drawn, infinitely many if it is irrational; write "
            "Fraction(2, 3) for two thirds"
        )
    if not abs(near) <= _LARGEST:
        raise ValueError(f"exponents must be at most {_LARGEST} in size, not {value!r}")
    return near


def _whole(value: Any) -> int:
    number = _fraction(value)
    if number.denominator != 1 or number == 0:
        raise ValueError(f"of: multiplicities must be whole numbers other than 0, not {value!r}")
    return int(number)


def _own(function: Any, singular: Any, second: Any, period: Any) -> OwnBranches:
    if singular is None or second is None:
        raise ValueError(
            "a function of your own needs singular=, where it is not analytic, such as [0], "
            "and second=, a bound of |g''| on disks, such as lambda z, r: 2.0"
        )
    if not callable(second):
        raise TypeError(f"second must be a function of z and a radius, not {second!r}")
    try:
        points = tuple(
            one if isinstance(one, BranchPoint) else BranchPoint(one) for one in singular
        )
    except TypeError:
        raise TypeError(
            f"singular must be complex numbers or BranchPoints, not {singular!r}"
        ) from None
    if period is not None and not (isinstance(period, numbers.Real) and 0 < float(period) < math.inf):
        raise ValueError(f"period must be a positive number, not {period!r}")
    backend = choose_backend("double")
    z = complex_type(backend)(*(backend.Float(one) for one in _PROBE))
    wrong = "the function must return its branches, each as (g, g') or (g, g', g''), not"
    try:
        branches = [tuple(one) for one in function(z)]
    except TypeError as error:
        raise TypeError(f"{wrong} what it does ({error})") from None
    if not branches or any(len(one) not in (2, 3) for one in branches):
        raise ValueError(f"{wrong} {branches!r}")
    for one in (number for branch in branches for number in branch):
        if not isinstance(one, type(z) | backend.Float | int | float | complex):
            raise TypeError(f"{wrong} with {one!r}: use operators, drjit.sqrt, drjit.log and so on")
    if period is not None and len(branches) > 1:
        raise ValueError(
            "a function with a period must have one branch up to it: of several, no side of the "
            "surface is told from the other in general; draw each by itself"
        )
    bound = _tried(second, z, backend.Float(_PROBE[1]))
    if not isinstance(bound, backend.Float | int | float):
        raise TypeError(f"second must return a real number, the bound of |g''|, not {bound!r}")
    shift = None if period is None else float(period)
    made = OwnBranches(function, points, second, len(branches), shift)
    made.at(z)
    return made


def _tried(second: Callable[[Any, Any], Any], z: Any, radius: Any) -> Any:
    try:
        return second(z, radius)
    except TypeError as error:
        raise TypeError(f"second must take z and a radius, as Dr.Jit numbers: {error}") from error


def _refuse(what: str, **settings: Any) -> None:
    given = [name for name, value in settings.items() if value is not None]
    if given:
        raise ValueError(f"{' and '.join(given)} cannot be given for {what}")
