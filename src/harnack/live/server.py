"""`view`: a small web server on this machine. A page is what the browser shows; it asks Python for
all changes of the scene. A question is one request of a page, and a client is an open page."""

from __future__ import annotations

import asyncio
import secrets
import sys
import threading
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, cast

from harnack.backend.validation import as_integer_in_range, flag
from harnack.live.live_scene import LiveScene
from harnack.live.page_file import check_title, document, still_png
from harnack.live.scene_file import FieldSources, check_sources
from harnack.live.session import MessageHandler, RequestError
from harnack.live.sliders import extreme_slider_values
from harnack.optional_packages import import_optional
from harnack.rendering.option_table import shows_options

if TYPE_CHECKING:
    from typing import Self

    from aiohttp import web

    from harnack.live.live_scene import JsonDict
    from harnack.live.widget import Widget
    from harnack.tracer import TraceOptions

__all__ = ["LiveView", "check_height", "view"]

_LOCAL = ("127.0.0.1", "::1", "localhost")
# The longest message in bytes, and the most questions of a client that may wait.
_LONGEST = 4 * 2**20
_WAITING = 8


@dataclass(frozen=True)
class LiveView:
    """A page that is being served until `close` is called. address: the page's URL, to be opened in
    a browser."""

    address: str
    _loop: asyncio.AbstractEventLoop
    # Not its thread: one whose `join` was interrupted by Ctrl-C counts as ended in Python 3.11.
    _ended: threading.Event

    def close(self) -> None:
        """Stop serving the page. A computation that is running for the page stops when it next
        reports progress."""
        if not self._ended.is_set():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._ended.wait()

    def wait(self) -> None:
        """Wait until Ctrl-C is pressed, or until the view is closed elsewhere."""
        try:
            # Short waits, between which Ctrl-C is noticed.
            while not self._ended.wait(0.2):
                pass
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
        finally:
            self.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()

    def _repr_html_(self) -> str:
        """Return the page in a frame, as notebooks on this machine show it."""
        return f'<iframe src="{self.address}" style="width:100%;height:480px;border:0"></iframe>'


@shows_options("view")
def view(
    surfaces: Any,
    *,
    title: str = "",
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = True,
    block: bool | None = None,
    sources: FieldSources = (),
    height: int = 480,
    options: TraceOptions | None = None,
    **keywords: Any,
) -> LiveView | Widget:
    """Show surfaces live in the browser: a person can turn them, move sliders and drag their
    curves.

        hk.view(hk.SolidAngle(vertices))
        hk.view(lambda l, m: hk.SphericalHarmonic(int(l), int(min(l, m))), level=0.1,
                l=hk.Slider(1, 8, 5, step=1), m=hk.Slider(0, 8, 3, step=1))

    The visitor's browser traces all rays by the kernels that Dr.Jit recorded, as in a page of
    `page`. Python prepares what has changed and sends it. Moving a point or a slider compiles no
    kernel.

    In a notebook that has anywidget (`pip install harnack[notebook]`) the result is a live widget,
    whose `camera`, `sliders`, `points` and `show` are attributes with events. `port` or
    `open_browser=False` asks for the server in a notebook too.

    surfaces, title, options, keywords: as for `page`: a field, a `Surface`, a list of them or a
        function of sliders; the title; and options of `render` and of traces. The points of the
        curve of a `SolidAngle` can be moved, inserted (double click), removed (Delete) and
        smoothed, with undo and redo.
    host: the address to serve at. Any address but this machine's own is open to the network; then
        the page's URL has a token, and requests without the token are refused.
    port: the port to serve at; 0 for a free one. height: of a widget, in pixels. open_browser:
        whether to open a browser.
    block: whether to return only when Ctrl-C is pressed; by default True unless Python is used
        interactively.
    sources: pairs of a field and its entry in scene files, as in `SceneFile`, for fields of files
        and of the gallery. Scene files that are saved in the view need them.

    Raises the errors of `page`; ModuleNotFoundError without aiohttp (`pip install harnack[view]`);
    OSError for an address that cannot be served at.
    """
    port = as_integer_in_range(port, "port", minimum=0, maximum=65535)
    height = check_height(height)
    check_title(title)
    flag(open_browser, "open_browser")
    check_sources(sources)
    if block is not None:
        flag(block, "block")
    if not isinstance(cast("Any", host), str):
        raise TypeError(f'host must be an address, such as "127.0.0.1", not {host!r:.60}')
    settings = {**keywords, "options": options}
    live = LiveScene.of(surfaces, settings, edits=True, sources=sources)
    live = live.framed(extreme_slider_values(live.content.sliders))
    title = title or live.content.name
    # A notebook shows a widget, unless the caller asks for the server by its options.
    if open_browser and port == 0 and host == _LOCAL[0] and block is None and in_notebook():
        try:
            from harnack.live.widget import Widget
        except ImportError:
            print(
                "a view in this notebook itself needs anywidget: pip install 'harnack[notebook]'",
                file=sys.stderr,
            )
        else:
            return Widget(live, title, height)
    scene = live.scene(title)
    # A page that is open to the network is protected by a secret in its address.
    token = "" if host in _LOCAL else secrets.token_urlsafe(16)
    server = _PageServer(live, document(scene, still_png(live), link="server"), token)
    live_view = server.start(host, port)
    print(f"{scene['title']}: {live_view.address}", file=sys.stderr)
    if token:
        print("open to the network: whoever has this address can use it", file=sys.stderr)
    if open_browser:
        webbrowser.open(live_view.address)
    # A script would end at once, and the page with it.
    if block is None:
        block = not (hasattr(sys, "ps1") or "ipykernel" in sys.modules)
    if block:
        live_view.wait()
    return live_view


