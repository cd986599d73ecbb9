"""Interpolation of two shapes, solids a and b bounded by meshes, by slices of a solid angle in four
dimensions. Solid a lies at height 0 along the fourth axis, solid b at height gap. Space at a height
w between them is a slice. The field f on the slice is the solid angle that both solids subtend, and
its level set f = 1/2 is a shape between a and b.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.backend.validation import as_positive, as_real
from harnack.fields.batched_fields import BatchedField
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.solid_angles.morph_slice import MorphSlice
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.fmm.point_values import PointValues
from harnack.geometry.meshes import MeshError, validate_mesh

if TYPE_CHECKING:
    import numpy.typing as npt

    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.geometry import Volume


class Morph(BatchedField):
    """A shape between two solids a and b, as the level set f = 1/2. The solids are flat in four
    dimensions: a lies at height 0 along the fourth axis, b at height `gap`, and f is defined on
    space at the height w between them. For w = 0 the shape is a, for w = gap it is b.

    U_a(x, w) = w int_a dV/(|y-x|^2 + w^2)^2 is the solid angle that a, as a flat solid in four
    dimensions, subtends at (x, w). It is harmonic in (x, w). For w -> 0 it is pi^2, half of all
    directions, inside a, and 0 outside. The morph is the solid f > 1/2,

        f(x) = (U_a(x, w) + U_b(x, gap - w))/(2 pi^2).

    For w -> 0 that is a, as 0 < U_b < pi^2, and for w -> gap it is b. (This is the 'solid angle in
    four dimensions' of the talk on Gillespie et al. 2024, with level pi^2 of the sum.)

    For w = 0 and w = gap the field is the winding number of the mesh itself, with jumps across its
    triangles. For w between these, U_a and U_b are computed by a *quadrature*. Each mesh is
    replaced by oriented points at the centroids of its triangles. Triangles are first cut so that
    their edges are at most `spacing` times the height of the slice above or below their mesh. If
    triangles are much smaller than that, a single point stands for several triangles. f is then the
    sum over these points. It is harmonic in four dimensions, like the integral, and its level set
    is traced with proof. `quadrature_displacement` bounds the distance of this level set from the
    surface that exact integration would give.

    mesh_a, mesh_b: pairs (vertices (n, 3), faces (m, 3)), counter-clockwise seen from outside.
        Holes are allowed. For w between 0 and gap the surface has a dent at a hole, as it is the
        set on which both winding numbers, blurred, add up to 1. For w = 0 and w = gap the surface
        of level 1/2 spans the hole.
    gap: the distance between the solids, in the unit of the meshes. With a large gap the slices in
        the middle are small, or empty: for solids of half-diagonal 1, 0.1 to 0.2 is good.
    w: the height of the slice, in [0, gap]. Like `gap` it is a parameter of compiled kernels, which
        are not compiled again for other numbers.
    spacing: see above, at most 2. A smaller spacing gives sharper surfaces, and needs 1/spacing^2
        times as many points. For real meshes surfaces were off by at most 0.02, 0.04 and 0.09 of w
        for 1, 1.4 and 2.
    accuracy: for w between 0 and gap, the sum uses the multipole moments of a cluster of points
        beyond `accuracy` times its radius; at least 2. The truncation error is part of all proved
        bounds, and tracing uses a higher accuracy where the tolerance needs it.

    Raises:
        MeshError: a ValueError, as `validate_mesh`; or an argument is no pair.
        ValueError: gap, w, spacing or accuracy out of range; w so near to an end, but not at it,
            that more than four million points would be needed.
    """

    default_level = 0.5

    def __init__(
        self,
        mesh_a: tuple[npt.ArrayLike, npt.ArrayLike],
        mesh_b: tuple[npt.ArrayLike, npt.ArrayLike],
        *,
        gap: float,
        w: float,
        spacing: float = 1.0,
        accuracy: float = 6.0,
    ) -> None:
        gap = as_positive(gap, "gap")
        if not 0 <= as_real(w, "w") <= gap:
            raise ValueError(f"w must lie between 0 and the gap {gap!r}, not {w!r}")
        if not 0 < as_real(spacing, "spacing") <= 2:
            raise ValueError(f"spacing must be above 0 and at most 2, not {spacing!r}")
        if not 2 <= as_real(accuracy, "accuracy") <= 100:
            raise ValueError(f"accuracy must lie between 2 and 100, not {accuracy!r}")
        self.w, self.gap = float(w), float(gap)
        self._mesh_a, self._mesh_b = _checked(mesh_a, "mesh_a"), _checked(mesh_b, "mesh_b")
        meshes = self._mesh_a, self._mesh_b
        # At an end of the gap the field is the winding number of the mesh that lies there.
        self._slice: MorphSlice | WindingNumber
        if 0 < w < gap:
            corners = [vertices[faces] for vertices, faces in meshes]
            self._slice = MorphSlice(
                corners, w=self.w, gap=self.gap, spacing=spacing, accuracy=accuracy
            )
        else:
            # w is 0 or `gap`: the index is 0 for mesh a, 1 for mesh b.
            self._slice = WindingNumber(*meshes[int(w > 0)])
        self.traits = self._slice.traits

    def quadrature_displacement(
        self, points: Any, *, precision: Precision | None = None
    ) -> FloatArray:
        """Bound, to first order, how far the surface f = 1/2 is from the surface that exact
        integration over the triangles would give, at points of the surface.

        points: (n, 3).
        precision: of the computation, "single" or "double"; None for that of the points.

        Returns (n,) lengths in the unit of the meshes: the bound of the quadrature's error of f,
        divided by the length of the gradient. For meshes of regular triangles the true distance is
        far smaller. The result is 0 if w is 0 or `gap`, because then no quadrature is used.
        """
        if isinstance(self._slice, MorphSlice):
            return self._slice.quadrature_displacement(points, precision)
        return np.zeros(len(np.asarray(points)))

    def describe(self) -> dict[str, Any]:
        """Collect facts about the field for users: w and gap, and the numbers of quadrature points
        of both meshes; or, at an end of the gap, which mesh is shown, with the facts about its
        winding number."""
        heights = {"w": self.w, "gap": self.gap}
        if isinstance(self._slice, WindingNumber):
            return {**heights, "shows": "mesh " + "ab"[self.w > 0], **self._slice.describe()}
        points = self._slice.point_counts
        return {**heights, "points of a": points[0], "points of b": points[1]}

    # At each height the function is that of the slice.

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        return self._slice.evaluator(backend, plan)

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        return self._slice.values_at(x, derivatives, closer)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        self._slice.validate_levels(levels)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        return self._slice.extent(levels)


def _checked(mesh: Any, name: str) -> tuple[FloatArray, IntArray]:
    """Check a mesh, and return its vertices (n, 3) and faces (m, 3) as arrays.

    mesh: what the user gave: a pair of vertices and faces.
    name: the name of that argument, "mesh_a" or "mesh_b", for messages.

    Raises:
        MeshError: the argument is no pair, or its mesh is not valid.
    """
    try:
        vertices, faces = mesh
    except (TypeError, ValueError):
        raise MeshError(f"{name}: give a pair (vertices, faces)") from None
    try:
        return validate_mesh(vertices, faces)
    except MeshError as error:
        raise MeshError(f"{name}: {error}") from None
