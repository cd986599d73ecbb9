"""Meshes of solids: closed meshes of level sets, cut by volumes and combined by the Boolean
operations union, intersection and complement. A solid is the set of points where its function is at
most a level, written {solid <= level}. The operands of a Boolean operation are the solids that it
combines. An operand is meshed on its own, as a solid of the library manifold3d (class `Manifold`),
which does the Boolean operations. A wall is the set {|g| <= w} of a field g.

A wall is not meshed as the level set {|g| = w}, which marching cubes breaks into hundreds of pieces
if cells are thicker than the wall. It is meshed as {g <= w} minus {g <= -w}, with two smooth
surfaces that do not meet, in a box a little larger than the volume that cuts it. Likewise unions,
intersections and complements are made of the meshes of their operands, so that the creases where
operands meet are edges of the mesh. Creases of a single function, such as a cylinder's, are
chamfered within the tolerance.

Offsets of meshes are meshed differently, without moving vertices and refining triangles: they have
creases everywhere, beside which moved and refined triangles would intersect each other. Their cells
are small, and manifold3d merges coplanar triangles afterwards. If a few triangles of the whole mesh
are still too far from the level set, these are cut (`outlier_projection`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, cast

import numpy as np

from harnack.backend import FloatArray
from harnack.backend.validation import as_finite
from harnack.fields import Field, Solid
from harnack.fields.clearance import bounded_side_extent
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solids.booleans import BooleanSolid, Complement, OffsetSolid
from harnack.fields.solids.extrusions import Extrusion, SolidOfRevolution
from harnack.fields.solids.from_field import BandSolid, SublevelSolid
from harnack.fields.solids.from_field import solid as solid_of
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.fields.solids.primitives import Cuboid, Cylinder, Plane, Sphere
from harnack.fields.solids.round_cones import Capsule, RoundCone
from harnack.fields.solids.struts import Struts
from harnack.fields.solids.thread import Thread
from harnack.fields.solids.transforms import TransformedSolid
from harnack.fields.solids.tube import Tube
from harnack.geometry import Ball, Box, Volume, VolumeIntersection
from harnack.meshing.bcc_lattice import BccLattice
from harnack.meshing.checks import check_manifold
from harnack.meshing.clipping import snap_to_box
from harnack.meshing.closed_mesh import (
    ball_manifold,
    box_manifold,
    cylinder_manifold,
    extruded_manifold,
    from_manifold,
    mesh_manifold,
    revolved_manifold,
    to_manifold,
    volume_manifold,
    without_short_edges,
)
from harnack.meshing.components import drop_degenerate_components
from harnack.meshing.csg_rewrite import drop_cancelled_operands, factor_common_operands, flatten_csg
from harnack.meshing.lattice_meshing import (
    IrrelevantRegion,
    MissedPartsError,
    mesh_closed_surface,
    split_faces_off_level,
)
from harnack.meshing.level_function import (
    CELLS_PER_WAVE,
    LevelFunction,
    LevelSamples,
)
from harnack.meshing.meshing_errors import (
    CELL_SIZE_RATIO,
    LocalizedMeshingError,
    MeshingError,
    OffLevelError,
    SelfIntersectionError,
    TriangleLimitError,
    is_retry_promising,
)
from harnack.meshing.outlier_projection import project_outliers
from harnack.meshing.self_intersection_repair import resolve_self_intersections
from harnack.meshing.strut_mesh import strut_manifold
from harnack.meshing.thread_mesh import thread_manifold
from harnack.meshing.triangle_mesh import TriangleMesh
from harnack.meshing.tube_mesh import tube_manifold
from harnack.name_suggestions import with_article
from harnack.tracer.traced_surface import CallCache

if TYPE_CHECKING:
    from manifold3d import Manifold

    from harnack.meshing.mesh_tolerance import MeshTolerance

__all__ = [
    "AngleMesher",
    "CsgMesher",
    "SolidMeshResult",
    "apart_of",
    "is_single_level_set",
    "mesh_solid",
    "solid_and_level",
    "solid_size",
    "solid_value_range",
]

# For offsets of meshes: the size of cells, in tolerances; and the number of steps of the secant
# method that find the level on an edge of a cell.
_OFFSET_CELLS, _SECANT_STEPS = 6.0, 2
# In lattices of at least this many cells, the cells in which the other operands of an intersection
# leave nothing are left out from the start.
_MANY_CELLS = 100_000
# How far surfaces of offsets may be moved, in tolerances. First by merging coplanar triangles:
# these lengths are tried in turn until crossing triangles can be moved apart. Then by moving them
# apart.
_MERGED_WITHIN, _MENDED_WITHIN = (0.5, 0.25, 0.1), 0.5
# Triangles of offsets are cut in three if their centers are farther from the level set than the
# first, in tolerances; the second is how many times that is repeated.
_FAR_OFF, _SPLITS = 1.8, 2

# Meshes a level set of a solid angle, which ends at the boundary curve: takes the field and the
# level, and returns the mesh.
AngleMesher = Callable[[SolidAngle, float], TriangleMesh]


IntersectedOperands: TypeAlias = tuple[tuple[Solid, float], ...]
"""Pairs (solid, level): sets {solid <= level} with which the meshed solid will be intersected. In a
region in which one of these sets is proved to have no points, nothing need be meshed.

