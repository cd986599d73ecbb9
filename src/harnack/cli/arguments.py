"""The argument parser of the command `harnack`, and its messages about wrong arguments."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn

from harnack._version import __version__
from harnack.cli.mesh_files import MESH_FILES
from harnack.cli.messages import printable
from harnack.enclosures.selection import ENCLOSURE_NAMES
from harnack.field_from_file import UP_AXES
from harnack.fields.expressions import TextFormula
from harnack.files.geometry_files import GEOMETRY_SUFFIXES
from harnack.meshing.level_function import MOST_FACES
from harnack.name_suggestions import did_you_mean
from harnack.rendering import MATERIALS, SHOW_MODES
from harnack.rendering.backdrops import IMAGE_FILES, parse_backdrop
from harnack.rendering.render_options import ANTIALIASING, MAX_SIDE, MAX_SPP
from harnack.rendering.scales import parse_color
from harnack.rendering.stage import parse_material
from harnack.view.live_scene import LIVE_MODES
from harnack.view.sliders import Slider

# Of what was typed, this much is repeated in messages.
_SHOWN = 60
_MESH_FILE = "a mesh: .stl, .obj, .ply, .off, .glb, .gltf or .3mf"


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, and which option an unknown one may have meant."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        # argparse takes -1 for a number and would take -0.3:0.3, -1,0,0 and the axis -x for
        # options.
        self._negative_number_matcher = re.compile(r"-([\d.]|[xyz]$)")

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{printable(f'{self.prog}: error: {message}')} (see {self.prog} --help)\n")

    def options(self) -> list[str]:
        """All options, as they are written."""
        return [name for action in self._actions for name in action.option_strings]


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The arguments of a command, by default of this process; `command` is its name.

    Ends the process with exit code 2 for wrong usage.
    """
    whole, commands = parsers()
    if not (sys.argv[1:] if arguments is None else arguments):
        whole.print_help(sys.stderr)
        whole.exit(2)
    found, rest = whole.parse_known_args(arguments)
    if rest:
        command: _Parser = commands[found.command]
        known = command.options()
        if rest[0] in known:  # behind "--"
            command.error(f"{_quoted(rest[0])} is an option: write it before --")
        what = "there is no option" if rest[0].startswith("-") else "there is no use for"
        command.error(f"{what} {_quoted(rest[0])}{did_you_mean(rest[0], known)}")
    return found


def parsers() -> tuple[_Parser, dict[str, _Parser]]:
    """The parser of the whole command line, and the parsers of the commands by name."""
    whole = _Parser(
        prog="harnack", description="Guaranteed ray tracing of harmonic and other surfaces."
    )
    whole.add_argument("--version", action="version", version=f"harnack {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND", dest="command")
    _add_render(commands)
    _add_turntable(commands)
    _add_live(commands)
    _add_mesh(commands)
    _add_repair(commands)
    _add_check(commands)
    many = commands.add_parser("gallery", help="draw or list the named scenes")
    many.add_argument("names", nargs="*", metavar="NAME", help="scenes to draw (all)")
    many.add_argument("--list", action="store_true", help="list them and draw nothing")
    many.add_argument("--demo", action="store_true", help="only those of `make demo`, small")
    many.add_argument("-o", "--output", metavar="FOLDER", default="out", help="folder (out)")
    _add_image_options(many)
    commands.add_parser("doctor", help="say what is installed, what works, what is missing")
    return whole, commands.choices


def _add_render(commands: Any) -> None:
    one = commands.add_parser(
        "render", help="draw one picture",
        description="Draw a gallery scene, the surface of a file, a formula, or a Mitsuba scene "
        "(.xml). A formula is written as 'x^2 + y^2 = 1 + sin(2*z)'; --ball or --box cuts it. "
        f"Surface files are {', '.join(GEOMETRY_SUFFIXES)}: meshes with any defects, point clouds, "
        "and curves; what a file was taken for is printed.",
    )  # fmt: skip
    one.add_argument("-o", "--output", metavar="FILE", help="picture, .png or .exr (SCENE.png)")
    _add_render_options(one, "meshes and clouds, else color")
    _add_cluster(one, tiles=True)
    _add_choice(
        one, "--antialias", ANTIALIASING,
        "which pixels of a shaded picture get all samples: edges in the picture, or also what "
        "cones around pixels find, wires thinner than a pixel (edges)",
    )  # fmt: skip


