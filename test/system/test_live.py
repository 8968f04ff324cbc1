"""`live`: what it sends, to whom, and what it does to a run; its page in a real browser."""

import asyncio
import os
import shutil
import signal
import subprocess
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from aiohttp import ClientSession, ClientWebSocketResponse
from bringup_processes import Session, bringup_sessions, wait_until
from live_pages import address_of, frames, listening_addresses
from ros_processes import ros_world
from waiting import DEADLINE_S

from backlash_ros.nodes.live import LIVE_LABELS

MODULE = 'live'


@pytest.fixture(scope='module')
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with bringup_sessions(tmp_path_factory.mktemp('live')) as start_session:
        session = start_session(
            '--config', 'two_axes.yaml', '--duration', 'inf', '--no-record', '--live',
            '--set', 'estimator.law=lms')
        address_of(session)
        session.wait_for_samples('pan')
        yield session


def test_alone_it_waits_for_a_controller_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        world.forked = False
        del world.environment['BACKLASH_ROS_EVENTS']
        live = world.start(MODULE, None, '/pan')
        wait_until(lambda: live.stdout.endswith('\n'), 'the address')
        state = next(frames(live.stdout.strip()))['state']
        assert f'of /pan in ROS_DOMAIN_ID={world.domain}' in state['awaited']
        port = live.stdout.strip().rpartition(':')[2]
        taken = world.start(MODULE, None, '--port', port)
        assert taken.wait() == 2
        assert taken.stderr.startswith(f'live: --port={port}: Address already in use')
        assert (len(taken.stderr.splitlines()), live.stop(), live.stderr) == (1, 0, '')


def test_a_page_shows_every_axis_to_this_machine_alone_and_a_run_goes_on_without_it(run):
    heard: dict[str, set[str]] = {}
    for frame in frames(address_of(run)):
        for curves in frame['curves']:
            for name, of_controller in curves.items():
                heard.setdefault(name, set()).update(of_controller)
        complete = [labels for labels in heard.values() if set(LIVE_LABELS) <= labels]
        if len(complete) == 2 and all(
            each['values'].get('rate [Hz]') for each in frame['state']['controllers']
        ):
            break
    assert set(heard) == {'/pan/controller', '/tilt/controller'}
    assert [each['name'] for each in frame['state']['controllers']] == sorted(heard)
    for state in frame['state']['controllers']:
        assert state['word']
        assert int(state['values']['samples']) > 0
        assert set(state['estimates']) == {'m', 'c_r', 'c_l'}
        assert state['events']
    assert listening_addresses(run.node('live')) == {'127.0.0.1'}
    with pytest.raises(HTTPError, match=r'only 127\.0\.0\.1 is served'):
        urlopen(Request(address_of(run), headers={'Host': 'elsewhere.example'}))
    os.kill(run.node('live'), signal.SIGKILL)
    said = 'live died (killed by SIGKILL), the run goes on without it'
    wait_until(lambda: said in run.stderr, said)
    lines = len(run.stderr.splitlines())
    wait_until(lambda: len(run.stderr.splitlines()) > lines, 'progress')
    run.process.send_signal(signal.SIGINT)
    assert run.wait() == 0, run.stderr
    assert (run.stderr.count(said), run.survivors()) == (1, {})


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


class Tab:
    """A page that is open. errors: what its script has failed with."""

    def __init__(self, socket: ClientWebSocketResponse) -> None:
        self._socket, self._calls = socket, 0
        self.errors: list[str] = []

    async def call(self, method: str, **parameters: object) -> dict[str, Any]:
        self._calls += 1
        await self._socket.send_json({'id': self._calls, 'method': method, 'params': parameters})
        while True:
            answer = await self._socket.receive_json()
            if answer.get('method') == 'Runtime.exceptionThrown':
                self.errors.append(str(answer['params']['exceptionDetails']))
            if answer.get('id') == self._calls:
                return dict(answer['result'])

    async def value(self, expression: str) -> Any:
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
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
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
            f"{MOVING}.map((id) => document.getElementById(id).toDataURL()); 0")
        await tab.wait_until("document.getElementById('samples').textContent !== before")
        for i, picture in enumerate(MOVING):
            await tab.wait_until(
                f"document.getElementById('{picture}').toDataURL() !== pictures[{i}]")
        await tab.wait_until(
            "slope = document.getElementById('slope'); empty = document.createElement('canvas'); "
            "[empty.width, empty.height] = [slope.width, slope.height]; "
            "slope.toDataURL() !== empty.toDataURL()")
        await tab.wait_until("document.getElementById('c_r_half').textContent.startsWith('± ')")
        m = await tab.value("document.getElementById('m').textContent")
        assert float(m) == pytest.approx(0.098, rel=0.1)
        assert await tab.value("document.getElementById('word').textContent.length > 3")
        assert (await tab.value("document.getElementById('rate').textContent")).endswith(' Hz')
        assert await tab.value('document.documentElement.scrollWidth <= innerWidth')
        session.process.send_signal(signal.SIGINT)
        await tab.wait_until("document.body.className === 'ended'")
        assert tab.errors == []


@pytest.mark.skipif(CHROMIUM is None, reason='Chromium is missing: apt-get install chromium')
def test_numbers_and_curves_move_until_ctrl_c(start, tmp_path):
    session = start(*WHOLE_RUN)
    asyncio.run(asyncio.wait_for(look(session, tmp_path / 'profile'), 2.0 * DEADLINE_S))
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert 'Traceback' not in session.stderr
    assert (session.out / 'logs' / 'live.log').read_text() == ''
