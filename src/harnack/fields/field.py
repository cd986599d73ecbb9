"""What a field is: the one-page interface between functions and the rest of the library.

A field gives, in one evaluation, its value, its gradient and what it knows about itself near
the point. What it knows is stated in the field's own units and must be *true*: every step that
the tracer takes rests on it. `harnack.testing.check_field` tests a field against this page.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume


@dataclass(frozen=True)
class HarmonicBall:
    """f extends to a harmonic function on the ball B(p, radius) of R^dimension that stays in range.

    The continuous lift of f that agrees with `Sample.value` at p is harmonic on the open ball and
    stays within [lower, upper] there. Either end may be infinite, not both. dimension is 2, 3 or
    4: a function of the plane extended constantly, of space, or a slice of a function of R^4.
    """

    radius: Real
    lower: Real
    upper: Real
    dimension: int = 3


@dataclass(frozen=True)
class Lipschitz:
    """|f(y) - f(p)| <= constant * |y - p| for every y with |y - p| < radius (default: all y)."""

    constant: Real
    radius: Real = float("inf")


@dataclass(frozen=True)
class Curvature:
    """|f(y) - f(p) - grad f(p).(y-p)| <= constant |y-p|^2/2 for every y with |y-p| < radius."""

    constant: Real
    radius: Real = float("inf")


Knowledge = HarmonicBall | Lipschitz | Curvature


@dataclass(frozen=True)
class Sample:
    """One evaluation at a point p: value f(p), gradient (3,), and what is known near p.

    error: how far rounding may have moved `value` from f at the point given, beyond eight units
        in its last place (and beyond |gradient| times the rounding of the point itself, which
        the tracer accounts for). Steps are shortened by it.
    """

    value: Real
    gradient: Vec3
    known: tuple[Knowledge, ...]
    error: Real = 0.0


class Field(abc.ABC):
    """A scalar function on R^3 whose level sets can be traced with a proof.

    Subclasses define `evaluate`; the class attributes are defaults that an instance may override.
    """

    period: ClassVar[float | None] = None
    """None for a real-valued function, else f is continuous modulo this number (angle-valued)."""

    default_level: float = 0.0
    """The level drawn when none is asked for."""

    overstep: float = 1.4
    """The over-stepping factor that needs the fewest evaluations, by experiment; at least 1."""

    domain: Volume | None = None
    """Where the field may be evaluated and is drawn; None for all of space. Rays are clipped to
    it, and what a sample promises need only hold for p in it."""

    @abc.abstractmethod
    def evaluate(self, p: Vec3) -> Sample:
        """Value, gradient and knowledge at p, a Dr.Jit 3-vector of any backend and precision.

        Called while a loop is being recorded: use `drjit` functions of p, no Python branches on
        its values.
        """

    def prepare(self, backend: Backend) -> Field:
        """A field equal to this one whose data lie on the backend, called once before a trace.

        The default suits fields that hold only Python numbers.
        """
        del backend
        return self

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume proved to hold every point of the level sets; None where none is known.

        It may be smaller than `domain`; it is what lets a ray without an end be a proved miss.
        """
        del levels
        return self.domain

    def check_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError if a level is one that no surface can have. The default accepts all."""
        del levels

    def parameters(self) -> tuple[Any, ...]:
        """Dr.Jit arrays that the value depends on and that may carry derivatives."""
        return ()

    def differentiable_value(self, p: Vec3) -> Real:
        """f(p) as an expression that Dr.Jit can differentiate in p and in the field's parameters.

        Only used at known hits, to attach derivatives. Override it where `evaluate` runs a
        recorded loop, which reverse mode cannot pass.
        """
        return self.evaluate(p).value

    def describe(self) -> dict[str, Any]:
        """What a person would want to know about the choices this field made by itself."""
        return {}
