"""Boxes, superellipsoids and supertori, and shapes grown by a distance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from harnack.arithmetic import minimum, norm
from harnack.arithmetic.blends import corner
from harnack.backend.numbers import finite, positive, triple
from harnack.fields.formula import prepared_numbers
from harnack.fields.solids.solid import Point, Shape, box_around, set_checked

if TYPE_CHECKING:
    from harnack.backend import Backend
    from harnack.fields.field import Field
    from harnack.geometry import Volume


@dataclass(frozen=True)
class Cuboid(Shape):
    """The box |x| <= a, |y| <= b, |z| <= c of half sides (a, b, c), its edges rounded by `radius`.

    The signed distance: that of the box smaller by the radius (`corner`), less the radius.
    """

    is_convex = True

    half_sides: Point = (1.0, 1.0, 1.0)
    radius: float = 0.0

    lipschitz = 1.0

    def __post_init__(self) -> None:
        sides = triple(self.half_sides, "the half sides of a box", all_positive=True)
        set_checked(self, "half_sides", sides)
        radius = finite(self.radius, "the radius of the edges of a box")
        if not 0.0 <= radius <= min(sides):
            raise ValueError(
                "the radius of the edges of a box must be between 0 and its least half side "
                f"{min(sides):g}, not {self.radius!r}"
            )
        set_checked(self, "radius", radius)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        sides = (
            abs(v) - (a - self.radius) for v, a in zip((x, y, z), self.half_sides, strict=True)
        )
        return corner(*sides) - self.radius

    def hull(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if above:
            return None
        a, b, c = (one + level for one in self.half_sides)
        return box_around((a, b, c))


def lipschitz_of_norms(p: float, q: float) -> float:
    """The Lipschitz constant of | (|(x, y)|_p, z) |_q, p, q >= 1.

    Hart (1996, equation 31) prints one that is right only for p = q < 2 or p, q >= 2. Proof. The
    gradient has the parts u^(q-1) grad |(x, y)|_p and v^(q-1), where (u, v) has the q-norm 1. The
    gradient of the p-norm has the dual norm 1, so its length is at most c = 2^max(0, 1/p - 1/2).
    So the square of the length is at most c^2 u^(2q-2) + v^(2q-2). For q >= 2 both powers are at
    most u^q and v^q, whose sum is 1: it is at most c^2, for c >= 1. For q < 2, Hoelder's inequality
    with the exponents q/(2q-2) and q/(2-q) gives (c^m + 1)^(2/m) with m = 2q/(2-q). All are
    attained.
    """
    c = 2.0 ** max(0.0, 1.0 / p - 0.5)
    if q >= 2.0:
        return c
    m = 2.0 * q / (2.0 - q)
    return (c**m + 1.0) ** (1.0 / m)


def _checked_powers(powers: Any, name: str) -> tuple[float, float]:
    try:
        p, q = (float(one) for one in powers)
    except (TypeError, ValueError):
        raise ValueError(f"the powers of a {name} must be two numbers, not {powers!r}") from None
    if not (p >= 1.0 and q >= 1.0):
        raise ValueError(
            f"the powers of a {name} must be at least 1, not {powers!r}: below 1 no step can be "
            "proved, for the slope has no bound"
        )
    return p, q


class _Powered(Shape):
    """A shape with powers, which are numbers of its kernel and no data."""

    powers: tuple[float, float]

    def prepare(self, backend: Backend) -> Field:
        made = prepared_numbers(self, backend)
        set_checked(made, "powers", self.powers)
        return made


@dataclass(frozen=True)
class Superellipsoid(_Powered):
    """The points with | (|(x/a, y/b)|_p, z/c) |_q <= 1, powers = (p, q), radii = (a, b, c).

    f = m (that norm - 1) with m the least radius (Hart, equations 28 to 30), whose constant is that
    of the norm for equal radii, and no larger for others: see `lipschitz_of_norms`.
    """

    is_convex = True

    powers: tuple[float, float] = (4.0, 4.0)
    radii: Point = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        set_checked(self, "powers", _checked_powers(self.powers, "superellipsoid"))
        radii = triple(self.radii, "the radii of a superellipsoid", all_positive=True)
        set_checked(self, "radii", radii)

    @property
    def lipschitz(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        return lipschitz_of_norms(*self.powers) * (1.0 + 1e-6)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        (p, q), (a, b, c) = self.powers, self.radii
        return (norm(norm(x / a, y / b, p=p), z / c, p=q) - 1.0) * minimum(a, b, c)

    def hull(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if above:
            return None
        a, b, c = self.radii
        size = 1.0 + level / min(self.radii)
        return box_around((size * a, size * b, size * c))


@dataclass(frozen=True)
class Supertorus(_Powered):
    """The points with | (|(x, y)|_p - R, z) |_q <= r, powers = (p, q).

    Its constant is that of the norms (`lipschitz_of_norms`): taking R away moves no gradient.
    """

    powers: tuple[float, float] = (4.0, 4.0)
    major: float = 1.0
    minor: float = 0.25

    def __post_init__(self) -> None:
        set_checked(self, "powers", _checked_powers(self.powers, "supertorus"))
        set_checked(self, "major", positive(self.major, "the major radius of a supertorus"))
        set_checked(self, "minor", positive(self.minor, "the minor radius of a supertorus"))

    @property
    def lipschitz(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        return lipschitz_of_norms(*self.powers) * (1.0 + 1e-6)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        p, q = self.powers
        return norm(norm(x, y, p=p) - self.major, z, p=q) - self.minor

    def hull(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if above:
            return None
        r = self.minor + level
        return box_around((self.major + r, self.major + r, r))
