"""A level set placed in the world: translated, rotated or mirrored, scaled alike on all axes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray
from harnack.backend.loops import compute_on_active
from harnack.rendering.isolines import Isolines, PreparedIsolines, isoline_index_at
from harnack.rendering.surface_hits import CappedSolid, SurfaceHit, intersect_surface
from harnack.tracer.pixel_cones import PixelCones

if TYPE_CHECKING:
    from harnack.backend import Backend, Index, Mask, Real, Vec3
    from harnack.tracer import SurfaceTracer, TracedSurface


@dataclass(frozen=True)
class Placement:
    """x -> scale * rotation @ x + translation, from a surface's coordinates to the world's.

    rotation: (3, 3) orthogonal, possibly with a reflection.
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    @classmethod
    def identity(cls) -> Placement:
        """Surfaces stay where they are."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def of(cls, world_from_local: npt.ArrayLike) -> Placement:
        """From a matrix (4, 4).

        Raises:
            ValueError: not finite, or no similarity: lengths along a ray have to keep their ratios,
                or the proved steps would not hold.
        """
        matrix = np.asarray(world_from_local, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError("to_world must be a finite matrix of shape (4, 4)")
        linear = matrix[:3, :3]
        scale = float(np.cbrt(abs(np.linalg.det(linear))))
        gram: FloatArray = np.matmul(linear, np.transpose(linear))
        is_similar = scale > 0 and np.allclose(gram, scale**2 * np.eye(3), atol=1e-4 * scale**2)
        if not is_similar or not np.allclose(matrix[3], (0, 0, 0, 1)):
            raise ValueError(
                "to_world must be made of translations, rotations, mirrors and one scale for all "
                f"axes, and this one is not:\n{matrix}"
            )
        return cls(scale, linear / scale, matrix[:3, 3])

    @property
    def matrix(self) -> FloatArray:
        """The map as a matrix (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    def apply(self, points: npt.ArrayLike) -> FloatArray:
        """Points (n, 3) of the surface, in the world."""
        local: FloatArray = np.asarray(points, dtype=np.float64)
        rotated: FloatArray = np.matmul(local, np.transpose(self.rotation))
        return self.scale * rotated + self.translation

    def apply_inverse(self, points: npt.ArrayLike) -> FloatArray:
        """Points (n, 3) of the world, in the surface's coordinates."""
        world: FloatArray = np.asarray(points, dtype=np.float64)
        local: FloatArray = np.matmul(world - self.translation, self.rotation)
        return local / self.scale

    def world_bounds(self, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner, (3,) each, of a box in the world that holds a box (2, 3)."""
        corners = self.apply(list(itertools.product(*ends.T.tolist())))
        return corners.min(axis=0), corners.max(axis=0)


@dataclass(frozen=True)
class _HitPoint:
    """A point at which a surface is hit, and the normal there."""

    position: Vec3
    normal: Vec3


@dataclass(frozen=True)
class _IsolineIndex:
    """The number of an isoline."""

    isoline_index: Index


@dataclass(frozen=True)
class PlacedSurface:
    """A level set or solid on a backend, to be hit by rays of the world.

    rotation_rows: of the rotation; all numbers are kernel parameters.
    isolines: drawn on it.
    """

    prepared: SurfaceTracer
    solid: CappedSolid | None
    scale: Real
    rotation_rows: tuple[Vec3, Vec3, Vec3]
    translation: Vec3
    isolines: tuple[PreparedIsolines, ...] = ()

    @classmethod
    def of(
        cls, surface: TracedSurface, placement: Placement, backend: Backend,
        isolines: Sequence[Isolines] = (), size: float = 1.0,
    ) -> PlacedSurface:  # fmt: skip
        """The surface on a backend. size: diagonal of the surface's box, for the default width of
        isolines."""

        def vector(numbers: FloatArray) -> Vec3:
            return backend.Array3f(*(dr.opaque(backend.Float, float(x)) for x in numbers))

        prepared = surface.prepare(backend)
        solid = None if surface.solid_range is None else CappedSolid.of(surface, prepared)
        rows = tuple(vector(row) for row in placement.rotation)
        scale = dr.opaque(backend.Float, placement.scale)
        lines = tuple(isoline.prepare(backend, size) for isoline in isolines)
        return cls(prepared, solid, scale, rows, vector(placement.translation), lines)

    def queued(self) -> PlacedSurface:
        """This surface, its rays traced without delay (`SurfaceTracer.uses_ray_queue`)."""
        prepared = replace(self.prepared, uses_ray_queue=True)
        solid = None if self.solid is None else replace(self.solid, prepared=prepared)
        return replace(self, prepared=prepared, solid=solid)

    def intersect(
        self, o: Vec3, d: Vec3, t_max: Real, active: Mask, leaves: Real = 0.0
    ) -> SurfaceHit:
        """The first hits of rays of the world, |d| = 1, in coordinates of the world.

        leaves: of a ray that starts on this very surface, 1 or -1 for the side of the normal that
            it goes to; else 0.
        """
        o, d, t_max = self._local_ray(o, d, t_max)
        if self.solid is not None:
            hit = self.solid.intersect(o, d, t_max, active, leaves)
        else:
            hit = intersect_surface(self.prepared, o, d, t_max, active)
        if self.isolines:
            hit = replace(hit, isoline_index=self._line(hit))
        position = self.scale * self._to_world(hit.position) + self.translation
        return replace(
            hit,
            t=self.scale * hit.t,
            position=position,
            normal=self._to_world(hit.normal),
            ray_offset=self.scale * hit.ray_offset,
        )

    def _line(self, hit: SurfaceHit) -> Index:
        """The number of the isoline at hits in the surface's coordinates."""
        index = self.prepared.backend.UInt32

        def numbers(point: _HitPoint) -> _IsolineIndex:
            return _IsolineIndex(
                isoline_index_at(self.isolines, point.position, point.normal, index)
            )

        point, none = _HitPoint(hit.position, hit.normal), _IsolineIndex(index(0))
        if self.prepared.uses_ray_queue:
            return compute_on_active(hit.is_hit, numbers, point, none).isoline_index
        return dr.select(hit.is_hit, numbers(point).isoline_index, 0)

    def has_line_near(self, position: Vec3, normal: Vec3, across: Vec3, down: Vec3) -> Mask:
        """Whether the edge of an isoline passes near points of the surface, in the world.

        across, down: the vectors to the points that neighboring pixels show.
        """
        vector = self.prepared.backend.Array3f
        p = self._to_local(vector(position) - self.translation) / self.scale
        n = self._to_local(vector(normal))
        u, v = (self._to_local(vector(step)) / self.scale for step in (across, down))
        near = self.prepared.backend.Bool(False)
        for isoline in self.isolines:
            near |= isoline.edge_is_near(p, n, u, v)
        return near

    def occludes(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> Mask:
        """Whether rays of the world hit it; rays that are not proved to miss it count as hits."""
        o, d, t_max = self._local_ray(o, d, t_max)
        if self.solid is not None:
            return self.solid.occludes(o, d, t_max, active)
        return self.prepared.occluded(o, d, 0, t_max, active)

    def covers_in_part(
        self,
        o: Vec3,
        d: Vec3,
        radius: Real,
        t_max: Real,
        bounding_balls: tuple[Vec3, Real, Real] | None,
    ) -> Mask:
        """Which cones around rays of the world are partly covered by the surface, before t_max or
        anything else.

        radius: of the cones, per unit of t.
        bounding_balls: see `PixelCones`.

        The surface must be prepared for crossings.
        """
        o, d, t_max = self._local_ray(o, d, t_max)
        solid = None if self.solid is None else (self.solid.low, self.solid.high)
        cones = PixelCones(
            self.prepared, o, d, self.prepared.backend.Float(radius), bounding_balls, solid
        )
        return cones.partially_covered(t_max, True)[0]

    def _local_ray(self, o: Vec3, d: Vec3, t_max: Real) -> tuple[Vec3, Vec3, Real]:
        backend = self.prepared.backend
        local = self._to_local(backend.Array3f(o) - self.translation) / self.scale
        return local, self._to_local(backend.Array3f(d)), backend.Float(t_max) / self.scale

    def _to_world(self, v: Vec3) -> Vec3:
        return self.prepared.backend.Array3f(*(dr.dot(row, v) for row in self.rotation_rows))

    def _to_local(self, v: Vec3) -> Vec3:
        x, y, z = v
        return self.rotation_rows[0] * x + self.rotation_rows[1] * y + self.rotation_rows[2] * z
