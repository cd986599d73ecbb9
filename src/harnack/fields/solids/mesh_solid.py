"""Solids bounded by closed triangle meshes: `MeshSolid`, whose function f is the signed distance
from the mesh, negative inside. Its size is found from the nearest triangle, and its sign from the
winding number: how often the mesh winds around a point, which is counted by the crossings of a ray
with the mesh. Points are used in unit coordinates, in which the mesh has a size of about 1.
`ClosedSurface.of` finds the faces of a mesh that bound the solid, and refuses a mesh that bounds
none. A jet holds proved ranges of a number and of its derivatives by some variables.

Why a ray decides whether a point is inside. The usual way would be the normals of edges and
vertices, weighted by angles. But near triangles as thin as rounding these normals decide nothing.
The ray decides there too, because the two triangles at an edge compare the edge with the ray by the
same bits. It takes a thirtieth of the time of the search for the nearest triangle.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic import Interval, Jet
from harnack.arithmetic.jet import range_times_length
from harnack.backend import BoolArray, FloatArray, IntArray, backend_of, choose_backend
from harnack.backend.elementary import fmin, max_norm
from harnack.backend.record_table import RecordTable
from harnack.backend.validation import format_vector
from harnack.enclosures import Lipschitz
from harnack.enclosures.samples import Ray as Ray
from harnack.enclosures.samples import RaySample, Sample
from harnack.fields.batched_fields import cached_upload
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.formula_evaluator import is_jet
from harnack.fields.solids.solid import Solid, box_around, set_frozen
from harnack.files.geometry_files import GEOMETRY_SUFFIXES, LoadedMesh, read_geometry
from harnack.fmm.unit_frame import UnitFrame, frame_parameters, round_to_single
from harnack.geometry import MeshError, validate_mesh, zero_area_faces
from harnack.geometry.mesh_edges import area_normals
from harnack.geometry.meshes import mesh_arrays
from harnack.geometry.orientability import is_nonorientable
from harnack.geometry.welding import Welded
from harnack.tree import build_balanced_tree
from harnack.tree.closest_triangles import (
    ClosestTriangle,
    initial_squared_distance,
    next_closest_triangle,
)
from harnack.tree.triangle_splitting import (
    split_intersecting_faces,
    winding_numbers_of_sides,
    windings_of_sides,
)
from harnack.tree.triangle_tree import (
    MAX_TRIANGLES,
    NO_TRIANGLE,
    PARITY_COLUMN,
    TriangleTree,
    triangle_records,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.geometry import Volume

_LEAF_SIZE = 4
# A lower bound of |gradient| of a signed distance, which is 1 wherever the gradient exists.
_MIN_GRADIENT = 0.99
# The rounding error of a distance, in machine epsilons of coordinates and of the mesh's size, as
# `tree.closest_triangles.distance_lower_bound` proves.
_DISTANCE_ROUNDINGS = 16.0
# If coordinates have an error of more than this many roundings, they stand for a range of points.
_MAX_POINT_ROUNDINGS = 256.0
# The normal of the nearest triangle decides whether a point is inside only where the distance is
# larger than this multiple of its error.
_CLEAR_MULTIPLE = 8.0


def solid_of_mesh(source: Any) -> MeshSolid:
    """The solid that a mesh bounds, as a `MeshSolid`.

    source: anything with the attributes `vertices` and `faces`, a pair (vertices, faces), or the
        path of a surface file.

    Raises:
        MeshError: the mesh bounds no solid; the message states the reason and a remedy.
        FileFormatError: a file that cannot be read.
        TypeError: the argument is not a mesh.
    """
    if isinstance(source, str | os.PathLike):
        surface = read_geometry(cast("Any", source), "winding")
        if not isinstance(surface, LoadedMesh):
            raise MeshError(f"{source}: it holds no faces, so it bounds no solid")
        faces = np.concatenate([surface.faces, surface.zero_area_faces])
        return MeshSolid(surface.vertices, faces)
    return MeshSolid(*mesh_arrays(source))


def looks_like_mesh(candidate: Any) -> bool:
    """Whether an argument is meant as a mesh: it has the attributes `vertices` and `faces`, is a
    pair, or is the name of a surface file."""
    if isinstance(candidate, str | os.PathLike):
        return Path(cast("Any", candidate)).suffix.lower() in GEOMETRY_SUFFIXES
    if hasattr(candidate, "vertices") and hasattr(candidate, "faces"):
        return True
    return isinstance(candidate, tuple | list) and len(cast("Any", candidate)) == 2


@dataclass(frozen=True, eq=False)
class MeshSolid(Solid):
    """The inside of a closed triangle mesh. Its function f is the signed distance from the surface
    of the mesh, negative inside. So f has the Lipschitz constant 1.

    vertices: (n, 3). Vertices at the same position count as one vertex. At open edges, vertices
        that differ by rounding count as one too (`geometry.welding`).
    faces: (m, 3), indices of vertices, counter-clockwise as seen from outside. Faces may have zero
        area.

    A mesh that crosses or contains itself is the solid of the points around which it winds more
    than 1/2 times, which is the union where its parts overlap or touch. f is the distance from the
    boundary of that union.

    |f| is the distance from the nearest triangle, which is found in a tree. Its error is at most 16
    epsilons of the size of the mesh and of the distance from its center
    (`tree.closest_triangles.ClosestPointOnTriangle`).

    Proof of the sign. The sign is that of 1/2 minus the winding number. The winding number is the
    sum of the signs of the crossings of the mesh with a ray along z
    (`tree.triangle_tree.signed_crossing`). It is right wherever the distance is more than its error
    e, also for rays through edges and vertices and for triangles without area. Each triangle that
    counts as crossed has a point within a distance c < e of the ray, where c is of the size of
    rounding; the depth of this point along the ray is compared with 0. Let C be the cylinder of
    radius c around the line of the ray. The ball of radius e about the point x has no point of the
    surface, and it divides C into a part in front of x and a part behind x. So the part of a
    triangle in C, which is convex, lies in one of these as a whole, and its depth decides in which.
    An edge that meets C in front of x belongs to two triangles in front. For both, the same bits
    decide on which side of the edge the ray passes, so that they cancel. All other edges are passed
    at a distance greater than rounding. So the sum is that of a ray in general position. Normals of
    edges and vertices, weighted by angles (Baerentzen and Aanaes 2005), would need no ray, but have
    no reliable direction near triangles as thin as rounding.

    If the nearest point lies inside a triangle, the triangle's normal decides the same without a
    ray. Proof. The ball about x through that point is free of the surface, so that x is on the side
    of the triangle that the normal tells. Suppose that rounding has mistaken a point on an edge for
    an inner point. Look along that edge: every other triangle at it makes more than a right angle
    with the direction to x (else it would be nearer), and this triangle makes about a right angle.
    So no other triangle lies between this one and x, and x is still on the side that its normal
    tells.

    Raises:
        MeshError: a mesh that is not closed, whose faces do not agree on its two sides, that is
            inside out somewhere, or whose faces lie on each other up to rounding and not exactly.
            The message states a remedy.
    """

    vertices: Any
    faces: Any

    lipschitz = 1.0

    def __post_init__(self) -> None:
        vertices, faces = validate_mesh(self.vertices, self.faces, allow_zero_area=True)
        set_frozen(self, "vertices", vertices)
        set_frozen(self, "faces", faces)
        set_frozen(self, "_surface", ClosedSurface.of(vertices, faces))

    @property
    def surface(self) -> ClosedSurface:
        """The triangles of the mesh that bound the solid, as a `ClosedSurface`."""
        return cast("Any", self)._surface

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def describe(self) -> dict[str, Any]:
        surface = self.surface
        return {
            "triangles": len(surface.faces),
            "crosses itself": surface.boundary_triangles is not None,
        }

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A box that contains all points where f <= level: the box of the mesh, grown by the level
        on each side. None if `above` (a volume for all points where f >= level), as these points
        are unbounded.

        Proof for a negative level. The ball of radius -level about a point where f <= level is
        inside the solid, and so in the box.
        """
        if above:
            return None
        surface = self.surface
        lower, upper = (surface.center + surface.size * corner for corner in surface.box)
        half, center = 0.5 * (upper - lower) + level, 0.5 * (upper + lower)
        x, y, z = (float(coordinate) for coordinate in half)
        return box_around((x, y, z), tuple(float(coordinate) for coordinate in center))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        del plan
        return _MeshSolidEvaluator(self._upload(backend))

    @cached_upload
    def _upload(self, backend: Backend) -> _MeshData:
        """Upload the triangles of the surface to a backend."""
        return _MeshData.upload(backend, self.surface)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        like = x.piece_length if is_jet(x, type(self).__name__) else x
        return self.formula_on(backend_of(like))(x, y, z)


