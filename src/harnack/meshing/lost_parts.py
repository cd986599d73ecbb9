"""Finds parts of a level set that are missing from its mesh: walls and gaps thinner than a cell.
This is for meshes that were made from the signs of a function ("the function", side * (f - level)
for a field f) at the points of a lattice, whose cubes are the "cells". Some points on the level set
are known without a mesh; they should be near the mesh.

The signs at the points of a lattice do not show a wall or a gap between two points.
`points_off_level` checks that all points of the mesh are near the level set. Here the converse is
checked: that points that are known to lie on the level set are near the mesh. Suppose that such a
point is farther than d from the mesh. Then the sign of the function changes within d of the point,
but near the point all space is on the same side of the mesh. So there is a part of the solid, or of
the space around it, that the mesh does not have.

Points of the level set are known: on the triangles of a mesh, where the winding number jumps across
the level; beside the points of a cloud; and along rays out of blobs. About three thousand of them
are used, spread evenly. They are a sample, and no proof.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend
from harnack.fields.blobs.blobs import Blobs
from harnack.fields.blobs.hrbf import HRBF
from harnack.fields.solid_angles.dipole import DipolePotential
from harnack.fields.solid_angles.oriented_points import OrientedPoints
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.geometry.mesh_edges import area_normals, distances_from_triangles, row_norms
from harnack.geometry.neighborhoods import kd_tree
from harnack.meshing.meshing_errors import point_text
from harnack.meshing.sign_function import SignFunction
from harnack.meshing.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from harnack.fields import Field
    from harnack.geometry import Volume

__all__ = ["LostParts", "PointsOnLevel"]

# The number of points that are spread over triangles by area, and the number of triangles with a
# point in their middle.
_MAX_POINTS, _MIDDLES = 2000, 1000
# Test points lie beside triangles at the first distance relative to the size of the mesh, or at the
# second relative to the largest coordinate, whichever is larger. The values there have to differ
# from the level by more than the third: otherwise rounding would decide on which side they are.
_BESIDE, _ROUNDED, _MIN_JUMP = 1e-9, 64 * 2.0**-53, 0.02
# The largest distance of the level from the points of a cloud, in smoothing lengths.
_MAX_SMOOTHING_LENGTHS = 2.0
# Parts are lost if more than the first, a fraction of the points, are farther from the mesh than
# the tolerance (the same fraction of the mesh's points may be off the level); or if any point is
# farther than the second, in cells.
_ALLOWED_SHARE, _ALLOWED_CELLS = 0.01, 0.5
# The number of points at which the thickness of a part is measured; and the thicknesses that are
# tried, in cells.
_MAX_MEASURED, _THICKNESSES = 40, 2.0 ** np.arange(-10, 0.5, 0.25)
# Parts thinner than this, in cells, are lost nearly everywhere.
_THIN = 0.25


@dataclass(frozen=True)
class PointsOnLevel:
    """Some points on a level set, known without a mesh of it.

    points: (k, 3).
    normals: (k, 3) unit normals there, towards where the function is positive."""

    points: FloatArray
    normals: FloatArray

    @classmethod
    def of(cls, function: SignFunction, tolerance: float) -> PointsOnLevel:
        """Find points on the level set of a function without a mesh of it: on the triangles of a
        field that is given by a mesh, beside the points of a cloud, or along rays out of blobs. For
        all other fields there are none.

        tolerance: a length. The sign of a cloud's field is evaluated at least this far from its
            points."""
        jumps = function.field.evaluator(choose_backend("double")).jumps
        # The vertices of the mesh, its faces, and more.
        mesh = None if jumps is None else jumps.mesh()
        if mesh is not None:
            return cls._on_triangles(function, mesh[0][mesh[1]])
        field = function.field
        # The ends of short segments that cross the level set; none for other fields.
        low = np.zeros((0, 3))
        high = low
        if isinstance(field, OrientedPoints | HRBF):
            rows = _spread(len(field.points), _MAX_POINTS)
            smoothing_length = field.smoothing if isinstance(field, DipolePotential) else 0.0
            # The level set passes near each point, across its normal.
            offset = max(tolerance, _MAX_SMOOTHING_LENGTHS * smoothing_length) * field.normals[rows]
            offset /= np.maximum(row_norms(field.normals[rows]), 1e-300)[:, None]
            low, high = field.points[rows] - offset, field.points[rows] + offset
        elif isinstance(field, Blobs):
            rows = _spread(len(field.centers), _MAX_POINTS)
            # From the center of a blob in a random direction to the end of the blob.
            offset = np.random.default_rng(0).normal(size=(len(rows), 3))
            offset *= ((field.radii * field.kernel.support)[rows] / row_norms(offset))[:, None]
            low, high = field.centers[rows], field.centers[rows] + offset
        is_low, is_high = function.values(low) > 0, function.values(high) > 0
        # The function must be positive at the second end. Segments without a change of sign are
        # left out.
        low, high = np.where(is_low[:, None], high, low), np.where(is_low[:, None], low, high)
        return cls(*function.crossings(low[is_low != is_high], high[is_low != is_high]))

    @classmethod
    def _on_triangles(cls, function: SignFunction, triangles: FloatArray) -> PointsOnLevel:
        """Points on triangles (m, 3, 3) across which the function changes its sign, and the normals
        of the triangles there, turned towards where the function is positive.

        About two thousand points are spread over the triangles by area, and a thousand triangles,
        or all if there are fewer, have a point in their middle. Points are left out if the function
        does not change its sign across the triangle there."""
        normal = area_normals(triangles)
        area = row_norms(normal)
        rows = np.concatenate([_by_area(area), _spread(len(triangles), _MIDDLES)])
        barycentric = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), len(rows))
        # The middles of the triangles that were chosen without regard to area.
        barycentric[-min(len(triangles), _MIDDLES) :] = 1 / 3
        points, normal = np.einsum("ki,kij->kj", barycentric, triangles[rows]), normal[rows]
        normal /= np.maximum(area[rows], 1e-300)[:, None]
        size, largest_coordinate = (
            float(np.ptp(triangles, axis=(0, 1)).max()),
            float(np.abs(triangles).max()),
        )
        # Values a little in front of the triangles and behind them.
        offset = max(_BESIDE * size, _ROUNDED * largest_coordinate) * normal
        points_beside = np.concatenate([points + offset, points - offset])
        value = function.relative_to_level(function.field.value(points_beside, precision="double"))
        function.evaluations += len(points_beside)
        value_in_front, value_behind = value.reshape(2, -1)
        changes_sign = (value_in_front > 0) != (value_behind > 0)
        changes_sign &= (np.minimum(np.abs(value_in_front), np.abs(value_behind)) > _MIN_JUMP) & (
            area[rows] > 0
        )
        return cls(
            points[changes_sign],
            np.where(value_in_front > 0, 1.0, -1.0)[changes_sign, None] * normal[changes_sign],
        )

    def select(self, rows: Any) -> PointsOnLevel:
        """The selected points, with their normals. rows: the indices of these points, or a mask."""
        return PointsOnLevel(self.points[rows], self.normals[rows])

    def within(self, lower: FloatArray, upper: FloatArray, volume: Volume | None) -> PointsOnLevel:
        """The points in the box from `lower` to `upper`, and in the volume if one is given."""
        is_in = ((self.points > lower) & (self.points < upper)).all(axis=1)
        if volume is not None:
            is_in &= volume.contains_points(self.points)
        return self.select(is_in)


@dataclass(frozen=True)
class LostParts:
    """Points of a level set that are farther from its mesh than the tolerance. They are signs of
    parts that the mesh has lost.

    far: the number of points that are farther from the mesh than `tolerance`.
    looked_at: the number of all points that were tested.
    tolerance: a length.
    beyond: the number of points that are also farther than half a cell.
    within: an upper bound of the distance of all points from the mesh; inf if it has no triangles.
    missing, filled: (k, 3), (j, 3) some of the far points: on parts that the mesh misses, and in
        gaps that it fills.
    undecided: (i, 3) more far points, of which it is not known which of the two is the case.
    thickness: the median thickness of these parts and gaps, a length; inf if they are wider than
        cells, or if no thickness is known.
    spacing: the size of cells, a length.
    advice: what to do, in words."""

    far: int
    looked_at: int
    tolerance: float
    beyond: int
    within: float
    missing: FloatArray
    filled: FloatArray
    undecided: FloatArray
    thickness: float
    spacing: float
    advice: str

    @classmethod
    def of(
        cls,
        function: SignFunction,
        known: PointsOnLevel,
        surface: TriangleMesh,
        tolerance: float,
        spacing: float,
    ) -> LostParts:
        """Find the parts of a level set that a mesh has lost.

        function: side * (f - level) for a field f; its sign changes at the level set.
        known: points on the level set, near which the mesh should be.
        surface: the mesh.
        tolerance: a length. A point within this distance of the mesh is no sign of a lost part.
        spacing: the size of the mesh's cells, a length.
        """
        corner = surface.vertices[surface.faces]
        distant = known.select(_are_farther(known.points, corner, tolerance))
        beyond = _are_farther(distant.points, corner, max(tolerance, _ALLOWED_CELLS * spacing))
        within = _bound_of_distances(distant.points, corner) if len(distant.points) else tolerance
        measured = distant.select(_spread(len(distant.points), _MAX_MEASURED))
        # At some of the points it is measured whether they are on a thin part or in a narrow gap.
        thickness, is_inside = _thicknesses(function, measured, spacing)
        is_thin = np.isfinite(thickness)
        thickness = thickness[is_thin]
        # far, looked_at, tolerance, beyond, within; the places missing, filled and undecided;
        # thickness, spacing and advice.
        return cls(
            len(distant.points),
            len(known.points),
            tolerance,
            int(beyond.sum()),
            within,
            measured.points[is_thin & is_inside],
            measured.points[is_thin & ~is_inside],
            measured.points[~is_thin],
            float(np.median(thickness)) if len(thickness) else np.inf,
            spacing,
            _advice(function.field),
        )

    @property
    def matter(self) -> bool:
        """Whether enough is lost to matter: more than 1 % of the points are far from the mesh, or
        any point is farther than half a cell. Creases and corners alone put a few points of any
        mesh off."""
        return self.beyond > 0 or self.far > _ALLOWED_SHARE * self.looked_at

    @property
    def show_thin_parts(self) -> bool:
        """Whether some points are on parts or in gaps thinner than cells, or farther than half a
        cell from the mesh. Then the coarseness of the mesh is not the only cause."""
        return self.beyond + len(self.missing) + len(self.filled) > 0

    def are_mended_by(self, smaller: float) -> bool:
        """Whether smaller cells may show the lost parts. They may not if the median thickness of
        these parts is less than a quarter of a smaller cell.

        smaller: the size of the smaller cells, as a fraction of `spacing`."""
        return self.thickness >= _THIN * smaller * self.spacing

    def __str__(self) -> str:
        """The result as a sentence for messages, with a place of each kind of lost part."""
        thin = (
            (self.missing, "parts that are thinner than these are missing"),
            (self.filled, "gaps that are narrower than these are filled"),
        )
        shown = [f"{words}, as near {point_text(x[0])}" for x, words in thin if len(x)]
        within = f" (all within {self.within:.3g})" if math.isfinite(self.within) else ""
        text = (
            f"{self.far:,} of {self.looked_at:,} points of the level are farther than "
            f"{self.tolerance:.3g} from the mesh{within}, which has cells of {self.spacing:.3g}: "
            f"{' and '.join(shown)}"
        )
        if shown:
            return f"{text}; they are about {self.thickness:.2g} thick"
        return f"{text}such as {point_text(self.undecided[0])}"


def _advice(field: Field) -> str:
    """What to do if cells miss parts of the field's level set, in words."""
    advice = "choose a smaller `cell_size`"
    if isinstance(field, WindingNumber):
        advice += "; repairing the mesh keeps thin parts where their triangles are sound"
    if isinstance(field, DipolePotential) and not field.smoothing:
        advice += ', or smoothing="auto" if the points have noise'
    return advice


