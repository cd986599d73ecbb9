"""The command line: arguments to calls to files."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from harnack._version import __version__
from harnack.backend import doctor
from harnack.gallery import SCENES, Scene
from harnack.geometry.surfaces import SURFACE_FILES
from harnack.opening import UP_AXES, open_surface
from harnack.rendering import MATERIALS, SHOW_MODES, Camera, render
from harnack.rendering.images import check_picture_path

_DEMO_SIZE = (480, 360)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; 0 on success, 1 for what went wrong, 2 for wrong usage, 130 for Ctrl-C."""
    options = _parser().parse_args(arguments)
    errors = Console(stderr=True)
    try:
        return int(options.run(options))
    except KeyboardInterrupt:
        errors.print("stopped; nothing was written for the picture in progress")
        return 130
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        errors.print(f"[bold red]error:[/] {error}", highlight=False, soft_wrap=True)
        return 1


def _angle(text: str) -> float:
    angle = float(text)
    if not math.isfinite(angle):
        raise argparse.ArgumentTypeError(f"an angle is a finite number of degrees, not {text}")
    return angle


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="harnack", description="Guaranteed ray tracing of harmonic and other surfaces."
    )
    parser.add_argument("--version", action="version", version=f"harnack {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_render(commands)
    many = commands.add_parser("gallery", help="draw or list the named scenes")
    many.add_argument("names", nargs="*", metavar="NAME", help="scenes to draw (all)")
    many.add_argument("--list", action="store_true", help="list them and draw nothing")
    many.add_argument("--demo", action="store_true", help="only those of `make demo`, small")
    many.add_argument("-o", "--output", metavar="FOLDER", default="out", help="folder (out)")
    _add_quality(many)
    many.set_defaults(run=_gallery)
    check = commands.add_parser("doctor", help="say what is installed, what works, what is missing")
    check.set_defaults(run=_doctor)
    return parser


def _add_render(commands: Any) -> None:
    one = commands.add_parser(
        "render", help="draw one picture",
        description="Draw a gallery scene, the surface of a file, or a Mitsuba scene (.xml). "
        f"Surface files are {', '.join(SURFACE_FILES)}: meshes with any defects, point clouds, "
        "and curves; what a file was taken for is printed.",
    )  # fmt: skip
    one.add_argument(
        "scene", metavar="SCENE", help="a name from `harnack gallery --list`, or a file"
    )
    one.add_argument("-o", "--output", metavar="FILE", help="picture, .png or .exr (SCENE.png)")
    one.add_argument(
        "--level", type=parse_level,
        help="level to draw (1/2 for meshes, 2pi for curves); pi is understood: 2pi, pi/2",
    )  # fmt: skip
    one.add_argument("--material", choices=sorted(MATERIALS), help="what it is made of")
    one.add_argument(
        "--show", choices=SHOW_MODES,
        help="what to draw: color follows light paths, shaded lights first hits by a formula, "
        "without noise (shaded for meshes and clouds, else color)",
    )  # fmt: skip
    for name, what in (("azimuth", "is turned"), ("elevation", "looks down")):
        one.add_argument(
            f"--{name}", type=_angle, metavar="DEG", help=f"how far the camera {what}, in degrees"
        )
    file = one.add_argument_group("surface files")
    file.add_argument(
        "--as", dest="as_", choices=("winding", "dipole", "loops"),
        help="take the file as a mesh, as points with normals (of a mesh: the centers of its "
        "faces) or as curves (of a mesh: its boundary), whatever it looks like",
    )  # fmt: skip
    file.add_argument(
        "--boundary", action="store_true", help="take the boundary of a file's faces as the curves"
    )
    file.add_argument(
        "--normals", choices=("estimate",), help="estimate the normals of a point cloud"
    )
    file.add_argument(
        "--up", choices=UP_AXES,
        help="the file's axis that points up (y for .glb, .gltf and surfaces in .obj, else z)",
    )  # fmt: skip
    _add_quality(one)
    one.set_defaults(run=_render)


def _add_quality(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", type=parse_size, metavar="WxH", help="pixels (800x600)")
    parser.add_argument(
        "--spp", type=_positive, metavar="N",
        help="samples a pixel (64; 9 at edges of shaded pictures)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="another seed, other noise (0)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def parse_size(text: str) -> tuple[int, int]:
    """ "800x600" as (800, 600)."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is no size; write it as 800x600")
    width, height = int(match[1]), int(match[2])
    if not (0 < width <= 16384 and 0 < height <= 16384):
        raise argparse.ArgumentTypeError(f"{text}: each side must be 1 to 16384 pixels")
    return width, height


def parse_level(text: str) -> float:
    """A number, or a multiple of pi such as "2pi", "1.5*pi", "-pi/2"."""
    match = re.fullmatch(
        r"([+-]?[\d.]*(?:e[+-]?\d+)?)\s*\*?\s*(pi)?\s*(?:/\s*([\d.]+))?", text.strip()
    )
    try:
        if not match:
            raise ValueError
        head, has_pi, below = match.groups()
        if head in ("", "+", "-"):
            if not has_pi:
                raise ValueError
            head += "1"
        return float(head) * (math.pi if has_pi else 1.0) / float(below or 1.0)
    except (ValueError, ZeroDivisionError):
        raise argparse.ArgumentTypeError(f"{text!r} is no level; write 0.5, 2pi or pi/3") from None


def _positive(text: str) -> int:
    number = int(text) if text.isdigit() else 0
    if not 1 <= number <= 1_000_000:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number from 1 to 1000000")
    return number


def _quality(options: Any) -> dict[str, Any]:
    asked = {"size": options.size, "spp": options.spp}
    chosen = {name: value for name, value in asked.items() if value is not None}
    return {**chosen, "seed": options.seed, "progress": not options.quiet}


def _render(options: Any) -> int:
    source = Path(options.scene)
    target = check_picture_path(options.output or f"{source.stem}.png")
    settings = _quality(options)
    if options.show is not None:
        settings["show"] = options.show
    if options.azimuth is not None or options.elevation is not None:
        settings["camera"] = _camera(options)
    kind = source.suffix.lower()
    if options.scene in SCENES or kind == ".xml":
        _refuse_file_options(options)
    if options.scene in SCENES:
        _draw_scene(SCENES[options.scene], target, options, settings)
    elif kind == ".xml":
        if options.level is not None or options.material is not None:
            raise ValueError("level and material of a Mitsuba scene are set in its own file")
        if not source.is_file():
            raise ValueError(f"there is no file {source}")
        render(str(source), target, **settings)
    elif kind in SURFACE_FILES:
        _draw_file(source, target, options, settings)
    else:
        raise ValueError(
            f"{options.scene!r} is no scene: give a name from `harnack gallery --list`, a surface "
            f"file ({', '.join(SURFACE_FILES)}) or a Mitsuba scene (.xml)"
        )
    Console().print(f"wrote {target}", highlight=False)
    return 0


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
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{source}: {opened.said}", markup=False)
    console.print(f"{type(opened.field).__name__}: {facts}", markup=False)
    if options.show is None and opened.show != "color":
        settings["show"] = opened.show
        console.print(f"drawn {opened.show}; --show color follows light paths, in minutes")
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


def _gallery(options: Any) -> int:
    console = Console()
    if options.list:
        for scene in SCENES.values():
            console.print(f"[bold]{scene.name:16}[/]{scene.title}", highlight=False)
        return 0
    for name in options.names:
        if name not in SCENES:
            raise ValueError(f"no scene is named {name!r}; there are {', '.join(SCENES)}")
    wanted = [SCENES[name] for name in options.names] or list(SCENES.values())
    if options.demo:
        wanted = [scene for scene in wanted if scene.demo_spp > 0]
    folder = Path(options.output)
    folder.mkdir(parents=True, exist_ok=True)
    for index, scene in enumerate(wanted, start=1):
        console.print(
            f"{index}/{len(wanted)} [bold]{scene.name}[/]: {scene.title}", highlight=False
        )
        target = folder / f"{scene.name}.png"
        small = {"size": _DEMO_SIZE, "spp": scene.demo_spp} if options.demo else {}
        scene.render(target, **{**small, **_quality(options)})
        console.print(f"    {target}", highlight=False)
    console.print(f"{len(wanted)} pictures in {folder.resolve()}", highlight=False)
    return 0


def _doctor(options: Any) -> int:
    del options
    return 0 if doctor.render_report(Console()) else 1


if __name__ == "__main__":
    sys.exit(main())
