"""Closed meshes: their conversion to and from solids of the library manifold3d (class `Manifold`,
which does Boolean operations), and other shapes as such solids."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry import Ball, Box, ConvexHull, HalfSpace, VolumeIntersection
from harnack.geometry.mesh_edges import row_dots
from harnack.geometry.outline_loops import Outline, scale_for_clipper
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.triangle_mesh import TriangleMesh
from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from manifold3d import CrossSection, Manifold

    from harnack.fields.solids.mesh_solid import MeshSolid
    from harnack.fields.solids.primitives import Cylinder
    from harnack.geometry import Volume

__all__ = [
    "ball_manifold",
    "box_manifold",
    "cylinder_manifold",
    "extruded_manifold",
    "from_manifold",
    "grown",
    "mesh_manifold",
    "polygon_factor",
    "revolved_manifold",
    "to_manifold",
    "volume_manifold",
    "without_short_edges",
]

# The largest number of segments around a ball or a solid of revolution.
_MAX_SEGMENTS = 2000
# The area of a union may differ from the area of the solid's boundary by the first, relative to it.
# Otherwise, and where triangles of the union cross, the faces of parts are moved outwards by the
# second, relative to the size. At sharp corners vertices are moved by at most that divided by the
# third.
_AREA_TOLERANCE, _GROWTH, _MIN_COSINE = 1e-6, 1e-9, 0.1
# The largest area of a twisted outline, in squares of the longest permitted edge.
_MAX_CELLS = 1_000_000


def to_manifold(surface: TriangleMesh) -> Manifold:
    """Convert a closed mesh to the manifold3d solid that it bounds. The faces of the mesh run
    counter-clockwise as seen from outside of the solid. A mesh without faces gives the empty solid.

    Raises:
        MeshingError: the mesh is not closed.
    """
    from manifold3d import Error, Manifold, Mesh64

    if not len(surface.faces):
        return Manifold()
    vertices = np.ascontiguousarray(surface.vertices, np.float64)
    body = Manifold(Mesh64(vertices, np.ascontiguousarray(surface.faces, np.uint64)))
    if body.status() != Error.NoError:
        raise MeshingError(
            f"a surface of the solid is not closed ({body.status().name}): cells are too large for "
            "it; choose a smaller `cell_size`"
        )
    return body


def mesh_manifold(solid: MeshSolid) -> Manifold | None:
    """Convert a `MeshSolid` to a manifold3d solid. If its mesh intersects itself, the result is the
    union of the solids of the mesh's components, or None if a component intersects itself or is a
    cavity.

    Where components touch each other only up to rounding, their union may have gaps as thin as
    rounding, whose walls add to the area, or triangles that cross. So if the area of the union
    differs from the area of the solid's boundary, or if triangles of the union cross, the faces of
    all components are first moved outwards by a tiny length. If triangles cross then too, the first
    union of the right area is returned, or None if there is none.

    Raises:
        MeshingError: more than two faces meet at an edge.
    """
    from manifold3d import Error, Manifold, Mesh64, OpType

    surface = solid.surface
    # Copies, which can be written to; vertices are the input's, bit by bit.
    body = Manifold(Mesh64(np.array(solid.vertices), np.array(surface.faces, np.uint64)))
    if body.status() != Error.NoError:
        raise MeshingError(
            f"the faces of the mesh do not meet two by two at its edges ({body.status().name}): "
            "join its parts by trimesh.boolean.union, or move them apart"
        )
    # All triangles bound the solid: the mesh does not intersect itself.
    if surface.boundary_triangles is None:
        return body
    parts = body.decompose()
    for part in parts:
        boundary = from_manifold(part)
        if part.volume() <= 0 or len(intersecting_faces(boundary.vertices, boundary.faces)):
            return None
    first_union: Manifold | None = None
    for length in (0.0, _GROWTH * surface.size):
        union = Manifold.batch_boolean([_grown_part(part, length) for part in parts], OpType.Add)
        if abs(union.surface_area() - surface.area) <= _AREA_TOLERANCE * surface.area:
            first_union = first_union or union
            boundary = from_manifold(union)
            if not len(intersecting_faces(boundary.vertices, boundary.faces)):
                return union
    return first_union


def _grown_part(part: Manifold, length: float) -> Manifold:
    """The solid `part` with its faces moved outwards by about `length`; `part` itself if the length
    is 0."""
    return part if length == 0 else to_manifold(grown(from_manifold(part), length))


def grown(surface: TriangleMesh, length: float) -> TriangleMesh:
    """A closed surface with its vertices moved outwards along their normals, so far that faces move
    by about `length`. Components that touched only up to rounding then overlap. A negative length
    moves them inwards."""
    import trimesh  # imported here: it takes half a second

    x, faces = surface.vertices, surface.faces
    mesh = trimesh.Trimesh(x, faces, process=False)
    normals = np.array(mesh.vertex_normals)
    # The smallest cosine between a vertex normal and the faces there: a move by length / cosine
    # moves the face by the length.
    cosine = np.ones(len(normals))
    for k in range(3):
        np.minimum.at(cosine, faces[:, k], row_dots(normals[faces[:, k]], mesh.face_normals))
    return TriangleMesh(x + normals * (length / np.maximum(cosine, _MIN_COSINE))[:, None], faces)


def without_short_edges(solid: Manifold, length: float) -> Manifold:
    """Remove short edges and slivers (thin triangles) of a solid, which moves its surface by up to
    `length`. If that changes the volume by more than 2 * length * area, the solid is returned as it
    was: manifold3d may lose a part of a solid with slivers as thin as rounding."""
    simpler = solid.simplify(length)
    max_change = 2 * length * solid.surface_area()
    return simpler if abs(simpler.volume() - solid.volume()) <= max_change else solid


def from_manifold(manifold: Manifold) -> TriangleMesh:
    """Convert the surface of a manifold3d solid to a triangle mesh."""
    mesh = manifold.to_mesh64()
    vertices = np.array(mesh.vert_properties, np.float64)[:, :3]
    return TriangleMesh(vertices, np.array(mesh.tri_verts, np.int64))


def box_manifold(lower: FloatArray, upper: FloatArray) -> Manifold:
    """The box between the corners `lower` and `upper`, (3,) each, as a manifold3d solid."""
    from manifold3d import Manifold

    x, y, z = (float(v) for v in upper - lower)
    a, b, c = (float(v) for v in lower)
    return Manifold.cube((x, y, z)).translate((a, b, c))


def polygon_factor(around: int) -> float:
    """The radius of the circle through the corners of a regular polygon that has the area of the
    unit circle."""
    angle = 2 * math.pi / around
    return math.sqrt(angle / math.sin(angle))


def cylinder_manifold(cylinder: Cylinder, level: float, tolerance: float) -> Manifold | None:
    """The points where the function of a cylinder is at most `level`, as a manifold3d solid. None
    if the level is positive, since the edges of a cylinder that grows are round, or if it has no
    ends. Cross sections have the right area; corners are outside of the surface, and the middles of
    edges inside, by less than `tolerance` (a length)."""
    from manifold3d import Manifold

    if level > 0 or cylinder.height is None:
        return None
    radius, height = cylinder.radius + level, cylinder.height + 2 * level
    if radius <= 0 or height <= 0:
        return Manifold()
    # Corners are about radius (2 pi/n)^2/12 outside, and edges half as much inside.
    around = max(8, math.ceil(2 * math.pi * math.sqrt(radius / (12 * tolerance))))
    while (polygon_factor(around) - 1) * radius > tolerance:
        around += 1
    if around > _MAX_SEGMENTS:
        raise MeshingError(
            f"a cylinder within {tolerance:.3g} has {around:,} faces: choose a larger `tolerance`"
        )
    corner = radius * polygon_factor(around)
    return Manifold.cylinder(height, corner, circular_segments=around, center=True)


def extruded_manifold(
    outline: Outline, height: float, twist: float, taper: float, tolerance: float
) -> Manifold:
    """A plane outline, extruded from z = 0 to z = height, as a manifold3d solid. The cross-section
    at the upper end is the outline turned by `twist` degrees and scaled by the factor `taper`; in
    between both change in proportion to z.

    Without a twist the faces are flat, and exact. With a twist the vertices lie on the exact
    surface, and faces are within `tolerance` (a length) of it. Proof. Take a triangle of the
    straight extrusion with edges of at most L, and the map that turns and scales the extrusion. Let
    M bound the second derivatives of the map along lines. The triangle lies in a ball of radius
    L/sqrt(3), so that linear interpolation of the map between the corners errs by at most M/2 times
    the square of that radius, M L^2/6. Let the map turn by the angle a (in radians) and change the
    scale by k, both per unit of z, at distances up to R from the axis. Then M = q (a + a^2 R) + k
    (1 + 2 a R), with q = max(1, taper).

    Raises:
        MeshingError: the tolerance is so small that there are millions of faces.
    """
    # The outline is enlarged by the factor `scale`, and the result is scaled back at the end.
    section, scale = _cross_section(outline)
    inverse_scale = (1 / scale, 1 / scale, 1 / scale)
    if twist == 0:  # neither intermediate sections (0) nor a twist (0.0)
        return section.extrude(height * scale, 0, 0.0, (taper, taper)).scale(inverse_scale)
    rate, growth = math.radians(twist) / height, (taper - 1.0) / height
    radius = max(float(np.linalg.norm(loop, axis=1).max()) for loop in outline)
    turn, q = abs(rate), max(1.0, taper)
    second_derivative = q * (turn + turn**2 * radius) + abs(growth) * (1 + 2 * turn * radius)
    # M L^2/6 = tolerance.
    max_edge = math.sqrt(6 * tolerance / second_derivative)
    straight = section.extrude(height * scale)
    # The area in squares of the longest edge; each square has about four triangles.
    square_count = straight.surface_area() / (scale * max_edge) ** 2
    if square_count > _MAX_CELLS:
        raise MeshingError(
            f"a twisted outline within {tolerance:.3g} has about {4 * square_count:,.0f} faces: "
            "choose a larger `tolerance`"
        )

    def mapped(points: FloatArray) -> FloatArray:
        """Turn and scale points (n, 3) of the straight extrusion in proportion to their height."""
        z = points[:, 2] / scale
        # c and s are the cosine and the sine of the angle of the turn.
        factor, c, s = 1 + growth * z, np.cos(rate * z), np.sin(rate * z)
        x, y = factor * points[:, 0], factor * points[:, 1]
        return np.column_stack([c * x - s * y, s * x + c * y, points[:, 2]])

    return straight.refine_to_length(max_edge * scale).warp_batch(mapped).scale(inverse_scale)


def revolved_manifold(outline: Outline, tolerance: float) -> Manifold:
    """An outline in the (r, z) plane, revolved about the z axis, as a manifold3d solid. Vertices
    lie on the exact surface, and faces are within `tolerance` (a length) of it. Proof. If a circle
    of radius r is divided into n segments, a chord is at most r (1 - cos(pi/n)) <= r (pi/n)^2/2
    from its arc.

    Raises:
        MeshingError: the tolerance is so small that there are too many segments.
    """
    radius = max(float(loop[:, 0].max()) for loop in outline)
    # From r (pi/n)^2/2 <= tolerance, rounded up to a multiple of 4.
    segments = 4 * math.ceil(0.25 * math.pi * math.sqrt(radius / (2 * tolerance)))
    if segments > _MAX_SEGMENTS:
        raise MeshingError(
            f"an outline of radius {radius:g} revolved within {tolerance:.3g} has {segments:,} "
            "segments around: choose a larger `tolerance`"
        )
    # The outline is enlarged by the factor `scale`, and the result is scaled back.
    section, scale = _cross_section(outline)
    return section.revolve(max(16, segments)).scale((1 / scale, 1 / scale, 1 / scale))


def _cross_section(outline: Outline) -> tuple[CrossSection, float]:
    """Returns two results: the manifold3d cross-section of an outline, scaled so that manifold3d
    does not round its coordinates (`scale_for_clipper`); and the factor by which it was scaled."""
    from manifold3d import CrossSection

    loops, scale = scale_for_clipper(outline)
    return CrossSection(loops), scale


def volume_manifold(
    volume: Volume, lower: FloatArray, upper: FloatArray, tolerance: float
) -> Manifold:
    """The part of a volume in the box from `lower` to `upper`, (3,) each, as a manifold3d solid.
    Polytopes are exact; a ball becomes a polyhedron whose vertices lie on the sphere and whose
    faces are within `tolerance` of it.

    Raises:
        MeshingError: the volume is neither a box, a ball, a half-space, a convex hull nor an
            intersection of these; or a ball would have millions of faces.
    """
    from manifold3d import Manifold

    manifold = box_manifold(lower, upper)
    if isinstance(volume, VolumeIntersection):
        for operand in volume.volumes:
            manifold ^= volume_manifold(operand, lower, upper, tolerance)
        return manifold
    if isinstance(volume, Box):
        low, high = (np.array(end, np.float64) for end in volume.bounds())
        low, high = np.maximum(low, lower), np.minimum(high, upper)
        return box_manifold(low, high) if (low < high).all() else Manifold()
    if isinstance(volume, HalfSpace | ConvexHull):
        for row in volume.planes():
            # A half-space x . n <= h; manifold3d keeps the side to which its normal points.
            x, y, z, h = (float(v) for v in row)
            manifold = manifold.trim_by_plane((-x, -y, -z), -h)
        return manifold
    if isinstance(volume, Ball):
        return manifold ^ ball_manifold(volume, tolerance)
    raise MeshingError(
        f"{with_article(type(volume).__name__)} cannot cut a mesh: give a box or a ball"
    )


def ball_manifold(ball: Ball, tolerance: float) -> Manifold:
    """A ball as a manifold3d solid: a geodesic polyhedron whose vertices lie on the sphere and
    whose faces are within `tolerance` (a length) of it.

    Proof. Let n be the number of segments around, and r the radius. The octahedron's faces are
    divided into equilateral triangles, whose vertices are then moved onto the sphere. A side of the
    octahedron becomes n/4 edges along a quarter of a great circle; their mean length is (r
    pi/2)/(n/4) = 2 pi r/n. All edges are at most sqrt(3) times as long. So the circle through the
    corners of a triangle has a radius of at most c = edge/sqrt(3) <= 2 pi r/n, and the triangle is
    at most c^2/(2 r) from the sphere.

    Raises:
        MeshingError: the tolerance is so small that there are millions of faces.
    """
    from manifold3d import Manifold

    r = ball.radius
    # A side of the octahedron becomes segments/4 edges, so each of its 8 faces becomes
    # (segments/4)^2 faces.
    # From (2 pi r/n)^2/(2 r) <= tolerance, rounded up to a multiple of 4.
    segments = 4 * math.ceil(0.25 * 2 * math.pi * math.sqrt(r / (2 * tolerance)))
    if segments > _MAX_SEGMENTS:
        raise MeshingError(
            f"a ball of radius {r:g} within {tolerance:.3g} has {segments**2 // 2:,} faces: choose "
            "a larger `tolerance`"
        )
    x, y, z = ball.center
    return Manifold.sphere(r, max(16, segments)).translate((x, y, z))
