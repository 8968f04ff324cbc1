"""Show running controllers on a page in the browser: state, estimates, moving curves.

The page is served to this machine only, at an address that is printed.
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
from threading import Thread
from typing import Any

from backlash_ros.nodes.followed import ControllerState, ViewerNode, viewer_options
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import ENABLED, emit, run, split_arguments
from backlash_ros.options import port
from backlash_ros.topics import WATCH_LABELS

HOST = '127.0.0.1'
PAGE_PERIOD_S = 0.1  # between two looks
LIVE_LABELS = tuple(
    label for label in WATCH_LABELS if label not in ('gap', 'innovation', 'status', 'latency_s'))


class PageServer(ThreadingHTTPServer):
    """Answers each browser in a thread of its own, so that a slow one does not delay the others.

    frames: those of the last shown_s [s], each with its time, the state and new points of curves.
    """

    daemon_threads = True

    def __init__(self, port: int, shown_s: float) -> None:
        super().__init__((HOST, port), PageRequest)
        self.address, self.shown_s = f'http://{HOST}:{self.server_address[1]}', shown_s
        kept = round(shown_s / PAGE_PERIOD_S)
        self.frames: deque[tuple[float, object, object]] = deque(maxlen=kept)


class PageRequest(BaseHTTPRequestHandler):
    """Serves the page, and /frames, a stream of what the page is to show."""

    server: PageServer
    timeout = 10.0  # [s] until a silent browser is given up

    def do_GET(self) -> None:
        # Against DNS rebinding: another site's name may point here, to read the data.
        if self.headers.get('Host', '').partition(':')[0] not in (HOST, 'localhost'):
            self.send_error(HTTPStatus.FORBIDDEN, f'only {HOST} is served')
            return
        streams = self.path == '/frames'
        self.send_response(HTTPStatus.OK)
        self.send_header('Content-Type', 'text/event-stream' if streams else 'text/html')
        self.send_header('Cache-Control', 'no-store')
        self.end_headers()
        if streams:
            self._send_frames()
        else:
            self.wfile.write(Path(__file__).with_suffix('.html').read_bytes())

    def _send_frames(self) -> None:
        """Send the newest state and all curves, then whatever is new, as server-sent events."""
        sent = 0.0
        while True:
            missing = [frame for frame in self.server.frames.copy() if frame[0] > sent]
            if missing:
                sent, state, _ = missing[-1]
                content = {'state': state, 'curves': [curves for *_, curves in missing]}
                self.wfile.write(f'data: {json.dumps(content, allow_nan=False)}\n\n'.encode())
            time.sleep(PAGE_PERIOD_S)

    def handle(self) -> None:
        with suppress(OSError):
            super().handle()

    def log_message(self, *message: Any) -> None:
        """Do not log requests: nobody would read that."""


class LiveNode(ViewerNode):
    """Shows the wanted controllers on the page of a server."""

    def __init__(self, wanted: Sequence[str], server: PageServer) -> None:
        super().__init__('live', wanted, LIVE_LABELS)
        self._server = server

    def work(self, executor: PromptExecutor) -> None:
        Thread(target=self._server.serve_forever, args=[PAGE_PERIOD_S], daemon=True).start()
        if ENABLED:
            emit('ready', address=self._server.address)
        else:
            print(self._server.address, flush=True)
        self.every(PAGE_PERIOD_S, self._add_frame)
        super().work(executor)
        self._server.shutdown()

    def _add_frame(self) -> None:
        self.take_messages()
        state = {
            'now': time.time(), 'shown': self._server.shown_s, 'awaited': self.awaited,
            'controllers': [content_of(each) for _, each in sorted(self.states.items())],
        }
        curves = {name: {
            label: [(round(1e-9 * at_ns, 6), rounded(value)) for at_ns, value in points]
            for label, points in each.watched.items()
        } for name, each in self.states.items()}
        self._server.frames.append((time.monotonic(), state, curves))


def rounded(value: float) -> float | None:
    """A number for JSON; None instead of nan and inf, which JSON lacks."""
    return float(f'{value:.7g}') if isfinite(value) else None


def content_of(state: ControllerState) -> dict[str, object]:
    return {
        'name': state.name, 'word': state.word, 'message': state.message, 'level': state.level,
        'estimates': {name: [*map(rounded, pair)] for name, pair in state.estimates.items()},
        'values': state.values, 'events': [*state.events],
    }


def main(args: list[str] | None = None) -> int:
    plain, of_ros = split_arguments(args)
    parser = viewer_options(
        'live', __doc__,
        'From elsewhere: ssh -L PORT:127.0.0.1:PORT HOST, then open the same address there.',
    )
    parser.add_argument('--port', type=port, default=0, metavar='PORT',
                        help='of the page (default: a free one)')
    options = parser.parse_args(plain)
    try:
        server = PageServer(options.port, shown_s=10.0)
    except OSError as error:
        parser.error(f'--port={options.port}: {error.strerror}: choose another one, or none')
    with server:
        return run('live', lambda: LiveNode(options.name, server), of_ros)


if __name__ == '__main__':
    sys.exit(main())
