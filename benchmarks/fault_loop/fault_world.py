"""What surrounds the controller in the fault campaign: a plant, a driver, a sensor, a clock.

One tick is one sample period. The command that acts over it is the newest one that has come by its
end, as docs/architecture.md has it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from backlash_ros.core.assembly import build_plant, build_reference
from backlash_ros.core.loop.sample_counter import Output
from backlash_ros.core.parameters import Parameters

START_NS = 1_800_000_000_000_000_000
TRANSIT = 0.05  # of a period: how long a message is under way
ANSWER = 0.1  # of a period: when the answer to a message leaves
REPORT_NS = 1000  # by which a report leaves before its output
SPIKES, LOSSES = 0.1, 0.3  # share of the samples while such a fault lasts


@dataclass
class Actuator:
    """What v is, whoever has commanded it."""

    v: float = 0.0


@dataclass
class Sensor:
    """What becomes of y on its way. fault: '' for none."""

    rng: np.random.Generator
    swing: float  # of a sound y
    fault: str = ''
    value: float = 0.0  # that a constant sensor shows
    last: float = 0.0

    def seen(self, y: float, tick: int) -> float:
        """What is measured instead of y."""
        chance = float(self.rng.random())
        if self.fault == 'sign':
            return -y
        if self.fault == 'constant':
            return self.value
        if self.fault == 'stuck':
            return self.last
        if self.fault == 'another axis':
            return self.swing * float(np.sin(0.037 * tick + 1.0))
        if self.fault == 'spikes' and chance < SPIKES:
            return y + 100.0 * self.swing * float(self.rng.standard_normal())
        if self.fault == 'nan' and chance < LOSSES:
            return float(self.rng.choice([np.nan, np.inf, -np.inf, 1e300]))
        self.last = y
        return y


SENSOR_FAULTS = ('sign', 'constant', 'stuck', 'another axis', 'spikes', 'nan')


@dataclass
class Driver:
    """Publishes y, applies the newest v, and reports it where it is asked to.

    origin: the v that a motor encoder shows where v is 0. slow: share by which its period is longer
    than it is told. jitter: share of a period by which stamps scatter.
    """

    p: Parameters
    rng: np.random.Generator
    actuator: Actuator
    sensor: Sensor
    reports: bool
    origin: float = 0.0
    slow: float = 0.0
    jitter: float = 0.0
    loses: bool = False
    loses_reports: bool = False
    repeats: bool = False
    down_until: int = 0
    offset_ns: int = 0  # of its clock, and of that of everybody
    tick: int = 0
    number: int = 0
    outputs: list[Output] = field(default_factory=list)  # on their way to the controller
    applied: list[tuple[float, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.plant = build_plant(self.p)
        self.reference: Callable[[float], float] = build_reference(self.p)
        self.period_ns = round(self.p.sample_period * 1e9 * (1.0 + self.slow))

    @property
    def time_ns(self) -> int:
        """Of the present sample."""
        return START_NS + self.tick * self.period_ns + self.offset_ns

    @property
    def answered_ns(self) -> int:
        """When the controller answers it."""
        return self.time_ns + round(ANSWER * self.period_ns)

    def advance(self) -> None:
        """Let one period pass, with the v that acts, and publish the sample at its end."""
        v = self.actuator.v
        self.plant.step(v)
        self.tick += 1
        y = self.sensor.seen(self.plant.measure(), self.tick)
        if self.tick < self.down_until:
            return
        if self.tick == self.down_until:
            self.number = 0
        self.number += 1
        now = self.time_ns
        if self.jitter:
            now += round(self.rng.random() * self.jitter * self.period_ns)
        if self.reports and not (self.loses_reports and self.rng.random() < LOSSES):
            self.applied.append((v + self.origin, now - REPORT_NS))
        if self.loses and self.rng.random() < LOSSES:
            return
        output = Output(y, now, now, now + round(TRANSIT * self.period_ns), self.number)
        self.outputs.append(output)
        if self.repeats and self.rng.random() < LOSSES:
            self.number += 1
            early = now + round(0.1 * self.period_ns)
            self.outputs.append(output._replace(stamp_ns=early, sequence=self.number))