def _by_area(area: FloatArray) -> IntArray:
    """The indices (2000,) of triangles for points that are spread evenly over their surface: each
    triangle is repeated about in proportion to its area.

    area: (m,) the areas of the triangles, in any unit."""
    cumulative: FloatArray = np.cumsum(area)
    targets: FloatArray = (np.arange(_MAX_POINTS) + 0.5) / _MAX_POINTS * cumulative[-1]
    return np.searchsorted(cumulative, targets)


def _spread(count: int, max_count: int) -> IntArray:
    """Evenly spread indices below `count`: `max_count` of them, or all if there are fewer."""
    return np.linspace(0, count - 1, min(count, max_count)).astype(np.int64)


def _thicknesses(
    function: SignFunction, points: PointsOnLevel, spacing: float
) -> tuple[FloatArray, BoolArray]:
    """How thick the part, or how wide the gap, is beside each of k points of the level set: a
    length.

    From each point the sign of the function is followed along the normal and against it, at
    distances up to the size of a cell, `spacing`. The result is the distance to the next change of
    sign, on the side where it is smaller.

    Returns:
        The thicknesses (k,), inf where the sign does not change again; and a mask (k,): True where
        the smaller distance is inside of the solid, so that it is a part, False where it is
        outside, so that it is a gap. For clouds all thicknesses are inf: they are not known.
    """
    if isinstance(function.field, OrientedPoints):  # each point is in its own bubble
        unknown_thickness = np.full(len(points.points), np.inf)
        return unknown_thickness, unknown_thickness > 0  # (the mask does not count)
    distances = spacing * _THICKNESSES
    distance_per_side: list[FloatArray] = []
    for sign in (1.0, -1.0):
        probes = points.points[:, None] + sign * distances[:, None] * points.normals[:, None]
        is_positive = function.values(probes.reshape(-1, 3)).reshape(-1, len(distances)) > 0
        # The normals point to where the function is positive.
        has_changed = is_positive != (sign > 0)
        distance_per_side.append(
            np.where(has_changed.any(axis=1), distances[has_changed.argmax(axis=1)], np.inf)
        )
    positive_side, negative_side = distance_per_side
    # The function is positive inside, or where its side is -1 outside.
    return np.minimum(positive_side, negative_side), (positive_side < negative_side) == (
        function.side > 0
    )


