"""Our surfaces as members of a Mitsuba scene.

Mitsuba 3.9 has no shapes written in Python, except meshes. So a surface travels in a mesh of two
triangles that are each a point, corners of its bounding box: no ray meets them, but the scene's
bounding box is right, and the mesh holds the BSDF. `world.World` finds the carriers in a scene
and traces what they carry.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harnack.rendering.mitsuba.scene_files import load_dictionary
from harnack.rendering.mitsuba.variant import load_mitsuba, mitsuba_backend
from harnack.rendering.surfaces.extent import box_of
from harnack.rendering.surfaces.placement import PlacedSurface, Placement
from harnack.tracer import LevelSet, level_set

if TYPE_CHECKING:
    import numpy.typing as npt

    from harnack.fields.field import Field
    from harnack.geometry.convex_volume import FloatArray

PLUGIN = "harnack"


def shape(
    surface: Field | LevelSet,
    *,
    bsdf: Mapping[str, Any] | Any = None,
    to_world: npt.ArrayLike | Any = None,
    **settings: Any,
) -> Any:
    """A Mitsuba shape of a field's level set, for a scene dictionary or a scene.

        scene = mitsuba.load_dict({
            "type": "scene",
            "integrator": {"type": "harnack_path"},
            "surface": harnack.rendering.shape(field, bsdf={"type": "roughconductor"}),
            ...
        })

    bsdf: dictionary or BSDF object; grey diffuse, seen from both sides, if left out. Open
        surfaces have two sides: wrap one-sided BSDFs as {"type": "twosided", ...}.
    to_world: matrix (4, 4) or Mitsuba transform of moves, turns and one scale for all axes.
    settings: as `harnack.level_set` takes them: level, clip, tolerance, solid, ... Glass needs a
        `solid`.

    Raises:
        ValueError: the surface has no bounds and no `clip`, or `to_world` is no similarity.
    """
    from harnack.rendering.mitsuba.plugins import (
        register,  # not above: plugins are made of carriers
    )

    mi = register()
    if isinstance(surface, LevelSet):
        if settings:
            raise ValueError(f"{', '.join(settings)}: a LevelSet holds its settings already")
    else:
        surface = level_set(surface, **settings)
    props = mi.Properties()
    props["bsdf"] = as_bsdf(mi, bsdf)
    if to_world is not None:
        props["to_world"] = mi.ScalarTransform4f(as_matrix(to_world))
    return from_properties(mi, props, surface)


def from_properties(mi: Any, props: Any, surface: LevelSet) -> Any:
    """The shape of a surface with the `to_world` and the BSDF that a plug-in's properties hold.

    Raises:
        ValueError: as `shape`; or the properties hold an emitter or a medium.
    """
    placement = Placement.identity()
    if "to_world" in props:
        placement = Placement.of(as_matrix(props["to_world"]))
    made = _carrier_class(mi.variant())(props, surface, placement)
    if made.emitter() is not None or made.is_medium_transition():
        raise ValueError("surfaces that are traced can neither emit light nor bound a medium")
    return made


def as_bsdf(mi: Any, bsdf: Any) -> Any:
    """A BSDF object, from one, its dictionary, or None."""
    if bsdf is None:
        bsdf = {"type": "twosided", "nested": {"type": "diffuse"}}
    made: Any = bsdf
    if isinstance(bsdf, Mapping):
        made = load_dictionary(mi, cast("Mapping[str, Any]", bsdf))
    if not isinstance(made, mi.BSDF):
        raise TypeError(f"bsdf must be a BSDF or its dictionary, not {type(made).__name__}")
    return made


def as_matrix(transform: Any) -> FloatArray:
    """A Mitsuba transform or an array as a float64 matrix (4, 4)."""
    matrix = getattr(transform, "matrix", transform)
    return np.array(matrix, dtype=np.float64).reshape(4, 4)


@functools.cache
def _carrier_class(variant: str) -> Any:
    """The class of carriers; Mitsuba's classes differ from variant to variant."""
    mi = load_mitsuba()
    assert mi.variant() == variant

    class Carrier(mi.Mesh):
        """A mesh that no ray meets, with the surface that it stands for."""

        def __init__(self, props: Any, surface: LevelSet, placement: Placement) -> None:
            ends = box_of(surface)
            mi.Mesh.__init__(self, PLUGIN, 2, 2, props=props)
            self.surface = surface
            self.placement = placement
            self.placed = PlacedSurface.of(surface, placement, mitsuba_backend(mi))
            params = mi.traverse(self)
            corners = np.concatenate(placement.world_bounds(ends))
            params["vertex_positions"] = mi.Float(corners.astype(np.float32))
            params["faces"] = mi.UInt32([0, 0, 0, 1, 1, 1])
            params.update()

        def to_string(self) -> str:
            return f"HarnackSurface[field = {self.surface.field!r}, bsdf = {self.bsdf()}]"

    return Carrier


def is_carrier(shape: Any) -> bool:
    """Whether a Mitsuba shape carries one of our surfaces."""
    return isinstance(getattr(shape, "placed", None), PlacedSurface)
