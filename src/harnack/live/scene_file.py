"""Scenes as text: what is drawn, how and from where, to be read by people and by every command.

A scene file is JSON of version 1. Nothing in it is ever run, and what is not known is refused:

    {
      "harnack": 1,
      "surfaces": [{"field": {"curves": [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]]}, "level": 6.28}],
      "settings": {"material": ["gold"], "camera": {"position": [3, 2, 1], "target": [0, 0, 0]}},
      "sliders": {"level": {"low": 1, "high": 12, "start": 6.28}}
    }

A field is one of {"curves": loops of points, "lift_bound": ..., "cells": true or false},
{"formula": text, "parameters": numbers by name},
{"scene": a name of the gallery, "number": which of its surfaces}, {"file": a surface file,
"read_as": ..., "take_boundary": ..., "normals": ..., "smoothing": ..., "up": ..., "origin": ...},
or the name of a class and its arguments, as {"Sphere": {"radius": 2}}. Beside it stand the
keywords of `Surface`; {"scene": ..., "number": ...} in place of a field and its keywords is a
surface of the gallery with its own. Under "settings" stand the options of `render` and of traces,
by the names that they have in Python (`rendering.option_table`).
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, cast, get_origin

import numpy as np

from harnack import geometry
from harnack.backend.validation import as_positive, as_real
from harnack.field_from_file import FILE_OPTIONS, field_from_file
from harnack.fields import Field, Solid, solids
from harnack.fields.analytic.periodic import Gyroid, SchwarzD, SchwarzP
from harnack.fields.analytic.polynomial import SphericalHarmonic
from harnack.fields.expressions import Expression, TextFormula, expression
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solids.solid import SpaceMap
from harnack.files.file_geometry import write_atomically
from harnack.gallery import SCENES
from harnack.geometry import Volume
from harnack.live.sliders import SLIDER_OPTIONS, Slider
from harnack.live.type_checks import check_types
from harnack.name_suggestions import did_you_mean, with_article
from harnack.rendering import Camera, Isolines
from harnack.rendering.framing import rotation_to_z_up
from harnack.rendering.option_table import BY_NAME, LIVE, LIVE_MODES, options_of
from harnack.rendering.stage import parse_material
from harnack.tracer import HitTolerance, Surface, TracedSurface, TraceOptions
from harnack.tracer.trace_options import (
    SURFACE_OPTIONS,
    TRACE_OPTIONS,
    surface_and_options,
    trace_options_among,
)

__all__ = [
    "FieldSources",
    "SceneFile",
    "SceneFileError",
    "check_sources",
    "parse_scene",
    "read_scene",
    "to_scene_text",
    "with_flat_options",
    "write_scene",
]

VERSION = 1
_MAX_BYTES = 64 * 2**20
_ENDING = ".json"
_SURFACE_KEYS = ("field", *SURFACE_OPTIONS)
_KNOWN = tuple(option.name for option in options_of("render") if option.in_files)
# Fields that say all of themselves by their arguments, besides solids.
_EXTRA_FIELD_TYPES: tuple[type[Field], ...] = (
    Gyroid, SchwarzD, SchwarzP, SphericalHarmonic,
)  # fmt: skip
# What Python says of arguments that are something else.
_CONSTRUCTION_ERRORS = (
    ValueError,
    TypeError,
    ArithmeticError,
    AttributeError,
    LookupError,
    NotImplementedError,
)

Plain = dict[str, Any]
FieldSources = Sequence[tuple[Field, Plain]]
"""Fields, and where they come from, as scene files say it."""


def check_sources(sources: Any) -> None:
    """Raise `TypeError` unless `sources` is a sequence of pairs of a field and a dictionary, the
    field's entry in a scene file."""
    try:
        is_right = all(
            isinstance(field, Field) and isinstance(entry, dict) for field, entry in sources
        )
    except (TypeError, ValueError):
        is_right = False
    if not is_right:
        raise TypeError(
            "sources must be pairs of a field and where it comes from, as SceneFile.sources has "
            f"them, not {sources!r:.60}"
        )


