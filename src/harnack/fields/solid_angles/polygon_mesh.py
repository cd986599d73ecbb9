"""Meshes of polygons that need not be flat. A *face* is a polygon, perhaps with holes; f is the
solid angle of its boundary curve, with period 4 pi. The *surface of a face* is the level set f = 2
pi, which spans this curve. Faces are traced one by one; which face is meant may differ from lane to
lane. *Unit coordinates* of a face have their origin at its center, and its radius is 1. A *lane* is
one entry of Dr.Jit's arrays, such as a point or a ray.

- `PolygonMesh`: the field, with a patch for each face.
- `FaceLoops`: the boundary curves of all faces on a backend; `FaceSolidAngle`: the solid angle of a
  face, which may differ from lane to lane.
- `face_boxes`: boxes that are proved to contain the surface of each face.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

import drjit as dr
import numpy as np

from harnack.backend import (
    BoolArray,
    FloatArray,
    IntArray,
    backend_of,
    choose_backend,
    to_numpy,
    to_vector3,
)
from harnack.backend.arrays import gather_vectors, upload_floats, upload_integers
from harnack.backend.elementary import fmin
from harnack.backend.record_table import RecordTable
from harnack.backend.tensors import is_tensor
from harnack.backend.validation import check_no_derivatives
from harnack.cluster.serialization import TransientCache
from harnack.enclosures import HarmonicBall, Lipschitz
from harnack.enclosures.samples import Ray, RaySample, Sample, space_scaled
from harnack.fields.attached_arrays import plain_array
from harnack.fields.batched_fields import cached_upload
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Traits
from harnack.fields.patch_boxes import PatchBoxes, PatchesInBoxes, PatchField
from harnack.fields.solid_angles.moving_vertices import drjit_vertices, moving_vectors
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fmm.curve_queries import lift_ball, remainder_promises
from harnack.fmm.edges import (
    Edge,
    LoopEdges,
    inner_product,
    spinor,
    sum_over_edges,
    vertex_rounding,
)
from harnack.fmm.moving_edges import MovingEdges
from harnack.fmm.source_sums import SUM_MARGIN
from harnack.fmm.trail_sums import RayLine, line_rates, lipschitz_along
from harnack.fmm.unit_frame import UnitFrame
from harnack.geometry.polygon_meshes import PolygonFaces, validate_polygons
from harnack.tree.closest_triangles import MAX_BOXES

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

__all__ = ["PERIOD", "FaceData", "FaceLoops", "FaceSolidAngle", "PolygonMesh", "face_boxes"]

PERIOD = 4 * math.pi
# The number of edges of a record. It is the same for all meshes, so that they share kernels.
EDGES_PER_RECORD = 4
# Records are counted in floats; single precision holds no larger integers without gaps.
_MAX_RECORDS = 2**24


@dataclass(frozen=True)
class FaceLoops:
    """The boundary curves of all faces of a mesh on a backend, as two tables of records (rows of
    numbers that kernels read): one record for each face, and the records of edges.

    heads: one record for each face. In this order it holds: the center (3,) and the size of the
        face; the index of the first record of its edges; the number of these records, with a minus
        sign as a mark that the face's vertices are in convex position (on the boundary of their
        convex hull); and bounds of the rounding of a point in the face's unit coordinates, and of
        the rounding of its solid angle.
    edges: the edges of all faces, four to a record, each face in its own unit coordinates.
    """

    heads: RecordTable
    edges: LoopEdges

    @classmethod
    def upload(cls, backend: Backend, faces: PolygonFaces) -> FaceLoops:
        """Upload all faces of a mesh to a backend, each relative to its center and scaled to unit
        size.

        The backend's precision holds the centers exactly, so that subtracting them near a face is
        exact. Raises ValueError if there are too many corners.
        """
        low, high = faces.face_boxes()
        center = (0.5 * (low + high)).astype(backend.dtype).astype(np.float64)
        face = faces.face_of_corner
        # The corners of all faces, one face after the other; later in unit coordinates.
        x = faces.vertices[faces.corners] - center[face]
        first_corner = np.flatnonzero(np.diff(face, prepend=-1))
        size = np.maximum.reduceat(np.linalg.norm(x, axis=1), first_corner)
        # The largest coordinate of a face, in units of its size: by it positions are rounded.
        magnitude = np.maximum(np.abs(low), np.abs(high)).max(axis=1) / size
        x /= size[face][:, None]
        loops = tuple(np.split(x, faces.loop_starts[1:]))
        # For each face, the number of records of its edges: of all its loops.
        counts = np.bincount(faces.face_of_loop, -(-faces.loop_sizes // EDGES_PER_RECORD)).astype(
            np.int64
        )
        if counts.sum() >= _MAX_RECORDS:
            raise ValueError(
                f"{len(x):,} corners of faces are too many: cut the mesh into parts, and give "
                "them as a list to draw"
            )
        # A negative number marks a face in convex position.
        signed_counts = np.where(faces.in_convex_position, -counts, counts)
        edges = LoopEdges.upload(backend, loops, EDGES_PER_RECORD)
        # A point has a few roundings of size 1 in unit coordinates, and was rounded once before, at
        # its distance from the origin, which is about `magnitude`.
        heads = np.column_stack(
            [
                center, size, np.cumsum(counts) - counts, signed_counts,
                backend.machine_epsilon * (6 + 2 * magnitude),
                edges.rounding(counts),
            ]
        )  # fmt: skip
        return cls(RecordTable.upload(backend, heads), edges)

    def face(self, index: Any, moving: Callable[[], FaceEdges] | None = None) -> FaceSolidAngle:
        """The solid angle of the face with this index. The index may differ from lane to lane.
        moving: as of `FaceSolidAngle`."""
        row = self.heads.read_record(index)  # self.heads: one record for each face
        backend = self.heads.backend
        integer = backend.UInt32
        # The columns of `upload`: center, size, index of the first record, signed number of
        # records, and the roundings of a point and of the value.
        edges = self.edges.records_of(integer(row[4]), integer(dr.abs(row[5])))
        data = FaceData(backend, backend.Array3f(*row[:3]), row[3], edges, *row[5:])
        return FaceSolidAngle(data, moving, index)

    def moving_edges(self, vertices: Vec3, faces: PolygonFaces) -> FaceEdges:
        """The edges of all faces between these vertices, which may have derivatives. The unit
        coordinates of faces are constants."""
        backend = self.heads.backend
        row = self.heads.read_record(upload_integers(backend, faces.face_of_corner))
        center, size = backend.Array3f(*row[:3]), row[3]
        ends: list[Real] = []
        for corner in (faces.corners, faces.corners[faces.next_corner]):
            point = gather_vectors(backend, vertices, upload_integers(backend, corner))
            ends += [*((point - center) / size)]
        counts = np.bincount(faces.face_of_corner)
        first = upload_integers(backend, np.cumsum(counts) - counts)
        return FaceEdges(tuple(ends), first, upload_integers(backend, counts))


@dataclass(frozen=True)
class FaceData(UnitFrame):
    """One face of a polygon mesh in unit coordinates: relative to a center near the face, and
    divided by its size. The face may differ from lane to lane.

    edges: the records of its boundary edges; a record holds four edges.
    signed_record_count: the number of these records, with a minus sign as a mark that the vertices
        of the face are in convex position (on the boundary of their convex hull).
    rounding: a bound of the rounding error of a point in unit coordinates.
    value_rounding: a bound of the rounding error of the solid angle of the face.
    """

    edges: LoopEdges
    signed_record_count: Real
    rounding: Real
    value_rounding: Real


@dataclass(frozen=True)
class FaceEdges:
    """The edges of all faces of a mesh, face after face, with derivatives by vertices.

    ends: the coordinates of all starts, and of all ends, six arrays (`MovingEdges`), in unit
        coordinates of the face of each edge.
    first, count: for each face the index of its first edge, and the number of its edges.
    """

    ends: tuple[Real, ...]
    first: Any
    count: Any

    def of_faces(self, index: Any) -> tuple[Any, Any]:
        """The first edge and the number of edges of faces with these indices."""
        kind = cast("Any", type(self.first))
        return dr.gather(kind, self.first, index), dr.gather(kind, self.count, index)


@dataclass(frozen=True, eq=False)
class FaceSolidAngle(Evaluator):
    """The evaluator of the solid angle f of the boundary of one face, with period 4 pi. The face
    may differ from lane to lane. The lift of f is the continuous function near a point that equals
    f modulo 4 pi.

    face: the face, on a backend.
    moving: a function that returns the edges of all faces, with derivatives by vertices; None if
        these are not known.
    index: the index of the face, for each lane.

    Its promises, proved bounds of f near a point, are those of `SolidAngle`, which has the proofs.
    They include a ball and a range of the lift on it. The range is that of `lift_bound="convex"` if
    the face is in convex position, and that of "edges" otherwise.
    """

    face: FaceData
    moving: Callable[[], FaceEdges] | None = None
    index: Any = None

    def differentiable_value(self, p: Vec3) -> Real:
        """f at points p, modulo 4 pi, as an expression that Dr.Jit can differentiate by p and by
        the vertices of faces."""
        if self.moving is None:
            return super().differentiable_value(p)
        edges = self.moving()
        return MovingEdges(self.face, edges.ends).angle(p, edges.of_faces(self.index))

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        """The gradient of f at points p, as an expression of the same kind."""
        if self.moving is None:
            return super().differentiable_gradient(p)
        edges = self.moving()
        return MovingEdges(self.face, edges.ends).gradient(p, edges.of_faces(self.index))

    def evaluate(self, p: Vec3) -> Sample:
        """A sample of f at points p: value, gradient, error bounds and proved bounds of f near
        p."""
        return self._sample(p, None)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """A sample of f at the ray parameter t, with proved bounds of how f changes along the ray
        in front of that point and behind it.

        path: the ray.
        ahead, back: the lengths in front and behind for which bounds are wanted. They are not used:
            the bounds state their own lengths.
        """
        del ahead, back
        return path.enclose(self._sample(path.point(t), path.direction))

    def _sample(self, p: Vec3, direction: Vec3 | None) -> Sample:
        """A sample of f at points p in user coordinates: value, gradient, errors and promises
        (proved bounds of f near p). At points of the boundary curve itself the value is 0, and the
        gradient is so long that p counts as close to any level.

        direction: (3,) a unit vector. The sample gets further bounds along the line through p in
            this direction; None for no such bounds.
        """
        face = self.face
        backend, x, rounding = face.backend, face.to_unit(p), face.rounding
        sums = sum_over_edges(face.edges, x)
        # A lower bound, also after rounding. inverse_squares, inverse_cubes and inverse_fourths are
        # the integrals of |dp|/D^2, |dp|/D^3 and |dp|/D^4 over the curve, with D the distance from
        # x.
        distance = sums.distance * (1 - SUM_MARGIN) - rounding
        promises = remainder_promises(sums.inverse_cubes, sums.inverse_fourths, distance)
        # A ball, and a range of the lift on it.
        lift = lift_ball(sums.angle, sums.gradient, sums.inverse_squares, promises)
        # In convex position the lift stays in (-6 pi, 6 pi) on the ball up to the curve.
        is_convex = face.signed_record_count < 0
        ball = HarmonicBall(
            dr.select(is_convex, distance, lift.radius),
            dr.select(is_convex, -1.5 * PERIOD, lift.lower),
            dr.select(is_convex, 1.5 * PERIOD, lift.upper),
        )
        # At the curve itself, up to rounding, f has all values: the gradient is so steep that the
        # point counts as close to any level.
        is_on_curve = sums.distance <= 2 * rounding
        steep_gradient = backend.Array3f(0, 0, 4 * PERIOD / rounding)
        gradient = dr.select(is_on_curve, steep_gradient, sums.gradient)
        error = vertex_rounding(backend.machine_epsilon, x, sums.inverse_squares)
        error = dr.select(is_on_curve, 0, error) + face.value_rounding
        error = dr.select(is_on_curve, 8 * PERIOD, error)  # the steep gradient times 2 rounding
        ray_promises: tuple[Lipschitz, ...] = ()
        if direction is not None:
            line = RayLine(x, backend.Array3f(direction), rounding)

            def rates(lengths: tuple[Real, ...], active: Mask) -> tuple[Real, ...]:
                """For each length T in `lengths`, a bound of the derivative of f along the line at
                its points within T of x (`line_rates`). Returns one bound for each length. active:
                the mask of the lanes to compute."""
                return line_rates(face.edges, line, lengths, active)

            ray_promises = lipschitz_along(line, sums.gradient, sums.distance, rates)
        value = dr.select(is_on_curve, 0, sums.angle)
        sample = Sample(
            value,
            gradient,
            promises,
            error,
            alternative_promises=(ball,),
            ray_promises=ray_promises,
        )
        return space_scaled(sample, face.size)


# All cells are split `_MIN_DEPTH` times. Cells at the faces of a box are split up to `_MAX_DEPTH`
# times, in at most `_ROUNDS` rounds, and for at most `_MAX_PAIRS` pairs of an edge and a cell.
_MIN_DEPTH, _MAX_DEPTH, _ROUNDS, _MAX_PAIRS = 2, 7, 24, 30_000_000
# Boxes are enlarged by this fraction of the size of a face.
_BOX_MARGIN = 1e-4
_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)), dtype=np.float64)


def face_boxes(faces: PolygonFaces, levels: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Make boxes that are proved to contain the surfaces of faces, that is, the level sets of each
    face's solid angle f. The boxes are computed in double precision, for all faces at once.
    `PolygonMesh.boxes` computes them once for a mesh and its levels.

    levels: the values of f whose level sets are meant.

    Returns the lower and the upper corners of the boxes of all m faces, both (m, 3).

    The 2 pi level of a face in convex position lies in its convex hull (paper, Theorem B.1), which
    lies in the box of its vertices. Other surfaces lie in the isoperimetric box of
    `SolidAngle.extent`. Cells of this box that are proved empty are removed (`_are_empty`), and the
    result is the box around the other cells.
    """
    low, high = faces.face_boxes()
    # The least distance of a level from the multiples of 4 pi.
    nearest = min(abs(math.remainder(level, PERIOD)) for level in levels)
    # Half the diagonal of each face's box.
    size = 0.5 * np.linalg.norm(high - low, axis=1)[:, None]
    # If 2 pi is the least distance, all levels are 2 pi modulo 4 pi.
    is_in_hull = faces.in_convex_position & (nearest > 2 * math.pi * (1 - 1e-9))
    # The isoperimetric box: rho = L/sqrt(l (4 pi - l)) around the face.
    margin = 1.0001 * faces.face_perimeters()[:, None] / math.sqrt(nearest * (PERIOD - nearest))
    lower = np.where(is_in_hull[:, None], low, low - margin)
    upper = np.where(is_in_hull[:, None], high, high + margin)
    carved_ids = np.flatnonzero(~is_in_hull)
    if carved_ids.size:
        lower[carved_ids], upper[carved_ids] = _carve_boxes(faces, carved_ids, lower, upper, levels)
    return lower - _BOX_MARGIN * size, upper + _BOX_MARGIN * size