@dataclass(frozen=True, eq=False)
class _MeshSolidEvaluator(Evaluator):
    """The evaluator of a `MeshSolid`.

    data: the triangles on a backend.
    """

    data: _MeshData

    def evaluate(self, p: Vec3) -> Sample:
        """The sample of f at p: value, gradient, error bounds and the Lipschitz constant 1. Within
        the context `share_samples`, a sample at the same Dr.Jit points is computed once and then
        taken from a cache."""
        data, cache = self.data, _SAMPLE_CACHE.get()
        if cache is None or dr.flag(dr.JitFlag.SymbolicScope):
            return data.sample(p)
        # Dr.Jit numbers its arrays: points with the same three indices are the same arrays.
        key = id(data), p.x.index, p.y.index, p.z.index
        if key not in cache:
            cache[key] = p, data.sample(p)  # with p, so that its indices name nothing else
        return cache[key][1]

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the point of a ray with parameter t, with enclosures (proved bounds of the
        change of f along the ray) in front of the point and behind it, and with a lower bound of
        |grad f|. The enclosures follow from the Lipschitz constant 1.

        path: the ray.
        ahead, back: the lengths in front of and behind the point for which enclosures are wanted;
            not used, as the enclosures hold on all lengths.
        """
        del ahead, back
        ray_sample = path.enclose(self.evaluate(path.point(t)))
        return RaySample(
            ray_sample.sample,
            ray_sample.forward,
            ray_sample.backward,
            ray_sample.slope,
            ray_sample.reach_growth,
            min_gradient_norm=_MIN_GRADIENT,
        )

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit numbers, or jets (ranges of numbers and of their
        derivatives)."""
        if not is_jet(x, self.name):
            return self.differentiable_value(backend_of(x).Array3f(x, y, z))
        return mesh_distance_jet(self.data, x, y, z)


