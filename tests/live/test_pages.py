"""Pages: what is in the file, and that the kernels in it find what the rays in it say."""

from __future__ import annotations

import base64
import functools
import gzip
import json
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cli import main
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import torus_mesh
from harnack.live.shading_data import shader_constants
from harnack.live.sliders import SlidingContent
from harnack.rendering import shading
from harnack.webgpu import NoDeviceError, find_device
from harnack.webgpu.device import CompiledShader
from harnack.webgpu.wgsl import Shader

page_module = import_module("harnack.live.page_file")  # beside the function of that name


def scene_of(path: Path) -> dict[str, Any]:
    found = re.search(r"^const scene = (\{.*\});$", path.read_text("utf-8"), re.MULTILINE)
    assert found is not None
    return json.loads(found.group(1))


def words(text: str) -> Any:
    return np.frombuffer(gzip.decompress(base64.b64decode(text)), np.uint32)


def run(surface: dict[str, Any], data: Any) -> tuple[Any, Any]:
    """What a surface's kernel finds for its rays: what is expected, and what a device says."""
    try:
        device = find_device()
    except NoDeviceError as missing:
        pytest.skip(str(missing))
    lanes = words(surface["check"]["lanes"]).reshape(len(surface["lanes"]), -1)
    names = tuple(map(str, range(len(lanes))))
    places = surface["results"]
    outputs = tuple(map(str, range(sum(place < 99 for place in places))))
    program: CompiledShader = device.compile(Shader(surface["code"], (), (), names, outputs))
    given = program.run_words(data, lanes)
    found = np.array([0 * given[0] if place == 99 else given[place] for place in places])
    return words(surface["check"]["results"]).reshape(7, -1), found


def test_shaders_have_the_constants_of_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shading, "KEY_WRAP", 0.125)
    assert "\nconst KEY_WRAP = 0.125;\n" in page_module.passes()
    shaders = page_module.resource("passes.wgsl")
    names = re.findall(r"^const (\w+) = ", shader_constants(), re.MULTILINE)
    assert [name for name in names if not re.search(rf"\b{name}\b", shaders)] == []
    assert [name for name in names if f"const {name} =" in shaders] == []


@pytest.mark.parametrize(
    "name", ["trefoil", "gyroid", pytest.param("spheres", marks=pytest.mark.slow)]
)
def test_the_kernel_of_a_page_finds_what_its_rays_say(name: str, tmp_path: Path) -> None:
    fields = {
        "trefoil": lambda: hk.SolidAngle(example_curves.torus_knot(2, 3, 60)),
        "gyroid": lambda: hk.Gyroid(0.5, domain=hk.Ball(radius=1.0)),
        "spheres": lambda: hk.union(
            [hk.Sphere(0.2, (x, y, z)) for x, y, z in np.random.default_rng(4).random((100, 3))]
        ),
    }
    path = tmp_path / "a.html"
    hk.page(fields[name](), path, title="A <surface> & more", progress=False)
    text = path.read_text("utf-8")
    assert len(text) < (2e6 if name == "spheres" else 1e6)
    assert "A &lt;surface&gt; &amp; more" in text
    assert not re.search(
        r"(src|href)=.https?:|@import .?(url|http)|fetch\(|import\(|^import |^export ", text, re.M
    )
    (surface,) = scene_of(path)["state"]["surfaces"]
    expected, found = run(surface, words(surface["data"]))
    status = expected[0]
    assert (status == int(hk.RayStatus.HIT)).mean() > 0.4
    assert (found[0] != status).mean() <= 1e-3
    both = (status == 1) & (found[0] == 1)
    off = np.abs(found[1].view(np.float32)[both] - expected[1].view(np.float32)[both])
    assert np.quantile(off, 0.9) <= 0.1 * surface["tolerance"] + 1e-5


@pytest.mark.slow
def test_a_page_of_a_mesh_of_fifty_thousand_faces_is_small(tmp_path: Path) -> None:
    vertices, faces = torus_mesh(1.0, 0.4, 250, 100)
    vertices += 0.002 * np.random.default_rng(0).normal(size=vertices.shape)
    assert len(faces) == 50_000
    path = tmp_path / "a.html"
    hk.page(hk.WindingNumber(vertices, faces[:-100]), path, progress=False)
    assert path.stat().st_size < 6e6


