"""Turns the arguments of `render` into the objects that its studio shows. A surface is a level set
of a field or, with a `side`, the boundary of a closed solid. A section is a half-space that cuts a
solid open. A `StudioObject` is a surface with its material and isolines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from harnack.fields import Field, Solid
from harnack.fields.field import suggest_field
from harnack.rendering.isolines import Isolines
from harnack.rendering.option_table import names_of
from harnack.rendering.stage import Material, StudioObject, parse_material
from harnack.tracer import Surface, TracedSurface, TraceOptions, traced_surface
from harnack.tracer.trace_options import surface_and_options
from harnack.tracer.traced_surface import check_has_inside

# The material of tubes around the curves at which surfaces end.
_TUBE_MATERIAL = "gold"


def _is_color(materials: Any) -> bool:
    """Return whether a list is a color, three numbers, and not a list of materials."""
    return len(materials) == 3 and all(isinstance(number, Real) for number in materials)


def drawn_surfaces(
    surfaces: Any,
    options: TraceOptions | None = None,
    boundary_radius: float | None = None,
    thickness: float | None = None,
    **shorthand: Any,
) -> list[TracedSurface]:
    """Return the surfaces that `render` draws for its first argument, `surfaces`.

    options: the `TraceOptions` of all surfaces.
    boundary_radius: the radius of tubes around the curves at which surfaces end; None for no tubes.
    thickness: if not None, closed walls of this thickness are drawn in place of the surfaces.
    shorthand: options of `Surface` and `TraceOptions` as keywords.
    """
    # Only the surfaces are used here, so the material (None, the default) does not matter.
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
    """Return the objects that the studio shows: fields and surfaces with materials and isolines,
    and tubes around the curves at which surfaces end.

    surfaces: the first argument of `render`.
    materials: its option `material`.
    options, shorthand: the `TraceOptions` of all surfaces, and options given as keywords, by name.
    boundary_radius: the radius of the tubes; None for no tubes.
    boundary_material: the material of the tubes, gold if None.
    section_material: the material of the faces at which sections cut solids; None for the material
        of the rest.
    isolines: lines to draw on all surfaces.
    thickness: if not None, closed walls of this thickness are drawn in place of the surfaces.

    One field may have several levels and a material for each; then there is one object for each
    level.

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
    # One material for all surfaces, or a list with one for each.
    has_list = isinstance(materials, list | tuple) and not _is_color(materials)
    material_values: list[Any] = [*materials] if has_list else [materials] * len(listed)
    drawn: list[tuple[Any, Mapping[str, Any]]] = [(element, shorthand) for element in listed]
    level_option: Any = shorthand.get("level")
    levels: list[Any] = [*level_option] if isinstance(level_option, Sequence | np.ndarray) else []
    # One field with as many materials as levels: each level becomes an object.
    if len(listed) == 1 and has_list and len(material_values) == len(levels) > 1:
        drawn = [(listed[0], {**shorthand, "level": single_level}) for single_level in levels]
    if len(material_values) != len(drawn):
        count = max(len(listed), len(levels))
        hint = f" or {count}, one for each {'surface' if len(listed) > 1 else 'level'}"
        raise ValueError(
            f"give one material{hint if count > 1 else ''}, not {len(material_values)}"
        )
    objects: list[StudioObject] = []
    for (element, keywords), material_value in zip(drawn, material_values, strict=True):
        material = parse_material(material_value)
        surface = _surface(element, options, keywords, material.transparent)
        # Lines of a surface's own function are meant for the other surfaces.
        may_skip_lines = surface.solid_range is None and len(listed) > 1
        lines = tuple(
            line
            for line in isolines
            if not (may_skip_lines and line.function_field is surface.field)
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
    """Return a surface as a wall: the closed mesh that `harnack.mesh` makes of it with a thickness,
    as the level set of the mesh's winding number.

    Raises:
        ValueError: there is no such mesh.
    """
    # Imported here: few pictures need them, and they take a tenth of a second.
    from harnack.fields.solid_angles.winding_number import WindingNumber
    from harnack.geometry.meshes import MeshError, without_zero_area_faces
    from harnack.meshing import MeshingError, mesh

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
        over_relaxation=field.traits.over_relaxation,
    )