_SAMPLE_CACHE: ContextVar[dict[tuple[int, ...], tuple[Vec3, Sample]] | None] = ContextVar(
    "kept samples", default=None
)


@contextmanager
def share_samples() -> Generator[None]:
    """A context within which a mesh is sampled only once at the same Dr.Jit points. So several
    operands of a combination that are made of the same mesh, such as a shell of it and a lattice
    cut off by it, share one search for the nearest triangles.

    While loops are recorded, samples are not shared, as their values are defined inside the loop
    only.
    """
    token = _SAMPLE_CACHE.set({})
    try:
        yield
    finally:
        _SAMPLE_CACHE.reset(token)


@dataclass(frozen=True)
class _MeshData(UnitFrame):
    """The triangles of a mesh on a backend, in unit coordinates: x = (p - center) / size for a
    point p of space. Two trees find closest points and the crossings of rays.

    rays: a tree of all faces, which form a closed mesh, with which the crossings of rays are found.
    near: a tree of the triangles that bound the solid, with which closest points are found.
    corners: a record of nine numbers for each triangle of `near`, its corners.
    low, high: the lowest and the highest corner of the box around the solid.
    """

    rays: TriangleTree
    near: TriangleTree
    corners: RecordTable
    low: Vec3
    high: Vec3

    @classmethod
    def upload(cls, backend: Backend, surface: ClosedSurface) -> _MeshData:
        """Upload the triangles of a surface to a backend, and make the trees."""
        vertices, faces, weights = surface.vertices, surface.faces, surface.weights
        # If the boundary of the solid is just the faces, one tree serves both purposes. Otherwise
        # there is another tree for closest points.
        near = rays = _triangle_tree(
            backend, vertices, faces, weights, slabs=surface.boundary_triangles is None
        )
        if surface.boundary_triangles is not None:
            points = surface.boundary_triangles.reshape(-1, 3)
            indices = np.arange(len(points)).reshape(-1, 3)
            # Each triangle of the boundary counts once.
            near = _triangle_tree(backend, points, indices, np.ones(len(indices)), slabs=True)
        corners = RecordTable.upload(backend, surface.corners.reshape(-1, 9))
        low, high = (
            backend.Array3f(*(dr.opaque(backend.Float, float(coordinate)) for coordinate in corner))
            for corner in surface.box
        )
        frame = frame_parameters(backend, surface.center, surface.size)
        return cls(*frame, rays=rays, near=near, corners=corners, low=low, high=high)

    def sample(self, p: Vec3) -> Sample:
        """The sample of the signed distance at p."""
        x = self.to_unit(p)
        return self._signed_sample(p, x, self._closest_triangle(x))

    def sample_with_feature(self, p: Vec3) -> tuple[Sample, Vec3, Mask, Mask]:
        """The sample of the signed distance at p, and which kind of point the closest point of the
        mesh is: a point inside a triangle, a point on an edge, or a vertex.

        Returns four results: the sample; a unit vector along an edge of the closest triangle, the
        edge that is nearest to the closest point; a mask, true where the closest point lies on that
        edge and is no vertex; and a mask, true where it is a vertex. Where the closest point is
        inside a triangle, both masks are false.
        """
        vector = self.backend.Array3f
        x = self.to_unit(p)
        closest = self._closest_triangle(x)
        corners = self.corners.read_record(closest.triangle, closest.triangle != NO_TRIANGLE)
        # The vectors from the closest point (x + closest.offset) to the corners of its triangle.
        to_corners = [vector(*corners[k : k + 3]) - (x + closest.offset) for k in (0, 3, 6)]
        # A corner nearer than this to the closest point is taken as the closest point itself.
        rounding = _DISTANCE_ROUNDINGS * self.backend.machine_epsilon * (1 + dr.max(dr.abs(x)))
        at_vertex, along, min_distance = (
            self.backend.Bool(False),
            vector(0),
            self.backend.Float(dr.inf),
        )
        for a, b in ((0, 1), (1, 2), (2, 0)):
            edge = to_corners[b] - to_corners[a]
            length = dr.norm(edge)
            # The distance of the closest point from the edge's line.
            edge_distance = dr.norm(dr.cross(to_corners[a], edge)) / length
            along = dr.select(edge_distance < min_distance, edge / length, along)
            min_distance = fmin(edge_distance, min_distance)
            at_vertex |= dr.norm(to_corners[a]) <= rounding
        # `is_inner` is true where the closest point is inside the triangle.
        on_edge = ~closest.is_inner & ~at_vertex
        return (self._signed_sample(p, x, closest), along, on_edge, ~closest.is_inner & at_vertex)

    def _closest_triangle(self, x: Vec3) -> ClosestTriangle:
        """The triangle closest to x, a point in unit coordinates."""
        backend = self.backend
        upper_bound = initial_squared_distance(self.near, x)
        # `next_closest_triangle` returns the triangle that follows another one in the order of
        # distance. A distance of -1 and no triangle as the one before give the first, which is the
        # closest.
        before = backend.Float(-1), backend.UInt32(NO_TRIANGLE)
        return next_closest_triangle(self.near, x, before, upper_bound, backend.Bool(True))

    def _signed_sample(self, p: Vec3, x: Any, closest: ClosestTriangle) -> Sample:
        """The sample of the signed distance at p, from the triangle that is closest to p.

        x: p in unit coordinates.
        closest: that triangle, with the vector from x to its closest point.
        """
        backend = self.backend
        real, vector, epsilon = backend.Float, backend.Array3f, backend.machine_epsilon
        distance = dr.sqrt(closest.squared_distance)
        error = _DISTANCE_ROUNDINGS * epsilon * (1 + dr.max(dr.abs(x)))

        # `closest.normal` has twice the triangle's area as its length.
        double_area = dr.norm(closest.normal)
        has_area = double_area > 0
        normal = dr.select(has_area, closest.normal / double_area, vector(0, 0, 1))
        height = -dr.dot(closest.offset, normal)  # of x above the triangle's plane
        # The normal decides the sign if the closest point is inside the triangle, the distance is
        # well above its error, and x is nearly straight above the triangle, as it must be then.
        # Otherwise a ray decides.
        normal_decides = closest.is_inner & (distance > _CLEAR_MULTIPLE * error)
        normal_decides &= 2 * dr.abs(height) > distance
        inside = self._is_inside(x, ~normal_decides)
        inside = dr.select(normal_decides, height < 0, inside)
        sign = dr.select(inside, real(-1), real(1))

        # If the closest point is inside a face, the gradient is plus or minus the face's normal,
        # also where the distance is mere rounding. If the distance is larger than its error, the
        # sign of f says which: the gradient points away from the face outside of the solid, and
        # towards it inside. (Behind a wall thinner than rounding the nearest face may be that of
        # the wall's other side.) Nearer to the face, the normal is taken as it is.
        on_face = (closest.is_inner & has_area) | (distance == 0)
        normal_sign = dr.select(distance > error, sign * dr.mulsign(real(1), height), 1)
        gradient = dr.select(on_face, normal * normal_sign, -closest.offset * (sign / distance))
        # Corners are rounded, which turns a triangle by an angle of about the rounding over its
        # height. The height is twice the area over the longest edge, whose length is of the order
        # of 1 at most. Elsewhere the gradient is a vector over its length: so is its error, which
        # is at most 2.
        normal_error = 8 * epsilon / double_area
        gradient_error = dr.select(on_face, fmin(normal_error, 2), fmin(2 * error / distance, 2))
        # On a triangle without area nothing is known of the gradient.
        gradient_error = dr.select((distance == 0) & ~has_area, 2, gradient_error)
        return Sample(
            sign * distance * self.size,
            gradient,
            (Lipschitz(0 * p.x + 1),),  # the constant 1, on each lane
            error * self.size,
            gradient_error,
        )

    def _is_inside(self, x: Vec3, active: Mask) -> Mask:
        """A mask, true on active lanes where the winding number at x is above 1/2, so that x is
        inside the solid. x is a point in unit coordinates. The winding number is counted along a
        ray from x in the direction z or -z, whichever leads to the nearer end of the mesh's box.
        Points outside of the box are outside of the solid."""
        is_in_box = dr.all((x >= self.low) & (x <= self.high))
        ray_sign = dr.select(x.z > 0.5 * (self.low.z + self.high.z), self.backend.Float(1), -1)
        crossings = self.rays.signed_crossings_vertical(x, ray_sign, active & is_in_box)
        return is_in_box & (ray_sign * crossings > 0.5)


