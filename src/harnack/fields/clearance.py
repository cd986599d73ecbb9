"""Proved lower bounds of the distance from a point to the level sets of a field, called clearances,
and the volumes that follow from them. A field is a function f of space. Its sample at a point holds
value and gradient there, and promises: proved bounds of f near the point. `clearance_function`
gives clearances at points. `tight_extent` proves in which volume the level sets lie, and
`occupied_cells` in which cells of a grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.backend.elementary import fmax, fmin, max_norm, safe_norm
from harnack.enclosures import LevelGaps, Levels, SlopeRange, choose_enclosures, longest_free_length
from harnack.fields.field import Field
from harnack.tree.empty_space import (
    BoxCells,
    OccupancyGrid,
    kdop_of_points,
    merge_kdops,
    nonempty_cells,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.enclosures.samples import Sample
    from harnack.fields.evaluator import Evaluator
    from harnack.geometry import ConvexHull, Volume
    from harnack.tree.empty_space import Clearance

__all__ = [
    "bounded_side_extent",
    "clearance_function",
    "level_distance_lower_bound",
    "occupied_cells",
    "tight_extent",
]

# The enclosures (bounds of f along a line) by which clearances are proved. They use all promises of
# a field: there are few points, so time matters less than a large clearance.
_PROOFS = choose_enclosures("curvature")


def clearance_function(
    field: Field, levels: tuple[float, ...], precision: Precision = "double"
) -> Clearance:
    """Make a function that takes points (n, 3) and returns their clearances (n,): proved lower
    bounds of the distance to the nearest of the level sets f = level
    (`level_distance_lower_bound`).

    field: the field f.
    levels: the levels of f.
    precision: "single" or "double", in which f is evaluated.
    """
    backend = choose_backend(precision)
    evaluator = field.evaluator(backend)
    # Kernel parameters, so that other levels compile nothing.
    values = tuple(dr.opaque(backend.Float, level) for level in levels)
    targets = Levels(values, field.period)

    def clearance(points: FloatArray) -> FloatArray:
        """The clearances (n,) of points (n, 3)."""
        p = to_vector3(backend, points)
        return to_numpy(
            level_distance_lower_bound(backend, evaluator, targets, p, evaluator.evaluate(p))
        )

    return clearance


def tight_extent(
    field: Field,
    levels: tuple[float, ...],
    lower: FloatArray,
    upper: FloatArray,
    max_cells: int,
    finest: int = 5,
    points: FloatArray | None = None,
) -> ConvexHull:
    """A convex polytope of few planes that contains every point of the field's level sets, for the
    given levels, inside a box.

    The box is cut into cells, in several rounds. A cell is left out if its clearance (the proved
    lower bound of the distance from its center to the level sets) is larger than the radius of the
    ball around the cell. In each round the edges of the remaining cells are halved. The polytope
    contains the cells that remain in the end. If none remains, it is the polytope around `points`,
    or if there are no such points, around the whole box.

    lower, upper: (3,) corners of the box.
    max_cells: the largest number of cells tested in a round.
    finest: the largest number of rounds.
    points: (n, 3) points that the polytope must contain in any case. A first polytope is put around
        them. Cells inside of it need no test, so they are not tested. None for no such points.
    """
    clearance = clearance_function(field, levels)
    # The polytope is enlarged by this length, for rounding.
    margin = 1e-4 * float(np.linalg.norm(upper - lower))
    if points is not None:
        # Cells inside the polytope of the given points count as free of levels, since that polytope
        # is part of the result anyway.
        given = kdop_of_points(points, margin)
        cells = nonempty_cells(
            lower, upper, _clearance_outside(given, clearance), max_cells, finest
        )
        return merge_kdops(given, cells.bounding_kdop(margin)) if len(cells.corners) else given
    cells = nonempty_cells(lower, upper, clearance, max_cells, finest)
    if not len(cells.corners):  # no level anywhere: any volume will do
        cells = BoxCells(np.array(lower)[None], np.array(upper) - np.array(lower))
    return cells.bounding_kdop(margin)


def _clearance_outside(polytope: ConvexHull, clearance: Clearance) -> Clearance:
    """A function like `clearance`, but about only that part of the level sets that lies outside of
    a polytope. It takes points (n, 3) and returns proved lower bounds (n,) of their distances to
    that part. For a point inside the polytope the bound is the distance to the nearest face, since
    the part lies beyond the faces. For a point outside it is the result of `clearance`.

    clearance: a function that takes points and returns lower bounds of their distances to the level
        sets.
    """

    def clearance_outside(points: FloatArray) -> FloatArray:
        """Lower bounds (n,) of the distances of points (n, 3) to the part of the level sets that
        lies outside of the polytope of `_clearance_outside`. For points outside of the polytope
        they are those to all level sets."""
        # The depth is positive inside.
        depth = (polytope.offsets - points @ polytope.normals.T).min(axis=1)
        outside = depth <= 0
        if outside.any():
            depth[outside] = clearance(points[outside])
        return depth

    return clearance_outside


def bounded_side_extent(
    field: Field, levels: tuple[float, ...], is_inside: Callable[[float], bool]
) -> Volume | None:
    """A volume that contains all points inside a solid made of the field f; None if none is known.
    If f is defined only in the field's domain, or the field has no extent (a volume that contains
    the level sets), it is the domain. Otherwise it is the extent, if that is bounded and all points
    outside of it are outside of the solid.

    field: the field f.
    levels: the values of f on the surface of the solid.
    is_inside: a function that takes a value of f, and returns whether points with this value are
        inside the solid.

    Proof. The level sets lie in `Field.extent`, which is convex. If it has bounds, its complement
    is connected and meets no level. So a single point of the complement decides on which side of
    the levels the whole complement lies. If it is outside the solid, the extent contains the solid.
    """
    extent = field.extent(levels)
    if field.traits.is_global and extent is field.domain:
        # For a global field the domain only clips the picture, and bounds no level set.
        return None
    if extent is None or (field.domain is not None and not field.traits.is_global):
        return field.domain
    lower, upper = extent.bounds()
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        return None
    # Any point outside of the extent's box decides, as in the proof.
    outside = upper + (upper - lower) + 1e-3
    value = float(field.value(outside, precision="double"))
    return None if is_inside(value) or not math.isfinite(value) else extent


def occupied_cells(
    field: Field, levels: tuple[float, ...], extent: Volume, cells_across: int
) -> OccupancyGrid:
    """A grid of cells over the box of an extent, which contains the level sets. Cells that may
    contain a point of a level set are marked as occupied; all others are proved to contain none.

    extent: a volume that contains the level sets.
    cells_across: the approximate number of cells along the longest side of its box.
    """
    return OccupancyGrid.from_clearance(
        *extent.bounds(), clearance_function(field, levels, "single"), cells_across
    )


def level_distance_lower_bound(
    backend: Backend, evaluator: Evaluator, levels: Levels, p: Vec3, sample: Sample
) -> Real:
    """A proved lower bound of the distance from the points p to the nearest level set of f.

    evaluator: the evaluator of f on the backend.
    levels: the levels, with the period of f.
    sample: the sample of f at p.

    Proof. Let v be a unit direction and s the slope of f at p along v. An enclosure (a bound of f
    along a line that follows from a promise) holds f(p + t v) within an interval [L(t, s), U(t,
    s)]. The length that it proves free of levels ends where this interval first meets a level. Both
    L and U grow with s or stay the same, which every enclosure has to prove (`Enclosure`).

    The slopes at p in all directions lie in [-G, G], where G is |grad f(p)| plus its error. So the
    interval [L(t, -G), U(t, G)] holds f(p + t v) for every direction v, and a length that it proves
    free is a lower bound of the distance. The distance to the level above and the distance to the
    level below are proved separately, each by the promise that proves the larger distance.

    As in the tracer, the differences of f to the levels are reduced by the rounding errors of the
    value and of the position, and the result is reduced by the rounding error of p itself. If f
    jumps across facets, the promises are about f continued smoothly through the facets. This equals
    f up to the nearest facet, so the result is at most the distance to that facet.
    """
    steepest = safe_norm(sample.gradient) + sample.gradient_error
    size = max_norm(p)
    epsilon = backend.machine_epsilon
    # Eight roundings of the value; and the change of f by four roundings of the point's
    # coordinates.
    rounding = 8 * epsilon * dr.abs(sample.value) + 4 * epsilon * size * steepest
    gaps = levels.gaps(sample.value).reduced_by(rounding + sample.value_error)
    enclosures = _PROOFS.from_promises(
        sample.promises,
        sample.alternative_promises,
        sample.value,
        sample.value_error,
        SlopeRange(-steepest, steepest),
    )
    inf = backend.Float(dr.inf)
    # An infinite gap stands for no level on that side.
    upward = longest_free_length(enclosures, LevelGaps(inf, gaps.above))
    downward = longest_free_length(enclosures, LevelGaps(gaps.below, inf))
    # If a gap is 0 or less, the point may lie on a level set.
    distance = dr.select(gaps.nearest > 0, fmin(upward, downward), 0)
    if evaluator.jumps is not None:
        distance = fmin(distance, evaluator.jumps.distance(p))
    return fmax(backend.Float(distance) - 2 * epsilon * size, 0)
