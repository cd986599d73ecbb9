"""Whether a mesh in a file is closed, as programs that read it see it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from manifold3d import Error, Manifold, Mesh64

from harnack.meshing.checks import check_no_self_intersection


def read_closed(path: Path) -> Any:
    """The mesh of a file, with points that are equal made one: trimesh finds it watertight and
    turned outwards, manifold3d takes it for a solid, and no two triangles pass through each other.
    """
    read: Any = trimesh.load(path, force="mesh")
    read.merge_vertices(merge_tex=True, merge_norm=True)
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.volume > 0
    vertices = np.ascontiguousarray(read.vertices, np.float64)
    faces = np.ascontiguousarray(read.faces, np.int64)
    assert Manifold(Mesh64(vertices, faces.astype(np.uint64))).status() == Error.NoError
    check_no_self_intersection(vertices, faces)
    return read
