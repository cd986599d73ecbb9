"""The dipole potential of oriented point clouds: Poisson reconstruction without a grid.

`DipolePotential` is the field, `DipoleTree` its sum by a tree, with far dipoles as multipoles.

The points of a field stay as they are (attributes such as `points` cannot be set): trees, cells and
extents are made of them once. `with_points` makes another field.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend import backend_of
from harnack.backend.elementary import fmax
from harnack.backend.validation import as_positive, as_real, no_derivatives
from harnack.fields.batched_fields import PointValues, SymmetricMatrix, sharpened
from harnack.fields.clearance import (
    UnitFrame,
    VariableAccuracyField,
    coordinate_rounding,
    frame_parameters,
    round_to_single,
)
from harnack.fields.field import Sample, space_scaled
from harnack.fields.solid_angles.cell_options import FieldWithCells
from harnack.fields.solid_angles.denoised_cloud import DenoisedCloud
from harnack.fields.solid_angles.dipole_cells import DipoleCells, build_cells
from harnack.fields.solid_angles.multipole import dipole_tree_moments
from harnack.fields.solid_angles.oriented_points import OrientedPoints
from harnack.fields.solid_angles.smoothed import SmoothedSum
from harnack.fields.solid_angles.treecode import (
    AddPrimitive,
    Treecode,
    dipole_hierarchy,
    dipole_records,
    records_in_slots,
)
from harnack.fields.source_sums import SourceSums, SourceTerm, dipole_rounding, final_rounding
from harnack.geometry import Box, CloudError, estimate_areas, estimate_normals, validate_cloud

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3
    from harnack.backend.record_table import RecordTable
    from harnack.fields.solid_angles.multipole import NodeMoments
    from harnack.geometry import Volume
    from harnack.tree import BalancedTree

# Cells are built by themselves from so many rays a point, and so many rays, on, and up to so many
# points. To build them takes as long as to trace about 6 rays a point without them; smaller ones,
# in which a ray takes two thirds of the time, pay from more rays a point on.
_PAYS, _LEAST_RAYS, _MOST_POINTS = 7, 100_000, 200_000
_FINER_PAYS = 60
# A point counts as near if the squared distance is less than this fraction of its area.
_SINGLE_POINT = 0.04


BuildCells: TypeAlias = "Callable[[list[NodeMoments], FloatArray, RecordTable], DipoleCells | None]"
"""Makes cells from the moments of a tree, and its dipoles as rows and on the backend."""


@dataclass(frozen=True)
class DipoleTree:
    """sum_i m_i.(y_i - x)/|y_i - x|^3 on a backend; a record holds y_i, m_i and |m_i|.

    cells: where samples cost only what is near; None for none.
    """

    clusters: Treecode
    rounding: Real
    cells: DipoleCells | None = None

    @property
    def backend(self) -> Backend:
        return self.clusters.backend

    @classmethod
    def of(
        cls, backend: Backend, tree: BalancedTree, points: FloatArray, moments: FloatArray,
        accuracy: float, build: BuildCells | None = None,
    ) -> DipoleTree:  # fmt: skip
        """From points (n, 3) of size about one and moments (n, 3), area times normal.

        tree: `dipole_hierarchy` these points, or of the same points at earlier positions.
        build: makes cells.
        """
        levels = dipole_tree_moments(tree, points[:, None], moments[:, None], points, points)
        rows = dipole_records(points, moments)
        rounding = final_rounding(backend, size=max(1.0, float(rows[:, 6].sum())))
        slots = records_in_slots(tree, rows)
        clusters = Treecode.of(backend, tree, levels, slots, accuracy)
        cells = None if build is None else build(levels, slots, clusters.tree.primitives)
        return cls(clusters, rounding, cells)

    @property
    def coarsest_accuracy(self) -> float:
        """The accuracy scale of coarse samples (`Field.coarsest_accuracy`)."""
        return self.clusters.coarsest_accuracy if self.cells is None else 1.0

    def values(self, x: Vec3, derivatives: int, closer: Real) -> PointValues:
        """Value and the derivatives asked for at x; closer: the detail, at least 1."""
        unit, detail = (
            coordinate_rounding(x),
            fmax(self.backend.Float(closer), self.backend.Float(1)),
        )
        sums, _ = self._near_sums(x, detail, unit, derivatives)
        return self.clusters.values(sums, 1.0, unit, self.rounding)

    def _sums(self, x: Vec3, detail: Real, unit: Real, derivatives: int) -> tuple[SourceSums, Vec3]:
        """All sums, and the moment of the nearest dipole of a near leaf."""
        add, vector = _dipole_adder(x, unit, derivatives), self.backend.Array3f
        sums, own = self.clusters.sums(x, detail, add, (vector(0),), derivatives=derivatives)
        return sums, own[0]

    def _near_sums(
        self, x: Vec3, detail: Real, unit: Real, derivatives: int = 1
    ) -> tuple[SourceSums, Vec3]:
        """As `_sums`, by the cells where there are any and derivatives are not second ones."""
        if self.cells is None or derivatives == 2:
            return self._sums(x, detail, unit, derivatives)
        add, none = _dipole_adder(x, unit, 1), (self.backend.Array3f(0),)
        sums, own = self.cells.sums_with_tree(self.clusters, x, detail, (add, add), none)
        return sums, own[0]

    def sample(self, x: Vec3, detail: Real) -> Sample:
        """Value, gradient and promises at x: see `SourceSums.sample`.

        With cells, details up to 1 are what their expansions give, and larger ones the tree's.
        """
        unit = coordinate_rounding(x)
        found, nearest = self._near_sums(x, detail, unit)
        # Where the field of one point dominates, shade with that point's normal, reversed, as f
        # is larger inside.
        weight = dr.norm(nearest)
        beside = (
            found.singularity_distance * found.singularity_distance < _SINGLE_POINT * weight
        ) & (weight > 0)
        normal = dr.select(beside, -nearest / weight, dr.normalize(found.gradient))
        return found.sample(1.0, unit, self.rounding, normal)


def _dipole_adder(x: Vec3, unit: Real, derivatives: int) -> AddPrimitive:
    """A function that adds a dipole to sums at x, and keeps the moment of the nearest one."""
    vector = cast("Any", type(x))

    def add(
        row: list[Real], active: Mask, sums: SourceSums, own: tuple[Any, ...]
    ) -> tuple[SourceSums, tuple[Any, ...]]:
        inverse, terms = _dipole(row, x, derivatives)
        distance, some = dr.rcp(inverse), active & (row[6] > 0)
        # An upper bound of 1/(distance - 2 unit), 2 unit being the rounding of the distance:
        # 1/(1-z) <= 1 + 2z for z <= 1/2. Nearer to a dipole nothing is known, and all bounds
        # are infinite. Padding has no area and adds nothing.
        z = 2 * unit * inverse
        closer = dr.select(z <= 0.5, dr.fma(2 * z, inverse, inverse), dr.inf)
        closer = dr.select(some, closer, 0)
        fourth = row[6] * dr.square(closer * closer)
        nearer = some & (distance <= sums.singularity_distance)
        added = sums.add_term(terms, active & (inverse < dr.inf))
        new = dataclasses.replace(
            added,
            rounding=added.rounding + dipole_rounding(row[6], closer, unit),
            singularity_distance=dr.select(nearer, distance, sums.singularity_distance),
            s4=sums.s4 + fourth,
            s5=dr.fma(fourth, closer, sums.s5),
        )
        return new, (dr.select(nearer, vector(*row[3:6]), own[0]),)

    return add


def _dipole(row: list[Real], x: Vec3, derivatives: int) -> tuple[Real, SourceTerm]:
    """One over the distance to a dipole, and its value and, if asked for, gradient (paper, Eq. 12
    and 15) and Hessian.

    With z = y - x and u = 1/|z|: f = m.z u^3, grad f = 3 (m.z) u^5 z - m u^3, and
    Hess f = 15 (m.z) u^7 z z^T - 3 u^5 (m z^T + z m^T + (m.z) I).
    """
    vector = cast("Any", type(x))
    z, m = vector(*row[:3]) - x, vector(*row[3:6])
    u = dr.rsqrt(dr.squared_norm(z))
    u2 = u * u
    along = dr.dot(m, z)
    value = along * u * u2
    if derivatives == 0:
        return u, SourceTerm(value)
    gradient = (u * u2) * dr.fma(vector(3 * along * u2), z, -m)
    if derivatives == 1:
        return u, SourceTerm(value, gradient)
    # In terms of the unit vector n = u z, so that no power of u overflows unless the result does.
    n, four = u * z, 3 * (u2 * u2)
    along = dr.dot(m, n)
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    hessian = (
        four * (5 * along * n[i] * n[j] - m[i] * n[j] - n[i] * m[j] - (along if i == j else 0))
        for i, j in pairs
    )
    return u, SourceTerm(value, gradient, SymmetricMatrix(*hessian))


_VALUES, _TRACED = 2.0, 4.0
# The least smoothing length, as a part of half the size of the cloud; the most points at which its
# level is looked for; the least level that is one, as a part of 2 pi if areas are estimated.
_LEAST_SMOOTHING, _MAX_LEVEL_SAMPLES = 1e-5, 10_000
_LEAST_PART, _LEAST_LEVEL = 0.1, 1e-3
# A tenth of the points may be off a smoothed surface by this part of the cloud's longest side.
_FAR_OF_SIZE = 0.04


class DipolePotential(OrientedPoints, FieldWithCells, VariableAccuracyField["_DipoleData"]):
    """f(x) = sum a_i n_i.(p_i - x)/|p_i - x|^3 of oriented points (paper, Eq. 12).

    With a_i the areas that the points stand for, f is about 4 pi inside and 0 outside: the
    surface is f = 2 pi. It passes through every point, with the point's normal.

    smoothing: a length h, for points with noise. Then

        f(x) = sum a_i n_i.(p_i - x) (rho_i^2 + 5 h^2/2)/(rho_i^2 + h^2)^(5/2),  rho_i = |p_i - x|,

    is the sum above blurred: averaged about x with the weight 15 h^4/(8 pi (rho^2 + h^2)^(7/2)),
    whose standard deviation along each axis is h/sqrt(2). It is finite everywhere, and its surface
    passes through no point, but on both sides of them: `default_level` is the median of f at the
    points. Details smaller than h are lost, edges become round, parts thinner than h may
    vanish. h = 1.4 sqrt(noise * spacing) was good on two meshes, with the standard
    deviation of the noise along an axis and the distance between neighboring points.

    smoothing="auto": for points with noise that is not known. The sum is then not that of the
    points given: those far from all others are left out, with a warning; the others are moved along
    their normals to where their neighbors say that the surface is (`geometry.denoising`), a part of
    them if noise is larger than the spacing; and their sum is smoothed over their spacing, or less.
    Normals that are estimated are corrected by the sum and by the moved points. `points`,
    `normals`, `areas` and `smoothing` are those of the sum, and `describe` has the noise that was
    found, and how many points were given and left out.

    points: (n, 3).
    normals: (n, 3), outward, of any length; or "estimate", from neighbors, oriented along a
        spanning tree (`geometry.estimate_normals`).
    areas: (n,), or None to estimate them from neighbors (Barill et al. 2018, Sec. 3.1).
    smoothing: see above, in the points' unit; 0 for the sum of dipoles itself.
    accuracy: a cluster of points is taken as a whole beyond `accuracy` times its radius; by
        default 2 for values at points and 4 for tracing, which takes more where the tolerance asks
        for it. At least 1.5. By default gradients at points are looked at more closely, until their
        error is about 1 % of their length or less in most places (`gradient_error_bound` bounds
        it).
    cells: for many rays through many points: cells in which the near points count one by one and
        all others as one polynomial, so that an evaluation for tracing costs a tenth. None builds
        them where they pay (`for_ray_count`), for pictures of small clouds and for path tracing;
        True always, also for values and gradients at points, which pays from some 600 values a
        point on; False never. They take some 1 kB a point, or the megabytes that are given (True:
        256) with larger and slower cells; where these would be too large, none are built, and
        `describe` of a prepared field says so. Building takes as long as tracing 100,000 to a
        million rays without cells, for each precision, at the first trace, and several times the
        memory. All bounds are proved, whatever is given.

    `with_points` gives the field of points that have moved.

    Raises CloudError (a ValueError) for what is no oriented point cloud; ValueError for a
    smoothing or an accuracy that cannot be.
    """

    period: ClassVar[float | None] = None
    default_level: float = 2 * math.pi

    def __init__(
        self,
        points: Any,
        normals: Any | Literal["estimate"] = None,
        areas: Any = None,
        *,
        smoothing: float | Literal["auto"] = 0.0,
        accuracy: float | None = None,
        cells: bool | float | None = None,
    ) -> None:
        super().__init__()
        if normals is None:
            raise CloudError(
                "normals are missing, and without them inside and outside are not known: give "
                'them, or normals="estimate" to estimate them from neighboring points'
            )
        if accuracy is not None and not 1.5 <= as_real(accuracy, "accuracy") <= 100:
            raise ValueError(f"accuracy must lie between 1.5 and 100, not {accuracy}")
        self.is_estimated = [isinstance(normals, str), areas is None]
        if isinstance(normals, str) and normals != "estimate":
            raise CloudError(f'normals must be (n, 3) or "estimate", not {normals!r}')
        self.fit_report: dict[str, Any] = {}
        if isinstance(smoothing, str):
            points, normals, smoothing = self._fitted(points, normals, areas, smoothing)
        if isinstance(normals, str):
            normals = estimate_normals(points)
        some = 1.0 if areas is None else areas
        points, normals, some = validate_cloud(points, normals, some)
        self._set_points(
            points, normals, estimate_areas(points, normals) if areas is None else some
        )
        self.accuracy = accuracy
        self.configure_cells(cells)
        self._box = low, high = self.points.min(axis=0), self.points.max(axis=0)
        self._center = round_to_single(0.5 * (low + high))
        extent = max(0.5 * float((high - low).max()), math.sqrt(float(self.areas.sum())) / 4)
        self._size = 2.0 ** math.ceil(math.log2(extent))
        self._given_hierarchy: BalancedTree | None = None
        self._smoothing = (
            0.0 if as_real(smoothing, "smoothing") == 0 else as_positive(smoothing, "smoothing")
        )
        if self.smoothing and self.cells:
            raise ValueError("cells are of sums without smoothing: give one of the two")
        if self.smoothing:
            self.default_level = self._median_level()

    def _fitted(
        self, points: Any, normals: Any, areas: Any, smoothing: str
    ) -> tuple[FloatArray, FloatArray, float]:
        """Points, normals and the length of `smoothing="auto"`; `fit_report` says what was
        found."""
        if smoothing != "auto":
            raise ValueError(f'smoothing must be a length or "auto", not {smoothing!r}')
        if areas is not None:
            raise CloudError(
                'with smoothing="auto" points are moved, and their areas are estimated: leave out '
                "the areas, or give a length"
            )

        def gradients(x: FloatArray, n: FloatArray, areas: FloatArray, length: float) -> FloatArray:
            field = DipolePotential(x, n, areas, smoothing=length)
            return np.asarray(field.rough_value_and_gradient(x)[1], np.float64)

        given = None if isinstance(normals, str) else normals
        found = DenoisedCloud.of(points, given, gradients)
        self.fit_report = found.report
        return found.points, found.normals, found.smoothing

    def _median_level(self) -> float:
        """The median of the smoothed sum at (some of) the points."""
        if not _LEAST_SMOOTHING <= self.smoothing / self._size <= 1:
            raise ValueError(
                f"smoothing={self.smoothing:g} is a length in the unit of the points, whose cloud "
                f"is about {2 * self._size:.2g} across: give one between "
                f"{_LEAST_SMOOTHING * self._size:.2g} and {self._size:.2g}, such as the length of "
                "the noise"
            )
        some = self.points[:: -(-len(self.points) // _MAX_LEVEL_SAMPLES)]
        values = np.asarray(self.value(some, precision="double"))
        level = float(np.median(values))
        # Areas that are given may stand for other things than a surface.
        least = _LEAST_PART * 2 * math.pi if self.is_estimated[1] else _LEAST_LEVEL
        if not abs(level) >= least:
            raise CloudError(
                f"the smoothed sum is {level:.2g} at the points, where it should be about 2 pi: "
                "normals cancel each other, or the points lie in a plane or on a line and enclose "
                "nothing, or what they enclose is thinner than the smoothing"
            )
        if not self.fit_report and self.is_estimated[1]:
            self._warn_if_far(some, values - level)
        return level

    def _warn_if_far(self, points: FloatArray, values: FloatArray) -> None:
        """Warn if the smoothed surface leaves a tenth of the points, with values above the level,
        far away, by their slopes."""
        slopes = self.rough_value_and_gradient(points, precision="double")[1]
        steep = np.linalg.norm(slopes, axis=1)
        far = float(np.quantile(np.abs(values) / np.maximum(steep, 1e-300), 0.9))
        longest = float((self._box[1] - self._box[0]).max())
        if far > _FAR_OF_SIZE * longest:
            warnings.warn(
                f"smoothing={self.smoothing:g} may be too long: a tenth of the points are farther "
                f"than {far:.2g} from the smoothed surface, and the cloud is {longest:.3g} long. "
                'Noise wants 1.4 sqrt(noise * spacing), or smoothing="auto"',
                stacklevel=4,
            )

    @no_derivatives
    def with_points(
        self, points: Any, normals: Any | Literal["estimate"] = None, areas: Any = None
    ) -> DipolePotential:
        """The potential of the same points at other positions (n, 3); normals and areas as for a
        new one.

        The tree, if there is one, keeps its shape and gets new centers, radii, moments and bounds.
        All promises are computed from the new positions, so a tree whose points moved far is slower
        than a new one, never wrong. Raises CloudError as for a new field.
        """
        field = DipolePotential(
            points,
            normals,
            areas,
            smoothing=self.smoothing,
            accuracy=self.accuracy,
            cells=self.cells,
        )
        if len(field.points) != len(self.points):
            raise CloudError(
                f"points: {len(field.points)} of them, where {len(self.points)} were before: "
                "moving points keeps their number and their order"
            )
        field._given_hierarchy = vars(self).get("_hierarchy", self._given_hierarchy)
        return field

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        on = self._batch_data(backend_of(x))
        x = on.to_unit(x)
        weight = float(self.areas.sum()) / self._size**2
        return (
            on.tree.values(x, derivatives, closer)
            .with_far_field_errors(x, 64, weight)
            .rescaled(on.size)
        )

    def sharp_values_at(self, x: Vec3) -> PointValues:
        if self.accuracy is not None:
            return self.values_at(x, 1)
        return sharpened(lambda place, closer: self.values_at(place, 1, closer), x)

    @functools.cached_property
    def _hierarchy(self) -> BalancedTree:
        """The tree's shape, from these points or, of moved ones, from where they were."""
        return self._given_hierarchy or dipole_hierarchy((self.points - self._center) / self._size)

    def _upload(self, backend: Backend, *, traced: bool) -> _DipoleData:
        accuracy = self.accuracy or (_TRACED if traced else _VALUES)
        unit = (self.points - self._center) / self._size
        # Areas scale with the square of lengths; the potential is invariant under scaling.
        moments = (self.areas / self._size**2)[:, None] * self.normals
        if self.smoothing:
            height, rows = self.smoothing / self._size, dipole_records(unit, moments)
            tree = SmoothedSum.of(backend, self._hierarchy, rows, height, accuracy)
        else:
            build = None
            if self.cells and (traced or self.cells_for_values):
                build = self._cell_builder(backend, self._half_side(unit))
            tree = DipoleTree.of(backend, self._hierarchy, unit, moments, accuracy, build)
        return _DipoleData(*frame_parameters(backend, self._center, self._size), tree)

    def _cell_builder(self, backend: Backend, half: float) -> BuildCells:
        """What makes cells of the cube [-half, half]^3, once for a backend."""

        def build(
            levels: list[NodeMoments], rows: FloatArray, dipoles: RecordTable
        ) -> DipoleCells | None:
            return self.build_cached(
                backend,
                lambda: build_cells(
                    backend, self._hierarchy, levels, rows, dipoles, half, self.max_bytes(),
                    finer=self.finer_cells,
                ),
            )  # fmt: skip

        return build

    def _half_side(self, unit: FloatArray) -> float:
        """Half the side of the cube of cells, which holds the `extent` of the default level: rays
        begin at the faces of that."""
        reach = math.sqrt(float(self.areas.sum()) / self.default_level) / self._size
        return 1.001 * (float(np.abs(unit).max()) + reach)

    def cells_pay_from(self) -> float:
        few = len(self.points) <= _MOST_POINTS and not self.smoothing
        return max(_LEAST_RAYS, _PAYS * len(self.points)) if few else math.inf

    def finer_cells_pay_from(self) -> float:
        return _FINER_PAYS * len(self.points)

    def prepare(self, backend: Backend) -> Self:
        prepared = super().prepare(backend)
        if prepared._device is not None:
            prepared.coarsest_accuracy = prepared._device.tree.coarsest_accuracy
        return prepared

    def _sample(self, on: _DipoleData, p: Vec3, detail: Real) -> Sample:
        return on.sample(p, detail)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        for level in levels:
            if abs(level) < 1e-6:
                raise ValueError(
                    "level 0 of a dipole potential reaches to infinity; the surface is at 2 pi"
                )

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A box around the points: at distance rho from all of them |f| <= (sum of areas)/rho^2,
        smoothed or not, as 1 + 5 q/2 <= (1 + q)^(5/2)."""
        reach = 1.0001 * math.sqrt(float(self.areas.sum()) / min(abs(level) for level in levels))
        low, high = self._box
        return Box(low - reach, high + reach)

    @property
    def singular_points(self) -> FloatArray:
        return np.zeros((0, 3)) if self.smoothing else self.points[self.areas > 0]

    @property
    def smoothing(self) -> float:
        """How far the surface is smoothed. It stays as it is: the default level depends on it."""
        return self._smoothing

    def describe(self) -> dict[str, Any]:
        said = ("estimated" if one else "given" for one in self.is_estimated)
        named = dict(zip(("normals", "areas"), said, strict=True))
        tree = None if self._device is None else self._device.tree
        cells = self.describe_cells(tree.cells if isinstance(tree, DipoleTree) else None)
        about = {"points": len(self.points), **named, **self.fit_report, **cells}
        if self.smoothing:
            about |= {"smoothing": self.smoothing, "level": self.default_level}
        return about


@dataclass(frozen=True)
class _DipoleData(UnitFrame):
    """The data of a potential on a backend."""

    tree: DipoleTree | SmoothedSum

    def sample(self, p: Vec3, detail: Real) -> Sample:
        return space_scaled(self.tree.sample(self.to_unit(p), detail), self.size)
