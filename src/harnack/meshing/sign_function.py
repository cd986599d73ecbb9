"""Functions whose level set is meshed by the signs of their values: their values at points, and the
points where segments cross the level. "The function" is side * (f - level) for a field f and side =
1 or -1. A "jump surface" is a surface across which f jumps, such as the triangles of a mesh whose
winding number f is; a "facet" is one of its triangles.

Every real-valued function has a sign at every point, whether or not it is continuous. Winding
numbers jump at triangles and are known up to an error, and potentials of dipoles are infinite at
points: Newton's method fails for both. Here a segment whose ends have different signs is halved
several times, by values alone, and what is left is intersected with the jump surfaces of the field,
such as triangles.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend
from harnack.backend.validation import format_vector
from harnack.enclosures import Levels
from harnack.fields.batch_evaluation import map_batches
from harnack.fields.batched_fields import BatchedField
from harnack.fields.blobs.blobs import Blobs
from harnack.fields.blobs.hrbf import HRBF
from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.fields.clearance import level_distance_lower_bound
from harnack.fields.solid_angles.dipole import DipolePotential
from harnack.fields.solid_angles.winding_number import WindingModuloOne, WindingNumber
from harnack.geometry.clouds import build_point_tree
from harnack.geometry.denoising import outlier_indices
from harnack.geometry.mesh_edges import row_dots, row_norms, unit_rows
from harnack.meshing.level_function import LevelFunction, LevelSamples
from harnack.meshing.meshing_errors import MeshingError

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.fields import Field

__all__ = ["SignFunction", "cell_size_for_smoothing", "empty_surface_hint", "uses_sign_meshing"]

# How often a segment is halved before it is intersected with facets; and how often a smooth
# function is evaluated along a segment, in turn where the secant meets the level and in the middle.
_HALVINGS, _MAX_EVALUATIONS = 4, 8
# A search along a segment ends at a value smaller than this, relative to the values at both ends.
_NEAR_ROOT = 1e-3
# How far a segment is extended beyond both of its ends, relative to its remaining length.
_EXTENSION = 1e-6
# Single precision is used where it distinguishes this many points along a cell.
_STEPS_IN_CELL = 1000
# Surfaces with a smoothing length below this, relative to a cell, have details that the cell does
# not show: of five meshes, cells up to 2.8 smoothing lengths were enough, and cells above 3.9 were
# not. Cells of the second number of smoothing lengths show the details, but not the noise: by
# experiment cells of 7 lose thin edges, and cells below 4 show bubbles around single points.
_UNRESOLVED_SMOOTHING, _RESOLVED_SMOOTHING_LENGTHS = 0.3, 4.8
# The largest number of points of a cloud at which its value is tested, and the fraction of the
# level that it must reach.
_MOST_PROBES, _MIN_VALUE_SHARE = 2000, 0.1


def uses_sign_meshing(field: Field) -> bool:
    """Whether the level sets of a field are meshed from the signs of its values on a lattice. It is
    so for sums over meshes, points and blobs. Their values cost little time, and their proved
    bounds of f near a point are useful only up to the next triangle or point."""
    return isinstance(field, BatchedField | Blobs | HRBF)


def cell_size_for_smoothing(
    field: Field, spacing: float, largest_factor: float, smallest_factor: float
) -> float:
    """The size of the lattice's cells, a length: `spacing`, or less for the field of a point cloud
    that is smoothed.

    If the smoothing length of the cloud is less than 0.3 `spacing`, its surface is likely to have
    details too small for cells of size `spacing`. Then cells are about 4.8 smoothing lengths wide,
    but at least `smallest_factor` and at most `largest_factor` times `spacing`."""
    if (
        not isinstance(field, DipolePotential)
        or not 0 < field.smoothing < _UNRESOLVED_SMOOTHING * spacing
    ):
        return spacing
    return min(
        max(_RESOLVED_SMOOTHING_LENGTHS * field.smoothing, smallest_factor * spacing),
        largest_factor * spacing,
    )


def empty_surface_hint(field: Field) -> str:
    """A likely reason why a mesh is empty, as the end of an error message: some points of the cloud
    are far from all others, so that cells are too large. "" if that is not so."""
    if not isinstance(field, DipolePotential) or len(field.points) < 2:
        return ""
    outliers = outlier_indices(field.points, build_point_tree(field.points))
    if not len(outliers):
        return ""
    return (
        f"; {len(outliers):,} of {len(field.points):,} points are far from all others, such as "
        f"{format_vector(field.points[outliers[0]])}, and make cells too large: leave them out, as "
        'smoothing="auto" does, or give a `cell_size`'
    )


@dataclass
class SignFunction(LevelFunction):
    """The function side * (f - level) of a real-valued field f, which need not be continuous. Its
    level set is found from the signs of values, not by Newton's method.

    side: 1; or -1 for a function that is negative where f is above the level.
    precision: the precision in which values are computed. Intersections of segments with jump
        surfaces are computed in double precision."""

    side: float = dataclasses.field(default=1.0, kw_only=True)
    precision: Precision = dataclasses.field(default="double", kw_only=True)

    def __post_init__(self) -> None:
        self._clearances: list[Callable[[FloatArray], FloatArray]] = []

    @classmethod
    def of(
        cls,
        field: Field,
        level: float,
        box: tuple[FloatArray, FloatArray],
        spacing: float,
        *,
        side: float = 1.0,
        most_faces: int,
    ) -> SignFunction:
        """Make the function side * (f - level) of the field's function f.

        box: the lower and the upper corner (3,) of the box in which it will be evaluated.
        spacing: the size of the cells of the lattice, a length. Values are computed in single
            precision if that resolves such cells everywhere in the box, else in double precision.
        side: 1, or -1 to reverse the sign.
        most_faces: the largest number of triangles of a mesh of the function.

        Raises:
            MeshingError: the field is that of a point cloud, and the normals of its points do not
                face outwards, or its points enclose nothing.
        """
        if isinstance(field, DipolePotential):
            _check_encloses(field, level)
        largest_coordinate = float(np.abs(box).max())
        # A thousand numbers of single precision along a cell, even at the largest coordinate.
        is_single_enough = largest_coordinate * 2.0**-24 * _STEPS_IN_CELL < spacing
        precision: Precision = "single" if is_single_enough else "double"
        return cls(field, level, side=side, precision=precision, most_faces=most_faces)

    def relative_to_level(self, value: FloatArray) -> FloatArray:
        """(n,) the function, side * (f - level), for values (n,) of f."""
        return self.side * (np.asarray(value, np.float64) - self.level)

    def values(self, points: FloatArray) -> FloatArray:
        """(n,) the values of the function at points (n, 3). They count as evaluations."""
        self.evaluations += len(points)
        return self.relative_to_level(self.field.value(points, precision=self.precision))

    def sample(self, points: FloatArray) -> LevelSamples:
        """The values and gradients of the function at points (n, 3). For a field that jumps,
        gradients are set to 0, since they tell nothing about the distance to the level set. Radii
        (`quarter_period_radius`) are 0."""
        no_radius = np.zeros(len(points))
        if self.field.traits.has_jumps:
            return LevelSamples(self.values(points), np.zeros((len(points), 3)), no_radius)
        self.evaluations += len(points)
        if isinstance(self.field, BatchedField):
            value, gradient = self.field.rough_value_and_gradient(points, precision=self.precision)
        else:
            backend = choose_backend(self.precision)
            evaluator = self.field.evaluator(backend)

            def value_and_gradient(p: Vec3) -> tuple[Real, Vec3]:
                """Two results for the points p: the value and the gradient of the field."""
                sample = evaluator.evaluate(p)
                return sample.value, sample.gradient

            value, gradient = map_batches(backend, value_and_gradient, points)
        return LevelSamples(
            self.relative_to_level(value), self.side * np.asarray(gradient, np.float64), no_radius
        )

    def count_undecided(self, points: FloatArray, value: FloatArray) -> int:
        """The number of points at which the sign of the function is not certain, because the bound
        of the value's error is at least |value|.

        value: (n,) the values of the function at points (n, 3).

        The error bound is computed only where |value| is less than a hundredth of the median of
        |value|. Without an error bound, as for blobs, the number is 0."""
        if not isinstance(self.field, BatchedField):
            return 0
        median_value = float(np.median(np.abs(value))) if len(value) else 0.0
        is_small = np.abs(value) < 1e-2 * median_value
        if not is_small.any():
            return 0
        error = self.field.error_bound(points[is_small], precision=self.precision)
        return int((np.abs(value[is_small]) <= error).sum())

    def clearance(self, points: FloatArray) -> FloatArray:
        """(n,) a proved lower bound of the distance of points (n, 3) from the level set, computed
        by `level_distance_lower_bound`.

        A winding number jumps at the triangles of its mesh, but modulo 1 it is smooth across them.
        For it the bound is the smaller of two lengths: the bound for the winding number modulo 1,
        and the distance from the triangles."""
        self.evaluations += len(points)
        if not self._clearances:
            self._clearances = _clearances(self.field, self.level, self.precision)
        distances = [bound(points) for bound in self._clearances]
        return np.min(distances, axis=0)

    def crossings(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where segments meet the level set.

        low, high: (n, 3) their ends. The function is not positive at `low` and positive at `high`.

        Returns:
            The points (n, 3), and unit normals (n, 3) there towards where the function grows. Where
            the function changes its sign by a jump, the point lies on the facet, to rounding.
        """
        if not len(low):
            return low.copy(), low.copy()
        direction = high - low
        t = np.zeros(len(low))
        normal, is_on_jump = np.zeros_like(low), np.zeros(len(low), np.bool_)
        if self.field.traits.has_jumps:
            # Halve the segments until few facets are left on them, and then intersect them with
            # these. Segments that meet none have a root.
            first, last = self._bisect(low, direction)
            t, normal, is_on_jump = self._jump_crossings(low, direction, first, last)
            # The shortened segments need two evaluations only.
            rows = np.flatnonzero(~is_on_jump)
            t[rows] = self._roots(low[rows], direction[rows], first[rows], last[rows], 2)
        else:
            # On the whole segments, from 0 to 1.
            t = self._roots(low, direction, t, t + 1, _MAX_EVALUATIONS)
        x = low + t[:, None] * direction
        smooth_rows = np.flatnonzero(~is_on_jump)
        normal[smooth_rows] = self._slopes(x[smooth_rows], direction[smooth_rows])
        is_falling = is_on_jump & (row_dots(normal, direction) < 0)
        normal[is_falling] *= -1
        return x, unit_rows(normal)

    def _slopes(self, x: FloatArray, direction: FloatArray) -> FloatArray:
        """(n, 3) gradients of the function at points x (n, 3).

        direction: (n, 3) for each point, the vector along a segment through it on which the
            function grows. It is returned where the gradient is 0 or not finite."""
        if not len(x):
            return x
        self.evaluations += len(x)
        if isinstance(self.field, BatchedField) and not self.field.traits.has_jumps:
            # [1]: the gradient.
            field_gradient = self.field.rough_value_and_gradient(x, precision=self.precision)[1]
        else:
            field_gradient = self.field.gradient(x, precision=self.precision)
        gradient = self.side * np.asarray(field_gradient, np.float64)
        has_no_gradient = ~np.isfinite(gradient).all(axis=1) | ~gradient.any(axis=1)
        gradient[has_no_gradient] = direction[has_no_gradient]
        return gradient

    def _bisect(self, start: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Shorten segments by halving them four times, so that the function still has different
        signs at both ends.

        start, direction: (n, 3) one end of each segment, and the vector to the other. The function
            is not positive at the first end and positive at the other.

        Returns two arrays (n,): the fractions of the original segments at which the shortened ones
        begin and end.
        """
        first, last = np.zeros(len(start)), np.ones(len(start))
        for _ in range(_HALVINGS):
            t = 0.5 * (first + last)
            is_positive = self.values(start + t[:, None] * direction) > 0
            first, last = np.where(is_positive, first, t), np.where(is_positive, t, last)
        return first, last

    def _roots(
        self, start: FloatArray, edge: FloatArray, first: FloatArray, last: FloatArray, steps: int
    ) -> FloatArray:
        """(n,) the fractions of segments at which the function is 0, between the fractions `first`
        and `last`.

        start, edge: (n, 3) one end of each segment, and the vector to the other. The function is
            not positive at `first` and positive at `last`.
        steps: the largest number of evaluations.

        The root of the secant and the middle of the interval are tried in turn, so that every
        second step at least halves the interval. A search ends early if the value is small compared
        with the values at both ends: then the root of one more secant is accurate enough."""
        if not len(start):
            return first
        first, last = first.copy(), last.copy()
        low, high = (self.values(start + t[:, None] * edge) for t in (first, last))
        small_value = _NEAR_ROOT * np.minimum(np.abs(low), np.abs(high))
        rows = np.arange(len(start))
        for k in range(steps):
            ends = first[rows], last[rows]
            # Odd steps halve the interval, even ones take the root of the secant.
            t = 0.5 * (ends[0] + ends[1]) if k % 2 else _secant(*ends, low[rows], high[rows])
            value = self.values(start[rows] + t[:, None] * edge[rows])
            is_positive = value > 0
            first[rows], last[rows] = (
                np.where(is_positive, ends[0], t),
                np.where(is_positive, t, ends[1]),
            )
            low[rows] = np.where(is_positive, low[rows], value)
            high[rows] = np.where(is_positive, value, high[rows])
            rows = rows[~(np.abs(value) <= small_value[rows])]
            if not len(rows):
                break
        return _secant(first, last, low, high)

    def _jump_crossings(
        self, start: FloatArray, direction: FloatArray, first: FloatArray, last: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Where segments first cross a jump surface of the field, between the fractions `first` and
        `last`.

        start, direction: (n, 3) one end of each segment, and the vector to the other.

        Returns:
            The fractions (n,) of the crossings; the normals (n, 3) of the surface there, 0 where
            there is no crossing; and the mask (n,) of segments that cross one.
        """
        backend = choose_backend("double")
        jumps = self.field.evaluator(backend).jumps
        assert jumps is not None
        length = row_norms(direction)
        ray = direction / np.maximum(length, 1e-300)[:, None]
        # Rays begin a little before the interval and end a little after it, so that rounding loses
        # no crossing at its ends.
        extension = _EXTENSION * (last - first)
        origin = start + (first - extension)[:, None] * direction
        max_t = (last - first + 2 * extension) * length

        def next_crossing(o: Vec3, d: Vec3, limit: Vec3) -> tuple[Real, Vec3]:
            """The t and the normal of the first crossing of a jump surface along rays o + t d, for
            t up to limit.x; t is infinite if there is none."""
            zero = backend.Array3f(0)
            # The place t = 0 of the ray, on no facet, with no jump and no normal. All lanes are
            # active (True).
            ray_start = JumpCrossing(
                backend.Float(0), backend.UInt32(NO_FACET), backend.Float(0), zero
            )
            crossing = jumps.next_crossing(o, d, ray_start, limit.x, backend.Bool(True))
            return crossing.t, crossing.normal

        t, normal = map_batches(backend, next_crossing, origin, ray, np.column_stack([max_t] * 3))
        is_crossed = np.isfinite(t) & (t <= max_t)
        fraction = first - extension + np.where(is_crossed, t, 0.0) / np.maximum(length, 1e-300)
        normal = np.where(is_crossed[:, None], normal, 0.0)
        return fraction, normal, is_crossed


def _check_encloses(field: DipolePotential, level: float) -> None:
    """Raise an error unless the points of a cloud seem to enclose a solid, judged by the field's
    values at the points.

    f is 4 pi inside of a closed surface and 0 outside. At a point of the surface, f without that
    point's own term is 2 pi; or -2 pi if normals face inwards. So the median of these values over
    the points has to be more than a tenth of the level. Nothing is checked if areas of the points
    were given (then the points need not represent a surface), if the field is smoothed, or if the
    level is not positive.

    Raises:
        MeshingError: normals face inwards, cancel each other, or the points lie in a plane.
    """
    # `is_estimated` tells whether normals, and whether areas, were estimated.
    if field.smoothing or not field.is_estimated[1] or not level > 0:
        return
    # The values at every step-th point, at most 2000 of them.
    step = -(-len(field.points) // _MOST_PROBES)
    median = float(np.median(field.value(field.points[::step], precision="double")))
    if not median > _MIN_VALUE_SHARE * level:
        fault = (
            "normals face inwards: turn them around, or mesh the level -2 pi"
            if median < -_MIN_VALUE_SHARE * level
            else "normals cancel each other, or the points lie in a plane"
        )
        raise MeshingError(
            f"the points of this {type(field).__name__} enclose nothing: its value at them, each "
            f"without its own term, is {median:.2g} in the median where 2 pi is right; {fault}"
        )


def _secant(first: FloatArray, last: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """(n,) for each of n intervals, the root of the linear function with given values at both ends;
    the middle of the interval if that root is not finite.

    first, last: (n,) the ends of intervals. low, high: (n,) the values at these ends, of different
        signs."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        fraction = low / (low - high)
    fraction = np.where(np.isfinite(fraction), np.clip(fraction, 0.0, 1.0), 0.5)
    return first + fraction * (last - first)


def _clearances(
    field: Field, level: float, precision: Precision
) -> list[Callable[[FloatArray], FloatArray]]:
    """Functions that bound the distance to the level set: each takes points (n, 3) and returns
    lengths (n,). At each point the smallest of these lengths is a proved lower bound of the
    distance to the level set. A winding number has two such functions, another field has one."""
    backend = choose_backend(precision)

    def bound(smooth: Field) -> Callable[[FloatArray], FloatArray]:
        """Make a function of points (n, 3) that returns lower bounds (n,) of the distance to the
        level set of `smooth`, a field without jumps."""
        evaluator = smooth.evaluator(backend)
        levels = Levels((dr.opaque(backend.Float, level),), smooth.period)

        def kernel(p: Vec3) -> tuple[Real]:
            """The lower bound of the distance from p to the level set, as a tuple of one."""
            sample = evaluator.evaluate(p)
            return (level_distance_lower_bound(backend, evaluator, levels, p, sample),)

        return lambda points: _evaluate_in_batches(backend, kernel, points)

    if not isinstance(field, WindingNumber):
        return [bound(field)]
    jumps = field.evaluator(backend).jumps
    assert jumps is not None

    def distance(p: Vec3) -> tuple[Real]:
        """The distance of the points p from the triangles of the mesh."""
        return (jumps.distance(p),)

    return [
        bound(WindingModuloOne(field)),
        lambda points: _evaluate_in_batches(backend, distance, points),
    ]


def _evaluate_in_batches(
    backend: Backend, kernel: Callable[[Vec3], tuple[Any, ...]], points: FloatArray
) -> FloatArray:
    """The first result (n,) of `kernel`, a function of points, at points (n, 3), as a NumPy array.
    It is computed for a batch of points at a time and converted to double precision."""
    return np.asarray(map_batches(backend, kernel, points, at_once=1 << 18)[0], np.float64)
