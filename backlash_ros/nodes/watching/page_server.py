"""Serves the page and its stream of server-sent events, to browsers of this machine alone."""

from __future__ import annotations

import asyncio
import json
import socket
from collections import deque
from collections.abc import Callable, Iterable
from math import isfinite
from pathlib import Path

from aiohttp import web
from aiohttp.typedefs import Handler

HOST = '127.0.0.1'
Curves = dict[str, list[float | None]]


def rounded(value: float) -> float | None:
    """A number for JSON, which has no nan: None."""
    return float(f'{value:.7g}') if isfinite(value) else None


def as_json(content: object) -> str:
    """Without spaces."""
    return json.dumps(content, separators=(',', ':'), allow_nan=False)


class CurvePoints:
    """Sorts the messages of one controller into points. start_ns: the time that counts as 0."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._v: deque[tuple[int, float]] = deque(maxlen=100)  # of which u has not come

    def take(self, messages: Iterable[tuple[str, int, float]]) -> Curves:
        """By label t [s] and value in turns, and for 'loop' v and u in turns.

        messages: label, time of arrival [ns], value.
        """
        curves: Curves = {}
        reconstructed: list[tuple[int, float]] = []
        for label, at_ns, value in messages:
            t = round(1e-9 * (at_ns - self._start_ns), 3)
            curves.setdefault(label, []).extend((t, rounded(value)))
            if label == 'v':
                self._v.append((at_ns, value))
            elif label == 'u_hat':
                reconstructed.append((at_ns, value))
        for at_ns, u in reconstructed:
            # u is sent with the v that it came from, after it: see WatchPublisher.
            v = None
            while self._v and self._v[0][0] <= at_ns:
                _, v = self._v.popleft()
            if v is not None:
                curves.setdefault('loop', []).extend((rounded(v), rounded(u)))
        return curves


def bound_socket(port: int) -> socket.socket:
    """A socket that listens on this port of this machine, 0 for a free one; raises OSError."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        # A port that was used a minute ago is free.
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((HOST, port))
        bound.listen()
    except OSError:
        bound.close()
        raise
    return bound


@web.middleware
async def for_this_machine(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Refuse whoever came here by another name."""
    # A page from elsewhere may let a name of its own point here, and read along.
    if request.host.partition(':')[0] not in (HOST, 'localhost'):
        raise web.HTTPForbidden(text=f'only {HOST} is served\n')
    return await handler(request)


class PageServer:
    """Sends every reader what is new, at the pace that it takes it.

    Nothing is queued for a reader: when it has taken one frame it gets the next with all portions
    that have been added, as far back as they are kept.

    head: what a frame holds besides, as members of a JSON object. kept: how many portions are.
    """

    def __init__(self, bound: socket.socket, head: Callable[[], str], kept: int) -> None:
        self._socket, self._head = bound, head
        self._portions: deque[str] = deque(maxlen=kept)  # each of them JSON
        self._count = 0  # of portions so far
        self._renewed = asyncio.Condition()
        self._readers = 0
        application = web.Application(middlewares=[for_this_machine])
        application.router.add_get('/', self._page)
        application.router.add_get('/events', self._events)
        self._runner = web.AppRunner(
            # Some browsers do not take what they are sent.
            application, access_log=None, handle_signals=False, shutdown_timeout=0.2,
        )

    async def start(self) -> None:
        """Begin to serve."""
        await self._runner.setup()
        await web.SockSite(self._runner, self._socket).start()

    async def add(self, portion: str) -> None:
        """Send it to every reader that waits, and to the others when they can take it."""
        self._portions.append(portion)
        self._count += 1
        async with self._renewed:
            self._renewed.notify_all()

    async def stop(self) -> None:
        """End all streams."""
        await self._runner.cleanup()

    async def _page(self, request: web.Request) -> web.StreamResponse:
        page = Path(__file__).with_name('page.html')
        return web.Response(
            text=page.read_text(encoding='utf-8'), content_type='text/html',
            headers={'Cache-Control': 'no-store'},
        )

    async def _events(self, request: web.Request) -> web.StreamResponse:
        most_readers = 16  # pages that are open at once
        if self._readers >= most_readers:
            raise web.HTTPServiceUnavailable(text=f'{most_readers} pages are open already\n')
        response = web.StreamResponse(
            headers={'Content-Type': 'text/event-stream', 'Cache-Control': 'no-store'}
        )
        self._readers += 1
        try:
            await response.prepare(request)
            known = 0  # portions that the reader has
            while True:
                missing = list(self._portions)[max(len(self._portions) - self._count + known, 0):]
                known = self._count
                # Waits here, and here alone, for a browser that is slow.
                await response.write(
                    f'data: {{{self._head()},"portions":[{",".join(missing)}]}}\n\n'.encode()
                )
                async with self._renewed:
                    await self._renewed.wait()
        except ConnectionResetError:
            return response  # the page was closed
        finally:
            self._readers -= 1
