"""A level set placed in the world: it is translated, rotated or mirrored, and scaled by one
factor."""

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
    """The map x -> scale * rotation @ x + translation from a surface's coordinates to the world's.

    rotation: (3, 3) orthogonal, possibly with a reflection.
    translation: (3,).
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    @classmethod
    def identity(cls) -> Placement:
        """The map that leaves all points where they are."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def of(cls, world_from_local: npt.ArrayLike) -> Placement:
        """The placement of a matrix (4, 4) of homogeneous coordinates.

        Raises:
            ValueError: the matrix is not finite, or it does not scale all lengths alike. It has to,
                or the steps that are proved in the surface's coordinates would not hold for rays of
                the world.
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
        """The points of the world, (n, 3), to which points (n, 3) of the surface's coordinates are
        mapped."""
        local: FloatArray = np.asarray(points, dtype=np.float64)
        rotated: FloatArray = np.matmul(local, np.transpose(self.rotation))
        return self.scale * rotated + self.translation

    def apply_inverse(self, points: npt.ArrayLike) -> FloatArray:
        """The points of the surface's coordinates, (n, 3), that are mapped to points (n, 3) of the
        world."""
        world: FloatArray = np.asarray(points, dtype=np.float64)
        local: FloatArray = np.matmul(world - self.translation, self.rotation)
        return local / self.scale

    def world_bounds(self, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper corner, (3,) each, of a box in the world that contains a box of
        the surface's coordinates. ends: (2, 3) the corners of that box."""
        corners = self.apply(list(itertools.product(*ends.T.tolist())))
        return corners.min(axis=0), corners.max(axis=0)


@dataclass(frozen=True)
class _HitPoint:
    """The point (3,) at which a ray hits a surface, and the unit normal (3,) there, for
    `compute_on_active`."""

    position: Vec3
    normal: Vec3


@dataclass(frozen=True)
class _IsolineIndex:
    """The number of the isoline at a hit, counted from 1, or 0, as a record for
    `compute_on_active`."""

    isoline_index: Index


