"""What a controller and a reference cost: processor time, memory, start, and growth at 1 kHz."""

import os
import re
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
from real_time.measuring import DEADLINE_S, MeasuringNode, node_command, processes, wait_for_event
from reporting import Check, Measured
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core import Parameters, build_plant

COST_HEADER = ('rate', 'process', 'processor [%]', 'per sample [us]', '/ echo', 'memory [MB]')
COST_RATES_HZ = (100.0, 200.0)
WARM_UP_S = 6.0  # acquisition is not counted
MEMORY_LIMIT_MB, START_LIMIT_S = 80.0, 1.0
NODES = ('controller', 'its fits', 'reference', 'echo')


class Driver(MeasuringNode):
    """A plant that publishes y at a steady rate, and a number for an echo at the same time."""

    def __init__(self, domain: int, parameters: Parameters) -> None:
        super().__init__(domain)
        self._plant, self._v = build_plant(parameters), 0.0
        self._period_s = parameters.sample_period
        self.first_command_at = np.nan
        self._y = self.node.create_publisher(Float64, topics.PLANT_OUTPUT, 10)
        self._number = self.node.create_publisher(Float64, 'echo/in', 10)
        self.node.create_subscription(Float64, topics.CONTROL, self._take, 10)

    def _take(self, message: Float64) -> None:
        self._v = message.data
        if not self.first_command_at > 0.0:
            self.first_command_at = time.perf_counter()

    def run(self, samples: int) -> None:
        """Publish so many samples, one every period."""
        next_s = time.perf_counter()
        for _ in range(samples):
            self._y.publish(Float64(data=self._plant.measure()))
            self._number.publish(Float64(data=self._v))
            next_s = max(next_s + self._period_s, time.perf_counter())
            self.wait_till(next_s)
            self._plant.step(self._v)

    def wait_for_command(self) -> float:
        """Publish until a command comes; when that was."""
        end = time.perf_counter() + DEADLINE_S
        while not self.first_command_at > 0.0:
            if time.perf_counter() > end:
                raise RuntimeError(f'no command came within {DEADLINE_S:g} s')
            self.run(1)
        return self.first_command_at


def measure_costs(duration_s: float) -> Measured:
    """Rows of a table, and the bounds, for the example of the paper."""
    found = [costs_at(rate, duration_s) for rate in COST_RATES_HZ]
    return [row for rows, _ in found for row in rows], [one for _, each in found for one in each]


def costs_at(rate: float, duration_s: float) -> Measured:
    common = {'sample_period': 1.0 / rate}
    of_the_loop = {**common, 'estimator.output_noise_std': 1e-3}
    commands = {
        'controller': node_command('controller', of_the_loop),
        'reference': node_command('reference', {**common, 'frequency': 0.02 * rate}),
        'echo': [sys.executable, str(Path(__file__).with_name('echo_node.py'))],
    }
    with processes(commands) as (supervisor, domain):
        wait_for_event(supervisor, 'ready', 'controller')
        began, p = time.perf_counter(), Parameters({**of_the_loop, 'output_noise_std': 1e-3})
        with closing(Driver(domain, p)) as driver:
            first_s = driver.wait_for_command() - began
            driver.run(round(WARM_UP_S * rate))
            pids = {child.name: child.process.pid for child in supervisor.children}
            worker = Path(f'/proc/{pids["controller"]}/task/{pids["controller"]}/children')
            pids['its fits'] = int(worker.read_text().split()[0])
            samples = round(duration_s * rate)
            before, began = {name: processor_s(pid) for name, pid in pids.items()}, time.time()
            driver.run(samples)
            passed_s = time.time() - began
            used = {name: processor_s(pid) - before[name] for name, pid in pids.items()}
            memory = {name: resident_mb(pid) for name, pid in pids.items()}
        supervisor.stop()
    rows = [[
        f'{rate:g} Hz', name, f'{100.0 * used[name] / passed_s:.1f}',
        f'{1e6 * used[name] / samples:.0f}', f'{used[name] / used["echo"]:.2f}',
        f'{memory[name]:.0f}',
    ] for name in NODES]
    of = f'{rate:g} Hz: '
    return rows, [
        Check(f'{of}memory of the controller without its worker [MB]', f'<= {MEMORY_LIMIT_MB:g}',
              f'{memory["controller"]:.0f}', memory['controller'] <= MEMORY_LIMIT_MB),
        Check(f'{of}first command after the first y of the driver [s]', f'<= {START_LIMIT_S:g}',
              f'{first_s:.2f}', first_s <= START_LIMIT_S),
    ]


def processor_s(pid: int) -> float:
    """Time of processors that all threads of a process have used [s]."""
    return 1e-9 * sum(int((task / 'schedstat').read_text().split()[0])
                      for task in Path(f'/proc/{pid}/task').iterdir())


def resident_mb(pid: int) -> float:
    pages = int(Path(f'/proc/{pid}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 2**20


PERIOD_S = 1e-3
GROWTH_LIMIT_MB = 1.0
WARM_UP = 0.5  # share of the time before memory is looked at: records and histories fill up once
# G(z) of the paper's example at a period of 1 ms.
PLANT = {
    'plant.numerator': [1.994012e-7, 7.952171e-7, 1.982084e-7],
    'plant.denominator': [1.0, -2.98805183, 2.97612354, -0.98807171],
    'sample_period': PERIOD_S,
}


def soak_checks(seconds: float) -> list[Check]:
    """Plant, reference and controller for so long."""
    samples = round(seconds / PERIOD_S)
    waiting = {'wait_for_subscribers': 1}
    commands = {
        'controller': node_command(
            'controller', {**PLANT, **waiting, 'estimator.output_noise_std': 1e-3}),
        'reference': node_command('reference', {'sample_period': PERIOD_S, **waiting}),
        'plant': node_command(
            'plant', {**PLANT, **waiting, 'samples': samples, 'output_noise_std': 1e-3}),
    }
    with processes(commands) as (supervisor, _):
        wait_for_event(supervisor, 'ready', 'plant')
        time.sleep(WARM_UP * seconds)
        controller = next(c for c in supervisor.children if c.name == 'controller')
        before = resident_mb(controller.process.pid)
        time.sleep((1.0 - WARM_UP) * seconds - 1.0)
        growth = resident_mb(controller.process.pid) - before
        wait_for_event(supervisor, 'done', 'plant', patience_s=2.0 * seconds)
        supervisor.stop()
        said = controller.log.read_text().strip().splitlines()[-1]
    counts = dict(re.findall(r'([a-z][a-z ]*): (\d+)', said))
    lost, unsent = (int(counts.get(name, 0)) for name in ('lost', 'of these never sent'))
    return [
        Check(f'1 kHz: samples lost between plant and controller, of {counts["samples"]}', '0',
              str(lost - unsent), lost == unsent),
        Check('1 kHz: samples for which the machine let the plant wake too late', '0',
              str(unsent), not unsent),
        Check(f'memory of the controller after {(1.0 - WARM_UP) * seconds:g} s [MB]',
              f'< {GROWTH_LIMIT_MB:g}', f'{growth:+.3f}', growth < GROWTH_LIMIT_MB),
    ]