def _add_turntable(commands: Any) -> None:
    one = commands.add_parser(
        "turntable", help="a film around a surface",
        description="Draw a film in which the camera goes around a gallery scene or the surface of "
        "a file.",
    )  # fmt: skip
    one.add_argument("-o", "--output", metavar="FILE", help="film, .gif or .mp4 (SCENE.gif)")
    one.add_argument("--frames", type=_samples, metavar="N", default=48, help="pictures (48)")
    one.add_argument(
        "--fps", type=_parse_positive, metavar="N", default=24.0, help="pictures a second (24)"
    )
    one.add_argument(
        "--turn", type=_angle, metavar="DEG", default=360.0, help="how far it goes around (360)"
    )
    _add_render_options(one, "all")
    _add_cluster(one)


def _add_live(commands: Any) -> None:
    page = commands.add_parser(
        "page", help="one HTML file in which a surface turns",
        description="Write one HTML file that opens in any browser with WebGPU, without Python and "
        "without a network. The visitor's own GPU traces the surface.",
    )  # fmt: skip
    page.add_argument("-o", "--output", metavar="FILE", help="the page, .html (SCENE.html)")
    page.add_argument("--quiet", action="store_true", help="no progress bar")
    _add_cluster(page)
    view = commands.add_parser(
        "view", help="a surface live in the browser: turned, its curve dragged, its level moved",
        description="Serve a page to the browser of this machine, until Ctrl-C. Python prepares "
        "what is moved there.",
    )  # fmt: skip
    view.add_argument(
        "--host", default="127.0.0.1",
        help="address to serve at; any but this machine's own is open to the network, and the "
        "page's address then has a token (127.0.0.1)",
    )  # fmt: skip
    view.add_argument("--port", type=_port, metavar="N", default=0, help="0 for a free one (0)")
    view.add_argument("--no-browser", action="store_true", help="open no browser")
    view.set_defaults(quiet=True)
    for one in (page, view):
        _add_choice(one, "--show", LIVE_MODES, "what to show at first (shaded)")
        one.add_argument("--title", metavar="TEXT", help="of the page")
        one.add_argument(
            "--slider", type=_slider, metavar="NAME=LOW:HIGH[:STEP]", action="append", default=[],
            help="a slider of the level (level=1:12) or of a name in the formula; as often as "
            "there are sliders",
        )  # fmt: skip
        _add_scene(one)
        _add_surface(one)
        _add_isolines(one)
        _add_camera_options(one)
        _add_file(one)


def _add_render_options(one: Any, shaded: str) -> None:
    """What is drawn, how, and seen from where. shaded: what is drawn so unless asked otherwise."""
    _add_scene(one)
    _add_choice(
        one, "--show", SHOW_MODES,
        "what to draw: color follows light paths, shaded lights first hits by a formula, "
        f"without noise (shaded for {shaded})",
    )  # fmt: skip
    _add_surface(one)
    _add_values(_add_isolines(one))
    _add_camera_options(one)
    _add_file(one)
    _add_image_options(one)
    one.add_argument(
        "--denoise", action="store_true",
        help="take the noise out of a color picture (needs pip install 'harnack[denoise]')",
    )  # fmt: skip


def _add_scene(one: Any) -> None:
    one.add_argument(
        "scene",
        metavar="SCENE",
        help="a name from `harnack gallery --list`, a file, or a formula of x, y and z",
    )
    one.add_argument(
        "--level", type=parse_level,
        help="level to draw (1/2 for meshes, 2pi for curves); pi is understood: 2pi, pi/2",
    )  # fmt: skip
    _add_parameters(one)
    one.add_argument(
        "--material", type=_material, metavar="NAME",
        help=f"what it is made of: {', '.join(MATERIALS)}, or a color by name or #rrggbb",
    )  # fmt: skip
    one.add_argument(
        "--confirm", action="store_true",
        help="a ray hits only where the field changes sign, not where it comes near and turns back",
    )  # fmt: skip


def _add_parameters(one: Any) -> None:
    one.add_argument(
        "--set", type=_parameter, metavar="NAME=NUMBER", action="append", default=[],
        dest="parameters", help="what a name in the formula stands for; once for each name",
    )  # fmt: skip


