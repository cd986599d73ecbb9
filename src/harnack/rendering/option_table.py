"""Defines the table `OPTIONS` of all options (keyword arguments) of the library's functions
`trace`, `render`, `mesh` and so on. These functions are called verbs here, and a verb is given by
its name, such as "render". Each row of the table is an `Option`: its name, the verbs that take it,
its check, its defaults and its help.

The table determines the checks and signatures of calls in Python, the options of the command line,
which options scene files hold and films and sliders may change, and a table of the documentation.
To add an option, add a row here, a check in `render_options`, and the code that uses it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from harnack.name_suggestions import did_you_mean
from harnack.rendering import option_text as text
from harnack.rendering import render_options as checks
from harnack.tracer.trace_options import (
    SURFACE_OPTIONS,
    TRACE_OPTIONS,
    TraceKeywords,
    TraceOptions,
    shorthand_parameters,
    shows_parameters,
)

if TYPE_CHECKING:
    import os

    from harnack.fields import Field
    from harnack.progress import ProgressFunction
    from harnack.rendering.backdrops import Backdrop
    from harnack.rendering.camera import Camera
    from harnack.rendering.isolines import Isolines
    from harnack.rendering.stage import MaterialLike

_Function = TypeVar("_Function", bound=Callable[..., Any])

PICTURES = frozenset(("render", "animate"))
LIVE = frozenset(("view", "page"))
DRAWN = PICTURES | LIVE
DISTANCES = frozenset(("signed_distance", "closest_points", "distance_bounds"))
CURVATURES = frozenset(("curvature", "curvature_lines"))
RAYS = frozenset(("trace", "crossings"))
VERBS = RAYS | DRAWN | DISTANCES | CURVATURES | {"mesh", "repair"}
"""The functions that take options."""
COMMANDS = DRAWN | {"mesh", "repair"}
"""Those that are commands of the command line as well."""

LIVE_MODES = ("shaded", "normal", "depth", "evaluations", "status")
"""The values of `show` that pages and views have."""

_PLACED = RAYS | DRAWN | DISTANCES | {"mesh", "curvature_lines"}

Parse = Callable[[str], Any]


@dataclass(frozen=True)
class Option:
    """One option (keyword argument) of some of the library's functions `trace`, `render`, `mesh`
    and so on. These functions are called verbs.

    name: the keyword in Python and the name in scene files; on the command line "--name", with
        hyphens.
    group: what the option is about: surface, trace, image, style, color, quality, run, film, live,
        server, mesh or repair.
    verbs: the names of the functions that take it. All other functions of `VERBS` refuse it with an
        error that names it.
    help: what it is, in a sentence without a period, and its default in brackets.
    value: what stands for its value in the help of the command line, such as "LENGTH" or "WxH"; ""
        for an option without a value.
    parse: turns the text on a command line into the value. It is None for a switch (an option that
        is False by default), for an option that the command line does not have, and for one that
        the command line builds from several others.
    check: a function of the value and of the option `show`, the kind of picture. It returns the
        value in its final form, or raises an error.
    default: the value if a call does not set the option.
    default_of: other defaults, by the name of the function.
    varies: whether the option may differ between pictures of a film, and may have a slider on a
        page.
    in_files: whether scene files hold it.
    """

    name: str
    group: str
    verbs: frozenset[str]
    help: str
    value: str = ""
    parse: Parse | None = None
    check: checks.Check = checks.unchecked
    default: Any = None
    default_of: Mapping[str, Any] = field(default_factory=dict[str, Any])
    varies: bool = False
    in_files: bool = True

    @property
    def flag(self) -> str:
        """The name of the option on the command line, such as "--max-steps" for `max_steps`."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def is_switch(self) -> bool:
        """Whether the option has no value on the command line: it is True if it is given, and False
        otherwise."""
        return self.parse is None and self.default is False

    @property
    def is_on_command_line(self) -> bool:
        """Whether some command of the command line has this option."""
        return bool(self.verbs & COMMANDS) and (self.parse is not None or self.is_switch)

    def default_in(self, verb: str) -> Any:
        """Return the value that the option has in a call of the function `verb` that does not set
        it."""
        return self.default_of.get(verb, self.default)


