"""The page in a real browser, fed by real Zenoh publishers."""

import asyncio
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.support.processes import free_base_port
from tests.visualiser.browser import Page, find_chromium, open_page
from tests.visualiser.feeder import Feeder, running
from visualiser.bridge import ViewOptions, run

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def text_of(selector: str) -> str:
    return f"document.querySelector('{selector}')?.textContent"


async def _check_live(page: Page) -> None:
    await page.wait_for(f"{text_of('#mode')} === 'ENGAGED'")
    await page.wait_for("window.xilgate.stats.horizonPoints === 31")
    await page.wait_for("window.xilgate.stats.frames > 5")
    assert await page.evaluate("document.querySelector('#mode').dataset.mode") == "ENGAGED"
    assert await page.evaluate(text_of("#reason")) == "the operator has engaged"
    assert await page.evaluate(text_of("#scenario")) == "iso3888-1"
    assert 78.0 < float(await page.evaluate(text_of("#speed"))) < 81.0
    assert (await page.evaluate(text_of("#speed-reference"))).endswith(" km/h")
    assert (await page.evaluate(text_of("#age-state"))).endswith(" ms")
    assert 0.0 <= await page.evaluate("window.xilgate.stats.ageMs.state") < 500.0
    assert await page.evaluate("document.querySelector('#lost').hidden")
    assert await page.evaluate("document.querySelectorAll('.uplot canvas').length") == 4
    before = await page.evaluate("window.xilgate.stats.pose.x")
    await page.wait_for(f"window.xilgate.stats.pose.x !== {before}")


async def _check_bird(page: Page) -> None:
    await page.evaluate("document.querySelector('[data-view=bird]').click()")
    assert await page.evaluate("document.querySelector('[data-view=bird]').getAttribute('aria-pressed')") == "true"
    frames = await page.evaluate("window.xilgate.stats.frames")
    await page.wait_for(f"window.xilgate.stats.frames > {frames + 2}")


async def _check_lost(page: Page) -> None:
    await page.wait_for("!document.querySelector('#lost').hidden")
    await page.wait_for(f"{text_of('#mode')} === 'NO LINK'")
    assert await page.evaluate(text_of("#lost-title")) == "LINK LOST"
    assert await page.evaluate(text_of("#reason")) == "last known: ENGAGED"
    await page.wait_for("window.xilgate.stats.lost.length === 6")
    await page.wait_for("window.xilgate.stats.horizonPoints === 0")


async def _look(base_port: int, port: int, picture: Path) -> None:
    async with open_page(f"http://127.0.0.1:{port}/") as page:
        await page.wait_for(f"{text_of('#lost-title')} === 'WAITING FOR TELEMETRY'")
        with Feeder(base_port):
            await _check_live(page)
            await _check_bird(page)
            png = await page.screenshot(picture)
        await _check_lost(page)
    assert png.startswith(PNG_SIGNATURE)
    assert len(png) > 30_000  # an empty page has a few thousand bytes
    assert {urlsplit(url).hostname for url in page.requests} == {"127.0.0.1"}
    assert f"ws://127.0.0.1:{port}/ws" in page.requests
    assert page.errors == []


def test_the_page_shows_the_drive_and_says_when_the_link_is_lost(tmp_path: Path) -> None:
    find_chromium()
    base_port, port, stop = free_base_port(), free_base_port(), threading.Event()
    with running(threading.Thread(target=run, args=(ViewOptions(port, base_port), stop)), stop):
        asyncio.run(_look(base_port, port, tmp_path / "view.png"))


def test_without_a_browser_the_test_fails_in_ci_and_is_skipped_elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="apt install chromium"):
        find_chromium()
    monkeypatch.delenv("CI")
    with pytest.raises(pytest.skip.Exception, match="apt install chromium"):
        find_chromium()
