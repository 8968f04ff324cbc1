"""Latency from y to v with `monitor` on a terminal and the page in a browser, and without.

`.venv/bin/python benchmarks/watched_latency.py`: one controller all the time, beside the echo node
of loop_latency.py; those who watch come and go. Each time without them is compared with the one
next to it, so that what else the machine does, and what the controller has learned, is the same.
"""

from __future__ import annotations

import argparse
import os
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

# Before numpy is imported: the matrices are tiny, threads would only disturb the loop.
os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
from real_time.loop_latency import RATES_HZ, WARM_UP_S, Latencies, driven_loop
from real_time.node_processes import check_running, node_command, processes_in, wait_for_event
from reporting import machine, markdown_table

LAW = 'moving_horizon'
BESIDE = Path(__file__).resolve().parent / 'real_time'
# Who is started; the last one says when it is ready, where it is no monitor.
WATCHES = {
    'monitor': ('monitor',),
    'stream': ('live', 'stream'),
    'page': ('live', 'page'),
    'both': ('monitor', 'live', 'page'),
}
EVERYBODY = 'both'
# The lowest one is that of samples which nothing else on the machine has held up.
QUANTILES = (0.1, 0.5, 0.9, 0.99)
SETTLED_S = 2.0  # after a start or an end, until times count: discovery, the first pictures
HEADER = (
    'rate', 'open', '', 'without', 'with', 'ratio', 'the same over the echo',
)
Pair = tuple[Latencies, Latencies]  # without, with


class Interrupted(Exception):
    """The measurement is to end."""


def watchers(names: Sequence[str]) -> dict[str, list[str]]:
    """Commands of these who watch."""
    with socket.create_server(('127.0.0.1', 0)) as found:
        port = found.getsockname()[1]
    address, monitor = f'http://127.0.0.1:{port}', node_command('monitor.command', {})
    commands = {
        'monitor': [sys.executable, str(BESIDE / 'on_terminal.py'), *monitor],
        'live': [*node_command('live.command', {}), '--port', str(port)],
        'stream': [sys.executable, str(BESIDE / 'read_stream.py'), address],
        'page': [sys.executable, str(BESIDE / 'open_page.py'), address],
    }
    return {name: commands[name] for name in names}


class Turns:
    """Starts and ends those who watch, and says what the times count for meanwhile.

    names: who watches. domain: of the loop. duration_s: of what counts, each time.
    """

    def __init__(
        self, rate: float, names: Sequence[str], domain: int, pairs: int, duration_s: float,
    ) -> None:
        self._rate, self._names, self._domain = rate, names, domain
        self._pairs, self._duration_s = pairs, duration_s
        self._interrupted = threading.Event()
        self.counted: Latencies | None = None

    def interrupt(self) -> None:
        """Let `take` end."""
        self._interrupted.set()

    def take(self) -> list[Pair]:
        """All pairs; each begins as the one before it has ended."""
        self._pass(WARM_UP_S)
        pairs = []
        for i in range(self._pairs):
            if i % 2:
                watched = self._time(self._names)
                pairs.append((self._time(()), watched))
            else:
                pairs.append((self._time(()), self._time(self._names)))
        return pairs

    def _time(self, names: Sequence[str]) -> Latencies:
        result = Latencies(self._rate)
        with ExitStack() as stack:
            if names:
                supervisor = stack.enter_context(processes_in(self._domain, watchers(names)))
                if names[-1] != 'monitor':
                    wait_for_event(
                        supervisor, lambda kind, who: (kind, who) == ('ready', names[-1])
                    )
                stack.callback(check_running, supervisor)
            self._pass(SETTLED_S)
            self.counted = result
            try:
                self._pass(self._duration_s)
            finally:
                self.counted = None
        return result

    def _pass(self, seconds: float) -> None:
        if self._interrupted.wait(seconds):
            raise Interrupted


def measured_pairs(rate: float, names: Sequence[str], pairs: int, duration_s: float) -> list[Pair]:
    """Times of a loop at this rate, without and with these who watch."""
    with driven_loop(rate, LAW) as (driver, domain):
        turns = Turns(rate, names, domain, pairs, duration_s)
        with ThreadPoolExecutor(1) as beside:
            taken = beside.submit(turns.take)
            try:
                driver.drive(lambda: turns.counted, lambda: not taken.done())
            finally:
                turns.interrupt()
            return taken.result()


def rows_of(rate: float, what: str, pairs: Sequence[Pair]) -> list[list[str]]:
    """Cells of each quantile: medians over the pairs, and the middle half of the ratios."""
    rows = []
    for quantile in QUANTILES:
        def of_controller(run: Latencies, q: float = quantile) -> float:
            return float(np.quantile(run.controller, q))

        def over_echo(run: Latencies, q: float = quantile) -> float:
            return run.ratio(q)

        rows.append([
            f'{rate:g} Hz', what, f'p{100 * quantile:g}',
            *(f'{1e3 * np.median([of_controller(run) for run in runs]):.3f} ms'
              for runs in zip(*pairs, strict=True)),
            _spread(pairs, of_controller), _spread(pairs, over_echo),
        ])
    return rows


def _spread(pairs: Sequence[Pair], figure: Callable[[Latencies], float]) -> str:
    ratios = [figure(watched) / figure(alone) for alone, watched in pairs]
    low, middle, high = np.quantile(ratios, (0.25, 0.5, 0.75))
    return f'{middle:.3f} ({low:.3f} to {high:.3f})'


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--pairs', type=int, default=10, metavar='N')
    parser.add_argument('--duration', type=float, default=5.0, metavar='SECONDS', help='of each')
    parser.add_argument('--rate', type=float, action='append', metavar='HZ',
                        help=f'default: {", ".join(f"{rate:g}" for rate in RATES_HZ)}')
    parser.add_argument('--open', choices=WATCHES, action='append',
                        help=f'default: {EVERYBODY}; stream: the page is served but not drawn')
    options = parser.parse_args()
    rows = []
    for rate in options.rate or RATES_HZ:
        for what in options.open or [EVERYBODY]:
            pairs = measured_pairs(rate, WATCHES[what], options.pairs, options.duration)
            rows += rows_of(rate, what, pairs)
            unanswered = [sum(run.unanswered for run in runs) for runs in zip(*pairs, strict=True)]
            print(f'{rate:g} Hz, {what}: unanswered {unanswered[0]} without, '
                  f'{unanswered[1]} with', flush=True)
    print(f'\n{machine()}; {options.pairs} pairs of {options.duration:g} s each\n')
    print(markdown_table(HEADER, rows))


if __name__ == '__main__':
    main()
