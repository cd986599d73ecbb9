"""Represents surfaces of harnack (level sets of fields, or boundaries of solids) in Mitsuba scenes:
proxy meshes that stand for them, and BSDFs with isolines. `mi` is the Mitsuba module.

Mitsuba 3.9 has no shapes written in Python, except meshes. So a level set is represented by a
*proxy*: a mesh of two triangles, each of which is a single point, at opposite corners of the level
set's bounding box. No ray hits such triangles, but the bounding box of the scene is right, and the
mesh holds the BSDF. `hybrid_scene.HybridScene` finds the proxies in a scene and traces their level
sets.

On an isoline another BSDF is used, chosen by the number of the isoline (`isoline_bsdf`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import upload_floats
from harnack.backend.validation import has_derivatives
from harnack.rendering.framing import bounding_box
from harnack.rendering.isolines import Isolines
from harnack.rendering.mitsuba import (
    load_dict,
    load_mitsuba,
    mitsuba_backend,
    transmittance_texture,
)
from harnack.rendering.placed_surface import PlacedSurface, Placement
from harnack.rendering.scales import Color, linear_from_srgb
from harnack.tracer import TracedSurface

if TYPE_CHECKING:
    from harnack.backend import FloatArray, Mask


def isoline_bsdf(mi: Any, bsdf: Any, colors: Sequence[Color]) -> Any:
    """Return a BSDF that draws isolines on a surface: on an isoline it is diffuse on both sides and
    has the line's color; elsewhere it is `bsdf`.

    colors: the sRGB colors of the isolines, in the order of their numbers.
    """
    paints = [load_dict(mi, _matte_bsdf(color)) for color in colors]
    return _lined_class(mi.variant())(bsdf, paints)


def _matte_bsdf(color: Color) -> dict[str, Any]:
    """Return the dictionary of a BSDF that is diffuse on both sides. color: sRGB."""
    reflectance = {"type": "rgb", "value": list(linear_from_srgb(color))}
    return {"type": "twosided", "nested": {"type": "diffuse", "reflectance": reflectance}}


@functools.cache
def _lined_class(variant: str) -> Any:
    """Return the class of the BSDFs that `isoline_bsdf` returns. There is one class for each
    variant of Mitsuba, as Mitsuba's base classes differ."""
    mi = load_mitsuba()
    assert mi.variant() == variant

    class Lined(mi.BSDF):
        """A BSDF that is `base` off the isolines, and on isoline k the k-th of `paints`. The
        surface interaction holds the number of the isoline, counted from 1, as its primitive index
        (`hybrid_scene.surface_interaction`); 0 means no isoline."""

        def __init__(self, base: Any, paints: Sequence[Any]) -> None:
            mi.BSDF.__init__(self, mi.Properties())
            self.base, self.paints = base, tuple(paints)
            bsdfs = (base, *self.paints)
            # The flags of a BSDF tell integrators what to expect: here everything that one of the
            # BSDFs has.
            self.m_components = [
                bsdf.flags(k) for bsdf in bsdfs for k in range(bsdf.component_count())
            ]
            flags = 0
            for bsdf in bsdfs:
                flags |= bsdf.flags()
            self.m_flags = flags

        def _select_bsdf(self, call: Callable[[Any, Mask], Any], si: Any, active: Mask) -> Any:
            """Evaluate on each lane the BSDF that applies: `base` or, on an isoline, the BSDF of
            this isoline. Returns the result of `call(bsdf, mask)`; the mask selects the active
            lanes of the BSDF.

            si: the surface interactions, which hold the numbers of the isolines.
            """
            line_number = si.prim_index
            result = call(self.base, active & (line_number == 0))
            for number, paint in enumerate(self.paints, start=1):
                lanes = line_number == number
                result = dr.select(lanes, call(paint, active & lanes), result)
            return result

        def sample(
            self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Mask = True
        ) -> tuple[Any, Any]:
            def call(bsdf: Any, lanes: Mask) -> tuple[Any, Any]:
                return bsdf.sample(ctx, si, sample1, sample2, lanes)

            return self._select_bsdf(call, si, active)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Mask = True) -> Any:
            return self._select_bsdf(lambda bsdf, lanes: bsdf.eval(ctx, si, wo, lanes), si, active)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Mask = True) -> Any:
            return self._select_bsdf(lambda bsdf, lanes: bsdf.pdf(ctx, si, wo, lanes), si, active)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Mask = True) -> tuple[Any, Any]:
            return self._select_bsdf(
                lambda bsdf, lanes: bsdf.eval_pdf(ctx, si, wo, lanes), si, active
            )

        def eval_diffuse_reflectance(self, si: Any, active: Mask = True) -> Any:
            return self._select_bsdf(
                lambda bsdf, lanes: bsdf.eval_diffuse_reflectance(si, lanes), si, active
            )

        def eval_null_transmission(self, si: Any, active: Mask = True) -> Any:
            return self._select_bsdf(
                lambda bsdf, lanes: bsdf.eval_null_transmission(si, lanes), si, active
            )

        def traverse(self, callback: Any) -> None:
            self.base.traverse(callback)

        def parameters_changed(self, keys: Any) -> None:
            self.base.parameters_changed(keys)

        def to_string(self) -> str:
            return f"Lined[{self.base}, lines = {len(self.paints)}]"

    return Lined


PLUGIN = "harnack"