Which sets they are, in a tree of unions, intersections and complements: outside of complements, the
operands of all intersections around the meshed solid. Inside a complement that is an operand of an
intersection, only those operands of this intersection that contain no complements.

Proof that the mesh of the whole tree is correct. "Omitted" means: not meshed, and so left empty.
(1) Let nothing inside complements be omitted. Unions and intersections of smaller sets are smaller,
so the mesh of every node of the tree is a subset of its true solid. At a point where something is
omitted, an operand of an intersection around it truly has no points. So its mesh has none, and
neither has the mesh of the intersection, which is correct. (2) Now let parts inside complements be
omitted too. Where something is omitted, the intersection around the complement has an operand that
contains no complements and truly has no points there. By (1) its mesh has none, so the mesh of the
intersection is correct there as well.
"""


@dataclass
class CsgMesher:
    """Meshes solids and their Boolean combinations in the box from `lower` to `upper`, (3,) each.
    It goes down the tree of operands, meshes the level set of each leaf in a lattice of cells, and
    combines the results. The attributes from `evaluations` to `smallest_cell` count what was done
    so far. `intersected_with` are solids with which the meshed one will be intersected, so that
    nothing need be meshed where one of them has no points.

    tolerance: a length, the largest distance of midpoints of edges and centers of faces from the
        surface.
    spacing: the largest size of cells.
    per_wave: the smallest number of cells along a wave (`Traits.min_wavelength`); None for no such
        limit.
    mesh_angle: meshes a level set of a `SolidAngle`; the mesh ends at the field's boundary curve.
    most_faces: the largest number of triangles of each level set.
    report: receives messages about the progress.
    evaluations: the number of points at which fields were evaluated.
    levels: the number of level sets.
    smallest_cell: the smallest size of cells used for them.
    uploads: the fields' data on the device, kept for further level sets of the same fields.
    intersected_with: solids, each with a level, with which everything that is meshed next will be
        intersected. Where one of the sets {solid <= level} has no points, nothing need be meshed
        (`IntersectedOperands`).
    irrelevant_region_cache: the value of `intersected_with` for which a region was computed last;
        and this region, in which one of these solids has no points.
    """

    lower: FloatArray
    upper: FloatArray
    tolerance: float
    spacing: float
    per_wave: float | None
    mesh_angle: AngleMesher
    most_faces: int
    report: Callable[[str], None]
    evaluations: int = 0
    levels: int = 0
    smallest_cell: float = math.inf
    uploads: CallCache = dataclasses.field(default_factory=CallCache)
    intersected_with: IntersectedOperands = ()
    irrelevant_region_cache: tuple[IntersectedOperands, IrrelevantRegion] | None = None

    def mesh_sublevel(self, solid: Solid, level: float) -> Manifold:
        """Mesh the set {solid <= level} in the box: the points where the solid's function is at
        most `level`. Each kind of solid has its own method; a solid without one is meshed as a
        level set. Returns a manifold3d solid, which has no meaning outside of the box.

        Raises:
            MeshingError: the solid or one of its operands cannot be meshed.
        """
        # A method returns None for a solid that is to be meshed as a level set.
        for kind, method in self.methods.items():
            manifold = method(self, solid, level) if isinstance(solid, kind) else None
            if manifold is not None:
                return manifold
        # [0]: the mesh.
        return to_manifold(self.mesh_smooth_level(solid, level)[0])

    def _mesh_boolean(self, solid: BooleanSolid, level: float) -> Manifold:
        """Mesh the set {solid <= level} for a union or an intersection, after common operands were
        factored out and operands that cancel were dropped."""
        from manifold3d import Manifold

        factored = factor_common_operands(solid, level) if solid.is_union else None
        if factored is not None:
            return self.mesh_sublevel(factored, 0.0)  # its level is 0
        reduced = drop_cancelled_operands(flatten_csg(solid), level)
        return Manifold() if reduced is None else self._combine_operands(reduced, level)

    def _mesh_box(self, box: Cuboid, level: float) -> Manifold | None:
        """Mesh the set {box <= level} if its edges are sharp; None if they are round. A box shrunk
        by -level keeps its sharp edges; a box that grows gets round ones."""
        from manifold3d import Manifold

        if box.radius != 0 or level > 0:
            return None
        half = 0.5 * np.array(box.sides) + level
        return box_manifold(-half, half) if (half > 0).all() else Manifold()

    def _combine_operands(self, solid: BooleanSolid, level: float) -> Manifold:
        """Mesh the set {solid <= level} for a union or an intersection: its operands are meshed and
        combined by manifold3d. If an operand of an intersection is a complement ~Q, it is not
        meshed; Q is meshed and cut away. If all operands are complements, the solids Q are cut from
        the whole box."""
        from manifold3d import Manifold, OpType

        indices = range(len(solid.parts))
        if solid.is_union:
            return Manifold.batch_boolean(
                [self._mesh_operand(solid, k, level) for k in indices], OpType.Add
            )
        complements = [k for k in indices if isinstance(solid.parts[k], Complement)]
        parts = [self._mesh_operand(solid, k, level) for k in indices if k not in complements]
        common = Manifold.batch_boolean(parts, OpType.Intersect) if parts else self._whole_box()
        cut_away = [self._mesh_operand(solid, k, level) for k in complements]
        return Manifold.batch_boolean([common, *cut_away], OpType.Subtract)

    def _mesh_operand(self, solid: BooleanSolid, number: int, level: float) -> Manifold:
        """Mesh the set {operand <= level} for one operand of a union or an intersection. If the
        operand of an intersection is a complement ~Q, mesh Q instead. While an operand of an
        intersection is meshed, `intersected_with` holds the other operands. So the operand is
        meshed only where these leave something of it (`IntersectedOperands`).

        solid: the union or intersection.
        number: the index of the operand.
        """
        previous, part = self.intersected_with, solid.parts[number]
        if not solid.is_union:
            others = [operand for operand in solid.parts if operand is not part]
            if isinstance(part, Complement):
                # Inside of a complement only these operands count, and none of the operations
                # around this one (the second part of the proof at `IntersectedOperands`).
                self.intersected_with = tuple(
                    (operand, level) for operand in others if _is_complement_free(operand)
                )
                part, level = part.field, -level
            else:
                self.intersected_with = (*previous, *((operand, level) for operand in others))
        try:
            if isinstance(part, Sphere):
                return self._mesh_ball(part, level)
            return self.mesh_sublevel(part, level)
        finally:
            self.intersected_with = previous

    def _mesh_ball(self, sphere: Sphere, level: float) -> Manifold:
        """Mesh the set {sphere <= level} as an operand: of a union of many spheres, level sets in
        cells would take most of the time. A sphere that is meshed alone has cells, and so the size
        of triangles that was asked for. Vertices lie on the sphere, so that spheres that touch from
        outside do not overlap."""
        from manifold3d import Manifold

        radius = sphere.radius + level
        return (
            ball_manifold(Ball(sphere.center, radius), self.tolerance) if radius > 0 else Manifold()
        )

    def _mesh_struts(self, struts: Struts, level: float) -> Manifold:
        """Mesh the set {struts <= level}."""
        return strut_manifold(struts, level, self.tolerance, self.most_faces)

    def _mesh_level_set(self, function: LevelFunction, lattice: BccLattice) -> TriangleMesh:
        """Mesh the level set of `function` in the cells of `lattice`; returns a closed mesh.

        If there are many cells, cells in which the solids `intersected_with` are proved to leave
        nothing are left out. If there are few cells, all are meshed, so that copies of a surface
        are the same bit by bit. If meshing all cells fails, cells are left out as well: in these
        cells a function may jump, as the angle about an axis does, or have no finite value.

        Raises:
            MeshingError: the level set cannot be meshed.
        """
        region: IrrelevantRegion | None = None
        if math.prod(lattice.counts.tolist()) < _MANY_CELLS:
            try:
                return mesh_closed_surface(function, lattice, self.tolerance, self.report)
            except MeshingError as error:
                region = self._empty_region()
                if region is None:
                    raise
                self.report(f"{error}; so only where the other parts leave something")
        return mesh_closed_surface(
            function,
            lattice,
            self.tolerance,
            self.report,
            elsewhere=region or self._empty_region(),
        )

    def _empty_region(self) -> IrrelevantRegion | None:
        """The region in which one of the solids `intersected_with` is proved to have no points, so
        that nothing need be meshed there; None if there are no such solids. It is computed once as
        long as `intersected_with` is the same object, as for the two sides of a wall."""
        if not self.intersected_with:
            return None
        if (
            self.irrelevant_region_cache is not None
            and self.irrelevant_region_cache[0] is self.intersected_with
        ):
            return self.irrelevant_region_cache[1]
        functions = [self.function(solid, level) for solid, level in self.intersected_with]

        def clearance(points: FloatArray) -> FloatArray:
            """(n,) for each of the points (n, 3) the radius of a ball about it in which one of the
            solids is proved to have no points; 0 if no such ball is known."""
            radii = np.zeros(len(points))
            for solid in functions:
                outside = np.flatnonzero(solid.values(points) > 0)
                radii[outside] = np.maximum(radii[outside], solid.clearance(points[outside]))
            return radii

        region = IrrelevantRegion(clearance)
        self.irrelevant_region_cache = self.intersected_with, region
        return region

    def mesh_smooth_level(self, field: Field, level: float) -> tuple[TriangleMesh, bool]:
        """Mesh the boundary of the set {field <= level} in the box as one level set. The cells fill
        only the part of the box that may hold the set.

        Returns the closed mesh; and whether the set is known to lie in the box. If not, the mesh is
        closed at or outside of the faces of the box by triangles that have no meaning.
        """
        hull = _finite_extent(field, level)
        lower, upper = self.lower, self.upper
        is_whole = False
        if hull is not None:
            low, high = hull.bounds()
            is_whole = bool((low >= lower).all() and (high <= upper).all())
            lower, upper = np.maximum(lower, low), np.minimum(upper, high)
            if not (lower < upper).all():
                return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64)), is_whole
        size = float((upper - lower).max())
        # At least eight cells along the longest side.
        spacing = min(self.spacing, size / 8)
        if self.per_wave is not None and field.traits.min_wavelength is not None:
            spacing = min(spacing, field.traits.min_wavelength / self.per_wave)
        self.smallest_cell = min(self.smallest_cell, spacing)
        function = self.function(_underlying_field(field), level)
        self.report(f"level {level:g} of {type(field).__name__} in cells of {spacing:.3g}")
        lattice = BccLattice.covering_box(lower, upper, spacing, layers=2)
        surface = self._mesh_level_set(function, lattice)
        self.evaluations += function.evaluations
        self.levels += 1
        return surface, is_whole

    def function(self, field: Field, level: float) -> LevelFunction:
        """The function field - level. Outside of the field's domain it has the value of the closest
        point of the domain."""
        return _DomainExtendedFunction(
            field, level, most_faces=self.most_faces, uploads=self.uploads
        )

    def _whole_box(self) -> Manifold:
        """A box that is a little larger than the meshed one. It stands for all of space."""
        pad = 1e-3 * (self.upper - self.lower)
        return box_manifold(self.lower - pad, self.upper + pad)

    def _mesh_wall(self, wall: BandSolid, level: float) -> Manifold:
        """Mesh a wall: the points where its field g satisfies |g - wall.level| <= wall.half_width +
        level. For a field without a period it is the difference of two sublevel sets; for a solid
        angle it lies between two level sets with a common boundary curve.

        Raises:
            MeshingError: g is the function of a plain field, no solid, and the wall is thinner than
                twice the tolerance; or g has a period and is no solid angle.
        """
        from manifold3d import Manifold

        half = wall.half_width + level
        if half <= 0:
            return Manifold()
        low, high = wall.level - half, wall.level + half
        field = wall.field
        if field.period is None:
            inside = SublevelSolid(field)
            # The estimate of the thickness is for plain fields. A wall about the surface of a solid
            # is only checked as every mesh is, after its parts were put together.
            if not isinstance(field, Solid):
                self._check_wall_thickness(field, low, high)
            return self.mesh_sublevel(inside, high) - self.mesh_sublevel(inside, low)
        # The wall contains all values of the field.
        if 2 * half >= field.period:
            return self._whole_box()
        if not isinstance(field, SolidAngle):
            raise MeshingError(
                f"a solid around a level of {type(field).__name__}, which is angle-valued, cannot "
                "be meshed: only those of a SolidAngle"
            )
        return to_manifold(self._between_angle_levels(field, low, high))

    def _check_wall_thickness(self, field: Field, low: float, high: float) -> None:
        """Raise MeshingError if the wall {low <= field <= high} is thinner than twice the
        tolerance, since the meshes of its two sides would meet. The thickness is estimated as (high
        - low) / s. Here s is the median length of the gradient at the centers of those cells of a
        coarse lattice that are nearest to the wall: half of all cells."""
        lattice = BccLattice.covering_box(
            self.lower, self.upper, float((self.upper - self.lower).max()) / 8
        )
        # The centers of all cells, whose lattice coordinates are odd.
        points = lattice.points(2 * np.argwhere(np.ones(lattice.counts)) + 1)
        middle = 0.5 * (low + high)
        samples = self.function(field, middle).sample(points)
        # The half of the cells that is nearest to the middle of the wall.
        near = samples.distance <= np.median(samples.distance)
        steep = float(np.median(np.linalg.norm(samples.gradient[near], axis=1)))
        self.evaluations += len(points)
        if high - low < 2 * self.tolerance * steep:
            raise MeshingError(
                f"the wall is about {(high - low) / steep:.2g} thick, and its sides are made "
                f"within {self.tolerance:.2g}: choose a smaller `tolerance`, or make the "
                "wall thicker"
            )

    def _between_angle_levels(self, field: SolidAngle, low: float, high: float) -> TriangleMesh:
        """The closed surface around the points where the solid angle lies between `low` and `high`.
        It consists of the surfaces of both levels, which end at the same vertices: those of the
        boundary curve.

        Raises:
            MeshingError: the two surfaces do not end at the same vertices.
        """
        inner, outer = self.mesh_angle(field, low), self.mesh_angle(field, high)
        count = sum(map(len, field.loops))
        if not np.array_equal(inner.vertices[:count], outer.vertices[:count]):
            raise MeshingError("the two sides of the solid do not end at the same curve")
        # The first `count` vertices, those of the curve, are common; other inner vertices come
        # last. The inner surface is turned over, so that all faces look out of the wall.
        index = np.arange(len(inner.vertices)) - count + len(outer.vertices)
        index[:count] = np.arange(count)
        vertices = np.concatenate([outer.vertices, inner.vertices[count:]])
        self.levels += 2
        return TriangleMesh(vertices, np.concatenate([outer.faces, index[inner.faces][:, ::-1]]))

    def _mesh_offset(self, solid: MeshSolid, level: float) -> Manifold:
        """Mesh an offset of a solid that is given by a mesh: the points within the distance `level`
        of it; or, if `level` is negative, its points deeper inside than -level.

        Offsets of meshes have creases wherever the mesh has, too many for cells to be refined
        beside them. So cells are small from the beginning; and since f is a distance, it is linear
        along the edges of cells except at creases. Then triangles that are nearly in a plane are
        merged, triangles across a crease are cut, and triangles that pass through each other are
        moved apart. If the last fails for all lengths of merging, the unmerged mesh is returned.
        Parts thinner than a cell, such as the tip of a knife edge, may be left out: their points
        are less than a cell from the level set.
        """
        lower, upper = (np.array(end) for end in _sublevel_bounds(solid, level))
        if not (lower < upper).all():
            return to_manifold(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64)))
        cell_size = min(self.spacing, _OFFSET_CELLS * self.tolerance)
        self.smallest_cell = min(self.smallest_cell, cell_size)
        function = dataclasses.replace(self.function(solid, level), secant_steps=_SECANT_STEPS)
        self.report(f"level {level:g} of a mesh in cells of {cell_size:.3g}")
        lattice = BccLattice.covering_box(lower - cell_size, upper + cell_size, cell_size, layers=2)
        surface = mesh_closed_surface(function, lattice, self.tolerance, self.report, as_cut=True)
        manifold = to_manifold(surface)
        self.levels += 1
        # If all lengths of merging fail, `surface` stays the unmerged mesh.
        for fraction in _MERGED_WITHIN:
            joined = from_manifold(without_short_edges(manifold, fraction * self.tolerance))
            # Triangles across creases are cut, in at most `_SPLITS` rounds.
            joined = split_faces_off_level(function, joined, _FAR_OFF * self.tolerance, _SPLITS)
            try:
                surface = resolve_self_intersections(joined, _MENDED_WITHIN * self.tolerance)
            except SelfIntersectionError:
                continue
            break
        self.evaluations += function.evaluations
        return to_manifold(surface)

    def _mesh_transformed(self, solid: TransformedSolid, level: float) -> Manifold | None:
        """Mesh the set {solid <= level} for a solid under an affine map; None if the original solid
        is meshed as one level set, since then the mapped solid can be. The original solid is meshed
        in the box around the preimage of this box, with a smaller tolerance if the map stretches;
        its mesh is then mapped."""
        if is_single_level_set(solid.field):
            return None
        matrix, offset = np.array(solid.map.matrix), np.array(solid.map.translation_vector)
        # The eight corners of this box.
        ends = np.stack([self.lower, self.upper])
        corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)
        # The box around the preimage of this box. The map stretches lengths by at most `scale`.
        local_corners = (corners - offset) @ solid.map.inverse.T
        scale = float(np.linalg.norm(matrix, 2))
        local = dataclasses.replace(
            self,
            lower=local_corners.min(axis=0),
            upper=local_corners.max(axis=0),
            tolerance=self.tolerance / scale,
            spacing=self.spacing / scale,
            evaluations=0,
            levels=0,
            smallest_cell=math.inf,
            intersected_with=(),
        )
        # The transformed function is value_factor times the original one.
        manifold = local.mesh_sublevel(solid.field, level / solid.map.value_factor)
        self.evaluations += local.evaluations
        self.levels += local.levels
        self.smallest_cell = min(self.smallest_cell, local.smallest_cell * scale)
        return manifold.transform(np.column_stack([matrix, offset]))

    # How solids of each class are meshed if not as one level set. A method returns None if it does
    # not apply to the given solid and level; then the solid is meshed as one level set after all.
    methods: ClassVar[dict[type[Solid], Callable[[CsgMesher, Any, float], Manifold | None]]] = {
        BooleanSolid: _mesh_boolean,
        # -f <= c where f >= -c.
        Complement: lambda self, solid, level: (
            self._whole_box() - self.mesh_sublevel(solid.field, -level)
        ),
        # f - distance <= c where f <= c + distance.
        OffsetSolid: lambda self, solid, level: self.mesh_sublevel(
            solid.field, level + solid.distance
        ),
        BandSolid: _mesh_wall,
        SublevelSolid: lambda self, solid, level: (
            self.mesh_sublevel(solid.field, level) if isinstance(solid.field, Solid) else None
        ),
        TransformedSolid: _mesh_transformed,
        Cuboid: _mesh_box,
        Cylinder: lambda self, solid, level: cylinder_manifold(solid, level, self.tolerance),
        Capsule: lambda self, solid, level: self._mesh_struts(Struts.of([solid]), level),
        RoundCone: lambda self, solid, level: self._mesh_struts(Struts.of([solid]), level),
        Struts: _mesh_struts,
        Extrusion: lambda self, solid, level: (
            extruded_manifold(solid.loops, solid.height, solid.twist, solid.taper, self.tolerance)
            if level == 0
            else None
        ),
        SolidOfRevolution: lambda self, solid, level: (
            revolved_manifold(solid.loops, self.tolerance) if level == 0 else None
        ),
        Thread: lambda self, solid, level: (
            thread_manifold(solid, float(self.lower[2]), float(self.upper[2]), self.tolerance)
            if level == 0
            else None
        ),
        Tube: lambda self, solid, level: tube_manifold(solid, level, self.tolerance),
        MeshSolid: lambda self, solid, level: (
            (mesh_manifold(solid) if level == 0 else None) or self._mesh_offset(solid, level)
        ),
        Plane: lambda self, solid, level: self._whole_box().trim_by_plane(
            tuple(-component for component in solid.normal), -(solid.distance + level)
        ),
    }


def _is_complement_free(solid: Solid) -> bool:
    """Whether neither a solid nor any of its operands is a complement or a wall. (A wall counts
    since it is meshed as a difference.)"""
    if isinstance(solid, BooleanSolid):
        return all(_is_complement_free(operand) for operand in solid.parts)
    if isinstance(solid, TransformedSolid | OffsetSolid):
        return _is_complement_free(solid.field)
    return not isinstance(solid, Complement | BandSolid)


def is_single_level_set(solid: Solid) -> bool:
    """Whether a solid is meshed as one level set. Other solids are meshed by Boolean operations, or
    by a method of their own that makes their sharp edges exact."""
    if isinstance(solid, SublevelSolid):
        return not isinstance(solid.field, Solid) or is_single_level_set(solid.field)
    if isinstance(solid, TransformedSolid):
        return is_single_level_set(solid.field)
    return not isinstance(solid, tuple(CsgMesher.methods))


def _sublevel_bounds(solid: MeshSolid, level: float) -> tuple[FloatArray, FloatArray]:
    """The lower and the upper corner, (3,) each, of a box that contains the set {solid <=
    level}."""
    low, high = cast("Volume", solid.sublevel_extent(level)).bounds()
    return np.array(low), np.array(high)


def _finite_extent(field: Field, level: float) -> Volume | None:
    """A volume with finite bounds that contains {field <= level}; None if no such volume is known.
    The field's own domain does not count, since the set may go on beyond the domain."""
    if isinstance(field, Solid):
        extent = field.sublevel_extent(level)
    else:
        extent = bounded_side_extent(field, (level,), lambda value: value <= level)
    if extent is None or extent == field.domain:
        return None
    if isinstance(field, SublevelSolid) and extent == field.field.domain:
        return None
    low, high = extent.bounds()
    return extent if np.isfinite(low).all() and np.isfinite(high).all() else None


