"""What a user sees of a mistake: the line in the controller's terminal, and how soon it is there.

    python benchmarks/user_mistakes.py [--case NAME]

Controller, reference and examples/motor_driver.py run with config/geared_motor.yaml, each as a
process. Each case makes one mistake; the line that names it must be in the terminal and in
/diagnostics within 3 s. What is wrong from the start counts from the first output on. Further
cases are no mistakes: a sensor with an offset, a G(z) that is far too slow, half of every processor
taken by something else. Nothing may be an error then. Last, in simulated time, drivers that are 0
to 9 % slow, for --minutes each: their rate is named, and nothing else.
"""

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from itertools import pairwise, product
from math import inf
from typing import NamedTuple

# Before numpy is imported.
os.environ.setdefault('OMP_NUM_THREADS', '1')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from fault_loop.fault_controller import blamed
from real_time.measuring import DEADLINE_S, MeasuringNode, node_command, processes_in
from reporting import CHECK_HEADER, ROOT, Check, format_table, machine, parser_of, processors

from backlash_ros import topics
from backlash_ros.tools.bringup.supervisor import Child, free_domain

BOUND_S, LONGEST_S = 3.0, 15.0  # in which a line is to be there, and that it is waited for
SOUND_S = 3.0  # of the loop before a mistake that is made while it runs
SOUND_FOR_S, BUSY, SLOW = 25.0, 'busy machine', 'slow drivers'
STALL_S = 0.012  # the controller is held up so long, after every look
# Of a load that is five times as slow as the one that is there.
SLOW_LOAD = ('plant.numerator:=[0.0069, 0.0062]', 'plant.denominator:=[1.0, -1.8593, 0.8724]')

# motor_driver.py with one fault, from the start or from SIGUSR1 on.
DRIVER = """
import signal, sys
fault, examples = sys.argv[1:]
sys.path.append(examples)
import motor_driver
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float32
begun = []
signal.signal(signal.SIGUSR1, lambda *_: begun.append(True))
read, write = motor_driver.read_motor_position, motor_driver.write_motor_position
if fault == 'rate':
    motor_driver.motor, motor_driver.SAMPLE_PERIOD_S = motor_driver.SimulatedMotor(0.02), 0.02
if fault == 'slow':
    motor_driver.SAMPLE_PERIOD_S *= 1.06
if fault == 'offset':
    motor_driver.read_motor_position = lambda: read() + 0.06
if fault == 'reversed':
    motor_driver.write_motor_position = lambda v: write(-v)
    motor_driver.read_motor_position = lambda: -read()
class Faulty(motor_driver.MotorDriver):
    def create_publisher(self, kind, topic, depth):
        if topic != 'plant_output':
            return super().create_publisher(kind, topic, depth)
        if fault == 'type':
            kind = Float32
        if fault == 'best_effort':
            depth = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        publisher = super().create_publisher(kind, topic, depth)
        publish = publisher.publish
        publisher.publish = lambda message: publish(
            kind(data=float('nan') if fault == 'nan' and begun else message.data))
        return publisher
motor_driver.MotorDriver = Faulty
motor_driver.main()
"""
# Half of a processor, until it is ended.
BUSY_LOOP = """
import time
while True:
    begun, until = time.monotonic(), time.process_time() + 0.025
    while time.process_time() < until:
        pass
    time.sleep(max(begun + 0.05 - time.monotonic(), 0.0))
"""


