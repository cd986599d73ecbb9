"""Blobs: metaballs, soft objects and densities of molecules, as level sets of sums of bumps. A blob
is a bump around a center that is 0 outside of a ball, its support; its shape is called the kernel.
f is the sum of all blobs or, if the blobs are divided into groups, the largest of the groups' sums.
For many blobs there is a uniform grid, which lists the blobs near each of its cells. Jets are
intervals that contain the values and the derivatives of a function.

`Blobs` is the field of any blobs. `Molecule` is the field of a molecule's atoms, with their van der
Waals radii.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr
import numpy as np

from harnack.arithmetic.jet import Dual
from harnack.backend import FloatArray, IntArray, backend_of
from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import fmin
from harnack.backend.record_table import RecordTable
from harnack.backend.validation import (
    as_real_array,
    check_coordinate_size,
    check_finite,
    check_vectors,
    format_vector,
)
from harnack.enclosures import Enclosure, LevelGaps, Lipschitz, SlopeRange
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.attached_arrays import (
    ExpressionFormula,
    attached_array,
    host_array,
    separate_variable,
    with_formula,
)
from harnack.fields.batched_fields import cached_upload
from harnack.fields.blobs.blob_sums import (
    PIECES,
    PIECES_IN_CELL,
    ForEach,
    KnotRecorder,
    SumValue,
    backend_number,
    blob_term,
    for_each_listed,
    for_each_record,
    hessian_at,
    sum_along,
    sum_jets,
    value_at,
)
from harnack.fields.blobs.grid import BlobGrid, CellLists
from harnack.fields.blobs.group_maximum import (
    GroupedList,
    GroupMaximumEnclosure,
    for_each_of_group,
    group_maximum_at,
    group_maximum_jet,
    largest_group_at,
)
from harnack.fields.blobs.kernels import BlobKernel, GaussianKernel, choose_kernel
from harnack.fields.evaluator import POINTS, EvaluateOnly, Plan
from harnack.fields.formula import Formula
from harnack.fields.formula_evaluator import FormulaEvaluator, is_jet
from harnack.fields.parameters import kept_arguments, record_arguments
from harnack.files.molecules import Atoms, read_molecule
from harnack.geometry import Box

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.formula_evaluator import FormulaFunction
    from harnack.geometry import Volume

# From this number of blobs on, a grid is faster than a sum over all blobs, by experiment.
_MIN_BLOBS_FOR_GRID = 64


class BlobError(ValueError):
    """Raised for arguments that are not valid blobs. The message states which blob, and why."""


class Blobs(Formula):
    """Metaballs: f(x) = sum over i of w_i A k(|x - c_i|^2 / (s R_i)^2). Blob i has the center c_i,
    the radius R_i and the weight w_i. The kernel k falls from the center to 0 at the distance s
    R_i, the radius of the blob's support. A is chosen so that a single blob of weight 1 has the
    value 1 at its radius. The surface is f = 1, and f is larger inside. Where blobs meet, they flow
    together.

    s is `BlobKernel.support`, and A is `BlobKernel.amplitude`.

    centers: (n, 3).
    radii: (n,) or one number, > 0.
    weights: (n,), or None for 1; negative weights carve.
    kernel: "compact" (a polynomial of the sixth degree), "gaussian", or the soft objects "cubic"
        and "sextic"; or a kernel with other parameters, such as `GaussianKernel(sharpness=2.0)`.
    groups: (n,) integers, the group of each blob. f is then the largest of the groups' sums, so
        that groups meet in creases. None for a single sum.

    Large numbers of blobs are kept in a uniform grid, whose cells list the blobs nearby, so that a
    sample reads only these.

    Values, gradients and hits can be differentiated by centers, radii and weights that are Dr.Jit
    arrays, vectors, tensors or lists of Dr.Jit numbers. With groups, a derivative is that of the
    largest sum.

    Raises:
        BlobError: numbers that are not valid blobs (a ValueError).
    """

    traits = dataclasses.replace(
        Formula.traits,
        is_cheap=False,
        is_larger_inside=True,
        differentiable_arguments=("centers", "radii", "weights"),
    )
    default_level: float = 1.0
    period: ClassVar[float | None] = None

    def __init__(
        self,
        centers: Any,
        radii: Any,
        weights: Any = None,
        *,
        kernel: str | BlobKernel = "compact",
        groups: Any = None,
    ) -> None:
        """Check the arguments, which the class describes (centers, radii, weights, kernel, groups).
        The blobs are sorted by groups."""
        self.centers, self.radii, self.weights, self.groups, self._order = _checked(
            centers, radii, weights, groups
        )
        self.kernel = choose_kernel(kernel)

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def _supports(self) -> FloatArray:
        """The radii (n,) of the balls outside of which the blobs are 0."""
        return self.radii * self.kernel.support

    @functools.cached_property
    def cell_lists(self) -> CellLists | None:
        """The uniform grid with a list of the blobs near each cell; None for fewer than 64 blobs,
        for which a sum over all is faster."""
        return (
            CellLists.of(self.centers, self._supports) if len(self) >= _MIN_BLOBS_FOR_GRID else None
        )

    @cached_upload
    def _upload(self, backend: Backend) -> _DeviceBlobs:
        """The blobs on a backend. Code that Dr.Jit compiles for them serves other blobs as well,
        because all numbers are data and none are literals."""
        return _DeviceBlobs.upload(backend, self)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> FormulaEvaluator:
        del plan
        blobs = self._upload(backend)
        return _BlobsEvaluator(self, blobs, blobs.lipschitz, blobs)

    def formula_on(self, backend: Backend) -> FormulaFunction:
        return self._upload(backend)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at jets of the coordinates (intervals that contain values and derivatives), or at
        Dr.Jit numbers or dual numbers, as an expression that Dr.Jit can differentiate. For jets the
        sum is over all blobs, because the grid serves only points."""
        if isinstance(x, Dual):
            blobs = self._upload(backend_of(x.value))
            return ExpressionFormula(type(self).__name__, blobs.differentiable_sums)(x, y, z)
        number = backend_number(x, y, z) if is_jet(x, type(self).__name__) else x
        return self._upload(backend_of(number))(x, y, z)

    def with_attached_numbers(self, backend: Backend) -> Blobs:
        """The copy whose formula has derivatives by the arguments of the constructor."""
        blobs = self._upload(backend)
        records = self._attached_records(backend, blobs.records)
        blobs = dataclasses.replace(blobs, records=records)
        return with_formula(self, blobs.differentiable_sums)

    def _attached_records(self, backend: Backend, records: RecordTable) -> RecordTable:
        """The table of the blobs' numbers with derivatives by the arguments of the constructor.

        In a record (`_blob_records`) the center c, one over the radius s R of the support, and the
        amplitude w A are numbers of the arguments; what rounding has cut off of the center does not
        depend on them. Lane 8 i + k is entry k of record i.
        """
        kept, count, index = kept_arguments(self), len(self), backend.UInt32
        in_given_order = np.empty(count, np.int64)
        in_given_order[self._order] = np.arange(count)

        def numbers(name: str, plain: FloatArray) -> Real:
            """The numbers of an argument, in the order in which they were given."""
            argument = kept.get(name)
            if argument is None:
                argument = plain[in_given_order]
            elif name != "centers" and np.ndim(host_array(argument, name)) == 0:
                return attached_array(argument, plain[:1], backend)
            return attached_array(argument, plain[in_given_order], backend)

        centers = numbers("centers", self.centers)
        radii, weights = numbers("radii", self.radii), numbers("weights", self.weights)
        lane = dr.arange(index, 8 * count)
        column, order = lane & 7, upload_integers(backend, self._order)
        blob = dr.gather(index, order, lane >> 3)
        real = backend.Float
        center = dr.gather(real, centers, 3 * blob + dr.minimum(column, 2))
        # (A single number for all blobs is an array of one entry.)
        radius = dr.gather(real, radii, dr.minimum(blob, dr.width(radii) - 1))
        weight = dr.gather(real, weights, dr.minimum(blob, dr.width(weights) - 1))
        entries = dr.select(column < 3, center, 0)
        entries = dr.select(column == 6, 1 / (self.kernel.support * radius), entries)
        entries = dr.select(column == 7, self.kernel.amplitude * weight, entries)
        return records.with_derivatives(entries)

    def largest_gradient(self) -> float:
        """A bound of |grad f| everywhere. It is a sum of bounds of the single blobs' gradients:
        without a grid the sum over all blobs, with a grid the largest of the sums over the cells'
        lists of blobs nearby."""
        gradient_bounds = np.abs(self.weights) * (
            self.kernel.amplitude * self.kernel.steepness.slope
        )
        gradient_bounds /= self._supports
        lists = self.cell_lists
        if lists is None:
            return float(gradient_bounds.sum())
        # A cell's sum is a difference of two running sums over the entries of all lists.
        running_sums = np.concatenate([[0.0], np.cumsum(gradient_bounds[lists.entries])])
        # (1e-6 covers the rounding of the sums.)
        return float((running_sums[lists.starts[1:]] - running_sums[lists.starts[:-1]]).max()) * (
            1 + 1e-6
        )

    def extent(self, levels: tuple[float, ...]) -> Volume:
        """The box around all supports, for any levels: outside of it f is 0."""
        del levels
        reach = self._supports[:, None] * (1 + 1e-6)
        return Box((self.centers - reach).min(axis=0), (self.centers + reach).max(axis=0))

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for level 0, which blobs take in all of the space outside of them."""
        for level in levels:
            if level == 0.0:
                raise ValueError(
                    "level 0 of blobs is all the space outside of them; a single blob has its "
                    "radius at level 1, and any other number but 0 gives a surface"
                )

    def describe(self) -> dict[str, Any]:
        """The number of blobs, the kernel's name and the size of the grid, as a dictionary for
        users."""
        facts: dict[str, Any] = {"blobs": len(self), "kernel": self.kernel.name}
        lists = self.cell_lists
        if lists is not None:
            nx, ny, nz = lists.shape
            facts["grid"] = f"{nx} x {ny} x {nz} cells of {lists.cell_size:.3g}"
        return facts


@dataclass(frozen=True, eq=False)
class _DeviceBlobs:
    """Blobs on a backend, and sums over them. A blob is a bump that is 0 outside of a ball, its
    support. Called with three coordinates, it is the formula of f.

    name: the name of the field's class, for messages.
    records: the table of the blobs' numbers, one row for each blob (`_blob_records`).
    grid: the lists of the blobs near each cell of a grid; None for a small number of blobs.
    groups: the group of each blob, and the number of groups; None if all blobs are one sum.
    has_negative_weights: whether amplitudes (factors of blobs) may be negative.
    max_path_length: a length greater than that of any straight line through all supports.
    kernel: the shape of the blobs.
    lipschitz: a bound of |grad f| everywhere.
    """

    backend: Backend
    name: str
    records: RecordTable
    grid: BlobGrid | None
    groups: tuple[Any, Any] | None
    has_negative_weights: bool
    max_path_length: Real
    kernel: BlobKernel
    lipschitz: Real

    @classmethod
    def upload(cls, backend: Backend, blobs: Blobs) -> _DeviceBlobs:
        """Upload the data of `blobs` to a backend."""
        lists = blobs.cell_lists
        groups = None
        if blobs.groups is not None:
            count = dr.opaque(backend.UInt32, int(blobs.groups.max()) + 1)
            groups = upload_integers(backend, blobs.groups), count
        lower, upper = blobs.extent(()).bounds()
        return cls(
            backend,
            type(blobs).__name__,
            RecordTable.upload(backend, _blob_records(backend, blobs)),
            None if lists is None else BlobGrid.upload(backend, lists),
            groups,
            bool((blobs.weights < 0).any()),
            # `max_path_length`: twice the diagonal of the blobs' box.
            dr.opaque(backend.Float, 2 * float(np.linalg.norm(upper - lower))),
            blobs.kernel.on_backend(backend),
            dr.opaque(backend.Float, blobs.largest_gradient()),
        )

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """f at jets of the coordinates (intervals that contain values and derivatives), or at
        Dr.Jit numbers. For jets the sum is over all blobs, because the grid serves only points."""
        if not is_jet(x, self.name):
            points = EvaluateOnly(lambda p: self.sample(self.value_at(p)))
            return points.differentiable_value(self.backend.Array3f(x, y, z))
        zero = self.backend.Float(0)
        term = blob_term(self.kernel, (x, y, z))
        if self.groups is None:
            return sum_jets(term, x, zero, for_each_record(self.records))
        # The list of all blobs.
        return group_maximum_jet(term, x, zero, self.grouped(None))

    def differentiable_sums(self, p: Vec3) -> tuple[Real, Vec3]:
        """f and grad f at points p, as expressions that Dr.Jit can differentiate with respect to p
        and to the records.

        Both are sums over blobs, f of A k(q) and grad f of -2 A k'(q) v/R with the vector v from p
        to the center in units of the support's radius R, and q = |v|^2. Dr.Jit differentiates a
        term, and runs the loop that adds the terms once more for reverse mode, since no term
        depends on the sum. If there are groups, the terms are those of the largest sum.
        """
        p = separate_variable(p)
        if self.groups is None:
            for_each = self.near(p, is_sum=True)
        else:
            with dr.suspend_grad():
                blobs = self.grouped(dr.detach(p))
                group = largest_group_at(self.kernel, self.backend, dr.detach(p), blobs)
            for_each = for_each_of_group(blobs, group)
        sums = value_at(self.kernel, self.backend, p, for_each)
        return sums.value, sums.gradient

    def near(self, p: Vec3, *, is_sum: bool = False) -> ForEach:
        """Make a function that loops over the blobs whose supports may contain p: for_each(body,
        state) sets state = body(record, state) for each of them and returns the last state. They
        are the blobs in the list of the grid cell that contains p or, without a grid, all blobs.

        is_sum: whether the state is a tuple of sums, which can be differentiated in reverse mode.
        """
        if self.grid is None:
            return for_each_record(self.records, is_sum=is_sum)
        begin, end = self.grid.list_at(dr.detach(p))
        return for_each_listed(self.records, self.grid.entries, begin, end, is_sum=is_sum)

    def grouped(self, p: Vec3 | None) -> GroupedList:
        """The blobs whose supports may contain p, as a list sorted by groups; all blobs if p is
        None or there is no grid."""
        assert self.groups is not None
        group_of_blob, count = self.groups
        # All records of the table, which are sorted by groups.
        if self.grid is None or p is None:
            # Without a list of entries (None), the list is all records, in their order.
            zero = self.backend.UInt32(0)
            return GroupedList(
                self.records, group_of_blob, None, zero, self.records.iteration_count, count
            )
        begin, end = self.grid.list_at(p)
        return GroupedList(self.records, group_of_blob, self.grid.entries, begin, end, count)

    def value_at(self, p: Vec3) -> SumValue:
        """f at points p: the sum of all blobs or, if there are groups, the largest of the groups'
        sums."""
        if self.groups is None:
            return value_at(self.kernel, self.backend, p, self.near(p))
        return group_maximum_at(self.kernel, self.backend, p, self.grouped(p))

    def sample(self, sums: SumValue) -> Sample:
        """The sample at points: value, gradient, and, as the proved bound of f near the points, a
        Lipschitz constant that holds everywhere.

        sums: value and gradient of f at the points, with bounds of their errors.
        """
        promises = (Lipschitz(0 * sums.value + self.lipschitz),)
        return Sample(sums.value, sums.gradient, promises, sums.error, sums.gradient_error)


@dataclass(frozen=True, eq=False)
class _BlobsEvaluator(FormulaEvaluator):
    """The evaluator of blobs.

    blobs: the blobs on the backend, which are also the formula.
    """

    blobs: _DeviceBlobs

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: the value and the gradient of f, and a Lipschitz constant that holds
        everywhere."""
        return self.blobs.sample(self.blobs.value_at(p))

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the position t of a ray, with enclosures: proofs of lengths in front of the
        point on which f takes none of the levels (the values that rays look for). It needs one loop
        over the blobs nearby. There is no enclosure behind the point.

        path: the ray.
        t: a length along it.
        ahead: the length in front of the point up to which proofs are wanted.
        back: the same behind the point; not used.

        In a grid, enclosures end where the ray leaves the cell of the point, enlarged by a margin:
        up to there the cell's list of blobs is complete. If the cell is empty, f is 0 until the ray
        comes to the first cell that is not empty. The enclosures then begin there and are proved
        from that cell's list (`DelayedEnclosure`).
        """
        del back
        p, d = path.point(t), path.direction
        blobs = self.blobs
        piece_count = PIECES if blobs.grid is None else PIECES_IN_CELL
        # The proofs are asked first at which knots they want ranges of derivatives; those are then
        # computed in the one loop over the blobs.
        recorder = KnotRecorder(piece_count)
        no_slope = SlopeRange(0.0, 0.0)  # in place of the slope, which is not needed for this
        path.proofs.from_restriction(recorder, no_slope, ahead)
        # No proof asks for ranges of derivatives: those from the Lipschitz constant are used.
        if recorder.knots is None:
            return path.enclose(self.evaluate(p))
        empty_length: Real | None = None
        piece_start, length = p, fmin(ahead, blobs.max_path_length)
        if blobs.grid is not None:
            empty_length = skipped = blobs.grid.empty_run(p, d, ahead)
            piece_start = dr.fma(type(p)(skipped), d, p)
            # Behind an empty run the length counts from the first cell that is not empty, so
            # `ahead` says nothing about it.
            to_exit = blobs.grid.cell(piece_start).exit_distance(d)
            length = fmin(
                dr.select(skipped > 0, to_exit, fmin(ahead, to_exit)), blobs.max_path_length
            )
        # The knots for the final length.
        path.proofs.from_restriction(recorder, no_slope, length)
        enclosures: tuple[Enclosure, ...]
        if blobs.groups is None:
            sums = sum_along(
                blobs.kernel,
                blobs.backend,
                piece_start,
                d,
                recorder.knots,
                blobs.near(piece_start),
                signed=blobs.has_negative_weights,
            )
            start = (
                # The sum is that at `piece_start`; at p, in an empty cell, f is 0.
                sums.start if empty_length is None else _zero_where(empty_length > 0, sums.start)
            )
            slope = dr.dot(start.gradient, d)
            slopes = SlopeRange.around(slope, start.gradient_error)
            enclosures = path.proofs.from_restriction(sums, slopes, length)
        else:
            # The value at p, not at `piece_start`: over an empty length both are 0.
            start = blobs.value_at(p)
            slope = dr.dot(start.gradient, d)
            enclosures = (
                GroupMaximumEnclosure(
                    blobs.kernel, blobs.grouped(piece_start), path, piece_start, start.value,
                    recorder.knots, length, blobs.has_negative_weights,
                ),
            )  # fmt: skip
        if empty_length is not None:
            enclosures = tuple(
                DelayedEnclosure(empty_length, enclosure) for enclosure in enclosures
            )
        # The next sample's proofs should reach as many of this step's lengths as there are pieces.
        return RaySample(blobs.sample(start), enclosures, (), slope, float(piece_count))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at points p. If blobs have groups, it is the Hessian
        of the largest of the groups' sums at p, which `FormulaEvaluator.hessian` computes with
        jets."""
        blobs = self.blobs
        if blobs.groups is not None:
            return super().hessian(p)
        xx, xy, xz, yy, yz, zz = hessian_at(blobs.kernel, blobs.backend, p, blobs.near(p))
        vector = blobs.backend.Array3f
        return vector(xx, xy, xz), vector(xy, yy, yz), vector(xz, yz, zz)


