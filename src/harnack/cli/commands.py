"""The commands of the command line, such as `render`. Each is a function that takes the parsed
arguments (an object with an attribute for each option) and returns the exit code. The "source" is
what is drawn or meshed: a scene of the gallery, a file or a formula.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from rich.console import Console

from harnack.backend import doctor
from harnack.cli.demo import check_demo_backend, draw_demo
from harnack.cli.example_scripts import copy_scripts, example_scripts
from harnack.cli.messages import python_to_cli_terms
from harnack.cli.sources import (
    is_mitsuba_scene,
    load_content,
    load_live_content,
    load_mitsuba_scene,
    load_single_surface,
    options_set,
    print_line,
    source_path,
)
from harnack.files.geometry_files import LoadedMesh, read_geometry
from harnack.gallery import SCENES
from harnack.geometry.boundary_edges import weld_vertices
from harnack.live import page, view
from harnack.mesh_to_file import (
    check_mesh_path,
    has_normals_unasked,
    write_mesh,
    write_plain_mesh,
)
from harnack.meshing import check_print, mesh, repair, wall_thickness
from harnack.meshing.sign_function import uses_sign_meshing
from harnack.name_suggestions import did_you_mean
from harnack.rendering import animate, render
from harnack.rendering.animation import check_film_path
from harnack.rendering.images import check_picture_path
from harnack.rendering.option_table import SHORTHAND
from harnack.tracer import Surface

# Of the pictures of `gallery --demo`, in pixels.
_SMALL_SIZE = (480, 360)


def _render(arguments: Any) -> int:
    """Run the command `render`: draw a picture of the source, and write it to a file."""
    path = source_path(arguments)
    target = check_picture_path(_output(arguments, path, ".png", "picture"))
    if is_mitsuba_scene(arguments, path):
        surfaces, settings = load_mitsuba_scene(arguments)
    else:
        # The third result, where the fields come from, is for scene files only.
        surfaces, settings, _ = load_content("render", arguments, path)
    render(surfaces, target, progress=not arguments.quiet, **settings)
    print_line(f"wrote {target}")
    return 0


def _animate(arguments: Any) -> int:
    """Run the command `animate`: write a film in which the camera goes around the source's
    surface."""
    path = source_path(arguments)
    target = check_film_path(_output(arguments, path, ".gif", "film"))
    if is_mitsuba_scene(arguments, path):
        raise ValueError("a film needs a scene, a surface file or a formula, no Mitsuba scene")
    # The third result, where the fields come from, is for scene files only.
    surfaces, settings, _ = load_content("animate", arguments, path)
    settings["show"] = arguments.show or "shaded"
    animate(surfaces, target, progress=not arguments.quiet, **settings)
    print_line(f"wrote {target}")
    return 0


def _page(arguments: Any) -> int:
    """Run the command `page`: write an HTML file in which the source's surface turns."""
    path = source_path(arguments)
    target = _output(arguments, path, ".html", "page")
    # The third result, where the fields come from, is for scene files only.
    surfaces, settings, _ = load_live_content("page", arguments, path)
    page(surfaces, target, progress=not arguments.quiet, **settings)
    print_line(f"wrote {target} ({Path(target).stat().st_size / 1e6:.1f} MB)")
    return 0


def _view(arguments: Any) -> int:
    """Run the command `view`: serve a page to the browser until Ctrl-C is pressed."""
    surfaces, settings, sources = load_live_content("view", arguments, source_path(arguments))
    view(surfaces, sources=sources, open_browser=not arguments.no_browser, block=True, **settings)
    return 0


def _output(arguments: Any, path: Path, suffix: str, kind: str) -> str:
    """Return the path of the file to write: the argument -o or, without it, the name of the source
    with the extension `suffix`. path: of the source. kind: what is written, such as "picture", for
    messages."""
    if arguments.output == "":
        raise ValueError(f"-o is empty: name the {kind} to write, such as a{suffix}")
    return arguments.output or f"{path.stem or kind}{suffix}"


def _mesh(arguments: Any) -> int:
    """Run the command `mesh`: write the source's surface as triangles, and print facts about
    them."""
    path = source_path(arguments)
    target = check_mesh_path(
        _output(arguments, path, ".stl", "mesh"), unit=arguments.unit, normals=arguments.normals_out
    )
    surface = load_single_surface(arguments, path)
    given_options = options_set("mesh", arguments)
    # The options of the surface were applied when it was loaded; the tolerance belongs to the mesh,
    # too.
    settings = {
        name: value
        for name, value in given_options.items()
        if name not in SHORTHAND or name == "tolerance"
    }
    triangles = mesh(surface, progress=not arguments.quiet, **settings)
    facts = triangles.metadata["harnack"]
    normals = _normals_of_field(surface, triangles, target, arguments)
    if arguments.scale is not None:
        triangles.apply_scale(arguments.scale)
    write_mesh(triangles, target, unit=arguments.unit, normals=normals)
    is_closed = triangles.is_watertight
    print_line(
        f"{len(triangles.faces):,} triangles, "
        f"{'closed' if is_closed else str(len(facts['boundary'])) + ' edges at its rim'}, "
        f"{facts['evaluations']:,} evaluations"
    )
    x, y, z = triangles.extents
    volume = f", volume {triangles.volume:.4g}" if is_closed else ""
    print_line(f"{x:.4g} x {y:.4g} x {z:.4g}{volume}")
    if "why" in facts:
        print_line(f"made of {facts['thickened_by']}: {facts['why']}")
    print_line(f"wrote {target}")
    return 0


