"""Where the level sets of a winding number can be: its triangles, and what spans its holes.

Modulo 1 a winding number does not jump, and it takes a level only on the surfaces that span holes.
Cells in which it is proved not to are empty, triangles or not: rays pass them without a look at the
winding number, but for where they cross triangles.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from harnack.fields.clearance import occupied_cells, tight_extent
from harnack.fields.field import Field, Sample
from harnack.geometry import Box

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, Vec3
    from harnack.cells import OccupiedCells
    from harnack.fields.meshes.winding_mesh import WindingMesh
    from harnack.geometry import Volume

__all__ = ["winding_box", "winding_cells", "winding_extent"]

# Cells that an extent looks at in one round at most, and how often the box is halved.
_MOST_CELLS = 20_000
_FINEST = 6
# Cells of the grid along its longest side, by experiment.
_ACROSS = 192


class WindingField(Protocol):
    """What is needed of a `WindingNumber`."""

    def prepare(self, backend: Backend) -> WindingField:
        """See `Field.prepare`."""
        ...

    def evaluate_modulo_one(self, p: Vec3) -> Sample:
        """See `WindingNumber.evaluate_modulo_one`."""
        ...


class _WindingModuloOne(Field):
    """A winding number modulo 1: continuous off the singular edges, sheets or not.

    winding: samples of it promise what they do of its lift, with all jumps taken out; the lift and
        w differ by whole numbers. They are coarse, which costs half as much: with close ones 2 %
        fewer cells are full.
    """

    period: ClassVar[float | None] = 1.0

    def __init__(self, winding: WindingField) -> None:
        self._winding = winding

    def prepare(self, backend: Backend) -> Self:
        prepared = copy.copy(self)
        prepared._winding = self._winding.prepare(backend)
        return prepared

    def evaluate(self, p: Vec3) -> Sample:
        return self._winding.evaluate_modulo_one(p)


def winding_cells(
    winding: WindingField, extent: Volume, levels: tuple[float, ...]
) -> OccupiedCells:
    """Cells over an extent, empty where w modulo 1 is proved to stay off the levels."""
    return occupied_cells(_WindingModuloOne(winding), levels, extent, _ACROSS)


def winding_extent(
    winding: WindingField, mesh: WindingMesh, levels: tuple[float, ...]
) -> Volume | None:
    """A polytope that holds the level sets of the winding number of a mesh; of a closed one a box.

    A point of a level set lies on a triangle, where w jumps over the level, or off the triangles,
    and then w has the level there modulo 1 too. All triangles are in the polytope; so are all
    cells of `winding_box` outside of it in which w modulo 1, to which triangles are nothing, is not
    proved to be off the level.
    """
    box = winding_box(mesh, levels)
    if not len(mesh.singular):
        return box
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    lower, upper = box.bounds()
    return tight_extent(
        _WindingModuloOne(winding), levels, lower, upper, _MOST_CELLS, _FINEST, corners
    )


def winding_box(mesh: WindingMesh, levels: tuple[float, ...]) -> Box:
    """A box around the mesh that holds the level sets, wider by the less of two distances.

    (a) At distance rho from the mesh |w| <= area/(4 pi rho^2). (b) Off the triangles 4 pi w
    is the solid angle of the singular edges mod 4 pi, and a level at distance l from the
    multiples of 4 pi lies within L/sqrt(l (4 pi - l)) of edges of total length L (isoperimetry
    on the sphere: see `SolidAngle.extent`).
    """
    low, high = mesh.box
    slack = 1e-4 * float((high - low).max())
    nearest = min(abs(level) for level in levels)
    wide = math.sqrt(mesh.area / (4 * math.pi * max(nearest, 1e-12)))
    away = min(abs(math.remainder(level, 1.0)) for level in levels) * 4 * math.pi
    narrow = mesh.boundary_length / math.sqrt(max(away * (4 * math.pi - away), 1e-12))
    reach = low, high
    if len(mesh.singular):
        ends = mesh.vertices[mesh.singular].reshape(-1, 3)
        near = np.minimum(low, ends.min(axis=0) - narrow)
        reach = near, np.maximum(high, ends.max(axis=0) + narrow)
    return Box(np.maximum(reach[0], low - wide) - slack, np.minimum(reach[1], high + wide) + slack)
