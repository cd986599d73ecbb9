"""Closed triangle meshes made solid: `MeshSolid`, the signed distance from their surface.

`ClosedSurface.of` gives the faces of a mesh that bound the solid, and refuses meshes that bound
none.

Signs of meshes come from crossings: normals of edges and vertices, weighted by angles, say nothing
beside triangles as thin as rounding; a ray whose edges are decided by the same bits on both sides
does, and takes a thirtieth of the time of the search for the nearest triangle.
"""

from __future__ import annotations

import copy
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
from harnack.fields.batched_fields import cached_prepare
from harnack.fields.clearance import UnitFrame, frame_parameters, round_to_single
from harnack.fields.formula import is_jet
from harnack.fields.samples import Ray as Ray
from harnack.fields.samples import RaySample, Sample
from harnack.fields.solids.solid import Solid, box_around, set_frozen
from harnack.files.geometry_files import GEOMETRY_SUFFIXES, LoadedMesh, read_geometry
from harnack.geometry import MeshError, validate_mesh, zero_area_faces
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
# Of a signed distance the gradient is a unit vector wherever it exists.
_STEEP = 0.99
# How far rounding may move a distance, in epsilons of coordinates and of the mesh's size, by
# `tree.closest_triangles.distance_lower_bound`.
_ROUNDING = 16.0
# Coordinates in jets that are known only up to more roundings are ranges.
_ROUNDED_BY = 256.0
# The nearest triangle decides the side only where the distance is so many times its error.
_CLEAR_ROUNDINGS = 8.0


def solid_of_mesh(given: Any) -> MeshSolid:
    """The solid of a mesh: anything with `vertices` and `faces`, a pair of these, or the path of a
    surface file.

    Raises:
        MeshError: the mesh bounds no solid; the message says why, and what to do.
        FileFormatError: a file that cannot be read.
        TypeError: it is no mesh.
    """
    if isinstance(given, str | os.PathLike):
        surface = read_geometry(cast("Any", given), "winding")
        if not isinstance(surface, LoadedMesh):
            raise MeshError(f"{given}: it holds no faces, so it bounds no solid")
        faces = np.concatenate([surface.faces, surface.zero_area_faces])
        return MeshSolid(surface.vertices, faces)
    mesh: Any = given
    if hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        return MeshSolid(mesh.vertices, mesh.faces)
    if isinstance(given, tuple | list) and len(cast("Any", given)) == 2:
        vertices, faces = cast("Any", given)
        return MeshSolid(vertices, faces)
    raise TypeError(
        "a mesh is a trimesh.Trimesh, a pair (vertices, faces), or the path of a file, not of type "
        f"{type(mesh).__name__}"
    )


def looks_like_mesh(given: Any) -> bool:
    """Whether something is meant as a mesh: by its attributes, as a pair, or as a file's name."""
    if isinstance(given, str | os.PathLike):
        return Path(cast("Any", given)).suffix.lower() in GEOMETRY_SUFFIXES
    if hasattr(given, "vertices") and hasattr(given, "faces"):
        return True
    return isinstance(given, tuple | list) and len(cast("Any", given)) == 2


