"""What Python answers to a live surface: right numbers, and why a question makes no sense."""

from __future__ import annotations

import json
import socket
import struct
import time
from typing import Any

import drjit as dr
import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import icosphere, torus_mesh
from harnack.live import live_scene
from harnack.live.live_scene import LiveScene, state_delta
from harnack.live.session import MessageHandler, RequestError, Session
from harnack.live.sliders import extreme_slider_values
from harnack.meshing.meshing_errors import LocalizedMeshingError

LOOP = example_curves.torus_knot(2, 3, 18)
FIELD = hk.SolidAngle(LOOP)
EYE = {
    "origin": [0, -6, 0.3], "right": [1, 0, 0], "up": [0, 0, 1], "forward": [0, 1, 0],
    "pixel": 0.008,
}  # fmt: skip
POSE = {"position": [0, -5, 1], "target": [0, 0, 0], "fov": 30}


@pytest.fixture(scope="module")
def live() -> LiveScene:
    return LiveScene.of(FIELD, {"level": hk.Slider(1.0, 12.0, 6.0)}, edits=True)


def compiled(session: Session, questions: list[dict[str, Any]]) -> set[str]:
    """The shaders of all answers that are not the first one's, which the browser compiles."""
    every = [session.answer({"kind": "change", **one})["surfaces"] for one in questions]
    return {surface["key"] for surfaces in every for surface in surfaces if "key" in surface}


def test_nothing_is_compiled_for_sliders_and_points(live: LiveScene) -> None:
    rng = np.random.default_rng(0)
    questions: list[dict[str, Any]] = [{}]
    for k in range(4):
        loop = LOOP + 0.05 * rng.normal(size=LOOP.shape)
        questions.append({"sliders": {"level": 2.0 + k}, "loops": [loop.tolist()]})
    assert compiled(Session(live), questions) == set()


NUMBERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "radius": (lambda a: hk.Torus(1.0, a), {}),
    "thickness": (
        hk.Gyroid(0.5, domain=hk.Ball()), {"level": lambda a: (-a, a), "side": "between"}
    ),
    "clip": (hk.Gyroid(0.5), {"clip": lambda a: hk.Ball(radius=1 + a)}),
    "section": (
        hk.Torus(1.0, 0.3), {"section": lambda a: hk.HalfSpace((1.0, 0.0, 0.0), a)}
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NUMBERS)
def test_nothing_is_compiled_for_numbers_of_surfaces(name: str) -> None:
    what, settings = NUMBERS[name]
    session = Session(LiveScene.of(what, {**settings, "a": hk.Slider(0.1, 0.5)}))
    questions = [{"sliders": {"a": one}} for one in (0.1, 0.23, 0.5)]
    assert compiled(session, questions) == set()


def test_the_tube_follows_the_curve() -> None:
    live = LiveScene.of(hk.SolidAngle(LOOP), {"boundary_radius": 0.05, "level": 6.0}, edits=True)
    session = Session(live)
    moved = LOOP.copy()
    moved[0] *= 1.5
    assert compiled(session, [{"loops": [moved.tolist()]}]) == set()
    _, tube = live.surfaces_at(session.controls({"loops": [moved.tolist()]}))
    assert abs(float(tube.surface.field.value(moved[0]))) < 0.06
    _, before = live.surfaces_at(live.initial_controls)
    assert float(before.surface.field.value(moved[0])) > 0.2


def test_material_and_tube_are_changed_and_saved() -> None:
    live = LiveScene.of(hk.SolidAngle(LOOP), {"level": 6.0, "material": "clay"}, edits=True)
    session, scene = Session(live), live.scene("T")
    assert (scene["material"], scene["tube"]) == ("clay", None)
    assert "gold" in scene["materials"]
    assert "glass" not in scene["materials"]
    change = session.answer({"kind": "change", "settings": {"material": "#4682b4"}})
    (surface,) = change["surfaces"]
    assert "code" not in surface
    assert surface["paints"][0]["front"][2] > 2 * surface["paints"][0]["front"][0]
    settings = {"material": "copper", "boundary_radius": 0.05}
    controls = session.controls({"settings": settings})
    surface, tube = live.surfaces_at(controls)
    assert abs(float(tube.surface.field.value(LOOP[0]))) < 0.06
    (one,) = live.surfaces_at(session.controls({"settings": {"boundary_radius": None}}))
    assert one.material != surface.material
    saved = session.answer({"kind": "save", "camera": POSE, "settings": settings})
    opened = session.answer({"kind": "load", "text": saved["text"]})
    assert (opened["material"], opened["tube"]) == ("copper", 0.05)
    assert len(opened["state"]["surfaces"]) == 2


