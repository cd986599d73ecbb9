"""The argument parser of the command `harnack`: its commands, their options, and messages about
wrong arguments. Most options come from the table of all options (`rendering.option_table`), which
says for each function of the library (such as `render` or `mesh`) what options it has. argparse,
Python's library, does the parsing. A "source" is what a command draws or meshes: a scene of the
gallery, a file or a formula. `parser` is the parser of one command, and `commands` is the object of
argparse to which parsers of commands are added."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn, cast

from harnack._version import __version__
from harnack.cli.messages import printable
from harnack.cli.welcome import print_welcome
from harnack.field_from_file import UP_AXES
from harnack.files.geometry_files import GEOMETRY_SUFFIXES
from harnack.files.mesh_contents import METERS
from harnack.gallery import SCENES
from harnack.live.live_scene import LIVE_MODES
from harnack.live.sliders import Slider
from harnack.mesh_to_file import MESH_FILES
from harnack.name_suggestions import did_you_mean
from harnack.rendering import option_text as text
from harnack.rendering.option_table import NAMES_ELSEWHERE, Option, options_of

_MESH_FILE = "a mesh: .stl, .obj, .ply, .off, .glb, .gltf or .3mf"
_GROUP_TITLES = {
    "surface": "surface", "trace": "trace", "image": "picture", "style": "style",
    "color": "colors of values", "quality": "quality", "film": "film", "live": "page",
    "run": "other machines, and going on after a stop", "server": "server", "mesh": "mesh",
    "repair": "repair",
}  # fmt: skip
CAMERA_OPTIONS = ("azimuth", "elevation", "fov", "zoom", "position", "target", "distance")
"""The options that say where the camera is."""


class _Parser(argparse.ArgumentParser):
    """An argument parser that reports an error on one line, and suggests an existing option for an
    unknown one."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # Arguments that match are no options. By itself, argparse takes -1 for a number, but would
        # take -1,0,0 and the axis -x for options.
        self._negative_number_matcher = re.compile(r"-([\d.]|[xyz]$)")

    def error(self, message: str) -> NoReturn:
        """Print an error message on one line, and end the process with exit code 2."""
        self.exit(2, f"{printable(f'{self.prog}: error: {message}')} (see {self.prog} --help)\n")

    def options(self) -> list[str]:
        """Return the names of all options of this parser as they are written, such as "--level"."""
        return [name for action in self._actions for name in action.option_strings]

    def positionals(self) -> list[str]:
        """Return the names of all arguments of this parser that are no options, such as
        "source"."""
        return [action.dest for action in self._actions if not action.option_strings]


class _Once(argparse.Action):
    """The action of argparse for an option that may be given only once: it stores the value. (By
    default argparse would take the last of several values.)"""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Store the value of the option as an attribute of `namespace`. It is an error of the
        command line if it has one already.

        values: the value.
        option_string: the option as it was written, such as "--level", for the message.
        """
        if getattr(namespace, self.dest, None) is not None:
            parser.error(f"{option_string} is given twice")
        setattr(namespace, self.dest, values)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the arguments of a command, by default those of this process. The result has an
    attribute for each option, and the name of the command in `command`.

    Ends the process with exit code 2 for wrong usage, and with 0 after printing a welcome if there
    are no arguments.
    """
    given = [*(sys.argv[1:] if arguments is None else arguments)]
    whole, commands = parsers()
    if not given:
        print_welcome()
        whole.exit(0)
    if given[0] == "help":  # `harnack help render` is `harnack render --help`
        given = [*given[1:2], "--help"]
    if not given[0].startswith("-") and given[0] not in commands:
        whole.error(_no_command(given[0], commands))
    namespace, unknown = whole.parse_known_args(given)
    if unknown:
        command: _Parser = commands[namespace.command]
        known = command.options()
        if unknown[0] in known:  # behind "--"
            command.error(f"{text.quoted(unknown[0])} is an option: write it before --")
        is_option = unknown[0].startswith("-")
        command.error(_no_option(unknown[0], known) if is_option else _no_use(unknown[0], command))
    return namespace


def _no_command(written: str, commands: Iterable[str]) -> str:
    """Return the message about a first argument that is no command. If it is what can be drawn, the
    message says how.

    written: the argument.
    commands: the names of all commands.
    """
    problem = f"there is no command {text.quoted(written)}"
    if written in SCENES or "=" in written or written.lower().endswith(GEOMETRY_SUFFIXES):
        return f"{problem}; to draw it, write `harnack render` before it"
    hint = did_you_mean(written, commands)
    return f"{problem}{hint}" if hint else f"{problem}; there are {', '.join(commands)}"


