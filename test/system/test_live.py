"""`live` without a browser: what it sends, to whom, and what it does to a run."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from math import nan
from pathlib import Path

import pytest
from aiohttp import ClientSession, ClientTimeout
from bringup_processes import Session, bringup_sessions, wait_until
from live_pages import address_of, frames, listening_addresses
from ros_processes import ros_world

from backlash_ros.nodes.live.history import CurvePoints, History
from backlash_ros.nodes.live.node import LABELS
from backlash_ros.nodes.live.page_server import MOST_READERS, PageServer, bound_socket

LOOK_S = 0.02
MODULE = 'live.command'
BIG = 'x' * 200_000
DEADLINE = ClientTimeout(total=30.0)


@pytest.fixture(scope='module')
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    """A run of two axes without end, with its page."""
    with bringup_sessions(tmp_path_factory.mktemp('live')) as start_session:
        session = start_session(
            '--config', 'two_axes.yaml', '--duration', 'inf', '--no-record', '--live'
        )
        address_of(session)
        session.wait_for_samples('pan')
        yield session


def test_frames_hold_state_and_curves_of_every_axis_ten_times_a_second(run: Session) -> None:
    async def look() -> None:
        async with ClientSession(timeout=DEADLINE) as session, session.get(
            f'{address_of(run)}/events'
        ) as response:
            assert response.content_type == 'text/event-stream'
            heard: dict[str, set[str]] = {}
            sent_s: list[float] = []  # on the clock of the node
            async for frame in frames(response):
                sent_s.append(frame['now'])
                for portion in frame['portions']:
                    for name, curves in portion.items():
                        heard.setdefault(name, set()).update(curves)
                complete = [labels for labels in heard.values() if {*LABELS, 'loop'} <= labels]
                if len(complete) == 2 and len(sent_s) > 20:
                    break
            assert sorted(set(sent_s)) == sent_s
            # Fewer where the machine is held up, never more.
            assert len(sent_s) - 1 < 12.0 * (sent_s[-1] - sent_s[0])
            assert set(heard) == {'/pan/controller', '/tilt/controller'}
            assert [each['name'] for each in frame['controllers']] == sorted(heard)
            for state in frame['controllers']:
                assert state['word']
                assert int(state['counts']['samples']) > 0
                assert state['rate'] > 0.0
                assert set(state['estimates']) == {'m', 'c_r', 'c_l'}
                assert state['events']

    asyncio.run(look())


def test_who_comes_later_gets_the_curves_so_far(run: Session) -> None:
    async def first_frame() -> int:
        async with ClientSession(timeout=DEADLINE) as session, session.get(
            f'{address_of(run)}/events'
        ) as response:
            async for frame in frames(response):
                return len(frame['portions'])
        return 0

    wait_until(lambda: asyncio.run(first_frame()) > 10, 'a history')
    assert asyncio.run(first_frame()) > 10, 'it is there for every further page'


def test_nothing_listens_beyond_this_machine_nor_answers_to_another_name(run: Session) -> None:
    assert listening_addresses(run.node('live.command')) == {'127.0.0.1'}

    async def statuses() -> list[int]:
        async with ClientSession(timeout=DEADLINE) as session:
            found = []
            for host in ('127.0.0.1', 'elsewhere.example'):
                async with session.get(address_of(run), headers={'Host': host}) as response:
                    found.append(response.status)
            return found

    assert asyncio.run(statuses()) == [200, 403]


async def read_quickly(address: str, count: int) -> list[int]:
    """Numbers of the frames that a reader gets which takes them at once."""
    async with ClientSession(timeout=DEADLINE) as session, session.get(
        f'{address}/events', read_bufsize=2 ** 20
    ) as response:
        got: list[int] = []
        async for frame in frames(response):
            got.append(frame['number'])
            if len(got) == count:
                break
        return got


class ServedFrames:
    """Large frames with a number, made anew as fast as they are asked for."""

    def __init__(self) -> None:
        self.socket = bound_socket(0)
        self.address = f'http://127.0.0.1:{self.socket.getsockname()[1]}'
        self.number = 0
        self.made = 0
        self.server = PageServer(self.socket, self._frame)

    async def run(self) -> None:
        """Renew frames until cancelled."""
        await self.server.start()
        try:
            while True:
                self.number += 1
                await self.server.renew()
                await asyncio.sleep(0.002)
        finally:
            await self.server.stop()

    def _frame(self, known: int) -> tuple[str, int]:
        self.made += 1
        return f'{{"number":{self.number},"x":"{BIG}"}}', self.number


def test_a_reader_that_takes_nothing_holds_up_nobody_and_is_sent_no_more() -> None:
    async def look() -> None:
        served = ServedFrames()
        running = asyncio.create_task(served.run())
        await asyncio.sleep(LOOK_S)
        slow = socket.create_connection(served.socket.getsockname())
        try:
            slow.sendall(b'GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n')
            quick = await read_quickly(served.address, 100)
            assert quick == sorted(set(quick))
            made_for_slow = served.made - len(quick)
            # What the kernel takes on the way to it, and not one more for each that was made.
            assert made_for_slow < 60
            before, number = served.made, served.number
            while served.number < number + 100:
                await asyncio.sleep(LOOK_S)
            assert served.made <= before + 2
        finally:
            slow.close()
            running.cancel()
            started_s = time.monotonic()
            await asyncio.gather(running, return_exceptions=True)
            assert time.monotonic() - started_s < 2.0

    asyncio.run(look())


def test_no_more_readers_are_let_in_than_are_served() -> None:
    async def look() -> None:
        served = ServedFrames()
        running = asyncio.create_task(served.run())
        await asyncio.sleep(LOOK_S)
        async with ClientSession(timeout=DEADLINE) as session:
            address = f'{served.address}/events'
            streams = [await session.get(address) for _ in range(MOST_READERS)]
            async with session.get(address) as refused:
                assert refused.status == 503
            for stream in streams:
                assert stream.status == 200
                stream.close()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(look())


def test_a_history_keeps_the_newest_portions_for_whoever_is_slow() -> None:
    history = History(3)
    assert history.since(0) == []
    for value in range(5):
        history.add({'/c': {'v': [float(value)]}})
    newest = ['{"/c":{"v":[2.0]}}', '{"/c":{"v":[3.0]}}', '{"/c":{"v":[4.0]}}']
    assert history.since(0) == newest
    assert history.since(4) == newest[2:]
    assert history.since(history.end) == []


def test_v_and_the_u_after_it_make_a_point_whatever_is_missing() -> None:
    points = CurvePoints(0)
    assert points.take([('v', 10, 1.0), ('u_hat', 20, 0.1)])['loop'] == [1.0, 0.1]
    # The u of a v that is under way still, or was lost.
    assert 'loop' not in points.take([('u_hat', 30, 0.2)])
    assert 'loop' not in points.take([('v', 40, 3.0)])
    assert points.take([('v', 50, 4.0), ('u_hat', 60, nan)])['loop'] == [4.0, None]
    assert points.take([('m', 2_000_000_000, 0.098)]) == {'m': [2.0, 0.098]}


def test_alone_it_waits_for_a_controller_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        world.forked = False
        del world.environment['BACKLASH_ROS_EVENTS']
        live = world.start(MODULE, None, '/pan')
        wait_until(lambda: live.stdout.endswith('\n'), 'the address')

        async def awaited() -> str:
            async with ClientSession(timeout=DEADLINE) as session, session.get(
                f'{live.stdout.strip()}/events'
            ) as response:
                async for frame in frames(response):
                    return str(frame['awaited'])
            return ''

        assert f'of /pan in ROS_DOMAIN_ID={world.domain}' in asyncio.run(awaited())
        assert live.stop() == 0
        assert live.stderr == ''


def test_a_port_that_is_taken_or_none_is_one_line(
    tmp_path: Path, start: Callable[..., Session],
) -> None:
    with bound_socket(0) as taken, ros_world(tmp_path) as world:
        port = taken.getsockname()[1]
        session = start('--live-port', str(port))
        assert session.wait() == 2
        assert session.stderr.startswith(f'bringup: --live-port={port}: Address already in use')
        assert len(session.stderr.splitlines()) == 1
        live = world.start(MODULE, None, '--port', str(port))
        assert live.wait() == 2
        assert live.stderr.startswith(f'live: --port={port}: Address already in use')
        assert len(live.stderr.splitlines()) == 1
    session = start('--live-port', '70000')
    assert session.wait() == 2
    assert session.stderr.startswith('bringup: --live-port=70000: must be from 0')


def test_a_run_goes_on_when_its_page_dies(start: Callable[..., Session]) -> None:
    session = start('--duration', 'inf', '--no-record', '--live')
    session.wait_for_samples()
    os.kill(session.node('live.command'), signal.SIGKILL)
    said = 'live died (killed by SIGKILL), the run goes on without it'
    wait_until(lambda: said in session.stderr, said)
    lines = len(session.stderr.splitlines())
    wait_until(lambda: len(session.stderr.splitlines()) > lines, 'progress')
    session.process.send_signal(signal.SIGINT)
    assert session.wait() == 0, session.stderr
    assert session.stderr.count(said) == 1
    assert session.survivors() == {}
