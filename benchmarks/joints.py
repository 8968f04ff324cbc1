"""One controller with six joints beside six controllers with one each: time, memory, latency.

    python benchmarks/joints.py --law lms --rate 100 --seconds 20

A node of the benchmark is the driver of all joints, six simulated plants with play: it publishes
their outputs every period and waits for the commands that answer them. Half a period later it asks
a bare rclpy node that answers with what it gets: what is late there is late because of the machine.
Processor time and memory are those of all processes of the controllers, workers included, once the
backlash is known; ratios of them say more than the figures of a busy machine.
"""

import sys
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from functools import partial
from math import sin
from pathlib import Path

import numpy as np
import psutil
from builtin_interfaces.msg import Time
from real_time.costs import processor_s, resident_mb
from real_time.measuring import MeasuringNode, node_command, processes, wait_for_event
from reporting import format_table, parser_of
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header

from backlash_ros.core import Parameters, build_plant

JOINTS = tuple(f'joint_{i}' for i in range(1, 7))
WARM_UP_S = 6.0  # acquisition is not counted
MEETING_S = 60.0  # longest wait until all listen
NOISE_STD = 4.4e-4  # of y, that of an encoder with 12 bits
# A servo of 4 Hz at 100 Hz; at other rates it is another one, which costs the same.
COMMON: dict[str, object] = {
    'structure': 'tracking', 'tracking.preview': 20, 'plant.numerator': [0.02, 0.018],
    'plant.denominator': [1.0, -1.75, 0.79], 'estimator.initial.m': 1.0,
    'estimator.initial.c_r': 0.01, 'estimator.initial.c_l': -0.01, 'control.rate_max': 5.0,
    'control.min': -3.0, 'control.max': 3.0, 'estimator.output_noise_std': NOISE_STD,
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
    """The plants of all joints: publishes references and outputs, and takes the commands.

    heard: messages of commands so far. echoed: answers of the echo so far.
    """

    def __init__(self, domain: int, together: bool, rate: float) -> None:
        super().__init__(domain)
        self.heard = self.echoed = 0
        self._together, self._rate = together, rate
        self._plants = [build_plant(Parameters({
            **COMMON, 'sample_period': 1.0 / rate, 'backlash.m': 1.0, 'backlash.c_r': 0.012,
            'backlash.c_l': -0.011, 'output_noise_std': NOISE_STD, 'seed': i,
        })) for i in range(len(JOINTS))]
        self._v = [0.0] * len(JOINTS)
        node = self.node
        self._states = node.create_publisher(JointState, 'robot_joint_states', 10)
        self._question = node.create_publisher(Float64, 'echo/in', 1)
        node.create_subscription(Float64, 'echo/out', self._take_echo, 1)
        if together:
            node.create_subscription(JointState, 'joint_commands', self._take_all, 100)
            self._references = [node.create_publisher(JointState, 'robot_joint_command', 10)]
        else:
            for i, joint in enumerate(JOINTS):
                node.create_subscription(
                    Float64MultiArray, f'{joint}/commands', partial(self._take, i), 100)
            self._references = [
                node.create_publisher(Float64, f'{joint}/reference', 10) for joint in JOINTS]

    def _take_all(self, message: JointState) -> None:
        self._v = list(message.position)
        self.heard += 1

    def _take(self, i: int, message: Float64MultiArray) -> None:
        self._v[i] = message.data[0]
        self.heard += 1

    def _take_echo(self, message: Float64) -> None:
        self.echoed += 1

    def all_listen(self) -> bool:
        """Whether every controller hears both its reference and its output."""
        return self._states.get_subscription_count() >= len(self._references) and all(
            each.get_subscription_count() for each in (*self._references, self._question))

    def sample(self, k: int) -> tuple[float, float]:
        """Period k, beginning now; times until all commands and the echo were there [s], or nan."""
        period_s, begin = 1.0 / self._rate, time.perf_counter()
        # The same motion per sample at every rate, as G is given in samples.
        y_m = [0.3 * sin(0.02 * k + i) for i in range(len(JOINTS))]
        y = [plant.measure() for plant in self._plants]
        stamp_ns, heard, asked = time.time_ns(), self.heard, time.perf_counter()
        self._states.publish(JointState(
            header=Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)),
            name=JOINTS, position=y,
        ))
        wanted = heard + len(self._references)
        answered_s = self._time_until(lambda: self.heard >= wanted, asked, begin + period_s)
        if self._together:
            self._references[0].publish(JointState(name=JOINTS, position=y_m))
        else:
            for publisher, value in zip(self._references, y_m, strict=True):
                publisher.publish(Float64(data=value))
        self.wait_till(begin + 0.5 * period_s)
        asked, echoed = time.perf_counter(), self.echoed
        self._question.publish(Float64(data=y[0]))
        echoed_s = self._time_until(lambda: self.echoed > echoed, asked, begin + period_s)
        self.wait_till(begin + period_s)
        for plant, v in zip(self._plants, self._v, strict=True):
            plant.step(v)
        return answered_s, echoed_s

    def _time_until(self, condition: Callable[[], bool], asked: float, end: float) -> float:
        while not condition():
            left = end - time.perf_counter()
            if left <= 0.0:
                return np.nan
            self.executor.serve_urgent(int(1e9 * left))
        return time.perf_counter() - asked


