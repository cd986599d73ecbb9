"""Scene files: what is written is read again, the same; what is not known is refused by name."""

from __future__ import annotations

import inspect
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cli import main
from harnack.gallery import SCENES
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import icosphere
from harnack.live.scene_file import (
    _constructible_types,
    parse_scene,
    to_scene_text,
    with_flat_options,
)
from harnack.live.type_checks import check_types

CURVE = hk.SolidAngle(example_curves.torus_knot(2, 3, 12))
SOLIDS = {
    "sphere": hk.Sphere(1.25),
    "moved": hk.Torus(1.0, 0.3).translated((1.0, 2.0, 3.0)).rotated(30.0, "x").scaled(2.0),
    "cut": hk.Sphere(1.0) - hk.Cuboid((1.0, 1.0, 4.0)) | hk.Capsule((0, 0, -1), (0, 0, 1), 0.2),
    "twisted": hk.Cuboid((0.8, 0.8, 2.0)).twisted(math.degrees(0.5)),
    "struts": hk.solids.struts([(0, 0, 0), (1, 0, 0), (0, 1, 1)], [(0, 1), (0, 2)], 0.1),
    "tube": hk.Tube(example_curves.torus_knot(2, 3, 12), 0.1),
    "outlines": hk.Extrusion(
        [[(0, 0), (2, 0), (0, 2)], [(0.2, 0.2), (1, 0.2), (0.2, 1)]], 0.5, twist=40.0, taper=0.5
    )
    | hk.SolidOfRevolution([(0, 0), (1, 0), (0, 1)]),
    "threads": hk.solids.metric_thread("M8", 10.0) | hk.Tube.helix(5.0, 2.0, 1.5, 0.3),
    "mesh": hk.solid(icosphere(0)).shell(0.2) - hk.solid(icosphere(0)).scaled(0.3),
    "gyroid": hk.Gyroid(0.5, domain=hk.Ball((0.1, 0.0, 0.0), 1.5)),
    "formula": hk.expression("x^2 + a*y^2 = 1 + z", parameters={"a": 0.1}, level=0.25),
    "curve": CURVE,
}


@pytest.mark.parametrize("name", SOLIDS)
def test_fields_come_back_as_they_were(name: str) -> None:
    field = SOLIDS[name]
    text = to_scene_text(field, {})
    saved = parse_scene(text)
    (found,) = saved.surfaces
    points = np.random.default_rng(1).normal(size=(100, 3))
    assert isinstance(found, hk.Field)
    assert np.array_equal(found.value(points), field.value(points), equal_nan=True)
    assert (found.default_level, found.domain) == (field.default_level, field.domain)
    assert to_scene_text(saved.surfaces, saved.settings) == text


def test_how_curves_are_traced_comes_back() -> None:
    """A curve of certificate "paper" came back as one that is proved."""
    loops = CURVE.loops
    for how in ({"lift_bound": "paper"}, {"cells": True}, {"cells": False}, {}):
        text = to_scene_text(hk.SolidAngle(loops, **how), {})
        about = json.loads(text)["surfaces"][0]["field"]
        assert {name: about[name] for name in about if name != "curves"} == how
        (field,) = parse_scene(text).surfaces
        assert isinstance(field, hk.SolidAngle)
        assert field.lift_bound_option == how.get("lift_bound", "auto")
        assert field.cells is how.get("cells")
    with pytest.raises(ValueError, match="true or false, not 3"):
        to_scene_text(hk.SolidAngle(loops, cells=3.0), {})
    for wrong, said in (({"cells": 9e9}, "true or false"), ({"lift_bound": "x"}, "lift_bound")):
        given = json.loads(to_scene_text(CURVE, {}))
        given["surfaces"][0]["field"] |= wrong
        with pytest.raises(ValueError, match=said):
            parse_scene(json.dumps(given))