def _blob_records(backend: Backend, blobs: Blobs) -> FloatArray:
    """The records (n, 8) of blobs, one row of numbers for each.

    A record holds, by columns: 0 to 2 the center, rounded to the precision of the backend; 3 to 5
    the rest of the center, which rounding has cut off; 6 one over the radius of the support; 7 the
    amplitude w_i A (weight times the kernel's amplitude).

    Raises:
        BlobError: a blob that is too small, too large or too far away for the precision.
    """
    supports = blobs.radii * blobs.kernel.support
    info = np.finfo(backend.dtype)
    largest, smallest = float(info.max), float(info.smallest_normal)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        amplitude = blobs.weights * blobs.kernel.amplitude
        rounded_centers = blobs.centers.astype(backend.dtype).astype(np.float64)
        # Bounds of the numbers that a sum adds up, which must not overflow.
        value_bound = np.abs(amplitude) * max(1.0, blobs.kernel.steepness.bend)
        inverse_radius = 1 / supports
        second_bound = value_bound * inverse_radius * inverse_radius
    is_invalid = ~((np.abs(blobs.centers) <= largest) & (supports[:, None] * smallest < 1)).all(
        axis=1
    )
    is_invalid |= ~((inverse_radius < 1e30) & (value_bound <= largest) & (second_bound <= largest))
    if is_invalid.any():
        worst = int(np.argmax(is_invalid))
        precision = "single" if backend.dtype == np.float32 else "double"
        other = ', or in Python precision="double"' if precision == "single" else ""
        raise BlobError(
            f"blob {worst}, with a radius of {blobs.radii[worst]:g}, a weight of "
            f"{blobs.weights[worst]:g} and its center at {format_vector(blobs.centers[worst])}, is "
            f"too small, too large or too far away for {precision} precision: "
            f"choose units nearer to 1{other}"
        )
    remainder = blobs.centers - rounded_centers
    return np.column_stack([rounded_centers, remainder, 1 / supports, amplitude])


