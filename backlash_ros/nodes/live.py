"""Shows running controllers on a page in the browser: state, estimates, moving curves.

The page is served to this machine alone, at an address that is printed.
"""

from __future__ import annotations

import argparse
import asyncio
import socket
import sys
import time
from collections.abc import Sequence

from rclpy.utilities import remove_ros_args

from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import ENABLED, ProcessNode, emit, ros_arguments, run
from backlash_ros.nodes.watching.followed import ControllerState, FollowedControllers, give_way
from backlash_ros.nodes.watching.page_server import (
    HOST,
    CurvePoints,
    PageServer,
    as_json,
    bound_socket,
    rounded,
)
from backlash_ros.options import LARGEST_PORT, OptionParser
from backlash_ros.topics import BACKLASH

LIVE = 'live'
SHOWN_S = 10.0  # width of the curves
LIVE_LABELS = (
    *BACKLASH, *(f'{name}_{end}' for name in BACKLASH for end in ('low', 'high')),
    'y_m', 'y', 'u_d', 'v', 'u_hat',
)


class LiveNode(ProcessNode):
    """Shows every controller of the domain, or those of some namespaces.

    wanted: names of controllers or namespaces, none for all. bound: where the page is served.
    """

    def __init__(self, wanted: Sequence[str], bound: socket.socket) -> None:
        super().__init__(LIVE)
        # A machine that is held up for a second loses no point.
        self._followed = FollowedControllers(self, wanted, LIVE_LABELS, depth=30)
        self._socket = bound
        self._start_ns = time.time_ns()
        self._points: dict[str, CurvePoints] = {}

    def work(self, executor: PromptExecutor) -> None:
        """Serve the page until a signal ends it."""
        asyncio.run(self._serve(executor))

    async def _serve(self, executor: PromptExecutor) -> None:
        frame_period_s = 0.1  # between two frames of the page
        server = PageServer(self._socket, self._head, kept=round(SHOWN_S / frame_period_s))
        await server.start()
        address = f'http://{HOST}:{self._socket.getsockname()[1]}'
        if ENABLED:
            emit('ready', address=address)
        else:
            print(address, flush=True)
        due_s = time.monotonic()
        try:
            while not self.stopping:
                executor.spin_once(timeout_sec=0.0)  # the look for further controllers
                self._followed.take_diagnostics()
                await server.add(as_json({
                    name: self._points.setdefault(name, CurvePoints(self._start_ns))
                    .take(state.watch()) for name, state in self._followed.by_name.items()
                }))
                due_s = max(due_s + frame_period_s, time.monotonic())
                await asyncio.sleep(due_s - time.monotonic())
        finally:
            await server.stop()

    def _head(self) -> str:
        by_name, now_s = self._followed.by_name, time.monotonic()
        return as_json({
            'now': round(1e-9 * (time.time_ns() - self._start_ns), 3), 'shown': SHOWN_S,
            'awaited': self._followed.awaited,
            'controllers': [content_of(by_name[name], now_s) for name in sorted(by_name)],
        })[1:-1]


def content_of(state: ControllerState, now_s: float) -> dict[str, object]:
    """What the page says of a controller in words and numbers. now_s: on the steady clock."""
    return {
        'name': state.name, 'word': state.word(now_s), 'message': state.message,
        # Nobody knows how somebody is who says nothing any more.
        'level': 2 if state.silent_s(now_s) else state.level,
        'estimates': {name: [*map(rounded, pair)] for name, pair in state.estimates.items()},
        'excitation': rounded(state.excitation),
        'rate': rounded(state.number('rate [Hz]')),
        'latency': [rounded(state.number(f'latency {which} [ms]')) for which in ('p50', 'p99')],
        'counts': {name: state.values.get(name, '') for name in ('samples', 'lost', 'late')},
        'learning': state.is_on('learning'), 'compensating': state.is_on('compensating'),
        'events': [*map(list, state.events)],
    }


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = sys.argv[1:] if args is None else args
    parser = OptionParser(
        LIVE, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='From elsewhere: ssh -L PORT:127.0.0.1:PORT HOST, then open the same address there.',
    )
    parser.add_argument('name', nargs='*', metavar='NAME',
                        help='a controller or a namespace, as /pan (default: all there are)')
    parser.add_argument('--port', type=int, default=0, metavar='PORT',
                        help='of the page (default: a free one)')
    options = parser.parse_args(remove_ros_args(['', *arguments])[1:])
    if not 0 <= options.port <= LARGEST_PORT:
        parser.error(f'--port={options.port}: must be from 0 (a free one) to {LARGEST_PORT}')
    try:
        bound = bound_socket(options.port)
    except OSError as error:
        parser.error(f'--port={options.port}: {error.strerror}: choose another one, or none')
    give_way()
    with bound:
        return run(LIVE, lambda: LiveNode(options.name, bound), ros_arguments(arguments))


if __name__ == '__main__':
    sys.exit(main())
