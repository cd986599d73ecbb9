"""The dipole potential of oriented point clouds: Poisson reconstruction without a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from harnack.backend import backend_of
from harnack.fields.batch import BatchedField, Values
from harnack.fields.clouds.dipole_tree import DipoleTree
from harnack.fields.field import Sample, lengthened
from harnack.fields.multipoles.dipole_records import hierarchy_of
from harnack.fields.unit_coordinates import DetailedField, UnitCoordinates, placed, single
from harnack.geometry import Box, CloudError, estimate_areas, estimate_normals, validate_cloud

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume
    from harnack.tree import Hierarchy


_VALUES, _TRACED = 2.0, 4.0


class DipolePotential(DetailedField["_DipoleBuffers"], BatchedField):
    """f(x) = sum a_i n_i.(p_i - x)/|p_i - x|^3 of oriented points (paper, Eq. 12).

    With a_i the areas that the points stand for, f is about 4 pi inside and 0 outside: the
    surface is f = 2 pi. It passes through every point, with the point's normal.

    points: (n, 3). normals: (n, 3), outward, of any length; or "estimate", from neighbours,
        oriented along a spanning tree (`geometry.estimate_normals`). areas: (n,), or None to
        estimate them from neighbours (Barill et al. 2018, Sec. 3.1).
    accuracy: a cluster of points is taken as a whole beyond `accuracy` times its radius; by
        default 2 for values at points and 4 for tracing, which takes more where the tolerance asks
        for it. At least 1.5.

    `moved` gives the field of points that have moved.

    Raises CloudError (a ValueError) for what is no oriented point cloud.
    """

    period: ClassVar[float | None] = None
    default_level: float = 2 * math.pi

    def __init__(
        self,
        points: Any,
        normals: Any | Literal["estimate"] = None,
        areas: Any = None,
        *,
        accuracy: float | None = None,
    ) -> None:
        super().__init__()
        if normals is None:
            raise CloudError(
                "normals are missing, and without them inside and outside are not known: give "
                'them, or normals="estimate" to estimate them from neighbouring points'
            )
        if accuracy is not None and not 1.5 <= accuracy <= 100:
            raise ValueError(f"accuracy must lie between 1.5 and 100, not {accuracy}")
        self.estimated = [isinstance(normals, str), areas is None]
        if isinstance(normals, str):
            if normals != "estimate":
                raise CloudError(f'normals must be (n, 3) or "estimate", not {normals!r}')
            normals = estimate_normals(points)
        some = np.ones(len(points)) if areas is None else areas
        self.points, self.normals, self.areas = validate_cloud(points, normals, some)
        if areas is None:
            self.areas = estimate_areas(self.points, self.normals)
        self.accuracy = accuracy
        self._box = low, high = self.points.min(axis=0), self.points.max(axis=0)
        self._centre = single(0.5 * (low + high))
        extent = max(0.5 * float((high - low).max()), math.sqrt(float(self.areas.sum())) / 4)
        self._size = 2.0 ** math.ceil(math.log2(extent))
        self._hierarchy: Hierarchy | None = None

    def moved(
        self, points: Any, normals: Any | Literal["estimate"] = None, areas: Any = None
    ) -> DipolePotential:
        """The potential of as many points (n, 3) elsewhere; normals and areas as for a new one.

        The tree, if there is one, keeps its shape and gets new centres, radii, moments and bounds.
        All that is promised is computed from where the points are now, so a tree whose points moved
        far is slower than a new one, never wrong. Raises CloudError as for a new field.
        """
        field = DipolePotential(points, normals, areas, accuracy=self.accuracy)
        if len(field.points) != len(self.points):
            raise CloudError(
                f"points: {len(field.points)} of them, where {len(self.points)} were before: "
                "moving points keeps their number and their order"
            )
        field._hierarchy = self._hierarchy
        return field

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> Values:
        on = self._batch(backend_of(x))
        x = on.unit(x)
        weight = float(self.areas.sum()) / self._size**2
        return on.tree.at(x, derivatives, closer).far_away(x, 64, weight).rescaled(on.size)

    def _upload(self, backend: Backend, *, traced: bool) -> _DipoleBuffers:
        accuracy = self.accuracy or (_TRACED if traced else _VALUES)
        unit = (self.points - self._centre) / self._size
        # Areas shrink with the square of lengths, and the potential knows no scale.
        moments = (self.areas / self._size**2)[:, None] * self.normals
        if self._hierarchy is None:
            self._hierarchy = hierarchy_of(unit)
        tree = DipoleTree.of(backend, self._hierarchy, unit, moments, accuracy)
        return _DipoleBuffers(*placed(backend, self._centre, self._size), tree)

    def prepare(self, backend: Backend) -> Self:
        prepared = super().prepare(backend)
        if prepared._device is not None:
            prepared.coarsest_detail = prepared._device.tree.clusters.coarsest
        return prepared

    def _sample(self, on: _DipoleBuffers, p: Vec3, detail: Real) -> Sample:
        return on.sample(p, detail)

    def check_levels(self, levels: tuple[float, ...]) -> None:
        for level in levels:
            if abs(level) < 1e-6:
                raise ValueError(
                    "level 0 of a dipole potential reaches to infinity; the surface is at 2 pi"
                )

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A box around the points: at distance rho from all of them |f| <= (sum of areas)/rho^2."""
        reach = 1.0001 * math.sqrt(float(self.areas.sum()) / min(abs(level) for level in levels))
        low, high = self._box
        return Box(low - reach, high + reach)

    def describe(self) -> dict[str, Any]:
        said = ("estimated" if one else "given" for one in self.estimated)
        return {"points": len(self.points), **dict(zip(("normals", "areas"), said, strict=True))}


@dataclass(frozen=True)
class _DipoleBuffers(UnitCoordinates):
    """A potential on a backend."""

    tree: DipoleTree

    def sample(self, p: Vec3, detail: Real) -> Sample:
        return lengthened(self.tree.sample(self.unit(p), detail), self.size)
