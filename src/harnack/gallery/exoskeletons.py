"""Scenes of meshes whose faces are large polygons that are not flat."""

from __future__ import annotations

import numpy as np

from harnack.fields.curves.polygon_mesh import PolygonMesh
from harnack.fields.solids.tubes import Tubes
from harnack.gallery.scene import Scene
from harnack.geometry import mesh_shapes
from harnack.geometry.polygon_meshes import polygon_patches
from harnack.rendering import Camera
from harnack.tracer import LevelSet, Tolerance, level_set

# Edges of faces lie inside the picture: what is met within the tolerance of one has no normal.
_CLOSE = Tolerance(1e-5)


def _exoskeleton() -> list[LevelSet]:
    """A wavy torus of some 150 patches, and tubes around their edges."""
    vertices, faces = mesh_shapes.torus_mesh(1.0, 0.45, 240, 108)
    turn = np.arctan2(vertices[:, 1], vertices[:, 0])
    ring = np.column_stack([np.cos(turn), np.sin(turn), 0.25 * np.sin(3 * turn)])
    across = vertices - np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    wavy = ring + across * (1 + 0.25 * np.cos(3 * turn))[:, None]
    mesh = PolygonMesh(*polygon_patches(wavy, faces, 150, smoothing=12))
    tubes = Tubes(mesh.vertices, mesh.edges, 0.011)
    return [level_set(mesh, tolerance=_CLOSE), level_set(tubes, tolerance=_CLOSE)]


def _patches() -> list[LevelSet]:
    """A bumpy sphere of 5,200 patches with some eleven corners each."""
    vertices, faces = mesh_shapes.bumpy_sphere(6)
    mesh = PolygonMesh(*polygon_patches(vertices, faces, 5200))
    return [level_set(mesh, tolerance=_CLOSE)]


EXOSKELETONS = (
    Scene(
        "exoskeleton",
        "a surface through the net of curves on a torus, one level set a face (paper, Fig. 14)",
        _exoskeleton,
        ("eggshell", "gold"),
        Camera(elevation=42),
        show="shaded",
        demo_spp=9,
    ),
    Scene(
        "patches",
        "5,200 polygons that are not flat, each a level set of its own",
        _patches,
        ("porcelain",),
        show="shaded",
    ),
)
