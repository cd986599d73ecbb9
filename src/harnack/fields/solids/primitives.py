"""Primitive solids: plane, sphere, ellipsoid, cylinder, cone, torus, box, superquadrics. A
solid is the set of points where its function f is at most 0. The f of each shape is its signed
distance, negative inside, or a bound of the distance (Hart 1996, appendix A). Where the Lipschitz
constant of f is 1, f is no larger than the distance outside. All shapes have this constant but the
superquadrics, whose constant is larger. Shapes lie at the origin with their axis along z; they can
be moved and rotated."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from harnack.arithmetic import cos, minimum, norm, sin
from harnack.arithmetic.norms import orthogonal_intersection
from harnack.backend.validation import as_finite, as_positive, as_triple
from harnack.fields.attached_numbers import with_attached_arguments
from harnack.fields.number_table import plain_numbers
from harnack.fields.parameters import kept_arguments
from harnack.fields.solids.solid import (
    FormulaSolid,
    Point,
    ball_around,
    box_around,
    by_numbers,
    set_frozen,
)

if TYPE_CHECKING:
    from harnack.fields.number_table import NumberReader
    from harnack.geometry import Volume


@dataclass(frozen=True)
class Plane(FormulaSolid):
    """The half-space n . x <= distance, where n is the unit vector along `normal`. f is the signed
    distance n . x - distance (Hart, equation 23).

    normal: (3,), of any length but 0.
    distance: the distance of the plane from the origin, along n.

    The gradient of f is n, so that the Lipschitz constant is 1.
    """

    traits = by_numbers("normal", "distance")

    is_convex = True

    # The unit vector is rounded.
    lipschitz = 1.0 + 1e-6

    normal: Point = (0.0, 0.0, 1.0)
    distance: float = 0.0

    def __post_init__(self) -> None:
        """Check the arguments, and make the normal a unit vector."""
        normal = as_triple(self.normal, "the normal of a plane")
        length = math.hypot(*normal)
        if length == 0.0:
            raise ValueError("the normal of a plane must not be zero")
        set_frozen(self, "normal", tuple(v / length for v in normal))
        set_frozen(self, "_given_normal", normal)
        set_frozen(self, "distance", as_finite(self.distance, "the distance of a plane"))

    def with_read_numbers(self, numbers: NumberReader) -> Plane:
        """The copy with the unit vector along the normal that was given, with its derivatives."""
        other = with_attached_arguments(self, ("distance",), numbers)
        direction: tuple[float, ...] = vars(self)["_given_normal"]
        normal = numbers.vector(kept_arguments(self).get("normal", direction), direction)
        length = norm(*normal)
        set_frozen(other, "normal", tuple(v / length for v in normal))
        return other

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        a, b, c = self.normal
        return x * a + y * b + z * c - self.distance

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        del level, above
        return None


@dataclass(frozen=True)
class Sphere(FormulaSolid):
    """The ball |x - center| <= radius. f is the signed distance |x - center| - radius (Hart,
    equation 24). By the triangle inequality its Lipschitz constant is 1."""

    traits = by_numbers("radius", "center")

    is_convex = True

    radius: float = 1.0
    center: Point = (0.0, 0.0, 0.0)

    lipschitz = 1.0

    def __post_init__(self) -> None:
        set_frozen(self, "radius", as_positive(self.radius, "the radius of a sphere"))
        set_frozen(self, "center", as_triple(self.center, "the center of a sphere"))

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        a, b, c = self.center
        return norm(x - a, y - b, z - c) - self.radius

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if above:
            return None
        return ball_around(self.center, self.radius + level)


def _box_of_radii(radii: tuple[float, float, float], level: float) -> Volume:
    """A box that contains all points where f = m (g - 1) <= level. Here g is a norm, the set g <= 1
    lies in the box with the half sides `radii`, and m is the smallest of these.

    radii: (3,) the half sides of that box.

    f <= level means g <= 1 + level/m, so the box is scaled by this number.
    """
    a, b, c = radii
    size = 1.0 + level / min(radii)
    return box_around((size * a, size * b, size * c))


@dataclass(frozen=True)
class Ellipsoid(FormulaSolid):
    """The points with |(x/a, y/b, z/c)| <= 1. f = m (|(x/a, y/b, z/c)| - 1), where m is the
    smallest of the radii a, b, c.

    radii: (a, b, c).

    Proof of the Lipschitz constant 1. The length of a vector has the Lipschitz constant 1, and the
    map (x, y, z) -> (x/a, y/b, z/c) has 1/m, attained along the shortest axis. The factor m makes
    their product 1. So f is no larger than the distance outside. The distance itself has no closed
    form.
    """

    traits = by_numbers("radii")

    is_convex = True

    radii: Point = (1.0, 1.0, 1.0)

    lipschitz = 1.0 + 1e-6  # quotients of radii are rounded

    def __post_init__(self) -> None:
        radii = as_triple(self.radii, "the radii of an ellipsoid", all_positive=True)
        set_frozen(self, "radii", radii)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        a, b, c = self.radii
        return (norm(x / a, y / b, z / c) - 1.0) * minimum(a, b, c)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        return None if above else _box_of_radii(self.radii, level)


@dataclass(frozen=True)
class Cylinder(FormulaSolid):
    """The points within `radius` of the z axis and, unless `height` is None, with |z| <= height/2.
    f is the signed distance.

    Without ends f is |(x, y)| - radius (Hart, equation 25). With ends, the distances from the side
    and from the ends have gradients at right angles, so that `orthogonal_intersection` of both is
    the signed distance. The Lipschitz constant is 1.
    """

    traits = by_numbers("radius", "height")

    is_convex = True

    radius: float = 1.0
    height: float | None = None

    lipschitz = 1.0

    def __post_init__(self) -> None:
        set_frozen(self, "radius", as_positive(self.radius, "the radius of a cylinder"))
        if self.height is not None:
            set_frozen(self, "height", as_positive(self.height, "the height of a cylinder"))

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at (x, y, z). With ends, the distances from the side and from the ends are combined as
        distances at right angles."""
        side = norm(x, y) - self.radius
        return (
            side
            if self.height is None
            else orthogonal_intersection(side, abs(z) - 0.5 * self.height)
        )

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A box that contains all points where f <= level: the box of the cylinder, grown by the
        level on each side. None for a cylinder without ends, and if `above` (a volume for all
        points where f >= level), as these points are unbounded."""
        if above:
            return None
        if self.height is None:
            return None
        r, margin = self.radius, level
        return box_around((r + margin, r + margin, 0.5 * self.height + margin))


@dataclass(frozen=True)
class DoubleCone(FormulaSolid):
    """The double cone around the z axis with its apex at the origin. f = |(x, y)| cos(angle) - |z|
    sin(angle) (Hart, equation 26).

    angle: between the axis and the sides, in degrees, above 0 and below 90.

    The gradient of f is a unit vector off the axis and off the plane z = 0, so that the Lipschitz
    constant is 1. Consider a point p, and the half-plane that is bounded by the axis and contains
    p. Let L be the line of the cone's side in it. f is the signed distance where the point of L
    nearest to p is not beyond the apex, and smaller elsewhere.
    """

    traits = by_numbers("angle")

    angle: float = 30.0

    lipschitz = 1.0 + 1e-6  # sine and cosine are rounded

    def __post_init__(self) -> None:
        """Raise ValueError unless the angle is between 0 and 90 degrees."""
        angle = as_finite(self.angle, "the angle of a cone")
        if not 0.0 < angle < 90.0:
            raise ValueError(
                "the angle of a cone between axis and side must be between 0 and 90 degrees, "
                f"not {self.angle!r}"
            )
        set_frozen(self, "angle", angle)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        angle = self.angle * (math.pi / 180)  # which kernels may read as a parameter
        return norm(x, y) * cos(angle) - abs(z) * sin(angle)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        del level, above
        return None


@dataclass(frozen=True)
class Torus(FormulaSolid):
    """The points within `minor` of the circle of radius `major` around the z axis. f is the signed
    distance | (|(x, y)| - major, z) | - minor (Hart, equation 27). As the distance from a set minus
    a constant, f has the Lipschitz constant 1. If minor > major (a spindle torus), f is only a
    bound of the distance inside."""

    traits = by_numbers("major", "minor")

    major: float = 1.0
    minor: float = 0.25

    lipschitz = 1.0

    def __post_init__(self) -> None:
        set_frozen(self, "major", as_positive(self.major, "the major radius of a torus"))
        set_frozen(self, "minor", as_positive(self.minor, "the minor radius of a torus"))

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return norm(norm(x, y) - self.major, z) - self.minor

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if above:
            return None
        r = self.minor + level
        return box_around((self.major + r, self.major + r, r))


@dataclass(frozen=True)
class Cuboid(FormulaSolid):
    """The box |x| <= a/2, |y| <= b/2, |z| <= c/2. f is the signed distance.

    sides: (a, b, c).
    radius: the radius with which the edges are rounded; 0 for sharp edges.

    f is computed as the signed distance from a box that is smaller by the radius on each side
    (`orthogonal_intersection`), minus the radius.
    """

    traits = by_numbers("sides", "radius")

    is_convex = True

    sides: Point = (2.0, 2.0, 2.0)
    radius: float = 0.0

    lipschitz = 1.0

    def __post_init__(self) -> None:
        """Check the arguments.

        Raises:
            ValueError: sides that are not positive, or a radius above half of the smallest side.
        """
        sides = as_triple(self.sides, "the sides of a box", all_positive=True)
        set_frozen(self, "sides", sides)
        radius = as_finite(self.radius, "the radius of the edges of a box")
        if not 0.0 <= radius <= 0.5 * min(sides):
            raise ValueError(
                "the radius of the edges of a box must be between 0 and its least half side "
                f"{0.5 * min(sides):g}, not {self.radius!r}"
            )
        set_frozen(self, "radius", radius)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        sides = (
            abs(v) - (0.5 * a - self.radius) for v, a in zip((x, y, z), self.sides, strict=True)
        )
        return orthogonal_intersection(*sides) - self.radius

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if above:
            return None
        a, b, c = (0.5 * side + level for side in self.sides)
        return box_around((a, b, c))


def lipschitz_of_norms(p: float, q: float) -> float:
    """The Lipschitz constant of | (|(x, y)|_p, z) |_q, for p, q >= 1, where |.|_p is the p-norm.

    Proof. Let (u, v) = (|(x, y)|_p, z), scaled to the q-norm 1. The gradient has the components
    u^(q-1) grad |(x, y)|_p and v^(q-1). The gradient of the p-norm has the dual norm 1, so its
    length is at most c = 2^max(0, 1/p - 1/2). So the square of the length of the whole gradient is
    at most c^2 u^(2q-2) + v^(2q-2). For q >= 2 both powers are at most u^q and v^q, whose sum is 1;
    so the square is at most c^2, as c >= 1. For q < 2, Hoelder's inequality with the exponents
    q/(2q-2) and q/(2-q) gives (c^m + 1)^(2/m) with m = 2q/(2-q). All these bounds are attained. The
    root is computed as c (1 + c^-m)^(1/m), as c^m overflows if q is just below 2. The result has an
    error of a few roundings, for which callers have to increase it. (Hart's constant, 1996,
    equation 31, is right only for p = q < 2, or p >= 2 and q >= 2.)
    """
    c = 2.0 ** max(0.0, 1.0 / p - 0.5)
    if q >= 2.0:
        return c
    m = 2.0 * q / (2.0 - q)
    return c * (1.0 + c**-m) ** (1.0 / m)


def _checked_powers(powers: Any, name: str) -> tuple[float, float]:
    """Check the powers of a superquadric, and return them as two numbers (p, q).

    name: the name of the shape, for messages.

    Raises:
        ValueError: not two numbers, or a power below 1.
    """
    try:
        p, q = plain_numbers(powers).tolist()
        p, q = float(p), float(q)
    except (TypeError, ValueError):
        raise ValueError(f"the powers of a {name} must be two numbers, not {powers!r}") from None
    if not (p >= 1.0 and q >= 1.0):
        raise ValueError(
            f"the powers of a {name} must be at least 1, not {powers!r}: below 1 no step can be "
            "proved, for the slope has no bound"
        )
    return p, q


class _Powered(FormulaSolid):
    """A solid whose formula has powers p and q, the exponents of norms. In a kernel they are
    literals, not parameters, so that other powers compile another kernel."""

    literals = ("powers",)

    powers: tuple[float, float]


@dataclass(frozen=True)
class Superellipsoid(_Powered):
    """The points with | (|(x/a, y/b)|_p, z/c) |_q <= 1, where |.|_p is the p-norm. f = m (that norm
    - 1), where m is the smallest of the radii (Hart, equations 28 to 30).

    powers: (p, q), each at least 1.
    radii: (a, b, c).

    For equal radii the Lipschitz constant of f is that of the norm (`lipschitz_of_norms`); for
    other radii it is no larger.
    """

    traits = by_numbers("powers", "radii")

    is_convex = True

    powers: tuple[float, float] = (4.0, 4.0)
    radii: Point = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        set_frozen(self, "powers", _checked_powers(self.powers, "superellipsoid"))
        radii = as_triple(self.radii, "the radii of a superellipsoid", all_positive=True)
        set_frozen(self, "radii", radii)

    @property
    def lipschitz(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        return lipschitz_of_norms(*self.powers) * (1.0 + 1e-6)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        (p, q), (a, b, c) = self.powers, self.radii
        return (norm(norm(x / a, y / b, p=p), z / c, p=q) - 1.0) * minimum(a, b, c)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        return None if above else _box_of_radii(self.radii, level)


@dataclass(frozen=True)
class Supertorus(_Powered):
    """The points with | (|(x, y)|_p - major, z) |_q <= minor, where |.|_p is the p-norm. f is that
    norm minus `minor`.

    powers: (p, q), each at least 1.
    major: the radius of the central curve, in the p-norm.
    minor: the radius of the tube around it, in the q-norm.

    The Lipschitz constant is that of the norms (`lipschitz_of_norms`), as subtracting `major`
    changes no gradient.
    """

    traits = by_numbers("powers", "major", "minor")

    powers: tuple[float, float] = (4.0, 4.0)
    major: float = 1.0
    minor: float = 0.25

    def __post_init__(self) -> None:
        set_frozen(self, "powers", _checked_powers(self.powers, "supertorus"))
        set_frozen(self, "major", as_positive(self.major, "the major radius of a supertorus"))
        set_frozen(self, "minor", as_positive(self.minor, "the minor radius of a supertorus"))

    @property
    def lipschitz(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        return lipschitz_of_norms(*self.powers) * (1.0 + 1e-6)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        p, q = self.powers
        return norm(norm(x, y, p=p) - self.major, z, p=q) - self.minor

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if above:
            return None
        r = self.minor + level
        return box_around((self.major + r, self.major + r, r))
