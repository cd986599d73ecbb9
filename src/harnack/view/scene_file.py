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
"read_as": ..., "take_boundary": ..., "normals": ..., "smoothing": ..., "up": ...}, or the name of a
class and its arguments, as {"Sphere": {"radius": 2}}. Beside it stand the settings of `level_set`,
under "settings" those of `render`, by the names that they have in Python.
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
from typing import Any, cast

import numpy as np

from harnack import geometry
from harnack.backend.validation import as_positive, as_real
from harnack.enclosures.selection import choose_enclosures
from harnack.field_from_file import field_from_file
from harnack.fields import Field, Solid, solids
from harnack.fields.analytic.periodic import Gyroid, SchwarzD, SchwarzP
from harnack.fields.analytic.polynomial import SphericalHarmonic
from harnack.fields.expressions import Expression, TextFormula, expression
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solids.solid import SpaceMap
from harnack.files.file_geometry import write_atomically
from harnack.gallery import SCENES
from harnack.geometry import Volume
from harnack.name_suggestions import did_you_mean
from harnack.rendering import Camera, Isolines
from harnack.rendering.framing import rotation_to_z_up
from harnack.rendering.render_options import OPTION_NAMES, STUDIO_OPTIONS, RenderOptions
from harnack.rendering.stage import parse_material
from harnack.rendering.studio_surfaces import with_options
from harnack.tracer import HitTolerance, Surface, level_set
from harnack.view.sliders import NUMERIC_RENDER_OPTIONS, Slider
from harnack.view.type_checks import check_types

__all__ = [
    "FieldSources",
    "SceneFile",
    "SceneFileError",
    "parse_scene",
    "read_scene",
    "surface_options",
    "to_scene_text",
    "write_scene",
]

VERSION = 1
_MAX_BYTES = 64 * 2**20
_ENDING = ".json"
SURFACE_SETTINGS = (
    "level", "solid", "clip", "section", "tolerance", "max_steps", "bound", "overstep", "confirm",
    "largest",
)  # fmt: skip
"""Names of the settings that `level_set` takes."""
_SLIDER_OPTIONS = (*SURFACE_SETTINGS, *NUMERIC_RENDER_OPTIONS)
_UNWRITTEN = ("of", "value_range", "colorbar", "progress")
_OF_PICTURE = tuple(name for name in OPTION_NAMES if name not in _UNWRITTEN)
_KNOWN = (*SURFACE_SETTINGS, *_OF_PICTURE)
STILL_OPTIONS = tuple(name for name in _OF_PICTURE if name not in (*STUDIO_OPTIONS, "show"))
"""Names of the settings that `render` takes for still pictures alone."""
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
_FILE_OPTIONS = ("read_as", "take_boundary", "normals", "smoothing", "up")

Plain = dict[str, Any]
FieldSources = Sequence[tuple[Field, Plain]]
"""Fields, and where they come from, as scene files say it."""


class SceneFileError(ValueError):
    """A text is no scene file, or an object cannot be stored in a scene file."""


@dataclass(frozen=True)
class SceneFile:
    """The contents of a scene file.

    surfaces: as `harnack.render`, `page` and `view` take them.
    settings: of these functions, by name.
    sliders: by the names of settings, for `page` and `view`; their start values are in `settings`.
    """

    surfaces: tuple[Field | Surface, ...]
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    sliders: Mapping[str, Slider] = field(default_factory=dict[str, Slider])
    sources: FieldSources = field(default=(), repr=False)

    @property
    def surfaces_with_options(self) -> tuple[Surface, ...]:
        """The surfaces with the settings of the scene that are theirs (level, clip, ...), for
        `harnack.trace` and whatever else takes a `Surface`."""
        own = surface_options(self.settings)
        return tuple(with_options(one, own) for one in self.surfaces)


def surface_options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that `level_set` takes, among all settings."""
    return {name: one for name, one in settings.items() if name in SURFACE_SETTINGS}


def read_scene(path: str | os.PathLike[str]) -> SceneFile:
    """The scene of a file that `write_scene` or a view has written.

        scene = hk.read_scene("mine.json")
        hk.render(scene.surfaces, "mine.png", **scene.settings)

    Files named in it are looked for beside it.

    Raises:
        SceneFileError (a ValueError): what is no such file: which part, and what is wrong.
        OSError: it cannot be read.
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
    """The path of a file that a scene names. If it does not exist, a file of the same name beside
    the scene is taken: scenes are sent to others together with their files."""
    found = folder / name
    return found if found.exists() or not (folder / found.name).exists() else folder / found.name


