"""Loads the "source" of a command (a scene of the gallery, a file or a formula), and combines it
with the options of the command line to arguments of the library's functions, such as `render` or
`mesh`. `arguments` is the result of the argument parser, with an attribute for each option (None if
it was not given). "Content" consists of surfaces, options by their names in Python, and for each
field the place where it comes from (for scene files).
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from rich.console import Console

from harnack.cli.arguments import CAMERA_OPTIONS
from harnack.cli.messages import printable, python_to_cli_terms
from harnack.field_from_file import FILE_OPTIONS, FieldFromFile, field_from_file
from harnack.fields import Field
from harnack.fields.expressions import expression, looks_like_formula
from harnack.files.geometry_files import GEOMETRY_SUFFIXES
from harnack.gallery import SCENES, Scene
from harnack.live import SceneFile, read_scene
from harnack.live.live_scene import LIVE_MODES, STILL_OPTIONS, live_options
from harnack.live.scene_file import FieldSources
from harnack.name_suggestions import did_you_mean
from harnack.rendering import Camera
from harnack.rendering.option_table import STUDIO_OPTIONS, options_of
from harnack.tracer import Surface, TraceOptions
from harnack.tracer.trace_options import SURFACE_OPTIONS, TRACE_OPTIONS

_SUFFIXES = (*GEOMETRY_SUFFIXES, ".xml", ".json")

Content = tuple[Any, dict[str, Any], FieldSources]
"""Surfaces, the options of a verb, and where the fields come from."""


def options_set(verb: str, arguments: Any) -> dict[str, Any]:
    """Return the options of a function that were given on the command line, by their names in
    Python. verb: the name of the function, such as "render".

    Raises:
        ValueError: a style of isolines was given without isolines.
    """
    values = {option.name: getattr(arguments, option.name, None) for option in options_of(verb)}
    given_options = {name: value for name, value in values.items() if value is not None}
    style = {
        name: value
        for name in ("width", "color")
        if (value := getattr(arguments, f"isolines_{name}", None)) is not None
    }
    if style and "isolines" not in given_options:
        raise ValueError(f"--isolines-{next(iter(style))} without isolines: give --isolines too")
    if style:
        # The style applies to all isolines.
        lines = given_options["isolines"]
        given_options["isolines"] = [replace(line, **style) for line in lines]
    return given_options


def source_path(arguments: Any) -> Path:
    """Return the source as a path: a file, the name of a scene, or "formula" for a formula. The
    output file is named after it.

    Raises:
        ValueError: the source is none of these, or --parameter was given without a formula.
    """
    name = arguments.source
    if is_formula(name):
        return Path("formula")
    if arguments.parameters:
        raise ValueError(f"--parameter {arguments.parameters[0][0]}: only formulas have names")
    if name not in SCENES and Path(name).suffix.lower() not in _SUFFIXES:
        raise ValueError(
            f"{name!r} is no scene: give a name from `harnack gallery --list`, a surface file "
            f"({', '.join(GEOMETRY_SUFFIXES)}), a scene file (.json), a Mitsuba scene (.xml) or a "
            f'formula such as "x^2 + y^2 + z^2 = 1"{did_you_mean(name, SCENES)}'
        )
    return Path(name)


def is_formula(name: str) -> bool:
    """Return whether the source with this name is a formula, and neither a scene of the gallery nor
    a file."""
    is_file = Path(name).suffix.lower() in _SUFFIXES
    return name not in SCENES and not is_file and looks_like_formula(name)


def is_mitsuba_scene(arguments: Any, path: Path) -> bool:
    """Return whether the source is the file of a Mitsuba scene (.xml). path: the source as
    `source_path` returns it."""
    return arguments.source not in SCENES and path.suffix.lower() == ".xml"


def load_mitsuba_scene(arguments: Any) -> tuple[str, dict[str, Any]]:
    """Return the path of a Mitsuba scene, and the options of its picture.

    Raises:
        ValueError: an option was given that the scene sets in its own file, such as a material.
    """
    _refuse_file_options(arguments)
    given_options = options_set("render", arguments)
    of_scene = (*SURFACE_OPTIONS, *TRACE_OPTIONS, *STUDIO_OPTIONS)
    wrong = [f"--{name.replace('_', '-')}" for name in given_options if name in of_scene]
    wrong += [f"--{name}" for name in _camera_options(arguments)]
    if wrong:
        raise ValueError(f"{', '.join(wrong)}: a Mitsuba scene sets this in its own file")
    return arguments.source, given_options


def load_content(
    verb: str, arguments: Any, path: Path, moved: Mapping[str, float] | None = None
) -> Content:
    """Load the source: its surfaces, the options of the function `verb` (such as "render"), and
    where the fields come from, for scene files.

    path: the source as `source_path` returns it.
    moved: numbers for further names in a formula, which --parameter does not set; by name.
    """
    given_options = options_set(verb, arguments)
    if arguments.source in SCENES:
        _refuse_file_options(arguments)
        return _of_scene(SCENES[arguments.source], arguments, given_options)
    if is_formula(arguments.source):
        _refuse_file_options(arguments)
        # A formula has no camera of its own.
        camera = _camera(arguments, Camera())
        return formula_field(arguments, moved), {**camera, **given_options}, ()
    if path.suffix.lower() == ".json":
        _refuse_file_options(arguments)
        return _of_scene_file(read_scene(path), arguments, given_options)
    return _of_file(path, arguments, given_options)


def load_live_content(verb: str, arguments: Any, path: Path) -> Content:
    """Load the source of a page or a view: its surfaces, options, and where the fields come from.
    Options that are moved by sliders have sliders as values; a formula with sliders becomes a
    function of them, which takes the place of the surfaces.

    verb: "page" or "view".
    path: the source as `source_path` returns it.

    Raises:
        ValueError: the source is a Mitsuba scene, or a slider has no option or name to move.
    """
    if is_mitsuba_scene(arguments, path):
        raise ValueError("a page needs a scene, a surface file or a formula, no Mitsuba scene")
    sliders = dict(arguments.slider)
    if path.suffix.lower() == ".json" and arguments.source not in SCENES:
        # A scene file has sliders of its own; those of the command line replace them.
        sliders = {**read_scene(path).sliders, **sliders}
    option_names = [option.name for option in options_of(verb)]
    formula_names = [name for name in sliders if name not in option_names]
    for name in sliders:
        # A slider begins at the value that is given as an option.
        value = getattr(arguments, name, None) if name in option_names else None
        if value is not None:
            sliders[name] = replace(sliders[name], start=value)
    if formula_names and not is_formula(arguments.source):
        raise ValueError(
            f"--slider {formula_names[0]}: there are sliders of options that are numbers, such as "
            "level, and of names in formulas"
        )
    # The formula is read once with each name at the start of its slider.
    start_values = {name: cast("float", sliders[name].start) for name in formula_names}
    surfaces, settings, sources = load_content(verb, arguments, path, start_values)
    show = getattr(arguments, "show", None)
    if path.suffix.lower() == ".json" and arguments.source not in SCENES:
        # A scene file may have options of pictures that pages lack.
        dropped_options = sorted(
            name
            for name, value in settings.items()
            if name in STILL_OPTIONS or (name == "show" and value not in LIVE_MODES)
        )
        if dropped_options:
            print_line(f"left out, as a {verb} does not have them: {', '.join(dropped_options)}")
    settings = live_options(settings) | ({} if show is None else {"show": show})
    # A slider can move an option of the surface only if this is an option of the page. So the
    # options of a single surface become options of the page.
    if any(name in SURFACE_OPTIONS for name in sliders):
        surfaces, settings = _unpacked(surfaces, settings)
    settings = _with_flat_options(settings, sliders) | sliders
    if not formula_names:
        return surfaces, settings, sources
    formula_text, fixed = arguments.source, dict(arguments.parameters)

    def field(**values: float) -> Field:
        """Return the formula's field for these values of its sliders."""
        return expression(formula_text, parameters={**fixed, **values})

    keyword_only = inspect.Parameter.KEYWORD_ONLY
    # Pages read the names of sliders from the function's signature.
    cast("Any", field).__signature__ = inspect.Signature(
        [inspect.Parameter(name, keyword_only) for name in formula_names]
    )
    return field, settings, sources


