"""Turns the arguments of `render` into the objects that its studio shows."""

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
from harnack.rendering.option_table import names_of
from harnack.rendering.stage import Material, StudioObject, parse_material
from harnack.tracer import Surface, TracedSurface, TraceOptions, traced_surface
from harnack.tracer.trace_options import surface_and_options
from harnack.tracer.traced_surface import check_has_inside

# The material of tubes around the curves at which surfaces end.
_TUBE_MATERIAL = "gold"


def _is_color(materials: Any) -> bool:
    """Whether a list holds three numbers, a color, and not materials."""
    return len(materials) == 3 and all(isinstance(number, Real) for number in materials)


def drawn_surfaces(
    surfaces: Any,
    options: TraceOptions | None = None,
    boundary_radius: float | None = None,
    thickness: float | None = None,
    **shorthand: Any,
) -> list[TracedSurface]:
    """The surfaces that `render` draws for its first argument. The other parameters are the options
    of `render` that change the surfaces."""
    drawn = studio_objects(
        surfaces, None, options, shorthand, boundary_radius=boundary_radius, thickness=thickness
    )
    return [element.surface for element in drawn]


def studio_objects(
    surfaces: Any,
    materials: Any,
    options: TraceOptions | None,
    shorthand: Mapping[str, Any],
    *,
    boundary_radius: float | None = None,
    boundary_material: Any = None,
    section_material: Any = None,
    isolines: tuple[Isolines, ...] = (),
    thickness: float | None = None,
) -> list[StudioObject]:
    """The objects that the studio shows: fields and surfaces with materials and isolines, and tubes
    around the curves at which surfaces end.

    surfaces: the first argument of `render`. materials: its option `material`.
    options, shorthand: the `TraceOptions` of all surfaces, and options given as keywords, by name.
    boundary_radius: the radius of the tubes; None for no tubes. boundary_material: their material,
        gold if None.
    section_material: the material of the faces at which sections cut solids; None for that of the
        rest.
    thickness: if not None, closed walls of this thickness are drawn in place of the surfaces.

    Raises:
        TypeError, ValueError: there is nothing to draw, or an option is wrong.
    """
    listed: list[Any] = [*surfaces] if isinstance(surfaces, list | tuple) else [surfaces]
    if not listed:
        raise ValueError("there is nothing to draw: give at least one field")
    for element in listed:
        if not isinstance(element, Field | Surface | TracedSurface):
            raise TypeError(
                f"what is drawn are fields and surfaces, not what is {suggest_field(element)}"
            )
    has_list = isinstance(materials, list | tuple) and not _is_color(materials)
    names: list[Any] = [*materials] if has_list else [materials] * len(listed)
    drawn: list[tuple[Any, Mapping[str, Any]]] = [(element, shorthand) for element in listed]
    level: Any = shorthand.get("level")
    levels: list[Any] = [*level] if isinstance(level, Sequence | np.ndarray) else []
    if len(listed) == 1 and has_list and len(names) == len(levels) > 1:
        drawn = [(listed[0], {**shorthand, "level": number}) for number in levels]
    if len(names) != len(drawn):
        count = max(len(listed), len(levels))
        hint = f" or {count}, one for each {'surface' if len(listed) > 1 else 'level'}"
        raise ValueError(f"give one material{hint if count > 1 else ''}, not {len(names)}")
    objects: list[StudioObject] = []
    for (element, keywords), name in zip(drawn, names, strict=True):
        material = parse_material(name)
        surface = _surface(element, options, keywords, material.transparent)
        # Lines of a surface's own function are meant for the other surfaces.
        is_open = surface.solid_range is None and len(listed) > 1
        lines = tuple(
            line for line in isolines if not (is_open and line.function_field is surface.field)
        )
        objects.append(StudioObject(surface, material, isolines=lines))
    _check_no_duplicates([element.surface for element in objects])
    if boundary_radius is None and boundary_material is not None:
        raise ValueError(
            "boundary_material needs the radius of the tubes as well, such as boundary_radius=0.03"
        )
    tube_material = parse_material(
        _TUBE_MATERIAL if boundary_material is None else boundary_material, "boundary_material"
    )
    if tube_material.transparent:
        raise ValueError("boundary_material: tubes have no inside, so light cannot pass through")
    tubes = (
        [] if boundary_radius is None else _boundary_tubes(objects, boundary_radius, tube_material)
    )
    if thickness is not None:
        objects = [
            replace(element, surface=_thickened(element.surface, thickness)) for element in objects
        ]
    if section_material is not None:
        objects = _with_section_material(
            objects, parse_material(section_material, "section_material")
        )
    return objects + tubes