def write_scene(
    path: str | os.PathLike[str],
    what: Any,
    *,
    origins: FieldSources = (),
    **settings: Any,
) -> None:
    """Write what is drawn, and how, into a scene file.

        hk.write_scene("mine.json", hk.SolidAngle(curve), level=2.0, material="gold")

    what, settings: as `harnack.render` and `page` take them, with a `Slider` for `level` if wanted.
    path: ends in .json. origins: fields that come from files or from the gallery, and where from.

    Raises:
        SceneFileError (a ValueError): something that a text cannot hold, such as a Python function
            or a mesh that was made in Python: by its name.
    """
    target = os.fspath(path)
    if not target.lower().endswith(_ENDING):
        raise SceneFileError(f"{target}: a scene is written as {_ENDING}")
    text = to_scene_text(what, settings, origins)
    with write_atomically(target) as partial:
        partial.write_text(text, encoding="utf-8")


# Writing.


def to_scene_text(what: Any, settings: Mapping[str, Any], origins: FieldSources = ()) -> str:
    """A scene as text.

    Raises:
        SceneFileError: as `write_scene`.
    """
    several: list[Any] = [*what] if isinstance(what, list | tuple) else [what]
    if not several:
        raise SceneFileError("there is nothing to write: give at least one field")
    made: Plain = {"harnack": VERSION, "surfaces": [_surface_text(one, origins) for one in several]}
    sliders = {name: one for name, one in settings.items() if isinstance(one, Slider)}
    for name in sliders:
        if name not in _SLIDER_OPTIONS:
            raise SceneFileError(f"a slider of {name} cannot be written: only settings of surfaces")
    written = {
        name: _setting_text(name, one, origins)
        for name, one in settings.items()
        if one is not None and name not in sliders
    }
    starts = {name: one.start for name, one in sliders.items()}
    given = {name: one for name, one in settings.items() if one is not None}
    _check_values(SceneFile(tuple(several), {**given, **starts}))
    if written:
        made["settings"] = written
    if sliders:
        made["sliders"] = {
            name: {key: one for key, one in dataclasses.asdict(slider).items() if one is not None}
            for name, slider in sliders.items()
        }
    return _json(made) + "\n"


def _json(made: Any, depth: int = 0) -> str:
    """JSON with a line for each entry, and rows of numbers on one line."""
    flat = json.dumps(made, allow_nan=False)
    if len(flat) <= 88 - 2 * depth or not isinstance(made, dict | list):
        return flat
    space = "  " * (depth + 1)
    entries: list[str] = []
    if isinstance(made, dict):
        for name, one in cast("Plain", made).items():
            entries.append(f"{space}{json.dumps(name)}: {_json(one, depth + 1)}")
    else:
        entries = [space + _json(one, depth + 1) for one in cast("list[Any]", made)]
    first, last = "{}" if isinstance(made, dict) else "[]"
    return f"{first}\n" + ",\n".join(entries) + "\n" + "  " * depth + last


def _surface_text(one: Any, origins: FieldSources) -> Plain:
    if isinstance(one, Field):
        return {"field": _field_text(one, origins)}
    if not isinstance(one, Surface):
        raise SceneFileError(f"what is written are fields and level sets, not {one!r:.60}")
    made: Plain = {"field": _field_text(one.field, origins)}
    usual = level_set(one.field)
    made["tolerance"] = _setting_text("tolerance", one.tolerance, origins)
    if one.solid is not None:
        made["solid"] = _setting_text("solid", one.solid, origins)
    elif one.levels:
        numbers = [float(number) for number in one.level_values]
        made["level"] = numbers[0] if len(numbers) == 1 else numbers
    if one.bound != choose_enclosures(None):
        raise SceneFileError("a Surface with proofs chosen by name: give bound= as a setting")
    for name in ("clip", "section", "max_steps", "overstep", "confirm", "largest"):
        if getattr(one, name) != getattr(usual, name):
            made[name] = _setting_text(name, getattr(one, name), origins)
    return made