def load_single_surface(arguments: Any, path: Path) -> Field | Surface:
    """Load the only surface of the source, from which a mesh is made, with the options of surfaces
    that were given.

    path: the source as `source_path` returns it.

    Raises:
        ValueError: the source has several surfaces, or an option does not apply to it.
    """
    surface_options = {
        k: v for k, v in options_set("mesh", arguments).items() if k in SURFACE_OPTIONS
    }
    if is_formula(arguments.source) or arguments.source in SCENES:
        _refuse_file_options(arguments)
        if arguments.up is not None:
            raise ValueError(f"--up is for surface files ({', '.join(GEOMETRY_SUFFIXES)}) only")
    surfaces: Sequence[Field | Surface]
    if is_formula(arguments.source):
        surfaces = [formula_field(arguments)]
    elif arguments.source in SCENES:
        surfaces = SCENES[arguments.source].surfaces()
    elif path.suffix.lower() == ".json":
        surfaces = read_scene(path).surfaces_with_options
    else:
        opened = _open(path, arguments)
        if arguments.smoothing == "auto":
            print_line(_described(opened.field))
        surfaces = [opened.field]
    if len(surfaces) != 1:
        raise ValueError(
            f"scene {path} has {len(surfaces)} surfaces, and a mesh can be made of one only"
        )
    return _replaced(surfaces[0], surface_options)