def _no_option(written: str, known: Sequence[str]) -> str:
    """Return the message about an option that a command does not have.

    written: the option as it was written, such as "--domain" or "--domain=ball:0,0,0,1".
    known: the names of the command's options.
    """
    name = written.partition("=")[0]
    other_name = NAMES_ELSEWHERE.get(name.lstrip("-").replace("-", "_").lower(), "")
    flag = f"--{other_name.replace('_', '-')}"
    hint = f'; did you mean "{flag}"?' if flag in known else did_you_mean(name, known)
    return f"there is no option {text.quoted(name)}{hint}"


def _no_use(written: str, command: _Parser) -> str:
    """Return the message about an argument that is no option, and one too many for a command."""
    problem = f"there is no use for {text.quoted(written)}"
    if "source" not in command.positionals():
        return f"{problem}{did_you_mean(written, command.options())}"
    return (
        f"{problem}: one scene, file or formula at a time, a formula in quotes; "
        "`harnack gallery A B` draws several scenes"
    )


def parsers() -> tuple[_Parser, dict[str, _Parser]]:
    """Make the parser of the whole command line, and the parser of each command by the
    command's name."""
    whole = _Parser(
        prog="harnack", description="Guaranteed ray tracing of harmonic and other surfaces."
    )
    whole.add_argument("--version", action="version", version=f"harnack {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND", dest="command")
    _add_demo(commands)
    _add_examples(commands)
    _add_render(commands)
    _add_animate(commands)
    _add_page(commands)
    _add_view(commands)
    _add_mesh(commands)
    _add_repair(commands)
    _add_check(commands)
    gallery = commands.add_parser("gallery", help="draw or list the named scenes")
    gallery.add_argument("names", nargs="*", metavar="NAME", help="scenes to draw (all)")
    gallery.add_argument("--list", action="store_true", help="list them and draw nothing")
    gallery.add_argument("--demo", action="store_true", help="only those of `make demo-all`, small")
    gallery.add_argument("-o", "--output", metavar="FOLDER", default="out", help="folder (out)")
    _add_options(gallery, "render", only=("size", "spp", "seed"))
    _add_quiet(gallery)
    commands.add_parser("doctor", help="say what is installed, what works, what is missing")
    return whole, commands.choices


def _add_render(commands: Any) -> None:
    """Add the command `render`, which draws one picture, to the parsers of commands."""
    parser = commands.add_parser(
        "render", help="draw one picture",
        description="Draw a gallery scene, the surface of a file, a formula, or a Mitsuba scene "
        "(.xml). A formula is written as 'x^2 + y^2 = 1 + sin(2*z)'; --clip cuts it. "
        f"Surface files are {', '.join(GEOMETRY_SUFFIXES)}: meshes with any defects, point clouds, "
        "and curves; what a file was taken for is printed.",
    )  # fmt: skip
    _add_drawing(parser, "render", "picture, .png or .exr (SOURCE.png)")
    _add_quiet(parser)


def _add_animate(commands: Any) -> None:
    """Add the command `animate`, which makes a film, to the parsers of commands."""
    parser = commands.add_parser(
        "animate", help="a film around a surface",
        description="Draw a film in which the camera goes around a gallery scene, a formula or the "
        "surface of a file.",
    )  # fmt: skip
    _add_drawing(parser, "animate", "film, .gif or .mp4 (SOURCE.gif)")
    _add_quiet(parser)


def _add_page(commands: Any) -> None:
    """Add the command `page`, which writes an HTML file, to the parsers of commands."""
    parser = commands.add_parser(
        "page", help="one HTML file in which a surface turns",
        description="Write one HTML file that opens in any browser with WebGPU, without Python and "
        "without a network. The visitor's own GPU traces the surface.",
    )  # fmt: skip
    _add_drawing(parser, "page", "the page, .html (SOURCE.html)")
    _add_sliders(parser)
    _add_quiet(parser)


def _add_view(commands: Any) -> None:
    """Add the command `view`, which serves a page, to the parsers of commands."""
    parser = commands.add_parser(
        "view", help="a surface live in the browser: turned, its curve dragged, its level moved",
        description="Serve a page to the browser of this machine, until Ctrl-C. Python prepares "
        "what is moved there.",
    )  # fmt: skip
    _add_drawing(parser, "view", None)
    _add_sliders(parser)
    parser.add_argument("--no-browser", action="store_true", help="open no browser")
    parser.set_defaults(quiet=True)


