"""Latency from y to v through DDS beside a bare echo node, and the speed of lockstep."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from reporting import Check
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_plant, build_reference
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.table import BY_NAME, CONTROLLER
from real_time.measuring_node import MeasuringNode
from real_time.node_processes import (
    DEADLINE_S,
    check_running,
    node_command,
    processes,
    wait_for_event,
)

RATES_HZ = (100.0, 1000.0)
BLOCK, SETTLE = 50, 10  # samples of a block, and how many of them at its start do not count
WARM_UP_S = 3.0  # acquisition is not counted either
PATIENCE_S = 0.2  # for an answer
LATENCY_LIMITS = {0.5: 1.0, 0.99: 1.2}  # times the echo, by quantile
LOCKSTEP_SAMPLES = 3000


@dataclass
class Latencies:
    """Times from question to answer [s] of one rate, and questions without an answer."""

    rate: float
    controller: list[float] = field(default_factory=list)
    echo: list[float] = field(default_factory=list)
    unanswered: int = 0

    def ratio(self, quantile: float) -> float:
        """Quantile of the controller over that of the echo."""
        return float(np.quantile(self.controller, quantile) / np.quantile(self.echo, quantile))

    @property
    def rows(self) -> list[list[str]]:
        """Cells: rate, p50 and p99 of controller and echo in us, their ratio, how many."""
        rows = []
        for quantile in (0.5, 0.99):
            of_controller = 1e6 * float(np.quantile(self.controller, quantile))
            of_echo = 1e6 * float(np.quantile(self.echo, quantile))
            rows.append([
                f'{self.rate:g} Hz', f'p{100 * quantile:g}', f'{of_controller:.0f}',
                f'{of_echo:.0f}', f'{self.ratio(quantile):.2f}',
                f'{len(self.controller)} + {len(self.echo)}',
            ])
        return rows


LATENCY_HEADER = ('rate', '', 'y to v [us]', 'echo [us]', 'ratio', 'samples')


class Driver(MeasuringNode):
    """A plant driver that asks controller and echo, and measures how long each takes."""

    def __init__(self, domain: int, parameters: Parameters) -> None:
        super().__init__(domain)
        self._plant, self._reference = build_plant(parameters), build_reference(parameters)
        self._period = parameters.sample_period
        self._v = self._v_before = 0.0
        self._v_came_at = 0.0
        self._answered_at: float | None = None
        node = self.node
        self._y_m = node.create_publisher(Float64, topics.REFERENCE, 1)
        self._y = node.create_publisher(Float64, topics.PLANT_OUTPUT, 1)
        self._question = node.create_publisher(Float64, 'echo/in', 1)
        self._answers = [
            node.create_subscription(Float64, topics.CONTROL, self._on_control, 1),
            node.create_subscription(Float64, 'echo/out', self._on_echo, 1),
        ]

    def _on_control(self, message: Float64, info: dict[str, Any]) -> None:
        self._answered_at = time.perf_counter()
        # What arrives in time counts, even if nobody has looked at it yet.
        waited_ns = time.time_ns() - info['received_timestamp']
        self._v_came_at = self._answered_at - 1e-9 * max(waited_ns, 0)
        self._v_before, self._v = self._v, message.data

    def _on_echo(self, message: Float64) -> None:
        self._answered_at = time.perf_counter()

    def _connected(self) -> bool:
        publishers = (self._y_m, self._y, self._question)
        return all(p.get_subscription_count() for p in publishers) and all(
            s.get_publisher_count() for s in self._answers)

    def connect(self) -> None:
        """Return once everybody is heard and the controller has a reference."""
        if not self.wait_for(self._connected, DEADLINE_S):
            raise RuntimeError(f'the nodes were not there within {DEADLINE_S:g} s')

    def _ask(self, publisher: rclpy.publisher.Publisher, value: float) -> float | None:
        message = Float64(data=value)
        self._answered_at = None
        start = time.perf_counter()
        publisher.publish(message)
        while self._answered_at is None:
            self.executor.serve_urgent(int(1e9 * PATIENCE_S))
            if self._answered_at is None and time.perf_counter() - start > PATIENCE_S:
                return None
        return self._answered_at - start

    def measure(self, duration_s: float) -> Latencies:
        """Be the plant, and ask both in alternating blocks, once the controller is warmed up."""
        result = Latencies(1.0 / self._period)
        start, tick = time.perf_counter(), 0
        while (now := time.perf_counter() - start) < WARM_UP_S + duration_s:
            due = int(now / self._period) + 1
            time.sleep(max(due * self._period - now, 0.0))
            # Who has overslept goes on with the sample of now.
            due = max(due, int((time.perf_counter() - start) / self._period))
            while tick < due:
                tick += 1
                # A sample that was skipped while an answer was late still ended without it.
                in_time = tick == due or self._v_came_at < start + tick * self._period
                self._plant.step(self._v if in_time else self._v_before)
            counts = now >= WARM_UP_S
            asks_controller = not counts or due // BLOCK % 2 == 0
            t = due * self._period
            passed = self._ask_controller(t) if asks_controller else self._ask(self._question, t)
            if not counts or due % BLOCK < SETTLE:
                continue
            if passed is None:
                result.unanswered += 1
            else:
                (result.controller if asks_controller else result.echo).append(passed)
        return result

    def _ask_controller(self, t: float) -> float | None:
        # Later than its y, so that the controller answers y with nothing else on its hands.
        passed = self._ask(self._y, self._plant.measure())
        self._y_m.publish(Float64(data=self._reference(t + self._period)))
        return passed


def measure_latency(
    rate: float, law: str, duration_s: float, changes: Mapping[str, object] | None = None,
) -> Latencies:
    """Latency of a controller process with this law at this rate, beside an echo."""
    # The same waves per sample at every rate: G is given in samples, not in seconds. While the
    # echo is asked the controller hears nothing, which is no silence of the driver.
    parameters = Parameters({
        'sample_period': 1.0 / rate, 'estimator.law': law, 'estimator.output_noise_std': 1e-3,
        'timeout.plant_output': 0.0, 'output_noise_std': 1e-3, 'frequency': 0.126 * rate,
        **(changes or {}),
    })
    commands = {
        'controller': node_command('controller', _values_of(CONTROLLER, parameters)),
        'echo': [sys.executable, str(Path(__file__).with_name('echo_node.py'))],
    }
    with processes(commands) as (supervisor, domain):
        driver = Driver(domain, parameters)
        try:
            driver.connect()
            result = driver.measure(duration_s)
        finally:
            driver.close()
        check_running(supervisor)
    if not (result.controller and result.echo):
        raise RuntimeError(f'{law}, {rate:g} Hz: nobody answered')
    return result


def _values_of(executable: str, parameters: Parameters) -> dict[str, object]:
    return {
        parameter.name: parameters[parameter.name] for parameter in BY_NAME.values()
        if executable in parameter.used_by and parameters[parameter.name] != parameter.default
    }


def latency_checks(found: Latencies, law: str) -> list[Check]:
    """The bounds on the ratio to the echo."""
    return [
        Check(f'y to v / bare echo, p{100 * quantile:g}, {law}, {found.rate:g} Hz',
              f'<= {limit:g}', f'{found.ratio(quantile):.2f}', found.ratio(quantile) <= limit)
        for quantile, limit in LATENCY_LIMITS.items()
    ]


def lockstep_speed(law: str, samples: int = LOCKSTEP_SAMPLES) -> float:
    """Samples per second of plant, controller and reference as processes in lockstep."""
    values = {'lockstep': True, 'samples': samples, 'estimator.law': law, 'seed': 1}
    commands = {name: node_command(name, values) for name in ('controller', 'reference', 'plant')}
    with processes(commands) as (supervisor, _):
        started = wait_for_event(supervisor, lambda kind, who: (kind, who) == ('ready', 'plant'))
        done = wait_for_event(supervisor, lambda kind, _: kind == 'done')
    return samples / (done - started)
