"""A view in a real browser, with Python behind it: what each control does, and how it ends."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

import harnack as hk
from harnack.geometry import example_curves
from tests.live.browsers import Page, chromium, launched

pytestmark = pytest.mark.browser
SIZE = (320, 240)
LOOP = example_curves.torus_knot(2, 3, 15)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as one:
        yield one


@pytest.fixture(scope="module")
def view() -> Iterator[hk.live.LiveView]:
    level = hk.Slider(2.0, 11.0, 6.0)
    with hk.view(
        hk.SolidAngle(LOOP), level=level, title="T", camera=hk.Camera(zoom=1.5), open_browser=False,
        block=False,
    ) as one:  # fmt: skip
        yield one


@pytest.fixture
def page(browser: Any, view: hk.live.LiveView) -> Iterator[Page]:
    one = Page(browser, view.address, SIZE, samples=1)
    yield one
    one.close()


def change(one: np.ndarray, other: np.ndarray) -> float:
    """The part of pixels that differ by more than a little."""
    return float((np.abs(one.astype(int) - other.astype(int)).max(axis=2) > 12).mean())


def python_draws(page: Page) -> None:
    page.do("() => panel.isRemote || panel.useRemoteRenderer('')")
    page.rest()


def lowest(page: Page) -> int:
    """The point of the curve that is lowest in the window, which nothing hides."""
    return max(range(len(LOOP)), key=lambda k: screen_of(page, 0, k)[1])


def screen_of(page: Page, curve: int, number: int) -> tuple[float, float]:
    """Where a point of a curve is in the window."""
    x, y = page.do(
        "([c, k]) => { const point = panel.placement.toStage(panel.curveEditor.curves[c][k]);"
        " const p = panel.camera.project(point, innerWidth, innerHeight); return [p.x, p.y]; }",
        [curve, number],
    )
    return x, y


def test_drag_turns_and_keys_and_wheel_come_closer(page: Page) -> None:
    before = page.picture("view-before")
    page.drag((100, 100), (180, 120))
    turned = page.picture("view-turned")
    assert change(before, turned) > 0.05
    page.tab.mouse.wheel(0, -400)
    closer = page.picture()
    assert change(turned, closer) > 0.05
    page.tab.keyboard.press("ArrowLeft")
    assert change(closer, page.picture()) > 0.02
    page.press("Reset view")
    assert change(before, page.picture()) < 0.01


@pytest.mark.parametrize("drawn_by", ["browser", "python"])
def test_a_slider_moves_the_level(drawn_by: str, page: Page) -> None:
    if drawn_by == "python":
        python_draws(page)
    before = page.picture()
    page.set("level", 3.0)
    moved = page.picture(f"view-level-{drawn_by}")
    assert change(before, moved) > 0.02
    page.set("level", 6.0)
    assert change(before, page.picture()) < 0.01


@pytest.mark.parametrize("drawn_by", ["browser", "python"])
def test_colors_that_are_numbers_have_a_legend(drawn_by: str, page: Page) -> None:
    if drawn_by == "python":
        python_draws(page)
    legend = "panel.legend.firstChild?.getAttribute('aria-label') ?? ''"
    assert page.do(legend) == ""
    choose(page, "show", "depth")
    page.picture(f"view-depth-{drawn_by}")
    near, far = map(
        float, re.findall(r"from ([\d.]+), bright, to ([\d.]+), dark", page.do(legend))[0]
    )
    position = page.do("panel.attributes.camera.position")
    away = np.linalg.norm(np.array(position) - example_curves.torus_knot(2, 3, 200), axis=1)
    assert 0.7 * away.min() < near < away.min() * 1.1  # in the unit of the surface
    assert near < far < 1.3 * away.max()
    choose(page, "show", "evaluations")
    page.picture(f"view-evaluations-{drawn_by}")
    assert "from 0, dark, to 64+, bright" in page.do(legend)
    choose(page, "show", "shaded")
    assert page.do(legend) == ""


@pytest.mark.parametrize("drawn_by", ["browser", "python"])
def test_material_and_tube_are_changed(drawn_by: str, page: Page) -> None:
    if drawn_by == "python":
        python_draws(page)
    before = page.picture()
    choose(page, "material", "gold")
    golden = page.picture(f"view-gold-{drawn_by}")
    assert change(before, golden) > 0.05
    choose(page, "material", "color")
    page.set("color", "#0000ff")
    page.set("tube", 0.06)
    assert page.do("() => panel.controlValues.settings") == {
        "material": "#0000ff",
        "boundary_radius": 0.06,
    }
    blue = page.picture(f"view-tube-{drawn_by}")
    assert change(golden, blue) > 0.05
    page.set("tube", 0)
    choose(page, "material", "as given")
    assert change(before, page.picture()) < 0.01
    assert page.message == ""


def choose(page: Page, name: str, value: str) -> None:
    """Chooses one of a list among the controls."""
    page.do(
        "([name, value]) => { const one = panel.controls.querySelector(`select[name=${name}]`);"
        " one.value = value; one.dispatchEvent(new Event('change')); }",
        [name, value],
    )


def test_points_are_dragged_inserted_removed_smoothed_and_that_undone(page: Page) -> None:
    before = page.picture()
    start = page.do("() => panel.curveEditor.curves")
    page.tick("Edit points")
    with_points = page.picture("view-points")
    assert change(before, with_points) > 0.002
    x, y = screen_of(page, 0, lowest(page))
    page.drag((x, y), (x + 40, y - 30))
    assert change(with_points, page.picture("view-dragged")) > 0.01
    moved = np.abs(np.array(page.do("() => panel.curveEditor.curves")) - start).max(axis=(0, 2))
    assert (moved > 1e-3).sum() == 1
    page.press("Undo")
    page.rest()
    assert page.do("() => panel.curveEditor.curves") == start
    page.press("Redo")
    page.rest()
    assert page.do("() => panel.curveEditor.curves") != start
    page.tab.keyboard.press("Control+z")
    (xa, ya), (xb, yb) = screen_of(page, 0, 5), screen_of(page, 0, 6)
    page.tab.mouse.dblclick(0.5 * (xa + xb), 0.5 * (ya + yb))
    page.rest()
    assert len(page.do("() => panel.curveEditor.curves")[0]) == len(LOOP) + 1
    page.do("() => panel.root.querySelector('canvas').focus()")
    page.tab.keyboard.press("Delete")
    page.rest()
    assert len(page.do("() => panel.curveEditor.curves")[0]) == len(LOOP)
    page.press("Smooth")
    page.rest()
    assert np.ptp(page.do("() => panel.curveEditor.curves")[0]) < np.ptp(start[0])
    assert page.message == ""


def test_a_probe_says_what_is_there_and_draws_the_proved_steps(page: Page) -> None:
    before = page.picture()
    page.tick("Probe by click")
    page.tab.mouse.click(150, 125)
    page.tab.wait_for_function("() => panel.message.textContent.includes('evaluations')")
    assert re.search(r"at \(.*\), normal \(.*\), f = .*mean curvature", page.message)
    assert change(before, page.picture("view-probe")) > 0


def test_a_cut_by_ball_box_and_plane(page: Page) -> None:
    whole = page.picture()
    for kind in ("ball", "box", "plane"):
        choose(page, "cut", kind)
        assert change(whole, page.picture(f"view-{kind}")) > 0.005, kind
    page.set("offset", 0.9)
    page.rest()
    assert page.do("() => panel.cutVolume.plane[3]") != 0


def test_a_scene_is_saved_and_opened_again(page: Page, tmp_path: Path) -> None:
    page.set("level", 4.0)
    page.rest()
    page.drag((100, 100), (160, 130))
    before = page.picture()
    with page.tab.expect_download() as waiting:
        page.do("() => { panel.saveScene(); }")
    path = tmp_path / "scene.json"
    waiting.value.save_as(path)
    saved = hk.read_scene(path)
    assert saved.sliders["level"].start == 4.0
    # The same picture by `render`.
    hk.render([*saved.surfaces], tmp_path / "a.png", size=SIZE, progress=False, **saved.settings)
    page.set("level", 9.0)
    page.press("Reset view")
    page.rest()
    page.tab.locator("input[name=scene]").set_input_files(path)
    page.tab.wait_for_function("() => panel.sliderValues.level === 4")
    # The floor, and what is seen of it, stands where the surface does at the saved level.
    opened = page.picture("view-opened")
    much = (np.abs(before.astype(int) - opened.astype(int)).max(axis=2) > 60).mean()
    assert much < 0.01
    path.write_text('{"harnack": 1, "surfaces": [{"field": {"Spere": {}}}]}')
    page.tab.locator("input[name=scene]").set_input_files(path)
    page.tab.wait_for_function("() => panel.message.textContent.includes('Sphere')")


def test_a_picture_is_rendered_and_called_off(page: Page) -> None:
    with page.tab.expect_download() as waiting:
        page.do("() => { panel.render(160, 'shaded'); }")
    assert Path(waiting.value.path()).read_bytes()[:4] == b"\x89PNG"
    page.do("() => { panel.render(2000, 'color'); }")
    page.tab.get_by_role("button", name="Cancel").click()
    page.tab.wait_for_function("() => panel.message.textContent.includes('stopped')")


def test_two_windows_and_a_hundred_connections(browser: Any, view: hk.live.LiveView) -> None:
    pages = [Page(browser, view.address, SIZE, samples=1) for _ in range(2)]
    pages[0].set("level", 3.0)
    pictures = [one.picture() for one in pages]
    assert change(*pictures) > 0.02  # each has its own
    script = """async () => {
      await panel.channel.request("change", {});
      for (let k = 0; k < 100; k++) {
        panel.channel.socket.close();
        await new Promise((done) => panel.channel.socket.addEventListener("close", done));
        await panel.channel.request("change", { sliders: { level: 2 + k / 20 } });
      }
    }"""
    pages[1].do(script)
    assert count(view) == 2
    for one in pages:
        one.close()
    end = time.monotonic() + 20
    while count(view) and time.monotonic() < end:
        time.sleep(0.1)
    assert count(view) == 0


def count(view: hk.live.LiveView) -> int:
    with urllib.request.urlopen(f"{view.address}clients") as answer:
        return int(json.load(answer)["clients"])


def test_messages_that_make_no_sense_are_answered_and_harm_nobody(page: Page) -> None:
    right = page.picture()
    answers = page.do("""async () => {
      const socket = new WebSocket(panel.channel.address);
      await new Promise((done) => { socket.onopen = done; });
      const answers = [];
      const wrong = ["", "[", "[]", "{}", '{"id": -1}', '{"id": 1e99, "kind": "draw"}',
        '{"id": 1, "kind": "\\u0000"}', '{"id": 2, "kind": "draw", "size": [1e9, 1e9]}',
        '{"id": 3, "kind": "change", "loops": [[[1e999, 0, 0]]]}', "[".repeat(100000)];
      for (const one of wrong) {
        const answer = new Promise((done) => { socket.onmessage = (e) => done(e.data); });
        socket.send(one);
        answers.push(JSON.parse(await answer).error);
      }
      socket.send(new Uint8Array(8));  // no question, and not answered
      const closed = new Promise((done) => { socket.onclose = (e) => done(e.code); });
      socket.send("x".repeat(5 * 2 ** 20));
      return [answers, await closed];
    }""")
    assert all(answers[0])
    assert answers[1] == 1009  # too long
    page.set("level", 6.0)
    assert change(right, page.picture()) < 0.01
    assert page.message == ""


def test_a_tab_that_is_closed_ends_its_work(browser: Any, view: hk.live.LiveView) -> None:
    page = Page(browser, view.address, SIZE, samples=1)
    page.do("() => { panel.fetchPicture(4000, 'color').catch(() => {}); }")
    page.tab.wait_for_function("() => panel.root.querySelector('progress')?.value > 0")
    page.close()
    page = Page(browser, view.address, SIZE, samples=1)
    page.tick("Probe by click")
    page.tab.mouse.click(150, 125)
    page.tab.wait_for_function(
        "() => panel.message.textContent.includes('evaluations')", timeout=20_000
    )
    page.close()


def test_without_webgpu_python_draws_and_the_page_says_so(
    browser: Any, view: hk.live.LiveView
) -> None:
    flags = ("--no-sandbox", "--disable-gpu", "--disable-features=WebGPU")
    with closing(launched(browser.browser_type, *flags)) as plain:
        page = Page(plain, view.address, SIZE, samples=1)
        page.rest()
        assert "Python draws" in page.message
        before = page.picture("view-python")
        page.drag((100, 100), (180, 120))
        assert change(before, page.picture()) > 0.05
        page.tick("Edit points")
        x, y = screen_of(page, 0, lowest(page))
        page.drag((x, y), (x + 40, y - 30))
        assert change(before, page.picture("view-python-dragged")) > 0.05
        page.close()


def test_a_device_that_lies_is_not_believed(browser: Any, view: hk.live.LiveView) -> None:
    """One factor in the shader is wrong by 1e-3. Where that is not noticed, it does nothing: as
    where a shorter proof than another one is a little shorter, or beside an edge that no ray meets.
    """
    page = Page(browser, view.address, SIZE, samples=1)
    right, refused = page.picture(), 0
    for place in np.arange(0.5, 24) / 24:
        wrong = page.do(
            """async (place) => {
              const state = structuredClone(panel.scene.state);
              const one = state.surfaces[0];
              const places = [...one.code.matchAll(/ = ([\\w]+) \\* ([\\w]+);/g)];
              const { index, 0: text, 1: a, 2: b } = places[Math.floor(place * places.length)];
              const lie = ` = 1.001f * ${a} * ${b};`;
              one.code = one.code.slice(0, index) + lie + one.code.slice(index + text.length);
              one.key = `lie ${place}`;
              return await panel.renderer.setState(state);
            }""",
            float(place),
        )
        refused += bool(wrong)
        if not wrong:
            page.do("() => panel.redraw()")
            assert change(right, page.picture()) < 0.003, place
    assert refused >= 2
    page.close()


def test_a_change_during_a_check_neither_accuses_the_device_nor_is_lost(page: Page) -> None:
    """The data that was checked was freed under the check."""
    page.rest()
    found = page.do("""async () => {
      const { renderer } = panel;
      const later = structuredClone(panel.scene.state);
      const wrong = await Promise.all([
        renderer.setState(panel.scene.state), renderer.setState(later, false),
      ]);
      return [...wrong, renderer.surfaces[0].source === later.surfaces[0]];
    }""")
    assert found == ["", "", True]


def test_others_are_not_answered(view: hk.live.LiveView) -> None:
    assert view.address.startswith("http://127.0.0.1:")
    for headers in ({"Host": "elsewhere.example"}, {"Origin": "http://elsewhere.example"}):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(view.address, headers=headers))
    field = hk.Sphere(1.0)
    with hk.view(field, host="0.0.0.0", open_browser=False, block=False) as public:
        token = public.address.split("token=")[1]
        address = public.address.replace("0.0.0.0", "127.0.0.1")
        assert urllib.request.urlopen(address).status == 200
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address.replace(token, "x"))
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address.replace(token, "%C3%A9"))  # no ASCII
    with pytest.raises(OSError, match="cannot be served at"):
        hk.view(field, host="203.0.113.1", open_browser=False, block=False)


def test_a_server_on_ipv6(browser: Any) -> None:
    try:
        with socket.socket(socket.AF_INET6) as one:
            one.bind(("::1", 0))
    except OSError:
        pytest.skip("this machine has no IPv6")
    with hk.view(hk.Sphere(1.0), host="::1", open_browser=False, block=False) as view:
        assert re.fullmatch(r"http://\[::1\]:\d+/", view.address)
        page = Page(browser, view.address, SIZE, samples=1)
        python_draws(page)  # by the socket
        assert np.ptp(page.picture("view-ipv6")) > 100
        assert page.message == ""
        page.close()
        elsewhere = urllib.request.Request(view.address, headers={"Host": "elsewhere.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(elsewhere)


@contextmanager
def served_by_command() -> Iterator[tuple[Any, str]]:
    """`harnack view`, and the address of its page."""
    command = [
        sys.executable, "-m", "harnack.cli", "view", "x^2+y^2+z^2=1", "--clip", "ball:0,0,0,2",
        "--no-browser",
    ]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ}) as one:
        try:
            line = one.stderr.readline() if one.stderr else ""
            address = re.search(r"http://\S+", line)
            assert address is not None, line
            yield one, address[0]
        finally:
            one.kill()


def assert_ended_cleanly(one: Any) -> None:
    one.send_signal(signal.SIGINT)
    _, said = one.communicate(timeout=20)
    assert one.returncode in (0, 130)
    assert "Traceback" not in said
    assert "stopped" in said


def test_ctrl_c_ends_it_cleanly() -> None:
    with served_by_command() as (one, address):
        assert urllib.request.urlopen(address).status == 200
        assert_ended_cleanly(one)


def test_ctrl_c_while_a_picture_is_rendered() -> None:
    async def begin(address: str) -> str:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{address}questions") as talk,
        ):
            camera = {"position": [0, -5, 1], "target": [0, 0, 0], "fov": 30}
            asked = {"id": 1, "kind": "picture", "size": [3000, 2000], "show": "path"}
            await talk.send_json({**asked, "camera": camera, "spp": 1000})
            while not json.loads(answer := (await talk.receive()).data).get("done"):
                assert "error" not in answer, answer
            assert_ended_cleanly(one)
            return answer

    # In a thread: Playwright's loop runs in this one.
    with served_by_command() as (one, address), ThreadPoolExecutor(1) as thread:
        assert '"done"' in thread.submit(asyncio.run, begin(address)).result()