def test_a_probe_of_a_triangle_says_no_derivatives() -> None:
    vertices, faces = icosphere(1)
    session = Session(LiveScene.of(hk.WindingNumber(vertices, faces[5:]), {}))
    middle = vertices[faces[20]].mean(axis=0)
    ray = {"origin": (3 * middle).tolist(), "direction": (-middle).tolist()}
    found = session.answer({"kind": "probe", **ray})
    assert found["triangle"] == 15
    assert not {"value", "mean", "gaussian"} & set(found)


def test_a_probe_says_the_value_next_to_the_level(live: LiveScene) -> None:
    found = Session(live).answer(
        {"kind": "probe", "origin": [0.3, 0.2, 6.0], "direction": [0, 0, -1]}
    )
    assert found["value"] == pytest.approx(6.0, abs=0.01)


def test_nothing_leaves_the_picture_when_a_slider_is_moved() -> None:
    """The farthest places of a ball that moves and grows stay within the picture of 4 : 3."""
    z, r = hk.Slider(-1.0, 3.0, 0.0), hk.Slider(0.2, 0.7, 0.5)
    live = LiveScene.of(lambda z, r: hk.Sphere(r).translated((0, 0, z)), {"z": z, "r": r})
    assert outermost(live, hk.Ball((0, 0, 3.0), 0.7)) > 1
    framed = live.framed(extreme_slider_values(live.content.sliders))
    for center in (-1.0, 0.0, 3.0):
        assert outermost(framed, hk.Ball((0, 0, center), 0.7)) < 0.95
    # What stands on the ground is all of it, in still pictures and in scene files too.
    assert framed.placement.apply([[0, 0, -1.7]])[0, 2] == pytest.approx(0.0, abs=0.01)
    camera = hk.Camera(position=(0, -5, 1), target=(0, 0, 0), fov=30)
    saved = json.loads(framed.to_scene_text(framed.initial_controls, camera=camera)[0])
    assert saved["settings"]["camera"]["box"]["Box"]["upper"][2] == pytest.approx(3.7, abs=0.01)


def outermost(live: LiveScene, ball: hk.Ball) -> float:
    """How far a ball is from the middle of the picture, where 1 is its edge."""
    points = np.random.default_rng(0).normal(size=(999, 3))
    points = ball.center + ball.radius * points / np.linalg.norm(points, axis=1, keepdims=True)
    pose = live.pose
    back = np.subtract(pose["position"], pose["target"])
    back = back / np.linalg.norm(back)
    right = np.cross((0, 0, 1), back)
    right = right / np.linalg.norm(right)
    away = points - pose["position"]
    depth = -(away @ back) * np.tan(np.radians(pose["fov"] / 2))
    across = [np.abs(away @ right), np.abs(away @ np.cross(back, right)) / 0.75]
    return float((np.array(across) / depth).max())


def test_a_place_at_which_nothing_can_be_drawn_is_named() -> None:
    def torus(r: float) -> hk.Field:
        return hk.Torus(1.0, r) if r < 0.35 else hk.solids.Plane((0, 0, 1))

    live = LiveScene.of(torus, {"r": hk.Slider(0.2, 0.4, 0.3)})
    live = live.framed(extreme_slider_values(live.content.sliders))
    with pytest.raises(ValueError, match=r"at the place r=0\.4 .*reaches to infinity"):
        Session(live).answer({"kind": "change", "sliders": {"r": 0.4}})
    with pytest.raises(ValueError, match=r"at the place r=0\.38 .*reaches to infinity"):
        LiveScene.of(torus, {"r": hk.Slider(0.2, 0.4, 0.38)})


def test_a_thickness_that_fails_says_at_which_place(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, thickness: float, **__: Any) -> Any:
        if thickness > 0.2:
            raise LocalizedMeshingError("sheets meet", np.zeros((1, 3)))
        return trimesh.creation.icosphere(1)

    monkeypatch.setattr(hk.meshing, "mesh", fail)
    live = LiveScene.of(FIELD, {"level": 6.0, "thickness": hk.Slider(0.1, 0.3, 0.1)})
    asked = {"kind": "change", "sliders": {"thickness": 0.3}}
    wrong = r"at the place thickness=0\.3 .*thickness=0\.3: sheets meet; give another thickness"
    with pytest.raises(ValueError, match=wrong):
        Session(live).answer(asked)
    with pytest.raises(ValueError, match=r"at the place t=0\.4 .*give another thickness"):
        LiveScene.of(FIELD, {"level": 6.0, "thickness": lambda t: t, "t": hk.Slider(0.1, 0.7)})


