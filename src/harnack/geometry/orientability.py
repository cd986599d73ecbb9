"""Orientability of triangle meshes: whether a mesh has two sides, or only one, like a Moebius
strip. Faces (m, 3) hold indices of vertices. Two faces are neighbors if they have an edge in common
that no third face has; they agree in orientation if they run it in opposite directions."""

from __future__ import annotations

import numpy as np

from harnack.backend.validation import IntArray
from harnack.geometry.mesh_edges import Edges, boundary_edges, half_edges
from harnack.geometry.neighborhoods import connected_groups

__all__ = ["is_nonorientable", "orientation_components"]


def is_nonorientable(faces: IntArray) -> bool:
    """Whether a mesh has a boundary and all of its components are non-orientable, like a Moebius
    strip. A component is a largest set of faces connected through neighbors."""
    if not len(boundary_edges(faces)):
        return False
    labels = orientation_components(faces)
    # A face and its reverse have the same label in a component that is non-orientable.
    return bool((labels[: len(faces)] == labels[len(faces) :]).all())


def orientation_components(faces: IntArray) -> IntArray:
    """Labels (2m,) that show whether the faces (m, 3) of a mesh can be oriented consistently. Entry
    k belongs to face k as given, entry m + k to face k reversed.

    Two such oriented faces have the same label if they are connected through neighbors whose
    orientations agree. So face k and its reverse have the same label if and only if the connected
    component of face k is non-orientable. (The labels are the components of the orientation double
    cover.)
    """
    face_count = len(faces)
    pairs = half_edges(faces)
    first, second = Edges.of(pairs).paired_half_edges().T
    # Both faces run the edge in the same direction: they disagree.
    is_reversed = ((pairs[first] == pairs[second]).all(axis=1)).astype(np.int64)
    first, second = first % face_count, second % face_count
    # Node k is face k as given, node face_count + k the face reversed; neighbors that agree are
    # joined.
    rows = np.concatenate([first, first + face_count])
    columns = np.concatenate(
        [second + face_count * is_reversed, second + face_count * (1 - is_reversed)]
    )
    return connected_groups(np.column_stack([rows, columns]), 2 * face_count)