@pytest.mark.slow
def test_every_scene_of_the_gallery_comes_back() -> None:
    for name, scene in SCENES.items():
        surfaces = scene.surfaces()
        sources = [
            (surface.field, {"scene": name, "number": k}) for k, surface in enumerate(surfaces)
        ]
        settings = scene.settings(len(surfaces))
        saved = parse_scene(to_scene_text(surfaces, settings, sources))
        assert saved.settings == with_flat_options(settings), name
        assert saved.trace_options == scene.options, name
        for surface, read in zip(surfaces, saved.surfaces, strict=True):
            assert isinstance(read, hk.Surface)
            for part in ("level_values", "clip", "section", "side", "largest"):
                assert getattr(surface, part) == getattr(read, part), (name, part)


def test_surfaces_of_the_gallery_have_their_own_keywords_in_place_of_a_field() -> None:
    """As a field alone they are traced by the keywords beside it."""
    scene = SCENES["helix"]
    about: dict[str, Any] = {"scene": "helix", "number": 0}
    surfaces = [about, {"field": about}, {"field": about, "level": 0.5}]
    whole, bare, other = parse_scene(json.dumps({"harnack": 1, "surfaces": surfaces})).surfaces
    (own, *_) = scene.surfaces()
    assert isinstance(whole, hk.Surface)
    assert whole.keywords == own.keywords
    assert whole.level_values == own.level_values
    assert isinstance(bare, hk.Field)
    assert isinstance(other, hk.Surface)
    assert (other.level_values, other.side) == ((0.5,), None)


def test_a_scene_is_traced_at_its_level(tmp_path: Path) -> None:
    hk.write_scene(
        tmp_path / "a.json", hk.Sphere(1.0), level=0.5, clip=hk.HalfSpace((0, 0, 1), 0.0)
    )
    (surface,) = hk.read_scene(tmp_path / "a.json").surfaces_with_options
    hits = hk.trace(surface, [[0, 0, 5.0]], [[0, 0, -1.0]])
    assert hits.t[0] == pytest.approx(6.5, abs=1e-3)


@pytest.mark.parametrize(
    ("settings", "wrong"),
    [
        ({"level": "x"}, "level"), ({"size": [1e9, 1e9]}, "size"),
        ({"material": {"Sphere": {}}}, "material"), ({"show": "nothing"}, "show"),
        ({"spp": -1}, "spp"), ({"require_crossing": "yes"}, "require_crossing"), ({"up": 3}, "up"),
        ({"boundary_radius": "x"}, "boundary_radius"), ({"thickness": True}, "thickness"),
        ({"largest": "yes"}, "largest"), ({"denoise": 1}, "denoise"),
        ({"enclosures": 3}, "enclosures"),
    ],
)  # fmt: skip
def test_settings_are_checked_when_they_are_read(settings: dict[str, Any], wrong: str) -> None:
    about = {"harnack": 1, "surfaces": [{"field": {"Sphere": {}}}], "settings": settings}
    with pytest.raises(hk.live.SceneFileError, match=f"settings: .*{wrong}"):
        parse_scene(json.dumps(about))


@pytest.mark.parametrize(
    ("settings", "wrong"),
    [
        ({"level": math.inf}, "level"), ({"clip": hk.Slider(0, 1)}, "clip"),
        ({"level": "x"}, "level"), ({"size": (10**9, 10**9)}, "size"),
    ],
)  # fmt: skip
def test_what_could_not_be_read_is_not_written(
    settings: dict[str, Any], wrong: str, tmp_path: Path
) -> None:
    with pytest.raises(hk.live.SceneFileError, match=wrong):
        hk.write_scene(tmp_path / "a.json", hk.Sphere(1.0), **settings)
    assert not any(tmp_path.iterdir())