class SceneFileError(ValueError):
    """The error for a text that is no valid scene file, or an object that cannot be written to a
    scene file."""


@dataclass(frozen=True)
class SceneFile:
    """The contents of a scene file.

    surfaces: fields and `Surface` objects, which `harnack.render`, `page` and `view` take.
    settings: options of these functions, by name.
    sliders: sliders by the names of the options that they move, for `page` and `view`. The settings
        hold the start values of these options.
    sources: pairs of a field and its entry in the file, for fields of files and of the gallery.
        Writing the scene again needs them.
    """

    surfaces: tuple[Field | Surface, ...]
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    sliders: Mapping[str, Slider] = field(default_factory=dict[str, Slider])
    sources: FieldSources = field(default=(), repr=False)

    @property
    def surfaces_with_options(self) -> tuple[Surface, ...]:
        """The surfaces, each with those options of the scene that are keywords of `Surface`
        (level, clip, ...). `harnack.trace` and other functions of a `Surface` take them."""
        shorthand = {k: value for k, value in self.settings.items() if k in SURFACE_OPTIONS}
        # Of the two results, the surface and the options of traces, the surface.
        return tuple(
            surface_and_options("a scene", surface, None, shorthand, SURFACE_OPTIONS)[0]
            for surface in self.surfaces
        )

    def settings_of(self, verb: str) -> dict[str, Any]:
        """Return those settings that a function of the library takes. verb: the name of the
        function, such as "page". `show` is left out if the function cannot draw this kind of
        picture."""
        names = {option.name for option in options_of(verb)}
        settings = {name: value for name, value in self.settings.items() if name in names}
        if verb in LIVE and settings.get("show") not in (None, *LIVE_MODES):
            del settings["show"]
        return settings

    @property
    def trace_options(self) -> TraceOptions:
        """The options of traces among the settings of the scene, with default values for all
        others."""
        return TraceOptions(**{k: v for k, v in self.settings.items() if k in TRACE_OPTIONS})


def read_scene(path: str | os.PathLike[str]) -> SceneFile:
    """Read a scene file, which `write_scene` or a view has written.

        scene = hk.read_scene("mine.json")
        hk.render(scene.surfaces, "mine.png", **scene.settings)

    Names of files in it are relative to the scene file's folder.

    Raises:
        SceneFileError (a ValueError): the file is no scene file; the message names the part that is
            wrong, and why.
        OSError: the file cannot be read.
    """
    source = Path(path)
    if source.stat().st_size > _MAX_BYTES:
        raise SceneFileError(f"{source}: a scene file has at most {_MAX_BYTES >> 20} MB")
    try:
        text = source.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise SceneFileError(f"{source}: a scene file is text in UTF-8") from None
    try:
        return parse_scene(text, lambda name: _resolve_file(source.parent, name))
    except SceneFileError as wrong:
        raise SceneFileError(f"{source}: {wrong}") from None


def _resolve_file(folder: Path, name: str) -> Path:
    """Return the path of a file that a scene in `folder` names: the named path or, if nothing
    exists there, a file of the same name in the folder itself. So a scene can be sent to other
    people together with its files."""
    path = folder / name
    return path if path.exists() or not (folder / path.name).exists() else folder / path.name


def write_scene(
    path: str | os.PathLike[str],
    surfaces: Any,
    *,
    sources: FieldSources = (),
    **settings: Any,
) -> None:
    """Write surfaces, and the options by which they are drawn, to a scene file.

        hk.write_scene("mine.json", hk.SolidAngle(curve), level=2.0, material="gold")

    path: the file to write; it must end in .json.
    surfaces, settings: surfaces and options as `harnack.render` and `page` take them, `options`
        included. The value of an option that is a number may be a `Slider`.
    sources: pairs of a field and its entry in scene files (as `SceneFile.sources` has them), for
        fields of files and of the gallery.

    Raises:
        SceneFileError (a ValueError): something cannot be written as text, such as a Python
            function or a mesh that was made in Python; the message names it.
    """
    target = os.fspath(path)
    check_sources(sources)
    if not target.lower().endswith(_ENDING):
        raise SceneFileError(f"{target}: a scene is written as {_ENDING}")
    text = to_scene_text(surfaces, settings, sources)
    with write_atomically(target) as partial:
        partial.write_text(text, encoding="utf-8")


