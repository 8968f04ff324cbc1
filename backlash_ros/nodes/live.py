"""Shows running controllers on a page in the browser: state, estimates, moving curves.

The page is served to this machine alone, at an address that is printed.
"""

import json
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from math import isfinite
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from backlash_ros.nodes import followed
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import ENABLED, ProcessNode, emit, run, split_arguments
from backlash_ros.options import port
from backlash_ros.topics import WATCH_LABELS

HOST = '127.0.0.1'
PAGE_PERIOD_S = 0.1  # between two looks
LIVE_LABELS = tuple(
    label for label in WATCH_LABELS if label not in ('gap', 'innovation', 'status', 'latency_s'))


class PageServer(ThreadingHTTPServer):
    """Answers each browser in a thread of its own, so that a slow one holds up nobody."""

    daemon_threads = True

    def __init__(self, port: int, kept: int) -> None:
        super().__init__((HOST, port), PageRequest)
        self.address = f'http://{HOST}:{self.server_address[1]}'
        self._began = time.time_ns()  # tells this server from one that was here before
        self._state, self._count = '{}', 0  # the newest state, how many portions there were
        self._portions: deque[str] = deque(maxlen=kept)
        self._lock = Lock()

    def add(self, state: object, portion: object) -> None:
        """Have this ready for whoever asks; portion: the newest points of curves."""
        texts = [json.dumps(each, separators=(',', ':'), allow_nan=False)
                 for each in (state, portion)]
        with self._lock:
            self._state, self._count = texts[0], self._count + 1
            self._portions.append(texts[1])

    def frame(self, known: int) -> str:
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
        path, _, known = self.path.partition('?known=')
        # A page from elsewhere may let a name of its own point here, and read along.
        if self.headers.get('Host', '').partition(':')[0] not in (HOST, 'localhost'):
            self.send_error(HTTPStatus.FORBIDDEN, f'only {HOST} is served')
        elif path == '/':
            self._answer('text/html', Path(__file__).with_suffix('.html').read_bytes())
        elif path == '/frame':
            frame = self.server.frame(int(known) if known.isdecimal() else 0)
            self._answer('application/json', frame.encode())
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def handle(self) -> None:
        with suppress(OSError):
            super().handle()

    def log_message(self, *message: Any) -> None:
        """Nobody reads of each request."""

    def _answer(self, kind: str, content: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header('Content-Type', f'{kind}; charset=utf-8')
        self.send_header('Content-Length', str(len(content)))
        self.send_header('Cache-Control', 'no-store')
        self.end_headers()
        self.wfile.write(content)


class LiveNode(ProcessNode):
    """Shows the controllers that are wanted, with curves that are shown_s [s] wide."""

    def __init__(self, wanted: Sequence[str], server: PageServer, shown_s: float) -> None:
        super().__init__('live')
        # A machine that is held up for a second loses no point.
        self._followed = followed.FollowedControllers(self, wanted, LIVE_LABELS, depth=30)
        self._server, self._shown_s = server, shown_s
        self._start_ns = time.time_ns()

    def work(self, executor: PromptExecutor) -> None:
        Thread(target=self._server.serve_forever, args=[PAGE_PERIOD_S], daemon=True).start()
        if ENABLED:
            emit('ready', address=self._server.address)
        else:
            print(self._server.address, flush=True)
        while not self.stopping:
            executor.spin_once(timeout_sec=0.0)  # the look for further controllers
            self._followed.take_messages()
            states, now_s = self._followed.by_name, time.monotonic()
            curves: dict[str, dict[str, list[object]]] = {name: {} for name in states}
            for name, state in states.items():
                for label, at_ns, value in state.watched:
                    point = self._seconds(at_ns), rounded(value)
                    curves[name].setdefault(label, []).append(point)
            self._server.add({
                'now': self._seconds(time.time_ns()), 'shown': self._shown_s,
                'awaited': self._followed.awaited,
                'controllers': [content_of(states[name], now_s) for name in sorted(states)],
            }, curves)
            time.sleep(PAGE_PERIOD_S)
        self._server.shutdown()

    def _seconds(self, at_ns: int) -> float:
        return round(1e-9 * (at_ns - self._start_ns), 6)


def rounded(value: float) -> float | None:
    """A number for JSON, which has no nan: None."""
    return float(f'{value:.7g}') if isfinite(value) else None


def content_of(state: followed.ControllerState, now_s: float) -> dict[str, object]:
    return {
        'name': state.name, 'word': state.word(now_s), 'message': state.message,
        # Nobody knows how somebody is who says nothing any more.
        'level': 2 if state.silent_s(now_s) else state.level,
        'estimates': {name: [*map(rounded, pair)] for name, pair in state.estimates.items()},
        'values': state.values, 'events': [*state.events],
    }


def main(args: list[str] | None = None) -> int:
    plain, of_ros = split_arguments(args)
    parser = followed.viewer_options(
        'live', __doc__,
        'From elsewhere: ssh -L PORT:127.0.0.1:PORT HOST, then open the same address there.',
    )
    parser.add_argument('--port', type=port, default=0, metavar='PORT',
                        help='of the page (default: a free one)')
    options = parser.parse_args(plain)
    shown_s = 10.0
    try:
        server = PageServer(options.port, kept=round(shown_s / PAGE_PERIOD_S))
    except OSError as error:
        parser.error(f'--port={options.port}: {error.strerror}: choose another one, or none')
    followed.give_way()
    with server:
        return run('live', lambda: LiveNode(options.name, server, shown_s), of_ros)


if __name__ == '__main__':
    sys.exit(main())