def _triangle_tree(
    backend: Backend, vertices: FloatArray, faces: IntArray, weights: Any, *, slabs: bool
) -> TriangleTree:
    """A tree of triangles, for closest points and for crossings with rays.

    vertices, faces: (n, 3), and (m, 3) indices of vertices.
    weights: (m,) or a number: how many times the crossings of a face count.
    slabs: whether the nodes of the tree store slabs (flat cylinders around their triangles) besides
        boxes. They make searches for closest points from far away faster; crossings do not use
        them.
    """
    tree = build_balanced_tree(vertices[faces].mean(axis=1), leaf_size=_LEAF_SIZE)
    records = triangle_records(vertices, faces)
    records[:, PARITY_COLUMN] *= weights
    return TriangleTree.of(backend, tree, records, slabs=slabs)


def mesh_distance_jet(data: _MeshData, x: Jet, y: Jet, z: Jet) -> Jet:
    """The jet (proved ranges of value and derivatives) of the signed distance d from a mesh, from
    the jets of the coordinates.

    data: the triangles of the mesh on a backend.
    x, y, z: the jets of the coordinates, at a point or on a piece of a line.

    Proof. d has the Lipschitz constant 1. So its derivative by any variable is at most the length
    of the derivative of (x, y, z) by that variable, and its value at the start is known up to the
    error of the coordinates there. On a piece d may have kinks, so that second derivatives have no
    bound. At a point they are those of the distance from the nearest face, edge or vertex. For a
    face they are 0. For a vertex they are 1/d across the gradient. For an edge they are 1/d across
    both the gradient and the edge, and 0 along the edge.
    """
    coordinates = (x, y, z)
    # The jets at the start of the piece; at a point, the jets themselves.
    starts = [
        coordinate if coordinate.jet_at_start is None else coordinate.jet_at_start
        for coordinate in coordinates
    ]
    zero = 0 * x.piece_length
    q = backend_of(zero).Array3f(*(zero + coordinate.value.midpoint for coordinate in starts))
    sample, edge, on_edge, at_vertex = data.sample_with_feature(q)
    input_error = sum((coordinate.value.radius for coordinate in starts), zero)
    error = sample.value_error + input_error
    # True where the coordinates are ranges, and not numbers with their rounding: at other points of
    # the ranges another face may be nearest.
    size = max_norm(q) + dr.abs(sample.value)
    is_range = input_error > _MAX_POINT_ROUNDINGS * float(dr.epsilon(zero)) * size
    value = Interval(sample.value, sample.value).widened(1e-6, 0.0) + Interval(-error, error)

    def speeds(jets: Any) -> list[Real]:
        """For each variable of the jets, a bound of the length of the derivative of (x, y, z) by
        that variable: of the speed at which the point moves.

        jets: the jets of the three coordinates, which are functions of one or more variables.
        """
        return [
            # (1e-5 covers the rounding of the length.)
            dr.sqrt(
                sum(
                    dr.square(zero + coordinate.first_derivatives[i].max_abs) for coordinate in jets
                )
            )
            * (1 + 1e-5)
            for i in range(len(x.first_derivatives))
        ]

    errors = Interval(zero - sample.gradient_error, zero + sample.gradient_error)
    # The components of the gradient with their error, as intervals.
    slopes = [Interval.point(coordinate) + errors for coordinate in sample.gradient]
    first: list[Interval] = []
    # First derivatives: by the chain rule, narrowed by the Lipschitz constant; on ranges of points
    # by the Lipschitz constant alone.
    for i, limit in enumerate(speeds(starts)):
        rate = Interval(0.0, 0.0)
        for slope, coordinate in zip(slopes, starts, strict=True):
            rate = rate + slope * coordinate.first_derivatives[i]
        lipschitz_range = Interval(-limit, limit)
        narrowed = rate.intersect(lipschitz_range)
        lower, upper = (
            dr.select(is_range, a, b)
            for a, b in ((-limit, zero + narrowed.lower), (limit, zero + narrowed.upper))
        )
        first.append(Interval(lower, upper))

    def rate_along(direction: Vec3, jets: Any, i: int) -> Interval:
        """The range of the dot product of a vector with the derivative of (x, y, z) by the variable
        i of the jets.

        direction: (3,) the vector.
        jets: the jets of the three coordinates, which are functions of one or more variables.
        """
        total = Interval(0.0, 0.0)
        for coordinate, jet in zip(direction, jets, strict=True):
            total = total + Interval.point(coordinate) * jet.first_derivatives[i]
        return total

    count = range(len(x.first_derivatives))
    # Second derivatives of d by the variables i and j. The curvature is 1/d near an edge or a
    # vertex, else 0. It is multiplied by the product of the motions across the gradient (and across
    # the edge): that is the product of the whole motions, minus the product of their parts along
    # the gradient (and along the edge).
    gradient_rates = [rate_along(sample.gradient, starts, i) for i in count]
    edge_rates = [rate_along(edge, starts, i) for i in count]
    curvature = dr.select(on_edge | at_vertex, 1 / sample.value, 0)
    range_margin = dr.select(is_range, dr.inf, zero)
    second: list[Interval] = []
    for k, (i, j) in enumerate(starts[0].hessian_indices()):
        across = -(gradient_rates[i] * gradient_rates[j])
        for coordinate in starts:
            across = across + coordinate.first_derivatives[i] * coordinate.first_derivatives[j]
        across = across - edge_rates[i] * edge_rates[j] * Interval.point(
            dr.select(on_edge, 1.0, 0.0)
        )
        rate = Interval.point(zero + curvature).widened(1e-5 + sample.gradient_error) * across
        for slope, coordinate in zip(slopes, starts, strict=True):
            rate = rate + slope * coordinate.second_derivatives[k]
        second.append(rate + Interval(-range_margin, range_margin))
    start = Jet(value, tuple(first), tuple(second), piece_length=starts[0].piece_length)
    if x.jet_at_start is None:
        return start
    # On a piece, only the Lipschitz constant is used.
    ranges = tuple(Interval(-limit, limit) for limit in speeds(coordinates))
    piece_value = value + range_times_length(ranges[0], x.piece_length)
    unbounded = (Interval(zero - dr.inf, zero + dr.inf),) * len(x.second_derivatives)
    return Jet(piece_value, ranges, unbounded, start, x.piece_length)


