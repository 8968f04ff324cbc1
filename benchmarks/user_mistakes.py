"""What a user sees of a mistake: the line in the controller's terminal, and how soon it is there.

    python benchmarks/user_mistakes.py [--case NAME]

Controller, reference and examples/motor_driver.py run with config/geared_motor.yaml, each as a
process. Each case makes one mistake; the line that names it must be in the terminal and in
/diagnostics within 3 s. What is wrong from the start counts from the first output on. Further
cases are no mistakes: a sensor with an offset, a G(z) that is far too slow, half of every processor
taken by something else. Nothing may be an error then. Last, in simulated time, drivers that are 0
to 9 % slow, for --minutes each: their rate is named, and nothing else.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from math import inf, isfinite
from pathlib import Path

# Before rclpy reads it, and before numpy is imported.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('OMP_NUM_THREADS', '1')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from fault_loop.sound_driver import blamed
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from real_time.node_processes import NODES
from reporting import CHECK_HEADER, ROOT, Check, machine, processors, text_table

from backlash_ros import topics
from backlash_ros.middleware.loopback import prefer_loopback
from backlash_ros.tools.bringup.environment import child_environment, free_domain

CONFIG = ROOT / 'config' / 'geared_motor.yaml'
BUSY_LOOP = ROOT / 'benchmarks' / 'real_time' / 'busy_loop.py'
BOUND_S = 3.0
LONGEST_S = 15.0  # that a line is waited for
START_S = 30.0  # for the processes to begin
SOUND_S = 3.0  # of the loop before a mistake that is made while it runs
LOOK_S = 0.02
LOAD, SOUND_FOR_S, BUSY, SLOW = 0.5, 25.0, 'busy machine', 'slow drivers'
STALL_S = 0.012  # the controller is held up so long, after every look
# Of a load that is five times as slow as the one that is there.
SLOW_LOAD = ('plant.numerator:=[0.0069, 0.0062]', 'plant.denominator:=[1.0, -1.8593, 0.8724]')

# motor_driver.py with one fault, from the start or from SIGUSR1 on.
DRIVER = """
import signal, sys
import motor_driver
from motor_driver import Float64
from rclpy.qos import QoSProfile, ReliabilityPolicy
fault, begun = sys.argv[1], []
signal.signal(signal.SIGUSR1, lambda *_: begun.append(True))
if fault == 'rate':
    motor_driver.motor = motor_driver.SimulatedMotor(0.02)
    motor_driver.SAMPLE_PERIOD_S = 0.02
if fault == 'slow':
    motor_driver.SAMPLE_PERIOD_S *= 1.06
if fault == 'offset':
    read_without = motor_driver.read_motor_position
    motor_driver.read_motor_position = lambda: read_without() + 0.06
if fault == 'reversed':
    write = motor_driver.write_motor_position
    motor_driver.write_motor_position = lambda v: write(-v)
    read = motor_driver.read_motor_position
    motor_driver.read_motor_position = lambda: -read()
class Faulty(motor_driver.MotorDriver):
    def create_publisher(self, kind, topic, depth):
        if topic == 'plant_output' and fault == 'type':
            from std_msgs.msg import Float32
            kind = Float32
        if topic == 'plant_output' and fault == 'best_effort':
            depth = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        publisher = super().create_publisher(kind, topic, depth)
        if topic == 'plant_output':
            publish = publisher.publish
            def send(message):
                publish(kind(data=float('nan') if fault == 'nan' and begun else message.data))
            publisher.publish = send
        return publisher