def _checked(parse: Parse, check: Callable[[Any], Any]) -> Parse:
    """Return a parser of texts that also checks the value, so that mistakes are found before any
    file is read.

    parse: turns the text into the value.
    check: returns the value in its final form, or raises an error.
    """
    return lambda text: check(parse(text))


def _of_trace(name: str) -> Any:
    """Return the default of the option `name` of the class `TraceOptions`."""
    return TraceOptions.__dataclass_fields__[name].default


OPTIONS: tuple[Option, ...] = (
    Option("level", "surface", _PLACED, "level to draw, or several with commas; pi is understood: "
           "2pi, pi/2 (the field's own: 1/2 for meshes, 2pi for curves)", "LEVEL",
           text.parse_levels, varies=True),
    Option("clip", "surface", _PLACED, "volume that cuts the surface: ball:X,Y,Z,RADIUS, or "
           "box:X,Y,Z,X,Y,Z between two corners", "VOLUME", text.parse_clip, varies=True),
    Option("section", "surface", _PLACED, "plane that opens the surface: leave out what is beyond "
           "it, on the side that the vector X,Y,Z points to, at a distance from the origin (0)",
           "X,Y,Z[,DISTANCE]", text.parse_section, varies=True),
    Option("side", "surface", DRAWN | {"mesh"}, "surface, or the closed solid where the function "
           "is below or above the level, or between two levels", "{surface,below,above,between}",
           text.parse_choice("surface", "below", "above", "between"), varies=True),
    Option("largest", "surface", DRAWN | {"trace", "mesh", "repair"},
           "only the largest connected component", default=False, varies=True),
    Option("tolerance", "trace", RAYS | DRAWN | {"mesh", "repair"}, "largest distance of hits or "
           "triangles from the surface (1e-4 of its size, 1e-3 for meshes)", "LENGTH",
           text.parse_positive, varies=True),
    Option("enclosures", "trace", RAYS | DRAWN, "proof by which steps are made (the longest of all "
           "that apply)", "NAME", text.parse_enclosures, varies=True),
    Option("max_steps", "trace", RAYS | DRAWN, "evaluations after which a ray is out of steps "
           "(2000)", "N", text.parse_count, default=_of_trace("max_steps"), varies=True),
    Option("over_relaxation", "trace", RAYS | DRAWN, "factor from 1 to 2 by which trial steps are "
           "longer than proved ones (the field's own)", "FACTOR", text.parse_positive, varies=True),
    Option("precision", "trace", RAYS | DISTANCES | CURVATURES, "arithmetic (that of the "
           "input; double for distances and curvatures)",
           "{single,double}", text.parse_choice("single", "double"), in_files=False),
    Option("backend", "trace", frozenset(("trace",)), "webgpu for any GPU of the system",
           "{webgpu}", text.parse_choice("webgpu"), in_files=False),
    Option("require_crossing", "trace", DRAWN | {"trace"}, "a ray hits only where the field passes "
           "to the other side of the level, not where it comes near and turns back",
           default=False, varies=True),
    Option("show", "image", DRAWN, "picture: path follows light paths, shaded lights first hits by "
           "a formula, without noise; or what a ray found", "{" + ",".join(checks.SHOW_MODES) + "}",
           text.parse_choice(*checks.SHOW_MODES), checks.ignoring_mode(checks.check_show),
           "path", dict.fromkeys(("animate", "view", "page"), "shaded")),
    Option("camera", "image", DRAWN, "camera, or the point where it stands",
           check=checks.ignoring_mode(checks.check_camera), varies=True),
    Option("size", "image", PICTURES, "width and height in pixels (800x600)", "WxH",
           _checked(text.parse_size, checks.check_image_size),
           checks.if_set(checks.check_image_size)),
    Option("spp", "image", PICTURES, "samples per pixel (64; 9 at edges of shaded pictures)", "N",
           _checked(text.parse_count, checks.check_spp), checks.if_set(checks.check_spp),
           varies=True),
    Option("material", "style", DRAWN, "material of the surface, by name, or a color by name or "
           "#rrggbb (two-tone)", "NAME", text.parse_material_name, varies=True),
    Option("section_material", "style", DRAWN, "material of the faces of a solid on its section "
           "(that of the rest)", "NAME", text.parse_material_name, varies=True),
    Option("boundary_radius", "style", DRAWN, "radius of a tube around the curve at which the "
           "surface ends (no tube)", "LENGTH", text.parse_positive, varies=True),
    Option("boundary_material", "style", DRAWN, "material of this tube (gold)", "NAME",
           text.parse_material_name, varies=True),
    Option("isolines", "style", DRAWN, "lines where a coordinate or a formula is a multiple of an "
           "interval, as z:0.1, x*y:1", "FORMULA:INTERVAL", text.parse_isolines_text,
           checks.check_isolines, varies=True),
    Option("thickness", "style", DRAWN | {"mesh"}, "thickness of a closed wall in place of the "
           "surface, half on each side", "LENGTH", text.parse_positive, varies=True),
    Option("backdrop", "style", DRAWN, "light, dark, transparent, a color such as white or "
           "#334455, two from bottom to top such as white,steelblue, or an image (light)",
           "BACKDROP", text.parse_backdrop_text, checks.check_backdrop, varies=True),
    Option("up", "style", DRAWN, "axis that points up (z; of files .glb, .gltf and surfaces in "
           ".obj y)", "AXIS", text.parse_axis, varies=True),
    Option("color_by", "color", PICTURES, "coordinate or formula of x, y and z whose values "
           "show=value shows", "FORMULA", text.parse_formula, checks.check_color_by, varies=True),
    Option("color_range", "color", PICTURES, "ends of the colors of values, depths or evaluations "
           "(what is seen)", "LOW:HIGH", text.parse_range, checks.check_color_range, varies=True),
    Option("color_bar", "color", PICTURES, "bar with numbers beside such a picture, or its title",
           "[TITLE]", str, checks.check_color_bar, default=False, varies=True),
    Option("antialias", "quality", PICTURES, "pixels of a shaded picture that get all samples: "
           "edges in the picture, or also what cones around pixels meet (edges)",
           "{" + ",".join(checks.ANTIALIASING) + "}", text.parse_choice(*checks.ANTIALIASING),
           checks.check_antialias, varies=True),
    Option("max_depth", "quality", PICTURES, "longest light path in edges, -1 for no limit (12)",
           "N", text.parse_integer, checks.check_max_depth, varies=True),
    Option("denoise", "quality", PICTURES, "take the noise out of a picture of light paths (needs "
           "pip install 'harnack[denoise]')", check=checks.check_denoise, default=False,
           varies=True),
    Option("seed", "quality", PICTURES | {"mesh", "repair"}, "another seed, other noise, or other "
           "small random moves of meshes (0)", "N", text.parse_integer,
           checks.as_integer("seed"), 0, varies=True),
    Option("client", "run", PICTURES | {"page"}, "workers of a Dask cluster that do the work, by "
           "its scheduler's address, such as tcp://10.0.0.1:8786 (needs pip install "
           "'harnack[cluster]')", "ADDRESS", str, in_files=False),
    Option("checkpoint", "run", PICTURES | {"page"}, "folder that keeps finished parts, and from "
           "which a stopped task goes on", "FOLDER", str, in_files=False),
    Option("chunks", "run", frozenset(("render",)), "number of parts that a picture is divided "
           "into (as suits the workers)", "N", text.parse_count, in_files=False),
    Option("progress", "run", PICTURES | DISTANCES | {"page", "mesh", "repair"}, "whether to show "
           "how far the work is", default=True,
           default_of=dict.fromkeys((*DISTANCES, "mesh", "repair"), False), in_files=False),
    Option("frames", "film", frozenset(("animate",)), "number of pictures", "N", text.parse_count,
           default=24, in_files=False),
    Option("fps", "film", frozenset(("animate",)), "pictures a second (24)", "N",
           text.parse_positive, default=24.0, in_files=False),
    Option("orbit", "film", frozenset(("animate",)), "degrees that the camera goes around the "
           "surface (360 if nothing else moves)", "DEGREES", text.parse_number, in_files=False),
    Option("title", "live", LIVE, "title of the page", "TEXT", str, default="", in_files=False),
    Option("host", "server", frozenset(("view",)), "address to serve at; any but this machine's "
           "own is open to the network, and the page's address then has a token (127.0.0.1)",
           "ADDRESS", str, default="127.0.0.1", in_files=False),
    Option("port", "server", frozenset(("view",)), "port to serve at, 0 for a free one (0)", "N",
           text.parse_port, default=0, in_files=False),
    Option("open_browser", "server", frozenset(("view",)), "whether to open a browser",
           default=True, in_files=False),
    Option("block", "server", frozenset(("view",)), "whether to return only after Ctrl-C",
           in_files=False),
    Option("height", "server", frozenset(("view",)), "height of a widget in pixels", default=480,
           in_files=False),
    Option("sources", "server", frozenset(("view",)), "where fields come from, for scene files "
           "that are saved", default=(), in_files=False),
    Option("cell_size", "mesh", frozenset(("mesh", "repair")), "size of cells before anything is "
           "refined", "LENGTH", text.parse_positive, in_files=False),
    Option("simplify", "mesh", frozenset(("mesh",)), "fewer triangles of closed meshes, as exact",
           default=False, in_files=False),
    Option("max_triangles", "mesh", frozenset(("mesh",)), "triangles beyond which a mesh is given "
           "up, before anything is simplified (2,000,000)", "N", text.parse_count, in_files=False),
    Option("keep", "repair", frozenset(("repair",)), "all: fail if the triangles cannot all be "
           "kept; valid: keep those that are valid; none: make all anew (the first that can be "
           "done)", "{all,valid,none}", text.parse_choice("all", "valid", "none"), in_files=False),
    Option("filling", "repair", frozenset(("repair",)), "smooth: continue the surface around "
           "holes; harmonic: where the winding number is 1/2 (smooth, and harmonic where those do "
           "not fit)", "{smooth,harmonic}", text.parse_choice("smooth", "harmonic"),
           default="smooth", in_files=False),
)  # fmt: skip
"""All options, in the order of their groups."""

