"""The commands of the command line."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from rich.console import Console

from harnack.backend import doctor
from harnack.cli.mesh_files import check_mesh_path, write_mesh
from harnack.cli.messages import printable, python_to_cli_terms
from harnack.field_from_file import field_from_file
from harnack.fields import Field
from harnack.fields.expressions import expression, looks_like_formula
from harnack.files.file_geometry import write_atomically
from harnack.files.geometry_files import GEOMETRY_SUFFIXES, LoadedMesh, read_geometry
from harnack.gallery import SCENES, Scene
from harnack.geometry import Ball, Box, HalfSpace
from harnack.geometry.boundary_edges import weld_vertices
from harnack.meshing import check_print, mesh, repair, wall_thickness
from harnack.name_suggestions import did_you_mean
from harnack.rendering import Camera, Isolines, animate, render
from harnack.rendering.animation import check_film_path
from harnack.rendering.images import check_picture_path
from harnack.rendering.render_options import OPTION_NAMES, STUDIO_OPTIONS
from harnack.view import SceneFile, page, read_scene, view
from harnack.view.live_scene import live_options
from harnack.view.scene_file import FieldSources

_DEMO_SIZE = (480, 360)


# Settings of pictures that are options of the same name; several options make up the others.
_SAME_NAME_OPTIONS = tuple(
    name for name in OPTION_NAMES if name not in ("boundary", "camera", "isolines", "progress")
)


def _render_options(options: Any) -> dict[str, Any]:
    """Settings of the picture that were asked for."""
    asked = {name: getattr(options, name, None) for name in _SAME_NAME_OPTIONS}
    given = (name for name, value in asked.items() if value is not None and value is not False)
    return {**{name: asked[name] for name in given}, "progress": not options.quiet}


def _execution_options(options: Any) -> dict[str, Any]:
    """Who does the work, and where its parts are kept, as far as it was asked for."""
    asked = {name: getattr(options, name, None) for name in ("client", "checkpoint", "tiles")}
    return {name: value for name, value in asked.items() if value is not None}


def _render(options: Any) -> int:
    source = _resolve_source(options)
    if options.output == "":
        raise ValueError("-o is empty: name the picture to write, such as a.png")
    target = check_picture_path(options.output or f"{source.stem or 'picture'}.png")
    if options.scene not in SCENES and source.suffix.lower() == ".xml":
        what, settings = _mitsuba_scene(options)
    else:
        what, settings, _ = _load_content(options, source)
    render(what, target, **settings, **_execution_options(options))
    _print_line(f"wrote {target}")
    return 0


def _turntable(options: Any) -> int:
    """A film around a surface."""
    source = _resolve_source(options)
    if options.output == "":
        raise ValueError("-o is empty: name the film to write, such as a.gif")
    target = check_film_path(options.output or f"{source.stem or 'turntable'}.gif")
    if source.suffix.lower() == ".xml":
        raise ValueError(
            "a turntable needs a scene of the gallery or a surface file, not a Mitsuba scene"
        )
    what, settings, _ = _load_content(options, source)
    film: dict[str, Any] = {
        "size": (320, 240), **settings, "show": options.show or "shaded",
        "frames": options.frames, "fps": options.fps, "turn": options.turn,
    }  # fmt: skip
    animate(what, target, **film, **_execution_options(options))
    _print_line(f"wrote {target}")
    return 0


def _page(options: Any) -> int:
    """A file to open in a browser."""
    source = _resolve_source(options)
    if options.output == "":
        raise ValueError("-o is empty: name the page to write, such as a.html")
    target = options.output or f"{source.stem or 'surface'}.html"
    what, settings, _ = _load_live_content(options, source)
    page(what, target, **settings, **_execution_options(options))
    _print_line(f"wrote {target} ({Path(target).stat().st_size / 1e6:.1f} MB)")
    return 0


def _view(options: Any) -> int:
    """A page that is served."""
    what, settings, origins = _load_live_content(options, _resolve_source(options))
    settings.pop("progress")
    view(
        what, origins=origins, host=options.host, port=options.port, opens=not options.no_browser,
        waits=True, **settings,
    )  # fmt: skip
    return 0


def _load_live_content(options: Any, source: Path) -> _Content:
    """What moves under a mouse, and its settings, some of them sliders."""
    if source.suffix.lower() == ".xml":
        raise ValueError("a page needs a scene, a surface file or a formula, no Mitsuba scene")
    sliders = dict(options.slider)
    if _is_saved(source):
        sliders = {**read_scene(source).sliders, **sliders}
    names = [name for name in sliders if name != "level"]
    if "level" in sliders:
        if options.level is not None:
            sliders["level"] = replace(sliders["level"], start=options.level)
        options.level = sliders["level"].start
    if names and not _is_formula(options.scene):
        raise ValueError(
            f"--slider {names[0]}: there are sliders of level and of names in formulas"
        )
    starts = {name: cast("float", sliders[name].start) for name in names}
    drawn, settings, origins = _load_content(options, source, starts)
    settings = {**live_options(settings), "title": options.title or "", **sliders}
    if options.show is not None:
        settings["show"] = options.show
    if not names:
        return drawn, settings, origins
    text, fixed = options.scene, dict(options.parameters)

    def formula(**values: float) -> Field:
        return expression(text, parameters={**fixed, **values})

    kind = inspect.Parameter.KEYWORD_ONLY
    own = [inspect.Parameter(name, kind) for name in names]
    cast("Any", formula).__signature__ = inspect.Signature(own)
    return formula, settings, origins


def _resolve_source(options: Any) -> Path:
    """The file to draw, or the name of a scene; of a formula, a name for its picture."""
    if _is_formula(options.scene):
        return Path("formula")
    if options.parameters:
        raise ValueError(f"--set {options.parameters[0][0]}: only formulas have names to set")
    if options.scene not in SCENES:
        _check_source(options.scene)
    return Path(options.scene)


def _is_formula(name: str) -> bool:
    is_file = Path(name).suffix.lower() in (*GEOMETRY_SUFFIXES, ".xml", ".json")
    return name not in SCENES and not is_file and looks_like_formula(name)


_Content = tuple[Any, dict[str, Any], FieldSources]
"""Surfaces, the settings of their picture, and where their fields come from."""


def _load_content(options: Any, source: Path, moved: Mapping[str, float] | None = None) -> _Content:
    """What a scene, a file or a formula is. moved: parameters of a formula besides those of the
    options."""
    settings = {**_render_options(options), **_isolines(options), **_surface_options(options)}
    if any(value is not None for value in _camera_options(options).values()):
        settings["camera"] = _camera(options)
    if options.scene in SCENES:
        _refuse_file_options(options)
        return _of_scene(SCENES[options.scene], options, settings)
    if _is_formula(options.scene):
        _refuse_file_options(options)
        return _formula(options, moved), {"level": options.level, **settings}, ()
    if _is_saved(source):
        _refuse_file_options(options)
        return _of_saved(read_scene(source), options, settings)
    return _of_file(source, options, settings)


def _is_saved(source: Path) -> bool:
    """Whether it is a scene file, as a view saves it."""
    return source.suffix.lower() == ".json"


def _of_saved(saved: SceneFile, options: Any, settings: dict[str, Any]) -> _Content:
    own = dict(saved.settings)
    asked = {name: value for name, value in _camera_options(options).items() if value is not None}
    if asked:
        usual = own.get("camera") or Camera()
        if {"azimuth", "elevation", "distance"} & set(asked):
            usual = replace(usual, position=None)
        settings["camera"] = replace(usual, **asked)
    if options.level is not None:
        if len(saved.surfaces) != 1:
            raise ValueError("a scene of several surfaces has their levels; --level does not apply")
        settings["level"] = options.level
    return [*saved.surfaces], {**own, **settings}, saved.sources


def _formula(options: Any, moved: Mapping[str, float] | None = None) -> Field:
    return expression(options.scene, parameters={**dict(options.parameters), **(moved or {})})


def _mitsuba_scene(options: Any) -> tuple[str, dict[str, Any]]:
    """A scene that has everything of its own."""
    _refuse_file_options(options)
    settings = {**_render_options(options), **_isolines(options)}
    of_scene = {**_surface_options(options), **_camera_options(options), "level": options.level}
    wrong = [name for name, value in of_scene.items() if value is not None]
    wrong += [name for name in settings if name in STUDIO_OPTIONS]
    if wrong:
        raise ValueError(f"{', '.join(wrong)}: a Mitsuba scene sets this in its own file")
    return options.scene, settings


def _surface_options(options: Any) -> dict[str, Any]:
    """Settings of the surfaces drawn that were asked for."""
    asked = {
        "confirm": True if options.confirm else None, "bound": options.bound,
        "solid": options.solid, "clip": _clip(options), "section": _section(options),
        "largest": True if options.largest else None, "boundary": options.boundary_tube,
    }  # fmt: skip
    return {name: value for name, value in asked.items() if value is not None}


def _isolines(options: Any) -> dict[str, Any]:
    """Isolines, if they were asked for."""
    asked = {"width": options.isolines_width, "color": options.isolines_color}
    style = {name: value for name, value in asked.items() if value is not None}
    if options.isolines is None:
        if style:
            raise ValueError(
                f"{' and '.join(style)} of isolines without isolines: give --isolines as well"
            )
        return {}
    axis, spacing = options.isolines
    return {"isolines": Isolines(axis, interval=spacing, **style)}


def _clip(options: Any) -> Box | Ball | None:
    """The volume that a surface is cut by."""
    if options.box is not None:
        x0, y0, z0, x1, y1, z1 = options.box
        return Box((x0, y0, z0), (x1, y1, z1))
    if options.ball is not None:
        x, y, z, radius = options.ball
        return Ball((x, y, z), radius)
    return None


def _section(options: Any) -> HalfSpace | None:
    """The half-space that is left where a surface is opened."""
    if options.section is None:
        return None
    *normal, offset = options.section
    x, y, z = normal
    return HalfSpace((x, y, z), offset * math.hypot(x, y, z))


def _check_source(name: str) -> None:
    """Check that a name is that of a scene or, by its extension, of a file to draw.

    Raises:
        ValueError: it is neither.
    """
    if Path(name).suffix.lower() not in (*GEOMETRY_SUFFIXES, ".xml", ".json"):
        raise ValueError(
            f"{name!r} is no scene: give a name from `harnack gallery --list`, a surface "
            f"file ({', '.join(GEOMETRY_SUFFIXES)}), a scene file (.json), a Mitsuba scene (.xml) "
            "or a "
            "formula such as "
            '"x^2 + y^2 + z^2 = 1"'
            f"{did_you_mean(name, SCENES)}"
        )


def _print_line(text: str) -> None:
    """One line of what was found or done; names in it stand as they are."""
    Console(highlight=False, soft_wrap=True, markup=False, emoji=False).print(printable(text))


def _camera_options(options: Any) -> dict[str, Any]:
    """What was asked of the camera; None for what was not."""
    names = ("azimuth", "elevation", "fov", "zoom", "position", "target", "distance")
    return {name: getattr(options, name) for name in names}


def _camera(options: Any) -> Camera:
    """The camera asked for; what was not given stays that of the scene or the studio."""
    usual = SCENES[options.scene].camera if options.scene in SCENES else Camera()
    asked = {name: value for name, value in _camera_options(options).items() if value is not None}
    if "position" in asked:  # in place of where the scene's own stands
        usual = replace(usual, azimuth=None, elevation=None, distance=None)
    return replace(usual, **asked)


def _refuse_file_options(options: Any) -> None:
    given = {
        "--read-as": options.read_as, "--take-boundary": options.take_boundary,
        "--normals": options.normals, "--smoothing": options.smoothing,
    }  # fmt: skip
    for name, value in given.items():
        if value:
            raise ValueError(f"{name} is for surface files ({', '.join(GEOMETRY_SUFFIXES)}) only")


def _described(field: Field) -> str:
    facts = ", ".join(
        f"{key}: {f'{value:.6g}' if isinstance(value, float) else value}"
        for key, value in field.describe().items()
    )
    return f"{type(field).__name__}: {facts}"


def _of_file(source: Path, options: Any, settings: dict[str, Any]) -> _Content:
    up = settings.pop("up", None)
    opened = field_from_file(
        source, read_as=options.read_as, take_boundary=options.take_boundary,
        normals=options.normals, smoothing=options.smoothing, up=up,
    )  # fmt: skip
    _print_line(f"{source}: {python_to_cli_terms(opened.summary)}")
    _print_line(_described(opened.field))
    if options.show is None and opened.show != "path":
        settings["show"] = opened.show
        _print_line(f"drawn {opened.show}; --show path follows light paths, in minutes")
    usual = {"level": options.level, "material": opened.material}
    asked = {
        "read_as": options.read_as, "take_boundary": options.take_boundary,
        "normals": options.normals, "smoothing": options.smoothing, "up": up,
    }  # fmt: skip
    origin = {"file": str(source.resolve()), **{k: v for k, v in asked.items() if v}}
    return opened.field, {**usual, **settings}, [(opened.field, origin)]


def _of_scene(scene: Scene, options: Any, settings: dict[str, Any]) -> _Content:
    surfaces = scene.surfaces()
    if options.level is not None:
        if len(surfaces) != 1 or (surfaces[0].solid is not None and options.solid is None):
            raise ValueError(
                f"scene {scene.name} has levels of its own; --level does not apply, nor does a "
                "slider of it"
            )
        settings["level"] = options.level
    if options.solid is not None and len(surfaces) != 1:
        raise ValueError(f"scene {scene.name} has several surfaces; --solid does not apply")
    origins = [(one.field, {"scene": scene.name, "number": k}) for k, one in enumerate(surfaces)]
    return surfaces, {**scene.settings(len(surfaces)), **settings}, origins


def _mesh(options: Any) -> int:
    """Triangles of a scene's surface, or of that of a file with curves."""
    source = _resolve_source(options)
    if options.output == "":
        raise ValueError("-o is empty: name the file to write, such as a.stl")
    target = check_mesh_path(options.output or f"{source.stem or 'surface'}.stl")
    field, settings = _load_mesh_input(options, source)
    for name in ("tolerance", "cell_size", "solid", "thickness", "max_triangles"):
        value = getattr(options, name)
        if value is not None:
            settings[name] = value
    if options.level is not None:
        settings["level"] = options.level
    if options.thickness is not None and options.solid is None:
        settings.pop("solid", None)
    if settings.get("solid") is not None and options.level is None:
        settings.pop("level", None)
    clip = _clip(options)
    if clip is not None:
        settings["clip"] = clip
    if options.section is not None:
        settings["section"] = _section(options)
    settings |= {"simplify": options.simplify, "largest": options.largest}
    if options.quiet:
        made = mesh(field, **settings)
    else:
        with Console().status("starting") as status:
            made = mesh(field, progress=status.update, **settings)
    facts = made.metadata["harnack"]
    if options.scale is not None:
        made.apply_scale(options.scale)
    write_mesh(made, target)
    closed = made.is_watertight
    _print_line(
        f"{len(made.faces):,} triangles, "
        f"{'closed' if closed else str(len(facts['boundary'])) + ' edges at its rim'}, "
        f"{facts['evaluations']:,} evaluations"
    )
    x, y, z = made.extents
    _print_line(f"{x:.4g} x {y:.4g} x {z:.4g}{f', volume {made.volume:.4g}' if closed else ''}")
    if "why" in facts:
        _print_line(f"made of {facts['thickened_by']}: {facts['why']}")
    _print_line(f"wrote {target}")
    return 0