motor_driver.MotorDriver = Faulty
motor_driver.main()
"""


@dataclass(frozen=True)
class Mistake:
    """One mistake. words: what of the line names the cause. fault: of the driver. given: further
    arguments of the controller. made: what is done once the loop runs, None where it is wrong from
    the start.
    """

    name: str
    words: str
    fault: str = 'none'
    given: tuple[str, ...] = ()
    made: Callable[[Scene], None] | None = None


class Scene:
    """A controller, a reference and a driver, and what the controller says."""

    def __init__(self, folder: Path, domain: int, stack: ExitStack) -> None:
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.said: list[tuple[float, DiagnosticStatus]] = []  # in /diagnostics, with the time [s]
        self.stalled = False  # the controller is held up again and again
        self._folder, self._stack = folder, stack
        self._environment = child_environment(folder, domain)
        paths = [str(ROOT / 'examples'), str(ROOT), self._environment.get('PYTHONPATH', '')]
        self._environment['PYTHONPATH'] = os.pathsep.join(filter(None, paths))
        prefer_loopback(os.environ)
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        stack.callback(lambda: rclpy.shutdown(context=context))
        self.node = Node('listener', context=context)
        self.node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._hear, 100)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        stack.callback(self._executor.shutdown)

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a process whose terminal is a file."""
        with (self._folder / name).open('wb') as terminal:
            process = subprocess.Popen(
                [sys.executable, *command], env=self._environment, stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=terminal,
            )
        self.processes[name] = process
        self._stack.callback(self._end, process)

    def start_node(self, name: str, *given: str) -> None:
        """Start a node of the package with the shipped file."""
        self.start(name, [
            '-m', f'{NODES}.{name.split()[0]}', '--ros-args', '--params-file', str(CONFIG), *given,
        ])

    def lines(self, name: str = 'controller') -> list[str]:
        """What stands in a terminal so far."""
        return (self._folder / name).read_text().splitlines()

    def pass_time(self) -> None:
        """Listen for a moment."""
        if self.stalled:
            controller = self.processes['controller']
            controller.send_signal(signal.SIGSTOP)
            time.sleep(STALL_S)
            controller.send_signal(signal.SIGCONT)
        self._executor.spin_once(timeout_sec=LOOK_S)

    def wait_for(self, condition: Callable[[], object], longest_s: float) -> bool:
        """Listen until the condition holds; whether it does."""
        deadline = time.monotonic() + longest_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.pass_time()
        return True

    def _hear(self, message: DiagnosticArray) -> None:
        self.said += [
            (time.monotonic(), status) for status in message.status
            if status.name == 'controller'
        ]

    @staticmethod
    def _end(process: subprocess.Popen[bytes]) -> None:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGCONT)
        process.kill()
        process.wait()


@contextmanager
def scene() -> Iterator[Scene]:
    """Processes in a domain of their own; all are gone afterwards."""
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain, ExitStack() as stack:
        yield Scene(Path(folder), domain, stack)


def second_controller(scene: Scene) -> None:
    scene.start_node('controller two', '-r', '__node:=second')


def broken_sensor(scene: Scene) -> None:
    scene.processes['driver'].send_signal(signal.SIGUSR1)


def no_driver(scene: Scene) -> None:
    scene.processes['driver'].kill()


def late_commands(scene: Scene) -> None:
    scene.stalled = True


MISTAKES = (
    Mistake('wrong rate', 'Hz, sample_period is 0.005 s (200 Hz)', 'rate'),
    Mistake('rate 6 % slow', 'Hz, sample_period is 0.005 s (200 Hz)', 'slow'),
    Mistake('second controller', '/second', made=second_controller),
    Mistake('NaN sensor', 'is no finite number: check the sensor', made=broken_sensor, fault='nan'),
    Mistake('wrong type', 'is sent as Float32, Float64 is wanted', 'type'),
    Mistake('best effort', 'is sent best effort, which does not arrive', 'best_effort'),
    Mistake('driver gone', 'is the driver running?', made=no_driver),
    Mistake('v late', 'of control came too late', made=late_commands),
    Mistake('motor reversed', 'moves against v: reverse it', 'reversed'),
)
# What is no mistake: fault of the driver, arguments of the controller, whether processors are busy.
SOUND: dict[str, tuple[str, tuple[str, ...], bool]] = {
    'offset of y': ('offset', (), False),
    'G five times too slow': ('none', SLOW_LOAD, False),
    BUSY: ('none', (), True),
}


@dataclass(frozen=True)
class Seen:
    """When the cause was named [s after the mistake], inf if it was not; the line that did."""

    terminal_s: float
    diagnostics_s: float
    line: str


