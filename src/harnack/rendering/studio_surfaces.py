"""Turns the arguments of `render` into surfaces on the stage of the studio."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from harnack.fields import Field, Solid
from harnack.fields.field import suggest_field
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.fields.solids.tube import Tube
from harnack.geometry.meshes import MeshError, without_zero_area_faces
from harnack.meshing import mesh
from harnack.meshing.checks import MeshingError
from harnack.rendering.isolines import Isolines
from harnack.rendering.render_options import check_settings
from harnack.rendering.scales import Color
from harnack.rendering.stage import Material, StudioObject, parse_material
from harnack.tracer import Surface, level_set

# The material of tubes around the curves at which surfaces end.
_TUBE_MATERIAL = "gold"

MaterialLike = str | Color | Material | Mapping[str, Any]


def _is_color(given: Any) -> bool:
    """Whether a list holds numbers, and not materials."""
    return len(given) == 3 and all(isinstance(one, Real) for one in given)


def drawn_surfaces(
    what: Any, boundary: float | None = None, thickness: float | None = None, **settings: Any
) -> list[Surface]:
    """The surfaces that `render` draws of fields and level sets, with settings of surfaces."""
    drawn = studio_objects(what, None, settings, boundary=boundary, thickness=thickness)
    return [one.surface for one in drawn]


def studio_objects(
    what: Any,
    materials: Any,
    settings: Mapping[str, Any],
    *,
    boundary: float | None = None,
    boundary_material: Any = None,
    cut: Any = None,
    isolines: tuple[Isolines, ...] = (),
    thickness: float | None = None,
) -> list[StudioObject]:
    """Fields and level sets as they stand on the stage, with lines on them, and tubes around where
    they end.

    boundary: the radius of these tubes; None for no tubes. boundary_material: golden if None.
    cut: the material of the faces at which sections cut solids; None for their own.
    thickness: of closed parts to draw in place of surfaces; None for the surfaces.

    Raises:
        TypeError, ValueError: there is nothing to draw, or something wrong with what is asked for.
    """
    check_settings(settings)
    given: list[Any] = [*what] if isinstance(what, list | tuple) else [what]
    if not given:
        raise ValueError("there is nothing to draw: give at least one field")
    for one in given:
        if not isinstance(one, Field | Surface):
            raise TypeError(
                f"what is drawn are fields and level sets, not what is {suggest_field(one)}"
            )
    listed = isinstance(materials, list | tuple) and not _is_color(materials)
    names: list[Any] = [*materials] if listed else [materials] * len(given)
    drawn: list[tuple[Any, Mapping[str, Any]]] = [(one, settings) for one in given]
    several: Any = settings.get("level")
    levels: list[Any] = [*several] if isinstance(several, Sequence | np.ndarray) else []
    if len(given) == 1 and listed and len(names) == len(levels) > 1:
        drawn = [(given[0], {**settings, "level": level}) for level in levels]
    if len(names) != len(drawn):
        count = max(len(given), len(levels))
        each = f" or {count}, one for each {'surface' if len(given) > 1 else 'level'}"
        raise ValueError(f"give one material{each if count > 1 else ''}, not {len(names)}")
    fitted = "tolerance" not in settings
    made: list[StudioObject] = []
    for (one, own_settings), name in zip(drawn, names, strict=True):
        material = parse_material(name)
        surface = _surface(one, own_settings, material.transparent)
        own = surface.solid is None and len(given) > 1  # then its isolines are meant for the others
        lines = tuple(
            line for line in isolines if not (own and line.function_field is surface.field)
        )
        fits = fitted and isinstance(one, Field)
        made.append(StudioObject(surface, material, fits, isolines=lines))
    _check_no_duplicates([one.surface for one in made])
    if boundary is None and boundary_material is not None:
        raise ValueError(
            "boundary_material needs the radius of the tubes as well, such as boundary=0.03"
        )
    tube_material = parse_material(
        _TUBE_MATERIAL if boundary_material is None else boundary_material
    )
    if tube_material.transparent:
        raise ValueError("boundary_material: tubes have no inside, so light cannot pass through")
    tubes = [] if boundary is None else _boundary_tubes(made, boundary, tube_material)
    if thickness is not None:
        made = [replace(one, surface=_thickened(one.surface, thickness)) for one in made]
    if cut is not None:
        made = _with_section_material(made, parse_material(cut))
    return made + tubes


def _thickened(surface: Surface, thickness: float) -> Surface:
    """The closed mesh that `mesh` makes of a surface with a thickness, as a surface."""
    if surface.solid is not None or len(surface.levels) != 1:
        raise ValueError("thickness needs a surface of one level; a solid has an inside already")
    if surface.largest:
        raise ValueError("thickness and largest: mesh the surface by hk.mesh(..., largest=True)")
    try:
        made = mesh(
            surface.field, surface.level_values[0], clip=surface.clip, section=surface.section,
            thickness=thickness,
        )  # fmt: skip
        # Slivers whose area is lost in rounding say nothing of the inside.
        field = WindingNumber(*without_zero_area_faces(made.vertices, made.faces))
    except (MeshError, MeshingError) as wrong:
        raise ValueError(
            f"no closed mesh could be made of this surface with thickness={thickness!r}: {wrong}; "
            "give another thickness (a smaller one where sheets meet), or mesh it by "
            "hk.mesh(..., thickness=..., cell_size=...) and draw hk.WindingNumber of that"
        ) from wrong
    return level_set(field, tolerance=surface.tolerance, max_steps=surface.max_steps)


def _with_section_material(made: list[StudioObject], material: Material) -> list[StudioObject]:
    """The same, with a material for the faces at which sections cut solids."""
    if not any(one.surface.section and one.surface.solid for one in made):
        raise ValueError(
            "cut_material needs a solid with a section, whose faces are made of it: give "
            "section=harnack.HalfSpace(normal, offset) as well and, of what is no harnack.Solid, "
            "solid=(low, high)"
        )
    return [
        replace(one, section_material=material)
        if one.surface.section and one.surface.solid
        else one
        for one in made
    ]


def _check_no_duplicates(surfaces: list[Surface]) -> None:
    """Raise ValueError for one surface that is there twice: which is seen would be an accident."""
    for k, one in enumerate(surfaces):
        for other in surfaces[:k]:
            same = _is_cut_alike(one, other) and one.solid == other.solid
            if same and _shared_levels(one, other):
                raise ValueError(
                    "a surface is drawn twice, and which is seen would be an accident. If levels "
                    "were meant for one field each: they are those of every field. Give one field "
                    "with level=[a, b] and material=[one, two], or harnack.level_set(field, a) for "
                    "each"
                )


def _shared_levels(one: Surface, other: Surface) -> bool:
    """Whether two level sets of a field share a level, modulo its period."""
    period = one.field.period
    apart = np.subtract.outer(one.level_values, other.level_values)
    if period is not None:
        apart -= period * np.round(apart / period)
    largest = max(1.0, *(abs(level) for level in (*one.level_values, *other.level_values)))
    return bool((np.abs(apart) <= 1e-9 * largest).any())


def _is_cut_alike(one: Surface, other: Surface) -> bool:
    """Whether both are of the same field, in the same volume."""
    same = one.field is other.field
    return same and one.clip == other.clip and one.section == other.section


def _boundary_tubes(
    made: list[StudioObject], radius: Any, material: Material
) -> list[StudioObject]:
    """Tubes around the curves at which surfaces end."""
    if isinstance(radius, bool) or not isinstance(radius, Real) or not 0 < float(radius) < math.inf:
        raise ValueError(f"boundary is the radius of a tube, such as 0.03, not {radius!r}")
    tubes: list[StudioObject] = []
    for k, one in enumerate(made):
        curves = one.surface.field.boundary_curves
        if any(_is_cut_alike(one.surface, other.surface) for other in made[:k]):
            continue  # another level of the same
        if curves:
            closed = [np.vstack([curve, curve[:1]]) for curve in curves]
            tube = level_set(
                Tube.from_polylines(closed, float(radius)), clip=one.surface.clip_volume
            )
            tubes.append(StudioObject(tube, material, has_default_tolerance=True))
    if not tubes:
        raise ValueError("boundary: none of these surfaces ends at a curve")
    return tubes


def _surface(one: Field | Surface, settings: Mapping[str, Any], clear: bool) -> Surface:
    """A surface with settings. A `Solid` is drawn as a solid where its inside can be seen: where a
    section opens it, or it is clear."""
    made = with_options(one, settings).with_call_cache(begins=True)
    opened = isinstance(made.field, Solid) and made.solid is None
    opened &= clear or made.section is not None
    if not opened or len(made.levels) != 1:
        return made
    return replace(made, solid=(-math.inf, made.level_values[0]))


def with_options(one: Field | Surface, settings: Mapping[str, Any]) -> Surface:
    """The surface, with its own options replaced by `settings` of `level_set`."""
    if isinstance(one, Field):
        return level_set(one, **settings)
    if not settings:
        return one
    own: dict[str, Any] = {
        "clip": one.clip, "tolerance": one.tolerance, "max_steps": one.max_steps,
        "bound": one.bound, "overstep": one.overstep, "confirm": one.confirm,
        "section": one.section, "largest": one.largest or False,
    }  # fmt: skip
    if "level" not in settings and "solid" not in settings:
        own |= {"level": one.levels} if one.solid is None else {"solid": one.solid}
    return level_set(one.field, **{**own, **settings})