BY_NAME: Mapping[str, Option] = {option.name: option for option in OPTIONS}

NAMES_ELSEWHERE: Mapping[str, str] = {
    "color": "material", "colour": "material", "bsdf": "material", "samples": "spp",
    "resolution": "size", "width": "size", "height": "size", "bound": "enclosures",
    "domain": "clip", "solid": "side",
}  # fmt: skip
"""Names in other programs and of arguments of fields, and the option that does the same here."""
# Further names in other programs, and in place of an option the text with which messages describe
# what does the same here.
_ARGUMENTS_ELSEWHERE = {
    **dict.fromkeys(("filename", "output", "file"), '"path", the second argument'),
    **dict.fromkeys(
        ("azimuth", "elevation", "fov", "zoom", "position", "target", "distance"),
        "camera=harnack.Camera(...), which has it",
    ),
}  # fmt: skip


class RenderKeywords(TraceKeywords, total=False):
    """The keywords of `render` with their types, for type checkers. They are all options of
    pictures."""

    show: ShowMode | str
    camera: Camera | tuple[float, float, float] | None
    size: tuple[int, int] | None
    spp: int | None
    material: Any
    section_material: MaterialLike | None
    boundary_radius: float | None
    boundary_material: MaterialLike | None
    isolines: Isolines | Any
    thickness: float | None
    backdrop: Any
    up: str | tuple[float, float, float] | None
    color_by: Any
    color_range: tuple[float, float] | None
    color_bar: bool | str
    antialias: str | None
    max_depth: int | None
    denoise: bool
    seed: int
    client: Any
    checkpoint: str | os.PathLike[str] | None
    chunks: int | None
    progress: bool | ProgressFunction