# The surface of a mesh.

# A triangle is thin if its height is below this number in unit coordinates, that is, this fraction
# of the mesh's size. Its computed winding numbers are not reliable, so they are not tested.
_THIN_HEIGHT = 1e-9
# The integral of the normal over a closed surface must be 0 up to this fraction of the surface's
# area.
_CLOSED_TOLERANCE = 1e-10
# Barycentric coordinates of the points of a triangle at which the winding numbers of both sides are
# compared.
_PROBE_POINTS = ((0.98, 0.01, 0.01), (0.01, 0.98, 0.01), (0.01, 0.01, 0.98))


@dataclass(frozen=True)
class ClosedSurface:
    """The boundary of the solid that a mesh bounds, in unit coordinates. A point u in unit
    coordinates stands for the point center + size * u of space; the coordinates are at most about
    1.

    vertices: (n, 3).
    faces: (m, 3), indices of vertices. They form a closed mesh, and no two are alike.
    weights: (m,) how many times each face is counted.
    center, size: (3,) and a length: they define the unit coordinates.
    boundary_triangles: (k, 3, 3) the corners of the triangles that bound the points of a winding
        number above 1/2; None if these are just the faces.
    box: the lowest and the highest corner (3,) of that boundary.
    area: the area of that boundary in the mesh's own units; triangles that coincide count once.
    """

    vertices: FloatArray
    faces: IntArray
    weights: IntArray
    center: FloatArray
    size: float
    boundary_triangles: FloatArray | None
    box: tuple[FloatArray, FloatArray]
    area: float

    @property
    def corners(self) -> FloatArray:
        """(k, 3, 3) the corners of the triangles that bound the solid."""
        return (
            self.vertices[self.faces]
            if self.boundary_triangles is None
            else self.boundary_triangles
        )

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> ClosedSurface:
        """Find the boundary of the solid that a mesh bounds.

        vertices, faces: (n, 3), and (m, 3) indices of vertices.

        Raises:
            MeshError: the mesh bounds no solid.
        """
        # A face and a reversed copy of it cancel each other. The faces that remain are called the
        # net; `multiplicity` says how many times each counts.
        welded = Welded.of(vertices, faces)
        net = welded.net
        if not len(net.faces):
            raise MeshError("the mesh bounds no volume: every face is canceled by a reversed copy")
        if len(net.faces) >= MAX_TRIANGLES:
            raise MeshError(f"at most {MAX_TRIANGLES - 1:,} faces are possible: decimate the mesh")
        _check_closed(vertices, welded)
        used = vertices[np.unique(net.faces)]
        lower, upper = used.min(axis=0), used.max(axis=0)
        # A power of two, so that scaling is exact.
        size = float(2.0 ** np.ceil(np.log2(0.5 * float((upper - lower).max()))))
        center = round_to_single(0.5 * (lower + upper))
        unit = (vertices - center) / size

        def place(corners: FloatArray) -> str:
            """The center of a triangle as text, in the mesh's own units, for messages.

            corners: (3, 3) of the triangle, in unit coordinates.
            """
            return format_vector(center + size * corners.mean(axis=0))

        pieces, area = _boundary_pieces(unit, net.faces, net.multiplicity, place)
        corners = unit[net.faces] if pieces is None else pieces
        box = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        return cls(unit, net.faces, net.multiplicity, center, size, pieces, box, area * size**2)


