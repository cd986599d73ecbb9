"""Meshes of polygons that need not be flat, each spanned by a level set of its solid angle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

from harnack.backend import FloatArray, IntArray
from harnack.fields.boxed_parts import BoxedField, BoxedParts
from harnack.fields.curves.face_boxes import face_boxes
from harnack.fields.curves.face_curves import PERIOD, FaceCurves
from harnack.fields.curves.solid_angle import SolidAngle
from harnack.fields.field import Field
from harnack.geometry.faces.polygon_meshes import PolygonFaces, validate_polygons
from harnack.tree.boxes import MOST_BOXES

if TYPE_CHECKING:
    from harnack.backend import Backend, Vec3

__all__ = ["PolygonMesh"]

# Levels as near as this to a multiple of 4 pi are those of no surface with bounds.
_NARROW = 1e-9 * PERIOD


class PolygonMesh(BoxedField["_MeshBuffers"]):
    """Faces of any number of corners, flat or not, each spanned by a smooth surface: the level set
    of the solid angle of its boundary curve (paper, Sections 4.2.1 and 4.2.4).

    vertices: (n, 3). faces: a list of faces, each a list of at least three indices of vertices,
    counter-clockwise seen from outside; or a list of such loops, of which holes run clockwise.
    Faces may have different numbers of corners, and need not be joined.

    The surface of a face is where its solid angle is 2 pi, modulo 4 pi; another `level` bulges it
    to one side. The faces are separate surfaces that meet in their common edges: `Hits.sheet` is
    the index of the face that was hit, the normal is that of its surface, to the positive side.
    Each is traced alone, with the proofs of `SolidAngle`, so that a ray pays only for faces whose
    boxes it enters (`harnack.fields.parts`). `face(k)` gives the solid angle of one.

    Raises:
        MeshError: a ValueError, for what `geometry.validate_polygons` refuses.
    """

    period: ClassVar[float | None] = PERIOD
    default_level: float = 2 * math.pi
    overstep: float = 1.3  # as of `SolidAngle`

    def __init__(self, vertices: Any, faces: Any) -> None:
        super().__init__()
        self.faces: PolygonFaces = validate_polygons(vertices, faces)
        if self.faces.count >= MOST_BOXES:
            raise ValueError(
                f"{self.faces.count:,} faces are too many: at most {MOST_BOXES:,}; cut the mesh "
                "into parts"
            )
        self._boxes: dict[tuple[float, ...], tuple[FloatArray, FloatArray]] = {}

    @property
    def vertices(self) -> FloatArray:
        """(n, 3)."""
        return self.faces.vertices

    @property
    def edges(self) -> IntArray:
        """(e, 2) pairs of vertices joined by an edge of some face, each once."""
        return self.faces.edges

    def face(self, index: int) -> SolidAngle:
        """The solid angle of the boundary of one face."""
        if not 0 <= index < self.faces.count:
            last = self.faces.count - 1
            raise IndexError(f"there is no face {index}: they are counted from 0 to {last}")
        return SolidAngle(self.faces.loops(index))

    def boxes(self, levels: tuple[float, ...] | None = None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corners (m, 3) of boxes proved to hold the surface of each face.

        levels: of the surfaces; None for the default.
        """
        levels = self.levels if levels is None else levels
        if levels not in self._boxes:
            self._boxes[levels] = face_boxes(self.faces, levels)
        return self._boxes[levels]

    def evaluate(self, p: Vec3) -> NoReturn:
        """Raises TypeError: there is a function for each face, and none of them all."""
        del p
        raise TypeError(
            "a polygon mesh is no level set of one function, but of one for each face: ask a "
            "face, such as mesh.face(0), which is a harnack.SolidAngle"
        )

    def _upload(self, backend: Backend) -> _MeshBuffers:
        boxes = BoxedParts.upload(backend, *self.boxes())
        return _MeshBuffers(boxes, FaceCurves.upload(backend, self.faces))

    def part_at(self, index: Any) -> Field:
        return self._on().curves.face(index)

    def check_levels(self, levels: tuple[float, ...]) -> None:
        for level in levels:
            if abs(math.remainder(float(level), PERIOD)) < _NARROW:
                raise ValueError(
                    f"level {level:g} is a multiple of 4 pi, which the solid angle of every face "
                    "comes near far away: its surfaces have no bounds; choose another level, such "
                    "as 2 pi"
                )

    def describe(self) -> dict[str, Any]:
        return {
            "faces": self.faces.count,
            "vertices": len(self.vertices),
            "corners": len(self.faces.corners),
            "in convex position": int(self.faces.in_convex_position.sum()),
        }


@dataclass(frozen=True)
class _MeshBuffers:
    """The faces' boxes and curves on a backend."""

    boxes: BoxedParts
    curves: FaceCurves
