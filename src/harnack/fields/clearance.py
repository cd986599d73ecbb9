"""A proved lower bound of the distance to a level set: the safe step of every direction at once.

And the extents that follow from it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.backend.extrema import fmax, fmin
from harnack.backend.lengths import largest_coordinate, length
from harnack.cells import Cells, OccupiedCells, carve, union, wrapped_points
from harnack.enclosures import Gaps, Slopes, TargetLevels, choose_proofs, longest_step

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.cells import Clearance
    from harnack.fields.field import Field, Sample
    from harnack.geometry import ConvexHull, Volume

__all__ = ["clearance_of", "distance_below", "occupied_cells", "tight_extent"]

# All that a field promises: points are few, and the longest proof counts.
_PROOFS = choose_proofs("curvature")


def clearance_of(
    field: Field, levels: tuple[float, ...], precision: Precision = "double"
) -> Clearance:
    """`distance_below` at points (n, 3)."""
    backend = choose_backend(precision)
    prepared = field.prepare(backend)
    # Data, so that other levels compile nothing.
    values = tuple(dr.opaque(backend.Float, level) for level in levels)
    targets = TargetLevels(values, field.period)

    def clearance(points: FloatArray) -> FloatArray:
        p = to_vector3(backend, points)
        return to_numpy(distance_below(backend, prepared, targets, p, prepared.evaluate(p)))

    return clearance


def tight_extent(
    field: Field,
    levels: tuple[float, ...],
    lower: FloatArray,
    upper: FloatArray,
    most: int,
    finest: int = 5,
    points: FloatArray | None = None,
) -> ConvexHull:
    """A polytope of few planes that holds every point of the level sets inside a box.

    Cells of the box are left out if their ball is within the clearance of its center; those left at
    the end are wrapped. most, finest: as for `cells.carve`.

    points: (n, 3) that the polytope is to hold in any case. What lies in the polytope around them
    needs no look: a ball that is inside it is as good as empty.
    """
    clearance = clearance_of(field, levels)
    slack = 1e-4 * float(np.linalg.norm(upper - lower))
    if points is not None:
        held = wrapped_points(points, slack)
        cells = carve(lower, upper, _outside(held, clearance), most, finest)
        return union(held, cells.wrapped(slack)) if len(cells.corners) else held
    cells = carve(lower, upper, clearance, most, finest)
    if not len(cells.corners):  # no level anywhere: any box will do
        cells = Cells(np.array(lower)[None], np.array(upper) - np.array(lower))
    return cells.wrapped(slack)


def _outside(held: ConvexHull, clearance: Clearance) -> Clearance:
    """The clearance from what lies outside a polytope: inside, the distance to its faces."""

    def beyond(points: FloatArray) -> FloatArray:
        depth = (held.offsets - points @ held.normals.T).min(axis=1)
        outside = depth <= 0
        if outside.any():
            depth[outside] = clearance(points[outside])
        return depth

    return beyond


def occupied_cells(
    field: Field, levels: tuple[float, ...], extent: Volume, across: int
) -> OccupiedCells:
    """A grid over an extent, with about so many cells along its longest side."""
    return OccupiedCells.of(*extent.bounds(), clearance_of(field, levels, "single"), across)


def distance_below(
    backend: Backend, field: Field, levels: TargetLevels, p: Vec3, sample: Sample
) -> Real:
    """A length that the distance from p to the nearest level is proved not to fall short of.

    sample: the field at p.

    Proof. An enclosure holds f(p + tv) within [L(t, s), U(t, s)], s the slope along a unit
    direction v, and steps to where that first meets a level. Neither end falls as s grows: that is
    what every enclosure has to say of itself (`Enclosure`).

    All slopes lie in [-G, G], G = |grad f(p)| and its error: one enclosure with that interval of
    slopes holds in every direction. The level above and that below are proofs of their own, and so
    is each promise: of each the longest counts.

    As in the tracer the levels are seen nearer by the rounding of value and position, and the
    result is shortened by the rounding of p itself. Where f jumps, all this is about f with the
    jumps taken out, which is f up to the nearest sheet.
    """
    steepest = length(sample.gradient) + sample.gradient_error
    size = largest_coordinate(p)
    epsilon = backend.epsilon
    rounding = 8 * epsilon * dr.abs(sample.value) + 4 * epsilon * size * steepest
    gaps = levels.gaps(sample.value).less(rounding + sample.error)
    enclosures = _PROOFS.enclose(
        sample.known, sample.weaker, sample.value, sample.error, Slopes(-steepest, steepest)
    )
    none = backend.Float(dr.inf)
    above = longest_step(enclosures, Gaps(none, gaps.up))
    below = longest_step(enclosures, Gaps(gaps.down, none))
    distance = dr.select(gaps.smaller > 0, fmin(above, below), 0)
    if field.has_sheets:
        distance = fmin(distance, field.distance_to_sheets(p))
    return fmax(backend.Float(distance) - 2 * epsilon * size, 0)
