"""A slice of the sum of two solid angles in four dimensions, strictly between its ends."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import backend_of
from harnack.backend.extrema import fmax
from harnack.enclosures import HarmonicBall
from harnack.fields.batch import BatchedField, Values
from harnack.fields.clearance import occupied_cells, tight_extent
from harnack.fields.field import Sample
from harnack.fields.meshes.centroids import Centroids, centroids, piece_counts
from harnack.fields.meshes.sliced_kernel import SlicedKernel
from harnack.fields.multipoles.dipole_records import dipole_rows
from harnack.fields.multipoles.radial_kernel import BALL, RadialSums
from harnack.fields.multipoles.radial_tree import ClusteredDipoles, TreeSum
from harnack.fields.points import at_points
from harnack.fields.sums import SLOPE_ROUNDINGS, SUM_ROUNDING
from harnack.fields.unit_coordinates import (
    DetailedField,
    UnitCoordinates,
    epsilon_at,
    placed,
    single,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, FloatArray, Precision, Real, Vec3
    from harnack.cells import OccupiedCells
    from harnack.geometry import Volume

MOST_POINTS = 4_000_000
"""Points of the quadrature of both meshes together."""

_SMALLEST_LEVEL = 1e-6
# Cells that an extent looks at in one round, at most.
_MOST_CELLS = 40_000
# Cells of the grid along its longest side, by experiment.
_ACROSS = 128


class MorphSlice(DetailedField["_SliceBuffers"], BatchedField):
    """f(x) = (U_a(x, w) + U_b(x, gap - w))/(2 pi^2), 0 < w < gap: see `Morph`.

    corners: two arrays (m, 3, 3) of triangles. w, gap, spacing, accuracy: as for `Morph`.

    Promises, with the 4D distances D of all points, d the least of them (`sliced_kernel` has the
    proof that terms bend no more than dipoles at a distance D): `Curvature` within 0.45 d, and a
    `HarmonicBall` of dimension 4 and radius 0.35 d, which proves shorter steps.
    """

    default_level = 0.5
    values_take_more = False

    def __init__(
        self, corners: Sequence[FloatArray], *, w: float, gap: float, spacing: float,
        accuracy: float,
    ) -> None:  # fmt: skip
        super().__init__()
        self.heights = (w, gap - w)
        self.spacing, self.accuracy = spacing, accuracy
        low = np.min([one.min(axis=(0, 1)) for one in corners], axis=0)
        high = np.max([one.max(axis=(0, 1)) for one in corners], axis=0)
        self._box = low, high
        self._centre = single(0.5 * (low + high))
        # A power of two, so that lengths are scaled without rounding.
        self._size = 2.0 ** math.ceil(math.log2(0.5 * float((high - low).max())))
        longest = [spacing * height for height in self.heights]
        _check_count([piece_counts(*one) for one in zip(corners, longest, strict=True)], w, gap)
        self._pieces = tuple(centroids(*one) for one in zip(corners, longest, strict=True))
        self._dipoles = tuple(self._clustered(one) for one in self._pieces)
        self._extents: dict[tuple[float, ...], Volume] = {}
        self._occupied: dict[tuple[float, ...], OccupiedCells] = {}

    def _clustered(self, pieces: Centroids) -> ClusteredDipoles:
        """The pieces in unit coordinates, scaled so that f is the sum of both."""
        share = 1 / (8 * math.pi * self._size**2)
        points = (pieces.points - self._centre) / self._size
        return ClusteredDipoles.of(dipole_rows(points, share * pieces.moments))

    @property
    def point_counts(self) -> tuple[int, ...]:
        """Points of the quadrature of each mesh."""
        return tuple(len(one.rows) for one in self._dipoles)

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> Values:
        on = self._batch(backend_of(x))
        x = on.unit(x)
        sums = on.sums(x, closer, derivatives).sums
        rounding = 8 * on.backend.epsilon * dr.abs(sums.value)
        values = sums.values(1.0, epsilon_at(x), rounding)
        weight = sum(float(one.rows[:, 6].sum()) for one in self._dipoles)
        return values.far_away(x, 64, weight).rescaled(on.size)

    def quadrature_displacement(self, points: Any, precision: Precision = "single") -> FloatArray:
        """As `Morph.quadrature_displacement`.

        A part with moment m whose point is D away is off by at most 2 |T|_* /D^3, the nuclear norm
        of T = sum of m_i times d_i, at most sqrt(3) times Frobenius', and by the remainder of
        Taylor's formula: |m| times the mean of |d|^2 (3-2q)/((1-q)^2 D^4), q = |d|/D
        (`RadialSums.remainder`). It is infinite where a part reaches farther than its point is.
        """

        def kernel(backend: Backend, x: Vec3) -> tuple[Real]:
            on = self._batch(backend)
            x = on.unit(x)
            error, gradient = backend.Float(0), backend.Array3f(0)
            for cloud, piece, height in zip(on.clouds, self._pieces, self.heights, strict=True):
                sums = cloud.sums(x, 1.0, 1)
                share = piece.farthest / height
                bend = dr.inf
                if share < 1:
                    bend = sums.remainder(share, piece.farthest / self._size, 1.0)
                error = dr.fma(piece.spread / self._size**2, bend, error)
                error = dr.fma(2 * math.sqrt(3) * piece.slant / self._size, sums.steep, error)
                gradient = gradient + sums.sums.gradient
            return (error / dr.norm(gradient) * on.size,)

        return at_points(points, kernel, precision)[0]

    def _upload(self, backend: Backend, *, traced: bool) -> _SliceBuffers:
        del traced
        clouds = tuple(
            TreeSum(backend, dipoles, SlicedKernel(backend, height / self._size), self.accuracy)
            for dipoles, height in zip(self._dipoles, self.heights, strict=True)
        )
        return _SliceBuffers(*placed(backend, self._centre, self._size), clouds)

    def _sample(self, on: _SliceBuffers, p: Vec3, detail: Real) -> Sample:
        return on.sample(p, detail)

    def check_levels(self, levels: tuple[float, ...]) -> None:
        for level in levels:
            if abs(level) < _SMALLEST_LEVEL:
                raise ValueError("level 0 of a morph reaches to infinity; the surface is at 0.5")

    def extent(self, levels: tuple[float, ...]) -> Volume:
        """A box without its cells that are proved empty (`tight_extent`): at a distance rho from
        all points |f| is at most their weight over rho^2."""
        if levels not in self._extents:
            weight = sum(float(one.rows[:, 6].sum()) for one in self._dipoles)
            reach = 1.0001 * self._size * math.sqrt(weight / min(abs(level) for level in levels))
            low, high = self._box
            self._extents[levels] = tight_extent(
                self, levels, low - reach, high + reach, _MOST_CELLS
            )
        return self._extents[levels]

    def occupied(self, levels: tuple[float, ...]) -> OccupiedCells:
        if levels not in self._occupied:
            self._occupied[levels] = occupied_cells(self, levels, self.extent(levels), _ACROSS)
        return self._occupied[levels]


@dataclass(frozen=True)
class _SliceBuffers(UnitCoordinates):
    """The points of both meshes on a backend, each seen from a height of its own."""

    clouds: tuple[TreeSum, ...]

    def sums(self, x: Vec3, closer: Real, derivatives: int) -> RadialSums:
        """Over both."""
        sums = RadialSums.zero(self.backend, derivatives)
        for cloud in self.clouds:
            sums = cloud.added(sums, x, closer)
        return sums

    def sample(self, p: Vec3, detail: Real) -> Sample:
        """f at points p, in units of `size`."""
        x = self.unit(p)
        radial = self.sums(x, detail, 1)
        sums = radial.sums
        slope_error = dr.fma(SLOPE_ROUNDINGS * epsilon_at(x), sums.s4, sums.slope_truncation)
        nearest = sums.free_distance * (1 - SUM_ROUNDING) - 8 * self.backend.epsilon
        nearest = fmax(nearest, 0)
        r = BALL * nearest
        moved = radial.variation(r, 1.0)
        ball = HarmonicBall(r * self.size, sums.value - moved, sums.value + moved, dimension=4)
        return Sample(
            sums.value,
            sums.gradient / self.size,
            radial.curvatures(lambda r: 1.0, nearest, self.size),
            sums.truncation + sums.rounding,
            slope_error / self.size,
            truncation=sums.truncation,
            weaker=(ball,),
        )


def _check_count(counts: Sequence[Any], w: float, gap: float) -> None:
    count = sum(int((one.astype(float) ** 2).sum()) for one in counts)
    if count > MOST_POINTS:
        raise ValueError(
            f"w = {w:g} is so near to an end of the gap {gap:g} that {count:,} points would be "
            f"needed, more than {MOST_POINTS:,}: show the end itself (w = 0 or w = gap), or choose "
            "a larger spacing"
        )
