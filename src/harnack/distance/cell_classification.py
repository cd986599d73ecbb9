"""Classifies the cells that may hold a level set: each is proved empty, or gets a slab (two
parallel planes) that contains the surface, and a point of the surface.

Some of these points lie on the *clip curve*, where the boundary of the field's domain cuts the
level set; `ClipCurveDescent` finds its closest point.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend
from harnack.backend.elementary import clamp, fmax, fmin, max_norm, safe_norm
from harnack.distance.cell_tree import FAR_SENTINEL, SurfaceCells
from harnack.distance.jump_surface_search import is_on_surface
from harnack.distance.tangent_plane import TangentPlane, has_hessian, in_batches
from harnack.fields.clearance import level_distance_lower_bound
from harnack.tracer import RayStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Levels
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume
    from harnack.tracer import TracedSurface

__all__ = ["CellClassifier", "ClipCurveDescent", "taylor_remainder"]

_ROUNDS, _MAX_CURVE_CORRECTIONS = 80, 8
# In epsilons, of coordinates: so far inside the domain feet are put, by how much they may miss
# that, and how near they are to the level.
_DOMAIN_INSET, _MISS, _NEAR = 64.0, 48.0, 256.0
# Of the way to another face: steps end there.
_BEFORE = 0.999
# States of a search at a corner of the domain: it turns into the other face, or has done so.
_TURNING, _TURNED = 1, 2
_LEAST_SHARE = 1e-9  # of a step: shorter ones are given up
_LEAST_SLOPE = 0.05  # of (x - y) . t along the curve: steps are no longer than 20 times that
_SAME = 1e-6  # cosines of angles between normals of one face differ from one by less
_LEAST_STEP = 1e-8  # of the distance: what is left is half its square


@dataclass(frozen=True)
class ClipCurveDescent:
    """Descent to the closest point of the clip curve, on which f = level and h = 0, where h is the
    distance from the domain's boundary; all prepared for one backend."""

    backend: Backend
    field: Field
    levels: Levels
    domain: Volume

    def closest(self, x: Vec3, start: Vec3) -> tuple[Vec3, Real]:
        """A point y of the curve at which the distance from x has a local minimum, by descent from
        `start`, and the curve's curvature there; NaN where the curve is not reached.

        Let the curve have the tangent t and the second derivative y'', which follows from those of
        f and h along t (differences of their gradients). Half the squared distance has the
        derivative -(x - y).t along the curve and the second derivative 1 - (x - y).y'', which give
        Newton's step w t + w^2/2 y''. After a step Newton's method for both equations leads back to
        the curve. The step counts if that comes nearer to x, else a quarter of it is tried. Where
        it led to another face of the domain instead, that face ends steps from then on, so that
        they lead to the corner where both faces meet; from there the search goes on, once, along
        the curve in the other face.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        x = vector(x)

        def body(
            y: Vec3, best: Vec3, nearest: Real, w: Real, tangent: Vec3, bend: Vec3, normal: Vec3,
            wall: Vec3, wall_height: Real, corner: Any, share: Real, landing: Any, k: Any,
            active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            there = self._at(y)
            distance = safe_norm(x - y)
            met = dr.isfinite(nearest)
            is_other = dr.dot(there.normal, normal) < 1 - _SAME
            gap = fmax(wall_height - dr.dot(wall, best), 0)
            turns = (
                (corner == _TURNING) & is_other & (distance < nearest + 8 * gap + 100 * there.near)
            )
            counts = there.is_on & (~met | (distance < nearest) | turns)
            # Beyond another face: that is a wall. Else off the curve: back to it, for some rounds.
            is_free = ~(dr.squared_norm(wall) > 0)
            crosses = met & is_other & is_free & ~counts & (corner != _TURNING)
            lands = ~there.is_on & ~crosses & (landing < _MAX_CURVE_CORRECTIONS)
            lands &= dr.isfinite(dr.squared_norm(there.correction))
            fails = ~counts & ~lands
            # On the curve, and nearer: the next step.
            slope = 1 - dr.dot(x - y, there.second_derivative)
            step = dr.dot(x - y, there.tangent) / fmax(dr.abs(slope), _LEAST_SLOPE)
            w = dr.select(counts, clamp(step, -distance, distance), w)
            best, nearest = dr.select(counts, y, best), dr.select(counts, distance, nearest)
            tangent = dr.select(counts, there.tangent, tangent)
            bend = dr.select(counts, there.second_derivative, bend)
            moves = counts & is_other
            wall = dr.select(crosses, there.normal, dr.select(moves, 0, wall))
            wall_height = dr.select(crosses, dr.dot(there.normal, y) + there.depth, wall_height)
            normal = dr.select(counts, there.normal, normal)
            share = dr.select(counts, fmin(4 * share, 1), share)
            share = dr.select(fails & ~crosses, 0.25 * share, share)
            # The wall is met where rate |s| + s^2/2 wall.bend is the gap.
            s, gap = share * w, fmax(wall_height - dr.dot(wall, best), 0)
            rate = dr.sign(w) * dr.dot(wall, tangent)
            root = rate + dr.sqrt(rate * rate + 2 * gap * dr.dot(wall, bend))
            until = dr.select(root > 0, _BEFORE * 2 * gap / root, dr.inf)
            is_limited = ~(is_free & ~crosses) & (until < dr.abs(s))
            s = dr.select(is_limited, clamp(s, -until, until), s)
            onward = dr.fma(vector(s), tangent, best) + vector(0.5 * s * s) * bend
            least = dr.select(is_limited, 0, _LEAST_STEP * nearest)
            is_short = dr.abs(s) <= fmax(least, there.near)
            corner = dr.select((corner == _TURNING) & ~lands, _TURNED, corner)
            ends = is_short & is_limited & ~lands & (corner == 0)
            corner = dr.select(ends, _TURNING, corner)
            onward = dr.select(ends, dr.fma(vector(gap + 8 * there.near), wall, best), onward)
            active &= (lands | counts | met) & (share > _LEAST_SHARE) & (k + 1 < _ROUNDS)
            active &= lands | ends | ~is_short
            y, landing = (
                dr.select(lands, y + there.correction, onward),
                dr.select(lands, landing + 1, 0),
            )
            return (
                y, best, nearest, w, tangent, bend, normal, wall, wall_height, corner, share,
                landing, k + 1, active,
            )  # fmt: skip

        def more(*state: Any) -> Mask:
            return state[-1]

        nothing, zero = vector(dr.nan), vector(0)
        state = (
            vector(start), nothing, real(dr.inf), real(0), zero, nothing, zero, zero, real(0),
            count(0), real(1), count(0), count(0), self.backend.Bool(True),
        )  # fmt: skip
        found = dr.while_loop(state, more, body, label="along the rim")
        return found[1], safe_norm(found[5])

    def _at(self, y: Vec3) -> _ClipCurveState:
        real, vector = self.backend.Float, self.backend.Array3f
        sample = self.field.evaluate(y)
        gradient, size = vector(sample.gradient), max_norm(y)
        steep, n = safe_norm(gradient), vector(self.domain.outward_normal(y))
        u = gradient / steep
        inwards = (
            -self.domain.signed_distance(y) - _DOMAIN_INSET * self.backend.machine_epsilon * size
        )
        off = self.levels.offset_to_nearest(sample.value) / steep
        near = dr.fma(_NEAR * self.backend.machine_epsilon, size, real(sample.value_error) / steep)
        cosine = dr.dot(n, u)
        sine = 1 - cosine * cosine

        def solution(along_u: Real, along_n: Real) -> Vec3:
            """The shortest vector with these products with u and n."""
            first, second = along_u - cosine * along_n, along_n - cosine * along_u
            return (vector(first) * u + vector(second) * n) / sine

        t = dr.cross(u, n) * dr.rsqrt(sine)
        h = self.backend.machine_epsilon**0.5 * fmax(size, real(1e-30))
        ahead = dr.fma(vector(h), t, y)
        falls = dr.dot(vector(self.field.evaluate(ahead).gradient) - gradient, t) / (steep * h)
        turns = dr.dot(vector(self.domain.outward_normal(ahead)) - n, t) / h
        # Beside an edge of the domain the normal is another one ahead: no curvature.
        turns = dr.select(dr.abs(turns) * h < 1e-3, turns, 0)
        is_on = (dr.abs(off) <= near) & (
            dr.abs(inwards) <= _MISS * self.backend.machine_epsilon * size
        )
        return _ClipCurveState(
            is_on, near, solution(off, inwards), t, solution(-falls, -turns), n, inwards
        )


@dataclass(frozen=True)
class _ClipCurveState:
    """A place near the rim.

    is_on: whether it is on it, to `near`.
    correction: the step back to it, to first order.
    tangent, second_derivative: unit tangent and second derivative of the rim.
    normal: of the domain.
    depth: how far the place is inside the domain, less a margin.
    """

    is_on: Mask
    near: Real
    correction: Vec3
    tangent: Vec3
    second_derivative: Vec3
    normal: Vec3
    depth: Real


# Cells.

_STEPS = 6
# More of them where Newton's steps shrink at a rate between these, as to a multiple root.
_MORE_STEPS, _SHRINKS = 14, (0.4, 0.97)
# The radius of the ball around a cube of half size 1.
_CUBE_CIRCUMRADIUS = 3**0.5 * (1 + 1e-9)
# A foot is on the level up to this share of its cell.
_CLOSE = 1e-7
# Rays through a cell of a field that jumps.
_DIAGONALS = ((1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0))


def taylor_remainder(sample: Sample, radius: Real, degree: int = 1) -> Real:
    """A bound of the Taylor remainder: by how much the Taylor polynomial of f about p, of degree 1
    or 2, differs from f(y) for |y - p| <= radius. Infinite where the field promises no bound. As a
    function of the radius it falls at least as the power degree + 1."""
    best: Real = dr.inf
    for known in sample.all_promises:
        best = fmin(best, known.taylor_remainder_bound(sample.value, radius, degree))
    return best + sample.value_error + sample.gradient_error * radius


def multiplicity(step: Real, last: Real) -> Real:
    """The multiplicity m of the root to which Newton's steps lead, by the lengths of the last two
    steps: at a root like that of u^m steps shrink by the factor 1 - 1/m, and a step m times as long
    as Newton's leads to the root. It is 1 where steps shrink faster, or hardly."""
    ratio = dr.abs(step) / last
    is_slow = (ratio > _SHRINKS[0]) & (ratio < _SHRINKS[1])
    return dr.select(is_slow, 1 / (1 - ratio), 1)


