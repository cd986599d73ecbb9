"""What users read when something they asked for is not there."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cli import main
from harnack.cli.arguments import parse, parsers
from harnack.cli.messages import error_line, level_text, printable, python_to_cli_terms
from harnack.field_from_file import field_from_file
from harnack.files import FileFormatError
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import icosphere
from harnack.name_suggestions import did_you_mean, with_article
from harnack.rendering import MATERIALS, UnboundedSurfaceError, mitsuba_shape
from harnack.rendering.option_table import OPTIONS

POLYGON = hk.SolidAngle(example_curves.wavy_polygon(12))
KNOT, RAY = example_curves.torus_knot(2, 3, 12), ([[0, 0, 3]], [[0, 0, -1]])
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0.3\nv 0 1 0\nf 1 2 3 4\n"
SMALL = ["--size", "8x8", "--show", "normal", "--quiet"]


def draw(**settings: Any) -> Any:
    return hk.render(POLYGON, **{"size": (8, 8), "spp": 1, "progress": False, **settings})


# --- in Python -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"camera": (3, 3)}, r"the \(x, y, z\) where it stands, not a tuple \(3, 3\)"),
        ({"camera": "top"}, r"camera must be a harnack.Camera.*Camera\(azimuth=-50"),
        ({"background": "dark"}, r"no option 'background'; did you mean \"backdrop\"\?$"),
        ({"levle": 3.0}, r"no option 'levle'; did you mean \"level\"\?$"),
        ({"quality": "high"}, r"no option 'quality'; it has level, .* material, .*, progress$"),
        ({"frames": 3}, r"render has no frames: that is an option of animate"),
        ({"clip": (0, 0, 0)}, r"clip must be a volume: a harnack.Ball"),
        ({"level": "2pi"}, r"level must be a number, .* not '2pi'"),
        ({"level": [1.0, "a"]}, r"level must be a number, .* not 'a'"),
        ({"solid": (0, 1)}, r"no option 'solid'; did you mean \"side\"\?$"),
        ({"tolerance": "x"}, r"tolerance must be a length or HitTolerance, not 'x'"),
        ({"material": 5}, r"material must be a name, .* not 5; there are two-tone"),
        ({"material": [0.5]}, r"material must be a name, a color, .* not 0.5; there are two"),
        ({"colour": "red"}, r"no option 'colour'; did you mean \"material\"\?$"),
        (
            {"filename": "a.png"},
            r"no option 'filename'; did you mean \"path\", the second argument\?$",
        ),
        ({"size": 5}, r"size must be \(width, height\) in pixels, .* not 5"),
        ({"size": (3.5, 2)}, r"size must be .* not \(3.5, 2\)"),
        ({"size": "800x600"}, r"size must be .* not '800x600'"),
        ({"spp": 2.5}, "spp must be an integer, not 2.5"),
        ({"seed": None}, "seed must be an integer, not None"),
        ({"max_depth": "x"}, "max_depth must be an integer, not 'x'"),
        ({"path": 3}, "path must name a picture"),
    ],
)
def test_a_wrong_kind_of_argument_is_named(settings: dict[str, Any], complaint: str) -> None:
    with pytest.raises(TypeError, match=complaint):
        draw(**settings)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"max_depth": 3, "show": "shaded"}, 'max_depth needs a picture with show="path"'),
        ({"material": "goldd"}, r"unknown material 'goldd'; .*; did you mean \"gold\"\?$"),
        ({"material": "tomatoe"}, r"unknown material 'tomatoe'; .*; did you mean \"tomato\"\?$"),
        ({"material": (0.5, 0.5, 2.0)}, r"unknown material \(0.5, 0.5, 2.0\); .* from 0 to 1$"),
        ({"up": "Y"}, r"up must be one of .* not 'Y'; did you mean \"y\"\?$"),
        ({"show": "normals"}, r"show must be one of .*; did you mean \"normal\"\?$"),
        ({"backdrop": "drak"}, r"backdrop must be one of .*; did you mean \"dark\"\?$"),
        ({"tolerance": -1}, r"tolerance must be finite and > 0, not -1\.0"),
        ({"tolerance": 0}, r"tolerance must be finite and > 0, not 0\.0"),
        ({"enclosures": "paper"}, r'did you mean "classic"'),
        ({"enclosures": "Slop"}, r"unknown enclosures 'Slop'.*; did you mean \"slope\"\?$"),
        ({"side": "abov"}, r"side must be one of .*; did you mean \"above\"\?$"),
        ({"side": "between"}, r"between two levels, level=\(low, high\), and 1 are given"),
        ({"size": (10**6, 10**6)}, "each side must be 1 to 32768"),
        ({"spp": 10**12}, "spp must be at least 1 and at most 1000000"),
        ({"max_depth": 10**12}, "max_depth must be at most 2147483647"),
        ({"material": ["gold", "clay"]}, "give one material, not 2"),
        ({"path": ""}, "name of the picture to write is empty"),
    ],
)
def test_a_wrong_value_is_named(settings: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        draw(**settings)


def test_a_picture_larger_than_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harnack.rendering.render_options._memory", lambda: 1e9)
    with pytest.raises(ValueError, match=r"needs about 75 GB of memory, .* has 1: choose a sm"):
        draw(size=(16384, 16384), show="shaded")


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: hk.trace(KNOT, *RAY), r"field is needed.*curve, take harnack.SolidAngle"),  # pyright: ignore
        (lambda: hk.trace(hk.Gyroid, *RAY), r"the class Gyroid itself.* Gyroid\(...\)"),  # pyright: ignore
        (lambda: hk.signed_distance(icosphere(1), [[0, 0, 1]]), "needed, .* not of type"),  # pyright: ignore
        (lambda: hk.mesh(abs), "a function: of a formula, take harnack.expression"),  # pyright: ignore
        (lambda: hk.render("x^2 + y^2 = 1"), "no such file; of a formula, take"),
        (lambda: hk.Surface(hk.Surface(POLYGON)), "Surface: take its .field"),  # pyright: ignore
        (lambda: hk.render([[POLYGON]]), "give one at a time, or to harnack.render one flat list"),
        (lambda: hk.render([KNOT]), "surfaces, not what is of type ndarray: of points"),
        (lambda: hk.trace(hk.Gyroid(1.0, domain="ball"), *RAY), "domain must be a volume"),  # pyright: ignore
        (lambda: hk.Ball(radius="2"), "radius of a ball must be a number, not '2'"),  # pyright: ignore
        (lambda: example_curves.torus_knot("2", 3, 60), "p of a torus knot must be a whole number"),  # pyright: ignore
        (lambda: hk.Isolines("z", levels="0.1"), "levels of isolines must be numbers"),
        (lambda: hk.mesh(POLYGON, thickness="0.1"), "thickness must be a number"),  # pyright: ignore
        (lambda: hk.expression(lambda x, y, z: x == y), "write left - right"),
        (lambda: mitsuba_shape(POLYGON, material="gold"), "takes bsdf=..., not material="),
        (lambda: mitsuba_shape(POLYGON, bsdf="gold"), r"MATERIALS\['gold'\].front, not str"),
        (lambda: hk.SphericalHarmonic(2.5, 1), r"two whole numbers, .* not \(2.5, 1\)"),  # pyright: ignore[reportArgumentType]
        (lambda: hk.HarmonicPolynomial("x"), r"such as \{\(2, 1, 0\): 1, .* not by 'x'"),  # pyright: ignore[reportArgumentType]
        (lambda: hk.Gyroid("a"), "edge length of the cell must be a number, not 'a'"),  # pyright: ignore[reportArgumentType]
        (lambda: hk.expression(lambda x, y: x), r"must take three .* takes \(x, y\)"),  # pyright: ignore
    ],
)
def test_fields_of_wrong_things_say_what_they_want(
    make: Callable[[], object], complaint: str
) -> None:
    with pytest.raises((TypeError, FileFormatError), match=complaint):
        make()


def test_what_cannot_be_seen_or_drawn_is_said(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="clip and section do not overlap"):
        draw(clip=hk.Ball((5, 5, 5), 1.0))
    with pytest.raises(ValueError, match="at s = 0 of the film, the surface of level 0 reaches"):
        hk.animate(POLYGON, tmp_path / "a.gif", level=lambda s: s, frames=3, size=(16, 12))
    with pytest.raises(ValueError, match=r"about the origin, write Ball\(radius=2\)"):
        hk.Ball(2)  # pyright: ignore
    ball = hk.Gyroid(1.0, domain=hk.Ball())
    with pytest.raises(UnboundedSurfaceError, match="does not end at that field's domain"):
        hk.render(hk.solid(ball, below=0), size=(8, 8))
    with pytest.raises(ValueError, match=r"its Laplacian is 4, not 0"):
        hk.HarmonicPolynomial({(2, 0, 0): 1, (0, 2, 0): 1})
    with pytest.raises(ValueError, match=r"rotated\(degrees, axis\), such as rotated\(30"):
        hk.Sphere(1.0).rotated("x", 30)  # pyright: ignore
    assert not list(tmp_path.iterdir())


def test_methods_and_certificates_that_there_are_not() -> None:
    with pytest.raises(ValueError, match=r'unknown method .*; did you mean "closest_point"\?'):
        hk.signed_distance(POLYGON, [[0, 0, 3]], method="closest_pont")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r'unknown lift_bound .*; did you mean "convex"\?'):
        hk.SolidAngle(example_curves.wavy_polygon(12), lift_bound="convx")  # pyright: ignore[reportArgumentType]


def test_messages_of_the_library_name_arguments_of_python(tmp_path: Path) -> None:
    mesh, cloud = tmp_path / "a.obj", tmp_path / "a.xyz"
    mesh.write_text(SQUARE)
    cloud.write_text("0 0 0\n1 0 0\n0 1 0\n0 0 1\n")
    for path, settings, complaint in (
        (mesh, {"normals": "estimate"}, 'leave out normals="estimate", or .* read_as="dipole"'),
        (
            mesh,
            {"take_boundary": True, "read_as": "dipole"},
            'take_boundary=True .* contradicts read_as="dipole"',
        ),
        (cloud, {}, 'let them be estimated with normals="estimate"'),
        (mesh, {"read_as": "dipoles"}, r'read_as must be .*; did you mean "dipole"\?'),
        (mesh, {"up": "w"}, "up must be one of x, y, z"),
        (mesh, {"normals": "guess"}, 'normals must be "estimate" or None'),
    ):
        with pytest.raises(ValueError, match=complaint) as caught:
            field_from_file(path, **settings)
        assert "--" not in str(caught.value)


@pytest.mark.parametrize("level", [0.0, 4 * math.pi, -8 * math.pi, 1e-300])
def test_a_level_without_bounds_names_one_that_has_them(level: float) -> None:
    with pytest.raises(UnboundedSurfaceError, match=r"such as a ball, or choose .* 6.28319") as e:
        draw(level=level)
    assert "multiples of its period" in str(e.value)
    assert e.value.bounded_level == 2 * math.pi
    assert draw(level=level, clip=hk.Ball((0, 0, 0), 1), show="normal").shape == (8, 8, 3)


@pytest.mark.parametrize("scale", [1e-99, 1e-25, 1e20, 1e25, 1e39, 9e99])
def test_what_single_precision_cannot_draw_is_refused_and_not_drawn_empty(scale: float) -> None:
    x = np.random.default_rng(0).normal(size=(60, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    for field in (
        hk.DipolePotential(x * scale, x),
        hk.SolidAngle(example_curves.wavy_polygon(12) * scale),
    ):
        with pytest.raises(ValueError, match="choose units nearer to 1"):
            hk.render(field, show="normal", size=(8, 8))


# --- on the command line ---------------------------------------------------------------------


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    try:
        code = main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "complaint"),
    [
        (["render", "trefoyl"], 1, r"'trefoyl' is no scene: .*; did you mean \"trefoil\"\?"),
        (["gallery", "Trefoyl"], 1, r"no scene is named .*; did you mean \"trefoil\"\?"),
        (["render", "polygon", "--material", "goldd"], 2, r"--material: unknown .* \"gold\"\?"),
        (["render", "polygon", "--show", "normals"], 2, r"--show: 'normals' .* \"normal\"\?"),
        (["render", "a.obj", "--read-as", "dipol"], 2,
         r"--read-as: 'dipol' is none of .* \"dipole\"\?"),
        (["render", "polygon", "--elevaton", "3"], 2, r"no option '--elevaton'; .*--elevation"),
        (["render", "gyroid", "--domain", "ball:0,0,0,1"], 2,
         r"no option '--domain'; did you mean \"--clip\"\?"),
        (["render", "gyroid", "--samples=4"], 2, r"no option '--samples'; did you mean \"--spp\""),
        (["render", "gyroid", "sphere"], 2,
         r"no use for 'sphere': one scene, .* at a time, .*`harnack gallery A B` draws several"),
        (["render", "x^2", "+", "y^2=1"], 2, r"no use for '\+': .* a formula in quotes"),
        (["check", "a.stl", "b.stl", "--json"], 2, r"no use for 'b.stl' \(see"),
        (["render", "x=R", "--parameter", "R=1,r=0.4"], 2,
         r"--parameter: 'R=1,r=0.4': write --parameter once for each name"),
        (["render", "x=R", "--parameter", "R=one"], 2, "'one' is no number; write 0.5, 2pi"),
        (["render", "gyroid", "--color-range", "a:1"], 2, "'a' is no number"),
        (["page", "x=R", "--slider", "R=1:2,r=0:1"], 2,
         r"--slider: 'R=1:2,r=0:1': write --slider once for each name"),
        (["page", "x=R", "--slider", "R=a:1"], 2, "'a' is no number"),
        (["render", "polygon", "--level", "4pi"], 1,
         r"level 12.5664 reaches to infinity.*; choose another --level, such as 2pi$"),
        (["render", "polygon", "--level", "1e999"], 2, "'1e999' is no level"),
        (["render", "polygon", "--azimuth", "abc"], 2, "'abc' must be a finite number"),
        (["render", "polygon", "--size", "0x0"], 2, "each side must be 1 to 32768"),
        (["render", "polygon", "--size", "100000x100000"], 2, "each side must be 1 to 32768"),
        (["render", "polygon", "--size", "1" * 5000 + "x1"], 2, r"111\.\.\.' is no size"),
        (["render", "polygon", "--spp", "0"], 2, "'0' must be a whole number from 1"),
        (["render", "polygon", "--spp", "-1"], 2, "'-1' must be a whole number from 1"),
        (["render", "polygon", "--spp", "²"], 2, "'²' must be a whole number from 1"),
        (["render", "polygon", "--spp", "1000001"], 2, "spp must be .* at most 1000000"),
        (["render", "polygon", "--max-depth", "x"], 2, "'x' must be an integer"),
        (["render", "polygon", "--seed", "9" * 5000], 2, "integer of at most 18 digits"),
        (["render", "polygon", "-o", ""], 1, "-o is empty"),
        (["render", "polygon", "-o", "folder.png"], 1, "it is a directory, name a file in it"),
        (["render", "polygon", "-o", "pipe.png"], 1, "it is a device or a pipe"),
        (["render", "polygon", "-o", "/proc/a.png"], 1, "cannot write /proc/a.png: "),
        (["render", "polygon", "-o", "y" * 300 + ".png"], 1, "its name is too long"),
        (["render", "polygon", "-o", "a\0.png"], 1, r"'a\\x00.png' is no name of a file"),
        (["gallery", "polygon", "-o", "file"], 1, "folder file: a file of that name is there"),
        (["gallery", "polygon", "-o", "/proc/x"], 1, "cannot make the folder /proc/x: "),
        (["render", "[/x]y.obj"], 1, r"^error: \[/x\]y.obj: there is no such file$"),
        (["render", "[red]y.obj"], 1, r"^error: \[red\]y.obj: there is no such file$"),
        (["render", "\x1b[31m.obj"], 1, r"^error: \\x1b\[31m.obj: there is no such file$"),
        (["render", "a\nb.obj"], 1, r"^error: a\\nb.obj: there is no such file$"),
        (["render", "a\0.obj", "-o", "a.png"], 1, r"^error: a\\x00.obj: "),
        (["render", "circle.obj"], 1, "a link that leads to no file"),
        (["render", "."], 1, r"^error: '.' is no scene"),
        (["render", "x^2 + yy = 1"], 1, r"'yy' is unknown"),
        (["render", "x*y*z = 0.1"], 1, r"infinity.*; cut it, such as by --clip ball:0,0,0,2$"),
        (["render", "x = a"], 1, r"of a number of your own, give --parameter a=1; write"),
        (["render", "polygon", "--boundary-material", "gold"], 1,
         "^error: --boundary-material needs .* such as --boundary-radius 0.03$"),
        (["render", "polygon", "--color-range", "0:1"], 1,
         "^error: --color-range needs a picture with --show evaluations .*, not \"normal\"$"),
        (["render", "gyroid", "--clip", "ball:1"], 2, "--clip: '1' must be 4 numbers"),
        (["render", "gyroid", "--clip", "cone:1"], 2, "--clip: .*; write ball:X,Y,Z,RADIUS"),
        (["render", "gyroid", "--side", "between", "--level", "0.3,0.1"], 1,
         "--side between needs --level low,high, low < high"),
        (["mesh", "2x = 1"], 1, r"a \* missing at '2x'"),
        (["render", ""], 1, r"^error: '' is no scene"),
    ],
)  # fmt: skip
def test_every_complaint_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    complaint: str,
) -> None:
    import os

    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").write_text("old")
    (tmp_path / "circle.obj").symlink_to("circle.obj")
    os.mkfifo(tmp_path / "pipe.png")
    before = sorted(tmp_path.iterdir())
    if arguments[0] == "render" and "--show" not in arguments:
        arguments = [*arguments[:2], "--show", "normal", *arguments[2:]]
    exit_code, said = run(capsys, *arguments, "--quiet")
    assert re.search(complaint, said.rstrip("\n")), said
    assert (exit_code, said.count("\n")) == (code, 1)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["a b.obj", "\xfc.obj", "[red].obj", "[bold] b.obj", "-a.obj"])
def test_files_of_any_name_are_drawn(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(SQUARE)
    code = main(["render", *SMALL, f"-o{name}.png", "--", name])
    said = capsys.readouterr().out
    assert code == 0
    assert said.startswith(f"{name}: 2 triangles")
    assert said.endswith(f"wrote {name}.png\n")


@pytest.mark.slow
def test_the_longest_name_that_the_disk_allows_is_written(tmp_path: Path) -> None:
    target = tmp_path / ("y" * 251 + ".png")
    assert main(["render", "polygon", *SMALL, "-o", str(target)]) == 0
    assert [path.name for path in tmp_path.iterdir()] == [target.name]


# --- their parts -----------------------------------------------------------------------------


def test_names_that_begin_alike_are_preferred() -> None:
    assert did_you_mean("background", ["back", "backdrop"]) == '; did you mean "backdrop"?'
    assert did_you_mean("GOLD", MATERIALS) == '; did you mean "gold"?'
    assert did_you_mean("zzz", MATERIALS) == ""
    assert did_you_mean(3, MATERIALS) == ""
    assert did_you_mean("gold", []) == ""


def test_beginnings_of_words_and_last_parts_are_similar() -> None:
    assert did_you_mean("tol", ["total", "tolerance"]) == '; did you mean "total"?'
    assert did_you_mean("tol", ["max_steps", "tolerance"]) == '; did you mean "tolerance"?'
    assert did_you_mean("level", ["domain", "default_level"]) == '; did you mean "default_level"?'
    assert did_you_mean("le", ["domain", "default_level"]) == ""
    names = ["parts.0", "parts.0.parts", "parts.0.field.radius", "parts.1.field.radius"]
    assert did_you_mean("parts.1.radius", names) == '; did you mean "parts.1.field.radius"?'


def test_names_have_their_article() -> None:
    names = "Sphere", "Expression", "Union", "HRBF", "AffineMap"
    with pytest.raises(TypeError, match="an Expression is a function of space"):
        _ = hk.expression("x") < 1
    assert [*map(with_article, names)] == [
        "a Sphere", "an Expression", "a Union", "an HRBF", "an AffineMap",
    ]  # fmt: skip


def test_lines_are_printable() -> None:
    assert printable("a\x1b[31m\r\u202eb") == r"a\x1b[31m\r\u202eb"
    assert error_line(RuntimeError("two\n  lines")) == "error: two lines"
    assert "choose a smaller --size" in error_line(MemoryError("of 11 TiB"))
    assert (
        error_line(ValueError('give read_as="loops", not cell_size'))
        == "error: give --read-as loops, not --cell-size"
    )


def texts_of_the_library() -> list[str]:
    """All texts of more than a word but for documentation, in which messages are; X stands for what
    is put in."""
    texts: list[str] = []
    for path in Path(hk.__file__).parent.rglob("*.py"):
        nodes = [*ast.walk(ast.parse(path.read_text()))]
        apart = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        formatted = [node for node in nodes if isinstance(node, ast.JoinedStr)]
        apart |= {id(part) for node in formatted for part in node.values}
        texts += [
            "".join(
                str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values
            )
            for node in formatted
        ]
        texts += [
            node.value
            for node in nodes
            if isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in apart
        ]
    return [text for text in texts if " " in text and not re.search('<|="X"', text)]  # HTML


# Of objects of Python and of values of a wrong type, to which no text of the command line leads.
ONLY_IN_PYTHON = re.compile(
    r"(camera|isolines|options) must be |backend=|camera=harnack|the center of a ball must"
    r"|a height field |X is a function of|.*in Python precision="
)
CONSTRUCTOR = re.compile(
    r"\b(Ball|Box|HalfSpace|Camera|Slider|Isolines|Surface|TraceOptions|VolumeIntersection)\("
)
KEYWORD = re.compile(rf"(?<![\w.])({'|'.join(option.name for option in OPTIONS)}|read_as|normals)=")


@pytest.mark.slow
def test_messages_on_the_command_line_name_its_options_and_nothing_of_python() -> None:
    _, commands = parsers()
    actions = [action for command in commands.values() for action in command._actions]
    flags = {flag for action in actions for flag in action.option_strings}
    on_command_line = {option.flag for option in OPTIONS if option.is_on_command_line}
    assert on_command_line <= flags
    assert not {option.flag for option in OPTIONS} - on_command_line & flags
    messages = [text for text in texts_of_the_library() if not ONLY_IN_PYTHON.match(text)]
    assert len(messages) > 1000
    for message in messages:
        said = python_to_cli_terms(message)
        named = [flag.rstrip("-") for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]*", said)]
        assert set(named) <= flags, said
        assert not CONSTRUCTOR.search(said), said
        outside_of_calls = re.sub(r"[\w.]+\((?:[^()]|\([^()]*\))*\)", "a call", said)
        assert not KEYWORD.search(outside_of_calls), said


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ('show="value" needs color_by="z"', "--show value needs --color-by z"),
        ("give level=(low, high), or a larger `clip`", "give --level low,high, or a larger --clip"),
        ("too long: raise max_steps.", "too long: raise --max-steps."),
        ("largest=... and simplify=True", "--largest and --simplify"),
        ("level: give at least one", "--level: give at least one"),
        ("(take_boundary=True)", "(--take-boundary)"),
        ("cut it (hk.mesh(f, level=(0, 1)))", "cut it (hk.mesh(f, level=(0, 1)))"),
        ('in Python precision="double"', 'in Python precision="double"'),
        ("cell_size/read_as.obj: surface.level=3", "cell_size/read_as.obj: surface.level=3"),
    ],
)
def test_keywords_become_options(message: str, said: str) -> None:
    assert python_to_cli_terms(message) == said


def test_warnings_are_notes_without_places_in_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(300, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    cloud = tmp_path / "rough.xyz"
    np.savetxt(cloud, np.column_stack([x + rng.normal(0, 0.03, x.shape), x]))
    command = ["mesh", str(cloud), "--cell-size", "0.2", "-o", str(tmp_path / "a.stl"), "--quiet"]
    assert main([*command, "--tolerance", "1e-4"]) == 0
    notes = capsys.readouterr().err.splitlines()
    assert len(notes) == 1
    assert re.match(r"note: [\d,]+ of [\d,]+ vertices and centers .* than the tolerance", notes[0])


@pytest.mark.parametrize(
    ("level", "text"),
    [(2 * math.pi, "2pi"), (math.pi, "pi"), (-math.pi / 2, "-0.5pi"), (0.5, "0.5"), (0.0, "0")],
)
def test_levels_are_written_as_they_are_typed(level: float, text: str) -> None:
    assert level_text(level) == text


def test_points_too_large_for_single_precision_say_so() -> None:
    """They overflowed with a warning of NumPy, and their values were not numbers."""
    field = hk.WindingNumber(*icosphere(1))
    with pytest.raises(ValueError, match="too large for single precision"):
        field.value([[1e39, 0.0, 0.0]])


@pytest.mark.parametrize("method", ["exakt", "trees"])
def test_a_mistyped_method_has_a_did_you_mean(method: str) -> None:
    with pytest.raises(ValueError, match="did you mean"):
        hk.WindingNumber(*icosphere(1), method=method)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["boundary-radius", "boundary_radius"])
def test_a_slider_of_an_option_may_have_its_name_on_the_command_line(name: str) -> None:
    """A hyphen was refused, though options are written with it."""
    arguments = parse(["page", "x", "--slider", f"{name}=0.01:0.1"])
    assert arguments.slider == [("boundary_radius", hk.Slider(0.01, 0.1))]