# Writing.


def to_scene_text(surfaces: Any, settings: Mapping[str, Any], sources: FieldSources = ()) -> str:
    """Write surfaces and options as the text of a scene file, and return it.

    surfaces: a field, a `Surface`, or a list of them.
    settings: options of `render` by name; values may be sliders.
    sources: pairs of a field and its entry in scene files.

    Raises:
        SceneFileError: something cannot be written as text; or an option is wrong.
    """
    surface_list: list[Any] = [*surfaces] if isinstance(surfaces, list | tuple) else [surfaces]
    if not surface_list:
        raise SceneFileError("there is nothing to write: give at least one field")
    scene: Plain = {
        "harnack": VERSION,
        "surfaces": [_surface_to_json(surface, sources) for surface in surface_list],
    }
    settings = with_flat_options(settings)
    sliders = {name: value for name, value in settings.items() if isinstance(value, Slider)}
    for name in sliders:
        if name not in SLIDER_OPTIONS:
            raise SceneFileError(
                f"a slider of {name} cannot be written: a file holds those of options that are "
                "numbers, such as level"
            )
    settings_json = {
        name: _setting_to_json(name, value, sources)
        for name, value in settings.items()
        if value is not None and name not in sliders
    }
    starts = {name: slider.start for name, slider in sliders.items()}
    values = {name: value for name, value in settings.items() if value is not None}
    # Errors appear on writing and not when the file is read.
    _check_values(SceneFile(tuple(surface_list), {**values, **starts}))
    if settings_json:
        scene["settings"] = settings_json
    if sliders:
        scene["sliders"] = {
            name: {k: v for k, v in dataclasses.asdict(slider).items() if v is not None}
            for name, slider in sliders.items()
        }
    return _json(scene) + "\n"