def test_scene_files_know_every_solid() -> None:
    solids = [getattr(hk.solids, name) for name in hk.solids.__all__]
    solids = [
        kind
        for kind in solids
        if inspect.isclass(kind) and issubclass(kind, hk.solids.FormulaSolid)
    ]
    assert len(solids) > 10
    for kind in _constructible_types().values():
        check_types(kind, {})  # whose annotations can be read
    for kind in set(solids) - {hk.solids.FormulaSolid}:
        about = {"harnack": 1, "surfaces": [{"field": {kind.__name__: {"q": 1}}}]}
        with pytest.raises(hk.live.SceneFileError, match="argument of"):
            parse_scene(json.dumps(about))


def test_settings_and_sliders_come_back(tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "clip": hk.Ball((0, 0, 0), 2.0), "section": hk.HalfSpace((1.0, 0.0, 0.0), 0.5),
        "tolerance": 1e-3, "material": ["gold"], "backdrop": "dark", "up": "y",
        "boundary_radius": 0.05,
        "camera": hk.Camera(position=(3.0, 2.0, 1.0), target=(0.0, 0.0, 0.0), fov=30.0),
        "isolines": [hk.Isolines("x*y", interval=0.25, color="navy")],
    }  # fmt: skip
    path = tmp_path / "a.json"
    hk.write_scene(path, CURVE, level=hk.Slider(1.0, 12.0, 5.0), **settings)
    saved = hk.read_scene(path)
    assert saved.sliders == {"level": hk.Slider(1.0, 12.0, 5.0)}
    isolines = saved.settings["isolines"]
    assert [(one.function, one.interval, one.color) for one in isolines] == [("x*y", 0.25, "navy")]
    kept = {name: one for name, one in saved.settings.items() if name != "isolines"}
    assert kept == {name: one for name, one in settings.items() if name != "isolines"} | {
        "level": 5.0
    }
    assert parse_scene(to_scene_text(CURVE, {"level": np.float32(0.5)})).settings == {"level": 0.5}
    surface = hk.Surface(hk.Gyroid(0.5), level=0.1, side="below", clip=hk.Ball())
    (found,) = parse_scene(to_scene_text([surface], {})).surfaces
    assert isinstance(found, hk.Surface)
    assert (found.side, found.clip) == (surface.side, surface.clip)


def test_a_file_is_found_beside_the_scene(tmp_path: Path) -> None:
    path = tmp_path / "curve.loops"
    path.write_text(" ".join(map(str, example_curves.wavy_polygon(8).ravel().tolist())))
    about: Any = {"harnack": 1, "surfaces": [{"field": {"file": "curve.loops"}, "level": 2.0}]}
    (tmp_path / "a.json").write_text(json.dumps(about))
    saved = hk.read_scene(tmp_path / "a.json")
    (one,) = saved.surfaces
    assert isinstance(one, hk.Surface)
    assert isinstance(one.field, hk.SolidAngle)
    assert (
        json.loads(to_scene_text(saved.surfaces, {}, saved.sources))["surfaces"][0]["level"] == 2.0
    )
    with pytest.raises(hk.live.SceneFileError, match="must not name files"):
        parse_scene(json.dumps(about))


