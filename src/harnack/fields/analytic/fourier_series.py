"""Any function on a box, as a cosine series fitted to it (paper, section 4.7.1). The series is the
sum of a_ijk cos(i u) cos(j v) cos(k w) with coefficients a_ijk, whose angles u, v and w go from 0
to pi along the sides of the box. The fitted function is a callable of the user or a grid of its
values at the midpoints of cells of the box. The field is the series; the fitted function serves
only to measure by how much the series differs from it."""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend.validation import as_real_array
from harnack.fields.analytic.cosine_series import CosineBounds, CosineSums, fit_cosines, midpoints
from harnack.fields.analytic.waves import mean_wavelength
from harnack.fields.attached_arrays import (
    attached_array,
    host_array,
    separate_variable,
    with_formula,
)
from harnack.fields.batched_fields import cached_upload
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Sample, Traits, validate_levels_in_range
from harnack.fields.parameters import kept_arguments
from harnack.geometry.clip_volumes import Box

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, FloatArray, Real, Vec3
    from harnack.geometry.volume import Volume

__all__ = ["FourierSeries", "SurfaceDisplacement"]

_MAX_TERMS = 24
# The default number of samples along a side of the box for each term; the smallest default number
# of samples along a side; the largest number of samples in all.
_SAMPLES, _MIN_SAMPLES, _MAX_SAMPLES = 4, 64, 1 << 25
# The number of points at which the error of a fit is measured; the number of Newton steps that move
# them to the surface, and their tolerance.
_CHECK_POINTS, _NEWTON_STEPS, _CONVERGED = 20_000, 12, 1e-9
# Coefficients below this fraction of the fitted values are rounding errors.
_MIN_COEFFICIENT = 1e-13
# A factor that covers terms of second order in the unit roundoff.
_SECOND_ORDER = 1.05

# A function of points (n, 3) with values (n,).
Function: TypeAlias = Callable[["FloatArray"], Any]


@dataclass(frozen=True)
class SurfaceDisplacement:
    """An estimate of the distance between two surfaces: the level set of a cosine series, and that
    of the function to which the series was fitted. It is made at points of the series' surface,
    where the distance is about |function - level|/|gradient of the series|.

    mean, largest: the mean and the largest distance, lengths.
    count: the number of points.
    """

    mean: float
    largest: float
    count: int