@dataclass(frozen=True, eq=False)
class MeshSolid(Solid):
    """The points inside of a closed triangle mesh: f is the signed distance from its surface.

    vertices: (n, 3). faces: (m, 3), indices of vertices, counter-clockwise as seen from outside.
        Vertices at the same place are one, and at open edges those that are apart by rounding
        (`geometry.welding`); faces may have zero area.

    A mesh that crosses or holds itself is the solid of the points around which it winds more than
    1/2 times, the union where its parts overlap or touch; f is the distance from the boundary of
    that.

    |f| is the distance from the nearest triangle, by a tree; so its constant is 1. It is off by at
    most 16 epsilons of the size of the mesh and the distance from its center
    (`tree.closest_triangles.ClosestPointOnTriangle`).

    Proof of the sign. It is that of the winding number, the sum of the signs of the crossings of a
    ray along z (`tree.triangle_tree.signed_crossing`), and is right wherever the distance is more
    than its error e, also for rays through edges and vertices and for triangles without area. Of
    each triangle that the ray counts as crossed, a point lies within rounding of the ray at the
    depth that is compared with 0. Let C be a cylinder of that radius around the line; the ball of
    radius e about x has no point of the surface. So the part of a triangle in C, which is convex,
    lies ahead of x or behind it as a whole, and its depth says which. Edges that meet C ahead of x
    are edges of two triangles ahead, where the same bits decide on which side the ray passes, so
    that they cancel; all other edges are passed at more than rounding. So the sum is that of a ray
    in general position. Normals of edges and vertices, weighted by angles (Baerentzen and Aanaes
    2005), would need no ray, but have no direction to trust beside triangles as thin as rounding.

    Where the nearest point is inside of a triangle, its normal says the same without a ray. Proof:
    from x down to that point, and beside it, the ball about x is free of the surface, so that x is
    on that side of the triangle. If rounding has taken an edge for the inside, all other triangles
    there lie at more than a right angle from x (else they would be nearer), so that the first that
    is met, turning from x, is this one.

    Raises:
        MeshError: a mesh that is not closed, whose faces do not agree on its two sides, that is
            inside out somewhere, or whose faces lie on each other up to rounding and not exactly;
            the message says what to do.
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
        """What of the mesh bounds the solid."""
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
        """The box of the mesh, wider by the level. Proof: a ball of radius -level about a point
        deeper than that is inside, and so within the box."""
        if above:
            return None
        surface = self.surface
        low, high = (surface.center + surface.size * end for end in surface.box)
        half, middle = 0.5 * (high - low) + level, 0.5 * (high + low)
        x, y, z = (float(one) for one in half)
        return box_around((x, y, z), tuple(float(one) for one in middle))

    @cached_prepare
    def prepare(self, backend: Backend) -> MeshSolid:
        made = copy.copy(self)
        set_frozen(made, "_on_device", _MeshData.upload(backend, self.surface))
        return made

    def evaluate(self, p: Vec3) -> Sample:
        buffers, kept = _on(self, p), _SAMPLE_CACHE.get()
        if kept is None or dr.flag(dr.JitFlag.SymbolicScope):
            return buffers.sample(p)
        key = id(buffers), p.x.index, p.y.index, p.z.index
        if key not in kept:
            kept[key] = p, buffers.sample(p)  # with p, so that its indices name nothing else
        return kept[key][1]

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        del ahead, back
        look = path.enclose(self.evaluate(path.point(t)))
        return RaySample(
            look.sample,
            look.forward,
            look.backward,
            look.slope,
            look.reach_growth,
            min_gradient_norm=_STEEP,
        )

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        if not is_jet(x, type(self).__name__):
            return self.differentiable_value(backend_of(x).Array3f(x, y, z))
        return mesh_distance_jet(self, x, y, z)


_SAMPLE_CACHE: ContextVar[dict[tuple[int, ...], tuple[Vec3, Sample]] | None] = ContextVar(
    "kept samples", default=None
)


@contextmanager
def share_samples() -> Generator[None]:
    """Within this context, a mesh is sampled only once at the same Dr.Jit points, so that a shell
    and a lattice made from one mesh share one nearest-triangle search.

    Inactive while loops are recorded, as their values are defined inside the loop only.
    """
    token = _SAMPLE_CACHE.set({})
    try:
        yield
    finally:
        _SAMPLE_CACHE.reset(token)


def _on(solid: Any, like: Any) -> _MeshData:
    """The solid's data on the backend of some number or point."""
    if not hasattr(solid, "_on_device"):
        solid = solid.prepare(backend_of(like))
    return solid._on_device