def from_properties(
    mi: Any,
    props: Any,
    surface: TracedSurface,
    tint: Any = None,
    section_bsdf: Any = None,
    isolines: Sequence[Isolines] = (),
) -> Any:
    """Return the proxy shape of a surface. Its `to_world` and its BSDF are in a plug-in's
    properties.

    props: the properties, `mitsuba.Properties`.
    tint: for a transparent solid, the fractions of red, green and blue light that are left after
        one unit of length in it, in the world; None for all of the light.
    section_bsdf: the BSDF of the faces at which a section cuts a solid; None for the BSDF of the
        rest.
    isolines: lines to be drawn on the surface.

    Raises:
        ValueError: the surface has no bounds, `to_world` does not scale all lengths alike, an
            option does not suit the surface, or the properties hold an emitter or a medium.
    """
    if tint is not None and surface.solid_range is None:
        raise ValueError(
            'tint needs a solid, which light goes through: give side="below" or side="above"'
        )
    placement = Placement.identity()
    if "to_world" in props:
        placement = Placement.of(as_matrix(props["to_world"]))
    for isoline in isolines:
        if isoline.function_field is surface.field and surface.solid_range is None:
            raise ValueError(
                f"isolines of {surface.field!r} on its own level set: it is constant there. Draw "
                "those of another function, or a solid, whose caps show them"
            )
    if isolines:
        colors = [isoline.srgb for isoline in isolines]
        props["bsdf"] = isoline_bsdf(mi, props["bsdf"], colors)
        section_bsdf = None if section_bsdf is None else isoline_bsdf(mi, section_bsdf, colors)
    # Textures with values at vertices do not work: the proxy's vertices are not on the surface.
    if any("MeshAttribute" in _bsdf_text(bsdf) for bsdf in (props.get("bsdf", None), section_bsdf)):
        raise ValueError(
            "a mesh_attribute belongs to vertices or faces, which a level set has not: take a "
            "texture of uv, which are x and y in the world, or draw the mesh of harnack.mesh(field)"
        )
    # Light sources and media would need Mitsuba's own rays to hit the shape.
    shape = _carrier_class(mi.variant())(props, surface, placement, tint, section_bsdf, isolines)
    if shape.emitter() is not None or shape.is_medium_transition():
        raise ValueError("surfaces that are traced can neither emit light nor bound a medium")
    return shape


def _bsdf_text(bsdf: Any) -> str:
    """Return the text of a BSDF; empty for a BSDF that was written in Python without
    `to_string`."""
    try:
        return str(bsdf)
    except RuntimeError:
        return ""


def as_matrix(transform: Any) -> FloatArray:
    """Return a Mitsuba transform or an array as a float64 matrix (4, 4)."""
    matrix = getattr(transform, "matrix", transform)
    return np.array(matrix, dtype=np.float64).reshape(4, 4)


@functools.cache
def _carrier_class(variant: str) -> Any:
    """Return the class of proxies. There is one class for each variant of Mitsuba, as Mitsuba's
    base classes differ."""
    mi = load_mitsuba()
    assert mi.variant() == variant

    class Carrier(mi.Mesh):
        """A proxy: a mesh that no ray hits, which holds the BSDF and the surface for which it
        stands. The surface, placed in the world, is the attribute `placed`."""

        def __init__(
            self, props: Any, surface: TracedSurface, placement: Placement, tint: Any,
            cut_bsdf: Any, isolines: Sequence[Isolines],
        ) -> None:  # fmt: skip
            # The lower and the upper corner of its box.
            ends = bounding_box(surface)
            # With two vertices and two faces.
            mi.Mesh.__init__(self, PLUGIN, 2, 2, props=props)
            self.surface = surface
            self.placement = placement
            self.tint = transmittance_texture(mi, tint)
            # Hits on the section belong to a shape of their own, which no ray hits either.
            self.section_proxy = None if cut_bsdf is None else _bsdf_holder(mi, cut_bsdf)
            backend, size = mitsuba_backend(mi), float(np.linalg.norm(np.diff(ends, axis=0)))
            self.placed = PlacedSurface.of(surface, placement, backend, isolines, size)
            self.line_colors = tuple(isoline.srgb for isoline in isolines)
            mesh_parameters = mi.traverse(self)
            # Two triangles, each a single point at a corner of the box in the world.
            corners = np.concatenate(placement.world_bounds(ends))
            mesh_parameters["vertex_positions"] = upload_floats(backend, corners)
            mesh_parameters["faces"] = mi.UInt32([0, 0, 0, 1, 1, 1])
            mesh_parameters.update()

        def to_string(self) -> str:
            return f"HarnackSurface[field = {self.surface.field!r}, bsdf = {self.bsdf()}]"

    return Carrier


def _bsdf_holder(mi: Any, bsdf: Any) -> Any:
    """Return a mesh that belongs to no scene and only holds a BSDF."""
    props = mi.Properties()
    props["bsdf"] = bsdf
    return mi.Mesh(PLUGIN, 1, 1, props=props)


def is_proxy(shape: Any) -> bool:
    """Return whether a Mitsuba shape is a proxy, a mesh that stands for a level set of harnack."""
    return isinstance(getattr(shape, "placed", None), PlacedSurface)


def refuse_attached_surfaces(scene: Any) -> None:
    """Check that no level set of harnack in a scene has derivatives enabled: the light of paths
    does not carry them, and zero would be wrong.

    Raises:
        NotImplementedError: parameters of a field, or levels, have derivatives enabled.
    """
    for shape in scene.shapes():
        if is_proxy(shape) and has_derivatives((shape.surface.field, shape.surface.levels)):
            raise NotImplementedError(
                f"pictures of Mitsuba scenes have no derivatives by the numbers of this "
                f"{type(shape.surface.field).__name__} or by its level: detach them, as "
                'drjit.detach does, or draw it by harnack.picture(field, show="path")'
            )