def with_flat_options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options by name, in which the entry "options" (a `TraceOptions`) is replaced by
    its attributes that differ from their defaults.

    Raises:
        TypeError: an option of traces stands in both places.
    """
    flat = dict(settings)
    options = flat.pop("options", None)
    if options is None:
        return flat
    # This raises the error for options that stand in both places.
    trace_options_among(options, flat)
    for option in dataclasses.fields(TraceOptions):
        value = getattr(options, option.name)
        if value != option.default:
            flat[option.name] = value
    return flat


def _json(value: Any, depth: int = 0) -> str:
    """Return a value as JSON text with a line for each entry; an entry that fits on one line, such
    as a row of numbers, stays on one line. depth: the depth of nesting, by which the text is
    indented."""
    # Lines have at most 88 characters.
    one_line = json.dumps(value, allow_nan=False)
    if len(one_line) <= 88 - 2 * depth or not isinstance(value, dict | list):
        return one_line
    indent = "  " * (depth + 1)
    entries: list[str] = []
    if isinstance(value, dict):
        for name, entry in cast("Plain", value).items():
            entries.append(f"{indent}{json.dumps(name)}: {_json(entry, depth + 1)}")
    else:
        entries = [indent + _json(entry, depth + 1) for entry in cast("list[Any]", value)]
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return f"{opening}\n" + ",\n".join(entries) + "\n" + "  " * depth + closing


def _surface_to_json(surface: Any, sources: FieldSources) -> Plain:
    """Return a field or surface as an entry of "surfaces" in a scene file: its field, its levels
    and its other keywords.

    sources: pairs of a field and its entry in scene files.

    Raises:
        SceneFileError: some part of it cannot be written as text.
    """
    if isinstance(surface, Field):
        return {"field": _field_to_json(surface, sources)}
    if isinstance(surface, TracedSurface):
        surface = surface.surface
    if not isinstance(surface, Surface):
        raise SceneFileError(f"what is written are fields and surfaces, not {surface!r:.60}")
    data: Plain = {"field": _field_to_json(surface.field, sources)}
    levels = [float(level) for level in surface.level_values]
    data["level"] = levels[0] if len(levels) == 1 else levels
    for name, value in surface.keywords.items():
        if value:
            data[name] = _setting_to_json(name, value, sources)
    return data


def _field_to_json(field: Field, sources: FieldSources) -> Plain:
    """Return a field as an entry of a scene file: its entry in `sources` if it has one, otherwise
    its formula, its curves, or its class and arguments.

    sources: pairs of a field and its entry in scene files.

    Raises:
        SceneFileError: the field cannot be written, or would not be the same when read again.
    """
    for source_field, origin in sources:
        if field is source_field:
            return origin
    if isinstance(field, Expression) and isinstance(field.function, TextFormula):
        data: Plain = {
            "formula": field.function.text,
            "parameters": dict(field.numbers),
        }
        # Only arguments that differ from their defaults are written.
        keywords = {
            "domain": field.domain,
            "level": field.default_level,
            "is_convex": field.is_convex,
        }
        parameters = inspect.signature(expression).parameters
        data |= {k: _to_json_value(v) for k, v in keywords.items() if v != parameters[k].default}
        # A formula without parameters has no such entry.
        return {name: value for name, value in data.items() if value != {}}
    if type(field) is SolidAngle and not field.circles:
        values = {"lift_bound": field.lift_bound_option, "cells": field.cells}
        parameters = inspect.signature(SolidAngle).parameters
        options = {
            name: value for name, value in values.items() if value != parameters[name].default
        }
        _check_cells(options)
        return {"curves": [np.asarray(loop).tolist() for loop in field.loops], **options}
    if type(field).__name__ not in _constructible_types():
        raise SceneFileError(
            f"{with_article(type(field).__name__)} that was made in Python cannot be written into "
            "a scene file, which holds curves, formulas, solids, surfaces of files and of the "
            "gallery"
        )
    # The field is read back to find out whether its arguments say all of it. It names no files.
    data = _object_to_json(field)
    _check_round_trip(field, _field_of(data, "field", None))
    return data


def _check_cells(options: Mapping[str, Any]) -> None:
    """Raise `SceneFileError` if the option "cells" is not a bool. A `SolidAngle` also takes a
    number of megabytes there; but a file must not choose the memory used."""
    if not isinstance(options.get("cells", True), bool):
        raise SceneFileError(f"cells of a scene are true or false, not {options['cells']!r:.60}")


def _check_round_trip(field: Field, copy: Field) -> None:
    """Raise `SceneFileError` if `copy`, which was read back from the text of `field`, is another
    field: if it has other values at 256 random points, another default level or another domain."""
    points = np.random.default_rng(0).normal(size=(256, 3))
    same = np.array_equal(field.value(points), copy.value(points), equal_nan=True)
    if not same or field.default_level != copy.default_level or field.domain != copy.domain:
        raise SceneFileError(
            f"{with_article(type(field).__name__)} like this one cannot be written: its own "
            "arguments do not say all of it"
        )


def _object_to_json(instance: Any) -> Plain:
    """Return a field or a volume as {class name: {argument: JSON value}}. Arguments that equal
    their default are left out. An argument that the object does not keep as an attribute is left
    out too; `_check_round_trip` reports an object that this changes."""
    arguments: Plain = {}
    for name, parameter in inspect.signature(instance.__class__).parameters.items():
        if name.startswith("_") or not hasattr(instance, name):
            continue  # `_check_round_trip` finds what would be lost
        value = getattr(instance, name)
        if _equals_default(value, parameter.default):
            continue
        arguments[name] = _to_json_value(value)
    return {type(instance).__name__: arguments}


def _equals_default(value: Any, default: Any) -> bool:
    """Return whether a value equals the default of its argument; False for values that cannot be
    compared as a whole, such as arrays."""
    try:
        return bool(value == default)
    except (TypeError, ValueError):  # arrays
        return False


def _to_json_value(value: Any) -> Any:
    """Return a number, string, sequence, array, volume or field as JSON data.

    Raises:
        SceneFileError: another value.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float | np.floating):
        return _finite_or_text(float(cast("Any", value)))
    if isinstance(value, np.ndarray):
        return _to_json_value(cast("Any", value).tolist())
    if isinstance(value, np.integer):
        return int(cast("Any", value))
    if isinstance(value, Sequence):
        return [_to_json_value(entry) for entry in cast("Sequence[Any]", value)]
    if isinstance(value, Field):  # a field in another object, without an entry of its own
        return _field_to_json(value, ())
    if type(value).__name__ in _constructible_types():
        return _object_to_json(value)
    raise SceneFileError(f"what is of type {type(value).__name__} cannot be written")