@dataclass(frozen=True)
class _MeshData(UnitFrame):
    """The triangles on a backend.

    rays: of all faces, closed. near: of those that bound the solid, in whatever pieces.
    corners: nine numbers of each of the latter. low, high: their box.
    """

    rays: TriangleTree
    near: TriangleTree
    corners: RecordTable
    low: Vec3
    high: Vec3

    @classmethod
    def upload(cls, backend: Backend, surface: ClosedSurface) -> _MeshData:
        vertices, faces, weights = surface.vertices, surface.faces, surface.weights
        near = rays = _tree(
            backend, vertices, faces, weights, slabs=surface.boundary_triangles is None
        )
        if surface.boundary_triangles is not None:
            points = surface.boundary_triangles.reshape(-1, 3)
            numbers = np.arange(len(points)).reshape(-1, 3)
            near = _tree(backend, points, numbers, np.ones(len(numbers)), slabs=True)
        corners = RecordTable.upload(backend, surface.corners.reshape(-1, 9))
        low, high = (
            backend.Array3f(*(dr.opaque(backend.Float, float(v)) for v in end))
            for end in surface.box
        )
        place = frame_parameters(backend, surface.center, surface.size)
        return cls(*place, rays=rays, near=near, corners=corners, low=low, high=high)

    def sample(self, p: Vec3) -> Sample:
        """The sample of the signed distance."""
        x = self.to_unit(p)
        return self._sample(p, x, self._nearest(x))

    def sample_with_feature(self, p: Vec3) -> tuple[Sample, Vec3, Mask, Mask]:
        """The sample; a unit vector along the edge on which the nearest point lies; and whether
        that is an edge, and whether a vertex. It is neither inside of a triangle."""
        vector = self.backend.Array3f
        x = self.to_unit(p)
        found = self._nearest(x)
        row = self.corners.read_record(found.triangle, found.triangle != NO_TRIANGLE)
        ends = [vector(*row[k : k + 3]) - (x + found.offset) for k in (0, 3, 6)]
        close = _ROUNDING * self.backend.machine_epsilon * (1 + dr.max(dr.abs(x)))
        at_vertex, along, least = self.backend.Bool(False), vector(0), self.backend.Float(dr.inf)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            edge = ends[b] - ends[a]
            length = dr.norm(edge)
            off = dr.norm(dr.cross(ends[a], edge)) / length
            along = dr.select(off < least, edge / length, along)
            least = fmin(off, least)
            at_vertex |= dr.norm(ends[a]) <= close
        on_edge = ~found.is_inner & ~at_vertex
        return self._sample(p, x, found), along, on_edge, ~found.is_inner & at_vertex

    def _nearest(self, x: Vec3) -> ClosestTriangle:
        backend = self.backend
        limit = initial_squared_distance(self.near, x)
        before = backend.Float(-1), backend.UInt32(NO_TRIANGLE)
        return next_closest_triangle(self.near, x, before, limit, backend.Bool(True))

    def _sample(self, p: Vec3, x: Any, found: ClosestTriangle) -> Sample:
        backend = self.backend
        real, vector, epsilon = backend.Float, backend.Array3f, backend.machine_epsilon
        distance = dr.sqrt(found.squared_distance)
        error = _ROUNDING * epsilon * (1 + dr.max(dr.abs(x)))

        steep = dr.norm(found.normal)
        has_area = steep > 0
        normal = dr.select(has_area, found.normal / steep, vector(0, 0, 1))
        height = -dr.dot(found.offset, normal)  # of x above the triangle's plane
        by_normal = found.is_inner & (distance > _CLEAR_ROUNDINGS * error)
        by_normal &= 2 * dr.abs(height) > distance
        inside = self._is_inside(x, ~by_normal)
        inside = dr.select(by_normal, height < 0, inside)
        sign = dr.select(inside, real(-1), real(1))

        # Across a face the direction is that of its normal, also where the distance is rounding.
        # Far from it the sign decides the side, as of a wall thinner than rounding both are near.
        on_face = (found.is_inner & has_area) | (distance == 0)
        side = dr.select(distance > error, sign * dr.mulsign(real(1), height), 1)
        gradient = dr.select(on_face, normal * side, -found.offset * (sign / distance))
        # Corners are rounded: that turns a triangle by as much over its height.
        turned = 8 * epsilon / steep
        doubt = dr.select(on_face, fmin(turned, 2), fmin(2 * error / distance, 2))
        doubt = dr.select((distance == 0) & ~has_area, 2, doubt)
        return Sample(
            sign * distance * self.size,
            gradient,
            (Lipschitz(0 * p.x + 1),),
            error * self.size,
            doubt,
        )

    def _is_inside(self, x: Vec3, asked: Mask) -> Mask:
        """Whether the winding number is above 1/2, where asked: by a ray along z, to the side on
        which less of the mesh lies."""
        inside = dr.all((x >= self.low) & (x <= self.high))
        way = dr.select(x.z > 0.5 * (self.low.z + self.high.z), self.backend.Float(1), -1)
        turns = self.rays.signed_crossings_vertical(x, way, asked & inside)
        return inside & (way * turns > 0.5)


