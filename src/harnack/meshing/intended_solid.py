"""The solid that a damaged mesh is meant to bound, and how another surface differs from it. The
measure is the winding number w of the mesh, the number of times that it winds around a point. For a
good mesh it is 1 inside and 0 outside; holes blur that, and points with w > 1/2 count as inside. A
closed part is a connected group of faces that run every edge as often in one direction as in the
other. The size is the longest side of the mesh's bounding box.

A closed mesh need not be right: a filling may cut off half of a solid. So each result of `repair`
is compared with the winding number of the input mesh, at points away from the surfaces of both.
Points at which w is clearly above 1/2 have to be inside of the result, and points at which w is
clearly below 1/2 have to be outside.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.geometry import MeshError, validate_mesh, without_zero_area_faces
from harnack.geometry.mesh_edges import (
    area_normals,
    distance_from_triangles,
    has_distinct_corners,
    row_dots,
    row_norms,
)
from harnack.geometry.welding import Welded
from harnack.meshing.bodies import closed_parts, nested, volume_of
from harnack.meshing.mesh_cleaning import against_neighbors
from harnack.meshing.triangle_mesh import TriangleMesh

__all__ = ["Difference", "IntendedSolid"]

# The number of points at which winding numbers are compared: in the box around the mesh, and near
# each surface.
_IN_BOX, _NEAR = 2000, 1000
# The smallest and the largest distance of the points near a surface from it, and the margin of the
# box, relative to the size.
_NEAREST, _FARTHEST, _MARGIN = 2e-3, 0.1, 0.05
# The winding number is clearly above or below 1/2 if it differs from 1/2 by more than this: smooth
# patches over holes stay within it.
_CLEARANCE = 0.36
# The largest relative difference of volumes of closed meshes that bound their solid once.
_VOLUME_TOLERANCE = 0.01
# Each face and the middle of the mesh span a tetrahedron, with a positive volume if the face looks
# away from the middle. The mesh winds counter-clockwise if the sum of these volumes is more than
# this fraction of the sum of their magnitudes.
_OUTWARD_SHARE = 0.5
# The distance of points next to faces from these, relative to the size.
_BESIDE = 1e-6
# The largest number of points on the wrong side whose distances from the surfaces are computed, and
# the largest number that a `Difference` lists.
_MAX_RETESTED, _MAX_LISTED = 40, 10
# About how many faces of each closed part are tested.
_PART_SAMPLES = 16
# A mesh is an open sheet if there is nothing inside next to at least this fraction of its area.
_OPEN_SHARE = 0.4


@dataclass(frozen=True)
class Difference:
    """How the closed surface that a repair returned differs from the input mesh. A compared point
    is on the wrong side if the input's winding number tells clearly that it should be inside and it
    is outside of the surface, or the reverse. `share` is the fraction of such points, and `missing`
    and `added` are how many there are of the first and of the second kind.

    share: the fraction of the compared points that are on the wrong side.
    places: (k, 3) some of these points.
    missing: the number of points that should be inside, and are not.
    added: the number of points that should not be inside, and are.
    volumes: the volume of the surface, and the volume of the input. None if they agree, or if the
        input is not a closed mesh that winds around every point at most once.
    """

    share: float
    places: FloatArray
    missing: int
    added: int
    volumes: tuple[float, float] | None

    @property
    def badness(self) -> float:
        """A number that grows with the difference, for comparing results: the fraction of points on
        the wrong side, plus the relative difference of the volumes."""
        volume_error = 0.0
        if self.volumes is not None:
            new, intended = self.volumes
            volume_error = abs(new - intended) / abs(intended)
        return self.share + volume_error

    def __str__(self) -> str:
        """The difference in words, for messages."""
        words = [
            f"{count:,} {side}"
            for count, side in ((self.missing, "inside of it"), (self.added, "outside"))
            if count
        ]
        text = f"{self.share:.2%} of the points compared" if self.share else "none of the points"
        if words:
            x, y, z = self.places[0]
            text += f" ({' and '.join(words)}, such as near ({x:.4g}, {y:.4g}, {z:.4g}))"
        text += " lie on the other side"
        if self.volumes is not None:
            text += ", and volumes are {:.4g} and {:.4g}".format(*self.volumes)
        return text


@dataclass(frozen=True)
class IntendedSolid:
    """The solid that a damaged mesh is meant to bound: the mesh with equal corners joined, and with
    faces turned over so that it is not inside out (the faces `oriented`). A closed part of it (one
    of `parts`) is a connected group of faces that run every edge as often in one direction as in
    the other.

    vertices, faces: (n, 3), (m, 3) the mesh.
    is_turned: (m,) mask of the faces whose orientation was reversed.
    oriented: (k, 3) the faces with three different corners, with equal corners joined, and turned
        over so that they agree with their neighbors where that is possible, and are not inside out.
    parts: for each closed part of `oriented`, the indices of its faces. Parts may touch, cross or
        lie in each other (`closed_parts`).
    rounded: the number of corners that were joined with others because only rounding separated
        them.
    """

    vertices: FloatArray
    faces: IntArray
    is_turned: BoolArray
    oriented: IntArray
    parts: list[IntArray]
    rounded: int

    @classmethod
    def of(cls, mesh: Any, *, as_it_is: bool = False) -> IntendedSolid:
        """Find the solid that a mesh is meant to bound.

        Corners that differ by rounding are joined. Then each closed part that is inside out is
        reversed, with all that lies in it. Faces that are not closed and lie in no closed part are
        reversed, with all that lies in them, if they wind around more points clockwise than
        counter-clockwise.

        mesh: any object with vertices and faces; faces may have no area.
        as_it_is: whether to reverse no faces.

        Raises:
            MeshError: the vertices or faces are not valid (`validate_mesh`).
        """
        x, faces = validate_mesh(
            np.asarray(mesh.vertices), np.asarray(mesh.faces), allow_zero_area=True
        )
        welded = Welded.of(x, faces)
        joined, raw = welded.index[faces], faces
        if welded.rounded:
            faces = joined
        # Faces that still have three different corners.
        rows = np.flatnonzero(has_distinct_corners(joined))
        # No faces are left (`net`) if equal faces are added and opposite ones cancel, so every face
        # has its reverse: keep one of both.
        if not len(welded.net.faces):
            rows = rows[np.unique(np.sort(joined[rows], axis=1), axis=0, return_index=True)[1]]
        joined, is_turned = joined[rows], np.zeros(len(faces), np.bool_)
        if as_it_is or not len(rows):
            return cls(x, faces, is_turned, joined, [], welded.rounded)
        disagrees = against_neighbors(x, joined)
        agreeing = _turned(joined, disagrees)
        raw = _turned(raw[rows], disagrees)
        # Most faces have their material inside; -1 reverses the order of corners while closed parts
        # are looked for.
        step = 1 if volume_of(x, agreeing) >= 0 else -1
        parts = closed_parts(x, raw[:, ::step], agreeing[:, ::step])
        turned = _inside_out(x, agreeing, parts)
        oriented = _turned(agreeing, turned)
        if turned.any() and not turned.all():
            parts = closed_parts(x, _turned(raw, turned), oriented)
        # Faces are reported as turned only if whole parts are: not if single faces disagreed with
        # their neighbors.
        if not disagrees.any():
            is_turned[rows] = turned
        return cls(x, _turned(faces, is_turned), is_turned, oriented, parts, welded.rounded)

    @functools.cached_property
    def size(self) -> float:
        """The longest side of the mesh's bounding box."""
        return float(np.ptp(self.vertices[self.oriented], axis=(0, 1)).max())

    @functools.cached_property
    def field(self) -> WindingNumber | None:
        """The winding number of the mesh as a field; None if all faces cancel each other."""
        return _winding_number(self.vertices, self.oriented)

    def winding(self, points: FloatArray) -> FloatArray:
        """The winding numbers (k,) of the mesh at points (k, 3)."""
        return _values(self.field, points)

    @functools.cached_property
    def samples(self) -> tuple[FloatArray, FloatArray]:
        """Points (k, 3) at which results are compared, in the box around the mesh and near its
        faces; and the winding numbers (k,) there."""
        rng = np.random.default_rng(0)
        corner = self.vertices[self.oriented]
        low, high = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
        margin = _MARGIN * self.size
        box = rng.uniform(low - margin, high + margin, (_IN_BOX, 3))
        points = np.concatenate([box, _near(corner, self.size, rng)])
        return points, self.winding(points)

    @functools.cached_property
    def beside(self) -> tuple[FloatArray, FloatArray]:
        """Points (k, 3) next to faces of closed parts, on both sides; and the winding numbers (k,)
        there. They are needed since a closed part may be so small or thin that no other test points
        are in it."""
        chosen = [self.oriented[part[:: max(1, len(part) // _PART_SAMPLES)]] for part in self.parts]
        if not chosen:
            return np.zeros((0, 3)), np.zeros(0)
        corner = self.vertices[np.concatenate(chosen)]
        corner = corner[row_norms(area_normals(corner)) > 0]
        normal = area_normals(corner)
        away = _BESIDE * self.size * normal / row_norms(normal)[:, None]
        middle = corner.mean(axis=1)
        points = np.concatenate([middle - away, middle + away])
        return points, self.winding(points)

    def check_encloses(self) -> None:
        """Raise an error if the mesh is an open sheet, which bounds no solid. At points spread over
        the faces it is tested whether the winding number is at least 1/2 on one of both sides. The
        mesh is an open sheet if that fails on more than 40 % of its area.

        Raises:
            MeshError: it is an open sheet.
        """
        rng = np.random.default_rng(0)
        corner = self.vertices[self.oriented]
        points, normals = _on_faces(corner, _NEAR, rng)
        away = _NEAREST * self.size * normals
        beside = self.winding(np.concatenate([points + away, points - away]))
        # One row for each of the two sides.
        has_nothing = (beside.reshape(2, -1) < 0.5).all(axis=0)
        fraction = float(has_nothing.mean())
        if fraction > _OPEN_SHARE:
            raise MeshError(
                f"the mesh is an open sheet: {fraction:.0%} of its area have nothing inside, on "
                "neither side, so that most of it would be lost; give it a thickness first, in the "
                "program that made it"
            )

    def difference(self, surface: TriangleMesh, away: float) -> Difference | None:
        """How a closed surface, the result of a repair, differs from this solid; None if no
        difference is found. It is measured at points that are farther than `away` (a length) from
        the surface and from the input mesh; and at points next to closed parts of the input that
        are farther than `away` from the surface."""
        points, w = self.samples
        corner = surface.vertices[surface.faces]
        # (Another seed than that of `samples`.)
        near_surface = _near(corner, self.size, np.random.default_rng(1))
        points, w = (
            np.concatenate([points, near_surface]),
            np.concatenate([w, self.winding(near_surface)]),
        )
        field = _winding_number(surface.vertices, surface.faces)
        # The triangles of both surfaces.
        both = np.concatenate([self.vertices[self.oriented], corner])
        missing, added, distant = _on_other_side(points, w, field, both, away)
        beside, windings = self.beside
        missing_beside, added_beside, beside_far = _on_other_side(
            beside, windings, field, corner, away
        )
        distant = np.concatenate([distant, beside_far])
        volumes = self._volumes(surface, away)
        if not len(distant) and volumes is None:
            return None
        missing, added = missing + missing_beside, added + added_beside
        fraction = (missing + added) / (len(points) + len(beside))
        return Difference(fraction, distant[:_MAX_LISTED], missing, added, volumes)

    def _volumes(self, surface: TriangleMesh, away: float) -> tuple[float, float] | None:
        """The volumes of the surface and of the mesh, or None if they agree. They agree if they
        differ by at most 1 %, or by at most `away` (a length) times the area of the surface. They
        are compared only for a closed mesh that winds around no point twice or clockwise; for other
        meshes the result is None."""
        _, w = self.samples
        # No field: there are no faces. Singular edges, which do not cancel: the mesh is not closed.
        if self.field is None or len(self.field.mesh.singular_edges):
            return None
        if (w > 1.5).any() or (w < -0.5).any():
            return None
        new, intended = (
            volume_of(surface.vertices, surface.faces),
            volume_of(self.vertices, self.oriented),
        )
        area = 0.5 * float(row_norms(area_normals(surface.vertices[surface.faces])).sum())
        allowed = max(_VOLUME_TOLERANCE * abs(intended), away * area)
        return (new, intended) if abs(new - intended) > allowed else None


def _on_other_side(
    points: FloatArray,
    w: FloatArray,
    field: WindingNumber | None,
    triangles: FloatArray,
    away: float,
) -> tuple[int, int, FloatArray]:
    """Count the points that lie on the wrong side of the result of a repair.

    points: (n, 3).
    w: (n,) the winding numbers of the input mesh at the points.
    field: the winding number of the result.
    triangles: (m, 3, 3) the triangles that points have to be away from.
    away: a length; if only points within this distance of the triangles are on the wrong side, the
        result counts as right.

    Returns the number of points outside of the result with w clearly above 1/2; the number of
    points inside of it with w clearly below 1/2; and the points (k, 3) of both kinds that are
    farther than `away` from the triangles, among at most 40 that are tested. If there are no such
    distant points, both numbers are 0.
    """
    inside = _values(field, points) > 0.5
    missing, added = (~inside & (w > 0.5 + _CLEARANCE), inside & (w < 0.5 - _CLEARANCE))
    rows = np.flatnonzero(missing | added)
    # At most 40 of them, evenly spaced in their order.
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _MAX_RETESTED)).astype(int)]
    distant = rows[[distance_from_triangles(points[k], triangles) > away for k in rows]]
    if not len(distant):
        return 0, 0, np.zeros((0, 3))
    return int(missing.sum()), int(added.sum()), points[distant]


def _winding_number(x: FloatArray, faces: IntArray) -> WindingNumber | None:
    """The winding number of a mesh with vertices x (n, 3) and faces (m, 3) as a field; None if all
    faces cancel each other or have no area."""
    try:
        return WindingNumber(*without_zero_area_faces(x, faces))
    except MeshError:  # all faces cancel, or have no area
        return None


def _values(field: WindingNumber | None, points: FloatArray) -> FloatArray:
    """The values (k,) of a winding number at points (k, 3); all 0 if `field` is None."""
    if field is None:
        return np.zeros(len(points))
    return np.asarray(field.value(points, precision="double"))


def _turned(faces: IntArray, is_turned: BoolArray) -> IntArray:
    """Faces (m, 3) with the orientation reversed where the mask `is_turned` (m,) is set."""
    return np.where(is_turned[:, None], faces[:, ::-1], faces)


# Points.


def _on_faces(
    triangles: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Returns random points (count, 3) on triangles (m, 3, 3), uniform by area; and for each point
    the unit normal of its triangle, (count, 3). rng: the source of random numbers."""
    normal = area_normals(triangles)
    area = row_norms(normal)
    chosen = rng.choice(len(triangles), count, p=area / area.sum())
    # Uniform weights of the three corners.
    shares = rng.dirichlet((1.0, 1.0, 1.0), count)
    points = np.einsum("ki,kij->kj", shares, triangles[chosen])
    return points, normal[chosen] / area[chosen, None]


def _near(triangles: FloatArray, size: float, rng: np.random.Generator) -> FloatArray:
    """Random points (k, 3) on both sides of triangles (m, 3, 3), uniform by area. Their distances
    from the triangles are between `_NEAREST` and `_FARTHEST` times `size`, and the logarithms of
    these distances are uniform. rng: the source of random numbers."""
    points, normals = _on_faces(triangles, _NEAR, rng)
    offsets = size * np.exp(rng.uniform(math.log(_NEAREST), math.log(_FARTHEST), len(points)))
    offsets *= rng.choice((-1.0, 1.0), len(points))
    return points + offsets[:, None] * normals


# Parts that are inside out.


def _inside_out(x: FloatArray, faces: IntArray, parts: list[IntArray]) -> BoolArray:
    """Mask (m,) of the faces to reverse so that the mesh is not inside out.

    A closed part is reversed if the outermost closed part that contains it has a negative volume.
    The faces that belong to no closed part are reversed if the largest closed part that contains
    them has a negative volume. If no closed part contains them, they are reversed if they wind
    clockwise (`_winds_clockwise`), together with the closed parts inside of them.

    x: (n, 3) the vertices.
    faces: (m, 3).
    parts: for each closed part, the indices of its faces.
    """
    is_inside_out, is_rest = np.zeros(len(faces), np.bool_), np.ones(len(faces), np.bool_)
    for rows in parts:
        is_rest[rows] = False
    open_faces = faces[is_rest]
    closed_faces = [faces[rows] for rows in parts]
    volumes = [volume_of(x, part) for part in closed_faces]
    holds_rest = [_lies_in(x, open_faces, part) for part in closed_faces]
    # The faces of no closed part; the closed parts inside of these are added.
    is_with_rest = is_rest.copy()
    for k, containers in enumerate(nested(x, closed_faces)):
        # `nested` lists the containers in order of increasing volume.
        outermost = containers[-1] if containers else k
        if not any(holds_rest) and _lies_in(x, closed_faces[outermost], open_faces):
            is_with_rest[parts[k]] = True
        else:
            is_inside_out[parts[k]] = volumes[outermost] < 0
    if any(holds_rest):
        sizes = np.where(holds_rest, np.abs(volumes), 0)
        is_inside_out[is_rest] = volumes[int(sizes.argmax())] < 0
    elif len(open_faces) and _winds_clockwise(x, open_faces):
        is_inside_out |= is_with_rest
    return is_inside_out


def _lies_in(x: FloatArray, faces: IntArray, container: IntArray) -> bool:
    """Whether faces lie inside of the mesh of other faces, `container`: that mesh winds around the
    centers of about 16 of them. False if there are no faces.

    x: (n, 3) the vertices.
    faces, container: (m, 3), (k, 3).
    """
    if not len(faces) or not len(container):
        return False
    centers = x[faces[:: max(1, len(faces) // _PART_SAMPLES)]].mean(axis=1)
    return bool((np.abs(_values(_winding_number(x, container), centers)) > 0.5).all())


def _winds_clockwise(x: FloatArray, faces: IntArray) -> bool:
    """Whether a mesh winds clockwise: of random points near it, it winds around more points
    clockwise than counter-clockwise. If nearly all faces look away from the middle of the mesh, as
    in most meshes, it winds counter-clockwise; that is decided by the signed volumes of the
    tetrahedra between the faces and the middle, without winding numbers.

    x: (n, 3) the vertices.
    faces: (m, 3).
    """
    rng = np.random.default_rng(0)
    triangles = x[faces]
    size = float(np.ptp(triangles, axis=(0, 1)).max())
    middle: FloatArray = triangles.mean(axis=(0, 1))
    volumes = row_dots(triangles[:, 0] - middle, area_normals(triangles))
    if float(volumes.sum()) > _OUTWARD_SHARE * float(np.abs(volumes).sum()):
        return False  # they look away from the middle
    w = _values(_winding_number(x, faces), _near(triangles, size, rng))
    return bool((w < -0.5).sum() > (w > 0.5).sum())