def _underlying_field(field: Field) -> Field:
    """The field that a `SublevelSolid` was made of; any other field itself."""
    return field.field if isinstance(field, SublevelSolid) else field


@dataclass
class _DomainExtendedFunction(LevelFunction):
    """The function field - level, continued beyond the field's domain: outside of the domain it has
    the value of the closest point of the domain.

    Its clearance at a point p, a proved lower bound of p's distance from the level set, is the
    clearance of p's closest point in the domain. Proof: the closest points of two points are no
    farther from each other than the two points are. So if p is near a point of the level set, p's
    closest point is at least as near to that point's closest point, which has the same value.
    """

    def sample(self, points: FloatArray) -> LevelSamples:
        """Samples (value and gradient) at the closest points of the domain."""
        return super().sample(self._closest(points))

    def values(self, points: FloatArray) -> FloatArray:
        """The values (n,) at the closest points of the domain."""
        return super().values(self._closest(points))

    def clearance(self, points: FloatArray) -> FloatArray:
        """(n,) proved lower bounds of the distances of points (n, 3) from the level set."""
        return super().clearance(self._closest(points))

    def _closest(self, points: FloatArray) -> FloatArray:
        """For each of the points (n, 3), the closest point of the field's domain; the points
        themselves if the field has values everywhere.

        Raises:
            MeshingError: points lie outside of a domain that is neither a box nor a ball.
        """
        domain = self.field.domain
        if domain is None or self.field.traits.is_global:
            return points
        if isinstance(domain, Box):
            return np.clip(points, *domain.bounds())
        if isinstance(domain, Ball):
            away = points - domain.center
            length = np.linalg.norm(away, axis=1)
            shrunk = np.minimum(1.0, domain.radius / np.maximum(length, 1e-300))
            return np.array(domain.center) + away * shrunk[:, None]
        low, high = domain.bounds()
        if math.prod(high - low) < math.inf and domain.contains_points(points).all():
            return points
        raise MeshingError(
            f"{type(self.field).__name__} ends at {with_article(type(domain).__name__)}, near "
            "which it cannot be meshed: give the field a box or a ball as its domain"
        )