def check_height(height: Any) -> int:
    """Return the height of a widget in pixels, if it is a whole number from 16 to 10,000.

    Raises:
        ValueError: the height is not such a number.
    """
    return as_integer_in_range(height, "height", minimum=16, maximum=10_000)


def in_notebook() -> bool:
    """Return whether Python runs in a notebook, of Jupyter or marimo."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    marimo = sys.modules.get("marimo")
    return hasattr(shell, "kernel") or (marimo is not None and marimo.running_in_notebook())


class _PageServer:
    """The web server that sends a view's page, and answers the questions of its clients (the open
    pages). One worker thread computes all answers, one after the other.

    live: the scene.
    page: the HTML text.
    token: a secret that requests must have; "" for none.
    """

    def __init__(self, live: LiveScene, page: str, token: str) -> None:
        self.live, self.page, self.token = live, page, token
        # Dr.Jit works on all cores for one question at a time.
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="harnack-view")
        self.clients: set[MessageHandler] = set()

    def start(self, host: str, port: int) -> LiveView:
        """Serve the page in a new thread, and return the view.

        host, port: the address to serve at; port 0 for a free port.

        Raises:
            OSError: the address cannot be served at.
            ModuleNotFoundError: the package aiohttp is not installed.
        """
        web = import_optional(
            "aiohttp.web", "a view is served by the package aiohttp: pip install 'harnack[view]'"
        )
        loop = asyncio.new_event_loop()
        application = web.Application(client_max_size=_LONGEST)
        application.router.add_get("/", self._serve_page)
        application.router.add_get("/questions", self._serve_socket)
        application.router.add_get("/clients", self._serve_count)
        runner = web.AppRunner(application, handle_signals=False, shutdown_timeout=1.0)

        async def begin() -> int:
            """Open the port, and return its number."""
            await runner.setup()
            await web.TCPSite(runner, host, port).start()
            return int(runner.addresses[0][1])

        ended = threading.Event()

        def serve() -> None:
            """Run the event loop until the view is closed, and then end everything that waits for
            it."""
            # `runner` answers requests; `ended` tells the `LiveView` that nothing runs any more.
            asyncio.set_event_loop(loop)
            try:
                loop.run_forever()
                for client in self.clients:
                    client.is_gone = True
                loop.run_until_complete(runner.cleanup())
                self.worker.shutdown(wait=False, cancel_futures=True)
                loop.close()
            finally:
                ended.set()

        # In a thread of its own from the start: notebooks have a loop that runs in this one.
        threading.Thread(target=serve, name="harnack-view", daemon=True).start()
        try:
            bound_port = asyncio.run_coroutine_threadsafe(begin(), loop).result()
        except OSError as wrong:
            LiveView("", loop, ended).close()  # ends the thread
            raise OSError(f"a view cannot be served at {host}, port {port}: {wrong}") from None
        host_in_url = f"[{host}]" if ":" in host else host
        query = f"?token={self.token}" if self.token else ""
        return LiveView(f"http://{host_in_url}:{bound_port}/{query}", loop, ended)

    def _reason_to_refuse(self, request: web.Request) -> str:
        """Return the reason to refuse a request as text, or "" to answer it. With a token, the
        request must have it. Without a token, the request must come from this machine and from the
        server's own page, since web pages of other sites could send requests too."""
        # Without the port, and without the brackets of an IPv6 address.
        host_name = request.host.rsplit(":", 1)[0].strip("[]")
        if self.token:
            token = request.query.get("token", "")
            # The comparison takes the same time wherever the first difference is.
            is_right = secrets.compare_digest(token.encode("utf-8", "replace"), self.token.encode())
            return "" if is_right else "the token is wrong"
        if host_name not in _LOCAL:
            return "this view is for its own machine alone"
        origin = request.headers.get("Origin")
        if origin is not None and origin != f"http://{request.host}":
            return "this view answers its own page alone"
        return ""

    async def _serve_page(self, request: web.Request) -> web.Response:
        """Send the HTML text of the page."""
        from aiohttp import web

        wrong = self._reason_to_refuse(request)
        if wrong:
            return web.Response(status=403, text=wrong)
        return web.Response(
            text=self.page, content_type="text/html", headers={"Cache-Control": "no-store"}
        )

    async def _serve_count(self, request: web.Request) -> web.Response:
        """Send the number of open pages."""
        from aiohttp import web

        wrong = self._reason_to_refuse(request)
        if wrong:
            return web.Response(status=403, text=wrong)
        return web.json_response({"clients": len(self.clients)})

    async def _serve_socket(self, request: web.Request) -> web.StreamResponse:
        """Answer the questions of one open page until it is closed. Questions wait for the worker
        thread in tasks, at most `_WAITING` of them."""
        from aiohttp import WSMsgType, web

        wrong = self._reason_to_refuse(request)
        if wrong:
            return web.Response(status=403, text=wrong)
        socket = web.WebSocketResponse(max_msg_size=_LONGEST, heartbeat=30.0)
        try:
            await socket.prepare(request)
        except ConnectionError:  # the page was closed before it was answered
            return web.Response()
        # Each open page has its own session, and tasks for its questions.
        client, waiting = MessageHandler(self.live), set[asyncio.Task[None]]()
        self.clients.add(client)
        try:
            async for message in socket:
                if message.type != WSMsgType.TEXT:
                    continue
                try:
                    question = client.read(message.data)
                except RequestError as wrong:
                    await _send(socket, {"id": None, "error": str(wrong)})
                    continue
                if question is None:  # another question was cancelled
                    continue
                # Too many questions at once are refused, so that a page cannot fill the memory.
                if len(waiting) >= _WAITING:
                    problem = f"more than {_WAITING} questions at once"
                    await _send(socket, {"id": question["id"], "error": problem})
                    continue
                task = asyncio.ensure_future(self._answer(socket, client, question))
                waiting.add(task)
                task.add_done_callback(waiting.discard)
        finally:
            # The page was closed: its computations stop.
            client.is_gone = True
            for task in waiting:
                task.cancel()
            self.clients.discard(client)
        return socket

    async def _answer(
        self, socket: web.WebSocketResponse, client: MessageHandler, question: JsonDict
    ) -> None:
        """Compute the answer to a question in the worker thread, and send it. Progress is sent
        meanwhile."""
        loop = asyncio.get_running_loop()

        def send(part: JsonDict) -> None:
            asyncio.run_coroutine_threadsafe(_send(socket, part), loop)

        await _send(socket, await loop.run_in_executor(self.worker, client.answer, question, send))


async def _send(socket: web.WebSocketResponse, answer: JsonDict | bytes) -> None:
    """Send an answer, bytes or JSON data, unless the page has been closed."""
    if socket.closed:
        return
    with suppress(ConnectionError):  # it is being closed
        if isinstance(answer, bytes):
            await socket.send_bytes(answer)
        else:
            await socket.send_json(answer)
