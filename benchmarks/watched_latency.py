"""Latency from y to v with `monitor` on a terminal and the page in a browser, and without.

`.venv/bin/python benchmarks/watched_latency.py`: runs with and without take turns, each beside the
echo node of loop_latency.py, so that what else the machine does falls on all of them.
"""

from __future__ import annotations

import argparse
import os
import socket
import sys
from pathlib import Path

# Before numpy is imported: the matrices are tiny, threads would only disturb the loop.
os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
from real_time.loop_latency import RATES_HZ, Latencies, measure_latency, node_command
from reporting import machine, markdown_table

LAW = 'moving_horizon'
BESIDE = Path(__file__).resolve().parent / 'real_time'
BROWSER = 'browser'
# The lowest one is that of samples which nothing else on the machine has held up.
QUANTILES = (0.1, 0.5, 0.99)
HEADER = (
    'rate', '', 'nobody watches', 'monitor and page are open', 'the same over the echo',
    'ratio of these',
)


def watchers() -> dict[str, list[str]]:
    """Commands of all who watch."""
    with socket.create_server(('127.0.0.1', 0)) as found:
        port = found.getsockname()[1]
    monitor = node_command('monitor.command', {})
    return {
        'monitor': [sys.executable, str(BESIDE / 'on_terminal.py'), *monitor],
        'live': [*node_command('live.command', {}), '--port', str(port)],
        BROWSER: [
            sys.executable, str(BESIDE / 'open_page.py'),
            f'http://127.0.0.1:{port}',
        ],
    }


def median(runs: list[Latencies], quantile: float) -> float:
    """Median over the runs of a quantile of the controller [s]."""
    return float(np.median([np.quantile(run.controller, quantile) for run in runs]))


def rows_of(rate: float, alone: list[Latencies], watched: list[Latencies]) -> list[list[str]]:
    """Cells of each quantile."""
    rows = []
    for quantile in QUANTILES:
        over_echo = [
            float(np.median([run.ratio(quantile) for run in runs])) for runs in (alone, watched)
        ]
        rows.append([
            f'{rate:g} Hz', f'p{100 * quantile:g}',
            *(f'{1e3 * median(runs, quantile):.2f} ms' for runs in (alone, watched)),
            f'{over_echo[0]:.3f}, {over_echo[1]:.3f}', f'{over_echo[1] / over_echo[0]:.3f}',
        ])
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=5, metavar='N', help='of each kind')
    parser.add_argument('--duration', type=float, default=10.0, metavar='SECONDS')
    options = parser.parse_args()
    rows = []
    for rate in RATES_HZ:
        alone, watched = [], []
        for _ in range(options.runs):
            alone.append(measure_latency(rate, LAW, options.duration))
            watched.append(measure_latency(
                rate, LAW, options.duration, beside=watchers(), awaited=BROWSER
            ))
            print(f'{rate:g} Hz: over the echo, p50, {alone[-1].ratio(0.5):.3f} alone, '
                  f'{watched[-1].ratio(0.5):.3f} watched; unanswered '
                  f'{alone[-1].unanswered}, {watched[-1].unanswered}', flush=True)
        rows += rows_of(rate, alone, watched)
    print(f'\n{machine()}; medians of {options.runs} runs of {options.duration:g} s each\n')
    print(markdown_table(HEADER, rows))


if __name__ == '__main__':
    main()
