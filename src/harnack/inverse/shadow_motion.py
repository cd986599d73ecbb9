"""How the edges of shadows move on the screen when f, the function of the field, changes.

A lamp sees the surface as a camera does. Where a ray from the lamp passes the boundary of what it
sees first, at a point x, and meets the surface again at y, behind that boundary, there is the edge
of a shadow at y. Seen from the lamp, both points are the same point of its screen. Let J_l be the
derivative of that by a point of space, n_l the normal of the boundary there, and v_l its normal
velocity, which `boundary_motion` tells as a weighted sum of changes of f: for outlines, creases,
cuts and ends alike. The edge at y moves along with it, and y stays on the surface:

    g . dy = -df(y),    (J_l^T n_l) . dy = v_l.

These are two conditions as those of a crease, and the motion on the screen of the camera follows in
the same way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import to_numpy
from harnack.inverse.boundary_motion import (
    PARALLEL,
    BoundaryKind,
    BoundaryMotion,
    Conditions,
    boundary_motion,
    gradients_at,
    inner_products,
    solve_conditions,
)
from harnack.inverse.discontinuities import Discontinuities, Seen
from harnack.tracer.hits import hits_with_derivatives
from harnack.tracer.rays import RayBatch

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray
    from harnack.inverse.distant_lights import DistantLights
    from harnack.inverse.film import Screen
    from harnack.tracer.surface_tracer import SurfaceTracer
    from harnack.tracer.traced_surface import TracedSurface

# Within so many times the accuracy of jumps on the screen, points are the same on both sides of a
# jump. On a surface under the sine s to the ray this is divided by s, but by no less than _GRAZING.
_SAME_POINT, _GRAZING = 3.0, 1e-3


@dataclass(frozen=True)
class LampScreen:
    """For each of n points, the screen of a distant lamp, with a pixel of the camera's at this
    point as the unit of length.

    origin: (n, 3) the points, at which rays to the lamps begin.
    direction: (n, 3) unit vectors to the lamps.
    across: (n, 2, 3) unit vectors along the screens, normal to these.
    width: (n,) the width of a pixel.
    """

    origin: FloatArray
    direction: FloatArray
    across: FloatArray
    width: FloatArray

    @classmethod
    def of(cls, origin: FloatArray, direction: FloatArray, width: FloatArray) -> LampScreen:
        """The screens of lamps in these directions."""
        axis = np.eye(3)[np.abs(direction).argmin(axis=1)]
        first: FloatArray = np.cross(direction, axis)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second: FloatArray = np.cross(direction, first)
        across = np.stack([first, second], axis=1)
        return cls(origin, direction, across, width)

    def at(self, index: IntArray) -> LampScreen:
        """The screens of the points with these indices."""
        return LampScreen(
            self.origin[index], self.direction[index], self.across[index], self.width[index]
        )

    def of_points(self, points: FloatArray) -> FloatArray:
        """Where points of space (n, 3) are seen, (n, 2), counted from the origins."""
        return np.einsum("nsi,ni->ns", self.across, points - self.origin) / self.width[:, None]

    def directions(self, screen: FloatArray) -> FloatArray:
        """The unit directions (n, 3) of rays to the lamps."""
        del screen
        return self.direction

    def origins(self, screen: FloatArray) -> FloatArray:
        """The origins (n, 3) of the rays that are seen at screen points (n, 2)."""
        return self.origin + np.einsum("ns,nsi->ni", screen * self.width[:, None], self.across)

    def jacobian(self, points: FloatArray) -> FloatArray:
        """The derivatives (n, 2, 3) of screen points by points of space."""
        del points
        return self.across / self.width[:, None, None]

    def pixel_width(self, points: FloatArray) -> FloatArray:
        """The width (n,) of a pixel, the same everywhere on a ray."""
        del points
        return self.width


def with_shadow_motion(
    motion: BoundaryMotion, jumps: Discontinuities, film: Screen, surface: TracedSurface,
    lights: DistantLights,
) -> BoundaryMotion:  # fmt: skip
    """Return the motion of jumps, with that of the edges of shadows.

    motion: of all jumps, with these of an unknown kind.
    jumps: with the channels of the lights as the last ones.
    surface: with a small tolerance.
    """
    if surface.field.traits.has_jumps or surface.field.traits.has_patches or not len(jumps):
        return motion
    tracer = lights.tracer
    change = (jumps.behind.color - jumps.before.color)[:, -len(lights) :]
    lamp = np.abs(change).argmax(axis=1)
    change = change[np.arange(len(jumps)), lamp]
    index = np.flatnonzero(_is_within_surface(jumps, film, tracer) & (change != 0))
    if not len(index):
        return motion
    lamp, is_lit_behind = lamp[index], change[index] > 0
    edges = jumps.at(index)
    y = np.where(is_lit_behind[:, None], edges.before.position, edges.behind.position)
    lit = np.where(is_lit_behind[:, None], edges.behind.position, edges.before.position)
    g = gradients_at(tracer, y)
    normals = g / np.linalg.norm(g, axis=1, keepdims=True)
    normals *= -np.sign(inner_products(normals, film.directions(edges.middle)))[:, None]
    start = lights.starts(y, normals)
    screen = LampScreen.of(start, lights.direction[lamp], film.pixel_width(y))
    seen = _shadow_casters(screen, tracer, screen.of_points(start + lit - y))
    cast = boundary_motion(seen, screen, surface, tracer)
    is_known = cast.kind != int(BoundaryKind.UNKNOWN)
    second = np.einsum("ns,nsi->ni", cast.normal, screen.jacobian(y))
    kind = np.where(is_known, int(BoundaryKind.SHADOW), int(BoundaryKind.UNKNOWN))
    solved = solve_conditions(edges, film, kind, y, Conditions(y, g, y, second))
    return _with_terms(motion, index, solved, cast)


def _is_within_surface(jumps: Discontinuities, film: Screen, tracer: SurfaceTracer) -> BoolArray:
    """Whether both sides of jumps (n,) are neighbors on a smooth part of the surface."""
    before, behind = jumps.before, jumps.behind
    is_hit = before.is_hit & behind.is_hit
    x, other = (np.where(is_hit[:, None], side.position, 0) for side in (before, behind))
    g1, g2 = gradients_at(tracer, x), gradients_at(tracer, other)
    squares = inner_products(g1, g1) * inner_products(g2, g2)
    is_smooth = squares - inner_products(g1, g2) ** 2 <= PARALLEL * squares
    directions = film.directions(jumps.middle)
    slope = inner_products(g1, directions)
    # At outlines, rays within the tolerance may hit the side that is turned away.
    is_smooth &= slope * inner_products(g2, directions) > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        sine = np.abs(slope) / np.linalg.norm(g1, axis=1)
    resolution = np.abs(jumps.screen[:, 1] - jumps.screen[:, 0]).max(axis=1)
    near = _SAME_POINT * resolution * film.pixel_width(x) / np.maximum(sine, _GRAZING)
    return is_hit & is_smooth & (np.linalg.norm(x - other, axis=1) < near)


def _shadow_casters(screen: LampScreen, tracer: SurfaceTracer, lit: FloatArray) -> Discontinuities:
    """What casts the shadows on n points, as jumps between a ray to the lamp that meets it and one
    beside, through the screen points `lit` (n, 2), that is free."""
    count = len(lit)
    rays = RayBatch.of(screen.origin, screen.direction, 0.0, np.inf, "double")
    with dr.suspend_grad():
        hits, _ = hits_with_derivatives(tracer, rays)
    is_hit = np.broadcast_to(to_numpy(hits.is_hit), (count,))
    position = np.where(is_hit[:, None], to_numpy(hits.position).reshape(-1, 3), screen.origin)
    color = np.zeros((count, 1))
    met = Seen(is_hit, color, to_numpy(hits.t).astype(np.float64), position)
    free = Seen(np.zeros(count, bool), color, np.full(count, np.inf), screen.origin)
    ends = np.stack([np.zeros((count, 2)), lit], axis=1)
    return Discontinuities(np.zeros(count, int), ends, met, free, 0.0)


def _with_terms(
    motion: BoundaryMotion, index: IntArray, solved: BoundaryMotion, cast: BoundaryMotion
) -> BoundaryMotion:
    """Return the motion with that of the jumps with these indices replaced.

    solved: their motion, with weights of df(y) and, behind these, of -v_l.
    cast: the motion v_l of the boundaries that lamps see.
    """
    known = np.flatnonzero(solved.kind != int(BoundaryKind.UNKNOWN))
    weight, second = np.split(solved.weight, 2)
    factor = np.zeros(len(index))
    factor[known] = -second
    is_kept = ~np.isin(motion.index, index)
    kind, normal = motion.kind.copy(), motion.normal.copy()
    kind[index], normal[index] = solved.kind, solved.normal
    return BoundaryMotion(
        kind,
        normal,
        np.concatenate([motion.index[is_kept], index[known], index[cast.index]]),
        np.concatenate([motion.position[is_kept], solved.position[: len(known)], cast.position]),
        np.concatenate([motion.weight[is_kept], weight, factor[cast.index] * cast.weight]),
    )
