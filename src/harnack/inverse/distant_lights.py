"""Light from distant lamps on a matt surface, with the shadows of the surface on itself: the light
of paths of two edges, from a lamp to the surface and from there to the camera.

A sky is sampled by a few lamps. Their directions are the same for all points of a picture: a
lattice that is turned at random. So each of them is uniform on the sphere, and the mean over many
pictures is the light of the uniform sky. Within one picture, shadows have sharp edges, each of
which is found and differentiated (`shadow_motion`). With a direction of its own for each ray of
the camera there would be no edges on the screen, and how shadows move would be lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import choose_backend, to_numpy
from harnack.backend.arrays import upload_floats, upload_vectors

if TYPE_CHECKING:
    from harnack.backend import FloatArray, Real
    from harnack.tracer import Hits
    from harnack.tracer.surface_tracer import SurfaceTracer
    from harnack.tracer.traced_surface import TracedSurface

# Of a matt surface in full sun, and with the whole sky above it.
_SUN, _SKY = 0.8, 0.2
# Rays to lamps begin so many tolerances above the surface.
_OFFSET = 100.0
# Lamps under this sine of an elevation above the surface are shown to the search for shadows as if
# they faded out, so that no jump is found where the sun sets.
_LOW = 0.1


@dataclass(frozen=True)
class DistantLights:
    """k lamps at infinity and the surface that they light.

    direction: (k, 3) unit vectors to the lamps.
    weight: (k,) the brightness of the surface where a lamp is in the zenith.
    tracer: of the surface, with a small tolerance, in double precision.
    offset: how far above the surface rays to lamps begin.
    """

    direction: FloatArray
    weight: FloatArray
    tracer: SurfaceTracer
    offset: float

    @classmethod
    def sun_and_sky(
        cls, sun: FloatArray, sky_count: int, random: np.random.Generator | None,
        surface: TracedSurface,
    ) -> DistantLights:  # fmt: skip
        """A sun and a uniform sky, all around.

        sun: (3,) the direction to the sun.
        sky_count: the number of lamps of the sky.
        random: turns the sky; None to leave it.
        surface: with a small tolerance.

        Light of the radiance L from all directions makes a surface of the reflectance rho as bright
        as rho L times the integral of cos/pi over the hemisphere, which is 1. For rho L = 0.2 and n
        lamps in place of the solid angle 4 pi, that is a weight of 0.2 * 4/n for each lamp.
        """
        # A Fibonacci lattice.
        z = 1 - (2 * np.arange(sky_count) + 1) / max(sky_count, 1)
        angle = np.pi * (3 - np.sqrt(5)) * np.arange(sky_count)
        r = np.sqrt(1 - z * z)
        sky = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
        if random is not None:
            turn, signs = np.linalg.qr(random.normal(size=(3, 3)))
            sky = sky @ (turn * np.sign(np.diag(signs)))
        weight = np.append(_SUN, np.full(sky_count, 4 * _SKY / max(sky_count, 1)))
        tracer = surface.tracer(choose_backend("double"), many_rays=False)
        offset = _OFFSET * surface.hit_tolerance.distance
        return cls(np.concatenate([sun[None], sky]), weight, tracer, offset)

    def __len__(self) -> int:
        """The number of lamps."""
        return len(self.weight)

    @property
    def hidden_count(self) -> int:
        """The number of channels that are not shown."""
        return 3 + len(self)

    def starts(self, points: FloatArray, normals: FloatArray) -> FloatArray:
        """The origins (n, 3) of rays from points of the surface (n, 3) to lamps. normals: (n, 3) on
        the side of the camera."""
        return points + self.offset * normals

    def channels(self, hits: Hits) -> list[Real]:
        """The brightness of hits, and numbers that are not shown: the normal, so that parts that
        are all dark are told apart; and for each lamp a number that jumps at the edges of its
        shadows, 1 in the light and 0 in the shadow.

        hits: with normals on the side of the camera. The brightness has the derivative by the
            normal; that by the motion of shadows is not of this point.
        """
        real = cast("Any", type(hits.t))
        with dr.suspend_grad():
            is_lit, cosine = self._lamps_above(hits)
            faded = np.where(is_lit, np.minimum(cosine / _LOW, 1), 0)
            backend = self.tracer.backend
            light = upload_vectors(backend, (self.weight[:, None] * is_lit).T @ self.direction)
            jumping = [real(upload_floats(backend, column)) for column in faded]
        brightness = sum(n * real(c) for n, c in zip(hits.normal, light, strict=True))
        normal = [0.5 * dr.detach(c) for c in hits.normal]
        return [brightness, *normal, *jumping]

    def _lamps_above(self, hits: Hits) -> tuple[FloatArray, FloatArray]:
        """Whether lamps light hits, (k, n), as 0 or 1, and the cosines (k, n) of their angles with
        the normals."""
        count = dr.width(hits)
        points, normals = (
            np.broadcast_to(to_numpy(v).reshape(-1, 3), (count, 3)).astype(np.float64)
            for v in (hits.position, hits.normal)
        )
        is_hit = np.broadcast_to(to_numpy(hits.is_hit), (count,))
        cosine = self.direction @ normals.T
        lamp, point = np.nonzero((cosine > 0) & is_hit)
        is_lit = np.zeros(cosine.shape)
        if len(lamp):
            backend = self.tracer.backend
            starts = upload_vectors(backend, self.starts(points[point], normals[point]))
            directions = upload_vectors(backend, self.direction[lamp])
            blocked = self.tracer.occluded(starts, directions, 0, np.inf)
            is_lit[lamp, point] = ~to_numpy(blocked)
        return is_lit, cosine
