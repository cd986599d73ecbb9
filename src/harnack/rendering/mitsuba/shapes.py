"""Surfaces as shapes, for scenes that are put together in Python."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

from harnack.rendering.mitsuba.carrier import as_matrix, from_properties
from harnack.rendering.mitsuba.plugins import register
from harnack.rendering.mitsuba.scene_files import load_dictionary
from harnack.rendering.surfaces.isolines import Isolines, checked_isolines
from harnack.tracer import LevelSet, level_set

if TYPE_CHECKING:
    import numpy.typing as npt

    from harnack.fields.field import Field


def shape(
    surface: Field | LevelSet,
    *,
    bsdf: Mapping[str, Any] | Any = None,
    to_world: npt.ArrayLike | Any = None,
    tint: Sequence[float] | None = None,
    cut_bsdf: Mapping[str, Any] | Any = None,
    isolines: Isolines | Sequence[Isolines] | None = None,
    **settings: Any,
) -> Any:
    """A Mitsuba shape of a field's level set, for a scene dictionary or a scene.

        scene = mitsuba.load_dict({
            "type": "scene",
            "integrator": {"type": "harnack_path"},
            "surface": harnack.rendering.shape(field, bsdf={"type": "roughconductor"}),
            ...
        })

    bsdf: dictionary or BSDF object; gray diffuse, seen from both sides, if left out. Open
        surfaces have two sides: wrap one-sided BSDFs as {"type": "twosided", ...}.
    to_world: matrix (4, 4) or Mitsuba transform of moves, turns and one scale for all axes.
    tint: of a solid of glass, what is left of red, green and blue light after one unit of length
        in it, in the world: (1, 1, 1) for clear (Beer and Lambert).
    cut_bsdf: of the faces on the `section` of an opaque solid; by default that of the rest.
    isolines: `harnack.Isolines` to draw on it, or several; later ones cover earlier ones.
    settings: as `harnack.level_set` takes them: level, clip, tolerance, solid, ... Glass needs a
        `solid`.

    Raises:
        ValueError: the surface has no bounds and no `clip`, or `to_world` is no similarity.
    """
    mi = register()
    if isinstance(surface, LevelSet):
        if settings:
            raise ValueError(f"{', '.join(settings)}: a LevelSet holds its settings already")
    else:
        if "material" in settings:
            raise TypeError(
                "a shape takes bsdf=..., not material=...: that is an argument of harnack.render"
            )
        surface = level_set(surface, **settings)
    surface = surface.in_one_call()
    props = mi.Properties()
    props["bsdf"] = as_bsdf(mi, bsdf)
    if to_world is not None:
        props["to_world"] = mi.ScalarTransform4f(as_matrix(to_world))
    of_cut = _of_cut(mi, surface, props["bsdf"], cut_bsdf)
    return from_properties(mi, props, surface, tint, of_cut, checked_isolines(isolines))


def _of_cut(mi: Any, surface: LevelSet, bsdf: Any, cut_bsdf: Any) -> Any:
    """The BSDF of the faces on a section; None for that of the rest."""
    if cut_bsdf is None:
        return None
    if surface.solid is None or surface.section is None:
        raise ValueError(
            "faces of a cut are those of a solid on its section: give solid=(low, high) and "
            "section=harnack.HalfSpace(normal, offset) as well"
        )
    made = as_bsdf(mi, cut_bsdf)
    for one in (bsdf, made):
        if mi.has_flag(one.flags(), mi.BSDFFlags.Transmission):
            raise ValueError(
                "the faces of a cut have a material of their own on opaque solids only"
            )
    return made


def as_bsdf(mi: Any, bsdf: Any) -> Any:
    """A BSDF object, from one, its dictionary, or None."""
    if bsdf is None:
        bsdf = {"type": "twosided", "nested": {"type": "diffuse"}}
    made: Any = bsdf
    if isinstance(bsdf, Mapping):
        made = load_dictionary(mi, cast("Mapping[str, Any]", bsdf))
    if not isinstance(made, mi.BSDF):
        raise TypeError(
            "bsdf must be a BSDF or its dictionary, such as harnack.rendering.MATERIALS['gold']"
            f".front, not {type(made).__name__}"
        )
    return made
