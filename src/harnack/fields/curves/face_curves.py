"""The closed curves of many faces on a backend, and the solid angle of one of them in each lane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr
import numpy as np

from harnack.backend.records import Records
from harnack.enclosures import HarmonicBall, Lipschitz
from harnack.fields.edges.curve_promises import bends, swept_ball
from harnack.fields.edges.edge_passing import Line, known_along, rates_along
from harnack.fields.edges.edge_records import LoopEdges
from harnack.fields.edges.edge_sums import sum_over_edges
from harnack.fields.field import Field, Look, Path, Sample, lengthened
from harnack.fields.sums import SUM_ROUNDING
from harnack.fields.unit_coordinates import UnitCoordinates

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.geometry.polygon_meshes import PolygonFaces

__all__ = ["PERIOD", "FaceCurve", "FaceCurves", "FaceHead"]

PERIOD = 4 * math.pi
# Edges of a record. Always as many: another number is another kernel.
RUN = 4
# Records are counted in floats; single precision counts no further.
_MOST_RECORDS = 2**24


@dataclass(frozen=True)
class FaceCurves:
    """Records of all faces: where their edges are, and in which coordinates.

    heads: of a face, its center and size, the first record of its edges, how many there are (less
    than 0 if it is in convex position), and what rounding may do to a point, in units of the face,
    and to the value.
    """

    heads: Records
    edges: LoopEdges

    @classmethod
    def upload(cls, backend: Backend, faces: PolygonFaces) -> FaceCurves:
        """All faces, each centered and scaled to unit size.

        Centers are numbers of the backend, so that near a face they are subtracted exactly.
        """
        low, high = faces.boxes()
        center = (0.5 * (low + high)).astype(backend.dtype).astype(np.float64)
        face = faces.face_of_corner
        x = faces.vertices[faces.corners] - center[face]
        first = np.flatnonzero(np.diff(face, prepend=-1))
        size = np.maximum.reduceat(np.linalg.norm(x, axis=1), first)
        magnitude = np.maximum(np.abs(low), np.abs(high)).max(axis=1) / size
        x /= size[face][:, None]
        loops = tuple(np.split(x, faces.starts[1:]))
        trips = np.bincount(faces.face_of_loop, -(-faces.sizes // RUN)).astype(np.int64)
        if trips.sum() >= _MOST_RECORDS:
            raise ValueError(
                f"{len(x):,} corners of faces are too many: cut the mesh into parts, and give "
                "them as a list to draw"
            )
        corners, signed = np.bincount(face), np.where(faces.in_convex_position, -trips, trips)
        heads = np.column_stack(
            [
                center, size, np.cumsum(trips) - trips, signed,
                backend.epsilon * (6 + 2 * magnitude),
                backend.epsilon * (8 + 2 * np.sqrt(corners)),
            ]
        )  # fmt: skip
        return cls(Records.upload(backend, heads), LoopEdges.upload(backend, loops, RUN))

    def face(self, index: Any) -> FaceCurve:
        """The solid angle of the face with that index, another in each lane."""
        row = self.heads.row(index)
        backend = self.heads.backend
        count = backend.UInt32
        edges = self.edges.part(count(row[4]), count(dr.abs(row[5])))
        return FaceCurve(FaceHead(backend, backend.Array3f(*row[:3]), row[3], edges, *row[5:]))


@dataclass(frozen=True)
class FaceHead(UnitCoordinates):
    """The head of a face, another in each lane, with its edges."""

    edges: LoopEdges
    trips: Real
    rounding: Real
    value_rounding: Real


class FaceCurve(Field):
    """The solid angle of a face, in each lane another: what `SolidAngle` is, and says why.

    Its promises are the same. The ball is that of any curve, or where the face is convex, that of a
    curve in convex position.
    """

    period: ClassVar[float | None] = PERIOD
    default_level: float = 2 * math.pi

    def __init__(self, face: FaceHead) -> None:
        self.face = face

    def evaluate(self, p: Vec3) -> Sample:
        return self._sample(p, None)

    def look(self, path: Path, t: Real, ahead: Real, back: Real) -> Look:
        del ahead, back
        return path.look(self._sample(path.point(t), path.direction))

    def _sample(self, p: Vec3, direction: Vec3 | None) -> Sample:
        face = self.face
        backend, x, rounding = face.backend, face.unit(p), face.rounding
        sums = sum_over_edges(face.edges, x)
        distance = sums.distance * (1 - SUM_ROUNDING) - rounding
        known = bends(sums.cubes, sums.fourths, distance)
        swept = swept_ball(sums.angle, sums.gradient, sums.squares, known)
        convex = face.trips < 0
        ball = HarmonicBall(
            dr.select(convex, distance, swept.radius),
            dr.select(convex, -1.5 * PERIOD, swept.lower),
            dr.select(convex, 1.5 * PERIOD, swept.upper),
        )
        # On the curve itself, to rounding, every level meets, and no gradient exists.
        met = sums.distance <= 2 * rounding
        steep = backend.Array3f(0, 0, 4 * PERIOD / rounding)
        gradient = dr.select(met, steep, sums.gradient)
        error = dr.select(met, 0, 2 * backend.epsilon * sums.squares) + face.value_rounding
        error = dr.select(met, 8 * PERIOD, error)
        along: tuple[Lipschitz, ...] = ()
        if direction is not None:
            line = Line(x, backend.Array3f(direction), rounding)

            def rates(lengths: tuple[Real, ...], active: Mask) -> tuple[Real, ...]:
                return rates_along(face.edges, line, lengths, active)

            along = known_along(line, sums.gradient, sums.distance, rates)
        value = dr.select(met, 0, sums.angle)
        sample = Sample(value, gradient, known, error, weaker=(ball,), along=along)
        return lengthened(sample, face.size)
