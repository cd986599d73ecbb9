"""The gallery: named scenes that the command line, the docs and the tests share. Each module has
functions that make the surfaces of scenes, and tuples of `Scene` objects.

A scene is data (fields, levels, materials and a camera); `Scene.render` passes it to the renderer.
Nothing is computed in this package.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from harnack.gallery.analytic import CURVES, HARMONICS, PLANE, SOLIDS
from harnack.gallery.meshes_and_clouds import MESHES
from harnack.gallery.outlines import OUTLINES
from harnack.gallery.scene import Scene
from harnack.gallery.shells import EXOSKELETONS, SHELLS
from harnack.gallery.solids import BLOBS, SHAPES

__all__ = ["SCENES", "Scene"]

SCENES: Mapping[str, Scene] = MappingProxyType(
    {
        scene.name: scene
        for scene in (
            *CURVES,
            *SHELLS,
            *HARMONICS,
            *SOLIDS,
            *MESHES,
            *EXOSKELETONS,
            *BLOBS,
            *SHAPES,
            *OUTLINES,
            *PLANE,
        )
    }
)
"""All scenes by name."""
