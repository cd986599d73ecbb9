"""What each command does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from rich.console import Console

from harnack.backend import doctor
from harnack.choices import did_you_mean
from harnack.cli.messages import in_options, printable
from harnack.files.surfaces import SURFACE_FILES, Mesh, read_surface
from harnack.files.writing import check_writable, write_atomically
from harnack.gallery import SCENES, Scene
from harnack.geometry.singular import weld_vertices
from harnack.meshing import mesh, repair
from harnack.opening import open_surface
from harnack.rendering import Camera, render
from harnack.rendering.pictures.images import check_picture_path

_DEMO_SIZE = (480, 360)
MESH_FILES = (".stl", ".ply", ".obj", ".glb")
"""What meshes are written to."""


def _quality(options: Any) -> dict[str, Any]:
    asked = {"size": options.size, "spp": options.spp}
    chosen = {name: value for name, value in asked.items() if value is not None}
    return {**chosen, "seed": options.seed, "progress": not options.quiet}


def _render(options: Any) -> int:
    source = Path(options.scene)
    if options.scene not in SCENES:
        _check_source(options.scene)
    if options.output == "":
        raise ValueError("-o is empty: name the picture to write, such as a.png")
    target = check_picture_path(options.output or f"{source.stem or 'picture'}.png")
    settings = _quality(options)
    if options.show is not None:
        settings["show"] = options.show
    if options.antialias is not None:
        settings["antialias"] = options.antialias
    if options.azimuth is not None or options.elevation is not None:
        settings["camera"] = _camera(options)
    kind = source.suffix.lower()
    if options.scene in SCENES or kind == ".xml":
        _refuse_file_options(options)
    if options.scene in SCENES:
        _draw_scene(SCENES[options.scene], target, options, {**settings, **_of_surfaces(options)})
    elif kind == ".xml":
        if options.level is not None or options.material is not None or options.confirm:
            raise ValueError(
                "level, material and confirm of a Mitsuba scene are set in its own file"
            )
        render(str(source), target, **settings)
    else:
        _draw_file(source, target, options, {**settings, **_of_surfaces(options)})
    _say(f"wrote {target}")
    return 0


def _of_surfaces(options: Any) -> dict[str, Any]:
    """Settings of the surfaces drawn that were asked for."""
    return {"confirm": True} if options.confirm else {}


def _check_source(name: str) -> None:
    """That a name is that of a scene or, by its extension, of a file to draw.

    Raises:
        ValueError: it is neither.
    """
    if Path(name).suffix.lower() not in (*SURFACE_FILES, ".xml"):
        raise ValueError(
            f"{name!r} is no scene: give a name from `harnack gallery --list`, a surface "
            f"file ({', '.join(SURFACE_FILES)}) or a Mitsuba scene (.xml)"
            f"{did_you_mean(name, SCENES)}"
        )


def _say(text: str) -> None:
    """One line of what was found or done; names in it stand as they are."""
    Console(highlight=False, soft_wrap=True, markup=False, emoji=False).print(printable(text))


def _camera(options: Any) -> Camera:
    """The camera asked for; angles that were not given stay those of the scene or the studio."""
    usual = SCENES[options.scene].camera if options.scene in SCENES else Camera()
    angles = {"azimuth": options.azimuth, "elevation": options.elevation}
    return replace(usual, **{name: value for name, value in angles.items() if value is not None})


def _refuse_file_options(options: Any) -> None:
    given = {
        "--as": options.as_, "--boundary": options.boundary, "--normals": options.normals,
        "--up": options.up,
    }  # fmt: skip
    for name, value in given.items():
        if value:
            raise ValueError(f"{name} is for surface files ({', '.join(SURFACE_FILES)}) only")


def _draw_file(source: Path, target: Path, options: Any, settings: dict[str, Any]) -> None:
    opened = open_surface(
        source, as_=options.as_, boundary=options.boundary, normals=options.normals, up=options.up
    )
    facts = ", ".join(f"{key}: {value}" for key, value in opened.field.describe().items())
    _say(f"{source}: {in_options(opened.said)}")
    _say(f"{type(opened.field).__name__}: {facts}")
    if options.show is None and opened.show != "color":
        settings["show"] = opened.show
        _say(f"drawn {opened.show}; --show color follows light paths, in minutes")
    material = options.material or opened.material
    render(opened.field, target, level=options.level, material=material, **settings)


def _draw_scene(scene: Scene, target: Path, options: Any, settings: dict[str, Any]) -> None:
    if options.material is not None:
        settings["material"] = options.material
    if options.level is not None:
        surfaces = scene.surfaces()
        if len(surfaces) != 1 or surfaces[0].solid is not None:
            raise ValueError(f"scene {scene.name} has levels of its own; --level does not apply")
        settings["level"] = options.level
    scene.render(target, **settings)


def _mesh(options: Any) -> int:
    """Triangles of a scene's surface, or of that of a file with curves."""
    source = Path(options.scene)
    target = Path(options.output or f"{source.stem or 'surface'}.stl")
    if target.suffix.lower() not in MESH_FILES:
        raise ValueError(f"{target} has no extension of a mesh: name it {', '.join(MESH_FILES)}")
    if options.scene in SCENES:
        surfaces = SCENES[options.scene].surfaces()
        if len(surfaces) != 1:
            raise ValueError(f"scene {source} has {len(surfaces)} surfaces, and a mesh is of one")
        field, level, clip = surfaces[0].field, surfaces[0].numbers[0], surfaces[0].clip
    else:
        _check_source(options.scene)
        opened = open_surface(source)
        _say(f"{source}: {in_options(opened.said)}")
        field, level, clip = opened.field, None, None
    settings = {"tolerance": options.tolerance, "spacing": options.spacing}
    chosen = {name: value for name, value in settings.items() if value is not None}
    check_writable(target)
    with Console().status("starting") as status:
        made = mesh(
            field, level if options.level is None else options.level, clip=clip,
            progress=None if options.quiet else status.update, **chosen,
        )  # fmt: skip
    with write_atomically(target) as partial:
        made.export(partial)
    facts = made.metadata["harnack"]
    closed = "closed" if made.is_watertight else f"{len(facts['boundary'])} edges at its rim"
    _say(f"{len(made.faces):,} triangles, {closed}, {facts['evaluations']:,} evaluations")
    _say(f"wrote {target}")
    return 0