def _finite_or_text(value: float) -> Any:
    """Return a number for JSON, which has no infinities: they become "inf" and "-inf".

    Raises:
        SceneFileError: the number is NaN.
    """
    if math.isnan(value):
        raise SceneFileError("NaN cannot be written")
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")


def _setting_to_json(name: str, value: Any, sources: FieldSources) -> Any:
    """Return the value of an option as JSON data.

    name: of the option, a keyword of `render` or of `Surface`.
    sources: pairs of a field and its entry in scene files.

    Raises:
        SceneFileError: the option is unknown, or its value cannot be written, such as a Python
            function.
    """
    _check_name(name, _KNOWN, "setting")
    if isinstance(value, HitTolerance):
        # All else must be as a length alone makes it.
        if value != HitTolerance(value.distance):
            raise SceneFileError("tolerance: only a length can be written")
        return value.distance
    if name == "enclosures" and not isinstance(value, str):
        raise SceneFileError("enclosures: only those chosen by name can be written")
    # Attributes that equal their defaults are left out.
    if isinstance(value, Camera):
        values = {option.name: getattr(value, option.name) for option in dataclasses.fields(value)}
        defaults = {option.name: option.default for option in dataclasses.fields(value)}
        return {key: _to_json_value(v) for key, v in values.items() if v != defaults[key]}
    if isinstance(value, Isolines):
        if not isinstance(value.function, str):
            raise SceneFileError("isolines: only those of a formula as text can be written")
        names = ("function", "levels", "interval", "width", "color")
        return {key: _to_json_value(v) for key in names if (v := getattr(value, key)) is not None}
    if name == "isolines" and isinstance(value, Sequence):
        return [_setting_to_json(name, entry, sources) for entry in cast("Sequence[Any]", value)]
    try:
        return _to_json_value(value)
    except SceneFileError as wrong:
        raise SceneFileError(f"{name}: {wrong}") from None


# Reading.


def parse_scene(text: str, find: Callable[[str], Path] | None = None) -> SceneFile:
    """Return the scene that the text of a scene file describes.

    find: returns the path of a file from its name in the text; None refuses texts that name files.

    Raises:
        SceneFileError: the text is no scene; the message names the part that is wrong.
    """
    try:
        return _scene_of(_parsed_json(text), find)
    except RecursionError:
        raise SceneFileError("more things are within each other than can be read") from None


def _parsed_json(text: str) -> Any:
    """Return the data of a JSON text. Raises a SceneFileError if it is no JSON."""
    try:
        return json.loads(text, parse_constant=_no_number, object_pairs_hook=_reject_duplicate_keys)
    except ValueError as wrong:
        raise SceneFileError(f"it is no JSON: {wrong}") from None