# Solids cut by volumes.

# The number of cells across a solid, unless a spacing is given.
_CELLS_ACROSS = 24
# How many sizes of cells are tried.
_MAX_ATTEMPTS = 3
# Where operands were cut by each other, slivers (thin triangles) may pass through their neighbors
# by rounding. They are removed by moving the surface by up to the first length, in tolerances; if
# that fails, by up to the next.
_SLIVERS_WITHIN = (1e-3, 1e-4, 0.0)
# The margin around an extent, relative to its size.
_MARGIN = 0.01


@dataclass(frozen=True)
class SolidMeshResult:
    """The closed mesh of a solid, and facts about how it was computed.

    surface: the mesh.
    spacing: the smallest size of cells, a length.
    evaluations: the number of points at which fields were evaluated.
    levels: the number of level sets that the mesh was made of.
    size: the longest edge of the box around the solid; relative tolerances are fractions of it.
    """

    surface: TriangleMesh
    spacing: float
    evaluations: int
    levels: int
    size: float


def solid_and_level(field: Field, solid: Any, level: float | None) -> tuple[Solid, float]:
    """The solid that the arguments `solid` and `level` of `mesh` describe, and its level. The set
    {solid <= level} is to be meshed.

    field: the field to be meshed.
    solid: True if the field itself is a solid; or values (low, high), one of which may be infinite:
        the solid is where the field lies between them.
    level: for a field that is a solid; None for its default level.

    Raises:
        ValueError: the argument describes no solid, or levels that no solid has.
        TypeError: it is neither True nor a pair of numbers.
    """
    if solid is True and isinstance(field, Solid):
        level = field.default_level if level is None else as_finite(level, "level")
        return field, level
    # The boundary of each solid made here is its level 0.
    low, high = solid_value_range(field, solid, level)
    if low == -math.inf:
        return solid_of(field, below=high), 0.0
    if high == math.inf:
        return solid_of(field, above=low), 0.0
    if field.period is not None:
        return solid_of(field, around=(0.5 * (low + high), 0.5 * (high - low))), 0.0
    return solid_of(field, between=(low, high)), 0.0