def _load_mesh_input(options: Any, source: Path) -> tuple[Field, dict[str, Any]]:
    """The field of a scene or a file, and what the scene says of its surface."""
    if _is_formula(options.scene) or options.scene in SCENES:
        _refuse_file_options(options)
        if options.up is not None:
            raise ValueError(f"--up is for surface files ({', '.join(GEOMETRY_SUFFIXES)}) only")
    if _is_formula(options.scene):
        return _formula(options), {}
    if options.scene not in SCENES and not _is_saved(source):
        opened = field_from_file(
            source, read_as=options.read_as, take_boundary=options.take_boundary,
            normals=options.normals, smoothing=options.smoothing, up=options.up,
        )  # fmt: skip
        _print_line(f"{source}: {python_to_cli_terms(opened.summary)}")
        if options.smoothing == "auto":
            _print_line(_described(opened.field))
        return opened.field, {}
    is_saved = _is_saved(source)
    scene = read_scene(source) if is_saved else None
    surfaces = SCENES[options.scene].surfaces() if scene is None else scene.surfaces_with_options
    if len(surfaces) != 1:
        raise ValueError(
            f"scene {source} has {len(surfaces)} surfaces, and a mesh can be made of one only"
        )
    surface = surfaces[0]
    cut = {"clip": surface.clip, "section": surface.section}
    if surface.solid is not None:
        if options.level is not None:  # then it is the level that is asked for
            return surface.field, cut
        return surface.field, {"solid": surface.solid, **cut}
    return surface.field, {"level": surface.level_values[0], **cut}


