"""One controller with six joints beside six controllers with one each: time, memory, latency.

    python benchmarks/joints.py --law lms --rate 100 --seconds 20
    python benchmarks/joints.py --bus --seconds 600

A node of the benchmark is the driver of all joints: it publishes a message of outputs every period
and waits for the commands that answer it. Processor time and memory are those of all processes of
the controllers, workers included; ratios of them say more than the figures of a busy machine.
--bus: the arm of physics instead, behind test/servo_bus.py, examples/bus_servo_driver.py and the
trajectory of examples/joint_trajectory.py: cycles, and whether each that was lost was counted.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Iterable
from math import sin
from pathlib import Path

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from rclpy.executors import SingleThreadedExecutor
from real_time.costs import processor_s, resident_mb
from real_time.node_processes import node_command, processes, processes_in, wait_for_event
from reporting import ROOT, text_table
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header

JOINTS = tuple(f'joint_{i}' for i in range(1, 7))
# Joints of the arm of physics.
SERVOS = ('waist', 'shoulder', 'elbow', 'forearm_roll', 'wrist_pitch', 'wrist_roll')
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


class Driver:
    """Publishes references and outputs of all joints, and counts the commands that come."""

    def __init__(self, domain: int, together: bool) -> None:
        rclpy.init(domain_id=domain)
        self.node, self._executor = rclpy.create_node('driver'), SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.heard, self._together = 0, together
        self._states = self.node.create_publisher(JointState, 'robot_joint_states', 10)
        if together:
            self._listen(JointState, 'joint_commands')
            self._references = [self.node.create_publisher(JointState, 'robot_joint_command', 10)]
        else:
            for joint in JOINTS:
                self._listen(Float64MultiArray, f'{joint}/commands')
            self._references = [
                self.node.create_publisher(Float64, f'{joint}/reference', 10) for joint in JOINTS
            ]

    @property
    def answers(self) -> int:
        """How many messages answer one of outputs."""
        return len(self._references)

    def meet(self) -> None:
        """Wait until all controllers listen."""
        end = time.monotonic() + MEETING_S
        while self._states.get_subscription_count() < self.answers or not all(
            each.get_subscription_count() for each in self._references
        ):
            self.spin(0.05)
            if time.monotonic() > end:
                raise RuntimeError(f'not all controllers listen within {MEETING_S:g} s')

    def sample(self, t: float, period_s: float) -> float:
        """One period, beginning now; returns the time until all commands were there [s], or nan."""
        y_m = [0.3 * sin(0.8 * t + i) for i in range(len(JOINTS))]
        if self._together:
            self._references[0].publish(JointState(name=JOINTS, position=y_m))
        else:
            for publisher, value in zip(self._references, y_m, strict=True):
                publisher.publish(Float64(data=value))
        y = [0.3 * sin(0.8 * t + i - 0.1) for i in range(len(JOINTS))]
        begin, stamp_ns, before = time.perf_counter(), time.time_ns(), self.heard
        self._states.publish(JointState(
            header=Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)),
            name=JOINTS, position=y,
        ))
        while self.heard < before + self.answers:
            left = period_s - (time.perf_counter() - begin)
            if left <= 0.0:
                return np.nan
            self.spin(left)
        return time.perf_counter() - begin

    def spin(self, seconds: float) -> None:
        """Listen."""
        self._executor.spin_once(timeout_sec=max(seconds, 0.0))

    def close(self) -> None:
        """Leave."""
        self.node.destroy_node()
        rclpy.shutdown()

    def _listen(self, kind: type, topic: str) -> None:
        def count(message: object) -> None:
            self.heard += 1

        self.node.create_subscription(kind, topic, count, 100)


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
        driver = Driver(domain, together)
        try:
            driver.meet()
            latencies, used, first = [], 0.0, 0.0
            pids = [child.process.pid for child in supervisor.children]
            next_s = time.perf_counter()
            for k in range(samples):
                if k == round(WARM_UP * samples):
                    latencies, used, first = [], used_s(pids), time.perf_counter()
                latencies.append(driver.sample(k * period_s, period_s))
                next_s = max(next_s + period_s, time.perf_counter())
                while (left := next_s - time.perf_counter()) > 0.0:
                    driver.spin(left)
            share = (used_s(pids) - used) / (time.perf_counter() - first)
            memory_mb = sum(resident_mb(pid) for pid in family(pids))
        finally:
            driver.close()
        supervisor.stop()
    late = int(np.isnan(latencies).sum())
    p50, p99 = 1e3 * np.nanpercentile(latencies, (50, 99))
    return [
        'six joints in one' if together else 'six controllers', f'{start_up:.1f}',
        f'{100.0 * share:.1f}', f'{memory_mb:.0f}', f'{p50:.2f}', f'{p99:.2f}',
        f'{late} of {len(latencies)}',
    ]


class BusWatch:
    """Counts what the driver of the bus publishes, and knows from its numbers what it missed."""

    def __init__(self, domain: int) -> None:
        rclpy.init(domain_id=domain)
        self.node, self._executor = rclpy.create_node('watch'), SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.heard = self.incomplete = self.published = 0
        self.node.create_subscription(JointState, 'robot_joint_states', self._count, 1000)

    def _count(self, message: JointState, info: dict[str, int]) -> None:
        self.heard += 1
        self.incomplete += len(message.name) < len(SERVOS)
        self.published = info['publication_sequence_number']

    def spin(self, seconds: float) -> None:
        """Listen for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def close(self) -> None:
        """Leave."""
        self.node.destroy_node()
        rclpy.shutdown()