def _add_file(one: Any) -> Any:
    file = one.add_argument_group("surface files")
    _add_choice(
        file, "--read-as", ("winding", "dipole", "loops", "polygons"),
        "take the file as a mesh, as points with normals (of a mesh: the centers of its "
        "faces), as curves (of a mesh: its boundary) or as polygons that need not be flat, each "
        "spanned by a surface, whatever it looks like",
    )  # fmt: skip
    file.add_argument(
        "--take-boundary",
        action="store_true",
        help="take the boundary of a file's faces as the curves",
    )
    _add_choice(file, "--normals", ("estimate",), "estimate the normals of a point cloud")
    file.add_argument(
        "--smoothing", type=_smoothing, metavar="LENGTH",
        help="even out the noise of a point cloud over such lengths, in its own unit, or auto: "
        "by the noise that is found, with points moved and far ones left out",
    )  # fmt: skip
    return file


def _add_up(group: Any) -> None:
    _add_choice(
        group, "--up", UP_AXES,
        "the axis that points up (of files .glb, .gltf and surfaces in .obj y, else z)",
    )  # fmt: skip


def _add_surface(one: Any) -> None:
    group = one.add_argument_group("what of a surface is drawn")
    group.add_argument(
        "--solid", type=_parse_range, metavar="LOW:HIGH",
        help="the solid where the function is between two values; one may be left out: :0",
    )  # fmt: skip
    _add_clip(group)
    _add_section(group)
    group.add_argument(
        "--cut-material", type=_material, metavar="NAME",
        help="what the faces of a solid on its section are made of",
    )  # fmt: skip
    group.add_argument("--largest", action="store_true", help="only the largest connected part")
    group.add_argument(
        "--thickness", type=_parse_positive, metavar="LENGTH",
        help="draw it as a sheet so thick, half on each side, by a mesh",
    )  # fmt: skip
    group.add_argument(
        "--boundary-tube", type=_parse_positive, metavar="RADIUS",
        help="draw a tube around the curve at which it ends",
    )  # fmt: skip
    group.add_argument(
        "--boundary-material", type=_material, metavar="NAME", help="what it is made of (gold)"
    )
    _add_choice(
        group,
        "--bound",
        ENCLOSURE_NAMES,
        "the proof that steps are made by (the longest of all that apply)",
    )


def _add_isolines(one: Any) -> Any:
    group = one.add_argument_group("lines and values on the surface")
    group.add_argument(
        "--isolines", type=_isolines, metavar="FORMULA:SPACING",
        help="lines where a coordinate or a formula is a multiple of the spacing, as z:0.1, x*y:1",
    )  # fmt: skip
    group.add_argument(
        "--isolines-width", type=_parse_positive, metavar="LENGTH",
        help="how wide they are, in the surface's coordinates (0.4 percent of its size)",
    )  # fmt: skip
    group.add_argument(
        "--isolines-color", type=_color, metavar="COLOR", help="a name or #rrggbb (black)"
    )
    return group


def _add_values(group: Any) -> None:
    group.add_argument(
        "--of", type=_formula, metavar="FORMULA",
        help="the coordinate or the formula of x, y and z that --show value shows",
    )  # fmt: skip
    group.add_argument(
        "--value-range", type=_parse_range, metavar="LOW:HIGH",
        help="of the colors of values, depths or evaluations (what is seen)",
    )  # fmt: skip
    group.add_argument(
        "--colorbar", action="store_const", const=True,
        help="put a bar with numbers beside such a picture",
    )  # fmt: skip
    group.add_argument(
        "--colorbar-title", dest="colorbar", metavar="TITLE", help="the same, under a title"
    )


def _add_clip(group: Any) -> None:
    clip = group.add_mutually_exclusive_group()
    clip.add_argument(
        "--box", type=_six_numbers, metavar="X,Y,Z,X,Y,Z", help="cut by a box between two corners"
    )
    clip.add_argument("--ball", type=_four_numbers, metavar="X,Y,Z,R", help="cut by a ball")


def _add_section(group: Any) -> None:
    group.add_argument(
        "--section", type=_parse_plane, metavar="X,Y,Z[,OFFSET]",
        help="leave out what lies beyond a plane, on the side that the vector X,Y,Z points to, at "
        "a distance from the origin (0)",
    )  # fmt: skip