@dataclass(frozen=True)
class DelayedEnclosure(Enclosure):
    """A proof about a function F(s) along a path, where F is 0 on the first part of the path: 0 <=
    s <= run.

    run: the length of that first part.
    then: the proof about F from s = run on.
    """

    run: Real
    then: Enclosure

    def free_length(self, gaps: LevelGaps) -> Real:
        """A length of the path that is proved to contain no level (a value of F that rays look
        for): the first part, where F is 0, plus a proved length behind it.

        gaps: the differences between F at the start, which is 0, and the next levels below and
            above.
        """
        return self.run + self.then.free_length(gaps)


def _zero_where(mask: Any, sums: SumValue) -> SumValue:
    """Sums of blobs at points, with value, gradient and errors replaced by 0 on the lanes on which
    the mask is true."""
    zero = 0 * sums.value
    return SumValue(
        dr.select(mask, zero, sums.value),
        dr.select(mask, type(sums.gradient)(0), sums.gradient),
        dr.select(mask, zero, sums.error),
        dr.select(mask, zero, sums.gradient_error),
    )


def _checked(
    centers: Any, radii: Any, weights: Any, groups: Any
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray | None, IntArray]:
    """The arguments of `Blobs` as arrays, sorted by groups: centers (n, 3), radii (n,), weights
    (n,) and groups (n,). Groups are numbered from 0 without gaps; None if none are given. In the
    code these four arrays are c, r, w and g. The fifth result is the order (n,): the index that
    each blob had in the arguments.

    Raises:
        BlobError: wrong shapes, or numbers that are not valid for a blob.
    """
    c = host_array(centers, "centers", BlobError)
    check_vectors(c, "centers", BlobError)
    if not len(c):
        raise BlobError("centers: there are none; give at least one blob")
    check_finite(c, "center {}", BlobError)
    check_coordinate_size(c, BlobError)
    r = _numbers(radii, "radii", len(c))
    bad = np.flatnonzero(~(r > 0))
    if bad.size:
        raise BlobError(f"radius {bad[0]} is {r[bad[0]]:g}: radii must be positive")
    check_coordinate_size(r, BlobError)
    w = np.ones(len(c)) if weights is None else _numbers(weights, "weights", len(c))
    if groups is None:
        return c, r, w, None, np.arange(len(c))
    g = as_real_array(groups, "groups", BlobError)
    if g.shape != (len(c),) or g.dtype.kind not in "iu":
        raise BlobError(
            f"groups must be {len(c)} integers, one for each blob, not {g.dtype} of shape {g.shape}"
        )
    order = np.argsort(g, kind="stable")
    return (
        c[order],
        r[order],
        w[order],
        np.unique(g[order], return_inverse=True)[1],  # the groups' numbers from 0 without gaps
        order,
    )