def soak(seconds: float, rate: float) -> str:
    """The bus for so long; a table of what was counted."""
    with tempfile.TemporaryDirectory() as folder:
        port, python = str(Path(folder) / 'port'), [sys.executable]
        servos = {'servos': [*python, str(ROOT / 'test' / 'servo_bus.py'), port]}
        with processes({
            'driver': [
                *python, str(ROOT / 'examples' / 'bus_servo_driver.py'), '--port', port, '--rate',
                str(rate), '--joints', *(f'{name}={i + 1}' for i, name in enumerate(SERVOS)),
            ],
            'controller': [*node_command('controller', {}), '--ros-args', '--params-file',
                           str(ROOT / 'config' / 'arm.yaml')],
            'trajectory': [*python, str(ROOT / 'examples' / 'joint_trajectory.py'), *SERVOS],
        }) as (supervisor, domain):
            watch, driver = BusWatch(domain), supervisor.children[0].process
            try:
                # Without a port the driver publishes nothing, so that nothing is missed here.
                while not watch.node.count_publishers('robot_joint_states'):
                    watch.spin(0.1)
                watch.spin(1.0)
                with processes_in(domain, servos):
                    watch.spin(seconds)
                    driver.terminate()
                    while driver.poll() is None:
                        watch.spin(0.1)
                watch.spin(1.0)
                supervisor.stop()
            finally:
                watch.close()
            logs = {child.name: child.log.read_text() for child in supervisor.children}
    found = re.search(r'(\d+) cycles, (\d+) of them lost', logs['driver'])
    if found is None:
        raise RuntimeError(logs['driver'])
    cycles, lost = map(int, found.groups())
    complete = watch.published - watch.incomplete
    print(*(line for line in logs['controller'].splitlines() if 'samples: ' in line), sep='\n')
    return text_table(('of the bus', 'number'), [[name, str(count)] for name, count in (
        ('cycles', cycles), ('of them lost, as the driver says', lost),
        ('messages with all joints', complete),
        ('messages that were not heard here', watch.published - watch.heard),
        ('lost and not counted', cycles - lost - complete),
    )])


def family(pids: Iterable[int]) -> list[int]:
    """These processes and all that they have started."""
    parents = {}
    for each in Path('/proc').iterdir():
        if each.name.isdigit():
            try:
                parents[int(each.name)] = int(_stat(int(each.name))[1])
            except OSError:  # it has ended meanwhile
                continue
    found = list(pids)
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found


def used_s(pids: Iterable[int]) -> float:
    """Time of processors that they and all that they have started have used [s]."""
    return sum(map(processor_s, family(pids)))


def _stat(pid: int) -> list[str]:
    """What stands in /proc behind the name of the process: state, parent, ..."""
    return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()


def main() -> None:
    """Print a table of both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--law', default='moving_horizon')
    parser.add_argument('--rate', type=float, default=100.0, help='[Hz]')
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('--bus', action='store_true')
    options = parser.parse_args()
    if options.bus:
        print(soak(options.seconds, options.rate))
        return
    header = ('', 'ready [s]', 'processor [%]', 'memory [MB]', 'p50 [ms]', 'p99 [ms]', 'late')
    print(text_table(header, [
        measure(together, options.law, options.rate, options.seconds) for together in (True, False)
    ]))


if __name__ == '__main__':
    main()