@dataclass
class CellClassifier:
    """Classifies the cells of a level set, in double precision."""

    surface: TracedSurface

    def __post_init__(self) -> None:
        self._backend = choose_backend("double")
        self._prepared = self.surface.prepare(self._backend)
        self._levels = self._prepared.levels
        self._volume = _domain(self.surface)
        self._has_hessian = has_hessian(self._backend, self._field)
        self._rim = None
        if self._volume is not None and not self.surface.field.has_jumps:
            volume = self._volume.prepare(self._backend)
            self._rim = ClipCurveDescent(self._backend, self._field, self._levels, volume)

    @property
    def _field(self) -> Field:
        return self._prepared.field

    def nonempty_cells(self, center: FloatArray, half: FloatArray) -> SurfaceCells:
        """The cubes that are not proved empty, with the slabs that the surface lies in.

        center: (n, 3) of cubes.
        half: (n,) half the length of their edges.
        """
        inside = np.ones(len(center), np.bool_)
        if self._volume is not None and len(center):
            inside = self._volume.contains_points(center)
            (away,) = self._at(self._distance_outside, center)
            some = inside | (away <= _CUBE_CIRCUMRADIUS * half)
            center, half, inside = center[some], half[some], inside[some]
        cells = SurfaceCells.unknown(center, half)
        if not inside.any():
            return cells
        # Nothing is promised about places outside the domain.
        empty, cells.normal[inside], cells.offset[inside], cells.thickness[inside] = self._at(
            self._slab, center[inside], _CUBE_CIRCUMRADIUS * half[inside]
        )
        not_empty = np.ones(len(cells), np.bool_)
        not_empty[inside] = empty == 0
        return cells.select(not_empty)

    def with_surface_points(self, cells: SurfaceCells) -> SurfaceCells:
        """The cells, completed by points of the surface and of the clip curve."""
        if not len(cells):
            return cells
        radius, start = _CUBE_CIRCUMRADIUS * cells.half, cells.center
        away = np.full(len(cells), np.inf)
        if self._volume is not None:
            away, start = self._at(self._pulled_inside, cells.center)
        foot, normal, spread, curvature = self._at(
            self._surface_point_and_plane, start, radius, cells.normal
        )
        self._outside(foot)
        rim, rim_curvature = cells.clip_point.copy(), cells.clip_curvature.copy()
        if self._rim is not None:
            cut = np.flatnonzero(np.abs(away) <= radius)
            rim[cut], rim_curvature[cut] = self._at(self._on_rim, start[cut], radius[cut])
            self._outside(rim)
        return dataclasses.replace(
            cells,
            surface_point=foot,
            normal=normal,
            plane_radius=spread,
            curvature=curvature,
            clip_point=rim,
            clip_curvature=rim_curvature,
        )

    def _at(
        self, compute: Callable[..., tuple[Any, ...]], points: FloatArray, *others: FloatArray
    ) -> tuple[Any, ...]:
        """others: vectors (n, 3), or numbers (n,) that come as vectors of equal components."""
        vectors = (np.tile(one[:, None], 3) if one.ndim == 1 else one for one in others)
        return in_batches(self._backend, compute, points, *vectors)

    def _outside(self, feet: FloatArray) -> None:
        """Put feet (n, 3) that lie outside the domain far away."""
        if self._volume is not None and len(feet):
            feet[~self._volume.contains_points(np.where(feet < FAR_SENTINEL, feet, 0))] = (
                FAR_SENTINEL
            )

    def _distance_outside(self, p: Vec3) -> tuple[Real]:
        return (self._volume.signed_distance(p),)

    def _pulled_inside(self, p: Vec3) -> tuple[Real, Vec3]:
        """How far p is from the domain, at least, and p or a place near it on the boundary."""
        assert self._volume is not None
        away = self._volume.signed_distance(p)
        normal = self._volume.outward_normal(p)
        return away, dr.select(away > 0, p - self._backend.Array3f(away) * normal, p)

    def _slab(self, p: Vec3, radii: Vec3) -> tuple[Real | Vec3, ...]:
        """Whether there is no level in the ball (1 or 0); the slab that the level lies in."""
        real, vector, radius = self._backend.Float, self._backend.Array3f, radii.x
        sample = self._field.evaluate(p)
        free = real(0)
        if sample.all_promises:
            free = level_distance_lower_bound(self._backend, self._field, self._levels, p, sample)
        above, steep = -self._levels.offset_to_nearest(sample.value), safe_norm(sample.gradient)
        rest = taylor_remainder(sample, radius) + 8 * self._backend.machine_epsilon * dr.abs(
            sample.value
        )
        known = (steep > 0) & dr.isfinite(rest) & (rest < FAR_SENTINEL * steep)
        if len(self._levels.values) > 1 or self.surface.field.has_jumps:
            known &= False
        elif self._levels.period is not None:  # no second level reaches into the ball
            known &= dr.fma(steep, radius, rest) < self._levels.period - dr.abs(above)
        slope = dr.select(known, steep, 1)
        normal = dr.select(known, sample.gradient / slope, vector(0, 0, 0))
        offset = dr.select(known, -above / slope, 0)
        thickness = dr.select(known, rest / slope, FAR_SENTINEL)
        empty = (free > radius) | (known & (dr.abs(offset) > radius + thickness))
        return dr.select(empty, real(1), 0), normal, offset, thickness

    def _surface_point_and_plane(
        self, p: Vec3, radii: Vec3, normal: Vec3
    ) -> tuple[Vec3, Vec3, Real, Real]:
        """A foot near p, the normal of a plane that is nearly the surface there, how far about the
        foot: as far as the cell, up to the curve that the surface ends in; and its curvature."""
        radius, unknown = radii.x, self._backend.Float(FAR_SENTINEL)
        if self.surface.field.has_jumps:
            return self._nearest_ray_hit(p, radius), normal, self._backend.Float(0), unknown
        foot = self._newton_point(p, radius)
        found = foot.x < 0.5 * FAR_SENTINEL
        at = dr.select(found, foot, p)
        gradient = self._field.evaluate(at).gradient
        n = gradient / safe_norm(gradient)
        is_plane = found & ~(dr.squared_norm(normal) > 0) & dr.isfinite(dr.squared_norm(n))
        spread, boundary = radius + safe_norm(at - p), self._field.closest_boundary_point(at)
        if boundary is not None:
            spread = fmin(spread, safe_norm(boundary - at))
        curvature = unknown
        if self._has_hessian:
            uu, vv, uv = TangentPlane.of(gradient).restrict_hessian(self._field.hessian(at))
            bent = dr.sqrt(dr.fma(uu, uu, dr.fma(vv, vv, 2 * uv * uv))) / safe_norm(gradient)
            curvature = dr.select(bent < FAR_SENTINEL, bent, unknown)
        return foot, dr.select(is_plane, n, normal), dr.select(found, spread, 0), curvature

    def _on_rim(self, p: Vec3, radii: Vec3) -> tuple[Vec3, Real]:
        """A point of the rim near p, and the rim's curvature."""
        assert self._rim is not None
        y, curvature = self._rim.closest(p, p)
        near = safe_norm(y - p) < 2 * radii.x
        return dr.select(near, y, self._backend.Array3f(FAR_SENTINEL)), dr.select(
            near, curvature, 0
        )

    def _newton_point(self, p: Vec3, radius: Real) -> Vec3:
        """Where Newton's method leads from the center, if that is near."""
        real, vector, count = self._backend.Float, self._backend.Array3f, self._backend.UInt32
        zero = dr.opaque(real, 0.0)  # no component of a gradient is a constant of the loop

        def body(y: Vec3, off: Real, k: Any) -> tuple[Any, ...]:
            sample = self._field.evaluate(y)
            steep = safe_norm(sample.gradient)
            off_level = self._levels.offset_to_nearest(sample.value)
            wanted = off_level / steep
            longer = dr.select(k >= _STEPS - 1, multiplicity(wanted, off), 1)
            move = clamp(longer * wanted, -radius, radius)
            going = dr.isfinite(move) & (dr.norm(y - p) < 4 * radius)
            shrinks = (k < _STEPS - 1) | (dr.abs(wanted) < _SHRINKS[1] * off)
            # On a surface along which the gradient is 0 the last step was the last one.
            is_flat = (off_level == 0) & (steep == 0)
            off = dr.select(going, dr.abs(wanted), dr.select(is_flat, 0, dr.inf))
            y = dr.select(going, dr.fma(vector(move / steep), sample.gradient + zero, y), y)
            going &= shrinks & (off > 1e-9 * radius)
            return y, off, dr.select(going, k + 1, _MORE_STEPS)

        def more(y: Vec3, off: Real, k: Any) -> Mask:
            del y, off
            return k < _MORE_STEPS

        start = (vector(p), real(dr.inf), count(0))
        y, off, _ = dr.while_loop(start, more, body, label="feet of cells")
        near = (off < _CLOSE * radius) & (dr.norm(y - p) < 2 * radius)
        return dr.select(near, y, vector(FAR_SENTINEL))

    def _nearest_ray_hit(self, p: Vec3, radius: Real) -> Vec3:
        """The hit nearest to the center of rays through the cell, of a field that jumps."""
        real, vector, count = self._backend.Float, self._backend.Array3f, self._backend.UInt32

        def body(foot: Vec3, best: Real, k: Any) -> tuple[Any, ...]:
            d = vector(*_DIAGONALS[0]) / 3**0.5
            for number, diagonal in enumerate(_DIAGONALS[1:], 1):
                d = dr.select(k == number, vector(*diagonal) / 3**0.5, d)
            o = dr.fma(vector(-radius), d, p)
            seen = self._prepared.first_hit(o, d, real(0), 2 * radius, self._backend.Bool(True))
            hit = seen.status == int(RayStatus.HIT)
            y = dr.fma(vector(seen.t), d, o)
            square = dr.squared_norm(y - p)
            nearer = hit & (square < best)
            nearer &= is_on_surface(self._prepared, y, seen, nearer)
            return dr.select(nearer, y, foot), dr.select(nearer, square, best), k + 1

        def more(foot: Vec3, best: Real, k: Any) -> Mask:
            del foot, best
            return k < len(_DIAGONALS)

        start = (vector(FAR_SENTINEL), real(dr.inf), count(0))
        return dr.while_loop(start, more, body, label="rays through cells")[0]


def _domain(surface: TracedSurface) -> Any:
    return surface.field.domain if surface.clip_volume is None else surface.volume