def _add_camera_options(one: Any) -> None:
    group = one.add_argument_group("camera and backdrop")
    for name, what in (("azimuth", "is turned"), ("elevation", "looks down")):
        group.add_argument(
            f"--{name}", type=_angle, metavar="DEG", help=f"how far the camera {what}, in degrees"
        )
    group.add_argument("--fov", type=_angle, metavar="DEG", help="its angle of view (26)")
    group.add_argument(
        "--zoom",
        type=_parse_positive,
        metavar="FACTOR",
        help="closer than what frames the surface (1)",
    )
    for name, what in (("position", "where it stands"), ("target", "what it looks at")):
        group.add_argument(
            f"--{name}", type=_three_numbers, metavar="X,Y,Z",
            help=f"{what}, in the surface's coordinates",
        )  # fmt: skip
    group.add_argument(
        "--distance", type=_parse_positive, metavar="LENGTH", help="how far it is from its target"
    )
    group.add_argument(
        "--backdrop", type=_backdrop, metavar="BACKDROP",
        help="what is behind the surface: light, dark, transparent, a color such as white or "
        "#334455, two from bottom to top such as white,steelblue, or an image "
        f"({', '.join(IMAGE_FILES)}) (light)",
    )  # fmt: skip
    _add_up(group)


def _add_mesh(commands: Any) -> None:
    one = commands.add_parser(
        "mesh", help="make triangles of a surface, or a closed part to print",
        description="Write the triangles of a gallery scene's surface, or of the surface that the "
        "curves of a file span. A surface that ends at a curve ends at its very vertices. Solids "
        "are closed, with caps where they are cut; --thickness makes a closed part of a surface.",
    )  # fmt: skip
    one.add_argument(
        "scene",
        metavar="SCENE",
        help="a name from `harnack gallery --list`, a file of curves, or a formula of x, y and z",
    )
    one.add_argument("-o", "--output", metavar="FILE", help=f"{', '.join(MESH_FILES)} (SCENE.stl)")
    one.add_argument("--level", type=parse_level, help="as for render")
    _add_parameters(one)
    one.add_argument(
        "--tolerance", type=_parse_positive, metavar="PART",
        help="how far triangles may be from the surface, as a part of its size (0.001)",
    )  # fmt: skip
    one.add_argument(
        "--cell-size",
        type=_parse_positive,
        metavar="LENGTH",
        help="of cells before anything is refined",
    )
    one.add_argument(
        "--solid", type=_parse_range, metavar="LOW:HIGH",
        help="the closed part where the function is between two values; one may be left out: :0",
    )  # fmt: skip
    one.add_argument(
        "--thickness", type=_parse_positive, metavar="LENGTH",
        help="a closed part so thick, in the scene's unit, half on each side of the surface",
    )  # fmt: skip
    _add_clip(one)
    _add_section(one)
    one.add_argument(
        "--simplify", action="store_true", help="fewer triangles of closed parts, as exact"
    )
    one.add_argument("--largest", action="store_true", help="only the largest connected part")
    one.add_argument(
        "--max-triangles", type=int, metavar="COUNT",
        help="of a surface, before anything is simplified: what would take more is not begun or "
        f"given up ({MOST_FACES:,})",
    )  # fmt: skip
    one.add_argument(
        "--scale", type=_parse_positive, metavar="FACTOR",
        help="multiply all lengths at the end: millimeters for one unit of the scene (1)",
    )  # fmt: skip
    _add_up(_add_file(one))
    one.add_argument("--quiet", action="store_true", help="do not say what is being done")


def _add_check(commands: Any) -> None:
    one = commands.add_parser(
        "check", help="say what a slicer would complain of",
        description="Say what is wrong with a mesh for printing, and where: open edges, edges of "
        "many faces, sides that disagree, crossing triangles, loose and tiny parts, cavities, thin "
        "walls. The exit code is 1 if something is wrong.",
    )  # fmt: skip
    one.add_argument("mesh", metavar="FILE", help=_MESH_FILE)
    one.add_argument(
        "--min-thickness",
        type=_parse_positive,
        metavar="LENGTH",
        help="the least thickness that is fine",
    )
    one.add_argument(
        "--build-volume",
        type=_parse_positive,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="what it has to fit on",
    )
    one.add_argument("--json", action="store_true", help="all of it as JSON")
    one.add_argument(
        "--colors", metavar="FILE",
        help="write the mesh with its thickness as colors, .ply or .glb (needs --min-thickness): "
        "red below the wall, gray from three times that on",
    )  # fmt: skip