def _repair(options: Any) -> int:
    """A mesh with patches over its holes."""
    import trimesh  # here: half a second that few need

    source = Path(options.mesh)
    target = Path(options.output or f"{source.stem}-repaired.ply")
    if target.suffix.lower() not in MESH_FILES:
        raise ValueError(f"{target} has no extension of a mesh: name it {', '.join(MESH_FILES)}")
    found = read_surface(source, "winding")
    if not isinstance(found, Mesh):
        raise ValueError(f"{source} holds no mesh to repair")
    _say(f"{source}: {in_options(found.said)}")
    settings = {"tolerance": options.tolerance, "spacing": options.spacing}
    chosen = {name: value for name, value in settings.items() if value is not None}
    check_writable(target)
    # Files such as .stl list the corners of each face anew.
    kept, faces = np.unique(weld_vertices(found.vertices)[found.faces], return_inverse=True)
    given = trimesh.Trimesh(found.vertices[kept], faces.reshape(-1, 3), process=False)
    with Console().status("starting") as status:
        made = repair(given, progress=None if options.quiet else status.update, **chosen)
    with write_atomically(target) as partial:
        made.export(partial)
    facts = made.metadata["harnack"]
    holes = f"{facts['holes']:,} hole" + ("" if facts["holes"] == 1 else "s")
    added = f"{facts['patches']:,} triangles added to {len(faces):,}"
    _say(f"{holes}, {added}, Euler characteristic {facts['euler_characteristic']}")
    _say(f"wrote {target}")
    return 0


def _gallery(options: Any) -> int:
    console = Console()
    if options.list:
        for scene in SCENES.values():
            console.print(f"[bold]{scene.name:16}[/]{scene.title}", highlight=False)
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
    folder = _made(options.output)
    for index, scene in enumerate(wanted, start=1):
        console.print(
            f"{index}/{len(wanted)} [bold]{scene.name}[/]: {scene.title}", highlight=False
        )
        target = folder / f"{scene.name}.png"
        small = {"size": _DEMO_SIZE, "spp": scene.demo_spp} if options.demo else {}
        scene.render(target, **{**small, **_quality(options)})
        _say(f"    {target}")
    _say(f"{len(wanted)} pictures in {folder.resolve()}")
    return 0


def _made(name: str) -> Path:
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
    return 0 if doctor.render_report(Console()) else 1


COMMANDS: Mapping[str, Callable[[Any], int]] = MappingProxyType(
    {"render": _render, "mesh": _mesh, "repair": _repair, "gallery": _gallery, "doctor": _doctor}
)
"""By name."""