@dataclass(frozen=True)
class PlacedSurface:
    """A level set or the boundary of a solid on a backend, placed in the world, to be hit by rays
    of the world.

    prepared: the tracer of the level set, in the coordinates of the surface.
    solid: the solid whose boundary is drawn; None for a level set.
    scale, rotation_rows, translation: the map from the surface's coordinates to the world's, x ->
        scale R x + translation. rotation_rows holds the rows of R. All numbers are kernel
        parameters.
    isolines: the isolines that are drawn on it.
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
        """The surface on a backend, placed in the world.

        isolines: lines to draw on it. size: the diagonal of the surface's box, for their default
            width.
        """

        def vector(numbers: FloatArray) -> Vec3:
            return backend.Array3f(*(dr.opaque(backend.Float, float(x)) for x in numbers))

        prepared = surface.prepare(backend)
        solid = None if surface.solid_range is None else CappedSolid.of(surface, prepared)
        rows = tuple(vector(row) for row in placement.rotation)
        scale = dr.opaque(backend.Float, placement.scale)
        lines = tuple(isoline.prepare(backend, size) for isoline in isolines)
        return cls(prepared, solid, scale, rows, vector(placement.translation), lines)

    def queued(self) -> PlacedSurface:
        """This surface, traced in the way in which few lanes share a queue of rays: a lane that has
        finished a ray takes the next one from the queue, so no lane waits for a longer ray. Such
        rays are traced at once when the method is called, so it cannot be called while a kernel is
        being recorded."""
        prepared = replace(self.prepared, uses_ray_queue=True)
        solid = None if self.solid is None else replace(self.solid, prepared=prepared)
        return replace(self, prepared=prepared, solid=solid)

    def intersect(
        self, o: Vec3, d: Vec3, t_max: Real, active: Mask, leaves: Real = 0.0
    ) -> SurfaceHit:
        """The first hits of rays o + t d, |d| = 1, 0 <= t <= t_max, as a `SurfaceHit`; rays and
        hits are in the world.

        leaves: for a ray that starts on this very surface, 1 if it goes to the side to which the
            normal points, else -1; 0 for a ray that starts elsewhere.
        """
        o, d, t_max = self._local_ray(o, d, t_max)
        if self.solid is not None:
            hit = self.solid.intersect(o, d, t_max, active, leaves)
        else:
            hit = intersect_surface(self.prepared, o, d, t_max, active)
        if self.isolines:
            hit = replace(hit, isoline_index=self._isoline_index(hit))
        position = self.scale * self._to_world(hit.position) + self.translation
        return replace(
            hit,
            t=self.scale * hit.t,
            position=position,
            normal=self._to_world(hit.normal),
            ray_offset=self.scale * hit.ray_offset,
        )

    def _isoline_index(self, hit: SurfaceHit) -> Index:
        """The number of the isoline on which each hit lies, counted from 1; 0 for no isoline and
        for no hit. hit: in the coordinates of the surface, not of the world."""
        index = self.prepared.backend.UInt32

        def numbers(point: _HitPoint) -> _IsolineIndex:
            """The number of the isoline at points, as a record."""
            return _IsolineIndex(
                isoline_index_at(self.isolines, point.position, point.normal, index)
            )

        point, none = _HitPoint(hit.position, hit.normal), _IsolineIndex(index(0))
        if self.prepared.uses_ray_queue:
            return compute_on_active(hit.is_hit, numbers, point, none).isoline_index
        return dr.select(hit.is_hit, numbers(point).isoline_index, 0)

    def has_line_near(self, position: Vec3, normal: Vec3, across: Vec3, down: Vec3) -> Mask:
        """Mask of points of the surface, in the world, for which the edge of an isoline passes
        through the pixel or near it.

        position, normal: (3,) the point in the middle of the pixel, and the unit normal there.
        across, down: (3,) vectors from it to the points of the tangent plane in the middles of the
            neighboring pixels.
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
        """Mask of rays o + t d, 0 <= t <= t_max, of the world that hit the surface. Rays that are
        not proved to miss it count as hits."""
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
        """Mask of the cones around rays o + t d of the world that this surface covers in part,
        before t_max.

        radius: of each cone, per unit of t.
        bounding_balls: (middle, depth, size) in the surface's coordinates: the common center of a
            ball of radius `depth` inside the extent of the surface and of a ball of radius `size`
            around it; None for an unbounded extent.

        The surface must be prepared for crossings (`TracedSurface.prepare`).
        """
        o, d, t_max = self._local_ray(o, d, t_max)
        solid = None if self.solid is None else (self.solid.low, self.solid.high)
        cones = PixelCones(
            self.prepared, o, d, self.prepared.backend.Float(radius), bounding_balls, solid
        )
        return cones.partially_covered(t_max, True)[0]

    def _local_ray(self, o: Vec3, d: Vec3, t_max: Real) -> tuple[Vec3, Vec3, Real]:
        """Origins, directions and largest parameters of rays of the world in the coordinates of the
        surface."""
        backend = self.prepared.backend
        local = self._to_local(backend.Array3f(o) - self.translation) / self.scale
        return local, self._to_local(backend.Array3f(d)), backend.Float(t_max) / self.scale

    def _to_world(self, v: Vec3) -> Vec3:
        """Vectors (3,) of the surface's coordinates, rotated as in the world; they are neither
        scaled nor translated."""
        return self.prepared.backend.Array3f(*(dr.dot(row, v) for row in self.rotation_rows))

    def _to_local(self, v: Vec3) -> Vec3:
        """Vectors (3,) of the world, rotated as in the surface's coordinates; they are neither
        scaled nor translated."""
        x, y, z = v
        return self.rotation_rows[0] * x + self.rotation_rows[1] * y + self.rotation_rows[2] * z