def solid_value_range(field: Field, solid: Any, level: float | None) -> tuple[float, float]:
    """The values (low, high) between which the field lies in a solid. They are the argument `solid`
    of `mesh`; one of them may be infinite.

    level: must be None, since the ends of the solid are its levels.

    Raises:
        ValueError: `solid` is True, or a level is given too, or the field has no such levels.
    """
    if solid is True:
        raise ValueError(
            f"{with_article(type(field).__name__)} has two sides: name the inside, by "
            'side="below" or side="above"'
        )
    if level is not None:
        raise ValueError("give either level or solid: the ends of a solid are its levels")
    low, high = solid
    field.validate_levels(tuple(end for end in (low, high) if math.isfinite(end)))
    return low, high


def mesh_solid(
    solid: Solid,
    level: float,
    volume: Volume | None,
    tolerance: MeshTolerance,
    spacing: float | None,
    angle_mesher: Callable[[float, float], AngleMesher],
    most_faces: int,
    check: Callable[[TriangleMesh, float], None],
    report: Callable[[str], None],
) -> SolidMeshResult:
    """Mesh the boundary of the part of {solid <= level} in a volume.

    volume: None for all of space.
    tolerance: how far triangles may be from the surface.
    spacing: the size of cells, a length. None for a default size; then smaller cells are tried if
        an attempt fails.
    angle_mesher: given a tolerance and a size of cells, both lengths, returns a function that
        meshes level sets of solid angles.
    most_faces: the largest number of triangles of a level set.
    check: called with a surface and the longest edge of the box around the solid. No triangles of
        the surface pass through each other. It raises an error if the surface fails a check; the
        check of distances from the level set comes last.
    report: receives messages about the progress.

    If vertices or centers of triangles are too far from the level set in a few places, they are
    moved nearer to it (`project_outliers`). If that is not enough, or another check fails in known
    places, smaller cells and half of the tolerance are tried: beside a part thinner than the
    tolerance, triangles within the tolerance may pass through each other.

    Raises:
        MeshingError: the solid is not bounded, or is empty, or an operand cannot be meshed.
    """
    lower, upper = _bounds(solid, level, volume)
    size = solid_size(solid, level, volume)
    cell_size = size / _CELLS_ACROSS if spacing is None else spacing
    # The other half is left for later steps.
    max_error = 0.5 * tolerance.at(size)
    attempts = _MAX_ATTEMPTS if spacing is None else 1
    per_wave = CELLS_PER_WAVE if spacing is None else None
    uploads = CallCache()
    # The errors of the first attempt, and of the one before the current attempt.
    first_failure: MeshingError | None = None
    previous_failure: MeshingError | None = None
    while True:
        mesher = CsgMesher(
            lower, upper, max_error, cell_size, per_wave, angle_mesher(max_error, cell_size),
            most_faces, report, uploads=uploads,
        )  # fmt: skip
        try:
            surface = _without_crossings(_mesh_in_volume(mesher, solid, level, volume), max_error)
            report("checking")
            surface = _check_and_mend(mesher, solid, level, surface, size, check)
            break
        except TriangleLimitError as too_large:
            if first_failure is None:
                raise
            # It was the first error that led to so small cells.
            raise first_failure from too_large
        except (MissedPartsError, LocalizedMeshingError) as failure:
            attempts, first_failure = attempts - 1, first_failure or failure
            # Give up after the last attempt, or if even the smallest cells to come would not help.
            if not attempts or not is_retry_promising(
                failure, previous_failure, CELL_SIZE_RATIO**attempts
            ):
                raise
            previous_failure = failure
            cell_size *= CELL_SIZE_RATIO
            # More cells along a wave in proportion, as these may limit the size of cells.
            per_wave = CELLS_PER_WAVE * size / (_CELLS_ACROSS * cell_size)
            if isinstance(failure, LocalizedMeshingError):
                max_error *= 0.5
            report(f"{failure}; so cells of {cell_size:.3g}")
    return SolidMeshResult(
        surface, min(cell_size, mesher.smallest_cell), mesher.evaluations, mesher.levels, size
    )


