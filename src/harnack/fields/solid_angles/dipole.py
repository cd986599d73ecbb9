"""The dipole potential f of an oriented point cloud, whose level set f = 2 pi is a surface through
the points: Poisson reconstruction without a grid. Each point is a dipole: its moment is its area
times its normal, and f is the sum over all dipoles. The sum is computed by a tree, or by FMM cells
(octree cells with a list of near dipoles and a polynomial for all far ones). A sample is f and its
gradient at a point, with error bounds and proved bounds of f near the point. The accuracy scale is
a number by which samples are made more accurate; larger is more accurate.

- `DipolePotential`: the field.
- `DipoleTree`: its sum by a tree, with multipole moments of far dipoles.

The points of a field do not change (attributes such as `points` cannot be set), because trees,
cells and extents are computed from them once. `with_points` makes another field.
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
from harnack.backend.validation import as_positive, as_real, check_no_derivatives
from harnack.fields.attached_arrays import plain_array
from harnack.fields.batched_fields import SourceSum, SumEvaluator, cached_upload
from harnack.fields.capabilities import Boundary
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.field import Sample, space_scaled
from harnack.fields.parameters import record_arguments
from harnack.fields.solid_angles.cell_options import CellChoice, FieldWithCells
from harnack.fields.solid_angles.denoised_cloud import DenoisedCloud
from harnack.fields.solid_angles.oriented_points import OrientedPoints, check_estimates
from harnack.fields.solid_angles.smoothed import SmoothedKernel, SmoothedSum
from harnack.fmm.dipole_cells import DipoleCells, TreeWithCells, build_cells
from harnack.fmm.moving_dipoles import MovingDipoles
from harnack.fmm.multipole import dipole_tree_moments
from harnack.fmm.point_values import PointValues, SymmetricMatrix, sharpened
from harnack.fmm.source_sums import SourceSums, SourceTerm, dipole_rounding, final_rounding
from harnack.fmm.treecode import (
    AddPrimitive,
    Treecode,
    dipole_hierarchy,
    dipole_records,
    records_in_slots,
)
from harnack.fmm.unit_frame import UnitFrame, center_and_size, coordinate_rounding, frame_parameters
from harnack.geometry import Box, CloudError, estimate_areas, estimate_normals, validate_cloud

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3
    from harnack.backend.record_table import RecordTable
    from harnack.fmm.multipole import NodeMoments
    from harnack.geometry import Volume
    from harnack.tree import BalancedTree

# Cells save time if there are at least `_PAYS` rays per point and at least `_LEAST_RAYS` rays, and
# at most `_MAX_POINTS` points: to build them takes as long as to trace about 6 rays per point
# without them. Smaller cells, in which a ray takes two thirds of the time, save time if there are
# at least `_FINER_PAYS_PER_POINT` rays per point.
_PAYS, _LEAST_RAYS, _MAX_POINTS = 7, 100_000, 200_000
_FINER_PAYS_PER_POINT = 60
# The dipole of a point dominates the field where the squared distance from it is less than this
# fraction of the point's area.
_NEAR_SQUARE_PER_AREA = 0.04


BuildCells: TypeAlias = "Callable[[list[NodeMoments], FloatArray, RecordTable], DipoleCells | None]"
"""A function that builds cells, or returns None. Arguments: the moments of all levels of a tree,
its dipoles as records, and the same records on the backend."""


class DipoleTree(TreeWithCells):
    """The sum f(x) of m_i.(y_i - x)/|y_i - x|^3 over all dipoles i, on a backend. The positions y_i
    and the moments m_i, which are area times normal, are in unit coordinates: the cloud is centered
    at 0 and its size is about one. Far dipoles are summed by the tree's multipole moments or by the
    cells, near dipoles one by one. A record of a dipole holds y_i, m_i and |m_i|.
    """

    @classmethod
    def of(
        cls, backend: Backend, tree: BalancedTree, points: FloatArray, moments: FloatArray,
        accuracy: float, build: BuildCells | None = None,
    ) -> DipoleTree:  # fmt: skip
        """Build the sum over dipoles, with its tree, and with cells if they are requested.

        tree: the hierarchy of the tree: which points are in which node. It is the result of
            `dipole_hierarchy` for these points, or for the same points at earlier positions.
        points: (n, 3) the positions of the dipoles, in unit coordinates.
        moments: (n, 3) their moments, which are area times normal.
        accuracy: the multipole moments of a node are used at points that are farther from its
            center than this many times its radius.
        build: a function that builds cells from the moments of the tree's nodes and the records of
            the dipoles (in NumPy, and on the backend); None for no cells.
        """
        # Each primitive is a single dipole, and its box is the dipole's position.
        levels = dipole_tree_moments(tree, points[:, None], moments[:, None], points, points)
        rows = dipole_records(points, moments)
        # Column 6 is |m_i|; the rounding is proportional to the size of the sum.
        rounding = final_rounding(backend, size=max(1.0, float(rows[:, 6].sum())))
        slots = records_in_slots(tree, rows)
        clusters = Treecode.of(backend, tree, levels, slots, accuracy)
        cells = None if build is None else build(levels, slots, clusters.tree.primitives)
        return cls(clusters, rounding, cells)

    def values(self, x: Vec3, derivatives: int, closer: Real) -> PointValues:
        """Compute f at points x, with derivatives and with error bounds, in unit coordinates.

        x: (3, n).
        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        closer: the accuracy scale (`VariableAccuracy`); larger is more accurate. A number below 1
            counts as 1.
        """
        unit, detail = (
            coordinate_rounding(x),
            fmax(self.backend.Float(closer), self.backend.Float(1)),
        )
        sums, _ = self._near_sums(x, detail, unit, derivatives)
        return self.clusters.values(sums, 1.0, unit, self.rounding)  # f is 1.0 times the sum

    def _near_sums(
        self, x: Vec3, detail: Real, unit: Real, derivatives: int = 1
    ) -> tuple[SourceSums, Vec3]:
        """Sum over all dipoles at points x.

        x: (3, n).
        detail: the accuracy scale; larger is more accurate.
        unit: a bound of the rounding of a coordinate of x.
        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.

        Returns the sums, and the moment (3, n) of the nearest dipole: among those that are summed
        one by one, and not by a node or a cell.
        """
        # The state is the moment of the nearest dipole so far; cells and tree add dipoles alike.
        add, start = _dipole_adder(x, unit), (self.backend.Array3f(0),)
        sums, state = self.sums(x, detail, lambda _: add, start, derivatives=derivatives)
        return sums, state[0]

    def sample(self, x: Vec3, detail: Real) -> Sample:
        """Compute a sample at points x (3, n): f, its gradient, error bounds, proved bounds of f
        near x, and a normal for shading.

        detail: the accuracy scale; larger is more accurate. If there are cells, scales up to 1 get
            the accuracy of the cells' polynomials, and for larger scales the tree is used.
        """
        unit = coordinate_rounding(x)
        sums, nearest_moment = self._near_sums(x, detail, unit)
        # Where the field of a single point dominates, shading uses that point's normal. It is
        # reversed, because gradients point inwards: f is larger inside.
        area = dr.norm(nearest_moment)
        # singularity_distance: the distance of the nearest dipole; of far nodes, about that.
        is_dominated = (
            sums.singularity_distance * sums.singularity_distance < _NEAR_SQUARE_PER_AREA * area
        ) & (area > 0)
        normal = dr.select(is_dominated, -nearest_moment / area, dr.normalize(sums.gradient))
        return sums.sample(1.0, unit, self.rounding, normal)


def _dipole_adder(x: Vec3, unit: Real) -> AddPrimitive:
    """Return a function that adds one dipole to sums over dipoles at points x
    (`treecode.AddPrimitive`).

    x: (3, n).
    unit: a bound of the rounding of a coordinate of x.
    """
    vector = cast("Any", type(x))

    def add(
        row: list[Real], active: Mask, sums: SourceSums, state: tuple[Any, ...]
    ) -> tuple[SourceSums, tuple[Any, ...]]:
        """Add one dipole to the sums on active lanes.

        row: the record of the dipole: position, moment, and length of the moment. A record of
            length 0 is padding and adds nothing.
        sums: the sums so far, with the distance of the nearest dipole.
        state: a tuple with the moment of the nearest dipole so far.

        Returns the new sums and the new state.
        """
        inverse, terms = _dipole_term(row, x, sums.derivatives)
        distance, has_area = dr.rcp(inverse), active & (row[6] > 0)
        # `upper` is an upper bound of 1/(distance - 2 unit): one over the true distance is at most
        # this, as 2 unit bounds the rounding of the distance. With z = 2 unit/distance,
        # 1/(1-z) <= 1 + 2z for z <= 1/2. Nearer to a dipole, where z > 1/2, all bounds are
        # infinite. Padding has no area and adds nothing.
        relative_rounding = 2 * unit * inverse
        upper = dr.select(
            relative_rounding <= 0.5, dr.fma(2 * relative_rounding, inverse, inverse), dr.inf
        )
        upper = dr.select(has_area, upper, 0)
        # s4 and s5 bound the sums of |m|/distance^4 and |m|/distance^5, from which bounds of the
        # second and third derivatives follow.
        fourth = row[6] * dr.square(upper * upper)
        is_nearest = has_area & (distance <= sums.singularity_distance)
        # At a dipole itself, where `inverse` is infinite, its term is left out.
        added = sums.add_term(terms, active & (inverse < dr.inf))
        new_sums = dataclasses.replace(
            added,
            rounding=added.rounding + dipole_rounding(row[6], upper, unit),
            singularity_distance=dr.select(is_nearest, distance, sums.singularity_distance),
            s4=sums.s4 + fourth,
            s5=dr.fma(fourth, upper, sums.s5),
        )
        return new_sums, (dr.select(is_nearest, vector(*row[3:6]), state[0]),)

    return add


def _dipole_term(row: list[Real], x: Vec3, derivatives: int) -> tuple[Real, SourceTerm]:
    """Compute the potential f of one dipole at points x (3, n), with its derivatives (paper, Eq. 12
    and 15).

    row: the record of the dipole: its position y, then its moment m.
    derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.

    Returns one over the distance of the dipole from x, and the value with its derivatives.

    With z = y - x and u = 1/|z|: f = m.z u^3, grad f = 3 (m.z) u^5 z - m u^3, and
    Hess f = 15 (m.z) u^7 z z^T - 3 u^5 (m z^T + z m^T + (m.z) I).
    """
    vector = cast("Any", type(x))
    z, m = vector(*row[:3]) - x, vector(*row[3:6])
    u = dr.rsqrt(dr.squared_norm(z))
    u2 = u * u
    product = dr.dot(m, z)
    value = product * u * u2
    if derivatives == 0:
        return u, SourceTerm(value)
    gradient = (u * u2) * dr.fma(vector(3 * product * u2), z, -m)
    if derivatives == 1:
        return u, SourceTerm(value, gradient)
    # In terms of the unit vector n = u z, so that no power of u overflows unless the result does.
    n, scale = u * z, 3 * (u2 * u2)
    product = dr.dot(m, n)
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    hessian = (
        scale * (5 * product * n[i] * n[j] - m[i] * n[j] - n[i] * m[j] - (product if i == j else 0))
        for i, j in pairs
    )
    return u, SourceTerm(value, gradient, SymmetricMatrix(*hessian))


_VALUES_ACCURACY, _TRACING_ACCURACY = 2.0, 4.0
# The smallest smoothing length, as a fraction of half the size of the cloud; and the largest number
# of points from which the level is computed. The smallest valid level is `_MIN_LEVEL_FRACTION`
# times 2 pi if areas are estimated, and `_MIN_LEVEL` otherwise.
_MIN_SMOOTHING, _MAX_LEVEL_SAMPLES = 1e-5, 10_000
_MIN_LEVEL_FRACTION, _MIN_LEVEL = 0.1, 1e-3
# A tenth of the points may be off a smoothed surface by this fraction of the cloud's longest side.
_FAR_OF_SIZE = 0.04


class DipolePotential(OrientedPoints, FieldWithCells, SourceSum):
    """The dipole potential f(x) = sum a_i n_i.(p_i - x)/|p_i - x|^3 of oriented points p_i with
    unit normals n_i (paper, Eq. 12). Each point stands for an area a_i of the surface. f is about 4
    pi inside and 0 outside, and the surface is the level set f = 2 pi. It passes through every
    point, with the point's normal. In unit coordinates the cloud is centered at 0 and its size is
    about one.

    smoothing: a length h, for points with noise. Then

        f(x) = sum a_i n_i.(p_i - x) (rho_i^2 + 5 h^2/2)/(rho_i^2 + h^2)^(5/2),  rho_i = |p_i - x|,

    is the sum above, averaged around x with the weight 15 h^4/(8 pi (rho^2 + h^2)^(7/2)), where rho
    is the distance from x. The standard deviation of this weight along each axis is h/sqrt(2). f is
    finite everywhere. Its surface does not pass through the points, but has points on both sides:
    `default_level` is the median of f at the points. Details smaller than h are lost, edges become
    round, and parts thinner than h may vanish. On two meshes h = 1.4 sqrt(noise * spacing) was
    good, where noise is the standard deviation of the noise along an axis, and spacing the distance
    between neighboring points.

    smoothing="auto": for points with noise of unknown size. f is then the sum over denoised points
    instead of the input points. Points far from all others are left out, with a warning. The
    remaining points are moved along their normals onto the surface that fits their neighbors
    (`geometry.denoising`); if the noise is larger than the spacing, only some of these points are
    used. The smoothing length h is their spacing, or less. Estimated normals are corrected by the
    sum and by the moved points. The attributes `points`, `normals`, `areas` and `smoothing` are
    those of the denoised points. `describe` has the estimated noise, the number of input points,
    and the number of points that were left out.

    Derivatives. Points, normals and areas may be Dr.Jit arrays (3-vectors of n lanes, arrays of n
    entries) or tensors of the same shapes as in NumPy. Hits, values and gradients can then be
    differentiated by them (`fmm.moving_dipoles`); values with derivatives are sums over all points,
    without the truncation of a tree. The default level is held fixed. Normals and areas that would
    be estimated from arrays with derivatives enabled are refused.

    points: (n, 3).
    normals: (n, 3), outward, of any length; or "estimate", from neighbors, oriented along a
        spanning tree (`geometry.estimate_normals`).
    areas: (n,), or None to estimate them from neighbors (Barill et al. 2018, Sec. 3.1).
    smoothing: see above, in the points' unit; 0 for the sum of dipoles itself.
    accuracy: the sum uses the multipole moments of a cluster of points beyond `accuracy` times its
        radius; at least 1.5. By default it is 2 for values at points and 4 for tracing. Tracing
        uses a larger accuracy where the tolerance needs it. By default the accuracy of gradients at
        points is increased until their error is about 1 % of their length or less in most places
        (`gradient_error_bound` bounds it).
    cells: whether to build FMM cells, for many rays through many points. In a cell, near points are
        summed directly and all others are one polynomial, so that an evaluation for tracing costs a
        tenth. None builds cells if they save more time than their construction takes
        (`cells_pay_from`): for pictures of small clouds and for path tracing. True always builds
        them, and uses them also for values and gradients at points, which saves time for more than
        some 600 values per point. False never builds them. A number builds them, too, and limits
        their memory to so many megabytes; the limit is 256 for True. Cells take some 1 kB per
        point. If this exceeds the limit, cells are larger and slower. If these would still be too
        large, there are no cells, and `describe` of an evaluator reports this. Cells are built at
        the first trace, for each precision. This takes as long as tracing 100,000 to a million rays
        without cells, and several times the memory of the cells. All bounds are proved, whatever
        the arguments.

    `with_points` gives the field of points that have moved.

    Raises CloudError (a ValueError) if the arguments are no oriented point cloud; ValueError for an
    invalid smoothing or accuracy; NotImplementedError for derivatives that would be lost.
    """

    period: ClassVar[float | None] = None
    default_level: float = 2 * math.pi
    traits = dataclasses.replace(
        SourceSum.traits, is_larger_inside=True, has_parameter_derivatives=True
    )

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
        name = type(self).__name__
        check_no_derivatives(name, smoothing, accuracy, cells)
        if normals is None:
            raise CloudError(
                "normals are missing, and without them inside and outside are not known: give "
                'them, or normals="estimate" to estimate them from neighboring points'
            )
        if accuracy is not None and not 1.5 <= as_real(accuracy, "accuracy") <= 100:
            raise ValueError(f"accuracy must lie between 1.5 and 100, not {accuracy}")
        self.is_estimated = [isinstance(normals, str), areas is None]  # normals, areas
        check_estimates(
            name,
            {"points": points, "normals": normals},
            has_normals=not isinstance(normals, str),
            has_areas=areas is not None,
        )
        points, normals, areas = map(plain_array, (points, normals, areas))
        if isinstance(normals, str) and normals != "estimate":
            raise CloudError(f'normals must be (n, 3) or "estimate", not {normals!r}')
        self.fit_report: dict[str, Any] = {}
        if isinstance(smoothing, str):  # "auto"
            points, normals, smoothing = self._fitted(points, normals, areas, smoothing)
            # `replace` makes a changed field from the recorded arguments: those of the denoised
            # cloud.
            record_arguments(self, points=points, normals=normals, smoothing=smoothing)
        if isinstance(normals, str):
            normals = estimate_normals(points)
        # 1.0 is only a valid number for the check, if areas are still to be estimated.
        known_areas = 1.0 if areas is None else areas
        points, normals, known_areas = validate_cloud(points, normals, known_areas)
        self._set_points(
            points, normals, estimate_areas(points, normals) if areas is None else known_areas
        )
        self.accuracy = accuracy
        self.configure_cells(cells)
        self._box = low, high = self.points.min(axis=0), self.points.max(axis=0)
        # The size is no smaller than a quarter of the root of the total area: some clouds have
        # areas that are large for their box.
        least_size = math.sqrt(float(self.areas.sum())) / 4
        self._center, self._size = center_and_size(low, high, least_size)
        # The hierarchy of the tree of the field from which `with_points` made this one.
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
        """Denoise the cloud for `smoothing="auto"`, and set `fit_report` to the report about the
        noise.

        points, normals, areas, smoothing: the arguments of the constructor.

        Returns the kept points (m, 3) moved onto the surface, their normals (m, 3), and the
        smoothing length.

        Raises:
            ValueError: `smoothing` is another string than "auto".
            CloudError: areas are given; or the cloud is not valid.
        """
        if smoothing != "auto":
            raise ValueError(f'smoothing must be a length or "auto", not {smoothing!r}')
        if areas is not None:
            raise CloudError(
                'with smoothing="auto" points are moved, and their areas are estimated: leave out '
                "the areas, or give a length"
            )

        def gradients(x: FloatArray, n: FloatArray, areas: FloatArray, length: float) -> FloatArray:
            """Compute the gradients (k, 3) of a smoothed dipole potential at the dipoles
            themselves.

            x, n, areas: the points (k, 3) of the dipoles, their normals (k, 3) and areas (k,).
            length: the smoothing length.
            """
            field = DipolePotential(x, n, areas, smoothing=length)
            return np.asarray(field.rough_value_and_gradient(x)[1], np.float64)

        known_normals = None if isinstance(normals, str) else normals  # else "estimate"
        cloud = DenoisedCloud.of(points, known_normals, gradients)
        self.fit_report = cloud.report
        return cloud.points, cloud.normals, cloud.smoothing

    def _median_level(self) -> float:
        """Compute the default level of a smoothed sum: the median of f at the points, or at some of
        the points if there are many. Warns if the smoothing seems to be too long.

        Raises:
            ValueError: the smoothing length is too small or too large for the cloud.
            CloudError: the median is not far enough from 0.
        """
        if not _MIN_SMOOTHING <= self.smoothing / self._size <= 1:
            raise ValueError(
                f"smoothing={self.smoothing:g} is a length in the unit of the points, whose cloud "
                f"is about {2 * self._size:.2g} across: give one between "
                f"{_MIN_SMOOTHING * self._size:.2g} and {self._size:.2g}, such as the length of "
                "the noise"
            )
        # Every k-th point, with the smallest k that gives no more than `_MAX_LEVEL_SAMPLES`.
        samples = self.points[:: -(-len(self.points) // _MAX_LEVEL_SAMPLES)]
        values = np.asarray(self.value(samples, precision="double"))
        level = float(np.median(values))
        # Areas from the user may stand for other things than a surface.
        # is_estimated[1]: whether the areas are estimated.
        min_level = _MIN_LEVEL_FRACTION * 2 * math.pi if self.is_estimated[1] else _MIN_LEVEL
        if not abs(level) >= min_level:
            raise CloudError(
                f"the smoothed sum is {level:.2g} at the points, where it should be about 2 pi: "
                "normals cancel each other, or the points lie in a plane or on a line and enclose "
                "nothing, or what they enclose is thinner than the smoothing"
            )
        if not self.fit_report and self.is_estimated[1]:
            self._warn_if_far(samples, values - level)
        return level

    def _warn_if_far(self, points: FloatArray, values: FloatArray) -> None:
        """Warn if a tenth of the points are farther from the smoothed surface than `_FAR_OF_SIZE`
        times the longest side of the cloud. The distance of a point is estimated as |f - level|
        over the length of the gradient.

        points: (n, 3).
        values: (n,) f minus the level, at the points.
        """
        gradients = self.rough_value_and_gradient(points, precision="double")[1]
        # The distance that nine tenths of the points do not exceed; 1e-300 prevents a division by
        # 0.
        norms = np.linalg.norm(gradients, axis=1)
        far = float(np.quantile(np.abs(values) / np.maximum(norms, 1e-300), 0.9))
        longest = float((self._box[1] - self._box[0]).max())
        if far > _FAR_OF_SIZE * longest:
            # stacklevel=4: the warning names the line that makes the field.
            warnings.warn(
                f"smoothing={self.smoothing:g} may be too long: a tenth of the points are farther "
                f"than {far:.2g} from the smoothed surface, and the cloud is {longest:.3g} long. "
                'Noise wants 1.4 sqrt(noise * spacing), or smoothing="auto"',
                stacklevel=4,
            )

    def with_points(
        self, points: Any, normals: Any | Literal["estimate"] = None, areas: Any = None
    ) -> DipolePotential:
        """Make the field of the same points at other positions.

        points: (n, 3) the new positions, in the same order.
        normals, areas: as for a new field.

        If this field has a tree, the new field's tree has the same hierarchy: the same points are
        in the same nodes. Centers, radii, moments and all bounds are computed from the new
        positions. So a tree whose points moved far is slower than a new tree, but never wrong.

        Raises:
            CloudError: the arguments are no oriented point cloud, or the number of points differs.
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
        # `_hierarchy` is in the dictionary if this field has computed it (`cached_property`).
        field._given_hierarchy = vars(self).get("_hierarchy", self._given_hierarchy)
        return field

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        """Compute f and its derivatives at points x (3, n), in the user's unit, with error bounds
        (`BatchedField.values_at`).

        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        closer: the accuracy scale; larger is more accurate. A number below 1 counts as 1.
        """
        data = self._upload(backend_of(x), traced=False, cells=self.cell_choice())
        x = data.to_unit(x)
        # The sum of the areas, in unit coordinates.
        weight = float(self.areas.sum()) / self._size**2
        # 64 terms: far away, where this matters, a point sums only a few nodes of the tree.
        return (
            data.tree.values(x, derivatives, closer)
            .with_far_field_errors(x, 64, weight)
            .rescaled(data.size)
        )

    def moving_sum(self, backend: Backend) -> MovingDipoles | None:
        """f as a sum over all dipoles, with derivatives by the points, normals and areas
        (`BatchedField.moving_sum`)."""
        frame = UnitFrame(*frame_parameters(backend, self._center, self._size))
        # With the smoothing length 0, psi_1 is 1/D^3, as for the plain sum.
        kernel = SmoothedKernel(backend, self.smoothing / self._size)
        return self._moving_dipoles(frame, kernel, 1.0)

    def sharp_values_at(self, x: Vec3) -> PointValues:
        """Compute f and its gradient at points x (3, n), with error bounds. Unless the user chose
        the accuracy, it is increased until the error of the gradient is about 1 % of the gradient's
        length."""
        if self.accuracy is not None:
            return self.values_at(x, 1)
        return sharpened(lambda points, factor: self.values_at(points, 1, factor), x)

    @functools.cached_property
    def _hierarchy(self) -> BalancedTree:
        """The hierarchy of the tree over the points: which points are in which node. It is computed
        from the points. But if this field was made by `with_points` from a field that has a
        hierarchy, it is that hierarchy, which stays valid for moved points."""
        return self._given_hierarchy or dipole_hierarchy((self.points - self._center) / self._size)

    def _ray_data(self, backend: Backend, plan: Plan) -> _DipoleData:
        return self._upload(backend, traced=True, cells=self.cell_choice(plan.ray_count))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> DipoleEvaluator:
        return DipoleEvaluator(self, self._ray_data(backend, plan))

    @cached_upload
    def _upload(self, backend: Backend, *, traced: bool, cells: CellChoice) -> _DipoleData:
        """Build the sum over the dipoles on a backend: smoothed, or with cells if they are wanted.

        traced: whether the sum is for tracing, and not for values at points. By default a sum for
            tracing is more accurate.
        cells: the FMM cells of the sum.
        """
        accuracy = self.accuracy or (_TRACING_ACCURACY if traced else _VALUES_ACCURACY)
        unit_points = (self.points - self._center) / self._size
        # Areas scale with the square of lengths; the potential is invariant under scaling.
        moments = (self.areas / self._size**2)[:, None] * self.normals
        if self.smoothing:
            # height: the smoothing length in unit coordinates.
            height, rows = self.smoothing / self._size, dipole_records(unit_points, moments)
            tree = SmoothedSum.of(backend, self._hierarchy, rows, height, accuracy)
        else:
            build = None
            if cells:
                build = self._cell_builder(backend, self._half_side(unit_points), cells)
            tree = DipoleTree.of(backend, self._hierarchy, unit_points, moments, accuracy, build)
        return _DipoleData(*frame_parameters(backend, self._center, self._size), tree, cells)

    def _cell_builder(self, backend: Backend, half: float, choice: CellChoice) -> BuildCells:
        """Return a function that builds the FMM cells of the cube [-half, half]^3, in unit
        coordinates, on a backend (`BuildCells`). Its first call builds the cells; later calls for
        the same choice of cells return the same cells."""

        def build(
            levels: list[NodeMoments], rows: FloatArray, dipoles: RecordTable
        ) -> DipoleCells | None:
            """Return the cells of the cube [-half, half]^3 that were built before, or build them.
            Returns None if they would take too much memory.

            levels: the multipole moments of the tree's nodes, one entry for each level of the tree.
            rows: the records of the dipoles, in the slots of the tree's leaves.
            dipoles: the same records on the backend.
            """
            return self.built_cells(
                backend,
                choice,
                lambda: build_cells(
                    backend, self._hierarchy, levels, rows, dipoles, half, choice.max_bytes,
                    finer=choice.finer,
                ),
            )  # fmt: skip

        return build

    def _half_side(self, unit: FloatArray) -> float:
        """Compute half the side, in unit coordinates, of the cube that the cells fill. This cube
        contains the `extent` of the default level, because rays begin at the faces of the extent.

        unit: (n, 3) the points in unit coordinates.
        """
        # As in `extent`, and larger by 0.1 % for rounding.
        margin = math.sqrt(float(self.areas.sum()) / self.default_level) / self._size
        return 1.001 * (float(np.abs(unit).max()) + margin)

    def cells_pay_from(self) -> float:
        """The smallest number of rays for which cells save more time than it takes to build them;
        infinite for large clouds and for smoothed sums, which never get cells by default."""
        is_small = len(self.points) <= _MAX_POINTS and not self.smoothing
        return max(_LEAST_RAYS, _PAYS * len(self.points)) if is_small else math.inf

    def finer_cells_pay_from(self) -> float:
        """The smallest number of rays for which smaller cells save more time than their longer
        construction costs."""
        return _FINER_PAYS_PER_POINT * len(self.points)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level whose surface would be unbounded."""
        for level in levels:
            if abs(level) < 1e-6:
                raise ValueError(
                    "level 0 of a dipole potential reaches to infinity; the surface is at 2 pi"
                )

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """Compute a box around the points that contains the level sets of f at these levels. The
        result is never None.

        Proof. At a distance of at least rho from all points |f| <= (sum of areas)/rho^2. This holds
        for the smoothed sum as well: with q = h^2/rho^2 each of its terms is the plain one times
        (1 + 5 q/2)/(1 + q)^(5/2), which is at most 1 by Bernoulli's inequality.
        """
        # The least rho of the proof, a little larger for rounding.
        margin = 1.0001 * math.sqrt(float(self.areas.sum()) / min(abs(level) for level in levels))
        low, high = self._box
        return Box(low - margin, high + margin)

    @property
    def boundary(self) -> Boundary | None:
        """The points at which f is singular, to which all level sets come near: those whose area is
        positive. None if the sum is smoothed."""
        return None if self.smoothing else Boundary(points=self.points[self.areas > 0])

    @property
    def smoothing(self) -> float:
        """The smoothing length h, in the points' unit; 0 for the plain sum. It cannot be set, as
        the default level depends on it."""
        return self._smoothing

    def describe(self) -> dict[str, Any]:
        """Collect facts about the field for users: the number of points; whether normals and areas
        were given or estimated; the report of the denoising; the cells; smoothing and level."""
        origins = ("estimated" if is_estimated else "given" for is_estimated in self.is_estimated)
        sources = dict(zip(("normals", "areas"), origins, strict=True))
        cells = self.describe_cell_option()
        report = {"points": len(self.points), **sources, **self.fit_report, **cells}
        if self.smoothing:
            report |= {"smoothing": self.smoothing, "level": self.default_level}
        return report


class DipoleEvaluator(SumEvaluator):
    """The evaluator of a dipole potential."""

    field: DipolePotential
    data: _DipoleData

    def describe(self) -> dict[str, Any]:
        """The facts of `DipolePotential.describe`, with the number and the memory of the FMM cells
        that were built."""
        tree = self.data.tree
        built = tree.cells if isinstance(tree, DipoleTree) else None
        return self.field.describe() | self.data.cell_choice.describe(built)


@dataclass(frozen=True)
class _DipoleData(UnitFrame):
    """The data of a dipole potential on a backend, with the map from the user's coordinates to unit
    coordinates, in which the points are centered at 0 and have a size of about one.

    tree: the sum over the dipoles in unit coordinates, plain or smoothed.
    cell_choice: the FMM cells that the sum was to have.
    """

    tree: DipoleTree | SmoothedSum
    cell_choice: CellChoice

    @property
    def coarsest_accuracy(self) -> float:
        """The accuracy scale of the coarsest samples."""
        return self.tree.coarsest_accuracy

    def sample(self, p: Vec3, detail: Real) -> Sample:
        """Compute a sample at points p (3, n): f, its gradient, error bounds, and proved bounds of
        f near p, all in the user's unit.

        detail: the accuracy scale; larger is more accurate.
        """
        return space_scaled(self.tree.sample(self.to_unit(p), detail), self.size)
