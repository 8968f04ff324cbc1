"""Shows running controllers on a page in the browser: state, estimates, moving curves.

The page is served to this machine alone, at an address that is printed.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Sequence

from rclpy.utilities import remove_ros_args

from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import ENABLED, ProcessNode, emit, ros_arguments, run
from backlash_ros.nodes.watching.followed import ControllerState, FollowedControllers, give_way
from backlash_ros.nodes.watching.page_server import CurvePoints, PageServer, rounded
from backlash_ros.options import LARGEST_PORT, OptionParser
from backlash_ros.topics import BACKLASH

LIVE = 'live'
SHOWN_S, PAGE_PERIOD_S = 10.0, 0.1  # width of the curves, time between two looks
LIVE_LABELS = (
    *BACKLASH, *(f'{name}_{end}' for name in BACKLASH for end in ('low', 'high')),
    'y_m', 'y', 'u_d', 'v', 'u_hat',
)


class LiveNode(ProcessNode):
    """Shows every controller of the domain, or those of some namespaces.

    wanted: names of controllers or namespaces, none for all.
    """

    def __init__(self, wanted: Sequence[str], server: PageServer) -> None:
        super().__init__(LIVE)
        # A machine that is held up for a second loses no point.
        self._followed = FollowedControllers(self, wanted, LIVE_LABELS, depth=30)
        self._server = server
        self._start_ns = time.time_ns()
        self._points: dict[str, CurvePoints] = {}

    def work(self, executor: PromptExecutor) -> None:
        """Serve the page until a signal ends it."""
        threading.Thread(
            target=self._server.serve_forever, args=[PAGE_PERIOD_S], daemon=True
        ).start()
        if ENABLED:
            emit('ready', address=self._server.address)
        else:
            print(self._server.address, flush=True)
        due_s = time.monotonic()
        while not self.stopping:
            executor.spin_once(timeout_sec=0.0)  # the look for further controllers
            self._followed.take_diagnostics()
            self._server.add(self._state(), {
                name: self._points.setdefault(name, CurvePoints(self._start_ns))
                .take(state.watch()) for name, state in self._followed.by_name.items()
            })
            now_s = time.monotonic()
            due_s = max(due_s + PAGE_PERIOD_S, now_s)
            time.sleep(due_s - now_s)
        self._server.shutdown()

    def _state(self) -> dict[str, object]:
        by_name, now_s = self._followed.by_name, time.monotonic()
        return {
            'now': round(1e-9 * (time.time_ns() - self._start_ns), 3), 'shown': SHOWN_S,
            'awaited': self._followed.awaited,
            'controllers': [content_of(by_name[name], now_s) for name in sorted(by_name)],
        }


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
        server = PageServer(options.port, kept=round(SHOWN_S / PAGE_PERIOD_S))
    except OSError as error:
        parser.error(f'--port={options.port}: {error.strerror}: choose another one, or none')
    give_way()
    with server:
        return run(LIVE, lambda: LiveNode(options.name, server), ros_arguments(arguments))


if __name__ == '__main__':
    sys.exit(main())
