"""Learning from the example driver while other processes take the processor.

    python benchmarks/loaded_machine.py [--runs 3] [--seconds 10] [--write]

Controller, reference and examples/motor_driver.py run as processes of their own with
config/geared_motor.yaml, in real time; beside them a busy loop for every processor takes 50 and
80 % of it. What counts is the time from the first output on after which c_r and c_l stay close to
those of the simulated motor: with applied_control from the driver, and without.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import product
from math import inf

# Before rclpy reads it, and before numpy is imported.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
import rclpy
from accuracy.motor_crossings import BOUND_S, LIMITS, CrossingError, crossing_error
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from real_time.node_processes import NODES, processes
from reporting import (
    CHECK_HEADER,
    ROOT,
    Check,
    machine,
    markdown_table,
    processors,
    text_table,
)
from std_msgs.msg import Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.estimate import Status
from backlash_ros.middleware.loopback import prefer_loopback

Array = NDArray[np.float64]

CONFIG = ROOT / 'config' / 'geared_motor.yaml'
DOCUMENT = ROOT / 'docs' / 'results' / 'loaded_machine.md'
BUSY_LOOP = ROOT / 'benchmarks' / 'real_time' / 'busy_loop.py'
DRIVER = ROOT / 'examples' / 'motor_driver.py'
PERIOD_S = 0.005  # of both
LOADS = (0.5, 0.8)
START_S = 30.0  # for the processes to begin
SLOWEST = 3.0  # times as long as the run is to last, at most
KEPT = 100  # messages that may wait for the listener


@dataclass
class Run:
    """What a listener heard: estimates by the number of their sample, and states.

    latencies_s: from y to v.
    """

    errors: dict[int, CrossingError] = field(default_factory=dict)
    states: Counter[Status] = field(default_factory=Counter)
    latencies_s: list[float] = field(default_factory=list)

    @property
    def samples(self) -> int:
        """Samples from the first one heard to the newest; the driver has counted some before."""
        return max(self.errors) - min(self.errors) + 1 if self.errors else 0

    def settled_s(self, limit: float) -> float:
        """Time from which on the error stays within the limit [s]; inf if it does not."""
        beyond = [k for k, error in self.errors.items() if not error.relative <= limit]
        since = min((k for k in self.errors if k > max(beyond, default=-1)), default=None)
        return inf if since is None else (since - min(self.errors)) * PERIOD_S


class Listener(Node):
    """Hears the estimates of the controller."""

    def __init__(self, context: Context) -> None:
        super().__init__('listener', context=context)
        self.run = Run()
        self.create_subscription(Float64MultiArray, topics.ESTIMATES, self._on_estimates, KEPT)
        self.create_subscription(Float64MultiArray, topics.SIGNALS, self._on_signals, KEPT)

    def _on_estimates(self, message: Float64MultiArray) -> None:
        values = dict(zip(topics.ESTIMATE_LABELS, message.data, strict=True))
        self.run.errors[int(values['sample'])] = crossing_error(
            *(values[name] for name in ('c_r', 'c_l', 'std_c_r', 'std_c_l'))
        )

    def _on_signals(self, message: Float64MultiArray) -> None:
        values = dict(zip(topics.SIGNAL_LABELS, message.data, strict=True))
        self.run.states[Status(int(values['status']))] += 1
        self.run.latencies_s.append(values['latency_s'])


@contextmanager
def listener(domain: int) -> Iterator[tuple[Listener, SingleThreadedExecutor]]:
    """A listener in this process, and what lets it hear."""
    prefer_loopback(os.environ)
    context = Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    node = Listener(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()  # type: ignore[no-untyped-call]
        rclpy.shutdown(context=context)


def measure(load: float, use: str, seconds: float) -> Run:
    """Run the loop for so long while every processor is busy for the share `load`."""
    node = [sys.executable, '-m']
    given = ['--ros-args', '--params-file', str(CONFIG)]
    commands = {
        **{f'load {i}': [sys.executable, str(BUSY_LOOP), str(load)]
           for i in range(processors() if load else 0)},
        'controller': [
            *node, f'{NODES}.controller', *given, '-p', f'estimator.use_applied_control:={use}',
        ],
        'reference': [*node, f'{NODES}.reference', *given],
        'driver': [sys.executable, str(DRIVER)],
    }
    with processes(commands) as (supervisor, domain), listener(domain) as (heard, executor):
        deadline = time.monotonic() + START_S + SLOWEST * seconds
        while heard.run.samples * PERIOD_S < seconds:
            executor.spin_once(timeout_sec=0.1)
            ended = [child.plan.name for child in supervisor.ended()]
            if ended or time.monotonic() > deadline:
                raise RuntimeError(
                    f'{ended} ended' if ended else
                    f'only {heard.run.samples} samples came: is the machine too busy?'
                )
        return heard.run


def judge(load: float, use: str, runs: Sequence[Run]) -> Check:
    """The bound for one load, with or without applied_control."""
    limit = LIMITS[use]
    settled = [run.settled_s(limit) for run in runs]
    return Check(
        f'{load:.0%} of {processors()} processors taken, use_applied_control {use}: c_r and c_l '
        f'within {limit:.0%} from [s]', f'<= {BOUND_S:g}',
        ', '.join(f'{t:.2f}' for t in settled), max(settled) <= BOUND_S,
    )


RUN_HEADER = (
    'load', 'reports', 'run', 'error at the end', 'deviations', 'tracking', 'inconsistent',
    'not answered', 'y to v p50 [ms]', 'p99',
)


def row(load: float, use: str, number: int, run: Run) -> list[str]:
    """Cells of the table of runs."""
    answered, at_end = sum(run.states.values()), run.errors[max(run.errors)]
    p50, p99 = 1e3 * np.quantile(run.latencies_s, [0.5, 0.99])
    return [
        f'{load:.0%}', use, str(number), f'{at_end.relative:.3%}', f'{at_end.deviations:.1f}',
        f'{run.states[Status.TRACKING] / answered:.0%}',
        f'{run.states[Status.INCONSISTENT] / answered:.0%}',
        f'{1.0 - answered / run.samples:.0%}', f'{p50:.1f}', f'{p99:.1f}',
    ]


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=3, help='of each kind, default 3')
    parser.add_argument('--seconds', type=float, default=10.0, help='of each run, default 10')
    parser.add_argument('--load', type=float, action='append', metavar='SHARE',
                        help=f'instead of {LOADS}; 0 is none; may be repeated')
    parser.add_argument('--use', action='append', choices=sorted(LIMITS),
                        help='estimator.use_applied_control instead of both; may be repeated')
    parser.add_argument('--write', action='store_true',
                        help=f'write {DOCUMENT.relative_to(ROOT)}; needs all loads and both uses')
    arguments = parser.parse_args()
    if arguments.runs < 1 or not arguments.seconds > BOUND_S:
        parser.error(f'--runs must be >= 1 and --seconds > {BOUND_S:g}')
    if not all(0.0 <= load < 1.0 for load in arguments.load or ()):
        parser.error('--load must be >= 0 and < 1')
    if arguments.write and (arguments.load or arguments.use):
        parser.error('--write needs all loads and uses: leave out --load and --use')
    return arguments


def write_document(checks: Sequence[Check], rows: Sequence[Sequence[str]], seconds: float) -> None:
    """Write the results as Markdown."""
    DOCUMENT.write_text('\n\n'.join([
        '# Learning on a busy machine',
        f'Written by `python benchmarks/loaded_machine.py --write` on: {machine()}. '
        '[examples/motor_driver.py](../../examples/motor_driver.py) runs beside the controller '
        f'with config/geared_motor.yaml for {seconds:g} s, while a busy loop for every processor '
        'takes a share of it.',
        markdown_table(CHECK_HEADER, [check.row for check in checks]),
        '*reports*: `estimator.use_applied_control`. *error at the end*: the larger one of c_r '
        'and c_l, relative. *deviations*: the same over its published deviation. *not answered*: '
        'outputs of the driver without a command.',
        markdown_table(RUN_HEADER, rows),
    ]) + '\n', encoding='utf-8')


def main() -> int:
    """Return 0 if every bound holds, else 1."""
    arguments = parse_arguments()
    print(machine())
    checks, rows = [], []
    for load, use in product(arguments.load or LOADS, arguments.use or LIMITS):
        runs = [measure(load, use, arguments.seconds) for _ in range(arguments.runs)]
        checks.append(judge(load, use, runs))
        rows += [row(load, use, number, run) for number, run in enumerate(runs, 1)]
    print(text_table(RUN_HEADER, rows))
    print()
    print(text_table(CHECK_HEADER, [check.row for check in checks]))
    if arguments.write:
        write_document(checks, rows, arguments.seconds)
        print(f'wrote {DOCUMENT.relative_to(ROOT)}')
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