@pytest.mark.slow
def test_the_places_of_sliders_are_in_the_page(tmp_path: Path) -> None:
    path = tmp_path / "a.html"
    hk.page(
        lambda r: hk.Torus(1.0, r),
        path,
        level=hk.Slider(-0.1, 0.1),
        r=hk.Slider(0.2, 0.4, step=0.1),
        progress=False,
    )
    scene = scene_of(path)
    (surface,) = scene["state"]["surfaces"]
    places, frames = scene["frames"]["places"], scene["frames"]["frames"]
    assert np.allclose(places["r"], [0.2, 0.3, 0.4])
    assert len(frames) == 17 * 3
    data = words(surface["data"]).copy()
    (change,) = frames[-1]["surfaces"]
    data[words(change["at"])] = words(change["to"])
    data[0] = 2048
    _, found = run(surface, data)
    lanes = words(surface["check"]["lanes"]).view(np.float32).reshape(len(surface["lanes"]), -1)
    rays = {part: lanes[k] for k, part in enumerate(surface["lanes"])}
    o, d = (np.column_stack([rays[k] for k in part]) for part in ((0, 1, 2), (3, 4, 5)))
    # The rays are the stage's: the surface stands there turned, moved and scaled.
    turned, moved, scale = np.split(np.array(scene["placement"]), [9, 12])
    o, d = (o - moved) @ turned.reshape(3, 3) / scale, d @ turned.reshape(3, 3)
    tolerance = surface["tolerance"] / scale[0]
    expected = hk.trace(
        hk.Torus(1.0, 0.4), o, d, level=0.1, tolerance=tolerance, precision="single"
    )
    assert (found[0] != expected.status).mean() <= 2e-3
    both = expected.is_hit & (found[0] == 1)
    assert both.mean() > 0.4
    off = np.abs(found[1].view(np.float32)[both] - scale * expected.t[both])
    assert np.quantile(off, 0.9) < 1e-4


