"""The page of `bringup --live` in a real browser."""

import asyncio
import signal
from collections.abc import Callable

import pytest
from bringup_processes import Session
from browser import Browser, Tab, chromium, executable
from live_pages import address_of

pytestmark = pytest.mark.skipif(
    executable() is None, reason='Chromium is not installed: apt-get install chromium'
)

PICTURES = ['gap', 'output', 'loop', 'slope', 'command']
WHOLE_RUN = ('--config', 'geared_motor.yaml', '--duration', 'inf', '--no-record', '--live')


async def check_that_it_moves(tab: Tab) -> None:
    """Wait until the count of samples and every picture are others than now."""
    await tab.wait_until("Number(document.getElementById('samples').textContent) > 0")
    await tab.value(
        "before = document.getElementById('samples').textContent; pictures = "
        f"{PICTURES}.map((id) => document.getElementById(id).toDataURL()); 0"
    )
    await tab.wait_until("document.getElementById('samples').textContent !== before")
    for i, picture in enumerate(PICTURES):
        await tab.wait_until(
            f"document.getElementById('{picture}').toDataURL() !== pictures[{i}]"
        )
    assert tab.errors == []


async def check_numbers(tab: Tab) -> None:
    """What is learned stands there, with its deviation and the state in words."""
    await tab.wait_until("document.getElementById('c_r_half').textContent.startsWith('± ')")
    assert float(await tab.value("document.getElementById('m').textContent")) == pytest.approx(
        0.098, rel=0.1
    )
    assert await tab.value("document.getElementById('word').textContent.length > 3")
    assert (await tab.value("document.getElementById('rate').textContent")).endswith(' Hz')
    assert await tab.value('document.documentElement.scrollWidth <= innerWidth')


async def check_two_tabs(browser: Browser, address: str, first: Tab) -> None:
    """Both move when they are looked at, and the first one when the second is gone."""
    async with browser.open(address) as second:
        await check_that_it_moves(second)
        await first.call('Page.bringToFront')
        await check_that_it_moves(first)
    await check_that_it_moves(first)


def test_numbers_and_curves_move_in_every_tab_until_ctrl_c(start: Callable[..., Session]) -> None:
    session = start(*WHOLE_RUN)
    address = address_of(session)

    async def look() -> None:
        async with chromium() as browser, browser.open(address) as tab:
            await check_that_it_moves(tab)
            await check_numbers(tab)
            await check_two_tabs(browser, address, tab)
            session.process.send_signal(signal.SIGINT)
            await tab.wait_until("document.body.className === 'ended'")
            assert tab.errors == []

    asyncio.run(look())
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert 'Traceback' not in session.stderr
    assert (session.out / 'logs' / 'live.log').read_text() == ''
