"""Isolines: lines of constant width on a surface, where another function g takes given values, its
levels.

A point of the surface belongs to a line if its distance from the curve {g = level} on the surface
is less than width/2. To first order this distance is |g - level| / |grad_T g|, where grad_T g is
the part of the gradient of g tangent to the surface. So a line is equally wide where g is steep and
where it is not. The test is made without division, |g - level| < width/2 |grad_T g|, so that
nothing is drawn where g is constant along the surface, even if g equals the level there.

Width near a critical point of g on the surface. To leading order let g - level be a homogeneous
polynomial q of degree n in the position on the surface (n = 2 at nondegenerate maxima, minima and
saddles). At the distance r from the point, |grad_T g| <= n Q/r, where Q is the largest |q| at this
distance (Kellogg 1928). So in directions with |q| >= Q/k the line ends before r = k n/2 width. A
maximum at the level is therefore a dot twice as wide as a line, and lines that cross at a saddle
are joined by a fillet of that size. If a maximum is a little higher than the level, g - level =
(R^2 - r^2)/2 at the distance r, and the line is {|r^2 - R^2| < width r}, which is r < width/2 +
sqrt(width^2/4 + R^2) <= R + width. So the line ends at most width/2 too far out.

Isolines are found once for each hit. The number of the isoline then travels as the primitive index
of Mitsuba's surface interaction, by which the BSDF chooses a color (`mitsuba_proxy`). So g is not
evaluated again at each call of the BSDF.

Pictures of values of a function use `as_field` and `padded_domain` of this module, too.
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
from harnack.rendering.scales import Color, parse_color

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Index, Mask, Real, Vec3
    from harnack.fields import Evaluator
    from harnack.geometry import Volume

# A surface that is cut by the function's own domain reaches beyond it by rounding, at most by this
# part of its size.
_PADDING = 1e-5


def as_field(function: Any, name: str = "color_by") -> Field:
    """Return a function on space as a `Field`.

    function: a field, which is returned; or what `harnack.expression` takes, a Python function of
        three coordinates or a text such as "z".
    name: of the argument, for messages.

    Raises:
        TypeError, ValueError: another argument, or a field that has a function of its own for each
            part of space.
    """
    from harnack.fields.expressions import expression  # imported here: few pictures need it

    if isinstance(function, str):
        try:
            return expression(function)
        except ValueError as error:  # the name may end with a comma, which suits other messages
            raise ValueError(f"{name.rstrip(',')}: {error}") from None
    if isinstance(function, Field):
        if function.traits.has_patches:
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
    """Return the volume in which a function is defined, with a margin for rounding; None if that is
    all of space.

    size: the length of the surface on which the function is evaluated; the margin is 1e-5 of it.
    """
    if function.domain is None or function.traits.is_global:
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
        Python function of x, y and z as `harnack.expression` takes it. Its coordinates are the
        coordinates of the surface, wherever the surface is placed. There are no lines outside the
        `domain` of a field, unless the field is defined everywhere (`is_global`).
    levels: the value, or several, at which there are lines. If the values of the field are angles,
        levels are taken modulo its period.
    interval: in place of levels: there are lines at all whole multiples of this number. It must
        divide the period of a field whose values are angles. Such a field has 12 lines if neither
        levels nor interval is given.
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
        self._exact_interval()  # raises the error of an interval that does not divide the period

    def _exact_interval(self) -> float | None:
        """Return the difference of neighboring levels; None if the levels are listed. For a
        periodic function it is exactly a fraction of the period.

        Raises:
            ValueError: the interval does not divide the period.
        """
        period = self.function_field.period
        if self.levels is not None or period is None:
            return self.interval
        line_count = _DEFAULT_LINE_COUNT if self.interval is None else round(period / self.interval)
        # A user's interval may be rounded, such as 0.3333.
        if self.interval is not None and abs(line_count * self.interval - period) > 1e-4 * period:
            raise ValueError(
                f"the function has the period {period:.6g}, and an interval of {self.interval:g} "
                "does not divide it: lines would end where it is passed. "
                "Give period / n, or levels"
            )
        return period / line_count

    def upload(self, backend: Backend, size: float) -> DeviceIsolines:
        """Return the isolines with their numbers uploaded to a backend (the device that traces
        rays).

        size: the diagonal of the surface's box, 0.4 percent of which is the default width of a
            line.
        """
        width = _DEFAULT_WIDTH * size if self.width is None else self.width
        step, period = self._exact_interval(), self.function_field.period
        volume = padded_domain(self.function_field, size)
        # g, its volume, half the width of a line, the interval or else the table of levels, and the
        # period of g; what does not exist is None.
        return DeviceIsolines(
            self.function_field.evaluator(backend),
            None if volume is None else volume.upload(backend),
            dr.opaque(backend.Float, 0.5 * width),
            None if step is None else dr.opaque(backend.Float, step),
            None if step is not None else upload_floats(backend, _table(self.levels, period)),
            None if period is None else dr.opaque(backend.Float, period),
        )


def _table(levels: tuple[float, ...], period: float | None) -> FloatArray:
    """Return a table of 2^k - 1 numbers in ascending order: the levels, then inf as filler.
    `DeviceIsolines` searches it for the level nearest to a value.

    period: of a function whose values are angles, else None. The levels of such a function are
        reduced to [0, period). A copy of the last level minus the period precedes them, and a copy
        of the first level plus the period follows them. So both neighbors of every value in [0,
        period) are in the table.
    """
    ordered = np.unique(np.array(levels) if period is None else np.mod(levels, period))
    if period is not None:
        ordered = np.array([ordered[-1] - period, *ordered, ordered[0] + period])
    # Kernels depend on the length, so short tables all have the same one.
    table_length = max(_MIN_TABLE_LENGTH, 2 ** len(ordered).bit_length()) - 1
    return np.concatenate([ordered, np.full(table_length - len(ordered), np.inf)])


def _numbers(levels: Any) -> tuple[float, ...]:
    """Return levels, one number or several, as a tuple of finite floats.

    Raises:
        TypeError, ValueError: anything else.
    """
    try:
        # A text is refused, also one that NumPy would read, such as "1": "none" is no number.
        numbers = np.atleast_1d(np.asarray("none" if isinstance(levels, str) else levels, float))
    except (TypeError, ValueError):
        raise TypeError(f"levels of isolines must be numbers, not {levels!r}") from None
    if numbers.ndim != 1 or not numbers.size or not np.isfinite(numbers).all():
        raise ValueError(f"levels of isolines must be finite numbers, at least one, not {levels!r}")
    return tuple(numbers.tolist())


def parse_isolines(isolines: Any) -> tuple[Isolines, ...]:
    """Return the value of the option `isolines` as a tuple of `Isolines`. The value is None, an
    `Isolines`, or a list of them.

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
class DeviceIsolines:
    """Isolines whose numbers are uploaded to a backend (the device that traces rays). The lines are
    on a surface, where another function g takes given values, its levels. All numbers are kernel
    parameters, so other numbers compile no other kernel.

    function: samples the function g.
    volume: the volume in which g is defined; None for all of space.
    half_width: half the width of a line, a length.
    spacing: if the lines are at all whole multiples of a number, this number; else None.
    levels: if the lines are at listed levels, the sorted table of `_table`; else None.
    period: the period of g if its values are angles, else None.
    """

    function: Evaluator
    volume: Volume | None
    half_width: Real
    spacing: Real | None
    levels: Real | None
    period: Real | None

    def contains(self, p: Vec3, normal: Vec3) -> Mask:
        """Return the mask of points p (3,) of a surface that are on a line. normal: (3,) the
        surface's unit normals there."""
        distance_in_value, tangential_gradient = self._gap_and_gradient(p, normal)
        return distance_in_value < self.half_width * norm(tangential_gradient)

    def edge_is_near(self, p: Vec3, normal: Vec3, across: Vec3, down: Vec3) -> Mask:
        """Return the mask of pixels through which the edge of a line passes, to first order, or
        near which it passes.

        p, normal: (3,) the point of the surface in the middle of the pixel, and the unit normal
            there.
        across, down: (3,) vectors from p to the points of the tangent plane in the middles of the
            neighboring pixels.

        The edge is where |g - level| equals half_width |grad_T g|. A pixel is in the mask if the
        difference of the two at p is less than `reach`, which to first order bounds |g - g(p)| in
        the whole pixel and at the middles of its eight neighbors.
        """
        distance_in_value, tangential_gradient = self._gap_and_gradient(p, normal)
        reach = dr.abs(dr.dot(tangential_gradient, across)) + dr.abs(
            dr.dot(tangential_gradient, down)
        )
        return dr.abs(distance_in_value - self.half_width * norm(tangential_gradient)) < reach

    def _gap_and_gradient(self, p: Vec3, normal: Vec3) -> tuple[Real, Vec3]:
        """Return |g - nearest level| at points p, and the part (3,) of the gradient of g tangent to
        the surface.

        normal: (3,) the surface's unit normals.

        The gradient is 0 outside the domain of g, and where its tangential part is so small that it
        is due to rounding. So there is no line at such points.
        """
        sample = self.function.evaluate(p)
        gradient = sample.gradient
        tangential = gradient - dr.dot(gradient, normal) * normal
        is_valid = norm(tangential) > _ROUNDING * norm(gradient)
        if self.volume is not None:
            is_valid &= self.volume.contains(p)
        return self._gap(sample.value), dr.select(is_valid, tangential, 0)

    def _gap(self, g: Real) -> Real:
        """Return the distance of values g from the nearest level, for g modulo the period if there
        is one."""
        if self.spacing is not None:
            return dr.abs(g - self.spacing * dr.round(g / self.spacing))
        if self.period is not None:
            g = g - self.period * dr.floor(g / self.period)
        table = cast("Any", self.levels)
        uint = dr.uint32_array_t(type(g))
        # Binary search for the number of entries below g, from its highest bit to its lowest. The
        # length of the table is a power of 2 minus 1.
        entries_below, bit = uint(0), (len(table) + 1) // 2
        while bit:
            # Are at least `bit` more entries below g?
            entry = dr.gather(type(g), table, entries_below + (bit - 1))
            entries_below, bit = dr.select(entry < g, entries_below + bit, entries_below), bit // 2
        # The nearest level is one of the two neighbors of g in the table.
        before = dr.gather(type(g), table, dr.select(entries_below > 0, entries_below - 1, 0))
        after = dr.gather(type(g), table, dr.minimum(entries_below, len(table) - 1))
        return dr.minimum(dr.abs(g - before), dr.abs(g - after))


def isoline_index_at(lines: tuple[DeviceIsolines, ...], p: Vec3, normal: Vec3, index: Any) -> Index:
    """Return the number of the isoline on which each point lies, counted from 1; 0 if it lies on
    none, and the last one if several overlap.

    lines: the isolines, in the order of their numbers.
    p, normal: (3,) points of the surface and unit normals.
    index: the array type of the result.
    """
    line_index = index(0)
    for number, isoline in enumerate(lines, start=1):
        line_index = dr.select(isoline.contains(p, normal), index(number), line_index)
    return line_index