def test_more_colors_than_are_drawn_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    live = LiveScene.of([hk.Sphere(1.0), hk.Sphere(0.5)], {})
    assert len(live.initial_state["surfaces"]) == 2
    monkeypatch.setattr(live_scene, "_MOST_PAINTS", 5)
    with pytest.raises(ValueError, match="have 6 colors"):
        live.state(live.initial_controls)


def test_what_is_sent_is_what_has_changed(live: LiveScene) -> None:
    moved = Session(live).controls({"sliders": {"level": 3.0}, "loops": [(1.1 * LOOP).tolist()]})
    state, first = live.state(moved), live.initial_state
    change = state_delta(first, state)
    ((new,), (old,), (own,)) = (one["surfaces"] for one in (state, first, change))
    data = old["data"].copy()
    data[own["at"]] = own["to"]
    assert np.array_equal(data, new["data"])
    assert 0 < len(own["at"]) < 0.7 * len(data)
    assert "code" not in own
    assert change["curves"] == state["curves"]
    longer = live.state(
        Session(live).controls({"loops": [example_curves.torus_knot(2, 3, 99).tolist()]})
    )
    assert state_delta(first, longer) is longer


def test_nothing_is_compiled_by_python_either(live: LiveScene) -> None:
    session = Session(live)
    asked = {"kind": "draw", "size": (64, 48), "eye": EYE}
    session.answer({**asked, "loops": [LOOP.tolist()]})
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        for k in range(3):
            session.answer({**asked, "sliders": {"level": 2.0 + k}, "loops": [(LOOP + k).tolist()]})
        history = dr.kernel_history()
    kernels = [one for one in history if one["type"] == dr.KernelType.JIT]
    assert kernels
    assert all(one["cache_hit"] for one in kernels)


def test_a_drawn_picture_is_that_of_render(live: LiveScene) -> None:
    session = Session(live)
    size = (64, 48)
    asked = {"kind": "draw", "size": size, "eye": EYE, "show": "normal"}
    drawn = session.answer(asked).pixels
    assert drawn.shape == (48, 64, 4)
    assert 0.05 < (np.ptp(drawn[..., :3].astype(int), axis=2) > 8).mean() < 0.9
    again = session.answer({**asked, "sliders": {"level": 3.0}}).pixels
    assert (again != drawn).any()


def test_a_probe_says_what_is_there(live: LiveScene) -> None:
    asked = {"kind": "probe", "origin": [0.3, 0.2, 5], "direction": [0, 0, -1]}
    found = Session(live).answer(asked)
    hit = hk.trace(FIELD, [[0.3, 0.2, 5]], [[0, 0, -1]], level=6.0)
    assert found["status"] == "HIT"
    assert found["t"] == pytest.approx(float(hit.t[0]), abs=2e-3)
    assert np.allclose(found["position"], hit.position[0], atol=2e-3)
    assert (np.diff(found["steps"]) > 0).all()
    assert found["steps"][-1] < found["t"]
    bent = hk.curvature(FIELD, hit.position)
    assert found["mean"] == pytest.approx(float(bent.mean[0]), rel=0.05)
    missed = Session(live).answer({**asked, "direction": [0, 0, 1]})
    assert (missed["status"], "t" in missed) == ("MISS", False)


@pytest.mark.parametrize("cut", [{"ball": [0, 0, 0, 0.9]}, {"box": [-1, -1, -1, 1, 1, 0.1]},
                                 {"plane": [0, 0, 1, 0.05]}])  # fmt: skip
def test_a_cut_leaves_what_clip_leaves(cut: dict[str, Any], live: LiveScene) -> None:
    volumes = {
        "ball": hk.Ball(radius=0.9), "box": hk.Box((-1, -1, -1), (1, 1, 0.1)),
        "plane": hk.HalfSpace((0, 0, 1.0), 0.05),
    }  # fmt: skip
    (kind,) = cut
    session = Session(live)
    for x, y in np.random.default_rng(3).uniform(-1, 1, (5, 2)):
        asked = {"kind": "probe", "origin": [x, y, 5], "direction": [0, 0, -1], "cut": cut}
        found = session.answer(asked)
        hit = hk.trace(FIELD, [[x, y, 5]], [[0, 0, -1]], level=6.0, clip=volumes[kind])
        assert ("t" in found) == bool(hit.is_hit[0])
        if "t" in found:
            assert found["t"] == pytest.approx(float(hit.t[0]), abs=2e-3)