def _tree(
    backend: Backend, vertices: FloatArray, faces: IntArray, weights: Any, *, slabs: bool
) -> TriangleTree:
    tree = build_balanced_tree(vertices[faces].mean(axis=1), leaf_size=_LEAF_SIZE)
    records = triangle_records(vertices, faces)
    records[:, PARITY_COLUMN] *= weights
    return TriangleTree.of(backend, tree, records, slabs=slabs)


def mesh_distance_jet(solid: MeshSolid, x: Jet, y: Jet, z: Jet) -> Jet:
    """The jet of a signed distance, of jets of coordinates.

    Proof. The distance has the constant 1, so a derivative in any variable is at most the length of
    that of (x, y, z), and the value is off by at most what the coordinates are at the start. On a
    piece there may be kinks, so that second derivatives have no bound. At a point they are those of
    the distance d from the nearest face, edge or vertex: 0, or 1/d across the gradient, and of an
    edge across that as well.
    """
    coordinates = (x, y, z)
    starts = [one if one.jet_at_start is None else one.jet_at_start for one in coordinates]
    zero = 0 * x.piece_length
    q = backend_of(zero).Array3f(*(zero + one.value.midpoint for one in starts))
    there, edge, on_edge, at_vertex = _on(solid, q).sample_with_feature(q)
    spread = sum((one.value.radius for one in starts), zero)
    off = there.value_error + spread
    # Of coordinates that are ranges, and not numbers with their rounding, another face may be
    # nearest.
    size = max_norm(q) + dr.abs(there.value)
    is_range = spread > _ROUNDED_BY * float(dr.epsilon(zero)) * size
    value = Interval(there.value, there.value).widened(1e-6, 0.0) + Interval(-off, off)

    def speeds(jets: Any) -> list[Real]:
        return [
            dr.sqrt(sum(dr.square(zero + one.first_derivatives[i].max_abs) for one in jets))
            * (1 + 1e-5)
            for i in range(len(x.first_derivatives))
        ]

    doubt = Interval(zero - there.gradient_error, zero + there.gradient_error)
    slopes = [Interval.point(one) + doubt for one in there.gradient]
    first: list[Interval] = []
    for i, most in enumerate(speeds(starts)):
        along = Interval(0.0, 0.0)
        for slope, one in zip(slopes, starts, strict=True):
            along = along + slope * one.first_derivatives[i]
        limits = Interval(-most, most)
        met = along.intersect(limits)
        low, high = (
            dr.select(is_range, a, b)
            for a, b in ((-most, zero + met.lower), (most, zero + met.upper))
        )
        first.append(Interval(low, high))

    def component(way: Vec3, jets: Any, i: int) -> Interval:
        total = Interval(0.0, 0.0)
        for one, jet in zip(way, jets, strict=True):
            total = total + Interval.point(one) * jet.first_derivatives[i]
        return total

    count = range(len(x.first_derivatives))
    upward = [component(there.gradient, starts, i) for i in count]
    onward = [component(edge, starts, i) for i in count]
    bend = dr.select(on_edge | at_vertex, 1 / there.value, 0)
    none = dr.select(is_range, dr.inf, zero)
    second: list[Interval] = []
    for k, (i, j) in enumerate(starts[0].hessian_indices()):
        across = -(upward[i] * upward[j])
        for one in starts:
            across = across + one.first_derivatives[i] * one.first_derivatives[j]
        across = across - onward[i] * onward[j] * Interval.point(dr.select(on_edge, 1.0, 0.0))
        along = Interval.point(zero + bend).widened(1e-5 + there.gradient_error) * across
        for slope, one in zip(slopes, starts, strict=True):
            along = along + slope * one.second_derivatives[k]
        second.append(along + Interval(-none, none))
    start = Jet(value, tuple(first), tuple(second), piece_length=starts[0].piece_length)
    if x.jet_at_start is None:
        return start
    ranges = tuple(Interval(-most, most) for most in speeds(coordinates))
    moved = value + range_times_length(ranges[0], x.piece_length)
    unknown = (Interval(zero - dr.inf, zero + dr.inf),) * len(x.second_derivatives)
    return Jet(moved, ranges, unknown, start, x.piece_length)