def _thickened(surface: TracedSurface, thickness: float) -> TracedSurface:
    """The surface of the closed mesh that `harnack.mesh` makes of a surface with a thickness.
    Raises ValueError if there is no such mesh."""
    if surface.solid_range is not None or len(surface.levels) != 1:
        raise ValueError("thickness needs a surface of one level; a solid has an inside already")
    if surface.largest:
        raise ValueError("thickness and largest exclude each other here: mesh the surface first")
    try:
        wall = mesh(surface.surface, thickness=thickness)
        # Triangles whose area is lost in rounding do not determine the inside.
        field = WindingNumber(*without_zero_area_faces(wall.vertices, wall.faces))
    except (MeshError, MeshingError) as wrong:
        raise ValueError(
            f"no closed mesh could be made of this surface with thickness={thickness!r}: {wrong}; "
            "give another thickness (a smaller one where sheets meet), or mesh it "
            "with a cell_size and draw the mesh"
        ) from wrong
    return TracedSurface(
        field,
        (field.default_level,),
        tolerance=surface.tolerance,
        max_steps=surface.max_steps,
        over_relaxation=field.over_relaxation,
    )


def _with_section_material(objects: list[StudioObject], material: Material) -> list[StudioObject]:
    """The objects; those that are solids cut by a section get this material on the faces of the
    cut. Raises ValueError if there are none."""

    def has_faces(element: StudioObject) -> bool:
        """Whether the object is a solid with a section."""
        return element.surface.section is not None and element.surface.solid_range is not None

    if not any(map(has_faces, objects)):
        raise ValueError(
            "section_material needs a solid with a section, whose faces are of it: give a section, "
            "such as a half-space, and for a field that is no solid also "
            'side="below" or side="above"'
        )
    return [
        replace(element, section_material=material) if has_faces(element) else element
        for element in objects
    ]


def _check_no_duplicates(surfaces: list[TracedSurface]) -> None:
    """Raise ValueError if a surface is in the list twice: chance would decide which of the two is
    seen."""
    for k, surface in enumerate(surfaces):
        for earlier in surfaces[:k]:
            same = _is_cut_alike(surface, earlier) and surface.solid_range == earlier.solid_range
            if same and _shared_levels(surface, earlier):
                raise ValueError(
                    "a surface is drawn twice, and which is seen would be an accident. If levels "
                    "were meant for one field each: they are those of every field. Give one field "
                    "with several levels and as many materials, or a Surface for each level"
                )


def _shared_levels(first: TracedSurface, second: TracedSurface) -> bool:
    """Whether two level sets of one field have a level in common, modulo the period of the
    field."""
    period = first.field.period
    gaps = np.subtract.outer(first.level_values, second.level_values)
    if period is not None:
        gaps -= period * np.round(gaps / period)
    largest = max(1.0, *(abs(level) for level in (*first.level_values, *second.level_values)))
    return bool((np.abs(gaps) <= 1e-9 * largest).any())


def _is_cut_alike(first: TracedSurface, second: TracedSurface) -> bool:
    """Whether two surfaces have the same field and the same clip and section."""
    same = first.field is second.field
    return same and first.clip == second.clip and first.section == second.section


def _boundary_tubes(
    objects: list[StudioObject], radius: Any, material: Material
) -> list[StudioObject]:
    """Tubes of a radius around the curves at which the surfaces of the objects end."""
    if isinstance(radius, bool) or not isinstance(radius, Real) or not 0 < float(radius) < math.inf:
        raise ValueError(f"boundary_radius is a length, such as 0.03, not {radius!r}")
    tubes: list[StudioObject] = []
    for k, element in enumerate(objects):
        curves = element.surface.field.boundary_curves
        if any(_is_cut_alike(element.surface, earlier.surface) for earlier in objects[:k]):
            continue  # another level of the same
        if curves:
            closed = [np.vstack([curve, curve[:1]]) for curve in curves]
            tube = traced_surface(
                Tube.from_polylines(closed, float(radius)), clip=element.surface.clip_volume
            )
            tubes.append(StudioObject(tube, material))
    if not tubes:
        raise ValueError("boundary_radius: none of these surfaces ends at a curve")
    return tubes


def _surface(
    element: Field | Surface | TracedSurface,
    options: TraceOptions | None,
    shorthand: Mapping[str, Any],
    is_clear: bool,
) -> TracedSurface:
    """A surface with the options of the call. A `Solid` is drawn as a solid if its inside can be
    seen: if a section opens it, or its material is transparent."""
    if isinstance(element, TracedSurface):
        return element.with_call_cache(begins=True)
    honored = names_of("render", "surface", "trace")
    target, choices = surface_and_options("render", element, options, shorthand, honored)
    surface = TracedSurface.of(target, choices).with_call_cache(begins=True)
    return with_visible_inside(surface, is_clear=is_clear)


def with_visible_inside(surface: TracedSurface, *, is_clear: bool = False) -> TracedSurface:
    """The surface; a `Solid` whose inside can be seen becomes the boundary of the solid, with faces
    where volumes cut it.

    Raises:
        ValueError: the boundary of a solid is requested for a field that has no closed solids
            (`check_has_inside`).
    """
    is_seen = is_clear or surface.section is not None
    is_solid = isinstance(surface.field, Solid) and len(surface.levels) == 1
    if surface.side is None and is_solid and is_seen:
        return replace(surface, side="below")
    check_has_inside(surface)
    return surface
