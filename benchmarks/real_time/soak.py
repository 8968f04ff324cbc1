"""The loop at 1 kHz: nothing lost, answers beside a bare echo node, memory of the controller.

    python benchmarks/real_time/soak.py [--seconds 60] [--minutes 10]

G(z) of the paper's example, resampled to a period of 1 ms, on real nodes in real time. Beside them
a bare clock, which does nothing but sleep until the next period, tells for how many periods the
machine itself stood still. The plant misses them as well, and more: samples that were never sent.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from pathlib import Path

# Before rclpy reads it, and before numpy is imported.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('OMP_NUM_THREADS', '1')
sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import numpy as np
from reporting import CHECK_HEADER, ROOT, Check, text_table
from scipy import linalg, signal

from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.bringup.supervisor import Child, ProcessSupervisor
from real_time.loop_latency import LATENCY_HEADER, measure_latency
from real_time.node_processes import node_command, processes, wait_for_event

PERIOD_S = 1e-3
LATENCY_LIMIT = 1.5  # of p99
GROWTH_LIMIT_MB = 1.0
WARM_UP_S = 60.0  # before memory is looked at: records and histories fill up once
NOISE = 1e-3


def resampled(period_s: float) -> dict[str, object]:
    """plant.numerator and plant.denominator of the example, exact for a v that is held."""
    p = Parameters()
    a, b, c, _ = signal.tf2ss(p.get_floats('plant.numerator'), p.get_floats('plant.denominator'))
    n = len(a)
    held = np.eye(n + 1)
    held[:n, :n], held[:n, n:] = a, b
    finer = np.real(linalg.expm(linalg.logm(held) * (period_s / p.get_float('sample_period'))))
    numerator, denominator = signal.ss2tf(finer[:n, :n], finer[:n, n:], c, np.zeros((1, 1)))
    return {
        'plant.numerator': np.trim_zeros(numerator[0], 'f').tolist(),
        'plant.denominator': denominator.tolist(), 'sample_period': period_s,
    }


def run_loop(seconds: float, minutes: float) -> list[Check]:
    """Plant, reference and controller for so long; lost samples, then the growth of memory."""
    samples = round(max(seconds, WARM_UP_S + 60.0 * minutes if minutes else 0.0) / PERIOD_S)
    plant = resampled(PERIOD_S)
    commands = {
        'controller': node_command('controller', {
            **plant, 'wait_for_subscribers': 1, 'estimator.output_noise_std': NOISE,
        }),
        'reference': node_command('reference', {
            'sample_period': PERIOD_S, 'wait_for_subscribers': 1,
        }),
        'plant': node_command('plant', {
            **plant, 'wait_for_subscribers': 1, 'samples': samples, 'output_noise_std': NOISE,
        }),
        'bare clock': [
            sys.executable, str(ROOT / 'benchmarks' / 'real_time' / 'bare_clock.py'), str(PERIOD_S),
        ],
    }
    checks = []
    with processes(commands) as (supervisor, _):
        wait_for_event(supervisor, lambda kind, who: (kind, who) == ('ready', 'plant'))
        if minutes:
            time.sleep(WARM_UP_S)
            before = _resident_mb(supervisor)
            time.sleep(60.0 * minutes - 1.0)
            growth = _resident_mb(supervisor) - before
            checks.append(Check(
                f'memory of the controller after {minutes:g} min [MB]', f'< {GROWTH_LIMIT_MB:g}',
                f'{growth:+.3f}', growth < GROWTH_LIMIT_MB,
            ))
        patience_s = 2.0 * samples * PERIOD_S
        wait_for_event(supervisor, lambda kind, _: kind == 'done', patience_s)
        supervisor.stop()
        logs = {
            child.plan.name: child.plan.log.read_text().strip().splitlines()[-1]
            for child in supervisor.children if child.plan.log.stat().st_size
        }
    counts = dict(re.findall(r'([a-z][a-z ]*): (\d+)', logs['controller']))
    lost, unsent = (int(counts.get(name, 0)) for name in ('lost', 'of these never sent'))
    checks[:0] = [
        Check(f'{what} of {counts["samples"]} at {1.0 / PERIOD_S:g} Hz', '0', str(count), not count)
        for what, count in (
            ('samples lost between plant and controller', lost - unsent),
            ('samples for which the machine let the plant wake too late', unsent),
        )
    ]
    for name in ('plant', 'controller', 'bare clock'):
        print(f'{name}: {logs[name]}')
    return checks


def _controller(supervisor: ProcessSupervisor) -> Child:
    return next(c for c in supervisor.children if c.plan.name == 'controller')


def _resident_mb(supervisor: ProcessSupervisor) -> float:
    status = Path(f'/proc/{_controller(supervisor).process.pid}/status').read_text()
    found = re.search(r'VmRSS:\s+(\d+) kB', status)
    assert found
    return int(found[1]) / 1024.0


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--minutes', type=float, default=0.0, help='0 leaves the memory out')
    options = parser.parse_args()
    checks = run_loop(options.seconds, options.minutes)
    latencies = measure_latency(
        1.0 / PERIOD_S, 'moving_horizon', options.seconds,
        {**resampled(PERIOD_S), 'frequency': 12.6},
    )
    print(text_table(LATENCY_HEADER, latencies.rows))
    ratio = latencies.ratio(0.99)
    checks.append(Check(
        f'y to v / bare echo, p99, {options.seconds:g} s', f'<= {LATENCY_LIMIT:g}',
        f'{ratio:.2f}', ratio <= LATENCY_LIMIT,
    ))
    print(text_table(CHECK_HEADER, [check.row for check in checks]))
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