def _numbers(values: Any, name: str, count: int) -> FloatArray:
    """The finite numbers `values` as an array (count,). A single number is repeated.

    name: what the numbers are, for messages.

    Raises:
        BlobError: a wrong shape, or a number that is not finite.
    """
    array = host_array(values, name, BlobError)
    if array.ndim == 0:
        array = np.full(count, float(array))
    if array.shape != (count,):
        raise BlobError(
            f"{name} must be one number, or {count}, one for each center, not an array of shape "
            f"{array.shape}"
        )
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise BlobError(f"{name}: entry {bad[0]} is {array[bad[0]]}, and all must be finite")
    return array


class Molecule(Blobs):
    """The surface of a molecule: the level 1 of a sum of Gaussians A exp(-s (d/r)^2) over its
    atoms. Here d is the distance from the atom, r its van der Waals radius, s the sharpness, and A
    makes a single atom a ball of its radius. From each Gaussian its tangent at the end is
    subtracted, so that it ends at a finite distance (`GaussianKernel`).

    source: a .pdb, .ent, .cif or .mmcif file, or `Atoms`.
    sharpness: s. The larger it is, the closer the surface follows the single atoms.
    tail: an atom ends where its Gaussian is this fraction of its value at the radius. With 1/32
        about ten atoms are nonzero at a point, with 1/1000 about twenty.

    Most viewers cut Gaussians off at 1/32. Then f jumps by this value, and the surface has seams.
    With the tangent subtracted, f is smooth where atoms end, and ranges of f along a ray are exact.
    A single atom is still a ball of its radius.

    Raises:
        FileFormatError: a file that does not hold a molecule.
    """

    traits = dataclasses.replace(Blobs.traits, differentiable_arguments=())

    def __init__(
        self,
        source: str | os.PathLike[str] | Atoms,
        *,
        sharpness: float = 1.0,
        tail: float = 1 / 32,
    ) -> None:
        """Read the atoms, and set up a blob with a Gaussian kernel for each.

        source: a .pdb, .ent, .cif or .mmcif file, or `Atoms`.
        sharpness: the number s in exp(-s (d/r)^2), with d the distance from an atom of the radius
            r. The larger it is, the closer the surface follows the single atoms.
        tail: an atom ends where its Gaussian is this fraction of its value at the radius.

        Raises:
            FileFormatError: a file that does not hold a molecule.
        """
        self.atoms = source if isinstance(source, Atoms) else read_molecule(source)
        record_arguments(self, source=self.atoms)  # so that `replace` reads no file
        super().__init__(
            self.atoms.positions, self.atoms.radii, kernel=GaussianKernel(sharpness, tail)
        )

    def describe(self) -> dict[str, Any]:
        """The number of atoms, the kernel's name and the size of the grid, as a dictionary for
        users."""
        facts = super().describe()
        return {"atoms": facts.pop("blobs"), **facts}
