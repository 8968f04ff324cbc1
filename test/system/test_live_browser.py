"""The page of `bringup --live` in a real browser, told what to do by its DevTools protocol."""

import asyncio
import os
import shutil
import signal
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from aiohttp import ClientSession, ClientWebSocketResponse
from bringup_processes import Session
from live_pages import address_of
from waiting import DEADLINE_S

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
CHROMIUM = next((path for name in NAMES if (path := shutil.which(name))), None)
# Nothing that is not of this machine is asked for, or even looked up. Its sandbox refuses root.
OPTIONS = (
    '--headless=new', '--remote-debugging-port=0', '--no-first-run', '--disable-gpu',
    '--disable-background-networking', '--disable-component-update', '--disable-sync',
    '--disable-dev-shm-usage', '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1',
    *(['--no-sandbox'] if os.geteuid() == 0 else []),
)
MOVING = ['gap', 'output', 'loop', 'command']  # a slope that is known stays where it is
WHOLE_RUN = ('--config', 'geared_motor.yaml', '--duration', 'inf', '--no-record', '--live')

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason='Chromium is not installed: apt-get install chromium'
)


class Tab:
    """A page that is open. errors: what its script has failed with."""

    def __init__(self, socket: ClientWebSocketResponse) -> None:
        self._socket, self._calls = socket, 0
        self.errors: list[str] = []

    async def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """The result of a method of the protocol."""
        self._calls += 1
        await self._socket.send_json({'id': self._calls, 'method': method, 'params': parameters})
        while True:
            answer = await self._socket.receive_json()
            if answer.get('method') == 'Runtime.exceptionThrown':
                self.errors.append(str(answer['params']['exceptionDetails']))
            if answer.get('id') == self._calls:
                return dict(answer['result'])

    async def value(self, expression: str) -> Any:
        """The value of an expression of JavaScript on the page."""
        answer = await self.call('Runtime.evaluate', expression=expression, returnByValue=True)
        return answer['result'].get('value')

    async def wait_until(self, expression: str) -> None:
        while not await self.value(expression):
            await asyncio.sleep(0.02)


@asynccontextmanager
async def tab_of(address: str, profile: Path) -> AsyncIterator[Tab]:
    """The page in a Chromium with a profile of its own."""
    process = subprocess.Popen(
        [str(CHROMIUM), *OPTIONS, f'--user-data-dir={profile}', 'about:blank'],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    try:
        file = profile / 'DevToolsActivePort'
        while not (file.exists() and '\n' in file.read_text()):
            await asyncio.sleep(0.02)
        control = f'http://127.0.0.1:{file.read_text().split()[0]}/json/new?{address}'
        async with ClientSession() as session:
            async with session.put(control) as answer:
                target = await answer.json()
            # Pictures are larger than what is taken for reasonable.
            async with session.ws_connect(target['webSocketDebuggerUrl'], max_msg_size=0) as socket:
                tab = Tab(socket)
                await tab.call('Runtime.enable')
                await tab.call('Page.bringToFront')
                yield tab
    finally:
        process.terminate()
        process.wait()


async def look(session: Session, profile: Path) -> None:
    """See numbers and pictures move, what is learned, and the end."""
    async with tab_of(address_of(session), profile) as tab:
        await tab.wait_until("Number(document.getElementById('samples').textContent) > 0")
        await tab.value(
            "before = document.getElementById('samples').textContent; pictures = "
            f"{MOVING}.map((id) => document.getElementById(id).toDataURL()); 0"
        )
        await tab.wait_until("document.getElementById('samples').textContent !== before")
        for i, picture in enumerate(MOVING):
            await tab.wait_until(
                f"document.getElementById('{picture}').toDataURL() !== pictures[{i}]"
            )
        await tab.wait_until(
            "slope = document.getElementById('slope'); empty = document.createElement('canvas'); "
            "[empty.width, empty.height] = [slope.width, slope.height]; "
            "slope.toDataURL() !== empty.toDataURL()"
        )
        await tab.wait_until("document.getElementById('c_r_half').textContent.startsWith('± ')")
        m = await tab.value("document.getElementById('m').textContent")
        assert float(m) == pytest.approx(0.098, rel=0.1)
        assert await tab.value("document.getElementById('word').textContent.length > 3")
        assert (await tab.value("document.getElementById('rate').textContent")).endswith(' Hz')
        assert await tab.value('document.documentElement.scrollWidth <= innerWidth')
        session.process.send_signal(signal.SIGINT)
        await tab.wait_until("document.body.className === 'ended'")
        assert tab.errors == []


def test_numbers_and_curves_move_until_ctrl_c(start, tmp_path):
    session = start(*WHOLE_RUN)
    asyncio.run(asyncio.wait_for(look(session, tmp_path / 'profile'), 2.0 * DEADLINE_S))
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert 'Traceback' not in session.stderr
    assert (session.out / 'logs' / 'live.log').read_text() == ''