def _repair(options: Any) -> int:
    """A closed mesh of a damaged one."""
    import trimesh  # here: half a second that few need

    source = Path(options.mesh)
    target = check_mesh_path(options.output or f"{source.stem}-repaired.ply")
    found = read_geometry(source, "winding")
    if not isinstance(found, LoadedMesh):
        raise ValueError(f"{source} holds no mesh to repair")
    _print_line(f"{source}: {python_to_cli_terms(found.summary)}")
    names = ("tolerance", "cell_size", "keep", "filling", "largest")
    settings = {name: getattr(options, name) for name in names}
    chosen = {name: value for name, value in settings.items() if value is not None}
    # Files such as .stl list the corners of each face anew.
    kept, faces = np.unique(weld_vertices(found.vertices)[found.faces], return_inverse=True)
    given = trimesh.Trimesh(found.vertices[kept], faces.reshape(-1, 3), process=False)
    with Console().status("starting") as status:
        made = repair(given, progress=None if options.quiet else status.update, **chosen)
    write_mesh(made, target)
    facts = made.metadata["harnack"]
    if facts["differs"] is not None:
        _print_line(
            f"not quite what was given: {facts['differs']['share']:.2%} of the points that were "
            "compared are on the wrong side"
        )
    _print_line(f"{_repaired(facts, len(faces), len(made.faces))}, Euler characteristic "
         f"{facts['euler_characteristic']}")  # fmt: skip
    _print_line(f"wrote {target}")
    return 0