def _boundary_pieces(
    unit: FloatArray, faces: IntArray, weights: IntArray, place: Callable[[FloatArray], str]
) -> tuple[FloatArray | None, float]:
    """Find the boundary of a solid: the triangles between points of a winding number below 1/2 and
    points of a winding number above 1/2. Faces are first cut into pieces where they meet other
    faces.

    unit: (n, 3) the vertices in unit coordinates.
    faces: (m, 3), indices of vertices.
    weights: (m,) how many times each face is counted.
    place: a function that returns the text for a place near a triangle, for messages.

    Returns two results: the corners (k, 3, 3) of the pieces that bound the solid, or None if these
    are all faces, uncut; and their area. Pieces run counter-clockwise as seen from outside. In the
    area, pieces that coincide count once. If several faces coincide, and more of them are turned
    one way than the opposite way, each of these is a piece of the boundary.

    Triangles thinner than `_THIN_HEIGHT` (about 1e-9 of the mesh's size) have no reliable normal,
    and so the winding numbers on their two sides are not reliable. If the boundary is all faces, it
    includes these triangles, too. Otherwise their computed winding numbers decide whether they are
    part of it; a wrong decision moves the surface by no more than their height.

    Raises:
        MeshError: the mesh is inside out, or faces lie on each other.
    """
    faces = np.repeat(faces, weights, axis=0)
    rays = _triangle_tree(choose_backend("double"), unit, faces, np.ones(len(faces)), slabs=False)
    # The faces of nonzero area. Only these can be cut.
    proper = np.delete(faces, zero_area_faces(unit, faces), axis=0)
    proper_tree = rays
    if len(proper) < len(faces):
        proper_tree = _triangle_tree(choose_backend("double"), unit, proper, 1.0, slabs=False)
    pieces, _ = split_intersecting_faces(proper_tree, unit, proper)
    edges = pieces - np.roll(pieces, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    # The cross product has twice the area as its length, which is height times longest edge.
    is_thick = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > _THIN_HEIGHT * longest
    # The winding numbers in front of and behind each piece.
    front, back = windings_of_sides(rays, pieces)
    # Across a face the winding number falls by 1 from back to front. A negative one says that
    # something is inside out.
    lower, upper = np.minimum(front, back), np.maximum(front, back)
    if (wrong := is_thick & (lower < 0)).any():
        if (upper[is_thick] <= 0).all():
            raise MeshError(
                "the mesh is inside out: its faces run clockwise as seen from outside; turn them "
                "by mesh.invert() or faces[:, ::-1]"
            )
        raise MeshError(
            f"a part of the mesh is inside out, such as near {place(pieces[wrong][0])}: turn the "
            "faces of that part (trimesh.repair.fix_normals(mesh, multibody=True) tries), or take "
            "harnack.WindingNumber, which asks for no sides"
        )
    # A piece is wrong if the winding numbers on its two sides are not the same at several of its
    # points: then another face crosses it or lies on a part of it.
    wrong = np.zeros(len(pieces), np.bool_)
    for barycentric in _PROBE_POINTS:
        front_probe, back_probe = winding_numbers_of_sides(rays, pieces, barycentric)
        wrong |= (front_probe != lower) | (back_probe != upper)
    # Keep the pieces between winding numbers below and above 1/2.
    is_kept, jump = (lower < 0.5) & (upper > 0.5), upper - lower
    if not _is_closed(pieces[is_kept], jump[is_kept], is_thick[is_kept]):
        wrong |= jump != 1  # where components are in contact, or faces are repeated
    if (wrong := wrong & is_thick).any():
        raise MeshError(
            f"{int(wrong.sum()):,} faces of the mesh lie on parts of others, such as near "
            f"{place(pieces[wrong][0])}: join the parts that touch there, as trimesh.boolean.union "
            "does"
        )
    is_inward = front > back
    is_uncut = (
        is_kept[is_thick].all() and len(pieces) == len(proper) and not is_inward[is_thick].any()
    )
    if not is_uncut and not is_kept.any():
        raise MeshError("the mesh bounds no volume: its parts cancel each other")
    # At one position, the number of pieces that face outwards minus the number of pieces that face
    # inwards is the jump of the winding number. So 1/jump is the share of each piece, and
    # coinciding pieces count once in all.
    area = (
        0.5 * np.linalg.norm(np.cross(edges[is_kept, 0], edges[is_kept, 1]), axis=1) / jump[is_kept]
    )
    area = float((area * np.where(is_inward[is_kept], -1.0, 1.0)).sum())
    # Pieces that face inwards are turned around.
    oriented = np.where(is_inward[:, None, None], pieces[:, ::-1], pieces)
    return None if is_uncut else oriented[is_kept], area


def _is_closed(pieces: FloatArray, jump: FloatArray, is_thick: BoolArray) -> bool:
    """Whether triangles together bound a volume. Some of them may coincide.

    pieces: (k, 3, 3) their corners.
    jump: (k,) by how much the winding number changes across each piece.
    is_thick: (k,) whether the piece is thick enough to have a reliable normal.

    Proof. By Gauss's theorem, the integral over a closed surface of the normal n is 0, and the
    integral of x_i n_j is the volume for i = j, else 0. A piece that does not belong to the surface
    violates this. At each position of pieces that coincide, the number of pieces turned one way
    minus the number turned the other way is the jump. So each piece counts with 1/jump. Pieces that
    are not thick may count or not, so their area is a tolerance.
    """
    # The integral of n over each piece; `moment` is the sum of the integrals of x_i n_j.
    normal_integral = 0.5 * area_normals(pieces)
    piece_area = np.linalg.norm(normal_integral, axis=1)
    normal_integral = normal_integral / np.maximum(jump, 1)[:, None]
    moment = np.einsum("ki,kj->ij", pieces.mean(axis=1), normal_integral)
    # `moment` must be the volume times the identity matrix.
    deviation = moment - np.trace(moment) / 3 * np.eye(3)
    tolerance = _CLOSED_TOLERANCE * piece_area.sum() + 4 * piece_area[~is_thick].sum()
    return bool(
        max(np.abs(normal_integral.sum(axis=0)).max(), np.abs(deviation).max()) <= tolerance
    )


def _check_closed(vertices: FloatArray, welded: Welded) -> None:
    """Raise MeshError unless every edge occurs as often in one direction as in the other. The
    message names an open edge, one that belongs to a single face. If there is none, it names an
    edge whose faces do not agree on which side is outside.

    vertices: (n, 3).
    welded: the faces; its `edges` are those that occur more often in one direction than in the
        other, and its `weights` say how many times more.
    """
    faces, edges, edge_weights = welded.net.faces, welded.edges, welded.weights
    if not len(edges):
        return
    face_edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, count = np.unique(face_edges, axis=0, return_counts=True)
    # Find each edge of `edges` among all edges of faces. An edge with the vertices a < b has the
    # key a n + b, with n the number of vertices; `pairs` is sorted by this key. (The matrix product
    # with [n, 1] computes it.)
    vertex_count = len(vertices)
    indices = np.searchsorted(pairs @ [vertex_count, 1], np.sort(edges, axis=1) @ [vertex_count, 1])
    is_open = (count[indices] == 1) & (edge_weights == 1)
    # Open edges are reported first.
    bad_edges = edges[is_open] if is_open.any() else edges
    example = " and ".join(format_vector(vertex) for vertex in vertices[bad_edges[0]])
    if is_open.any():
        if is_nonorientable(faces):
            raise MeshError(
                "the mesh has one side only, as a Moebius strip has, so that nothing is inside of "
                "it: give it a thickness first, in the program that made it"
            )
        raise MeshError(
            f"the mesh is not closed: {int(is_open.sum()):,} edges have one face alone, such as "
            f"that between {example}; harnack.repair(mesh) closes holes. Welding vertices that are "
            "apart by more than rounding (mesh.merge_vertices(digits_vertex=...)) may be enough. "
            "harnack.WindingNumber draws any mesh as it is"
        )
    raise MeshError(
        f"the faces at {len(edges):,} edges do not agree on their two sides, such as at that "
        f"between {example}: trimesh.repair.fix_winding(mesh) turns faces that were reversed, and "
        "harnack.WindingNumber draws any mesh as it is"
    )