def test_what_is_saved_can_be_opened(live: LiveScene) -> None:
    session = Session(live)
    moved = (LOOP + 0.1).tolist()
    asked = {
        "kind": "save",
        "camera": POSE,
        "sliders": {"level": 4.0},
        "loops": [moved],
        "show": "depth",
    }
    saved = session.answer(asked)
    assert saved["lost"] == []
    scene = session.answer({"kind": "load", "text": saved["text"]})
    assert scene["show"] == "depth"
    assert scene["sliders"][0]["start"] == 4.0
    assert np.allclose(scene["state"]["curves"], [moved])
    eye = np.array(scene["camera"]["target"])
    assert np.isfinite(eye).all()
    asked |= {"loops": None, "sliders": {"level": 5.0}}
    for kind, numbers in (("ball", [0, 0, 0, 0.9]), ("plane", [0, 0, 1, 0.05])):
        cut = session.answer({**asked, "cut": {kind: numbers}})
        assert cut["lost"] == []
        scene = session.answer({"kind": "load", "text": cut["text"]})
        assert scene["sliders"][0]["start"] == 5.0
        (opened,) = session.live.surfaces_at(session.controls({"sliders": {"level": 7.0}}))
        assert opened.surface.level_values == (7.0,)
        is_ball = kind == "ball"
        assert (opened.surface.clip if is_ball else opened.surface.section) is not None
    solid = Session(LiveScene.of(hk.Sphere(1.0), {"level": hk.Slider(0.0, 0.5, 0.25)}, edits=True))
    saved = solid.answer({"kind": "save", "camera": POSE, "cut": {"plane": [1, 0, 0, 0.1]}})
    solid.answer({"kind": "load", "text": saved["text"]})
    (opened,) = solid.live.surfaces_at(solid.controls({"sliders": {"level": 0.5}}))
    assert opened.surface.solid_range == (-np.inf, 0.5)  # with a face, at the level of the slider
    text = '{"harnack": 1, "surfaces": [{"field": {"file": "/etc/hosts"}}]}'
    with pytest.raises(hk.live.SceneFileError, match="must not name files"):
        session.answer({"kind": "load", "text": text})


@pytest.mark.parametrize(
    ("question", "wrong"),
    [
        ({}, "kind must be one of"),
        ({"kind": "eval"}, "kind must be one of"),
        ({"kind": "change", "sliders": 3}, "numbers by name"),
        ({"kind": "change", "sliders": {"levle": 3}}, 'mean "level"'),
        ({"kind": "change", "sliders": {"level": 99}}, "from 1 to 12"),
        ({"kind": "change", "sliders": {"level": True}}, "from 1 to 12"),
        ({"kind": "change", "sliders": {"level": float("nan")}}, "from 1 to 12"),
        ({"kind": "change", "loops": []}, "a list of curves"),
        ({"kind": "change", "loops": [[[0, 0], [1, 1]]]}, "three finite numbers"),
        ({"kind": "change", "loops": [[[0, 0, "x"]]]}, "three finite numbers"),
        ({"kind": "change", "loops": [[[0, 0, 0]] * 30_000]}, "at most 20,000"),
        ({"kind": "change", "cut": {"ball": [0, 0, 0]}}, "4 finite numbers"),
        ({"kind": "change", "cut": {"cone": [0]}}, "one of ball, box, plane"),
        ({"kind": "change", "cut": {"ball": [0, 0, 0, -1]}}, "radius"),
        ({"kind": "change", "settings": 3}, "an object"),
        ({"kind": "change", "settings": {"materials": "gold"}}, 'mean "material"'),
        ({"kind": "change", "settings": {"material": ["gold"]}}, "a name or a color"),
        ({"kind": "change", "settings": {"material": "glod"}}, 'mean "gold"'),
        ({"kind": "change", "settings": {"material": "glass"}}, "not drawn transparent"),
        ({"kind": "change", "settings": {"boundary_radius": True}}, "a positive number"),
        ({"kind": "change", "settings": {"boundary_radius": float("nan")}}, "a positive number"),
        ({"kind": "change", "settings": {"boundary_radius": -1}}, "a positive number"),
        ({"kind": "probe"}, "origin"),
        ({"kind": "draw", "size": [99_999, 9]}, "at most 8192|each side"),
        ({"kind": "draw", "size": [64, 48]}, "eye must be"),
        ({"kind": "draw", "size": [64, 48], "show": "x", "eye": EYE}, "show is one of"),
        ({"kind": "draw", "size": [64, 48], "eye": {**EYE, "pixel": 0}}, "pixel must be"),
        ({"kind": "draw", "size": [True, True]}, "size must be"),
        ({"kind": "draw", "size": [64, 48], "eye": {**EYE, "pixel": 10**400}}, "pixel must be"),
        ({"kind": "picture", "size": [64, 48]}, "camera must be"),
        ({"kind": "picture", "size": [64, 48], "camera": {**POSE, "fov": -5}}, "camera: fov"),
        ({"kind": "picture", "size": [64, 48], "camera": POSE, "spp": True}, "spp must be"),
        ({"kind": "change", "loops": [[[10**400, 0, 0]] * 3]}, "three finite numbers"),
        ({"kind": "load"}, "text must be"),
    ],
)
def test_questions_that_make_no_sense(question: Any, wrong: str, live: LiveScene) -> None:
    with pytest.raises((RequestError, ValueError, TypeError), match=wrong):
        Session(live).answer(question)


