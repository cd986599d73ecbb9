"""Isolines: lines on a surface where another function takes given values.

A line is the set of points within half its width of the curve {g = level} on the surface. Its
distance from a point is |g - level| / |grad_T g| to first order, with the part grad_T g of the
gradient along the surface: lines are as wide where g rises gently as where it is steep. They are
compared without the quotient, |g - level| < width/2 |grad_T g|, so that nothing is drawn where g is
constant along the surface, whatever its value there.

Where g has a critical point on the surface, lines cannot widen without limit. Let its difference
from the level be q(x) of degree n there, to leading order (2 at maxima, minima and saddles, where
no more vanishes). Along a ray from the point q = c r^n, and |grad_T g| <= n |q|_max / r, where
|q|_max is the largest |q| at the distance r (Kellogg 1928): in directions in which |q| is within a
factor k of that, the line ends before r = k n/2 width. So a maximum at a level is a dot, as wide as
two lines, and lines that cross at a saddle are joined by a fillet of that size. Around a maximum
that is a little higher, with g - level = (R^2 - r^2)/2 at the distance r, the line is where
|r^2 - R^2| < width r, which is r < width/2 + sqrt(width^2/4 + R^2) <= R + width: at most half a
width too far.

`as_field` and `padded_domain` serve pictures of values as well.

Lines are found with the hit, once, and their number travels in the interaction's index of the
primitive, by which the BSDF chooses (`mitsuba_proxy`): the other function is not evaluated again by
every question that a BSDF is asked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import upload_floats
from harnack.backend.elementary import safe_norm as norm
from harnack.backend.validation import as_positive
from harnack.fields import Field
from harnack.fields.expressions import expression
from harnack.rendering.scales import Color, parse_color

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Index, Mask, Real, Vec3
    from harnack.geometry import Volume

# A surface that is cut by the function's own domain reaches beyond it by rounding, at most by this
# part of its size.
_PADDING = 1e-5


def as_field(function: Any, name: str = "color_by") -> Field:
    """A function on space as a field. It is a field; or an argument of `harnack.expression`: a
    function of three coordinates, or a text such as "z".

    Raises:
        TypeError, ValueError: another argument, or a field with patches.
    """
    if isinstance(function, str):
        try:
            return expression(function)
        except ValueError as error:
            raise ValueError(f"{name.rstrip(',')}: {error}") from None
    if isinstance(function, Field):
        if function.has_patches:
            raise ValueError(
                f"{name} must be one function on space, and this {type(function).__name__} has one "
                "for each part"
            )
        return function
    if not callable(function):
        raise TypeError(
            f'{name} must be a text such as "z" or "x*y", a field, or a function of x, y and z, '
            f"not {function!r}"
        )
    return expression(cast("Callable[[Any, Any, Any], Any]", function))


def padded_domain(function: Field, size: float) -> Volume | None:
    """The volume in which a function is defined, with a margin for rounding; None for all of space.

    size: the size of the surface on which the function is evaluated.
    """
    if function.domain is None or function.is_global:
        return None
    return function.domain.padded(_PADDING * size)


# The default width of a line, as a fraction of the diagonal of the surface's box.
_DEFAULT_WIDTH = 0.004
# If the component of the gradient along the surface is smaller than this fraction of the gradient,
# it is due to rounding of the normal and of the position.
_ROUNDING = 1e-4
# The default number of lines of an angle-valued function.
_DEFAULT_LINE_COUNT = 12
# Tables of levels have at least this many entries, as kernels depend on the logarithm of the
# length.
_MIN_TABLE_LENGTH = 64


@dataclass(frozen=True, eq=False)
class Isolines:
    """Lines on a surface where a function takes given values.

        hk.render(field, "a.png", isolines=hk.Isolines("z", interval=0.1))
        hk.render(field, "b.png", isolines=[hk.Isolines(other, [0, 1], color="white"), ...])

    function: the function: "x", "y" or "z", which gives contour lines of height; a `Field`; or a
        Python function of x, y and z as `harnack.expression` takes it. All are in the coordinates
        of the surface, wherever it stands. There are no lines where the field is not defined:
        outside of its `domain`, unless it `is_global`.
    levels: the values, or one; those of angle-valued fields count up to their period.
    interval: in place of levels, lines at all whole multiples of it. It must divide the period of
        an angle-valued field, which has 12 lines if neither is given.
    width: of the lines, along the surface, in the unit of its coordinates; by default 0.4 percent
        of the diagonal of the surface's box.
    color: a name of CSS, "#rrggbb", or three numbers of sRGB.
    """

    function: Any
    levels: Any = None
    interval: float | None = None
    width: float | None = None
    color: Any = "black"
    function_field: Field = field(init=False, repr=False)
    srgb: Color = field(init=False, repr=False)

    def __post_init__(self) -> None:
        values: dict[str, Any] = {
            "function_field": as_field(self.function, "function, whose isolines are drawn,"),
            "srgb": parse_color(self.color, "color of isolines"),
        }
        for name in ("interval", "width"):
            if getattr(self, name) is not None:
                values[name] = as_positive(getattr(self, name), f"{name} of isolines")
        if self.levels is not None:
            if self.interval is not None:
                raise ValueError("isolines have either levels or an interval, not both")
            values["levels"] = _numbers(self.levels)
        elif self.interval is None and values["function_field"].period is None:
            raise ValueError(
                "say which isolines: levels=[...], or interval= for all whole multiples of it"
            )
        for name, number in values.items():
            object.__setattr__(self, name, number)
        self._exact_interval()

    def _exact_interval(self) -> float | None:
        """The interval; exactly a fraction of the period, if there is a period. None for lines at
        levels."""
        period = self.function_field.period
        if self.levels is not None or period is None:
            return self.interval
        count = _DEFAULT_LINE_COUNT if self.interval is None else round(period / self.interval)
        if self.interval is not None and abs(count * self.interval - period) > 1e-4 * period:
            raise ValueError(
                f"the function has the period {period:.6g}, and an interval of {self.interval:g} "
                "does not divide it: lines would end where it is passed. "
                "Give period / n, or levels"
            )
        return period / count

    def prepare(self, backend: Backend, size: float) -> PreparedIsolines:
        """The isolines on a backend. size: diagonal of the surface's box, for the default width."""
        width = _DEFAULT_WIDTH * size if self.width is None else self.width
        step, period = self._exact_interval(), self.function_field.period
        volume = padded_domain(self.function_field, size)
        return PreparedIsolines(
            self.function_field.prepare(backend),
            None if volume is None else volume.prepare(backend),
            dr.opaque(backend.Float, 0.5 * width),
            None if step is None else dr.opaque(backend.Float, step),
            None if step is not None else upload_floats(backend, _table(self.levels, period)),
            None if period is None else dr.opaque(backend.Float, period),
        )