@pytest.mark.slow
def test_a_page_holds_fewer_places_where_they_are_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each place of a parameter of a formula brings a kernel of its own."""
    formula, path = "x^2 + a*y^2 + z^2 = 1", str(tmp_path / "a.html")
    command = ["page", formula, "--clip", "ball:0,0,0,2", "-o", path, "--quiet", "--slider"]
    monkeypatch.setattr(page_module, "_TARGET_BYTES", 1e6)
    monkeypatch.setattr(page_module, "_MANY_BYTES", 1e6)
    assert main([*command, "a=1:2"]) == 0
    assert len(scene_of(Path(path))["frames"]["frames"]) == 9
    said = capsys.readouterr()
    assert "at 9 places of the sliders: give them larger steps" in said.err
    assert re.search(r"wrote .*a\.html \(\d\.\d MB\)", said.out)
    assert main([*command, "a=1:2:1"]) == 0
    assert len(scene_of(Path(path))["frames"]["frames"]) == 2
    assert "step" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_kernel_that_is_not_the_first_one_brings_rays_to_check(tmp_path: Path) -> None:
    path = tmp_path / "a.html"

    def lens(c: float) -> hk.Field:
        return hk.Sphere(1.0) & hk.Sphere(1.0).translated((c, 0, 0))

    hk.page(lens, path, c=hk.Slider(0, 9, 1, step=1), progress=False)
    first, *_, last = scene_of(path)["frames"]["frames"]
    assert ["code" in one for one in (*first["surfaces"], *last["surfaces"])] == [True, True]
    for frame in scene_of(path)["frames"]["frames"]:
        for one in frame["surfaces"]:
            assert ("check" in one) == ("code" in one)


def test_a_page_says_at_which_place_nothing_can_be_drawn(tmp_path: Path) -> None:
    def torus(r: float) -> hk.Field:
        if r > 0.35:
            raise ZeroDivisionError("too thick")
        return hk.Torus(1.0, r)

    r = hk.Slider(0.2, 0.4, step=0.1)
    with pytest.raises(ValueError, match=r"at the place r=0\.4 .*: ZeroDivisionError: too thick"):
        hk.page(torus, tmp_path / "a.html", r=r, progress=False)
    assert list(tmp_path.iterdir()) == []


def test_a_title_does_not_end_the_script(tmp_path: Path) -> None:
    path, title = tmp_path / "a.html", "<!--<script>\n</script>"
    hk.page(hk.Sphere(1.0), path, title=title, progress=False)
    assert "<!--" not in path.read_text("utf-8")
    assert scene_of(path)["title"] == title


def test_too_many_choices_of_places_are_refused(tmp_path: Path) -> None:
    one = hk.Slider(1, 2, step=0.01)
    with pytest.raises(ValueError, match="a, b have 10,201 choices of places"):
        hk.page(lambda a, b: hk.Sphere(a + b), tmp_path / "a.html", a=one, b=one, progress=False)


def test_what_is_no_page(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"written as \.html"):
        hk.page(hk.Sphere(1.0), tmp_path / "a.png")
    with pytest.raises(ValueError, match="not drawn transparent"):
        hk.page(hk.Sphere(1.0), tmp_path / "a.html", material="glass")
    with pytest.raises(ValueError, match="reaches to infinity"):
        hk.page(hk.solids.Plane((0.0, 0.0, 1.0)), tmp_path / "a.html")
    with pytest.raises(TypeError, match="fields and surfaces, not"):
        hk.page("gyroid", tmp_path / "a.html")
    with pytest.raises(TypeError, match=r"no option 'levle'; did you mean \"level\""):
        hk.page(hk.Sphere(1.0), tmp_path / "a.html", levle=0.1)
    with pytest.raises(ValueError, match='"light" or "dark"'):
        hk.page(hk.Sphere(1.0), tmp_path / "a.html", backdrop="tomato")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "wrong"),
    [
        ({"port": True}, "port must be an integer"), ({"port": 1.5}, "port must be an integer"),
        ({"port": 70_000}, "port must be an integer"), ({"height": True}, "height must be"),
        ({"height": 3}, "height must be"), ({"title": 3}, "title must be text"),
        ({"host": None}, "host must be an address"), ({"tolerance": True}, "tolerance"),
        ({"boundary_radius": np.nan}, "boundary_radius"), ({"level": np.nan}, "level"),
    ],
)  # fmt: skip
def test_what_is_no_view(given: dict[str, Any], wrong: str) -> None:
    field: Any = hk.SolidAngle(example_curves.torus_knot(2, 3, 12))
    with pytest.raises((TypeError, ValueError), match=wrong):
        hk.view(field, open_browser=False, block=False, **given)


def test_sliders() -> None:
    assert hk.Slider(0, 1).start == 0.5
    assert hk.Slider(1, 8, step=2).values(99) == [1, 3, 5, 7]
    assert hk.Slider(1, 8, step=2).start == 3
    assert hk.Slider(0, 1, step=0.1).values(9)[3] == pytest.approx(0.3)
    tenths = hk.Slider(0, 0.3, step=0.1)
    assert (tenths.nearest(0.3), tenths.nearest(0.2999), max(tenths.values(9))) == (0.3, 0.2, 0.3)
    for wrong in ((1, 1), (0, 1, 2), (0, 1, 0.5, 0), (0, 1, 0.5, 2)):
        with pytest.raises(ValueError, match=r"slider goes|step must|start must"):
            hk.Slider(*wrong)
    for low in ("0", False, np.False_, 10**400):
        with pytest.raises(TypeError, match="low"):
            hk.Slider(low, 1)  # type: ignore[arg-type]
    subject = SlidingContent.of(
        lambda r: hk.Sphere(r), {"level": hk.Slider(0, 1), "r": hk.Slider(1, 2)}
    )
    what, settings = subject.at({"level": 0.25, "r": 2.0})
    assert (what.radius, settings) == (2.0, {"level": 0.25})
    for function in (
        lambda r, other=2: hk.Sphere(r),
        lambda r, /: hk.Sphere(r),
        lambda other=2, r=1, /, *more, **named: hk.Sphere(r),
        functools.partial(lambda center, r: hk.Sphere(r, center), center=(0, 0, 0)),
    ):
        what, _ = SlidingContent.of(function, {"r": hk.Slider(1, 2)}).at({"r": 2.0})
        assert what.radius == 2.0
    with pytest.raises(TypeError, match=r"a function of 'q'.*no such slider"):
        SlidingContent.of(lambda q: hk.Sphere(q), {"r": hk.Slider(1, 2)})
    with pytest.raises(TypeError, match="nothing depends on the slider 'r'"):
        SlidingContent.of(hk.Sphere(1.0), {"r": hk.Slider(1, 2)})