def _add_mesh(commands: Any) -> None:
    """Add the command `mesh`, which writes a surface as triangles, to the parsers of commands."""
    parser = commands.add_parser(
        "mesh", help="make triangles of a surface, or a closed part to print",
        description="Write the triangles of a gallery scene's surface, of a formula, or of the "
        "surface that the curves of a file span. A surface that ends at a curve ends at its very "
        "vertices. Solids are closed, with caps where they are cut; --thickness makes a closed "
        "part of a surface.",
    )  # fmt: skip
    _add_source(parser, f"{', '.join(MESH_FILES)} (SOURCE.stl)")
    _add_options(parser, "mesh", without=("seed",))
    parser.add_argument(
        "--scale", type=_argument(text.parse_positive), metavar="FACTOR",
        help="multiply all lengths at the end: millimeters for one unit of the source (1)",
    )  # fmt: skip
    _add_unit(parser)
    parser.add_argument(
        "--vertex-normals", dest="normals_out", action="store_true",
        help="write normals at vertices, by the field's gradient where it has one, to .ply and "
        ".obj files (others have none, or always have them)",
    )  # fmt: skip
    _add_file_options(parser).add_argument(
        "--up", type=_argument(text.parse_choice(*UP_AXES)), metavar="{" + ",".join(UP_AXES) + "}",
        help="axis of the file that points up (of .glb, .gltf and surfaces in .obj y, else z)",
    )  # fmt: skip
    _add_quiet(parser)


def _add_repair(commands: Any) -> None:
    """Add the command `repair`, which closes a damaged mesh, to the parsers of commands."""
    parser = commands.add_parser(
        "repair", help="close a damaged mesh",
        description="Write a mesh with its holes filled; its triangles stay as they are. Where "
        "that cannot be done, the valid ones stay, and others (crossing, doubled) are left out or "
        "turned over. Where that fails too, as for loose triangles, everything is made anew by the "
        "sign of the winding number less 1/2, and closed whatever the mesh is.",
    )  # fmt: skip
    parser.add_argument("mesh", metavar="FILE", help=_MESH_FILE)
    parser.add_argument(
        "-o", "--output", metavar="FILE", help=f"{', '.join(MESH_FILES)} (FILE-repaired.ply)"
    )
    _add_options(parser, "repair", without=("seed",))
    _add_unit(parser)
    _add_quiet(parser)


def _add_check(commands: Any) -> None:
    """Add the command `check`, which examines a mesh before printing, to the parsers of
    commands."""
    parser = commands.add_parser(
        "check", help="say what a slicer would complain of",
        description="Say what is wrong with a mesh for printing, and where: open edges, edges of "
        "many faces, sides that disagree, crossing triangles, loose and tiny components, cavities, "
        "thin walls. The exit code is 1 if something is wrong.",
    )  # fmt: skip
    parser.add_argument("mesh", metavar="FILE", help=_MESH_FILE)
    length = _argument(text.parse_positive)
    parser.add_argument(
        "--min-thickness", type=length, metavar="LENGTH", help="smallest thickness of a sound wall"
    )
    parser.add_argument(
        "--build-volume", type=length, nargs=3, metavar=("X", "Y", "Z"),
        help="size of the space that it has to fit into",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="everything as JSON")
    parser.add_argument(
        "--colors", metavar="FILE",
        help="write the mesh with its thickness as colors to a file of any format but .stl (needs "
        "--min-thickness): red below that thickness, gray from three times that on",
    )  # fmt: skip


def _add_drawing(parser: Any, verb: str, output: str | None) -> None:
    """Add the arguments that all commands that draw have: the source, the output, and the options
    of the function `verb` of the library (such as "render"), of the camera and of surface files.
    output: the help text of -o; None for no such option."""
    _add_source(parser, output)
    _add_options(parser, verb)
    _add_camera(parser)
    _add_file_options(parser)


def _add_demo(commands: Any) -> None:
    """Add the command `demo`, which draws six pictures, to the parsers of commands."""
    parser = commands.add_parser(
        "demo", help="draw six pictures, in about a minute",
        description="Draw six pictures that show what harnack is for: surfaces that span a knot "
        "and a link, glass, a carved solid, a mesh with holes, and points. Five are shaded, which "
        "takes seconds; the glass follows light paths.",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", metavar="FOLDER", default="harnack-demo", help="folder (harnack-demo)"
    )
    _add_options(parser, "render", only=("size", "spp", "seed"))
    _add_quiet(parser)