# The surface of a mesh.

# Of the mesh's size: triangles not as high as that are not asked what is beside them.
_THIN = 1e-9
# Of the area of a closed surface: the integral of its normal is 0 up to this.
_CLOSED = 1e-10
# Places of a triangle at which the winding numbers on both sides are the same.
_PROBE_POINTS = ((0.98, 0.01, 0.01), (0.01, 0.98, 0.01), (0.01, 0.01, 0.98))


@dataclass(frozen=True)
class ClosedSurface:
    """What of a mesh bounds a solid, in coordinates of at most about one: center + size times them
    are the real ones.

    vertices: (n, 3). faces: (m, 3), closed, no two alike; weights: (m,) how often each counts.
    boundary_triangles: (k, 3, 3) corners of triangles that bound the points of a winding number
        above 1/2; None if these are just the faces.
    box: the lowest and the highest coordinates of that boundary. area: of that boundary, a real
        one, what is there several times counted once.
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
        """(k, 3, 3) of the triangles that bound the solid."""
        return (
            self.vertices[self.faces]
            if self.boundary_triangles is None
            else self.boundary_triangles
        )

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> ClosedSurface:
        """Of a mesh.

        Raises:
            MeshError: it bounds no solid.
        """
        welded = Welded.of(vertices, faces)
        net = welded.net
        if not len(net.faces):
            raise MeshError("the mesh bounds no volume: every face is canceled by a reversed copy")
        if len(net.faces) >= MAX_TRIANGLES:
            raise MeshError(f"at most {MAX_TRIANGLES - 1:,} faces are possible: decimate the mesh")
        _check_closed(vertices, welded)
        used = vertices[np.unique(net.faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        size = float(2.0 ** np.ceil(np.log2(0.5 * float((high - low).max()))))
        center = round_to_single(0.5 * (low + high))
        unit = (vertices - center) / size

        def place(corners: FloatArray) -> str:
            return format_vector(center + size * corners.mean(axis=0))

        pieces, area = _boundary(unit, net.faces, net.multiplicity, place)
        corners = unit[net.faces] if pieces is None else pieces
        box = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        return cls(unit, net.faces, net.multiplicity, center, size, pieces, box, area * size**2)


def _boundary(
    unit: FloatArray, faces: IntArray, weights: IntArray, place: Callable[[FloatArray], str]
) -> tuple[FloatArray | None, float]:
    """The pieces of faces between winding numbers below and above 1/2, None if these are all faces,
    uncut; and the area that they have, what is there several times counted once.

    Pieces run counter-clockwise as seen from outside: where faces lie on each other, more of them
    turned one way than the other, each stands for the boundary.

    Triangles thinner than `_THIN` have no normal along which to look. They are kept with the
    others, if these are all faces; else whatever is found beside them moves the surface by no more.

    Raises:
        MeshError: the mesh is inside out, or faces lie on each other.
    """
    faces = np.repeat(faces, weights, axis=0)
    rays = _tree(choose_backend("double"), unit, faces, np.ones(len(faces)), slabs=False)
    whole = np.delete(faces, zero_area_faces(unit, faces), axis=0)
    same = rays
    if len(whole) < len(faces):
        same = _tree(choose_backend("double"), unit, whole, 1.0, slabs=False)
    pieces, _ = split_intersecting_faces(same, unit, whole)
    edges = pieces - np.roll(pieces, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    is_thick = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > _THIN * longest
    front, back = windings_of_sides(rays, pieces)
    low, high = np.minimum(front, back), np.maximum(front, back)
    if (odd := is_thick & (low < 0)).any():
        if (high[is_thick] <= 0).all():
            raise MeshError(
                "the mesh is inside out: its faces run clockwise as seen from outside; turn them "
                "by mesh.invert() or faces[:, ::-1]"
            )
        raise MeshError(
            f"a part of the mesh is inside out, such as near {place(pieces[odd][0])}: turn the "
            "faces of that part (trimesh.repair.fix_normals(mesh, multibody=True) tries), or take "
            "harnack.WindingNumber, which asks for no sides"
        )
    odd = np.zeros(len(pieces), np.bool_)
    for shares in _PROBE_POINTS:
        one, other = winding_numbers_of_sides(rays, pieces, shares)
        odd |= (one != low) | (other != high)
    on, jump = (low < 0.5) & (high > 0.5), high - low
    if not _is_closed(pieces[on], jump[on], is_thick[on]):
        odd |= jump != 1  # where parts are in contact, or faces there several times
    if (odd := odd & is_thick).any():
        raise MeshError(
            f"{int(odd.sum()):,} faces of the mesh lie on parts of others, such as near "
            f"{place(pieces[odd][0])}: join the parts that touch there, as trimesh.boolean.union "
            "does"
        )
    looks_in = front > back
    is_whole = on[is_thick].all() and len(pieces) == len(whole) and not looks_in[is_thick].any()
    if not is_whole and not on.any():
        raise MeshError("the mesh bounds no volume: its parts cancel each other")
    # In one place, as many more look out than in as the winding number jumps by.
    area = 0.5 * np.linalg.norm(np.cross(edges[on, 0], edges[on, 1]), axis=1) / jump[on]
    area = float((area * np.where(looks_in[on], -1.0, 1.0)).sum())
    turned = np.where(looks_in[:, None, None], pieces[:, ::-1], pieces)
    return None if is_whole else turned[on], area


def _is_closed(pieces: FloatArray, jump: FloatArray, is_thick: BoolArray) -> bool:
    """Whether triangles (k, 3, 3), several of which may be in one place, bound a volume; if the
    winding number jumps there by `jump` (k,) at each place.

    The integrals of the normal and of x_i n_j over a closed surface are 0, and its volume for i = j
    and else 0, by Gauss. What a piece in contact with another adds that ought to be left out is
    none of that. Of those in one place, as many more are turned one way as the other as it jumps
    by. Pieces that are not thick may count or not.
    """
    area = 0.5 * np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0])
    size = np.linalg.norm(area, axis=1)
    area = area / np.maximum(jump, 1)[:, None]
    moment = np.einsum("ki,kj->ij", pieces.mean(axis=1), area)
    off = moment - np.trace(moment) / 3 * np.eye(3)
    most = _CLOSED * size.sum() + 4 * size[~is_thick].sum()
    return bool(max(np.abs(area.sum(axis=0)).max(), np.abs(off).max()) <= most)


def _check_closed(vertices: FloatArray, welded: Welded) -> None:
    """Raise MeshError unless every edge is run as often one way as the other."""
    faces, edges, left = welded.net.faces, welded.edges, welded.weights
    if not len(edges):
        return
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, count = np.unique(ends, axis=0, return_counts=True)
    key = len(vertices)
    at = np.searchsorted(pairs @ [key, 1], np.sort(edges, axis=1) @ [key, 1])
    is_open = (count[at] == 1) & (left == 1)
    where = edges[is_open] if is_open.any() else edges
    first = " and ".join(format_vector(one) for one in vertices[where[0]])
    if is_open.any():
        if is_nonorientable(faces):
            raise MeshError(
                "the mesh has one side only, as a Moebius strip has, so that nothing is inside of "
                "it: give it a thickness first, in the program that made it"
            )
        raise MeshError(
            f"the mesh is not closed: {int(is_open.sum()):,} edges have one face alone, such as "
            f"that between {first}; harnack.repair(mesh) closes holes. Welding vertices that are "
            "apart by more than rounding (mesh.merge_vertices(digits_vertex=...)) may be enough. "
            "harnack.WindingNumber draws any mesh as it is"
        )
    raise MeshError(
        f"the faces at {len(edges):,} edges do not agree on their two sides, such as at that "
        f"between {first}: trimesh.repair.fix_winding(mesh) turns faces that were reversed, and "
        "harnack.WindingNumber draws any mesh as it is"
    )
