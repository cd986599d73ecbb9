"""The generalized winding number w of triangle meshes: how many times a mesh winds around a point.
Its level set w = 1/2 is the mesh where the mesh is sound; it closes holes, and repairs triangle
soups and overlaps. w jumps by an integer across each triangle. So w *modulo 1* (w minus an unknown
integer) is smooth across triangles. It is determined by the *singular edges*, the edges at which
triangles do not cancel. *Promises* are proved bounds of w near a point. In unit coordinates the
mesh has a size of about one. A sample's *accuracy scale* is a number: larger is more accurate. In
an *FMM cell* (fast multipole method) near edges or triangles are summed directly, and all others
are replaced by one polynomial. A *lane* is one entry of Dr.Jit's arrays, such as a point or a ray;
a *backend* is what Dr.Jit computes on, and in which precision; an *evaluator* samples a field on a
backend.

- `WindingNumber`: the field.
- `WindingModuloOne`: the field w modulo 1.
- `winding_extent`, `winding_cells`: the volume and the cells that are proved to contain its level
  sets, on its triangles and on the surfaces that span its holes.

A cell counts as empty if w modulo 1 is proved to take no level in it, whether or not the cell
contains triangles. In empty cells rays sample w only where they cross triangles.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray, backend_of
from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import fmax
from harnack.backend.validation import as_integer_in_range, as_real, check_no_derivatives
from harnack.cluster.serialization import TransientCache
from harnack.enclosures import Lipschitz
from harnack.fields.attached_arrays import plain_array
from harnack.fields.batch_evaluation import evaluate_points
from harnack.fields.batched_fields import BatchedEvaluator, BatchedField, cached_upload
from harnack.fields.capabilities import (
    NO_FACET,
    JumpCrossing,
    Jumps,
    ModuloOne,
    MovingTriangles,
    NearestFacet,
    VariableAccuracy,
)
from harnack.fields.clearance import occupied_cells, tight_extent
from harnack.fields.evaluator import POINTS, EvaluateOnly, Evaluator, Plan
from harnack.fields.field import Field, Sample, Traits, space_scaled
from harnack.fields.parameters import record_arguments
from harnack.fields.solid_angles.boundary_cells import BoundaryCells
from harnack.fields.solid_angles.cell_options import (
    NO_CELLS,
    BuiltCells,
    CellChoice,
    FieldWithCells,
)
from harnack.fields.solid_angles.moving_vertices import (
    MovingWinding,
    drjit_vertices,
    moving_vectors,
)
from harnack.fields.solid_angles.own_sheet import lies_on_own_level
from harnack.fields.solid_angles.winding_exact import ExactWinding
from harnack.fields.solid_angles.winding_mesh import WindingMesh
from harnack.fields.solid_angles.winding_rates import BoundaryRates, with_rates
from harnack.fields.solid_angles.winding_tree import TreeWinding
from harnack.fmm.point_values import PointValues
from harnack.fmm.unit_frame import UnitFrame, coordinate_rounding, frame_parameters
from harnack.geometry import Box
from harnack.name_suggestions import did_you_mean, is_one_of
from harnack.tree.closest_triangles import (
    distance_lower_bound,
    jump_sum_within,
    next_closest_triangle,
)
from harnack.tree.triangle_tree import RayFrame, TriangleTree

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.geometry import Volume
    from harnack.tree.empty_space import OccupancyGrid

__all__ = ["WindingModuloOne", "winding_box", "winding_cells", "winding_extent"]

# For `winding_extent`, which cuts a box into cells, tests them, and halves those that are left: the
# largest number of cells that are tested in one round, and the largest number of rounds.
_MAX_CELLS = 20_000
_MAX_HALVINGS = 6
# The number of cells of the grid of `winding_cells` along its longest side, by experiment.
_CELLS_ACROSS = 192


class WindingModuloOne(Field):
    """The winding number w of a mesh modulo 1, as a field with period 1. It is continuous off the
    singular edges, also across the triangles. Where w takes a level off its triangles, this field
    takes it, too; the converse does not hold.

    Samples are the coarsest ones by default, which take half the time of ordinary ones. Ordinary
    samples would prove only 2 % more cells empty.
    """

    period: ClassVar[float | None] = 1.0
    traits = Traits(has_variable_accuracy=True)

    def __init__(self, winding: WindingNumber, cells: CellChoice | None = None) -> None:
        """winding: the winding number w. cells: the FMM cells from which samples come; None if the
        number of rays decides, as for w."""
        self._winding, self._cells = winding, cells

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The object that samples w modulo 1 on a backend. plan: what it will be used for."""
        cells = self._winding.cell_choice(plan.ray_count) if self._cells is None else self._cells
        return _ModuloOneEvaluator(self._winding.traced_data(backend, cells))

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that is proved to contain the level sets of w; None if there is no bounded
        one."""
        return self._winding.extent(levels)


class _ModuloOneEvaluator(Evaluator):
    """The winding number w of a mesh modulo 1, sampled on a backend. The proved bounds in its
    samples hold for a function that differs from w by integers: the smooth continuation of w
    through all triangles.

    data: the mesh on the backend.
    """

    def __init__(self, data: WindingData) -> None:
        """data: the mesh on the backend."""
        self._data = data
        # How w modulo 1 is sampled with another accuracy.
        self.variable_accuracy = VariableAccuracy(
            lambda scale: EvaluateOnly(lambda p: data.sample_modulo_one(p, scale))
        )

    def evaluate(self, p: Vec3) -> Sample:
        """A coarsest sample of w minus an unknown integer at points p."""
        return self._data.sample_modulo_one(p)


def winding_cells(
    winding: WindingNumber, cells: CellChoice, extent: Volume, levels: tuple[float, ...]
) -> OccupancyGrid:
    """A grid over the volume `extent`, whose cells are marked as occupied or empty. One is empty if
    the winding number w modulo 1 is proved to take none of the levels in it; triangles do not
    matter. cells: the FMM cells from which samples of w come."""
    return occupied_cells(WindingModuloOne(winding.detached, cells), levels, extent, _CELLS_ACROSS)


def winding_extent(winding: WindingNumber, levels: tuple[float, ...]) -> Volume | None:
    """A polytope that is proved to contain the level sets of the winding number w of a mesh. For a
    closed mesh it is a box. There always is one; None occurs only in the type of the result, which
    is that of `Field.extent`. It is computed without FMM cells.

    winding: the winding number.
    levels: the values of w whose level sets are meant.

    Proof. A point of a level set lies on a triangle, where w jumps over the level; or it lies off
    the triangles, and then w modulo 1 has the level there, too. The polytope contains all
    triangles. It also contains all cells of `winding_box` in which w modulo 1, which does not jump
    at triangles, is not proved to be off the level.
    """
    mesh = winding.mesh
    box = winding_box(mesh, levels)
    # A closed mesh has its level sets on its triangles, and these lie in the box.
    if not len(mesh.singular_edges):
        return box
    # The polytope must contain the triangles, and so their corners.
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    lower, upper = box.bounds()
    return tight_extent(
        WindingModuloOne(winding.detached, NO_CELLS),
        levels,
        lower,
        upper,
        _MAX_CELLS,
        _MAX_HALVINGS,
        corners,
    )


def winding_box(mesh: WindingMesh, levels: tuple[float, ...]) -> Box:
    """A box that is proved to contain the level sets, for these levels, of the winding number w of
    a mesh. It contains the mesh. Where it is larger than the box of the mesh, two proofs bound its
    size. By (a), the level sets reach at most a certain length beyond the mesh. By (b), off the
    triangles they reach at most another length beyond the singular edges.

    (a) At distance rho from a mesh whose area is A, |w| <= A/(4 pi rho^2). So a level lies within
    rho = sqrt(A/(4 pi |level|)) of the mesh. (b) Off the triangles 4 pi w is, modulo 4 pi, the
    solid angle of the singular edges. A level of this angle at distance l from the multiples of 4
    pi lies within L/sqrt(l (4 pi - l)) of edges of total length L (isoperimetry on the sphere: see
    `SolidAngle.extent`).
    """
    low, high = mesh.box
    slack = 1e-4 * float((high - low).max())  # for the rounding of the box
    # The numbers 1e-12 prevent divisions by 0: margins are huge for levels that have no bound.
    min_level = min(abs(level) for level in levels)
    area_margin = math.sqrt(mesh.area / (4 * math.pi * max(min_level, 1e-12)))
    level_gap = min(abs(math.remainder(level, 1.0)) for level in levels) * 4 * math.pi  # l
    edge_margin = mesh.boundary_length / math.sqrt(
        max(level_gap * (4 * math.pi - level_gap), 1e-12)
    )
    # Off the triangles a closed mesh has no level: then the box of the mesh is enough.
    box = low, high
    if len(mesh.singular_edges):
        ends = mesh.vertices[mesh.singular_edges].reshape(-1, 3)
        edge_low = np.minimum(low, ends.min(axis=0) - edge_margin)
        box = edge_low, np.maximum(high, ends.max(axis=0) + edge_margin)
    return Box(
        np.maximum(box[0], low - area_margin) - slack,
        np.minimum(box[1], high + area_margin) + slack,
    )


MethodName = Literal["auto", "exact", "tree"]

# Up to this number of boundary edges the exact method is used: an edge costs about a nanosecond, a
# tree two to three microseconds.
_MAX_EXACT_EDGES = 2048
# With fewer edges samples take so little time that cells save none.
_MIN_CELL_EDGES = 64
# Cells save more time than they take to build if there are at least `_PAYS_PER_EDGE` rays per edge
# and `_MIN_RAYS` rays, and at most `_MAX_CELL_EDGES` edges.
_PAYS_PER_EDGE, _MIN_RAYS, _MAX_CELL_EDGES = 3.0, 5e3, 100_000
# A mesh is a soup if it has more singular edges than `_SOUP_RATIO` times the number of triangles.
# The cells of a soup sum over near triangles, not edges. They save time if there are at least
# `_PAYS_PER_TRIANGLE` rays per triangle, and at most `_MOST_OF_SOUP` triangles.
_SOUP_RATIO, _PAYS_PER_TRIANGLE, _MOST_OF_SOUP = 1.5, 12.0, 50_000
# The cube of a soup's cells is larger than the extent, where all rays begin, by this factor. So the
# cells also serve values at points outside of the extent. This adds a few large cells.
_CUBE_FACTOR = 2.002
# The default accuracy for values at points, and for tracing, by experiment.
_VALUES_ACCURACY, _TRACING_ACCURACY = 2.0, 4.0
# See `WindingNumber._center_values`: 16.5 roundings of each of 100,000 edges, and as much for the
# steep terms near a point, are less than 1e-6 (`edge_lift.FACTOR_ROUNDINGS`).
_EXACT_ERROR = 1e-6
# A point nearer to a triangle than this many roundings of a coordinate may be on either side of it.
_TRIANGLE_ROUNDINGS = 8.0


class WindingNumber(FieldWithCells, BatchedField):
    """The winding number w of a triangle mesh around a point, as a field (Jacobson et al. 2013). It
    can be computed exactly, from one ray through the triangles and the singular edges, at which
    triangles do not cancel; or by a tree with multipoles. Promises are proved bounds of w near a
    point.

    For a closed mesh w is 1 inside and 0 outside. For a mesh with holes, cracks, duplicated or
    flipped faces or self-intersections, or for a triangle soup, w is harmonic off the triangles and
    jumps by integers across them. The surface w = 1/2 is the mesh itself where the mesh is sound,
    and spans its holes. Faces are counter-clockwise seen from outside.

    vertices: (n, 3). They may be a Dr.Jit 3-vector of n lanes, or a tensor: hits, values and
        gradients can then be differentiated by them (`moving_vertices.MovingWinding`). Hits on
        triangles move with their planes.
    faces: (m, 3) indices into them.
    method: "exact" (`edge_lift`: no truncation, time by the number of singular edges), "tree"
        (`winding_tree`), or "auto": exact up to 2048 singular edges.
    accuracy: for the tree, the moments of a cluster of triangles are used beyond `accuracy` times
        its radius; at least 1.5. A larger accuracy is slower and has smaller errors. By default it
        is 2 for values at points and 4 for tracing. Tracing uses a higher accuracy where the
        tolerance needs it. By default gradients and Hessians at points do not come from this tree.
        For up to 32,768 singular edges they come from sums over these edges, exact up to rounding.
        For more edges, the accuracy of gradients is increased until their error is about 1 % of
        their length in most places (`gradient_error_bound` bounds it).
    order: the order of the multipoles of the tree: 0 (dipoles), 1 or 2 (octupoles).
    cells: whether to build FMM cells (fast multipole method), for many rays. In a cell w is, up to
        an integer, the solid angle of a few near edges plus one polynomial for all others, with a
        proved remainder (`boundary_cells`). So a sample takes the same time whatever the number of
        edges. In a soup, where triangles have hardly an edge in common, near triangles take the
        place of edges if the method is "tree" (`dipole_cells`). None builds cells if they save time
        (`Plan.ray_count`), True always, False never. They take at most the number of megabytes of
        this argument (True: 256), and several times as much while they are built. If the user
        requested the cells of a soup, they also give values and gradients at points, which saves
        time for more than some 2,000 points per triangle. All other values and derivatives at
        points are computed by `method`.

    Some meshes lie on their own spanning surface, such as any flat mesh, or a file that `mesh`
    wrote of a `SolidAngle`. Such a mesh has the level right beside all of its triangles, and
    rounding decides on which side. Then the surface is the mesh itself, every triangle and nothing
    else. It is traced, meshed and measured as such, while values do not change (`own_sheet`). Other
    open meshes have the level where they lie before the surface that spans their boundary, and not
    where they lie behind it.

    Hits on triangles have `Hits.primitive_index`; `facet_faces` gives the face of each.
    `with_vertices` gives the field for the same faces when vertices have moved.

    Raises MeshError (a ValueError) for meshes that `validate_mesh` rejects.
    """

    period: ClassVar[float | None] = None
    default_level: float = 0.5
    traits = Traits(has_jumps=True, is_larger_inside=True, has_parameter_derivatives=True)
    copies_parameters: ClassVar[bool] = True  # `cached_upload`

    def __init__(
        self,
        vertices: Any,
        faces: Any,
        *,
        method: MethodName = "auto",
        accuracy: float | None = None,
        order: int = 2,
        cells: bool | float | None = None,
    ) -> None:
        """Validate the mesh and the options, and choose the method.

        vertices, faces: (n, 3) and (m, 3), the mesh.
        method: "exact", "tree" or "auto".
        accuracy: for the tree, the moments of a cluster are used beyond this many times its radius;
            None for the default.
        order: the order of the tree's multipoles: 0, 1 or 2.
        cells: whether to build FMM cells: True, False, None if they save time, or the number of
            megabytes that they may take.
        """
        check_no_derivatives(type(self).__name__, faces, method, accuracy, order, cells)
        if not is_one_of(method, ("auto", "exact", "tree")):
            hint = did_you_mean(method, ("auto", "exact", "tree"))
            raise ValueError(f'method is "auto", "exact" or "tree", not {method!r}{hint}')
        if accuracy is not None and not 1.5 <= as_real(accuracy, "accuracy") <= 100:
            raise ValueError(f"accuracy must lie between 1.5 and 100, not {accuracy}")
        order = as_integer_in_range(order, "order", 0, 2)
        self._mesh = WindingMesh.of(plain_array(vertices), faces)
        has_few_edges = len(self.mesh.singular_edges) <= _MAX_EXACT_EDGES
        self._method: Literal["exact", "tree"] = (
            ("exact" if has_few_edges else "tree") if method == "auto" else method
        )
        self.accuracy, self.order = accuracy, order
        self.configure_cells(cells)
        # What is computed once for a tuple of levels.
        self._extents: TransientCache[tuple[float, ...], Volume | None] = TransientCache()
        self._own_levels: TransientCache[tuple[float, ...], bool] = TransientCache()
        # Grids of cells, by the FMM cells from which samples come, and by the levels.
        self._occupied: TransientCache[tuple[CellChoice, tuple[float, ...]], OccupancyGrid] = (
            TransientCache()
        )

    def with_vertices(self, vertices: Any) -> WindingNumber:
        """The winding number of the same faces with other positions of their vertices (n, 3). This
        takes less time than a new field.

        Faces are not joined and sorted into a tree again. The new tree has the same hierarchy of
        triangles, with new centers, radii, moments and bounds. All proved bounds are computed from
        the new positions. So a tree whose vertices moved far is slower than a new tree, but never
        wrong.

        Raises MeshError as for a new mesh, and for vertices that coincided and come apart.
        """
        field = copy.copy(self)
        field._mesh = self.mesh.with_vertices(plain_array(vertices))
        record_arguments(field, vertices=vertices)  # they may have derivatives
        vars(field).pop("_detached_copy", None)
        # What was computed from the old positions is dropped.
        field._extents, field._occupied = TransientCache(), TransientCache()
        field._own_levels = TransientCache()
        field.configure_cells(self.cells)
        return field

    @property
    def detached(self) -> WindingNumber:
        """The same field without derivatives by its vertices; this field itself if it was given
        NumPy arrays."""
        return self if drjit_vertices(self) is None else self._detached_copy

    @functools.cached_property
    def _detached_copy(self) -> WindingNumber:
        """The same field without derivatives by its vertices, as another field."""
        field = copy.copy(self)
        record_arguments(field, vertices=self.mesh.vertices)
        return field

    @property
    def method(self) -> Literal["exact", "tree"]:
        """How w is computed: "exact" (one ray and the singular edges) or "tree" (multipoles). It is
        decided once, at construction."""
        return self._method

    @property
    def mesh(self) -> WindingMesh:
        """The mesh, prepared for sums: welded vertices, triangles, singular edges. It cannot be
        set, because all other data are computed from it once; `with_vertices` makes a field with
        moved vertices."""
        return self._mesh

    @property
    def facet_faces(self) -> npt.NDArray[np.int64]:
        """For each facet (a triangle that rays can hit, numbered as in `Hits.primitive_index`), the
        index of the user's face from which it comes."""
        return self.mesh.input_face

    def constructor_arguments(self) -> dict[str, Any]:
        """The arguments of the constructor by name."""
        vertices = drjit_vertices(self)
        mesh = {
            "vertices": self.mesh.vertices if vertices is None else vertices,
            "faces": self.mesh.input_faces,
        }
        return {**super().constructor_arguments(), **mesh}

    def moving_vertices(self, backend: Backend) -> Vec3:
        """The vertices as a 3-vector of a backend, with their derivatives if they have some."""
        return moving_vectors(backend, drjit_vertices(self), self.mesh.vertices)

    def moving_sum(self, backend: Backend) -> MovingWinding | None:
        """w on a backend with derivatives by vertices (`BatchedField.moving_sum`)."""
        vertices = drjit_vertices(self)
        if vertices is None or not dr.grad_enabled(vertices):
            return None
        return MovingWinding.of(self, backend)

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        """w at points x (3, n) in user coordinates, and its derivatives up to order `derivatives`
        (0, 1 or 2), with error bounds. With a tree, second derivatives come from the singular edges
        (`winding_rates`), unless the user chose the accuracy.

        closer: the accuracy scale, for a tree; larger is more accurate.
        """
        return self._values_from(self._values_data(backend_of(x)), x, derivatives, closer)

    def _values_from(
        self, data: WindingData, x: Vec3, derivatives: int, closer: Real
    ) -> PointValues:
        """w at points x and its derivatives, as `values_at` returns them, from the mesh on their
        backend."""
        winding, x = data.winding, data.to_unit(x)
        if isinstance(winding, TreeWinding):
            if derivatives == 2 and self.accuracy is None:
                # Second derivatives from the edges, and only the value from the tree.
                rates = self._upload_rates(data.backend).at(x, 2, closer)
                values = with_rates(winding.values(x, 0, closer), rates)
            else:
                values = winding.values(x, derivatives, closer)
        else:
            values = winding.values(x, derivatives)
            # The error bound is kept, and the value replaced by that of a faster way.
            if derivatives == 0:
                values = dataclasses.replace(values, value=winding.fast_values(x))
        return self._stated(data, x, values)

    def sharp_values_at(self, x: Vec3) -> PointValues:
        """w and its gradient at points x (3, n) in user coordinates, with error bounds. With a
        tree, gradients come from the singular edges (`winding_rates`), unless the user chose the
        accuracy. The error of a gradient is then about 1 % of the gradient's length in most places,
        or far less."""
        data = self._values_data(backend_of(x))
        winding = data.winding
        if not isinstance(winding, TreeWinding) or self.accuracy is not None:
            return self.values_at(x, 1)  # 1: with gradients
        x = data.to_unit(x)
        # So that the kernels below read x, and do not compute it again.
        dr.eval(x)
        rates = self._upload_rates(data.backend)
        values = rates.sharp(x)
        # If the derivatives come from the tree over the triangles, so does the value. Otherwise
        # the result has derivatives only, and the value is computed by the tree.
        if rates.summed is not winding:
            values = with_rates(winding.values(x, 0, data.backend.Float(1)), values)
        return self._stated(data, x, values)

    @cached_upload
    def _upload_rates(self, backend: Backend) -> BoundaryRates:
        """The object that evaluates the derivatives of w at points from the singular edges only
        (`winding_rates`), for the method "tree". Where the edges are of no use, it sums over the
        triangles."""
        winding = self._values_data(backend).winding
        assert isinstance(winding, TreeWinding)  # for the type: the method is "tree"
        return BoundaryRates.of(backend, self.mesh, self.order, winding)

    def _stated(self, data: WindingData, x: Vec3, values: PointValues) -> PointValues:
        """Complete results at points: enlarge their error bounds by two errors that are still
        missing, and convert results and bounds to the user's units. The first error is the jump of
        w at a triangle, if rounding hides on which side of the triangle x is. The second one
        matters only far from the mesh, where small numbers underflow and the terms of triangles
        nearly cancel (`PointValues.with_far_field_errors`).

        data: the mesh on the backend of the points.
        x: (3, n) the points in unit coordinates.
        values: w and its derivatives in unit coordinates, with error bounds.

        Returns w and its derivatives in the user's units, with complete error bounds.
        """
        # If a triangle is within rounding of x, it is not known on which side of it x is.
        possible_jump = jump_sum_within(data.rays, x, _TRIANGLE_ROUNDINGS * coordinate_rounding(x))
        values = dataclasses.replace(values, error=values.error + possible_jump)
        # The sum of the weights of all triangles as dipoles: the area in unit coordinates, over
        # 4 pi.
        weight = self.mesh.area / (4 * math.pi * self.mesh.size**2)
        # Far away a point sums all singular edges, and few other terms.
        return values.with_far_field_errors(x, 64 + len(self.mesh.singular_edges), weight).rescaled(
            data.size
        )

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> WindingEvaluator:
        """The object that samples w on a backend. If the surface of the plan's levels is the mesh
        itself (`is_whole_surface`), it takes the level only at the triangles.

        plan: what the evaluator will be used for. For many rays it has FMM cells.
        """
        level_of_sheets, cells = None, self.cell_choice(plan.ray_count)
        if self.is_whole_surface(plan.levels):
            level_of_sheets, cells = plan.levels[0], NO_CELLS
        data = self.traced_data(backend, cells)
        return WindingEvaluator(self, data, cells, level_of_sheets, plan)

    def traced_data(self, backend: Backend, cells: CellChoice) -> WindingData:
        """The mesh on a backend, for tracing. cells: the FMM cells that it has."""
        return self._upload(backend, traced=True, cells=cells)

    def _values_data(self, backend: Backend) -> WindingData:
        """The mesh on a backend, for values at points. It has FMM cells if the user requested those
        of a soup."""
        cells = self.cell_choice() if self._is_soup else NO_CELLS
        return self._upload(backend, traced=False, cells=cells)

    @cached_upload
    def _upload(self, backend: Backend, *, traced: bool, cells: CellChoice) -> WindingData:
        """Copy the mesh to a backend, in unit coordinates.

        traced: True for tracing rays; False for values at points. It decides the default accuracy
            of a tree.
        cells: the FMM cells that are added.
        """
        accuracy = self.accuracy or (_TRACING_ACCURACY if traced else _VALUES_ACCURACY)
        mesh = self.mesh
        rays = TriangleTree.of(backend, mesh.ray_tree, mesh.ray_records)
        if self.method == "exact":
            winding = ExactWinding.of(backend, mesh, rays, traced)
        else:
            winding = TreeWinding.of(backend, mesh, accuracy, self.order)
        data = WindingData(*frame_parameters(backend, mesh.center, mesh.size), winding, rays)
        if not cells or not len(mesh.singular_edges):
            return data
        return self._add_cells(data, cells, traced=traced)

    def _add_cells(self, data: WindingData, choice: CellChoice, *, traced: bool) -> WindingData:
        """Return `data` with FMM cells, or unchanged if they would take too much memory. For a soup
        (triangles that have few edges in common) these are cells of triangles. Otherwise, and if a
        soup's cells take too much memory, they are cells of singular edges, which are built for
        tracing only.

        data: the mesh on a backend.
        choice: the choice of cells.
        traced: whether the data are for tracing rays, and not for values at points.
        """
        mesh, winding = self.mesh, data.winding
        extent = self.extent((self.default_level,))
        assert extent is not None  # for the type: there always is an extent
        low, high = extent.bounds()
        if self._is_soup and isinstance(winding, TreeWinding):
            # Half the side of the cube around the origin of the unit coordinates that contains the
            # extent. The cells fill a cube of the whole side, enlarged by 0.1 % (`_CUBE_FACTOR`).
            reach = float(np.maximum(high - mesh.center, mesh.center - low).max()) / mesh.size
            half = _CUBE_FACTOR * reach
            cells = self.built_cells(
                data.backend, choice, lambda: winding.build_cells(mesh, half, choice.max_bytes)
            )
            if cells is not None:
                return dataclasses.replace(data, winding=dataclasses.replace(winding, cells=cells))
        if not traced:
            return data
        cells = BoundaryCells.build(
            data.rays, mesh, low, high, choice.max_bytes, self._center_values
        )
        return dataclasses.replace(data, cells=cells)

    @property
    def _is_soup(self) -> bool:
        """Whether triangles have so few edges in common that FMM cells sum over near triangles, and
        not over near edges. Only for the method "tree"."""
        edges, triangles = len(self.mesh.singular_edges), len(self.mesh.triangles)
        return self.method == "tree" and edges > _SOUP_RATIO * triangles

    def _center_values(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """w at the centers (n, 3) of FMM cells, and proved bounds (n,) of its error. For the exact
        method the sum is computed in double precision, at points that are many roundings of single
        precision off the triangles; so its rounding is far below the bound."""
        is_exact = self.method == "exact"

        def kernel(backend: Backend, x: Vec3) -> tuple[Any, ...]:
            """w at the Dr.Jit points x, without FMM cells; by a tree with a bound of its error."""
            data = self._upload(backend, traced=False, cells=NO_CELLS)
            values = self._values_from(data, x, 0, 1.0)
            return (values.value,) if is_exact else (values.value, values.error)

        value, *error = evaluate_points(points, kernel, "double")
        value = np.array(value)
        return value, np.full(len(value), _EXACT_ERROR) if is_exact else error[0]

    def cells_pay_from(self) -> float:
        """The smallest number of rays for which FMM cells save more time than it takes to build
        them; infinite if they never do. A soup (`_is_soup`) has cells of triangles, another mesh
        cells of singular edges."""
        edges, triangles = len(self.mesh.singular_edges), len(self.mesh.triangles)
        if self._is_soup:
            is_small = triangles <= _MOST_OF_SOUP
            return max(_MIN_RAYS, _PAYS_PER_TRIANGLE * triangles) if is_small else math.inf
        saves_time = _MIN_CELL_EDGES <= edges <= _MAX_CELL_EDGES
        return max(_MIN_RAYS, _PAYS_PER_EDGE * edges) if saves_time else math.inf

    def occupied_cells_of(self, plan: Plan) -> OccupancyGrid | None:
        """A grid over the extent, computed once for the levels of a plan. A cell is empty if w
        modulo 1 is proved to take none of the levels in it (`winding_cells`); rays then sample w
        there only where they cross triangles. None in three cases: the mesh has few singular edges;
        the surface is the mesh itself; or the method is "tree" and there are no FMM cells for this
        number of rays."""
        cells, levels = self.cell_choice(plan.ray_count), plan.levels
        is_small = len(self.mesh.singular_edges) < _MIN_CELL_EDGES
        if is_small or self.is_whole_surface(levels) or (self.method != "exact" and not cells):
            return None
        extent = self.extent(levels)
        if extent is None:  # only for the type: there always is an extent
            return None
        return self._occupied.get_or_make(
            (cells, levels), lambda: winding_cells(self, cells, extent, levels)
        )

    def is_whole_surface(self, levels: tuple[float, ...]) -> bool:
        """Whether the surface of these levels is the mesh itself, all triangles and nothing else,
        because the mesh lies on its own level set (`own_sheet`). It is computed once. It is False
        for several levels."""
        if len(levels) != 1:
            return False
        return self._own_levels.get_or_make(levels, lambda: lies_on_own_level(self.mesh, levels[0]))

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for level 0, the value of w outside a closed mesh, which is no
        surface."""
        for level in levels:
            if abs(level) < 1e-6:
                raise ValueError("level 0 of a winding number is no surface; try 0.5")

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that is proved to contain the level sets: all triangles, and the cells around
        them that are not proved empty (`winding_extent`). It is computed once for these levels, and
        is never None."""
        return self._extents.get_or_make(levels, lambda: winding_extent(self, levels))

    def describe(self) -> dict[str, Any]:
        """Facts about the field for users, as a dictionary of names and values: the numbers of
        triangles and singular edges, the method, and the FMM cells."""
        mesh = self.mesh
        return {
            "triangles": len(mesh.triangles),
            "singular edges": len(mesh.singular_edges),
            "method": self.method,
            **({"corners joined by rounding": mesh.rounded} if mesh.rounded else {}),
            **self.describe_cell_option(),
        }


class WindingEvaluator(BatchedEvaluator):
    """The evaluator of a winding number w.

    jumps: the triangles, across which w jumps.
    modulo_one: how w is sampled up to an unknown integer, by FMM cells of edges; None if there are
        none.
    """

    def __init__(
        self,
        field: WindingNumber,
        data: WindingData,
        cells: CellChoice,
        level_of_sheets: float | None,
        plan: Plan,
    ) -> None:
        """field: the winding number. data: the mesh on the backend. cells: the FMM cells that it
        has. level_of_sheets: the level that w takes at the triangles and nowhere else, if the mesh
        is the whole surface of this level (`own_sheet`); otherwise None. plan: what the evaluator
        will be used for."""
        self.field, self.data, self._cells, self._plan = field, data, cells, plan
        self.jumps = _TriangleJumps(field, data, cells, level_of_sheets)
        self.modulo_one = None if data.cells is None else _CellSamples(data)

    def evaluate(self, p: Vec3) -> Sample:
        """A sample of w itself at points p, jumps included: value, gradient, errors and proved
        bounds near p. The bounds hold for the smooth continuation of w through all triangles."""
        data = self.data
        frame = data.upward_rays(p)
        return _sample_at_start(data, frame, data.winding.crossings_ahead(frame, 0, True), 1.0)

    def occupied_cells(self) -> OccupancyGrid | None:
        return self.field.occupied_cells_of(self._plan)

    def describe(self) -> dict[str, Any]:
        """The facts of `WindingNumber.describe`, with the number and the memory of the FMM cells
        that were built."""
        return self.field.describe() | self._cells.describe(self.data.built)


# Capabilities of a winding number as objects (`fields.capabilities`).


class _TriangleJumps(Jumps):
    """The triangles of a mesh, across which its winding number w jumps by an integer.

    field: the winding number.
    data: the mesh on a backend, in unit coordinates.
    cells: the FMM cells that it has.
    level: if the mesh is the whole surface (`own_sheet`), the level that w takes at the triangles
        and nowhere else; otherwise None.
    """

    def __init__(
        self, field: WindingNumber, data: WindingData, cells: CellChoice, level: float | None
    ) -> None:
        """field: the winding number. data: the mesh on a backend. cells: the FMM cells that it has.
        level: the level that w takes at the triangles and nowhere else, if the mesh is the whole
        surface; otherwise None."""
        self.field, self.data, self.cells, self.level = field, data, cells, level
        self.takes_all_levels = level is not None

    def next_crossing(
        self, o: Vec3, d: Vec3, after: JumpCrossing, t_max: Real, active: Mask
    ) -> JumpCrossing:
        """The next crossing of each ray o + t d with a triangle, after the crossing `after` and up
        to t = t_max, with the jump of w there along the ray. active: the mask of the lanes to
        compute."""
        data = self.data
        frame = RayFrame.along(data.backend, data.to_unit(o), d)
        behind = (after.t / data.size, after.facet)
        t, facet, sign, normal = data.rays.next_crossing(frame, behind, t_max / data.size, active)
        # w is larger on the side opposite to the normal.
        return JumpCrossing(t * data.size, facet, -sign, -normal)

    def initial_offset(self, o: Vec3, d: Vec3, t_min: Real, active: Mask) -> Real:
        """The signed number of triangles that each ray o + t d crosses beyond t_min: the number
        from which the exact method follows w along the ray. It is 0 for the tree, which needs no
        such number, and if the surface is the mesh itself."""
        data = self.data
        if self.takes_all_levels:
            return data.backend.Float(0)
        frame = RayFrame.along(data.backend, data.to_unit(o), d)
        return data.winding.crossings_ahead(frame, t_min / data.size, active)

    def continuation(
        self, o: Vec3, d: Vec3, behind: JumpCrossing, ahead: JumpCrossing, offset: Real
    ) -> Evaluator:
        """The winding number w on each ray o + t d between the crossings `behind` and `ahead` with
        triangles, as an evaluator without jumps. offset: the signed number of all crossings beyond
        `behind` on the ray."""
        data = self.data
        if self.level is not None:
            return _BesideSheets(data.backend, self.level, behind, ahead)
        frame = RayFrame.along(data.backend, data.to_unit(o), d)
        start = JumpCrossing(behind.t / data.size, behind.facet, behind.jump, behind.normal)
        return _WindingOnInterval(data, frame, start, offset)

    def distance(self, p: Vec3) -> Real:
        """A lower bound of the distance from p to the triangles, at which w jumps."""
        data = self.data
        return distance_lower_bound(data.rays, data.to_unit(p)) * data.size

    def nearest_facet(
        self, p: Vec3, after: tuple[Real, Any], limit: Real, active: Mask
    ) -> NearestFacet:
        """The next triangle in the order of distance from p, after the triangle given by `after`,
        within the distance `limit`. Called repeatedly, it lists the triangles by distance.

        after: the squared distance and the index of the previous triangle.
        """
        data = self.data
        # data.rays is the tree of triangles.
        facet = next_closest_triangle(
            data.rays, data.to_unit(p), after, dr.square(limit / data.size), active
        )
        # Triangles without an area get an arbitrary normal, and count as having no inner points.
        length = dr.norm(facet.normal)
        up = data.backend.Array3f(0, 0, 1)
        normal = dr.select(length > 0, facet.normal / length, up)
        is_inner = facet.is_inner & (length > 0)
        return NearestFacet(
            facet.squared_distance, facet.triangle, facet.offset * data.size, normal, is_inner
        )

    def moving_triangles(self) -> MovingTriangles:
        """The triangles between the user's vertices, which may have derivatives."""
        mesh, backend = self.field.mesh, self.data.backend
        # The vertices of input faces: those of `mesh.faces` may stand for several of the user's.
        faces = mesh.input_faces[mesh.input_face]
        a, b, c = (upload_integers(backend, faces[:, k]) for k in range(3))
        return MovingTriangles(self.field.moving_vertices(backend), (a, b, c))

    def mesh(self) -> tuple[FloatArray, IntArray, bool] | None:
        """The mesh at which w jumps: vertices (n, 3), triangles (k, 3), and whether the mesh is
        closed. It is never None here."""
        return (
            self.field.mesh.vertices,
            self.field.mesh.triangles,
            not len(self.field.mesh.singular_edges),
        )

    def smooth_field(self) -> Field | None:
        """The winding number modulo 1, which is continuous across triangles; never None here."""
        return WindingModuloOne(self.field.detached, self.cells)

    def are_whole_surface(self, levels: tuple[float, ...]) -> bool:
        """Whether the surface of these levels is the mesh itself."""
        return self.field.is_whole_surface(levels)


class _CellSamples(ModuloOne):
    """Samples of a winding number w from FMM cells, up to an unknown integer.

    data: the mesh and its FMM cells of edges on a backend.
    """

    def __init__(self, data: WindingData) -> None:
        """data: the mesh and its FMM cells of edges on a backend."""
        self.data = data

    @property
    def sure_accuracy(self) -> float:
        """The smallest accuracy scale at which samples give w with its integer."""
        return self.data.winding.coarsest_accuracy

    def evaluate(self, p: Vec3) -> Sample:
        """A coarsest sample of w minus an unknown integer at points p."""
        return self.data.sample_modulo_one(p)

    def value_if_cheap(self, p: Vec3, rounding: Real, active: Mask) -> Real:
        """w at points p, with its integer, on active lanes on which the FMM cell that contains p
        determines it; NaN on all other lanes. rounding: a bound of the rounding of a coordinate of
        p."""
        data = self.data
        if data.cells is None:
            return data.backend.Float(dr.nan)
        x = data.to_unit(p)
        return data.cells.value_where_known(
            x, fmax(coordinate_rounding(x), rounding / data.size), active
        )


@dataclass(frozen=True)
class WindingData(UnitFrame):
    """The mesh of a winding number w on a backend, in unit coordinates.

    winding: the object that evaluates w, exactly or by a tree.
    rays: a tree of the triangles, for crossings with rays and for distances.
    cells: the FMM cells of edges; None if there are none.
    """

    winding: ExactWinding | TreeWinding
    rays: TriangleTree
    cells: BoundaryCells | None = None

    @property
    def built(self) -> BuiltCells | None:
        """The FMM cells that were built, of edges or of triangles; None if there are none."""
        if self.cells is None and isinstance(self.winding, TreeWinding):
            return self.winding.cells
        return self.cells

    def upward_rays(self, p: Vec3) -> RayFrame:
        """Rays from the points p along z, in unit coordinates. With an exact method their crossings
        with triangles give the integer part of w."""
        return RayFrame.along(self.backend, self.to_unit(p), self.backend.Array3f(0, 0, 1))

    def sample_modulo_one(self, p: Vec3, detail: Real = 0.0) -> Sample:
        """A sample of w minus an unknown integer at points p: value, gradient, errors and proved
        bounds of w near p. The integer may differ from point to point.

        detail: the accuracy scale; larger is more accurate. At 0, the default, the sample comes
            from an FMM cell of edges where there is one.
        """
        frame, detail = self.upward_rays(p), self.backend.Float(detail)
        if self.cells is None:
            return _sample_at_start(self, frame, self.backend.Float(0), detail)
        # None: no direction of a ray. The last argument is the mask of the lanes to compute.
        from_cells, is_in_cell = self.cells.sample(
            frame.o, None, coordinate_rounding(frame.o), detail <= 0
        )
        # The number of crossings ahead is an integer, so that 0 may stand for it.
        from_all = _sample_at_start(self, frame, self.backend.Float(0), detail, ~is_in_cell)
        return from_all.select(is_in_cell, space_scaled(from_cells, self.size))


def _sample_at_start(
    data: WindingData, frame: RayFrame, turns: Real, detail: Real, active: Mask = True
) -> Sample:
    """A sample of w at the origins of rays, on active lanes, in the user's units. It has proved
    bounds near the origins, but none along the rays.

    data: the mesh on a backend.
    frame: the rays, in unit coordinates.
    turns: the signed number of triangles that each ray crosses, or 0 for w up to an integer; only
        the exact method uses it.
    detail: the accuracy scale; larger is more accurate.
    """
    # A crossing at t = 0 with no triangle: all crossings at t > 0 are ahead of it.
    start = JumpCrossing(0.0, data.backend.UInt32(NO_FACET), 0.0, data.backend.Array3f(0, 0, 1))
    detail = data.backend.Float(detail)
    sample = data.winding.sample_interval(frame, frame.o, start, turns, detail, active)
    return space_scaled(dataclasses.replace(sample, ray_promises=()), data.size)


class _WindingOnInterval(Evaluator):
    """The winding number w of a mesh on an interval of each ray, between two crossings of
    triangles, continued smoothly to both ends. A crossing is a point at which the ray passes
    through a triangle.

    on: the mesh on a backend.
    frame: the rays, in unit coordinates.
    behind: the crossing at the start of the interval, with its position in unit coordinates.
    offset: the signed number of crossings beyond the start; only the exact method uses it.
    detail: the accuracy scale; larger is more accurate.
    """

    def __init__(
        self,
        on: WindingData,
        frame: RayFrame,
        behind: JumpCrossing,
        offset: Real,
        detail: Real = 1.0,
    ) -> None:
        """on: the mesh on a backend. frame: the rays, in unit coordinates. behind: the crossing at
        the start of the interval, in unit coordinates. offset: the signed number of crossings
        beyond the start; only the exact method uses it. detail: the accuracy scale; larger is more
        accurate."""
        self._on, self._frame, self._detail = on, frame, on.backend.Float(detail)
        self._behind, self._offset = behind, offset
        has_cells = on.cells is not None
        if on.winding.has_detail or has_cells:
            # If there are FMM cells of edges, coarse samples may give w only up to an unknown
            # integer.
            at = functools.partial(_WindingOnInterval, on, frame, behind, offset)
            self.variable_accuracy: VariableAccuracy | None = VariableAccuracy(
                at, on.winding.coarsest_accuracy, has_cells
            )

    def evaluate(self, p: Vec3) -> Sample:
        """A sample of w at points p of the interval. On lanes on which it comes from an FMM cell of
        edges, it is w up to an unknown integer, and marked as such (`branch_unknown`)."""
        data, frame = self._on, self._frame
        x, detail = data.to_unit(p), self._detail
        if data.cells is None:
            sample = data.winding.sample_interval(frame, x, self._behind, self._offset, detail)
            return space_scaled(sample, data.size)
        unit = fmax(coordinate_rounding(frame.o), coordinate_rounding(x))
        # Samples from cells leave an integer unknown. So they count as coarser than all others, and
        # serve only accuracy scales below the coarsest one.
        from_cells, is_in_cell = data.cells.sample(
            x, frame.d, unit, detail < data.winding.coarsest_accuracy
        )
        sample = data.winding.sample_interval(
            frame, x, self._behind, self._offset, detail, ~is_in_cell
        )
        sample = dataclasses.replace(
            sample.select(is_in_cell, from_cells), branch_unknown=is_in_cell
        )
        return space_scaled(sample, data.size)


class _BesideSheets(Evaluator):
    """The function on an interval of each ray between two crossings of a mesh that lies on its own
    level set (`own_sheet`), so that its triangles are the whole surface. On the interval it is
    constant: the level plus 1/2 or minus 1/2. The sign is such that the jump at the triangle
    ahead passes the level. If no triangle is ahead, the jump at the triangle behind decides.

    level: the level of the surface.
    behind, ahead: the crossings at the ends of the interval.
    """

    def __init__(
        self, backend: Backend, level: float, behind: JumpCrossing, ahead: JumpCrossing
    ) -> None:
        """backend: that of the crossings. level: the level of the surface. behind, ahead: the
        crossings at the ends of the interval."""
        real = backend.Float
        # A positive jump ahead leads up through the level, so that the function is below it before.
        # After a positive jump behind the function is above it. A jump of 0 means that there is no
        # triangle.
        jump = dr.select(real(ahead.jump) != 0, -real(ahead.jump), real(behind.jump))
        self._value = dr.select(jump > 0, real(level + 0.5), level - 0.5)

    def evaluate(self, p: Vec3) -> Sample:
        """The sample of the constant at points p of the interval."""
        return Sample(self._value, 0 * p, (Lipschitz(0.0),), 0.0)
