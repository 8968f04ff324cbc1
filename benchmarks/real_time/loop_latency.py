"""Latency from y to v through DDS beside a bare echo node, and the speed of lockstep."""

import sys
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.publisher import Publisher
from real_time import measuring
from real_time.measuring import DEADLINE_S, MeasuringNode, node_command, processes, wait_for_event
from reporting import Check, Measured
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_plant, build_reference
from backlash_ros.core.parameters import BY_NAME, CONTROLLER, Parameters

RATES_HZ = (100.0, 1000.0)
LOOPS = (('moving_horizon', 'proportional'), ('moving_horizon', 'tracking'),
         ('lms', 'proportional'))
BLOCK, SETTLE = 50, 10  # samples of a block, and how many of them at its start do not count
WARM_UP_S = 3.0  # acquisition is not counted either
PATIENCE_S = 0.2  # for an answer
LATENCY_LIMITS = {0.5: 1.0, 0.99: 1.2}  # times the echo, by quantile
LOCKSTEP_SAMPLES = 3000


@dataclass
class Latencies:
    """Times from question to answer [s], and questions without an answer."""

    controller: list[float] = field(default_factory=list)
    echo: list[float] = field(default_factory=list)
    unanswered: int = 0

    def ratio(self, quantile: float) -> float:
        return float(np.quantile(self.controller, quantile) / np.quantile(self.echo, quantile))


LATENCY_HEADER = ('loop', 'rate', '', 'y to v [us]', 'echo [us]', 'ratio', 'samples')


class Driver(MeasuringNode):
    """A plant driver that asks controller and echo, and measures how long each takes."""

    def __init__(self, domain: int, parameters: Parameters) -> None:
        super().__init__(domain)
        self._plant, self._reference = build_plant(parameters), build_reference(parameters)
        self._period = parameters.sample_period
        self._v = self._v_before = 0.0
        self._v_came_at = 0.0
        self._answered_at: float | None = None
        self._asked = self._y_m, self._y, self._question = [
            self.node.create_publisher(Float64, topic, 1)
            for topic in (topics.REFERENCE, topics.PLANT_OUTPUT, 'echo/in')]
        self._answers = [
            self.node.create_subscription(Float64, topics.CONTROL, self._on_control, 1),
            self.node.create_subscription(Float64, 'echo/out', self._on_echo, 1)]

    def _on_control(self, message: Float64, info: dict[str, Any]) -> None:
        self._answered_at = time.perf_counter()
        # What arrives in time counts, even if nobody has looked at it yet.
        waited_ns = time.time_ns() - info['received_timestamp']
        self._v_came_at = self._answered_at - 1e-9 * max(waited_ns, 0)
        self._v_before, self._v = self._v, message.data

    def _on_echo(self, message: Float64) -> None:
        self._answered_at = time.perf_counter()

    def connected(self) -> bool:
        return all(p.get_subscription_count() for p in self._asked) and all(
            s.get_publisher_count() for s in self._answers)

    def _ask(self, publisher: Publisher, value: float) -> float | None:
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
        result = Latencies()
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
    # The same waves per sample at every rate: G is given in samples, not in seconds. While the
    # echo is asked the controller hears nothing, which is no silence of the driver.
    parameters = Parameters({
        'sample_period': 1.0 / rate, 'estimator.law': law, 'estimator.output_noise_std': 1e-3,
        'timeout.plant_output': 0.0, 'output_noise_std': 1e-3, 'frequency': 0.126 * rate,
        **(changes or {}),
    })
    commands = {
        'controller': node_command('controller', {
            p.name: parameters[p.name] for p in BY_NAME.values()
            if CONTROLLER in p.used_by and parameters[p.name] != p.default}),
        'echo': [sys.executable, str(Path(__file__).with_name('echo_node.py'))],
    }
    with processes(commands) as (supervisor, domain):
        with closing(Driver(domain, parameters)) as driver:
            driver.wait_for(driver.connected, DEADLINE_S, 'the nodes')
            result = driver.measure(duration_s)
        measuring.check_running(supervisor)
    if not (result.controller and result.echo):
        raise RuntimeError(f'{law}, {rate:g} Hz: nobody answered')
    return result


def measure_latencies(duration_s: float) -> Measured:
    """Of every loop at every rate: p50 and p99 of controller and echo, and the bounds on them."""
    rows, checks = [], []
    for (law, structure), rate in product(LOOPS, RATES_HZ):
        name = f'{law}, {structure}'
        found = measure_latency(rate, law, duration_s, {'structure': structure})
        for q, limit in LATENCY_LIMITS.items():
            us = [f'{1e6 * np.quantile(of, q):.0f}' for of in (found.controller, found.echo)]
            rows.append([name, f'{rate:g} Hz', f'p{100 * q:g}', *us, f'{found.ratio(q):.2f}',
                         f'{len(found.controller)} + {len(found.echo)}'])
            checks.append(Check(
                f'y to v / bare echo, p{100 * q:g}, {name}, {rate:g} Hz', f'<= {limit:g}',
                f'{found.ratio(q):.2f}', found.ratio(q) <= limit))
        if found.unanswered:
            print(f'{name}, {rate:g} Hz: {found.unanswered} samples without an answer')
    return rows, checks


def lockstep_speed(law: str, samples: int = LOCKSTEP_SAMPLES) -> float:
    """Samples per second of plant, controller and reference as processes in lockstep."""
    values = {'lockstep': True, 'samples': samples, 'estimator.law': law, 'seed': 1}
    commands = {name: node_command(name, values) for name in ('controller', 'reference', 'plant')}
    with processes(commands) as (supervisor, _):
        started = wait_for_event(supervisor, 'ready', 'plant')
        done = wait_for_event(supervisor, 'done', 'plant')
    return samples / (done - started)