class Scene(MeasuringNode):
    """A controller, a reference and a driver, and what the controller says."""

    def __init__(self, domain: int, stack: ExitStack, given: Sequence[str]) -> None:
        super().__init__(domain)
        self.said: list[tuple[float, DiagnosticStatus]] = []  # in /diagnostics, with the time [s]
        self.stalled = False  # the controller is held up again and again
        self._domain, self._stack = domain, stack
        self.controller = self.start('controller', *(part for p in given for part in ('-p', p)))
        self.start('reference')
        self.node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._hear, 100)

    def start(self, name: str, *given: str) -> Child:
        """Start a node of the package with the shipped file, or other code."""
        config = str(ROOT / 'config' / 'geared_motor.yaml')
        command = [sys.executable, '-c', *given] if name in ('driver', 'load') else [
            *node_command(name, {}), '--ros-args', '--params-file', config, *given]
        return self._stack.enter_context(processes_in(self._domain, {name: command})).children[0]

    def lines(self) -> list[str]:
        return self.controller.log.read_text().splitlines()

    def spin(self, seconds: float) -> None:
        if self.stalled:
            self.controller.process.send_signal(signal.SIGSTOP)
            time.sleep(STALL_S)
            self.controller.process.send_signal(signal.SIGCONT)
        super().spin(seconds)

    def go_on(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        self.wait_for(lambda: time.monotonic() > deadline, inf)

    def _hear(self, message: DiagnosticArray) -> None:
        self.said += [(time.monotonic(), status) for status in message.status
                      if status.name == 'controller']


@contextmanager
def scene(fault: str, given: Sequence[str] = (), busy: int = 0) -> Iterator[tuple[Scene, Child]]:
    """The loop, and its driver, once it publishes; all are gone afterwards."""
    with free_domain() as domain, ExitStack() as stack:
        on = stack.enter_context(closing(Scene(domain, stack, given)))
        on.wait_for(lambda: on.said, DEADLINE_S)
        for _ in range(busy):
            on.start('load', BUSY_LOOP)
        driver = on.start('driver', DRIVER, fault, str(ROOT / 'examples'))
        on.wait_for(lambda: on.node.count_publishers(topics.PLANT_OUTPUT), DEADLINE_S)
        yield on, driver


class Mistake(NamedTuple):
    """One mistake. words: what of the line names the cause. fault: of the driver. made: what is
    done once the loop runs, None where it is wrong from the start.
    """

    words: str
    fault: str = 'none'
    made: Callable[[Scene, Child], object] | None = None


MISTAKES = {
    'wrong rate': Mistake('Hz, sample_period is 0.005 s (200 Hz)', 'rate'),
    'rate 6 % slow': Mistake('Hz, sample_period is 0.005 s (200 Hz)', 'slow'),
    'second controller': Mistake(
        '/second', made=lambda on, driver: on.start('controller', '-r', '__node:=second')),
    'NaN sensor': Mistake('is not a finite number: check the sensor', 'nan',
                          lambda on, driver: driver.process.send_signal(signal.SIGUSR1)),
    'wrong type': Mistake('is sent as Float32, Float64 is wanted', 'type'),
    'best effort': Mistake('is sent best effort, which does not arrive', 'best_effort'),
    'driver gone': Mistake('is the driver running?', made=lambda on, driver: driver.process.kill()),
    'v late': Mistake('of control came too late',
                      made=lambda on, driver: setattr(on, 'stalled', True)),
    'motor reversed': Mistake('moves against v: reverse it', 'reversed'),
}
# What is no mistake: fault of the driver, arguments of the controller, busy processors.
SOUND: dict[str, tuple[str, tuple[str, ...], int]] = {
    'offset of y': ('offset', (), 0),
    'G five times too slow': ('none', SLOW_LOAD, 0),
    BUSY: ('none', (), processors()),
}


def check_mistake(name: str) -> Check:
    words, fault, made = MISTAKES[name]
    with scene(fault) as (on, driver):
        if made is not None:
            on.go_on(SOUND_S)
            made(on, driver)
        begin, before = time.monotonic(), len(on.lines())
        after_s = {'terminal': inf, '/diagnostics': inf}

        def named() -> bool:
            said = {'terminal': on.lines()[before:],
                    '/diagnostics': [status.message for at, status in on.said if at > begin]}
            for place, texts in said.items():
                if any(words in text for text in texts):
                    after_s[place] = min(after_s[place], time.monotonic() - begin)
            return max(after_s.values()) < inf

        on.wait_for(named, LONGEST_S)
        lines = on.lines()[before:]
    found = [line for line in lines if words in line][:1] or lines
    print('\n  '.join([f'{name}:', *found]), flush=True)
    return Check(name, f'<= {BOUND_S:g} s',
                 ', '.join(f'{place} {s:.2f} s' for place, s in after_s.items()),
                 max(after_s.values()) <= BOUND_S)


def check_sound(name: str) -> Check:
    """Whether a loop that makes no mistake is never called an error."""
    with scene(*SOUND[name]) as (on, _):
        on.go_on(SOUND_FOR_S)
        levels, lines = [status.level for _, status in on.said], on.lines()
    print('\n  '.join([f'{name}:', *lines]), flush=True)
    errors = levels.count(DiagnosticStatus.ERROR)
    changes = sum(a != b for a, b in pairwise(levels))
    said = f'{errors} of {len(levels)} are ERROR, {changes} changes of the level'
    return Check(f'{name}, for {SOUND_FOR_S:g} s', 'no ERROR', said, errors == 0)


def check_slow(minutes: float) -> Iterator[Check]:
    """Whether no healthy part is blamed though a driver does not keep its rate."""
    for hz, slow in product((50.0, 100.0, 200.0, 500.0), (0.0, 0.005, 0.03, 0.09)):
        _, kinds = blamed(hz, slow, 0.05, 60.0 * minutes, {
            'output_noise_std': 1e-3, 'estimator.output_noise_std': 1e-3,
            'plant.uncertainty': 0.2, 'frequency': 0.126 * hz,
            'structure': 'tracking' if slow == 0.03 else 'proportional'})
        yield Check(f'{hz:g} Hz, {slow:.1%} slow, for {minutes:g} min',
                    'rate' if slow else 'nothing', ', '.join(kinds) or 'nothing',
                    set(kinds) == ({'rate'} if slow else set()))


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument('--case', choices=[*MISTAKES, *SOUND, SLOW], action='append',
                        help='instead of all; may be repeated')
    parser.add_argument('--minutes', type=float, default=0.5, help='of each slow driver')
    arguments = parser.parse_args()
    wanted = arguments.case or [*MISTAKES, *SOUND, SLOW]
    print(machine())
    checks = [check_mistake(name) for name in MISTAKES if name in wanted]
    checks += [check_sound(name) for name in SOUND if name in wanted]
    checks += check_slow(arguments.minutes) if SLOW in wanted else []
    print('\n' + format_table(CHECK_HEADER, [check.row for check in checks]))
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