def _repaired(facts: dict[str, Any], given: int, made: int) -> str:
    """What `repair` kept, changed and added; and why not more was kept."""
    parts = _counted(len(facts["parts"]), "part")
    if facts["dropped"]:
        parts += f", of which {facts['dropped']:,} dropped"
    why = "" if facts["why"] is None else f" since {facts['why']}"
    if facts["stage"] == "remeshed":
        return (
            f"made anew: {made:,} triangles in place of {given:,}{why}; {facts['far']:,} vertices "
            f"and centers are beyond the tolerance, all are within {facts['within']:.2g}; {parts}"
        )
    if facts["stage"] == "boolean_union":
        return f"bodies united: {made:,} triangles around them, of {given:,}{why}; {parts}"
    added = f"{_counted(facts['holes'], 'hole')}, {facts['patches']:,} triangles added"
    if facts["stage"] == "filled":
        return f"{added} to {given:,}, which are all kept; {parts}"
    start, kept = f"kept what is sound{why}", facts["kept"]
    if facts["stage"] == "welded":
        kept = facts["joined"]
        start = f"corners joined that moved up to {facts['moved']:.2g}{why}"
    out = ", ".join(f"{count:,} {what}" for what, count in facts["left_out"].items() if count)
    return (
        f"{start}: {kept:,} triangles of {given:,}, {facts['turned']:,} "
        f"of them turned over; left out {out or 'none'}; {added}; {parts}"
    )


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}" + ("" if count == 1 else "s")