def _table(levels: tuple[float, ...], period: float | None) -> FloatArray:
    """Levels in ascending order, in which the nearest level is next to the place of a value.

    The levels of an angle-valued function lie in [0, period); a copy of the last precedes them and
    a copy of the first follows them. The rest of the table, of 2^k - 1 entries, is infinite.
    """
    ordered = np.unique(np.array(levels) if period is None else np.mod(levels, period))
    if period is not None:
        ordered = np.array([ordered[-1] - period, *ordered, ordered[0] + period])
    entries = max(_MIN_TABLE_LENGTH, 2 ** len(ordered).bit_length()) - 1
    return np.concatenate([ordered, np.full(entries - len(ordered), np.inf)])


def _numbers(levels: Any) -> tuple[float, ...]:
    try:
        numbers = np.atleast_1d(np.asarray("none" if isinstance(levels, str) else levels, float))
    except (TypeError, ValueError):
        raise TypeError(f"levels of isolines must be numbers, not {levels!r}") from None
    if numbers.ndim != 1 or not numbers.size or not np.isfinite(numbers).all():
        raise ValueError(f"levels of isolines must be finite numbers, at least one, not {levels!r}")
    return tuple(numbers.tolist())


def parse_isolines(isolines: Any) -> tuple[Isolines, ...]:
    """`Isolines`, or a list of them, as a tuple; empty for None.

    Raises:
        TypeError: anything else.
    """
    if isolines is None:
        return ()
    is_list: bool = isinstance(isolines, list | tuple)
    elements: list[Any] = [*isolines] if is_list else [isolines]
    for element in elements:
        if not isinstance(element, Isolines):
            raise TypeError(
                "isolines must be harnack.Isolines, or a list of them, such as "
                f'hk.Isolines("z", interval=0.1), not {element!r}'
            )
    return tuple(elements)


