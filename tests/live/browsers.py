"""Chromium without a screen, whose WebGPU is computed on the CPU, and what pages do in it."""

from __future__ import annotations

import functools
import http.server
import io
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

FLAGS = (
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan,WebGPU",
    "--use-vulkan=swiftshader", "--ignore-gpu-blocklist", "--force-color-profile=srgb",
)  # fmt: skip
# Milliseconds for a surface to be compiled, checked and drawn.
PATIENCE = 120_000


@contextmanager
def chromium(*flags: str) -> Iterator[Any]:
    """A browser; of the distribution where there is one, else Playwright's own."""
    sync = pytest.importorskip("playwright.sync_api")
    with sync.sync_playwright() as playwright:
        browser = launched(playwright.chromium, *(flags or FLAGS))
        yield browser
        browser.close()


def launched(kind: Any, *flags: str) -> Any:
    return kind.launch(executable_path=shutil.which("chromium"), args=[*flags])


class Page:
    """A tab in which nothing may ask for anything elsewhere, nor complain."""

    def __init__(
        self, browser: Any, address: str, size: tuple[int, int] = (480, 360), samples: int = 16,
        exposed: Mapping[str, Callable[..., Any]] | None = None,
    ) -> None:  # fmt: skip
        self.elsewhere: list[str] = []
        self.complaints: list[str] = []
        self.samples = samples
        self.tab = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.tab.set_default_timeout(PATIENCE)
        home = address.split("/?")[0].rstrip("/").rsplit("/", 1)[0]
        self.tab.route("**/*", lambda route: self._allow(route, home))
        self.tab.on("console", lambda one: self._hear(one.type, one.text))
        self.tab.on("pageerror", lambda one: self._hear("error", str(one)))
        for name, function in (exposed or {}).items():
            self.tab.expose_function(name, function)
        self.tab.goto(address)
        self.tab.wait_for_function("window.panel")
        # Nobody is chosen to draw by the speed of this machine.
        self.do("() => { Object.getPrototypeOf(panel).chooseRenderer = async () => {}; }")
        self.tab.wait_for_function(
            "panel.isRemote"
            " || (panel.root.dataset.state && !/^Compiling/.test(panel.message.textContent))"
        )

    def _allow(self, route: Any, home: str) -> None:
        if route.request.url.startswith((home, "data:", "blob:")):
            return route.continue_()
        self.elsewhere.append(route.request.url)
        return route.abort()

    def _hear(self, kind: str, text: str) -> None:
        # Chromium says so of devices that are none.
        known = ("fallback adapter", "No available adapters")
        if kind in ("error", "warning") and not any(one in text for one in known):
            self.complaints.append(text)

    def do(self, code: str, given: Any = None) -> Any:
        return self.tab.evaluate(code, given)

    @property
    def message(self) -> str:
        return self.do("panel.message.textContent")

    def rest(self) -> None:
        """Until what is asked for is drawn, all of it."""
        self.do("(n) => { if (panel.renderer) panel.renderer.samplesPerPixel = n; }", self.samples)
        self.tab.wait_for_function(
            "() => !panel.isUpdating && !panel.isUpdateDue && !panel.isFetching"
            " && !/^Compiling/.test(panel.message.textContent)"
            " && (!panel.renderer || (!panel.renderer.isBusy && panel.renderer.pictureCount > 0))"
        )
        # What was drawn is in the window two frames later.
        self.do("""async () => {
          await panel.renderer?.device.queue.onSubmittedWorkDone();
          for (let k = 0; k < 2; k++) await new Promise(requestAnimationFrame);
        }""")

    def picture(self, name: str = "") -> np.ndarray:
        """(h, w, 3) of what is drawn, without controls. name: of a file in `out/browser`."""
        self.rest()
        show = (
            "(shown) => { for (const one of [panel.controls, panel.message, panel.legend])"
            " one.style.visibility = shown; }"
        )
        self.do(show, "hidden")
        made = self.tab.screenshot()
        self.do(show, "")
        if name:
            folder = Path("out/browser")
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{name}.png").write_bytes(self.tab.screenshot())
        return np.asarray(Image.open(io.BytesIO(made)).convert("RGB"))

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 5) -> None:
        mouse = self.tab.mouse
        mouse.move(*start)
        mouse.down()
        mouse.move(*end, steps=steps)
        mouse.up()

    def press(self, name: str) -> None:
        """Presses a button among the controls."""
        self.do("() => { panel.controls.open = true; }")
        self.tab.get_by_role("button", name=name).click()
        self.do("() => { panel.controls.open = false; }")

    def tick(self, name: str) -> None:
        """Ticks a box among the controls."""
        self.do("() => { panel.controls.open = true; }")
        self.tab.get_by_label(name).check()
        self.do("() => { panel.controls.open = false; }")

    def set(self, name: str, value: float | str) -> None:
        """Moves a slider, or chooses a color."""
        self.do(
            "([name, value]) => { const one = panel.controls.querySelector(`input[name=${name}]`);"
            " one.value = value; one.dispatchEvent(new Event('input')); }",
            [name, value],
        )

    def close(self) -> None:
        self.tab.close()
        assert self.elsewhere == []
        assert self.complaints == []


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder on this machine."""
    quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    handler = functools.partial(quiet, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