def _add_repair(commands: Any) -> None:
    one = commands.add_parser(
        "repair", help="close a damaged mesh",
        description="Write a mesh with patches over its holes; the triangles that there are stay "
        "as they are. Where that cannot be done, those that are sound stay, and others (crossing, "
        "doubled) are left out or turned over. Where that fails too, as for loose triangles, all "
        "is made anew by the sign of the winding number less 1/2, and closed whatever the mesh is.",
    )  # fmt: skip
    one.add_argument("mesh", metavar="FILE", help=_MESH_FILE)
    one.add_argument(
        "-o", "--output", metavar="FILE", help=f"{', '.join(MESH_FILES)} (FILE-repaired.ply)"
    )
    one.add_argument(
        "--tolerance", type=_parse_positive, metavar="PART",
        help="how far new triangles may be from the surface, as a part of their size (0.001)",
    )  # fmt: skip
    one.add_argument(
        "--keep", choices=("all", "valid", "none"),
        help="all: fail if the triangles cannot all be kept; sound: keep those that are sound; "
        "none: make all anew (the first that can be done)",
    )  # fmt: skip
    one.add_argument(
        "--filling", choices=("smooth", "harmonic"),
        help="smooth: continue the surface around holes; harmonic: where the winding number is "
        "1/2 (smooth, and harmonic where those do not fit)",
    )  # fmt: skip
    one.add_argument(
        "--largest", action="store_true", default=None, help="keep the largest part alone"
    )
    one.add_argument(
        "--cell-size",
        type=_parse_positive,
        metavar="LENGTH",
        help="of cells before anything is refined",
    )
    one.add_argument("--quiet", action="store_true", help="do not say what is being done")