@dataclass(frozen=True)
class PreparedIsolines:
    """Isolines on a backend; all of their numbers are data, which kernels do not depend on.

    volume: where the function is defined; None for all of space.
    spacing: of lines at whole multiples of it.
    levels: a table, for lines at single levels.
    """

    function: Field
    volume: Volume | None
    half_width: Real
    spacing: Real | None
    levels: Real | None
    period: Real | None

    def contains(self, p: Vec3, normal: Vec3) -> Mask:
        """Whether points of a surface, with unit normals, are on a line."""
        gap, along = self._gap_and_gradient(p, normal)
        return gap < self.half_width * norm(along)

    def edge_is_near(self, p: Vec3, normal: Vec3, across: Vec3, down: Vec3) -> Mask:
        """Whether the edge of a line passes through a pixel, to first order, or near it.

        across, down: from a pixel's middle on the surface to those of its neighbors.
        """
        gap, along = self._gap_and_gradient(p, normal)
        reach = dr.abs(dr.dot(along, across)) + dr.abs(dr.dot(along, down))
        return dr.abs(gap - self.half_width * norm(along)) < reach

    def _gap_and_gradient(self, p: Vec3, normal: Vec3) -> tuple[Real, Vec3]:
        """The gap from g to the nearest level, and the gradient of g along the surface."""
        sample = self.function.evaluate(p)
        gradient = sample.gradient
        along = gradient - dr.dot(gradient, normal) * normal
        counts = norm(along) > _ROUNDING * norm(gradient)
        if self.volume is not None:
            counts &= self.volume.contains(p)
        return self._gap(sample.value), dr.select(counts, along, 0)

    def _gap(self, g: Real) -> Real:
        if self.spacing is not None:
            return dr.abs(g - self.spacing * dr.round(g / self.spacing))
        if self.period is not None:
            g = g - self.period * dr.floor(g / self.period)
        table = cast("Any", self.levels)
        index = dr.uint32_array_t(type(g))
        # The number of entries below g, digit by digit; the table has one less than a power of 2.
        below, step = index(0), (len(table) + 1) // 2
        while step:
            entry = dr.gather(type(g), table, below + (step - 1))
            below, step = dr.select(entry < g, below + step, below), step // 2
        before = dr.gather(type(g), table, dr.select(below > 0, below - 1, 0))
        after = dr.gather(type(g), table, dr.minimum(below, len(table) - 1))
        return dr.minimum(dr.abs(g - before), dr.abs(g - after))


def isoline_index_at(
    lines: tuple[PreparedIsolines, ...], p: Vec3, normal: Vec3, index: Any
) -> Index:
    """The number of the isoline that points are on, counted from 1; the last isoline where they
    overlap; 0 for no isoline.

    index: the type of the numbers.
    """
    line_index = index(0)
    for number, isoline in enumerate(lines, start=1):
        line_index = dr.select(isoline.contains(p, normal), index(number), line_index)
    return line_index
