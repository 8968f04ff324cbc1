"""One controller with six joints beside six controllers with one each: time, memory, latency.

    python benchmarks/joints.py --law lms --rate 100 --seconds 20

A node of the benchmark is the driver of all joints: it publishes a message of outputs every period
and waits for the commands that answer it. Processor time and memory are those of all processes of
the controllers, workers included; ratios of them say more than the figures of a busy machine.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from contextlib import closing
from math import sin
from pathlib import Path

import numpy as np
from builtin_interfaces.msg import Time
from real_time.costs import processor_s, resident_mb
from real_time.measuring_node import MeasuringNode
from real_time.node_processes import node_command, processes, wait_for_event
from reporting import text_table
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header

JOINTS = tuple(f'joint_{i}' for i in range(1, 7))
WARM_UP = 0.25  # share of the samples before anything is measured
MEETING_S = 60.0  # longest wait until all listen
# A servo of 4 Hz at 100 Hz; at other rates it is another one, which costs the same.
COMMON: dict[str, object] = {
    'structure': 'tracking', 'tracking.preview': 20, 'plant.numerator': [0.02, 0.018],
    'plant.denominator': [1.0, -1.75, 0.79], 'estimator.initial.m': 1.0,
    'estimator.initial.c_r': 0.01, 'estimator.initial.c_l': -0.01, 'control.rate_max': 5.0,
    'control.min': -3.0, 'control.max': 3.0, 'estimator.output_noise_std': 4.4e-4,
}


def commands(together: bool, law: str, period_s: float) -> dict[str, list[str]]:
    """How to start the controllers."""
    common = {**COMMON, 'estimator.law': law, 'sample_period': period_s}
    if together:
        return {'controller': node_command('controller', {
            **common, 'joints': list(JOINTS), 'io.style': 'joint_state_topic',
        })}
    return {joint: [
        *node_command('controller', {**common, 'io.style': 'ros2_control', 'io.joint': joint}),
        '-r', f'__node:={joint}', '-r', f'reference:={joint}/reference',
        '-r', 'joint_states:=robot_joint_states',
        '-r', f'forward_command_controller/commands:={joint}/commands',
    ] for joint in JOINTS}


class Driver(MeasuringNode):
    """Publishes references and outputs of all joints, and counts the commands that come."""

    def __init__(self, domain: int, together: bool) -> None:
        super().__init__(domain)
        self.heard, self._together = 0, together
        self._states = self.node.create_publisher(JointState, 'robot_joint_states', 10)
        heard = [(JointState, 'joint_commands')] if together else [
            (Float64MultiArray, f'{joint}/commands') for joint in JOINTS]
        for kind, topic in heard:
            self.node.create_subscription(kind, topic, self._count, 100)
        told = [(JointState, 'robot_joint_command')] if together else [
            (Float64, f'{joint}/reference') for joint in JOINTS]
        self._references = [self.node.create_publisher(*of, 10) for of in told]

    def _count(self, message: object) -> None:
        self.heard += 1

    def all_listen(self) -> bool:
        """Whether every controller hears both its reference and its output."""
        return self._states.get_subscription_count() >= len(self._references) and all(
            each.get_subscription_count() for each in self._references)

    def sample(self, t: float, period_s: float) -> float:
        """One period, beginning now; returns the time until all commands were there [s], or nan."""
        y_m, y = ([0.3 * sin(0.8 * t + i - late) for i in range(len(JOINTS))] for late in (0, 0.1))
        if self._together:
            self._references[0].publish(JointState(name=JOINTS, position=y_m))
        else:
            for publisher, value in zip(self._references, y_m, strict=True):
                publisher.publish(Float64(data=value))
        begin, stamp_ns, before = time.perf_counter(), time.time_ns(), self.heard
        self._states.publish(JointState(
            header=Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)),
            name=JOINTS, position=y,
        ))
        while self.heard < before + len(self._references):
            left = period_s - (time.perf_counter() - begin)
            if left <= 0.0:
                return np.nan
            self.spin(left)
        return time.perf_counter() - begin


def measure(together: bool, law: str, rate: float, seconds: float) -> list[str]:
    """A row: start-up, processor time, memory, latency, commands that came too late."""
    period_s, samples = 1.0 / rate, round(rate * seconds)
    begin = time.perf_counter()
    with processes(commands(together, law, period_s)) as (supervisor, domain):
        waited = {child.name for child in supervisor.children}
        while waited:
            wait_for_event(
                supervisor, lambda kind, who: kind == 'ready' and waited.discard(who) is None
            )
        start_up = time.perf_counter() - begin
        pids = [child.process.pid for child in supervisor.children]
        with closing(Driver(domain, together)) as driver:
            if not driver.wait_for(driver.all_listen, MEETING_S):
                raise RuntimeError(f'not all controllers listen within {MEETING_S:g} s')
            latencies, used, first = [], 0.0, 0.0
            next_s = time.perf_counter()
            for k in range(samples):
                if k == round(WARM_UP * samples):
                    latencies, used, first = [], used_s(pids), time.perf_counter()
                latencies.append(driver.sample(k * period_s, period_s))
                next_s = max(next_s + period_s, time.perf_counter())
                while (left := next_s - time.perf_counter()) > 0.0:
                    driver.spin(left)
            share = (used_s(pids) - used) / (time.perf_counter() - first)
            memory_mb = sum(map(resident_mb, family(pids)))
        supervisor.stop()
    p50, p99 = 1e3 * np.nanpercentile(latencies, (50, 99))
    return [
        'six joints in one' if together else 'six controllers', f'{start_up:.1f}',
        f'{100.0 * share:.1f}', f'{memory_mb:.0f}', f'{p50:.2f}', f'{p99:.2f}',
        f'{int(np.isnan(latencies).sum())} of {len(latencies)}',
    ]


def family(pids: Iterable[int]) -> list[int]:
    """These processes and all that they have started."""
    found = list(pids)
    for pid in found:
        for task in Path(f'/proc/{pid}/task').iterdir():
            found += map(int, (task / 'children').read_text().split())
    return found


def used_s(pids: Iterable[int]) -> float:
    """Time of processors that they and all that they have started have used [s]."""
    return sum(map(processor_s, family(pids)))


def main() -> None:
    """Print a table of both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--law', default='moving_horizon')
    parser.add_argument('--rate', type=float, default=100.0, help='[Hz]')
    parser.add_argument('--seconds', type=float, default=20.0)
    options = parser.parse_args()
    header = ('', 'ready [s]', 'processor [%]', 'memory [MB]', 'p50 [ms]', 'p99 [ms]', 'late')
    print(text_table(header, [
        measure(together, options.law, options.rate, options.seconds) for together in (True, False)
    ]))


if __name__ == '__main__':
    main()
