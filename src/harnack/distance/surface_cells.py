"""What is proved about the level set in cells: that it is not there, or that it lies in a slab."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend
from harnack.backend.extrema import clamp, fmin
from harnack.backend.lengths import length
from harnack.distance.batches import in_batches
from harnack.distance.cell_tree import FAR, SurfaceCells
from harnack.enclosures import Curvature, HarmonicBall
from harnack.fields.clearance import distance_below
from harnack.tracer import Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Mask, Real, Vec3
    from harnack.cells import Cells
    from harnack.enclosures.promises import Promise
    from harnack.fields.field import Field, Sample
    from harnack.tracer import LevelSet

__all__ = ["CellProofs", "remainder"]

_STEPS = 6
# A foot is on the level up to this share of its cell.
_CLOSE = 1e-7
# Rays through a cell of a field with sheets.
_DIAGONALS = ((1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0))


def remainder(sample: Sample, radius: Real) -> Real:
    """A bound of |f(y) - value - gradient . (y - p)| for |y - p| <= radius; infinite where the
    field promises none. It falls at least as the square of the radius.

    Proof for a harmonic f >= c on a ball of radius R in n dimensions: f - c is the integral of
    Poisson's kernel P(q, s) = sum over l of the zonal harmonics, all largest at s = 1, with a
    measure of mass f(p) - c; those of degree 0 and 1 are the value and the gradient. The rest is
    between -(P - 1 - n q) and P - 1 - n q at s = 1, P = (1 + q)/(1 - q)^(n - 1), times f(p) - c.
    The same holds for C - f, and the smaller of both counts.
    """
    best: Real = dr.inf
    for known in sample.promises:
        best = fmin(best, _of_promise(known, sample.value, radius))
    return best + sample.error + sample.gradient_error * radius


def _of_promise(known: Promise, value: Real, radius: Real) -> Real:
    if isinstance(known, Curvature):
        bound = 0.5 * known.constant * radius * radius
        return dr.select(radius < known.radius, bound, dr.inf)
    if not isinstance(known, HarmonicBall):
        return dr.inf
    mass = fmin(value - known.lower, known.upper - value)
    q = radius / known.radius
    rest = {
        2: 2 * q * q / (1 - q),
        3: q * q * (5 - 3 * q) / dr.square(1 - q),
        4: q * q * (9 - q * (11 - 4 * q)) / (dr.square(1 - q) * (1 - q)),
    }[known.dimension]
    return dr.select((q < 1) & (mass < dr.inf), mass * rest, dr.inf)


@dataclass
class CellProofs:
    """Cells of a level set, looked at in double precision.

    cells: how many were looked at so far.
    """

    surface: LevelSet
    looked_at: int = dataclasses.field(default=0, init=False)

    def __post_init__(self) -> None:
        self._backend = choose_backend("double")
        self._prepared = self.surface.prepare(self._backend)
        self._levels = self._prepared.levels
        self._volume = _domain(self.surface)

    @property
    def _field(self) -> Field:
        return self._prepared.field

    def kept(self, cells: Cells) -> SurfaceCells:
        """Of cubes those that are not proved empty, with what is known of them."""
        self.looked_at += len(cells.corners)
        centre, half = cells.centres, 0.5 * float(cells.size[0])
        radius = dr.opaque(self._backend.Float, cells.half_diagonal * (1 + 1e-9))
        inside, start = np.ones(len(centre), np.bool_), centre
        if self._volume is not None:
            inside = self._volume.contains_points(centre)
            away, start = self._at(centre, self._pulled_inside)
            some = inside | (away <= cells.half_diagonal * (1 + 1e-9))
            centre, inside, start = centre[some], inside[some], start[some]
        n = len(centre)
        result = SurfaceCells(
            centre, np.full(n, half), np.full((n, 3), FAR), np.tile([0.0, 0.0, 1.0], (n, 1)),
            np.zeros(n), np.full(n, FAR),
        )  # fmt: skip
        kept = np.ones(n, np.bool_)
        # Nothing is promised about places outside the domain.
        empty, result.normal[inside], result.offset[inside], result.thickness[inside] = self._at(
            centre[inside], lambda p: self._slab(p, radius)
        )
        kept[inside] = empty == 0
        result, start = result.some(kept), start[kept]
        find = self._hit if self.surface.field.has_sheets else self._foot
        (foot,) = self._at(start, lambda p: (find(p, radius),))
        if self._volume is not None and len(foot):
            foot[~self._volume.contains_points(np.where(foot < FAR, foot, 0))] = FAR
        result.foot[:] = foot
        return result

    def _at(
        self, points: FloatArray, compute: Callable[[Vec3], tuple[Any, ...]]
    ) -> tuple[Any, ...]:
        return in_batches(self._backend, compute, points)

    def _pulled_inside(self, p: Vec3) -> tuple[Real, Vec3]:
        """How far p is from the domain, at least, and p or a place near it on the boundary."""
        assert self._volume is not None
        away = self._volume.signed_distance(p)
        normal = self._volume.outward_normal(p)
        return away, dr.select(away > 0, p - self._backend.Array3f(away) * normal, p)

    def _slab(self, p: Vec3, radius: Real) -> tuple[Real | Vec3, ...]:
        """Whether there is no level in the ball (1 or 0); the slab that the level lies in."""
        real, vector = self._backend.Float, self._backend.Array3f
        sample = self._field.evaluate(p)
        free = real(0)
        if sample.promises:
            free = distance_below(self._backend, self._field, self._levels, p, sample)
        above, steep = -self._levels.to_nearest(sample.value), length(sample.gradient)
        rest = remainder(sample, radius) + 8 * self._backend.epsilon * dr.abs(sample.value)
        known = (steep > 0) & dr.isfinite(rest) & (rest < FAR * steep)
        if len(self._levels.values) > 1 or self.surface.field.has_sheets:
            known &= False
        elif self._levels.period is not None:  # no second level reaches into the ball
            known &= dr.fma(steep, radius, rest) < self._levels.period - dr.abs(above)
        slope = dr.select(known, steep, 1)
        normal = dr.select(known, sample.gradient / slope, vector(0, 0, 1))
        offset = dr.select(known, -above / slope, 0)
        thickness = dr.select(known, rest / slope, FAR)
        empty = (free > radius) | (known & (dr.abs(offset) > radius + thickness))
        return dr.select(empty, real(1), 0), normal, offset, thickness

    def _foot(self, p: Vec3, radius: Real) -> Vec3:
        """Where Newton's method leads from the centre, if that is near."""
        real, vector, count = self._backend.Float, self._backend.Array3f, self._backend.UInt32
        zero = dr.opaque(real, 0.0)  # no component of a gradient is a constant of the loop

        def body(y: Vec3, off: Real, k: Any) -> tuple[Any, ...]:
            sample = self._field.evaluate(y)
            steep = length(sample.gradient)
            wanted = self._levels.to_nearest(sample.value) / steep
            move = clamp(wanted, -radius, radius)
            going = dr.isfinite(move) & (dr.norm(y - p) < 4 * radius)
            off = dr.select(going, dr.abs(wanted), dr.inf)
            y = dr.select(going, dr.fma(vector(move / steep), sample.gradient + zero, y), y)
            return y, off, dr.select(going & (off > 1e-9 * radius), k + 1, _STEPS)

        def more(y: Vec3, off: Real, k: Any) -> Mask:
            del y, off
            return k < _STEPS

        start = (vector(p), real(dr.inf), count(0))
        y, off, _ = dr.while_loop(start, more, body, label="feet of cells")
        near = (off < _CLOSE * radius) & (dr.norm(y - p) < 2 * radius)
        return dr.select(near, y, vector(FAR))

    def _hit(self, p: Vec3, radius: Real) -> Vec3:
        """The hit nearest to the centre of rays through the cell, of a field that jumps."""
        real, vector, count = self._backend.Float, self._backend.Array3f, self._backend.UInt32

        def body(foot: Vec3, best: Real, k: Any) -> tuple[Any, ...]:
            d = vector(*_DIAGONALS[0]) / 3**0.5
            for number, diagonal in enumerate(_DIAGONALS[1:], 1):
                d = dr.select(k == number, vector(*diagonal) / 3**0.5, d)
            o = dr.fma(vector(-radius), d, p)
            seen = self._prepared.first_hit(o, d, real(0), 2 * radius, self._backend.Bool(True))
            hit = seen.status == int(Status.HIT)
            y = dr.fma(vector(seen.t), d, o)
            square = dr.squared_norm(y - p)
            nearer = hit & (square < best)
            return dr.select(nearer, y, foot), dr.select(nearer, square, best), k + 1

        def more(foot: Vec3, best: Real, k: Any) -> Mask:
            del foot, best
            return k < len(_DIAGONALS)

        start = (vector(FAR), real(dr.inf), count(0))
        return dr.while_loop(start, more, body, label="rays through cells")[0]


def _domain(surface: LevelSet) -> Any:
    return surface.field.domain if surface.clip is None else surface.volume
