"""A headless Chromium, told what to do by its DevTools protocol."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import tempfile
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from aiohttp import ClientSession, ClientWebSocketResponse

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
START_S = 30.0  # at most, on a machine under load
LOOK_S = 0.02
# Nothing that is not of this machine is asked for, or even looked up.
OPTIONS = (
    '--headless=new', '--remote-debugging-port=0', '--no-first-run', '--disable-gpu',
    '--disable-background-networking', '--disable-component-update', '--disable-sync',
    '--disable-dev-shm-usage', '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1',
)


def executable() -> str | None:
    """Where Chromium is, None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Tab:
    """A page that is open. errors: what its script has failed with."""

    def __init__(self, socket: ClientWebSocketResponse) -> None:
        self._socket = socket
        self._calls = 0
        self.errors: list[str] = []

    async def call(self, method: str, **parameters: object) -> Mapping[str, Any]:
        """Call a method of the protocol and return its result; raises RuntimeError."""
        self._calls += 1
        await self._socket.send_json(
            {'id': self._calls, 'method': method, 'params': parameters}
        )
        while True:
            answer = await self._socket.receive_json()
            if answer.get('method') == 'Runtime.exceptionThrown':
                self.errors.append(str(answer['params']['exceptionDetails']))
            if answer.get('id') == self._calls:
                if 'error' in answer:
                    raise RuntimeError(f'{method}: {answer["error"]["message"]}')
                result: Mapping[str, Any] = answer['result']
                return result

    async def value(self, expression: str) -> Any:
        """The value of an expression of JavaScript on the page."""
        answer = await self.call('Runtime.evaluate', expression=expression, returnByValue=True)
        return answer['result'].get('value')

    async def wait_until(self, expression: str, patience_s: float = START_S) -> None:
        """Return once the expression is true; raises TimeoutError."""
        async def look() -> None:
            while not await self.value(expression):
                await asyncio.sleep(LOOK_S)

        try:
            await asyncio.wait_for(look(), patience_s)
        except asyncio.TimeoutError:
            raise TimeoutError(f'not within {patience_s:g} s: {expression}') from None


class Browser:
    """A Chromium that runs."""

    def __init__(self, session: ClientSession, port: int) -> None:
        self._session, self._port = session, port

    @asynccontextmanager
    async def open(self, address: str) -> AsyncIterator[Tab]:
        """A page in a tab of its own, in front of the others, until the context is left."""
        control = f'http://127.0.0.1:{self._port}/json'
        async with self._session.put(f'{control}/new?{address}') as answer:
            target = await answer.json()
        # Pictures are larger than what is taken for reasonable.
        async with self._session.ws_connect(
            target['webSocketDebuggerUrl'], max_msg_size=0
        ) as socket:
            tab = Tab(socket)
            await tab.call('Runtime.enable')
            await tab.call('Page.bringToFront')
            yield tab
        async with self._session.get(f'{control}/close/{target["id"]}'):
            pass


@asynccontextmanager
async def chromium() -> AsyncIterator[Browser]:
    """A Chromium with a profile of its own, gone when the context is left."""
    program = executable()
    if program is None:
        raise RuntimeError('Chromium is not installed: apt-get install chromium')
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        # Its sandbox refuses to work for root.
        sandbox = ['--no-sandbox'] if os.geteuid() == 0 else []
        process = subprocess.Popen(
            [program, *OPTIONS, *sandbox, f'--user-data-dir={profile}', 'about:blank'],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        try:
            port = await asyncio.wait_for(_port_of(Path(profile)), START_S)
            async with ClientSession() as session:
                yield Browser(session, port)
        finally:
            process.terminate()
            process.wait()


async def _port_of(profile: Path) -> int:
    file = profile / 'DevToolsActivePort'
    while True:
        lines = file.read_text().split() if file.exists() else []
        if len(lines) > 1:
            return int(lines[0])
        await asyncio.sleep(LOOK_S)