def _scene_of(data: Any, find: Callable[[str], Path] | None) -> SceneFile:
    """Return the scene that JSON data describes, with all its values checked. find: returns the
    path of a file from its name; None refuses named files.

    Raises:
        SceneFileError: the data is no scene; the message names the part that is wrong.
    """
    scene_data = _object(data, "a scene")
    # In Python, true equals 1.
    if scene_data.get("harnack") != VERSION or scene_data["harnack"] is True:
        raise SceneFileError(f'it must say "harnack": {VERSION}, the version of scene files')
    for name in scene_data:
        _check_name(name, ("harnack", "surfaces", "settings", "sliders"), "part")
    listed = scene_data.get("surfaces")
    if not isinstance(listed, list) or not listed:
        raise SceneFileError("surfaces must be a list of one surface at least")
    sources: list[tuple[Field, Plain]] = []
    surfaces = tuple(
        _surface_of(entry, f"surfaces[{k}]", find, sources)
        for k, entry in enumerate(cast("list[Any]", listed))
    )
    settings = _settings_of(_object(scene_data.get("settings", {}), "settings"), _KNOWN)
    entries = _object(scene_data.get("sliders", {}), "sliders")
    sliders: dict[str, Slider] = {}
    for name, entry in entries.items():
        _check_name(name, SLIDER_OPTIONS, "slider")
        sliders[name] = _construct(Slider, entry, f"sliders: {name}")
        # The option of a slider has the slider's start value in the settings.
        settings[name] = sliders[name].start
    scene = SceneFile(surfaces, settings, sliders, tuple(sources))
    _check_values(scene)
    return scene


def _check_values(scene: SceneFile) -> None:
    """Raise `SceneFileError` for values that `render` or `Surface` would refuse when the scene is
    drawn."""
    settings = scene.settings
    show = settings.get("show", "shaded")
    try:
        # These properties raise the errors of `Surface` and `TraceOptions`.
        _ = scene.surfaces_with_options, scene.trace_options
        for name, value in settings.items():
            if name in BY_NAME:
                BY_NAME[name].check(value, show)
            if name in ("boundary_radius", "thickness"):
                as_positive(value, name)
        if settings.get("up") is not None:
            rotation_to_z_up(settings["up"])
        for name in ("material", "boundary_material", "section_material"):
            materials: Any = settings.get(name, [])
            for material in (
                cast("list[Any]", materials) if isinstance(materials, list) else [materials]
            ):
                parse_material(material)
    except _CONSTRUCTION_ERRORS as wrong:
        raise SceneFileError(f"settings: {wrong}") from None


def _no_number(name: str) -> float:
    """Raise `ValueError` for the name of a number that Python's JSON reader accepts and JSON does
    not have: NaN, Infinity or -Infinity."""
    raise ValueError(f"{name} is no number of JSON")


def _reject_duplicate_keys(pairs: list[tuple[str, Any]]) -> Plain:
    """Return the pairs of a JSON object as a dictionary.

    Raises:
        ValueError: a name occurs twice.
    """
    data: Plain = {}
    for name, value in pairs:
        if name in data:
            raise ValueError(f"{name!r:.60} is said twice in one object")
        data[name] = value
    return data


def _object(value: Any, where: str) -> Plain:
    """Return the value, if it is a JSON object (a dictionary). where: the place in the file, for
    the message.

    Raises:
        SceneFileError: it is no object.
    """
    if not isinstance(value, dict):
        raise SceneFileError(f"{where} must be an object with names, not {value!r:.60}")
    return cast("Plain", value)


def _check_name(name: str, known: Sequence[str], kind: str) -> None:
    """Raise `SceneFileError` if a name is not among the known names. kind: what is named, for the
    message."""
    if name not in known:
        raise SceneFileError(f"there is no {kind} {name!r:.60}{did_you_mean(name, known)}")


