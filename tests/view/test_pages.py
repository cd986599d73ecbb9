"""Pages: what is in the file, and that the kernel in it finds what the rays in it say."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import shapes
from harnack.webgpu import NoDeviceError, find_device
from harnack.webgpu.device import Program
from harnack.webgpu.wgsl import Shader


def scene_of(path: Path) -> dict[str, Any]:
    found = re.search(r"^open\((\{.*\}), canvas, say\)", path.read_text("utf-8"), re.MULTILINE)
    assert found is not None
    return json.loads(found.group(1))


def words(text: str) -> Any:
    return np.frombuffer(base64.b64decode(text), np.uint32)


@pytest.mark.parametrize("name", ["trefoil", "gyroid"])
def test_the_kernel_of_a_page_finds_what_its_rays_say(name: str, tmp_path: Path) -> None:
    fields = {
        "trefoil": lambda: hk.SolidAngle(shapes.torus_knot(2, 3, 60)),
        "gyroid": lambda: hk.Gyroid(0.5, domain=hk.Ball(radius=1.0)),
    }
    path = tmp_path / "a.html"
    hk.page(fields[name](), path, title="A <surface> & more")
    text = path.read_text("utf-8")
    assert len(text) < 1e6
    assert "A &lt;surface&gt; &amp; more" in text
    assert not re.search(r"(src|href)=.https?:|@import|fetch\(|import\(", text)
    scene = scene_of(path)
    check, results = scene["check"], scene["results"]
    status = words(check["status"])
    assert (status == int(hk.Status.HIT)).mean() > 0.4
    try:
        device = find_device()
    except NoDeviceError as missing:
        pytest.skip(str(missing))
    shader = Shader(scene["code"], (), (), tuple(map(str, range(6))), tuple(results))
    program: Program = device.compile(shader)
    data, lanes = words(scene["data"]), words(check["lanes"]).reshape(6, -1)
    found = dict(zip(results, program._dispatch(data, lanes), strict=True))
    assert (found["status"] != status).mean() <= 1e-3
    both = (status == 1) & (found["status"] == 1)
    t = words(check["t"]).view(np.float32)[both]
    off = np.abs(found["t"].view(np.float32)[both] - t)
    assert np.quantile(off, 0.9) <= 0.1 * scene["tolerance"] + 1e-5


def test_what_is_no_page(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"written as \.html"):
        hk.page(hk.Sphere(1.0), tmp_path / "a.png")
    with pytest.raises(TypeError, match="holds its settings already"):
        hk.page(hk.level_set(hk.Sphere(1.0)), tmp_path / "a.html", level=0.1)
    with pytest.raises(ValueError, match="leave out solid"):
        hk.page(hk.Gyroid(), tmp_path / "a.html", solid=(0.0, 1.0))
    with pytest.raises(ValueError, match="reaches to infinity"):
        hk.page(hk.Plane((0.0, 0.0, 1.0)), tmp_path / "a.html")
    with pytest.raises(TypeError, match="a harnack field is needed"):
        hk.page("gyroid", tmp_path / "a.html")  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
