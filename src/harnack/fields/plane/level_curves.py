"""Level curves of harmonic functions of the plane, as walls: Harnack tracing in two dimensions."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend import backend_of
from harnack.backend.lengths import largest_coordinate
from harnack.backend.numbers import finite
from harnack.enclosures import Curvature, HarmonicBall
from harnack.fields.field import Field
from harnack.fields.look import Sample
from harnack.fields.plane.branches import Branches, Disk, complex_of, derivatives
from harnack.fields.plane.functions import branches_of
from harnack.geometry.volumes import Box

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.plane.branches import Branch, Complex
    from harnack.geometry import Volume

# Radii of the disks on which the function is bounded, as parts of the distance to the nearest
# singular point.
_PARTS = (0.4, 0.8)
_LONGEST = 1e6


class LevelCurves(Field):
    """f(x, y, z) = Re g(x + i y), or Im: its level sets are walls over level curves of the plane.

    function, exponent, of, singular, second, period: an analytic function with one branch, up to a
        period, as for `RiemannSurface`: {a_i: n_i} with whole n_i for a rational function, "log"
        with of={a_i: n_i} for charges n_i at a_i.
    part: "real" or "imag".
    level: the one drawn when none is asked for.
    domain: the volume it is drawn in; by default the box |x|, |y| <= 2, |z| <= 1/4.

    Re g is harmonic in the plane: Harnack's inequality of dimension 2 holds in disks up to the
    nearest singular point, and as |g''| is bounded there (`Branches.bend`) f moves by at most
    |g'| r + |g''| r^2/2 on a disk of radius r. It promises that, as a ball of dimension 2, and the
    second derivatives themselves.

    Raises:
        TypeError, ValueError: no such function, or one with several branches.
    """

    is_entire = True

    def __init__(
        self,
        function: str | Mapping[complex, Any] | Callable[[Any], Any],
        part: str = "real",
        *,
        exponent: Any = None,
        of: Mapping[complex, int] | None = None,
        singular: Iterable[Any] | None = None,
        second: Callable[[Any, Any], Any] | None = None,
        period: float | None = None,
        level: float = 0.0,
        domain: Volume | None = None,
    ) -> None:
        if part not in ("imag", "real"):
            raise ValueError(f'part must be "real" or "imag", not {part!r}')
        self.part = part
        self.branches: Branches = branches_of(
            function, exponent=exponent, of=of, singular=singular, second=second, period=period
        )
        if self.branches.count > 1:
            raise ValueError(
                f"level curves need a function with one branch, and this one has "
                f"{self.branches.count}: draw its Riemann surface, whose plane cuts they are"
            )
        self.domain = Box((-2.0, -2.0, -0.25), (2.0, 2.0, 0.25)) if domain is None else domain
        self.default_level = finite(level, "level")
        shift = self.branches.period(part == "imag")
        self.period = shift  # pyright: ignore[reportAttributeAccessIssue]

    def prepare(self, backend: Backend) -> LevelCurves:
        made = copy.copy(self)
        made.branches = self.branches.prepare(backend)
        return made

    def evaluate(self, p: Vec3) -> Sample:
        rounding, z, branch = self._at(p)
        x, y = derivatives(branch.first, self.part)
        vector = cast("Any", type(p))
        gradient = vector(x, y, 0 * x)
        slope, error = dr.norm(gradient), self.branches.roundings(z, (branch,))
        reach = self.branches.clearance(z)
        known: list[Curvature | HarmonicBall] = []
        value = branch.value.imag if self.part == "imag" else branch.value.real
        for part in _PARTS:
            radius = part * dr.minimum(reach, _LONGEST)
            bend = self.branches.bend(Disk(z, radius, rounding)) * (1 + 1e-4)
            moves = (slope * radius + 0.5 * bend * radius * radius) * (1 + 1e-5)
            known += [
                Curvature(bend, radius), HarmonicBall(radius, value - moves, value + moves, 2),
            ]  # fmt: skip
        return Sample(value, gradient, tuple(known), backend_of(p).epsilon * error)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """Rows of the Hessian, free of trace.

        Raises:
            NotImplementedError: a function of your own comes without its second derivative.
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
        """The rounding of the point, the point in the plane, and the function there."""
        rounding = 4 * backend_of(p).epsilon * largest_coordinate(p)
        z = self.branches.moved_off(complex_of(p.x, p.y), rounding)
        return rounding, z, self.branches.at(z)[0]