def _bound_of_distances(points: FloatArray, triangles: FloatArray) -> float:
    """An upper bound of the distances of all points (n, 3) from triangles (m, 3, 3): the largest
    distance of a point from the nearest corner or center of a triangle. It is inf if there are no
    triangles."""
    if not len(triangles):
        return math.inf
    mesh_points = np.concatenate([triangles.reshape(-1, 3), triangles.mean(axis=1)])
    tree = kd_tree(mesh_points, is_balanced=False)
    # (`query` returns distances and indices.)
    return float(tree.query(points)[0].max())


def _are_farther(points: FloatArray, corner: FloatArray, distance: float) -> BoolArray:
    """(n,) whether each of the points (n, 3) is farther than `distance` from all triangles.

    corner: (m, 3, 3) the corners of the triangles.

    If a triangle comes within `distance` of a point, its center is within `distance` + r of the
    point, where r is the largest distance of the triangle's corners from its center. Only such
    triangles are measured. Triangles whose r differ by less than a factor of 2 are searched
    together, with the larger r."""
    is_far = np.ones(len(points), np.bool_)
    if not len(points):
        return is_far
    center = corner.mean(axis=1)
    radius = np.stack([row_norms(corner[:, k] - center) for k in range(3)]).max(axis=0)
    # Triangles are grouped by the power of 2 above r; small ones, with r < distance, are one group.
    exponent = np.ceil(np.log2(np.maximum(radius, distance))).astype(np.int64)
    for k in np.unique(exponent).tolist():
        remaining, rows = np.flatnonzero(is_far), np.flatnonzero(exponent == k)
        tree = kd_tree(center[rows], is_balanced=False)
        nearby_faces = tree.query_ball_point(points[remaining], 2.0**k + distance)
        counts = np.array([len(indices) for indices in nearby_faces], np.int64)
        if not counts.sum():
            continue
        query, face = (
            np.repeat(remaining, counts),
            rows[np.concatenate(nearby_faces).astype(np.int64)],
        )
        is_far[query[distances_from_triangles(points[query], corner[face]) <= distance]] = False
    return is_far