ShowMode = Literal["path", "shaded", "normal", "evaluations", "status", "depth", "value"]


def options_of(verb: str) -> tuple[Option, ...]:
    """Return the options (rows of `OPTIONS`) that a function of the library takes. verb: the name
    of the function, such as "render"."""
    return tuple(option for option in OPTIONS if verb in option.verbs)


def names_of(verb: str, *groups: str) -> tuple[str, ...]:
    """Return the names of the options that a function of the library takes.

    verb: the name of the function, such as "render".
    groups: only options of these groups are returned (`Option.group`).
    """
    return tuple(option.name for option in options_of(verb) if option.group in groups)


def complete_options(verb: str, keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Return all options of a call of a function, by name: those that the caller set, and the
    defaults of the others. Options of `Surface` and `TraceOptions` that are not set are left out,
    because those classes have the defaults.

    verb: the name of the function, such as "render".
    keywords: the options that the caller set, by name.

    Raises:
        TypeError: there is no such option, or it is an option of other functions only.
    """
    refuse_unknown(verb, keywords)
    unset = {
        option.name: option.default_in(verb)
        for option in options_of(verb)
        if option.name not in SHORTHAND
    }
    return {**unset, **keywords}


def refuse_unknown(verb: str, keywords: Mapping[str, Any]) -> None:
    """Raise TypeError for keywords that are no options of the function `verb` of the library, such
    as "render". Of an option of other functions, the message names these (`refuse_others`). Of
    other names it suggests what has this name in other programs, an option or another argument, or
    else an option with a similar name. If there is none, it lists the options of the function."""
    refuse_others(verb, keywords)
    for name in keywords:
        if name not in BY_NAME:
            names = [option.name for option in options_of(verb)]
            option = NAMES_ELSEWHERE.get(name.lower())
            suggestion = f'"{option}"' if option else _ARGUMENTS_ELSEWHERE.get(name.lower())
            hint = f"; did you mean {suggestion}?" if suggestion else did_you_mean(name, names)
            raise TypeError(
                f"{verb} has no option {name!r}{hint or '; it has ' + ', '.join(names)}"
            )


def refuse_others(verb: str, keywords: Mapping[str, Any]) -> None:
    """Raise TypeError for keywords that are options of other functions, but not of this one. The
    message names the other functions. Keywords that are no options at all are not refused here.

    verb: the name of the function, such as "render".
    """
    others = [BY_NAME[name] for name in keywords if name in BY_NAME]
    refused = [
        f"no {option.name}: that is an option of {', '.join(sorted(option.verbs))}"
        for option in others
        if verb not in option.verbs
    ]
    if refused:
        raise TypeError(f"{verb} has {'; '.join(refused)}")


def shows_options(verb: str) -> Callable[[_Function], _Function]:
    """Return a decorator for a function that takes its options as `**keywords`. Documentation and
    editors then show the options in the function's signature, by name and with their defaults.

    verb: the name of the function, such as "render".

    `view` and `page` still show `**keywords` as well, as they take further keywords.
    """
    shorthand, annotations = shorthand_parameters(), RenderKeywords.__annotations__
    kind = inspect.Parameter.KEYWORD_ONLY
    parameters = [
        # Options of `Surface` and `TraceOptions` have their parameters, with types, from those
        # classes.
        shorthand[option.name]
        if option.name in shorthand
        else inspect.Parameter(
            option.name,
            kind,
            default=option.default_in(verb),
            # Annotations of a TypedDict are forward references, which hold the type as a text.
            annotation=getattr(annotations.get(option.name), "__forward_arg__", "Any"),
        )
        for option in options_of(verb)
    ]
    return shows_parameters(parameters, keeps_others=verb in LIVE)


STUDIO_OPTIONS = ("camera", *names_of("render", "style"))
"""The options of pictures that a Mitsuba scene, which has all of its own, does not take."""
SHORTHAND = frozenset((*SURFACE_OPTIONS, *TRACE_OPTIONS))
"""The names of the options of `Surface` and `TraceOptions`."""


def shorthand_among(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the given options that belong to `Surface` and `TraceOptions`, by name."""
    return {name: value for name, value in options.items() if name in SHORTHAND}


@dataclass(frozen=True)
class RenderOptions:
    """The checked options of one picture, as `render` describes them. Sizes and counts are
    integers, and an option that is not set is None. The options of surfaces and traces are not
    among them, nor the options that say where the work is done."""

    show: str
    size: tuple[int, int] | None
    spp: int | None
    antialias: str | None
    material: Any
    camera: Camera
    backdrop: Backdrop
    up: Any
    boundary_radius: float | None
    boundary_material: Any
    section_material: Any
    isolines: tuple[Isolines, ...]
    thickness: float | None
    color_by: Field | None
    color_range: tuple[float, float] | None
    color_bar: bool | str
    max_depth: int | None
    seed: int
    denoise: bool

    def __post_init__(self) -> None:
        if self.antialias == "cones" and self.spp == 1:
            raise ValueError(
                'antialias="cones" looks for pixels for more than one sample, and spp is 1: give '
                "spp=9, or leave antialias out"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> RenderOptions:
        """Check the values of options, given by name, and return them as `RenderOptions`.

        Raises:
            TypeError, ValueError: a value is wrong; the message names the option and says what it
                should be.
        """
        show: str = options["show"]
        names = [column.name for column in fields(cls)]
        return cls(**{name: BY_NAME[name].check(options[name], show) for name in names})