def _surface_of(
    entry: Any, where: str, find: Callable[[str], Path] | None, sources: list[tuple[Field, Plain]]
) -> Field | Surface:
    """Return the field or surface that an entry of "surfaces" describes.

    where: the place in the file, for messages.
    find: returns the path of a named file; None refuses named files.
    sources: gets a pair of the field and its entry, if the field comes from a file or the gallery.

    Raises:
        SceneFileError: the entry describes no surface.
    """
    data = dict(_object(entry, where))
    try:
        if "scene" in data:
            surface = _gallery_surface(data)
            sources.append((surface.field, data))
            return surface
        if "field" not in data:
            raise SceneFileError(f"{where} has no field")
        for name in data:
            _check_name(name, _SURFACE_KEYS, "keyword of a surface")
        field_entry = data.pop("field")
        # Fields of files and of the gallery keep their entry, by which the scene can be written
        # again.
        field = _source_of(field_entry, where, find)
        if field is not None:
            sources.append((field, field_entry))
        else:
            field = _field_of(field_entry, f"{where}: field", find)
        keywords = _settings_of(data, SURFACE_OPTIONS)
        return Surface(field, **keywords) if keywords else field
    except SceneFileError:
        raise
    except (*_CONSTRUCTION_ERRORS, OSError) as wrong:
        raise SceneFileError(f"{where}: {wrong}") from None


def _gallery_surface(data: Plain) -> Surface:
    """Return the surface of the gallery that {"scene": name, "number": index of its surface}
    describes.

    Raises:
        SceneFileError: there is no such scene or surface.
    """
    for name in data:
        _check_name(name, ("scene", "number"), "part of a surface of the gallery")
    scene, number = data["scene"], data.get("number", 0)
    if not isinstance(scene, str) or scene not in SCENES:
        raise SceneFileError(f"no scene is named {scene!r:.60}{did_you_mean(str(scene), SCENES)}")
    surfaces = SCENES[scene].surfaces()
    if type(number) is not int or not 0 <= number < len(surfaces):
        raise SceneFileError(f"{scene} has {len(surfaces)} surfaces, and no number {number!r:.60}")
    return surfaces[number]


def _source_of(entry: Any, where: str, find: Callable[[str], Path] | None) -> Field | None:
    """Return the field of a surface of the gallery or of a file; None if the entry describes
    another kind of field.

    entry: JSON data.
    where: the place in the file, for messages.
    find: returns the path of a named file; None refuses named files.
    """
    data = _object(entry, f"{where}: field")
    if "scene" in data:
        return _gallery_surface(data).field
    if "file" not in data:
        return None
    for name in data:
        _check_name(name, ("file", *FILE_OPTIONS), "part of a field")
    options = {key: value for key, value in data.items() if key != "file"}
    check_types(field_from_file, options)
    if not isinstance(data["file"], str):
        raise SceneFileError(f"{where}: file must be a text, not {data['file']!r:.60}")
    if find is None:
        raise SceneFileError("a scene that is opened in a browser must not name files")
    return field_from_file(find(data["file"]), **cast("Any", options)).field


def _field_of(value: Any, where: str, find: Callable[[str], Path] | None) -> Field:
    """Return the field that an entry describes by curves, by a formula, or by a class and its
    arguments.

    value: the entry, JSON data.
    where: the place in the file, for messages.
    find: returns the path of a named file; None refuses named files.

    Raises:
        SceneFileError: the entry describes no field; errors of constructors pass through.
    """
    data = _object(value, where)
    if "curves" in data:
        for name in data:
            _check_name(name, ("curves", "lift_bound", "cells"), "part of curves")
        options = {name: value for name, value in data.items() if name != "curves"}
        check_types(SolidAngle, options)
        _check_cells(options)
        return SolidAngle(data["curves"], **options)
    if "formula" in data:
        known = ("formula", "parameters", "domain", "level", "is_convex")
        for name in data:
            _check_name(name, known, "part of a formula")
        not_converted = ("formula", "parameters")
        arguments = {
            name: _from_json_value(part, where)
            for name, part in data.items()
            if name not in not_converted
        }
        arguments["parameters"] = _object(data.get("parameters", {}), f"{where}: parameters")
        if not isinstance(data["formula"], str):
            raise SceneFileError(f"{where}: a formula is a text")
        for name, number in arguments["parameters"].items():
            as_real(number, f"{where}: parameters: {name}")
        check_types(expression, arguments)
        return expression(data["formula"], **arguments)
    field = _from_json_value(data, where)
    if not isinstance(field, Field):
        raise SceneFileError(f"{where}: this is no field: {value!r:.60}")
    return field