def _check_and_mend(
    mesher: CsgMesher,
    solid: Solid,
    level: float,
    surface: TriangleMesh,
    size: float,
    check: Callable[[TriangleMesh, float], None],
) -> TriangleMesh:
    """Check a surface, and return it. If the check fails only because a few vertices or centers of
    triangles are too far from the level set, return the surface with these points moved nearer to
    it.

    mesher: meshed the surface; it makes the function of the level set.
    size: the longest edge of the box around the solid, which `check` needs.
    check: called with the surface and the size; raises an error if the surface fails a check.

    Raises:
        MeshingError: another check fails, or the moved surface fails one.
    """
    try:
        check(surface, size)
    except OffLevelError as error:
        # (The mesher's tolerance is half of the whole one.)
        moved = project_outliers(
            mesher.function(solid, level), surface, error.locations, 2 * mesher.tolerance,
            lambda candidate: check(candidate, size),
        )  # fmt: skip
        if moved is None:
            raise
        check_manifold(moved.faces, moved.vertices)  # the whole mesh: `check` saw new faces only
        return moved
    return surface


def apart_of(whole: Manifold, tolerance: float) -> TriangleMesh:
    """The surface of a manifold3d solid made by Boolean operations. Thin triangles are removed, and
    vertices are moved where triangles would pass through each other.

    whole: the solid.
    tolerance: a length; vertices are moved by at most half of it.

    Raises:
        MeshingError: the solid is empty, or triangles still pass through each other.
    """
    return _without_crossings(_Assembly(whole), tolerance)


