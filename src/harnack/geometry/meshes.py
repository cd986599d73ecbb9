"""Triangle meshes: validation, faces of zero area, and solid angles of triangles. A mesh is an
array (n, 3) of vertices and an array (m, 3) of faces, indices of vertices counted from 0. The
positive side of a face is the one from which its vertices run counter-clockwise. A mesh may have
holes, cross itself, repeat faces or reverse them; no face need be joined to another."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend.validation import (
    TRANSPOSE_ADVICE,
    BoolArray,
    FloatArray,
    IntArray,
    check_coordinate_size,
    check_finite,
    check_no_derivatives,
    check_vectors,
    format_vector,
    others_suffix,
)

__all__ = [
    "MeshError",
    "mesh_arrays",
    "solid_angles",
    "validate_mesh",
    "without_zero_area_faces",
    "zero_area_faces",
]

MAX_VERTICES = 100_000_000
MAX_FACES = 100_000_000

# Twice the area of a face, divided by the square of its longest edge, up to which the face counts
# as flat.
ZERO_AREA_RATIO = 8.0 * float(np.finfo(np.float64).eps)


class MeshError(ValueError):
    """A mesh cannot be used; the message says why and what to do."""


def mesh_arrays(mesh: Any) -> tuple[Any, Any]:
    """Return the vertices (n, 3) and the faces (m, 3) of a mesh as they are, not validated yet.

    mesh: an object with the attributes `vertices` and `faces`, such as a trimesh.Trimesh; or a pair
        (vertices, faces).

    Raises:
        TypeError: the argument is neither. The message says which pairs to give for meshes of
            other libraries.
    """
    if hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        return mesh.vertices, mesh.faces
    pair: Any = mesh
    if isinstance(mesh, tuple | list) and len(pair) == 2:
        return pair[0], pair[1]
    raise TypeError(
        "a mesh is a trimesh.Trimesh, a pair (vertices, faces) or, where files are read, the path "
        f"of a file, not of type {type(pair).__name__}. Of other libraries give the pair: "
        "(mesh.points, mesh.regular_faces) of PyVista, (mesh.vertices, mesh.triangles) of Open3D, "
        '(mesh.points, mesh.cells_dict["triangle"]) of meshio'
    )


def validate_mesh(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, *, allow_zero_area: bool = False
) -> tuple[FloatArray, IntArray]:
    """Validate a mesh. Returns vertices (n, 3) float64 and faces (m, 3) int64: copies that cannot
    be written to. Vertices that no face uses are kept, and checked like all others.

    allow_zero_area: whether faces may have zero area, as those faces of closed meshes that only
        join other faces.

    Raises:
        MeshError: not numbers of these shapes, faces that are not triangles of integers, an empty
            mesh; a coordinate that is not finite; an index without a vertex; a face of zero area as
            `zero_area_faces` defines it; sizes whose squares overflow or vanish.
    """
    x, triangles = _checked_arrays(vertices, faces)
    is_flat, longest = _measure_faces(x, triangles)
    if is_flat.any() and not allow_zero_area:
        raise MeshError(_zero_area_message(x, triangles, np.flatnonzero(is_flat)))
    _check_size(longest)
    x.setflags(write=False)
    triangles.setflags(write=False)
    return x, triangles


def zero_area_faces(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> IntArray:
    """Find the faces that count as faces of zero area; returns their indices (k,). Twice the area
    of such a face is at most 2^-49 (8 units in the last place) of the square of its longest edge.
    So up to the rounding of a cross product, its vertices lie on a line, or two of them are equal.
    This depends neither on the scale nor on the position of the mesh. Such a face has no reliable
    normal.

    Raises:
        MeshError: the mesh is not valid, apart from faces of zero area (see `validate_mesh`).
    """
    # (The first result is the mask of faces of zero area.)
    return np.flatnonzero(_measure_faces(*_checked_arrays(vertices, faces))[0])


def without_zero_area_faces(
    vertices: npt.ArrayLike, faces: npt.ArrayLike
) -> tuple[FloatArray, IntArray]:
    """The mesh without its faces of zero area (see `zero_area_faces`): vertices (n, 3) float64 and
    faces (k, 3) int64, copies that cannot be written to. All vertices stay, so indices keep their
    meaning.

    A face of zero area adds nothing to a winding number. If it filled a gap of zero width (where a
    vertex lies in the middle of a neighboring face's edge), the edges on the two sides of that gap
    become boundary edges at the same place. They still cancel in every sum. But they count as
    boundary edges, so that distances to boundary edges become smaller than necessary.

    Raises:
        MeshError: the mesh is not valid, apart from faces of zero area (see `validate_mesh`); or no
            face has an area.
    """
    x, triangles = _checked_arrays(vertices, faces)
    is_flat, longest = _measure_faces(x, triangles)
    if is_flat.all():
        raise MeshError(
            f"all {len(triangles):,} faces have zero area: the vertices of each lie on a line; "
            "check which column of the faces is which, and that coordinates were not rounded away"
        )
    _check_size(longest)
    proper_faces = triangles[~is_flat]
    x.setflags(write=False)
    proper_faces.setflags(write=False)
    return x, proper_faces


def solid_angles(corners: FloatArray, point: FloatArray) -> FloatArray:
    """The solid angles (m,) of triangles with corners (m, 3, 3) as seen from a point (3,), between
    -2 pi and 2 pi (Van Oosterom and Strackee 1983). They are positive if the point is on the
    negative side of the triangle. Their sum over a mesh, divided by 4 pi, is the winding number of
    the mesh."""
    a, b, c = (corners[:, k] - point for k in range(3))
    # The vectors a, b, c from the point to the corners, their lengths, and their dot products.
    x, y, z = (np.sqrt(np.einsum("ij,ij->i", offset, offset)) for offset in (a, b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, c), (c, a)))
    denominator = x * y * z + ab * z + bc * x + ca * y
    return 2 * np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), denominator)


def _checked_arrays(vertices: Any, faces: Any) -> tuple[FloatArray, IntArray]:
    """Convert vertices to a new float64 array (n, 3) of finite numbers, and faces to a new int64
    array (m, 3) of valid indices. Raises `MeshError` if that is not possible."""
    x = checked_vertices(
        _as_array(vertices, "the vertices", "every vertex needs three coordinates")
    )
    triangles = _as_faces(faces, len(x))
    return x, triangles


def checked_vertices(array: npt.NDArray[Any]) -> FloatArray:
    """Convert an array of vertices to a new float64 array (n, 3) of finite numbers. Raises
    `MeshError` if that is not possible."""
    if array.size == 0:
        raise MeshError("there are no vertices: give an array (n, 3)")
    if array.dtype.kind not in "fiu":
        raise MeshError(f"the vertices must be real numbers, not {array.dtype}")
    check_vectors(array, "the vertices", MeshError, transposed=TRANSPOSE_ADVICE)
    if len(array) > MAX_VERTICES:
        raise MeshError(f"{len(array):,} vertices are too many: at most {MAX_VERTICES:,}")
    x = np.array(array, dtype=np.float64, order="C")
    advice = "coordinates must be finite; remove it and the faces that use it"
    check_finite(x, "vertex {}", MeshError, advice)
    check_coordinate_size(x, MeshError)
    return x


def _as_faces(faces: Any, count: int) -> IntArray:
    """Convert faces to a new int64 array (m, 3) of indices below `count`, the number of vertices.
    Raises `MeshError` if that is not possible."""
    array = _as_array(faces, "the faces", "every face needs three indices; triangulate polygons")
    if array.size == 0:
        raise MeshError("there are no faces: give an array (m, 3) of vertex indices")
    if array.ndim != 2 or array.shape[1] != 3:
        hint = ""
        if array.ndim == 2 and array.shape[1] == 4:
            hint = ": these look like quadrilaterals, triangulate them (a b c d -> a b c, a c d)"
        elif array.ndim == 2 and array.shape[0] == 3:
            hint = ": transpose it"
        raise MeshError(f"the faces must have shape (m, 3), not {array.shape}{hint}")
    if array.dtype.kind not in "iu":
        hint = ": convert them with .astype(int)" if array.dtype.kind == "f" else ""
        raise MeshError(f"the faces must be integer indices of vertices, not {array.dtype}{hint}")
    if len(array) > MAX_FACES:
        raise MeshError(f"{len(array):,} faces are too many: at most {MAX_FACES:,}; decimate them")
    _check_range(array, count)
    return np.array(array, dtype=np.int64, order="C")


def _check_range(faces: npt.NDArray[Any], count: int) -> None:
    """Raise `MeshError` if a face (m, 3) has an index outside of [0, count)."""
    if int(faces.min()) >= 0 and int(faces.max()) < count:
        return
    outside = (faces < 0) | (faces >= count)
    bad = np.flatnonzero(outside.any(axis=1))
    first = faces[bad[0]]
    index = int(first[outside[bad[0]]][0])
    hint = ""
    if index == count and int(faces.min()) == 1:
        hint = "; these indices seem to count from 1: subtract 1"
    raise MeshError(
        f"face {bad[0]} is {tuple(map(int, first))}{others_suffix(bad.size)}, but vertex {index} "
        "is "
        f"out of range: there are {count:,} vertices, counted from 0{hint}"
    )


def _as_array(values: Any, name: str, ragged: str) -> npt.NDArray[Any]:
    """Convert values to a NumPy array of numbers.

    name: what they are, for messages.
    ragged: the end of the message for rows of different lengths.

    Raises:
        MeshError: they are no array of numbers.
        NotImplementedError: they carry derivatives, which would be lost.
    """
    check_no_derivatives(name, values)
    try:
        array = np.asarray(values)
    except (ValueError, OverflowError):
        raise MeshError(f"{name} are ragged: {ragged}") from None
    if array.dtype == object:
        raise MeshError(f"{name} are no array of numbers: {ragged}")
    return array


def _measure_faces(x: FloatArray, faces: IntArray) -> tuple[BoolArray, FloatArray]:
    """Two results for each face: whether it counts as a face of zero area, (m,); and the largest
    difference of two of its vertices in any coordinate, (m,). Edges are scaled before they are
    multiplied, so that nothing overflows or underflows.

    x: (n, 3) the vertices.
    faces: (m, 3).
    """
    a, b, c = (np.ascontiguousarray(x[corner].T) for corner in faces.T)
    u, v, w = b - a, c - a, c - b  # (3, m) each: rows are x, y, z
    longest = np.max([np.abs(edge).max(axis=0) for edge in (u, v, w)], axis=0)
    scale = np.where(longest > 0.0, longest, 1.0)
    u, v, w = u / scale, v / scale, w / scale
    normal = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
    twice_area = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    longest_square = np.max([(edge * edge).sum(axis=0) for edge in (u, v, w)], axis=0)
    return twice_area <= ZERO_AREA_RATIO * longest_square, longest


def _check_size(longest: FloatArray) -> None:
    """Raise a MeshError for a face so small that squares of its edges underflow.

    longest: (m,) the largest difference of two vertices of each face in any coordinate. It is 0 for
        faces whose vertices are equal, which are not reported here.
    """
    small = np.flatnonzero((longest > 0.0) & (longest < 1e-100))
    if small.size:
        raise MeshError(
            f"the edges of face {small[0]}{others_suffix(small.size)} are only "
            f"{longest[small[0]]:g} long: choose units nearer to 1, or remove it"
        )


def _zero_area_message(x: FloatArray, faces: IntArray, flat: IntArray) -> str:
    """The text of an error message about faces of zero area.

    x, faces: (n, 3), (m, 3) the mesh.
    flat: the indices of the faces of zero area.
    """
    a, b, c = (x[k] for k in faces[flat[0]])
    corners = ", ".join(format_vector(corner) for corner in (a, b, c))
    repeated = bool((a == b).all() or (b == c).all() or (c == a).all())
    why = "two of its vertices are equal" if repeated else "its vertices lie on a line"
    count = f"{flat.size:,} of {len(faces):,} faces have" if flat.size > 1 else "one face has"
    return (
        f"{count} zero area, first face {flat[0]} with vertices {corners}: {why}; "
        "harnack.geometry.without_zero_area_faces(vertices, faces) removes such faces"
    )