def _with_section_material(objects: list[StudioObject], material: Material) -> list[StudioObject]:
    """Return the objects; those that are solids cut by a section get this material on the faces of
    the cut.

    Raises:
        ValueError: there are none.
    """

    def has_faces(element: StudioObject) -> bool:
        """Return whether the object is a solid with a section."""
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
            is_alike = (
                _is_cut_alike(surface, earlier) and surface.solid_range == earlier.solid_range
            )
            if is_alike and _shared_levels(surface, earlier):
                raise ValueError(
                    "a surface is drawn twice, and which is seen would be an accident. If levels "
                    "were meant for one field each: they are those of every field. Give one field "
                    "with several levels and as many materials, or a Surface for each level"
                )


def _shared_levels(first: TracedSurface, second: TracedSurface) -> bool:
    """Return whether two surfaces of one field have a level in common, modulo the period of the
    field."""
    period = first.field.period
    differences = np.subtract.outer(first.level_values, second.level_values)
    if period is not None:
        differences -= period * np.round(differences / period)
    # Levels that differ by rounding are the same.
    largest = max(1.0, *(abs(level) for level in (*first.level_values, *second.level_values)))
    return bool((np.abs(differences) <= 1e-9 * largest).any())


def _is_cut_alike(first: TracedSurface, second: TracedSurface) -> bool:
    """Return whether two surfaces have the same field and the same clip and section."""
    is_same_field = first.field is second.field
    return is_same_field and first.clip == second.clip and first.section == second.section


def _boundary_tubes(
    objects: list[StudioObject], radius: Any, material: Material
) -> list[StudioObject]:
    """Return objects of the studio: tubes with this radius and material around the curves at which
    the surfaces of the given objects end. Levels of the same field with the same clip end at the
    same curves, which get one tube.

    Raises:
        ValueError: the radius is no positive number, or no surface ends at a curve.
    """
    from harnack.fields.solids.tube import Tube  # imported here: few pictures need it

    if isinstance(radius, bool) or not isinstance(radius, Real) or not 0 < float(radius) < math.inf:
        raise ValueError(f"boundary_radius is a length, such as 0.03, not {radius!r}")
    tubes: list[StudioObject] = []
    for k, element in enumerate(objects):
        boundary = element.surface.field.boundary
        curves = () if boundary is None else boundary.curves
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
    """Return the surface for one entry of the first argument of `render`, with the options of the
    call. A `Solid` (a field that is negative inside of a closed body) is drawn as a solid if its
    inside can be seen: if a section opens it, or its material is transparent.

    element: the entry.
    options, shorthand: the `TraceOptions` of the call, and options given as keywords, by name.
    is_clear: whether the material is transparent.
    """
    # Such a surface has all of its options already.
    if isinstance(element, TracedSurface):
        return element.with_call_cache(begins=True)
    # All options of surfaces and of traces that `render` has.
    honored = names_of("render", "surface", "trace")
    target, choices = surface_and_options("render", element, options, shorthand, honored)
    # In the call's cache, the evaluator is made only once.
    surface = TracedSurface.of(target, choices).with_call_cache(begins=True)
    return with_visible_inside(surface, is_clear=is_clear)


def with_visible_inside(surface: TracedSurface, *, is_clear: bool = False) -> TracedSurface:
    """Return the surface as it is to be drawn if its inside can be seen. If its field is a `Solid`
    (the points where f <= 0), it becomes the boundary of this solid, with faces where volumes cut
    it. Other surfaces stay as they are.

    is_clear: whether the material is transparent.

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
