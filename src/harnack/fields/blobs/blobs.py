"""Blobs: metaballs, soft objects and densities of molecules, as level sets of sums of kernels.

`Blobs` is the field, `Molecule` that of a molecule's atoms, by their van der Waals radii.
"""

from __future__ import annotations

import copy
import functools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, cast

import drjit as dr
import numpy as np

from harnack.arithmetic import Jet
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
from harnack.fields.batched_fields import cached_prepare
from harnack.fields.blobs.blob_sums import (
    PIECES,
    PIECES_IN_CELL,
    ForEach,
    KnotRecorder,
    SumValue,
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
    group_maximum_at,
    group_maximum_jet,
)
from harnack.fields.blobs.kernels import BlobKernel, GaussianKernel, choose_kernel
from harnack.fields.formula import Formula, is_jet
from harnack.fields.samples import Ray, RaySample, Sample
from harnack.files.molecules import Atoms, read_molecule
from harnack.geometry import Box

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume

# From so many blobs on, a grid is faster than a sum over all, by experiment.
_MIN_BLOBS_FOR_GRID = 64


class BlobError(ValueError):
    """Blobs that cannot be; the message says which and why."""


class Blobs(Formula):
    """f(x) = sum of w_i A k(|x - c_i|^2 / R_i^2): metaballs, whose surface is f = 1.

    A single blob of weight 1 is the ball with its radius; where blobs meet, they flow together.
    Inside f is larger.

    centers: (n, 3).
    radii: (n,) or one number, > 0.
    weights: (n,), or None for 1; negative ones carve.
    kernel: "compact" (a polynomial of the sixth degree), "gaussian", or the soft objects "cubic"
        and "sextic"; or one with other parameters, such as `GaussianKernel(sharpness=2.0)`. Each
        ends at `BlobKernel.support` times the radius.
    groups: (n,) integers: f is then the largest of the sums of each group, so that groups meet in
        creases; None for one sum.

    Many blobs are kept in a uniform grid of lists, so that a sample takes only those nearby.

    Raises BlobError (a ValueError) for numbers that are no blobs.
    """

    is_cheap = False
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
        self.centers, self.radii, self.weights, self.groups = _checked(
            centers, radii, weights, groups
        )
        self.kernel = choose_kernel(kernel)
        self._on: _BlobDeviceData | None = None

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def _supports(self) -> FloatArray:
        return self.radii * self.kernel.support

    @functools.cached_property
    def cell_lists(self) -> CellLists | None:
        """The lists of blobs near each cell of a grid; None for few blobs."""
        return (
            CellLists.of(self.centers, self._supports) if len(self) >= _MIN_BLOBS_FOR_GRID else None
        )

    @cached_prepare
    def prepare(self, backend: Backend) -> Blobs:
        """The blobs as records of the backend; other blobs compile no other kernel."""
        prepared = copy.copy(self)
        prepared._on = _BlobDeviceData.upload(backend, self)
        prepared.kernel = self.kernel.prepare(backend)
        prepared.lipschitz = dr.opaque(backend.Float, self.largest_gradient())
        return prepared

    def largest_gradient(self) -> float:
        """A bound of |grad f|: the largest sum of the largest gradients of overlapping blobs."""
        steep = np.abs(self.weights) * (self.kernel.amplitude * self.kernel.steepness.slope)
        steep /= self._supports
        lists = self.cell_lists
        if lists is None:
            return float(steep.sum())
        ends = np.concatenate([[0.0], np.cumsum(steep[lists.entries])])
        return float((ends[lists.starts[1:]] - ends[lists.starts[:-1]]).max()) * (1 + 1e-6)

    def extent(self, levels: tuple[float, ...]) -> Volume:
        """The box around all supports: outside f is 0."""
        del levels
        reach = self._supports[:, None] * (1 + 1e-6)
        return Box((self.centers - reach).min(axis=0), (self.centers + reach).max(axis=0))

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        for level in levels:
            if level == 0.0:
                raise ValueError(
                    "level 0 of blobs is all the space outside of them; a single blob has its "
                    "radius at level 1, and any other number but 0 gives a surface"
                )

    def evaluate(self, p: Vec3) -> Sample:
        on = self._prepared(p)
        return self._sample(on.value_at(self.kernel, p))

    def _sample(self, found: SumValue) -> Sample:
        known = () if self.lipschitz is None else (Lipschitz(0 * found.value + self.lipschitz),)
        return Sample(found.value, found.gradient, known, found.error, found.gradient_error)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """Value and ranges by one loop over the blobs nearby; looking back nothing is proved.

        In a grid, enclosures reach to the end of the point's cell. From an empty cell, f is 0 until
        the path comes to the first cell that is not empty: steps from there are proved from that
        cell's list.
        """
        del back
        p, d = path.point(t), path.direction
        on = self._prepared(p)
        count = PIECES if on.grid is None else PIECES_IN_CELL
        asked = KnotRecorder(count)
        nothing = SlopeRange(0.0, 0.0)
        path.proofs.from_restriction(asked, nothing, ahead)
        if asked.knots is None:
            return path.enclose(self.evaluate(p))
        on = self._prepared(p)
        run: Real | None = None
        there, length = p, fmin(ahead, on.max_path_length)
        if on.grid is not None:
            run = empty = on.grid.empty_run(p, d, ahead)
            there = dr.fma(type(p)(empty), d, p)
            reach = on.grid.cell(there).exit_distance(d)
            length = fmin(dr.select(empty > 0, reach, fmin(ahead, reach)), on.max_path_length)
        path.proofs.from_restriction(asked, nothing, length)
        enclosures: tuple[Enclosure, ...]
        if on.groups is None:
            found = sum_along(
                self.kernel,
                on.backend,
                there,
                d,
                asked.knots,
                on.near(there),
                signed=on.has_negative_weights,
            )
            start = found.start if run is None else _zero_where(run > 0, found.start)
            slope = dr.dot(start.gradient, d)
            slopes = SlopeRange.around(slope, start.gradient_error)
            enclosures = path.proofs.from_restriction(found, slopes, length)
        else:
            start = on.value_at(self.kernel, p)
            slope = dr.dot(start.gradient, d)
            enclosures = (
                GroupMaximumEnclosure(
                    self.kernel, on.grouped(there), path, there, start.value, asked.knots, length,
                    on.has_negative_weights,
                ),
            )  # fmt: skip
        if run is not None:
            enclosures = tuple(DelayedEnclosure(run, one) for one in enclosures)
        return RaySample(self._sample(start), enclosures, (), slope, float(count))

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f of jets of the coordinates, or of Dr.Jit numbers: a sum over all blobs."""
        if not is_jet(x, type(self).__name__):
            return self.differentiable_value(backend_of(x).Array3f(x, y, z))
        on = self._prepared_for(backend_of(_backend_number(x, y, z)))
        zero = on.backend.Float(0)
        term = blob_term(self.kernel, (x, y, z))
        if on.groups is None:
            return sum_jets(term, x, zero, for_each_record(on.records))
        return group_maximum_jet(term, x, zero, on.grouped(None))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """Rows of the Hessian of the sum, or of the largest sum."""
        on = self._prepared(p)
        if on.groups is not None:
            return super().hessian(p)
        xx, xy, xz, yy, yz, zz = hessian_at(self.kernel, on.backend, p, on.near(p))
        vector = on.backend.Array3f
        return vector(xx, xy, xz), vector(xy, yy, yz), vector(xz, yz, zz)

    def _prepared(self, p: Vec3) -> _BlobDeviceData:
        return self._prepared_for(backend_of(p))

    def _prepared_for(self, backend: Backend) -> _BlobDeviceData:
        if self._on is None:
            return _BlobDeviceData.upload(backend, self)
        return self._on

    def describe(self) -> dict[str, Any]:
        facts: dict[str, Any] = {"blobs": len(self), "kernel": self.kernel.name}
        lists = self.cell_lists
        if lists is not None:
            nx, ny, nz = lists.shape
            facts["grid"] = f"{nx} x {ny} x {nz} cells of {lists.cell_size:.3g}"
        return facts


@dataclass(frozen=True)
class _BlobDeviceData:
    """The data of blobs on a backend.

    groups: the group of each blob, and the number of groups; None if all are one sum.
    has_negative_weights: whether amplitudes may be negative.
    max_path_length: longer than any path through all supports.
    """

    backend: Backend
    records: RecordTable
    grid: BlobGrid | None
    groups: tuple[Any, Any] | None
    has_negative_weights: bool
    max_path_length: Real

    @classmethod
    def upload(cls, backend: Backend, blobs: Blobs) -> _BlobDeviceData:
        """The blobs on a backend."""
        lists = blobs.cell_lists
        groups = None
        if blobs.groups is not None:
            count = dr.opaque(backend.UInt32, int(blobs.groups.max()) + 1)
            groups = upload_integers(backend, blobs.groups), count
        low, high = blobs.extent(()).bounds()
        return cls(
            backend,
            RecordTable.upload(backend, _rows(backend, blobs)),
            None if lists is None else BlobGrid.upload(backend, lists),
            groups,
            bool((blobs.weights < 0).any()),
            dr.opaque(backend.Float, 2 * float(np.linalg.norm(high - low))),
        )

    def near(self, p: Vec3) -> ForEach:
        """The blobs whose supports may contain p: those of its cell."""
        if self.grid is None:
            return for_each_record(self.records)
        return for_each_listed(self.records, self.grid.entries, *self.grid.list_at(p))

    def grouped(self, p: Vec3 | None) -> GroupedList:
        """The same, by groups; all blobs if p is None."""
        assert self.groups is not None
        of, count = self.groups
        if self.grid is None or p is None:
            zero = self.backend.UInt32(0)
            return GroupedList(self.records, of, None, zero, self.records.iteration_count, count)
        begin, end = self.grid.list_at(p)
        return GroupedList(self.records, of, self.grid.entries, begin, end, count)

    def value_at(self, kernel: BlobKernel, p: Vec3) -> SumValue:
        """The sum, or the largest sum, at points p."""
        if self.groups is None:
            return value_at(kernel, self.backend, p, self.near(p))
        return group_maximum_at(kernel, self.backend, p, self.grouped(p))


def _rows(backend: Backend, blobs: Blobs) -> FloatArray:
    """Records (n, 8): the center, rounded; the rest of the center; 1/R; and the amplitude."""
    supports = blobs.radii * blobs.kernel.support
    info = np.finfo(backend.dtype)
    largest, smallest = float(info.max), float(info.smallest_normal)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        amplitude = blobs.weights * blobs.kernel.amplitude
        near = blobs.centers.astype(backend.dtype).astype(np.float64)
        strong = np.abs(amplitude) * max(1.0, blobs.kernel.steepness.bend)
        inverse = 1 / supports
        bend = strong * inverse * inverse
    outside = ~((np.abs(blobs.centers) <= largest) & (supports[:, None] * smallest < 1)).all(axis=1)
    outside |= ~((inverse < 1e30) & (strong <= largest) & (bend <= largest))
    if outside.any():
        worst = int(np.argmax(outside))
        precision = "single" if backend.dtype == np.float32 else "double"
        help_ = 'use precision="double" or ' if precision == "single" else ""
        raise BlobError(
            f"blob {worst}, with a radius of {blobs.radii[worst]:g}, a weight of "
            f"{blobs.weights[worst]:g} and its center at {format_vector(blobs.centers[worst])}, is "
            f"too small, too large or too far away for {precision} precision: "
            f"{help_}choose units nearer to 1"
        )
    rest = blobs.centers - near
    return np.column_stack([near, rest, 1 / supports, amplitude])


@dataclass(frozen=True)
class DelayedEnclosure(Enclosure):
    """F = 0 for 0 <= s <= run; from there on the path is that of another enclosure."""

    run: Real
    then: Enclosure

    def free_length(self, gaps: LevelGaps) -> Real:
        return self.run + self.then.free_length(gaps)


def _zero_where(mask: Any, found: SumValue) -> SumValue:
    """The sum, replaced by 0 where the mask holds."""
    zero = 0 * found.value
    return SumValue(
        dr.select(mask, zero, found.value),
        dr.select(mask, type(found.gradient)(0), found.gradient),
        dr.select(mask, zero, found.error),
        dr.select(mask, zero, found.gradient_error),
    )


def _backend_number(*jets: Jet) -> Any:
    """Some number of the backend from the ranges of jets.

    Raises:
        TypeError: they are all constants.
    """
    for jet in jets:
        for one in (jet.value, *jet.first_derivatives):
            for end in (one.lower, one.upper):
                if dr.is_array_v(cast("Any", type(end))):
                    return end
    raise TypeError("blobs need a point of the backend: the coordinates are constants")


def _checked(
    centers: Any, radii: Any, weights: Any, groups: Any
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray | None]:
    """The arguments as arrays, sorted by groups.

    Raises:
        BlobError: wrong shapes, or numbers that no blob can have.
    """
    c = as_real_array(centers, "centers", BlobError).astype(np.float64)
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
        return c, r, w, None
    g = as_real_array(groups, "groups", BlobError)
    if g.shape != (len(c),) or g.dtype.kind not in "iu":
        raise BlobError(
            f"groups must be {len(c)} integers, one for each blob, not {g.dtype} of shape {g.shape}"
        )
    order = np.argsort(g, kind="stable")
    return c[order], r[order], w[order], np.unique(g[order], return_inverse=True)[1]


def _numbers(values: Any, name: str, count: int) -> FloatArray:
    array = as_real_array(values, name, BlobError).astype(np.float64)
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
    """The surface of a molecule: the level 1 of a sum of A exp(-s (d/r)^2) over its atoms, each
    less a tangent that makes it end (see `GaussianKernel`); r is the van der Waals radius of the
    atom.

    source: a .pdb, .ent, .cif or .mmcif file, or `Atoms`.
    sharpness: s; the larger, the closer the surface follows the single atoms.
    tail: an atom ends where its Gaussian is this fraction of its value at the radius. With 1/32
        about ten atoms reach a point, with 1/1000 about twenty.

    The usual viewers cut Gaussians off at 1/32: then f jumps by that, and the surface has seams.
    Here the tangent is subtracted, so that atoms end smoothly and ranges of f along a ray are
    exact; a single atom is still a ball of its radius.

    Raises FileFormatError for what is no file of a molecule.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Atoms,
        *,
        sharpness: float = 1.0,
        tail: float = 1 / 32,
    ) -> None:
        self.atoms = source if isinstance(source, Atoms) else read_molecule(source)
        super().__init__(
            self.atoms.positions, self.atoms.radii, kernel=GaussianKernel(sharpness, tail)
        )

    def describe(self) -> dict[str, Any]:
        facts = super().describe()
        return {"atoms": facts.pop("blobs"), **facts}