def _add_image_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--size", type=parse_size, metavar="WxH", help="pixels (800x600; of films 320x240)"
    )
    parser.add_argument(
        "--spp", type=_samples, metavar="N",
        help="samples a pixel (64; 9 at edges of shaded pictures)",
    )  # fmt: skip
    parser.add_argument(
        "--seed", type=_seed, metavar="N", default=0, help="another seed, other noise (0)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _add_cluster(one: Any, *, tiles: bool = False) -> None:
    group = one.add_argument_group("other machines, and going on after a stop")
    group.add_argument(
        "--scheduler", metavar="ADDRESS", dest="client",
        help="have the workers of a Dask cluster do the work, such as tcp://10.0.0.1:8786 "
        "(needs pip install 'harnack[cluster]')",
    )  # fmt: skip
    group.add_argument(
        "--checkpoint", metavar="FOLDER",
        help="keep finished parts in this folder, and do not do again those that are there",
    )  # fmt: skip
    if tiles:
        group.add_argument(
            "--tiles", type=_samples, metavar="N",
            help="cut the picture into so many parts (as suits the workers)",
        )  # fmt: skip


def _add_choice(parser: Any, option: str, names: Iterable[str], help: str, **settings: Any) -> None:
    known = tuple(names)
    shown = "{" + ",".join(known) + "}"
    parser.add_argument(option, type=_choice_parser(known), metavar=shown, help=help, **settings)


def _choice_parser(known: Sequence[str]) -> Callable[[str], str]:
    def chosen(text: str) -> str:
        if text not in known:
            raise argparse.ArgumentTypeError(
                f"{_quoted(text)} is none of {', '.join(known)}{did_you_mean(text, known)}"
            )
        return text

    return chosen


def _parse_positive(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{_quoted(text)} must be a positive number")
    return number


def _smoothing(text: str) -> float | str:
    return text if text == "auto" else _parse_positive(text)


def _port(text: str) -> int:
    if not re.fullmatch(r"[0-9]{1,5}", text) or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{_quoted(text)} must be a number from 0 to 65535")
    return int(text)


def _parameter(text: str) -> tuple[str, float]:
    """ "a=0.5" as ("a", 0.5)."""
    name, equals, number = text.partition("=")
    if not equals or not name.strip().isidentifier():
        raise argparse.ArgumentTypeError(f"{_quoted(text)}: write a name and a number as a=0.5")
    return name.strip(), parse_level(number)


def _slider(text: str) -> tuple[str, Slider]:
    """ "a=0:2:0.5" as ("a", Slider(0, 2, step=0.5))."""
    name, _, rest = text.partition("=")
    numbers = rest.split(":")
    if not name.strip().isidentifier() or len(numbers) not in (2, 3):
        raise argparse.ArgumentTypeError(
            f"{_quoted(text)}: write a name and two ends as level=1:12, a step behind them as "
            "level=1:12:0.5"
        )
    low, high, *step = map(parse_level, numbers)
    try:
        return name.strip(), Slider(low, high, step=step[0] if step else None)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{_quoted(text)}: {error}") from None


def _parse_range(text: str) -> tuple[float, float]:
    """ "-0.3:0.3" as (-0.3, 0.3), ":0" as (-inf, 0)."""
    low, colon, high = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{_quoted(text)}: write two values as -0.3:0.3")
    ends = (parse_level(low) if low else -math.inf, parse_level(high) if high else math.inf)
    if not ends[0] < ends[1] or all(map(math.isinf, ends)):
        raise argparse.ArgumentTypeError(f"{_quoted(text)}: the first value must be the lower one")
    return ends


def _isolines(text: str) -> tuple[str, float]:
    """ "z:0.1" as ("z", 0.1)."""
    formula, colon, spacing = text.rpartition(":")
    if not colon:
        raise argparse.ArgumentTypeError(
            f"{_quoted(text)}: write a coordinate or a formula, and a spacing, as z:0.1"
        )
    return _formula(formula), _parse_positive(spacing)


def _formula(text: str) -> str:
    try:
        TextFormula.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _material(text: str) -> str:
    try:
        parse_material(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _color(text: str) -> str:
    try:
        parse_color(text, "a color")
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _backdrop(text: str) -> Any:
    """What `render` takes: a name, colors with a comma, or an image's file."""
    parts = [part.strip() for part in text.split(",")]
    is_file = text.lower().endswith(IMAGE_FILES)
    given: Any = text if is_file or len(parts) != 2 else tuple(parts)
    try:
        parse_backdrop(given)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return given


def _three_numbers(text: str) -> tuple[float, ...]:
    return _numbers(text, 3)


def _six_numbers(text: str) -> tuple[float, ...]:
    return _numbers(text, 6)


def _four_numbers(text: str) -> tuple[float, ...]:
    return _numbers(text, 4)


def _parse_plane(text: str) -> tuple[float, ...]:
    """ "0,0,1" as (0, 0, 1, 0); a fourth number is the distance from the origin."""
    plane = _numbers(text, 4 if text.count(",") == 3 else 3)
    if not any(plane[:3]):
        raise argparse.ArgumentTypeError(f"{_quoted(text)}: the vector must not be zero")
    return plane if len(plane) == 4 else (*plane, 0.0)


def _numbers(text: str, count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(one) for one in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise argparse.ArgumentTypeError(f"{_quoted(text)} must be {count} numbers with commas")
    return numbers


def _angle(text: str) -> float:
    try:
        angle = float(text)
    except ValueError:
        angle = math.nan
    if not math.isfinite(angle):
        raise argparse.ArgumentTypeError(
            f"an angle is a finite number of degrees, not {_quoted(text)}"
        )
    return angle


def parse_size(text: str) -> tuple[int, int]:
    """ "800x600" as (800, 600)."""
    match = re.fullmatch(r"([0-9]{1,9})[xX]([0-9]{1,9})", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{_quoted(text)} is no size; write it as 800x600")
    width, height = int(match[1]), int(match[2])
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise argparse.ArgumentTypeError(f"{text}: each side must be 1 to {MAX_SIDE} pixels")
    return width, height


def parse_level(text: str) -> float:
    """A finite number, or a multiple of pi such as "2pi", "1.5*pi", "-pi/2"."""
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
        level = float(head) * (math.pi if has_pi else 1.0) / float(below or 1.0)
        if not math.isfinite(level):
            raise ValueError
        return level
    except (ValueError, ZeroDivisionError):
        raise argparse.ArgumentTypeError(
            f"{_quoted(text)} is no level; write 0.5, 2pi or pi/3"
        ) from None


def _samples(text: str) -> int:
    number = int(text) if re.fullmatch(r"[0-9]{1,9}", text) else 0
    if not 1 <= number <= MAX_SPP:
        raise argparse.ArgumentTypeError(f"{_quoted(text)} must be a number from 1 to {MAX_SPP}")
    return number


def _seed(text: str) -> int:
    if not re.fullmatch(r"[+-]?[0-9]{1,18}", text):
        raise argparse.ArgumentTypeError(f"{_quoted(text)} must be an integer of at most 18 digits")
    return int(text)


def _quoted(text: str) -> str:
    """What was typed, in quotes, its beginning if it is long."""
    return repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "...")