def measure(together: bool, law: str, rate: float, seconds: float) -> list[str]:
    """A row: start-up, processor time, memory, latency, commands that came too late."""
    controllers = commands(together, law, 1.0 / rate)
    echo = [sys.executable, str(Path(__file__).parent / 'real_time' / 'echo_node.py')]
    begin = time.perf_counter()
    with processes({**controllers, 'echo': echo}) as (supervisor, domain):
        wait_for_event(supervisor, 'ready', *controllers)
        start_up = time.perf_counter() - begin
        pids = [child.process.pid for child in supervisor.children if child.name != 'echo']
        with closing(Driver(domain, together, rate)) as driver:
            driver.wait_for(driver.all_listen, MEETING_S, 'controllers that listen')
            warm_up = round(rate * WARM_UP_S)
            for k in range(warm_up):
                driver.sample(k)
            used, first = used_s(pids), time.perf_counter()
            latencies, echoes = np.array([
                driver.sample(warm_up + k) for k in range(round(rate * seconds))
            ]).T
            share = (used_s(pids) - used) / (time.perf_counter() - first)
            memory_mb = sum(map(resident_mb, family(pids)))
        supervisor.stop()
    (p50, p99), (echo_p50, echo_p99) = (
        1e3 * np.nanpercentile(each, (50, 99)) for each in (latencies, echoes))
    return [
        'six joints in one' if together else 'six controllers', f'{start_up:.1f}',
        f'{100.0 * share:.1f}', f'{memory_mb:.0f}', f'{p50:.2f}', f'{p99:.2f}',
        f'{p50 / echo_p50:.2f}', f'{p99 / echo_p99:.2f}', f'{1e3 * np.nanmax(latencies):.1f}',
        f'{int(np.isnan(latencies).sum())} of {len(latencies)}', f'{int(np.isnan(echoes).sum())}',
    ]


def family(pids: Iterable[int]) -> list[int]:
    """These processes and all that they have started."""
    each = [psutil.Process(pid) for pid in pids]
    return [one.pid for first in each for one in (first, *first.children(recursive=True))]


def used_s(pids: Iterable[int]) -> float:
    """Time of processors that they and all that they have started have used [s]."""
    return sum(map(processor_s, family(pids)))


def main() -> None:
    """Print a table of both."""
    parser = parser_of(__doc__)
    parser.add_argument('--law', default='moving_horizon')
    parser.add_argument('--rate', type=float, default=100.0, help='[Hz]')
    parser.add_argument('--seconds', type=float, default=20.0)
    options = parser.parse_args()
    header = ('', 'ready [s]', 'processor [%]', 'memory [MB]', 'p50 [ms]', 'p99 [ms]',
              'p50 / echo', 'p99 / echo', 'max [ms]', 'late', 'late echo')
    print(format_table(header, [
        measure(together, options.law, options.rate, options.seconds) for together in (True, False)
    ]))


if __name__ == '__main__':
    main()