def _field_text(one: Field, origins: FieldSources) -> Plain:
    for known, origin in origins:
        if one is known:
            return origin
    if isinstance(one, Expression) and isinstance(one.function, TextFormula):
        made: Plain = {"formula": one.function.text, "parameters": dict(one.function.parameters)}
        extra = {"domain": one.domain, "level": one.default_level, "is_convex": one.is_convex}
        usual = inspect.signature(expression).parameters
        made |= {k: _to_json_value(v) for k, v in extra.items() if v != usual[k].default}
        return {name: value for name, value in made.items() if value != {}}
    if type(one) is SolidAngle and not one.circles:
        how = {"lift_bound": one.lift_bound_option, "cells": one.cells}
        usual = inspect.signature(SolidAngle).parameters
        own = {name: value for name, value in how.items() if value != usual[name].default}
        _check_cells(own)
        return {"curves": [np.asarray(loop).tolist() for loop in one.loops], **own}
    if type(one).__name__ not in _constructible_types():
        raise SceneFileError(
            f"a {type(one).__name__} that was made in Python cannot be written into a scene file, "
            "which holds curves, formulas, solids, surfaces of files and of the gallery"
        )
    made = _object_text(one)
    _check_round_trip(one, _field_of(made, "field", None))
    return made


def _check_cells(how: Mapping[str, Any]) -> None:
    """Raise for megabytes: how much memory is used is not up to a file."""
    if not isinstance(how.get("cells", True), bool):
        raise SceneFileError(f"cells of a scene are true or false, not {how['cells']!r:.60}")


def _check_round_trip(one: Field, other: Field) -> None:
    """Raise SceneFileError for a field of which the text says too little."""
    points = np.random.default_rng(0).normal(size=(256, 3))
    same = np.array_equal(one.value(points), other.value(points), equal_nan=True)
    if not same or one.default_level != other.default_level or one.domain != other.domain:
        raise SceneFileError(f"a {type(one).__name__} like this one cannot be written: its own "
                             "arguments do not say all of it")  # fmt: skip


def _object_text(one: Any) -> Plain:
    """A field or a volume by its class and its arguments."""
    given: Plain = {}
    for name, about in inspect.signature(one.__class__).parameters.items():
        if name.startswith("_") or not hasattr(one, name):
            continue  # `_check_round_trip` finds what would be lost
        value = getattr(one, name)
        if _same(value, about.default):
            continue
        given[name] = _to_json_value(value)
    return {type(one).__name__: given}


def _same(value: Any, default: Any) -> bool:
    try:
        return bool(value == default)
    except (TypeError, ValueError):  # arrays
        return False


