"""Solids made of any field: where its values lie on one side of a level, or between two."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.arithmetic import Interval, Jet
from harnack.backend import backend_of
from harnack.backend.elementary import fmax, fmin, max_norm, safe_norm
from harnack.backend.validation import no_derivatives
from harnack.enclosures import Enclosure, LevelGaps
from harnack.fields.field import Field, check_is_field
from harnack.fields.formula import Formula, is_jet, prepare_value
from harnack.fields.samples import Ray, RaySample, Sample, value_error_bound
from harnack.fields.solids.booleans import Complement, OffsetSolid, lipschitz_of, negated_sample
from harnack.fields.solids.mesh_solid import looks_like_mesh, solid_of_mesh
from harnack.fields.solids.solid import Solid, SolidOfField

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.geometry import Volume


@no_derivatives
def solid(
    field: Any,
    *,
    below: float | None = None,
    above: float | None = None,
    between: tuple[float, float] | None = None,
    around: tuple[float, float] | None = None,
) -> Solid:
    """The solid of a closed mesh; or the solid of all points at which a field is below or above a
    level, or between two levels.

    field: a field; or, with none of the levels, a trimesh.Trimesh, a pair (vertices (n, 3), faces
        (m, 3)), or the path of a surface file, of which the solid is a `MeshSolid`, the signed
        distance from the mesh.
    below, above: a level.
    between: (low, high).
    around: (level, half_width): the points at which the value is at most half_width from the level.
        This is the argument for angle-valued fields, as for a thickened surface that spans a knot.

        hk.solid(hk.Gyroid(1.0), between=(-0.3, 0.3)) & hk.Torus(0.8, 0.3)
        hk.solid("part.stl") - hk.Cylinder(2.0, 50.0)

    Raises:
        ValueError: none, or several, of these given; bad numbers; a field with jumps,
            or an angle-valued one without `around`; a mesh that bounds no solid (`MeshError`).
    """
    given = [one for one in (below, above, between, around) if one is not None]
    if looks_like_mesh(field):
        if given:
            raise ValueError(
                "a mesh is solid by itself: below=, above=, between= and around= are for fields; "
                "solid(mesh).offset(d) moves its surface by d, and solid(mesh).shell(t) hollows it"
            )
        return solid_of_mesh(field)
    if len(given) != 1:
        raise ValueError("give exactly one of below=, above=, between=, around=")
    check_is_field(field)
    if field.has_jumps:
        raise ValueError(
            f"{type(field).__name__} jumps across sheets: values on both sides of a level may meet "
            "without any in between, so it bounds no solid"
        )
    two = between is not None or around is not None
    numbers = _levels(given[0] if two else (given[0],), 2 if two else 1)
    if numbers is None:
        count = ", two of them" if two else ""
        raise ValueError(f"levels must be finite numbers{count}, not {given[0]!r}")
    if field.period is not None and around is None:
        raise ValueError(
            f"{type(field).__name__} is angle-valued: no value is below another. Use "
            "around=(level, half_width) for the solid near a level"
        )
    inside = SublevelSolid(field)
    if below is not None:
        return OffsetSolid(inside, numbers[0])
    if above is not None:
        return Complement(OffsetSolid(inside, numbers[0]))
    low, high = numbers
    if around is not None:
        if not high > 0:
            raise ValueError(f"half_width must be positive, not {high:g}")
        if field.period is not None and not 2 * high < field.period:
            raise ValueError(f"half_width must be below {field.period / 2:g}, half of the period")
        return BandSolid(field, low, high)
    if not low < high:
        raise ValueError(f"between must be (low, high) with low < high, not {between}")
    return BandSolid(field, 0.5 * (low + high), 0.5 * (high - low))


def _levels(given: Any, count: int) -> tuple[float, ...] | None:
    """`count` finite numbers; None if they are not."""
    try:
        numbers = tuple(float(one) for one in given)
    except (TypeError, ValueError):
        return None
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else None


@dataclass(frozen=True, eq=False)
class SublevelSolid(SolidOfField):
    """The points where a field is at most 0."""

    field: Field

    def __post_init__(self) -> None:
        self._copy_settings()
        domain = None if self.field.is_global else self.field.domain
        object.__setattr__(self, "domain", domain)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if self.field.is_global:
            return None

        def is_inside(value: float) -> bool:
            return value >= level if above else value <= level

        return bounded_side_extent(self.field, (level,), is_inside)

    def evaluate(self, p: Vec3) -> Sample:
        return self.field.evaluate(p)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return self.field.hessian(p)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        return self.field.sample_ray(path, t, ahead, back)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        if isinstance(self.field, Formula):
            return self.field.formula(x, y, z)
        if not is_jet(x, type(self.field).__name__):
            return self.differentiable_value(_vector(x, y, z))
        return field_jet(self.field, x, y, z)


def bounded_side_extent(
    field: Field, levels: tuple[float, ...], is_inside: Callable[[float], bool]
) -> Volume | None:
    """A volume that contains all points inside, if one is proved; else the domain, outside of which
    the field is not known.

    Proof. Level sets lie in `extent`, which is convex; if it has bounds, its complement is
    connected and meets no level, so that one point tells on which side of the levels all of it is.
    """
    extent = field.extent(levels)
    if field.is_global and extent is field.domain:  # only where it is drawn: it bounds no level set
        return None
    if extent is None or (field.domain is not None and not field.is_global):
        return field.domain
    low, high = extent.bounds()
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    beyond = high + (high - low) + 1e-3
    value = float(field.value(beyond, precision="double"))
    return None if is_inside(value) or not math.isfinite(value) else extent


def _vector(x: Real, y: Real, z: Real) -> Vec3:
    return backend_of(x).Array3f(x, y, z)


def field_jet(field: Field, x: Jet, y: Jet, z: Jet) -> Jet:
    """The jet of a field whose second derivatives are bounded near a point.

    Proof. Let |f''| <= H within r of q, the point where the piece starts (or the point itself), and
    let coordinates be within m of q on the piece, rounding included. If m <= r, the gradient on the
    piece differs from that at q by at most H m, by the mean value theorem, and derivatives along
    the path follow by the chain rule; the value is that at the start plus the length times the
    derivative. Where m > r derivatives are not bounded. Second derivatives at a point (of
    coordinates with all six) are those of the field where it has some, up to its error of these
    (without what the rounding of coordinates adds), or up to 2 H, as both are at most H.

    Raises:
        TypeError: the field promises no bound of its second derivatives.
    """
    coordinates = (x, y, z)
    starts = [one if one.jet_at_start is None else one.jet_at_start for one in coordinates]
    q = _vector(*(0 * x.piece_length + one.value.midpoint for one in starts))
    sample = field.evaluate(q)
    bound, radius = _second_derivatives(field, sample)
    off = safe_norm(type(q)(*(0 * x.piece_length + one.value.radius for one in starts)))
    rows = _second_derivatives_at(field, q) if len(x.second_derivatives) == _ALL_PAIRS else None
    doubt = 2 * bound
    if rows is not None:
        is_point = off <= _AT_POINT * float(dr.epsilon(type(q.x))) * max_norm(q)
        doubt = dr.select(is_point, fmin(doubt, field.derivative_errors(q, sample)[1]), doubt)

    def derivatives(
        jets: list[Jet], distance: Real
    ) -> tuple[tuple[Interval, ...], tuple[Interval, ...]]:
        most = dr.select(distance <= radius, bound, dr.inf)
        change = most * distance * (1 + 1e-5) + sample.gradient_error
        slopes = [Interval(one - change, one + change) for one in sample.gradient]
        first = tuple(
            _interval_sum(g * one.first_derivatives[i] for g, one in zip(slopes, jets, strict=True))
            for i in range(len(x.first_derivatives))
        )
        speeds = [
            safe_norm(
                type(q)(*(0 * x.piece_length + one.first_derivatives[i].max_abs for one in jets))
            )
            for i in range(len(x.first_derivatives))
        ]
        second: list[Interval] = []
        for k, (i, j) in enumerate(_pairs(len(x.first_derivatives), len(x.second_derivatives))):
            along = _interval_sum(
                g * one.second_derivatives[k] for g, one in zip(slopes, jets, strict=True)
            )
            if rows is None:
                bent = most * speeds[i] * speeds[j] * (1 + 1e-5)
            else:
                bent = doubt * speeds[i] * speeds[j] * (1 + 1e-5)
                own = (
                    row[n] * (jet.first_derivatives[i] * column.first_derivatives[j])
                    for row, jet in zip(rows, jets, strict=True)
                    for n, column in enumerate(jets)
                )
                along = along + _interval_sum(own)
            second.append(along + Interval(-bent, bent))
        return first, tuple(second)

    steep = safe_norm(sample.gradient) + sample.gradient_error
    unit = 2 * float(dr.epsilon(type(q.x)))
    wide = sample.value_error + 8 * unit * dr.abs(sample.value)
    wide = (wide + off * (steep + dr.select(off <= radius, bound, dr.inf) * off)) * (1 + 1e-5)
    value = Interval(sample.value - wide, sample.value + wide)
    first, second = derivatives(starts, off)
    start = Jet(value, first, second, piece_length=starts[0].piece_length)
    if x.jet_at_start is None:
        return start
    moves = (
        fmax(dr.abs(one.value.upper - m), dr.abs(one.value.lower - m))
        for one, m in zip(coordinates, q, strict=True)
    )
    first, second = derivatives(list(coordinates), safe_norm(type(q)(*moves)) * (1 + 1e-5))
    span = Interval(0 * x.piece_length, 0 * value.lower + x.piece_length)
    return Jet(value + first[0] * span, first, second, start, x.piece_length)


def _interval_sum(terms: Iterable[Interval]) -> Interval:
    total = Interval(0.0, 0.0)
    for one in terms:
        total = total + one
    return total


def _pairs(n: int, count: int) -> list[tuple[int, int]]:
    """The pairs of variables of the entries of `Jet.second_derivatives`."""
    return [(i, j) for i in range(n) for j in range(i, n)][:count]


# All second derivatives by three coordinates; and the roundings of coordinates of a point.
_ALL_PAIRS, _AT_POINT = 6, 256.0


def _second_derivatives_at(field: Field, q: Vec3) -> list[list[Interval]] | None:
    """The Hessian of a field at a point; None where the field has none."""
    try:
        rows = field.hessian(q)
    except NotImplementedError:
        return None
    return [[Interval.point(number) for number in row] for row in rows]


def _second_derivatives(field: Field, sample: Sample) -> tuple[Real, Real]:
    """A bound of all second derivatives, and the radius within which it holds."""
    for promise in sample.all_promises:
        found = promise.implied_second_derivative_bound(sample.value)
        if found is not None:
            return found
    raise TypeError(
        f"{type(field).__name__} promises neither a HarmonicBall with both ends nor a Curvature "
        "without a radius, and has no formula, so it cannot be blended, twisted or tapered; "
        "move it by moved, rotated, scaled or transformed, and join it by |, & and -"
    )


@dataclass(frozen=True, eq=False)
class BandSolid(SolidOfField):
    """The points where a field is at most half_width from a level: |f - level| - half_width.

    For an angle-valued field, from the level plus any multiple of the period.

    Proof. It changes as f does, up to the sign, so it does not reach a value v as long as f stays
    away from level + v + half_width and level - v - half_width, and from these plus multiples of
    the period (`FoldedEnclosure`).
    """

    field: Field
    level: float
    half_width: float

    def __post_init__(self) -> None:
        self._copy_settings()
        domain = None if self.field.is_global else self.field.domain
        object.__setattr__(self, "domain", domain)

    def prepare(self, backend: Backend) -> Solid:
        other = super().prepare(backend)
        for name in ("level", "half_width"):
            object.__setattr__(other, name, prepare_value(getattr(self, name), backend))
        return other

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        ends = tuple(self.level + sign * (self.half_width + level) for sign in (-1, 1))
        if above or (self.field.is_global and self.field.period is None):
            return self.domain

        def is_inside(value: float) -> bool:
            offset, period = value - self.level, self.field.period
            if period is not None:
                offset -= period * round(offset / period)
            return abs(offset) <= self.half_width + level

        return bounded_side_extent(self.field, ends, is_inside)

    def evaluate(self, p: Vec3) -> Sample:
        return self._fold_sample(self.field.evaluate(p))[0]

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        below = self._level_difference(self.field.evaluate(p).value) < 0
        x, y, z = (dr.select(below, -row, row) for row in self.field.hessian(p))
        return x, y, z

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """The bounds of the inner field; infinite where rounding leaves open on which side of a
        fold the point is, since derivatives jump there."""
        own = self.field.evaluate(p)
        slope, bend = self.field.derivative_errors(p, own)
        doubt = value_error_bound(own, safe_norm(own.gradient), max_norm(p))
        away = dr.abs(self._level_difference(own.value))
        if self.field.period is not None:
            away = fmin(away, 0.5 * self.field.period - away)
        is_clear = away > doubt
        return dr.select(is_clear, slope, dr.inf), dr.select(is_clear, bend, dr.inf)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        look = self.field.sample_ray(path, t, ahead, back)
        sample, offset = self._fold_sample(look.sample)

        def folded(enclosures: tuple[Enclosure, ...]) -> tuple[Enclosure, ...]:
            return tuple(FoldedEnclosure(one, offset, self.field.period) for one in enclosures)

        slope = dr.mulsign(look.slope, offset)
        ahead_, back_ = folded(look.forward), folded(look.backward)
        return RaySample(sample, ahead_, back_, slope, look.reach_growth, look.slope_error)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        if not isinstance(self.field, Formula | Solid):
            return super().formula(x, y, z)
        return abs(self.field.formula(x, y, z) - self.level) - self.half_width

    def _level_difference(self, value: Real) -> Real:
        """f - level, reduced to half a period on either side."""
        offset, period = value - self.level, self.field.period
        return offset if period is None else offset - period * dr.round(offset / period)

    def _fold_sample(self, sample: Sample) -> tuple[Sample, Real]:
        offset = self._level_difference(sample.value)
        turned = negated_sample(sample)
        below = offset < 0
        unit = 2 * float(dr.epsilon(type(offset)))
        rounding = 8 * unit * (dr.abs(sample.value) + abs(self.level) + self.half_width)
        lipschitz = lipschitz_of(sample)
        return replace(
            sample,
            value=dr.abs(offset) - self.half_width,
            gradient=dr.select(below, turned.gradient, sample.gradient),
            value_error=sample.value_error + rounding,
            shading_normal=None,
            promises=() if lipschitz is None else (lipschitz,),
            alternative_promises=(),
            ray_promises=(),
        ), offset


@dataclass(frozen=True)
class FoldedEnclosure(Enclosure):
    """The movement of |r| from that of r, r known modulo a period and reduced to within half of it
    around 0.

    Proof. |r| rises to |r| + g, or falls to |r| - g >= 0, only where r reaches plus or minus that
    value, or either plus a multiple of the period. Those nearest to r above and below are the
    levels of r. Where |r| - g < 0, or |r| + g is beyond half a period, r never reaches such a
    value.
    """

    inner: Enclosure
    offset: Real
    period: float | None

    def free_length(self, gaps: LevelGaps) -> Real:
        return self.inner.free_length(self._gaps(gaps))

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        return self.inner.is_free(self._gaps(gaps), length)

    def _gaps(self, gaps: LevelGaps) -> LevelGaps:
        """How far r must move, for r >= 0 with s = |r| (else mirrored), for |r| to reach A = s + up
        or B = s - down: upwards to A or P - B, downwards to B or -A, P the period."""
        size, none = dr.abs(self.offset), type(self.offset)(dr.inf)
        has_below = gaps.below <= size * _SLACK
        upwards, downwards = gaps.above, 2 * size + gaps.above
        if self.period is not None:
            has_above = size + gaps.above <= 0.5 * self.period * _SLACK
            upwards, downwards = (dr.select(has_above, one, none) for one in (upwards, downwards))
            around = self.period - 2 * size + gaps.below
            upwards = dr.select(has_below, fmin(around, upwards), upwards)
        downwards = dr.select(has_below, fmin(gaps.below, downwards), downwards)
        # NaN proves nothing.
        known = (gaps.below >= 0) & (gaps.above >= 0) & (size >= 0)
        upwards, downwards = (dr.select(known, one, dr.nan) for one in (upwards, downwards))
        positive = self.offset >= 0
        return LevelGaps(
            dr.select(positive, downwards, upwards), dr.select(positive, upwards, downwards)
        )


# Covers the rounding in the tests whether r can reach such a value.
_SLACK = 1.0 + 1e-5