def formula_field(arguments: Any, moved: Mapping[str, float] | None = None) -> Field:
    """Return the field of the formula that is the source. moved: numbers for further names in the
    formula, which --parameter does not set; by name."""
    return expression(arguments.source, parameters={**dict(arguments.parameters), **(moved or {})})


def print_line(line: str) -> None:
    """Print a line about what was read or done, without rich's markup, so that names appear as they
    are."""
    Console(highlight=False, soft_wrap=True, markup=False, emoji=False).print(printable(line))


def _of_scene(scene: Scene, arguments: Any, given_options: dict[str, Any]) -> Content:
    """Return a scene of the gallery as content (surfaces, options, and where the fields come from).
    given_options: the options that were given, by name; they replace those of the scene.

    Raises:
        ValueError: a level or side was given, and the scene has several surfaces.
    """
    surfaces = scene.surfaces()
    of_surface, other_options = _split(given_options, SURFACE_OPTIONS)
    single_surface_options = [name for name in ("level", "side") if name in of_surface]
    if single_surface_options and len(surfaces) != 1:
        raise ValueError(
            f"scene {scene.name} has several surfaces; --{single_surface_options[0]} does not apply"
        )
    # A scene file can name a field of the gallery by its scene and its number there.
    sources = [
        (surface.field, {"scene": scene.name, "number": number})
        for number, surface in enumerate(surfaces)
    ]
    of_trace, other_options = _split(other_options, TRACE_OPTIONS)
    settings = {**scene.settings(len(surfaces)), **other_options}
    settings["options"] = scene.options.replace(**of_trace)
    settings |= _camera(arguments, scene.camera)
    return [_replaced(surface, of_surface) for surface in surfaces], settings, sources


def _of_scene_file(scene: SceneFile, arguments: Any, given_options: dict[str, Any]) -> Content:
    """Return the scene that a scene file (.json) describes as content (surfaces, options, and where
    the fields come from). given_options: the options that were given, by name; they replace those
    of the file.

    Raises:
        ValueError: a level was given, and the scene has several surfaces.
    """
    settings = dict(scene.settings)
    settings |= _camera(arguments, settings.get("camera") or Camera())
    if "level" in given_options and len(scene.surfaces) != 1:
        raise ValueError("a scene of several surfaces has their levels; --level does not apply")
    surface_options, other_options = _split(given_options, SURFACE_OPTIONS)
    surfaces = [
        _replaced(surface, surface_options) if isinstance(surface, Surface) else surface
        for surface in scene.surfaces
    ]
    # Fields take the options of surfaces from the settings.
    if not all(isinstance(surface, Surface) for surface in surfaces):
        settings |= surface_options
    return surfaces, {**settings, **other_options}, scene.sources


def _of_file(path: Path, arguments: Any, given_options: dict[str, Any]) -> Content:
    """Return a surface file as content (its field, options, and where the field comes from). What
    the file was taken for is printed. given_options: the options that were given, by name."""
    # `up` turns the field when the file is read, so it is no option of the picture.
    given_options = {name: value for name, value in given_options.items() if name != "up"}
    opened = _open(path, arguments)
    print_line(_described(opened.field))
    if getattr(arguments, "show", None) is None and opened.show != "path":
        given_options["show"] = opened.show
        print_line(f"drawn {opened.show}; --show path follows light paths, in minutes")
    source: dict[str, Any] = {"file": str(path.resolve())}
    source |= {name: value for name, value in _file_options(arguments).items() if value}
    # The point itself, so that the scene stays where it is if the file gets other points.
    source.pop("origin", None)
    if any(opened.origin):
        source["origin"] = list(opened.origin)
    settings = {"material": opened.material, **_camera(arguments, Camera()), **given_options}
    return opened.field, settings, [(opened.field, source)]


def _open(path: Path, arguments: Any) -> FieldFromFile:
    """Return the field of a surface file, and print what the file was taken for."""
    opened = field_from_file(path, **_file_options(arguments))
    print_line(f"{path}: {python_to_cli_terms(opened.summary)}")
    return opened