def _from_json_value(value: Any, where: str) -> Any:
    """Return a JSON value as an argument of a constructor: lists become tuples, "inf" and "-inf"
    become floats, and an object (a dictionary) becomes the field, volume or map of space that it
    describes. Other values stay as they are. where: the place in the file, for messages."""
    if isinstance(value, list):
        return tuple(_from_json_value(entry, where) for entry in cast("list[Any]", value))
    if value in ("inf", "-inf"):
        return float(value)
    if not isinstance(value, dict):
        return value
    data = cast("Plain", value)
    if "curves" in data or "formula" in data:
        return _field_of(data, where, None)  # None: it names no files
    # Any other object is a class name with arguments.
    kinds = _constructible_types()
    if len(data) != 1:
        raise SceneFileError(f"{where}: write one name and its arguments, not {data!r:.60}")
    ((name, arguments),) = data.items()
    _check_name(name, tuple(kinds), "kind of field or volume")
    return _construct(kinds[name], arguments, f"{where}: {name}")


def _construct(kind: type, value: Any, where: str) -> Any:
    """Call the constructor `kind` with arguments from a JSON object, after checks of their names
    and types. Returns the new object.

    value: the JSON object, with the arguments by name.
    where: the place in the file, for messages.

    Raises:
        SceneFileError: an argument is unknown, has the wrong type, or is refused by the
            constructor.
    """
    known = [name for name in inspect.signature(kind).parameters if not name.startswith("_")]
    data = _object(value, where)
    for name in data:
        _check_name(name, known, f"argument of {kind.__name__}")
    try:
        values = {name: _from_json_value(entry, where) for name, entry in data.items()}
        check_types(kind, values)
        return kind(**values)
    except SceneFileError:
        raise
    except _CONSTRUCTION_ERRORS as wrong:
        raise SceneFileError(f"{where}: {wrong}") from None


def _settings_of(data: Plain, known: Sequence[str]) -> Plain:
    """Return the options, by name, that the JSON object `data` describes. known: the names of the
    options that are allowed."""
    settings: Plain = {}
    for name, value in data.items():
        _check_name(name, known, "setting")
        if name == "camera":
            settings[name] = _construct(Camera, value, name)
        elif name == "isolines":
            listed = cast("list[Any]", value if isinstance(value, list) else [value])
            settings[name] = [_construct(Isolines, entry, name) for entry in listed]
        else:
            plain = _from_json_value(value, name)
            # Lists of materials and levels stay lists, which is how `render` knows several from
            # one.
            settings[name] = (
                [*plain] if name in ("material", "level") and type(plain) is tuple else plain
            )
    return settings


def _constructible_types() -> dict[str, type]:
    """Return the classes that scene files can name: solids, volumes, maps of space and a few more
    fields, each determined by its arguments. None of their constructors reads files or calls its
    arguments."""
    types: dict[str, type] = {kind.__name__: kind for kind in _EXTRA_FIELD_TYPES}
    modules = [
        import_module(f"{solids.__name__}.{info.name}") for info in iter_modules(solids.__path__)
    ]
    for module in (*modules, geometry):
        for name, kind in vars(module).items():
            if (
                inspect.isclass(kind)
                and get_origin(kind) is None  # Python 3.10 takes tuple[float] for a class
                and issubclass(kind, Solid | Volume | SpaceMap)
                and dataclasses.is_dataclass(kind)
                and not name.startswith("_")
            ):
                types[name] = kind
    return types
