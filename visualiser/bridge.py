"""`xilgate view`: serves the page and passes telemetry on to browsers. Start reading at `run`.

A browser asks for a frame and gets, as soon as there is news, the newest sample of every topic that changed since its last
frame. What it does not ask for is never sent nor kept, so that a stalled browser costs nothing and catches up at once,
without a backlog of old samples in a socket.
"""

import asyncio
import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
from aiohttp import WSCloseCode, web
from aiohttp.typedefs import Handler

from dbc.errors import SetupFailure
from gateway.telemetry import DEFAULT_BASE_PORT, TOPICS, Sample, Subscriber, TlsSection
from visualiser.board import Board

DEFAULT_PORT = 8080
HOST = "127.0.0.1"

_PAGE = Path(__file__).parent / "page"
_FRAME_PERIOD_S = 0.02  # a browser draws 60 pictures per second at best
_SILENCE_S = 0.25  # without news an empty frame says that the bridge is alive
_STOP_POLL_S = 0.1
_HEADERS = {
    # A browser that would follow a link out of the machine is told not to.
    "Content-Security-Policy": "default-src 'self'",
    # Assets change with the installed version, at the same address.
    "Cache-Control": "no-cache",
    "X-Content-Type-Options": "nosniff",
}


class ViewError(SetupFailure):
    """The page cannot be served; one line that says why."""


@dataclass(frozen=True)
class ViewOptions:
    """Settings of the view.

    Args:
        port: TCP port of the page on the loopback interface.
        telemetry_base_port: first telemetry port of the processes to look at.
        tls: for a rig that is another machine; None for this one.
    """

    port: int = DEFAULT_PORT
    telemetry_base_port: int = DEFAULT_BASE_PORT
    tls: TlsSection | None = None

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.port}/"


class TopicNews(msgspec.Struct, frozen=True):
    """A sample and its age when the frame was made [ms]."""

    age_ms: float
    sample: Sample


class Frame(msgspec.Struct, frozen=True):
    """What a browser gets for one request.

    Args:
        topics: newest sample of every topic with news for this browser.
        rejected: payloads so far that were no samples.
    """

    topics: dict[str, TopicNews]
    rejected: int


class Bridge:
    """The board, the browsers that look at it, and the web application between them. All of it lives on one event loop."""

    def __init__(self, is_clock_shared: bool = True) -> None:
        self._board = Board(is_clock_shared)
        self._wakes: set[asyncio.Event] = set()
        self._sockets: set[web.WebSocketResponse] = set()
        self._encoder = msgspec.json.Encoder()

    def application(self) -> web.Application:
        """The web application: the page at `/`, telemetry at `/ws`."""
        application = web.Application(middlewares=[_loopback_only])
        application.router.add_get("/", _index)
        application.router.add_get("/ws", self._serve_browser)
        application.router.add_static("/", _PAGE)
        application.on_response_prepare.append(_add_headers)
        application.on_shutdown.append(self._close_sockets)
        return application

    def accept(self, topic: str, payload: bytes) -> None:
        """Take a payload and wake the browsers that wait for news."""
        if self._board.accept(topic, payload, time.monotonic_ns()):
            for wake in self._wakes:
                wake.set()

    async def _serve_browser(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(timeout=0.5, max_msg_size=1024)
        await socket.prepare(request)
        wake = asyncio.Event()
        wake.set()
        self._wakes.add(wake)
        self._sockets.add(socket)
        seen: dict[str, int] = {}
        try:
            async for _ in socket:
                await _wait(wake, _SILENCE_S)
                wake.clear()
                await socket.send_str(self._encoder.encode(self._news(seen)).decode())
                await asyncio.sleep(_FRAME_PERIOD_S)
        except ConnectionError:
            pass  # the browser left between its request and our answer
        finally:
            self._wakes.discard(wake)
            self._sockets.discard(socket)
        return socket

    def _news(self, seen: dict[str, int]) -> Frame:
        now_ns = time.monotonic_ns()
        topics = {}
        for topic, received in self._board.newest.items():
            if seen.get(topic) != received.number:
                seen[topic] = received.number
                topics[topic] = TopicNews(self._board.age_ms(topic, now_ns), received.sample)
        return Frame(topics, self._board.rejected)

    async def _close_sockets(self, _: web.Application) -> None:
        for socket in list(self._sockets):
            await socket.close(code=WSCloseCode.GOING_AWAY)


async def _wait(event: asyncio.Event, timeout_s: float) -> None:
    try:
        async with asyncio.timeout(timeout_s):
            await event.wait()
    except TimeoutError:
        return


@web.middleware
async def _loopback_only(request: web.Request, handler: Handler) -> web.StreamResponse:
    # Any page of any site may address 127.0.0.1: answer to our own page only.
    is_own_page = request.headers.get("Origin", f"http://{request.host}") == f"http://{request.host}"
    if request.url.host not in (HOST, "localhost") or not is_own_page:
        raise web.HTTPForbidden(text="this view serves its own page on the loopback interface only")
    return await handler(request)


async def _index(_: web.Request) -> web.FileResponse:
    return web.FileResponse(_PAGE / "index.html")


async def _add_headers(_: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)


async def _listen(runner: web.AppRunner, port: int) -> None:
    if not 1 <= port <= 65535:
        raise ViewError(f"port {port} of the view is outside 1 to 65535")
    try:
        await web.TCPSite(runner, HOST, port).start()
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise ViewError(f"port {port} of the view cannot be used: {reason}; choose another one") from error


async def _serve(options: ViewOptions, stop: threading.Event) -> None:
    bridge = Bridge(is_clock_shared=options.tls is None)
    runner = web.AppRunner(bridge.application(), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    loop = asyncio.get_running_loop()

    def on_sample(topic: str, payload: bytes) -> None:
        loop.call_soon_threadsafe(bridge.accept, topic, payload)

    try:
        await _listen(runner, options.port)
        with Subscriber(on_sample, list(TOPICS), options.telemetry_base_port, options.tls):
            while not stop.is_set():
                await asyncio.sleep(_STOP_POLL_S)
    finally:
        await runner.cleanup()


def run(options: ViewOptions, stop: threading.Event) -> None:
    """Serve the page until `stop` is set.

    Raises:
        ViewError: the port cannot be used.
    """
    asyncio.run(_serve(options, stop))