def _add_examples(commands: Any) -> None:
    """Add the command `examples`, which copies example scripts, to the parsers of commands."""
    parser = commands.add_parser(
        "examples", help="copy Python scripts to start from, or list them",
        description="Copy the example scripts into a folder, and list them. Files that are there "
        "already and differ are not overwritten.",
    )  # fmt: skip
    parser.add_argument(
        "folder", nargs="?", metavar="FOLDER", default="harnack-examples",
        help="folder to copy to (harnack-examples)",
    )  # fmt: skip
    parser.add_argument("--list", action="store_true", help="list them and copy nothing")


def _add_source(parser: Any, output: str | None) -> None:
    """Add three arguments: the source; the option -o, unless its help text `output` is None; and
    the option --parameter."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="a name from `harnack gallery --list`, a file, or a formula of x, y and z",
    )
    if output is not None:
        parser.add_argument("-o", "--output", metavar="FILE", help=output)
    parser.add_argument(
        "--parameter", type=_argument(_parse_parameter), metavar="NAME=NUMBER", action="append",
        default=[], dest="parameters", help="the number of a name in the formula; once a name",
    )  # fmt: skip


def _add_options(
    parser: Any,
    verb: str,
    *,
    only: Sequence[str] | None = None,
    without: Sequence[str] = (),
) -> None:
    """Add the options that the table of all options lists for a function of the library, in groups.

    verb: the name of the function, such as "render".
    only: the names of the options to add; None for all.
    without: names of options to leave out.
    """
    groups: dict[str, Any] = {}
    for option in options_of(verb):
        if option.name in without or not option.is_on_command_line:
            continue
        if only is not None and option.name not in only:
            continue
        if option.group not in groups:
            groups[option.group] = parser.add_argument_group(_GROUP_TITLES[option.group])
        _add_option(groups[option.group], option, verb)
        if option.name == "isolines":
            _add_isolines_style(groups[option.group])


def _add_option(group: Any, option: Option, verb: str) -> None:
    """Add an option of the table to a group of a parser. verb: the function of the library that the
    command calls, such as "render"."""
    if option.is_switch:
        # None, and not False, if it is not given.
        group.add_argument(option.flag, action="store_true", default=None, help=option.help)
        return
    settings: dict[str, Any] = {
        "type": _argument(cast("Any", option.parse)),
        "metavar": option.value,
    }
    # Brackets mean that the value may be left out.
    if option.value.startswith("["):
        settings |= {"nargs": "?", "const": True, "metavar": option.value[1:-1]}
    help_text = option.help
    # Pages and views have fewer kinds of pictures.
    if option.name == "show" and verb in ("page", "view"):
        names = "{" + ",".join(LIVE_MODES) + "}"
        settings |= {"type": _argument(text.parse_choice(*LIVE_MODES)), "metavar": names}
        help_text = "picture at first (shaded)"
    action = "append" if option.name == "isolines" else _Once
    group.add_argument(option.flag, dest=option.name, help=help_text, action=action, **settings)


def _add_isolines_style(group: Any) -> None:
    """Add the options for the width and the color of isolines."""
    group.add_argument(
        "--isolines-width", type=_argument(text.parse_positive), metavar="LENGTH",
        help="width of these lines, in the surface's coordinates (0.4 percent of its size)",
    )  # fmt: skip
    group.add_argument(
        "--isolines-color", type=_argument(text.parse_color_name), metavar="COLOR",
        help="their color, a name or #rrggbb (black)",
    )  # fmt: skip


def _add_camera(parser: Any) -> None:
    """Add the options that say where the camera is."""
    group = parser.add_argument_group("camera")
    helps: dict[str, tuple[Callable[[str], Any], str, str]] = {
        "azimuth": (text.parse_number, "DEGREES", "direction it looks from, around up (-50)"),
        "elevation": (text.parse_number, "DEGREES", "how far it looks down (28)"),
        "fov": (text.parse_number, "DEGREES", "its angle of view (26)"),
        "zoom": (text.parse_positive, "FACTOR", "closer than what frames the surface (1)"),
        "position": (text.parse_point, "X,Y,Z", "where it stands, in the surface's coordinates"),
        "target": (text.parse_point, "X,Y,Z", "the point that it looks at, in the same"),
        "distance": (text.parse_positive, "LENGTH", "how far it is from its target"),
    }
    for name in CAMERA_OPTIONS:
        parse_text, value, help_text = helps[name]
        group.add_argument(f"--{name}", type=_argument(parse_text), metavar=value, help=help_text)


def _add_sliders(parser: Any) -> None:
    """Add the option --slider, for pages and views."""
    parser.add_argument(
        "--slider", type=_argument(_parse_slider), metavar="NAME=LOW:HIGH[:STEP]", action="append",
        default=[],
        help="a slider of an option that is a number, such as level=1:12, or of a name in the "
        "formula; once for each slider",
    )  # fmt: skip


def _add_file_options(parser: Any) -> Any:
    """Add the options for surface files to a parser, and return their group."""
    group = parser.add_argument_group("surface files")
    kinds = ("winding", "dipole", "loops", "polygons")
    group.add_argument(
        "--read-as", type=_argument(text.parse_choice(*kinds)), metavar="{" + ",".join(kinds) + "}",
        help="take the file as a mesh, as points with normals (of a mesh: the centers of its "
        "faces), as curves (of a mesh: its boundary) or as polygons that need not be flat, each "
        "spanned by a surface, whatever it looks like",
    )  # fmt: skip
    group.add_argument(
        "--take-boundary", action="store_true",
        help="take the boundary of a file's faces as the curves",
    )  # fmt: skip
    group.add_argument(
        "--normals", type=_argument(text.parse_choice("estimate")), metavar="{estimate}",
        help="estimate the normals of a point cloud",
    )  # fmt: skip
    group.add_argument(
        "--smoothing", type=_argument(_parse_smoothing), metavar="LENGTH",
        help="even out the noise of a point cloud over such lengths, in its own unit, or auto: "
        "by the noise that is measured, with points moved and far ones left out",
    )  # fmt: skip
    group.add_argument(
        "--origin", type=_argument(_parse_origin), metavar="{center,file,X,Y,Z}",
        help="the point of the file that becomes the origin: its middle, its own origin or a point "
        "(its middle if it is more than 1,000 sizes away, as coordinates of maps are; else its own "
        "origin)",
    )  # fmt: skip
    return group


def _add_unit(parser: Any) -> None:
    """Add the option --unit, for commands that write a mesh."""
    parser.add_argument(
        "--unit", type=_argument(text.parse_choice(*METERS)), metavar="{" + ",".join(METERS) + "}",
        help="what one unit of the written coordinates is: .3mf and USD files say so, and those of "
        ".glb files are converted to meters (mm of .3mf, m of .glb, cm of USD files)",
    )  # fmt: skip


def _add_quiet(parser: Any) -> None:
    """Add the option --quiet, which shows no progress."""
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def _argument(parse_text: Callable[[str], Any]) -> Callable[[str], Any]:
    """Make a function for argparse that parses an option's text by `parse_text`. Its errors become
    errors of argparse, so that they are shown as errors of that option."""

    def parsed(value: str) -> Any:
        """Return the parsed value of an option's text."""
        try:
            return parse_text(value)
        except (ValueError, TypeError) as wrong:
            raise argparse.ArgumentTypeError(str(wrong)) from None

    return parsed


