"""The bridge: newest value per browser, nothing for those who do not ask, loopback only."""

import asyncio
import json
import re
import socket
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from aiohttp import ClientSession, ClientWebSocketResponse, WSServerHandshakeError
from aiohttp.test_utils import TestServer

from gateway.telemetry import TOPICS
from tests.support.processes import free_base_port
from tests.visualiser.feeder import Feeder, running
from tests.visualiser.test_board import encoded
from visualiser import bridge as bridge_module
from visualiser.bridge import Bridge, ViewError, ViewOptions, run

PAGE = Path(bridge_module.__file__).parent / "page"
MODULES = sorted(path.name for path in PAGE.glob("*.js"))

Look = Callable[[Bridge, ClientSession, str], Awaitable[None]]


def state(seq: int, age_ms: float = 0.0) -> bytes:
    return encoded("state", time.monotonic_ns() - int(age_ms * 1e6), seq)


def with_bridge(look: Look) -> None:
    async def serve() -> None:
        bridge = Bridge()
        async with TestServer(bridge.application(), host="127.0.0.1") as server, ClientSession() as session:
            await look(bridge, session, str(server.make_url("/")))

    asyncio.run(serve())


@asynccontextmanager
async def browser(session: ClientSession, url: str) -> AsyncIterator[ClientWebSocketResponse]:
    async with session.ws_connect(f"{url}ws") as link:
        yield link


async def ask(link: ClientWebSocketResponse) -> dict[str, object]:
    await link.send_str("next")
    return json.loads(await link.receive_str(timeout=10.0))


def test_a_browser_gets_the_newest_sample_and_gets_it_once() -> None:
    async def look(bridge: Bridge, session: ClientSession, url: str) -> None:
        async with browser(session, url) as link:
            for seq in range(100):
                bridge.accept("state", state(seq))
            bridge.accept("scene", encoded("scene", time.monotonic_ns(), 5))
            first, second = await ask(link), await ask(link)
            assert first["topics"]["state"]["sample"]["seq"] == 99
            assert first["topics"]["scene"]["sample"]["lanes"][1]["name"] == "gate 2"
            assert second["topics"] == {}
            bridge.accept("state", state(100))
            third = await ask(link)
            assert {topic: news["sample"]["seq"] for topic, news in third["topics"].items()} == {"state": 100}

    with_bridge(look)


def test_a_request_waits_for_news() -> None:
    async def look(bridge: Bridge, session: ClientSession, url: str) -> None:
        async with browser(session, url) as link:
            await ask(link)
            asyncio.get_running_loop().call_later(0.05, bridge.accept, "state", state(1))
            assert (await ask(link))["topics"]["state"]["sample"]["seq"] == 1

    with_bridge(look)


def test_the_age_is_that_of_the_sample_when_the_frame_is_made() -> None:
    async def look(bridge: Bridge, session: ClientSession, url: str) -> None:
        async with browser(session, url) as link:
            bridge.accept("state", state(1, age_ms=300.0))
            await asyncio.sleep(0.2)
            assert 500.0 <= (await ask(link))["topics"]["state"]["age_ms"] < 5_000.0

    with_bridge(look)


def test_junk_is_counted_and_not_passed_on() -> None:
    async def look(bridge: Bridge, session: ClientSession, url: str) -> None:
        async with browser(session, url) as link:
            for payload in (b"", b"\xff\xff", b'{"t_ns": 1}', b"<html>"):
                bridge.accept("state", payload)
            assert await ask(link) == {"topics": {}, "rejected": 4}

    with_bridge(look)


def test_a_stalled_browser_holds_nobody_up_and_has_no_backlog() -> None:
    async def look(bridge: Bridge, session: ClientSession, url: str) -> None:
        async with browser(session, url) as stalled, browser(session, url) as other:
            for seq in range(2_000):
                bridge.accept("state", state(seq))
                if seq % 200 == 0:
                    assert (await ask(other))["topics"]["state"]["sample"]["seq"] == seq
            with pytest.raises(TimeoutError):
                await stalled.receive(timeout=0.05)
            assert (await ask(stalled))["topics"]["state"]["sample"]["seq"] == 1_999
            assert (await ask(stalled))["topics"] == {}

    with_bridge(look)


def test_a_browser_that_leaves_is_forgotten() -> None:
    async def look(bridge: Bridge, session: ClientSession, url: str) -> None:
        async with browser(session, url) as gone:
            await gone.send_str("next")
        async with browser(session, url) as stays:
            bridge.accept("state", state(1))
            assert (await ask(stays))["topics"]["state"]["sample"]["seq"] == 1
            assert len(bridge._wakes) == 1

    with_bridge(look)


def test_the_page_and_all_it_needs_are_served_without_leave_to_call_elsewhere() -> None:
    async def look(_: Bridge, session: ClientSession, url: str) -> None:
        for name in ("", "style.css", *MODULES, "vendor/three/three.module.js", "vendor/three/three.core.js", "vendor/uplot/uPlot.esm.js"):
            async with session.get(url + name) as answer:
                assert answer.status == 200, name
                assert answer.headers["Content-Security-Policy"] == "default-src 'self'"
                assert "javascript" in answer.content_type or not name.endswith(".js")
        async with session.get(f"{url}../bridge.py") as answer:
            assert answer.status == 404

    with_bridge(look)


def test_no_file_of_the_page_names_another_host() -> None:
    namespace = "http://www.w3.org/2000/svg"
    for path in PAGE.iterdir():
        if path.is_file():
            addresses = set(re.findall(r"\b(?:https?|wss?)://[^\s\"'`]+", path.read_text()))
            assert addresses <= {namespace, "ws://${location.host}/ws"}, path.name


@pytest.mark.parametrize("header", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Origin": "null"}])
def test_other_sites_cannot_read_through_the_browser_of_the_user(header: dict[str, str]) -> None:
    async def look(_: Bridge, session: ClientSession, url: str) -> None:
        async with session.get(url, headers=header) as answer:
            assert answer.status == 403
        with pytest.raises(WSServerHandshakeError):
            await session.ws_connect(f"{url}ws", headers=header)

    with_bridge(look)


def test_a_busy_port_is_one_clear_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ViewError) as caught:
            run(ViewOptions(port, free_base_port()), threading.Event())
    assert str(caught.value) == f"port {port} of the view cannot be used: Address already in use; choose another one"


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_a_port_out_of_range_is_one_clear_line(port: int) -> None:
    with pytest.raises(ViewError, match=f"port {port} of the view is outside 1 to 65535"):
        run(ViewOptions(port, free_base_port()), threading.Event())


def test_live_samples_reach_a_browser_and_the_view_ends_with_one_still_attached() -> None:
    base_port, port, stop = free_base_port(), free_base_port(), threading.Event()
    options = ViewOptions(port, base_port)

    async def look() -> None:
        seen: dict[str, dict[str, object]] = {}
        async with ClientSession() as session:
            while True:
                try:
                    link = await session.ws_connect(f"{options.url}ws")
                    break
                except OSError:
                    await asyncio.sleep(0.05)
            deadline = time.monotonic() + 20.0
            while len(seen) < len(TOPICS) and time.monotonic() < deadline:
                seen |= (await ask(link))["topics"]
            stop.set()
            assert (await link.receive(timeout=10.0)).data == 1001  # the bridge says that it goes away
        assert set(seen) == set(TOPICS)
        assert len(seen["plan"]["sample"]["x_m"]) == 31

    with running(threading.Thread(target=run, args=(options, stop)), stop), Feeder(base_port):
        asyncio.run(look())
    with socket.create_server(("127.0.0.1", port)):
        pass  # the port is free again
