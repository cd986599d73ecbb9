"""The live view as a notebook widget, by the package anywidget. The widget sends a page into the
notebook. When a person changes something there, the page sends a question, and the widget answers
it."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, cast

import anywidget
import traitlets

from harnack.live.live_scene import LIVE_MODES
from harnack.live.page_file import MODULES, passes, resource, script, still_png
from harnack.live.server import check_height
from harnack.live.session import MessageHandler, RequestError, parse_camera

if TYPE_CHECKING:
    from harnack.live.live_scene import JsonDict, LiveScene

__all__ = ["Widget"]

_RENDER = "\nexport default { render: ({ model, el }) => renderWidget(Panel, model, el) };\n"


class Widget(anywidget.AnyWidget):
    """A live surface in a notebook. Its attributes change when a person moves something, and
    setting an attribute moves it in the picture.

        view = hk.view(field, level=hk.Slider(1, 12))
        view.observe(lambda change: print(change.new["level"]), names="sliders")
        view.sliders = {"level": 6.0}

    camera: {"position": (3,), "target": (3,), "fov": degrees} in the surfaces' coordinates, of a
        picture of 4 : 3.
    sliders: values by name.
    points: the boundary curves, a list of points (n, 3) for each loop. The points of a `SolidAngle`
        can be moved.
    show: one of "shaded", "normal", "depth", "evaluations" and "status".
    height: of the widget, in pixels.

    Raises traitlets.TraitError for values that make no sense.
    """

    _esm = script(*MODULES) + _RENDER
    _css = resource("panel.css")
    camera: Any = traitlets.Dict().tag(sync=True)
    sliders: Any = traitlets.Dict().tag(sync=True)
    points: Any = cast("Any", traitlets.List)().tag(sync=True)
    show: Any = traitlets.Enum(LIVE_MODES).tag(sync=True)
    height: Any = traitlets.Int(480).tag(sync=True)
    _scene: Any = traitlets.Dict().tag(sync=True)
    _passes: Any = traitlets.Unicode().tag(sync=True)
    _still: Any = traitlets.Unicode().tag(sync=True)

    def __init__(self, live: LiveScene, title: str, height: int) -> None:
        self._client = MessageHandler(live)
        # Beside the notebook's own thread, so that a picture can be called off.
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="harnack-widget")
        scene = live.scene(title)
        super().__init__(
            _scene=scene, _passes=passes(), height=height, show=live.show,
            _still=f"data:image/png;base64,{still_png(live)}", points=scene["state"]["curves"],
            sliders=dict(live.initial_controls.values), camera=live.pose,
        )  # fmt: skip
        self.on_msg(self._receive)

    def close(self) -> None:
        """Stop answering, and remove the widget from the page."""
        self._client.is_gone = True
        self._worker.shutdown(wait=False, cancel_futures=True)
        super().close()

    def _receive(self, _: Any, text: Any, __: Any) -> None:
        """Read a message of the browser, and have its question answered in the worker thread. The
        first and third argument, the widget and buffers, are not used."""
        if self._client.is_gone:  # closed, while the message was on its way
            return
        try:
            question = self._client.read(str(text))
        except RequestError as wrong:
            self._send_answer({"id": None, "error": str(wrong)})
            return
        if question is not None:
            self._worker.submit(self._answer, question)

    def _answer(self, question: JsonDict) -> None:
        """Answer a question, and send the answer. A picture is sent as a buffer of bytes."""
        answer = self._client.answer(question, self._send_answer)
        if isinstance(answer, bytes):
            self.send({"id": question["id"]}, buffers=[answer])
        else:
            self._send_answer(answer)

    def _send_answer(self, answer: JsonDict) -> None:
        """Send JSON data to the browser."""
        self.send(answer)

    @traitlets.validate("height")
    def _checked_height(self, proposal: Any) -> int:
        """Return the proposed height, if it is valid; otherwise raise `TraitError`."""
        try:
            return check_height(proposal["value"])
        except ValueError as wrong:
            raise traitlets.TraitError(str(wrong)) from None

    @traitlets.validate("sliders", "points", "camera")
    def _checked(self, proposal: Any) -> Any:
        """Return the proposed value of `sliders`, `points` or `camera` as plain Python numbers, if
        it is valid; otherwise raise `TraitError`."""
        name, value = proposal["trait"].name, proposal["value"]
        session = self._client.session
        try:
            # Through JSON, NumPy's arrays and numbers become plain lists and numbers.
            value = json.loads(json.dumps(value, default=_listed, allow_nan=False))
            if name == "camera":
                parse_camera(value)
            elif name == "sliders":
                value = dict(session.controls({"sliders": {**self.sliders, **value}}).values)
            elif session.live.editable:
                session.controls({"loops": value})
        except (RequestError, TypeError, ValueError, OverflowError) as wrong:
            raise traitlets.TraitError(f"{name}: {wrong}") from None
        return value


def _listed(value: Any) -> Any:
    """Return a NumPy array or number as Python lists and numbers; JSON's encoder calls this."""
    return value.tolist()
