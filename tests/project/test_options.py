"""Every verb and every option: honored, or refused by name, in Python, on the command line and in
scene files, as the table of options says."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cli.arguments import parse, parsers
from harnack.geometry.example_meshes import bumpy_sphere
from harnack.rendering.option_table import (
    BY_NAME,
    OPTIONS,
    VERBS,
    Option,
    RenderKeywords,
    names_of,
    options_of,
)

SPHERE = hk.Sphere(1.0)
RAY = [[3.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0]]
POINTS = [[2.0, 0.0, 0.0]]


class Wrong:
    """A value that no option can have."""

    def __repr__(self) -> str:
        return "Wrong()"


def damaged_mesh() -> Any:
    trimesh = pytest.importorskip("trimesh")
    vertices, faces = bumpy_sphere(1)
    return trimesh.Trimesh(vertices, faces[1:], process=False)


def quick(**options: Any) -> dict[str, Any]:
    """Options of a small picture, unless they are given."""
    return {"size": (8, 6), "show": "shaded", "progress": False, **options}


CALLS: dict[str, Callable[..., Any]] = {
    "trace": lambda path, **k: hk.trace(k.pop("surface", SPHERE), *RAY, **k),
    "crossings": lambda path, **k: hk.crossings(
        k.pop("surface", SPHERE), *RAY, max_crossings=2, **k
    ),
    "render": lambda path, **k: hk.render(k.pop("surface", SPHERE), **quick(**k)),
    "animate": lambda path, **k: hk.animate(
        k.pop("surface", SPHERE), path / "a.gif", **{"frames": 1, **quick(**k)}
    ),
    "view": lambda path, **k: hk.view(
        k.pop("surface", SPHERE), **{"block": False, "open_browser": False, **k}
    ),
    "page": lambda path, **k: hk.page(
        k.pop("surface", SPHERE), path / "a.html", **{"progress": False, **k}
    ),
    "mesh": lambda path, **k: hk.mesh(k.pop("surface", SPHERE), **k),
    "repair": lambda path, **k: hk.repair(damaged_mesh(), **k),
    "signed_distance": lambda path, **k: hk.signed_distance(k.pop("surface", SPHERE), POINTS, **k),
    "closest_points": lambda path, **k: hk.distance.closest_points(
        k.pop("surface", SPHERE), POINTS, **k
    ),
    "distance_bounds": lambda path, **k: hk.distance.distance_bounds(
        k.pop("surface", SPHERE), POINTS, **k
    ),
    "curvature": lambda path, **k: hk.curvature(k.pop("surface", SPHERE), POINTS, **k),
    "curvature_lines": lambda path, **k: hk.distance.curvature_lines(
        k.pop("surface", SPHERE), POINTS, step=0.1, length=0.2, **k
    ),
}
OF_SURFACE = {
    "level": 0.1, "clip": hk.Ball((0, 0, 0), 2.0), "section": hk.HalfSpace((0, 0, 1), 0.5),
    "side": "surface", "largest": True,
}  # fmt: skip
OF_TRACE = {
    "tolerance": 1e-3, "enclosures": "slope", "max_steps": 100, "over_relaxation": 1.2,
    "precision": "single", "backend": "webgpu", "require_crossing": True,
}  # fmt: skip


def function_of(verb: str) -> Callable[..., Any]:
    return getattr(hk, verb, None) or getattr(hk.distance, verb)


def test_the_table_knows_every_verb() -> None:
    assert set(CALLS) == VERBS
    assert len(BY_NAME) == len(OPTIONS)
    assert set(RenderKeywords.__annotations__) >= set(names_of("render", *GROUPS))


GROUPS = ("image", "style", "color", "quality", "run")


@pytest.mark.parametrize("verb", CALLS)
def test_signatures_show_the_options_of_the_table(verb: str) -> None:
    shown = set(inspect.signature(function_of(verb)).parameters)
    assert shown & set(BY_NAME) == {option.name for option in options_of(verb)}


@pytest.mark.parametrize("verb", CALLS)
def test_each_option_is_honored_or_refused_by_name(verb: str, tmp_path: Path) -> None:
    for option in OPTIONS:
        with pytest.raises((TypeError, ValueError)) as error:
            CALLS[verb](tmp_path, **{option.name: Wrong()})
        message = str(error.value)
        assert option.name in message or option.name.replace("_", " ") in message
        refusals = ("{verb} has no {name}", "{verb} has no argument '{name}'",
                    "unexpected keyword argument '{name}'")  # fmt: skip
        is_refused = any(text.format(verb=verb, name=option.name) in message for text in refusals)
        assert is_refused == (verb not in option.verbs), message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("verb", [verb for verb in CALLS if verb != "repair"])
def test_keywords_raise_beside_the_object_that_holds_them(verb: str, tmp_path: Path) -> None:
    surface, options = hk.Surface(SPHERE), hk.TraceOptions()
    for name in names_of(verb, "surface"):
        with pytest.raises(TypeError, match=rf"{name}.*Surface holds its own"):
            CALLS[verb](tmp_path, surface=surface, **{name: OF_SURFACE[name]})
    for name in names_of(verb, "trace"):
        with pytest.raises(TypeError, match=rf"{name}.*options already"):
            CALLS[verb](tmp_path, options=options, **{name: OF_TRACE[name]})


@pytest.mark.parametrize("verb", CALLS)
def test_objects_with_what_a_verb_does_not_honor_raise(verb: str, tmp_path: Path) -> None:
    honored = names_of(verb, "surface", "trace")
    for name, value in OF_TRACE.items():
        if name not in honored:
            with pytest.raises(TypeError, match=rf"{verb} has no {name}|render has no {name}"):
                CALLS[verb](tmp_path, options=hk.TraceOptions(**{name: value}))
    if verb in ("repair", "curvature"):
        return
    for name in ("side", "largest"):
        if name not in honored:
            surface = hk.Surface(SPHERE, **{name: "below" if name == "side" else True})
            with pytest.raises(TypeError, match=rf"{verb} has no {name}"):
                CALLS[verb](tmp_path, surface=surface)


def test_unknown_names_get_a_hint() -> None:
    for call, hint in (
        (lambda: hk.trace(SPHERE, *RAY, levle=1.0), "level"),
        (lambda: hk.render(SPHERE, solid=(0, 1)), "side"),
        (lambda: hk.render(SPHERE, color="red"), "material"),
        (lambda: hk.mesh(SPHERE, tolerence=1.0), "tolerance"),
        (lambda: hk.trace(SPHERE, *RAY, tol=1e-3), "tolerance"),
        (lambda: hk.TraceOptions(tol=1e-3), "tolerance"),
        (lambda: hk.TraceOptions().replace(steps=5), "max_steps"),
        (lambda: hk.Surface(SPHERE, sides="below"), "side"),
        (lambda: hk.Surface(SPHERE).replace(levl=5), "level"),
    ):
        with pytest.raises(TypeError, match=f'did you mean "{hint}"'):
            call()


def test_unknown_names_get_the_list() -> None:
    for call, names in (
        (lambda: hk.trace(SPHERE, *RAY, zzz=1), "level, clip, section, largest, tolerance"),
        (lambda: hk.TraceOptions(zzz=1), "tolerance, enclosures, max_steps"),
        (lambda: hk.Surface(SPHERE).replace(zzz=1), "field, level, clip, section, side, largest"),
    ):
        with pytest.raises(TypeError, match=f"has no argument 'zzz'; .* {names}"):
            call()


def test_one_message_names_all_options_that_a_verb_lacks() -> None:
    options = hk.TraceOptions(tolerance=1e-5, max_steps=9, precision="double")
    solid = hk.Surface(SPHERE, side="below", largest=True)
    point = [[1.0, 0.0, 0.0]]
    wanted = (
        r"curvature has no tolerance, max_steps, largest, side; of the options of surfaces and "
        r"traces it has precision; give options\.replace\(tolerance=None, max_steps=2000\) and "
        r'give surface\.replace\(largest=False, side="surface"\): faces of a solid'
    )
    with pytest.raises(TypeError, match=wanted):
        hk.curvature(solid, point, options=options)
    wanted = r"mesh has no max_steps, precision; .* give options\.replace\(max_steps=2000, precis"
    with pytest.raises(TypeError, match=wanted):
        hk.mesh(SPHERE, options=options)
    left_out = r"signed_distance has no tolerance, side; .*; leave out tolerance, side$"
    with pytest.raises(TypeError, match=left_out):
        hk.signed_distance(SPHERE, point, tolerance=1.0, side="below", level=0.0)
    with pytest.raises(TypeError, match=r"render has no frames: .* animate; no orbit: .* animate"):
        hk.render(SPHERE, frames=3, orbit=3)


# The command line.

COMMANDS = ("render", "animate", "page", "view", "mesh", "repair")
# Options of Python whose flags have other names, or that a command always sets.
OTHER_FLAGS = {
    "camera": "--azimuth", "progress": "--quiet", "open_browser": "--no-browser",
}  # fmt: skip
ONLY_IN_PYTHON = {"block", "height", "sources"}


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_have_the_options_of_their_verbs(command: str) -> None:
    flags = set(parsers()[1][command].options())
    for option in OPTIONS:
        flag = OTHER_FLAGS.get(option.name, option.flag)
        expected = command in option.verbs and option.name not in ONLY_IN_PYTHON
        if (command, option.name) in {("mesh", "seed"), ("repair", "seed")}:
            expected = False
        if (command, option.name) == ("mesh", "up"):
            expected = True  # of the file
        assert (flag in flags) == expected, (command, option.name)


# Scene files.

SCENE_VALUES: dict[str, Any] = {
    **OF_SURFACE, **OF_TRACE, "show": "shaded", "camera": hk.Camera(azimuth=10.0),
    "size": (64, 48), "spp": 4, "material": "clay", "section_material": "gold",
    "boundary_radius": 0.1, "boundary_material": "gold", "isolines": hk.Isolines("z", interval=0.5),
    "thickness": 0.1, "backdrop": "dark", "up": "y", "color_by": "z", "color_range": (0.0, 1.0),
    "color_bar": True, "antialias": "edges", "max_depth": 3, "denoise": True, "seed": 7,
}  # fmt: skip
SHOWN_BY = {"color_by": "value", "color_range": "value", "color_bar": "value", "max_depth": "path",
            "denoise": "path"}  # fmt: skip


@pytest.mark.parametrize(
    "option", [o for o in OPTIONS if "render" in o.verbs], ids=lambda o: o.name
)
def test_scene_files_hold_the_options_of_pictures(option: Option, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    value = SCENE_VALUES.get(option.name, "text")
    settings = {option.name: value}
    if option.name in SHOWN_BY:
        settings["show"] = SHOWN_BY[option.name]
    if option.name in ("color_range", "color_bar"):
        settings["color_by"] = "z"
    if not option.in_files:
        with pytest.raises(hk.live.SceneFileError, match=option.name):
            hk.write_scene(path, SPHERE, **settings)
        return
    hk.write_scene(path, SPHERE, **settings)
    scene = hk.read_scene(path)
    read = scene.settings[option.name]
    if option.name == "isolines":
        assert [(lines.function, lines.interval) for lines in read] == [("z", 0.5)]
    else:
        assert read == value
    if option.group == "surface":
        (surface,) = scene.surfaces_with_options
        assert surface == hk.Surface(SPHERE, **settings)
    if option.group == "trace":
        assert getattr(scene.trace_options, option.name) == value


def test_scene_files_refuse_options_of_other_verbs(tmp_path: Path) -> None:
    for option in OPTIONS:
        if "render" not in option.verbs and option.name != "sources":
            with pytest.raises(hk.live.SceneFileError, match=option.name):
                hk.write_scene(tmp_path / "a.json", SPHERE, **{option.name: 1})
    assert not list(tmp_path.iterdir())


# One meaning.


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_defaults_follow_the_size_of_the_surface(scale: float) -> None:
    """A ball cut from a gyroid, scaled: the same hits and crossings, relative to its size."""
    rng = np.random.default_rng(3)
    o = rng.normal(size=(500, 3))
    o *= 2.0 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.6, 0.6, o.shape) - o
    origins, directions = o.astype(np.float32), d.astype(np.float32)

    def hits(size: float) -> Any:
        field = hk.Gyroid(0.7 * size, domain=hk.Ball((0, 0, 0), size))
        return hk.trace(field, np.float32(size) * origins, directions)

    unit, scaled = hits(1.0), hits(scale)
    # Rays that graze the surface within the tolerance may end otherwise.
    assert (unit.status != scaled.status).mean() < 0.01
    both = unit.is_hit & scaled.is_hit
    apart = np.abs(scaled.t[both] / scale - unit.t[both])
    assert np.quantile(apart, 0.98) < 4e-4


def test_options_that_are_given_twice_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse(["render", "x^2 = 1", "--clip", "ball:0,0,0,1", "--clip", "ball:0,0,0,2"])
    assert "--clip is given twice" in capsys.readouterr().err
    lines = parse(["render", "x^2 = 1", "--isolines", "z:0.2", "--isolines", "x:0.5"]).isolines
    assert [line.function for line in lines] == ["z", "x"]


def test_scenes_say_which_settings_a_verb_has(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    hk.write_scene(path, SPHERE, show="value", color_by="z", size=(64, 48), material="gold")
    scene = hk.read_scene(path)
    assert set(scene.settings_of("render")) == {"show", "color_by", "size", "material"}
    assert set(scene.settings_of("page")) == {"material"}