def _normals_of_field(surface: Any, triangles: Any, target: Path, arguments: Any) -> Any:
    """Return the normals of a mesh that are written, by the gradient of its field: an array (n, 3);
    True for those of the faces, where the gradient is of no use; or None if none are written.

    surface: the field or surface whose mesh it is.
    triangles: the mesh, in the field's unit.
    target: the file that is written.
    """
    if not (arguments.normals_out or has_normals_unasked(target)):
        return None
    field = surface.field if isinstance(surface, Surface) else surface
    # Thick parts are beside the surface; and fields that are meshed by signs are rough on it.
    if arguments.thickness is not None or uses_sign_meshing(field):
        return True
    return field.gradient(triangles.vertices, precision="double")


def _repair(arguments: Any) -> int:
    """Run the command `repair`: close a damaged mesh, write it, and print what was changed."""
    import trimesh  # here: half a second that few need

    source = Path(arguments.mesh)
    target = check_mesh_path(arguments.output or f"{source.stem}-repaired.ply", unit=arguments.unit)
    loaded = read_geometry(source, "winding")
    if not isinstance(loaded, LoadedMesh):
        raise ValueError(f"{source} holds no mesh to repair")
    print_line(f"{source}: {python_to_cli_terms(loaded.summary)}")
    given_options = options_set("repair", arguments)
    # Files such as .stl list the corners of each face anew: corners at the same position are
    # joined.
    used, faces = np.unique(weld_vertices(loaded.vertices)[loaded.faces], return_inverse=True)
    damaged = trimesh.Trimesh(loaded.vertices[used], faces.reshape(-1, 3), process=False)
    repaired = repair(damaged, progress=not arguments.quiet, **given_options)
    write_mesh(repaired, target, unit=arguments.unit)
    facts = repaired.metadata["harnack"]
    if facts["differs"] is not None:
        print_line(
            f"not quite what was given: {facts['differs']['share']:.2%} of the points that were "
            "compared are on the wrong side"
        )
    print_line(f"{_repaired(facts, len(faces), len(repaired.faces))}, Euler characteristic "
         f"{facts['euler_characteristic']}")  # fmt: skip
    print_line(f"wrote {target}")
    return 0


def _repaired(facts: dict[str, Any], old: int, new: int) -> str:
    """Describe a repair in one line: what was kept, changed and added, and why not more was kept.

    facts: the metadata that `harnack.repair` returns with a mesh.
    old, new: the numbers of triangles before and after.
    """
    parts = _counted(len(facts["parts"]), "part")
    if facts["dropped"]:
        parts += f", of which {facts['dropped']:,} dropped"
    since = "" if facts["why"] is None else f" since {facts['why']}"
    if facts["stage"] == "remeshed":
        return (
            f"made anew: {new:,} triangles in place of {old:,}{since}; {facts['far']:,} vertices "
            f"and centers are beyond the tolerance, all are within {facts['within']:.2g}; {parts}"
        )
    if facts["stage"] == "boolean_union":
        return f"bodies united: {new:,} triangles around them, of {old:,}{since}; {parts}"
    added = f"{_counted(facts['holes'], 'hole')}, {facts['patches']:,} triangles added"
    if facts["stage"] == "filled":
        return f"{added} to {old:,}, which are all kept; {parts}"
    start, remaining = f"kept what is sound{since}", facts["kept"]
    if facts["stage"] == "welded":
        remaining = facts["joined"]
        start = f"corners joined that moved up to {facts['moved']:.2g}{since}"
    left_out = ", ".join(
        f"{count:,} {reason}" for reason, count in facts["left_out"].items() if count
    )
    return (
        f"{start}: {remaining:,} triangles of {old:,}, {facts['turned']:,} "
        f"of them turned over; left out {left_out or 'none'}; {added}; {parts}"
    )