def _file_options(arguments: Any) -> dict[str, Any]:
    """Return the options for surface files, by name, also those that were not given. What is far
    from its origin is moved unless that was decided otherwise."""
    options = {name: getattr(arguments, name) for name in FILE_OPTIONS}
    origins = {None: "auto", "file": None}
    return options | {"origin": origins.get(options["origin"], options["origin"])}


def _refuse_file_options(arguments: Any) -> None:
    """Raise a ValueError if an option for surface files was given. It is called if the source is no
    such file."""
    for name in FILE_OPTIONS:
        if name != "up" and getattr(arguments, name):  # pictures have an axis that is up, too
            raise ValueError(
                f"--{name.replace('_', '-')} is for surface files "
                f"({', '.join(GEOMETRY_SUFFIXES)}) only"
            )


def _split(values: Mapping[str, Any], names: Sequence[str]) -> tuple[dict[str, Any], ...]:
    """Split the dictionary `values` in two: the entries whose names are among `names`, and all
    other entries."""
    named = {name: value for name, value in values.items() if name in names}
    return named, {name: value for name, value in values.items() if name not in names}


def _replaced(surface: Field | Surface, keywords: Mapping[str, Any]) -> Field | Surface:
    """Return a copy of a surface with the given keywords of `Surface` changed; of a field, the
    surface with these keywords. Without keywords it is returned unchanged. A new level of a solid
    that lies between two levels turns it into a level set."""
    if not keywords:
        return surface
    if isinstance(surface, Field):
        return Surface(surface, **keywords)
    changes = dict(keywords)
    if "level" in changes and "side" not in changes and surface.side == "between":
        changes["side"] = None
    return surface.replace(**changes)


def _unpacked(surfaces: Any, settings: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Replace a single surface by its field, and add the surface's keywords to the options, so that
    a slider can be the value of a keyword. Fields stay as they are. Returns the fields and the
    options.

    Raises:
        ValueError: there are several surfaces with keywords of their own, or a solid between two
            levels.
    """
    listed: list[Any] = [*surfaces] if isinstance(surfaces, list | tuple) else [surfaces]
    if not any(isinstance(surface, Surface) for surface in listed):
        return listed, settings
    if len(listed) != 1:
        raise ValueError("a scene of several surfaces has their levels; sliders do not apply")
    (surface,) = listed
    if surface.side == "between":
        raise ValueError("this scene is a solid between two levels; a slider does not apply")
    keywords = {name: value for name, value in surface.keywords.items() if value}
    return surface.field, {"level": surface.level_values[0], **keywords, **settings}


def _with_flat_options(settings: dict[str, Any], sliders: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of `page` or `view`, by name, in a form in which sliders can move them. If
    a slider moves an option of traces, the entry "options" (a `TraceOptions`) is replaced by two
    entries, "tolerance" and "max_steps": a slider can only be the value of an entry. Otherwise the
    options are returned unchanged.

    sliders: the sliders by the names of the options that they move.
    """
    options = settings.get("options")
    if not isinstance(options, TraceOptions) or not any(name in TRACE_OPTIONS for name in sliders):
        return settings
    flat = {name: value for name, value in settings.items() if name != "options"}
    return {**{name: getattr(options, name) for name in ("tolerance", "max_steps")}, **flat}


def _camera_options(arguments: Any) -> dict[str, Any]:
    """Return the options of the camera that were given, by name."""
    values = {name: getattr(arguments, name, None) for name in CAMERA_OPTIONS}
    return {name: value for name, value in values.items() if value is not None}


def _camera(arguments: Any, camera: Camera) -> dict[str, Any]:
    """Return the option {"camera": ...}: the given `camera`, changed by the options of the command
    line. The dictionary is empty if none of these options was given."""
    given_options = _camera_options(arguments)
    if not given_options:
        return {}
    if "position" in given_options:  # in place of where the camera stands by its angles
        camera = replace(camera, azimuth=None, elevation=None, distance=None)
    # Angles and distance say where the camera stands, in place of a position.
    elif {"azimuth", "elevation", "distance"} & set(given_options):
        camera = replace(camera, position=None)
    return {"camera": replace(camera, **given_options)}


def _described(field: Field) -> str:
    """Return one line about a field: the name of its class and the facts of its method
    `describe`."""
    facts = ", ".join(
        f"{key}: {f'{value:.6g}' if isinstance(value, float) else value}"
        for key, value in field.describe().items()
    )
    return f"{type(field).__name__}: {facts}"
