"""Meshes for pictures, tests and examples, and functions that damage meshes. A mesh is a pair of
vertices (n, 3), float64, and faces (m, 3), int64, which hold the indices of the corners of
triangles. It is closed, and faces run counter-clockwise as seen from outside. Functions that damage
a mesh take its faces and return other faces; `seed` makes their random choice repeatable."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from harnack.backend.validation import FloatArray, IntArray

__all__ = [
    "bumpy_sphere",
    "duplicate_faces",
    "flip_faces",
    "icosphere",
    "remove_faces",
    "torus_mesh",
]

MeshArrays: TypeAlias = tuple[FloatArray, IntArray]


def icosphere(subdivisions: int) -> MeshArrays:
    """The icosahedron in the unit sphere, with each face cut in four `subdivisions` times. It has
    20 * 4^subdivisions faces, and all vertices are on the unit sphere.

    Raises:
        ValueError: negative, or above 10 (21 million faces).
    """
    if not 0 <= subdivisions <= 10:
        raise ValueError(f"an icosphere takes 0 to 10 subdivisions, not {subdivisions}")
    vertices, faces = _icosahedron()
    for _ in range(subdivisions):
        vertices, faces = _subdivided(vertices, faces)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, faces


def bumpy_sphere(subdivisions: int) -> MeshArrays:
    """The icosphere with each vertex (x, y, z) moved from the unit sphere to the radius r = 1 +
    0.15 sin 5x sin 5y sin 5z."""
    vertices, faces = icosphere(subdivisions)
    radii = 1.0 + 0.15 * np.sin(5.0 * vertices).prod(axis=1, keepdims=True)
    return vertices * radii, faces


def torus_mesh(major_radius: float, minor_radius: float, n: int, m: int) -> MeshArrays:
    """A torus about the z axis with 2 n m faces: n segments the long way round, m the short way.

    Raises:
        ValueError: fewer than 3 segments, or not 0 < minor_radius < major_radius.
    """
    if n < 3 or m < 3:
        raise ValueError(f"a torus needs at least 3 segments each way, not {n} and {m}")
    if not 0.0 < minor_radius < major_radius:
        raise ValueError(
            f"a torus needs 0 < minor_radius < major_radius, not {minor_radius} and {major_radius}"
        )
    i, j = (index.ravel() for index in np.mgrid[:n, :m])
    s, t = 2.0 * np.pi * i / n, 2.0 * np.pi * j / m
    distance = major_radius + minor_radius * np.cos(t)
    vertices = np.column_stack(
        [distance * np.cos(s), distance * np.sin(s), minor_radius * np.sin(t)]
    )
    # The four corners of each quadrilateral (i, j), counter-clockwise.
    a, b = i * m + j, (i + 1) % n * m + j
    c, d = (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return vertices, faces.astype(np.int64)


def remove_faces(faces: IntArray, fraction: float, seed: int) -> IntArray:
    """The faces (m, 3) without a random fraction of them, in the same order. seed: a seed of the
    random choice."""
    return np.delete(faces, _random_faces(faces, fraction, seed), axis=0)


def flip_faces(faces: IntArray, fraction: float, seed: int) -> IntArray:
    """The faces (m, 3) with a random fraction of them reversed; the winding number jumps the
    opposite way across a reversed face. seed: a seed of the random choice."""
    flipped = faces.copy()
    chosen = _random_faces(faces, fraction, seed)
    flipped[chosen] = faces[chosen][:, [0, 2, 1]]
    return flipped


def duplicate_faces(
    faces: IntArray, fraction: float, seed: int, *, flipped: bool = False
) -> IntArray:
    """The faces (m, 3), followed by copies of a random fraction of them. The copies are reversed if
    `flipped`. seed: a seed of the random choice.

    The winding number jumps by 2 across a duplicated face. Across a face with a reversed duplicate
    it does not jump, as if there were a hole.
    """
    copies = faces[_random_faces(faces, fraction, seed)]
    return np.concatenate([faces, copies[:, [0, 2, 1]] if flipped else copies])


def _random_faces(faces: IntArray, fraction: float, seed: int) -> IntArray:
    """Choose a random fraction of the faces; returns their indices, all different. Their number is
    rounded to a whole one. seed: a seed of the random choice.

    Raises:
        ValueError: fraction outside [0, 1].
    """
    if not 0.0 <= fraction <= 1.0:
        raise ValueError(f"the fraction must lie between 0 and 1, not {fraction}")
    rng = np.random.default_rng(seed)
    return rng.permutation(len(faces))[: round(fraction * len(faces))]


def _icosahedron() -> MeshArrays:
    """The icosahedron in the unit sphere."""
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    # The four corners of a rectangle in each of the coordinate planes.
    corners = [(0.0, y, z) for y in (-1.0, 1.0) for z in (-golden, golden)]
    vertices = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    # The faces are the triples of vertices 2 apart from each other, turned to face outward.
    near = np.abs(((vertices[:, None] - vertices) ** 2).sum(axis=2) - 4.0) < 0.1
    faces = np.array(
        [
            (a, b, c) if np.linalg.det(vertices[[a, b, c]]) > 0.0 else (a, c, b)
            for a in range(12)
            for b in range(a + 1, 12)
            for c in range(b + 1, 12)
            if near[a, b] and near[b, c] and near[c, a]
        ],
        dtype=np.int64,
    )
    return vertices / np.sqrt(1.0 + golden * golden), faces


def _subdivided(vertices: FloatArray, faces: IntArray) -> MeshArrays:
    """The mesh with each face divided in four at the midpoints of its edges, which become new
    vertices. Returns vertices and faces."""
    ends = np.roll(faces, -1, axis=1)
    n = len(vertices)
    # One integer for each edge, the same for both directions.
    keys = np.minimum(faces, ends) * n + np.maximum(faces, ends)
    edges, midpoint_index = np.unique(keys.ravel(), return_inverse=True)
    midpoints = 0.5 * (vertices[edges // n] + vertices[edges % n])
    a, b, c = faces.T
    ab, bc, ca = (n + midpoint_index.reshape(-1, 3)).T
    children = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return np.concatenate([vertices, midpoints]), children
