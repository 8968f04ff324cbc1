"""What a controller and a reference cost: processor time per sample, memory, time to the start."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from reporting import Check
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_plant
from backlash_ros.core.parameters import Parameters
from real_time.measuring_node import MeasuringNode
from real_time.node_processes import DEADLINE_S, node_command, processes, wait_for_event

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
            while (left := next_s - time.perf_counter()) > 0.0:
                self.executor.serve_urgent(int(1e9 * left))
            self._plant.step(self._v)

    def wait_for_command(self) -> float:
        """Publish until a command comes; when that was."""
        end = time.perf_counter() + DEADLINE_S
        while not self.first_command_at > 0.0:
            if time.perf_counter() > end:
                raise RuntimeError(f'no command came within {DEADLINE_S:g} s')
            self.run(1)
        return self.first_command_at


def measure_costs(
    rate: float, duration_s: float, changes: Mapping[str, object] | None = None,
) -> tuple[list[list[str]], list[Check]]:
    """Rows of a table, and the bounds, for the example of the paper at this rate."""
    common = {'sample_period': 1.0 / rate}
    of_the_loop = {**common, 'estimator.output_noise_std': 1e-3, **(changes or {})}
    commands = {
        'controller': node_command('controller', of_the_loop),
        'reference': node_command('reference', {**common, 'frequency': 0.02 * rate}),
        'echo': [sys.executable, str(Path(__file__).with_name('echo_node.py'))],
    }
    with processes(commands) as (supervisor, domain):
        wait_for_event(supervisor, lambda kind, who: (kind, who) == ('ready', 'controller'))
        began = time.perf_counter()
        driver = Driver(domain, Parameters({**of_the_loop, 'output_noise_std': 1e-3}))
        try:
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
        finally:
            driver.close()
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
    return 1e-9 * sum(
        int((task / 'schedstat').read_text().split()[0])
        for task in Path(f'/proc/{pid}/task').iterdir()
    )


def resident_mb(pid: int) -> float:
    """Memory of a process [MB]."""
    pages = int(Path(f'/proc/{pid}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 2**20
