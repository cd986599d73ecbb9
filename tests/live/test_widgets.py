"""The widget of notebooks: what its attributes take, and it in Chromium, without a notebook."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import example_curves
from harnack.live import server
from tests.live.browsers import Page, chromium, served

widgets = pytest.importorskip("harnack.live.widget")
traitlets = pytest.importorskip("traitlets")
LOOP = example_curves.torus_knot(2, 3, 12)


@pytest.fixture
def widget(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setattr(server, "in_notebook", lambda: True)
    made = hk.view(hk.SolidAngle(LOOP), level=hk.Slider(1.0, 12.0, 6.0), title="T", height=240)
    assert isinstance(made, widgets.Widget)
    yield made
    made.close()


def test_attributes_are_what_is_drawn_and_refuse_nonsense(widget: Any) -> None:
    assert widget.sliders == {"level": 6.0}
    assert np.allclose(widget.points, [LOOP])
    assert widget.show == "shaded"
    assert np.linalg.norm(np.subtract(widget.camera["position"], widget.camera["target"])) > 1
    heard: list[Any] = []
    widget.observe(heard.append, names=["sliders", "points"])
    widget.sliders = {"level": np.float64(3.0)}
    widget.points = [LOOP + 0.1]
    assert [one["name"] for one in heard] == ["sliders", "points"]
    for name, wrong in {
        "sliders": {"levle": 3}, "points": [[[0, 0]]], "camera": {"position": (0, 0, 1)},
        "show": "colour", "height": True,
    }.items():  # fmt: skip
        with pytest.raises(traitlets.TraitError):
            setattr(widget, name, wrong)
    assert widget.sliders == {"level": 3.0}


def test_a_message_is_answered(widget: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[Any] = []
    done = threading.Event()

    def send(content: Any, buffers: Any = None) -> None:
        said.append((content, buffers))
        if "done" not in content:
            done.set()

    monkeypatch.setattr(widget, "send", send)
    widget._receive(widget, json.dumps({"id": 7, "kind": "change", "sliders": {"level": 2}}), [])
    assert done.wait(60)
    assert said[-1][0]["answer"]["surfaces"]
    widget._receive(widget, "no question", [])
    assert said[-1][0]["error"] == "a question is an object in JSON"


def test_nan_is_refused_and_a_closed_widget_is_silent(
    widget: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pose, nan = dict(widget.camera), float("nan")
    for name, wrong in {
        "camera": {**pose, "fov": nan}, "sliders": {"level": nan},
        "points": [[[nan, 0, 0], *LOOP[1:].tolist()]], "height": nan,
    }.items():  # fmt: skip
        with pytest.raises(traitlets.TraitError):
            setattr(widget, name, wrong)
    with pytest.raises(traitlets.TraitError):
        widget.camera = {**pose, "position": (10**400, 0, 0)}
    assert widget.camera == pose
    assert widget.sliders == {"level": 6.0}
    said: list[Any] = []
    monkeypatch.setattr(widget, "send", lambda *given, **_: said.append(given))
    widget.close()
    widget._receive(widget, json.dumps({"id": 1, "kind": "change"}), [])
    widget.close()
    assert said == []


# What a notebook does for a widget, in a page: attributes, and messages by a function of the test.
MODEL = """
class Model {
  constructor(state) { this.state = state; this.heard = {}; }
  get(name) { return this.state[name]; }
  set(name, value) { this.state[name] = value; }
  save_changes() { window.python(JSON.stringify({ state: this.state })); }
  on(event, heard) { this.heard[event] = heard; }
  async send(text) {
    for (const [said, bytes] of await window.python(JSON.stringify({ message: text })))
      this.heard["msg:custom"](said, bytes ? [new DataView(Uint8Array.from(bytes).buffer)] : []);
  }
  move(name, value) { this.state[name] = value; this.heard[`change:${name}`](); }
}
const model = window.model = new Model(await (await fetch("state.json")).json());
const root = document.getElementById("surface");
const widget = (await import("./widget.js")).default;
window.end = widget.render({ model, el: root });
"""


@pytest.mark.browser
def test_a_widget_is_moved_and_moves(widget: Any, tmp_path: Path) -> None:
    state = {name: getattr(widget, name) for name in widget.keys if name[0] != "_"}
    state = {name: state[name] for name in ("camera", "sliders", "points", "show", "height")}
    state |= {name: getattr(widget, name) for name in ("_scene", "_passes", "_still")}
    (tmp_path / "state.json").write_text(json.dumps(state))
    # The panel is shown to the test, as a page shows it.
    code = widgets.Widget._esm.replace("panel.open();", "window.panel = panel; panel.open();")
    (tmp_path / "widget.js").write_text(str(code))
    (tmp_path / "a.html").write_text(
        "<!doctype html><style>body, #surface { margin: 0; } " + str(widgets.Widget._css)
        + '</style><div id="surface"></div><script type="module">' + MODEL + "</script>"
    )  # fmt: skip

    def python(text: str) -> Any:
        given = json.loads(text)
        if "state" in given:
            for name in ("camera", "sliders", "points", "show"):
                setattr(widget, name, given["state"][name])
            return []
        question = widget._client.read(given["message"])
        if question is None:
            return []
        answer = widget._client.answer(question, lambda part: None)
        if isinstance(answer, bytes):
            return [[{}, list(answer)]]
        return [[answer, None]]

    with chromium() as browser, served(tmp_path) as address:
        page = Page(browser, f"{address}/a.html", (320, 240), samples=1, exposed={"python": python})
        before = page.picture("widget")
        pose = widget.camera
        page.drag((100, 100), (180, 120))
        turned = page.picture()
        assert (np.abs(before.astype(int) - turned).max(axis=2) > 12).mean() > 0.05
        assert widget.camera["position"] != pose["position"]
        page.do("(pose) => model.move('camera', pose)", pose)
        back = page.picture()
        assert (np.abs(before.astype(int) - back).max(axis=2) > 12).mean() < 0.01
        page.set("level", 3.0)
        page.rest()
        assert widget.sliders == {"level": 3.0}
        page.do("() => model.move('sliders', { level: 9 })")
        moved = page.picture("widget-moved")
        assert (np.abs(before.astype(int) - moved).max(axis=2) > 12).mean() > 0.02
        assert page.do("() => panel.sliderValues.level") == 9
        assert page.message == ""
        page.close()