def _without_crossings(parts: TriangleMesh | _Assembly, tolerance: float) -> TriangleMesh:
    """A surface whose vertices are moved where triangles would pass through each other. If `parts`
    is an assembly, its thin triangles (slivers) are removed first; if triangles still pass through
    each other in the end, it is tried again with fewer slivers removed.

    parts: a mesh, returned with moved vertices; or an assembly, of which the surface is taken.
    tolerance: a length; vertices are moved by at most half of it.

    Raises:
        MeshingError: the surface is empty. It is a SelfIntersectionError if moving vertices does
            not help, or if the number of crossing triangles hardly falls when fewer slivers are
            removed.
    """
    raised: SelfIntersectionError | None = None
    for factor in _SLIVERS_WITHIN if isinstance(parts, _Assembly) else (0.0,):
        mesh = parts.without_slivers(factor * tolerance) if isinstance(parts, _Assembly) else parts
        if not len(mesh.faces):
            raise MeshingError("the solid is empty: no point of the box is inside")
        try:
            return resolve_self_intersections(mesh, _MENDED_WITHIN * tolerance)
        except SelfIntersectionError as error:
            if not is_retry_promising(error, raised):
                raise
            raised = error
    raise cast("SelfIntersectionError", raised)


@dataclass(frozen=True)
class _Assembly:
    """A solid that Boolean operations made of the meshes of its operands.

    whole: the manifold3d solid.
    volume: the volume that cut it; None for all of space.
    """

    whole: Manifold
    volume: Volume | None = None

    def without_slivers(self, length: float) -> TriangleMesh:
        """The surface of the solid without short edges, slivers (thin triangles) and components
        that are only rounding error. Vertices within rounding of a box of the volume are moved onto
        it.

        length: how far the removal of edges and slivers may move the surface; 0 removes none.
        """
        simpler = without_short_edges(self.whole, length) if length > 0 else self.whole
        surface = drop_degenerate_components(from_manifold(simpler))
        return surface if self.volume is None else _snap_to_boxes(surface, self.volume)


