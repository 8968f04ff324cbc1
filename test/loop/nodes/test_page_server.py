"""The server of the live page: readers that are slow, too many, or come late."""

import asyncio
import socket
from math import nan

from aiohttp import ClientSession, ClientTimeout
from live_pages import frames

from backlash_ros.nodes.watching.page_server import CurvePoints, PageServer, bound_socket

LOOK_S = 0.02
BIG = 'x' * 200_000
DEADLINE = ClientTimeout(total=30.0)


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
        self.server = PageServer(self.socket, self._head, kept=3)

    async def run(self) -> None:
        """Renew frames until cancelled."""
        await self.server.start()
        try:
            while True:
                self.number += 1
                await self.server.add(str(self.number))
                await asyncio.sleep(0.002)
        finally:
            await self.server.stop()

    def _head(self) -> str:
        self.made += 1
        return f'"number":{self.number},"x":"{BIG}"'


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
            await asyncio.gather(running, return_exceptions=True)

    asyncio.run(look())


def test_a_reader_gets_the_newest_portions_and_each_of_them_once() -> None:
    async def look() -> None:
        served = ServedFrames()
        await served.server.start()
        try:
            for portion in range(5):
                await served.server.add(str(portion))
            async with ClientSession(timeout=DEADLINE) as session, session.get(
                f'{served.address}/events', read_bufsize=2 ** 20
            ) as response:
                got = frames(response)
                assert (await anext(got))['portions'] == [2, 3, 4]
                await served.server.add('5')
                assert (await anext(got))['portions'] == [5]
        finally:
            await served.server.stop()

    asyncio.run(look())


def test_v_and_the_u_after_it_make_a_point_whatever_is_missing() -> None:
    points = CurvePoints(0)
    assert points.take([('v', 10, 1.0), ('u_hat', 20, 0.1)])['loop'] == [1.0, 0.1]
    # The u of a v that is under way still, or was lost.
    assert 'loop' not in points.take([('u_hat', 30, 0.2)])
    assert 'loop' not in points.take([('v', 40, 3.0)])
    assert points.take([('v', 50, 4.0), ('u_hat', 60, nan)])['loop'] == [4.0, None]
    assert points.take([('m', 2_000_000_000, 0.098)]) == {'m': [2.0, 0.098]}