def _check(options: Any) -> int:
    """What is wrong with a mesh for printing: 0 if nothing is."""
    if options.colors is not None:
        if options.min_thickness is None:
            raise ValueError(
                "--colors needs --min-thickness: the thickness below which they are red"
            )
        if check_mesh_path(options.colors).suffix.lower() not in (".ply", ".glb"):
            raise ValueError(f"--colors {options.colors}: only .ply and .glb hold colors")
    found = check_print(
        options.mesh, min_thickness=options.min_thickness, build_volume=options.build_volume
    )
    if options.json:
        print(json.dumps(found.as_dict()))
    else:
        size = " x ".join(f"{one:.4g}" for one in found.size)
        volume = "not closed" if found.volume is None else f"volume {found.volume:.4g}"
        _print_line(f"{options.mesh}: {found.triangles:,} triangles, {size}, {volume}")
        for one in found.problems:
            _print_line(f"{'wrong' if one.is_error else 'note'}: {one.kind}: {one.message}")
        if found.is_printable:
            _print_line("nothing is wrong")
    if options.colors is not None:
        thin = wall_thickness(options.mesh)
        with write_atomically(Path(options.colors)) as partial:
            kind = Path(options.colors).suffix.lower()[1:]
            cast(
                "Any", thin.to_colored_mesh(options.min_thickness, 3 * options.min_thickness)
            ).export(partial, kind)
        if not options.json:
            _print_line(f"wrote {options.colors}")
    return 0 if found.is_printable else 1


