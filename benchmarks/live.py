"""Live views: a vertex of a curve is dragged in a browser, on this machine's processors alone."""

from __future__ import annotations

from typing import Any

import numpy as np

import harnack as hk
from harnack.geometry import example_curves
from tests.live.browsers import Page, chromium

VERTICES, SIZE, SECONDS, EVENTS = 64, 512, 4.0, 60
# What makes the panel let Python draw, or not.
DRAWN_BY = {"the browser, SwiftShader": "", "Python, LLVM": "panel.let_python_draw('')"}
# Drags a vertex along a circle. The time of each event is recorded, and of each picture the time
# and the last event that it shows.
_DRAG = """async ([seconds, rate]) => {
  const target = panel.is_remote ? panel.remote_canvas : panel.drawing.canvas;
  const events = [], pictures = [];
  let whole = 0;
  const shows = (event) => { pictures.push([performance.now(), event]); };
  let sent = -1, there = -1, drawn = -1;
  const wrap = (object, name, around) => {
    const inner = object[name].bind(object);
    object[name] = (...given) => around(inner, given);
  };
  if (panel.is_remote) {
    wrap(panel, "fetch_picture", async (inner, given) => {
      const now = events.length - 1;
      const image = await inner(...given);
      drawn = now;
      return image;
    });
    wrap(panel, "show_image", (inner, given) => {
      inner(...given);
      shows(drawn);
      if (given[0].width >= panel.root.clientWidth && drawn === events.length - 1)
        whole ||= performance.now();
    });
  } else {
    wrap(panel.link, "change", async (inner, given) => {
      const now = events.length - 1;
      const state = await inner(...given);
      sent = now;
      return state;
    });
    wrap(panel.drawing, "set", async (inner, given) => {
      const now = sent;
      const wrong = await inner(...given);
      there = now;
      return wrong;
    });
    wrap(panel.drawing, "trace", async (inner, given) => {
      drawn = there;
      return await inner(...given);
    });
    wrap(panel.drawing, "present", (inner, given) => {
      inner(...given);
      shows(drawn);
      if (given[0] >= panel.drawing.canvas.width && drawn === events.length - 1)
        whole ||= performance.now();
    });
  }
  const [c, k] = [0, 0];
  const home = panel.curves[c][k];
  panel.editing = true;
  const box = target.getBoundingClientRect();
  const at = panel.camera().project(panel.to_stage(home), box.width, box.height);
  const fire = (kind, x, y) => target.dispatchEvent(new PointerEvent(kind, {
    clientX: box.left + x, clientY: box.top + y, button: 0, buttons: 1, pointerId: 1,
  }));
  target.setPointerCapture = () => {};
  fire("pointerdown", at.x, at.y);
  const start = performance.now();
  for (let n = 0; performance.now() - start < 1000 * seconds; n++) {
    const angle = 0.1 * n;
    events.push(performance.now());
    fire("pointermove", at.x + 25 * Math.sin(angle), at.y + 25 * (1 - Math.cos(angle)));
    await new Promise((done) => setTimeout(done, 1000 / rate));
  }
  const last = performance.now();
  whole = 0;
  fire("pointerup", at.x, at.y);
  while (!whole) await new Promise((done) => setTimeout(done, 5));
  return { events, pictures, last, whole };
}"""


def live() -> str:
    """A table of the two ways to draw."""
    lines = [
        f"A vertex of a trefoil of {VERTICES} vertices is dragged in Chromium, in a "
        "window of "
        f"{SIZE} x {SIZE} pixels, with {EVENTS} events a second. *Latency* is the time from an "
        "event to the first picture that shows it. The last "
        "column is the time from the last event to the first picture with a ray for every pixel. "
        "The panel measures who is quicker and lets it draw; no GPU takes part.\n",
        "| drawn by | pictures a second | median latency | 90 % of latencies | every pixel after |",
        "|---|---|---|---|---|",
    ]
    for name, choice in DRAWN_BY.items():
        rate, *times = measured(choice)
        lines.append(f"| {name} | {rate:.1f} | " + " | ".join(f"{t:.0f} ms" for t in times) + " |")
    return "## Live views\n\n" + "\n".join(lines) + "\n"


def measured(choice: str) -> tuple[float, float, float, float]:
    """Pictures a second while a vertex is dragged; of the latencies of events the median and the
    90 % quantile; and how long a whole picture takes when nothing moves any more; milliseconds.

    choice: what the panel does before, in JavaScript.
    """
    field = hk.SolidAngle(example_curves.torus_knot(2, 3, VERTICES))
    with (
        chromium() as browser,
        hk.view(field, level=6.0, open_browser=False, block=False) as view,
    ):
        page = Page(browser, view.address, (SIZE, SIZE), samples=1)
        page.rest()
        page.do(f"() => {{ {choice} }}")
        page.rest()
        page.do(_DRAG, [1.0, EVENTS])  # compiles what is left to be compiled
        page.rest()
        timings: dict[str, Any] = page.do(_DRAG, [SECONDS, EVENTS])
        page.close()
    events, pictures = np.array(timings["events"]), np.array(timings["pictures"])
    moving = (pictures[:, 0] >= events[0]) & (pictures[:, 0] <= timings["last"])
    shown = [pictures[pictures[:, 1] >= k, 0].min() - t for k, t in enumerate(events)]
    rate = float(moving.sum() / (timings["last"] - events[0]) * 1000)
    full_picture = float(timings["whole"] - timings["last"])
    return rate, float(np.median(shown)), float(np.quantile(shown, 0.9)), full_picture