class FourierSeries(Field):
    """A cosine series on a box: f is the sum of a_ijk cos(i u) cos(j v) cos(k w), whose angles u, v
    and w go from 0 to pi along the sides of the box. `fit` computes the series of any function or
    grid of values.

    **All proofs are about the series**, not about the function that it was fitted to: `fit_error`
    is the difference of their values and `displacement` the distance of their surfaces, both by
    sampling.

    Beyond the faces of the box the series is a reflection of itself. It converges quickly if the
    function is smooth and has no slope across the faces. Kinks, such as those of distances, cost
    accuracy. So does a function that is very steep far from the surface: compress it first, for
    example by tanh.

    coefficients: (K_x, K_y, K_z) the a_ijk; each of the three sizes is at most 24. Values,
        gradients and hits can be differentiated by them if they are a Dr.Jit tensor.
    box: a finite `Box`.

    Promises (proved bounds of f near a point): bounds of the second derivatives (`CosineBounds` has
    the proof), on the whole box and, if local bounds are smaller, on balls around the cells of
    grids over it. Rounding, in units of the unit roundoff: an angle k u has the error of u (3
    roundings, which move the point) and that of the product, at most k pi; a sine or cosine has 2;
    a coefficient has 1; a term takes part in i + j + k + 3 sums.

    Raises:
        ValueError: coefficients of another shape, not finite, or all zero except the first; a box
            without size.
    """

    traits = Traits(over_relaxation=1.5, differentiable_arguments=("coefficients",))

    fit_error: float | None = None
    """The largest sampled difference of values between series and function; None for a series made
    from coefficients."""

    def __init__(self, coefficients: Any, box: Box | tuple[Any, Any]) -> None:
        """Check the coefficients (K_x, K_y, K_z) and the box, and compute proved bounds of the
        series."""
        checked = host_array(coefficients, "coefficients")
        if checked.ndim != 3 or 0 in checked.shape:
            raise ValueError(f"coefficients must have shape (K_x, K_y, K_z), not {checked.shape}")
        _check_terms(checked.shape)
        if not np.isfinite(checked).all():
            raise ValueError("coefficients must be finite numbers")
        # Entry 0 is the constant term.
        if not np.any(checked.ravel()[1:]):
            raise ValueError("the series is constant: it has no level sets")
        self.coefficients = checked
        self.domain = self._box = _finite_box(box)
        self._lower, upper = self._box.bounds()
        self._size = upper - self._lower
        self._bounds = CosineBounds.of(checked, self._size)
        wave_vectors = np.indices(checked.shape).reshape(3, -1)[:, 1:].T * (math.pi / self._size)
        min_wavelength = mean_wavelength(checked.ravel()[1:], np.linalg.norm(wave_vectors, axis=1))
        self.traits = dataclasses.replace(self.traits, min_wavelength=min_wavelength)
        self._rounding = _rounding(checked, self._size)
        self._source: Function | FloatArray | None = None

    @classmethod
    def fit(
        cls,
        function: Function | Any,
        box: Box | tuple[Any, Any],
        terms: int | tuple[int, int, int] = 12,
        *,
        samples: int | tuple[int, int, int] | None = None,
    ) -> Self:
        """Compute the cosine series that is closest to a function in mean square.

        function: a callable that takes points (n, 3) and gives values (n,); or a grid (n_x, n_y,
            n_z) of values at the midpoints of that many cells of the box.
        box: a finite `Box`, or its two corners.
        terms: the number of cosines along each axis, one number or three, each from 1 to 24.
        samples: the number of cells along each side on which a callable is sampled, one number or
            three; by default 4 for each term, at least 64.

        Raises:
            ValueError: values that are NaN or infinite, or of another shape; more terms than 24 or
                than samples; a function that is constant; a box without size.
            TypeError: neither a function nor numbers; terms that are no integers.
        """
        counts = _as_triple(terms, "terms")
        _check_terms(counts)
        checked_box = _finite_box(box)
        lower, upper = checked_box.bounds()
        if callable(function):
            default_samples = tuple(max(_SAMPLES * n, _MIN_SAMPLES) for n in counts)
            shape = _as_triple(default_samples if samples is None else samples, "samples")
            if math.prod(shape) > _MAX_SAMPLES:
                raise ValueError(f"{shape} samples are too many: at most {_MAX_SAMPLES} in all")
            _check_samples(counts, shape)
            grid = _values(function, midpoints(lower, upper, shape)).reshape(shape)
        else:
            if samples is not None:
                raise TypeError("samples says where a function is evaluated: a grid has its own")
            grid = as_real_array(function, "a grid", type_error=TypeError).astype(np.float64)
            if grid.ndim != 3 or 0 in grid.shape:
                raise ValueError(f"a grid must have shape (n_x, n_y, n_z), not {grid.shape}")
            _check_samples(counts, cast("tuple[int, int, int]", grid.shape))
            if not np.isfinite(grid).all():
                invalid = np.argwhere(~np.isfinite(grid))
                raise ValueError(
                    f"the grid has {len(invalid)} values that are NaN or infinite, the first at "
                    f"{tuple(invalid[0].tolist())}: replace them by numbers"
                )
        if float(np.ptp(grid)) == 0.0:
            raise ValueError("the function is constant: it has no level sets")
        fitted = fit_cosines(grid, counts)
        # All coefficients but the constant one are rounding errors.
        if np.abs(fitted).sum() - abs(fitted[0, 0, 0]) < _MIN_COEFFICIENT * np.abs(grid).max():
            raise ValueError(
                f"the series of {counts} terms is constant, though the function is not: take more "
                "terms"
            )
        series = cls(fitted, checked_box)
        series._source = cast("Any", function) if callable(function) else grid
        series.fit_error = series._largest_difference()
        return series

    @property
    def value_range(self) -> tuple[float, float]:
        """The ends (low, high) of an interval that is proved to contain all values of the series on
        its box."""
        return self._bounds.low, self._bounds.high

    @property
    def curvature(self) -> float:
        """A proved bound of the absolute second derivatives of the series along any direction, on
        its box."""
        return self._bounds.curvature

    def displacement(self, level: float | None = None, *, rng: int = 0) -> SurfaceDisplacement:
        """Estimate the distance between two level sets: that of the series and that of the fitted
        function.

        level: by default `default_level`.
        rng: the seed of the random points.

        If a callable was fitted, the distance is measured at random points of the series' surface;
        if a grid was fitted, at those of its points that are next to the surface.

        Raises:
            ValueError: the series was not computed by `fit`, or no point of the level was found.
        """
        if self._source is None:
            raise ValueError("the series was made from coefficients: there is no function to miss")
        chosen_level = self.default_level if level is None else float(level)
        points, differences = self._near(chosen_level, rng)
        if not len(points):
            raise ValueError(f"no point with level {chosen_level:g} was found in the box")
        slope = np.linalg.norm(self.gradient(points, precision="double"), axis=1)
        distances = np.abs(differences) / np.maximum(slope, 1e-300)
        return SurfaceDisplacement(float(distances.mean()), float(distances.max()), len(points))

    def _near(self, level: float, rng: int) -> tuple[FloatArray, FloatArray]:
        """Two results: points (n, 3) on or next to the surface of the series at this level; and the
        fitted function minus the series (n,) at each of them.

        level: the level of the surface.
        rng: the seed of the random points, if a callable was fitted. They are moved to the surface
            by Newton's method. If a grid was fitted, the points are those of the grid within about
            a cell of the surface.
        """
        if not callable(self._source):
            grid = cast("FloatArray", self._source)
            points = midpoints(self._lower, self._lower + self._size, grid.shape)
            value = self.value(points, precision="double")
            slope = np.linalg.norm(self.gradient(points, precision="double"), axis=1)
            cell = float((self._size / grid.shape).max())
            is_near = np.abs(value - level) <= slope * cell
            return points[is_near], (grid.ravel() - value)[is_near]
        points_on_surface = self._lower + self._size * np.random.default_rng(rng).random(
            (_CHECK_POINTS, 3)
        )
        for _ in range(_NEWTON_STEPS):
            gradient = self.gradient(points_on_surface, precision="double")
            square = np.maximum((gradient**2).sum(axis=1), 1e-300)
            # A Newton step along the gradient, limited to a tenth of the box.
            difference = (self.value(points_on_surface, precision="double") - level) / square
            step = difference[:, None] * gradient
            length = np.linalg.norm(step, axis=1, keepdims=True)
            points_on_surface = points_on_surface - step * np.minimum(
                1, 0.1 * self._size.min() / np.maximum(length, 1e-300)
            )
            points_on_surface = np.clip(points_on_surface, self._lower, self._lower + self._size)
        slope = np.linalg.norm(self.gradient(points_on_surface, precision="double"), axis=1)
        difference = np.abs(self.value(points_on_surface, precision="double") - level)
        # Points at which the method has not converged are left out.
        points_on_surface = points_on_surface[
            difference <= _CONVERGED * float(self._size.max()) * slope
        ]
        # On the surface the series has the value `level`.
        return points_on_surface, (
            _values(self._source, points_on_surface) if len(points_on_surface) else np.zeros(0)
        ) - level

    def _largest_difference(self) -> float:
        """The largest |series - fitted function|, at random points of the box if a callable was
        fitted, at all points of the grid if a grid was."""
        if callable(self._source):
            # With the seed 0, so that the result is always the same.
            points = self._lower + self._size * np.random.default_rng(0).random((_CHECK_POINTS, 3))
            values = _values(self._source, points)
        else:
            grid = cast("FloatArray", self._source)
            points = midpoints(self._lower, self._lower + self._size, grid.shape)
            values = grid.ravel()
        return float(np.abs(self.value(points, precision="double") - values).max())

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        del plan
        return _SeriesEvaluator(self._upload(backend))

    @cached_upload
    def _upload(self, backend: Backend) -> CosineSums:
        """The coefficients and bounds of the series, uploaded to a backend, in an object that
        evaluates it."""
        return CosineSums.upload(
            backend, self.coefficients, self._lower, self._size, self._bounds, self._rounding
        )

    def with_attached_numbers(self, backend: Backend) -> FourierSeries:
        """The copy whose formula has derivatives by the coefficients."""
        argument = kept_arguments(self)["coefficients"]
        coefficients = attached_array(argument, self.coefficients, backend)
        series = self._upload(backend).with_coefficients(coefficients)

        def expression(p: Vec3) -> tuple[Real, Vec3]:
            return series.value(separate_variable(p), is_sum=True)

        return with_formula(self, expression)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """The box around all cells in which the series may take one of the levels; the whole box if
        there are no such cells.

        levels: the levels.
        """
        fractions = self._bounds.extent(levels)
        if fractions is None:
            return self.domain
        low, high = fractions
        corners = self._lower + low * self._size, self._lower + high * self._size
        return Box(cast("Any", tuple(corners[0].tolist())), cast("Any", tuple(corners[1].tolist())))

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level outside of the range of the series in its box."""
        validate_levels_in_range(levels, self.value_range, "in its box the series")

    def describe(self) -> dict[str, Any]:
        """The size of the series, its proved bounds and the error of the fit, as a dictionary for
        users."""
        return {
            "terms": self.coefficients.shape,
            "range": self.value_range,
            "second derivatives": self.curvature,
            "grids of local bounds": tuple(cells.count for cells in self._bounds.cells),
            "error of the fit": self.fit_error,
        }


@dataclass(frozen=True, eq=False)
class _SeriesEvaluator(Evaluator):
    """The evaluator of a `FourierSeries`, which has the proofs.

    series: the coefficients and bounds of the series on the backend.
    """

    series: CosineSums

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: value and gradient of the series, bounds of their rounding errors, and
        proved bounds of second derivatives on balls about p."""
        series = self.series
        value, gradient = series.value(p)
        roundoff = float(dr.epsilon(type(value))) * _SECOND_ORDER
        # The rounding of an angle, (p - lower) pi/size, moves the point: three roundings of p -
        # lower (of the difference, of pi/size and of the product), and that of `lower`.
        moves = [
            dr.fma(3.0, dr.abs(p[k] - series.lower[k]), dr.abs(series.lower[k])) for k in range(3)
        ]
        error = sum((moves[k] * dr.abs(gradient[k]) for k in range(3)), 0 * p.x)
        # Entry 0 of `rounding` is for the value, entry 1 for the gradient.
        error = roundoff * (error + series.rounding[0])
        move_length = dr.norm(series.backend.Array3f(*moves))
        # A move of the point changes the gradient by at most the bound of second derivatives times
        # the length.
        slope_error = roundoff * dr.fma(series.curvature, move_length, series.rounding[1])
        return Sample(value, gradient, series.curvatures(p), error, slope_error)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of the series at p."""
        return self.series.hessian(p)


def _as_triple(numbers: Any, name: str) -> tuple[int, int, int]:
    """Three integers, from one integer, which is repeated, or from three.

    numbers: the integer, or the three.
    name: what the integers are, for the messages.

    Raises:
        TypeError, ValueError: neither one integer nor three.
    """
    try:
        number = operator.index(numbers)
    except TypeError:
        try:
            triple = tuple(operator.index(n) for n in numbers)
        except TypeError as error:
            raise TypeError(
                f"{name} must be whole numbers, one or three, not {numbers!r} ({error})"
            ) from None
        if len(triple) != 3:
            raise ValueError(f"{name} must be one number or three, not {len(triple)}") from None
        return triple[0], triple[1], triple[2]
    return number, number, number


def _check_terms(terms: tuple[int, ...]) -> None:
    """Raise ValueError if a number of terms along an axis is not from 1 to 24."""
    if min(terms) < 1 or max(terms) > _MAX_TERMS:
        raise ValueError(
            f"terms must be 1 to {_MAX_TERMS} along each axis, not {tuple(terms)}: an evaluation "
            "takes about 2 K^3 products. Fit a smaller box or a smoother function instead"
        )


def _check_samples(terms: tuple[int, int, int], shape: tuple[int, int, int]) -> None:
    """Raise ValueError if there are fewer samples than terms along an axis.

    terms: the numbers of terms along the axes.
    shape: the numbers of samples along the axes.
    """
    if any(k > n for k, n in zip(terms, shape, strict=True)):
        raise ValueError(
            f"{terms} terms cannot be told apart by {shape} samples: take fewer terms or more "
            "samples"
        )


def _finite_box(box: Any) -> Box:
    """A box with finite sides longer than 0, from a `Box` or from its two corners.

    Raises:
        TypeError, ValueError: it is no such box.
    """
    try:
        volume = box if isinstance(box, Box) else Box(*box)
    except TypeError:
        raise TypeError(f"box must be a harnack.Box or two corners, not {box!r}") from None
    lower, upper = volume.bounds()
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower < upper).all()):
        raise ValueError(f"the box of a series needs finite sides longer than 0, not {volume}")
    return volume


def _values(function: Function, points: FloatArray) -> FloatArray:
    """The values (n,) of the user's function at points (n, 3), after checks.

    Raises:
        TypeError, ValueError: they are not n finite numbers.
    """
    values = as_real_array(function(points), "values of the function", type_error=TypeError)
    if values.shape != (len(points),):
        raise ValueError(
            f"the function must give one value for each point (n, 3): for {len(points)} points it "
            f"gave an array of shape {values.shape}"
        )
    ids = np.flatnonzero(~np.isfinite(values))
    if ids.size:
        raise ValueError(
            f"the function is {values[ids[0]]} at {points[ids[0]].tolist()}, and NaN or infinite "
            f"at {ids.size} of {len(points)} points: bound it first"
        )
    return values.astype(np.float64)


def _rounding(coefficients: FloatArray, size: FloatArray) -> tuple[float, float]:
    """Two bounds, of the rounding errors of the value and of the gradient of a cosine series, as
    multiples of the unit roundoff (half of the machine epsilon). `FourierSeries` has the proof. The
    rounding of the angles, which acts like a move of the point, is left out.

    coefficients: (K_x, K_y, K_z).
    size: (3,) the lengths of the box's sides.
    """
    i, j, k = np.indices(coefficients.shape)
    # Of a term: its angles are at most i pi, j pi and k pi; 2 for each of three sines or cosines, 1
    # for the coefficient, and i + j + k + 3 sums.
    roundings = (i + j + k) * (math.pi + 1) + 10
    abs_coefficients = np.abs(coefficients)
    slopes = [
        math.pi / size[axis] * float((abs_coefficients * n * (roundings + 4)).sum())
        for axis, n in enumerate((i, j, k))
    ]
    return float((abs_coefficients * roundings).sum()), math.hypot(*slopes)
