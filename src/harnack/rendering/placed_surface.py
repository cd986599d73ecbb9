"""A surface placed in the world: it is rotated or mirrored, scaled by one factor, and translated. A
surface, a level set of a field or the boundary of a solid, is traced in its own coordinates. Rays
of the world are mapped to these coordinates, and hits are mapped back."""

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
from harnack.rendering.isolines import DeviceIsolines, Isolines, isoline_index_at
from harnack.rendering.surface_hits import CappedSolid, SurfaceHit, intersect_surface

if TYPE_CHECKING:
    from harnack.backend import Backend, Index, Mask, Real, Vec3
    from harnack.tracer import SurfaceTracer, TracedSurface


@dataclass(frozen=True)
class Placement:
    """The map x -> scale * rotation @ x + translation from a surface's coordinates to the world's.

    rotation: (3, 3) orthogonal, possibly with a reflection.
    translation: (3,) in the world.
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    @classmethod
    def identity(cls) -> Placement:
        """Return the map that leaves all points where they are."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def of(cls, world_from_local: npt.ArrayLike) -> Placement:
        """Return the placement of a matrix (4, 4) of homogeneous coordinates.

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
        # All lengths are scaled alike if the linear part times its transpose is scale^2 times the
        # identity.
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
        """The map as a matrix (4, 4) of homogeneous coordinates."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    def apply(self, points: npt.ArrayLike) -> FloatArray:
        """Map points (n, 3) from the surface's coordinates to the world."""
        local: FloatArray = np.asarray(points, dtype=np.float64)
        rotated: FloatArray = np.matmul(local, np.transpose(self.rotation))
        return self.scale * rotated + self.translation

    def apply_inverse(self, points: npt.ArrayLike) -> FloatArray:
        """Map points (n, 3) from the world to the surface's coordinates."""
        world: FloatArray = np.asarray(points, dtype=np.float64)
        local: FloatArray = np.matmul(world - self.translation, self.rotation)
        return local / self.scale

    def world_bounds(self, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the lower and the upper corner, (3,) each, of a box in the world that contains a
        box of the surface's coordinates.

        ends: (2, 3) the lower and the upper corner of the box in the surface's coordinates.
        """
        corners = self.apply(list(itertools.product(*ends.T.tolist())))
        return corners.min(axis=0), corners.max(axis=0)


@dataclass(frozen=True)
class _HitPoint:
    """The point (3,) at which a ray hits a surface, and the unit normal (3,) there. It is the
    argument of `compute_on_active`."""

    position: Vec3
    normal: Vec3


@dataclass(frozen=True)
class _IsolineIndex:
    """The number of the isoline at a hit, counted from 1; 0 for no isoline. It is the result of
    `compute_on_active`."""

    isoline_index: Index


@dataclass(frozen=True)
class PlacedSurface:
    """A level set or the boundary of a solid, placed in the world and prepared to be hit by rays of
    the world. The map from the surface's own coordinates to the world is x -> scale R x +
    translation.

    tracer: the tracer of the surface, in the surface's coordinates.
    solid: the solid whose boundary is drawn; None for a level set.
    scale, rotation_rows, translation: the map. rotation_rows holds the rows of R. All numbers are
        kernel parameters.
    isolines: the isolines that are drawn on it.
    """

    tracer: SurfaceTracer
    solid: CappedSolid | None
    scale: Real
    rotation_rows: tuple[Vec3, Vec3, Vec3]
    translation: Vec3
    isolines: tuple[DeviceIsolines, ...] = ()

    @classmethod
    def of(
        cls, surface: TracedSurface, placement: Placement, backend: Backend,
        isolines: Sequence[Isolines] = (), size: float = 1.0,
    ) -> PlacedSurface:  # fmt: skip
        """Prepare a surface on a backend, the device that traces rays, and place it in the world.

        placement: the map from the coordinates of the surface to the world.
        isolines: lines to draw on it.
        size: the diagonal of the surface's box, which determines the lines' default width.
        """

        def vector(numbers: FloatArray) -> Vec3:
            return backend.Array3f(*(dr.opaque(backend.Float, float(x)) for x in numbers))

        tracer = surface.tracer(backend)
        solid = None if surface.solid_range is None else CappedSolid.of(surface, tracer)
        rows = tuple(vector(row) for row in placement.rotation)
        scale = dr.opaque(backend.Float, placement.scale)
        lines = tuple(isoline.upload(backend, size) for isoline in isolines)
        return cls(tracer, solid, scale, rows, vector(placement.translation), lines)

    def queued(self) -> PlacedSurface:
        """Return this surface with another way of tracing: few lanes share a queue of rays. A lane
        that has finished a ray takes the next one from the queue, so no lane waits for a longer
        ray. Such rays are traced at once when the method is called, so it cannot be called while a
        kernel is being recorded."""
        tracer = replace(self.tracer, uses_ray_queue=True)
        solid = None if self.solid is None else replace(self.solid, tracer=tracer)
        return replace(self, tracer=tracer, solid=solid)

    def intersect(
        self, o: Vec3, d: Vec3, t_max: Real, active: Mask, leaves: Real = 0.0
    ) -> SurfaceHit:
        """Find the first hits of rays o + t d, |d| = 1, 0 <= t <= t_max. Returns a `SurfaceHit`.
        Rays and hits are in the world.

        active: mask of the rays to trace.
        leaves: for a ray that starts on this very surface, 1 if it goes to the side to which the
            normal points, else -1; 0 for a ray that starts elsewhere.
        """
        o, d, t_max = self._local_ray(o, d, t_max)
        if self.solid is not None:
            hit = self.solid.intersect(o, d, t_max, active, leaves)
        else:
            hit = intersect_surface(self.tracer, o, d, t_max, active)
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
        """Return the number of the isoline on which each hit lies, counted from 1; 0 for no isoline
        and for no hit.

        hit: in the coordinates of the surface, not of the world.
        """
        index = self.tracer.backend.UInt32

        def find_index(point: _HitPoint) -> _IsolineIndex:
            """Return the numbers of the isolines at points, as an `_IsolineIndex`."""
            return _IsolineIndex(
                isoline_index_at(self.isolines, point.position, point.normal, index)
            )

        point, no_isoline = _HitPoint(hit.position, hit.normal), _IsolineIndex(index(0))
        if self.tracer.uses_ray_queue:
            return compute_on_active(hit.is_hit, find_index, point, no_isoline).isoline_index
        return dr.select(hit.is_hit, find_index(point).isoline_index, 0)

    def has_line_near(self, position: Vec3, normal: Vec3, across: Vec3, down: Vec3) -> Mask:
        """Return the mask of points for which the edge of an isoline passes through the pixel or
        near it. The points lie on the surface and are given in the world.

        position, normal: (3,) the point in the middle of the pixel, and the unit normal there.
        across, down: (3,) vectors from it to the points of the tangent plane in the middles of the
            neighboring pixels.
        """
        vector = self.tracer.backend.Array3f
        p = self._to_local(vector(position) - self.translation) / self.scale
        n = self._to_local(vector(normal))
        u, v = (self._to_local(vector(step)) / self.scale for step in (across, down))
        is_near = self.tracer.backend.Bool(False)
        for isoline in self.isolines:
            is_near |= isoline.edge_is_near(p, n, u, v)
        return is_near

    def occludes(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> Mask:
        """Return the mask of rays o + t d, 0 <= t <= t_max, of the world that hit the surface. Rays
        that are not proved to miss it count as hits."""
        o, d, t_max = self._local_ray(o, d, t_max)
        if self.solid is not None:
            return self.solid.occludes(o, d, t_max, active)
        return self.tracer.occluded(o, d, 0, t_max, active)

    def covers_in_part(
        self,
        o: Vec3,
        d: Vec3,
        radius: Real,
        t_max: Real,
        bounding_balls: tuple[Vec3, Real, Real] | None,
    ) -> Mask:
        """Return the mask of cones that this surface covers only in part, at some t before t_max.
        The axes of the cones are rays o + t d of the world.

        radius: of each cone at t = 1; at t it is t times as large.
        bounding_balls: (center, inner_radius, outer_radius) in the surface's coordinates. The
            extent of a surface is a volume that is proved to contain it. The ball with the inner
            radius lies inside the extent, and the extent lies inside the ball with the outer
            radius. None for an unbounded extent.

        The tracer must be one for crossings (`TracedSurface.tracer`).
        """
        from harnack.tracer.pixel_cones import PixelCones  # imported here: few pictures need it

        o, d, t_max = self._local_ray(o, d, t_max)
        solid_range = None if self.solid is None else (self.solid.low, self.solid.high)
        cones = PixelCones(
            self.tracer, o, d, self.tracer.backend.Float(radius), bounding_balls, solid_range
        )
        # True: all cones are active. The second result, the number of evaluations, is not needed.
        return cones.partially_covered(t_max, True)[0]

    def _local_ray(self, o: Vec3, d: Vec3, t_max: Real) -> tuple[Vec3, Vec3, Real]:
        """Map rays o + t d, t <= t_max, from the world to the coordinates of the surface. Returns
        their origins, directions and largest parameters there. Directions keep the length 1, so
        parameters are divided by the scale."""
        backend = self.tracer.backend
        local_origin = self._to_local(backend.Array3f(o) - self.translation) / self.scale
        return local_origin, self._to_local(backend.Array3f(d)), backend.Float(t_max) / self.scale

    def _to_world(self, v: Vec3) -> Vec3:
        """Rotate vectors (3,) from the surface's coordinates to the world's. They are neither
        scaled nor translated."""
        return self.tracer.backend.Array3f(*(dr.dot(row, v) for row in self.rotation_rows))

    def _to_local(self, v: Vec3) -> Vec3:
        """Rotate vectors (3,) from the world's coordinates to the surface's. They are neither
        scaled nor translated."""
        x, y, z = v
        # The transpose of R times v.
        return self.rotation_rows[0] * x + self.rotation_rows[1] * y + self.rotation_rows[2] * z