def _to_json_value(value: Any) -> Any:
    """Numbers, names, lists, volumes and fields as JSON has them."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float | np.floating):
        return _number(float(cast("Any", value)))
    if isinstance(value, np.ndarray):
        return _to_json_value(cast("Any", value).tolist())
    if isinstance(value, np.integer):
        return int(cast("Any", value))
    if isinstance(value, Sequence):
        return [_to_json_value(one) for one in cast("Sequence[Any]", value)]
    if isinstance(value, Field):
        return _field_text(value, ())
    if type(value).__name__ in _constructible_types():
        return _object_text(value)
    raise SceneFileError(f"what is of type {type(value).__name__} cannot be written")


def _number(value: float) -> Any:
    """A number for JSON, which has no infinities: they become "inf" and "-inf"."""
    if math.isnan(value):
        raise SceneFileError("NaN cannot be written")
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")


def _setting_text(name: str, value: Any, origins: FieldSources) -> Any:
    _check_name(name, _KNOWN, "setting")
    if isinstance(value, HitTolerance):
        usual = HitTolerance(value.distance)
        if value != usual:
            raise SceneFileError("tolerance: only a length can be written")
        return value.distance
    if isinstance(value, Camera):
        every = {one.name: getattr(value, one.name) for one in dataclasses.fields(value)}
        usual = {one.name: one.default for one in dataclasses.fields(value)}
        return {key: _to_json_value(one) for key, one in every.items() if one != usual[key]}
    if isinstance(value, Isolines):
        if not isinstance(value.function, str):
            raise SceneFileError("isolines: only those of a formula as text can be written")
        names = ("function", "levels", "interval", "width", "color")
        return {
            key: _to_json_value(one) for key in names if (one := getattr(value, key)) is not None
        }
    if name == "isolines" and isinstance(value, Sequence):
        return [_setting_text(name, one, origins) for one in cast("Sequence[Any]", value)]
    try:
        return _to_json_value(value)
    except SceneFileError as wrong:
        raise SceneFileError(f"{name}: {wrong}") from None


# Reading.


def parse_scene(text: str, find: Callable[[str], Path] | None = None) -> SceneFile:
    """The scene of a text.

    find: where a file is that the text names; None if it must not name any.

    Raises:
        SceneFileError: as `read_scene`.
    """
    try:
        given = json.loads(
            text, parse_constant=_no_number, object_pairs_hook=_reject_duplicate_keys
        )
    except (ValueError, RecursionError) as wrong:
        raise SceneFileError(f"it is no JSON: {wrong}") from None
    try:
        return _scene_of(given, find)
    except RecursionError:
        raise SceneFileError("more things are within each other than can be read") from None


def _scene_of(given: Any, find: Callable[[str], Path] | None) -> SceneFile:
    whole = _object(given, "a scene")
    if whole.get("harnack") != VERSION or whole["harnack"] is True:
        raise SceneFileError(f'it must say "harnack": {VERSION}, the version of scene files')
    for name in whole:
        _check_name(name, ("harnack", "surfaces", "settings", "sliders"), "part")
    listed = whole.get("surfaces")
    if not isinstance(listed, list) or not listed:
        raise SceneFileError("surfaces must be a list of one surface at least")
    origins: list[tuple[Field, Plain]] = []
    surfaces = tuple(
        _surface_of(one, f"surfaces[{k}]", find, origins)
        for k, one in enumerate(cast("list[Any]", listed))
    )
    settings = _settings_of(_object(whole.get("settings", {}), "settings"), _KNOWN)
    sliders = _object(whole.get("sliders", {}), "sliders")
    made: dict[str, Slider] = {}
    for name, one in sliders.items():
        _check_name(name, _SLIDER_OPTIONS, "slider")
        made[name] = _construct(Slider, one, f"sliders: {name}")
        settings[name] = made[name].start
    scene = SceneFile(surfaces, settings, made, tuple(origins))
    _check_values(scene)
    return scene


def _check_values(scene: SceneFile) -> None:
    """Raise SceneFileError for values that `render` or `level_set` would refuse later."""
    settings = scene.settings
    show = settings.get("show", "shaded")
    try:
        _ = scene.surfaces_with_options
        for one in dataclasses.fields(RenderOptions):
            if one.name in settings:
                one.metadata["check"](settings[one.name], show)
        for name in NUMERIC_RENDER_OPTIONS:
            if settings.get(name) is not None:
                as_positive(settings[name], name)
        if settings.get("up") is not None:
            rotation_to_z_up(settings["up"])
        for name in ("material", "boundary_material", "cut_material"):
            given: Any = settings.get(name, [])
            for each in cast("list[Any]", given) if isinstance(given, list) else [given]:
                parse_material(each)
    except _CONSTRUCTION_ERRORS as wrong:
        raise SceneFileError(f"settings: {wrong}") from None


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")


def _reject_duplicate_keys(pairs: list[tuple[str, Any]]) -> Plain:
    made: Plain = {}
    for name, one in pairs:
        if name in made:
            raise ValueError(f"{name!r:.60} is said twice in one object")
        made[name] = one
    return made


def _object(given: Any, where: str) -> Plain:
    if not isinstance(given, dict):
        raise SceneFileError(f"{where} must be an object with names, not {given!r:.60}")
    return cast("Plain", given)


def _check_name(name: str, known: Sequence[str], what: str) -> None:
    if name not in known:
        raise SceneFileError(f"there is no {what} {name!r:.60}{did_you_mean(name, known)}")


def _surface_of(
    given: Any, where: str, find: Callable[[str], Path] | None, origins: list[tuple[Field, Plain]]
) -> Field | Surface:
    own = dict(_object(given, where))
    if "field" not in own:
        raise SceneFileError(f"{where} has no field")
    about = own.pop("field")
    try:
        one = _origin_of(about, where, find)
        if one is not None:
            origins.append((one.field if isinstance(one, Surface) else one, about))
        else:
            one = _field_of(about, f"{where}: field", find)
        settings = _settings_of(own, SURFACE_SETTINGS)
        return with_options(one, settings) if settings else one
    except SceneFileError:
        raise
    except (*_CONSTRUCTION_ERRORS, OSError) as wrong:
        raise SceneFileError(f"{where}: {wrong}") from None


def _origin_of(
    given: Any, where: str, find: Callable[[str], Path] | None
) -> Field | Surface | None:
    """A surface of the gallery or of a file; None for another."""
    about = _object(given, f"{where}: field")
    if "scene" in about:
        for name in about:
            _check_name(name, ("scene", "number"), "part of a field")
        scene, number = about["scene"], about.get("number", 0)
        if not isinstance(scene, str) or scene not in SCENES:
            raise SceneFileError(
                f"no scene is named {scene!r:.60}{did_you_mean(str(scene), SCENES)}"
            )
        surfaces = SCENES[scene].surfaces()
        if type(number) is not int or not 0 <= number < len(surfaces):
            raise SceneFileError(
                f"{scene} has {len(surfaces)} surfaces, and no number {number!r:.60}"
            )
        return surfaces[number]
    if "file" not in about:
        return None
    for name in about:
        _check_name(name, ("file", *_FILE_OPTIONS), "part of a field")
    options = {key: one for key, one in about.items() if key != "file"}
    check_types(field_from_file, options)
    if not isinstance(about["file"], str):
        raise SceneFileError(f"{where}: file must be a text, not {about['file']!r:.60}")
    if find is None:
        raise SceneFileError("a scene that is opened in a browser must not name files")
    opened = field_from_file(find(about["file"]), **cast("Any", options))
    return opened.field


def _field_of(given: Any, where: str, find: Callable[[str], Path] | None) -> Field:
    about = _object(given, where)
    if "curves" in about:
        for name in about:
            _check_name(name, ("curves", "lift_bound", "cells"), "part of curves")
        how = {name: value for name, value in about.items() if name != "curves"}
        check_types(SolidAngle, how)
        _check_cells(how)
        return SolidAngle(about["curves"], **how)
    if "formula" in about:
        known = ("formula", "parameters", "domain", "level", "is_convex")
        for name in about:
            _check_name(name, known, "part of a formula")
        plain = ("formula", "parameters")
        own = {
            name: _from_json_value(one, where) for name, one in about.items() if name not in plain
        }
        own["parameters"] = _object(about.get("parameters", {}), f"{where}: parameters")
        if not isinstance(about["formula"], str):
            raise SceneFileError(f"{where}: a formula is a text")
        for name, one in own["parameters"].items():
            as_real(one, f"{where}: parameters: {name}")
        check_types(expression, own)
        return expression(about["formula"], **own)
    made = _from_json_value(about, where)
    if not isinstance(made, Field):
        raise SceneFileError(f"{where}: this is no field: {given!r:.60}")
    return made


def _from_json_value(given: Any, where: str) -> Any:
    """Numbers, names and lists as they are; objects of one of the kinds that there are."""
    if isinstance(given, list):
        return tuple(_from_json_value(one, where) for one in cast("list[Any]", given))
    if given in ("inf", "-inf"):
        return float(given)
    if not isinstance(given, dict):
        return given
    about = cast("Plain", given)
    if "curves" in about or "formula" in about:
        return _field_of(about, where, None)
    kinds = _constructible_types()
    if len(about) != 1:
        raise SceneFileError(f"{where}: write one name and its arguments, not {about!r:.60}")
    ((name, arguments),) = about.items()
    _check_name(name, tuple(kinds), "kind of field or volume")
    return _construct(kinds[name], arguments, f"{where}: {name}")


def _construct(kind: type, given: Any, where: str) -> Any:
    known = [name for name in inspect.signature(kind).parameters if not name.startswith("_")]
    about = _object(given, where)
    for name in about:
        _check_name(name, known, f"argument of {kind.__name__}")
    try:
        values = {name: _from_json_value(one, where) for name, one in about.items()}
        check_types(kind, values)
        return kind(**values)
    except SceneFileError:
        raise
    except _CONSTRUCTION_ERRORS as wrong:
        raise SceneFileError(f"{where}: {wrong}") from None


def _settings_of(given: Plain, known: Sequence[str]) -> Plain:
    made: Plain = {}
    for name, one in given.items():
        _check_name(name, known, "setting")
        if name == "camera":
            made[name] = _construct(Camera, one, name)
        elif name == "isolines":
            listed = cast("list[Any]", one if isinstance(one, list) else [one])
            made[name] = [_construct(Isolines, each, name) for each in listed]
        else:
            value = _from_json_value(one, name)
            made[name] = (
                [*value] if name in ("material", "level") and type(value) is tuple else value
            )
    return made


def _constructible_types() -> dict[str, type]:
    """Fields and volumes that are their class and its arguments: solids, volumes, and some more.
    None of them reads files or calls what it is given."""
    found: dict[str, type] = {one.__name__: one for one in _EXTRA_FIELD_TYPES}
    rooms = [
        import_module(f"{solids.__name__}.{one.name}") for one in iter_modules(solids.__path__)
    ]
    for room in (*rooms, geometry):
        for name, one in vars(room).items():
            if (
                inspect.isclass(one)
                and issubclass(one, Solid | Volume | SpaceMap)
                and dataclasses.is_dataclass(one)
                and not name.startswith("_")
            ):
                found[name] = one
    return found