def _mesh_in_volume(
    mesher: CsgMesher, solid: Solid, level: float, volume: Volume | None
) -> TriangleMesh | _Assembly:
    """Mesh the boundary of the part of {solid <= level} in the volume; None stands for all of
    space. Returns a mesh if the boundary is one whole level set, else an assembly of the meshes of
    operands. mesher: meshes level sets and combines them."""
    if volume is None and is_single_level_set(solid):
        return mesher.mesh_smooth_level(solid, level)[0]
    lower, upper = mesher.lower, mesher.upper
    manifold = mesher.mesh_sublevel(solid, level)
    mesher.report("putting the parts together")
    if volume is None:
        volume = Box(tuple(lower.tolist()), tuple(upper.tolist()))
        # If the solid ends inside the box, it need not be cut at the box.
        ends = np.array(manifold.bounding_box(), np.float64)
        if (ends[:3] > lower).all() and (ends[3:] < upper).all():
            return _Assembly(manifold, volume)
    cut = volume_manifold(volume, lower, upper, mesher.tolerance)
    return _Assembly(manifold ^ cut, volume)


def solid_size(solid: Solid, level: float, volume: Volume | None) -> float:
    """The longest side of the box in which the part of {solid <= level} in the volume is meshed, a
    length. volume: None for all of space.

    Raises:
        MeshingError: there is no finite box, or it is empty.
    """
    lower, upper = _bounds(solid, level, volume)
    return float((upper - lower).max())


def _bounds(solid: Solid, level: float, volume: Volume | None) -> tuple[FloatArray, FloatArray]:
    """The lower and upper corners (3,) of a box that contains the part of {solid <= level} in the
    volume. The box has a margin where the solid ends, but not where the volume does.

    Raises:
        MeshingError: there is no finite box, or it is empty.
    """
    lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
    if volume is not None:
        lower, upper = (np.array(end, np.float64) for end in volume.bounds())
    hull = solid.sublevel_extent(level)
    if hull is not None:
        low, high = (np.array(end, np.float64) for end in hull.bounds())
        pad = _MARGIN * float((high - low).max())
        if math.isfinite(pad):
            low, high = low - pad, high + pad
        lower, upper = np.maximum(lower, low), np.minimum(upper, high)
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise MeshingError(
            f"{type(solid).__name__} does not say where it ends (a solid does not end at the "
            "domain of the field it is made of): give a clip, such as a box (harnack.Box)"
        )
    if not (lower < upper).all():
        raise MeshingError("the solid is empty: it lies outside of the clip")
    return lower, upper


def _snap_to_boxes(surface: TriangleMesh, volume: Volume) -> TriangleMesh:
    """The surface, with vertices moved onto the faces of boxes if they are outside, or within
    rounding of a face. The boxes are `volume` itself or, if it is an intersection of volumes, the
    boxes among these."""
    boxes = volume.volumes if isinstance(volume, VolumeIntersection) else (volume,)
    vertices = surface.vertices
    for box in boxes:
        if isinstance(box, Box):
            # (Within 1e-12 of the plane's coordinate.)
            vertices = snap_to_box(np.clip(vertices, *box.bounds()), box, 1e-12)
    return TriangleMesh(vertices, surface.faces)