def _gallery(options: Any) -> int:
    console = Console()
    if options.list:
        width = max(map(len, SCENES)) + 2
        for name, scene in SCENES.items():
            console.print(f"[bold]{name:{width}}[/]{scene.title}", highlight=False, soft_wrap=True)
        return 0
    for name in options.names:
        if name not in SCENES:
            raise ValueError(
                f"no scene is named {name!r}; there are {', '.join(SCENES)}"
                f"{did_you_mean(name, SCENES)}"
            )
    wanted = [SCENES[name] for name in options.names] or list(SCENES.values())
    if options.demo:
        wanted = [scene for scene in wanted if scene.demo_spp > 0]
    folder = _create_folder(options.output)
    for index, scene in enumerate(wanted, start=1):
        console.print(
            f"{index}/{len(wanted)} [bold]{scene.name}[/]: {scene.title}", highlight=False
        )
        target = folder / f"{scene.name}.png"
        small = {"size": _DEMO_SIZE, "spp": scene.demo_spp} if options.demo else {}
        scene.render(target, **{**small, **_render_options(options)})
        _print_line(f"    {target}")
    _print_line(f"{len(wanted)} pictures in {folder.resolve()}")
    return 0


def _create_folder(name: str) -> Path:
    """A folder to write to."""
    if not name:
        raise ValueError("-o is empty: name the folder to write to, such as out")
    folder = Path(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ValueError(f"cannot make the folder {folder}: a file of that name is there") from None
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"cannot make the folder {folder}: {why}; name another one") from None
    return folder


def _doctor(options: Any) -> int:
    del options
    return 0 if doctor.print_report(Console()) else 1


COMMANDS: Mapping[str, Callable[[Any], int]] = MappingProxyType(
    {
        "render": _render,
        "turntable": _turntable,
        "page": _page,
        "view": _view,
        "mesh": _mesh,
        "repair": _repair,
        "check": _check,
        "gallery": _gallery,
        "doctor": _doctor,
    }
)
"""All commands by name."""