def _counted(count: int, noun: str) -> str:
    """Return a count and its noun, as text such as "1 hole" or "2 holes"."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def _check(arguments: Any) -> int:
    """Run the command `check`: print the problems of a mesh for 3D printing, and write it with its
    thickness as colors if that is asked for. Returns 0 if there is no error, else 1."""
    if arguments.colors is not None:
        if arguments.min_thickness is None:
            raise ValueError(
                "--colors needs --min-thickness: the thickness below which they are red"
            )
        check_mesh_path(arguments.colors, colors=True)
    report = check_print(
        arguments.mesh, min_thickness=arguments.min_thickness, build_volume=arguments.build_volume
    )
    if arguments.json:
        print(json.dumps(report.as_dict()))
    else:
        size = " x ".join(f"{side:.4g}" for side in report.size)
        volume = "not closed" if report.volume is None else f"volume {report.volume:.4g}"
        print_line(f"{arguments.mesh}: {report.triangles:,} triangles, {size}, {volume}")
        for fault in report.problems:
            print_line(f"{'wrong' if fault.is_error else 'note'}: {fault.kind}: {fault.message}")
        if report.is_printable:
            print_line("nothing is wrong")
    if arguments.colors is not None:
        walls = wall_thickness(arguments.mesh)
        # Red below the smallest thickness, gray from three times that on. As it is, since the mesh
        # may be wrong.
        colored = walls.to_colored_mesh(arguments.min_thickness, 3 * arguments.min_thickness)
        write_plain_mesh(colored, Path(arguments.colors))
        if not arguments.json:
            print_line(f"wrote {arguments.colors}")
    return 0 if report.is_printable else 1


def _gallery(arguments: Any) -> int:
    """Run the command `gallery`: list the scenes of the gallery, or draw them into a folder."""
    console = Console()
    if arguments.list:
        width = max(map(len, SCENES)) + 2
        for name, scene in SCENES.items():
            console.print(f"[bold]{name:{width}}[/]{scene.title}", highlight=False, soft_wrap=True)
        return 0
    for name in arguments.names:
        if name not in SCENES:
            raise ValueError(
                f"no scene is named {name!r}; there are {', '.join(SCENES)}"
                f"{did_you_mean(name, SCENES)}"
            )
    scenes = [SCENES[name] for name in arguments.names] or list(SCENES.values())
    if arguments.demo:  # only scenes that are drawn with --demo have a number of samples for it
        scenes = [scene for scene in scenes if scene.demo_spp > 0]
    folder = _create_folder(arguments.output)
    for index, scene in enumerate(scenes, start=1):
        console.print(
            f"{index}/{len(scenes)} [bold]{scene.name}[/]: {scene.title}", highlight=False
        )
        target = folder / f"{scene.name}.png"
        # These pictures are small; options that were given count nevertheless.
        small = {"size": _SMALL_SIZE, "spp": scene.demo_spp} if arguments.demo else {}
        scene.render(
            target, **{**small, **options_set("render", arguments), "progress": not arguments.quiet}
        )
        print_line(f"    {target}")
    print_line(f"{len(scenes)} pictures in {folder.resolve()}")
    return 0


def _demo(arguments: Any) -> int:
    """Run the command `demo`: draw six pictures into a folder."""
    check_demo_backend()
    draw_demo(_create_folder(arguments.output), arguments)
    return 0


def _examples(arguments: Any) -> int:
    """Run the command `examples`: list the example scripts, and copy them into a folder."""
    scripts = example_scripts()
    folder = arguments.folder
    if not arguments.list:
        copy_scripts(scripts, _create_folder(folder, "the folder's name"))
    width = max(len(script.name) for script in scripts) + 2
    for script in scripts:
        print_line(f"{script.name:<{width}}{script.title}{script.requirement}")
    if arguments.list:
        print_line(f"`harnack examples` copies them into the folder {folder}")
        return 0
    print_line(f"{len(scripts)} scripts are in {Path(folder).resolve()}; run one, such as by")
    script = Path(folder) / "spanning_surface.py"
    print_line(f"    {shlex.join(['python', str(script), 'out'])}")
    print_line("which writes into the folder out")
    return 0


def _create_folder(name: str, argument: str = "-o") -> Path:
    """Create the folder with this name if it does not exist, and return its path. Raises a
    ValueError if that is impossible. argument: what the name was given as, for the message."""
    if not name:
        raise ValueError(f"{argument} is empty: name the folder to write to, such as out")
    folder = Path(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ValueError(f"cannot make the folder {folder}: a file of that name is there") from None
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"cannot make the folder {folder}: {why}; name another one") from None
    return folder


def _doctor(arguments: Any) -> int:
    """Run the command `doctor`: print a report about this installation. Returns 0 if harnack can
    work, else 1."""
    del arguments
    return 0 if doctor.print_report(Console()) else 1


COMMANDS: Mapping[str, Callable[[Any], int]] = MappingProxyType(
    {
        "render": _render,
        "animate": _animate,
        "page": _page,
        "view": _view,
        "mesh": _mesh,
        "repair": _repair,
        "check": _check,
        "gallery": _gallery,
        "demo": _demo,
        "examples": _examples,
        "doctor": _doctor,
    }
)
"""All commands by name."""