def watch(mistake: Mistake) -> Seen:
    """Make a mistake and look for the line that names it."""
    with scene() as on:
        on.start_node('controller', *(part for p in mistake.given for part in ('-p', p)))
        on.start_node('reference')
        on.wait_for(lambda: on.said, START_S)
        on.start('driver', ['-c', DRIVER, mistake.fault])
        on.wait_for(lambda: on.node.count_publishers(topics.PLANT_OUTPUT), START_S)
        if mistake.made is not None:
            deadline = time.monotonic() + SOUND_S
            on.wait_for(lambda: time.monotonic() > deadline, 2.0 * SOUND_S)
            mistake.made(on)
        begin, terminal_s, before = time.monotonic(), inf, len(on.lines())

        def diagnostics_s() -> float:
            return next((
                at - begin for at, status in on.said
                if at > begin and mistake.words in status.message
            ), inf)

        def named() -> bool:
            nonlocal terminal_s
            if any(mistake.words in line for line in on.lines()[before:]):
                terminal_s = min(terminal_s, time.monotonic() - begin)
            return isfinite(terminal_s) and isfinite(diagnostics_s())

        on.wait_for(named, LONGEST_S)
        lines = on.lines()[before:]
        found = [line for line in lines if mistake.words in line]
        return Seen(terminal_s, diagnostics_s(), found[0] if found else '\n'.join(lines))


def judge(mistake: Mistake, seen: Seen) -> Check:
    """The bound for one mistake."""
    return Check(
        mistake.name, f'<= {BOUND_S:g} s',
        f'terminal {seen.terminal_s:.2f} s, /diagnostics {seen.diagnostics_s:.2f} s',
        max(seen.terminal_s, seen.diagnostics_s) <= BOUND_S,
    )


def check_sound(name: str) -> Check:
    """Whether a loop that makes no mistake is never called an error."""
    fault, given, busy = SOUND[name]
    with scene() as on:
        on.start_node('controller', *(part for p in given for part in ('-p', p)))
        on.start_node('reference')
        on.wait_for(lambda: on.said, START_S)
        for i in range(processors() if busy else 0):
            on.start(f'load {i}', [str(BUSY_LOOP), str(LOAD)])
        on.start('driver', ['-c', DRIVER, fault])
        on.wait_for(lambda: on.node.count_publishers(topics.PLANT_OUTPUT), START_S)
        deadline = time.monotonic() + SOUND_FOR_S
        on.wait_for(lambda: time.monotonic() > deadline, 2.0 * SOUND_FOR_S)
        levels = [status.level for _, status in on.said]
        print('\n  '.join([f'{name}:', *on.lines()]), flush=True)
        changes = sum(a != b for a, b in pairwise(levels))
        errors = levels.count(DiagnosticStatus.ERROR)
        return Check(
            f'{name}, for {SOUND_FOR_S:g} s', 'no ERROR',
            f'{errors} of {len(levels)} are ERROR, {changes} changes of the level', errors == 0,
        )


def check_slow(minutes: float) -> Iterator[Check]:
    """Whether no healthy part is blamed though a driver does not keep its rate."""
    for hz in (50.0, 100.0, 200.0, 500.0):
        for slow in (0.0, 0.005, 0.03, 0.09):
            values = {
                'output_noise_std': 1e-3, 'estimator.output_noise_std': 1e-3,
                'plant.uncertainty': 0.2, 'frequency': 0.126 * hz,
                'structure': 'tracking' if slow == 0.03 else 'proportional',
            }
            _, kinds = blamed(hz, slow, 0.05, 60.0 * minutes, values)
            yield Check(
                f'{hz:g} Hz, {slow:.1%} slow, for {minutes:g} min', 'rate' if slow else 'nothing',
                ', '.join(kinds) or 'nothing', set(kinds) == ({'rate'} if slow else set()),
            )


def main() -> int:
    """Return 0 if every bound holds, else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--case', choices=[*(each.name for each in MISTAKES), *SOUND, SLOW],
                        action='append',
                        help='instead of all; may be repeated')
    parser.add_argument('--minutes', type=float, default=0.5, help='of each slow driver')
    arguments = parser.parse_args()
    print(machine())
    checks = []
    for mistake in MISTAKES:
        if arguments.case and mistake.name not in arguments.case:
            continue
        seen = watch(mistake)
        print(f'{mistake.name}:\n  {seen.line}', flush=True)
        checks.append(judge(mistake, seen))
    checks += [check_sound(name) for name in SOUND if name in (arguments.case or SOUND)]
    if SLOW in (arguments.case or [SLOW]):
        checks += check_slow(arguments.minutes)
    print()
    print(text_table(CHECK_HEADER, [check.row for check in checks]))
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