# Texts that are no scenes, and fields, surfaces and other parts of scenes that are none.
WRONG = {
    "": "no JSON",
    "[" * 100_000: "within each other",
    '{"harnack": NaN}': "NaN is no number",
    "[]": "must be an object",
    "{}": 'must say "harnack": 1',
    '{"harnack": 2, "surfaces": []}': 'must say "harnack": 1',
    '{"harnack": true, "surfaces": []}': 'must say "harnack": 1',
    '{"harnack": 1, "surfaces": [], "surfaces": []}': "'surfaces' is said twice",
    '{"harnack": 1, "surfaces": [' + "[" * 900 + "]" * 900 + "]}": "must be an object",
    '{"harnack": 1, "surfaces": []}': "one surface at least",
    '{"harnack": 1, "surfaces": [3]}': "must be an object",
    '{"harnack": 1, "surfaces": [{"scene": "gyroid", "level": 1}]}': "no part of a surface of the",
    '{"harnack": 1, "surfaces": [{}]}': r"surfaces\[0\] has no field",
}
WRONG_FIELDS = {
    '{"Spere": {}}': 'mean "Sphere"',
    '{"Sphere": {"radus": 1}}': 'mean "radius"',
    '{"Sphere": {"radius": -1}}': "radius",
    '{"Sphere": {"radius": "x"}}': "radius",
    '{"Sphere": {}, "Torus": {}}': "write one name",
    '{"Ball": {}}': "this is no field",
    '{"Molecule": {"source": "/etc/hosts"}}': "no kind",
    '{"expression": {"function": "x"}}': "no kind",
    '{"scene": "gyroit"}': 'mean "gyroid"',
    '{"scene": "gyroid", "number": 9}': "no number 9",
    '{"scene": "gyroid", "path": 9}': "no part of a surface of the gallery",
    '{"file": "a.ply"}': "must not name files",
    '{"file": ["a.ply"]}': "file must be a text",
    '{"file": "a.ply", "read_as": "x"}': "read_as must be",
    """{"formula": "__import__('os')"}""": "no formula",
    '{"formula": 3}': "a formula is a text",
    '{"formula": "x=1", "parameters": {"a": 1}}': "no parameter 'a'",
    '{"OffsetSolid": {"distance": 0.1, "field": ' * 2000
    + '{"Sphere": {}}'
    + "}}" * 2000: "each other",
    '{"Sphere": {}}, "level": ' + "[" * 900 + "]" * 900: "within each other",
    '{"Complement": {"field": null}}': "Complement",
    '{"DeformedSolid": {"inner": {"Sphere": {}}, '
    '"map": {"Sphere": {}}}}': "DeformedSolid: map must be a Deformation",
    '{"BooleanSolid": {"parts": [{"Sphere": {}}, 3], "is_union": true}}': "parts must be a list",
    '{"BooleanSolid": {"parts": [{"Sphere": {}}], '
    '"is_union": 1}}': "is_union must be true or false",
    '{"SublevelSolid": {"field": {"Ball": {}}}}': "SublevelSolid: field must be a Field",
    '{"OffsetSolid": {"field": {"Sphere": {}}, "distance": true}}': "distance must be a number",
    '{"DisplacedSolid": {"solid": {"Sphere": {}}, '
    '"noise": {"Sphere": {}}}}': "noise must be a FractalNoise",
    '{"Gyroid": {"domain": {"Sphere": {}}}}': "Gyroid: domain must be a Volume or null",
    '{"SphericalHarmonic": {"l": 2.5, "m": 0}}': "l must be a whole number",
    '{"formula": "x=1", "is_convex": "yes"}': "is_convex must be true or false",
    '{"formula": "x=1", "domain": {"Sphere": {}}}': "domain must be a Volume or null",
    '{"formula": "x=1", "level": "0"}': "level must be a number",
    '{"formula": "x=a", "parameters": {"a": true}}': "parameters: a must be a number",
    '{"file": "a.ply", "take_boundary": "yes"}': "take_boundary must be true or false",
    '{"Gyroid": {"cell": 1e308}}': "Gyroid",
    '{"scene": []}': "no scene is named",
    '{"curves": [[1, 2]]}': "surfaces",
    '{"curves": [], "level": 1}': "part of curves",
    '{"Sphere": {}}, "levle": 1': 'mean "level"',
    '{"Sphere": {}}, "level": "x"': "level",
}
WRONG_PARTS = {
    '"a": 1': "no part 'a'",
    '"settings": {"path": "/a"}': "no setting 'path'",
    '"settings": {"camera": {"eye": 1}}': "no argument of Camera",
    '"settings": {"camera": {"zoom": "2"}}': "zoom must be a number",
    '"settings": {"camera": {"box": {"Ball": {}}}}': "box must be a Box or null",
    '"settings": {"clip": {"VolumeIntersection": '
    '{"volumes": [{"Sphere": {}}]}}}': "volumes must be",
    '"settings": {"camera": 3}': "must be an object",
    '"sliders": {"level": {"low": 1}}': "sliders: level",
    '"sliders": {"material": {"low": 1, "high": 2}}': "no slider",
}
WHOLE = '{"harnack": 1, "surfaces": [{"field": %s}]}'


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        *WRONG.items(),
        *((WHOLE % field, wrong) for field, wrong in WRONG_FIELDS.items()),
        *(
            (WHOLE[:-1] % '{"Sphere": {}}' + f", {part}}}", one)
            for part, one in WRONG_PARTS.items()
        ),
    ],
)
def test_what_is_not_known_is_refused(text: str, wrong: str) -> None:
    with pytest.raises(hk.live.SceneFileError, match=wrong):
        parse_scene(text)


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    mesh = hk.WindingNumber(*icosphere(1))
    with pytest.raises(hk.live.SceneFileError, match="a WindingNumber that was made in Python"):
        hk.write_scene(tmp_path / "a.json", mesh)
    with pytest.raises(hk.live.SceneFileError, match="Expression that was made in Python"):
        hk.write_scene(tmp_path / "a.json", hk.expression(lambda x, y, z: x * y - z))
    with pytest.raises(hk.live.SceneFileError, match="no setting 'levle'"):
        hk.write_scene(tmp_path / "a.json", CURVE, levle=1.0)
    with pytest.raises(hk.live.SceneFileError, match=r"written as \.json"):
        hk.write_scene(tmp_path / "a.txt", CURVE)
    with pytest.raises(hk.live.SceneFileError, match="only those of a formula as text"):
        hk.write_scene(
            tmp_path / "a.json", CURVE, isolines=hk.Isolines(hk.Sphere(1.0), interval=1.0)
        )
    with pytest.raises(hk.live.SceneFileError, match="material"):
        hk.write_scene(tmp_path / "a.json", CURVE, material={"type": "diffuse"})
    with pytest.raises(hk.live.SceneFileError, match="nothing to write"):
        hk.write_scene(tmp_path / "a.json", [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_every_command_reads_a_scene_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, picture = str(tmp_path / "a.json"), tmp_path / "a.png"
    hk.write_scene(
        path, hk.Torus(1.0, 0.3), level=hk.Slider(-0.1, 0.1), backdrop="dark", show="normal"
    )
    small = ["--size", "32x24", "--quiet"]
    assert main(["render", path, "-o", str(picture), *small]) == 0
    assert main(["render", path, "-o", str(tmp_path / "b.png"), "--azimuth", "90", *small]) == 0
    assert main(["mesh", path, "-o", str(tmp_path / "a.stl"), "--cell-size", "0.2", "--quiet"]) == 0
    assert main(["page", path, "-o", str(tmp_path / "a.html"), "--quiet"]) == 0
    written = (tmp_path / "a.html").read_text()
    assert '"name": "level", "low": -0.1' in written
    assert '"show": "normal"' in written
    assert len(list(tmp_path.iterdir())) == 5
    (tmp_path / "b.json").write_text("{}")
    assert main(["render", str(tmp_path / "b.json")]) == 1
    assert '"harnack": 1' in capsys.readouterr().err


def test_a_file_is_found_beside_the_scene_that_was_sent_with_it(tmp_path: Path) -> None:
    path = tmp_path / "curve.loops"
    path.write_text(" ".join(map(str, example_curves.wavy_polygon(8).ravel().tolist())))
    about = {"harnack": 1, "surfaces": [{"field": {"file": "/elsewhere/curve.loops"}}]}
    (tmp_path / "a.json").write_text(json.dumps(about))
    (field,) = hk.read_scene(tmp_path / "a.json").surfaces
    assert isinstance(field, hk.SolidAngle)
