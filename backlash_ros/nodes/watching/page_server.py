"""Serves the live page, and what it asks for ten times a second, to browsers of this machine."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from math import isfinite
from pathlib import Path
from threading import Lock
from typing import Any

HOST = '127.0.0.1'
Curves = dict[str, list[float | None]]


def rounded(value: float) -> float | None:
    """A number for JSON, which has no nan: None."""
    return float(f'{value:.7g}') if isfinite(value) else None


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


class PageServer(ThreadingHTTPServer):
    """Answers each browser in a thread of its own, so that a slow one holds up nobody.

    port: 0 for a free one; raises OSError. kept: portions of curves for who has asked last so long
    ago. began: tells this server from one that was here before.
    """

    daemon_threads = True

    def __init__(self, port: int, kept: int) -> None:
        super().__init__((HOST, port), PageRequest)
        self.address = f'http://{HOST}:{self.server_address[1]}'
        self._began = time.time_ns()
        self._state, self._count = '{}', 0  # the newest state, how many portions there were
        self._portions: deque[str] = deque(maxlen=kept)
        self._lock = Lock()

    def add(self, state: Mapping[str, object], portion: Mapping[str, Curves]) -> None:
        """Have this ready for whoever asks: what the page says, and the newest points of curves."""
        texts = [json.dumps(each, separators=(',', ':'), allow_nan=False)
                 for each in (state, portion)]
        with self._lock:
            self._state, self._count = texts[0], self._count + 1
            self._portions.append(texts[1])

    def frame(self, known: int) -> str:
        """The state and the portions that somebody is missing who has so many, as JSON."""
        with self._lock:
            first = len(self._portions) - self._count + known if known <= self._count else 0
            missing = ','.join(list(self._portions)[max(first, 0):])
            return (f'{{"state":{self._state},"began":{self._began},"count":{self._count},'
                    f'"portions":[{missing}]}}')


class PageRequest(BaseHTTPRequestHandler):
    """What a browser asks for: / is the page, /frame?known=N what it is missing."""

    server: PageServer
    protocol_version = 'HTTP/1.1'  # one connection for all frames
    timeout = 10.0  # [s] for a browser that has fallen silent

    def do_GET(self) -> None:
        """Answer it; called by the library."""
        path, _, known = self.path.partition('?known=')
        # A page from elsewhere may let a name of its own point here, and read along.
        if self.headers.get('Host', '').partition(':')[0] not in (HOST, 'localhost'):
            self.send_error(HTTPStatus.FORBIDDEN, f'only {HOST} is served')
        elif path == '/':
            self._answer('text/html', Path(__file__).with_name('page.html').read_bytes())
        elif path == '/frame':
            frame = self.server.frame(int(known) if known.isdecimal() else 0)
            self._answer('application/json', frame.encode())
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def handle(self) -> None:
        """Answer until the browser has gone."""
        with suppress(OSError):
            super().handle()

    def log_message(self, *message: Any) -> None:
        """Nobody reads of each request."""

    def _answer(self, kind: str, content: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        for name, value in (('Content-Type', f'{kind}; charset=utf-8'),
                            ('Content-Length', str(len(content))), ('Cache-Control', 'no-store')):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)