def test_texts_that_are_no_questions(live: LiveScene) -> None:
    client = MessageHandler(live)
    for text in (
        "",
        "[]",
        "3",
        "{",
        "[" * 9999,
        '{"kind": "change"}',
        '{"id": -1}',
        '{"id": true}',
    ):
        with pytest.raises(RequestError):
            client.read(text)
    question = client.read('{"id": 1, "kind": "none"}')
    assert question is not None
    said = client.answer(question, lambda part: None)
    assert isinstance(said, dict)
    assert said["error"].startswith("RequestError: kind")


@pytest.mark.slow
def test_a_page_that_is_closed_at_once_writes_nothing(caplog: pytest.LogCaptureFixture) -> None:
    """Its connection is reset before the answer to its request is written."""
    with hk.view(hk.Sphere(1.0), open_browser=False, block=False) as view:
        port = int(view.address.rstrip("/").rpartition(":")[2])
        for _ in range(3):
            with socket.create_connection(("127.0.0.1", port)) as page:
                page.sendall(
                    f"GET /questions HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n"
                    "Connection: Upgrade\r\nSec-WebSocket-Key: aGFybmFja2hhcm5hY2s9PQ==\r\n"
                    "Sec-WebSocket-Version: 13\r\n\r\n".encode()
                )
                page.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            time.sleep(0.05)
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


def test_a_picture_can_be_called_off(live: LiveScene) -> None:
    client, said = MessageHandler(live), []
    text = json.dumps({"id": 7, "kind": "picture", "camera": POSE, "size": [64, 48]})
    question = client.read(text)
    assert question is not None
    assert client.read('{"kind": "cancel", "which": 7}') is None
    assert client.answer(question, said.append) == {"id": 7, "error": "stopped, as asked"}
    done = client.answer(question, said.append)
    assert isinstance(done, dict)
    assert done["answer"]["png"].startswith("iVBOR")
    client.is_gone = True
    assert "error" in client.answer(question, said.append)


def test_the_floor_hides_nothing_that_moves_below_it() -> None:
    """The floor stands where the surface did at first, and hid what a slider moved."""
    ball = LiveScene.of(
        lambda z: hk.Sphere(0.5).translated((0, 0, z)), {"z": hk.Slider(-1.0, 0.0, 0.0)}
    )
    session = Session(ball)
    eye = {**EYE, "origin": [0, -6, 0.8], "pixel": 0.02}
    asked = {"kind": "draw", "size": (64, 64), "eye": eye, "is_idle": True}
    parts: list[float] = []
    for z in (0.0, -1.0):
        drawn = session.answer({**asked, "sliders": {"z": z}}).pixels
        parts.append((np.ptp(drawn[..., :3].astype(int), axis=2) > 40).mean())
    assert parts[0] > 0.01
    assert parts[1] == pytest.approx(parts[0], rel=0.3)


def test_many_pictures_are_painted_with_cells() -> None:
    """Of a broken mesh, from the second on: and they show the same."""
    vertices, faces = torus_mesh(1.0, 0.4, 24, 12)
    broken = np.delete(faces, slice(None, None, 9), axis=0)
    session = Session(LiveScene.of(hk.WindingNumber(vertices, broken), {}))
    plain = Session(LiveScene.of(hk.WindingNumber(vertices, broken, cells=False), {}))
    asked = {"kind": "draw", "size": (64, 48), "eye": EYE}
    for has_cells in (False, True, True):
        pictures = [one.answer(asked).pixels[..., :3].astype(int) for one in (session, plain)]
        state = session._painted
        assert state is not None
        surface = state.drawn[0].surface
        assert bool(surface.field.cell_choice(surface.ray_count)) == has_cells
        assert (np.abs(pictures[0] - pictures[1]).max(axis=2) > 8).mean() < 5e-3
    assert np.ptp(pictures[0], axis=(0, 1)).max() > 50
    # Other controls begin anew.
    session.answer({**asked, "settings": {"material": "gold"}})
    assert session._painted is not state
