"""Edges of a curve in one piece again, where they were cut for the tetrahedra.

A long edge of a curve is cut by points on it, so that cells near it need not be as large as it is.
In the triangles these points are moved off the edge, into the surface, by no more than the
tolerance, and the gap to the edge is filled: the mesh then ends at the curve as it was given. The
triangles in the gap are thin. That cannot be helped: the surface winds about the edge, and a
triangle on all of it is within the tolerance only if it is about as low as that.
"""

from __future__ import annotations

import numpy as np

from harnack.backend import FloatArray
from harnack.meshing.edges import IntArray, boundary_edges
from harnack.meshing.points import newton
from harnack.meshing.samples import LevelFunction

__all__ = ["whole_edges"]

# How far points are moved, at most, as a part of the edges of triangles beside them.
_SHALLOW = 0.1


def whole_edges(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    kept: int,
    cut: int,
    height: float,
) -> tuple[FloatArray, IntArray]:
    """Vertices and faces whose rim runs through the first `kept` vertices alone.

    kept, cut: vertices before `kept` are those of the curve, those from there to `cut` lie on its
        edges. height: how far these are moved, at most.
    """
    if cut == kept:
        return vertices, faces
    successor = dict(boundary_edges(faces).tolist())
    chains: list[list[int]] = []
    for start in range(kept):
        chain = [start]
        while (place := successor.get(chain[-1])) is not None:
            chain.append(place)
            if place < kept:
                break
        if len(chain) > 2:
            chains.append(chain)
    inner = np.array([place for chain in chains for place in chain[1:-1]], np.int64)
    if not len(inner):
        return vertices, faces
    owner = np.repeat(np.arange(len(chains)), [len(one) - 2 for one in chains])
    ends = np.array([(one[0], one[-1]) for one in chains], np.int64)
    vertices = vertices.copy()
    vertices[inner] = _moved_in(function, vertices, faces, inner, owner, ends, height)
    gaps = [face for chain in chains for face in _filling(chain)]
    return vertices, np.concatenate([faces, np.array(gaps, np.int64)])


def _moved_in(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    inner: IntArray,
    owner: IntArray,
    ends: IntArray,
    height: float,
) -> FloatArray:
    """Points (k, 3) `inner` of the edges owner (k,) with these ends (m, 2), off them and on the
    surface. The heights over an edge are one parabola, so that its filling lies below the chain."""
    here = vertices[inner]
    a, along = vertices[ends[:, 0]], vertices[ends[:, 1]] - vertices[ends[:, 0]]
    length = np.linalg.norm(along, axis=1)
    along, a = (along / length[:, None])[owner], a[owner]
    share = ((here - a) * along).sum(axis=1) / length[owner]
    inward, shortest = np.zeros_like(vertices), np.full(len(vertices), np.inf)
    for k in range(3):
        place, one, other = (faces[:, (k + j) % 3] for j in range(3))
        np.add.at(inward, place, vertices[one] + vertices[other] - 2 * vertices[place])
        for end in (one, other):
            span = np.linalg.norm(vertices[end] - vertices[place], axis=1)
            np.minimum.at(shortest, place, span)
    most = np.full(len(ends), height)
    np.minimum.at(most, owner, _SHALLOW * shortest[inner])
    far = 4 * share * (1 - share) * most[owner]
    way = _across(inward[inner], along)
    start = here + far[:, None] * way
    there = newton(function, start, function.at(start), 0.3 * far, None)
    # Along the edge, and away from it, points stay where they are: about it they are turned.
    turned = _across(there - here, along)
    good = (turned * way).sum(axis=1) > 0.3
    return here + far[:, None] * np.where(good[:, None], turned, way)


def _across(vectors: FloatArray, along: FloatArray) -> FloatArray:
    """The unit vectors (k, 3) of parts of vectors at right angles to unit vectors."""
    part = vectors - (vectors * along).sum(axis=1)[:, None] * along
    return part / np.maximum(np.linalg.norm(part, axis=1), 1e-300)[:, None]


def _filling(chain: list[int]) -> list[tuple[int, int, int]]:
    """Triangles between the edge from the first to the last point of a chain, and the chain."""
    if len(chain) < 3:
        return []
    middle = len(chain) // 2
    return [
        (chain[0], chain[-1], chain[middle]),
        *_filling(chain[: middle + 1]),
        *_filling(chain[middle:]),
    ]