def _carve_boxes(
    faces: PolygonFaces, carved: IntArray, lower: FloatArray, upper: FloatArray,
    levels: tuple[float, ...],
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Make boxes of faces smaller: divide each into cells, remove cells that are proved to contain
    no level set, and take the box around the rest.

    carved: (k,) the indices of the faces whose boxes are made smaller, in increasing order.
    lower, upper: (m, 3) corners of the old boxes of all faces.
    levels: the values of the solid angle whose level sets the boxes must contain.

    Returns the lower and the upper corners of the new boxes, both (k, 3).

    A box becomes smaller only if cells at its sides are removed. So all cells are split twice, and
    then only the cells at the sides, until they are small or the work is too large.
    """
    curves = FaceLoops.upload(choose_backend("double"), faces)
    box_sizes, pair_count = upper - lower, 0
    corner_counts = np.bincount(faces.face_of_corner)
    cells = _FaceCells(carved, lower[carved], np.zeros(len(carved), dtype=np.int64))
    low, high = cells.boxes(box_sizes)
    for round_index in range(_ROUNDS):
        is_split = cells.depth < _MIN_DEPTH
        if round_index >= _MIN_DEPTH:
            # Only cells at the sides of the box. place: for each cell the position of its face in
            # `carved`, found by bisection, since these indices increase.
            place = np.searchsorted(carved, cells.face)
            is_split = cells.touch(low[place], high[place], box_sizes) & (cells.depth < _MAX_DEPTH)
        # The number of pairs of an octant and a corner: the work so far.
        pair_count += 8 * int(corner_counts[cells.face[is_split]].sum())
        if not is_split.any() or pair_count > _MAX_PAIRS:
            break
        octants = cells.subset(is_split).split(box_sizes)
        size = octants.sizes(box_sizes)
        # The balls around the octants are tested.
        half = 0.5 * np.linalg.norm(size, axis=1)
        is_empty = _are_empty(curves, octants.face, octants.corner + 0.5 * size, half, levels)
        cells = cells.subset(~is_split).joined(octants.subset(~is_empty))
        low, high = cells.boxes(box_sizes)
    return low, high


@dataclass(frozen=True)
class _FaceCells:
    """Cells of the boxes of faces of a mesh with m faces. A cell comes from a box by splitting it
    into eight equal octants, and these again.

    face: (k,) the index of the face that each cell belongs to, in increasing order. Every face that
        is considered has at least one cell.
    corner: (k, 3) the lower corners of the cells.
    depth: (k,) the number of splits of the face's box that gave the cell.
    """

    face: IntArray
    corner: FloatArray
    depth: IntArray

    def sizes(self, sides: FloatArray) -> FloatArray:
        """The side lengths (k, 3) of the cells. sides: (m, 3) the side lengths of the original
        boxes of all faces."""
        return sides[self.face] * (0.5**self.depth)[:, None]

    def boxes(self, sides: FloatArray) -> tuple[FloatArray, FloatArray]:
        """For each face that has cells, the box around its cells: two arrays with three columns, of
        the lower and of the upper corners. sides: (m, 3) the side lengths of the original boxes of
        all faces."""
        first_cell = np.flatnonzero(np.diff(self.face, prepend=-1))
        low = np.minimum.reduceat(self.corner, first_cell)
        return low, np.maximum.reduceat(self.corner + self.sizes(sides), first_cell)

    def touch(self, low: FloatArray, high: FloatArray, sides: FloatArray) -> BoolArray:
        """A mask (k,) of the cells that lie at a side of the box around the cells of their face, up
        to a quarter of the cell's size.

        low, high: (k, 3) for each cell the corners of that box.
        sides: (m, 3) the side lengths of the original boxes of all faces.
        """
        size = self.sizes(sides)
        # `corner` is the lower corner of a cell.
        at_low = self.corner < low + 0.25 * size
        at_high: BoolArray = self.corner > high - 1.25 * size
        return np.logical_or.reduce(at_low | at_high, axis=1)

    def subset(self, chosen: BoolArray) -> _FaceCells:
        """The cells selected by a mask (k,)."""
        return _FaceCells(self.face[chosen], self.corner[chosen], self.depth[chosen])

    def split(self, sides: FloatArray) -> _FaceCells:
        """The eight octants of each cell. sides: (m, 3) the side lengths of the original boxes of
        all faces."""
        depth = np.repeat(self.depth + 1, 8)
        face = np.repeat(self.face, 8)
        half = sides[face] * (0.5**depth)[:, None]
        steps = np.tile(_CORNERS, (len(self.face), 1))
        return _FaceCells(face, np.repeat(self.corner, 8, axis=0) + steps * half, depth)

    def joined(self, other: _FaceCells) -> _FaceCells:
        """The cells of this object and of `other` together, sorted by face."""
        face = np.concatenate([self.face, other.face])
        order = np.argsort(face, kind="stable")
        corner = np.concatenate([self.corner, other.corner])
        return _FaceCells(face[order], corner[order], np.append(self.depth, other.depth)[order])


def _are_empty(
    curves: FaceLoops, face: IntArray, centers: FloatArray, half: FloatArray,
    levels: tuple[float, ...],
) -> BoolArray:  # fmt: skip
    """A mask (k,) of balls, true where the ball is proved to contain no level set of the solid
    angle f of a face. Each ball has a face of its own.

    curves: the boundary curves of all faces.
    face: (k,) for each ball the index of the face.
    centers, half: (k, 3) centers and (k,) radii of the balls.
    levels: the values of f whose level sets are meant.

    Proof. Let h be the radius, less than the distance d_e of the center from every edge e, of
    length 2a. There is no level in the ball if no level lies in [f - S, f + S], where f is the
    value at the center. Here S bounds the change, within h, of the lift (f without jumps of 4 pi).
    The smaller of two bounds is used:

    - At the distance s from the center, an edge's part of grad f is at most
      2a/((d_e - s) sqrt((d_e - s)^2 + a^2)) (`LiftedEdge.bounds`). Its integral over s from 0 to h
      gives S = sum_e 2 [asinh(a/(d_e - h)) - asinh(a/d_e)].
    - The second derivative along a line is at most 2 times the sum over e of the integral of
      rho^-3 along the edge, where rho is the distance to a point of the edge. That integral is at
      most 2a/((d_e - h)^2 sqrt((d_e - h)^2 + a^2)) (`LiftedEdge.bounds`). With the gradient at the
      center, S = |grad f| h + h^2 sum_e 2a/((d_e - h)^2 sqrt((d_e - h)^2 + a^2)).

    A ball that contains a point of the curve is never empty.
    """
    backend = curves.heads.backend
    real = backend.Float
    index = upload_integers(backend, face)
    data = curves.face(index).face
    x = (to_vector3(backend, centers) - data.center) / data.size
    h = upload_floats(backend, half) / data.size

    def add(p: Vec3, q: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the edge from p to q to the state, and return the new state. It holds the product
        (zr, zi) of the edges' factors, the gradient, the distance of the nearest edge, and the sums
        over edges in the two bounds S for the ball of radius h around x. The argument of an edge's
        factor is half the solid angle of the edge.

        inverse: 1/|q - p|^2.
        """
        zr, zi, gradient, nearest, change, second = state
        edge = Edge.between(p, q, inverse, x)
        # The factor is the inner product of the spinors of both ends; the result of `spinor` ends
        # with the spinor.
        re, im = inner_product(spinor(edge.a)[2], spinor(edge.b)[2])
        zr, zi = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
        # Only the argument of the product matters: it is scaled to a length of about 1.
        scale = dr.rcp(dr.abs(zr) + dr.abs(zi))
        weight, c = edge.biot_savart()
        distance, a = dr.sqrt(edge.squared_distance), 0.5 * dr.rsqrt(inverse)
        # The two sums of the proof, with gap = d_e - h.
        gap = distance - h
        change = change + 2 * (dr.asinh(a / gap) - dr.asinh(a / distance))
        second = second + 2 * a / (gap * gap * dr.sqrt(gap * gap + a * a))
        gradient = dr.fma(type(gradient)(weight), c, gradient)
        return zr * scale, zi * scale, gradient, fmin(distance, nearest), change, second

    start = (real(1), real(0), backend.Array3f(0), real(dr.inf), real(0), real(0))
    zr, zi, gradient, nearest, change, second = data.edges.for_each(add, start, "face boxes")
    variation = fmin(change, h * dr.fma(h, second, dr.norm(gradient)))
    f, is_off_curve, max_change = (
        to_numpy(column) for column in (2 * dr.atan2(zi, zr), nearest > 1.001 * h, variation)
    )
    # The distance from f to the nearest level, modulo the period.
    level_gap = np.full(len(f), math.inf)
    for level in levels:
        # Between minus and plus half a period.
        offset = np.remainder(f - level + 0.5 * PERIOD, PERIOD) - 0.5 * PERIOD
        level_gap = np.minimum(level_gap, np.abs(offset))
    return is_off_curve & (level_gap > max_change * (1 + 1e-9) + 1e-9)


# Levels nearer than this to a multiple of 4 pi are refused: their surfaces are unbounded.
_LEVEL_MARGIN = 1e-9 * PERIOD


class PolygonMesh(PatchField):
    """Faces of any number of corners, flat or not, each spanned by a smooth surface: the level set
    of the solid angle of its boundary curve (paper, Sections 4.2.1 and 4.2.4). The field has a
    *patch* for each face, the solid angle of that face. Which face is meant may differ from lane to
    lane.

    vertices: (n, 3); a Dr.Jit 3-vector of n lanes or a tensor, if hits are to be differentiated by
        them.
    faces: a list of faces. A face is a list of at least three indices of vertices, in
        counter-clockwise order seen from outside; or it is a list of such loops, in which holes run
        clockwise. Faces may have different numbers of corners, and need not be joined.

    The surface of a face is the set on which its solid angle is 2 pi, modulo 4 pi. With another
    `level` the surface bulges to one side. The faces are separate surfaces that meet in their
    common edges. `Hits.primitive_index` is the index of the face that was hit; the normal is that
    of its surface, towards the positive side of the face. Each face is traced by itself, with the
    proofs of `SolidAngle`, so that a ray spends time only on faces whose boxes it enters
    (`harnack.fields.capabilities`). `face(k)` is the solid angle of face k.

    Raises:
        MeshError: a ValueError, for vertices and faces that `geometry.validate_polygons` refuses.
    """

    period: ClassVar[float | None] = PERIOD
    default_level: float = 2 * math.pi
    traits = Traits(  # as for `SolidAngle`
        has_patches=True, over_relaxation=1.3, has_parameter_derivatives=True
    )
    copies_parameters: ClassVar[bool] = True  # `cached_upload`
    no_single_function = (
        "a polygon mesh is no level set of one function, but of one for each face: ask a "
        "face, such as mesh.face(0), which is a harnack.SolidAngle"
    )

    def __init__(self, vertices: Any, faces: Any) -> None:
        """Validate vertices (n, 3) and faces, a list of polygons: each is a list of indices of
        vertices, or a list of such loops."""
        check_no_derivatives(type(self).__name__, faces)
        self.faces: PolygonFaces = validate_polygons(plain_array(vertices), faces)
        if self.faces.face_count >= MAX_BOXES:
            raise ValueError(
                f"{self.faces.face_count:,} faces are too many: at most {MAX_BOXES:,}; cut the "
                "mesh "
                "into parts"
            )
        self._boxes: TransientCache[tuple[float, ...], tuple[FloatArray, FloatArray]] = (
            TransientCache()
        )

    @property
    def vertices(self) -> FloatArray:
        """The positions (n, 3) of the vertices."""
        return self.faces.vertices

    def constructor_arguments(self) -> dict[str, Any]:
        """The arguments of the constructor by name. A face is a list of loops, or a single loop."""
        faces: list[list[list[int]]] = [[] for _ in range(self.faces.face_count)]
        loops = np.split(self.faces.corners, self.faces.loop_starts[1:])
        for owner, loop in zip(self.faces.face_of_loop, loops, strict=True):
            faces[owner].append(loop.tolist())
        vertices = drjit_vertices(self)
        return {
            "vertices": self.vertices if vertices is None else vertices,
            "faces": [face if len(face) > 1 else face[0] for face in faces],
        }

    @property
    def edges(self) -> IntArray:
        """Pairs (e, 2) of indices of vertices that an edge of some face joins. Each pair occurs
        once."""
        return self.faces.edges

    def face(self, index: int) -> SolidAngle:
        """The solid angle of the boundary of the face with this index, as a field of its own.
        Raises IndexError if there is no such face."""
        if not 0 <= index < self.faces.face_count:
            last = self.faces.face_count - 1
            raise IndexError(f"there is no face {index}: they are counted from 0 to {last}")
        moving = drjit_vertices(self)
        if moving is None:
            return SolidAngle(self.faces.loops(index))
        backend = backend_of(moving.array if is_tensor(moving) else moving)
        vertices = moving_vectors(backend, moving, self.vertices)
        corners = np.split(self.faces.corners, self.faces.loop_starts[1:])
        loops = [corners[k] for k in np.flatnonzero(self.faces.face_of_loop == index)]
        return SolidAngle(
            [gather_vectors(backend, vertices, upload_integers(backend, loop)) for loop in loops]
        )

    def boxes(self, levels: tuple[float, ...] | None = None) -> tuple[FloatArray, FloatArray]:
        """Boxes proved to contain the surfaces of the m faces: their lower and upper corners, both
        (m, 3). The surface of a face consists of the level sets of the solid angle of its boundary.
        The boxes are computed once for the same levels.

        levels: values of the solid angle; None for the default level.
        """
        levels = (self.default_level,) if levels is None else levels
        return self._boxes.get_or_make(levels, lambda: face_boxes(self.faces, levels))

    @cached_upload
    def _upload(self, backend: Backend, levels: tuple[float, ...]) -> _FacePatches:
        """Copy the boxes of all faces and their boundary curves to a backend."""
        boxes = PatchBoxes.upload(backend, *self.boxes(levels))
        return _FacePatches(boxes, FaceLoops.upload(backend, self.faces))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        patches = self._upload(backend, plan.levels or (self.default_level,))

        def moving() -> FaceEdges:
            """The edges of all faces, with derivatives by vertices."""
            vertices = moving_vectors(backend, drjit_vertices(self), self.vertices)
            return patches.curves.moving_edges(vertices, self.faces)

        return self.evaluator_of(replace(patches, moving=moving))

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level that is a multiple of 4 pi: its surfaces would be
        unbounded."""
        for level in levels:
            if abs(math.remainder(float(level), PERIOD)) < _LEVEL_MARGIN:
                raise ValueError(
                    f"level {level:g} is a multiple of 4 pi, which the solid angle of every face "
                    "comes near far away: its surfaces have no bounds; choose another level, such "
                    "as 2 pi"
                )

    def describe(self) -> dict[str, Any]:
        """Facts about the field for users, as a dictionary of names and values: the numbers of
        faces, vertices and corners, and of faces in convex position."""
        return {
            "faces": self.faces.face_count,
            "vertices": len(self.vertices),
            "corners": len(self.faces.corners),
            "in convex position": int(self.faces.in_convex_position.sum()),
        }


@dataclass(frozen=True)
class _FacePatches(PatchesInBoxes):
    """The faces of a polygon mesh on a backend.

    curves: the boundary curves of all faces.
    moving: a function that returns their edges with derivatives by vertices; None for no
        derivatives.
    """

    curves: FaceLoops
    moving: Callable[[], FaceEdges] | None = None

    def patch(self, index: Any) -> Evaluator:
        return self.curves.face(index, self.moving)