def _parse_smoothing(value: str) -> float | str:
    """Return the number that a text gives, a positive length; or "auto", which stays as it is."""
    return value if value == "auto" else text.parse_positive(value)


def _parse_origin(value: str) -> str | tuple[float, ...]:
    """Return "center" or "file" as they are, and any other text as a point."""
    return value if value in ("center", "file") else text.parse_point(value)


def _parse_parameter(value: str) -> tuple[str, float]:
    """Return a name and a number from text: "a=0.5" as ("a", 0.5). Raises a ValueError for any
    other text."""
    name, equals, number = value.partition("=")
    if not equals or not name.strip().isidentifier():
        raise ValueError(f"{text.quoted(value)}: write a name and a number as a=0.5")
    if "=" in number:
        raise ValueError(
            f"{text.quoted(value)}: write --parameter once for each name, as --parameter a=0.5 "
            "--parameter b=1"
        )
    return name.strip(), text.parse_level(number, "number")


def _parse_slider(value: str) -> tuple[str, Slider]:
    """Return a name and a slider from text: "a=0:2:0.5" as ("a", Slider(0, 2, step=0.5)). The name
    of an option may be written as on the command line, such as "boundary-radius". Raises a
    ValueError for any other text."""
    name, _, interval_text = value.partition("=")
    name = name.strip().replace("-", "_")
    if "=" in interval_text:
        raise ValueError(
            f"{text.quoted(value)}: write --slider once for each name, as --slider a=0:1 "
            "--slider b=1:2"
        )
    numbers = interval_text.split(":")
    if not name.isidentifier() or len(numbers) not in (2, 3):
        raise ValueError(
            f"{text.quoted(value)}: write a name and two ends as level=1:12, a step behind them as "
            "level=1:12:0.5"
        )
    low, high, *step = (text.parse_level(number, "number") for number in numbers)
    try:
        return name, Slider(low, high, step=step[0] if step else None)
    except ValueError as wrong:
        raise ValueError(f"{text.quoted(value)}: {wrong}") from None
